"""Plays episodes on this machine, or on all machines of a Ray cluster; the results are the same.

A task of the cluster is one episode. It is played as here, in a process of its own beside Ray's, so that an environment
that raises, hangs or dies is named by its seed and step there, too.
"""

import contextlib
import pickle
import zlib
from collections.abc import Callable, Iterator, Sequence
from types import TracebackType
from typing import Any, NamedTuple

from envs.rollouts.workers import EpisodePool, Failed, OnError, Result, SeededTask
from envs.supervision import TIMEOUT_S, failure
from predictor.support.cluster import Cluster, Lost, Packed, connected
from predictor.support.errors import UserError

PACKAGES = ("highway-env", "mpe2", "pettingzoo", "envpool", "gymnasium", "torch", "numpy")
"""Packages that episodes depend on."""


def episode_pool(
    play: Callable[[Any], Result],
    workers: int,
    timeout_s: float = TIMEOUT_S,
    on_error: OnError = "stop",
    cluster: str | None = None,
) -> EpisodePool[Result]:
    """Returns processes that play episodes; a context manager.

    Args:
        play: function of a module that plays the episode of a task.
        workers: number of processes of this machine.
        timeout_s: largest time between two steps of an episode [s].
        on_error: whether an episode that fails stops the others.
        cluster: address of a Ray cluster that plays in place of this machine.
    """
    if cluster is None:
        return EpisodePool(play, workers, timeout_s, on_error)
    return ClusterPool(play, cluster, timeout_s, on_error)


class ClusterPool(EpisodePool[Result]):
    """Machines of a cluster that play episodes; a context manager, which leaves the cluster.

    Args:
        play: function of a module that plays the episode of a task.
        address: address of the cluster.
        timeout_s: largest time between two steps of an episode [s].
        on_error: whether an episode that fails stops the others.
    """

    def __init__(
        self, play: Callable[[Any], Result], address: str, timeout_s: float = TIMEOUT_S, on_error: OnError = "stop"
    ) -> None:
        """Connects to nothing yet."""
        super().__init__(play, 1, timeout_s, on_error)
        self._address, self._left = address, contextlib.ExitStack()
        self._cluster: Cluster | None = None

    def __enter__(self) -> "ClusterPool[Result]":
        """Connects to the cluster.

        Raises:
            UserError: Ray is not installed, or no cluster answers.
        """
        self._cluster = self._left.enter_context(connected(self._address, PACKAGES))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Leaves the cluster."""
        self._cluster = None
        self._left.close()

    @property
    def size(self) -> int:
        """Number of episodes that are played at one time."""
        assert self._cluster is not None
        return self._cluster.size

    def play(self, tasks: Sequence[SeededTask]) -> Iterator[Result | Failed]:
        """Yields the result of each task, in their order; `Failed` in its place with `on_error="skip"`.

        Raises:
            EnvironmentFailedError: an episode failed, after the results of all tasks before it.
            UserError: a machine has other versions, or no machine could play an episode.
        """
        assert self._cluster is not None
        found, wanted = dict[int, Result | Failed](), 0
        packed = [_Remote(task.env_id, task.seed, self._timeout_s, Packed((self._play, task))) for task in tasks]
        with contextlib.closing(self._cluster.results(_play_there, packed)) as results:
            for number, result in results:
                found[number] = _opened(tasks[number], result)
                while wanted in found:
                    result = found.pop(wanted)
                    if isinstance(result, Failed) and self._stops(result):
                        raise result.kind(result.reason)
                    yield result
                    wanted += 1


class _Remote(NamedTuple):
    """Task of a cluster: only the process that plays unpacks what is played, and imports what that needs."""

    env_id: str
    seed: int
    timeout_s: float
    packed: Packed


_kept: dict[tuple[str, float], EpisodePool[bytes]] = {}
"""The process that plays beside this process of Ray; it stays from task to task, with what it has imported.

It plays one environment, as those here do: highway-env's intersection changes the drivers of its whole process.
"""


def _play_there(remote: _Remote) -> bytes | Failed:
    """Plays one episode in a process beside this one; in a task."""
    kind = (remote.env_id, remote.timeout_s)
    if kind not in _kept:
        for other in list(_kept):
            _kept.pop(other).__exit__(None, None, None)
        _kept[kind] = EpisodePool(_unpacked, 1, remote.timeout_s, on_error="skip")
    (result,) = _kept[kind].play([remote])
    return result


def _unpacked(remote: _Remote) -> bytes:
    """Plays one episode; the result is packed: Ray's process knows no episodes, and their labels are mostly zeros."""
    play, task = remote.packed.unpack()
    return zlib.compress(pickle.dumps(play(task), protocol=pickle.HIGHEST_PROTOCOL), level=1)


def _opened(task: SeededTask, result: bytes | Failed | Lost) -> Any:
    if isinstance(result, Lost):
        return Failed(task.seed, failure(task.env_id, f"seed {task.seed}", result.reason), UserError)
    return result if isinstance(result, Failed) else pickle.loads(zlib.decompress(result))
