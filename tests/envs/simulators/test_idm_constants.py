"""Drivers' constants: those of an intersection do not reach the environments that are made or reset after it."""

from collections.abc import Callable

import gymnasium as gym
import highway_env  # noqa: F401
import numpy as np
import pytest
from highway_env.vehicle.behavior import IDMVehicle

from envs.registry import make_env
from envs.simulators.idm_constants import SHIPPED
from envs.wrappers import SceneObservation


def constants() -> dict[str, float]:
    return {name: getattr(IDMVehicle, name) for name in SHIPPED}


def cross() -> None:
    crossing = make_env("intersection-v2")
    crossing.reset(seed=0)
    assert constants() == {"DISTANCE_WANTED": 7, "COMFORT_ACC_MAX": 6, "COMFORT_ACC_MIN": -3}
    crossing.close()


def motion(env: gym.Env) -> np.ndarray:
    """Returns where all vehicles are at each step of one episode."""
    env.reset(seed=5)
    places = []
    for _ in range(8):
        if env.step(1)[2]:
            break
        places.append([vehicle.position.copy() for vehicle in env.unwrapped.road.vehicles])  # type: ignore[attr-defined]
    env.close()
    return np.array(places)


def test_the_shipped_values_are_those_of_highway_env():
    assert constants() == SHIPPED


@pytest.mark.parametrize(
    "make",
    [lambda: make_env("highway-fast-v0"), lambda: SceneObservation(gym.make("highway-fast-v0"))],
    ids=["make_env", "wrapper"],
)
def test_traffic_is_the_same_after_an_intersection(make: Callable[[], gym.Env]):
    alone = motion(make())
    cross()
    np.testing.assert_array_equal(motion(make()), alone)
    assert constants() == SHIPPED


def test_an_env_that_was_made_before_is_right_after_its_reset():
    env = SceneObservation(make_env("highway-fast-v0"))
    cross()
    env.reset(seed=5)
    assert constants() == SHIPPED


def test_an_intersection_keeps_its_own_beside_another():
    env = SceneObservation(make_env("intersection-v2"))
    env.reset(seed=0)
    make_env("intersection-v2").close()
    env.step(1)
    assert constants()["DISTANCE_WANTED"] == 7
