"""Hyperparameters for each algorithm and environment, as frozen dataclasses.

They start from highway-env's own training scripts (``scripts/sb3_highway_ppo.py``, ``sb3_highway_dqn.py``,
``sb3_racetracks_ppo.py``); where a value differs, the field says why.
"""

from dataclasses import dataclass, replace
from typing import Literal

from agents.task import Backend
from envs.registry import is_multiagent_id

Algorithm = Literal["ppo", "dqn"]


@dataclass(frozen=True)
class PPOPreset:
    """Hyperparameters of proximal policy optimisation (PPO)."""

    n_steps: int = 128
    """Number of steps per environment between updates."""
    batch_size: int = 64
    """Number of samples per gradient step."""
    n_epochs: int = 10
    """Number of passes over each rollout."""
    learning_rate: float = 5e-4
    """Adam's step size."""
    gamma: float = 0.8
    """Discount per policy step; on a highway, what counts happens within a few seconds."""
    gae_lambda: float = 0.95
    """Bias-variance trade-off of the advantages; SB3's default."""
    ent_coef: float = 0.0
    """Weight of the entropy bonus; SB3's default."""
    net_arch: tuple[int, ...] = (256, 256)
    """Sizes of the hidden layers, equal for actor and critic."""


@dataclass(frozen=True)
class DQNPreset:
    """Hyperparameters of deep Q-learning (DQN)."""

    learning_rate: float = 5e-4
    """Adam's step size."""
    buffer_size: int = 15_000
    """Number of transitions kept."""
    learning_starts: int = 200
    """Number of random transitions before the first update."""
    batch_size: int = 32
    """Number of samples per gradient step."""
    gamma: float = 0.8
    """Discount per policy step."""
    train_freq: int = 1
    """Number of vector steps between updates."""
    gradient_steps: int = -1
    """Number of gradient steps per update; -1 makes one per collected transition (the scripts: 1, for one env)."""
    target_update_interval: int = 50
    """Number of transitions between copies to the target network."""
    exploration_fraction: float = 0.7
    """Share of the training over which the exploration rate falls."""
    exploration_final_eps: float = 0.05
    """Exploration rate at the end; SB3's default."""
    net_arch: tuple[int, ...] = (256, 256)
    """Sizes of the hidden layers of the Q network."""


Preset = PPOPreset | DQNPreset

PRESETS: dict[Algorithm, Preset] = {"ppo": PPOPreset(), "dqn": DQNPreset()}
"""Algorithm → its preset where `preset_for` has no other."""
# Racetracks step five times as often, so the same foresight needs a longer discount (their script: 0.9).
_FIVE_HZ_GAMMA = 0.9


# Many EnvPool environments give large rollouts: larger batches keep the gradient steps per sample near a tenth of
# those of one environment.
_ENVPOOL_PPO = PPOPreset(n_steps=32, batch_size=512, n_epochs=5)
# Episodes of the particle world have 25 steps of 0.1 s; rewards are dense.
_PARTICLES = PPOPreset(n_steps=100, batch_size=300, n_epochs=8, learning_rate=7e-4, gamma=0.95, ent_coef=0.01)


def preset_for(env_id: str, algorithm: Algorithm, backend: Backend = "gymnasium") -> Preset:
    """Returns the preset of an algorithm that fits an env id and a backend."""
    if algorithm == "ppo" and is_multiagent_id(env_id):
        return _PARTICLES
    if algorithm == "ppo" and backend == "envpool":
        gamma = _FIVE_HZ_GAMMA if env_id.startswith("racetrack") else _ENVPOOL_PPO.gamma
        return replace(_ENVPOOL_PPO, gamma=gamma)
    preset = PRESETS[algorithm]
    return replace(preset, gamma=_FIVE_HZ_GAMMA) if env_id.startswith("racetrack") else preset
