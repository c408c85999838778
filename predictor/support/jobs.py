"""Runs jobs side by side, each in a process of its own that prints into a log, here or on the machines of a cluster."""

import contextlib
import fcntl
import multiprocessing
import time
from collections.abc import Callable, Generator, Sequence
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, NamedTuple, Protocol, runtime_checkable

from predictor.support.cluster import Cluster, Lost, Packed, check_shared
from predictor.support.errors import run_entry_point
from predictor.support.locks import LOCK_FILE
from predictor.support.processes import end, follow_parent, how_it_ended, print_into, start
from predictor.support.progress import WorkShown

SAVING_S = 60.0
"""Time that a job's process gets to save its training when the command is stopped [s]."""
LOG_FILE = "log.txt"
_POLL_S = 0.5


@runtime_checkable
class Task(Protocol):
    """What is to be done; can be pickled."""

    @property
    def name(self) -> str:
        """Name in messages."""

    @property
    def folder(self) -> Path:
        """Folder of its log."""

    @property
    def result(self) -> Path:
        """File that is there once the job is done."""

    @property
    def locked_folder(self) -> Path:
        """Folder that the command has locked, and that holds `folder`."""

    def run(self) -> None:
        """Does it, in a process of its own."""


@runtime_checkable
class Job(Task, Protocol):
    """Task that may have to wait for others."""

    def waits_for(self, other: Any) -> bool:
        """Returns whether the other job has to end before this one."""


def run_jobs(title: str, pending: Sequence[Job], workers: int) -> dict[str, str]:
    """Runs jobs in processes of this machine; returns why those that failed did (`why_failed`), by name.

    Args:
        title: words before the progress.
        pending: jobs.
        workers: largest number of processes.
    """
    waiting, failed, done = list(pending), dict[str, str](), 0
    running: list[tuple[Job, BaseProcess]] = []
    with WorkShown(title, len(pending)) as shown:
        try:
            while waiting or running:
                busy = [*waiting, *(job for job, _ in running)]
                ready = [job for job in waiting if not any(job.waits_for(other) for other in busy)]
                for job in ready[: workers - len(running)]:
                    waiting.remove(job)
                    running.append((job, _start(job)))
                time.sleep(_POLL_S)
                ended = [one for one in running if one[1].exitcode is not None]
                for job, process in ended:
                    if process.exitcode:
                        failed[job.name] = why_failed(job.folder / LOG_FILE, process.exitcode)
                running = [one for one in running if one not in ended]
                done += len(ended)
                if ended or ready:
                    shown.to(done, ", ".join(job.name for job, _ in running))
        finally:
            end([process for _, process in running], SAVING_S)
    return failed


def run_jobs_on(cluster: Cluster, title: str, pending: Sequence[Job], gpus: int = 0) -> dict[str, str]:
    """Runs jobs on the machines of a cluster, which share their folders; returns what `run_jobs` does.

    Args:
        cluster: cluster.
        title: words before the progress.
        pending: jobs; those that wait for others begin when all others have ended.
        gpus: number of GPUs of each job.

    Raises:
        UserError: a machine does not see the folder, or has other versions.
    """
    late = [job for job in pending if any(job.waits_for(other) for other in pending)]
    failed = dict[str, str]()
    with WorkShown(title, len(pending)) as shown:
        for jobs in ([job for job in pending if job not in late], late):
            with contextlib.closing(ended_on(cluster, jobs, gpus)) as ended:
                for number, reason in ended:
                    if reason is not None:
                        failed[jobs[number].name] = reason
                    shown.advance()
    return failed


def ended_on(cluster: Cluster, tasks: Sequence[Task], gpus: int = 0) -> Generator[tuple[int, str | None]]:
    """Runs tasks on the machines of a cluster; yields the number of each that ended, and why it failed, or None.

    Args:
        cluster: cluster; its machines share the folders of the tasks.
        tasks: tasks.
        gpus: number of GPUs of each task.

    Raises:
        UserError: a machine does not see the folder, or has other versions.
    """
    remote = [_Remote(task.folder.absolute(), task.locked_folder.absolute(), Packed(task)) for task in tasks]
    with contextlib.closing(cluster.results(_run_alone, remote, gpus, SAVING_S)) as results:
        for number, found in results:
            yield number, found.reason if isinstance(found, Lost) else found


def why_failed(log: Path, exit_code: int | None) -> str:
    """Returns why a process failed: how it was killed, or else the last line of its log."""
    killed = exit_code is not None and exit_code < 0
    return how_it_ended(exit_code) if killed else last_line(log)


def last_line(log: Path) -> str:
    """Returns the last line of a log; a few words if there is none."""
    lines = log.read_text(errors="replace").strip().splitlines() if log.exists() else []
    return lines[-1] if lines else "it ended without a message"


class _Remote(NamedTuple):
    """Task of a cluster; only the process that does the work unpacks it, and imports what it needs."""

    folder: Path
    locked_folder: Path
    packed: Packed


def _run_alone(remote: _Remote) -> str | None:
    """Does one task in a process beside this process of Ray; returns why it failed, or None."""
    check_shared(remote.locked_folder)
    process = _started(_work_unpacked, remote, remote.folder)
    try:
        while process.exitcode is None:  # a task that is cancelled is not woken out of `join`
            time.sleep(_POLL_S)
    finally:
        end([process], SAVING_S)
    return why_failed(remote.folder / LOG_FILE, process.exitcode) if process.exitcode else None


def _work_unpacked(remote: _Remote) -> None:
    """Does a task that was packed; its log may go on from a machine that died."""
    follow_parent()
    _work(lambda: remote.packed.unpack(), remote.folder, "a")


def _start(job: Job) -> BaseProcess:
    return _started(_work_job, job, job.folder)


def _started(function: Callable[[Any], None], argument: Any, folder: Path) -> BaseProcess:
    folder.mkdir(parents=True, exist_ok=True)
    process = multiprocessing.get_context("spawn").Process(target=function, args=(argument,))
    start(process)
    return process


def _work_job(job: Job) -> None:
    """Does a job of this machine."""
    follow_parent()
    _work(lambda: job, job.folder, "w")


def _work(opened: Callable[[], Task], folder: Path, mode: str) -> None:
    """Does a task in a process of its own, which ends with the one that started it; SIGTERM saves what it trains."""
    with (folder / LOG_FILE).open(mode, buffering=1) as log, (folder / LOCK_FILE).open("a") as lock:
        print_into(log)
        with contextlib.suppress(OSError):  # a file system without locks
            fcntl.flock(lock, fcntl.LOCK_EX)  # the process of a machine that was given up may still be here
        task = opened()
        if not task.result.exists():
            run_entry_point(task.run)
