"""Interventions in a running simulator: which families allow them, and what is done to one agent.

An intervention overrides the agent within the simulation; readers and recordings see only what follows from it. It
lives inside the simulator: `copy.deepcopy` and `pickle` of an environment carry it along. When its steps are over, the
agent's driver takes over again. `envs.rollouts.interventions` finds the agent by the id that readers report.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from highway_env.envs.common.abstract import AbstractEnv

from envs.simulators.held_agents import MotionLog
from envs.simulators.highway_interventions import hold_on_road, intervene_on_road, log_road, road_interventions
from envs.simulators.intervention import KINDS, Intervention, Kind, NotAllowedError
from envs.simulators.mpe_interventions import (
    drop_from_particles,
    hold_particles,
    intervene_on_particles,
    log_particles,
    particle_interventions,
)
from predictor.support.errors import UserError

__all__ = [
    "KINDS",
    "Intervention",
    "Kind",
    "NotAllowedError",
    "drop_all",
    "generator_of",
    "hold",
    "in_force",
    "kinds_for",
    "log_motion",
    "simulator_of",
    "start",
]


def simulator_of(env: Any) -> Any:
    """Returns what simulates behind an environment: highway-env's environment also where it has several learners."""
    inner = env.unwrapped
    return inner.highway.unwrapped if hasattr(inner, "highway") else inner


def kinds_for(env: Any) -> tuple[Kind, ...]:
    """Returns the kinds of interventions that an environment allows.

    Raises:
        UserError: its simulator cannot be perturbed.
    """
    simulator = simulator_of(env)
    if isinstance(simulator, AbstractEnv):
        return KINDS
    if _has_particles(simulator):
        return ("brake", "accelerate", "remove")
    name = type(simulator).__name__
    why = ": EnvPool's C++ simulator has no access to its agents" if name == "EnvPoolEnv" else ""
    raise UserError(f"{name} cannot be perturbed{why}; use an environment of highway-env, of this project, or mpe2")


def start(env: Any, body: Any, intervention: Intervention) -> None:
    """Begins an intervention on one agent, the simulator's own object.

    Raises:
        NotAllowedError: this agent does not allow it.
        UserError: no agent of this simulator does.
    """
    kinds_for(env)
    simulator = simulator_of(env)
    if isinstance(simulator, AbstractEnv):
        intervene_on_road(simulator, body, intervention)
    else:
        intervene_on_particles(simulator.world, body, intervention)


def in_force(env: Any) -> dict[int, Intervention]:
    """Returns the interventions that act on the next step, by agent; empty where none are possible."""
    simulator = simulator_of(env)
    if isinstance(simulator, AbstractEnv):
        return {} if simulator.road is None else road_interventions(simulator)
    return particle_interventions(simulator.world) if _has_particles(simulator) else {}


def log_motion(env: Any) -> MotionLog:
    """Begins to log the motion of all agents that are present, frame by frame, and returns the log.

    Raises:
        UserError: the simulator cannot be perturbed.
    """
    kinds_for(env)
    simulator = simulator_of(env)
    return log_road(simulator) if isinstance(simulator, AbstractEnv) else log_particles(simulator.world)


def hold(env: Any, log: MotionLog, free: Sequence[Any]) -> None:
    """Holds all agents but some to the motion of another branch; called at once after the copy.

    Args:
        env: a copy of the environment from the moment at which the log began.
        log: motion of the other branch.
        free: agents that move freely, the simulator's own objects.
    """
    simulator = simulator_of(env)
    if isinstance(simulator, AbstractEnv):
        hold_on_road(simulator, log, free)
    else:
        hold_particles(simulator.world, log, free)


def drop_all(env: Any) -> None:
    """Drops all interventions before a reset; needed where it keeps the simulated agents (mpe2)."""
    simulator = simulator_of(env)
    if _has_particles(simulator):
        drop_from_particles(simulator.world)


def generator_of(env: Any) -> np.random.Generator | None:
    """Returns the simulator's own random stream; None where it has none in NumPy."""
    found = getattr(simulator_of(env), "np_random", None)
    return found if isinstance(found, np.random.Generator) else None


def _has_particles(simulator: Any) -> bool:
    return any(cls.__module__.partition(".")[0] == "mpe2" for cls in type(simulator).__mro__)
