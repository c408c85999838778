"""Typed values from TOML: a table becomes a dataclass, and what does not fit is named by its key."""

import dataclasses
import types
from collections.abc import Mapping
from typing import Any, Literal, TypeVar, Union, cast, get_args, get_origin, get_type_hints

from predictor.support.errors import UserError

Table = TypeVar("Table")

_WORDS = {str: "a text", int: "a whole number", float: "a number", bool: "true or false"}


def from_table(
    kind: type[Table], table: Mapping[str, Any], where: str, given: Mapping[str, Any] | None = None
) -> Table:
    """Makes a dataclass from a table.

    Args:
        kind: dataclass; its types say what the keys must hold, fields without a default are required.
        table: content of the table.
        where: file and table, for messages ("quick.toml" or "quick.toml: scenarios.merge").
        given: values of fields that do not come from the table and are no keys of it.

    Raises:
        UserError: an unknown or missing key, a value of another type, or one that the dataclass refuses.
    """
    given, make = given or {}, cast(Any, kind)
    known = {field.name: field for field in dataclasses.fields(make) if field.name not in given}
    hints = get_type_hints(kind)
    for key in table:
        if key not in known:
            raise UserError(f"{where}: unknown key '{key}'; there are {', '.join(known)}")
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
    """Returns a value of TOML as a value of a type: arrays become tuples, whole numbers serve as numbers.

    Args:
        value: value as `tomllib` reads it.
        kind: str, int, float, bool, a `Literal` of these, a tuple of any length, a dict with texts as keys, or a union.
        where: file and key, for messages.

    Raises:
        UserError: the value does not have the type.
    """
    origin, arguments = get_origin(kind), get_args(kind)
    if kind is Any:
        return value
    if origin in (Union, types.UnionType):
        return _one_of(value, [part for part in arguments if part is not type(None)], where)
    if origin is Literal:
        if value not in arguments or isinstance(value, bool) != any(value is choice for choice in (True, False)):
            raise UserError(f"{where} must be one of {', '.join(map(str, arguments))}, got {value!r}")
        return value
    if origin is tuple and len(arguments) == 2 and arguments[1] is Ellipsis:
        if not isinstance(value, list):
            raise UserError(f"{where} must be an array, got {value!r}")
        return tuple(converted(entry, arguments[0], where) for entry in value)
    if origin in (dict, Mapping) or kind is dict:
        if not isinstance(value, dict):
            raise UserError(f"{where} must be a table, got {value!r}")
        return value
    if kind is float and type(value) is int:
        return float(value)
    if type(value) is not kind:
        raise UserError(f"{where} must be {_WORDS.get(kind, str(kind))}, got {value!r}")
    return value


def _one_of(value: Any, kinds: list[Any], where: str) -> Any:
    """Returns a value of the first type that takes it; if none does, the error names all of them."""
    wanted = []
    for kind in kinds:
        try:
            return converted(value, kind, where)
        except UserError as error:
            wanted.append(str(error).removeprefix(f"{where} must be ").rpartition(", got ")[0])
    raise UserError(f"{where} must be {' or '.join(wanted)}, got {value!r}")
