"""Runs tasks side by side, each in a process of its own that prints into a log, here or on the machines of a cluster.

Where modules are named to be imported once, the processes are forked on Linux from a server that has imported them;
elsewhere they are spawned. A process ends when the command that started it does, however that ends. It locks the folder
of its task, so that a command that follows a killed one waits for the last of its processes.
"""

import contextlib
import fcntl
import multiprocessing
import os
import sys
import time
from collections.abc import Callable, Generator, Sequence
from multiprocessing.connection import wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, NamedTuple, Protocol, runtime_checkable

from predictor.support.cluster import Cluster, Lost, Packed, check_shared
from predictor.support.errors import run_entry_point
from predictor.support.locks import LOCK_FILE, open_own
from predictor.support.processes import end, follow_parent, how_it_ended, print_into, start
from predictor.support.stopping import resumable

SAVING_S = 60.0
"""Time that a task's process gets to save its training when the command is stopped [s]."""
APPENDING = os.O_WRONLY | os.O_APPEND
LOG_FILE = "log.txt"
SERVED = "forkserver" if sys.platform == "linux" else "spawn"
"""How processes start that share imports."""
_POLL_S = 0.5


@runtime_checkable
class Task(Protocol):
    """What is to be done; can be pickled."""

    @property
    def folder(self) -> Path:
        """Folder of its log."""

    @property
    def result(self) -> Path:
        """File that is there once the task is done."""

    @property
    def locked_folder(self) -> Path:
        """Folder that the command has locked, and that holds `folder`."""

    def run(self) -> None:
        """Does it, in a process of its own."""

    def waits_for(self, other: Any) -> bool:
        """Returns whether the other task has to end before this one."""


def run_tasks(
    tasks: Sequence[Task],
    *,
    workers: int,
    cluster: Cluster | None = None,
    gpus: int = 0,
    imports: Sequence[str] = (),
    on_start: Callable[[int], None] = lambda number: None,
) -> Generator[tuple[int, str | None]]:
    """Runs tasks; yields the number of each that ended, and why it has no result, or None. Closing it ends what runs.

    Args:
        tasks: tasks.
        workers: largest number of processes of this machine.
        cluster: machines that run the tasks instead, and share their folders; there, tasks that wait for others begin
            when all others have ended.
        gpus: number of GPUs of each task on a cluster.
        imports: names of modules that this machine's processes import together, once.
        on_start: called with the number of each task that starts on this machine.

    Raises:
        UserError: a machine of the cluster does not see the folder, or has other versions.
    """
    return _run_here(tasks, workers, imports, on_start) if cluster is None else _run_on(cluster, tasks, gpus)


def _run_here(
    tasks: Sequence[Task], workers: int, imports: Sequence[str], on_start: Callable[[int], None]
) -> Generator[tuple[int, str | None]]:
    waiting, running = list(range(len(tasks))), dict[int, BaseProcess]()
    try:
        while waiting or running:
            busy = [*waiting, *running]
            ready = [i for i in waiting if not any(tasks[i].waits_for(tasks[j]) for j in busy)]
            for i in ready[: workers - len(running)]:
                waiting.remove(i)
                running[i] = _started(tasks[i], tasks[i].folder, imports)
                on_start(i)
            wait([process.sentinel for process in running.values()])
            for i in [i for i, process in running.items() if process.exitcode is not None]:
                yield i, _reason(tasks[i], running.pop(i).exitcode)
    finally:
        end(list(running.values()), SAVING_S)


def _run_on(cluster: Cluster, tasks: Sequence[Task], gpus: int) -> Generator[tuple[int, str | None]]:
    late = [i for i, task in enumerate(tasks) if any(task.waits_for(other) for other in tasks)]
    for part in ([i for i in range(len(tasks)) if i not in late], late):
        remote = [
            _Remote(tasks[i].folder.absolute(), tasks[i].locked_folder.absolute(), Packed(tasks[i])) for i in part
        ]
        with contextlib.closing(cluster.results(_run_alone, remote, gpus, SAVING_S)) as results:
            for number, found in results:
                i = part[number]
                yield i, found.reason if isinstance(found, Lost) else _reason(tasks[i], found)


def _reason(task: Task, exit_code: int | None) -> str | None:
    """Returns why a task that ended has no result: how its process was killed, or the last line of its log."""
    if exit_code == 0 and task.result.exists():
        return None
    killed = exit_code is not None and exit_code < 0
    return how_it_ended(exit_code) if killed else _last_line(task.folder / LOG_FILE)


def _last_line(log: Path) -> str:
    """Returns the last line of a log; a few words if there is none."""
    lines = log.read_text(errors="replace").strip().splitlines() if log.exists() else []
    return lines[-1] if lines else "it ended without a message"


class _Remote(NamedTuple):
    """Task of a cluster; only the process that does the work unpacks it, and imports what it needs."""

    folder: Path
    locked_folder: Path
    packed: Packed


def _run_alone(remote: _Remote) -> int | None:
    """Does one task in a process beside this process of Ray; returns its exit code."""
    check_shared(remote.locked_folder)
    process = _started(remote.packed, remote.folder)
    try:
        while process.exitcode is None:  # a task that is cancelled is not woken out of `join`
            time.sleep(_POLL_S)
    finally:
        end([process], SAVING_S)
    return process.exitcode


def _started(task: Task | Packed, folder: Path, imports: Sequence[str] = ()) -> BaseProcess:
    folder.mkdir(parents=True, exist_ok=True)
    for name in (LOG_FILE, LOCK_FILE):
        os.close(open_own(folder / name, APPENDING))  # a link is told by this process, which is asked
    context: Any = multiprocessing.get_context(SERVED if imports else "spawn")
    if imports and SERVED == "forkserver":
        context.set_forkserver_preload(list(imports))
    process: BaseProcess = context.Process(target=_work, args=(task, folder))
    start(process)
    return process


def _work(task: Task | Packed, folder: Path) -> None:
    """Does a task in a process of its own; SIGTERM saves what it trains. The log of an earlier try goes on."""
    follow_parent()
    log, lock = (os.fdopen(open_own(folder / name, APPENDING), "a", 1) for name in (LOG_FILE, LOCK_FILE))
    with log, lock:
        print_into(log)
        with contextlib.suppress(OSError):  # a file system without locks
            fcntl.flock(lock, fcntl.LOCK_EX)  # the process of a command or machine that was killed may still be here
        opened: Task = task.unpack() if isinstance(task, Packed) else task
        if not opened.result.exists():
            run_entry_point(lambda: _run(opened))


def _run(task: Task) -> None:
    with resumable("the same command goes on"):
        task.run()
