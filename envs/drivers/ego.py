"""Drivers of the ego in data collection and evaluation.

A driver is a partial or a bound method, not a closure: `copy.deepcopy` of a running world copies its state too.
"""

from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from highway_env.vehicle.controller import ControlledVehicle

from envs.drivers.planner import PLANNER, is_planner, planner_driver
from envs.drivers.sampled_actions import uniform_action, varied_actions
from envs.drivers.trained import EgoDriver, kept_policy
from predictor.support.errors import UserError

WHO = "random egos"
EGO_DRIVER_NAMES = ("random", "idle", "varied", "keep-lane", PLANNER)


def make_ego_driver(name: str, env: gym.Env, rng: np.random.Generator) -> EgoDriver:
    """Returns a driver of the ego for one episode.

    Args:
        name: "random" (uniform actions), "idle" (no action), "varied" (each episode draws its own preferences and how
            long a choice is kept), "keep-lane" (steers along its lane; continuous steering only), "planner" (the best
            of its plans by what-if forecasts, `envs.drivers.planner`; "planner:CHECKPOINT" names the forecaster), or
            the path of a Stable-Baselines3 ``.zip``.
        env: the environment that will be driven.
        rng: source of all randomness of this episode.

    Raises:
        UserError: unknown name, or a driver that does not support this action space.
    """
    if name == "random":
        return partial(_random, env.action_space, rng)
    if name == "idle":
        return partial(_constant, idle_action(env))
    if name == "varied":
        return varied_actions(env.action_space, rng, WHO)
    if name == "keep-lane":
        return _keep_lane(env, rng)
    if is_planner(name):
        return planner_driver(name, env, rng)
    if name.endswith(".zip"):
        kept_policy(name)
        return partial(_trained, name)
    raise UserError(f"driver must be one of {', '.join(EGO_DRIVER_NAMES)} or the path of a policy .zip, got '{name}'")


def idle_action(env: gym.Env) -> Any:
    """Returns the action that changes nothing: highway-env's IDLE, or zeros."""
    space = env.action_space
    if isinstance(space, gym.spaces.Discrete):
        indexes = getattr(getattr(env.unwrapped, "action_type", None), "actions_indexes", {})
        return int(indexes.get("IDLE", 0))
    if isinstance(space, gym.spaces.Box):
        return np.zeros(space.shape, dtype=space.dtype)
    raise UserError(f"no idle action is known for {space}")


def _keep_lane(env: gym.Env, rng: np.random.Generator) -> EgoDriver:
    """Follows the current lane with highway-env's own lane controller, with a little steering noise per episode."""
    action_type: Any = getattr(env.unwrapped, "action_type", None)
    if not isinstance(env.action_space, gym.spaces.Box) or not hasattr(action_type, "steering_range"):
        raise UserError(f"keep-lane needs continuous steering, got {env.action_space}; use random, idle or varied")
    return partial(_steer, env, action_type.steering_range[1], rng.uniform(0.0, 0.1), rng)


def _steer(env: gym.Env, range_rad: float, noise: float, rng: np.random.Generator, obs: Any) -> Any:
    vehicle: Any = env.unwrapped.vehicle  # type: ignore[attr-defined]
    driver = ControlledVehicle(vehicle.road, vehicle.position, vehicle.heading, vehicle.speed)
    steering = driver.steering_control(vehicle.lane_index) / range_rad
    action = idle_action(env)
    action[-1] = np.clip(steering + noise * rng.standard_normal(), -1, 1)
    return action


def _random(space: gym.Space, rng: np.random.Generator, obs: Any) -> Any:
    return uniform_action(space, rng, WHO)


def _constant(action: Any, obs: Any) -> Any:
    return np.copy(action) if isinstance(action, np.ndarray) else action


def _trained(path: str, obs: Any) -> Any:
    return kept_policy(path).predict(obs, deterministic=True)[0]
