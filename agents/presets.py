"""Hyperparameters for each algorithm and environment, as frozen dataclasses.

They start from highway-env's own training scripts (``scripts/sb3_highway_ppo.py``, ``sb3_highway_dqn.py``,
``sb3_racetracks_ppo.py``), those of algorithms without a script from the defaults of Stable-Baselines3 and sb3-contrib;
where a value differs, the field says why. `agents.preset_settings` changes them from command lines and files.
"""

from dataclasses import asdict, dataclass, replace
from typing import Any, Literal, get_args

from agents.task import Backend
from envs.readers.mpe import MPE_IDS
from envs.registry import is_foreign_id, is_multiagent_id
from envs.sb3.algorithms import Algorithm
from predictor.support.config_checks import (
    MOST_WIDTH,
    check_at_least,
    check_at_most,
    check_choice,
    check_choices,
    check_positive,
)
from predictor.support.errors import UserError
from predictor.support.memory import check_memory

_COUNTS = (
    *("n_steps", "batch_size", "n_epochs", "buffer_size", "train_freq", "target_update_interval", "net_arch"),
    *("lstm_hidden_size", "n_lstm_layers", "n_quantiles", "n_critics"),
)
_AMOUNTS = ("learning_starts", "ent_coef", "top_quantiles_to_drop_per_net", "gamma", "gae_lambda", "vf_coef")
_POSITIVE = ("learning_rate", "tau", "exploration_fraction", "target_kl")
_WIDTHS = ("net_arch", "lstm_hidden_size", "n_quantiles")
_LAYERS = ("n_critics", "n_lstm_layers")
MOST_LAYERS = 1_000
"""Largest number of networks, and of layers, beside each other or one behind the other."""
_KEPT = ("n_steps", "buffer_size", "batch_size")
STEP_BYTES = 32
"""Least memory of a step that is kept: an observation of one number, action, reward, value and end."""
_SHARES = ("gamma", "gae_lambda", "tau", "exploration_fraction", "exploration_final_eps")


@dataclass(frozen=True)
class Preset:
    """Hyperparameters that every algorithm has."""

    learning_rate: float = 5e-4
    """Step size of the optimiser."""
    gamma: float = 0.8
    """Discount per policy step; on a highway, what counts happens within a few seconds. Environments that are neither
    highway-env's nor listed here get 0.99, SB3's default."""
    net_arch: tuple[int, ...] = (256, 256)
    """Sizes of the hidden layers, equal for actor and critic."""

    def __post_init__(self) -> None:
        """Checks ranges.

        Raises:
            UserError: a value is out of range.
        """
        names = asdict(self)
        check_choices(self)
        check_at_least(self, 1, *(name for name in _COUNTS if name in names))
        check_at_least(self, 0, *(name for name in _AMOUNTS if name in names and not isinstance(names[name], str)))
        check_positive(self, *(name for name in _POSITIVE if name in names))
        check_at_most(self, MOST_WIDTH, *(name for name in _WIDTHS if name in names))
        check_at_most(self, MOST_LAYERS, *(name for name in _LAYERS if name in names))
        for name in _KEPT:
            kept = names.get(name, 0)
            check_memory(kept * STEP_BYTES, f"{name}={kept:,}", f"choose a smaller {name}")
        for name in _SHARES:
            if name in names and not 0 <= names[name] <= 1:
                raise UserError(f"{name} must lie in [0, 1], got {names[name]}")

    @property
    def of_policy(self) -> dict[str, Any]:
        """Values that are arguments of SB3's policy network, not of the algorithm."""
        return {"net_arch": list(self.net_arch)}


@dataclass(frozen=True)
class OnPolicyPreset(Preset):
    """Hyperparameters that every algorithm has that learns from its latest steps alone."""

    n_steps: int = 128
    """Number of steps per environment between updates."""
    gae_lambda: float = 0.95
    """Bias-variance trade-off of the advantages; SB3's default."""
    ent_coef: float = 0.0
    """Weight of the entropy bonus; SB3's default."""
    vf_coef: float = 0.5
    """Weight of the critic's loss, which grows with the square of the returns; SB3's default."""

    @property
    def of_policy(self) -> dict[str, Any]:
        """Values that are arguments of SB3's policy network, not of the algorithm."""
        return {"net_arch": {"pi": list(self.net_arch), "vf": list(self.net_arch)}}


@dataclass(frozen=True)
class PPOPreset(OnPolicyPreset):
    """Hyperparameters of proximal policy optimisation (PPO)."""

    batch_size: int = 64
    """Number of samples per gradient step; few environments give smaller batches."""
    n_epochs: int = 10
    """Number of passes over each rollout."""
    target_kl: float | None = None
    """Passes end where the policy has moved 1.5 times this far (KL divergence); None sets no bound."""

    def __post_init__(self) -> None:
        """Checks ranges; advantages are normalised over a batch, which therefore needs two samples."""
        super().__post_init__()
        check_at_least(self, 2, "n_steps", "batch_size")


@dataclass(frozen=True)
class RecurrentPPOPreset(PPOPreset):
    """Hyperparameters of PPO with an LSTM behind the features extractor; the others are those of PPO."""

    lstm_hidden_size: int = 128
    """Number of units of the actor's and of the critic's LSTM: about as many as the features extractor has outputs
    (sb3-contrib: 256)."""
    n_lstm_layers: int = 1
    """Number of layers of each LSTM; the default of sb3-contrib."""

    @property
    def of_policy(self) -> dict[str, Any]:
        """Values that are arguments of SB3's policy network, not of the algorithm."""
        lstm = {"lstm_hidden_size": self.lstm_hidden_size, "n_lstm_layers": self.n_lstm_layers}
        return super().of_policy | lstm


@dataclass(frozen=True)
class A2CPreset(OnPolicyPreset):
    """Hyperparameters of advantage actor-critic (A2C)."""

    learning_rate: float = 7e-4
    """Step size of the optimiser, RMSprop; SB3's default."""
    n_steps: int = 5
    """Number of steps per environment between updates; SB3's default."""
    gae_lambda: float = 1.0
    """Bias-variance trade-off of the advantages; 1 is the full return, SB3's default."""


@dataclass(frozen=True)
class OffPolicyPreset(Preset):
    """Hyperparameters that every algorithm with a replay buffer has."""

    buffer_size: int = 15_000
    """Number of transitions kept."""
    learning_starts: int = 200
    """Number of environment steps with random actions before the first update."""
    batch_size: int = 32
    """Number of samples per gradient step."""
    train_freq: int = 1
    """Number of vector steps between updates."""
    gradient_steps: int = -1
    """Number of gradient steps per update; -1 makes one per collected transition (the scripts: 1, for one env)."""

    def __post_init__(self) -> None:
        """Checks ranges."""
        super().__post_init__()
        if self.gradient_steps < 1 and self.gradient_steps != -1:
            raise UserError(f"gradient_steps must be -1 or at least 1, got {self.gradient_steps}")


@dataclass(frozen=True)
class DQNPreset(OffPolicyPreset):
    """Hyperparameters of deep Q-learning (DQN)."""

    target_update_interval: int = 50
    """Number of transitions between copies to the target network."""
    exploration_fraction: float = 0.7
    """Share of the training over which the exploration rate falls."""
    exploration_final_eps: float = 0.05
    """Exploration rate at the end; SB3's default."""


@dataclass(frozen=True)
class QRDQNPreset(DQNPreset):
    """Hyperparameters of DQN with a distribution of returns (QR-DQN); the others are those of DQN."""

    n_quantiles: int = 200
    """Number of quantiles of each action's return; the default of sb3-contrib."""

    @property
    def of_policy(self) -> dict[str, Any]:
        """Values that are arguments of SB3's policy network, not of the algorithm."""
        return super().of_policy | {"n_quantiles": self.n_quantiles}


@dataclass(frozen=True)
class SACPreset(OffPolicyPreset):
    """Hyperparameters of soft actor-critic (SAC), for continuous actions."""

    learning_rate: float = 3e-4
    """Adam's step size; SB3's default."""
    buffer_size: int = 20_000
    """Number of transitions kept: all of a training of the default length (SB3: 1,000,000). The buffer is part of every
    checkpoint, with 3 to 8 kB per transition with forecasts."""
    batch_size: int = 256
    """Number of samples per gradient step; SB3's default."""
    tau: float = 0.005
    """Share of the way that the target network goes to the critic at each update; SB3's default."""
    ent_coef: float | Literal["auto"] = "auto"
    """Weight of the entropy bonus; "auto" learns it, SB3's default."""


@dataclass(frozen=True)
class TQCPreset(SACPreset):
    """Hyperparameters of SAC with truncated quantile critics (TQC); the others are those of SAC."""

    n_quantiles: int = 25
    """Number of quantiles of each critic; the default of sb3-contrib."""
    n_critics: int = 2
    """Number of critics; the default of sb3-contrib."""
    top_quantiles_to_drop_per_net: int = 2
    """Number of highest quantiles left out of targets, for each critic; the default of sb3-contrib."""

    def __post_init__(self) -> None:
        """Checks ranges."""
        super().__post_init__()
        if self.top_quantiles_to_drop_per_net >= self.n_quantiles:
            raise UserError(
                f"top_quantiles_to_drop_per_net must be less than n_quantiles ({self.n_quantiles}), "
                f"got {self.top_quantiles_to_drop_per_net}"
            )

    @property
    def of_policy(self) -> dict[str, Any]:
        """Values that are arguments of SB3's policy network, not of the algorithm."""
        return super().of_policy | {"n_quantiles": self.n_quantiles, "n_critics": self.n_critics}


PRESETS: dict[Algorithm, Preset] = {
    "ppo": PPOPreset(),
    "dqn": DQNPreset(),
    "a2c": A2CPreset(),
    "sac": SACPreset(),
    "qrdqn": QRDQNPreset(),
    "recurrent-ppo": RecurrentPPOPreset(),
    "tqc": TQCPreset(),
}
"""Algorithm → its preset where `preset_for` has no other."""
# Racetracks step five times as often, so the same foresight needs a longer discount (their script: 0.9).
_FIVE_HZ_GAMMA = 0.9
# How long a step of another environment lasts is not known: 0.8 would be half a second at ten steps a second.
_UNKNOWN_GAMMA = 0.99


# Many EnvPool environments give large rollouts: larger batches keep the gradient steps per sample near a tenth of
# those of one environment.
_ENVPOOL_PPO = PPOPreset(n_steps=32, batch_size=512, n_epochs=5)
# Other agents' lives make returns noisy: a longer discount and an entropy bonus.
_MULTIAGENT = PPOPreset(n_steps=100, batch_size=300, n_epochs=8, learning_rate=7e-4, gamma=0.95, ent_coef=0.01)
# A rollout is one episode (25 steps of 0.1 s) of each copy. In simple_tag a touch pays 10 and most episodes have none;
# at SB3's weight the critic's loss is a hundred times the actor's, and clipping its gradient slows the actor.
_PARTICLES = PPOPreset(
    n_steps=25, batch_size=480, n_epochs=5, target_kl=0.01, learning_rate=1e-3, gamma=0.95, ent_coef=0.01,
    vf_coef=0.005, net_arch=(64, 64),
)  # fmt: skip


def preset_for(env_id: str, algorithm: Algorithm, backend: Backend = "gymnasium") -> Preset:
    """Returns the preset of an algorithm that fits an env id and a backend.

    Raises:
        UserError: there is no such algorithm, or no such backend.
    """
    check_choice("algorithm", algorithm, tuple(PRESETS))
    check_choice("backend", backend, get_args(Backend))
    preset = PRESETS[algorithm]
    if isinstance(preset, PPOPreset):
        if is_multiagent_id(env_id):
            return replace(preset, **asdict(_PARTICLES if env_id in MPE_IDS else _MULTIAGENT))
        if backend == "envpool":
            preset = replace(preset, **asdict(_ENVPOOL_PPO))
    if is_foreign_id(env_id):
        return replace(preset, gamma=_UNKNOWN_GAMMA)
    if is_multiagent_id(env_id):
        return replace(preset, gamma=_MULTIAGENT.gamma)
    is_racetrack = env_id.removeprefix("envpool/").lower().startswith("racetrack")
    return replace(preset, gamma=_FIVE_HZ_GAMMA) if is_racetrack else preset
