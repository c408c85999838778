"""Tasks in processes of their own: each ends once, in an order that fits, and none stays behind."""

import contextlib
import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from predictor.support.errors import UserError
from predictor.support.jobs import run_tasks

SCRIPT = """
import sys
from pathlib import Path

from tests.predictor.support.test_jobs import Sleeper, tracker_runs
from predictor.support.errors import run_entry_point
from predictor.support.jobs import run_tasks

folder = Path(sys.argv[1])
if sys.argv[2] == "again":
    tracker_runs()
(folder / "began").touch()
tasks = [Sleeper(folder / "task")]
run_entry_point(lambda: print(list(run_tasks(tasks, workers=1, imports=["tests.predictor.support.slow_import"]))))
"""


@dataclass(frozen=True)
class Toy:
    """Task that ends as its name says."""

    folder: Path
    after: tuple[str, ...] = ()

    @property
    def result(self) -> Path:
        return self.folder / "result"

    @property
    def locked_folder(self) -> Path:
        return self.folder.parent

    def waits_for(self, other: "Toy") -> bool:
        return other.folder.name in self.after

    def run(self) -> None:
        ends: dict[str, Any] = {"wrong": UserError("what was wrong"), "broken": RuntimeError("what broke")}
        if self.folder.name == "killed":
            os.kill(os.getpid(), signal.SIGKILL)
        if self.folder.name in ends:
            raise ends[self.folder.name]
        if self.folder.name != "idle":
            missing = [name for name in self.after if not (self.locked_folder / name / "result").exists()]
            self.result.write_text(str(missing))


@dataclass(frozen=True)
class Sleeper(Toy):
    """Task that takes minutes."""

    def run(self) -> None:
        time.sleep(300)


def tracker_runs() -> None:
    """Starts what multiprocessing keeps beside a process that has started another one."""
    from multiprocessing.resource_tracker import ensure_running

    ensure_running()


def test_each_task_ends_with_its_reason(tmp_path: Path):
    names = ("good", "wrong", "broken", "killed", "idle")
    reasons = dict(run_tasks([Toy(tmp_path / name) for name in names], workers=2))
    assert [reasons[i] for i in range(5)] == [
        None,
        "error: what was wrong",
        "RuntimeError: what broke",
        "its process was killed by SIGKILL (by the system, if memory ran out)",
        "it ended without a message",
    ]


def test_tasks_wait_for_those_that_they_need(tmp_path: Path):
    tasks = [Toy(tmp_path / "last", ("first", "second")), Toy(tmp_path / "first"), Toy(tmp_path / "second", ("first",))]
    ended = list(run_tasks(tasks, workers=3))
    assert ended == [(1, None), (2, None), (0, None)]
    assert all(task.result.read_text() == "[]" for task in tasks)


@pytest.mark.parametrize("when", ["first", "again"])
def test_ctrl_c_while_a_process_starts_ends_it(tmp_path: Path, when: str):
    """The server imports for seconds first; a Ctrl-C in that time was lost, or left the process behind."""
    command = [sys.executable, "-c", SCRIPT, str(tmp_path), when]
    running = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    try:
        while not (tmp_path / "began").exists():
            assert running.poll() is None
            time.sleep(0.05)
        time.sleep(1.0)
        running.send_signal(signal.SIGINT)
        _, said = running.communicate(timeout=120)
    finally:
        with contextlib.suppress(ProcessLookupError):
            running.kill()
        running.wait()
    assert running.returncode == 130 and said.startswith("stopped: "), said
