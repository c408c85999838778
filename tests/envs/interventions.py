"""What tests of interventions share: worlds on which vehicles stand where a test puts them."""

from typing import Any

import numpy as np
from highway_env.vehicle.behavior import IDMVehicle

from envs.rollouts.world import EgoWorld, open_world
from predictor.scene import Scene

ASIDE = (-200.0, 12.0)
"""On the last lane, far behind all others."""


def road_world(*others_m: tuple[float, float], ego_m: tuple[float, float] = ASIDE, speed_mps: float = 20.0) -> EgoWorld:
    """Returns highway-fast-v0 with an idle ego (id 0) and exactly these drivers (ids 1, 2, …), all at one speed.

    Lanes are at y = 0, 4, 8 and 12 m. Drivers begin no lane change.
    """
    world = open_world("highway-fast-v0", "idle")
    assert isinstance(world, EgoWorld)
    world.reset(0)
    put(world, *others_m, ego_m=ego_m, speed_mps=speed_mps)
    return world


def put(world: EgoWorld, *others_m: tuple[float, float], ego_m: tuple[float, float], speed_mps: float) -> None:
    simulator: Any = world.env.unwrapped
    road, ego = simulator.road, simulator.vehicle
    ego.position, ego.heading, ego.speed, ego.target_speed = np.array(ego_m), 0.0, speed_mps, speed_mps
    ego.on_state_update()
    ego.target_lane_index = ego.lane_index
    drivers = [
        IDMVehicle(road, np.array(place), 0.0, speed_mps, target_speed=speed_mps, enable_lane_change=False)
        for place in others_m
    ]
    road.vehicles = [ego, *drivers]
    world._reader.reset()
    world.full_scene()


def state_of(scene: Scene, agent: int) -> np.ndarray:
    """Returns one agent's state: x, y [m], vx, vy [m/s]."""
    return scene.states[scene.ids.tolist().index(agent)]


def played(world: Any, steps: int) -> list[Scene]:
    """Steps a world and returns all agents after each step."""
    scenes = []
    for _ in range(steps):
        world.step()
        scenes.append(world.full_scene())
    return scenes


def assert_same_scenes(found: list[Scene], expected: list[Scene]) -> None:
    assert len(found) == len(expected)
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one.ids, other.ids)
        np.testing.assert_array_equal(one.states, other.states)
