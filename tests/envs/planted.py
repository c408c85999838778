"""Environments and readers with planted mistakes, by name: `tests.envs.planted:units`."""

from typing import Any

import gymnasium as gym
import numpy as np

from envs.readers import FunctionReader, register_reader
from tests.envs.semantics import Swarm, SwarmReader, read_crowd
from tests.envs.testing.test_check_reader import MISTAKES, SPEC, Pushed, SwarmMistaken

READERS = {name.replace(" ", "_"): reader for name, (reader, _) in MISTAKES.items()}
"""Name of a reader, as it is written on a command line → reader."""


def __getattr__(name: str) -> Any:
    """Returns a reader by its name."""
    if name not in READERS:
        raise AttributeError(name)
    return READERS[name]


class Walk(Pushed):
    """Crowd whose reader is right."""

    def __init__(self) -> None:
        super().__init__(shift_m=40.0)


class Forgetful(Walk):
    """Shows the first observation of an episode in every step."""

    def reset(self, **options: Any) -> Any:
        self.first, info = super().reset(**options)
        return self.first, info

    def step(self, action: Any) -> Any:
        _, *others = super().step(action)
        return self.first, *others


class Broken(Walk):
    """Shows infinity from the third step on."""

    def step(self, action: Any) -> Any:
        observation, *others = super().step(action)
        return observation + (np.inf if self.time > 2 else 0.0), *others


class Priceless(Walk):
    """Gives a reward that is not a number."""

    def step(self, action: Any) -> Any:
        observation, _, *others = super().step(action)
        return observation, float("nan"), *others


class Unnamed(Walk):
    """Gives a text as a reward."""

    def step(self, action: Any) -> Any:
        observation, _, *others = super().step(action)
        return observation, "high", *others


class Wide(Walk):
    """Shows more than its space says."""

    observation_space = gym.spaces.Box(-1.5, 1.5, Walk.observation_space.shape, np.float64)


class Longer(Walk):
    """Shows arrays of another shape."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (3,), np.float64)


class Keyless(Walk):
    """Shows an array where its space is a Dict."""

    observation_space = gym.spaces.Dict({"table": Walk.observation_space})


class Lower(Walk):
    """Shows numbers of another type, which is no mistake."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, Walk.observation_space.shape, np.float32)


class Old(Walk):
    """Returns what gym did before gymnasium."""

    def step(self, action: Any) -> Any:
        observation, reward, terminated, truncated, info = super().step(action)
        return observation, reward, terminated or truncated, info


class Bare(Walk):
    """Resets to an observation alone."""

    def reset(self, **options: Any) -> Any:
        return super().reset(**options)[0]


class Silent(Walk):
    """Gives no info."""

    def step(self, action: Any) -> Any:
        return *super().step(action)[:4], None


class Seedless(Walk):
    """Takes no seed."""

    def reset(self) -> Any:  # type: ignore[override]
        return super().reset(seed=0)


class Falling(Walk):
    """Raises in the third step."""

    def step(self, action: Any) -> Any:
        if self.time == 2:
            raise RuntimeError("it fell")
        return super().step(action)


class Plural(Walk):
    """Ends episodes by an array."""

    def step(self, action: Any) -> Any:
        observation, reward, _, truncated, info = super().step(action)
        return observation, reward, np.zeros(2, bool), truncated, info


class FewOptions(Swarm):
    """PettingZoo environment whose reset takes no options."""

    def reset(self, seed: int | None = None) -> Any:  # type: ignore[override]
        return super().reset(seed=seed)


class NoInfos(Swarm):
    """PettingZoo environment without infos."""

    def step(self, actions: Any) -> Any:
        return *super().step(actions)[:4], None


class Chance(Walk):
    """Takes a seed and ignores it."""

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        return super().reset(seed=int(np.random.default_rng().integers(1_000_000)))


class Trembling(Walk):
    """Differs from reset to reset by what rounding does, and shows its agents in another order."""

    def reset(self, **options: Any) -> Any:
        found = super().reset(**options)
        for walker in self.people:
            walker.state += np.random.default_rng().normal(scale=1e-6, size=4)
        return found


class FastSwarm(Swarm):
    """PettingZoo environment whose reader gives km/h."""

    make_scene_reader = None


register_reader(Walk, FunctionReader(read_crowd, SPEC))
register_reader(FewOptions, SwarmReader)
register_reader(NoInfos, SwarmReader)
register_reader(FastSwarm, SwarmMistaken)


def a_number() -> int:
    """Returns no environment."""
    return 3
