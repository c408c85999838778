"""Typed values from JSON and TOML: an object becomes a dataclass, and what does not fit is named by its key."""

import dataclasses
import difflib
import math
import types
from collections.abc import Mapping
from typing import Any, Literal, TypeVar, Union, cast, get_args, get_origin, get_type_hints

from predictor.support.errors import UserError, short

Table = TypeVar("Table")

_WORDS = {str: "a text", int: "a whole number", float: "a number", bool: "true or false", type(None): "null"}
_MOST_SHOWN = 80
"""Number of letters of a wrong value in a message."""


def from_table(kind: type[Table], table: Any, where: str, given: Mapping[str, Any] | None = None) -> Table:
    """Makes a dataclass from a table.

    Args:
        kind: dataclass; its types say what the keys must hold, fields without a default are required.
        table: content of the table; anything else is refused.
        where: file and table, for messages ("quick.toml" or "quick.toml: scenarios.merge").
        given: values of fields that do not come from the table and are no keys of it.

    Raises:
        UserError: an unknown or missing key, a value of another type, or one that the dataclass refuses.
    """
    if not isinstance(table, Mapping):
        raise UserError(f"{where} must be a table of keys and values, got {_shown(table)}")
    given, make = given or {}, cast(Any, kind)
    known = {field.name: field for field in dataclasses.fields(make) if field.name not in given}
    hints = get_type_hints(kind)
    for key in table:
        if key not in known:
            similar = difflib.get_close_matches(str(key), known, 1)
            meant = f"did you mean {similar[0]}? There are" if similar else "there are"
            raise UserError(f"{where}: unknown key '{short(key, _MOST_SHOWN)}'; {meant} {', '.join(known)}")
    for name, field in known.items():
        has_default = field.default is not dataclasses.MISSING or field.default_factory is not dataclasses.MISSING
        if name not in table and not has_default:
            raise UserError(f"{where}: key '{name}' is missing")
    values = {key: converted(value, hints[key], f"{where}: {key}") for key, value in table.items()}
    try:
        return cast(Table, make(**given, **values))
    except UserError as error:
        raise UserError(f"{where}: {error}") from error


def converted(value: Any, kind: Any, where: str) -> Any:
    """Returns a value of JSON or TOML as a value of a type: arrays become tuples, whole numbers serve as numbers.

    Args:
        value: value as `json` or `tomllib` reads it.
        kind: str, int, float, bool, None, a `Literal` of these, a tuple, a dict with texts as keys, a dataclass, or a
            union of them.
        where: file and key, for messages.

    Raises:
        UserError: the value does not have the type.
    """
    origin, arguments = get_origin(kind), get_args(kind)
    if kind is Any:
        return value
    if origin in (Union, types.UnionType):
        if value is None and type(None) in arguments:
            return None
        return _one_of(value, [part for part in arguments if part is not type(None)], where)
    if origin is Literal:
        if not any(value == choice and type(value) is type(choice) for choice in arguments):
            raise UserError(f"{where} must be one of {', '.join(map(str, arguments))}, got {_shown(value)}")
        return value
    if origin is tuple:
        return _tuple(value, arguments, where)
    if origin in (dict, Mapping) or kind is dict:
        if not isinstance(value, dict):
            raise UserError(f"{where} must be a table, got {_shown(value)}")
        if len(arguments) < 2:
            return value
        return {key: converted(entry, arguments[1], f"{where}.{short(key, 40)}") for key, entry in value.items()}
    if dataclasses.is_dataclass(kind):
        return from_table(cast(type, kind), value, where)
    if kind is float and type(value) is int:
        try:
            return float(value)
        except OverflowError as error:
            digits = int(value.bit_length() * math.log10(2)) + 1
            raise UserError(f"{where} must be a number of at most 308 digits, got one of {digits}") from error
    if type(value) is not kind:
        raise UserError(f"{where} must be {_WORDS.get(kind, str(kind))}, got {_shown(value)}")
    return value


def _tuple(value: Any, kinds: tuple[Any, ...], where: str) -> tuple[Any, ...]:
    """Returns an array as a tuple, of any length or with a type for each entry."""
    if not isinstance(value, list | tuple):
        raise UserError(f"{where} must be an array, got {_shown(value)}")
    if len(kinds) == 2 and kinds[1] is Ellipsis:
        return tuple(converted(entry, kinds[0], f"{where}[{i}]") for i, entry in enumerate(value))
    if len(value) != len(kinds):
        raise UserError(f"{where} must have {len(kinds)} entries, got {len(value)}")
    each = enumerate(zip(value, kinds, strict=True))
    return tuple(converted(entry, kind, f"{where}[{i}]") for i, (entry, kind) in each)


def _shown(value: Any) -> str:
    try:
        return short(repr(value), _MOST_SHOWN)
    except ValueError:  # Python writes no integer of thousands of digits
        return "an integer of thousands of digits"


def _one_of(value: Any, kinds: list[Any], where: str) -> Any:
    """Returns a value of the first type that takes it; if none does, the error names all of them."""
    wanted = []
    for kind in kinds:
        try:
            return converted(value, kind, where)
        except UserError as error:
            if len(kinds) == 1:
                raise
            if isinstance(value, list | dict) and not str(error).startswith(f"{where} must be "):
                raise  # the value is of this type, and what it holds is not
            wanted.append(str(error).removeprefix(f"{where} must be ").rpartition(", got ")[0])
    raise UserError(f"{where} must be {' or '.join(wanted)}, got {_shown(value)}")
