import copy
import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from envs.rollouts.interventions import body_of, intervene, interventions_of
from envs.rollouts.world import EgoWorld, World, open_world
from envs.simulators.highway_interventions import RATE_MPS2
from envs.simulators.intervention import Intervention, Kind, NotAllowedError
from tests.envs.interventions import assert_same_scenes, played, road_world, state_of

CARS = ((0.0, 4.0), (40.0, 4.0), (80.0, 4.0), (40.0, 8.0))
"""Three in a row, ids 1 to 3, and one beside the middle one, id 4."""


def test_a_vehicle_brakes_to_a_speed_and_holds_it_while_it_lasts():
    world = road_world(*CARS)
    intervene(world, Intervention(2, "brake", 3, change_mps=8.0))
    assert state_of(world.full_scene(), 2)[2] == 20.0  # not at once
    speeds = [state_of(scene, 2)[2] for scene in played(world, 3)]
    np.testing.assert_allclose(speeds, [20.0 - RATE_MPS2["brake"], 12.0, 12.0])
    after = [state_of(scene, 2)[2] for scene in played(world, 4)]
    assert after[-1] > 15.0 and after == sorted(after)  # the driver goes back to its own speed
    assert "act" not in world.env.unwrapped.road.__dict__


def test_braking_ends_at_rest():
    world = road_world(*CARS)
    intervene(world, Intervention(2, "brake", 5, change_mps=100.0))
    assert [round(state_of(scene, 2)[2], 6) for scene in played(world, 5)] == [14.0, 8.0, 2.0, 0.0, 0.0]


def test_a_speed_changes_at_once_and_the_driver_is_free():
    world = road_world(*CARS)
    intervene(world, Intervention(2, "brake", 0, change_mps=8.0, at_once=True))
    assert state_of(world.full_scene(), 2)[2] == 12.0
    assert interventions_of(world) == {}
    assert state_of(played(world, 1)[0], 2)[2] > 13.0


def test_who_brakes_may_brake_harder_for_its_leader():
    world = road_world((0.0, 4.0), (14.0, 4.0))
    expected = copy.deepcopy(world)
    intervene(world, Intervention(1, "brake", 2, change_mps=0.1))
    slow, free = played(world, 2)[-1], played(expected, 2)[-1]
    assert state_of(slow, 1)[2] <= state_of(free, 1)[2] < 17.0


def test_a_vehicle_accelerates_while_there_is_room():
    world = road_world(*CARS)
    intervene(world, Intervention(3, "accelerate", 3, change_mps=5.0))
    np.testing.assert_allclose([state_of(s, 3)[2] for s in played(world, 3)], [23.0, 25.0, 25.0])
    close = road_world((0.0, 4.0), (25.0, 4.0))
    intervene(close, Intervention(1, "accelerate", 8, change_mps=10.0))
    scenes = played(close, 8)
    gaps = [state_of(scene, 2)[0] - state_of(scene, 1)[0] for scene in scenes]
    assert min(gaps) > 6.0
    assert not any(vehicle.crashed for vehicle in close.env.unwrapped.road.vehicles)


@pytest.mark.parametrize(("kind", "lane_m"), [("left", 0.0), ("right", 8.0)])
def test_a_vehicle_changes_lane_and_stays_there_while_it_lasts(kind: Kind, lane_m: float):
    world = road_world((0.0, 4.0))
    intervene(world, Intervention(1, kind, 4))
    assert abs(state_of(played(world, 4)[-1], 1)[1] - lane_m) < 0.3


def test_a_vehicle_that_is_taken_out_comes_back_to_its_driver():
    world = road_world(*CARS)
    free = copy.deepcopy(world)
    intervene(world, Intervention(2, "remove", 3))
    seen = []
    for _ in range(4):
        seen.append((2 in interventions_of(world), *(2 in scene.ids for scene in played(world, 1))))
    assert seen == [(True, False), (True, False), (True, False), (False, True)]  # taken out for three steps
    back = state_of(world.full_scene(), 2)
    np.testing.assert_allclose(back, state_of(played(free, 4)[-1], 2), atol=1.0)
    assert interventions_of(world) == {}


def test_a_vehicle_does_not_come_back_into_another_one():
    world = road_world(*CARS)
    intervene(world, Intervention(2, "remove", 1))
    vehicle = world.env.unwrapped.road.vehicles[1]
    played(world, 1)
    absent = world.env.unwrapped.road.act.running[0].vehicle
    vehicle.position = absent.position + np.array([5.5, 0.0])
    vehicle.speed = absent.speed
    world.step()
    assert 2 not in world.full_scene().ids
    assert interventions_of(world)[2].kind == "remove"
    vehicle.position = vehicle.position + np.array([200.0, 0.0])
    world.step()
    assert 2 in world.full_scene().ids


@pytest.mark.parametrize("driver", ["random", "idle"])
def test_the_ego_brakes_whatever_its_policy_asks_and_is_free_again(driver: str):
    world = open_world("highway-fast-v0", driver)
    world.reset(5)
    simulator: Any = world.env.unwrapped
    lane = simulator.vehicle.target_lane_index[2]
    before = state_of(world.full_scene(), 0)[2]
    intervene(world, Intervention(0, "brake", 3, change_mps=6.0))
    for _ in range(3):
        world.step()
        assert simulator.vehicle.target_lane_index[2] == lane
    assert simulator.vehicle.speed <= before - 6.0 + 1e-6
    played(world, 2)
    assert simulator.vehicle.speed > before - 6.0 + 1.0


def test_a_policy_cannot_change_lane_while_its_vehicle_brakes():
    world = road_world((100.0, 4.0), ego_m=(0.0, 4.0))
    simulator: Any = world.env.unwrapped
    asked = simulator.action_type.actions_indexes["LANE_RIGHT"]
    intervene(world, Intervention(0, "brake", 2, change_mps=6.0))
    lanes = []
    for _ in range(3):
        world.env.step(asked)
        lanes.append(simulator.vehicle.target_lane_index[2])
    assert lanes == [1, 1, 2]


@pytest.mark.parametrize("kind", ["brake", "accelerate", "left"])
def test_a_driver_begins_no_lane_change_meanwhile_and_may_again_afterwards(kind: Kind):
    world = road_world((0.0, 4.0))
    (_, driver) = world.env.unwrapped.road.vehicles
    driver.enable_lane_change = True
    intervene(world, Intervention(1, kind, 2))
    assert not driver.enable_lane_change
    played(world, 3)
    assert driver.enable_lane_change


def test_two_interventions_in_a_row_give_the_vehicle_back_as_it_was():
    world = road_world(*CARS)
    vehicle = body_of(world, 2)
    vehicle.enable_lane_change = True
    intervene(world, Intervention(2, "brake", 1, change_mps=4.0))
    played(world, 1)
    intervene(world, Intervention(2, "accelerate", 2, change_mps=4.0))
    played(world, 1)
    assert not vehicle.enable_lane_change  # the second one is in force
    played(world, 2)
    assert vehicle.enable_lane_change


def test_an_ego_that_steers_itself_keeps_its_own_acceleration_for_later():
    """A continuous action is given once per step and kept over its frames."""
    world = open_world("racetrack-v1", "keep-lane")
    world.reset(0)
    before = state_of(world.full_scene(), 0)
    intervene(world, Intervention(0, "brake", 5, change_mps=1.5))
    speeds = [float(np.linalg.norm(state_of(scene, 0)[2:])) for scene in played(world, 5)]
    target = float(np.linalg.norm(before[2:])) - 1.5
    assert speeds[-1] == pytest.approx(target, abs=1e-6)
    assert min(speeds) >= target - 1e-6
    with pytest.raises(
        NotAllowedError, match="agent 0 is steered by its policy itself and cannot be sent to another lane"
    ):
        intervene(road_without(world), Intervention(0, "left", 2))


def road_without(world: World) -> World:
    played(world, 1)
    return world


COPIES: dict[str, Callable[[Any], Any]] = {
    "deepcopy": copy.deepcopy,
    "pickle": lambda world: pickle.loads(pickle.dumps(world)),
}


@pytest.mark.parametrize("way", COPIES)
@pytest.mark.parametrize("kind", ["brake", "accelerate", "right", "remove"])
def test_a_copy_of_a_world_under_an_intervention_continues_exactly(kind: Kind, way: str):
    world = road_world(*CARS)
    intervene(world, Intervention(2, kind, 4))
    played(world, 2)
    copied = COPIES[way](world)
    assert interventions_of(copied) == interventions_of(world) != {}
    alone = COPIES[way](copied)  # a copy of a copy, played after both
    expected = played(world, 6)
    assert_same_scenes(played(copied, 6), expected)
    assert_same_scenes(played(alone, 6), expected)


@pytest.mark.parametrize("env_id", ["merge-v1", "roundabout-v1", "intersection-v2", "highway-mixed-v0"])
def test_other_roads_can_be_perturbed(env_id: str):
    world = open_world(env_id, "idle")
    world.reset(1)
    before = np.linalg.norm(state_of(world.full_scene(), 1)[2:])
    intervene(world, Intervention(1, "brake", 1, change_mps=3.0))
    assert np.linalg.norm(state_of(played(world, 1)[0], 1)[2:]) <= before - 3.0 + 1e-6


def test_learners_of_the_multiagent_intersection_can_be_perturbed():
    world = open_world("intersection-multi-agent-v2", "idle")
    world.reset(1)
    before = world.full_scene()
    learner = world.env.unwrapped.highway.unwrapped.controlled_vehicles[0]
    agent = next(int(a) for a in before.ids if world.env.reader.body_of(world.env, int(a)) is learner)
    intervene(world, Intervention(agent, "brake", 2, change_mps=3.0))
    world.step()
    assert learner.speed <= np.linalg.norm(state_of(before, agent)[2:]) - 3.0 + 1e-6
    with pytest.raises(NotAllowedError, match=f"agent {agent} is under an intervention already"):
        intervene(world, Intervention(agent, "brake", 2))


@pytest.mark.parametrize(
    ("intervention", "message"),
    [
        (Intervention(0, "remove", 2), "agent 0 is driven by a policy and cannot be taken out"),
        (Intervention(5, "left", 2), "agent 5 has no lane on its left"),
        (Intervention(9, "brake", 2), "no agent 9 is present; present are 0, 1, 2, 3, 4, 5"),
    ],
)
def test_what_is_not_possible_is_named(intervention: Intervention, message: str):
    world = road_world(*CARS, (0.0, 0.0))
    with pytest.raises(NotAllowedError, match=f"^{message}"):
        intervene(world, intervention)
    assert interventions_of(world) == {}


def test_a_reset_drops_interventions():
    world = open_world("highway-fast-v0", "idle")
    assert isinstance(world, EgoWorld)
    world.reset(3)
    expected = played(world, 3)
    world.reset(3)
    intervene(world, Intervention(1, "remove", 5))
    world.step()
    world.reset(3)
    assert interventions_of(world) == {}
    assert_same_scenes(played(world, 3), expected)


@pytest.mark.parametrize(
    ("place_m", "speed_mps", "returns"), [(-22.0, 30.0, False), (22.0, 30.0, True), (-22.0, 15.0, True)]
)
def test_who_drives_behind_decides_how_much_room_a_vehicle_needs_to_come_back(
    place_m: float, speed_mps: float, returns: bool
):
    """10 m and half a second of the one behind: 25 m in front of 30 m/s, 20 m where 20 m/s follows."""
    world = road_world(*CARS)
    intervene(world, Intervention(2, "remove", 1))
    other = world.env.unwrapped.road.vehicles[1]
    played(world, 1)
    absent = world.env.unwrapped.road.act.running[0].vehicle
    for vehicle in world.env.unwrapped.road.vehicles:
        if vehicle is not other:
            vehicle.position = vehicle.position + np.array([500.0, 0.0])
    absent.speed = 20.0
    other.position, other.speed = absent.position + np.array([place_m, 0.0]), speed_mps
    assert (2 not in interventions_of(world)) == returns
