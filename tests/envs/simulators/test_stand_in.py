from typing import Any

import gymnasium as gym
import highway_env  # noqa: F401
import numpy as np
import pytest
from highway_env.vehicle.behavior import IDMVehicle

from envs.rollouts.branches import copied
from envs.rollouts.world import open_world
from envs.simulators.stand_in import StandIn, seat_driver
from tests.envs.interventions import played, road_world


def test_the_driver_brakes_for_who_is_ahead_and_no_action_reaches_it():
    """The ego (0) is 20 m behind a slower vehicle (1)."""
    plain = road_world((20.0, 4.0), ego_m=(0.0, 4.0))
    plain.env.unwrapped.road.vehicles[1].target_speed = plain.env.unwrapped.road.vehicles[1].speed = 15.0
    seated = copied(plain)
    assert seat_driver(seated.env)
    ego = seated.env.unwrapped.vehicle
    assert isinstance(ego, IDMVehicle) and ego is seated.env.unwrapped.road.vehicles[0]
    ego.enable_lane_change = False
    faster = copied(seated)
    faster.hand_over(lambda _: 3)  # type: ignore[attr-defined]
    played(plain, 3), played(seated, 3), played(faster, 3)
    speeds = [world.full_scene().states[0, 2] for world in (plain, seated, faster)]
    assert speeds[1] < speeds[0] - 3.0 and speeds[2] == speeds[1]
    assert seated.full_scene().ids[0] == plain.full_scene().ids[0] == 0


def test_the_driver_wishes_the_limit_of_its_lane():
    world = road_world(ego_m=(0.0, 4.0))
    world.env.unwrapped.vehicle.target_speed = 0.0
    limit = world.env.unwrapped.vehicle.lane.speed_limit
    assert seat_driver(world.env)
    played(world, 10)
    assert world.full_scene().states[0, 2] == pytest.approx(limit, abs=2.0)


def test_the_driver_is_the_same_after_an_intersection_was_played(monkeypatch: pytest.MonkeyPatch):
    """Which writes over the constants of `IDMVehicle` for the whole process."""
    found = []
    for wanted in (10.0, 7.0):
        monkeypatch.setattr(IDMVehicle, "DISTANCE_WANTED", wanted)
        monkeypatch.setattr(IDMVehicle, "COMFORT_ACC_MAX", wanted / 2)
        world = road_world((15.0, 4.0), ego_m=(0.0, 4.0))
        assert seat_driver(world.env)
        world.env.unwrapped.road.vehicles[1].COMFORT_ACC_MAX = 3.0
        world.step()
        found.append(world.full_scene().states[0])
    np.testing.assert_array_equal(*found)


@pytest.mark.parametrize("env_id", ["racetrack-v1", "two-way-v0", "roundabout-v1", "intersection-v2"])
def test_every_road_drives_on_with_the_driver(env_id: str):
    """Of racetrack the ego has continuous actions; observation and reward of two-way ask an ego for its speeds."""
    world = open_world(env_id, "idle")
    world.reset(0)
    assert seat_driver(world.env)
    before = world.full_scene().states[0, :2].copy()
    played(world, 2)
    assert np.linalg.norm(world.full_scene().states[0, :2] - before) > 2.0


def test_where_no_ego_has_a_place_nothing_changes():
    several = gym.make("intersection-multi-agent-v2")
    several.reset(seed=0)
    kinds = [type(vehicle) for vehicle in several.unwrapped.road.vehicles]
    assert not seat_driver(several)
    assert [type(vehicle) for vehicle in several.unwrapped.road.vehicles] == kinds
    assert not seat_driver(open_world("simple_tag_v3", "heuristic").env)


def test_its_constants_are_not_those_that_an_intersection_writes(monkeypatch: pytest.MonkeyPatch):
    for name, value in (("DISTANCE_WANTED", 7.0), ("COMFORT_ACC_MAX", 6.0), ("COMFORT_ACC_MIN", -3.0)):
        monkeypatch.setattr(IDMVehicle, name, value)
    assert constants(StandIn) == (10.0, 3.0, -5.0)
    world = road_world((15.0, 4.0), ego_m=(0.0, 4.0))
    assert seat_driver(world.env) and constants(world.env.unwrapped.vehicle) == (10.0, 3.0, -5.0)


def test_at_an_intersection_it_has_the_constants_of_the_traffic_there():
    for env_id in ("intersection-v2", "intersection-mixed-v0"):
        world = open_world(env_id, "idle")
        world.reset(0)
        assert seat_driver(world.env)
        crossing = world.env.unwrapped
        assert constants(crossing.vehicle) == (7.0, 6.0, -3.0)
        assert env_id != "intersection-v2" or len({constants(driver) for driver in crossing.road.vehicles}) == 1


def constants(driver: Any) -> tuple[float, float, float]:
    return driver.DISTANCE_WANTED, driver.COMFORT_ACC_MAX, driver.COMFORT_ACC_MIN
