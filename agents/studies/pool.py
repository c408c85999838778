"""Runs cells side by side, each in a process of its own, in a folder that one study uses at a time.

On Linux all processes are forked from a server that has imported everything once (5 s); elsewhere they are spawned.

A process ends when the study that started it does, however that ends: it waits for a pipe to close. A cell that is
being run is locked, so that a study that follows a killed one waits for the last of its processes.
"""

import contextlib
import fcntl
import multiprocessing
import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

from tqdm import tqdm  # type: ignore[import-untyped]

from agents.studies.cells import LOG_FILE, Cell, run_cell
from agents.studies.results import RESULT_FILE
from predictor.support.cluster import Cluster
from predictor.support.errors import UserError
from predictor.support.jobs import ended_on, why_failed
from predictor.support.locks import LOCK_FILE
from predictor.support.processes import ctrl_c_ignored, end, print_into
from predictor.support.runtime import keep_freed_memory

START_METHOD = "forkserver" if sys.platform == "linux" else "spawn"


@dataclass(frozen=True)
class Running:
    """Cell whose process runs."""

    cell: Cell
    """Cell that is run."""
    process: Any
    """Process that runs it."""
    lifeline: Connection
    """End of a pipe; the process ends when it closes."""


def run_cells(
    cells: Sequence[Cell], folder: Path, workers: int, commit: str, on_end: Callable[[Cell, str | None], None]
) -> None:
    """Runs cells in processes, at most `workers` at a time; returns when all have ended.

    Args:
        cells: cells without a result.
        folder: folder of the cells' folders.
        workers: largest number of processes.
        commit: commit whose code runs them.
        on_end: called with each cell that ended, and why it has no result; with None if it has one.
    """
    waiting, running = list(cells), list[Running]()
    try:
        while waiting or running:
            while waiting and len(running) < workers:
                running.append(_start(waiting.pop(0), folder, commit))
            ended = wait([one.process.sentinel for one in running])
            for one in [one for one in running if one.process.sentinel in ended]:
                one.process.join()
                one.lifeline.close()
                running.remove(one)
                on_end(one.cell, _reason(folder / one.cell.name, one.process.exitcode))
    finally:
        _stop(running)


def run_cells_on(
    cluster: Cluster, cells: Sequence[Cell], folder: Path, commit: str, on_end: Callable[[Cell, str | None], None]
) -> None:
    """Runs cells on the machines of a cluster, which share the folder; returns when all have ended.

    Args:
        cluster: cluster.
        cells: cells without a result.
        folder: folder of the cells' folders, inside that of the study, which is locked.
        commit: commit whose code runs them.
        on_end: called with each cell that ended, and why it has no result; with None if it has one.

    Raises:
        UserError: a machine does not see the folder, or has other versions.
    """
    tasks = [_Task(cell, folder.absolute(), commit) for cell in cells]
    with contextlib.closing(ended_on(cluster, tasks)) as ended:
        for number, reason in ended:
            on_end(cells[number], reason or _reason(tasks[number].folder, 0))


def _reason(folder: Path, exit_code: int | None) -> str | None:
    """Returns why a cell that ended has no result; None if it has one."""
    if exit_code == 0 and (folder / RESULT_FILE).exists():
        return None
    return why_failed(folder / LOG_FILE, exit_code)


@dataclass(frozen=True)
class _Task:
    """Cell that is run on a machine of a cluster."""

    cell: Cell
    cells: Path
    commit: str

    @property
    def name(self) -> str:
        """Name in messages."""
        return self.cell.title

    @property
    def folder(self) -> Path:
        """Folder of the cell."""
        return self.cells / self.cell.name

    @property
    def result(self) -> Path:
        """File of its result."""
        return self.folder / RESULT_FILE

    @property
    def locked_folder(self) -> Path:
        """Folder of the study."""
        return self.cells.parent

    def run(self) -> None:
        """Runs the cell."""
        _prepare()
        run_cell(self.cell, self.folder, self.commit)


def _start(cell: Cell, folder: Path, commit: str) -> Running:
    """Starts the process of a cell; what it prints goes into the cell's log."""
    context: Any = multiprocessing.get_context(START_METHOD)
    if START_METHOD == "forkserver":
        context.set_forkserver_preload([__name__])
    theirs, ours = context.Pipe(duplex=False)
    process = context.Process(target=_work, args=(cell, folder / cell.name, commit, theirs), name=cell.name)
    with ctrl_c_ignored():
        process.start()
    theirs.close()
    return Running(cell, process, ours)


def _stop(running: Sequence[Running]) -> None:
    end([one.process for one in running])
    for one in running:
        one.lifeline.close()


def _work(cell: Cell, folder: Path, commit: str, lifeline: Connection) -> None:
    """Runs one cell in a process of its own."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the study ends this process
    threading.Thread(target=_end_with, args=(lifeline,), daemon=True).start()
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / LOG_FILE).open("a", buffering=1) as log, (folder / LOCK_FILE).open("a") as lock:
        print_into(log)
        with contextlib.suppress(OSError):  # a file system without locks
            fcntl.flock(lock, fcntl.LOCK_EX)  # the last process of a killed study may still be here, for a moment
        if (folder / RESULT_FILE).exists():
            return
        _prepare()
        try:
            run_cell(cell, folder, commit)
        except UserError as error:
            print(f"error: {error}")
            sys.exit(2)
        except Exception:
            traceback.print_exc(file=log)
            sys.exit(1)


def _prepare() -> None:
    """Sets this process up for a cell."""
    keep_freed_memory()
    tqdm.set_lock(threading.RLock())  # a progress bar's own lock is a semaphore, which a stopped process would leak


def _end_with(lifeline: Connection) -> None:
    """Ends this process when the other end of the pipe closes."""
    with contextlib.suppress(EOFError, OSError):
        lifeline.recv()
    os._exit(1)
