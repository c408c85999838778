from collections.abc import Callable
from dataclasses import asdict, astuple, fields, replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from highway_env import utils
from highway_env.envs.common.abstract import AbstractEnv
from highway_env.vehicle.behavior import AggressiveVehicle, DefensiveVehicle, IDMVehicle, LinearVehicle
from highway_env.vehicle.controller import ControlledVehicle
from highway_env.vehicle.kinematics import Vehicle
from hypothesis import given
from hypothesis import strategies as st
from stable_baselines3.common.env_checker import check_env as check_env_sb3

from envs.readers import reader_for
from envs.readers.highway import HighwayReader, vehicles_of
from envs.simulators.costly_collisions import BASE_ID as COSTLY
from envs.simulators.mixed_traffic import (
    BASE_ID,
    DRIVER_KINDS,
    DriverMix,
    KindMix,
    MixedDriver,
    Traits,
    register_scenarios,
)
from predictor.support.errors import UserError
from tests.envs.helpers import random_actions

HIGHWAY = "highway-mixed-v0"
TRAITS = Traits(
    "idm",
    speed_factor=0.5,
    time_gap_s=1.25,
    jam_gap_m=2.0,
    acceleration_mps2=0.75,
    braking_mps2=2.0,
    exponent=3.75,
    politeness=0.5,
    lane_change_gain_mps2=0.4,
)


class Courteous(MixedDriver):
    """A mix of one kind only, as a user would write it."""

    none = KindMix(0.0, (1.0, 1.0), (1.0, 1.0))
    mix = DriverMix(none, none, KindMix(1.0, (0.5, 0.5), (2.0, 2.0)))


def make(env_id: str = HIGHWAY, **config: Any) -> gym.Env:
    return gym.make(env_id, config=config, disable_env_checker=True)


def drivers_of(env: gym.Env) -> list[Any]:
    return [vehicle for vehicle in vehicles_of(env) if isinstance(vehicle, MixedDriver)]


def watch(env: gym.Env, seed: int, steps: int = 6, meanwhile: Callable[[], Any] = lambda: None) -> list[list[Any]]:
    """Where all vehicles are, step by step, and what the drivers are like."""
    env.reset(seed=seed)
    seen = []
    for action in random_actions(env, steps, seed):
        seen.append([(*v.position, v.speed, v.heading, getattr(v, "traits", None)) for v in vehicles_of(env)])
        meanwhile()
        if any(env.step(action)[2:4]):
            break
    return seen


@pytest.fixture
def road() -> Any:
    """Four lanes at y = 0, 4, 8 and 12 m with a limit of 30 m/s, no agent on them."""
    env = make("highway-v0", vehicles_count=1)
    env.reset(seed=0)
    env.unwrapped.road.vehicles = []
    return env.unwrapped.road


def driver(road: Any, traits: Traits = TRAITS, x_m: float = 0.0, speed_mps: float = 20.0, **kwargs: Any) -> MixedDriver:
    return MixedDriver(road, np.array([x_m, 4.0]), 0.0, speed_mps, traits=traits, **kwargs)


@pytest.mark.parametrize(("env_id", "base_id"), BASE_ID.items())
def test_each_id_is_its_base_with_other_drivers(env_id: str, base_id: str):
    env, base = make(env_id), make(base_id)
    assert env.unwrapped.spec.id == env_id
    assert isinstance(env.unwrapped, AbstractEnv) and isinstance(env.unwrapped, type(base.unwrapped))
    assert (env.observation_space, env.action_space) == (base.observation_space, base.action_space)
    changed = {k for k, value in env.unwrapped.config.items() if value != base.unwrapped.config[k]}
    assert changed - {"vehicles_count"} == {"other_vehicles_type"}
    env.reset(seed=0)
    others = vehicles_of(env)[1:]
    assert others and all(type(other) is MixedDriver for other in others)
    assert reader_for(env).spec.dt_s == reader_for(base).spec.dt_s == 1.0


def test_registering_again_changes_nothing():
    before = {env_id: gym.registry[env_id] for env_id in BASE_ID}
    register_scenarios()
    assert all(gym.registry[env_id] is spec for env_id, spec in before.items())


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*value is -?infinity:UserWarning")  # highway-env's own observations
@pytest.mark.filterwarnings("ignore:Your observation  has an unconventional shape:UserWarning")
@pytest.mark.parametrize("env_id", [*BASE_ID, *COSTLY])
def test_contracts_of_gymnasium_and_sb3(env_id: str):
    env = make(env_id)
    check_env(env.unwrapped, skip_render_check=True)
    check_env_sb3(env)
    picture = gym.make(env_id, render_mode="rgb_array", disable_env_checker=True)
    picture.reset(seed=0)
    frame = picture.render()
    assert isinstance(frame, np.ndarray) and frame.ndim == 3
    picture.close()


@pytest.mark.slow
@pytest.mark.parametrize("env_id", BASE_ID)
def test_a_seed_fixes_drivers_and_motion(env_id: str):
    first, again, other = (watch(make(env_id), seed) for seed in (3, 3, 4))
    assert first == again
    assert [line[4] for line in first[0]] != [line[4] for line in other[0]]
    env = make(env_id)
    watch(env, 4)
    assert watch(env, 3) == first  # not the first episode of this env


@pytest.mark.slow
def test_environments_of_one_process_do_not_disturb_each_other():
    alone = watch(make(), 1)
    others = [make(env_id) for env_id in ("intersection-mixed-v0", "intersection-v2", HIGHWAY)]
    for env in others:
        env.reset(seed=2)

    def step_the_others() -> None:
        for env in others:
            if any(env.step(0)[2:4]):
                env.reset()

    assert IDMVehicle.DISTANCE_WANTED == MixedDriver.DISTANCE_WANTED == 7  # highway-env's intersection did that
    assert watch(make(), 1, meanwhile=step_the_others) == alone


def test_constants_of_highway_env_stay():
    classes = (Vehicle, ControlledVehicle, IDMVehicle, LinearVehicle, AggressiveVehicle, DefensiveVehicle)

    def constants() -> list[Any]:
        return [repr({k: v for k, v in vars(c).items() if k.isupper()}) for c in classes]

    before = constants()
    for env_id in BASE_ID:
        watch(make(env_id), 0, steps=2)
    assert constants() == before


def test_kinds_come_as_often_as_configured():
    shares = {"idm": 0.5, "aggressive": 0.2, "defensive": 0.3}
    mix = replace(DriverMix(), **{kind: replace(DriverMix().of(kind), share=share) for kind, share in shares.items()})
    rng = np.random.default_rng(0)
    drawn = [mix.draw(rng).kind for _ in range(4000)]
    for kind, share in shares.items():
        assert drawn.count(kind) / len(drawn) == pytest.approx(share, abs=0.03)  # four standard deviations


@pytest.mark.parametrize("kind", DRIVER_KINDS)
def test_traits_fill_their_ranges(kind: Any):
    mix, rng = DriverMix(), np.random.default_rng(0)
    drawn = [traits for traits in (mix.draw(rng) for _ in range(3000)) if traits.kind == kind]
    for field in fields(Traits)[1:]:
        own = mix.of(kind) if field.name in ("speed_factor", "time_gap_s") else mix
        low, high = getattr(own, field.name)
        values = np.array([getattr(traits, field.name) for traits in drawn])
        assert low <= values.min() < low + 0.02 * (high - low)
        assert high - 0.02 * (high - low) < values.max() <= high
        assert values.mean() == pytest.approx((low + high) / 2, abs=0.05 * (high - low))


@given(st.integers(0, 2**32 - 1), st.sampled_from(DRIVER_KINDS), st.sampled_from(DRIVER_KINDS))
def test_what_comes_after_a_driver_does_not_depend_on_its_kind(seed: int, one: Any, other: Any):
    after = []
    for kind in (one, other):
        only = {k: replace(DriverMix().of(k), share=float(k == kind)) for k in DRIVER_KINDS}
        rng = np.random.default_rng(seed)
        assert replace(DriverMix(), **only).draw(rng).kind == kind
        after.append(rng.random())
    assert after[0] == after[1]


IDM = DriverMix().idm
BAD = {
    "shares-too-many": ({"idm": replace(IDM, share=0.5)}, r"must sum to 1, got \[0.5, 0.33"),
    "share-negative": (
        {"idm": replace(IDM, share=-0.5), "aggressive": replace(DriverMix().aggressive, share=7 / 6)},
        "must not be negative",
    ),
    "range-reversed": ({"exponent": (4.0, 3.0)}, r"exponent needs 0 < low <= high, got \(4, 3\)"),
    "range-negative": ({"politeness": (-0.1, 1.0)}, r"politeness needs 0 <= low <= high, got \(-0.1, 1\)"),
    "braking-zero": ({"braking_mps2": (0.0, 1.0)}, r"braking_mps2 needs 0 < low <= high, got \(0, 1\)"),
    "not-a-number": ({"jam_gap_m": (float("nan"), 1.0)}, "jam_gap_m needs 0 <= low <= high"),
    "of-a-kind": ({"idm": replace(IDM, time_gap_s=(0.0, 1.0))}, "idm.time_gap_s needs 0 < low <= high"),
}


@pytest.mark.parametrize(("changes", "message"), BAD.values(), ids=BAD)
def test_a_mix_that_makes_no_sense_is_refused(changes: dict[str, Any], message: str):
    with pytest.raises(UserError, match=message):
        replace(DriverMix(), **changes)


def test_ranges_may_be_points_and_politeness_zero():
    mix = replace(DriverMix(), politeness=(0.0, 0.0), braking_mps2=(2.0, 2.0))
    assert (mix.draw(np.random.default_rng(0)).politeness, mix.draw(np.random.default_rng(0)).braking_mps2) == (0, 2)


@pytest.mark.parametrize("env_id", BASE_ID)
def test_another_mix_is_a_class_named_in_the_config(env_id: str):
    env = make(env_id, other_vehicles_type=f"{__name__}.Courteous")
    env.reset(seed=0)
    found = {(d.traits.kind, d.traits.speed_factor, d.TIME_WANTED) for d in drivers_of(env)}
    assert found == {("defensive", 0.5, 2.0)}


def test_traits_are_the_parameters_of_the_instance(road: Any):
    made = driver(road)
    expected = {
        "TIME_WANTED": 1.25,
        "DISTANCE_WANTED": 7.0,  # bumper to bumper and one length
        "COMFORT_ACC_MAX": 0.75,
        "COMFORT_ACC_MIN": -2.0,
        "DELTA": 3.75,
        "POLITENESS": 0.5,
        "LANE_CHANGE_MIN_ACC_GAIN": 0.4,
    }
    assert {name: vars(made)[name] for name in expected} == expected
    assert made.target_speed == 0.5 * 30.0
    made.randomize_behavior()
    assert {name: vars(made)[name] for name in expected} == expected


@pytest.mark.parametrize(
    ("kind", "law"), [("idm", IDMVehicle), ("aggressive", AggressiveVehicle), ("defensive", DefensiveVehicle)]
)
@pytest.mark.parametrize(("gap_m", "leader_mps"), [(None, 0.0), (12.0, 25.0), (30.0, 15.0), (80.0, 19.0)])
def test_each_kind_accelerates_like_its_class_of_highway_env(
    road: Any, kind: Any, law: type[IDMVehicle], gap_m: float | None, leader_mps: float
):
    mixed = driver(road, replace(TRAITS, kind=kind))
    plain = law(road, np.array([0.0, 4.0]), 0.0, 20.0, target_speed=15.0)
    for name in ("TIME_WANTED", "DISTANCE_WANTED", "COMFORT_ACC_MAX", "COMFORT_ACC_MIN", "DELTA"):
        setattr(plain, name, getattr(mixed, name))
    leader = None if gap_m is None else Vehicle(road, np.array([gap_m, 4.0]), 0.0, leader_mps)
    assert mixed.acceleration(mixed, leader) == pytest.approx(plain.acceleration(plain, leader), rel=1e-12)
    assert mixed.acceleration(None, leader) == 0  # MOBIL asks so where no agent follows


@pytest.mark.parametrize("kind", DRIVER_KINDS)
def test_all_kinds_steer_alike_and_collect_nothing(road: Any, kind: Any):
    made = driver(road, replace(TRAITS, kind=kind))
    made.position[1] += 1.0
    made.heading = 0.1
    for lane in range(4):
        index = ("0", "1", lane)
        assert made.steering_control(index) == ControlledVehicle.steering_control(made, index)
    made.act()
    assert made.data == {}


@pytest.mark.parametrize("kind", DRIVER_KINDS)
def test_who_yields_brakes_hard_whatever_its_kind(road: Any, kind: Any):
    made = driver(road, replace(TRAITS, kind=kind))
    made.target_speed, made.is_yielding = 0, True
    made.act()
    assert made.action["acceleration"] == -IDMVehicle.ACC_MAX
    made.is_yielding = False
    made.act()
    assert (made.action["acceleration"] == -IDMVehicle.ACC_MAX) == (kind == "idm")


def test_the_road_asks_and_the_driver_makes_its_own_of_it(road: Any):
    made = driver(road)
    for asked_mps in (30.0, 0.0, 12.0):
        made.target_speed = asked_mps
        assert made.target_speed == 0.5 * asked_mps
    assert driver(road, target_speed=10.0).target_speed == 5.0
    assert driver(road, target_speed=0.0).target_speed == 0.0
    road.network.get_lane(("0", "1", 1)).speed_limit = None
    assert driver(road, speed_mps=18.0).target_speed == 9.0


def test_a_driver_created_from_itself_is_the_same_driver(road: Any):
    made = driver(road, target_speed=0.0, enable_lane_change=False, timer=0.25)
    made.target_lane_index, made.route = ("0", "1", 2), [("0", "1", 2)]
    state = road.np_random.bit_generator.state
    copy = MixedDriver.create_from(made)
    assert road.np_random.bit_generator.state == state
    skipped = ("position", "lane", "road", "history", "action", "impact", "log", "data")
    assert {k: v for k, v in vars(copy).items() if k not in skipped} == {
        k: v for k, v in vars(made).items() if k not in skipped
    }
    assert copy.position.tolist() == made.position.tolist() and copy.position is not made.position


def test_a_driver_created_from_another_class_is_new(road: Any):
    plain = IDMVehicle(road, np.array([5.0, 4.0]), 0.0, 22.0, target_speed=28.0)
    copy = MixedDriver.create_from(plain)
    assert copy.target_speed == copy.traits.speed_factor * 28.0
    assert copy.traits != MixedDriver.create_from(plain).traits


def test_traits_last_for_life_and_survive_highway_envs_copies():
    env = make()
    env.reset(seed=0)
    before = [d.traits for d in drivers_of(env)]
    env.step(1)
    assert [d.traits for d in drivers_of(env)] == before
    assert len(set(map(astuple, before))) == len(before)
    for copy in (
        env.unwrapped.change_vehicles("envs.simulators.mixed_traffic.MixedDriver"),
        env.unwrapped.randomize_behavior(),
    ):
        assert [v.traits for v in copy.road.vehicles if isinstance(v, MixedDriver)] == before


@pytest.mark.parametrize("env_id", [HIGHWAY, "roundabout-mixed-v0"])
def test_drawing_trajectories_changes_nothing(env_id: str):
    """highway-env then creates every vehicle anew at every frame."""
    assert watch(make(env_id, show_trajectories=True), 0, 3) == watch(make(env_id), 0, 3)


@pytest.mark.parametrize("env_id", BASE_ID)
def test_no_observation_shows_the_traits(env_id: str):
    env = make(env_id)
    env.reset(seed=0)
    reader = HighwayReader(env)

    def seen() -> tuple[bytes, bytes]:
        return env.unwrapped.observation_type.observe().tobytes(), reader.read(env).states.tobytes()

    before = seen()
    for made in drivers_of(env):
        kind = DRIVER_KINDS[(DRIVER_KINDS.index(made.traits.kind) + 1) % 3]
        other = {name: 2 * value for name, value in asdict(made.traits).items() if name != "kind"}
        made.traits = Traits(kind, **other)
        made.TIME_WANTED *= 2
    assert seen() == before


def test_the_same_scene_has_another_future_with_other_drivers(road: Any):
    """What one snapshot cannot tell: two drivers at the same place and speed, one of whom wishes to go faster."""
    ends = []
    for factor in (0.6, 1.0):
        road.vehicles = [driver(road, replace(TRAITS, speed_factor=factor, acceleration_mps2=1.5))]
        for _ in range(25):
            road.act()
            road.step(0.2)
        ends.append((road.vehicles[0].position[0], road.vehicles[0].speed))
    (slow_m, slow_mps), (fast_m, fast_mps) = ends
    assert fast_m - slow_m > 8.0
    assert slow_mps < 20.0 < fast_mps


def test_the_roundabouts_lanes_have_a_limit_that_its_drivers_know():
    env = make("roundabout-mixed-v0")
    env.reset(seed=0)
    assert {lane.speed_limit for lane in env.unwrapped.road.network.lanes_list()} == {14.0}
    for made in drivers_of(env):
        assert made.target_speed == made.traits.speed_factor * 14.0


def test_the_class_in_the_config_is_found():
    assert utils.class_from_path(make().unwrapped.config["other_vehicles_type"]) is MixedDriver
