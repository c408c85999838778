"""Kinds of perturbations to which reactions are measured: who is perturbed, how, and whose reaction counts.

On roads with lanes the simulator says who follows whom. Leaders and bystanders brake by a given speed at once, after
which their drivers are free. Elsewhere (arenas, several learners) who reacts is found out by trying: what is called
*near* moves the receiver by more than the threshold of the causal labels, a *bystander* by less than a tenth of it.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from envs.readers.highway import is_highway_env
from envs.readers.highway_labels import LEADER, NO_EDGE, SceneLabels
from envs.rollouts.causal_labels import settings_for
from envs.rollouts.interventions import body_of, interventions_of, is_on_roads
from envs.rollouts.moving import moving_agents
from envs.rollouts.world import EgoWorld, World
from envs.simulators.highway_interventions import CHANGE_MPS
from envs.simulators.interventions import Intervention, Kind

STILL_M = 0.1
"""True shift below which a receiver on a road counts as not moved [m]."""
STILL_SHARE = 0.1
"""Share of the threshold below which a receiver elsewhere counts as not moved, and of the scale of velocities below
which a sender counts as at rest where braking takes all its speed."""

Role = Literal["leader", "ego", "aside", "any"]
Pair = tuple[int, int]
"""Ids of receiver and sender."""


@dataclass(frozen=True)
class Cell:
    """One kind of perturbation."""

    name: str
    """Name in tables."""
    role: Role
    """Who the sender is to the receiver: its leader; its leader, which is the ego; a car of another lane; any."""
    kind: Kind
    """What is done to the sender: brake or remove."""
    change_mps: float | None = None
    """Loss of speed at once [m/s], to rest at most; None takes the family's (8 m/s on roads, to rest in mpe2)."""
    moves: bool | None = None
    """Whether the receiver must truly move: beyond the threshold, or not at all; None takes all."""

    def intervention(self, sender: int, horizon_steps: int) -> Intervention:
        """Returns what is done to a sender: a change of speed at once, or absence beyond the horizon."""
        if self.kind == "remove":
            return Intervention(sender, "remove", horizon_steps + 1)
        return Intervention(sender, self.kind, 0, self.change_mps, at_once=True)


LEADER_CELL = Cell("leader brakes by 8 m/s", "leader", "brake", 8.0)
BYSTANDER_CELL = Cell("bystander brakes by 8 m/s", "aside", "brake", 8.0, moves=False)
ON_LANES = (
    LEADER_CELL,
    Cell("leader brakes by 3 m/s", "leader", "brake", 3.0),
    Cell("ego in front brakes by 5 m/s", "ego", "brake", 5.0),
    BYSTANDER_CELL,
    Cell("taken out", "any", "remove", moves=True),
)
"""Cells where the simulator has lanes and leaders."""
NEAR_CELL = Cell("near one brakes", "any", "brake", moves=True)
STILL_CELL = Cell("bystander brakes", "any", "brake", moves=False)
ELSEWHERE = (NEAR_CELL, STILL_CELL, Cell("taken out", "any", "remove", moves=True))
"""Cells elsewhere."""
FALSE_BESIDE = {BYSTANDER_CELL.name: LEADER_CELL.name, STILL_CELL.name: NEAR_CELL.name}
"""Cell of bystanders → cell whose predicted shift theirs is compared with."""


def cells_of(world: World) -> tuple[Cell, ...]:
    """Returns the cells that are measured in a world."""
    return ON_LANES if isinstance(world, EgoWorld) and is_highway_env(world.env) else ELSEWHERE


def is_moved_as_asked(cell: Cell, world: World, shift_m: Float[np.ndarray, "horizon axes"]) -> bool:
    """Returns whether the receiver's true shift is what the cell asks for, at its farthest over the horizon."""
    threshold_m = settings_for(world).threshold_m
    farthest_m = float(np.linalg.norm(shift_m, axis=-1).max())
    if cell.moves is None:
        return True
    if cell.moves:
        return farthest_m > threshold_m
    return farthest_m < (STILL_M if cell.role == "aside" else STILL_SHARE * threshold_m)


def pairs_of(cell: Cell, world: World) -> list[Pair]:
    """Returns all pairs of receiver and sender that a cell allows now, before anything is tried.

    Both are perceived and within the distance of the causal labels (`CausalSettings.near_m`); no receiver is the ego,
    whose future is its policy's choice; senders that brake lose at least half of what they are asked to lose, and are
    not near rest already where that is all their speed.
    """
    scene, spec = world.perceived(), world.spec
    settings, labels = settings_for(world), world.labels()
    place = {int(agent): i for i, agent in enumerate(world.full_scene().ids)}
    moving = [int(i) for i in np.flatnonzero(moving_agents(scene, spec))]
    busy = interventions_of(world)
    speeds = np.linalg.norm(scene.states[:, spec.position_dim : 2 * spec.position_dim], axis=-1)
    slowest = _least_speed(cell, world)
    found = []
    for sender in moving:
        if speeds[sender] < slowest or int(scene.ids[sender]) in busy:
            continue
        is_ego = spec.has_ego and sender == 0
        if is_ego != (cell.role == "ego"):
            continue
        for receiver in moving:
            apart = scene.states[receiver, : spec.position_dim] - scene.states[sender, : spec.position_dim]
            if receiver == sender or (spec.has_ego and receiver == 0) or np.linalg.norm(apart) > settings.near_m:
                continue
            pair = int(scene.ids[receiver]), int(scene.ids[sender])
            if _fits(cell.role, world, pair, labels, place):
                found.append(pair)
    return found


def _least_speed(cell: Cell, world: World) -> float:
    """Returns the speed [m/s] below which a sender's braking would be next to nothing."""
    if cell.kind != "brake":
        return 0.0
    if cell.change_mps is not None or is_on_roads(world):
        return (cell.change_mps or CHANGE_MPS["brake"]) / 2
    return STILL_SHARE * world.spec.feature_scales[world.spec.position_dim]


def _fits(role: Role, world: World, pair: Pair, labels: SceneLabels | None, place: dict[int, int]) -> bool:
    """Returns whether the sender is to the receiver what the role says."""
    if role == "any":
        return True
    assert labels is not None
    edge = labels.edge_types[place[pair[0]], place[pair[1]]]
    if role == "aside":
        return bool(edge == NO_EDGE) and _is_on_another_lane(world, pair)
    return bool(edge == LEADER)


def _is_on_another_lane(world: World, pair: Pair) -> bool:
    """Returns whether the sender is on another lane than the receiver, and beside that lane's extension too."""
    receiver, sender = (body_of(world, agent) for agent in pair)
    along_m, aside_m = receiver.lane.local_coordinates(sender.position)
    return sender.lane_index != receiver.lane_index and abs(aside_m) > receiver.lane.width_at(along_m) / 2
