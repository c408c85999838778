"""The benchmark of rows: what it measures, what it prints, and that its traffic is traffic."""

import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks import rows as module
from benchmarks.row_costs import Measured, make_run
from benchmarks.rows import exponents, table
from benchmarks.tensor_traffic import TensorTraffic, spec
from benchmarks.worker_process import rows as measure
from envs.readers.batched import TensorReader
from predictor.support.errors import UserError


def test_one_number_of_rows_is_measured():
    found = Measured(
        **measure(simulator="traffic", rows=3, checkpoint="constant-velocity", max_rows=2, seconds=0.01, device="cpu")
    )
    assert found.rows == 3 and found.forecast_ms > 0 and found.simulator_ms > 0
    assert found.peak_mib is None or found.peak_mib >= 0
    assert found.steps_per_s == pytest.approx(3000 / (found.forecast_ms + found.simulator_ms))


def linear(counts: tuple[int, ...]) -> list[Measured]:
    return [Measured(n, 2.0 * n, 1.0, 0.5 * n**2) for n in counts]


def test_exponents_are_of_large_numbers_of_rows():
    found = exponents([Measured(1, 500.0, 1.0, 900.0), *linear((256, 1024, 4096, 16384))])
    assert found == {"time": pytest.approx(1.0), "memory": pytest.approx(2.0)}
    assert exponents(linear((1, 16))) == {}
    unmeasured = [Measured(n, 1.0, 1.0, None) for n in (1024, 4096)]
    assert exponents(unmeasured) == {"time": pytest.approx(0.0)}


def test_the_table_has_a_line_for_each_number():
    lines = table([Measured(1, 8.0, 2.0, None), Measured(4096, 2048.0, 0.0, 1234.5)]).splitlines()
    assert lines[2] == "| 1 | 100 | 8.0 | 8.000 | 2.0 | – |"
    assert lines[3] == "| 4,096 | 2,000 | 2,048.0 | 0.500 | 0.0 | 1,234 |"


@pytest.mark.slow
def test_the_command_prints_and_writes(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture):
    words = ["rows", "--num-envs", "1", "2", "--seconds", "0.01", "--checkpoint", "constant-velocity"]
    monkeypatch.setattr(sys, "argv", [*words, "--out", str(tmp_path / "rows.json")])
    module.main()
    assert capsys.readouterr().out.count("\n| ") == 3 and (tmp_path / "rows.json").is_file()


def test_vmas_is_asked_for_in_a_line_where_it_is_absent(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "vmas", None)
    with pytest.raises(UserError, match="--simulator vmas needs VMAS .*pip install vmas"):
        make_run("vmas", 1, "simple-spread", 1, "cpu")


def test_agents_of_tensor_traffic_come_and_go():
    traffic, reader = TensorTraffic(50, 8, seed=1), TensorReader(spec(8))
    known: list[set[int]] = [set() for _ in range(50)]
    begun = np.zeros(50, dtype=np.int64)
    for _ in range(30):
        read = reader.read(traffic.agents, np.arange(50))
        assert read.valid[:, 0].all() and (read.ids[:, 0] == 0).all()
        for row in range(50):
            if traffic.begun[row]:
                known[row], begun[row] = set(), begun[row] + 1
            known[row] |= set(read.ids[row][read.valid[row]].tolist())
        traffic.step()
    assert np.mean([len(ids) for ids in known]) > 9 > 8  # more than there are places
    assert (begun >= 1).all() and 20 < begun.sum() - 50 < 45
    assert 0.35 < float(traffic.agents.valid[:, 1:].float().mean()) < 0.65  # type: ignore[union-attr]


def test_tensor_traffic_is_drawn_from_its_seed():
    first, same, other = (TensorTraffic(4, 5, seed) for seed in (1, 1, 2))
    for each in (first, same, other):
        each.step()
    torch.testing.assert_close(first.agents.states, same.agents.states)
    assert not torch.equal(first.agents.states, other.agents.states)
