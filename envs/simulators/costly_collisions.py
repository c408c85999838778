"""Driving scenarios in which a collision costs, as gymnasium ids: the traffic of another id, with other rewards.

In highway-env a collision ends the episode and costs little else, or waiting costs as much: who drives into others
returns as much as who looks ahead. Importing this module registers the ids.
"""

from typing import Any, ClassVar

from highway_env.envs.common.abstract import AbstractEnv
from highway_env.envs.intersection_env import ConnectedLaneIntersectionEnv

from envs.simulators.mixed_traffic import MixedHighwayEnv, register_scenarios


class _Costly(AbstractEnv):
    settings: ClassVar[dict[str, Any]] = {}

    @classmethod
    def default_config(cls) -> dict[str, Any]:
        """Returns the base's config with other rewards."""
        return {**super().default_config(), **cls.settings}


class CostlyMixedHighwayEnv(_Costly, MixedHighwayEnv):
    """highway-mixed-v0 where a collision costs as much as a minute of the best driving.

    Rewards are a tenth of the base's before these are normalised (0.05 for the fastest second in the right lane), so
    that returns are of the order of one.
    """

    settings = {
        "normalize_reward": False,
        "collision_reward": -3.0,
        "high_speed_reward": 0.04,
        "right_lane_reward": 0.01,
    }


class CostlyIntersectionEnv(_Costly, ConnectedLaneIntersectionEnv):
    """intersection-v2 where arriving brings 1, a collision costs 2, and waiting nothing.

    Speed is rewarded in proportion, so that a way brings the same at any speed (0.05 for 9 m), and an episode is long
    enough to wait for a gap: 20 s instead of 13.
    """

    settings = {
        "collision_reward": -2.0,
        "arrived_reward": 1.0,
        "high_speed_reward": 0.05,
        "reward_speed_range": [0.0, 9.0],
        "duration": 20,
    }


BASE_ID = {"highway-mixed-costly-v0": "highway-mixed-v0", "intersection-costly-v0": "intersection-v2"}
"""Id defined here → the id with the same traffic."""

register_scenarios({"highway-mixed-costly-v0": CostlyMixedHighwayEnv, "intersection-costly-v0": CostlyIntersectionEnv})
