"""Causal labels: whose future changes when an agent brakes or is taken out, by how much, and not through a third one.

At a step the world is branched (`envs.rollouts.branches`): for each sender, once it brakes over the whole horizon, once
it is taken out, where that is possible. Receivers that either moves by more than the threshold may have been reached
through others: a sender's follower brakes, and so its follower brakes. So each of them is played again, with all others
held to what they do without the intervention. The label is the farthest direct shift within the horizon [m]; of
receivers below the threshold already, the whole shift. Where a sender was not tried, the label is unknown, and so are
those of a receiver under an intervention, which its driver does not decide about.

What the ego does is its policy's choice, which no intervention in one episode tells apart from a habit. The labels of
what reaches the ego are therefore those of a driver of the simulator in its place (`envs.simulators.stand_in`): each
intervention is played once more with that driver, all others held to what they do beside it.

Edges are thus what one agent does to another at once. Chains follow from them, as in a model whose messages pass edge
by edge; labels that contained the chains would grow with the horizon and with the density of traffic.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np
from jaxtyping import Float

from envs.rollouts.branches import Branches, BranchPoint, copied
from envs.rollouts.interventions import intervene, interventions_of, is_on_roads, kinds_of
from envs.rollouts.world import World
from envs.simulators.interventions import Intervention, Kind, NotAllowedError
from envs.simulators.stand_in import seat_driver
from predictor.data.store import Episode

TRIED: tuple[Kind, ...] = ("brake", "remove")
"""What is done to a sender; a vehicle at rest can hold others up without braking, and a policy's cannot be removed."""


@dataclass(frozen=True)
class CausalSettings:
    """How causal labels are measured."""

    horizon_s: float
    """Time that branches are played [s]."""
    threshold_m: float
    """Shift above which an edge counts as causal [m]."""
    near_m: float
    """A sender has another agent within this distance [m]; others are not tried."""
    senders: int = 8
    """Largest number of senders at a step, nearest to the ego first; without an ego, nearest to another agent."""


ON_ROADS = CausalSettings(horizon_s=3.0, threshold_m=1.0, near_m=60.0)
"""Settings for highway-env."""
IN_ARENAS = CausalSettings(horizon_s=1.0, threshold_m=0.05, near_m=1.5)
"""Settings for mpe2, whose arena is 2 m wide."""


def settings_for(world: World) -> CausalSettings:
    """Returns the settings of the world's family.

    Raises:
        UserError: the world cannot be perturbed.
    """
    return ON_ROADS if is_on_roads(world) else IN_ARENAS


@dataclass(frozen=True)
class CausalLabels:
    """Causal labels at one instant."""

    ids: Sequence[int]
    """Agents, in the order of `World.full_scene`."""
    shift_m: Float[np.ndarray, "agents agents"]
    """float32, receiver first: farthest direct shift by an intervention on the sender [m]; NaN where unknown. The row
    of an ego is that of a driver in its place."""


def causal_labels(world: World, settings: CausalSettings) -> CausalLabels:
    """Measures the labels of a running world, which is not changed.

    Raises:
        UserError: the world cannot be copied or perturbed.
    """
    scene = world.full_scene()
    ids = [int(agent) for agent in scene.ids]
    shift_m = np.full((len(ids), len(ids)), np.nan, dtype=np.float32)
    steps = max(1, round(settings.horizon_s / world.spec.dt_s))
    tries = filter(None, (possible(world, sender, steps) for sender in _candidates(world, settings)))
    tried = [intervention for of_sender in islice(tries, settings.senders) for intervention in of_sender]
    point = BranchPoint(world, steps) if tried else None
    for intervention in tried:
        assert point is not None
        column = ids.index(intervention.agent)
        found = direct_shift_m(point, point.perturbed(intervention), settings.threshold_m)
        shift_m[:, column] = np.fmax(shift_m[:, column], found)
    if world.spec.has_ego:
        shift_m[0] = shift_in_place_of_ego_m(world, ids, tried, settings.threshold_m)
    shift_m[[ids.index(agent) for agent in interventions_of(world) if agent in ids]] = np.nan
    np.fill_diagonal(shift_m, np.nan)
    return CausalLabels(ids, shift_m)


def direct_shift_m(
    point: BranchPoint, found: Branches, threshold_m: float, steps: int | None = None
) -> Float[np.ndarray, " agents"]:
    """Computes how far an intervention moves each agent at most [m]; beyond the threshold, the direct shift alone.

    Args:
        point: the moment of the branches.
        found: what followed the intervention.
        threshold_m: shift above which an agent is played again, with all others held [m].
        steps: number of steps that count; None takes all that were played.
    """
    whole_m = farthest(found, threshold_m, steps)
    sender = found.intervention.agent
    for receiver in np.flatnonzero(whole_m > threshold_m):
        if point.ids[receiver] != sender:
            alone = point.direct(found.intervention, int(point.ids[receiver]))
            whole_m[receiver] = farthest(alone, threshold_m, steps)[receiver]
    return whole_m


def shift_in_place_of_ego_m(
    world: World, ids: Sequence[int], tried: Sequence[Intervention], threshold_m: float
) -> Float[np.ndarray, " agents"]:
    """Computes how far interventions on each agent move a driver of the simulator in the ego's place, directly [m].

    NaN for agents that are not tried, and everywhere where no such driver can take the place.

    Args:
        world: a running world with one ego; it is not changed.
        ids: agents, the ego first.
        tried: interventions of equal duration, which is the horizon.
        threshold_m: shift above which one counts that cannot be followed to the end [m].
    """
    shift_m = np.full(len(ids), np.nan)
    of_others = [intervention for intervention in tried if intervention.agent != ids[0]]
    if not of_others or not seat_driver((beside := copied(world)).env):
        return shift_m
    point = BranchPoint(beside, of_others[0].steps)
    for intervention in of_others:
        column = ids.index(intervention.agent)
        shift_m[column] = np.fmax(shift_m[column], farthest(point.direct(intervention, ids[0]), threshold_m)[0])
    return shift_m


def farthest(found: Branches, threshold_m: float, steps: int | None = None) -> Float[np.ndarray, " agents"]:
    """Returns each agent's farthest shift over the first steps [m]; None takes all.

    NaN for an agent that one branch does not have at each step, unless it has moved beyond the threshold before. Where
    the episode ends within these steps all are NaN: of nobody it is known whether it would have moved so far.
    """
    last = len(found.plain.valid) - 1 if steps is None else steps
    if not found.plain.valid[last].any():
        return np.full(found.plain.valid.shape[1], np.nan)
    shift, valid = (found_all[: None if steps is None else steps + 1] for found_all in found.shift())
    farthest_m = np.linalg.norm(shift, axis=-1).max(axis=0)
    return np.where(valid.all(axis=0) | (farthest_m > threshold_m), farthest_m, np.nan)


def senders_of(world: World, settings: CausalSettings) -> list[int]:
    """Returns the agents to try: perceived, with another one near, and under no intervention."""
    return list(islice((a for a in _candidates(world, settings) if possible(world, a, 1)), settings.senders))


def _candidates(world: World, settings: CausalSettings) -> list[int]:
    """Returns the agents to try as far as can be seen without trying, those to try first in front."""
    scene = world.perceived()
    ids, positions = scene.ids[scene.valid], scene.states[scene.valid, : world.spec.position_dim]
    apart = np.linalg.norm(positions[:, None] - positions[None], axis=-1)
    np.fill_diagonal(apart, np.inf)
    nearest = apart.min(axis=1) if len(ids) > 1 else np.full(len(ids), np.inf)
    order = range(len(ids)) if world.spec.has_ego else np.argsort(nearest, kind="stable")
    return [int(ids[i]) for i in order if nearest[i] <= settings.near_m]


def possible(world: World, agent: int, steps: int) -> list[Intervention]:
    """Returns what can be tried on an agent: nothing if it does not move by itself or is under an intervention.

    Raises:
        UserError: the world cannot be copied or perturbed.
    """
    kinds_of(world)
    found = []
    for kind in TRIED:
        intervention, beside = Intervention(agent, kind, steps), copied(world)
        try:
            intervene(beside, intervention)
        except NotAllowedError:
            continue
        found.append(intervention)
    return found


def with_causal_labels(episode: Episode, labels: Mapping[int, CausalLabels]) -> Episode:
    """Returns the episode with labels of some of its steps; all other steps are unknown (NaN)."""
    column = {int(agent): i for i, agent in enumerate(episode.ids)}
    shift_m = np.full((*episode.valid.shape, len(column)), np.nan, dtype=np.float32)
    for step, label in labels.items():
        columns = np.array([column[agent] for agent in label.ids])
        shift_m[step, columns[:, None], columns] = label.shift_m
    return replace(episode, causal_shift_m=shift_m)
