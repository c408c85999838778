"""The fork: each agent turns left or right by a coin, so the truth of the modes is known."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from predictor.data.store import Episode, StoreInfo, write_store
from predictor.forecaster import Futures
from predictor.scene import SceneSpec
from predictor.training.config import TrainConfig
from predictor.training.trainer import Trainer
from predictor.training.training_data import load_data

BEFORE, AFTER, AGENTS, MODES = 3, 4, 3, 20
SPEC = SceneSpec(dt_s=1.0, feature_scales=(30.0, 30.0, 5.0, 5.0), has_ego=False, max_agents=AGENTS)
SIZES = ("hidden_dim=32", "rnn_dim=16", "head_dim=32", "message_dim=32", "decoder_dim=48")


def episode(rng: np.random.Generator) -> Episode:
    """Three agents side by side, each of which turns by 60 degrees within two steps, after the last observed one."""
    side, speed = rng.choice([-1, 1], AGENTS), rng.uniform(1.5, 2.5, AGENTS)
    position = np.stack([rng.uniform(-2, 2, AGENTS), 20.0 * np.arange(AGENTS)], axis=-1)
    heading, states = np.zeros(AGENTS), []
    for t in range(BEFORE + AFTER):
        velocity = speed[:, None] * np.stack([np.cos(heading), np.sin(heading)], axis=-1)
        states.append(np.concatenate([position, velocity], axis=-1))
        position = position + velocity
        if BEFORE - 1 <= t <= BEFORE:
            heading = heading + side * np.pi / 6
    joined = np.stack(states).astype(np.float32)
    return Episode(joined, np.ones(joined.shape[:2], dtype=np.bool_), np.arange(AGENTS))


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    rng = np.random.default_rng(0)
    path = tmp_path_factory.mktemp("fork") / "store"
    write_store(path, StoreInfo(SPEC, "fork"), [episode(rng) for _ in range(600)])
    return path


@cache
def forecast(store: Path, modes: int) -> tuple[Futures, Tensor, Tensor]:
    """Trains on the fork; returns futures of test scenes just before it, true positions and the last observed ones."""
    config = TrainConfig(
        data=(store,),
        out=store.parent / "run",
        preset="plural" if modes else "fast",
        set=(*SIZES, f"num_modes={modes}"),
        input_changes=False,
        fit_inputs=False,
        edge_geometry=False,
        steps=450,
        batch_size=32,
        lr=4e-3,
        history_steps=BEFORE,
        horizon_steps=AFTER,
        device="cpu",
    )
    trainer = Trainer(config, load_data(config))
    while not trainer.finished:
        trainer.train_step()
    model, rng = trainer.model.eval(), np.random.default_rng(1)
    states = torch.from_numpy(np.stack([episode(rng).states for _ in range(200)]))
    memory, valid = model.empty_memory(len(states), AGENTS), torch.ones(len(states), AGENTS).bool()
    with torch.no_grad():
        for t in range(BEFORE):
            memory, belief = model.observe(memory, states[:, t], valid)
        futures = model.rollout(belief, AFTER, MODES, torch.Generator().manual_seed(0))
    return futures, states[:, BEFORE:, :, :2].transpose(1, 2), states[:, BEFORE - 1, :, :2]


def left(futures: Futures, last: Tensor) -> Tensor:
    """Returns which samples end to the left of where the agent was; shape (scenes, samples, agents)."""
    return futures.states[..., -1, 1] > last[:, None, :, 1]


def error_m(futures: Futures, truth: Tensor) -> Tensor:
    """Returns the displacement error of each sample, shape (scenes, samples, agents)."""
    return torch.linalg.vector_norm(futures.states[..., :2] - truth[:, None], dim=-1).mean(-1)


@pytest.mark.slow
def test_every_agent_has_both_turns_in_their_true_shares(store: Path):
    futures, truth, last = forecast(store, MODES)
    turns = left(futures, last)
    assert turns.any(1).all() and (~turns).any(1).all()
    assert futures.mode_probs is not None
    share = (futures.mode_probs * turns).sum(1)
    assert (share - 0.5).abs().max() < 0.1
    assert error_m(futures, truth).min(1).values.mean() < 0.3


@pytest.mark.slow
def test_the_single_forecast_does_not_pay_for_the_modes(store: Path):
    plural, collapsed = (error_m(*forecast(store, modes)[:2])[:, 0].mean() for modes in (MODES, 0))
    assert plural < 1.02 * collapsed
    futures, _, last = forecast(store, 0)
    turns = left(futures, last)
    assert not (turns.any(1) & (~turns).any(1)).float().mean() > 0.1  # without modes the samples are copies
