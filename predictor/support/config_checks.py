"""Checks that configs call in `__post_init__`; each raises a `UserError` that names the field and its value.

They check values alone. Requirements on files or on a run are checked by the function that uses the config.
"""

import math
import types
from dataclasses import fields, is_dataclass
from functools import cache
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np

from predictor.support.errors import UserError, short


def is_whole(value: Any) -> bool:
    """Returns whether a value is a whole number, of Python or NumPy; True and False are none."""
    return isinstance(value, int | np.integer) and not isinstance(value, bool)


def check_choices(config: Any) -> None:
    """Checks every field whose type is a `Literal`, also inside an optional or a tuple.

    Raises:
        UserError: a value is not listed by its type.
    """
    for name, allowed in _closed_fields(type(config)).items():
        value = getattr(config, name)
        for given in value if isinstance(value, tuple) else (value,):
            check_choice(name, given, allowed)


def check_choice(name: str, value: Any, allowed: tuple[Any, ...]) -> None:
    """Checks that one value is among the allowed ones.

    Raises:
        UserError: it is not.
    """
    if value not in allowed:
        listed = ", ".join(str(choice) for choice in allowed if choice is not None)
        raise UserError(f"{name} must be one of {listed}, got '{value}'")


MOST_WIDTH = 65_536
"""Largest width of a layer; what a network of this size takes is estimated before it is built."""
MOST_PARTS = 1_024
"""Largest number of parts of a network that are alike, such as layers, types and modes."""


_SIMPLE: dict[type, tuple[tuple[type, ...], str]] = {
    bool: ((bool, np.bool_), "true or false"),
    int: ((int, np.integer), "a whole number"),
    float: ((int, float, np.integer, np.floating), "a number"),
    str: ((str,), "a text"),
}
"""Types of Python that also serve as a field's type, and its name."""


def check_types(config: Any) -> None:
    """Checks that fields of simple types (numbers, texts, true or false), also optional ones, have values of them.

    Raises:
        UserError: one has another.
    """
    config_class: Any = type(config)
    for name, kinds in _simple_fields(config_class).items():
        value = getattr(config, name)
        allowed = tuple(part for kind in kinds for part in ((type(None),) if kind is type(None) else _SIMPLE[kind][0]))
        if not isinstance(value, allowed) or (isinstance(value, bool) and bool not in kinds):
            wanted = " or ".join("None" if kind is type(None) else _SIMPLE[kind][1] for kind in kinds)
            raise UserError(f"{name} must be {wanted}, got {short(repr(value), 60)}")


def check_fields(config: Any) -> None:
    """Checks types (`check_types`) and choices (`check_choices`) of a config's fields.

    Raises:
        UserError: a field has another type, or a value that is no choice of it.
    """
    check_types(config)
    check_choices(config)


def make_plain(config: Any) -> None:
    """Turns lists and arrays among the fields of a config into tuples, NumPy's numbers into Python's, as in JSON."""
    for field in fields(config):
        value = getattr(config, field.name)
        if isinstance(value, list | np.ndarray):
            object.__setattr__(config, field.name, value := tuple(np.asarray(value).tolist()))
        numbers = value if isinstance(value, tuple) else (value,)
        if any(isinstance(number, np.generic) for number in numbers):
            made = tuple(number.item() if isinstance(number, np.generic) else number for number in numbers)
            object.__setattr__(config, field.name, made if isinstance(value, tuple) else made[0])


@cache
def _simple_fields(config_class: Any) -> dict[str, tuple[type, ...]]:
    """Returns the types of the fields that have simple ones only."""
    hints = get_type_hints(config_class)
    found = {}
    for field in fields(config_class):
        hint = hints[field.name]
        kinds = get_args(hint) if get_origin(hint) in (Union, types.UnionType) else (hint,)
        if all(kind is type(None) or kind in _SIMPLE for kind in kinds):
            found[field.name] = tuple(kinds)
    return found


MOST_THREADS = 4_096
"""Largest number of CPU threads of a process."""
MOST_WHOLE = 10**15
"""Largest whole number of a command line; what counts more things than this never ends."""
MOST_NUMBER = 1e30
"""Largest finite number of a command line; the square of a larger one is no float32."""


def check_numbers(config: Any) -> None:
    """Checks that no number of a config is absurd: NaN, or too large to be computed with.

    Infinity passes, since it can mean that there is no limit; what has no use for it refuses it itself.

    Raises:
        UserError: a number is.
    """
    for field in fields(config):
        value = getattr(config, field.name)
        if is_dataclass(value):
            check_numbers(value)
        for number in value if isinstance(value, tuple) else (value,):
            if isinstance(number, int) and abs(number) > MOST_WHOLE:
                raise UserError(
                    f"{field.name} must be at most {MOST_WHOLE:,}, got a number of {len(str(abs(number)))} digits"
                )
            if isinstance(number, float) and (math.isnan(number) or MOST_NUMBER < abs(number) < math.inf):
                raise UserError(f"{field.name} must be a number of at most {MOST_NUMBER:g}, got {number}")


def check_scale_values(config: Any, *names: str) -> None:
    """Checks that all entries of tuples are finite and above zero.

    Raises:
        UserError: one is not.
    """
    for name in names:
        scales = getattr(config, name)
        if not all(0 < scale < math.inf for scale in scales):
            raise UserError(f"{name} must be positive, finite numbers, got {scales}")


def check_at_least(config: Any, least: int, *names: str) -> None:
    """Checks that numbers, or all entries of tuples, are finite and at least `least`; None passes.

    Raises:
        UserError: one is not.
    """
    for name in names:
        value = getattr(config, name)
        for number in value if isinstance(value, tuple) else (value,):
            if number is None:
                continue
            if not -math.inf < number < math.inf:
                bound = f"at least {least}" if least else "not negative"
                raise UserError(f"{name} must be finite and {bound}, got {value}")
            if number < least:
                bound = f"be at least {least}" if least else "not be negative"
                raise UserError(f"{name} must {bound}, got {value}")


def check_at_most(config: Any, most: int, *names: str) -> None:
    """Checks that numbers, or all entries of tuples, are at most `most`; None passes.

    Raises:
        UserError: one is not.
    """
    for name in names:
        value = getattr(config, name)
        for number in value if isinstance(value, tuple) else (value,):
            if number is not None and number > most:
                raise UserError(f"{name} must be at most {most:,}, got {value}")


def check_positive(config: Any, *names: str) -> None:
    """Checks that numbers are finite and above zero; None passes.

    Raises:
        UserError: one is not.
    """
    for name in names:
        value = getattr(config, name)
        if value is not None and not 0 < value < math.inf:
            raise UserError(f"{name} must be positive, got {value}")


def _closed_fields(config_class: type) -> dict[str, tuple[Any, ...]]:
    """Returns the choices of each field that has a closed list of them."""
    hints = get_type_hints(config_class)
    found = {field.name: _choices(hints[field.name]) for field in fields(config_class)}
    return {name: allowed for name, allowed in found.items() if allowed}


def _choices(kind: Any) -> tuple[Any, ...]:
    """Returns the values that a type lists; empty if it lists none."""
    origin, arguments = get_origin(kind), get_args(kind)
    if origin is Literal:
        return arguments
    if origin is tuple and len(arguments) == 2 and arguments[1] is Ellipsis:
        return _choices(arguments[0])
    if origin in (Union, types.UnionType):
        listed = [(None,) if part is type(None) else _choices(part) for part in arguments]
        closed = all(listed) and any(part != (None,) for part in listed)
        return tuple(choice for part in listed for choice in part) if closed else ()
    return ()
