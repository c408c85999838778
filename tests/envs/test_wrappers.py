from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import FlattenObservation
from stable_baselines3.common.env_checker import check_env as check_env_for_sb3

from envs.entries import FORECAST_KEYS, PATH_KEYS, ego_entries
from envs.observation import SCENE_KEYS
from envs.readers import FunctionReader
from envs.readers.base import Reader
from envs.registry import CHECKPOINTS, checkpoint_for, make_env
from envs.wrappers import ForecastObservation, SceneObservation
from predictor.checkpoint import load_checkpoint
from predictor.scene import Scene, SceneBatch, SceneSpec
from predictor.support.errors import ProtocolError, UserError
from tests.envs.helpers import (
    HIGHWAY_SPEC,
    HORIZON,
    MAX_AGENTS,
    PERCEPTION_M,
    NamedReader,
    ShuffledReader,
    assert_same,
    forecast_of_history,
    largest_difference,
    light_env,
    play,
    random_actions,
    short_env,
)
from tests.envs.own_code import READER

KINDS = ("scene", "forecast", "flat")

# What the checkers warn about is not the wrappers' doing, or is meant:
CHECKER_WARNINGS = (
    # … the wrapped env is what we check;
    r"ignore:.*is different from the unwrapped version:UserWarning",
    # … metres and m/s have no bound, neither here nor in highway-env's own observation;
    r"ignore:.*A Box observation space (minimum|maximum) value is (-?)infinity:UserWarning",
    # … SB3 takes every 3-D entry for an image (the forecast, and highway-env's occupancy grids) and expects vectors
    # elsewhere; agents × features is for agents.features, MlpPolicy gets flatten=True.
    r"ignore:It seems that your observation .*is an image:UserWarning",
    r"ignore:The minimal resolution for an image:UserWarning",
    r"ignore:Your observation .*has an unconventional shape:UserWarning",
)


def wrap(env: gym.Env, kind: str, checkpoint: str) -> gym.Env:
    if kind == "scene":
        return SceneObservation(env)
    return ForecastObservation(env, checkpoint, flatten=kind == "flat")


def ignore_checker_warnings(test: Any) -> Any:
    for line in CHECKER_WARNINGS:
        test = pytest.mark.filterwarnings(line)(test)
    return test


@ignore_checker_warnings
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("env_id", CHECKPOINTS)
def test_gymnasium_accepts(env_id: str, kind: str, checkpoint_of: dict[str, str]):
    check_env(wrap(light_env(env_id), kind, checkpoint_of[env_id]), skip_render_check=True)


@ignore_checker_warnings
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("env_id", CHECKPOINTS)
def test_sb3_accepts(env_id: str, kind: str, checkpoint_of: dict[str, str]):
    check_env_for_sb3(wrap(light_env(env_id), kind, checkpoint_of[env_id]))


@pytest.mark.parametrize("num_samples", [1, 3])
@pytest.mark.parametrize("env_id", CHECKPOINTS)
def test_same_seed_same_sequences(env_id: str, num_samples: int, checkpoint_of: dict[str, str]):
    def make() -> gym.Env:
        return ForecastObservation(light_env(env_id), checkpoint_of[env_id], num_samples=num_samples)

    env = make()
    actions = random_actions(env, 3)
    first, again, other = play(env, actions, seed=7), play(make(), actions, seed=7), play(env, actions, seed=7)
    assert len(first) > 1
    for run in (again, other):
        assert [step[1:] for step in run] == [step[1:] for step in first]
        for (obs, *_), (expected, *_) in zip(run, first, strict=True):
            assert_same(obs, expected, tolerance=0.0)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("env_id", ["highway-fast-v0", "two-way-v0", "intersection-v2", "racetrack-v1"])
def test_own_observation_and_rewards_are_untouched(env_id: str, kind: str, checkpoint_of: dict[str, str]):
    bare, wrapped = make_env(env_id), wrap(make_env(env_id), kind, checkpoint_of[env_id])
    actions = random_actions(bare, 3)
    expected, actual = play(bare, actions, seed=1), play(wrapped, actions, seed=1)
    assert [step[1:] for step in actual] == [step[1:] for step in expected]
    for (obs, *_), (own, *_) in zip(actual, expected, strict=True):
        if kind == "flat":
            obs = gym.spaces.unflatten(wrapped._layout.dict_space, obs)
        np.testing.assert_array_equal(obs["observation"], own)


# --- What the observation holds ---------------------------------------------------------------------------------------


def test_scene_entries(highway_checkpoint: str):
    env = SceneObservation(short_env(10), PERCEPTION_M, MAX_AGENTS)
    obs, _ = env.reset(seed=0)
    assert set(obs) == {"observation", *SCENE_KEYS}
    np.testing.assert_array_equal(obs["scene_states"], env.scene.states)
    np.testing.assert_array_equal(obs["scene_ids"], env.scene.ids)
    np.testing.assert_array_equal(obs["scene_states"][0, :2], env.unwrapped.vehicle.position)
    assert obs["scene_states"].dtype == np.float64
    assert env.scene_source == "highway-fast-v0"
    assert (env.scene_spec.perception_m, env.scene_spec.max_agents) == (PERCEPTION_M, MAX_AGENTS)


def test_forecast_entries_take_their_sizes_from_the_checkpoint(highway_checkpoint: str):
    env = ForecastObservation(short_env(10), highway_checkpoint)
    obs, _ = env.reset(seed=0)
    others = MAX_AGENTS - 1
    assert {key: value.shape for key, value in obs.items()} == {
        "observation": (5, 5),
        "agents": (others, 4),
        "forecast": (others, HORIZON, 2),
        "edge_probs": (others, 2),
        "edge_features": (others, 6),
        "valid": (others,),
        "ego_path": (HORIZON, 2),
        "closest": (others, 2),
    }
    assert {value.dtype for value in obs.values()} == {np.dtype(np.float32)}
    assert env.get_wrapper_attr("scene_spec") == HIGHWAY_SPEC


def test_arguments_go_before_the_checkpoint(highway_checkpoint: str):
    env = ForecastObservation(
        short_env(10), highway_checkpoint, horizon_steps=7, num_samples=2, perception_m=25.0, max_agents=3
    )
    obs, _ = env.reset(seed=0)
    assert obs["forecast"].shape == (2, 2, 7, 2)
    distance_m = np.hypot(*obs["agents"][obs["valid"] == 1, :2].T)
    assert (distance_m <= 25.0).all()
    assert obs in env.observation_space


def test_entries_are_the_ego_view_of_scene_and_forecast(racetrack_checkpoint: str):
    """The track bends, so that the ego's axes are not the world's."""
    env = ForecastObservation(make_env("racetrack-v1"), racetrack_checkpoint)
    for obs, *_ in play(env, random_actions(env, 4), seed=0):
        last = obs
    expected = ego_entries(SceneBatch.stack([env.scene]), env.forecast)
    assert_same({key: last[key] for key in FORECAST_KEYS}, {key: value[0] for key, value in expected.items()}, 0.0)
    assert last["valid"].any()
    assert abs(env.scene.heading_rad) > 1e-3


def test_constant_velocity_meets_the_simulator():
    """The first forecast step of an unperturbed car is where highway-env then puts it."""
    env = ForecastObservation(short_env(10), "constant-velocity")
    obs, _ = env.reset(seed=0)
    ego, ahead = env.unwrapped.vehicle, env.unwrapped.road.vehicles[1]
    ahead.act = lambda action=None: ahead.action.update(acceleration=0.0, steering=0.0)
    row = int(np.argmin(np.abs(obs["agents"][:, :2] - (ahead.position - ego.position)).sum(-1)))
    before_m = ego.position.copy()
    env.step(1)
    np.testing.assert_allclose(obs["forecast"][row, 0], ahead.position - before_m, atol=1e-3)


def test_flat_is_the_dict_in_key_order(highway_checkpoint: str):
    nested = ForecastObservation(short_env(10), highway_checkpoint, num_samples=2)
    flat = ForecastObservation(short_env(10), highway_checkpoint, num_samples=2, flatten=True)
    space = nested.observation_space
    assert isinstance(space, gym.spaces.Dict)
    expected, _ = nested.reset(seed=4)
    actual, _ = flat.reset(seed=4)
    assert actual.dtype == np.float32
    np.testing.assert_array_equal(actual, np.concatenate([expected[key].ravel() for key in space]))
    assert flat.observation_space == gym.spaces.flatten_space(space)


def test_a_scene_observation_below_is_used(highway_checkpoint: str):
    below = SceneObservation(short_env(10), PERCEPTION_M, MAX_AGENTS)
    actions = [1, 0, 3]
    expected = play(ForecastObservation(short_env(10), highway_checkpoint), actions, seed=3)
    actual = play(ForecastObservation(below, highway_checkpoint), actions, seed=3)
    for (obs, *_), (want, *_) in zip(actual, expected, strict=True):
        assert_same(obs, want, tolerance=0.0)


def test_ego_alone(highway_checkpoint: str):
    env = ForecastObservation(short_env(10, vehicles=0), highway_checkpoint)
    for obs, *_ in play(env, [1, 1], seed=0):
        assert all((obs[key] == 0).all() for key in FORECAST_KEYS)


# --- History ----------------------------------------------------------------------------------------------------------


def test_each_forecast_comes_from_the_history_of_its_episode_alone(highway_checkpoint: str):
    env = ForecastObservation(short_env(4), highway_checkpoint)
    model, _ = load_checkpoint(highway_checkpoint)
    lengths = []
    for seed in (0, 1):
        obs, _ = env.reset(seed=seed)
        scenes: list[Scene] = [env.scene]
        for action in random_actions(env, 10):
            entries = forecast_of_history(model, HIGHWAY_SPEC, scenes)
            assert_same({key: obs[key] for key in (*FORECAST_KEYS, *PATH_KEYS)}, entries)
            obs, _, terminated, truncated, _ = env.step(action)
            scenes.append(env.scene)
            if terminated or truncated:
                break
        newest = forecast_of_history(model, HIGHWAY_SPEC, scenes[-1:])
        assert largest_difference(obs, newest) > 1e-3  # the history has a say
        lengths.append(len(scenes))
    assert lengths == [5, 5]


def test_reset_forgets(highway_checkpoint: str):
    seasoned, fresh = (ForecastObservation(short_env(10), highway_checkpoint) for _ in range(2))
    play(seasoned, [1, 1, 1], seed=0)
    for (obs, *_), (want, *_) in zip(play(seasoned, [1, 3], 5), play(fresh, [1, 3], 5), strict=True):
        assert_same(obs, want, tolerance=0.0)


def test_memory_follows_the_vehicle_not_the_place(highway_checkpoint: str):
    def make(**kwargs: Any) -> gym.Env:
        return ForecastObservation(short_env(10), highway_checkpoint, **kwargs)

    actions = [0, 2, 3, 1, 1]
    steps = play(make(reader=ShuffledReader), actions, seed=2), play(make(), actions, seed=2)
    for (obs, *_), (want, *_) in zip(*steps, strict=True):
        assert_same(obs, want)
    assert want["valid"].sum() > 1


def test_nothing_before_reset(highway_checkpoint: str):
    env = ForecastObservation(short_env(10), highway_checkpoint)
    with pytest.raises(ProtocolError, match="no forecast yet; call reset"):
        _ = env.forecast
    with pytest.raises(ProtocolError, match="no scene yet; call reset"):
        _ = env.scene


# --- Specs ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "arguments",
    [{}, {"num_samples": 3, "flatten": True}, {"horizon_steps": 2, "perception_m": 40.0, "max_agents": 4}],
    ids=["defaults", "samples-flat", "sizes"],
)
def test_spec_round_trips(arguments: dict[str, Any], highway_checkpoint: str):
    env = ForecastObservation(make_env("highway-fast-v0"), highway_checkpoint, **arguments)
    spec = env.spec
    assert spec is not None
    assert_rebuilds(env, gym.make(spec))
    assert_rebuilds(env, gym.make(EnvSpec.from_json(spec.to_json())))
    (_, wrapper) = spec.additional_wrappers
    assert wrapper.kwargs is not None
    assert {key: wrapper.kwargs[key] for key in arguments} == arguments
    assert wrapper.kwargs["checkpoint"] == highway_checkpoint


def test_the_spec_of_an_env_with_its_own_reader_round_trips(highway_checkpoint: str):
    env = ForecastObservation(make_env("highway-fast-v0"), highway_checkpoint, reader=ShuffledReader)
    assert env.spec is not None
    assert_rebuilds(env, gym.make(env.spec))


@pytest.mark.filterwarnings("ignore:.*Current gymnasium version requires")
def test_a_reader_by_name_stands_in_the_json_of_a_spec():
    """A reader itself cannot: JSON has no functions."""
    env_id, name = "tests.envs.own_code:OneOnly-v0", "tests.envs.own_code:READER"
    env = ForecastObservation(gym.make(env_id), "constant-velocity", reader=name)
    assert env.spec is not None
    again = gym.make(EnvSpec.from_json(env.spec.to_json()))
    assert again.unwrapped is not env.unwrapped
    assert again.get_wrapper_attr("reader").spec == READER.spec
    env.reset(seed=3)
    expected = env.scene.states
    env.close()
    again.reset(seed=3)
    np.testing.assert_array_equal(again.get_wrapper_attr("scene").states, expected)
    again.close()
    with pytest.raises(UserError, match="module 'tests.envs.own_code' has no function or class 'ABSENT'"):
        ForecastObservation(gym.make(env_id), "constant-velocity", reader="tests.envs.own_code:ABSENT")


def assert_rebuilds(env: gym.Env, rebuilt: gym.Env) -> None:
    assert str(rebuilt) == str(env)
    assert rebuilt.spec == env.spec
    assert rebuilt.observation_space == env.observation_space
    for (obs, *_), (want, *_) in zip(play(rebuilt, [1, 0], 9), play(env, [1, 0], 9), strict=True):
        assert_same(obs, want, tolerance=0.0)


def test_scene_spec_round_trips():
    env = SceneObservation(make_env("merge-v1"), perception_m=40.0, max_agents=4)
    assert env.spec is not None
    assert_rebuilds(env, gym.make(env.spec))


def test_make_takes_it_as_an_additional_wrapper(highway_checkpoint: str):
    wrapper = ForecastObservation.wrapper_spec(checkpoint=highway_checkpoint, num_samples=2)
    made = gym.make(replace(gym.spec("highway-fast-v0"), additional_wrappers=(wrapper,)))
    by_hand = ForecastObservation(gym.make("highway-fast-v0"), highway_checkpoint, num_samples=2)
    assert isinstance(made, ForecastObservation)
    for (obs, *_), (want, *_) in zip(play(made, [1, 0], 9), play(by_hand, [1, 0], 9), strict=True):
        assert_same(obs, want, tolerance=0.0)


# --- Checkpoints by env id --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("env_id", CHECKPOINTS)
def test_no_name_is_needed_where_a_checkpoint_ships(env_id: str):
    env = ForecastObservation(light_env(env_id))
    steps = play(env, random_actions(env, 2), seed=0)
    for obs, *_ in steps:
        assert obs in env.observation_space
        assert all(np.isfinite(value).all() for value in obs.values())


def test_registry_names_the_ids_it_knows():
    assert checkpoint_for("merge-v1") == CHECKPOINTS["merge-v1"]
    with pytest.raises(UserError, match="no checkpoint ships for env 'parking-v0'.*Shipped ids: highway-v0, "):
        checkpoint_for("parking-v0")


# --- Errors -----------------------------------------------------------------------------------------------------------


def test_time_steps_that_differ_are_both_named(highway_checkpoint: str):
    with pytest.raises(UserError, match="tiny-highway' was trained at dt_s=1 but env 'racetrack-v1' steps at dt_s=0.2"):
        ForecastObservation(make_env("racetrack-v1"), highway_checkpoint)


def test_time_step_changed_in_the_config_is_seen(highway_checkpoint: str):
    with pytest.raises(UserError, match=r"trained at dt_s=1 but env 'merge-v1' steps at dt_s=0.2"):
        ForecastObservation(make_env("merge-v1", config={"policy_frequency": 5}), highway_checkpoint)


def test_time_step_changed_at_reset_is_seen(highway_checkpoint: str):
    """highway-env's documented way to configure an env after gym.make."""
    env = ForecastObservation(make_env("merge-v1"), highway_checkpoint)
    with pytest.raises(UserError, match=r"dt_s=1.*dt_s=0.2"):
        env.reset(options={"config": {"policy_frequency": 5}})


def test_unknown_checkpoint_is_named():
    with pytest.raises(UserError, match="no checkpoint 'nowhere': neither a folder nor a shipped name"):
        ForecastObservation(make_env("merge-v1"), "nowhere")


def test_folder_that_is_no_checkpoint_is_named(tmp_path: Path):
    with pytest.raises(UserError, match="is .* a predictor checkpoint"):
        ForecastObservation(make_env("merge-v1"), str(tmp_path))


def test_id_without_a_checkpoint_is_named():
    with pytest.raises(UserError, match="no checkpoint ships for env 'lane-keeping-v0'; pass one"):
        ForecastObservation(make_env("lane-keeping-v0"))


def test_several_controlled_vehicles_are_named():
    env = make_env("intersection-multi-agent-v2")
    for wrapper, arguments in ((SceneObservation, ()), (ForecastObservation, ("constant-velocity",))):
        with pytest.raises(UserError, match="with several egos; highway-env's intersection for several is HighwayP"):
            wrapper(env, *arguments)


def test_forecasts_are_added_once(highway_checkpoint: str):
    shown = ForecastObservation(short_env(10), highway_checkpoint, flatten=True)
    with pytest.raises(UserError, match="ForecastObservation would add forecasts to those of ForecastObservation in"):
        ForecastObservation(shown, highway_checkpoint, flatten=True)
    hidden = FlattenObservation(SceneObservation(short_env(10)))
    with pytest.raises(UserError, match="a wrapper around SceneObservation hides its scenes from ForecastObservation"):
        ForecastObservation(hidden, highway_checkpoint)


def test_steps_after_an_end_are_warned_of_once(highway_checkpoint: str):
    env = ForecastObservation(short_env(1), highway_checkpoint)
    env.reset(seed=0)
    assert env.step(1)[3]
    deepcopy(env).step(1)  # a copy looks ahead
    with pytest.warns(UserWarning, match="step.. of env '.*' was called after an episode's end, without reset"):
        env.step(1)
    env.step(1)
    env.reset(seed=0)
    env.step(1)


class Old(gym.Env):
    """An environment as Gym had them before version 0.26."""

    observation_space = gym.spaces.Box(-1, 1, (2,))
    action_space = gym.spaces.Discrete(2)
    new_reset = False

    def reset(self, **_: Any) -> Any:
        zeros = np.zeros(2, dtype=np.float32)
        return (zeros, {}) if self.new_reset else zeros

    def step(self, action: Any) -> Any:
        return np.zeros(2, dtype=np.float32), 0.0, False, {}


def test_environments_of_older_versions_are_told_what_to_return():
    def read(env: gym.Env) -> Scene:
        return Scene(np.zeros((1, 4)), np.arange(1), np.ones(1, dtype=np.bool_))

    old = Old()
    env = SceneObservation(old, reader=FunctionReader(read, SceneSpec(dt_s=1.0)))
    with pytest.raises(UserError, match="reset of env 'Old' must return .observation, info., got ndarray"):
        env.reset()
    old.new_reset = True
    env.reset()
    with pytest.raises(UserError, match="step of env 'Old' must return .*truncated, info., got 4 values"):
        env.step(0)


@pytest.mark.parametrize("field", ["num_samples", "horizon_steps"])
def test_zero_is_named(field: str, highway_checkpoint: str):
    with pytest.raises(UserError, match=f"{field} must be at least 1, got 0"):
        ForecastObservation(short_env(10), highway_checkpoint, **{field: 0})


def test_env_of_another_family_is_named():
    for wrapper, arguments in ((SceneObservation, ()), (ForecastObservation, ("constant-velocity",))):
        with pytest.raises(UserError, match="no scene reader knows CartPoleEnv; pass reader="):
            wrapper(gym.make("CartPole-v1"), *arguments)


def test_unknown_id_is_named():
    with pytest.raises(UserError, match="cannot make env 'nope-v0': .*known here: highway-v0"):
        make_env("nope-v0")


# --- Readers of one's own ---------------------------------------------------------------------------------------------


class BadReader(NamedReader):
    """Breaks the contract in the way its `fault` says."""

    def __init__(self, fault: str) -> None:
        super().__init__(SceneSpec(dt_s=0.02, max_agents=3))
        self.fault = fault

    def read(self, env: gym.Env) -> Scene:
        states = np.zeros((3, 4))
        ids, valid = np.array([0, 1, -1]), np.array([True, True, False])
        if self.fault == "states must be finite":
            states[1, 2] = np.nan
        elif self.fault == "ids must be unique":
            ids[1] = 0
        elif self.fault == "agent 0 must be the ego":
            valid[0] = False
        return Scene(states, ids, valid)


def test_any_env_works_with_a_reader_of_its_own():
    env = ForecastObservation(
        gym.make("CartPole-v1"), "constant-velocity", reader=lambda env: NamedReader(SceneSpec(dt_s=0.02, max_agents=3))
    )
    obs, _ = env.reset(seed=0)
    assert obs["forecast"].shape == (2, 5, 2)
    assert obs in env.observation_space


def test_a_reader_is_refused_over_scenes_that_have_theirs(highway_checkpoint: str):
    env = SceneObservation(short_env(10))
    with pytest.raises(
        UserError, match="^ForecastObservation over a SceneObservation takes no reader: .* give reader="
    ):
        ForecastObservation(env, highway_checkpoint, reader=ShuffledReader)


@pytest.mark.parametrize("fault", ["states must be finite", "ids must be unique", "agent 0 must be the ego"])
def test_reader_that_breaks_the_contract_is_named(fault: str):
    env = SceneObservation(gym.make("CartPole-v1"), reader=lambda env: BadReader(fault))
    with pytest.raises(UserError, match=f"scene reader of 'CartPole-v1': {fault}"):
        env.reset(seed=0)


@pytest.mark.parametrize("bound", [{"perception_m": 40.0}, {"max_agents": 4}])
def test_bounds_that_the_scenes_below_do_not_have_are_refused(bound: dict[str, Any]):
    scenes = SceneObservation(gym.make("highway-fast-v0"), perception_m=60.0, max_agents=6)
    with pytest.raises(UserError, match=r"do not fit the SceneObservation below .60, 6.; give them to that wrapper"):
        ForecastObservation(scenes, "constant-velocity", **bound)
    ForecastObservation(scenes, "constant-velocity", perception_m=60.0, max_agents=6)


class InPlace(Reader):
    """Hands over arrays into which each reading writes, as a simulator may."""

    def __init__(self, env: Any) -> None:
        super().__init__(SceneSpec(dt_s=1.0, max_agents=2))
        self._scene = Scene(np.zeros((2, 4)), np.arange(2), np.ones(2, np.bool_))

    def read_all(self, env: Any) -> Scene:
        return self.read(env)

    def read(self, env: Any) -> Scene:
        self._scene.states[:] += 1.0
        return self._scene


def test_an_observation_keeps_its_scene_when_the_simulator_writes_in_place():
    env = SceneObservation(gym.make("highway-fast-v0"), reader=InPlace)
    first, _ = env.reset(seed=0)
    scene = env.scene
    second, *_ = env.step(1)
    assert (first["scene_states"] == 1).all() and (second["scene_states"] == 2).all()
    assert (scene.states == 1).all()
