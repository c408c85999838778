"""Independent random streams from the seed of an episode.

Environments draw from `numpy.random.default_rng(seed)`: Gymnasium, PettingZoo and mpe2 make their generators so. A
driver whose generator had the same seed would draw the numbers that set the environment's start, and its hidden habits
could be inferred from the first scene. Each driver therefore draws from a child of the seed's `SeedSequence`. So do
random interventions, the choice of the steps that get causal labels, branches, what is perturbed to measure reactions,
the steps at which plans are played, and what is drawn anew there, whatever the number of drivers.
"""

from enum import IntEnum

import numpy as np


class Purpose(IntEnum):
    """What is drawn for an episode beside its drivers; the numbers of the children, of which drivers have the first."""

    PERTURBATIONS = 2**16
    """Random interventions."""
    LABELS = 2**16 + 1
    """Steps with causal labels."""
    BRANCHES = 2**16 + 2
    """Moments and interventions of branches."""
    REACTIONS = 2**16 + 3
    """Steps and agents at which reactions are measured."""
    PLANS = 2**16 + 4
    """Steps at which what-if forecasts are measured."""
    HIDDEN = 2**16 + 5
    """What no scene shows, drawn anew where what-if forecasts are measured."""


def episode_rng(seed: int, purpose: Purpose) -> np.random.Generator:
    """Returns the generator of one purpose in the episode of a seed."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(int(purpose),)))


def driver_rng(seed: int | None, group: int = 0) -> np.random.Generator:
    """Returns the generator of the drivers of an episode, independent of the environment's own.

    Args:
        seed: seed that the environment is reset with; None draws a fresh one.
        group: number of the group of drivers; groups of one episode (partners, stand-ins of learners) draw
            independently.
    """
    return np.random.default_rng(np.random.SeedSequence(seed).spawn(group + 1)[group])


def reseed(generator: np.random.Generator, rng: np.random.Generator) -> None:
    """Lets a generator, wherever it is held, go on with numbers that another one draws."""
    generator.bit_generator.state = np.random.default_rng(rng.integers(2**63)).bit_generator.state
