"""Leaders and followers in highway-env, read from the drivers themselves: labels for training and for scores.

A vehicle driven by the intelligent driver model (IDM) brakes for the vehicle in front of it on its lane, and while it
changes lane for the one on the lane it changes to as well. Those are its leaders. highway-env's linear drivers, and the
mixed ones of `envs.simulators.mixed_traffic`, react to the same vehicles. A perception system could not know this (nor
the driver's parameters), so labels never enter an observation; scenes are read in `envs.readers.highway`.

Only the longitudinal driving is labelled. A lane change also weighs the gaps on the other lane, for one frame.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import gymnasium as gym
import numpy as np
from highway_env.vehicle.behavior import AggressiveVehicle, DefensiveVehicle, IDMVehicle, LinearVehicle
from highway_env.vehicle.objects import RoadObject
from jaxtyping import Float, Int

from envs.readers.highway import vehicles_of
from envs.simulators.mixed_traffic import DRIVER_KINDS, MixedDriver
from predictor.data.store import Episode
from predictor.scene import Scene

UNKNOWN, NO_EDGE, LEADER = -1, 0, 1
"""Edge types: not known, the sender does not lead the receiver, the sender leads the receiver."""
ATTRIBUTE_NAMES = ("time_gap_s", "desired_time_gap_s", "headway_m", "desired_speed_mps", "driver_kind")
"""Attributes of a leader edge: headway over the receiver's speed [s]; the driver's own TIME_WANTED [s]; distance
between centres along the receiver's lane, as its driver measures it [m] (`leaders_of`); `desired_speed_mps`;
`driver_kind`."""
OTHER_KIND = -1
"""Kind of a driver by a law that is not in `envs.simulators.mixed_traffic.DRIVER_KINDS`."""
_LINEAR_KINDS = {
    AggressiveVehicle: DRIVER_KINDS.index("aggressive"),
    DefensiveVehicle: DRIVER_KINDS.index("defensive"),
}
MAX_TIME_GAP_S = 10.0
"""Largest time gap of a label [s]; longer ones, and that of a receiver at rest, are set to it."""


@dataclass(frozen=True)
class SceneLabels:
    """Edges at one instant, agents in the order of `HighwayReader.read_all`."""

    edge_types: Int[np.ndarray, "agents agents"]
    """int8, receiver first: LEADER, NO_EDGE or UNKNOWN. Unknown are the edges to an agent without an IDM driver (the
    ego), those of an agent with itself, and all but the leaders of one that yields to another by a crossing's rules.
    """
    edge_attributes: Float[np.ndarray, "agents agents attributes"]
    """float32, named in `ATTRIBUTE_NAMES`; zeros without a leader edge."""
    ahead: int | None = None
    """Index of the vehicle next ahead of the only ego on its lane; None if there is none, or several egos."""


def read_labels(env: gym.Env) -> SceneLabels:
    """Returns the edges between the vehicles on the road; changes nothing in the simulation.

    Obstacles are no agents: a vehicle that follows one has no leader, since a driver does not react to what is beyond.
    """
    vehicles = vehicles_of(env)
    index = {vehicle: i for i, vehicle in enumerate(vehicles)}
    controlled = env.unwrapped.controlled_vehicles  # type: ignore[attr-defined]
    types = np.full((len(vehicles), len(vehicles)), UNKNOWN, dtype=np.int8)
    attributes = np.zeros((*types.shape, len(ATTRIBUTE_NAMES)), dtype=np.float32)
    for receiver, vehicle in enumerate(vehicles):
        if not isinstance(vehicle, IDMVehicle) or vehicle in controlled:
            continue
        if not getattr(vehicle, "is_yielding", False):
            types[receiver] = NO_EDGE
        for leader, headway_m in leaders_of(vehicle).items():
            if leader in index:
                time_gap_s = min(headway_m / max(vehicle.speed, 1e-6), MAX_TIME_GAP_S)
                types[receiver, index[leader]] = LEADER
                driver = vehicle.TIME_WANTED, headway_m, desired_speed_mps(vehicle), driver_kind(vehicle)
                attributes[receiver, index[leader]] = time_gap_s, *driver
    np.fill_diagonal(types, UNKNOWN)
    ahead = None
    if len(controlled) == 1:
        ahead = index.get(controlled[0].road.neighbour_vehicles(controlled[0], controlled[0].lane_index)[0])
    return SceneLabels(types, attributes, ahead)


def leaders_of(vehicle: IDMVehicle) -> dict[RoadObject, float]:
    """Returns the vehicles that the driver brakes for, on its lane and on the one it changes to, with headways [m].

    IDM reacts to its leader at any distance; a linear driver only to one that is slower, or nearer than its wished gap.
    A driver that has crashed does not react. The headway is the driver's own: its lane is extended straight past its
    end, and the sign is lost in a square. Where the lane bends it is therefore less than the distance along the road;
    and drivers that leave intersection-v2 brake for oncoming ones, since highway-env takes the two lanes for connected.
    """
    if vehicle.crashed:
        return {}
    found: dict[RoadObject, float] = {}
    for lane_index in dict.fromkeys((vehicle.lane_index, vehicle.target_lane_index)):
        leader, _ = vehicle.road.neighbour_vehicles(vehicle, lane_index)
        if leader is not None:
            found[leader] = abs(float(vehicle.lane_distance_to(leader)))
    return found


def driver_kind(vehicle: IDMVehicle) -> int:
    """Returns the index of the driver's law in `envs.simulators.mixed_traffic.DRIVER_KINDS`, or OTHER_KIND."""
    if isinstance(vehicle, MixedDriver):
        return DRIVER_KINDS.index(vehicle.traits.kind)
    if isinstance(vehicle, LinearVehicle):
        return _LINEAR_KINDS.get(type(vehicle), OTHER_KIND)
    return DRIVER_KINDS.index("idm")


def desired_speed_mps(vehicle: IDMVehicle) -> float:
    """Returns the speed that the driver would keep on a free road now: 0 while it yields; IDM keeps to lane limits."""
    limit_mps = vehicle.lane.speed_limit if driver_kind(vehicle) == DRIVER_KINDS.index("idm") else None
    return float(vehicle.target_speed if limit_mps is None else np.clip(vehicle.target_speed, 0, limit_mps))


def with_labels(episode: Episode, scenes: Sequence[Scene], labels: Sequence[SceneLabels]) -> Episode:
    """Returns the episode with the labels of its scenes, moved from the scenes' order to the episode's columns."""
    column = {int(agent): i for i, agent in enumerate(episode.ids)}
    types = np.full((*episode.valid.shape, len(column)), UNKNOWN, dtype=np.int8)
    attributes = np.zeros((*types.shape, len(ATTRIBUTE_NAMES)), dtype=np.float32)
    for t, (scene, label) in enumerate(zip(scenes, labels, strict=True)):
        columns = np.array([column[int(agent)] for agent in scene.ids])
        types[t, columns[:, None], columns] = label.edge_types
        attributes[t, columns[:, None], columns] = label.edge_attributes
    return replace(episode, edge_types=types, edge_attributes=attributes)
