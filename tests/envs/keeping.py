"""A PettingZoo environment of three steps that never takes agents out of `agents`, and its reader."""

from typing import Any

import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv

from envs.readers.base import MultiagentScene
from predictor.scene import Scene, SceneSpec

STEPS = 3


class Keeping(ParallelEnv):
    """Says by terminations alone that an episode is over."""

    metadata = {"name": "keeping_v0"}
    possible_agents = ["one", "two"]
    render_mode = None

    def observation_space(self, agent: str) -> spaces.Space:
        return spaces.Box(-100, 100, (1,), np.float32)

    def action_space(self, agent: str) -> spaces.Space:
        return spaces.Discrete(2)

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict, dict]:
        self.agents, self.time = list(self.possible_agents), 0
        return self._each(np.zeros(1, np.float32)), self._each({})

    def step(self, actions: dict) -> tuple[dict, dict, dict, dict, dict]:
        self.time += 1
        assert self.time <= STEPS, "stepped beyond the end"
        seen = self._each(np.full(1, self.time, np.float32))
        return seen, self._each(1.0), self._each(self.time == STEPS), self._each(False), self._each({})

    def _each(self, value: Any) -> dict[str, Any]:
        return dict.fromkeys(self.agents, value)


class KeepingReader:
    spec = SceneSpec(dt_s=0.1, has_ego=False, max_agents=2)

    def __init__(self, env: Any) -> None: ...

    def reset(self) -> None: ...

    def read(self, env: Any) -> MultiagentScene:
        states = np.array([[0.1 * env.unwrapped.time, 5.0 * agent, 1.0, 0.0] for agent in range(2)])
        scene = Scene(states, np.arange(2), np.ones(2, dtype=np.bool_))
        return MultiagentScene(scene, {"one": 0, "two": 1}, np.zeros(2))
