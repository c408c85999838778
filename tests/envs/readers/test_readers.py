import math

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import MaxAndSkipObservation
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.kinematics import Vehicle

from envs.drivers.ego import idle_action
from envs.readers import reader_for
from envs.readers.highway import HighwayReader
from envs.registry import CHECKPOINTS, make_env
from envs.wrappers import ForecastObservation, SceneObservation
from predictor.scene import PADDING_ID, Scene
from predictor.support.errors import ProtocolError, UserError
from tests.envs.helpers import light_env, random_actions, short_env

FRAMES = {
    "highway-v0": ("ego", "world"),
    "highway-fast-v0": ("ego", "world"),
    "two-way-v0": ("ego", "world"),
    "highway-mixed-v0": ("ego", "world"),
    "merge-mixed-v0": ("world", "world"),
    "roundabout-mixed-v0": ("world", "world"),
    "intersection-mixed-v0": ("world", "world"),
    "merge-v1": ("world", "world"),
    "merge-generic-v1": ("world", "world"),
    "roundabout-v1": ("world", "world"),
    "roundabout-generic-v1": ("world", "world"),
    "intersection-v2": ("world", "world"),
    "exit-v1": ("world", "world"),
    "racetrack-v1": ("world", "world"),
    "racetrack-large-v1": ("world", "world"),
    "racetrack-oval-v1": ("world", "world"),
    "u-turn-v1": ("world", "world"),
}
STEPS = 4


def place(env: gym.Env, *positions_m: tuple[float, float], speed_mps: float = 20.0, heading_rad: float = 0.0) -> None:
    """Put exactly these vehicles, and the ego at the origin, on the road."""
    road, ego = env.unwrapped.road, env.unwrapped.vehicle
    ego.position, ego.heading, ego.speed = np.zeros(2), heading_rad, speed_mps
    road.vehicles = [ego] + [Vehicle(road, np.array(p), heading_rad, speed_mps) for p in positions_m]


def by_object(env: gym.Env, reader: HighwayReader) -> dict[int, Vehicle]:
    """Which vehicle each id stands for, found by position."""
    scene = reader.read(env)
    found = {}
    for state, number in zip(scene.states[scene.valid], scene.ids[scene.valid], strict=True):
        (vehicle,) = [v for v in env.unwrapped.road.vehicles if np.array_equal(v.position, state[:2])]
        found[int(number)] = vehicle
    return found


@pytest.fixture
def env() -> gym.Env:
    made = short_env(30)
    made.reset(seed=0)
    return made


def test_frames_cover_the_registry():
    assert set(FRAMES) == set(CHECKPOINTS)


@pytest.mark.parametrize("env_id", CHECKPOINTS)
def test_every_registered_id_reads(env_id: str):
    env = light_env(env_id)
    reader = reader_for(env)
    assert isinstance(reader, HighwayReader)
    env.reset(seed=3)
    spec = reader.spec
    assert spec.frame == FRAMES[env_id]
    seen: dict[int, Vehicle] = {}
    for action in random_actions(env, STEPS):
        scene = reader.read(env)
        scene.check(env_id)
        assert scene.states.shape == (spec.max_agents, 4)
        assert np.isfinite(scene.states).all()
        assert (scene.ids[~scene.valid] == PADDING_ID).all()
        assert (scene.states[~scene.valid] == 0).all()
        np.testing.assert_array_equal(scene.states[0, :2], env.unwrapped.vehicle.position)
        for number, vehicle in by_object(env, reader).items():
            assert seen.setdefault(number, vehicle) is vehicle
        before = env.unwrapped.steps
        _, _, terminated, truncated, _ = env.step(action)
        simulated_s = (env.unwrapped.steps - before) / env.unwrapped.config["simulation_frequency"]
        assert spec.dt_s == pytest.approx(simulated_s)
        if terminated or truncated:
            break
    assert len(set(map(id, seen.values()))) == len(seen)


@pytest.mark.parametrize("policy_hz", [1, 2, 5, 15])
def test_time_step_is_what_the_simulator_simulates(policy_hz: int):
    """15 Hz is no multiple of 2 Hz: highway-env then simulates 7 of 7.5 frames, and its clock counts 7.5."""
    wrapped = ForecastObservation(make_env("merge-v1", config={"policy_frequency": policy_hz}), "constant-velocity")
    wrapped.reset(seed=0)
    for _ in range(3):
        wrapped.step(1)
    env = make_env("merge-v1", config={"policy_frequency": policy_hz})
    env.reset(seed=0)
    start_m = float(env.unwrapped.vehicle.position[0])
    speed_mps = float(env.unwrapped.vehicle.speed)
    env.step(idle_action(env))
    travelled_m = float(env.unwrapped.vehicle.position[0]) - start_m
    assert reader_for(env).spec.dt_s == pytest.approx(travelled_m / speed_mps, rel=1e-3)


def test_an_episode_that_begins_unseen_is_refused():
    env = ForecastObservation(make_env("highway-fast-v0"), "constant-velocity")
    env.reset(seed=0)
    for _ in range(2):
        env.step(1)
    env.unwrapped.reset(seed=1)
    with pytest.raises(UserError, match="an episode began that the wrapper with the reader did not see"):
        env.step(1)


def test_a_wrapper_inside_that_repeats_steps_is_refused():
    """Otherwise all forecasts would be of another time than `dt_s` says."""
    inside = ForecastObservation(MaxAndSkipObservation(make_env("highway-fast-v0"), skip=3), "constant-velocity")
    inside.reset(seed=0)
    with pytest.raises(UserError, match="wrapped at dt_s=1 but 3 s passed between two scenes; put a wrapper that"):
        inside.step(1)
    outside = MaxAndSkipObservation(ForecastObservation(make_env("highway-fast-v0"), "constant-velocity", flatten=True))
    outside.reset(seed=0)
    outside.step(1)
    outside.reset(seed=1)  # a new episode begins at 0 s
    outside.step(1)


def test_states_are_position_and_velocity_of_each_vehicle(env: gym.Env):
    road = env.unwrapped.road
    place(env, (10.0, 4.0), (-20.0, 0.0), heading_rad=0.3)
    road.vehicles[2].speed = 7.0
    scene = reader_for(env).read(env)
    expected = [[*v.position, v.speed * math.cos(0.3), v.speed * math.sin(0.3)] for v in road.vehicles]
    np.testing.assert_allclose(scene.states[:3], expected, rtol=0, atol=1e-12)
    assert scene.heading_rad == pytest.approx(0.3)
    assert scene.valid.tolist() == [True] * 3 + [False] * 9


def test_nearest_come_first_and_the_ego_before_all(env: gym.Env):
    place(env, (30.0, 0.0), (0.0, 0.0), (-10.0, 0.0), (0.0, 12.0))
    vehicles = env.unwrapped.road.vehicles
    vehicles.append(vehicles.pop(0))  # the ego is last in highway-env's own list, and shares its place with another
    found = by_object_order(env, reader_for(env).read(env))
    assert found == [vehicles[-1], vehicles[1], vehicles[2], vehicles[3], vehicles[0]]


def by_object_order(env: gym.Env, scene: Scene) -> list[Vehicle]:
    """The vehicles of the scene; the ego first among those that share its place."""
    ego = env.unwrapped.vehicle
    full = [ego] + [v for v in env.unwrapped.road.vehicles if v is not ego]
    found: list[Vehicle] = []
    for state in scene.states[scene.valid]:
        found.append(next(v for v in full if v not in found and np.array_equal(v.position, state[:2])))
    return found


@pytest.mark.parametrize(("perception_m", "visible"), [(50.0, 3), (49.99, 2), (10.0, 2), (9.99, 1), (1e9, 4)])
def test_range_includes_its_boundary(env: gym.Env, perception_m: float, visible: int):
    place(env, (10.0, 0.0), (30.0, 40.0), (-500.0, 0.0))
    assert reader_for(env, perception_m=perception_m).read(env).valid.sum() == visible


@pytest.mark.parametrize("max_agents", [1, 2, 3, 6])
def test_only_the_nearest_fit(env: gym.Env, max_agents: int):
    place(env, (40.0, 0.0), (-20.0, 0.0), (30.0, 0.0), (10.0, 0.0))
    scene = reader_for(env, max_agents=max_agents).read(env)
    assert scene.states.shape == (max_agents, 4)
    assert scene.states[scene.valid, 0].tolist() == [0.0, 10.0, -20.0, 30.0, 40.0][:max_agents]


def test_what_is_out_of_sight_changes_nothing(env: gym.Env):
    place(env, (10.0, 0.0), (200.0, 0.0))
    reader = reader_for(env, perception_m=100.0)
    before = reader.read(env)
    hidden = env.unwrapped.road.vehicles[2]
    hidden.position, hidden.speed = np.array([-150.0, 4.0]), 3.0
    after = reader.read(env)
    for name in ("states", "ids", "valid"):
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name))


def test_truth_has_all_agents(env: gym.Env):
    place(env, (10.0, 0.0), (200.0, 0.0), (5000.0, 0.0))
    reader = reader_for(env, perception_m=50.0, max_agents=2)
    seen, truth = reader.read(env), reader.read_all(env)
    assert truth.states[:, 0].tolist() == [0.0, 10.0, 200.0, 5000.0]
    assert truth.valid.all()
    assert truth.ids[:2].tolist() == seen.ids.tolist()


def test_an_id_stays_with_its_vehicle_when_lists_are_sorted_anew(env: gym.Env):
    reader = reader_for(env)
    rng = np.random.default_rng(0)
    vehicles = env.unwrapped.road.vehicles
    number_of: dict[int, int] = {}
    orders = []
    for action in random_actions(env, 5):
        rng.shuffle(vehicles)
        found = by_object(env, reader)
        for number, vehicle in found.items():
            assert number_of.setdefault(id(vehicle), number) == number  # no vehicle leaves this road
        orders.append(list(found))
        env.step(action)
    assert len(set(number_of.values())) == len(number_of)
    assert any(order != sorted(order) for order in orders)


def test_a_vehicle_that_returns_is_the_same(env: gym.Env):
    place(env, (10.0, 0.0), (20.0, 0.0))
    reader = reader_for(env, perception_m=100.0)
    first = reader.read(env).ids[:3].tolist()
    wanderer = env.unwrapped.road.vehicles[1]
    wanderer.position = np.array([500.0, 0.0])
    assert reader.read(env).ids[:3].tolist() == [first[0], first[2], PADDING_ID]
    wanderer.position = np.array([30.0, 0.0])
    assert reader.read(env).ids[:3].tolist() == [first[0], first[2], first[1]]


def test_a_number_is_never_given_twice_although_python_reuses_addresses(env: gym.Env):
    place(env)
    reader = reader_for(env)
    road = env.unwrapped.road
    numbers, addresses = [], []
    for _ in range(20):
        road.vehicles.append(IDMVehicle(road, np.array([10.0, 0.0])))
        numbers.append(int(reader.read(env).ids[1]))
        addresses.append(id(road.vehicles[1]))
        road.vehicles.pop()
    assert len(set(addresses)) < len(addresses)
    assert len(set(numbers)) == len(numbers)


def test_numbering_restarts_at_reset():
    env = SceneObservation(short_env(30))
    first, _ = env.reset(seed=5)
    for action in random_actions(env, 3):
        env.step(action)
    env.reset(seed=6)
    again, _ = env.reset(seed=5)
    np.testing.assert_array_equal(again["scene_ids"], first["scene_ids"])
    assert first["scene_ids"].max() < len(env.unwrapped.road.vehicles)


def test_without_vehicles_there_is_nothing_to_read(env: gym.Env):
    reader = reader_for(env)
    env.unwrapped.road = None
    with pytest.raises(ProtocolError, match="no vehicles yet; call reset"):
        reader.read(env)


def test_scene_before_reset_is_a_protocol_error():
    env = SceneObservation(short_env(30))
    with pytest.raises(ProtocolError, match="no scene yet; call reset"):
        _ = env.scene


def test_other_families_are_named():
    env = gym.make("CartPole-v1")
    with pytest.raises(UserError, match="no scene reader knows CartPoleEnv; pass reader="):
        reader_for(env)
    with pytest.raises(UserError, match="HighwayReader needs a highway-env environment, got CartPoleEnv"):
        HighwayReader(env)


@pytest.mark.parametrize(
    ("perception_m", "max_agents", "words"),
    [
        (0.0, None, "perception_m must be a positive number, got 0.0"),
        (-5.0, None, "perception_m must be a positive number, got -5.0"),
        (None, 0, "max_agents must be a whole number from 1 to 65,536, got 0"),
        (True, None, "perception_m must be a positive number, got True"),
        (None, True, "max_agents must be a whole number from 1 to 65,536, got True"),
    ],
)
def test_impossible_perception_is_named(perception_m: float | None, max_agents: int | None, words: str):
    with pytest.raises(UserError, match=words):
        reader_for(short_env(30), perception_m, max_agents)


def test_a_reader_that_is_made_without_help_checks_its_numbers_too():
    with pytest.raises(UserError, match="max_agents must be a whole number from 1 to 65,536, got 2.7"):
        HighwayReader(short_env(30), max_agents=2.7)  # type: ignore[arg-type]
