"""Runs commands so that all their processes can be found again, and judges what they leave."""

import os
import subprocess
import time
import uuid
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
ORPHAN_S = 60.0
"""Longest time that a process may live on after the command that started it [s]."""
TRACEBACK = "Traceback (most recent call last)"
_MARK = "STORM_RUN"


@dataclass
class Run:
    """Command that runs."""

    process: subprocess.Popen[bytes]
    """Its own process."""
    mark: str
    """Value of an environment variable that all its processes inherit."""
    log: Path
    """File with all that it says."""
    began_at: int
    """Length of the log before it began [bytes]."""

    def said(self) -> str:
        """Returns what it said so far."""
        return self.log.read_bytes()[self.began_at :].decode(errors="replace")


def start(words: Sequence[str], log: Path, errors: Path | None = None) -> Run:
    """Starts a command; what it says is added to a log, its stderr to a file of its own if one is given."""
    mark = uuid.uuid4().hex
    before = log.stat().st_size if log.exists() else 0
    environment = os.environ | {_MARK: mark, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    with log.open("ab") as stream, (errors or log).open("ab") as error_stream:
        process = subprocess.Popen(
            words, cwd=ROOT, env=environment, stdin=subprocess.DEVNULL, stdout=stream, stderr=error_stream,
            start_new_session=True,
        )  # fmt: skip
    return Run(process, mark, log, before)


def finish(run: Run) -> int:
    """Waits for a command; returns its exit status. A storm that is stopped meanwhile takes it along."""
    try:
        return run.process.wait()
    finally:
        run.process.kill()


def orphans(run: Run, patience_s: float = ORPHAN_S) -> list[int]:
    """Returns the processes of a command that ended which still live after some time."""
    until = time.monotonic() + patience_s
    while (found := _processes_with(run.mark)) and time.monotonic() < until:
        time.sleep(0.2)
    return found


def _processes_with(mark: str) -> list[int]:
    wanted, found = f"{_MARK}={mark}".encode(), []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            inherited = (folder / "environ").read_bytes().split(b"\0")
            is_dead = (folder / "stat").read_text().rpartition(")")[2].split()[0] == "Z"
        except OSError:
            continue
        if wanted in inherited and not is_dead:
            found.append(int(folder.name))
    return found


def tracebacks_below(folder: Path) -> int:
    """Returns the number of tracebacks in the logs that a command's own processes wrote below a folder."""
    return sum(path.read_text(errors="replace").count(TRACEBACK) for path in folder.rglob("log.txt"))
