"""What a user might bring, by name (`tests.envs.own_code:chases`): drivers, and a simulator that allows no second."""

from collections.abc import Callable
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np

from envs.readers import FunctionReader, register_reader
from tests.envs.semantics import read_crowd
from tests.envs.testing.test_check_reader import SPEC, Pushed

LANE_RIGHT, SLOWER = 2, 4


def brakes(env: gym.Env, rng: np.random.Generator) -> Callable[[Any], int]:
    """An ego that steps on the brake in every step; its function needs an environment that has been reset."""
    assert env.unwrapped.vehicle is not None  # type: ignore[attr-defined]
    return lambda observation: SLOWER


class Dodges:
    """An ego that changes its lane after as many steps as it draws, and sees the environment's own observation."""

    def __init__(self, env: gym.Env, rng: np.random.Generator) -> None:
        self.space, self.left = env.unwrapped.observation_space, int(rng.integers(1, 4))

    def __call__(self, observation: Any) -> int:
        assert self.space.contains(observation)
        self.left -= 1
        return LANE_RIGHT if self.left == 0 else 1


def flock(env: Any, rng: np.random.Generator) -> Callable[[Any], dict[str, int]]:
    """All agents of mpe2 push the same way, drawn for each episode."""
    push = int(rng.integers(1, 5))
    return lambda observations: {agent: push for agent in env.agents if agent in observations}


def wavers(env: gym.Env, rng: np.random.Generator) -> Callable[[Any], int]:
    """An ego whose function closes over its generator, a counter, itself and a module."""
    import operator

    steps = 0

    def act(observation: Any) -> int:
        nonlocal steps
        steps += 1
        assert callable(act) and operator.ge(steps, 1)
        return int(rng.integers(5)) if steps % 2 else 1

    return act


def shoves(env: Any, rng: np.random.Generator) -> Callable[[Any], dict[str, int]]:
    """All agents of mpe2 push anywhere, drawn in each step; its function closes over the environment, too."""
    return lambda observations: {agent: int(rng.integers(5)) for agent in env.agents if agent in observations}


def takes_nothing() -> Callable[[Any], int]:
    """A driver's function without the arguments that it is called with."""
    return lambda observation: 1


def sees_nothing(env: gym.Env, rng: np.random.Generator) -> Callable[[], int]:
    """A driver without the observation."""
    return lambda: 1


def adds_a_text(env: gym.Env, rng: np.random.Generator) -> Callable[[Any], int]:
    """A driver with a bug that Python calls a TypeError, too."""
    return lambda observation: 1 + "1"  # type: ignore[operator]


def a_number(env: Any, rng: np.random.Generator) -> int:
    """No driver."""
    return 3


def raises(env: Any, rng: np.random.Generator) -> Any:
    """A driver with a bug."""
    raise KeyError("goal")


def raises_later(env: Any, rng: np.random.Generator) -> Any:
    """A driver with a bug in its first step."""
    return lambda observation: {}["goal"]


class OneOnly(Pushed):
    """A simulator with an engine that a process has once: a second one raises at its reset, until the first closes."""

    running: ClassVar[Any] = None

    def __init__(self, size: int = 1) -> None:
        super().__init__(shift_m=40.0)
        self.size = size

    def reset(self, **options: Any) -> Any:
        if OneOnly.running not in (None, self):
            raise RuntimeError("there is an engine in this process already")
        OneOnly.running = self
        return super().reset(**options)

    def close(self) -> None:
        if OneOnly.running is self:
            OneOnly.running = None


READER = FunctionReader(read_crowd, SPEC)
register_reader(OneOnly, READER)
gym.register("OneOnly-v0", "tests.envs.own_code:OneOnly", max_episode_steps=12)
ONE_ONLY = "tests.envs.own_code:OneOnly-v0"
