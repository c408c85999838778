"""Environments whose own observation is a Dict: its entries stay beside those that are added, in every wrapper."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from stable_baselines3.common.vec_env import DummyVecEnv

from envs.entries import FORECAST_KEYS, PATH_KEYS, SCENE_KEYS
from envs.own_observation import (
    ADDED_KEYS,
    carries_forecasts,
    own_entries,
    own_spaces,
    space_without_added,
    without_added,
)
from envs.parallel import ForecastParallelEnv, batch_forwards
from envs.readers import FunctionReader
from envs.sb3.agents_as_rows import ParallelVecEnv
from envs.sb3.forecast import VecForecast
from envs.vector import VectorForecast
from envs.wrappers import ForecastObservation, SceneObservation
from predictor.support.errors import UserError
from tests.envs.dict_crowd import DictCrowd, dict_swarm
from tests.envs.semantics import Crowd, Swarm, SwarmReader, read_crowd
from tests.envs.testing.test_check_reader import SPEC

OWN = {"table", "goal", "mode"}
ENTRIES = {*FORECAST_KEYS, *PATH_KEYS}
PUSH = np.array([0.3, -0.4], np.float32)


def same(one: Any, other: Any) -> bool:
    return one.keys() == other.keys() and all(np.array_equal(one[key], other[key]) for key in one)


def wrapped(env: gym.Env, **options: Any) -> ForecastObservation:
    reader = FunctionReader(read_crowd, SPEC)
    return ForecastObservation(env, "constant-velocity", reader=reader, **options)


def test_own_entries_stay_beside_the_forecasts():
    plain, env, of_table = DictCrowd(), wrapped(DictCrowd()), wrapped(Crowd())
    assert set(env.observation_space.spaces) == OWN | ENTRIES
    expected, _ = plain.reset(seed=3)
    seen, _ = env.reset(seed=3)
    other, _ = of_table.reset(seed=3)
    for _ in range(5):
        assert env.observation_space.contains({**seen, "mode": int(seen["mode"])})
        assert same({key: seen[key] for key in OWN}, expected)
        assert same(without_added(seen), expected)
        assert same({key: seen[key] for key in ENTRIES}, {key: other[key] for key in ENTRIES})
        expected, *_ = plain.step(PUSH)
        seen, *_ = env.step(PUSH)
        other, *_ = of_table.step(PUSH)


def test_the_scene_is_added_likewise():
    env = SceneObservation(DictCrowd())
    seen, _ = env.reset(seed=0)
    assert set(seen) == set(env.observation_space.spaces) == OWN | set(SCENE_KEYS)
    over_scene = ForecastObservation(env, "constant-velocity")
    assert set(over_scene.observation_space.spaces) == OWN | ENTRIES


def test_flattened_it_is_gymnasiums_order():
    env, flat = wrapped(DictCrowd()), wrapped(DictCrowd(), flatten=True)
    seen, _ = env.reset(seed=1)
    row, _ = flat.reset(seed=1)
    np.testing.assert_array_equal(row, gym.spaces.flatten(env.observation_space, seen))
    assert flat.observation_space.shape == row.shape


@pytest.mark.parametrize("flatten", [False, True])
def test_vector_wrappers_show_what_single_ones_show(flatten: bool):
    single = [wrapped(DictCrowd(), flatten=flatten) for _ in range(2)]
    venv: Any = DummyVecEnv([lambda: SceneObservation(DictCrowd())] * 2)
    venv = VecForecast(venv, "constant-velocity", flatten=flatten)
    made: Any = SyncVectorEnv([lambda: SceneObservation(DictCrowd())] * 2, autoreset_mode=AutoresetMode.SAME_STEP)
    vector = VectorForecast(made, "constant-velocity", flatten=flatten)
    venv.seed(4)
    rows, (columns, _) = venv.reset(), vector.reset(seed=4)
    alone = [env.reset(seed=4 + i)[0] for i, env in enumerate(single)]
    for step in range(9):
        for i in range(2):
            for both in (rows, columns):
                shown = both[i] if flatten else {key: value[i] for key, value in both.items()}
                assert np.array_equal(shown, alone[i]) if flatten else same(shown, alone[i])
        alone = [env.step(PUSH)[0] for env in single]
        rows, _, dones, infos = venv.step(np.stack([PUSH] * 2))
        columns, *_, info = vector.step(np.stack([PUSH] * 2))
        if step == 8:
            assert dones.all()
            for i in range(2):
                for last in (infos[i]["terminal_observation"], info["final_obs"][i]):
                    assert np.array_equal(last, alone[i]) if flatten else same(last, alone[i])


def test_agents_may_have_a_dict_each():
    env, plain = (ForecastParallelEnv(e, "constant-velocity", reader=SwarmReader) for e in (dict_swarm(), Swarm()))
    seen, _ = env.reset(seed=2)
    other, _ = plain.reset(seed=2)
    for _ in range(6):
        for agent, shown in seen.items():
            assert set(shown) == {"observation", "action_mask", *ENTRIES} == set(env.observation_space(agent).spaces)
            assert shown["action_mask"].tolist() == [1, 0]
            assert same({key: shown[key] for key in other[agent]}, other[agent])
        actions = {agent: PUSH for agent in env.agents}
        seen, *_ = env.step(actions)
        other, *_ = plain.step(actions)


def test_copies_share_a_forward_with_dicts_too():
    def make() -> Any:
        return ForecastParallelEnv(dict_swarm(), "constant-velocity", reader=SwarmReader)

    assert batch_forwards([make(), make()]) is not None
    venv = ParallelVecEnv([make] * 2)
    seen = venv.reset()
    assert set(seen) == {"observation", "action_mask", *ENTRIES}
    assert seen["valid"].any() and len(seen["forecast"]) == venv.num_envs


def test_what_cannot_stay_beside_the_forecasts_is_named():
    box = gym.spaces.Box(0, 1, (2,))
    clash = gym.spaces.Dict({"valid": box})
    with pytest.raises(UserError, match=r"of env 'a' has an entry 'valid', as forecasts have; rename it"):
        own_spaces(clash, "env 'a'")
    with pytest.raises(UserError, match=r"must be a flat Dict, but its entry 'deep' is a Dict; flatten it first"):
        own_spaces(gym.spaces.Dict({"deep": clash}), "env 'a'")
    with pytest.raises(UserError, match="must be one array or a Dict of arrays, got Tuple"):
        own_spaces(gym.spaces.Tuple([box]), "env 'a'")

    class Clash(DictCrowd):
        def __init__(self) -> None:
            super().__init__()
            self.observation_space = gym.spaces.Dict({"scene_ids": box})

    with pytest.raises(UserError, match="of env 'Clash' has an entry 'scene_ids'"):
        wrapped(Clash())


def test_every_added_entry_is_known(highway_checkpoint: str):
    """A new entry that is not in the list would be taken for the environment's own."""
    env = ForecastObservation(gym.make("highway-fast-v0"), highway_checkpoint, num_samples=2, what_if=True)
    scenes = SceneObservation(gym.make("highway-fast-v0"))
    added = {*env.observation_space.spaces, *scenes.observation_space.spaces} - {"observation"}
    assert added <= ADDED_KEYS
    assert carries_forecasts(env.observation_space) and not carries_forecasts(scenes.observation_space)
    assert space_without_added(env.observation_space) == gym.make("highway-fast-v0").observation_space


def test_arrays_have_an_entry_of_their_own():
    array = np.zeros(3)
    assert own_entries(array) == {"observation": array} and without_added({"observation": array}) is array
    assert without_added(array) is array
    box = gym.spaces.Box(0, 1, (2,))
    assert space_without_added(box) is box and own_spaces(box, "") == {"observation": box}
