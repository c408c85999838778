"""A tiny parallel environment that no reader knows and no heuristic drives."""

from typing import Any

import gymnasium as gym
import numpy as np
from pettingzoo import ParallelEnv

TOY = f"{__name__}:Meadow"
LIVES = {"ant_0": 2, "bee_0": 5}
"""Steps that each agent lives."""


class Meadow(ParallelEnv):
    """Everyone is paid its action; the ant dies before the bee."""

    metadata = {"name": "meadow_v0"}
    possible_agents = list(LIVES)

    def observation_space(self, agent: str) -> gym.Space:
        return _SEEN

    def action_space(self, agent: str) -> gym.Space:
        return _DONE

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict, dict]:
        self.agents, self.time = list(LIVES), 0
        return self._seen(), {agent: {} for agent in self.agents}

    def step(self, actions: dict[str, Any]) -> tuple[dict, dict, dict, dict, dict]:
        assert set(actions) == set(self.agents)
        self.time += 1
        seen = self._seen()
        ended = {agent: self.time == LIVES[agent] for agent in self.agents}
        self.agents = [agent for agent in self.agents if not ended[agent]]
        rewards = {agent: float(action) for agent, action in actions.items()}
        return seen, rewards, ended, dict.fromkeys(ended, False), {agent: {} for agent in ended}

    def render(self) -> None: ...

    def close(self) -> None: ...

    def _seen(self) -> dict[str, np.ndarray]:
        return {agent: np.full(1, self.time, np.float32) for agent in self.agents}


_SEEN, _DONE = gym.spaces.Box(0, 10, (1,), np.float32), gym.spaces.Discrete(2)
