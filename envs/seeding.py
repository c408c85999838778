"""Independent random streams from the seed of an episode.

Environments draw from `numpy.random.default_rng(seed)`: Gymnasium, PettingZoo and mpe2 make their generators so. A
driver whose generator had the same seed would draw the numbers that set the environment's start, and its hidden habits
could be inferred from the first scene. Each driver therefore draws from a child of the seed's `SeedSequence`. So do
random interventions, the choice of the steps that get causal labels, branches, what is perturbed to measure reactions,
and the steps at which plans are played, whatever the number of drivers.
"""

import numpy as np

_PERTURBATIONS, _LABELS, _BRANCHES, _REACTIONS, _PLANS = (2**16 + i for i in range(5))
"""Numbers of the children for what is not a driver; drivers have the first ones."""


def perturbation_rng(seed: int) -> np.random.Generator:
    """Returns the generator of an episode's random interventions."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(_PERTURBATIONS,)))


def label_rng(seed: int) -> np.random.Generator:
    """Returns the generator that chooses an episode's steps with causal labels."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(_LABELS,)))


def branch_rng(seed: int) -> np.random.Generator:
    """Returns the generator of the moments and interventions of an episode's branches."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(_BRANCHES,)))


def reaction_rng(seed: int) -> np.random.Generator:
    """Returns the generator that chooses an episode's steps and agents at which reactions are measured."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(_REACTIONS,)))


def plan_rng(seed: int) -> np.random.Generator:
    """Returns the generator that chooses an episode's steps at which what-if forecasts are measured."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(_PLANS,)))


def driver_rng(seed: int | None, group: int = 0) -> np.random.Generator:
    """Returns the generator of the drivers of an episode, independent of the environment's own.

    Args:
        seed: seed that the environment is reset with; None draws a fresh one.
        group: number of the group of drivers; groups of one episode (partners, stand-ins of learners) draw
            independently.
    """
    return np.random.default_rng(np.random.SeedSequence(seed).spawn(group + 1)[group])
