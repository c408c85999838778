"""What an episode's infos say of its outcome: under which keys an environment reports crashes and success.

No key is guessed: what an environment does not report, and nobody named, is "not reported" and not 0 %. Known are
highway-env's "crashed" and arrivals, and "is_success", which Stable-Baselines3 and many environments share.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from envs.readers.envpool import is_envpool_env
from envs.readers.highway import is_highway_env
from predictor.support.errors import UserError, short

_ARRIVED = "rewards.arrived_reward"
"""Key of highway-env's intersections: the arrival is a part of the reward."""


@dataclass(frozen=True)
class OutcomeKeys:
    """Keys of an environment's infos; a point leads into a nested dict ("outcome.collided")."""

    crash: tuple[str, ...] = ()
    """Keys of which the first one in an info says whether the ego has crashed; none where crashes are not reported."""
    success: tuple[str, ...] = ("is_success",)
    """Keys of which the first one in an info says whether the ego has succeeded."""

    def crashed(self, info: Mapping[str, Any]) -> bool | None:
        """Returns whether an info reports a crash, of any ego where there are several; None if it says nothing."""
        value = _first(info, self.crash)
        return None if value is None else bool(np.any(_shares(value, self.crash) > 0))

    def succeeded(self, info: Mapping[str, Any]) -> bool | None:
        """Returns whether an info reports success, of all egos where there are several; None if it says nothing."""
        value = _first(info, self.success)
        return None if value is None else bool(np.all(_shares(value, self.success) == 1))


def _shares(value: Any, keys: Sequence[str]) -> np.ndarray:
    """Returns what an info says as an array: 1 (true) or 0 for each ego, or the share of all, as highway-env does.

    A dict, a text or a speed, which would always be true, is refused.
    """
    try:
        shares = np.asarray(value)
    except ValueError:  # rows of unequal length
        shares = np.asarray(None)
    if shares.dtype.kind not in "buif" or not ((shares >= 0) & (shares <= 1)).all():
        raise UserError(f"info {' or '.join(keys)} must be true or false, or so for each ego, got {short(value, 60)}")
    return shares


_NAMED: dict[type, OutcomeKeys] = {}


def register_outcomes(env_class: type, crash_key: str | None = None, success_key: str | None = None) -> None:
    """Names the keys under which environments of a class, and what derives from it, report outcomes.

    Args:
        env_class: class of the unwrapped environment.
        crash_key: key of the infos that says whether the ego has crashed, in every step or in the last one; a point
            leads into a nested dict. None: crashes are not reported.
        success_key: key that says, in the last step, whether the ego has succeeded; None takes "is_success".

    Raises:
        UserError: a key is empty.
    """
    _NAMED[env_class] = _keys(OutcomeKeys(), crash_key, success_key)


def outcome_keys(env: Any, crash_key: str | None = None, success_key: str | None = None) -> OutcomeKeys:
    """Returns the keys of an environment: the given ones, else those that are registered or known.

    Raises:
        UserError: a key is empty.
    """
    kinds = type(env.unwrapped).__mro__
    known = next((_NAMED[kind] for kind in kinds if kind in _NAMED), OutcomeKeys())
    if not any(kind in _NAMED for kind in kinds) and (is_highway_env(env) or is_envpool_env(env)):
        known = OutcomeKeys(("crashed",), ("is_success", _ARRIVED))
    return _keys(known, crash_key, success_key)


def _keys(known: OutcomeKeys, crash_key: str | None, success_key: str | None) -> OutcomeKeys:
    for name, key in (("crash_key", crash_key), ("success_key", success_key)):
        if key is not None and (not isinstance(key, str) or not all(key.split("."))):
            raise UserError(f"{name} must be the name of a key of the infos, got {key!r}")
    return OutcomeKeys(
        known.crash if crash_key is None else (crash_key,), known.success if success_key is None else (success_key,)
    )


def _first(info: Mapping[str, Any], keys: tuple[str, ...]) -> Any:
    return next((value for key in keys if (value := _value(info, key)) is not None), None)


def _value(info: Any, key: str) -> Any:
    """Returns what a key leads to; None if it leads nowhere."""
    if isinstance(info, Mapping) and key in info:
        return info[key]
    first, _, rest = key.partition(".")
    return _value(info[first], rest) if rest and isinstance(info, Mapping) and first in info else None
