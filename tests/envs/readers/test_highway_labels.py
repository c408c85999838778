from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from highway_env.vehicle.behavior import AggressiveVehicle, DefensiveVehicle, IDMVehicle, LinearVehicle
from highway_env.vehicle.kinematics import Vehicle
from highway_env.vehicle.objects import Landmark, Obstacle, RoadObject

from envs.collect import CollectConfig, collect
from envs.drivers.ego import make_ego_driver
from envs.readers.highway import HighwayReader, vehicles_of
from envs.readers.highway_labels import (
    ATTRIBUTE_NAMES,
    LEADER,
    OTHER_KIND,
    UNKNOWN,
    SceneLabels,
    desired_speed_mps,
    driver_kind,
    leaders_of,
    read_labels,
    with_labels,
)
from envs.registry import CHECKPOINTS, make_env
from envs.seeding import driver_rng
from envs.simulators.mixed_traffic import BASE_ID, DRIVER_KINDS, DriverMix, MixedDriver
from predictor.data.store import Episode, StoreInfo, read_store, write_store
from predictor.data.windows import Windows
from predictor.scene import PADDING_ID, Scene
from predictor.support.errors import ProtocolError
from tests.envs.helpers import light_env, random_actions, short_env

Place = tuple[float, float]
ASIDE = (-100.0, 12.0)
"""On the last lane, behind all agents."""


@pytest.fixture
def env() -> gym.Env:
    made = short_env(30)
    made.reset(seed=0)
    return made


def place(env: gym.Env, *others_m: Place, ego_m: Place = ASIDE, kind: Callable[..., Vehicle] = IDMVehicle) -> list[Any]:
    """Put exactly these drivers and the ego on the road, all at 20 m/s; lanes are at y = 0, 4, 8 and 12 m."""
    road, ego = env.unwrapped.road, env.unwrapped.vehicle
    ego.position, ego.heading, ego.speed = np.array(ego_m), 0.0, 20.0
    others = [kind(road, np.array(position), 0.0, 20.0) for position in others_m]
    road.vehicles = [*others, ego]  # the ego is not first in highway-env's own list
    return others


def edges(labels: SceneLabels) -> set[tuple[int, int]]:
    """Pairs (receiver, sender)."""
    return {(int(r), int(s)) for r, s in np.argwhere(labels.edge_types == LEADER)}


def test_who_follows_has_exactly_its_leader(env: gym.Env):
    place(env, (0.0, 4.0), (30.0, 4.0), (10.0, 8.0))
    labels = read_labels(env)
    assert labels.edge_types.tolist() == [
        [-1, -1, -1, -1],  # the ego: no IDM driver
        [0, -1, 1, 0],
        [0, 0, -1, 0],
        [0, 0, 0, -1],
    ]
    expected = np.zeros((4, 4, 5))
    expected[1, 2] = 30.0 / 20.0, 1.5, 30.0, 20.0, 0.0
    np.testing.assert_allclose(labels.edge_attributes, expected)
    assert (labels.edge_types.dtype, labels.edge_attributes.dtype) == (np.int8, np.float32)


def test_the_ego_leads_but_its_own_leader_is_unknown(env: gym.Env):
    place(env, (0.0, 4.0), (90.0, 4.0), ego_m=(50.0, 4.0))
    labels = read_labels(env)
    assert labels.edge_types.tolist() == [[-1, -1, -1], [1, -1, 0], [0, 0, -1]]
    assert labels.edge_attributes[1, 0, 2] == 50.0
    assert not labels.edge_attributes[0].any()


def test_only_the_next_one_leads(env: gym.Env):
    place(env, (60.0, 0.0), (0.0, 0.0), (20.0, 0.0))
    assert edges(read_labels(env)) == {(2, 3), (3, 1)}


def test_the_ego_alone_has_no_pair(env: gym.Env):
    place(env)
    labels = read_labels(env)
    assert labels.edge_types.tolist() == [[UNKNOWN]]
    assert labels.edge_attributes.shape == (1, 1, len(ATTRIBUTE_NAMES))


def test_who_changes_lane_has_a_leader_on_both(env: gym.Env):
    """`IDMVehicle.act` takes the smaller of both accelerations."""
    changer, *_ = place(env, (0.0, 4.0), (30.0, 4.0), (12.0, 8.0))
    changer.target_lane_index = ("0", "1", 2)
    labels = read_labels(env)
    assert edges(labels) == {(1, 2), (1, 3)}
    assert labels.edge_attributes[1, :, 2].tolist() == [0.0, 0.0, 30.0, 12.0]


def test_one_leader_on_both_lanes_counts_once(env: gym.Env):
    changer, _ = place(env, (0.0, 4.0), (30.0, 6.0))  # between the lanes: on both, by highway-env's margin
    changer.target_lane_index = ("0", "1", 2)
    assert edges(read_labels(env)) == {(1, 2)}
    (headway_m,) = leaders_of(changer).values()
    assert headway_m == 30.0


@pytest.mark.parametrize(("kind", "leads"), [(Obstacle, False), (Landmark, True)])
def test_an_obstacle_hides_the_leader_and_a_landmark_does_not(env: gym.Env, kind: type[RoadObject], leads: bool):
    place(env, (0.0, 4.0), (30.0, 4.0))
    road = env.unwrapped.road
    road.objects.append(kind(road, np.array([15.0, 4.0])))
    labels = read_labels(env)
    assert edges(labels) == ({(1, 2)} if leads else set())
    assert labels.edge_types[1].tolist() == [0, UNKNOWN, int(leads)]
    assert labels.edge_attributes.any() == leads


def test_who_has_no_idm_driver_leads_but_is_not_known_to_follow(env: gym.Env):
    place(env, (0.0, 4.0), (30.0, 4.0), kind=Vehicle)
    env.unwrapped.road.vehicles.append(IDMVehicle(env.unwrapped.road, np.array([-20.0, 4.0]), 0.0, 20.0))
    labels = read_labels(env)
    assert edges(labels) == {(3, 1)}
    assert (labels.edge_types[:3] == UNKNOWN).all()


def test_an_ego_is_unknown_whatever_drives_it(env: gym.Env):
    driver, _ = place(env, (0.0, 4.0), (30.0, 4.0))
    env.unwrapped.controlled_vehicles = [driver]
    assert (read_labels(env).edge_types[0] == UNKNOWN).all()


def test_a_crashed_vehicle_has_no_leader_and_still_leads(env: gym.Env):
    _, wreck, _ = place(env, (0.0, 4.0), (30.0, 4.0), (60.0, 4.0))
    wreck.crashed = True
    labels = read_labels(env)
    assert edges(labels) == {(1, 2)}
    assert labels.edge_types[2].tolist() == [0, 0, UNKNOWN, 0]


def test_whom_one_yields_to_is_unknown(env: gym.Env):
    """At crossings highway-env stops a driver for another one that it does not name."""
    yielding, *_ = place(env, (0.0, 4.0), (30.0, 4.0), (10.0, 8.0))
    yielding.is_yielding = True
    assert read_labels(env).edge_types[1].tolist() == [UNKNOWN, UNKNOWN, LEADER, UNKNOWN]
    yielding.is_yielding = False
    assert read_labels(env).edge_types[1].tolist() == [0, UNKNOWN, LEADER, 0]


@pytest.mark.parametrize(
    ("speed_mps", "headway_m", "time_gap_s"),
    [(20.0, 40.0, 2.0), (4.0, 39.0, 9.75), (4.0, 40.0, 10.0), (4.0, 41.0, 10.0), (0.0, 5.0, 10.0), (-3.0, 5.0, 10.0)],
)
def test_time_gap_is_headway_over_speed_up_to_a_limit(
    env: gym.Env, speed_mps: float, headway_m: float, time_gap_s: float
):
    follower, _ = place(env, (0.0, 4.0), (headway_m, 4.0))
    follower.speed = speed_mps
    np.testing.assert_allclose(read_labels(env).edge_attributes[1, 2, :3], [time_gap_s, 1.5, headway_m], rtol=1e-6)


def test_the_desired_time_gap_is_the_drivers_own(env: gym.Env):
    patient, keen, _ = place(env, (0.0, 4.0), (30.0, 4.0), (60.0, 4.0))
    patient.TIME_WANTED, keen.TIME_WANTED = 2.75, 0.5
    attributes = read_labels(env).edge_attributes
    assert (attributes[1, 2, 1], attributes[2, 3, 1]) == (2.75, 0.5)
    place(env, (0.0, 4.0), (30.0, 4.0), kind=DefensiveVehicle)
    assert read_labels(env).edge_attributes[1, 2, 1] == DefensiveVehicle.TIME_WANTED


def drivers_of_all_kinds(road: Any) -> list[IDMVehicle]:
    """highway-env's own and ours, at 20 m/s on a lane with a limit of 30 m/s; ours wish for 21 m/s."""
    own = [law(road, np.array([0.0, 4.0]), 0.0, 20.0) for law in (IDMVehicle, AggressiveVehicle, DefensiveVehicle)]
    ours = []
    for kind in DRIVER_KINDS:
        traits = replace(DriverMix().draw(np.random.default_rng(0)), kind=kind, speed_factor=0.7)
        ours.append(MixedDriver(road, np.array([0.0, 4.0]), 0.0, 20.0, traits=traits))
    return own + ours


def acceleration_of(vehicle: IDMVehicle) -> float:
    """What the driver would do now [m/s²], were it not for the limits of its car."""
    vehicle.enable_lane_change, vehicle.ACC_MAX = False, np.inf
    vehicle.act()
    return float(vehicle.action["acceleration"])


def test_kinds_and_desired_speeds_are_the_drivers_own(env: gym.Env):
    made = drivers_of_all_kinds(env.unwrapped.road)
    assert [driver_kind(vehicle) for vehicle in made] == [0, 1, 2, 0, 1, 2]
    assert [desired_speed_mps(vehicle) for vehicle in made] == [20.0] * 3 + [21.0] * 3
    assert driver_kind(LinearVehicle(env.unwrapped.road, np.array([0.0, 4.0]))) == OTHER_KIND


@pytest.mark.parametrize("asked_mps", [0.0, 12.0, 25.0, 40.0])
def test_without_a_leader_the_desired_speed_is_kept(env: gym.Env, asked_mps: float):
    for vehicle in drivers_of_all_kinds(env.unwrapped.road):
        env.unwrapped.road.vehicles = [vehicle]
        vehicle.target_speed = asked_mps
        vehicle.speed = desired_speed_mps(vehicle)
        expected = vehicle.COMFORT_ACC_MAX if driver_kind(vehicle) == 0 and asked_mps == 0 else 0.0
        assert acceleration_of(vehicle) == pytest.approx(expected, abs=1e-9)  # IDM at rest takes 0 for 0.01 m/s


def test_the_kind_and_the_desired_speed_stand_on_the_followers_edge(env: gym.Env):
    road = env.unwrapped.road
    for follower in drivers_of_all_kinds(road):
        leader = IDMVehicle(road, np.array([30.0, 4.0]), 0.0, 17.0)
        road.vehicles = [follower, leader, env.unwrapped.vehicle]
        found = read_labels(env).edge_attributes[1, 2]
        np.testing.assert_allclose(
            found, [1.5, follower.TIME_WANTED, 30.0, desired_speed_mps(follower), driver_kind(follower)], rtol=1e-6
        )


@pytest.mark.parametrize("env_id", BASE_ID)
def test_labels_hold_the_traits_of_each_driver(env_id: str):
    env, seen = make_env(env_id), 0
    for seed in range(3):
        env.reset(seed=seed)
        for action in random_actions(env, 4, seed):
            labels = read_labels(env)
            for receiver, sender in edges(labels):
                driver = vehicles_of(env)[receiver]
                _, gap_s, _, speed_mps, kind = labels.edge_attributes[receiver, sender]
                assert gap_s == np.float32(driver.traits.time_gap_s)
                assert DRIVER_KINDS[int(kind)] == driver.traits.kind
                asked_mps = 0.0 if getattr(driver, "is_yielding", False) else driver.lane.speed_limit
                assert speed_mps == pytest.approx(driver.traits.speed_factor * asked_mps, rel=1e-6)
                seen += 1
            if any(env.step(action)[2:4]):
                break
    assert seen


@pytest.mark.parametrize("seed", range(12))
def test_labelled_leaders_change_the_acceleration_and_no_other_vehicle_does(env: gym.Env, seed: int):
    """By intervention: each other vehicle in turn drives back at full speed; who may pull out is not asked."""
    rng, road = np.random.default_rng(seed), env.unwrapped.road
    road.vehicles = []
    for x_m in rng.permutation(np.arange(8) * 13.0):
        lane = int(rng.integers(3))
        road.vehicles.append(MixedDriver(road, np.array([x_m, 4.0 * lane]), 0.0, 20.0))
        if rng.random() < 0.4:
            road.vehicles[-1].target_lane_index = ("0", "1", lane + (1 if lane < 2 else -1))
    vehicles = [env.unwrapped.vehicle, *road.vehicles]
    env.unwrapped.vehicle.position = np.array(ASIDE)
    road.vehicles = vehicles[1:] + vehicles[:1]
    found = set()
    for receiver, driver in enumerate(vehicles[1:], start=1):
        before = acceleration_of(driver)
        for sender, other in enumerate(vehicles):
            if other is not driver:
                other.speed = -1e5
                if acceleration_of(driver) != before:
                    found.add((receiver, sender))
                other.speed = 20.0
    assert found == edges(read_labels(env)) != set()


@pytest.mark.parametrize("kind", DRIVER_KINDS)
@pytest.mark.parametrize(
    ("gap_m", "leader_mps", "linear_cares"), [(90.0, 25.0, False), (90.0, 15.0, True), (25.0, 25.0, True)]
)
def test_only_idm_reacts_to_a_faster_leader_farther_than_it_wishes(
    env: gym.Env, kind: str, gap_m: float, leader_mps: float, linear_cares: bool
):
    follower = drivers_of_all_kinds(env.unwrapped.road)[3 + DRIVER_KINDS.index(kind)]
    leader = IDMVehicle(env.unwrapped.road, np.array([gap_m, 4.0]), 0.0, leader_mps)
    env.unwrapped.road.vehicles = [follower]
    alone = acceleration_of(follower)
    env.unwrapped.road.vehicles.append(leader)
    assert (acceleration_of(follower) != alone) == (kind == "idm" or linear_cares)
    assert set(leaders_of(follower)) == {leader}


def test_without_a_road_it_says_so(env: gym.Env):
    env.unwrapped.road = None
    with pytest.raises(ProtocolError, match="has no vehicles yet; call reset"):
        read_labels(env)


@pytest.mark.parametrize("env_id", [*CHECKPOINTS, *BASE_ID])
def test_leaders_are_those_that_the_drivers_then_brake_for(env_id: str, monkeypatch: pytest.MonkeyPatch):
    """Of all who ask for an acceleration, only `act` passes the rear vehicle; it looks at its own lane first."""
    env = light_env(env_id)
    asked: list[tuple[Vehicle, Vehicle | None]] = []
    for law in (IDMVehicle, MixedDriver):

        def spied(self: IDMVehicle, *args: Any, original: Any = law.acceleration, **kwargs: Any) -> float:
            if "rear_vehicle" in kwargs:
                asked.append((kwargs["ego_vehicle"], kwargs["front_vehicle"]))
            return float(original(self, *args, **kwargs))

        monkeypatch.setattr(law, "acceleration", spied)
    checked = 0
    for seed in range(2):
        env.reset(seed=seed)
        for action in random_actions(env, 8, seed):
            vehicles, labels = vehicles_of(env), read_labels(env)
            targets = [getattr(vehicle, "target_lane_index", None) for vehicle in vehicles]
            asked.clear()
            env.unwrapped.road.act()
            for place, vehicle in enumerate(vehicles):
                found = {sender for receiver, sender in edges(labels) if receiver == place}
                fronts = [front for asker, front in asked if asker is vehicle]
                agents = {vehicles.index(front) for front in fronts if front in vehicles}
                if place and vehicle.target_lane_index != targets[place]:  # it began or ended a lane change just now
                    assert fronts[0] not in vehicles or vehicles.index(fronts[0]) in found
                else:
                    assert agents == found
                for sender in found:
                    distance_m = abs(vehicle.lane_distance_to(vehicles[sender]))
                    assert labels.edge_attributes[place, sender, 2] == pytest.approx(distance_m, rel=1e-6)
                checked += len(found)
            _, _, terminated, truncated, _ = env.step(action)
            if terminated or truncated:
                break
    assert checked or env_id.startswith("racetrack")  # one other car only, half a lap away


def config(env_id: str, **changes: Any) -> CollectConfig:
    return CollectConfig(**{"env_id": env_id, "out": Path("unused"), "workers": 1, "driver": ("random",), **changes})


@pytest.mark.slow
@pytest.mark.parametrize("env_id", ["highway-fast-v0", "intersection-v2", "roundabout-v1", "u-turn-v1", "racetrack-v1"])
def test_labels_change_nothing_that_is_recorded(env_id: str):
    runs = [collect(config(env_id, episodes=2, max_steps=6, seed=5, labels=labels)) for labels in (False, True)]
    for without, labelled in zip(*runs, strict=True):
        assert without.edge_types is None and without.edge_attributes is None
        assert labelled.edge_types is not None and labelled.edge_attributes is not None
        assert labelled.edge_types.shape == (*labelled.valid.shape, len(labelled.ids))
        for name in ("states", "valid", "ids"):
            assert getattr(labelled, name).tobytes() == getattr(without, name).tobytes()


def scene(*ids: int) -> Scene:
    return Scene(np.zeros((len(ids), 4)), np.array(ids), np.ones(len(ids), dtype=np.bool_))


def label(agents: int, leads: Sequence[tuple[int, int]]) -> SceneLabels:
    types = np.zeros((agents, agents), dtype=np.int8)
    attributes = np.zeros((agents, agents, len(ATTRIBUTE_NAMES)), dtype=np.float32)
    for receiver, sender in leads:
        types[receiver, sender], attributes[receiver, sender] = LEADER, (receiver, sender, 7, 8, 9)
    return SceneLabels(types, attributes)


def test_labels_go_to_the_columns_of_their_agents():
    scenes = [scene(0, 3), scene(0, 7, 3), scene(0, 7)]  # 7 enters before 3, which leaves
    made = Episode.from_scenes(scenes)
    assert made.ids.tolist() == [0, 3, 7]
    labelled = with_labels(made, scenes, [label(2, [(1, 0)]), label(3, [(1, 2), (2, 0)]), label(2, [(1, 0)])])
    assert labelled.edge_types is not None and labelled.edge_attributes is not None
    assert labelled.edge_types.tolist() == [
        [[0, 0, -1], [1, 0, -1], [-1, -1, -1]],
        [[0, 0, 0], [1, 0, 0], [0, 1, 0]],
        [[0, -1, 0], [-1, -1, -1], [1, -1, 0]],
    ]
    assert labelled.edge_attributes[1, 2, 1].tolist() == [
        1,
        2,
        7,
        8,
        9,
    ]  # receiver id 7 at index 1, sender id 3 at index 2
    assert labelled.edge_attributes[1, 1, 0].tolist() == [2, 0, 7, 8, 9]
    assert ((labelled.edge_attributes != 0).any(-1) == (labelled.edge_types == LEADER)).all()


def replay(episode: Episode, env_id: str) -> list[dict[tuple[int, int], tuple[int, list[float]]]]:
    """The labels of each step by the agents' ids, from another run of the same seed."""
    env = make_env(env_id)
    obs, _ = env.reset(seed=episode.seed)
    ego, reader = make_ego_driver(episode.label, env, driver_rng(episode.seed)), HighwayReader(env)
    steps = []
    for _ in range(len(episode.states)):
        ids, labels = reader.read_all(env).ids.tolist(), read_labels(env)
        steps.append(
            {
                (a, b): (int(labels.edge_types[i, j]), labels.edge_attributes[i, j].tolist())
                for i, a in enumerate(ids)
                for j, b in enumerate(ids)
                if i != j
            }
        )
        obs, *_ = env.step(ego(obs))
    return steps


@pytest.mark.slow
def test_labels_follow_their_agents_through_the_store_into_windows(tmp_path: Path):
    """Vehicles enter and leave this crossing; windows reorder columns and leave out who is not seen."""
    env_id = "intersection-v2"
    recorded = list(collect(config(env_id, episodes=2, seed=64)))
    assert any(not e.valid[0].all() for e in recorded) and any(not e.valid[-1].all() for e in recorded)
    info = StoreInfo(HighwayReader(make_env(env_id)).spec, env_id, edge_attribute_names=ATTRIBUTE_NAMES)
    write_store(tmp_path / "store", info, recorded)
    episodes = read_store(tmp_path / "store").episodes
    truths = [replay(episode, env_id) for episode in episodes]
    windows = Windows(episodes, info.spec, history_steps=4, horizon_steps=3)
    batch = windows.batch(np.arange(len(windows)))
    assert batch.edge_types is not None and batch.edge_attributes is not None
    moved = edges_seen = 0
    for place, (number, now) in enumerate(windows.index.tolist()):
        begin = now - int(batch.last_observed[place])
        for t, valid in enumerate(batch.valid[place].numpy()):
            ids = ids_of(episodes[number], begin + t, batch.states[place, t].numpy(), valid)
            moved += ids[valid].tolist() != sorted(ids[valid].tolist())
            for i, j in np.argwhere(~np.eye(len(ids), dtype=np.bool_)):
                found = int(batch.edge_types[place, t, i, j]), batch.edge_attributes[place, t, i, j].tolist()
                both = valid[i] and valid[j]
                assert found == (
                    truths[number][begin + t][ids[i], ids[j]] if both else (UNKNOWN, [0.0] * len(ATTRIBUTE_NAMES))
                )
                edges_seen += found[0] == LEADER
    assert moved and edges_seen > 50


def ids_of(episode: Episode, step: int, states: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Who stands in each column of a window, told by the state: no two agents are in one place."""
    ids = np.full(len(states), PADDING_ID)
    for column in np.flatnonzero(valid):
        (same,) = np.flatnonzero((episode.states[step] == states[column]).all(-1) & episode.valid[step])
        ids[column] = episode.ids[same]
    return ids
