"""Environments whose own observation is a Dict: "tests.envs.dict_crowd:DictCrowd-v0" and `dict_swarm`."""

from typing import Any

import gymnasium as gym
import numpy as np
from pettingzoo.utils import BaseParallelWrapper

from envs.readers import FunctionReader, register_reader
from tests.envs.semantics import Crowd, Swarm, read_crowd
from tests.envs.testing.test_check_reader import SPEC


class DictCrowd(Crowd):
    """The crowd, whose observation is a Dict of its table, a goal and a mode; it reports collisions and arrivals."""

    def __init__(self) -> None:
        super().__init__()
        self.observation_space = gym.spaces.Dict(
            {"table": Crowd.observation_space, "goal": gym.spaces.Box(-9, 9, (2,)), "mode": gym.spaces.Discrete(3)}
        )

    def reset(self, **options: Any) -> Any:
        table, info = super().reset(**options)
        return self._shown(table), info

    def step(self, action: Any) -> Any:
        table, reward, terminated, truncated, _ = super().step(action)
        outcome = {"collided": self.time == 3, "goal": {"reached": truncated}}
        return self._shown(table), reward, terminated, truncated, {"outcome": outcome, "crashed": False}

    def _shown(self, table: np.ndarray) -> dict[str, Any]:
        return {"table": table, "goal": np.full(2, self.time, np.float32), "mode": self.time % 3}


class MaskedSwarm(BaseParallelWrapper):
    """Adds an action mask to each agent's observation, as PettingZoo's games do."""

    def observation_space(self, agent: str) -> gym.Space:
        mask = gym.spaces.MultiBinary(2)
        return gym.spaces.Dict({"observation": self.env.observation_space(agent), "action_mask": mask})

    def reset(self, seed: int | None = None, options: Any = None) -> Any:
        shown, infos = self.env.reset(seed=seed, options=options)
        return self._masked(shown), infos

    def step(self, actions: Any) -> Any:
        shown, *others = self.env.step(actions)
        return self._masked(shown), *others

    def _masked(self, shown: Any) -> Any:
        return {a: {"observation": own, "action_mask": np.array([1, 0], np.int8)} for a, own in shown.items()}


def dict_swarm() -> Any:
    """Makes the PettingZoo environment."""
    return MaskedSwarm(Swarm())


register_reader(DictCrowd, FunctionReader(read_crowd, SPEC))
gym.register("DictCrowd-v0", DictCrowd)
