"""Hyperparameters that tuning varies, and their ranges; the preset of the environment is one point of them.

The sizes of the network are fixed but for a recurrent policy's memory; all arms of a study have one network. Whole
numbers that must fit each other are powers of two. Optuna, which draws from these ranges, is an optional package (extra
"tune").
"""

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

from agents.presets import Preset

if TYPE_CHECKING:
    from optuna.distributions import BaseDistribution


@dataclass(frozen=True)
class Range:
    """Numbers between two bounds, both included."""

    low: int | float
    """Lower bound."""
    high: int | float
    """Upper bound."""
    log: bool = False
    """Whether factors count, not differences."""


RANGES: dict[str, Range] = {
    "learning_rate": Range(5e-5, 5e-3, log=True),
    "gamma": Range(0.7, 0.995),
    "gae_lambda": Range(0.8, 1.0),
    "ent_coef": Range(0.0, 0.05),
    "n_epochs": Range(2, 20),
    "tau": Range(1e-3, 0.1, log=True),
    "target_update_interval": Range(20, 2000, log=True),
    "exploration_fraction": Range(0.1, 0.9),
    "exploration_final_eps": Range(0.01, 0.1),
    "top_quantiles_to_drop_per_net": Range(0, 5),
}
"""Hyperparameter → its range; whole numbers where those of the preset are."""
CHOICES: dict[str, tuple[int, ...]] = {
    "n_steps": (8, 16, 32, 64, 128, 256, 512),
    "batch_size": (32, 64, 128, 256, 512),
    "lstm_hidden_size": (32, 64, 128, 256),
}
"""Hyperparameter → its values; that of the preset is added."""


def tuned_names(preset: Preset) -> tuple[str, ...]:
    """Returns the hyperparameters of a preset that are varied; a text ("auto", SAC's ent_coef) is none of them."""
    return tuple(
        name for name, value in asdict(preset).items() if name in (*RANGES, *CHOICES) and not isinstance(value, str)
    )


def search_space(preset: Preset) -> "dict[str, BaseDistribution]":
    """Returns Optuna's distribution of each hyperparameter that is varied."""
    from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

    space: dict[str, BaseDistribution] = {}
    for name in tuned_names(preset):
        value = getattr(preset, name)
        if name in CHOICES:
            space[name] = CategoricalDistribution(sorted({*CHOICES[name], value}))
            continue
        found = RANGES[name]
        if isinstance(value, int):
            space[name] = IntDistribution(int(found.low), int(found.high), log=found.log)
        else:
            space[name] = FloatDistribution(found.low, found.high, log=found.log)
    return space
