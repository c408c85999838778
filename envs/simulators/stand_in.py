"""A driver of highway-env's traffic in the ego's place: whom would whoever sits there react to?"""

from typing import Any

from highway_env import utils
from highway_env.envs.common.abstract import AbstractEnv
from highway_env.envs.intersection_env import IntersectionEnv
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.controller import MDPVehicle

from envs.simulators.idm_constants import SHIPPED
from envs.simulators.interventions import simulator_of


class StandIn(IDMVehicle):
    """IDM driver in the ego's place, with what observations and rewards ask of an ego.

    Its constants are highway-env's, also in processes in which an intersection has written over those of its base;
    at an intersection `seat_driver` gives it those.
    """

    DISTANCE_WANTED = SHIPPED["DISTANCE_WANTED"]
    COMFORT_ACC_MAX = SHIPPED["COMFORT_ACC_MAX"]
    COMFORT_ACC_MIN = SHIPPED["COMFORT_ACC_MIN"]

    index_to_speed = MDPVehicle.index_to_speed
    speed_to_index = MDPVehicle.speed_to_index


def seat_driver(env: Any) -> bool:
    """Lets an IDM driver drive the only ego on from now on; returns False, without a change, where that is impossible.

    It begins with the ego's lane and route, changes lane as others do, and wishes to drive at the limit of its lane
    (without one, at the present speed). Its IDM constants are those of the simulator's traffic. The policy's actions
    have no effect any more, and rules of a crossing bind it. The ego stays the same object: ids, observations and
    interventions find it as before.

    Args:
        env: environment, in wrappers or not; a copy, since nothing takes the driver out again.
    """
    simulator = simulator_of(env)
    if not isinstance(simulator, AbstractEnv) or len(simulator.controlled_vehicles) != 1:
        return False
    ego = simulator.controlled_vehicles[0]
    driver = StandIn(
        ego.road, ego.position, ego.heading, ego.speed, getattr(ego, "target_lane_index", None),
        ego.lane.speed_limit, getattr(ego, "route", None),
    )  # fmt: skip
    ego.__dict__ = {**vars(driver), **vars(ego), **_written_constants(simulator), "target_speed": driver.target_speed}
    ego.__class__ = StandIn
    return True


def _written_constants(simulator: AbstractEnv) -> dict[str, float]:
    """Returns what an intersection has written over the constants of its traffic; nothing elsewhere."""
    if not isinstance(simulator, IntersectionEnv):
        return {}
    traffic = utils.class_from_path(simulator.config["other_vehicles_type"])
    return {name: getattr(traffic, name) for name in SHIPPED}
