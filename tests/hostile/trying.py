"""Tries a command line in a process of its own, and says what came of it."""

import contextlib
import os
import shutil
import signal
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol

from predictor.support.errors import MOST_LETTERS, run_entry_point
from tests.hostile.inputs import snapshot

Verdict = Literal["one clear line", "argued fine", "traceback", "silent", "unclear", "hang", "death", "files changed"]
MOST_S = 60.0
"""Time after which a command counts as hanging [s]."""


class Trial(Protocol):
    """What is tried."""

    @property
    def title(self) -> str:
        """Name of the trial."""

    @property
    def expected(self) -> tuple[str, ...]:
        """Parts of the line, of which one must be there."""

    def run(self) -> None:
        """Does it, in a folder of inputs; raises, or prints and exits."""


@dataclass(frozen=True)
class Outcome:
    """What came of a trial."""

    verdict: Verdict
    """Kind of end."""
    said: str
    """What it said on stderr."""
    seconds: float
    """Time that it took."""


def try_apart(trial: Trial, inputs: Path, most_s: float = MOST_S) -> Outcome:
    """Runs a trial in a forked process, in a copy of the inputs; modules must be imported before."""
    with tempfile.TemporaryDirectory(prefix="hostile-", ignore_cleanup_errors=True) as name:
        folder = Path(name) / "here"
        copy_inputs(inputs, folder)
        before, began = snapshot(folder), time.monotonic()
        errors = Path(name) / "stderr"
        child = os.fork()
        if child == 0:
            _run(trial, folder, errors)
        status = _wait(child, most_s)
        seconds, said = time.monotonic() - began, errors.read_text(errors="replace")
        return Outcome(_verdict(trial, status, said, before != snapshot(folder)), said, seconds)


def copy_inputs(inputs: Path, folder: Path) -> None:
    """Copies a folder with its links and pipes."""
    shutil.copytree(inputs, folder, symlinks=True, ignore=lambda _, names: {"fifo"} & set(names))
    os.mkfifo(folder / "fifo")


def _run(trial: Trial, folder: Path, errors: Path) -> None:
    """Runs the command in this process, which ends with it."""
    status = 70
    try:
        os.setsid()
        os.chdir(folder)
        for number, path in ((1, os.devnull), (2, str(errors))):
            os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), number)
        sys.stdout, sys.stderr = os.fdopen(1, "w", closefd=False), os.fdopen(2, "w", closefd=False)
        run_entry_point(trial.run)
        status = 0
    except SystemExit as leaving:
        status = leaving.code if isinstance(leaving.code, int) else 1
    except BaseException:
        import traceback

        traceback.print_exc()
    finally:
        with contextlib.suppress(BaseException):
            sys.stdout.flush(), sys.stderr.flush()
        os._exit(status)


def _wait(child: int, most_s: float) -> int | None:
    """Returns the exit status of a process, negative for a signal; None if it was killed for taking too long."""
    until = time.monotonic() + most_s
    while True:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(child, signal.SIGKILL)  # workers that it started
            return os.waitstatus_to_exitcode(status)
        if time.monotonic() > until:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(child, signal.SIGKILL)
            os.waitpid(child, 0)
            return None
        time.sleep(0.002)


def _verdict(trial: Trial, status: int | None, said: str, changed: bool) -> Verdict:
    if status is None:
        return "hang"
    if status < 0:
        return "death"
    if "Traceback (most recent call last)" in said:
        return "traceback"
    if status == 0:
        return "silent"
    if changed:
        return "files changed"
    return "one clear line" if status == 2 and is_clear(said, trial.expected) else "unclear"


def is_clear(said: str, expected: tuple[str, ...]) -> bool:
    """Returns whether an error is one printable line that names what is wrong."""
    line = said.rstrip("\n")
    named = not any(expected) or any(part in line for part in expected if part)
    return line.startswith("error: ") and line.isprintable() and len(line) <= MOST_LETTERS + 20 and named
