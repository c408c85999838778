"""Helpers of several test files: untrained policies, episodes, an environment without reader and heuristic driver."""

from typing import Any

import gymnasium as gym
import numpy as np
import torch
from pettingzoo import ParallelEnv
from stable_baselines3 import PPO

from agents.task import Task
from agents.vec_envs import EpisodeResult, make_multiagent_venv

TOY = f"{__name__}:Meadow"
STEERING = f"{__name__}:Steering-v0"
LIVES = {"ant_0": 2, "bee_0": 5}
"""Number of steps that each agent lives."""
EPISODES = [
    EpisodeResult(seed=10, episode_return=20.0, length=30, crashed=False, mean_speed_mps=22.0),
    EpisodeResult(seed=11, episode_return=10.0, length=12, crashed=True, mean_speed_mps=28.0),
    EpisodeResult(seed=12, episode_return=21.0, length=30, crashed=False, mean_speed_mps=25.0),
]
"""Episodes of one policy."""


class Meadow(ParallelEnv):
    """Environment in which each agent's reward is its action; the ant dies before the bee."""

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


class Steering(gym.Env[np.ndarray, np.ndarray]):
    """Environment with continuous actions: each episode has six steps, and the reward is the action."""

    observation_space = gym.spaces.Box(-1, 1, (2,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self._steps = 0
        return self._look(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self._steps += 1
        return self._look(), float(action[0]), False, self._steps == 6, {}

    def _look(self) -> np.ndarray:
        return self.np_random.uniform(-1, 1, size=2).astype(np.float32)


if "Steering-v0" not in gym.registry:
    gym.register("Steering-v0", entry_point=Steering)

_SEEN, _DONE = gym.spaces.Box(0, 10, (1,), np.float32), gym.spaces.Discrete(2)


def policy_for(task: Task) -> PPO:
    """Makes an untrained policy with weights so large that its actions depend on the observation."""
    venv = make_multiagent_venv(task, 1)
    kind = "MultiInputPolicy" if isinstance(venv.observation_space, gym.spaces.Dict) else "MlpPolicy"
    model = PPO(kind, venv, n_steps=4, batch_size=4 * venv.num_envs, policy_kwargs={"net_arch": [8]}, seed=0)
    with torch.no_grad():
        for parameter in model.policy.parameters():
            parameter.mul_(5.0)
    return model


def refuse(constant: str) -> None:
    """Refuses a constant that JSON does not have, as `parse_constant` of `json.loads`."""
    raise AssertionError(f"{constant} is not JSON")
