"""Actions sampled from an action space alone, for drivers of an ego and drivers of all agents."""

from collections.abc import Callable
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np

from envs.own_observation import require_space
from predictor.support.errors import UserError


def uniform_action(space: gym.Space, rng: np.random.Generator, who: str) -> Any:
    """Returns an action drawn uniformly.

    Args:
        space: Discrete or a bounded Box.
        rng: source of the draw.
        who: name of the drivers, for the message.

    Raises:
        UserError: neither Discrete nor a bounded Box.
    """
    if isinstance(space, gym.spaces.Discrete):
        return int(space.start + rng.integers(space.n))
    if isinstance(space, gym.spaces.Box) and space.is_bounded():
        return rng.uniform(space.low, space.high).astype(space.dtype)
    require_space(space, "the action space")
    raise UserError(f"{who} need a Discrete or a bounded Box action space, got {space}")


def varied_actions(space: gym.Space, rng: np.random.Generator, who: str) -> Callable[[Any], Any]:
    """Returns a driver with preferences that repeats its choices for a while; both are drawn once, for an episode.

    Args:
        space: Discrete or a bounded Box.
        rng: source of all draws.
        who: name of the drivers, for the message.
    """
    persistence = rng.uniform(0.0, 0.9)
    taste = rng.dirichlet(np.full(int(space.n), 0.7)) if isinstance(space, gym.spaces.Discrete) else None
    return partial(_varied, space, rng, who, persistence, taste, [])


def _varied(
    space: gym.Space,
    rng: np.random.Generator,
    who: str,
    persistence: float,
    taste: np.ndarray | None,
    last: list[Any],
    seen: Any,
) -> Any:
    if last and rng.random() <= persistence:
        return last[0]
    if isinstance(space, gym.spaces.Discrete):
        last[:] = [int(space.start + rng.choice(int(space.n), p=taste))]
    else:
        last[:] = [uniform_action(space, rng, who)]
    return last[0]
