"""Environments that raise, hang, die or return no finite numbers: one sentence that names environment, seed and step.

A `Place` says where an episode is. In a process that plays for another one its numbers are in memory that both see, so
that the place is known even of a process that was killed.
"""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from copy import deepcopy
from typing import Any

import gymnasium as gym
import numpy as np

from predictor.support.errors import UserError, reason_of

TIMEOUT_S = 600.0
"""Time that one step of an environment may take, in a process of its own, by default [s]."""
NUMBERS = 4
"""Number of integers that a place takes in shared memory (type code "q")."""
_SEED, _EPISODE, _STEP, _MOVES = range(NUMBERS)
_UNKNOWN = -1
_shared: Any = None


class EnvironmentFailedError(UserError):
    """Raised when an environment raised, hung, died or returned NaN or infinity."""


class Place:
    """Seed, episode and step of an environment that is played.

    Args:
        numbers: array of `NUMBERS` integers (`multiprocessing.RawArray`); None takes the one that `share` gave to this
            process, or a list.
    """

    def __init__(self, numbers: Any = None) -> None:
        """Begins before the first episode."""
        shared = _shared if numbers is None else numbers
        self._numbers: Any = [_UNKNOWN, 0, _UNKNOWN, 0] if shared is None else shared

    def __reduce__(self) -> tuple[type["Place"], tuple[list[int]]]:
        """Makes copies and pickles (of an environment with its place) begin here and count for themselves."""
        return Place, (list(self._numbers),)

    def begin(self, seed: int | None) -> None:
        """Notes that an episode begins; without a seed it is a later one of the seed before."""
        if seed is not None:
            self._numbers[_SEED], self._numbers[_EPISODE] = seed, 0
        self._numbers[_EPISODE] += 1
        self._numbers[_STEP] = 0
        self._tick()

    def move(self) -> None:
        """Notes that a step begins; steps count from 1."""
        self._numbers[_STEP] += 1
        self._tick()

    def _tick(self) -> None:
        """Counts a move; that of a copy (a branch that is played) also where another process looks for a hang."""
        self._numbers[_MOVES] += 1
        if _shared is not None and _shared is not self._numbers:
            _shared[_MOVES] += 1

    def clear(self) -> None:
        """Notes that nothing is played yet."""
        self._numbers[_SEED], self._numbers[_EPISODE], self._numbers[_STEP] = _UNKNOWN, 0, _UNKNOWN

    @property
    def moves(self) -> int:
        """Number that changes with every reset and step."""
        return self._numbers[_MOVES]

    @property
    def has_begun(self) -> bool:
        """Whether an episode has begun."""
        return self._numbers[_STEP] != _UNKNOWN

    def __str__(self) -> str:
        """Returns the place in words: "seed 3, step 12"; "before its first reset"."""
        seed, episode, step, _ = self._numbers
        if not self.has_begun:
            return "before its first reset"
        words = [] if seed == _UNKNOWN else [f"seed {seed}"]
        words += [f"episode {episode}"] if episode > 1 or seed == _UNKNOWN else []
        return ", ".join([*words, f"step {step}" if step else "its reset"])


def share(numbers: Any) -> Place:
    """Makes the places of this process use an array that another process sees, too; returns that one place."""
    global _shared
    _shared = numbers
    place = Place(numbers)
    place.clear()
    return place


class SupervisedEnv(gym.Wrapper):
    """Names the environment, seed and step in what an environment raises, and refuses NaN and infinity.

    Args:
        env: environment.
        env_id: id in messages.

    Raises:
        EnvironmentFailedError: in `reset` and `step`, if the environment raises or returns NaN or infinity.
    """

    def __init__(self, env: gym.Env, env_id: str) -> None:
        """Wraps the environment."""
        super().__init__(env)
        self._id, self._place = env_id, Place()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Resets the environment."""
        self._place.begin(seed)
        with named(self._id, self._place):
            observation, info = self.env.reset(seed=seed, options=options)
            check_numbers(observation)
        return observation, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Makes a step; an episode's last observation is a copy, as the next reset may write into the array."""
        self._place.move()
        with named(self._id, self._place):
            observation, reward, terminated, truncated, info = self.env.step(action)
            check_numbers(observation, reward)
            if terminated or truncated:
                observation = deepcopy(observation)
        return observation, reward, terminated, truncated, info


@contextmanager
def named(env_id: str, place: Place | str) -> Iterator[None]:
    """Turns what an environment raises inside the block into one sentence with its id and place.

    Raises:
        EnvironmentFailedError: the environment raised.
    """
    try:
        yield
    except EnvironmentFailedError:
        raise
    except Exception as error:
        raise EnvironmentFailedError(failure(env_id, place, reason_of(error))) from error


def failure(env_id: str, place: Place | str, reason: str) -> str:
    """Returns the sentence for an environment that failed."""
    return f"{env_id}, {place}: {reason}"


def check_numbers(observation: Any, reward: Any = 0.0) -> None:
    """Checks that neither a reward nor an observation (an array, or a Dict or Tuple of arrays) has NaN or infinity.

    Raises:
        UserError: one has.
    """
    if np.ndim(reward):
        raise UserError(f"the reward must be one number, got an array of shape {np.shape(reward)}")
    if not math.isfinite(float(reward)):
        raise UserError(f"the reward must be a finite number, got {_kind(float(reward))}")
    found = _not_finite(observation)
    if found is not None:
        raise UserError(f"the observation must be of finite numbers, got {_kind(found)}")


def _kind(number: float) -> str:
    return "NaN" if math.isnan(number) else "infinity"


def _not_finite(value: Any) -> float | None:
    """Returns a number of an observation that is not finite, if there is one."""
    if isinstance(value, dict | tuple):
        parts = value.values() if isinstance(value, dict) else value
        return next((found for part in parts if (found := _not_finite(part)) is not None), None)
    array = np.asarray(value)
    if array.dtype.kind != "f" or np.isfinite(array).all():
        return None
    return float(array[~np.isfinite(array)].flat[0])
