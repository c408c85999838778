"""A network with the scales of other data, and the same forecasts."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from predictor.checkpoint import load_checkpoint
from predictor.data.store import StoreInfo, write_store
from predictor.support.errors import UserError
from predictor.train import train
from predictor.training.config import TrainConfig
from predictor.training.rescaling import rescaled
from predictor.training.trainer import Trainer
from predictor.training.training_data import load_data
from tests.predictor.helpers import any_model, circling_episode, random_states, spec

SCALES = {
    "delta_scales": (0.3, 7.0, 2.0, 0.5),
    "input_scales": (150.0, 3.0, 2.5, 0.6),
    "change_scales": (20.0, 0.5, 1.4, 0.9),
}


def forecasts(model: Any) -> torch.Tensor:
    states = random_states(3, 2, 4, 5, 4)
    memory, belief = model.empty_memory(2, 5), None
    for step in range(4):
        memory, belief = model.observe(memory, states[:, step], torch.ones(2, 5).bool())
    return model.rollout(belief, 3, max(1, model.config.num_modes)).states


@pytest.mark.parametrize("kind", ["dgvae", "dgvae-plural"])
def test_forecasts_stay_and_weights_change(kind: str):
    source = any_model(kind)
    copy = rescaled(source, "dgvae", SCALES, 3)
    given = SCALES if source.config.change_scales else SCALES | {"change_scales": ()}
    assert copy.config == replace(source.config, **given)
    torch.testing.assert_close(forecasts(copy), forecasts(source), rtol=1e-4, atol=1e-4)
    assert not torch.allclose(copy.decoder.readout.weight, source.decoder.readout.weight)
    assert source.config == any_model(kind).config and source.training is False


def test_all_modes_are_compared_over_the_whole_horizon(monkeypatch: pytest.MonkeyPatch):
    source, seen = any_model("dgvae-plural"), []
    plain = type(source).rollout

    def spy(self: Any, *args: Any, **kwargs: Any) -> Any:
        futures = plain(self, *args, **kwargs)
        seen.append(tuple(futures.states.shape[1:4:2]))
        return futures

    monkeypatch.setattr(type(source), "rollout", spy)
    rescaled(source, "dgvae", SCALES, 7)
    assert seen == [(source.config.num_modes, 7)] * 2


def test_geometry_takes_the_new_scales_though_forecasts_move():
    source = any_model("dgvae-plural")
    copy = rescaled(source, "dgvae", {"geometry_scales": (20.0, 9.0)}, 3)
    assert copy.config.geometry_scales == (20.0, 9.0)
    assert not torch.allclose(forecasts(copy), forecasts(source), atol=1e-3)


def test_scales_of_what_the_data_do_not_show_stay():
    """Where no step has two agents, no neighbour is typical, and the network keeps its layers for geometry."""
    source = any_model("dgvae-plural")
    assert source.config.geometry_scales
    copy = rescaled(source, "dgvae", SCALES | {"geometry_scales": ()}, 3)
    assert copy.config.geometry_scales == source.config.geometry_scales
    torch.testing.assert_close(forecasts(copy), forecasts(source), rtol=1e-4, atol=1e-4)


def test_a_network_whose_other_layers_see_the_state_is_refused():
    with pytest.raises(UserError, match="refit_scales cannot keep what this network forecasts, it moves by"):
        rescaled(any_model("dgvae-rich"), "dgvae", SCALES, 3)


def config(data: Path, out: Path, **changes: Any) -> TrainConfig:
    small: dict[str, Any] = {"steps": 2, "batch_size": 4, "history_steps": 3, "horizon_steps": 2, "val_fraction": 0.34}
    return TrainConfig(data=(data,), out=out, eval_every=2, **(small | changes))


@pytest.mark.slow
def test_training_goes_on_with_the_scales_of_its_data(tmp_path: Path):
    """A second road ten times as long: fitted scales are ten times the first one's, forecasts begin as they were."""
    for name, factor in (("short", 1.0), ("long", 10.0)):
        episodes = [circling_episode(i) for i in range(6)]
        episodes = [replace(e, states=factor * e.states) for e in episodes]
        write_store(tmp_path / name, StoreInfo(spec(), "circles"), episodes)
    first = str(train(config(tmp_path / "short", tmp_path / "first")))
    kept, refitted = (
        Trainer(begun, load_data(begun)).model
        for begun in (
            config(tmp_path / "long", tmp_path / "second", init=first, refit_scales=refit) for refit in (False, True)
        )
    )
    source = load_checkpoint(first)[0].config
    for field in ("delta_scales", "input_scales", "change_scales", "geometry_scales"):
        assert getattr(kept.config, field) == getattr(source, field)
        assert getattr(refitted.config, field) == pytest.approx([10 * s for s in getattr(source, field)], rel=1e-3)
    whole = config(tmp_path / "long", tmp_path / "whole", init=first, refit_scales=True, steps=4)
    train(whole)
    train(replace(whole, out=tmp_path / "parts", steps=2))
    train(replace(whole, out=tmp_path / "parts", resume=True))
    ours, theirs = (load_checkpoint(tmp_path / name)[0].state_dict() for name in ("parts", "whole"))
    assert all(torch.equal(ours[name], theirs[name]) for name in ours)


@pytest.mark.parametrize("changes", [{}, {"init": "any", "only_spread": True}, {"init": "any", "model": "lstm"}])
def test_refitting_needs_a_network_to_start_from(tmp_path: Path, changes: dict[str, Any]):
    with pytest.raises(UserError, match="refit_scales needs a dG-VAE to start from, and not only_spread; pass --init"):
        config(tmp_path, tmp_path, refit_scales=True, **changes)
