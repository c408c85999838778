"""Tasks in processes of their own: each ends once, in an order that fits, and none stays behind."""

import multiprocessing
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
from predictor.support.jobs import LOG_FILE, run_tasks
from predictor.support.processes import end

SCRIPT = """
import sys
from multiprocessing.resource_tracker import ensure_running
from pathlib import Path

from tests.predictor.support.test_jobs import Sleeper
from predictor.support.errors import run_entry_point
from predictor.support.jobs import run_tasks

folder = Path(sys.argv[1])
if sys.argv[2] == "again":
    ensure_running()  # as after any other process
(folder / "began").touch()
tasks, imports = [Sleeper(folder / "task")], ["tests.predictor.support.slow_import"] if sys.argv[2] != "late" else []
run_entry_point(lambda: print(list(run_tasks(tasks, workers=1, imports=imports))))
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
        (self.locked_folder / "runs").touch()
        time.sleep(300)


@pytest.mark.slow
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


@pytest.mark.parametrize("name", [LOG_FILE, ".lock"])
def test_a_planted_link_is_not_written_through(tmp_path: Path, name: str):
    (tmp_path / "victim").write_text("years of work")
    (tmp_path / "task").mkdir()
    (tmp_path / "task" / name).symlink_to(tmp_path / "victim")
    with pytest.raises(UserError, match=f"task/{name} must be a file of its own, not a link or a pipe; remove it"):
        list(run_tasks([Toy(tmp_path / "task")], workers=1))
    assert (tmp_path / "victim").read_text() == "years of work"


@pytest.mark.slow
def test_tasks_wait_for_those_that_they_need(tmp_path: Path):
    tasks = [Toy(tmp_path / "last", ("first", "second")), Toy(tmp_path / "first"), Toy(tmp_path / "second", ("first",))]
    started: list[int] = []
    ended = list(run_tasks(tasks, workers=3, on_start=started.append))
    assert ended == [(1, None), (2, None), (0, None)] and started == [1, 2, 0]
    assert all(task.result.read_text() == "[]" for task in tasks)


@pytest.mark.slow
@pytest.mark.parametrize("when", ["first", "again"])
def test_ctrl_c_while_a_process_starts_ends_it(tmp_path: Path, when: str):
    """The server imports for seconds first; a Ctrl-C in that time was lost, or left the process behind."""
    assert stopped(tmp_path, when, "began", signal.SIGINT, after_s=1.0) == 130


@pytest.mark.slow
def test_the_log_of_a_task_that_was_stopped_says_that_it_goes_on(tmp_path: Path):
    assert stopped(tmp_path, "late", "runs", signal.SIGTERM) == 143
    assert (tmp_path / "task" / LOG_FILE).read_text() == "stopped: the same command goes on\n"


def stopped(folder: Path, when: str, begun: str, number: signal.Signals, after_s: float = 0.0) -> int:
    """Returns the exit status of a command that a signal stops once a file is there."""
    running = subprocess.Popen([sys.executable, "-c", SCRIPT, str(folder), when], stderr=subprocess.PIPE, text=True)
    try:
        while not (folder / begun).exists():
            assert running.poll() is None
            time.sleep(0.05)
        time.sleep(after_s)
        running.send_signal(number)
        _, said = running.communicate(timeout=120)
    finally:
        running.kill()
        running.wait()
    assert said.startswith("stopped: "), said
    return running.returncode


@pytest.mark.slow
def test_a_second_ctrl_c_kills_what_does_not_end(tmp_path: Path):
    process = multiprocessing.get_context("spawn").Process(target=stay, args=(tmp_path / "stays",))
    process.start()
    while not (tmp_path / "stays").exists():
        assert process.is_alive()
        time.sleep(0.05)
    before = signal.signal(signal.SIGALRM, signal.default_int_handler)
    signal.alarm(1)
    try:
        with pytest.raises(KeyboardInterrupt):
            end([process], patience_s=300.0)
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)
    assert process.exitcode == -signal.SIGKILL


def stay(began: Path) -> None:
    """Ignores that it is asked to end."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    began.touch()
    time.sleep(300)
