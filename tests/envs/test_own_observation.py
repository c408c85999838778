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
    check_own,
    check_reward,
    check_unwrapped,
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
    with pytest.raises(
        UserError,
        match=r"of env 'a' has an entry 'valid', as forecasts have; if it is wrapped",
    ):
        own_spaces(clash, "env 'a'")
    with pytest.raises(UserError, match=r"must be a flat Dict, but its entry 'deep' is a Dict; flatten it first"):
        own_spaces(gym.spaces.Dict({"deep": clash}), "env 'a'")
    with pytest.raises(UserError, match="must be one array or a Dict of arrays, got Tuple"):
        own_spaces(gym.spaces.Tuple([box]), "env 'a'")
    with pytest.raises(UserError, match="a Dict whose only entry is 'observation', the name under which wrappers"):
        own_spaces(gym.spaces.Dict({"observation": box}), "env 'a'")

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
    assert own_entries(array) == {"observation": array} and without_added({"observation": array, "valid": 1}) is array
    assert without_added(array) is array
    box = gym.spaces.Box(0, 1, (2,))
    assert space_without_added(box) is box and own_spaces(box, "") == {"observation": box}
    assert space_without_added(gym.spaces.Dict({"observation": box, "valid": box})) is box


def test_a_dict_to_which_nothing_was_added_stays():
    """An environment's own observation may be a Dict with this one entry."""
    seen, space = {"observation": np.zeros(2)}, gym.spaces.Dict({"observation": gym.spaces.Box(0, 1, (2,))})
    assert without_added(seen) is seen and space_without_added(space) is space


def test_names_of_added_entries_are_refused_without_forecasts_too(highway_checkpoint: str):
    box = gym.spaces.Box(0, 1, (2,))
    with pytest.raises(
        UserError,
        match=r"of env 'a' has an entry 'agents', as forecasts have; if it is wrapped",
    ):
        check_unwrapped(gym.spaces.Dict({"agents": box, "position": box}), "env 'a'")
    for space in (box, gym.spaces.Dict({"position": box}), gym.spaces.Tuple([box])):
        check_unwrapped(space, "env 'a'")
    inside = gym.make("highway-fast-v0")
    check_unwrapped(ForecastObservation(inside, highway_checkpoint).observation_space, "env 'a'")
    check_unwrapped(SceneObservation(inside).observation_space, "env 'a'")


BOX = gym.spaces.Box(-1, 1, (2,), np.float32)
IMAGE = gym.spaces.Box(0, 255, (2, 2), np.uint8)
BOTH = gym.spaces.Dict({"place": BOX, "mode": gym.spaces.Discrete(3)})


@pytest.mark.parametrize(
    ("space", "seen"),
    [
        (BOX, np.array([1.5, -np.inf])),  # beyond its bounds, of float64
        (BOX, [0, 1]),
        (gym.spaces.Box(-np.inf, np.inf, (2,)), np.array([3, 4])),
        (IMAGE, np.full((2, 2), 255)),
        (gym.spaces.Box(0, np.inf, ()), 3.0),
        (gym.spaces.Discrete(3), np.array([2])),
        (gym.spaces.MultiBinary(2), np.array([True, False])),
        (BOTH, {"place": np.zeros(2), "mode": np.int64(1), "further": "kept"}),
    ],
)
def test_what_lies_in_its_space_is_taken(space: gym.Space, seen: Any):
    check_own(own_spaces(space, "env 'a'"), seen, "env 'a'")


@pytest.mark.parametrize(
    ("space", "seen", "message"),
    [
        (BOX, np.zeros((2, 1)), r"got float64 of the shape \(2, 1\)"),
        (BOX, np.array(["a", "b"]), r"got <U1 of the shape \(2,\)"),
        (BOX, np.array([np.nan, 0]), "got nan"),
        (BOX, [[1.0], [1.0, 2.0]], "got a list"),
        (IMAGE, np.full((2, 2), 0.5), "got numbers of type float64"),
        (
            IMAGE,
            np.full((2, 2), 256),
            r" must lie in its space Box\(0, 255, \(2, 2\), uint8\), got 256; change the observation",
        ),
        (IMAGE, np.full((2, 2), -1), "got -1"),
        (gym.spaces.Discrete(3), 3, "got 3"),
        (gym.spaces.Discrete(3), np.zeros(2, int), r"got \[0 0\]"),
        (BOTH, {"place": np.zeros(3), "mode": 1}, r", entry 'place', must lie in its space .*of the shape \(3,\)"),
        (BOTH, {"place": np.zeros(2)}, r"must have the entries \['mode', 'place'\] of its .*, got \['place'\]; return"),
        (BOTH, np.zeros(2), r"must have the entries \['mode', 'place'\] of its .*, got \['observation'\]"),
    ],
)
def test_an_observation_outside_of_its_space_is_named(space: gym.Space, seen: Any, message: str):
    with pytest.raises(UserError, match=f"the own observation of env 'a'.*{message}"):
        check_own(own_spaces(space, "env 'a'"), seen, "env 'a'")


@pytest.mark.parametrize("reward", [None, "much", float("nan"), float("inf"), [1.0, np.nan], {}])
def test_a_reward_that_is_no_number_is_named(reward: Any):
    with pytest.raises(UserError, match="the reward of env 'a' must be a finite number, got .*; return a float"):
        check_reward(reward, "env 'a'")


def test_one_ego_is_checked_at_its_first_reset_and_step():
    class Wrong(Crowd):
        observation_space = gym.spaces.Box(0, 255, Crowd.observation_space.shape, np.uint8)

    class Silent(Crowd):
        def step(self, action: Any) -> Any:
            return *super().step(action)[:1], None, *super().step(action)[2:]

    with pytest.raises(UserError, match="of env 'Wrong' must lie in its space .*uint8.*, got numbers of type float64"):
        wrapped(Wrong()).reset(seed=0)
    env = wrapped(Silent())
    env.reset(seed=0)
    with pytest.raises(UserError, match="the reward of env 'Silent' must be a finite number, got None"):
        env.step(PUSH)


def test_each_of_many_learners_is_checked_at_the_first_reset_and_step():
    class Wrong(Swarm):
        def observation_space(self, agent: str) -> gym.Space:
            return BOX if agent == "dies" else super().observation_space(agent)

    class Silent(Swarm):
        def step(self, actions: Any) -> Any:
            shown, rewards, *others = super().step(actions)
            return shown, dict.fromkeys(rewards, np.nan), *others

    env = ForecastParallelEnv(Wrong(), "constant-velocity", reader=SwarmReader)
    with pytest.raises(UserError, match=r"of 'dies' of env 'swarm_v0' must lie in its space .*of the shape \(1,\)"):
        env.reset(seed=0)
    env = ForecastParallelEnv(Silent(), "constant-velocity", reader=SwarmReader)
    env.reset(seed=0)
    with pytest.raises(UserError, match="the reward of 'stays' of env 'swarm_v0' must be a finite number, got nan"):
        env.step(dict.fromkeys(env.agents, PUSH))
