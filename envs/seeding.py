"""Independent random streams from the seed of an episode.

Environments draw from `numpy.random.default_rng(seed)`: Gymnasium, PettingZoo and mpe2 make their generators so. A
driver whose generator had the same seed would draw the numbers that set the environment's start, and its hidden habits
could be inferred from the first scene. Each driver therefore draws from a child of the seed's `SeedSequence`.
"""

import numpy as np


def driver_rng(seed: int | None, group: int = 0) -> np.random.Generator:
    """Returns the generator of the drivers of an episode, independent of the environment's own.

    Args:
        seed: seed that the environment is reset with; None draws a fresh one.
        group: number of the group of drivers; groups of one episode (partners, stand-ins of learners) draw
            independently.
    """
    return np.random.default_rng(np.random.SeedSequence(seed).spawn(group + 1)[group])
