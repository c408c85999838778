"""The GPU run and its projection, at sizes that a CPU does in seconds."""

import json
import os
import sys
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest
import torch

from benchmarks import gpu_springs as script
from benchmarks.gpu_springs import Counter, GpuSpringsConfig, Kernel, on_card
from predictor.support.errors import UserError, run_entry_point
from predictor.training.trainer import Trainer

CARD = GpuSpringsConfig(
    project=True, peak_tflops=10.0, bandwidth_gbs=1000.0, share=0.5, kernel_us=2.0, target_minutes=1.0
)


@pytest.fixture(autouse=True)
def one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    """A run takes all cores; other tests are on them."""
    monkeypatch.setattr(os, "cpu_count", lambda: 1)


@pytest.fixture
def small(tmp_path: Path) -> GpuSpringsConfig:
    return GpuSpringsConfig(
        tmp_path / "data", tmp_path / "run", "cpu", budget="smoke", steps=2, sequences=30, held_out=12
    )


# --- The run ----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_one_command_from_nothing_to_a_summary(
    small: GpuSpringsConfig, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    words = ["--data", small.data, "--out", small.out, "--device", "cpu", "--budget", "smoke", "--steps", 2]
    words += ["--sequences", 30, "--held-out", 12]
    monkeypatch.setattr(sys, "argv", ["gpu_springs", *map(str, words)])
    script.main()
    summary = json.loads((small.out / "summary.json").read_text())
    assert (summary["steps"], summary["steps_of_the_last_call"]) == (2, 2)
    assert summary["steps_per_s_with_validation"] > 0 and summary["below_target"] is True
    assert summary["min_ade_m"] == summary["tests"]["test"]["horizon_only"]["min_ade_m"] > 0
    assert set(summary["tests"]) == {"test", "ood"} and set(summary["data_seconds"]) == set(script.SPLITS)
    assert summary["provenance"]["versions"]["torch"] == version("torch")
    said = capsys.readouterr().out
    assert "2 steps in " in said and f"written to {small.out / 'summary.json'}" in said
    # again: nothing is made, trained or measured anew
    monkeypatch.setattr(script, "make", lambda _: pytest.fail("the data is there"))
    monkeypatch.setattr(script, "run_line", lambda *_: pytest.fail("the line is there"))
    script.main()
    again = json.loads((small.out / "summary.json").read_text())
    assert again == json.loads(json.dumps(summary))


@pytest.mark.slow
def test_a_run_that_was_stopped_goes_on(small: GpuSpringsConfig, monkeypatch: pytest.MonkeyPatch):
    """The summary has the number of steps that the time is for."""
    sizes = replace(script.SPRINGS.budgets["smoke"], steps=3, eval_every=1, val_windows=4, test_windows=4)
    monkeypatch.setitem(script.SPRINGS.budgets, "smoke", sizes)
    whole = replace(small, steps=0)
    original = Trainer.train_step

    def stopping(trainer: Trainer) -> Any:
        if trainer.step == 2:
            raise KeyboardInterrupt
        return original(trainer)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(Trainer, "train_step", stopping)
        script.run(whole)
    summary = script.run(whole)
    assert (summary["steps"], summary["steps_of_the_last_call"]) == (3, 1)
    assert summary["below_target"] is None
    assert script.run(whole) == json.loads(json.dumps(summary))  # not three steps in the time of one
    other = script.run(replace(whole, target_minutes=1e6))
    names = ("device", "steps_of_the_last_call", "steps_per_s_with_validation", "below_target")
    assert [other[name] for name in names] == [summary[name] for name in names]
    (whole.out / "summary.json").unlink()
    assert [script.run(whole)[name] for name in names] == [None] * 4


def test_only_missing_splits_are_made(small: GpuSpringsConfig):
    assert set(script.make_missing(small)) == set(script.SPLITS)
    (small.data / "springs" / "ood").rename(small.data / "elsewhere")
    assert set(script.make_missing(small)) == {"ood"}
    assert script.make_missing(small) == {}


# --- The projection ---------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_step_is_timed_counted_and_projected(
    small: GpuSpringsConfig, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    words = ["--project", "--out", small.out, "--budget", "smoke", "--timed-steps", 1, "--batch-size", 4]
    monkeypatch.setattr(sys, "argv", ["gpu_springs", *map(str, words)])
    monkeypatch.setattr(script, "matmul_rate", lambda: 1e12)
    script.main()
    content = json.loads((small.out / "projection.json").read_text())
    here, card = content["here"], content["card"]
    assert (content["batch_size"], content["horizon_steps"]) == (4, 10)
    assert content["history_steps"] == 27  # histories of 8 to 40, rounded up to eights, on average
    assert here["flop_per_step"] > 1e6 and here["kernels_per_step"] > 1000
    assert sum(here["kernels_by_operation"].values()) + script.UPDATE_KERNELS == here["kernels_per_step"]
    assert here["share_of_matmul_rate"] == card["share_of_peak"]
    assert card["step_s"] >= max(card["products_s"], card["memory_s"], card["kernels_s"])
    others = content["minutes_by_kernel_us"]
    assert list(others) == ["1.5", "2.0", "2.5", "3.0"] and list(others.values()) == sorted(others.values())
    assert others["2.0"] == card["minutes"]
    said = capsys.readouterr().out
    assert "PROJECTION, not a measurement" in said and "not a measurement" in content["what"]


def test_counting_in_closed_form():
    """(2×3)·(3×4) forward, and twice that backward; views and allocations are no kernels."""
    left, right = torch.ones(2, 3, requires_grad=True), torch.ones(3, 4, requires_grad=True)
    with Counter() as counter:
        (left @ right).t().sum().backward()
    products = [k for k in counter.kernels if k.flop]
    assert [k.flop for k in products] == [2 * 2 * 3 * 4] * 3
    assert products[0].moved_bytes == 4 * (6 + 12 + 8)
    assert "t" not in {k.name for k in counter.kernels}


@pytest.mark.parametrize("operation", ["addmm_", "addmm_out", "baddbmm_", "bmm"])
def test_products_in_place_count_as_well(operation: str):
    one, a, b = torch.zeros(2, 4), torch.ones(2, 3), torch.ones(3, 4)
    with Counter() as counter:
        if operation == "addmm_":
            one.addmm_(a, b)
        elif operation == "addmm_out":
            torch.addmm(one, a, b, out=torch.empty(2, 4))
        elif operation == "baddbmm_":
            one[None].baddbmm_(a[None], b[None])
        else:
            torch.bmm(a[None], b[None])
    assert sum(k.flop for k in counter.kernels) == 48


def test_card_in_closed_form():
    """A kernel is as slow as its slowest limit: start (2 µs), product (5 TFLOP/s), memory (1 TB/s)."""
    kernels = [Kernel("tiny", 0.0, 1e3), Kernel("mm", 5e9, 1e6), Kernel("copy", 0.0, 4e9)]
    card = on_card(CARD, kernels, here={"share_of_matmul_rate": 0.9}, steps=6000)
    start = (3 + script.UPDATE_KERNELS) * 2e-6
    assert card["products_s"] == pytest.approx(1e-3) and card["memory_s"] == pytest.approx(4.001001e-3)
    assert card["kernels_s"] == pytest.approx(start)
    assert card["step_s"] == pytest.approx(2e-6 + 1e-3 + 4e-3 + script.UPDATE_KERNELS * 2e-6)
    assert card["minutes"] == pytest.approx(100 * card["step_s"])
    default = on_card(
        replace(CARD, peak_tflops=0.0, precision="tf32"), kernels, here={"share_of_matmul_rate": 0.9}, steps=1
    )
    assert default["peak_tflops"] == 494.0 and default["products_s"] == pytest.approx(5e9 / 247e12)
    measured = on_card(replace(CARD, share=0.0), kernels, here={"share_of_matmul_rate": 0.25}, steps=1)
    assert measured["share_of_peak"] == 0.25 and measured["products_s"] == pytest.approx(2e-3)


def test_matmul_rate_is_a_rate():
    assert 1e8 < script.matmul_rate(128, 2) < 1e14


# --- Bad input --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"sequences": 0}, "sequences must be at least 1, got 0"),
        ({"steps": -1}, "steps must not be negative, got -1"),
        ({"peak_tflops": -1.0}, "peak_tflops must not be negative, got -1.0"),
        ({"kernel_us": 0.0}, "kernel_us must be positive, got 0.0"),
        ({"batch_size": 64}, "batch_size is of a projection and has no effect without --project"),
        ({"share": 1.5}, "share must lie between 0 and 1, got 1.5"),
        ({"device": "cuda"}, "torch finds no CUDA device; use --device cpu, or pass --project for an estimate"),
    ],
)
def test_bad_settings_are_named(
    small: GpuSpringsConfig, monkeypatch: pytest.MonkeyPatch, changes: dict[str, Any], message: str
):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(UserError, match=message):
        replace(small, **changes)
    assert replace(small, device="cuda", project=True).suite.device == "cpu"


def test_what_is_damaged_in_a_run_folder_is_named(small: GpuSpringsConfig, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(script, "make_missing", lambda _: {})
    monkeypatch.setattr(script.SuiteConfig, "check_stores", lambda _: None)
    monkeypatch.setattr(script, "run_line", lambda *_: pytest.fail("trained on"))
    folder = small.out / "line"
    monkeypatch.setattr(script, "line_folder", lambda *_: folder)
    (folder / "run").mkdir(parents=True)
    (folder / "run" / "train_state.pt").write_bytes(b"PK cut")
    with pytest.raises(UserError, match=r"train_state.pt is damaged; delete .*run to train anew"):
        script.run(small)
    (folder / "run" / "train_state.pt").unlink()
    (folder / "result.json").write_text("{}")
    with pytest.raises(UserError, match=r"result.json is not the result of this line; delete it"):
        script.run(small)
    (folder / "result.json").write_text("")
    with pytest.raises(UserError, match=r"result.json"):
        script.run(small)


def test_a_place_that_cannot_be_written_is_said_before_the_work(
    small: GpuSpringsConfig, monkeypatch: pytest.MonkeyPatch
):
    small.out.write_text("a file")
    monkeypatch.setattr(script, "project", lambda _: pytest.fail("projected"))
    monkeypatch.setattr(sys, "argv", ["gpu_springs", "--project", "--out", str(small.out)])
    with pytest.raises(UserError, match=str(small.out)):
        script.main()


def test_without_a_card_one_line_says_so(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(sys, "argv", ["gpu_springs"])
    with pytest.raises(SystemExit) as stop:
        run_entry_point(script.main)
    assert stop.value.code == 2
    missing = "device 'cuda' was asked for but torch finds no CUDA device"
    advice = "use --device cpu, or pass --project for an estimate"
    assert capsys.readouterr().err == f"error: {missing}; {advice}\n"
