"""Errors that a user can cause, printed by an entry point in one line, with exit status 2 and no traceback.

Signals end a command in one line, too: Ctrl-C with status 130, SIGTERM with status 143. What was saved and how to go on
is told by `predictor.support.stopping.resumable`.
"""

import contextlib
import errno
import io
import os
import select
import signal
import sys
import threading
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

_WRONG_PATH = (FileNotFoundError, FileExistsError, NotADirectoryError, IsADirectoryError, PermissionError)
"""Errors that say by themselves what is wrong, where they are not of the operating system."""

DISK_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EFBIG, errno.EIO)
"""Errors of the operating system when a disk is full, over its quota, read-only or broken."""

_WRONG_NAMES = {
    errno.ENOENT: "there is no such file or folder",
    errno.EEXIST: "something else is there, or a part of the path is a file",
    errno.ENOTDIR: "a part of the path is a file, not a folder",
    errno.EISDIR: "it is a folder, not a file",
    errno.EACCES: "no permission for it",
    errno.EPERM: "no permission for it",
    errno.ENAMETOOLONG: "its name is too long",
    errno.ELOOP: "it has links that lead in a circle",
    errno.ENXIO: "it is a pipe, a device or a socket",
}
"""Errors of the operating system for paths that do not fit, and what is wrong with them."""


_UNREAD = 128 + signal.SIGPIPE
"""Exit status where nobody reads the output, as of other commands."""


class UserError(ValueError):
    """Raised for bad input; the message names what was required, what was given and what to do."""


class CannotWriteError(UserError):
    """Raised when a disk takes no more; what was there before is whole."""


class Terminated(BaseException):
    """Raised in the main thread when SIGTERM asks the process to end."""


class ProtocolError(RuntimeError):
    """Raised when methods are called in a wrong order (for example a step before the first reset)."""


MOST_LETTERS = 2000
"""Largest length of a message; a longer one is cut in the middle."""


def short(value: object, letters: int = 300) -> str:
    """Returns a value as text of at most this many letters (2 or more), cut in the middle: for names in messages."""
    text = str(value)
    return text if len(text) <= letters else f"{text[: (letters - 1) // 2]}…{text[-(letters // 2) :]}"


def some(values: list[Any], most: int = 3) -> str:
    """Returns the first few of many values as text, and how many more there are: for lists in messages."""
    return short(values[:most]) + (f" and {len(values) - most:,} more" if len(values) > most else "")


def named(error: BaseException) -> str:
    """Returns kind and message of an error, whose message alone may say too little (a KeyError's)."""
    return f"{type(error).__name__}: {error}"


def one_line(error: BaseException) -> str:
    """Returns the message of an error as one line that a terminal shows as it is.

    Files name things: their control characters, which could move the cursor or end the line, become spaces.
    """
    shown = "".join(letter if letter.isprintable() else " " for letter in str(error))
    return short(" ".join(shown.split()), MOST_LETTERS)


def reason_of(error: BaseException) -> str:
    """Returns an error in words: the message of a user error, else its type and the line that raised it, too."""
    text = short(one_line(error), 500)
    if isinstance(error, UserError):
        return text
    frames = traceback.extract_tb(error.__traceback__)
    where = f" ({frames[-1].filename}, line {frames[-1].lineno})" if frames else ""
    return f"{type(error).__name__}: {text or 'no message'}{where}"


def run_entry_point(main: Callable[[], None]) -> None:
    """Runs `main`; prints user errors, full disks, Ctrl-C and SIGTERM in one line on stderr and exits.

    Exit status: 2 after an error, 130 after Ctrl-C, 143 after SIGTERM; 141 and no line where whatever read the
    output has left (`| head`).
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a terminal without Unicode shows ? for what it does not have
            stream.reconfigure(errors="replace")
    try:
        with _until_reader_leaves(), _terminable():
            main()
    except UserError as error:
        _leave("error", one_line(error), error, 2)
    except OSError as error:
        if error.errno is None and isinstance(error, _WRONG_PATH):
            _leave("error", one_line(error), error, 2)
        if error.errno in _WRONG_NAMES:
            _leave("error", one_line(Exception(cannot_use(error))), error, 2)
        if error.errno not in DISK_ERRORS:
            raise
        _leave("error", cannot_write(error.filename or "the output", error), error, 2)
    except KeyboardInterrupt as stop:
        _leave("stopped", "", stop, 128 + signal.SIGINT)
    except Terminated as stop:
        _leave("stopped", "", stop, 128 + signal.SIGTERM)


def cannot_write(path: object, error: OSError) -> str:
    """Returns the message for a path that a disk does not take."""
    reason = os.strerror(error.errno or errno.EIO)
    return f"cannot write {path}: {reason}; what was there before is whole; make room or choose another disk"


def cannot_use(error: OSError, path: object = None) -> str:
    """Returns the message for a path that does not fit."""
    path = error.filename2 or error.filename or "a path" if path is None else path
    return f"{short(path)} cannot be used: {_WRONG_NAMES.get(error.errno or 0, error.strerror)}; choose another path"


def _leave(word: str, message: str, error: BaseException, status: int) -> None:
    """Prints one line, with what was said on how to go on, and exits."""
    advice = _advice(error)
    if word == "stopped" and advice is None:
        advice = "what was not written yet is lost; the same command begins anew"
    if word == "stopped":  # in the middle of a read or a write of Zarr, which Python would tell at its end
        warnings.filterwarnings("ignore", "coroutine .* was never awaited", RuntimeWarning)
    text = "; ".join(filter(None, (message, advice)))
    print(f"{word}: {text}", file=sys.stderr)
    sys.exit(status)


def _advice(error: BaseException | None) -> str | None:
    """Returns the first note of an error, or of one during whose handling it came (a second Ctrl-C)."""
    while error is not None:
        if notes := getattr(error, "__notes__", None):
            return one_line(Exception(notes[0]))
        error = error.__context__
    return None


@contextmanager
def _until_reader_leaves() -> Iterator[None]:
    """Exits without a word if the output is a pipe that nobody reads any more; what else ends the block is kept."""
    try:
        yield
    except BrokenPipeError:
        if not _reader_left():
            raise
        _discard()
        sys.exit(_UNREAD)
    except SystemExit as end:
        # rich exits with 1 where it finds that nobody reads
        if (not _flush() and not end.code) or isinstance(end.__context__, BrokenPipeError):
            sys.exit(_UNREAD)
        raise
    except BaseException:
        with contextlib.suppress(OSError):  # a full disk; what ends the block says more
            _flush()
        raise
    if not _flush():
        sys.exit(_UNREAD)


def _flush() -> bool:
    """Flushes the output, not only at the interpreter's end, which prints an error; returns whether it is read."""
    if sys.stdout is None or sys.stdout.closed:
        return True
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        _discard()
        return False
    return True


def _discard() -> None:
    """Lets what is still written to the output go nowhere."""
    with open(os.devnull, "w") as nowhere:
        os.dup2(nowhere.fileno(), sys.stdout.fileno())


def _reader_left() -> bool:
    """Returns whether the standard output is a pipe or a socket whose other end is closed."""
    try:
        number = sys.stdout.fileno()
    except (AttributeError, OSError, ValueError):  # there is none, it is not a file, or a closed one
        return False
    pipe = select.poll()
    pipe.register(number, select.POLLOUT)
    return any(event & (select.POLLERR | select.POLLHUP) for _, event in pipe.poll(0))


@contextmanager
def _terminable() -> Iterator[None]:
    """Raises `Terminated` at SIGTERM inside the block; elsewhere than in the main thread it changes nothing."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, _terminate)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _terminate(number: int, frame: FrameType | None) -> None:
    raise Terminated
