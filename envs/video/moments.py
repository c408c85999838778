"""What a film shows of all agents of a PettingZoo environment at one policy step: positions, forecasts, edges."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from envs.parallel import ForecastParallelEnv
from envs.video.roles import named_role, unnamed_role

_AT_REST_MPS = 1e-3


@dataclass(frozen=True)
class Body:
    """Agent at one policy step."""

    now_m: Float[np.ndarray, "2"]
    """Position."""
    tick: Float[np.ndarray, "2"]
    """Unit vector along its heading, or its velocity where agents have no heading; zeros at rest."""
    radius_m: float
    """Radius; 0 where scenes have none."""
    role: str
    """Role, which sets the colour."""
    forecast_m: Float[np.ndarray, "samples horizon 2"]
    """Forecast positions."""
    shares: Float[np.ndarray, " samples"]
    """Probability of each sample."""
    acts: float
    """Probability that it acts on the focus agent."""


@dataclass(frozen=True)
class Moment:
    """All agents at one policy step."""

    bodies: dict[int, Body]
    """Agents, by id."""
    returns: dict[str, float]
    """Mean return so far of each role's agents."""


def bodies_now(
    env: ForecastParallelEnv, focus: int | None, names: Mapping[int, str], num_samples: int
) -> dict[int, Body]:
    """Returns all agents of the present scene, by id.

    Args:
        env: the environment, after a reset or a step.
        focus: index in the scene of the agent whose incoming edges count; None if it is not there.
        names: names of the agents that have one, by id.
        num_samples: number of futures of each agent.
    """
    scene, spec = env.scene, env.scene_spec
    has_as_many = env.forecast.xy.shape[1] == num_samples
    forecast = env.forecast if has_as_many else env.pictured(num_samples)
    states = scene.scene.states
    xy_m = forecast.xy[0].double().cpu().numpy().swapaxes(0, 1)
    shares = forecast.sample_probs()[0].double().cpu().numpy().T
    probs = 1 - forecast.edge_probs[0, :, :, 0].double().cpu().numpy()  # receiver first
    has_heading = bool(scene.heading_rad.any())
    sizes = spec.feature_names.index("radius_m") if "radius_m" in spec.feature_names else None
    bodies = {}
    for i in np.flatnonzero(scene.scene.valid):
        key = int(scene.scene.ids[i])
        bodies[key] = Body(
            now_m=states[i, :2].copy(),
            tick=_tick(states[i, 2:4], float(scene.heading_rad[i]) if has_heading else None),
            radius_m=0.0 if sizes is None else float(states[i, sizes]),
            role=named_role(names[key]) if key in names else unnamed_role(states[i], spec),
            forecast_m=xy_m[i],
            shares=shares[i],
            acts=0.0 if focus is None else float(probs[focus, i]),
        )
    return bodies


def _tick(velocity_mps: Float[np.ndarray, "2"], heading_rad: float | None) -> Float[np.ndarray, "2"]:
    """Returns the unit vector along the heading; without one, along the velocity, zeros at rest."""
    if heading_rad is not None:
        return np.array([np.cos(heading_rad), np.sin(heading_rad)])
    speed_mps = float(np.hypot(*velocity_mps))
    return velocity_mps / speed_mps if speed_mps > _AT_REST_MPS else np.zeros(2)
