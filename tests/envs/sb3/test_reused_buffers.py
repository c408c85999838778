"""Environments that write into arrays of their own: what was seen last is what policies learn from at the end."""

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from pettingzoo import ParallelEnv

from envs import ForecastParallelEnv
from envs.readers.base import MultiagentScene
from envs.sb3.agents_as_rows import ParallelVecEnv
from predictor.scene import Scene, SceneSpec

LENGTH = 3


class Counting(ParallelEnv):
    """Two agents that see the number of the step, in arrays that every step and reset writes into."""

    metadata = {"name": "counting"}
    possible_agents = ["a", "b"]

    def __init__(self, as_dict: bool) -> None:
        self._as_dict, self.time, self.agents = as_dict, 0, list[str]()
        self._arrays = {agent: np.zeros(1, np.float32) for agent in self.possible_agents}

    def observation_space(self, agent: str) -> gym.Space:
        box = gym.spaces.Box(-9, 9, (1,), np.float32)
        return gym.spaces.Dict({"count": box}) if self._as_dict else box

    def action_space(self, agent: str) -> gym.Space:
        return gym.spaces.Discrete(2)

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict, dict]:
        self.time, self.agents = 0, list(self.possible_agents)
        return self._seen(), {agent: {} for agent in self.agents}

    def step(self, actions: dict[str, Any]) -> tuple[dict, dict, dict, dict, dict]:
        self.time += 1
        ends, names = self.time >= LENGTH, self.possible_agents
        self.agents = [] if ends else list(names)
        return self._seen(), *({agent: value for agent in names} for value in (1.0, False, ends)), {}

    def _seen(self) -> dict[str, Any]:
        for array in self._arrays.values():
            array[:] = self.time
        return {agent: {"count": array} if self._as_dict else array for agent, array in self._arrays.items()}


class CountingReader:
    """Two agents at rest; `b` stands as far from `a` as steps were made."""

    spec = SceneSpec(dt_s=1.0, max_agents=2, has_ego=False, frame=("world", "world"))

    def __init__(self, env: Any) -> None:
        pass

    def reset(self) -> None:
        pass

    def read(self, env: Any) -> MultiagentScene:
        states = np.array([[0.0, 0.0, 0.0, 0.0], [1.0 + env.unwrapped.time, 0.0, 0.0, 0.0]])
        scene = Scene(states, np.arange(2), np.ones(2, bool))
        return MultiagentScene(scene, {"a": 0, "b": 1}, np.zeros(2))


def wrapped(as_dict: bool) -> ParallelEnv:
    return ForecastParallelEnv(Counting(as_dict), "constant-velocity", reader=CountingReader)


@pytest.mark.parametrize("copies", [1, 2])
@pytest.mark.parametrize("as_dict", [False, True])
@pytest.mark.parametrize("make", [Counting, wrapped])
def test_a_reset_does_not_change_the_closing_observation(
    make: Callable[[bool], ParallelEnv], as_dict: bool, copies: int
):
    """With one copy each forecasts by itself; several share a forward, which adds forecasts after the reset."""
    venv: Any = ParallelVecEnv([lambda: make(as_dict)] * copies)
    venv.reset()
    for _ in range(LENGTH):
        opening, _, dones, infos = venv.step(np.zeros(venv.num_envs, int))
    assert dones.all()
    for i, info in enumerate(infos):
        closing = info["terminal_observation"]
        if isinstance(closing, dict):
            if make is wrapped:
                assert closing.keys() == opening.keys()
                assert closing["agents"][0][0] == (LENGTH + 1) * (1 if i % 2 == 0 else -1), "b from a, or a from b"
            closing = closing["count" if as_dict else "observation"]
        assert closing.tolist() == [LENGTH]
    assert (opening if not isinstance(opening, dict) else opening["count" if as_dict else "observation"]).max() == 0
