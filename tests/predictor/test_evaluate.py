import json
import math
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from predictor import evaluate as evaluation
from predictor.accuracy import Accuracy
from predictor.checkpoint import CheckpointInfo, save_checkpoint
from predictor.data.store import StoreInfo, read_store, write_store
from predictor.dgvae import DGVAE
from predictor.errors import UserError, run_entry_point
from predictor.evaluate import EvaluateConfig, evaluate, markdown_table
from predictor.scene import SceneSpec
from tests.predictor.helpers import FAST_LIKE, spec, write_circles


@pytest.fixture
def data(tmp_path: Path) -> Path:
    return write_circles(tmp_path / "data", episodes=3, steps=6)


@pytest.fixture
def checkpoint(tmp_path: Path) -> Path:
    """A model whose change of state is always zero, so that its forecasts are known: constant velocity."""
    torch.manual_seed(0)
    forecaster = DGVAE(spec(), FAST_LIKE, horizon_steps=2)
    torch.nn.init.zeros_(forecaster.decoder.readout.weight)
    torch.nn.init.zeros_(forecaster.decoder.readout.bias)
    save_checkpoint(tmp_path / "toy", forecaster, CheckpointInfo(spec(), FAST_LIKE, 2, std_m=(1.0, 2.0)))
    return tmp_path / "toy"


def run(monkeypatch: pytest.MonkeyPatch, *words: object) -> None:
    monkeypatch.setattr(sys, "argv", ["evaluate", *map(str, words)])
    run_entry_point(evaluation.main)


def refuse(constant: str) -> None:
    raise AssertionError(f"{constant} is not JSON")


def test_smoke(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], data: Path, checkpoint: Path, tmp_path: Path
):
    out = tmp_path / "out"
    run(monkeypatch, "--checkpoint", checkpoint, "--data", data, "--samples", 3, "--out", out)
    printed = capsys.readouterr().out
    assert "minADE [m]" in printed and "constant velocity" in printed
    assert "displacement of the best sample [m] / RMSE of the mean [m] / NLL [nats]" in " ".join(printed.split())
    assert sorted(p.name for p in out.iterdir()) == [
        "accuracy.json",
        "accuracy.md",
        "error_by_horizon.png",
        "scenes.png",
    ]
    for name in ("error_by_horizon.png", "scenes.png"):
        picture = (out / name).read_bytes()
        assert picture.startswith(b"\x89PNG") and len(picture) > 5000
    content = json.loads((out / "accuracy.json").read_text(), parse_constant=refuse)
    assert (content["source"], content["dt_s"]) == ("circles", 1.0)
    assert [(r["name"], r["num_samples"]) for r in content["rows"]] == [
        ("dG-VAE", 1),
        ("dG-VAE", 3),
        ("constant velocity", 1),
    ]
    assert all(len(r["by_step_m"]) == len(r["rmse_m"]) == len(r["nll"]) == 2 for r in content["rows"])
    lines = (out / "accuracy.md").read_text().splitlines()
    assert lines[0] == "| forecaster | K | minADE [m] | minFDE [m] | 1 s | 2 s |"
    assert [line.split("|")[1].strip() for line in lines[2:]] == ["dG-VAE", "dG-VAE", "constant velocity"]


def test_known_model_scores_what_it_must(data: Path, checkpoint: Path):
    one, many, straight = evaluate(EvaluateConfig(str(checkpoint), data, samples=4))
    for row in (one, many):
        assert row.min_ade_m == pytest.approx(straight.min_ade_m, rel=1e-5)
        assert row.min_fde_m == pytest.approx(straight.min_fde_m, rel=1e-5)
        assert row.by_step_m == pytest.approx(straight.by_step_m, rel=1e-5)
        assert row.rmse_m == pytest.approx(straight.rmse_m, rel=1e-5)
        # one point: d²/(2σ²) + 2 log σ + log 2π on average, with the checkpoint's spread
        expected = [
            r**2 / (2 * s**2) + 2 * math.log(s) + math.log(2 * math.pi)
            for r, s in zip(row.rmse_m, (1.0, 2.0), strict=True)
        ]
        assert row.nll == pytest.approx(expected, rel=1e-4)
    assert straight.min_ade_m > 0.5
    assert one.agents == 3 * 4  # of 6 steps, 4 have two steps after them; one other agent per episode


def test_horizon_and_number_of_windows_can_be_chosen(data: Path, checkpoint: Path):
    rows = evaluate(EvaluateConfig(str(checkpoint), data, horizon_steps=4, max_windows=5))
    assert all(len(r.by_step_m) == 4 and r.agents <= 5 for r in rows)
    assert [r.num_samples for r in rows] == [1, 20, 1]


def test_one_sample_gives_one_row(data: Path, checkpoint: Path):
    assert [r.name for r in evaluate(EvaluateConfig(str(checkpoint), data, samples=1))] == [
        "dG-VAE",
        "constant velocity",
    ]


def test_equal_seeds_give_equal_rows(data: Path, checkpoint: Path):
    settings = EvaluateConfig(str(checkpoint), data, samples=3, max_windows=6)
    assert evaluate(settings) == evaluate(settings)


def test_markdown_closed_form():
    rows = [Accuracy("dG-VAE", 20, 0.1234, 0.5, [0.1, 0.25], [0.2, 0.3], [], 7)]
    assert markdown_table(rows, 0.2) == (
        "| forecaster | K | minADE [m] | minFDE [m] | 0.2 s | 0.4 s |\n"
        "|---|---|---|---|---|---|\n"
        "| dG-VAE | 20 | 0.123 | 0.500 | 0.10 | 0.25 |\n"
    )


def refused(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *words: object) -> str:
    with pytest.raises(SystemExit) as stop:
        run(monkeypatch, *words)
    assert stop.value.code == 2
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.count("\n") == 1
    return captured.err


def another_time_step(data: Path, checkpoint: Path) -> list[Any]:
    other = data.with_name("other")
    write_store(other, StoreInfo(spec(dt_s=0.2), "quick"), read_store(data).episodes)
    return ["--checkpoint", checkpoint, "--data", other]


def other_features(data: Path, checkpoint: Path) -> list[Any]:
    other, (first, *_) = data.with_name("other"), read_store(data).episodes
    layout = SceneSpec(1.0, feature_names=(*spec().feature_names, "heading_rad"), feature_scales=(1.0,) * 5)
    states = first.states[..., [0, 1, 2, 3, 3]]
    write_store(other, StoreInfo(layout, "turning"), [replace(first, states=states)])
    return ["--checkpoint", checkpoint, "--data", other]


def no_such_store(data: Path, checkpoint: Path) -> list[Any]:
    return ["--checkpoint", checkpoint, "--data", data.with_name("nowhere")]


def no_such_checkpoint(data: Path, checkpoint: Path) -> list[Any]:
    return ["--checkpoint", "highwy", "--data", data]


def truncated_checkpoint(data: Path, checkpoint: Path) -> list[Any]:
    weights = checkpoint / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[:-10])
    return ["--checkpoint", checkpoint, "--data", data]


def negative_samples(data: Path, checkpoint: Path) -> list[Any]:
    return ["--checkpoint", checkpoint, "--data", data, "--samples", -1]


def no_horizon(data: Path, checkpoint: Path) -> list[Any]:
    return ["--checkpoint", checkpoint, "--data", data, "--horizon-steps", 0]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (another_time_step, "toy' was trained at dt_s=1 but store "),
        (another_time_step, "steps at dt_s=0.2; retrain on its data"),
        (other_features, "'heading_rad')"),
        (no_such_store, "no episode store at "),
        (no_such_checkpoint, "no checkpoint 'highwy': neither a folder nor a shipped name"),
        (truncated_checkpoint, "model.safetensors cannot be read"),
        (negative_samples, "samples must be at least 1, got -1"),
        (no_horizon, "horizon_steps must be at least 1, got 0"),
    ],
)
def test_bad_input_is_one_line(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    data: Path,
    checkpoint: Path,
    tmp_path: Path,
    words: Any,
    message: str,
):
    given = refused(monkeypatch, capsys, *words(data, checkpoint), "--out", tmp_path / "out")
    assert given.startswith("error: ") and message in given
    assert not (tmp_path / "out").exists()


def test_windows_without_a_future_are_refused(data: Path, checkpoint: Path, tmp_path: Path):
    short = [replace(e, states=e.states[:1], valid=e.valid[:1]) for e in read_store(data).episodes]
    write_store(tmp_path / "short", StoreInfo(spec(), "short"), short)
    with pytest.raises(UserError, match="no window fits: episodes have at most 1 steps"):
        evaluate(EvaluateConfig(str(checkpoint), tmp_path / "short"))
