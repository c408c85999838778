import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from predictor.baselines.mlp import MLP, MLPConfig
from predictor.card import CardConfig, write_card
from predictor.checkpoint import CheckpointInfo, save_checkpoint
from predictor.data.store import StoreInfo, write_store
from predictor.evaluation.in_env_record import read_record
from predictor.support.errors import UserError
from tests.predictor.helpers import circling_episode, model, spec, write_circles

ROW: dict[str, Any] = {
    "checkpoint": "toy",
    "env_id": "toy-v0",
    "driver": "idle",
    "model": {"min_ade_m": 1.254, "min_fde_m": 2.5},
    "model_samples": {
        "min_ade_m": 0.75,
        "min_joint_ade_m": 0.875,
        "energy_m": 0.5,
        "overlap": 0.125,
        "true_overlap": 0.0,
    },
    "constant_velocity": {"min_ade_m": 5.0, "min_fde_m": 9.0},
    "reduction": 0.75,
    "reduction_interval": [0.5, 0.875],
}
RESULTS = {
    "config": {"seed": 10000, "episodes": 40, "num_samples": 20},
    "provenance": {"command": "python -m envs.evaluate --all"},
}
MADE = {
    "command": "python -m predictor.train --data a",
    "commit": "abc",
    "versions": {"torch": "2.13.0"},
    "train_config": {"seed": 3},
    "result": {"step": 500, "val_energy_m": 0.5, "val_ade_m": 0.75, "val_constant_velocity_ade_m": 1.5},
}


@pytest.fixture
def config(tmp_path: Path) -> CardConfig:
    forecaster = model()
    info = CheckpointInfo(forecaster.spec, forecaster.config, 3, (1.0,) * 3, ("circles",), MADE)
    save_checkpoint(tmp_path / "toy", forecaster, info)
    (tmp_path / "accuracy.json").write_text(json.dumps(RESULTS | {"results": [ROW | {"checkpoint": "other"}, ROW]}))
    return CardConfig(tmp_path / "toy", (write_circles(tmp_path / "data"),), tmp_path / "accuracy.json")


def test_card_says_what_the_files_say(config: CardConfig):
    path = write_card(config)
    text = path.read_text()
    assert path == config.checkpoint / "README.md"
    assert text.startswith("# Predictor checkpoint `toy`\n")
    assert [line for line in text.splitlines() if line.startswith("| toy-v0")] == [
        "| toy-v0 | idle | 40 | 20 | 1.25 / 2.50 | 0.750 | – | 5.00 / 9.00 | 75 % (50 to 88) |",
        "| toy-v0 | 20 | dG-VAE | 0.750 | 0.875 | 0.500 | – | 12.5 (0.0) % |",
    ]
    (measured,) = read_record(config.checkpoint)
    assert (measured.env_id, measured.min_ade_m, measured.below_cv_interval) == ("toy-v0", 1.254, (0.5, 0.875))
    for fact in (
        "forecasts 3 steps of 1 s",
        "Held-out seeds from 10,000; the ego itself is not counted",
        "* circles: 6 episodes, 60 scenes.",
        "* toy-v0: `python -m envs.evaluate --all`, commit not recorded",
        "`python -m predictor.train --data a`",
        "Seed 3, commit abc, torch 2.13.0.",
        "step 500: energy score 0.500 m, ADE 0.750 m against 1.500 m of constant velocity",
    ):
        assert fact in text


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "is not an accuracy.json of envs.evaluate"),
        ('{"rows": []}', r"is not an accuracy.json of envs.evaluate \('results'\)"),
        (json.dumps(RESULTS | {"results": [ROW | {"checkpoint": "other"}]}), "has no result of checkpoint 'toy'"),
    ],
    ids=["broken", "foreign", "another_checkpoint"],
)
def test_card_without_its_accuracy_is_refused(config: CardConfig, content: Any, message: str):
    config.accuracy.write_text(content)
    with pytest.raises(UserError, match=message):
        write_card(config)
    assert_nothing_is_written(config)


@pytest.mark.parametrize(
    ("changes", "shown"),
    [
        ({"model": {"min_ade_m": "abc", "min_fde_m": 2.5}}, "min_ade_m must be a number, got 'abc'"),
        ({"driver": 5}, "driver must be a text, got 5"),
        ({"reduction_interval": [1]}, "below_cv_interval must have 2 entries, got 1"),
        ({"model_samples": ROW["model_samples"] | {"coverage": ["a"]}}, r"coverage\[0\] must be a number, got 'a'"),
    ],
)
def test_figures_of_another_type_are_refused(config: CardConfig, changes: dict[str, Any], shown: str):
    config.accuracy.write_text(json.dumps(RESULTS | {"results": [ROW | changes]}))
    with pytest.raises(UserError, match=f"is not an accuracy.json of envs.evaluate .*{shown}"):
        write_card(config)
    assert_nothing_is_written(config)


def test_a_share_of_overlaps_that_was_not_measured_is_left_out(config: CardConfig):
    samples = ROW["model_samples"] | {"overlap": None}
    config.accuracy.write_text(json.dumps(RESULTS | {"results": [ROW | {"model_samples": samples}]}))
    assert "| toy-v0 | 20 | dG-VAE | 0.750 | 0.875 | 0.500 | – | – |" in write_card(config).read_text()


def test_card_without_its_stores_is_refused(config: CardConfig, tmp_path: Path):
    """Nothing is written: a new record beside an old card would contradict it."""
    with pytest.raises(UserError, match="no episode store at .*nowhere"):
        write_card(replace(config, data=(config.checkpoint / "nowhere",)))
    write_store(tmp_path / "other", StoreInfo(spec(), "another road"), [circling_episode(0)])
    for data, got in (((tmp_path / "other",), "other has another road"), ((), "none")):
        with pytest.raises(UserError, match=f"data are the stores that 'toy' was trained on .*got .*{got}"):
            write_card(replace(config, data=data))
    assert_nothing_is_written(config)


def test_card_with_some_of_its_stores_is_refused(config: CardConfig):
    info = CheckpointInfo(model().spec, model().config, 3, (1.0,) * 3, ("circles", "another road"), MADE)
    save_checkpoint(config.checkpoint, model(), info)
    with pytest.raises(UserError, match=r"was trained on \(circles, another road\), got circles"):
        write_card(config)
    assert_nothing_is_written(config)


def test_card_of_a_checkpoint_that_was_not_trained_is_refused(config: CardConfig):
    save_checkpoint(config.checkpoint, model(), CheckpointInfo(model().spec, model().config, 3))
    with pytest.raises(UserError, match="checkpoint 'toy' does not say how it was trained; write cards of checkpoints"):
        write_card(config)
    assert_nothing_is_written(config)


def test_card_says_which_model_it_is(config: CardConfig):
    info = CheckpointInfo(spec(), MLPConfig(), 3, (1.0,) * 3, ("circles",), MADE, model="mlp")
    assert "\ndG-VAE, " in write_card(config).read_text()
    save_checkpoint(config.checkpoint, MLP(spec(), MLPConfig(), 3), info)
    assert "\nMLP, " in write_card(config).read_text()


def test_card_says_how_the_spread_was_trained(config: CardConfig):
    result = {"step": 300, "val_mixture_nll": -0.256}
    command = "python -m predictor.train --init toy --only-spread"
    told = {"command": command, "commit": "def", "train_config": {"seed": 4}, "result": result}
    forecaster = model()
    info = CheckpointInfo(forecaster.spec, forecaster.config, 3, (1.0,) * 3, ("circles",), MADE | {"spread": told})
    assert "spread of its modes was then" not in write_card(config).read_text()
    save_checkpoint(config.checkpoint, forecaster, info)
    text = write_card(config).read_text()
    assert (
        "Seed 3, commit abc" in text and "alone, which moves no forecast: `python -m predictor.train --init toy" in text
    )
    assert (
        "--only-spread`, seed 4, commit def. Best validation at step 300: negative log-likelihood -0.26 nats." in text
    )


def assert_nothing_is_written(config: CardConfig) -> None:
    assert sorted(path.name for path in config.checkpoint.iterdir()) == ["config.json", "model.safetensors"]
