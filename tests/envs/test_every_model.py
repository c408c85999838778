"""Every trainable forecaster can be put into an observation, not the dG-VAE alone."""

from pathlib import Path

import numpy as np
import pytest
import torch

from envs.readers import reader_for
from envs.registry import make_env
from envs.wrappers import ForecastObservation
from predictor.checkpoint import CheckpointInfo, save_checkpoint
from predictor.models import build, configure

SMALL = {
    "dgvae": ("hidden_dim=4", "rnn_dim=4", "head_dim=4", "message_dim=4", "decoder_dim=4", "edge_feature_dim=3"),
    "dvae": ("hidden_dim=4", "rnn_dim=4", "head_dim=4", "message_dim=4", "decoder_dim=4", "edge_feature_dim=0"),
    "dnri": ("hidden_dim=4", "rnn_dim=4", "head_dim=4", "message_dim=4", "decoder_dim=4", "num_edge_types=3"),
    "imma": ("hidden_dim=4", "rnn_dim=4", "message_dim=4", "decoder_dim=4"),
    "lstm": ("embed_dim=4", "rnn_dim=4"),
    "lstm-joint": ("embed_dim=4", "rnn_dim=4", "joint=true"),
    "mlp": ("hidden_dim=4",),
}


@pytest.mark.parametrize("kind", list(SMALL))
def test_wrapped(kind: str, tmp_path: Path):
    env = make_env("highway-fast-v0")
    spec = reader_for(env).spec
    name = {"dvae": "dgvae", "lstm-joint": "lstm"}.get(kind, kind)
    torch.manual_seed(0)
    config = configure(name, "paper", SMALL[kind])
    model = build(name, spec, config, 2)
    save_checkpoint(tmp_path / kind, model, CheckpointInfo(spec, config, 2, sources=("test",), model=name))
    wrapped = ForecastObservation(env, str(tmp_path / kind), num_samples=2)
    obs, _ = wrapped.reset(seed=0)
    for _ in range(3):
        assert wrapped.observation_space.contains(obs)
        assert all(np.isfinite(value).all() for value in obs.values())
        obs, *_ = wrapped.step(1)
    assert obs["forecast"].any()
    wrapped.close()
