"""A trained policy drives a PettingZoo environment: the rows it learned on, rebuilt for one step of one environment.

Who learned, and who drove the others, is read from the policy's run folder (`train_policy.py` writes it); without one,
all agents are the policy's.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from envs.drivers import Driver, make_driver
from envs.egos import load_policy
from envs.multiagent_spaces import SharedObservation, learners_named, own_action, roles_of
from predictor.errors import UserError


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
    rows = SharedObservation(spaces, roles_of(spaces, actions), None)
    if rows.space != policy.observation_space:
        raise UserError(
            f"policy {path} was trained on {_line(policy.observation_space)}, but the env gives {_line(rows.space)}"
        )
    others = (
        make_driver(run.get("partner", "heuristic"), env, rng) if set(learners) < set(env.possible_agents) else None
    )

    def drive(observations: Mapping[str, Any]) -> dict[str, Any]:
        chosen = {} if others is None else others({a: s for a, s in observations.items() if a not in learners})
        for agent in (a for a in observations if a in learners and a in env.agents):
            action, _ = policy.predict(rows.one(agent, _seen(observations[agent], sees_forecasts)), deterministic=True)
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
