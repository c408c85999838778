from typing import Any

import pytest

from benchmarks import many_agents
from benchmarks.many_agents import dense_bytes, exponent
from benchmarks.models import sized
from benchmarks.settings import Settings
from benchmarks.timing import Meter

QUICK = Settings(quick=True, threads=1)


@pytest.mark.parametrize("power", [0.0, 1.0, 2.0, 1.5])
def test_the_exponent_of_an_exact_power(power: float):
    assert exponent({n: 3e-4 * n**power for n in (50, 100, 200, 500)}) == pytest.approx(power, abs=1e-9)


def test_the_exponent_is_a_least_squares_fit():
    assert exponent({1: 1.0, 10: 1.0, 100: 100.0}) == pytest.approx(1.0)


class _Worker:
    """Answers that memory grows with the square of the number of agents."""

    def __init__(self, threads: int, environment: dict[str, str]) -> None:
        assert threads == 1 and environment["MALLOC_MMAP_THRESHOLD_"]

    def __enter__(self) -> "_Worker":
        return self

    def __exit__(self, *error: object) -> None:
        pass

    def ask(self, task: str, **arguments: Any) -> dict[str, Any]:
        assert task == "forecast"
        return {"peak_bytes": 2**20 * arguments["agents"] ** 2}


@pytest.fixture
def tiny(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(many_agents, "WorkerProcess", _Worker)
    monkeypatch.setattr(many_agents, "COUNTS", {"quick": (3, 4, 6)})
    monkeypatch.setattr(many_agents, "MEMORY_COUNTS", {"quick": (4, 6)})
    monkeypatch.setattr(many_agents, "FIT_FROM", 4)
    monkeypatch.setattr(many_agents, "HORIZON", 2)
    monkeypatch.setattr(many_agents, "NEIGHBOURS", 2)
    monkeypatch.setattr(many_agents, "MOST_DENSE", {"quick": 4})
    monkeypatch.setattr(many_agents, "SIZES", ("fast",))
    monkeypatch.setattr(Meter, "of", staticmethod(lambda settings: Meter(3, 0.0, 0.0)))


def test_the_section_measures_both_graphs_and_fits_from_its_threshold(tiny: None):
    lines = many_agents.run(QUICK)
    assert [(r.what["graph"], r.what["agents"]) for r in lines if r.name == "forecast"] == [
        ("all pairs", 3), ("all pairs", 4), ("2 nearest", 3), ("2 nearest", 4), ("2 nearest", 6),
    ]  # fmt: skip
    fits = {r.name: r for r in lines if r.name.startswith("exponent")}
    assert fits["exponent of memory"].value == pytest.approx(2.0)
    assert fits["exponent of time"].what["agents"] == "4 to 6"
    assert all(r.what["graph"] == "2 nearest" for r in fits.values())  # one dense count is no line
    tolerances = {name: fits[f"exponent of {name}"].compared.tolerance for name in ("time", "memory")}  # type: ignore[union-attr]
    assert tolerances["time"] > 1.4 > tolerances["memory"]  # times of one commit differ by so much


def test_what_does_not_fit_into_memory_is_skipped_with_a_note(tiny: None, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(many_agents, "MOST_BYTES", dense_bytes(sized("fast"), 3))
    lines = [r for r in many_agents.run(QUICK) if r.name == "forecast" and r.what["graph"] == "all pairs"]
    assert [r.value is None for r in lines] == [False, True]
    assert "all pairs need more than" in lines[1].note
