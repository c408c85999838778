"""Tells agents that move from landmarks, which stand in scenes but are never measured."""

import numpy as np
from jaxtyping import Bool

from predictor.evaluation.outcomes import LANDMARK
from predictor.scene import Scene, SceneSpec


def moving_agents(scene: Scene, spec: SceneSpec) -> Bool[np.ndarray, " agents"]:
    """Returns which entries of a scene hold an agent that is no landmark."""
    if LANDMARK not in spec.feature_names:
        return scene.valid
    return scene.valid & (scene.states[:, spec.feature_names.index(LANDMARK)] == 0)
