"""Interventions in mpe2: one agent's push, overridden in every step, or the agent taken out of the arena.

`ParticleInterventions` stands in the world's `step`. An agent that brakes pushes against its velocity, as hard as it
can or as the intervention says; one that accelerates pushes along it. An agent that is taken out is moved `AWAY_M`
away and marked as not alive, so that readers leave it out; the drivers and observations of the others still have it,
far away. It comes back where it was, with the velocity that it had, when its time is over and its place is free.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from envs.simulators.held_agents import HeldAgents, MotionLog
from envs.simulators.intervention import Intervention, NotAllowedError
from predictor.support.errors import UserError

MOTION = ("p_pos", "p_vel", "u")
"""Attributes of an agent's state and action that make up its motion in a step."""
CHANGE_MPS = {"brake": np.inf, "accelerate": 1.0}
"""Changes of speed where an intervention names none: brake to rest."""
AWAY_M = 100.0
"""Distance to where an agent is that is taken out; the arena is 2 m wide."""
RETURN_GAP_M = 0.02
"""Least free distance around an agent that comes back [m]."""
_DEFAULT_PUSH = 5.0  # mpe2's sensitivity where an agent has no `accel`


def intervene_on_particles(world: Any, body: Any, intervention: Intervention) -> None:
    """Begins an intervention on an agent of a running world.

    Raises:
        NotAllowedError: not an agent that moves, under an intervention already, or a lane change, since there are no
            lanes.
    """
    name = f"agent {intervention.agent}"
    if intervention.agent in particle_interventions(world):
        raise NotAllowedError(f"{name} is under an intervention already; let it end, or choose another agent")
    if intervention.kind in ("left", "right"):
        raise NotAllowedError(
            "mpe2's arenas have no lanes, so left and right are not possible; use brake or accelerate"
        )
    if not any(agent is body for agent in world.agents) or not body.movable or body.action_callback is not None:
        raise NotAllowedError(
            f"{name} ({body.name}) does not move by actions and cannot be perturbed; choose another agent"
        )
    begun = (_Absence if intervention.kind == "remove" else _Push)(world, body, intervention)
    if intervention.steps:
        _standing(world).running.append(begun)


def log_particles(world: Any) -> MotionLog:
    """Begins to log the motion of all agents, and returns the log."""
    standing = _standing(world)
    standing.log = MotionLog(_parts(world.agents), MOTION)
    return standing.log


def hold_particles(world: Any, log: MotionLog, free: Sequence[Any]) -> None:
    """Holds all agents but some to a log; called before any intervention.

    Raises:
        UserError: one of those is no agent that acts.
    """
    for body in free:
        if not any(body is agent for agent in world.agents):
            raise UserError(f"only agents that act can be free of a log, got {getattr(body, 'name', body)}")
    _standing(world).held = HeldAgents(_parts(world.agents), log, _parts(free))


def _parts(agents: Sequence[Any]) -> list[Any]:
    return [part for agent in agents for part in (agent.state, agent.action)]


def _standing(world: Any) -> "ParticleInterventions":
    """Returns what stands in the world's `step`; puts it there if nothing does."""
    if "step" not in world.__dict__:
        world.step = ParticleInterventions(world)
    found: ParticleInterventions = world.step
    return found


def particle_interventions(world: Any) -> dict[int, Intervention]:
    """Returns the interventions that act on the next step, by agent."""
    standing = world.__dict__.get("step")
    return {} if standing is None else {one.intervention.agent: one.intervention for one in standing.running}


def drop_from_particles(world: Any) -> None:
    """Ends all interventions without putting anything back: an episode begins, and the world is the same object."""
    for one in getattr(world.__dict__.get("step"), "running", ()):
        one.body.__dict__.pop("alive", None)
    world.__dict__.pop("step", None)


class ParticleInterventions:
    """Interventions that are in force in a world; called in place of `World.step`.

    Args:
        world: mpe2's world.
    """

    def __init__(self, world: Any) -> None:
        """Starts without interventions."""
        self.world = world
        self.running: list[_Push | _Absence] = []
        self.log: MotionLog | None = None
        self.held: HeldAgents | None = None

    def __call__(self) -> None:
        """Overrides actions, steps the world, and ends what is over."""
        if self.held is not None:
            self.held.place()
        for one in self.running:
            one.before()
        if self.log is not None:
            self.log.note(_parts(self.world.agents))
        type(self.world).step(self.world)
        for one in self.running:
            one.after()
            one.steps -= 1
        self.running = [one for one in self.running if one.steps > 0 or not one.end()]
        if not self.running and self.log is None and self.held is None:
            del self.world.step


class _Push:
    def __init__(self, world: Any, body: Any, intervention: Intervention) -> None:
        self.world, self.body, self.intervention = world, body, intervention
        self.steps = intervention.steps
        velocity = body.state.p_vel
        speed_mps = float(np.linalg.norm(velocity))
        change_mps = intervention.change_mps or CHANGE_MPS[intervention.kind]
        self._target_mps = max(speed_mps + intervention.sign * change_mps, 0.0)
        self._largest = body.accel or _DEFAULT_PUSH
        if intervention.rate_mps2 is not None:
            self._largest = intervention.rate_mps2 * body.mass
        if intervention.at_once:
            body.state.p_vel = self._direction() * self._target_mps

    def before(self) -> None:
        """Replaces the push by the one that brings the velocity closest to the wanted one."""
        velocity = self.body.state.p_vel
        missing = self._direction() * self._target_mps - velocity * (1 - self.world.damping)
        push = missing * self.body.mass / self.world.dt
        self.body.action.u = push * min(1.0, self._largest / max(float(np.linalg.norm(push)), 1e-9))

    def after(self) -> None:
        """Does nothing: the world has stepped."""

    def end(self) -> bool:
        """Leaves the agent to its driver."""
        return True

    def _direction(self) -> Float[np.ndarray, " axes"]:
        """Returns the direction of motion; at rest, of the agent's own push, or the first axis."""
        pushed = self.body.action.__dict__.get("_u")
        for vector in (self.body.state.p_vel, pushed):
            if vector is not None and (length := float(np.linalg.norm(vector))) > 1e-9:
                return np.asarray(vector / length, dtype=np.float64)
        return np.eye(self.world.dim_p)[0]


class _Absence:
    def __init__(self, world: Any, body: Any, intervention: Intervention) -> None:
        self.world, self.body, self.intervention = world, body, intervention
        self.steps = intervention.steps
        self._left = body.state.p_pos.copy(), body.state.p_vel.copy()
        self._away = body.state.p_pos + AWAY_M
        body.alive = False
        self.after()

    def before(self) -> None:
        """Takes the push away."""
        self.body.action.u = np.zeros(self.world.dim_p)

    def after(self) -> None:
        """Keeps the agent where it is out of the way."""
        self.body.state.p_pos = self._away.copy()
        self.body.state.p_vel = np.zeros(self.world.dim_p)

    def end(self) -> bool:
        """Puts the agent back if its place is free."""
        position, velocity = self._left
        for other in self.world.entities:
            least_m = other.size + self.body.size + RETURN_GAP_M
            solid = other is not self.body and other.collide and self.body.collide
            if solid and np.linalg.norm(other.state.p_pos - position) < least_m:
                return False
        self.body.state.p_pos, self.body.state.p_vel = position, velocity
        del self.body.alive
        return True
