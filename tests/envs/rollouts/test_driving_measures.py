"""Measures of scripted drives on a real road of highway-env."""

import math
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import pytest
from highway_env.vehicle.kinematics import Vehicle

from envs.registry import make_env
from envs.rollouts.driving_measures import LONGEST_S, DrivingMeasures, is_lane_change, next_contact_s, recorder_for

HIGHWAY = "highway-fast-v0"


@pytest.fixture
def env() -> gym.Env:
    """Returns a highway on which the ego is alone, in its second lane at 20 m/s."""
    env = make_env(HIGHWAY)
    env.reset(seed=0)
    base: Any = env.unwrapped
    base.road.vehicles = [base.vehicle]
    place(base, x_m=100.0, lane=1, speed_mps=20.0)
    return env


def place(base: Any, x_m: float, lane: int, speed_mps: float, y_m: float | None = None) -> None:
    """Puts the ego somewhere."""
    ego = base.vehicle
    ego.position[:] = x_m, 4.0 * lane if y_m is None else y_m
    ego.heading, ego.speed = 0.0, speed_mps
    ego.on_state_update()


def drive(env: gym.Env, *moves: Callable[[Any], None]) -> DrivingMeasures:
    """Returns the measures of an episode of one step per move, each of which changes the simulator."""
    recorder = recorder_for(env)
    assert recorder is not None
    recorder.begin()
    for move in moves:
        move(env.unwrapped)
        recorder.note()
    return recorder.measures()


def at_speed(speed_mps: float) -> Callable[[Any], None]:
    """Returns a move after which the ego has this speed."""
    return lambda base: setattr(base.vehicle, "speed", speed_mps)


def in_lane(lane: int, y_m: float | None = None) -> Callable[[Any], None]:
    """Returns a move after which the ego is in this lane, or at this y."""
    return lambda base: place(base, 100.0, lane, 20.0, y_m)


def test_a_car_that_drives_backwards_brakes_where_it_slows_down(env: gym.Env):
    backwards = [at_speed(-4.0 * step) for step in range(1, 3)]
    stop = at_speed(0.0)  # from 20 m/s: the one hard step of three
    assert drive(env, stop, *backwards).hard_brake_share == pytest.approx(1 / 3)
    env.unwrapped.vehicle.speed = 20.0  # type: ignore[attr-defined]
    assert drive(env, stop, *backwards, at_speed(-4.0), stop).hard_brake_share == pytest.approx(3 / 5)


def test_steady_driving_alone(env: gym.Env):
    measures = drive(env, *[at_speed(20.0)] * 4)
    assert measures == DrivingMeasures(4.0, 0.0, 0, LONGEST_S, LONGEST_S, 0.0, 0.0)


def test_times_are_those_that_the_simulator_simulates():
    """Policy steps of 0.2 s; decelerations of 2.5, 3.5 and 2.5 m/s², so jerks of −5 and 5 m/s³."""
    env = make_env("racetrack-v1")
    env.reset(seed=0)
    base: Any = env.unwrapped
    speeds = [base.vehicle.speed - drop for drop in (0.5, 1.2, 1.7)]
    measures = drive(env, *map(at_speed, speeds))
    assert measures.time_s == pytest.approx(0.6)
    assert measures.hard_brake_share == pytest.approx(1 / 3)
    assert measures.jerk_rms_mps3 == pytest.approx(5.0)


def test_braking_is_hard_above_three_metres_per_second_squared(env: gym.Env):
    """Decelerations of 3.0, 3.1, 2.9 and −4.0 m/s² (an acceleration)."""
    speeds = (17.0, 13.9, 11.0, 15.0)
    assert drive(env, *map(at_speed, speeds)).hard_brake_share == pytest.approx(1 / 4)


def test_jerk_is_the_change_of_acceleration(env: gym.Env):
    """Accelerations 0, −2, 1 m/s² in steps of 1 s: jerks of −2 and 3 m/s³."""
    measures = drive(env, *map(at_speed, (20.0, 18.0, 19.0)))
    assert measures.jerk_rms_mps3 == pytest.approx(math.sqrt((4 + 9) / 2))


def test_the_step_of_a_crash_is_no_braking(env: gym.Env):
    def crash(base: Any) -> None:
        base.vehicle.crashed, base.vehicle.speed = True, 0.0

    measures = drive(env, at_speed(20.0), crash)
    assert (measures.hard_brake_share, measures.jerk_rms_mps3) == (0.0, None)
    assert (measures.time_s, measures.min_time_to_contact_s) == (2.0, 0.0)
    at_once = drive(env, crash)
    assert (at_once.hard_brake_share, at_once.jerk_rms_mps3) == (None, None)


def test_lane_changes_are_counted_one_by_one(env: gym.Env):
    measures = drive(env, *map(in_lane, (1, 0, 0, 1, 2, 2)))
    assert (measures.lane_changes, measures.off_road_share) == (3, 0.0)


def test_share_of_steps_beyond_the_road(env: gym.Env):
    """Lanes are 4 m wide with centres at y = 0, 4 and 8 m; a vehicle is where its centre is."""
    measures = drive(env, in_lane(0), in_lane(0, y_m=-1.9), in_lane(0, y_m=-3.5), in_lane(2, y_m=11.5))
    assert (measures.off_road_share, measures.lane_changes) == (0.5, 2)


def test_time_to_contact_of_each_step(env: gym.Env):
    """The ego at 20 m/s, a car at rest with 40, 20, 60 m between the bumpers: 2, 1 and 3 s."""
    base: Any = env.unwrapped
    other = Vehicle(base.road, (0.0, 4.0), 0.0, 0.0)
    far = Vehicle(base.road, (1000.0, 4.0), 0.0, 0.0)
    base.road.vehicles += [other, far]

    def with_gap(gap_m: float) -> Callable[[Any], None]:
        return lambda base: other.position.__setitem__(0, base.vehicle.position[0] + gap_m + 5.0)

    measures = drive(env, *map(with_gap, (40.0, 20.0, 60.0)))
    assert measures.min_time_to_contact_s == pytest.approx(1.0)
    assert measures.low_time_to_contact_s == pytest.approx(1.1)  # 5 % of the way from 1 to 3 s, in halves: 1 + 0.1 · 1
    assert drive(env, with_gap(300.0)).min_time_to_contact_s == LONGEST_S
    other.heading, other.speed = math.pi, 20.0
    other.position[0] = base.vehicle.position[0] + 85.0
    assert next_contact_s(base.road.vehicles) == pytest.approx(2.0)  # head-on, 80 m apart at 40 m/s
    assert math.isinf(next_contact_s([base.vehicle]))


def test_a_lane_goes_on_in_the_next_segment():
    base: Any = make_env("merge-v1").unwrapped
    network = base.road.network
    assert not is_lane_change(network, ("a", "b", 0), ("b", "c", 0))
    assert not is_lane_change(network, ("a", "b", 1), ("b", "c", 1))
    assert not is_lane_change(network, ("k", "b", 0), ("b", "c", 2))  # the ramp becomes the third lane
    assert is_lane_change(network, ("a", "b", 0), ("b", "c", 1))
    assert is_lane_change(network, ("b", "c", 2), ("b", "c", 1))
    assert not is_lane_change(network, ("a", "b", 0), ("c", "d", 1))  # a segment was passed unseen


@pytest.mark.slow
def test_a_played_episode_has_the_measures_of_its_states():
    """A plain loop over the same episode, with what the environment reports."""
    env = make_env(HIGHWAY)
    recorder = recorder_for(env)
    assert recorder is not None
    env.reset(seed=5)
    recorder.begin()
    base: Any = env.unwrapped
    speeds, lanes, ended = [base.vehicle.speed], [base.vehicle.lane_index[2]], False
    env.action_space.seed(2)
    while not ended:
        _, _, terminated, truncated, info = env.step(env.action_space.sample())
        recorder.note()
        speeds.append(info["speed"])
        lanes.append(base.vehicle.lane_index[2])
        ended = terminated or truncated
    measures = recorder.measures()
    drops = [a - b for a, b in zip(speeds, speeds[1:], strict=False)][: len(speeds) - 1 - info["crashed"]]
    assert measures.time_s == len(speeds) - 1
    assert measures.lane_changes == sum(a != b for a, b in zip(lanes, lanes[1:], strict=False)) > 0
    assert measures.hard_brake_share == pytest.approx(sum(drop > 3.0 for drop in drops) / len(drops))
    assert 0 <= measures.min_time_to_contact_s <= measures.low_time_to_contact_s <= LONGEST_S
    assert not info["crashed"] or measures.min_time_to_contact_s == 0.0


def test_other_environments_have_no_measures():
    assert recorder_for(make_env("CartPole-v1")) is None
