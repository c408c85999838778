"""Locks, so that one process at a time writes a folder or a store.

A lock is one of the operating system (flock) on a hidden file, which it takes back when the process ends, however that
ends: what is left of a killed process never blocks. Within one process a lock may be taken again.
"""

import contextlib
import errno
import fcntl
import os
import stat
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from predictor.support.errors import UserError
from predictor.support.remote import is_remote, require_local

LOCK_FILE = ".lock"
_NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)
"""Errors of file systems without locks; there, nothing is locked."""


@dataclass
class _Held:
    """Lock that this process holds."""

    descriptor: int
    holders: int = 0


_held: dict[str, _Held] = {}


@contextlib.contextmanager
def locked(folder: Path, what: str) -> Iterator[None]:
    """Holds the lock of a folder in which `what` runs; makes the folder, and removes it if it stays empty.

    Raises:
        UserError: another process holds it.
    """
    require_local(folder, "--out")
    with _made(folder), _held_file(folder / LOCK_FILE, f"another {what} runs in {folder}", "--out"):
        yield


@contextlib.contextmanager
def locked_path(path: Path) -> Iterator[None]:
    """Holds the lock of a store that is written as a whole, by a file beside it; other file systems have no locks.

    Raises:
        UserError: another process writes it.
    """
    if is_remote(path):
        yield
        return
    place = Path(os.path.realpath(path))  # what a link leads to is what is written
    lock = place.with_name(f".{place.name}.lock")
    with _made(place.parent), _held_file(lock, f"another process writes {path}", "path"):
        yield


@contextlib.contextmanager
def _made(folder: Path) -> Iterator[None]:
    """Makes a folder and those above it; removes those that it made and that stay empty."""
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    try:
        yield
    finally:
        with contextlib.suppress(OSError):
            for path in missing:  # the innermost first; one that is not empty ends it
                path.rmdir()


@contextlib.contextmanager
def _held_file(file: Path, problem: str, other: str) -> Iterator[None]:
    key = os.path.abspath(file)
    if key not in _held:
        _held[key] = _Held(_taken(file, problem, other))
    held = _held[key]
    held.holders += 1
    try:
        yield
    finally:
        held.holders -= 1
        if not held.holders:  # of several threads the last one to leave
            _held.pop(key, None)
            with contextlib.suppress(OSError):
                file.unlink()
            os.close(held.descriptor)


def _taken(file: Path, problem: str, other: str) -> int:
    """Returns the descriptor of a file that is locked and still there: another process may have removed it."""
    while True:
        descriptor = open_own(file, os.O_RDWR)
        try:
            _lock(descriptor, problem, other)
            if _is_there(file, descriptor):
                with contextlib.suppress(OSError):  # a full disk takes no number
                    os.truncate(descriptor, 0)
                    os.write(descriptor, str(os.getpid()).encode())
                return descriptor
        except BaseException:  # Ctrl-C, too: a lock that is left behind would refuse this process itself
            os.close(descriptor)
            raise
        os.close(descriptor)


def open_own(file: Path, flags: int) -> int:
    """Opens a file of a run's own for writing, and makes it if there is none; returns its descriptor.

    Raises:
        UserError: it is a link, or another name of a file, which a stranger's folder may have: what it leads to would
            be written over. Or it is no file.
    """
    try:
        descriptor = os.open(file, flags | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK, 0o644)
    except OSError as error:
        if error.errno not in (errno.ELOOP, errno.EMLINK, errno.ENXIO, errno.EISDIR):
            raise
        raise UserError(f"{file} must be a file of its own, not a link or a pipe; remove it") from error
    found = os.fstat(descriptor)
    if not stat.S_ISREG(found.st_mode) or found.st_nlink > 1:
        os.close(descriptor)
        raise UserError(f"{file} must be a file of its own, not a link or a pipe; remove it")
    return descriptor


def _lock(descriptor: int, problem: str, other: str) -> None:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        found = os.read(descriptor, 20).decode(errors="replace").strip() or "unknown"
        raise UserError(f"{problem} (process {found}); wait for its end or choose another {other}") from error
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            raise


def _is_there(file: Path, descriptor: int) -> bool:
    try:
        return os.path.samestat(os.stat(file), os.fstat(descriptor))
    except FileNotFoundError:
        return False
