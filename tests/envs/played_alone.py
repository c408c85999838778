"""What one environment of a vector environment should see: the same episodes, played alone by `ForecastObservation`."""

from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from envs.wrappers import ForecastObservation
from tests.envs.helpers import short_env, short_scene_env

DURATIONS = (2, 5, 3)
"""Steps per episode of each environment, so that environments end at different times."""
STEPS = 7
SEED = 20
ACTIONS = np.random.default_rng(0).integers(5, size=(STEPS, len(DURATIONS)))
MAKERS = [partial(short_scene_env, duration) for duration in DURATIONS]


@dataclass
class Played:
    """What one environment should see, played alone by `ForecastObservation`."""

    opening: dict[str, Any]
    """The first observation."""
    steps: list[dict[str, Any]] = field(default_factory=list)
    """The observation that each step leads to; the closing one where an episode ends."""
    rewards: list[float] = field(default_factory=list)
    ends: list[bool] = field(default_factory=list)
    successors: dict[int, dict[str, Any]] = field(default_factory=dict)
    """By step at which an episode ended: the first observation of the next."""


def play_alone(i: int, checkpoint: str, idle_steps: bool = False, **options: Any) -> Played:
    """One environment for `STEPS` steps of its vector env; with `idle_steps`, the step after an end only resets.

    Options are those of the wrapper.
    """
    env = ForecastObservation(short_env(DURATIONS[i]), checkpoint, **options)
    played = Played(env.reset(seed=SEED + i)[0])
    fresh_at = -1
    for t in range(STEPS):
        if t == fresh_at:
            played.steps.append(played.successors[t - 1])
            played.rewards.append(0.0)
            played.ends.append(False)
            continue
        obs, reward, terminated, truncated, _ = env.step(int(ACTIONS[t, i]))
        played.steps.append(obs)
        played.rewards.append(float(reward))
        played.ends.append(terminated or truncated)
        if terminated or truncated:
            played.successors[t] = env.reset()[0]
            fresh_at = t + 1 if idle_steps else -1
    return played


def one_of(observations: dict[str, Any], i: int) -> dict[str, Any]:
    return {key: value[i] for key, value in observations.items()}
