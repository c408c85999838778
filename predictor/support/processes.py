"""Processes that work for another one: they leave Ctrl-C to it and end when it ends, however that ends."""

import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from multiprocessing.process import BaseProcess
from multiprocessing.resource_tracker import ensure_running
from typing import IO, Any

PATIENCE_S = 5.0
"""Time that a process gets to end when it is asked to, before it is killed [s]."""
_WATCH_S = 1.0


def follow_parent() -> None:
    """Makes this process ignore Ctrl-C, which reaches the whole group, and end when the one that started it ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if multiprocessing.parent_process() is not None:
        threading.Thread(target=_end_with_parent, daemon=True).start()


def stop_with_parent() -> None:
    """Asks this process to stop (SIGTERM) when the one that started it, which may know nothing of it, is gone."""
    threading.Thread(target=_ask_without, args=(os.getppid(),), daemon=True).start()


def start(process: BaseProcess) -> None:
    """Starts a process that ignores Ctrl-C from its first instruction on; it calls `follow_parent` itself.

    A Ctrl-C that comes meanwhile is raised here, and the process is ended.
    """
    ensure_running()  # it lets Ctrl-C through when it starts, so not inside
    try:
        with ctrl_c_ignored():
            process.start()
    except BaseException:
        if process.pid is not None:
            end([process])
        raise


@contextmanager
def ctrl_c_ignored() -> Iterator[None]:
    """Lets processes that are started inside the block ignore Ctrl-C; one that comes meanwhile waits for its end."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    blocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
        signal.pthread_sigmask(signal.SIG_SETMASK, blocked)


def end(processes: Sequence[BaseProcess], patience_s: float = PATIENCE_S) -> None:
    """Asks processes to end, and kills those that do not."""
    for process in processes:
        process.terminate()
    until = time.monotonic() + patience_s
    try:
        for process in processes:
            process.join(max(0.0, until - time.monotonic()))
    finally:  # a second Ctrl-C waits no longer
        for process in processes:
            process.kill()
            process.join()


def print_into(log: IO[Any]) -> None:
    """Makes this process print into a file, what C code prints included."""
    sys.stdout.flush(), sys.stderr.flush()
    for number in (1, 2):
        os.dup2(log.fileno(), number)


def how_it_ended(exit_code: int | None) -> str:
    """Returns in words how a process ended."""
    if exit_code is not None and exit_code < 0:
        name = signal.Signals(-exit_code).name if -exit_code in set(signal.Signals) else f"signal {-exit_code}"
        return f"its process was killed by {name}" + (
            " (by the system, if memory ran out)" if name == "SIGKILL" else ""
        )
    return f"its process ended with status {exit_code}"


def _ask_without(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(_WATCH_S)
    os.kill(os.getpid(), signal.SIGTERM)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)
