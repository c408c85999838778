"""The soak: a short one is flat, and each kind of leak is found when it is planted."""

import gc
import mmap
import os
import sys
import threading
from collections.abc import Callable, Iterator
from types import ModuleType
from typing import Any

import pytest
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from envs.readers.function import FunctionReader
from envs.wrappers import SceneObservation
from predictor.scene import SceneSpec
from predictor.support.errors import UserError
from tests.storm import soak as module
from tests.storm.soak import LIMITS, NAMES, Limit, Sample, SoakConfig, count_entries, judge, soak, take_sample
from tests.storm.soak_subjects import SUBJECTS, Churning, read

ROWS, STEPS, SAMPLES = 12, 1200, 8
SHORT = LIMITS | {"memory_mb": Limit(12.0, 0.0), "entries": Limit(400.0, 0.0)}
"""A short run grows while torch and the allocator still find their sizes."""


def run(venv: VecEnv, each: Callable[[int], None] | None = None) -> dict[str, bool]:
    try:
        found = judge(soak(venv, STEPS, SAMPLES, each=each), SHORT)
    finally:
        venv.close()
    return {what: one.is_flat for what, one in found.items()}


def without_forecasts() -> VecEnv:
    reader = FunctionReader(read, SceneSpec(dt_s=1.0))
    return DummyVecEnv([lambda: SceneObservation(Churning(3, 0.2), reader=reader)] * ROWS)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_a_short_soak_is_flat(name: str):
    if name == "envpool":
        pytest.importorskip("envpool")
    assert run(SUBJECTS[name](ROWS)) == dict.fromkeys(LIMITS, True)


@pytest.fixture
def planted() -> Iterator[Callable[[int], None]]:
    """A leak of each kind, by the vector step."""
    kept: list[Any] = []
    stop = threading.Event()

    def leak(step: int) -> None:
        kept.append(mmap.mmap(-1, 2**20))  # from the system: freed memory of other tests would hide an array
        kept[-1].write(bytes([1]) * 2**20)
        kept.extend((step, i) for i in range(20))
        if step % 10 == 0:
            kept.append(open(os.devnull))
            kept.append(threading.Thread(target=stop.wait))
            kept[-1].start()

    yield leak
    stop.set()
    for one in kept:
        if isinstance(one, threading.Thread):
            one.join()
        elif hasattr(one, "close"):
            one.close()


@pytest.mark.slow
def test_planted_leaks_are_found(planted: Callable[[int], None]):
    assert run(without_forecasts(), planted) == dict.fromkeys(LIMITS, False)


@pytest.mark.slow
def test_a_dictionary_that_the_collector_does_not_track_is_counted():
    held = {"all": {i: float(i) for i in range(5000)}}
    before = count_entries()
    held["all"].clear()
    assert 4500 < before - count_entries() <= 5500


def samples(entries: list[int], every: int = 1000) -> list[Sample]:
    return [Sample(every * (i + 1), 100.0, 5, 2, count) for i, count in enumerate(entries)]


def test_growth_is_judged_from_the_second_quarter_to_the_last():
    limits = {"entries": Limit(10.0, 1000.0)}
    grown = samples([0, 0, 100, 100, 100, 100, 170, 170])
    finding = judge(grown, limits)["entries"]
    assert (finding.before, finding.after) == (100, 170)
    assert finding.allowed == pytest.approx(10 + 1000 * 4000 / 100_000)
    assert not finding.is_flat
    assert judge(samples([0, 0, 100, 100, 900, 100, 150, 150]), limits)["entries"].is_flat  # 50 are allowed


@pytest.mark.slow
def test_a_sample_is_of_this_process():
    before = take_sample(7)
    with open(os.devnull):
        after = take_sample(7)
    assert after.files == before.files + 1 and before.threads >= 1 and before.memory_mb > 50 and before.steps == 7


def test_the_command_ends_with_status_1_if_something_grows(monkeypatch: pytest.MonkeyPatch, capsys: Any):
    class Here:
        def __init__(self, *arguments: Any, **named: Any) -> None: ...
        def __enter__(self) -> "Here":
            return self

        def __exit__(self, *error: Any) -> None: ...
        def submit(self, run: Any, name: str, config: Any) -> Any:
            found = [0] * 4 + [10**6] * 4 if name == "egos" else [5] * 8
            return type("Result", (), {"result": lambda self: samples(found)})()

    monkeypatch.setattr(module, "ProcessPoolExecutor", Here)
    for only, status in (("egos", 1), ("multiagent", None)):
        monkeypatch.setattr(sys, "argv", ["soak", "--only", only])
        if status is None:
            module.main()
        else:
            with pytest.raises(SystemExit) as ended:
                module.main()
            assert ended.value.code == status
        assert ("NOT FLAT" in capsys.readouterr().out) == (status == 1)


def test_a_run_too_short_to_judge_is_refused():
    with pytest.raises(UserError, match=r"steps must be at least 15360 \(2 · rows · samples\), got 1000"):
        SoakConfig(steps=1000)


@pytest.mark.slow
def test_modules_are_not_asked_what_they_hold(monkeypatch: pytest.MonkeyPatch):
    """The collector of some releases of Python hangs once `_asyncio` has been asked."""
    asked = set[type]()
    ask = gc.get_referents
    monkeypatch.setattr(gc, "get_referents", lambda *things: asked.update(map(type, things)) or ask(*things))
    assert count_entries() > 0
    assert asked and not any(issubclass(kind, ModuleType) for kind in asked)
