"""Copies and pickles of wrappers of SB3's vector environments, which keep notes on their class that do not pickle."""

import inspect
from typing import Any

from stable_baselines3.common.vec_env import VecEnvWrapper

_CLASS_NOTES = "class_attributes"
_INNER = "inner wrappers"


def without_notes(state: dict[str, Any]) -> dict[str, Any]:
    """Returns the state of a wrapper without its notes and those of the wrappers inside.

    Wrappers inside that define a state of their own are left as they are.

    Args:
        state: attributes of a `VecEnvWrapper`.
    """
    inside, venv = [], state["venv"]
    while isinstance(venv, VecEnvWrapper) and type(venv).__getstate__ is object.__getstate__:
        inside.append((type(venv), {k: v for k, v in vars(venv).items() if k not in (_CLASS_NOTES, "venv")}))
        venv = venv.venv
    return {k: v for k, v in state.items() if k != _CLASS_NOTES} | {"venv": venv, _INNER: inside}


def with_notes(kind: type, state: dict[str, Any]) -> dict[str, Any]:
    """Returns the attributes of a wrapper of a class, from what `without_notes` returned."""
    venv = state["venv"]
    for inner, attributes in reversed(state[_INNER]):
        wrapper = object.__new__(inner)
        wrapper.__dict__.update(attributes, venv=venv, **{_CLASS_NOTES: dict(inspect.getmembers(inner))})
        venv = wrapper
    kept = {k: v for k, v in state.items() if k != _INNER}
    return kept | {"venv": venv, _CLASS_NOTES: dict(inspect.getmembers(kind))}
