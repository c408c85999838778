"""`unflatten` is the inverse of `flatten=True`, for every wrapper, one observation or many."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import SyncVectorEnv
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor

from dgvae_rl import unflatten
from envs.parallel import ForecastParallelEnv
from envs.sb3.forecast import VecForecast
from envs.vector import VectorForecast
from envs.wrappers import ForecastObservation, SceneObservation
from predictor.support.errors import UserError
from tests.envs.dict_crowd import DictCrowd, dict_swarm
from tests.envs.semantics import SwarmReader

PUSH = np.array([0.3, -0.4], np.float32)


def equal(one: Any, other: Any) -> None:
    assert one.keys() == other.keys()
    for key in one:
        np.testing.assert_array_equal(one[key], other[key], err_msg=key)
        assert np.shape(one[key]) == np.shape(other[key])


def wrapped(flatten: bool) -> Any:
    return ForecastObservation(DictCrowd(), "constant-velocity", num_samples=2, flatten=flatten)


def test_one_environment():
    env, flat = wrapped(False), gym.wrappers.RecordEpisodeStatistics(wrapped(True))
    seen, row = env.reset(seed=1)[0], flat.reset(seed=1)[0]
    for _ in range(4):
        equal(unflatten(flat, row), seen)
        seen, row = env.step(PUSH)[0], flat.step(PUSH)[0]


def test_many_environments():
    def scenes() -> Any:
        return SceneObservation(DictCrowd())

    venvs: Any = [VecForecast(DummyVecEnv([scenes] * 3), "constant-velocity", flatten=flat) for flat in (False, True)]
    for venv in venvs:
        venv.seed(1)
    seen, rows = venvs[0].reset(), VecMonitor(venvs[1]).reset()
    equal(unflatten(VecMonitor(venvs[1]), rows), seen)
    equal(unflatten(venvs[1], rows[2]), {key: value[2] for key, value in seen.items()})
    made = [VectorForecast(SyncVectorEnv([scenes] * 2), "constant-velocity", flatten=flat) for flat in (False, True)]
    seen, rows = made[0].reset(seed=3)[0], made[1].reset(seed=3)[0]
    equal(unflatten(made[1], rows), seen)


def test_agents():
    envs = [
        ForecastParallelEnv(dict_swarm(), "constant-velocity", reader=SwarmReader, flatten=flat)
        for flat in (False, True)
    ]
    seen, rows = (env.reset(seed=2)[0] for env in envs)
    for agent in seen:
        equal(unflatten(envs[1], rows[agent], agent), seen[agent])
    with pytest.raises(UserError, match="unflatten needs the name of the agent, one of stays, "):
        unflatten(envs[1], rows["stays"])


def test_what_is_no_flattened_observation_is_named():
    flat = wrapped(True)
    row, _ = flat.reset(seed=0)
    with pytest.raises(UserError, match=rf"has {len(row)} numbers, got an array of shape \(3,\)"):
        unflatten(flat, np.zeros(3))
    with pytest.raises(UserError, match="observations are a Dict already"):
        unflatten(wrapped(False), row)
    with pytest.raises(UserError, match="unflatten needs an environment with forecasts, got DictCrowd"):
        unflatten(DictCrowd(), row)
    with pytest.raises(UserError, match="an agent in PettingZoo environments alone, got 'stays'; omit it"):
        unflatten(flat, row, "stays")
