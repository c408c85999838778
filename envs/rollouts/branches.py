"""Branches of a running world: what happens with an intervention, beside what happens without.

The world is copied, so that it continues as if this had not been asked. Both branches have the same driver and random
streams: at each step, the branch with the intervention gets the state that the streams had in the branch without. So
what differs follows from the intervention. Streams that agents of a PettingZoo environment have of their own are
copied, and drawn from at each step alike.

>>> from envs.rollouts.branches import branch
>>> from envs.rollouts.world import open_world
>>> from envs.simulators.interventions import Intervention
>>> world = open_world("highway-fast-v0", "idle")
>>> world.reset(seed=0)
>>> found = branch(world, Intervention(agent=1, kind="brake", steps=3, change_mps=8.0), horizon_steps=3)
>>> shift_m, valid = found.shift()
>>> shift_m.shape == (4, len(found.ids), 2) and bool(shift_m[3, 1, 0] < -5.0)
True
"""

from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import Any

import numpy as np
from highway_env.envs.common.abstract import AbstractEnv
from jaxtyping import Bool, Float, Int

from envs.rollouts.interventions import body_of, hold_others, intervene, kinds_of, knows_bodies
from envs.rollouts.world import EgoWorld, World, open_to_look
from envs.simulators.copies import running_copy
from envs.simulators.interventions import Intervention, log_motion, simulator_of
from predictor.scene import Scene
from predictor.support.errors import UserError


@dataclass(frozen=True)
class Branch:
    """What happened in one branch; agents as in `Branches.ids`."""

    states: Float[np.ndarray, "time agents state"]
    """True states, world frame, SI units; step 0 is now (after a change of speed at once), zeros where not valid."""
    valid: Bool[np.ndarray, "time agents"]
    """Whether the agent is present; False after an episode's end where the environment cannot go on."""
    perceived: tuple[Scene, ...]
    """What forecasters get at each step; fewer scenes where the environment cannot go on."""
    crashed: frozenset[int] = frozenset()
    """Ids of the agents that have crashed by the end; none where the simulator knows no crash."""
    cut: bool = False
    """Whether the ego's time limit ended the branch before its last step, so that nobody knows what follows."""


@dataclass(frozen=True)
class Branches:
    """States of the steps that follow one moment, with and without an intervention."""

    intervention: Intervention
    """What was done in the perturbed branch."""
    ids: Int[np.ndarray, " agents"]
    """Agents that are present now, without the intervention, in the order of `World.full_scene`; those that appear
    later are left out, for their ids need not mean the same agent in both branches."""
    plain: Branch
    """Branch without the intervention."""
    perturbed: Branch
    """Branch with it."""
    axes: int = 2
    """Number of coordinates of a position."""

    def shift(self) -> tuple[Float[np.ndarray, "time agents axes"], Bool[np.ndarray, "time agents"]]:
        """Returns how far the intervention moved each agent [m], world frame, and where both branches have it."""
        valid = self.plain.valid & self.perturbed.valid
        moved = self.perturbed.states[..., : self.axes] - self.plain.states[..., : self.axes]
        return np.where(valid[..., None], moved, 0.0), valid

    def shift_of(self, agent: int) -> Float[np.ndarray, "horizon axes"] | None:
        """Returns one agent's shift at each step ahead [m]; None if one of the branches does not have it to the end."""
        shift_m, valid = self.shift()
        column = self.ids.tolist().index(agent)
        return shift_m[1:, column] if valid[:, column].all() else None

    @property
    def crashed(self) -> frozenset[int]:
        """Ids of the agents that have crashed by the end of one of the branches."""
        return self.plain.crashed | self.perturbed.crashed


def branch(world: World, intervention: Intervention, horizon_steps: int) -> Branches:
    """Plays the next steps with and without an intervention, in copies of the world.

    Args:
        world: a running world; it is not changed.
        intervention: what is done now.
        horizon_steps: number of steps to play.

    Raises:
        UserError: the environment cannot be copied or perturbed, or the agent does not allow the intervention.
    """
    return BranchPoint(world, horizon_steps).perturbed(intervention)


class BranchPoint:
    """One moment of a running world, from which any number of interventions are played; the plain branch once.

    Args:
        world: a running world; it is not changed, and must not step before the last branch has been played.
        horizon_steps: number of steps to play.
        perturbs: whether interventions will be played; other drivers need copies alone.

    Raises:
        UserError: the environment cannot be copied or perturbed.
    """

    def __init__(self, world: World, horizon_steps: int, *, perturbs: bool = True) -> None:
        """Plays the plain branch."""
        if horizon_steps < 1:
            raise UserError(f"horizon_steps must be at least 1, got {horizon_steps}")
        if perturbs:
            kinds_of(world)
        self._world, self._horizon = world, horizon_steps
        self.ids = world.full_scene().ids.copy()
        other = copied(world)
        self._log = log_motion(other.env) if perturbs else None
        self.plain, self._streams = _play(other, self.ids, horizon_steps)

    def perturbed(self, intervention: Intervention) -> Branches:
        """Plays an intervention; all agents may react.

        Raises:
            UserError: the agent does not allow it.
        """
        return self._branches(copied(self._world), intervention)

    def driven(self, driver: Callable[[Any], Any]) -> Branch:
        """Plays the moment with another driver of the ego, and without an intervention.

        Args:
            driver: function from the ego's observation to its action.

        Raises:
            UserError: the environment has no ego.
        """
        other = copied(self._world)
        if not isinstance(other, EgoWorld):
            raise UserError("another driver of the ego needs an environment with one ego, this one has several agents")
        other.hand_over(driver)
        return _play(other, self.ids, self._horizon, self._streams)[0]

    def direct(self, intervention: Intervention, receiver: int) -> Branches:
        """Plays an intervention to which one agent alone may react: all others move as without it.

        So its shift is what reaches it directly, not through a third agent. The others' shifts are 0, but for the
        agent of the intervention.

        Args:
            intervention: what is done.
            receiver: id of the agent that may react.

        Raises:
            UserError: the agent does not allow it.
        """
        assert self._log is not None, "interventions need BranchPoint(perturbs=True)"
        other = copied(self._world)
        hold_others(other, self._log, (intervention.agent, receiver))
        return self._branches(other, intervention)

    def _branches(self, other: World, intervention: Intervention) -> Branches:
        intervene(other, intervention)
        perturbed, _ = _play(other, self.ids, self._horizon, self._streams)
        return Branches(intervention, self.ids, self.plain, perturbed, self._world.spec.position_dim)


def check_can_branch(env_id: str, driver: str, env_kwargs: str = "") -> None:
    """Checks that agents of an environment can be perturbed in copies of it.

    Raises:
        UserError: they cannot, or the environment or the driver is unknown.
    """
    with closing(open_to_look(env_id, driver, env_kwargs)) as world:
        kinds_of(world)


def copied(world: World) -> World:
    """Returns a copy that continues exactly; it shares the road network, which no step changes.

    Raises:
        UserError: the environment cannot be copied (EnvPool).
    """
    return running_copy(world, simulator_of(world.env))


def _play(
    world: World, ids: Int[np.ndarray, " agents"], horizon_steps: int, streams: Sequence[list[Any]] = ()
) -> tuple[Branch, list[list[Any]]]:
    """Plays a copy; returns also the state of its random streams before each step.

    Args:
        world: the copy.
        ids: agents to report.
        horizon_steps: number of steps.
        streams: states that the streams get before each step, if given.
    """
    states = np.zeros((horizon_steps + 1, len(ids), world.spec.num_features))
    valid = np.zeros(states.shape[:2], dtype=np.bool_)
    index = {int(agent): i for i, agent in enumerate(ids)}
    seen: list[Scene] = []
    drawn: list[list[Any]] = []

    def note(step: int, perceived: Scene, full: Scene) -> None:
        seen.append(perceived)
        for agent, state in zip(full.ids, full.states, strict=True):
            if (column := index.get(int(agent))) is not None:
                states[step, column], valid[step, column] = state, True

    note(0, *world.reread())
    # highway-env simulates on after the end of an episode of its ego
    goes_on = isinstance(simulator_of(world.env), AbstractEnv) and world.spec.has_ego
    for step in range(horizon_steps):
        if step < len(streams):
            for generator, state in zip(world.generators(), streams[step], strict=True):
                generator.bit_generator.state = state
        drawn.append([generator.bit_generator.state for generator in world.generators()])
        ended = world.step()
        note(step + 1, world.perceived(), world.full_scene())
        if ended and not goes_on:
            break
    cut = len(seen) <= horizon_steps and isinstance(world, EgoWorld) and world.cut
    return Branch(states, valid, tuple(seen), _crashed(world, ids), cut), drawn


def _crashed(world: World, ids: Int[np.ndarray, " agents"]) -> frozenset[int]:
    """Returns the agents that have crashed; where the reader knows no bodies, the ego if the infos said so."""
    if not knows_bodies(world):
        return frozenset(ids[:1].tolist() if isinstance(world, EgoWorld) and world.crashed else ())
    bodies = ((int(agent), body_of(world, int(agent))) for agent in ids)
    return frozenset(agent for agent, body in bodies if getattr(body, "crashed", False))
