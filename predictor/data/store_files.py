"""Checks of a store's files before Zarr opens them, and reading of its arrays with the damaged chunk named.

Zarr reads whatever a group declares: other formats, whose arrays may be pickles, sizes of any height, pipes. So a store
is Zarr's format 3, has only arrays that a store has, of their types and codecs, and fits into memory, and so does what
each chunk unpacks to. Stores carry a CRC-32C of every chunk (Zarr's codec crc32c) and a SHA-256 of their attributes.
"""

import hashlib
import itertools
import json
import math
import os
import stat
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import zarr
from zarr.codecs import Crc32cCodec, ZstdCodec

from predictor.data.zstd_frames import unpacked_bytes
from predictor.support.errors import UserError, short
from predictor.support.files import check_place
from predictor.support.memory import check_memory
from predictor.support.reading import MIB, NoSuchFile, as_object, check_regular, read_object, unreadable
from predictor.support.remote import address, exists, is_remote, names_below
from predictor.support.stopping import deferred_stops

FORMAT = "dgvae-rl episodes"
METADATA = "zarr.json"
CONTENT = "content_sha256"
DIGEST = "sha256"
COMPRESSORS = (ZstdCodec(level=0), Crc32cCodec())
"""Codecs of a new array: compression, and a checksum of each chunk."""
MOST_METADATA_BYTES, MOST_CHUNK_BYTES = 256 * MIB, 16_384 * MIB
_CODECS = (["bytes", "zstd", "crc32c"], ["bytes", "zstd"])
"""Codecs of an array, in their order: of a new store, and of an older one."""
_CRC_BYTES = 4
_FLOAT, _INT = ("float32", "float64"), ("int8", "int16", "int32", "int64")
_ARRAYS: dict[str, tuple[tuple[str, ...], int]] = {
    "states": (_FLOAT, 3),
    "valid": (("bool",), 2),
    "ids": (_INT, 2),
    "starts": (_INT, 1),
    "seeds": (_INT, 1),
    "perturbed": (_INT, 2),
    "label_starts": (_INT, 1),
    "edge_types": (_INT, 3),
    "edge_attributes": (_FLOAT, 4),
    "causal_shift_m": (_FLOAT, 3),
}
"""Types and number of axes of each array that a store may have."""
_ALWAYS = ("states", "valid", "ids", "starts", "seeds")
_BAD = (KeyError, TypeError, ValueError, OSError, RuntimeError, MemoryError, AttributeError, zarr.errors.BaseZarrError)
"""What Zarr and its codecs raise for what they cannot read."""


@dataclass(frozen=True)
class StoreHeader:
    """What a store declares."""

    attributes: dict[str, Any]
    """Attributes of the group."""
    shapes: dict[str, tuple[int, ...]]
    """Shapes of its arrays."""


def most_bytes_of(name: str) -> int:
    """Returns the largest size of a store's file by its name [bytes]."""
    return MOST_METADATA_BYTES if name == METADATA else MOST_CHUNK_BYTES


def is_unfinished(path: Path) -> bool:
    """Returns whether an address holds what is left of a store that was being copied there, and nothing else."""
    names = names_below(path) if is_remote(path) else []
    return bool(names) and all(name.partition("/")[0] in _ARRAYS for name in names)


def digest_of(attributes: Mapping[str, Any]) -> str:
    """Returns the SHA-256 of attributes, in hexadecimal digits; that of an older digest does not count."""
    kept = {key: value for key, value in attributes.items() if key != DIGEST}
    return hashlib.sha256(json.dumps(kept, sort_keys=True).encode()).hexdigest()


class ArrayWriter:
    """Writes arrays into a group: every chunk, so that a missing one is damage, not zeros.

    Args:
        group: group of a store.

    Attributes:
        content: SHA-256 of names, types, shapes and values of the arrays so far.
    """

    def __init__(self, group: zarr.Group) -> None:
        """Starts with no array."""
        self._group = group
        self.content = hashlib.sha256()

    def write(self, name: str, data: np.ndarray, **options: Any) -> None:
        """Writes an array; `options` are Zarr's."""
        self.content.update(f"{name} {data.dtype.str} {data.shape}".encode())
        if data.size:
            self.content.update(np.ascontiguousarray(data).data.cast("B"))
        self._group.create_array(
            name, data=data, compressors=COMPRESSORS, config={"write_empty_chunks": True}, **options
        )


def check_exists(path: Path) -> None:
    """Checks that there is something at the path of a store.

    Raises:
        UserError: there is nothing.
    """
    if not exists(path):
        raise UserError(f"no episode store at {short(address(path))}; make one with python -m envs.collect")


def attributes_of(path: Path, format: str) -> dict[str, Any]:
    """Reads the attributes of a group, which must have the given value of "format".

    Raises:
        UserError: there is no such group.
    """
    try:
        content = read_object(path / METADATA, MOST_METADATA_BYTES)
    except NoSuchFile as error:
        check_exists(path)
        raise UserError(f"{short(path)} is not an episode store (it has no {METADATA}); see docs/datasets") from error
    if content.get("zarr_format") != 3 or content.get("node_type") != "group":
        raise UserError(
            f"{short(path)} is not an episode store (zarr_format must be 3 and node_type group, got "
            f"{short(repr(content.get('zarr_format')), 40)} and {short(repr(content.get('node_type')), 40)})"
        )
    attributes = as_object(content.get("attributes"), f"{path / METADATA}: attributes")
    if attributes.get("format") != format:
        raise UserError(f"{short(path)} is not an episode store; make one with python -m envs.collect")
    return attributes


def check_new_store(path: Path, overwrite: bool) -> None:
    """Checks, before any work is done, that a store may be written at a path.

    Raises:
        UserError: the path cannot be one or has no name, or something is there that may not be replaced.
    """
    check_place(path)
    if path.name in ("", ".."):
        raise UserError(f"a store needs a path that ends in its name, got {address(path)}; pass that of a new folder")
    if exists(path):
        if not overwrite:
            raise UserError(f"{address(path)} exists; choose another path or pass --overwrite")
        check_replaceable(path)


def check_replaceable(path: Path) -> None:
    """Checks that a path that may be replaced holds a store, and nothing else: all below it is deleted.

    Raises:
        UserError: it holds something else, such as another Zarr group, or other stores beside its own arrays.
    """
    if is_unfinished(path):
        return
    try:
        attributes_of(path, FORMAT)
    except UserError as error:
        raise UserError(
            f"{address(path)} is not an episode store and will not be replaced; choose another path"
        ) from error
    if is_remote(path):
        return  # arrays alone are replaced there
    others = sorted(entry.name for entry in path.iterdir() if entry.name not in (METADATA, *_ARRAYS))
    if others:
        raise UserError(
            f"{address(path)} also holds {short(others[0], 60)}, which is no part of the store and would be lost; "
            "move it, or choose another path"
        )


def read_header(path: Path, format: str) -> StoreHeader:
    """Checks all files of a store but the content of its arrays.

    Raises:
        UserError: an entry is neither file nor folder, a store cannot have such an array, or it is too large.
    """
    attributes = attributes_of(path, format)
    _check_files(path)
    shapes, total = dict[str, tuple[int, ...]](), 0
    for name in _ARRAYS:
        if name in _ALWAYS or (path / name).exists():
            shapes[name], size = _array(path / name, name)
            total += size
    check_memory(2 * total, f"store {short(path)}", "copy it anew, or read it on a larger machine")
    return StoreHeader(attributes, shapes)


def check_digest(path: Path, attributes: Mapping[str, Any]) -> None:
    """Checks the checksum of a store's attributes.

    Raises:
        UserError: the attributes are not those that were written.
    """
    if attributes.get(DIGEST) != digest_of(attributes):
        raise UserError(f"{path / METADATA} is damaged (its checksum does not fit); copy or collect it anew")


def open_group(path: Path, mode: Literal["r", "w"], **options: Any) -> zarr.Group:
    """Opens a group; Ctrl-C and SIGTERM wait until it is open.

    Zarr loses letters of the names in a relative folder whose name is short (`d`).

    The first group starts Zarr's event loop, which complains at its end where a signal came while it was being made.
    """
    with deferred_stops() as stops:
        group = zarr.open_group(path.absolute(), mode=mode, **options)
    stops.stop()
    return group


def read_arrays(path: Path, header: StoreHeader) -> dict[str, np.ndarray]:
    """Reads all arrays of a store whose files have been checked.

    Raises:
        UserError: chunks are missing or damaged; the message names one.
    """
    try:
        group = open_group(path, mode="r", zarr_format=3, use_consolidated=False)
        return {name: _read(path, name, group[name]) for name in header.shapes}
    except UserError:
        raise
    except _BAD as error:
        reason = short(" ".join(str(error).split()), 200)
        raise UserError(f"{short(path)} is not a readable episode store ({reason}); collect it anew") from error


def _read(path: Path, name: str, stored: Any) -> np.ndarray:
    if stored.nchunks_initialized != stored.nchunks:  # Zarr reads what is missing as zeros
        raise UserError(f"{path}: chunks of '{name}' are missing; copy or collect it anew")
    _check_chunks(path, name, stored)
    try:
        return np.asarray(stored)
    except _BAD as error:
        reason = short(" ".join(str(error).split()), 120)
        raise UserError(
            f"{path}: chunk {_damaged(stored)} of '{name}' is damaged ({reason}); copy or collect it anew"
        ) from error


def _check_chunks(path: Path, name: str, stored: Any) -> None:
    """Raises a `UserError` if a chunk unpacks to more than its array has in a chunk, without unpacking it."""
    most = math.prod(stored.chunks) * stored.dtype.itemsize
    trailer = _CRC_BYTES * any(isinstance(codec, Crc32cCodec) for codec in stored.metadata.codecs)
    for entry in _entries(path / name):
        chunk = entry.relative_to(path / name)
        if chunk.parts[0] != "c" or not all(part.isdecimal() for part in chunk.parts[1:]) or entry.is_dir():
            continue  # nothing that Zarr reads as a chunk
        size = unpacked_bytes(entry, trailer)
        if size is None or size > most:
            reason = "it is not one whole frame of zstd" if size is None else f"it unpacks to {size} bytes, not {most}"
            raise UserError(f"{path}: chunk {chunk} of '{name}' is damaged ({reason}); copy or collect it anew")


def _damaged(stored: Any) -> str:
    """Returns the name of the first chunk that cannot be read."""
    counts = [math.ceil(length / chunk) for length, chunk in zip(stored.shape, stored.chunks, strict=True)]
    for place in itertools.product(*map(range, counts)):
        try:
            stored[tuple(slice(i * chunk, (i + 1) * chunk) for i, chunk in zip(place, stored.chunks, strict=True))]
        except _BAD:
            return "/".join(["c", *map(str, place)])
    return "c"


def _check_files(path: Path) -> None:
    """Checks that everything below a folder is a regular file of a possible size, or a folder."""
    for entry in _entries(path):
        try:
            is_folder = stat.S_ISDIR(os.stat(entry).st_mode)
        except OSError as error:
            raise unreadable(entry, error) from error
        if not is_folder:
            check_regular(entry, most_bytes_of(entry.name))
        elif entry.is_symlink():  # what is behind it would be read unchecked
            raise UserError(f"{entry} is a link to a folder, and a store has none; copy the store with its files")


def _entries(path: Path) -> Iterator[Path]:
    for folder, folders, files in os.walk(path):
        yield from (Path(folder) / name for name in (*folders, *files))


def _array(path: Path, name: str) -> tuple[tuple[int, ...], int]:
    """Returns shape and size in bytes of an array, after a check of all that its metadata declares."""
    where = str(path / METADATA)
    content = read_object(path / METADATA, MIB)
    if content.get("zarr_format") != 3 or content.get("node_type") != "array":
        raise UserError(f"{where}: '{name}' must be an array of zarr_format 3; collect the store anew")
    kinds, axes = _ARRAYS[name]
    kind = content.get("data_type")
    if kind not in kinds:
        raise UserError(f"{where}: data_type must be {' or '.join(kinds)}, got {short(repr(kind), 60)}")
    shape = _sizes(content.get("shape"), axes, 0, f"{where}: shape")
    grid = as_object(content.get("chunk_grid"), f"{where}: chunk_grid")
    inner = as_object(grid.get("configuration"), f"{where}: chunk_grid.configuration")
    chunks = _sizes(inner.get("chunk_shape"), axes, 1, f"{where}: chunk_shape")
    item = np.dtype(kind).itemsize
    size, chunk = math.prod(shape) * item, math.prod(chunks) * item
    if grid.get("name") != "regular" or chunk > max(2 * size, MIB):
        raise UserError(f"{where}: a chunk must not be larger than the array, got {list(chunks)} in {list(shape)}")
    codecs = content.get("codecs")
    if not isinstance(codecs, list) or not codecs:
        raise UserError(f"{where}: codecs must be an array of codecs, got {short(repr(codecs), 60)}")
    if [codec.get("name") if isinstance(codec, dict) else None for codec in codecs] not in _CODECS:
        raise UserError(
            f"{where}: codecs must be {', '.join(_CODECS[0])}, got {short(repr(codecs), 200)}; collect the store anew"
        )
    keys = as_object(content.get("chunk_key_encoding"), f"{where}: chunk_key_encoding")
    if keys.get("name") != "default" or keys.get("configuration", {}) not in ({}, {"separator": "/"}):
        raise UserError(
            f"{where}: chunk_key_encoding must be default with /, got {short(repr(keys), 100)}; collect the store anew"
        )
    if content.get("storage_transformers"):
        raise UserError(f"{where}: storage_transformers must be empty")
    return shape, size


def _sizes(values: Any, axes: int, least: int, where: str) -> tuple[int, ...]:
    given: Sequence[Any] = values if isinstance(values, list) else ()
    if len(given) != axes or not all(type(value) is int and least <= value < 2**48 for value in given):
        raise UserError(f"{where} must be {axes} whole numbers from {least} up, got {short(repr(values), 60)}")
    return tuple(given)
