"""Actions chosen from an action space alone, for drivers of an ego, drivers of all agents, and partners."""

import copy
from collections.abc import Callable
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np

from envs.own_observation import require_space
from predictor.support.errors import UserError

OWN_DRIVER = "drive it with one of your own, own:module:function (docs/wrap_your_env.md)"
"""What to do where no driver knows the actions."""


def uniform_action(space: gym.Space, rng: np.random.Generator, who: str, advice: str = OWN_DRIVER) -> Any:
    """Returns an action drawn uniformly.

    Args:
        space: Discrete, MultiDiscrete, MultiBinary or a bounded Box.
        rng: source of the draw.
        who: name of the drivers, for the message.
        advice: what to do about another space, for the message.

    Raises:
        UserError: another space.
    """
    if isinstance(space, gym.spaces.Discrete):
        return int(space.start + rng.integers(space.n))
    if isinstance(space, gym.spaces.MultiDiscrete):
        return (space.start + rng.integers(space.nvec)).astype(space.dtype)
    if isinstance(space, gym.spaces.MultiBinary):
        return rng.integers(2, size=space.shape, dtype=space.dtype)
    if isinstance(space, gym.spaces.Box) and space.is_bounded():
        if np.issubdtype(space.dtype, np.integer):
            return rng.integers(space.low, space.high, endpoint=True, dtype=space.dtype)
        return np.asarray(rng.uniform(space.low, space.high), dtype=space.dtype)
    require_space(space, "the action space")
    raise UserError(
        f"{who} need a Discrete, MultiDiscrete, MultiBinary or bounded Box action space, got {space}; {advice}"
    )


def first_action(space: gym.Space) -> Any:
    """Returns the first action of a space: the lowest numbers; of a Box, zeros within its bounds.

    Raises:
        UserError: a space that `uniform_action` does not draw from.
    """
    if isinstance(space, gym.spaces.Discrete):
        return int(space.start)
    if isinstance(space, gym.spaces.MultiDiscrete):
        return space.start.copy()
    if isinstance(space, gym.spaces.MultiBinary):
        return np.zeros(space.shape, dtype=space.dtype)
    if isinstance(space, gym.spaces.Box):
        return np.clip(np.zeros(space.shape, dtype=space.dtype), space.low, space.high)
    raise UserError(f"no idle action is known for {space}; {OWN_DRIVER}")


def varied_actions(space: gym.Space, rng: np.random.Generator, who: str) -> Callable[[Any], Any]:
    """Returns a driver with preferences that repeats its choices for a while; both are drawn once, for an episode.

    Args:
        space: as for `uniform_action`.
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
    if not last or rng.random() > persistence:
        if isinstance(space, gym.spaces.Discrete):
            last[:] = [int(space.start + rng.choice(int(space.n), p=taste))]
        else:
            last[:] = [uniform_action(space, rng, who)]
    return copy.deepcopy(last[0])  # an environment may change the action it is given
