"""Tiny specs, models and scenes that the predictor's tests share."""

from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from predictor.baselines.dnri import DNRIConfig
from predictor.baselines.imma import IMMAConfig
from predictor.baselines.lstm import LSTMConfig
from predictor.baselines.mlp import MLPConfig
from predictor.data.store import Episode, StoreInfo, write_store
from predictor.dgvae import DGVAE
from predictor.dgvae.config import DGVAEConfig
from predictor.models import build
from predictor.scene import PADDING_ID, AxisFrame, Scene, SceneBatch, SceneSpec

WORLD: tuple[AxisFrame, AxisFrame] = ("world", "world")
ROAD: tuple[AxisFrame, AxisFrame] = ("ego", "world")

# Every width differs from every other, so that an axis in the wrong place cannot fit by chance.
FAST_LIKE = DGVAEConfig(
    hidden_dim=9,
    rnn_dim=5,
    head_dim=8,
    message_dim=11,
    decoder_dim=13,
    edge_feature_dim=6,
    residual="constant_velocity",
)
PAPER_LIKE = replace(FAST_LIKE, hidden_dim=12, rnn_dim=7, head_dim=17, message_dim=10, decoder_dim=15, residual="state")
# Everything that the paper does not have, at once.
RICH = replace(
    FAST_LIKE,
    residual="trapezoid",
    change_scales=(3.0, 3.0, 2.0, 2.0),
    forget_bias=1.0,
    innovation_rounds=2,
    innovation_dim=4,
    static_dim=3,
    substeps=2,
    gated_messages=True,
    geometry_scales=(2.0, 1.5),
)
# An edge of each agent to itself, with types that are its futures; every other option that fits, too.
PLURAL = replace(
    FAST_LIKE,
    num_modes=4,
    spread_by_type=True,
    rollout_graph="frozen",
    change_scales=(3.0, 3.0, 2.0, 2.0),
    static_dim=2,
    geometry_scales=(2.0, 1.5),
)
SIZES = {"fast": FAST_LIKE, "paper": PAPER_LIKE, "rich": RICH, "plural": PLURAL}
# Every kind of trainable forecaster: its name in `predictor.models`, and a small config.
EVERY_MODEL: dict[str, tuple[str, Any]] = {
    "dgvae": ("dgvae", FAST_LIKE),
    "dgvae-rich": ("dgvae", RICH),
    "dgvae-symmetric": ("dgvae", replace(FAST_LIKE, symmetric_types=True, num_edge_types=3)),
    "dgvae-window": ("dgvae", replace(RICH, pair_matching="window", hard_samples=True, num_edge_types=3)),
    "dgvae-plural": ("dgvae", PLURAL),
    "dgvae-plural-rich": ("dgvae", replace(RICH, num_modes=3, rollout_graph="frozen")),
    "dnri": ("dnri", DNRIConfig(hidden_dim=9, rnn_dim=5, head_dim=8, decoder_dim=13, message_dim=11)),
    "imma": ("imma", IMMAConfig(hidden_dim=9, rnn_dim=5, decoder_dim=13, message_dim=11)),
    "imma-dynamic": (
        "imma",
        IMMAConfig(hidden_dim=9, rnn_dim=5, decoder_dim=13, message_dim=11, num_layers=3, dynamic_graph=True),
    ),
    "lstm": ("lstm", LSTMConfig(embed_dim=9, rnn_dim=5, residual="constant_velocity")),
    "lstm-joint": ("lstm", LSTMConfig(joint=True, embed_dim=9, rnn_dim=5)),
    "mlp": ("mlp", MLPConfig(hidden_dim=9, delta_scales=(0.1, 0.2, 0.3, 1 / 3))),
}


def spec(
    frame: tuple[AxisFrame, AxisFrame] = WORLD,
    has_ego: bool = True,
    max_agents: int = 4,
    perception_m: float = 100.0,
    dt_s: float = 1.0,
) -> SceneSpec:
    """Scales that make states of a few metres matter to a small untrained network."""
    scales = (10.0, 10.0, 5.0, 5.0)
    return SceneSpec(
        dt_s, frame, feature_scales=scales, has_ego=has_ego, max_agents=max_agents, perception_m=perception_m
    )


@torch.no_grad()
def enlarge(network: Any) -> None:
    """Makes fresh weights large enough for every path to leave a trace; those that begin at zero are drawn."""
    for parameter in network.parameters():
        parameter.mul_(1.7)
        if not parameter.any():
            parameter.normal_()


@cache
def model(
    size: Literal["fast", "paper", "rich", "plural"] = "fast",
    num_edge_types: int = 2,
    residual: Literal["state", "constant_velocity", "trapezoid"] | None = None,
    frame: tuple[AxisFrame, AxisFrame] = WORLD,
    has_ego: bool = True,
    horizon_steps: int = 3,
) -> DGVAE:
    """An untrained model in evaluation mode, with weights large enough for every path to leave a trace."""
    config = replace(SIZES[size], num_edge_types=num_edge_types)
    if residual is not None:
        config = replace(config, residual=residual)
    torch.manual_seed(7)
    made = DGVAE(spec(frame, has_ego), config, horizon_steps)
    enlarge(made)
    return made.eval().requires_grad_(False)


@cache
def precise(*args: Any, **kwargs: Any) -> DGVAE:
    """`model` in float64: a sum in another order then shows as 1e-13, and a leak as what it is."""
    return deepcopy(model(*args, **kwargs)).double()


@cache
def any_model(kind: str) -> Any:
    """One of `EVERY_MODEL`, untrained and in evaluation mode, with weights large enough to leave a trace."""
    name, config = EVERY_MODEL[kind]
    torch.manual_seed(7)
    made = build(name, spec(), config, horizon_steps=3)
    enlarge(made)
    return made.eval().requires_grad_(False)


def random_states(seed: int, *shape: int) -> Tensor:
    """States [SI] within ±20 m and ±10 m/s; the last axis of `shape` is the state's."""
    drawn = np.random.default_rng(seed).uniform(-1, 1, size=shape) * np.array([20.0, 20.0, 10.0, 10.0])
    return torch.from_numpy(drawn.astype(np.float32))


def random_presence(seed: int, *shape: int, ego: bool = True, share: float = 0.7) -> Tensor:
    """Who is present, at random; with `ego` agent 0 always is."""
    drawn = np.random.default_rng([seed, 1]).random(shape) < share
    if ego:
        drawn[..., 0] = True
    return torch.from_numpy(drawn)


def scene(agents: Mapping[int, Sequence[float]], size: int, order: Sequence[int] | None = None) -> Scene:
    """Returns a scene from id → state [SI].

    Args:
        agents: state of each present agent by its id.
        size: number of agents, padding included.
        order: id at each place (-1 for none); None takes the mapping's order, with padding at the end.
    """
    if order is None:
        order = list(agents)
    states, ids, valid = np.zeros((size, 4)), np.full(size, PADDING_ID), np.zeros(size, dtype=np.bool_)
    for place, agent in enumerate(order):
        if agent != PADDING_ID:
            states[place], ids[place], valid[place] = agents[agent], agent, True
    return Scene(states, ids, valid)


def batch(*scenes: Scene) -> SceneBatch:
    """Short for `SceneBatch.stack`."""
    return SceneBatch.stack(scenes)


def circling_episode(seed: int, steps: int = 10, agents: int = 2, turn_rad: float = 0.5) -> Episode:
    """Agents on circles: every velocity turns by `turn_rad` in each step of 1 s, so constant velocity is far off."""
    rng = np.random.default_rng(seed)
    angle = rng.uniform(0, 2 * np.pi, size=agents) + turn_rad * np.arange(steps)[:, None]
    speed_mps = rng.uniform(2, 5, size=agents)
    centre = rng.uniform(-5, 5, size=(agents, 2))
    radius_m = speed_mps / turn_rad
    states = np.zeros((steps, agents, 4), dtype=np.float32)
    states[..., 0] = centre[:, 0] + radius_m * np.sin(angle)
    states[..., 1] = centre[:, 1] - radius_m * np.cos(angle)
    states[..., 2] = speed_mps * np.cos(angle)
    states[..., 3] = speed_mps * np.sin(angle)
    return Episode(states, np.ones((steps, agents), dtype=np.bool_), np.arange(agents), "circle", seed)


def following_episode(seed: int) -> Episode:
    """Agent 1 takes over the ego's velocity after the first of three steps: unknowable without looking at the ego."""
    rng = np.random.default_rng(seed)
    velocity_mps, position_m = rng.uniform(-5, 5, size=(2, 2)), rng.uniform(-5, 5, size=(2, 2))
    states = np.zeros((3, 2, 4), dtype=np.float32)
    for t in range(3):
        states[t] = np.concatenate([position_m, velocity_mps], axis=-1)
        velocity_mps = np.stack([velocity_mps[0], velocity_mps[0]])
        position_m = position_m + velocity_mps
    return Episode(states, np.ones((3, 2), dtype=np.bool_), np.arange(2), "follow", seed)


def write_circles(path: Path, episodes: int = 6, **kwargs: int) -> Path:
    """A small store of circling agents."""
    write_store(path, StoreInfo(spec(), "circles"), [circling_episode(i, **kwargs) for i in range(episodes)])
    return path
