"""Drivers of the ego in data collection and evaluation.

A driver is a partial, a bound method or an `ActingPolicy`, not a closure: `copy.deepcopy` of a running world copies its
state too.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from highway_env.vehicle.controller import ControlledVehicle

from envs.drivers.own import OwnDriver
from envs.drivers.planner import PLANNER, is_planner, planner_driver
from envs.drivers.trained import EgoDriver, trained_ego
from envs.sampled_actions import first_action, uniform_action, varied_actions
from predictor.own_forecasters import is_own
from predictor.support.errors import UserError

WHO = "random egos"
EGO_DRIVER_NAMES = ("random", "idle", "varied", "keep-lane", PLANNER)
CONSTANT_ACTIONS = "constant-actions"
"""Name that stands for the drivers of all constant actions in a list of drivers."""


def make_ego_driver(name: str, env: gym.Env, rng: np.random.Generator) -> EgoDriver:
    """Returns a driver of the ego for one episode.

    Args:
        name: "random" (uniform actions), "idle" (no action), "varied" (each episode draws its own preferences and how
            long a choice is kept), "keep-lane" (steers along its lane; continuous steering only), "planner" (the best
            of its plans by what-if forecasts, `envs.drivers.planner`; "planner:CHECKPOINT" names the forecaster,
            "planner@0.3" the bound on the risk), an action that is taken in every step, by its name in
            `constant_actions` ("slower", "action-4"), one of a user's own ("own:module:function", `envs.drivers.own`),
            or the path of a Stable-Baselines3 ``.zip``.
        env: the environment that will be driven.
        rng: source of all randomness of this episode.

    Raises:
        UserError: unknown name, or a driver that does not support this action space.
    """
    if name in ("random", "varied"):
        uniform_action(env.action_space, np.random.default_rng(0), WHO)  # so that it fails before the first step
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
    if is_own(name):
        return OwnDriver(name, env, rng)
    if name.endswith(".zip"):
        return trained_ego(name)
    constants = constant_actions(env)
    if name in constants:
        return partial(_constant, constants[name])
    names = ", ".join(dict.fromkeys((*EGO_DRIVER_NAMES, *constants)))
    raise UserError(f"driver must be one of {names}, own:module:function or the path of a policy .zip, got '{name}'")


def constant_actions(env: gym.Env) -> dict[str, int]:
    """Returns the actions of a discrete-action environment by the names of the drivers that take nothing else.

    highway-env's meta-actions have their own names: "lane-left", "idle", "lane-right", "faster", "slower". Others are
    "action-0", "action-1", … Other action spaces have none.
    """
    space = env.action_space
    if not isinstance(space, gym.spaces.Discrete):
        return {}
    labels = {number: label.lower().replace("_", "-") for label, number in _meta_actions(env).items()}
    return {labels.get(n, f"action-{n}"): n for n in range(int(space.start), int(space.start + space.n))}


def named_drivers(names: Sequence[str], env: gym.Env) -> tuple[str, ...]:
    """Returns names of drivers in their order, each once, with those of all constant actions for "constant-actions".

    Raises:
        UserError: all constant actions of an environment whose actions are not discrete.
    """
    if CONSTANT_ACTIONS in names and not constant_actions(env):
        raise UserError(f"{CONSTANT_ACTIONS} needs an environment with discrete actions, got {env.action_space}")
    found = [constant_actions(env) if name == CONSTANT_ACTIONS else (name,) for name in names]
    return tuple(dict.fromkeys(name for group in found for name in group))


def idle_action(env: gym.Env) -> Any:
    """Returns the action that changes nothing: highway-env's IDLE, the first action, or zeros within the bounds.

    Raises:
        UserError: another space.
    """
    first = first_action(env.action_space)
    return _meta_actions(env).get("IDLE", first) if isinstance(env.action_space, gym.spaces.Discrete) else first


def _meta_actions(env: gym.Env) -> dict[str, int]:
    """Returns highway-env's meta-actions; none for other action types and environments."""
    found: dict[str, int] = getattr(getattr(env.unwrapped, "action_type", None), "actions_indexes", {})
    return found


def _keep_lane(env: gym.Env, rng: np.random.Generator) -> EgoDriver:
    """Follows the current lane with highway-env's own lane controller, with a little steering noise per episode."""
    action_type: Any = getattr(env.unwrapped, "action_type", None)
    if not isinstance(env.action_space, gym.spaces.Box) or not getattr(action_type, "lateral", False):
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
