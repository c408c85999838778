"""What scenes do not show of highway-env's traffic (`envs.simulators.hidden_traffic`)."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from highway_env.vehicle.behavior import IDMVehicle

from envs.simulators.hidden_traffic import possible_goals, redraw_hidden


def simulator(env_id: str) -> Any:
    found: Any = gym.make(env_id).unwrapped
    found.reset(seed=0)
    found.road.vehicles = found.road.vehicles[-1:] if env_id.startswith("intersection") else [found.vehicle]
    return found


def car(env: Any, lane: tuple[str, str, int], target: tuple[str, str, int] | None = None) -> IDMVehicle:
    vehicle = IDMVehicle.make_on_lane(env.road, lane, 5.0, 8.0)
    vehicle.target_lane_index = target or lane
    env.road.vehicles.append(vehicle)
    return vehicle


@pytest.mark.parametrize(
    ("env_id", "lane", "goals"),
    [
        ("intersection-v2", ("o1", "ir1", 0), ["o0", "o2", "o3"]),
        ("intersection-v2", ("ir1", "il3", 0), []),  # it turns already
        ("intersection-v2", ("il3", "o3", 0), []),  # it leaves
        ("roundabout-v1", ("eer", "ees", 0), ["exr", "sxr", "nxr"]),  # it has not entered yet
        ("roundabout-v1", ("ees", "ee", 0), ["exr", "sxr", "nxr"]),
        ("roundabout-v1", ("we", "sx", 0), ["exr", "sxr", "nxr"]),  # past an exit that nobody takes there
        ("roundabout-v1", ("se", "ex", 1), ["exr", "nxr"]),  # just past the southern exit
        ("roundabout-v1", ("nx", "ne", 0), ["exr", "sxr"]),
        ("roundabout-v1", ("ex", "exs", 0), []),  # it leaves
        ("roundabout-v1", ("exs", "exr", 0), []),
        ("roundabout-generic-v1", ("nx", "ne", 0), ["exr", "sxr", "wxr"]),
        ("highway-fast-v0", ("0", "1", 0), []),
    ],
)
def test_where_a_vehicle_may_be_going(env_id: str, lane: tuple[str, str, int], goals: list[str]):
    env = simulator(env_id)
    assert possible_goals(env, car(env, lane)) == goals


def test_one_that_steers_for_another_road_has_chosen_its_way():
    env = simulator("intersection-v2")
    assert possible_goals(env, car(env, ("o1", "ir1", 0), ("ir1", "il3", 0))) == []


def test_goals_and_moments_of_looking_aside_are_drawn_evenly():
    env = simulator("intersection-v2")
    vehicle = car(env, ("o1", "ir1", 0))
    rng = np.random.default_rng(0)
    goals, timers = [], []
    for _ in range(300):
        redraw_hidden(env, rng)
        goals.append(vehicle.route[-1][1])
        timers.append(vehicle.timer)
        assert vehicle.route[0][:2] == ("o1", "ir1")
    counts = [goals.count(goal) for goal in ("o0", "o2", "o3")]
    assert sum(counts) == 300 and min(counts) > 70
    assert 0 <= min(timers) < 0.05 and 0.95 < max(timers) < vehicle.LANE_CHANGE_DELAY


def test_an_ego_keeps_its_goal():
    env = simulator("intersection-v2")
    route = list(env.vehicle.route)
    env.road.vehicles = [env.vehicle]
    redraw_hidden(env, np.random.default_rng(0))
    assert env.vehicle.route == route
