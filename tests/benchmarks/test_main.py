import json
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest
import torch

from benchmarks import __main__ as entry
from benchmarks import forecast, suite
from benchmarks.results import Line
from benchmarks.timing import Meter
from predictor.support.errors import run_entry_point
from predictor.support.runtime import processor
from tests.benchmarks.helpers import line, write


@pytest.fixture(autouse=True)
def gentle(monkeypatch: pytest.MonkeyPatch) -> None:
    """Keeps allocator and threads of the test process, and measures almost nothing."""
    monkeypatch.setattr(entry, "keep_freed_memory", lambda: False)
    monkeypatch.setattr(torch, "set_num_threads", lambda threads: None)
    monkeypatch.setattr(Meter, "of", staticmethod(lambda settings: Meter(3, 0.0, 0.0)))


def call(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    """Returns the exit status of `python -m benchmarks …`."""
    monkeypatch.setattr(sys, "argv", ["benchmarks", "--quick", "--threads", "1", *arguments])
    try:
        run_entry_point(entry.main)
    except SystemExit as end:
        return int(end.code or 0)
    return 0


def serve(monkeypatch: pytest.MonkeyPatch, *measurements: Sequence[Line]) -> list[str]:
    """Lets section "data" give these lines, one measurement after the other; returns what was run."""
    left, ran = list(measurements), []

    def run(section: str, settings: object) -> list[Line]:
        ran.append(section)
        return list(left.pop(0)) if section == "data" else []

    monkeypatch.setattr(suite, "_run", run)
    return ran


def test_a_section_from_the_command_line_to_the_table_and_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
):
    monkeypatch.setattr(forecast, "CASES", {"quick": (forecast.Case(1, 3, 2, 1),)})
    out = tmp_path / "new" / "benchmarks.json"
    assert call(monkeypatch, "--only", "forecast", "--out", str(out)) == 0
    shown = capsys.readouterr()
    assert processor() in shown.out and "1 torch threads" in shown.out and "quick run" in shown.out
    lines = shown.out.splitlines()
    assert lines[2].startswith("section")
    assert sum(line.startswith("forecast") for line in lines) == 13
    assert "forecast …" in shown.err
    result = json.loads(out.read_text())
    assert result["machine"] == processor() and result["threads"] == 1 and result["mode"] == "quick"
    assert result["keeps_freed_memory"] is False
    assert {"commit", "versions"} <= set(result["provenance"])
    assert len(result["lines"]) == 13
    assert result["lines"][0]["key"] == "forecast | observe | preset fast, batch 1, agents 3, horizon 2, samples 1"
    assert result["lines"][0]["flop"] > 0
    assert [path.name for path in out.parent.iterdir()] == ["benchmarks.json"]  # no half-written file


def test_results_are_written_before_the_table_is_printed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Whoever reads the table may leave in the middle."""

    def left(lines: Sequence[Line]) -> str:
        raise BrokenPipeError

    serve(monkeypatch, [line(1.0)])
    monkeypatch.setattr(entry, "plain", left)
    out, made = tmp_path / "out.json", tmp_path / "baseline.json"
    with pytest.raises(BrokenPipeError):
        call(monkeypatch, "--out", str(out), "--write-baseline", str(made))
    assert out.exists() and made.exists()


def test_what_got_slower_is_measured_twice_reported_and_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
):
    path = write(tmp_path / "baseline.json", [line(1.0), line(1.0, "other")], machine=processor())
    ran = serve(monkeypatch, [line(4.0), line(1.0, "other")], [line(3.0), line(9.0, "other")])
    arguments = ("--only", "data", "machine", "--baseline", str(path), "--out", str(tmp_path / "out.json"))
    assert call(monkeypatch, *arguments) == 1
    shown = capsys.readouterr().out
    assert ran == ["machine", "data", "data"]
    assert "SLOWER  3.00× slower (1 → 3, tolerance 1.50×): data | step | agents 5" in shown
    assert "2 lines compared: 1 slower, 0 faster, 0 missing, 0 new" in shown
    assert "measured twice" in shown and "another processor" not in shown


def test_a_broken_promise_is_measured_twice_and_fails_without_being_slower(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
):
    path = write(tmp_path / "baseline.json", [line(2.1, at_most=2.0)], machine=processor())
    arguments = ("--only", "data", "--baseline", str(path), "--out", str(tmp_path / "out.json"))
    for again, status in ((2.2, 1), (1.9, 0)):
        ran = serve(monkeypatch, [line(2.1, at_most=2.0)], [line(again, at_most=2.0)])
        assert call(monkeypatch, *arguments) == status and ran == ["data", "data"]
        shown = capsys.readouterr().out
        assert ("BROKEN  2.10 of one, promised 2.00: data | step | agents 5" in shown) == bool(status)
        assert "1 lines compared: 0 slower" in shown


def test_noise_that_a_second_measurement_takes_away_does_not_fail(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
):
    path = write(tmp_path / "baseline.json", [line(1.0)], machine="another one")
    serve(monkeypatch, [line(4.0)], [line(1.1)])
    arguments = ("--only", "data", "--baseline", str(path), "--out", str(tmp_path / "out.json"))
    assert call(monkeypatch, *arguments) == 0
    shown = capsys.readouterr().out
    assert "1 lines compared: 0 slower" in shown
    assert "the baseline is of another processor (another one)" in shown


def test_a_written_baseline_is_what_the_next_run_is_held_against(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path, out = tmp_path / "baseline.json", str(tmp_path / "out.json")
    serve(monkeypatch, [line(2.0)], [line(2.9)], [line(3.1)], [line(3.2)])
    assert call(monkeypatch, "--write-baseline", str(path), "--out", out) == 0
    assert call(monkeypatch, "--baseline", str(path), "--out", out) == 0
    assert call(monkeypatch, "--baseline", str(path), "--out", out) == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--only", "nothing"), "error: there is no section nothing; there are machine, "),
        (("--baseline", "no-such-file.json"), "error: no baseline at no-such-file.json; make one with python -m"),
        (("--env-id", "nonsense-v0"), "error: no checkpoint ships for env 'nonsense-v0'"),
        (("--reference", "no-such-folder"), "error: --reference no-such-folder is no folder; it must be a checkout"),
    ],
)
def test_bad_input_is_one_line_before_anything_is_measured(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, arguments: tuple[str, ...], message: str
):
    ran = serve(monkeypatch)
    assert call(monkeypatch, *arguments) == 2
    shown = capsys.readouterr()
    assert shown.err.startswith(message) and shown.err.count("\n") == 1
    assert ran == [] and shown.out == ""
