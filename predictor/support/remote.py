"""Files on other file systems (`s3://`, `gs://`, `file://`, `memory://`, …): bounded copies, taken and given by fsspec.

What is read from there is first copied to a local folder, after its names and sizes have been checked, and then read
as any other file from strangers. What is written is made whole on the local disk and then copied. So nothing else in
the project knows of these file systems. A `Path` keeps an address with one slash fewer ("s3:/bucket/store").
"""

import errno
import os
import re
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from multiprocessing.util import Finalize
from pathlib import Path
from typing import Any

import fsspec
from fsspec.registry import known_implementations

from predictor.support.errors import UserError, short

MOST_FILES = 1_000_000
"""Largest number of files below an address."""
LAST = ("zarr.json", "config.json")
"""Files without which a folder is neither a store nor a checkpoint: they are written last and removed first."""
_ADDRESS = re.compile(r"([a-zA-Z][a-zA-Z0-9+.\-]+):/+(.*)", re.DOTALL)
_PACKAGES = {
    "s3": "s3fs", "s3a": "s3fs", "gs": "gcsfs", "gcs": "gcsfs", "abfs": "adlfs", "az": "adlfs", "hf": "huggingface_hub",
    "http": "aiohttp", "https": "aiohttp",
}  # fmt: skip
_LOCAL = ("file", "local")
_CHUNK = 2**22
_COPIES: dict[str, tuple[list[str], Path, Path, int]] = {}
"""Copies that are kept until the process ends: address to state of the files, folder, the folder around it, process."""


def is_remote(path: str | Path) -> bool:
    """Returns whether a path is an address on another file system.

    >>> [is_remote(path) for path in ("s3://bucket/store", Path("gs://bucket/store"), "data/store", "own:module:name")]
    [True, True, False, False]
    """
    return _ADDRESS.fullmatch(str(path)) is not None


def address(path: str | Path) -> str:
    """Returns an address with all its slashes; other paths as they are.

    >>> address(Path("s3://bucket/store")), address(Path("file:///data/store")), address(Path("data/store"))
    ('s3://bucket/store', 'file:///data/store', 'data/store')
    """
    found = _ADDRESS.fullmatch(str(path))
    if found is None:
        return str(path)
    protocol, rest = found[1].lower(), found[2]
    return f"{protocol}:///{rest}" if protocol in _LOCAL else f"{protocol}://{rest}"


def exists(path: Path) -> bool:
    """Returns whether there is a file or folder, here or on another file system.

    Raises:
        UserError: the other file system does not answer.
    """
    if not is_remote(path):
        return path.exists()
    system, key = _system(path)
    with _told(path):
        return bool(system.exists(key))


def names_below(path: Path) -> list[str]:
    """Returns the paths of all files below an address.

    Raises:
        UserError: the file system does not answer, or a name has no place in a folder.
    """
    system, key = _system(path)
    return [name for name, _, _ in _listed(system, key, path, must=False)]


def size_of(path: Path) -> int:
    """Returns the size of a file on another file system.

    Raises:
        FileNotFoundError: there is none.
        UserError: it is a folder, or the file system does not answer.
    """
    system, key = _system(path)
    return int(_info(system, key, path)["size"])


def read(path: Path, most_bytes: int) -> bytes:
    """Reads a file of another file system, or its first `most_bytes` + 1 bytes.

    Raises:
        FileNotFoundError: there is none.
        UserError: the file system does not answer.
    """
    system, key = _system(path)
    with _told(path, missing_passes=True), system.open(key, "rb") as file:
        return bytes(file.read(most_bytes + 1))


@contextmanager
def local_copy(path: Path, largest: Callable[[str], int | None]) -> Iterator[Path]:
    """Yields a copy of a folder of another file system, which is deleted at the end; errors name the address.

    Args:
        path: address of the folder.
        largest: returns the largest size of a file by its name; None leaves the file out.

    Raises:
        UserError: there is nothing, a file is too large or has a name that no file of ours has, or the disk is full.
    """
    system, key = _system(path)
    with tempfile.TemporaryDirectory(prefix="dgvae-rl-") as folder:
        copy = Path(folder) / (path.name or "copy")
        copy.mkdir()
        wanted = list(_wanted(_listed(system, key, path), largest, path))
        if sum(size for _, size, _ in wanted) > shutil.disk_usage(folder).free:
            raise UserError(f"{short(address(path))} is larger than the room in {tempfile.gettempdir()}; set TMPDIR")
        for name, size, source in wanted:
            _copy(system, source, copy / name, size, path)
        with named(copy, path):
            yield copy


@contextmanager
def named(copy: Path, path: str | Path) -> Iterator[None]:
    """Lets the errors of a block name an address, not its copy."""
    try:
        yield
    except UserError as error:
        if not is_remote(path):
            raise
        raise type(error)(str(error).replace(str(copy), address(path))) from error


def kept_copy(path: Path, files: Mapping[str, int]) -> Path | None:
    """Returns a folder with copies of some files of another file system; None if one is not there.

    It is kept until the process ends, or until the files have changed: it is then made anew.

    Args:
        path: address of the folder that has the files.
        files: largest size of each file by its name.

    Raises:
        UserError: a file is too large, or the file system does not answer.
    """
    system, key = _system(path)
    sizes, state = dict[str, int](), list[str]()
    for name, most in files.items():
        try:
            found = _info(system, f"{key}/{name}", path / name)
        except FileNotFoundError:
            return None
        sizes[name] = int(found["size"])
        state.append(repr(sorted((name, str(value)) for name, value in found.items())))
        if sizes[name] > most:
            raise UserError(f"{short(address(path / name))} is too large: {sizes[name]:,} of at most {most:,} bytes")
    kept = _COPIES.get(address(path))
    if kept is None or kept[0] != state:
        # names in tables are those of the last two folders
        root = Path(tempfile.mkdtemp(dir=_folder_of_copies()))
        copy = root.joinpath(*path.parts[1:][-2:])
        for name, size in sizes.items():
            _copy(system, f"{key}/{name}", copy / name, size, path)
        if kept is not None and kept[3] == os.getpid():  # the process that forked this one may read its own
            shutil.rmtree(kept[2], ignore_errors=True)
        kept = _COPIES[address(path)] = (state, copy, root, os.getpid())
    return kept[1]


@cache
def _folder_of_copies() -> str:
    """Returns a folder that this process deletes at its end."""
    folder = tempfile.mkdtemp(prefix="dgvae-rl-")
    Finalize(None, shutil.rmtree, (folder, True), exitpriority=0)  # atexit does not run in forked processes
    return folder


@contextmanager
def uploaded(path: Path) -> Iterator[Path]:
    """Yields a local path for a file or folder; copies it to another file system at the end.

    A store or checkpoint replaces another one, file by file: the file that makes it one is removed first and written
    last, so that a reader finds it whole or not at all. Files that are no part of either stay.

    Raises:
        UserError: the file system does not take it.
    """
    system, key = _system(path)
    with tempfile.TemporaryDirectory(prefix="dgvae-rl-") as folder:
        made = Path(folder) / (path.name or "made")
        yield made
        with _told(path):
            if not made.is_dir():
                _put(system, made, key)
                return
            old = {name: source for name, _, source in _listed(system, key, path, must=False)}
            for name in sorted(old, key=lambda name: name not in LAST):
                folder_of = name.partition("/")[0]
                is_part = f"{folder_of}/{LAST[0]}" in old or (made / folder_of).is_dir()  # of an array of a store
                if name in LAST or (is_part and not (made / name).is_file()):
                    system.rm_file(old[name])
            names = [file.relative_to(made).as_posix() for file in made.rglob("*") if file.is_file()]
            for name in sorted(names, key=lambda name: (name in LAST, name)):
                _put(system, made / name, f"{key}/{name}")


def require_local(path: Path, what: str) -> None:
    """Checks that a path is on this machine's file system.

    Raises:
        UserError: it is an address.
    """
    if is_remote(path):
        raise UserError(
            f"{what} must be a local folder, got {address(path)}: it is locked, and its files are exchanged at once, "
            "which object stores cannot do; write it here and copy it when it is done"
        )


def _system(path: Path) -> tuple[Any, str]:
    """Returns the file system of an address, and the key there."""
    url = address(path)
    protocol = url.partition(":")[0]
    if "::" in url:
        raise UserError(f"{short(url)}: addresses inside others (::) are not read; pass a plain one")
    if ".." in path.parts:
        raise UserError(f"{short(url)}: an address has no '..'; pass the folder itself")
    if protocol not in known_implementations and protocol not in fsspec.registry:
        known = "s3://, gs://, abfs://, https://, file://"
        raise UserError(f"{short(url)}: there is no file system '{short(protocol)}'; pass a path, or one of {known}")
    try:
        system, key = fsspec.core.url_to_fs(url)
    except ImportError as error:
        package = _PACKAGES.get(protocol)
        advice = f"install the package {package}" if package else short(" ".join(str(error).split()))
        raise UserError(f"{short(url)} cannot be reached: {advice}") from error
    except Exception as error:
        raise _refused(path, error) from error
    system.invalidate_cache()  # another process may have written meanwhile
    return system, str(key).rstrip("/")


def _info(system: Any, key: str, path: Path) -> dict[str, Any]:
    with _told(path, missing_passes=True):
        found: dict[str, Any] = system.info(key)
    if found.get("type") != "file":
        kind = "a folder, not a file" if found.get("type") == "directory" else "no regular file"
        raise UserError(f"{short(address(path))} cannot be read: it is {kind}")
    if not isinstance(found.get("size"), int):
        raise UserError(f"{short(address(path))} cannot be read: its file system does not say how large it is")
    return found


def _listed(system: Any, key: str, path: Path, must: bool = True) -> list[tuple[str, int, str]]:
    """Returns name, size and key of all files below an address."""
    with _told(path):
        found = system.find(key, detail=True)
    if not found and must:
        raise UserError(f"there is nothing at {short(address(path))}; check the address")
    if len(found) > MOST_FILES:
        raise UserError(f"{short(address(path))} has {len(found):,} files, at most {MOST_FILES:,} are read")
    files = []
    for source, info in found.items():
        name = str(source)[len(key) :].lstrip("/") if str(source).startswith(f"{key}/") else ""
        if any(part in ("", ".", "..") or "\0" in part or len(part) > 255 for part in name.split("/")):
            raise UserError(f"{short(address(path))} has a file '{short(source)}', which has no place in a folder")
        if info["type"] != "file":
            raise UserError(f"{short(address(path))}: '{short(source)}' is no regular file")
        files.append((name, int(info["size"]), str(source)))
    return files


def _wanted(
    files: list[tuple[str, int, str]], largest: Callable[[str], int | None], path: Path
) -> Iterator[tuple[str, int, str]]:
    """Yields the files that have a largest size, after a check of theirs."""
    for name, size, source in files:
        most = largest(name.rpartition("/")[2])
        if most is not None and size > most:
            raise UserError(f"{short(address(path))}/{short(name)} is too large: {size:,} of at most {most:,} bytes")
        if most is not None:
            yield name, size, source


def _copy(system: Any, source: str, target: Path, size: int, path: Path) -> None:
    """Copies a file that has been listed with this size."""
    target.parent.mkdir(parents=True, exist_ok=True)
    left = size
    with _told(path), system.open(source, "rb") as stream, target.open("wb") as file:
        while left >= 0 and (part := stream.read(min(_CHUNK, left + 1))):
            left -= len(part)
            file.write(part)
    if left:
        raise UserError(f"{short(address(path))}: '{short(source)}' changed while it was read; try again")


def _put(system: Any, file: Path, key: str) -> None:
    protocols = (system.protocol,) if isinstance(system.protocol, str) else system.protocol
    if set(_LOCAL) & set(protocols):
        system.makedirs(key.rpartition("/")[0], exist_ok=True)
    system.put_file(str(file), key)


@contextmanager
def _told(path: Path, missing_passes: bool = False) -> Iterator[None]:
    """Turns the errors of a file system, which are of many kinds, into one sentence."""
    try:
        yield
    except UserError:
        raise
    except FileNotFoundError as error:
        if missing_passes:
            raise
        raise _refused(path, error) from error
    except OSError as error:
        if error.errno == errno.ENOSPC:
            raise
        raise _refused(path, error) from error
    except Exception as error:
        raise _refused(path, error) from error


def _refused(path: Path, error: Exception) -> UserError:
    reason = short(" ".join(str(error).split()), 200) or type(error).__name__
    return UserError(f"{short(address(path))} cannot be reached: {reason}; check address, rights and network")
