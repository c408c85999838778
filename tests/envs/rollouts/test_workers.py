"""Episodes in processes that raise, hang or die."""

import multiprocessing
import os
import time
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from envs import collect
from envs.collect import CollectConfig
from envs.rollouts import workers
from envs.rollouts.workers import EpisodePool, Failed
from envs.supervision import NUMBERS, EnvironmentFailedError, Place
from predictor.support.errors import UserError
from tests.envs.misbehaving import AT_STEP, NUM_STEPS, env_id

REASONS = {
    "Raise": "step 2: RuntimeError: the simulator broke (",
    "RaiseReset": "its reset: RuntimeError: the simulator broke (",
    "Exit": "step 2: its process ended with status 3",
    "Kill": "step 2: its process was killed by SIGKILL",
    "Hang": "step 2: no step for 3 s; it hangs, or --timeout-s is too short",
    "HangReset": "its reset: no step for 3 s",
    "NanState": "step 2: ",
}
"""What is said of a seed that misbehaves, after its id and seed."""


def test_the_reasons_are_of_the_step_at_which_the_environments_misbehave():
    assert AT_STEP == 2


def record(task: collect._Task) -> int:
    """Plays an episode; returns its number of scenes."""
    (episode,) = collect._record(task)
    return len(episode.states)


def tasks(kinds: list[str], seeds: list[int]) -> list[collect._Task]:
    settings = collect.recording_of(CollectConfig("two-way-v0", Path("unused"), workers=1))
    return [collect._Task(env_id(kind), "random", seed, settings, "") for kind, seed in zip(kinds, seeds, strict=True)]


@pytest.mark.slow
def test_other_episodes_go_on_beside_those_that_fail():
    """Each failure stands in its own place, with environment, seed and step; no process is left."""
    kinds = [kind for kind in REASONS for _ in range(2)]
    asked = tasks(kinds, [seed for number in range(len(REASONS)) for seed in (3 * number, 3 * number + 1)])
    with EpisodePool(record, 2, timeout_s=3.0, on_error="skip") as pool:
        found = list(pool.play(asked))
    for kind, task, result in zip(kinds, asked, found, strict=True):
        if task.seed % 3:
            assert result == NUM_STEPS + 1
        else:
            assert isinstance(result, Failed)
            assert result.reason.startswith(f"{env_id(kind)}, seed {task.seed}, {REASONS[kind]}"), result.reason
            assert "\n" not in result.reason
    assert not multiprocessing.active_children()


def test_a_pause_of_the_whole_command_is_not_the_episode_s(monkeypatch: pytest.MonkeyPatch):
    clock, place = [0.0], Place([0] * NUMBERS)
    monkeypatch.setattr(workers, "time", SimpleNamespace(monotonic=lambda: clock[0]))
    ours, theirs = multiprocessing.Pipe()
    worker = workers._Worker(None, ours, place, ready=True, moves=place.moves, asked_s=0.0)

    def late_after(seconds: float) -> bool:
        clock[0] += seconds
        return worker.is_late(3.0)

    assert [late_after(s) for s in (1.0, 3600.0, 0.0, 0.5)] == [False, False, False, True]
    worker.wait_anew()
    assert [late_after(s) for s in (1.0, 1.0, 1.0, 1.0)] == [False, False, False, True]
    worker.moves -= 1  # the episode has moved since
    assert not late_after(1.0)
    ours.close()
    theirs.close()


@pytest.mark.slow
def test_an_episode_that_fails_stops_the_others():
    """What came before it has been handed over."""
    found = []
    with (
        pytest.raises(EnvironmentFailedError, match=r"seed 3, step 2: .*the simulator broke \(.*line \d+\)$"),
        EpisodePool(record, 1) as pool,
    ):
        found.extend(pool.play(tasks(["Raise"] * 5, [1, 2, 3, 4, 5])))
    assert not multiprocessing.active_children()


@dataclass(frozen=True)
class Plain:
    """A task of no environment."""

    seed: int
    env_id: str = "none"


def fail(task: Plain) -> int:
    """Raises what this project's own code could raise."""
    if task.seed == 0:
        raise UserError("edges are missing")
    if task.seed == 1:
        raise KeyError("a mistake")
    return os.getpid()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "kind", "message"),
    [
        (0, UserError, "^edges are missing$"),
        (1, RuntimeError, "none, seed 1, before its first reset: KeyError: 'a mistake'"),
    ],
)
def test_errors_that_are_not_the_environments_are_never_skipped(seed: int, kind: type[Exception], message: str):
    with pytest.raises(kind, match=message), EpisodePool(fail, 1, on_error="skip") as pool:
        list(pool.play([Plain(seed)]))


@pytest.mark.slow
def test_a_worker_plays_one_episode_after_the_other():
    with EpisodePool(fail, 2) as pool:
        first = list(pool.results([Plain(2), Plain(3), Plain(4)]))
        again = list(pool.results([Plain(5)]))
    assert set(again) <= set(first)
    assert os.getpid() not in first
    assert 1 <= len(set(first)) <= 2


def wait_if_first(task: Plain) -> int:
    """Returns the seed; the first one takes a while."""
    if task.seed == 0:
        time.sleep(2.0)
    return task.seed


@pytest.mark.slow
def test_episodes_behind_one_that_hangs_do_not_pile_up(monkeypatch: pytest.MonkeyPatch):
    """They wait in memory, and are lost when the command is stopped."""
    monkeypatch.setattr(workers, "MOST_AHEAD", 4)
    handed: list[int] = []
    with EpisodePool(wait_if_first, 2) as pool:
        hand_out = pool._hand_out

        def spied(*arguments: Any) -> None:
            hand_out(*arguments)
            handed.append(max([worker.number for worker in pool._workers if worker.number is not None], default=0))

        monkeypatch.setattr(pool, "_hand_out", spied)
        results = pool.results([Plain(seed) for seed in range(40)])
        assert next(results) == 0
        assert max(handed) < 8
        assert list(results) == list(range(1, 40))
