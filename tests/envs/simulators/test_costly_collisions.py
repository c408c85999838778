from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from envs.plans.highway import HighwayPlans
from envs.readers import reader_for
from envs.readers.highway import vehicles_of
from envs.registry import entry_for
from envs.simulators.costly_collisions import BASE_ID
from tests.envs.helpers import random_actions

CROSSING = "intersection-costly-v0"


def make(env_id: str) -> gym.Env:
    return gym.make(env_id, disable_env_checker=True)


def watched(env: gym.Env, seed: int, steps: int) -> list[list[tuple[float, ...]]]:
    """Where all vehicles are, step by step."""
    env.reset(seed=seed)
    seen = []
    for action in random_actions(env, steps, seed):
        seen.append([(*v.position, v.speed, v.heading) for v in vehicles_of(env)])
        if any(env.step(action)[2:4]):
            break
    return seen


@pytest.mark.slow
@pytest.mark.parametrize(("env_id", "base_id"), BASE_ID.items())
def test_each_id_has_the_traffic_of_its_base_and_other_rewards(env_id: str, base_id: str):
    env, base = make(env_id), make(base_id)
    assert env.unwrapped.spec.id == env_id and isinstance(env.unwrapped, type(base.unwrapped))
    assert (env.observation_space, env.action_space) == (base.observation_space, base.action_space)
    changed = {k for k, value in env.unwrapped.config.items() if value != base.unwrapped.config[k]}
    assert "collision_reward" in changed
    assert all("reward" in name for name in changed - {"duration"})
    assert reader_for(env).spec == reader_for(base).spec
    assert entry_for(env_id).checkpoint == entry_for(base_id).checkpoint
    for seed in range(3):
        assert watched(env, seed, 8) == watched(base, seed, 8)


def test_a_collision_costs_a_minute_of_the_best_driving():
    env = make("highway-mixed-costly-v0")
    env.reset(seed=0)
    ego = env.unwrapped.vehicle
    ego.speed = 30.0
    ego.target_lane_index = ego.lane_index = ("0", "1", 2)
    ego.lane = env.unwrapped.road.network.get_lane(ego.lane_index)
    ego.position = ego.lane.position(100.0, 0.0)
    best = env.unwrapped._reward(1)
    ego.crashed = True
    assert best == pytest.approx(0.05) and env.unwrapped._reward(1) == pytest.approx(best - 60 * 0.05)


def reward_of(env: Any, speed_mps: float, crashed: bool = False) -> float:
    ego = env.unwrapped.vehicle
    ego.speed, ego.crashed = speed_mps, crashed
    return float(env.unwrapped._reward(1))


def test_a_way_through_the_crossing_brings_the_same_at_any_speed():
    env = make(CROSSING)
    env.reset(seed=0)
    slow, fast = (reward_of(env, speed) / speed for speed in (3.0, 9.0))
    assert slow == pytest.approx(fast) == pytest.approx(0.05 / 9)
    assert reward_of(env, 0.0) == 0.0
    assert reward_of(env, 9.0, crashed=True) == pytest.approx(0.05 - 2.0)


def test_who_arrives_earns_one_and_the_episode_ends(monkeypatch: pytest.MonkeyPatch):
    env = make(CROSSING)
    env.reset(seed=0)
    monkeypatch.setattr(env.unwrapped, "has_arrived", lambda vehicle, exit_distance=25: True)
    _, reward, terminated, truncated, _ = env.step(1)
    assert (reward, terminated, truncated) == (1.0, True, False)


@pytest.mark.slow
def test_a_driver_that_waits_has_twenty_seconds():
    env, steps, over = make(CROSSING), 0, False
    env.reset(seed=0)
    while not over:
        _, _, terminated, truncated, _ = env.step(0)
        over, steps = terminated or truncated, steps + 1
    assert (steps, terminated, truncated) == (20, False, True)


def test_plans_know_what_progress_brings():
    env = make(CROSSING)
    env.reset(seed=0)
    plans = HighwayPlans(env)
    made = plans.plans(env, 4)
    returns = dict(zip(plans.names, made.rewards.sum(-1).tolist(), strict=True))
    assert returns["SLOWER"] < returns["IDLE"] <= returns["FASTER"]
    np.testing.assert_allclose(made.crash_rewards, made.rewards - 2.0, atol=1e-6)
