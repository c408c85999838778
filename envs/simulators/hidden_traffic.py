"""What no scene of highway-env shows of its traffic: where each vehicle is going, when its driver next looks aside.

Drawn anew, both give other traffic that looks the same now. What a driver wishes and how it decides is left as it is.
"""

import numpy as np
from highway_env.envs.common.abstract import AbstractEnv
from highway_env.envs.intersection_env import IntersectionEnv
from highway_env.envs.roundabout_env import RoundaboutEnv, RoundaboutGenericEnv
from highway_env.vehicle.behavior import IDMVehicle

EXITS = ("exr", "sxr", "nxr", "wxr")
"""Exits of a roundabout."""


def redraw_hidden(env: AbstractEnv, rng: np.random.Generator) -> None:
    """Draws anew where all drivers of the traffic are going, and when they may next begin a change of lane.

    Args:
        env: simulator, which is changed: a copy.
        rng: source of the numbers.
    """
    for vehicle in env.road.vehicles:
        if isinstance(vehicle, IDMVehicle):
            vehicle.timer = rng.uniform(0.0, vehicle.LANE_CHANGE_DELAY)
            if goals := possible_goals(env, vehicle):
                vehicle.plan_route_to(goals[rng.integers(len(goals))])


def possible_goals(env: AbstractEnv, vehicle: IDMVehicle) -> list[str]:
    """Returns the nodes that a vehicle may be going to, all equally likely; none where its lane tells its way.

    At a crossing a vehicle that has not entered it yet may leave by any other road. In a roundabout one may leave by
    any exit that the environment draws, but for the one that it has just driven past.
    """
    start, end = vehicle.lane_index[:2]
    if vehicle.target_lane_index[:2] != (start, end):  # it has chosen already
        return []
    if isinstance(env, IntersectionEnv):
        return [f"o{road}" for road in range(4) if f"o{road}" != start] if start.startswith("o") else []
    if not isinstance(env, RoundaboutEnv) or end.endswith(("xs", "xr")):
        return []
    exits = EXITS if isinstance(env, RoundaboutGenericEnv) else EXITS[:3]
    is_inside = len(start) == len(end) == 2
    passed = max(EXITS, key=lambda node: len(env.road.network.shortest_path(end, node))) if is_inside else None
    return [node for node in exits if node != passed]
