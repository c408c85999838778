from dataclasses import replace
from pathlib import Path

import pytest
import torch

from predictor.data.store import read_store
from predictor.online import OnlineForecaster
from predictor.support.errors import ProtocolError, UserError
from predictor.training.config import TrainConfig
from predictor.training.objective import nll
from tests.predictor.helpers import batch, model, scene, write_circles


@pytest.mark.parametrize("damage", ["truncated", "missing"])
def test_damaged_chunk_is_not_read_as_zeros(tmp_path: Path, damage: str):
    store = write_circles(tmp_path / "data")
    chunk = next(f for f in (store / "states").rglob("*") if f.is_file() and f.name != "zarr.json")
    if damage == "truncated":
        chunk.write_bytes(chunk.read_bytes()[:10])
    else:
        chunk.unlink()
    with pytest.raises(UserError, match="collect it anew"):
        read_store(store)


def test_nothing_is_forecast_from_a_forgotten_history():
    online = OnlineForecaster(model(), 1, 3)
    online.observe(batch(scene({0: (0.0, 0.0, 1.0, 0.0)}, 3)))
    online.reset()
    with pytest.raises(ProtocolError):
        online.forecast()


def test_infinite_invalid_target_leaves_the_gradient_finite():
    predicted, target = torch.zeros(2, 4, requires_grad=True), torch.zeros(2, 4)
    target[1] = torch.inf
    nll(predicted, target, torch.tensor([True, False]), torch.ones(4), 1.0).backward()
    assert predicted.grad is not None and torch.isfinite(predicted.grad).all()


@pytest.mark.parametrize("bad", [{"lr": float("nan")}, {"clip_norm": 0.0}, {"kl_weight": -1.0}, {"seed": -1}])
def test_impossible_numbers_are_named(tmp_path: Path, bad: dict[str, float]):
    with pytest.raises(UserError, match=next(iter(bad))):
        TrainConfig((tmp_path / "data",), tmp_path / "run", **bad)  # type: ignore[arg-type]


def test_heading_must_be_finite():
    with pytest.raises(UserError, match="heading_rad"):
        replace(scene({0: (0.0, 0.0, 1.0, 0.0)}, 2), heading_rad=float("nan")).check()
