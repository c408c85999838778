"""Reading of files that may come from strangers: bounded, checked, and never a wait; one line for what does not fit.

A file must be a regular one and not larger than its kind allows, which is checked before any of it is read. JSON must
be UTF-8, without repeated keys, nested at most `MOST_LEVELS` deep, with integers of at most 64 bits.
"""

import errno
import json
import math
import os
import re
import stat
import tomllib
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from predictor.support.errors import UserError, short
from predictor.support.remote import address, is_remote, read, size_of

MIB = 2**20
MOST_JSON_BYTES = 64 * MIB
"""Largest size of a file of JSON, where its reader does not give another one."""
MOST_TEXT_BYTES = 4096 * MIB
"""Largest size of a text of a dataset."""
MOST_LEVELS = 64
"""Largest depth of lists and objects in JSON."""
_DIGITS = "integers have at most 19 digits (64 bits)"
_REASONS = {
    errno.ENOENT: "there is no such file",
    errno.ENOTDIR: "a part of the path is a file, not a folder",
    errno.EISDIR: "it is a folder, not a file",
    errno.ELOOP: "it has links that lead in a circle",
    errno.EACCES: "no permission to read it",
    errno.EPERM: "no permission to read it",
    errno.ENAMETOOLONG: "its name is too long",
    errno.EIO: "the disk reports an error",
    errno.ENXIO: "it is no regular file",
}


class NoSuchFile(UserError, FileNotFoundError):
    """Raised where there is no file; readers of optional files catch it."""


def check_regular(path: Path, most_bytes: int) -> int:
    """Checks, without opening it, that a path leads to a regular file that is not too large; returns its size.

    Raises:
        UserError: it does not; as `NoSuchFile` if there is nothing.
    """
    if is_remote(path):
        return _check_remote(path, most_bytes)
    try:
        found = os.stat(path)
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        raise unreadable(path, error) from error
    if stat.S_ISDIR(found.st_mode):
        raise UserError(f"{short(path)} cannot be read: it is a folder, not a file")
    if not stat.S_ISREG(found.st_mode):
        raise UserError(f"{short(path)} cannot be read: it is no regular file (a pipe, a device or a socket)")
    return _check_size(found.st_size, short(path), most_bytes)


def _check_remote(path: Path, most_bytes: int) -> int:
    """Checks that there is a file on another file system that is not too large; returns its size."""
    try:
        return _check_size(size_of(path), short(address(path)), most_bytes)
    except FileNotFoundError as error:
        raise NoSuchFile(f"{short(address(path))} cannot be read: there is no such file; check the address") from error


def _check_size(found: int, where: str, most_bytes: int) -> int:
    if found > most_bytes:
        raise UserError(
            f"{where} is too large: a file of its kind has at most {_size(most_bytes)}, this one has {_size(found)}"
        )
    return found


def unreadable(path: Path, error: Exception) -> UserError:
    """Returns the error for a path that the operating system refuses."""
    number = error.errno if isinstance(error, OSError) else None
    reason = _REASONS.get(number or 0) or (error.strerror if isinstance(error, OSError) else str(error))
    kind = NoSuchFile if number == errno.ENOENT else UserError
    return kind(f"{short(path)} cannot be read: {reason}; check the path")


def read_bytes(path: Path, most_bytes: int) -> bytes:
    """Reads a whole file.

    Raises:
        UserError: it is no regular file, is larger than `most_bytes`, or cannot be read.
    """
    check_regular(path, most_bytes)
    try:
        if is_remote(path):
            content = read(path, most_bytes)
        else:
            # not blocking: the file may have become a pipe since it was checked
            with open(os.open(path, os.O_RDONLY | os.O_NONBLOCK), "rb") as file:
                content = file.read(most_bytes + 1)
    except OSError as error:
        raise unreadable(path, error) from error
    if len(content) > most_bytes:
        raise UserError(f"{short(path)} is too large: a file of its kind has at most {_size(most_bytes)}")
    return content


def read_text(path: Path, most_bytes: int = MOST_TEXT_BYTES) -> str:
    """Reads a text in UTF-8; a byte-order mark is left out.

    Raises:
        UserError: as `read_bytes`, or the file is not UTF-8.
    """
    content = read_bytes(path, most_bytes)
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content[: error.start].count(b"\n") + 1
        raise UserError(f"{short(path)}, line {line}: expected text in UTF-8, got other bytes; get it anew") from error


def read_json(path: Path, most_bytes: int = MOST_JSON_BYTES, finite: bool = False) -> Any:
    """Reads a file of JSON.

    Args:
        path: path of the file.
        most_bytes: largest size.
        finite: whether NaN and infinite numbers are refused.

    Raises:
        UserError: as `read_text`, or see `parse_json`.
    """
    return parse_json(read_text(path, most_bytes), short(path), finite)


def read_object(path: Path, most_bytes: int = MOST_JSON_BYTES) -> dict[str, Any]:
    """Reads a file that holds one JSON object; NaN and infinite numbers pass.

    Raises:
        UserError: as `read_json`, or the file holds something else.
    """
    return as_object(read_json(path, most_bytes), short(path))


def damage_in(path: Path, error: Exception) -> str:
    """Returns what an error says of the content of a file, without the file's name and without advice."""
    return str(error).removeprefix(short(path)).lstrip(":, ").removesuffix("; get it anew")


def as_object(content: Any, where: str) -> dict[str, Any]:
    """Returns content of JSON that must be an object.

    Raises:
        UserError: it is something else.
    """
    if not isinstance(content, dict):
        raise UserError(f"{where} must be a JSON object, got {short(repr(content), 60)}")
    return content


def read_toml(path: Path, most_bytes: int = MIB) -> dict[str, Any]:
    """Reads a file of TOML.

    Raises:
        UserError: as `read_text`, or the file is no TOML.
    """
    text = read_text(path, most_bytes)
    if most_dotted(text) > MOST_LEVELS:
        raise UserError(f"{short(path)} is not valid TOML: it is nested too deeply")
    try:
        content = tomllib.loads(text)
    except RecursionError as error:
        raise UserError(f"{short(path)} is not valid TOML: it is nested too deeply") from error
    except ValueError as error:  # a TOMLDecodeError, or an integer of thousands of digits
        raise UserError(f"{short(path)} is not valid TOML: {error}") from error
    _check_values(content, short(path), finite=False)
    return content


def most_dotted(text: str) -> int:
    """Returns the number of parts of the longest dotted name of a text; tomllib takes time by its square."""
    joined = re.sub(r"[ \t]+", " ", text).replace(" .", ".").replace(". ", ".")
    return max(sum(map(bool, word.split("."))) for word in re.split(r"[^\w.\"'-]+", joined))


def parse_json(text: str | bytes, where: str, finite: bool = False) -> Any:
    """Parses JSON.

    Args:
        text: the text, or UTF-8.
        where: file, for messages.
        finite: whether NaN and infinite numbers are refused.

    Raises:
        UserError: the text is no JSON, is nested too deeply, repeats a key, has an integer of more than 64 bits, or
            text with half a surrogate.
    """
    try:
        if isinstance(text, bytes):
            text = text.decode("utf-8")
        content = json.loads(text, object_pairs_hook=_without_repeats)
    except json.JSONDecodeError as error:
        raise UserError(f"{where}, line {error.lineno}: no JSON ({error.msg}); get it anew") from error
    except UnicodeDecodeError as error:
        raise UserError(f"{where}: expected text in UTF-8, got other bytes; get it anew") from error
    except _Repeated as error:
        raise UserError(f"{where}: key {short(repr(str(error)))} is given twice; get it anew") from error
    except RecursionError as error:
        raise UserError(f"{where}: lists and objects are nested more than {MOST_LEVELS} deep; get it anew") from error
    except ValueError as error:  # an integer of more digits than Python converts
        raise UserError(f"{where}: {_DIGITS}, got a longer one; get it anew") from error
    _check_values(content, where, finite)
    return content


class _Repeated(Exception):
    """Raised where an object has a key twice."""


def _without_repeats(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) != len(pairs):
        times = Counter(name for name, _ in pairs)
        raise _Repeated(next(name for name, number in times.items() if number > 1))
    return found


def _check_values(content: Any, where: str, finite: bool) -> None:
    """Checks depth, numbers and texts, level by level."""
    level, depth = [content], 0
    while level:
        depth += 1
        if depth > MOST_LEVELS + 1:
            raise UserError(f"{where}: lists and objects are nested more than {MOST_LEVELS} deep; get it anew")
        inner: list[Any] = []
        for value in level:
            if isinstance(value, dict):
                inner.extend(value.values())
                inner.extend(key for key in value if not key.isascii())
            elif isinstance(value, list):
                inner.extend(value)
            elif isinstance(value, float):
                if finite and not math.isfinite(value):
                    raise UserError(f"{where}: numbers must be finite, got {value}; get it anew")
            elif isinstance(value, str):
                if not value.isascii() and any("\ud800" <= letter <= "\udfff" for letter in value):
                    raise UserError(f"{where}: a text has half a surrogate, {short(repr(value), 60)}; get it anew")
            elif isinstance(value, int) and not -(2**63) <= value < 2**64:
                raise UserError(f"{where}: {_DIGITS}, got one of {value.bit_length():,} bits; get it anew")
        level = inner


def _size(number: int) -> str:
    for name, unit in (("GiB", 2**30), ("MiB", MIB), ("KiB", 2**10)):
        if number >= unit:
            return f"{number / unit:,.0f} {name}"
    return f"{number} bytes"


def version_of(content: Mapping[str, Any], reads: int, where: str) -> None:
    """Checks the version of a file's format.

    Raises:
        UserError: it is not the one that this release reads.
    """
    version = content.get("version")
    if type(version) is not int or version != reads:
        raise UserError(f"{where} has version {short(repr(version), 40)}, this release reads {reads}; make it anew")
