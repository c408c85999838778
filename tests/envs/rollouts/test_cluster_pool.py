"""The process beside one of Ray's, without Ray; `tests/test_cluster.py` plays on a cluster."""

import os
from typing import Any, NamedTuple

import pytest

from envs.rollouts import cluster_pool
from envs.rollouts.cluster_pool import _opened, _play_there, _Remote
from predictor.support.cluster import Packed


class Asked(NamedTuple):
    env_id: str
    seed: int = 0


def its_process(task: Asked) -> int:
    """Plays nothing; returns the number of the process that was to play."""
    return os.getpid()


@pytest.fixture
def played(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Plays a task as a process of Ray does; returns the number of the process that played."""
    kept: dict[Any, Any] = {}
    monkeypatch.setattr(cluster_pool, "_kept", kept)

    def play(task: Asked) -> Any:
        return _opened(task, _play_there(_Remote(task.env_id, task.seed, 60.0, Packed((its_process, task)))))

    yield play
    for pool in kept.values():
        pool.__exit__(None, None, None)


def test_a_process_plays_the_episodes_of_one_environment(played: Any):
    first = played(Asked("intersection-v2"))
    assert first != os.getpid() and played(Asked("intersection-v2", 1)) == first
    other = played(Asked("highway-fast-v0"))
    assert other not in (first, os.getpid())
    with pytest.raises(ProcessLookupError):
        os.kill(first, 0)
