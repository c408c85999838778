"""A trained policy drives a PettingZoo environment: what it learned on is rebuilt for one step of one environment.

Who learned, and who drove the others, is read from the policy's run folder (`train_policy.py` writes it); without one,
all agents are the policy's.
"""

import functools
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np

from envs.drivers.all_agents import Driver, make_driver
from envs.sb3.padded_spaces import SharedObservation, learners_named, own_action, roles_of
from predictor.checkpoint import CONSTANT_VELOCITY
from predictor.errors import UserError

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm

EgoDriver = Callable[[Any], Any]
"""From an observation to an action."""


def trained_driver(path: str, env: Any, rng: np.random.Generator) -> Driver:
    """A driver of all agents for one episode: the policy for those that learned, by name for the others.

    Args:
        path: of an SB3 ``.zip``. It holds pickled data: trust its source.
        env: a `ForecastParallelEnv`, whose observations the driver gets; with several samples, the first one counts.
        rng: of the drivers by name.

    Raises:
        UserError: no such policy, or one of other observations than the environment gives.
    """
    policy = load_policy(path)
    run = _run_of(path)
    learners = learners_named(env.possible_agents, tuple(run.get("learners") or ()), path)
    sees_forecasts = isinstance(policy.observation_space, gym.spaces.Dict)
    spaces = {agent: _seen_space(env.observation_space(agent), sees_forecasts) for agent in learners}
    actions = {agent: env.action_space(agent) for agent in learners}
    padded = SharedObservation(spaces, roles_of(spaces, actions), None)
    if padded.space != policy.observation_space:
        raise UserError(
            f"policy {path} was trained on {_line(policy.observation_space)}, but the env gives {_line(padded.space)}"
        )
    others = (
        make_driver(run.get("partner", "heuristic"), env, rng) if set(learners) < set(env.possible_agents) else None
    )

    def drive(observations: Mapping[str, Any]) -> dict[str, Any]:
        chosen = {} if others is None else others({a: s for a, s in observations.items() if a not in learners})
        for agent in (a for a in observations if a in learners and a in env.agents):
            action, _ = policy.predict(
                padded.one(agent, _seen(observations[agent], sees_forecasts)), deterministic=True
            )
            chosen[agent] = own_action(action, actions[agent])
        return chosen

    return drive


def _run_of(path: str) -> dict[str, Any]:
    try:
        config: dict[str, Any] = json.loads((Path(path).parent / "config.json").read_text())["config"]
    except (OSError, ValueError, KeyError, TypeError):
        return {}
    return config


def _line(space: gym.Space) -> str:
    return " ".join(str(space).split())


def _seen_space(space: gym.Space, sees_forecasts: bool) -> gym.Space:
    """An agent's observation space with one forecast, or without any."""
    assert isinstance(space, gym.spaces.Dict)
    if not sees_forecasts:
        return space["observation"]
    forecast = space["forecast"]
    shape = forecast.shape or ()
    one = gym.spaces.Box(-np.inf, np.inf, (shape[0], *shape[-2:]), np.float32)
    return gym.spaces.Dict({**space.spaces, "forecast": one})


def _seen(observation: Mapping[str, Any], sees_forecasts: bool) -> Any:
    """The observation itself, in that space."""
    if not sees_forecasts:
        return observation["observation"]
    forecast = observation["forecast"]
    return {**observation, "forecast": forecast[:, 0] if forecast.ndim == 4 else forecast}


def env_for_driver(env: gym.Env, name: str) -> gym.Env:
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


def forecaster_of(policy: Path) -> str | None:
    """The checkpoint that the policy's run folder names; None (the one that ships) if there is no such folder."""
    try:
        config = json.loads((policy.parent / "config.json").read_text())["config"]
    except (OSError, ValueError, KeyError):
        return None
    return CONSTANT_VELOCITY if config.get("observe") == CONSTANT_VELOCITY else config.get("checkpoint")
