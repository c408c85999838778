import json
import shutil
import sys
from pathlib import Path

import pytest
import torch

from predictor import nba_score
from predictor.baselines.mlp import MLP, MLPConfig
from predictor.checkpoint import CheckpointInfo, save_checkpoint
from predictor.data import nba
from predictor.data.nba import scene_spec
from predictor.data.store import read_store
from predictor.dgvae import DGVAE
from predictor.nba_score import NbaScoreConfig, measure, sentence
from predictor.support.errors import UserError, run_entry_point
from tests.predictor.data.helpers import possession
from tests.predictor.helpers import FAST_LIKE, spec, write_circles


def turning(entity: int, t: int) -> tuple[float, float]:
    """Players on parabolas: constant velocity is off by (h² + h) / 2 · 0.02 ft, h frames ahead."""
    return (40.0, 20.0 + t) if entity == -1 else (10.0 + entity, 5.0 + 0.01 * t**2)


@pytest.fixture
def store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "score"
    folder.mkdir()
    for i, frames in enumerate((26, 24)):
        (folder / f"ATL_BKN_{i}_1_60.0_50.0.txt").write_text(possession(frames, list(range(11, 21)), turning))
    words = ["--source", folder, "--episode-steps", 0, "--out", tmp_path / "store"]
    monkeypatch.setattr(sys, "argv", ["nba", *map(str, words)])
    run_entry_point(nba.main)
    assert len(read_store(tmp_path / "store").episodes) == 2
    return tmp_path / "store"


@pytest.fixture
def checkpoint(tmp_path: Path) -> Path:
    torch.manual_seed(0)
    info = CheckpointInfo(scene_spec(), MLPConfig(), 12, model="mlp")
    save_checkpoint(tmp_path / "run" / "checkpoint", MLP(scene_spec(), MLPConfig(), 12), info)
    return tmp_path / "run"


def run(monkeypatch: pytest.MonkeyPatch, *words: object) -> None:
    monkeypatch.setattr(sys, "argv", ["nba_score", *map(str, words)])
    run_entry_point(nba_score.main)


def test_table_and_files(
    store: Path, checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    out = tmp_path / "out"
    run(monkeypatch, "--data", store, "--train-data", store, "--checkpoint", checkpoint, "--out", out)
    printed = capsys.readouterr().out
    assert "120 forecasts; the published figures are over 592,640." in printed
    for name in nba_score.HEADINGS:
        assert all(word in printed for word in name.split()), name
    content = json.loads((out / "nba_score.json").read_text())
    rows = content["rows"]
    assert [(row["name"], row["num_samples"], row["forecasts"]) for row in rows] == [
        ("constant velocity", 1, 120),
        ("constant velocity + noise", 20, 120),
        ("run, single forecast + Gaussian", 20, 120),
        ("run", 20, 120),
    ]
    assert rows[2]["ade_ft"] == pytest.approx(rows[3]["ade_ft"], rel=1e-4)  # sample 0 is the single forecast
    assert rows[2]["min_ade_ft"] < rows[2]["ade_ft"]
    off = [0.01 * (h * h + h) for h in range(1, 13)]
    assert rows[0]["min_ade_ft"] == pytest.approx(sum(off) / 12, rel=1e-3)
    assert rows[0]["min_fde_ft"] == pytest.approx(off[-1], rel=1e-3)
    assert rows[0]["coverage"] is None and 0 <= rows[1]["coverage"] <= 1
    assert rows[1]["min_ade_ft"] < rows[0]["min_ade_ft"] == pytest.approx(rows[1]["ade_ft"], rel=1e-6)
    assert [(p["name"], p["min_ade_ft"], p["min_fde_ft"]) for p in content["published"]] == [
        ("SocialVAE, published", 0.64, 1.17),
        ("SocialVAE + FPC, published", 0.58, 0.95),
    ]
    written = (out / "nba_score.md").read_text()
    assert "| SocialVAE, published | 20 | 0.64 | 1.17 | – |" in written
    assert written.count("\n| ") == 1 + 4 + 2
    for name in ("constant velocity", "constant velocity + noise", "run", "SocialVAE + FPC, published"):
        assert f"\n| {name} |" in written
        assert " ".join(name.split()[:2]) in printed


def test_a_model_that_keeps_velocities_scores_as_constant_velocity(store: Path, tmp_path: Path):
    torch.manual_seed(0)
    model = DGVAE(scene_spec(), FAST_LIKE, horizon_steps=12)
    torch.nn.init.zeros_(model.decoder.readout.weight)
    torch.nn.init.zeros_(model.decoder.readout.bias)
    save_checkpoint(tmp_path / "zero", model, CheckpointInfo(scene_spec(), FAST_LIKE, 12))
    straight, zero = measure(NbaScoreConfig(store, (str(tmp_path / "zero"),), num_samples=1))
    assert (zero.min_ade_ft, zero.min_fde_ft) == pytest.approx((straight.min_ade_ft, straight.min_fde_ft), rel=1e-4)


def test_checkpoints_that_are_called_alike_have_rows_of_their_own(store: Path, checkpoint: Path, tmp_path: Path):
    shutil.copytree(checkpoint, tmp_path / "other" / "run")
    runs = str(checkpoint), str(tmp_path / "other" / "run")
    names = [line.name for line in measure(NbaScoreConfig(store, runs, max_windows=1))]
    assert names == ["constant velocity", f"{tmp_path.name}/run", "other/run"]
    with pytest.raises(UserError, match="each checkpoint is given once"):
        measure(NbaScoreConfig(store, (runs[0], f"{runs[0]}/checkpoint")))


def test_some_windows_and_some_rows(store: Path):
    (line,) = measure(NbaScoreConfig(store, max_windows=5))
    assert (line.name, line.forecasts) == ("constant velocity", 50)
    assert [x.num_samples for x in measure(NbaScoreConfig(store, train_data=store, num_samples=4))] == [1, 4]
    with pytest.raises(UserError, match="--train-data needs --num-samples of at least 2"):
        NbaScoreConfig(store, train_data=store, num_samples=1)


def test_the_published_windows_are_recognised(store: Path):
    (line,) = measure(NbaScoreConfig(store))
    assert sentence([line]) == "120 forecasts; the published figures are over 592,640."
    published = type(line)(**{**vars(line), "forecasts": 592_640})
    assert sentence([published]) == "592,640 forecasts, all of the published test windows."


def test_what_does_not_fit_is_refused(store: Path, checkpoint: Path, tmp_path: Path):
    circles = write_circles(tmp_path / "circles")
    with pytest.raises(UserError, match="circles holds no basketball"):
        measure(NbaScoreConfig(circles))
    with pytest.raises(UserError, match="circles holds no basketball"):
        measure(NbaScoreConfig(store, train_data=circles))
    save_checkpoint(tmp_path / "road", MLP(spec(), MLPConfig(), 2), CheckpointInfo(spec(), MLPConfig(), 2, model="mlp"))
    with pytest.raises(UserError, match="checkpoint '.*road' was trained on features"):
        measure(NbaScoreConfig(store, (str(tmp_path / "road"),)))
