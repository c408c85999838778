"""Ways to drive the ego while data is collected or accuracy is measured."""

import functools
import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from highway_env.vehicle.controller import ControlledVehicle

from envs.habits import uniform_action, varied_actions
from predictor.checkpoint import CONSTANT_VELOCITY
from predictor.errors import UserError

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm

Ego = Callable[[Any], Any]
"""From an observation to an action."""

WHO = "random egos"
EGO_NAMES = ("random", "idle", "varied", "keep-lane")


def make_ego(name: str, env: gym.Env, rng: np.random.Generator) -> Ego:
    """An ego for one episode.

    Args:
        name: "random" (uniform actions), "idle" (no action), "varied" (each episode draws its own preferences and how
            long it keeps to a choice), "keep-lane" (steers along its lane; continuous steering only), or the path of a
            Stable-Baselines3 ``.zip``.
        env: the environment that will be driven.
        rng: source of all randomness of this episode.

    Raises:
        UserError: unknown name, or an ego that cannot drive this action space.
    """
    if name == "random":
        return lambda obs: uniform_action(env.action_space, rng, WHO)
    if name == "idle":
        action = idle_action(env)
        return lambda obs: np.copy(action) if isinstance(action, np.ndarray) else action
    if name == "varied":
        return varied_actions(env.action_space, rng, WHO)
    if name == "keep-lane":
        return _keep_lane(env, rng)
    if name.endswith(".zip"):
        return _trained(name)
    raise UserError(f"ego must be one of {', '.join(EGO_NAMES)} or the path of a policy .zip, got '{name}'")


def idle_action(env: gym.Env) -> Any:
    """The action that changes nothing: highway-env's IDLE, or zeros."""
    space = env.action_space
    if isinstance(space, gym.spaces.Discrete):
        indexes = getattr(getattr(env.unwrapped, "action_type", None), "actions_indexes", {})
        return int(indexes.get("IDLE", 0))
    if isinstance(space, gym.spaces.Box):
        return np.zeros(space.shape, dtype=space.dtype)
    raise UserError(f"no idle action is known for {space}")


def _keep_lane(env: gym.Env, rng: np.random.Generator) -> Ego:
    """Follow the current lane with highway-env's own lane controller, with a little steering noise per episode."""
    action_type: Any = getattr(env.unwrapped, "action_type", None)
    if not isinstance(env.action_space, gym.spaces.Box) or not hasattr(action_type, "steering_range"):
        raise UserError(f"keep-lane needs continuous steering, got {env.action_space}; use random, idle or varied")
    noise = rng.uniform(0.0, 0.1)

    def act(obs: Any) -> Any:
        vehicle: Any = env.unwrapped.vehicle  # type: ignore[attr-defined]
        driver = ControlledVehicle(vehicle.road, vehicle.position, vehicle.heading, vehicle.speed)
        steering = driver.steering_control(vehicle.lane_index) / action_type.steering_range[1]
        action = idle_action(env)
        action[-1] = np.clip(steering + noise * rng.standard_normal(), -1, 1)
        return action

    return act


def env_for_ego(env: gym.Env, name: str) -> gym.Env:
    """The env as the ego wants to see it: with forecasts for a policy that was trained on them, else as it is.

    Raises:
        UserError: no such policy, or one of other observations.
    """
    if not name.endswith(".zip"):
        return env
    if sees_forecasts(name):
        from envs.wrappers import ForecastObservation  # the wrappers need no egos; most egos need no wrappers

        env = ForecastObservation(env, forecaster_of(Path(name)))
    require_view(env, name)
    return env


def require_view(env: gym.Env, name: str) -> None:
    """Raise a `UserError` if the ego is a policy that was trained on other observations than the env gives."""
    if not name.endswith(".zip"):
        return
    wanted = load_policy(name).observation_space
    if env.observation_space != wanted:
        raise UserError(f"policy {name} was trained on {wanted}, but the env gives {env.observation_space}")


def sees_forecasts(name: str) -> bool:
    """Whether the ego is a policy that was trained on forecasts."""
    return name.endswith(".zip") and isinstance(load_policy(name).observation_space, gym.spaces.Dict)


@functools.cache
def load_policy(path: str) -> "BaseAlgorithm":
    """A PPO or DQN policy of Stable-Baselines3, loaded once per process. Its zip holds pickled data: trust its source.

    Raises:
        UserError: not there, or neither PPO nor DQN.
    """
    from stable_baselines3 import DQN, PPO

    if not Path(path).exists():
        raise UserError(f"no policy at {path}; train one with python train_policy.py")
    for algorithm in (PPO, DQN):
        try:
            return algorithm.load(path, device="cpu")
        except (TypeError, KeyError, AttributeError, ValueError, AssertionError):
            continue
    raise UserError(f"{path} is neither a PPO nor a DQN policy")


def _trained(path: str) -> Ego:
    policy = load_policy(path)
    return lambda obs: policy.predict(obs, deterministic=True)[0]


def forecaster_of(policy: Path) -> str | None:
    """The checkpoint that the policy's run folder names; None (the one that ships) if there is no such folder."""
    try:
        config = json.loads((policy.parent / "config.json").read_text())["config"]
    except (OSError, ValueError, KeyError):
        return None
    return CONSTANT_VELOCITY if config.get("observe") == CONSTANT_VELOCITY else config.get("checkpoint")
