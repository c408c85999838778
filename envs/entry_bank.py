"""Records forecast entries of other episodes, which the arm "shuffled" shows instead of those of the present scene."""

from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from envs.arms import Arm, EntryBank
from envs.own_observation import ADDED_KEYS
from envs.parallel import ForecastParallelEnv, living
from envs.seeding import driver_rng
from envs.wrappers import ForecastObservation
from predictor.support.errors import UserError

FIRST_SEED = 2_100_000_000
"""Seed of the first recorded episode; training, model selection and evaluation use lower ones (`agents.task`), and
EnvPool tells no others apart."""
EPISODES = 20
"""Number of recorded episodes."""
MAX_STEPS = 50
"""Number of steps of an episode that are recorded at most."""

Wrapper = ForecastObservation | ForecastParallelEnv


def record_bank(env: Wrapper, source: str, episodes: int = EPISODES) -> EntryBank:
    """Plays episodes with random actions and keeps the forecast entries of all scenes with another agent; closes `env`.

    Args:
        env: environment in a wrapper with forecasts, of the arm "forecast" and not flattened.
        source: description of environment and forecaster.
        episodes: number of episodes; episode i is reset with FIRST_SEED + i.

    Raises:
        UserError: another arm, a flattened observation, or no scene with another agent.
    """
    shown = (
        env.observation_space(env.possible_agents[0]) if isinstance(env, ForecastParallelEnv) else env.observation_space
    )
    arm = env.stream.config.arm.name
    if arm != Arm().name or not isinstance(shown, gym.spaces.Dict):
        raise UserError(
            f"a bank is recorded with the arm '{Arm().name}' and flatten=False, got the arm '{arm}' and a "
            f"{type(shown).__name__} observation"
        )
    found: list[dict[str, NDArray[Any]]] = []
    for episode in range(episodes):
        rng = driver_rng(FIRST_SEED + episode)
        observations, _ = env.reset(seed=FIRST_SEED + episode)
        for _ in range(MAX_STEPS):
            seen = observations.values() if isinstance(env, ForecastParallelEnv) else [observations]
            found += [one for one in seen if one["valid"].any()]
            observations, over = _random_step(env, rng)
            if over:
                break
    env.close()
    if not found:
        raise UserError(f"the arm 'shuffled' needs scenes with another agent, {source} had none in {episodes} episodes")
    return EntryBank(source, {key: np.stack([one[key] for one in found]) for key in found[0] if key in ADDED_KEYS})


def _random_step(env: Wrapper, rng: np.random.Generator) -> tuple[Any, bool]:
    """Steps with random actions; returns the observations and whether the episode is over."""
    if isinstance(env, ForecastParallelEnv):
        actions = {agent: _drawn(env.action_space(agent), rng) for agent in env.agents}
        observations, _, ended, cut, _ = env.step(actions)
        return observations, not living(env, ended, cut)
    observation, _, terminated, truncated, _ = env.step(_drawn(env.action_space, rng))
    return observation, bool(terminated or truncated)


def _drawn(space: gym.Space, rng: np.random.Generator) -> Any:
    space.seed(int(rng.integers(2**31)))
    return space.sample()
