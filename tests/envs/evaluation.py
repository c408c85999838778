"""What the tests of the evaluation in live environments share: a small checkpoint for mpe2, and a clean slate."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from envs.readers import multiagent_reader_for
from envs.registry import make_multiagent_env
from envs.rollouts import episode as live
from envs.rollouts import reactions
from envs.rollouts.kept_world import close_kept_world
from envs.rollouts.side_forecasts import kept_forecaster
from envs.rollouts.workers import EpisodePool
from predictor.checkpoint import CheckpointInfo, save_checkpoint
from predictor.dgvae import DGVAE
from predictor.scene import SceneSpec
from tests.envs.helpers import HORIZON, SIZES

TAG = "simple_tag_v3"
TAG_CHANGES = (0.1, 0.1, 0.5, 0.5, 1.0, 1.0, 1.0)
"""Typical change per step of each feature of mpe2's scenes."""


def tag_spec() -> SceneSpec:
    """Scenes of simple_tag_v3."""
    return multiagent_reader_for(make_multiagent_env(TAG)).spec


def save_tag(path: Path, has_ego: bool = False, **changes: Any) -> str:
    """A small dG-VAE with random weights for simple_tag_v3, as it is or as trained around an ego."""
    spec, sizes = replace(tag_spec(), has_ego=has_ego), replace(SIZES, delta_scales=TAG_CHANGES, **changes)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        model = DGVAE(spec, sizes, HORIZON)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.mul_(2.0)
    save_checkpoint(path, model.eval(), CheckpointInfo(spec, sizes, HORIZON))
    return str(path)


def forget() -> None:
    """Drop what `envs.rollouts` keeps from episode to episode: nothing of one test may serve in another."""
    for kept in (
        live._kept_controls,
        live._kept_ablations,
        reactions._kept_neighbours,
        kept_forecaster,
    ):
        kept.cache_clear()
    close_kept_world()


def no_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lets pools play their episodes here: a process of its own takes seconds to start."""
    monkeypatch.setattr(EpisodePool, "play", lambda pool, tasks: map(pool._play, tasks))


def read_json(path: Path) -> Any:
    """Strictly: a reader other than Python's knows no NaN."""

    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} is not JSON")

    return json.loads(path.read_text(), parse_constant=refuse)
