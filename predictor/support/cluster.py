"""Tasks on a Ray cluster: functions of a module with their arguments, run on all machines of the cluster.

In the process of a task the command line and the working folder are those of the command, as is its main module where
a task needs it, as in a process that multiprocessing spawns; Ray finds modules where the command does. A task whose
machine dies is run again on another one; a task that raises is not. Ray is imported by `connected` alone.
"""

import contextlib
import functools
import importlib
import multiprocessing.spawn
import os
import pickle
import re
import signal
import socket
import sys
import threading
import types
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from predictor.support.errors import UserError, one_line, short
from predictor.support.locks import LOCK_FILE
from predictor.support.provenance import provenance
from predictor.support.stopping import deferred_stops

INSTALL = "--cluster needs Ray, which is not installed; pip install 'dgvae-rl[ray]', on every machine"
RETRIES = 10
"""Number of times that a task is run again because its machine, or Ray's process on it, died."""
AHEAD = 2
"""Number of tasks that are handed out per CPU of the cluster; one of them waits."""
ANSWER_S = 10.0
"""Time that a machine gets to answer at an address [s]; Ray itself would try for two minutes."""
_POLL_S = 0.5
_PREFACE = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + bytes([0, 0, 0, 4, 0, 0, 0, 0, 0])
"""First bytes of an HTTP/2 client with empty settings (RFC 9113, 3.4): Ray's services speak gRPC, which is HTTP/2."""
_SETTINGS = 4
"""Type of the frame that a server answers with."""
_MAIN = ("init_main_from_name", "init_main_from_path")
"""What multiprocessing says of the main module: its name, or its file."""


@dataclass(frozen=True)
class Lost:
    """Task without a result: Ray could not run it to its end, on any machine."""

    reason: str
    """What Ray says of it."""


@dataclass(frozen=True)
class _Command:
    """What a process needs to run a task as if the command had spawned it."""

    folder: str
    """Working folder."""
    arguments: list[str]
    """Command line."""
    packages: tuple[str, ...]
    """Packages whose versions have to be the same everywhere."""
    made_by: dict[str, Any]
    """Versions and commit on the machine of the command."""


def check_address(address: str | None) -> None:
    """Checks the form of an address; None is none.

    Raises:
        UserError: it is neither "auto" nor HOST:PORT.
    """
    if address is None or address == "auto":
        return
    match = re.fullmatch(r"[^\s/:]+:(\d{1,5})", address)
    if match is None or not 0 < int(match[1]) < 2**16:
        raise UserError(f"cluster must be auto or HOST:PORT (as in 10.0.0.1:6379), got '{short(address)}'")


@contextlib.contextmanager
def connected(address: str | None, packages: Sequence[str]) -> Iterator["Cluster | None"]:
    """Yields a cluster, and leaves it; None for no address. A connection that is there already is used, and stays.

    Args:
        address: "auto" (the cluster that runs on this machine, or RAY_ADDRESS), or HOST:PORT of its head.
        packages: packages whose versions have to be the same on all machines, beside this one.

    Raises:
        UserError: Ray is not installed, or no cluster answers at the address.
    """
    if address is None:
        yield None
        return
    check_address(address)
    try:
        ray: Any = importlib.import_module("ray")
    except ImportError as error:
        raise UserError(INSTALL) from error
    if ray.is_initialized():
        yield Cluster(ray, packages)
        return
    _connect(ray, address)
    try:
        yield Cluster(ray, packages)
    finally:
        ray.shutdown()


class Cluster:
    """Cluster that this process is connected to.

    Args:
        ray: the module.
        packages: packages whose versions have to be the same on all machines.
    """

    def __init__(self, ray: Any, packages: Sequence[str]) -> None:
        """Takes a snapshot of this process for its tasks."""
        self._ray = ray
        made = provenance(packages)
        made_by = {name: made[name] for name in ("versions", "commit")}
        self._command = _Command(os.getcwd(), list(sys.argv), tuple(packages), made_by)

    @property
    def size(self) -> int:
        """Number of tasks that run at one time: one per CPU that the cluster has now."""
        return max(1, int(self._ray.cluster_resources().get("CPU", 0)))

    def results(
        self, function: Callable[[Any], Any], tasks: Sequence[Any], gpus: int = 0, saving_s: float = 0.0
    ) -> Generator[tuple[int, Any]]:
        """Runs a function on each task; yields their numbers and results as they end. Closing it cancels what runs.

        Args:
            function: function of a module other than the main one.
            tasks: arguments; each can be pickled, as can what the function returns. What belongs to the main module is
                wrapped in `Packed`.
            gpus: number of GPUs of a task, beside one CPU.
            saving_s: time that a task gets to leave when it is cancelled [s]; it is raised a KeyboardInterrupt.

        Raises:
            UserError: a task raised it, the cluster has no such GPUs, or a machine has other versions.
        """
        if gpus > self._ray.cluster_resources().get("GPU", 0):
            raise UserError(f"each task needs {gpus} GPU, and the cluster has none; add a machine or --device cpu")
        remote = self._ray.remote(_run).options(num_cpus=1, num_gpus=gpus, max_retries=RETRIES)
        waiting, running = deque(enumerate(tasks)), dict[Any, int]()
        try:
            while waiting or running:
                room = AHEAD * self.size - len(running) if waiting else 0
                for _ in range(min(room, len(waiting))):
                    number, task = waiting.popleft()
                    running[remote.remote(self._command, pickle.dumps((function, task)))] = number
                with deferred_stops() as stops:  # Ray would make another error of a signal that comes while it waits
                    ended, _ = self._ray.wait(list(running), timeout=_POLL_S)
                    stops.stop()
                for one in ended:
                    found = self._result_of(one)
                    yield running.pop(one), found
        finally:
            self._cancel(list(running), saving_s)

    def _result_of(self, one: Any) -> Any:
        """Returns the result of a task that ended.

        Raises:
            UserError: the task raised it.
        """
        errors = self._ray.exceptions
        try:
            has_ended_well, result = pickle.loads(self._ray.get(one))
        except errors.RayTaskError:
            raise  # an error of this project's own code, with its traceback
        except errors.RayError as error:
            return Lost(f"Ray lost its task: {type(error).__name__}: {short(one_line(error), 500)}")
        if not has_ended_well:
            raise result
        return result

    def _cancel(self, running: Sequence[Any], saving_s: float) -> None:
        """Ends tasks that run or wait."""
        left = list(running)
        for force in (False, True) if saving_s else (True,):
            for one in left:
                self._ray.cancel(one, force=force)
            if left:
                _, left = self._ray.wait(left, num_returns=len(left), timeout=_POLL_S if force else saving_s)


class Packed:
    """Object that is unpacked only where it is needed, with the main module of the command, which may define it.

    Args:
        content: object that can be pickled.
    """

    def __init__(self, content: Any) -> None:
        """Packs the object."""
        data: dict[str, Any] = multiprocessing.spawn.get_preparation_data("task")
        self._main: dict[str, Any] = {name: data[name] for name in _MAIN if name in data}
        self._content = pickle.dumps(content, protocol=pickle.HIGHEST_PROTOCOL)

    def unpack(self) -> Any:
        """Returns the object, in a process of a task or of one that it started."""
        main = dict(self._main)
        if not os.path.exists(main.get("init_main_from_path", "")):
            main.pop("init_main_from_path", None)  # the script that starts an installed command
        multiprocessing.spawn.prepare(main)
        return pickle.loads(self._content)


def check_shared(folder: Path) -> None:
    """Checks, in a task, that its machine sees the folder that the command has locked.

    Raises:
        UserError: it does not.
    """
    if not (folder / LOCK_FILE).exists():
        raise UserError(
            f"the machine {socket.gethostname()} does not see what is written to {folder.absolute()}; with --cluster "
            "the folder has to be on a file system that all machines share, under one path"
        )


def _connect(ray: Any, address: str) -> None:
    """Connects this process.

    Raises:
        UserError: no cluster answers.
    """
    what = "no Ray cluster runs on this machine" if address == "auto" else f"no Ray cluster answers at {address}"
    advice = "start one with ray start --head, or pass --cluster HOST:PORT of its head (docs/scale.md)"
    try:
        found = importlib.import_module("ray._private.services").canonicalize_bootstrap_address(address)
        _check_answers(found)
        with _signals_kept():
            ray.init(address=found, log_to_driver=False, logging_level="ERROR")
    except (OSError, RuntimeError, ValueError, SystemExit) as error:  # Ray leaves the process where it gives up
        raise UserError(f"{what} ({short(one_line(error)) or type(error).__name__}); {advice}") from error


def _check_answers(address: str) -> None:
    """Checks that something at an address speaks HTTP/2 (with RAY_USE_TLS: that it listens).

    Raises:
        OSError: it does not, within `ANSWER_S`.
    """
    host, _, port = address.rpartition(":")
    with socket.create_connection((host.strip("[]"), int(port)), ANSWER_S) as link:
        if os.environ.get("RAY_USE_TLS", "0") not in ("", "0"):
            return
        link.sendall(_PREFACE)
        answer = link.recv(9)
    if len(answer) < 4 or answer[3] != _SETTINGS:
        raise OSError("something else listens there")


@contextlib.contextmanager
def _signals_kept() -> Iterator[None]:
    """Puts back what this process does at SIGTERM and Ctrl-C, which Ray changes where it connects."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _run(command: _Command, packed: bytes) -> bytes:
    """Runs a task in a process of Ray; results are packed here, since Ray would hand out arrays that are read-only."""
    try:
        _become(pickle.dumps(command))
        function, task = pickle.loads(packed)
        result = True, function(task)
    except UserError as error:
        result = False, error
    return pickle.dumps(result, protocol=pickle.HIGHEST_PROTOCOL)


@functools.cache
def _become(packed: bytes) -> None:
    """Makes this process look as if the command had spawned it; once, since Ray keeps its processes.

    Raises:
        UserError: this machine has other versions than that of the command.
    """
    command: _Command = pickle.loads(packed)
    _check_versions(command)
    sys.argv = list(command.arguments)
    with contextlib.suppress(OSError):  # another machine may lack the folder: its tasks may need no file
        os.chdir(command.folder)
    sys.modules["__main__"] = types.ModuleType("__main__")  # processes that start here would import all of Ray with it


def _check_versions(command: _Command) -> None:
    here, there = provenance(command.packages), command.made_by
    differing = [
        f"{name} {version} and not {there['versions'][name]}"
        for name, version in here["versions"].items()
        if version != there["versions"][name]
    ]
    if here["commit"] != there["commit"] and "unknown" not in (here["commit"], there["commit"]):
        differing.append(f"commit {here['commit']} and not {there['commit']}")
    if differing:
        raise UserError(
            f"the machine {socket.gethostname()} has {', '.join(differing)} as the one of the command; results are the "
            "same only with the same versions: install them on all machines"
        )
