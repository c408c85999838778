"""Roles of agents in films: from an agent's name, or from a flag among its features."""

import numpy as np
from jaxtyping import Float

from envs.readers.base import role_of
from predictor.scene import SceneSpec

LANDMARK = "landmark"
"""Role of landmarks: drawn below all agents, without forecast."""
OTHER = "other"
"""Role of agents without a name or flag."""


def named_role(name: str) -> str:
    """Returns the role of a named agent: its name without the number."""
    role = role_of(name)
    return OTHER if role.isdigit() else role


def unnamed_role(state: Float[np.ndarray, " features"], spec: SceneSpec) -> str:
    """Returns the first flag that is set among the constant features ("landmark", "evader")."""
    flags = [name for name in spec.constant_features if not name.endswith("_m")]
    return next((name for name in flags if state[spec.feature_names.index(name)] == 1.0), OTHER)


def mean_by_role(returns: dict[str, float]) -> dict[str, float]:
    """Returns the mean return of each role's agents."""
    grouped: dict[str, list[float]] = {}
    for name, value in returns.items():
        grouped.setdefault(named_role(name), []).append(value)
    return {role: float(np.mean(values)) for role, values in grouped.items()}
