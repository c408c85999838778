"""Interventions in a running world, by the ids that its reader reports.

>>> from envs.rollouts.interventions import intervene
>>> from envs.rollouts.world import open_world
>>> from envs.simulators.interventions import Intervention
>>> world = open_world("highway-fast-v0", "idle")
>>> world.reset(seed=0)
>>> before_mps = world.full_scene().states[1, 2]
>>> intervene(world, Intervention(agent=1, kind="brake", steps=2, change_mps=8.0))
>>> _ = world.step()
>>> bool(world.full_scene().states[1, 2] < before_mps - 5.0)
True
"""

from collections.abc import Sequence
from typing import Any

from envs.rollouts.world import World
from envs.simulators.held_agents import MotionLog
from envs.simulators.interventions import Intervention, Kind, NotAllowedError, hold, in_force, kinds_for, start
from predictor.support.errors import UserError


def intervene(world: World, intervention: Intervention) -> None:
    """Begins an intervention; it acts from the next step on, and a change of speed at once acts now.

    Raises:
        NotAllowedError: the agent does not allow it, or no such agent is present.
        UserError: the environment cannot be perturbed.
    """
    kinds_of(world)
    body = body_of(world, intervention.agent)
    if body is None:
        present = ", ".join(str(agent) for agent in sorted(world.full_scene().ids.tolist()))
        raise NotAllowedError(f"no agent {intervention.agent} is present; present are {present}")
    start(world.env, body, intervention)


def kinds_of(world: World) -> tuple[Kind, ...]:
    """Returns the kinds of interventions that a world allows.

    Raises:
        UserError: its environment cannot be perturbed, or its reader cannot find an agent by its id.
    """
    kinds = kinds_for(world.env)
    reader = _reader(world)
    if not knows_bodies(world):
        raise UserError(
            f"{type(reader).__name__} cannot find an agent by its id, so no intervention is possible; give it a method "
            "body_of(env, agent) that returns the simulator's object"
        )
    return kinds


def is_on_roads(world: World) -> bool:
    """Returns whether agents drive in lanes (highway-env); else they move freely at about 1 m/s (mpe2).

    Raises:
        UserError: see `kinds_of`.
    """
    return "left" in kinds_of(world)


def knows_bodies(world: World) -> bool:
    """Returns whether the world's reader can find the simulator's object of an agent."""
    return hasattr(_reader(world), "body_of")


def interventions_of(world: World) -> dict[int, Intervention]:
    """Returns the interventions that act on the next step, by agent."""
    return in_force(world.env)


def hold_others(world: World, log: MotionLog, free: Sequence[int]) -> None:
    """Holds all agents but some to the motion of another branch of the same moment.

    Args:
        world: a copy of the moment at which the log began.
        log: motion of the other branch (`envs.simulators.interventions.log_motion`).
        free: ids of the agents that move freely.
    """
    hold(world.env, log, [body_of(world, agent) for agent in free])


def body_of(world: World, agent: int) -> Any:
    """Returns the simulator's object of an agent; None if it is not present."""
    return _reader(world).body_of(world.env, agent)


def _reader(world: World) -> Any:
    """Returns the reader of the world's scenes."""
    return world.env.get_wrapper_attr("reader") if hasattr(world.env, "get_wrapper_attr") else world.env.reader
