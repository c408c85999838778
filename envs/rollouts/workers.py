"""Plays episodes in worker processes that may raise, hang or die; their results come in the order of the tasks.

`multiprocessing.Pool` waits forever for the result of a worker that died. Here each worker says where its episode is;
one that dies, or makes no step for some time, is named and ended, and a new one takes its place.
"""

import contextlib
import importlib
import multiprocessing
import pickle
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import Connection, wait
from types import TracebackType
from typing import Any, Generic, Literal, Protocol, TypeVar, runtime_checkable

from envs.supervision import NUMBERS, TIMEOUT_S, EnvironmentFailedError, Place, failure, share
from predictor.support.errors import UserError, reason_of
from predictor.support.processes import end, follow_parent, how_it_ended, start

OnError = Literal["stop", "skip"]
"""What an episode that fails does: it stops the command, or is left out."""
MOST_AHEAD = 32
"""Number of episodes for each worker that may be played beyond one that is not finished: they wait in memory."""
_POLL_S = 1.0
_MOMENT_S = 2.0
"""Longest time between two looks at a worker that counts; more, and this process itself was paused."""
_DYING_S = 5.0
_START_S = 600.0
"""Time that a process gets to import what it needs on a busy machine [s]."""

Result = TypeVar("Result")


@runtime_checkable
class SeededTask(Protocol):
    """Settings of an episode."""

    @property
    def env_id(self) -> str:
        """Id of the environment."""

    @property
    def seed(self) -> int:
        """Seed of the episode."""


@dataclass(frozen=True)
class Failed:
    """Episode that has no result."""

    seed: int
    """Seed of the episode."""
    reason: str
    """What happened, with environment, seed and step."""
    kind: type[Exception] = EnvironmentFailedError
    """Type of the error to raise; only failures of environments can be skipped."""


@dataclass
class _Worker:
    """Process that plays one episode at a time."""

    process: Any
    pipe: Connection
    place: Place
    number: int | None = None
    ready: bool = False
    moves: int = -1
    waited_s: float = 0.0
    asked_s: float = field(default_factory=time.monotonic)

    def wait_anew(self) -> None:
        """Counts the time without a step from now on."""
        self.waited_s, self.asked_s = 0.0, time.monotonic()

    def is_late(self, timeout_s: float) -> bool:
        """Returns whether no step was made for too long; a pause of the whole command counts for a moment."""
        if self.moves != self.place.moves:
            self.moves = self.place.moves
            self.wait_anew()
        now = time.monotonic()
        self.waited_s += min(now - self.asked_s, _MOMENT_S)
        self.asked_s = now
        return self.waited_s > (timeout_s if self.ready else max(timeout_s, _START_S))


class EpisodePool(Generic[Result]):
    """Processes that play episodes; a context manager, which ends them.

    Args:
        play: function of a module that plays the episode of a task.
        workers: number of processes.
        timeout_s: largest time between two steps of an episode [s].
        on_error: whether an episode that fails stops the others.
    """

    def __init__(
        self,
        play: Callable[[Any], Result],
        workers: int,
        timeout_s: float = TIMEOUT_S,
        on_error: OnError = "stop",
    ) -> None:
        """Starts nothing yet."""
        self._play, self._size, self._timeout_s, self._on_error = play, workers, timeout_s, on_error
        self._workers: list[_Worker] = []

    def __enter__(self) -> "EpisodePool[Result]":
        """Returns itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Ends all processes."""
        end([worker.process for worker in self._workers])
        for worker in self._workers:
            worker.pipe.close()
        self._workers = []

    @property
    def size(self) -> int:
        """Number of episodes that are played at one time."""
        return self._size

    def play(self, tasks: Sequence[SeededTask]) -> Iterator[Result | Failed]:
        """Yields the result of each task, in their order; `Failed` in its place with `on_error="skip"`.

        Raises:
            EnvironmentFailedError: an episode failed, after the results of all tasks before it.
        """
        waiting, found, failed = deque(range(len(tasks))), dict[int, Result | Failed](), False
        for wanted in range(len(tasks)):
            while wanted not in found:
                if not failed:
                    self._hand_out(waiting, tasks, wanted + MOST_AHEAD * self._size)
                for number, result in self._received(tasks):
                    found[number] = result
                    failed = failed or self._stops(result)
            result = found.pop(wanted)
            if isinstance(result, Failed) and self._stops(result):
                raise result.kind(result.reason)
            yield result

    def results(self, tasks: Sequence[SeededTask]) -> Iterator[Result]:
        """Yields the result of each task, in their order.

        Raises:
            EnvironmentFailedError: an episode failed.
        """
        for result in self.play(tasks):
            if isinstance(result, Failed):
                raise result.kind(result.reason)
            yield result

    def _stops(self, result: Result | Failed) -> bool:
        """Returns whether a result ends all episodes."""
        skips = self._on_error == "skip"
        return isinstance(result, Failed) and not (skips and result.kind is EnvironmentFailedError)

    def _hand_out(self, waiting: deque[int], tasks: Sequence[SeededTask], end: int) -> None:
        """Gives each free worker a task whose number is below `end`; starts workers that are missing."""
        while len(self._workers) < min(self._size, len(waiting) + self._num_busy()):
            self._workers.append(_started(self._play))
        for worker in self._workers:
            if worker.number is None and waiting and waiting[0] < end:
                worker.number = waiting.popleft()
                worker.place.clear()
                worker.wait_anew()
                try:
                    worker.pipe.send(tasks[worker.number])
                except OSError:
                    continue  # it died; `_received` says how

    def _num_busy(self) -> int:
        return sum(worker.number is not None for worker in self._workers)

    def _received(self, tasks: Sequence[SeededTask]) -> Iterator[tuple[int, Result | Failed]]:
        """Waits for a moment; yields the results that came, and the tasks whose workers died or hang."""
        wait([worker.pipe for worker in self._workers], min(_POLL_S, self._timeout_s / 4))
        for worker in list(self._workers):
            try:
                content = pickle.loads(worker.pipe.recv_bytes()) if worker.pipe.poll() else None
            except (EOFError, OSError):
                worker.process.join(_DYING_S)
                end([worker.process])  # a thread of the environment may keep it alive
                reason = how_it_ended(worker.process.exitcode)
            else:
                if isinstance(content, _Ready):
                    worker.ready = True
                    worker.wait_anew()
                    continue
                if content is not None:
                    number, worker.number = worker.number, None
                    assert number is not None
                    if isinstance(content[0], Failed):
                        self._end(worker)  # its simulator may be broken: the next episode gets a new process
                    yield number, content[0]
                    continue
                if worker.number is None or not worker.is_late(self._timeout_s):
                    continue
                reason = f"no step for {self._timeout_s:g} s; it hangs, or --timeout-s is too short"
            self._end(worker)
            if worker.number is not None:
                task = tasks[worker.number]
                place = worker.place if worker.place.has_begun else f"seed {task.seed}, before its reset"
                yield worker.number, Failed(task.seed, failure(task.env_id, str(place), reason))
            elif not worker.ready:
                raise UserError(f"a worker did not start: {reason}")

    def _end(self, worker: _Worker) -> None:
        self._workers.remove(worker)
        end([worker.process])
        worker.pipe.close()


class _Ready:
    """What a worker sends when it has imported everything."""


def _started(play: Callable[[Any], Any]) -> _Worker:
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    numbers: Any = context.RawArray("q", NUMBERS)
    process = context.Process(target=_work, args=(play, theirs, numbers), daemon=True)
    worker = _Worker(process, ours, Place(numbers))
    start(process)
    theirs.close()
    return worker


def _work(play: Callable[[Any], Any], pipe: Connection, numbers: Any) -> None:
    """Plays tasks until the other end of the pipe closes, or an episode fails."""
    follow_parent()
    importlib.import_module("torch").set_num_threads(1)  # workers already fill the cores
    place = share(numbers)
    with contextlib.suppress(OSError):  # the other end may be closed by now
        _play_all(play, pipe, place)


def _play_all(play: Callable[[Any], Any], pipe: Connection, place: Place) -> None:
    """Plays tasks; results are pickled here, since torch's way through a pipe leaves tensors in this process."""
    pipe.send_bytes(pickle.dumps(_Ready()))
    while True:
        try:
            task = pipe.recv()
        except EOFError:
            return
        result: Any
        try:
            result = play(task)
        except EnvironmentFailedError as error:
            result = Failed(task.seed, str(error))
        except UserError as error:
            result = Failed(task.seed, str(error), UserError)
        except Exception as error:  # of this project's own code
            where = str(place) if place.has_begun else f"seed {task.seed}, {place}"
            reason = failure(task.env_id, where, reason_of(error))
            result = Failed(task.seed, f"{reason}\n{traceback.format_exc()}", RuntimeError)
        pipe.send_bytes(pickle.dumps((result,), protocol=pickle.HIGHEST_PROTOCOL))
