"""Constants of highway-env's traffic: an intersection writes over those of every IDM driver of its process."""

from typing import Any

from highway_env.envs.common.abstract import AbstractEnv
from highway_env.envs.intersection_env import IntersectionEnv
from highway_env.vehicle.behavior import IDMVehicle

SHIPPED = {"DISTANCE_WANTED": 5.0 + IDMVehicle.LENGTH, "COMFORT_ACC_MAX": 3.0, "COMFORT_ACC_MIN": -5.0}
"""Values of highway-env 1.12 by name: distance [m], accelerations [m/s²]."""


def restore_idm_constants(env: Any) -> None:
    """Puts back what an intersection has written over, so that the traffic of this env does not depend on others.

    Args:
        env: environment that is made or reset, in wrappers or not. For an intersection, which writes its own at each
            reset, and outside highway-env nothing is done.
    """
    simulator = getattr(env, "unwrapped", env)
    if isinstance(simulator, AbstractEnv) and not isinstance(simulator, IntersectionEnv):
        for name, value in SHIPPED.items():
            setattr(IDMVehicle, name, value)
