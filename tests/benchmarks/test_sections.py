"""Every section that needs no simulator, shrunk to almost nothing."""

import json
from pathlib import Path
from typing import Any

import pytest

from benchmarks import environments as wrappers
from benchmarks import forecast, machine, ppo, reading, streaming, suite, training
from benchmarks.settings import Settings
from benchmarks.timing import Meter

QUICK = Settings(quick=True, threads=1)


@pytest.fixture(autouse=True)
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Meter, "of", staticmethod(lambda settings: Meter(3, 0.0, 0.0)))


def test_the_machines_rate_is_of_all_products_together():
    lines = machine.run(QUICK)
    assert len(lines) == 6
    assert all(r.unit == "GFLOP/s" and (r.value or 0) > 0 and r.compared is None for r in lines)
    assert lines[-1].flop == sum(r.flop or 0 for r in lines[:4])


@pytest.mark.slow
def test_forecasts_have_rates_and_ratios_to_the_evolving_graph(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(forecast, "CASES", {"quick": (forecast.Case(2, 3, 4, 2),)})
    lines = {r.name: r for r in forecast.run(QUICK) if r.what.get("preset") == "fast"}
    assert len(lines) == 5
    assert all((r.flop or 0) > 0 or "half" in r.name for r in lines.values())
    assert all(r.compared is not None for r in lines.values())
    assert [name for name, r in lines.items() if r.ratio is not None] == ["roll-out, frozen graph"]
    frozen, evolving = lines["roll-out, frozen graph"], lines["roll-out"]
    assert (frozen.flop or 0) < (evolving.flop or 0)
    assert lines["observe + roll-out"].unit == "agent-forecasts/s"


@pytest.mark.slow
def test_modes_are_measured_beside_one_forecast_and_a_model_without(monkeypatch: pytest.MonkeyPatch):
    case = forecast.Case(2, 3, 4, 1)
    monkeypatch.setattr(forecast, "CASES", {"quick": (case, case._replace(samples=6))})
    shown: list[tuple[int, int]] = []
    rollout = forecast.DGVAE.rollout

    def watched(self: forecast.DGVAE, belief: Any, steps: int, samples: int = 1, *rest: Any) -> Any:
        shown.append((self.config.num_modes, samples))
        return rollout(self, belief, steps, samples, *rest)

    monkeypatch.setattr(forecast.DGVAE, "rollout", watched)
    one, six, plans = (r for r in forecast.run(QUICK) if "plural" in r.name)
    assert (one.ratio_to, six.ratio_to) == (forecast.WITHOUT_MODES, forecast.ONE) and one.what["samples"] == 1
    assert (one.ratio or 0) > 0 and (six.ratio or 0) > 0 and six.what == case._asdict() | {"samples": 6}
    assert plans.ratio_to == forecast.ONE and (plans.ratio or 0) > 0 and plans.what == case._asdict()
    assert {(0, 1), (20, 1), (20, 6)} <= set(shown)


@pytest.mark.slow
def test_the_cost_of_modes_and_plans_is_promised_for_a_single_scene(monkeypatch: pytest.MonkeyPatch):
    cases = forecast.Case(1, 3, 4, 1), forecast.Case(2, 3, 4, 1)
    monkeypatch.setattr(forecast, "CASES", {"quick": cases})
    lines = [r for r in forecast.run(QUICK) if "plural" in r.name]
    promised = {(r.name, r.compared.at_most) for r in lines if r.compared and r.compared.at_most is not None}
    assert promised == {(forecast.ONE, 1.2), (forecast.SIX, 2.0), (forecast.PLANS, 2.5)}
    assert all(r.what["batch"] == 1 and r.compared.value == r.ratio for r in lines if r.compared and r.compared.at_most)


def test_five_plans_are_rolled_out_at_once(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(forecast, "CASES", {"quick": (forecast.Case(2, 3, 4, 1),)})
    shapes: set[tuple[int, ...]] = set()
    rollout_plans = forecast.DGVAE.rollout_plans

    def watched(self: forecast.DGVAE, belief: Any, plans: Any, *rest: Any) -> Any:
        futures = rollout_plans(self, belief, plans, *rest)
        shapes.add((*plans.shape, *futures.states.shape))
        return futures

    monkeypatch.setattr(forecast.DGVAE, "rollout_plans", watched)
    forecast.run(QUICK)
    assert shapes == {(2, 5, 4, 4, 2, 5, 1, 3, 4, 4)}


@pytest.mark.slow
def test_streaming_keeps_each_history_near_its_mark(monkeypatch: pytest.MonkeyPatch):
    seen: dict[int, list[int]] = {}
    block = streaming.Streamed.block

    def watched(self: streaming.Streamed) -> float:
        seconds = block(self)
        seen.setdefault(self.history, []).append(self.seen)
        return seconds

    monkeypatch.setattr(streaming.Streamed, "block", watched)
    monkeypatch.setattr(streaming, "HISTORIES", (10, 30))
    monkeypatch.setattr(streaming, "ANEW", (2,))
    monkeypatch.setattr(streaming, "BATCH", 1)
    monkeypatch.setattr(streaming, "AGENTS", 3)
    monkeypatch.setattr(streaming, "ROUNDS", {"quick": 5})
    lines = streaming.run(QUICK)
    assert seen == {10: [13, 13, 13, 13, 13], 30: [33, 37, 33, 37, 33]}
    ratio = next(r for r in lines if r.unit == "×")
    assert ratio.name == "a step after 30 steps / after 10" and ratio.compared is not None
    assert [r.what["history"] for r in lines if r.unit == "ms"] == [10, 30, 2]


class _Worker:
    def __init__(self, threads: int, environment: dict[str, str] | None = None) -> None:
        pass

    def __enter__(self) -> "_Worker":
        return self

    def __exit__(self, *error: object) -> None:
        pass

    def ask(self, task: str, **arguments: Any) -> dict[str, Any]:
        return {"seconds": 1.0, "peak_bytes": 3 * 2**20}


@pytest.mark.slow
def test_training_counts_windows_memory_and_the_allocator(monkeypatch: pytest.MonkeyPatch):
    case = training.Case("fast", 3, 6, 4, 2)
    monkeypatch.setattr(training, "CASES", {"quick": (case,)})
    monkeypatch.setattr(training, "ALLOCATOR_CASE", case)
    monkeypatch.setattr(training, "WorkerProcess", _Worker)
    monkeypatch.setattr(training, "keep_freed_memory", lambda: True)
    steps, windows, rounded, memory, allocator = training.run(QUICK)
    assert (steps.unit, windows.unit, memory.unit, memory.value) == ("steps/s", "windows/s", "MiB", 3.0)
    assert windows.value == pytest.approx(4 * (steps.value or 0))
    assert steps.matmul_share is not None and windows.compared is None
    assert {allocator.unit, rounded.unit} == {"×"} and allocator.compared is None and rounded.compared is None
    monkeypatch.setattr(training, "keep_freed_memory", lambda: False)
    assert training.run(QUICK)[-1].note == "skipped: needs glibc"


@pytest.mark.slow
def test_data_is_read_and_cut_and_absent_simulators_are_skipped(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(reading, "EPISODES", {"quick": 8})
    monkeypatch.setattr(reading, "missing", lambda *modules: f"needs {modules[0]}")
    lines = reading.run(QUICK)
    assert [r.unit for r in lines] == ["MB/s", "windows/s"] * 2 + ["rollouts/s", "", ""]
    assert [r.note for r in lines[-2:]] == ["skipped: needs highway_env", "skipped: needs envpool"]


def test_the_committed_baseline_has_the_vector_environments_of_this_section():
    """A kind that is called otherwise there would be compared with nothing."""
    lines = json.loads((Path(wrappers.__file__).parent / "baseline.json").read_text())["lines"]
    kinds = {key.rpartition("vec ")[2] for key in lines if key.startswith("wrappers |")}
    assert kinds == {case.vec for case in wrappers.CASES["quick"]}


def test_without_envpool_its_lines_are_skipped_in_one_line_each(monkeypatch: pytest.MonkeyPatch):
    for module in (wrappers, ppo):
        monkeypatch.setattr(module, "missing", lambda *modules: "needs envpool")
    monkeypatch.setattr(wrappers, "CASES", {"quick": (wrappers.Case("EnvPool", 2, "envpool", False, 1, 1),)})
    for section in (wrappers, ppo):
        (line,) = section.run(QUICK)
        assert line.value is None and line.note == "skipped: needs envpool"


def test_without_simulators_whole_sections_are_skipped(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(suite, "missing", lambda *modules: f"needs {modules[-1]}" if modules else "")
    names: list[str] = []
    lines = suite.measure(QUICK, ("wrappers", "ppo"), names.append)
    assert names == ["wrappers", "ppo"]
    assert [r.note for r in lines] == ["skipped: needs stable_baselines3"] * 2


def test_an_environment_is_measured_plain_with_forecasts_and_at_the_papers_size(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(wrappers, "CASES", {"quick": (wrappers.Case("highway-env", 1, "dummy", True, 1, 3),)})
    lines = wrappers.run(QUICK)
    assert [(r.name, r.unit) for r in lines] == [
        ("plain", "steps/s"),
        ("with forecasts", "steps/s"),
        ("with forecasts, paper size", "steps/s"),
        ("with forecasts / plain", "×"),
        ("with forecasts, paper size / plain", "×"),
    ]
    assert [r.compared is not None for r in lines] == [False, True, True, True, True]
