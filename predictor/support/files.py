"""Writing of files and folders so that a reader finds the old version or the whole new one, never a part.

Unfinished files are beside their targets, under hidden names that end in ``.partial``. On Linux a folder is exchanged
with the new one at once; elsewhere it is absent for a moment, and after a crash the old one may be beside it, as
``.NAME.old``. A disk that is full or read-only ends in one sentence (`CannotWriteError`), with the old version whole.
"""

import contextlib
import ctypes
import glob
import json
import math
import os
import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from predictor.support.errors import DISK_ERRORS, CannotWriteError, UserError, cannot_use, cannot_write, short
from predictor.support.remote import address, is_remote, require_local, uploaded

Stamp = tuple[int, int]
"""Time of the last change [ns] and size [bytes] of a file; zeros of one that is not there."""
_FULL_BYTES = 65_536
"""Free space below which a disk counts as full when a library fails to write without saying why."""
_CODE = 8
"""Number of digits in the name of an unfinished file."""
_HERE, _EXCHANGE = -100, 2  # AT_FDCWD of <fcntl.h>, RENAME_EXCHANGE of <linux/fs.h>


def stamp(path: str | Path) -> Stamp:
    """Returns the stamp of a file: what is kept of the file is kept with it, and made anew if the file is replaced."""
    try:
        found = os.stat(path)
    except OSError:
        return 0, 0
    return found.st_mtime_ns, found.st_size


@contextmanager
def new_file(path: Path) -> Iterator[Path]:
    """Yields a temporary path to write to; renames it to `path` at the end, or deletes it if the body raises.

    The content is flushed to disk before it is renamed, so that even a power cut leaves the old file or the new one.
    The temporary name has the suffix of `path`, by which encoders choose their format. A missing parent folder is made.
    To another file system (`s3://…`) it is copied at the end.
    """
    if is_remote(path):
        with uploaded(path) as partial:
            yield partial
        return
    with disk_errors_of(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        partial = _beside(path, path.suffix)
        try:
            with disk_errors_of(path):  # while the part still fills the disk
                yield partial
                _flush(partial)
            os.replace(partial, path)
            _flush(path.parent)
        finally:
            partial.unlink(missing_ok=True)


@contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """Yields an empty temporary folder to fill; replaces `path` by it at the end, or deletes it on an error.

    What is written into it with `new_file` is on the disk before the folder is replaced; of other files a power cut may
    leave an empty one.
    On another file system (`s3://…`) it is replaced file by file (`predictor.support.remote.uploaded`).
    """
    if is_remote(path):
        with uploaded(path) as partial:
            partial.mkdir()
            yield partial
        return
    path = Path(os.path.realpath(path))  # what a link leads to is replaced, not the link
    with scratch_folder(path) as partial:
        with disk_errors_of(path):
            yield partial
            _replace_folder(partial, path)
            _flush(path.parent)


@contextmanager
def told_of(path: Path, partial: Path) -> Iterator[None]:
    """Lets the errors of a block name the place that is written to, not the unfinished folder."""
    try:
        yield
    except UserError as error:
        raise UserError(f"{str(error).replace(str(partial), address(path))}; nothing was written") from error


@contextmanager
def scratch_folder(path: Path) -> Iterator[Path]:
    """Yields an empty temporary folder beside `path`, on the same disk; deletes it at the end."""
    with disk_errors_of(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        partial = _beside(path)
        partial.mkdir()
    try:
        yield partial
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def copy_file(source: Path, target: Path) -> None:
    """Copies a file to `target`."""
    with new_file(target) as partial:
        shutil.copyfile(source, partial)


def write_bytes(path: Path, content: bytes) -> None:
    """Writes a file of bytes."""
    with new_file(path) as partial:
        partial.write_bytes(content)


def write_text(path: Path, text: str) -> None:
    """Writes text as UTF-8."""
    with new_file(path) as partial:
        partial.write_text(text, encoding="utf-8")


def write_json(path: Path, content: Any) -> None:
    """Writes JSON; NumPy's numbers as numbers, other values without a JSON type as strings."""
    write_text(path, json.dumps(content, indent=2, default=plain) + "\n")


def plain(value: Any) -> Any:
    """Returns what JSON holds of a value without a JSON type: a number of NumPy's, or a text."""
    return value.item() if isinstance(value, np.generic) else str(value)


def finite(content: Any) -> Any:
    """Returns the content with lists for arrays, and None for NaN and infinity, which JSON does not have."""
    if isinstance(content, np.ndarray):
        return finite(content.tolist())
    if isinstance(content, dict):
        return {key: finite(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [finite(value) for value in content]
    return None if isinstance(content, float) and not math.isfinite(content) else content


def check_out(out: Path, only_stores: bool = False) -> None:
    """Checks that the folder of a command's output is a local one and not a file; called before any work is done.

    Args:
        out: path of the folder.
        only_stores: whether only stores are written below it, which may be on other file systems.

    Raises:
        UserError: it is not, or nothing can be written there.
    """
    if only_stores and is_remote(out):
        return
    require_local(out, "--out")
    check_place(out)
    if out.exists() and not out.is_dir():
        raise UserError(f"{out} is a file; choose another --out")
    _check_writable(out)


def check_out_file(out: Path | None) -> None:
    """Checks that the file of a command's result, if there is one, can be written; called before any work is done.

    Raises:
        UserError: it is a folder, or nothing can be written there.
    """
    if out is None:
        return
    check_place(out)
    if out.is_dir():
        raise UserError(f"{out} is a folder; name a file")
    _check_writable(out.parent)


def _check_writable(folder: Path) -> None:
    there = next(place for place in (folder.absolute(), *folder.absolute().parents) if place.exists())
    if not os.access(there, os.W_OK | os.X_OK):
        raise UserError(f"{folder} cannot be used: no permission to write in {there}; choose another --out")


def check_place(out: Path) -> None:
    """Checks that a path can become a file or a folder, unless it is an address; called before any work is done.

    Raises:
        UserError: its name is too long, a part of it is a file, or it is a link that leads nowhere or in a circle.
    """
    if is_remote(out):
        return
    try:
        if out.name:
            with contextlib.suppress(FileNotFoundError):
                os.stat(_beside(out, out.suffix))  # whose name is longer
        os.stat(out)
    except FileNotFoundError as error:
        if out.is_symlink():
            raise UserError(f"{out} is a link that leads nowhere; choose another path") from error
    except OSError as error:
        raise UserError(cannot_use(error, out)) from error
    except ValueError as error:  # a NUL in the name
        raise UserError(f"{short(out)} cannot be used: {error}; choose another path") from error


def delete_leftovers(folder: Path, name: str = "") -> None:
    """Deletes the unfinished files that a killed process left in a folder, those of the file `name` if given."""
    pattern = f".{glob.escape(name)}.{'[0-9a-f]' * _CODE}.partial*" if name else ".*.partial*"
    for leftover in folder.glob(pattern):
        if leftover.is_dir() and not leftover.is_symlink():
            shutil.rmtree(leftover, ignore_errors=True)
        else:
            leftover.unlink(missing_ok=True)


def delete_folder(folder: Path) -> None:
    """Deletes a folder as a whole: one that is deleted in part has another name."""
    doomed = _beside(folder)
    folder.rename(doomed)
    shutil.rmtree(doomed, ignore_errors=True)


def _beside(path: Path, suffix: str = "") -> Path:
    return path.with_name(f".{path.name}.{uuid.uuid4().hex[:_CODE]}.partial{suffix}")


def _flush(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextmanager
def disk_errors_of(path: Path) -> Iterator[None]:
    """Turns the errors of a full or read-only disk into one sentence that names a path that is written inside.

    Raises:
        CannotWriteError: the disk took no more.
    """
    try:
        yield
    except CannotWriteError:
        raise
    except Exception as error:
        cause = _disk_error_in(error, path)
        if cause is None:
            raise
        raise CannotWriteError(cannot_write(path, cause)) from error


def _disk_error_in(error: BaseException, path: Path) -> OSError | None:
    """Returns the disk's error behind one of a library, which may hide it (torch, ffmpeg); None if there is none."""
    seen: BaseException | None = error
    while seen is not None:
        if isinstance(seen, OSError) and seen.errno in DISK_ERRORS:
            return seen
        seen = seen.__cause__ or seen.__context__
    if isinstance(error, UserError):
        return None
    try:
        free = os.statvfs(path.parent)
    except OSError:
        return None
    return OSError(DISK_ERRORS[0], "") if free.f_bavail * free.f_frsize < _FULL_BYTES else None


def _replace_folder(new: Path, target: Path) -> None:
    """Replaces `target` by `new`; a crash leaves one of them whole, under the target's name or beside it."""
    if not target.exists():
        new.rename(target)
        return
    if _exchange(new, target):
        return  # what is now the old folder is deleted with the temporary one
    old = target.with_name(f".{target.name}.old")
    shutil.rmtree(old, ignore_errors=True)
    target.rename(old)
    os.replace(new, target)
    shutil.rmtree(old, ignore_errors=True)


def _exchange(first: Path, second: Path) -> bool:
    """Exchanges two paths of one disk at once; returns whether the system can."""
    rename = getattr(ctypes.CDLL(None), "renameat2", None) if os.name == "posix" else None
    return rename is not None and rename(_HERE, os.fsencode(first), _HERE, os.fsencode(second), _EXCHANGE) == 0
