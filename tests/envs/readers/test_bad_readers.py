"""Readers that break the contract: each gets one line that says what was required and what arrived."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from envs.readers.base import Reader, perceive, perceive_batch
from envs.readers.function import FunctionReader
from envs.wrappers import ForecastObservation, SceneObservation
from predictor.data.store import Episode
from predictor.data.windows import visible
from predictor.scene import PADDING_ID, Scene, SceneBatch, SceneSpec
from predictor.support.errors import UserError

SPEC = SceneSpec(dt_s=0.5, max_agents=4, perception_m=50.0)
GOOD: dict[str, Any] = {
    "states": np.array([[0.0, 0, 1, 0], [3, 4, 0, 0], [9, 0, 0, 0]]),
    "ids": np.array([0, 8, 3]),
    "valid": np.ones(3, dtype=np.bool_),
    "heading_rad": 0.0,
}


class Room(gym.Env):
    """Nothing happens."""

    observation_space = gym.spaces.Box(-1, 1, (1,), np.float32)
    action_space = gym.spaces.Discrete(1)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict]:
        self.steps = 0
        return np.zeros(1, np.float32), {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict]:
        self.steps += 1
        return np.zeros(1, np.float32), 0.0, False, False, {}


def raw_scene(**fields: Any) -> Scene:
    """A scene of anything: the shape checks that these tests run with would stop its constructor."""
    scene = object.__new__(Scene)
    for name, value in (GOOD | fields).items():
        object.__setattr__(scene, name, value)
    return scene


class PaddedReader(Reader):
    """Does its own perceiving: what `read` gives is what the wrapper gets."""

    def __init__(self, make_scene: Callable[[], Any]) -> None:
        super().__init__(SPEC)
        self.make_scene = make_scene

    def read_all(self, env: Any) -> Scene:
        raise NotImplementedError

    def read(self, env: Any) -> Scene:
        return self.make_scene()


def through_a_function(make_scene: Callable[[], Any]) -> gym.Env:
    def read_room(env):
        return make_scene()

    return SceneObservation(Room(), reader=FunctionReader(read_room, SPEC))


def through_a_reader(make_scene: Callable[[], Any]) -> gym.Env:
    def padded() -> Any:
        scene = make_scene()
        return scene if not isinstance(scene, Scene) else pad(scene, SPEC.max_agents)

    return SceneObservation(Room(), reader=lambda env: PaddedReader(padded))


def pad(scene: Scene, agents: int) -> Scene:
    """Agents of padding of whatever kind of array there is."""
    fields = {}
    for name, nothing in (("states", 0), ("ids", PADDING_ID), ("valid", False)):
        array = getattr(scene, name)
        if isinstance(array, np.ndarray) and array.ndim and len(array) < agents:
            blank = np.full((agents - len(array), *array.shape[1:]), nothing, dtype=array.dtype)
            array = np.concatenate([array, blank])
        fields[name] = array
    return raw_scene(**fields, heading_rad=scene.heading_rad)


FAULTS: dict[str, tuple[dict[str, Any], str]] = {
    "twins": ({"ids": np.array([0, 8, 8])}, r"ids must be unique within a scene, got \[0, 8, 8\]"),
    "negative_id": ({"ids": np.array([0, 8, -2])}, r"ids of valid agents must be non-negative, got \[0, 8, -2\]"),
    "padding_id": ({"ids": np.array([0, 8, PADDING_ID])}, r"ids of valid agents must be non-negative"),
    "no_ego": ({"valid": np.array([False, True, True])}, "agent 0 must be the ego, but it is absent or not valid"),
    "nobody": (
        {"states": np.zeros((0, 4)), "ids": np.zeros(0, np.int64), "valid": np.zeros(0, np.bool_)},
        "agent 0 must be the ego, but it is absent or not valid",
    ),
    "infinite_in_half_precision": (
        {"states": (GOOD["states"] + [[0, 0, 0, 0], [np.inf, 0, 0, 0], [0, 0, 0, 0]]).astype(np.float16)},
        "states must be finite",
    ),
    "nan": ({"states": GOOD["states"] * [1, 1, np.nan, 1]}, r"states must be finite, .*got \[\[.*nan"),
    "infinite": ({"states": GOOD["states"] + [np.inf, 0, 0, 0]}, "states must be finite"),
    "nan_heading": ({"heading_rad": float("nan")}, "heading_rad must be .*finite.*, got nan"),
    "object_states": (
        {"states": GOOD["states"].astype(object)},
        r"states must be a NumPy array of floating point with 2 axes, got object \(\d, 4\)",
    ),
    "int_states": (
        {"states": GOOD["states"].astype(np.int64)},
        r"states must be a NumPy array of floating point with 2 axes, got int64 \(\d, 4\)",
    ),
    "list_states": (
        {"states": GOOD["states"].tolist()},
        "states must be a NumPy array of floating point with 2 axes, got list",
    ),
    "flat_states": (
        {"states": GOOD["states"].ravel()},
        r"states must be a NumPy array of floating point with 2 axes, got float64 \(12,\)",
    ),
    "float_ids": (
        {"ids": GOOD["ids"].astype(np.float64)},
        r"ids must be a NumPy array of integers with 1 axes, got float64 \(\d,\)",
    ),
    "text_ids": ({"ids": np.array(["a", "b", "c"])}, "ids must be a NumPy array of integers with 1 axes, got <U"),
    "int_valid": (
        {"valid": np.ones(3, dtype=np.int64)},
        r"valid must be a NumPy array of bool with 1 axes, got int64 \(\d,\)",
    ),
    "no_valid": ({"valid": None}, "valid must be a NumPy array of bool with 1 axes, got NoneType"),
    "features": (
        {"states": np.zeros((3, 5))},
        r"states need 4 features \('x_m', 'y_m', 'vx_mps', 'vy_mps'\), got 5",
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("make_env", [through_a_function, through_a_reader])
def test_a_broken_scene_is_named(make_env: Callable[..., gym.Env], fault: str):
    fields, message = FAULTS[fault]
    env = make_env(lambda: raw_scene(**fields))
    with pytest.raises(UserError, match=message) as error:
        env.reset(seed=0)
    assert "\n" not in str(error.value)
    assert str(error.value).startswith(("read_room: ", "scene reader of 'Room': "))


@pytest.mark.parametrize("make_env", [through_a_function, through_a_reader])
def test_the_same_scene_whole_is_taken(make_env: Callable[..., gym.Env]):
    obs, _ = make_env(lambda: raw_scene()).reset(seed=0)
    assert obs["scene_ids"].tolist() == [0, 8, 3, PADDING_ID]
    assert obs["scene_valid"].tolist() == [1, 1, 1, 0]


@pytest.mark.parametrize("what", [None, GOOD["states"], (GOOD["states"], GOOD["ids"]), {"states": 1}])
@pytest.mark.parametrize("make_env", [through_a_function, through_a_reader])
def test_what_is_no_scene_at_all_is_named(make_env: Callable[..., gym.Env], what: Any):
    expected = rf": reading must give a Scene \(predictor.scene\), got {type(what).__name__}$"
    with pytest.raises(UserError, match=expected):
        make_env(lambda: what).reset(seed=0)


class Everyone(PaddedReader):
    """Keeps the `read` of `Reader`."""

    read = Reader.read

    def read_all(self, env: Any) -> Scene:
        return self.make_scene()


def test_what_is_no_scene_names_the_class_of_the_reader():
    env = SceneObservation(Room(), reader=lambda env: Everyone(lambda: None))
    with pytest.raises(UserError, match="^Everyone: reading must give a Scene"):
        env.reset(seed=0)


def test_arrays_of_unequal_length_are_named():
    for fields in ({"ids": np.arange(4)}, {"states": np.zeros((2, 4))}, {"valid": np.ones(5, dtype=np.bool_)}):
        with pytest.raises(UserError, match="states, ids and valid need one entry per agent, got"):
            through_a_function(lambda fields=fields: raw_scene(**fields)).reset(seed=0)


def test_the_ego_stays_the_first_agent_until_the_episode_ends():
    """A reader that returns only who is alive makes another agent the ego once the ego is gone."""
    alive = [GOOD["ids"]] * 4 + [np.array([8, 3])]
    env = through_a_function(
        lambda: raw_scene(
            **{k: v[-len(alive[0]) :] for k, v in GOOD.items() if k != "ids" and np.ndim(v)}, ids=alive.pop(0)
        )
    )
    env.reset(seed=0)
    env.step(0)
    env.reset(seed=0)
    env.step(0)
    with pytest.raises(UserError, match="^scene reader of 'Room': the first agent was 0 and is now 8; it must be"):
        env.step(0)


def test_an_ego_has_another_id_in_another_episode():
    ids = [np.array([0, 8, 3]), np.array([5, 8, 3])]
    env = through_a_function(lambda: raw_scene(ids=ids.pop(0)))
    env.reset(seed=0)
    assert env.reset(seed=0)[0]["scene_ids"].tolist() == [5, 8, 3, PADDING_ID]


def crowd(agents: int) -> Scene:
    states = np.zeros((agents, 4))
    states[:, 0] = np.arange(agents)[::-1]
    states[0, 0] = 0.0
    return Scene(states, np.arange(agents), np.ones(agents, dtype=np.bool_))


def test_of_too_many_the_nearest_are_kept():
    obs, _ = through_a_function(lambda: crowd(9)).reset(seed=0)
    assert obs["scene_ids"].tolist() == [0, 8, 7, 6]


@pytest.mark.parametrize("agents", [3, 5])
def test_a_read_of_ones_own_must_be_padded_to_max_agents(agents: int):
    env = SceneObservation(Room(), reader=lambda env: PaddedReader(lambda: crowd(agents)))
    expected = rf"a scene needs 4 agents \(max_agents\), padding included, got {agents}"
    with pytest.raises(UserError, match=f"scene reader of 'Room': {expected}"):
        env.reset(seed=0)


def test_features_that_come_and_go_are_named():
    def read_room(env):
        return raw_scene(states=np.zeros((3, 4 + env.unwrapped.steps)))

    env = ForecastObservation(Room(), "constant-velocity", reader=FunctionReader(read_room, SPEC))
    env.reset(seed=0)
    with pytest.raises(UserError, match=r"read_room: states need 4 features .*, got 5"):
        env.step(0)


def test_a_fault_in_a_later_step_leaves_the_last_good_scene():
    def read_room(env):
        return crowd(3) if env.unwrapped.steps == 0 else raw_scene(ids=np.array([1, 1, 1]))

    env = SceneObservation(Room(), reader=FunctionReader(read_room, SPEC))
    env.reset(seed=0)
    with pytest.raises(UserError, match="ids must be unique"):
        env.step(0)
    assert env.scene.ids.tolist() == [0, 2, 1, PADDING_ID]


def test_a_scene_without_the_specs_features_never_reaches_a_checkpoint():
    names = (*SPEC.feature_names, "radius_m")
    spec = replace(SPEC, feature_names=names, feature_scales=(1.0,) * 5)
    with pytest.raises(UserError, match=r"states need 5 features .*'radius_m'\), got 4"):
        SceneObservation(Room(), reader=FunctionReader(lambda env: crowd(2), spec)).reset(seed=0)


def test_an_absent_agent_is_out_of_sight_also_of_an_ego_that_sees_everything():
    full = Scene(**GOOD | {"valid": np.array([True, False, True])})
    seen = perceive(full, replace(SPEC, perception_m=np.inf))
    assert seen.ids.tolist() == [0, 3, PADDING_ID, PADDING_ID]
    assert seen.valid.tolist() == [True, True, False, False]


@pytest.mark.slow
@given(seed=st.integers(0, 2**16), perception_m=st.sampled_from([2.0, 40.0, np.inf]), max_agents=st.integers(1, 8))
def test_a_batch_perceives_what_each_ego_does_and_so_do_training_windows(
    seed: int, perception_m: float, max_agents: int
):
    rng = np.random.default_rng(seed)
    spec = SceneSpec(dt_s=1.0, perception_m=perception_m, max_agents=max_agents)
    states, valid = rng.integers(-3, 4, size=(5, 6, 4)).astype(np.float64), rng.random((5, 6)) < 0.7
    valid[:, 0] = True
    states[~valid] = 0.0
    ids = np.where(valid, np.arange(6), PADDING_ID)
    scenes = [Scene(*arrays) for arrays in zip(states, ids, valid, strict=True)]
    expected = SceneBatch.stack([perceive(scene, spec) for scene in scenes])
    found = perceive_batch(SceneBatch(states, ids, valid, np.zeros(5)), spec)
    for name in ("states", "ids", "valid"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
    in_windows = visible(Episode(states.astype(np.float32), valid, np.arange(6)), spec)
    for scene, kept in zip(expected.ids, in_windows, strict=True):
        assert set(scene) - {PADDING_ID} == set(np.flatnonzero(kept))


def test_a_reader_without_an_ego_is_refused_where_there_is_one():
    reader = FunctionReader(lambda env: Scene(**GOOD), replace(SPEC, has_ego=False))
    with pytest.raises(UserError, match="an environment with one ego needs a reader whose spec has has_ego=True"):
        SceneObservation(Room(), reader=reader)
