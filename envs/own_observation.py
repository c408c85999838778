"""An environment's own observation among the entries that wrappers add: a Dict's own entries, or one for an array.

An array (or a number) becomes the entry "observation". A Dict's entries stay as they are, beside those that are added;
none may have the name of an added one.
"""

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np

from envs.entries import FORECAST_KEYS, PATH_KEYS, SCENE_KEYS, UNCERTAINTY_KEYS, WHAT_IF_KEYS
from predictor.support.errors import UserError, short

OWN_KEY = "observation"
"""Name of the entry that holds an environment's own observation where that is no Dict."""
ADDED_KEYS = frozenset((*SCENE_KEYS, *FORECAST_KEYS, *PATH_KEYS, *UNCERTAINTY_KEYS, *WHAT_IF_KEYS))
"""Names of all entries that wrappers can add."""
_COMPOSED = (gym.spaces.Dict, gym.spaces.Tuple, gym.spaces.Graph, gym.spaces.Sequence, gym.spaces.OneOf)


def require_space(space: Any, what: str) -> gym.Space:
    """Returns a space, which must be one of gymnasium.

    Args:
        space: what an environment gives as a space.
        what: name of the space, for messages.

    Raises:
        UserError: it is something else, as a space of the package gym, which came before gymnasium.
    """
    if isinstance(space, gym.Space):
        return space
    raise UserError(
        f"{what} must be a space of gymnasium, got {type(space).__module__}.{type(space).__name__}; make it anew, for "
        "example gymnasium.spaces.Box(space.low, space.high, dtype=space.dtype)"
    )


def own_spaces(space: gym.Space, source: str) -> dict[str, gym.Space]:
    """Returns the entries that hold an environment's own observation, by name.

    Args:
        space: its own observation space.
        source: name of the environment, for messages.

    Raises:
        UserError: the space is no gymnasium space, is composed otherwise than as a flat Dict, or has an entry with the
            name of an added one, or none but one with the name that wrappers give an array.
    """
    require_space(space, f"the own observation space of {source}")
    if not isinstance(space, gym.spaces.Dict):
        if isinstance(space, _COMPOSED):
            raise UserError(
                f"the own observation of {source} must be one array or a Dict of arrays, got {type(space).__name__}; "
                "flatten it first, in gymnasium with FlattenObservation (gymnasium.wrappers)"
            )
        return {OWN_KEY: space}
    if set(space.spaces) == {OWN_KEY}:
        raise UserError(
            f"the own observation of {source} is a Dict whose only entry is '{OWN_KEY}', the name under which wrappers "
            "put an array; give the array itself, in gymnasium with TransformObservation"
        )
    for key, entry in space.spaces.items():
        if isinstance(entry, _COMPOSED):
            raise UserError(
                f"the own observation of {source} must be a flat Dict, but its entry '{key}' is a "
                f"{type(entry).__name__}; flatten it first, in gymnasium with FlattenObservation (gymnasium.wrappers)"
            )
        if key in ADDED_KEYS:
            raise UserError(
                f"the own observation of {source} has an entry '{key}', as forecasts have; if it is wrapped already, "
                "leave one wrapper out, else rename the entry with a wrapper (gymnasium: TransformObservation)"
            )
    return dict(space.spaces)


def check_unwrapped(space: gym.Space, source: str) -> None:
    """Checks the own observation space of an environment that no wrapper of ours is put around (`own_spaces`).

    One that has forecasts or scenes already, from a wrapper inside, passes, as does what is no Dict.

    Raises:
        UserError: it has an entry with the name of an added one, or is composed otherwise than as a flat Dict.
    """
    if isinstance(space, gym.spaces.Dict) and not carries_forecasts(space) and not set(SCENE_KEYS) <= set(space):
        own_spaces(space, source)


def check_returned(returned: Any, method: str, source: str) -> None:
    """Checks that an environment's `reset` or `step` returned what Gymnasium's return, not older ones.

    Raises:
        UserError: it returned something else.
    """
    wanted = {"reset": "(observation, info)", "step": "(observation, reward, terminated, truncated, info)"}[method]
    count = wanted.count(",") + 1
    if not isinstance(returned, tuple) or len(returned) != count or not isinstance(returned[-1], Mapping):
        got = f"{len(returned)} values" if isinstance(returned, tuple) else type(returned).__name__
        raise UserError(f"{method} of {source} must return {wanted}, got {got}")


def own_entries(observation: Any) -> dict[str, Any]:
    """Returns an environment's own observation as entries, in a new dict."""
    return dict(observation) if isinstance(observation, Mapping) else {OWN_KEY: observation}


def check_own(own: Mapping[str, gym.Space], observation: Any, source: str) -> None:
    """Checks that an environment's own observation fits its space: entries, shapes, and types that keep its values.

    Learners keep observations in arrays of the space's type: in one of integers, floats are cut, and numbers beyond
    its bounds wrap around. Floats beyond the bounds of a space of floats lose nothing, and pass.

    Args:
        own: spaces of its entries (`own_spaces`).
        observation: its own observation.
        source: name of the environment, for messages.

    Raises:
        UserError: it does not.
    """
    entries = own_entries(observation)
    missing = [key for key in own if key not in entries]
    if missing:
        raise UserError(
            f"the own observation of {source} must have the entries {short([*own], 100)} of its observation space, got "
            f"{short([*entries], 100)}; return what the space says"
        )
    for key, space in own.items():
        fault = _fault(space, entries[key])
        if fault:
            entry = f", entry '{key}'," if isinstance(observation, Mapping) else ""
            raise UserError(
                f"the own observation of {source}{entry} must lie in its space {short(space, 150)}, got {fault}; "
                "change the observation or its space"
            )


def as_numbers(value: Any) -> np.ndarray | None:
    """Returns a value as an array of numbers; None of what is none."""
    try:
        array = np.asarray(value)
    except (TypeError, ValueError, RuntimeError):  # a ragged list, a tensor of another device
        return None
    return array if array.dtype.kind in "biuf" else None


def check_reward(reward: Any, source: str) -> None:
    """Checks that a reward is a finite number, or several.

    Raises:
        UserError: it is not.
    """
    values = as_numbers(reward)
    if values is None or not np.isfinite(values).all():
        raise UserError(f"the reward of {source} must be a finite number, got {short(reward, 60)}; return a float")


def _fault(space: gym.Space, value: Any) -> str | None:
    """Returns in words what does not fit a space, if anything."""
    if not isinstance(space, gym.spaces.Box):
        fits = space.contains(value) or (np.size(value) == 1 and space.contains(np.asarray(value).item()))
        return None if fits else short(value, 60)
    try:
        array = np.asarray(value)
    except (TypeError, ValueError, RuntimeError):
        return f"a {type(value).__name__}"
    if array.shape != space.shape or array.dtype.kind not in "biuf":
        return f"{array.dtype} of the shape {array.shape}"
    if not np.issubdtype(space.dtype, np.integer):
        return "nan" if np.isnan(array).any() else None
    if array.dtype.kind == "f":
        return f"numbers of type {array.dtype}"
    outside = (array < space.low) | (array > space.high)
    return f"{short(array[outside].flat[0], 40)}" if outside.any() else None


def own_part(space: gym.spaces.Dict) -> dict[str, gym.Space]:
    """Returns the spaces of an environment's own entries, out of a space with added ones."""
    return {key: entry for key, entry in space.spaces.items() if key not in ADDED_KEYS}


def without_added(observation: Any) -> Any:
    """Returns an environment's own observation, out of one with added entries; others as they are."""
    if not isinstance(observation, Mapping) or not ADDED_KEYS & observation.keys():
        return observation
    own = {key: value for key, value in observation.items() if key not in ADDED_KEYS}
    return own[OWN_KEY] if own.keys() == {OWN_KEY} else own


def space_without_added(space: gym.Space) -> gym.Space:
    """Returns the space of `without_added`."""
    if not isinstance(space, gym.spaces.Dict) or not ADDED_KEYS & space.spaces.keys():
        return space
    own = own_part(space)
    return own[OWN_KEY] if own.keys() == {OWN_KEY} else gym.spaces.Dict(own)


def carries_forecasts(space: gym.Space) -> bool:
    """Returns whether observations of this space hold forecasts; flattened ones do not show it."""
    return isinstance(space, gym.spaces.Dict) and all(key in space.spaces for key in FORECAST_KEYS)
