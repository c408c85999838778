import pickle
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from envs.readers.entities import EntityRowsReader
from envs.readers.highway import HighwayReader
from envs.registry import make_env
from envs.wrappers import ForecastObservation, SceneObservation
from predictor.scene import KINEMATIC_FEATURES, KINEMATIC_FEATURES_3D, Scene, SceneSpec
from predictor.support.errors import ProtocolError, UserError
from tests.envs.helpers import play, random_actions

SPEC = SceneSpec(dt_s=0.5, max_agents=6)
COLUMNS = ("presence", "x", "y", "vx", "vy")
HIGHWAY = SceneSpec(dt_s=1.0, frame=("ego", "world"), perception_m=1000.0, max_agents=60)


class Table(gym.Env):
    """Shows the tables it was given, one after the other."""

    action_space = gym.spaces.Discrete(1)

    def __init__(self, *tables: Any) -> None:
        self.tables = [np.array(table, dtype=np.float64) for table in tables]
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, self.tables[0].shape, np.float64)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict]:
        self.time = 0
        return self.tables[0], {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict]:
        self.time += 1
        return self.tables[self.time], 0.0, self.time == len(self.tables) - 1, False, {}


def scenes_of(config: EntityRowsReader, *tables: Any) -> list[Scene]:
    env = Table(*tables)
    reader = config(env)
    scenes = []
    for table in env.tables:
        reader.see(table)
        scenes.append(reader.read_all(env))
    return scenes


# --- Columns ----------------------------------------------------------------------------------------------------------


def test_columns_in_any_order_with_any_between():
    config = EntityRowsReader(("vy", "", "x", "id", "vx", "", "y"), SPEC)
    (scene,) = scenes_of(config, [[4, -1, 1, 7, 3, -1, 2], [40, -1, 10, 0, 30, -1, 20]])
    assert scene.states.tolist() == [[1, 2, 3, 4], [10, 20, 30, 40]]
    assert scene.ids.tolist() == [7, 0]
    assert scene.valid.tolist() == [True, True]


def test_scales_bring_each_column_to_si():
    config = EntityRowsReader(COLUMNS, SPEC, scales=(1.0, 100.0, 10.0, -2.0, 0.5))
    (scene,) = scenes_of(config, [[1, 0.5, 0.5, 0.5, 0.5]])
    assert scene.states.tolist() == [[50, 5, -1, 0.25]]


def test_a_flat_observation_is_the_same_table():
    config = EntityRowsReader(COLUMNS, SPEC)
    table = np.arange(10.0) + 1
    (flat,), (square,) = scenes_of(config, table), scenes_of(config, table.reshape(2, 5))
    np.testing.assert_array_equal(flat.states, square.states)


def test_lines_without_presence_hold_no_agent():
    table = [[1, 0, 0, 0, 0], [0, 5, 5, 0, 0], [1, 9, 9, 0, 0]]
    (scene,) = scenes_of(EntityRowsReader(COLUMNS, SPEC), table)
    assert scene.states[:, 0].tolist() == [0, 9]


def test_padding_holds_no_agent_only_if_set_and_is_never_the_ego():
    columns, table = COLUMNS[1:], [[-1.0] * 4, [-1.0] * 4, [-1.0, -1.0, 0.0, -1.0]]
    for padding, agents in ((None, 3), (-1.0, 2), (0.0, 3)):
        (scene,) = scenes_of(EntityRowsReader(columns, SPEC, padding=padding, scales=(3.0,) * 4), table)
        assert len(scene.ids) == agents
    (scene,) = scenes_of(EntityRowsReader(columns, SPEC, padding=0.1), np.float32([[1.0] * 4, [0.1] * 4, [0.2] * 4]))
    assert len(scene.ids) == 2  # 0.1 of float32 is another number in float64


@pytest.mark.parametrize(
    ("names", "values"),
    [(("heading",), (-2.5,)), (("cos_h", "sin_h"), (np.cos(-2.5), np.sin(-2.5))), ((), ())],
    ids=["heading", "cos_sin", "none"],
)
def test_heading_is_the_egos(names: tuple[str, ...], values: tuple[float, ...]):
    table = [[0, 0, 1, 1, *values], [5, 5, 1, 1, *[0.5] * len(values)]]
    (scene,) = scenes_of(EntityRowsReader((*COLUMNS[1:], *names), SPEC), table)
    assert scene.heading_rad == pytest.approx(-2.5 if names else 0.0)


def test_further_features_come_after_the_kinematic_ones():
    names = (*KINEMATIC_FEATURES, "radius_m", "goal_m")
    spec = replace(SPEC, feature_names=names, feature_scales=(1.0,) * 6)
    (scene,) = scenes_of(EntityRowsReader(("goal_m", "x", "y", "radius_m", "vx", "vy"), spec), [[9, 1, 2, 5, 3, 4]])
    assert scene.states.tolist() == [[1, 2, 3, 4, 5, 9]]


def test_three_axes():
    spec = SceneSpec(dt_s=1.0, frame=("ego",) * 3, feature_names=KINEMATIC_FEATURES_3D, feature_scales=(1.0,) * 6)
    config = EntityRowsReader(("x", "vx", "y", "vy", "z", "vz"), spec, relative=True, dead_reckoning=True)
    first, second = scenes_of(
        config, [[0, 1, 0, 2, 0, 3], [5, 0, 5, 0, 5, 1]], [[0, 1, 0, 2, 0, 3], [5, 0, 5, 0, 6, 1]]
    )
    assert first.states.tolist() == [[0, 0, 0, 1, 2, 3], [5, 5, 5, 1, 2, 4]]
    assert second.states.tolist() == [[1, 2, 3, 1, 2, 3], [6, 7, 9, 1, 2, 4]]
    assert second.ids.tolist() == [0, 1]


# --- Relative lines ---------------------------------------------------------------------------------------------------


def walk(seed: int, agents: int = 5, steps: int = 6) -> np.ndarray:
    """States (steps, agents, 4) under constant accelerations, far enough apart at first."""
    rng = np.random.default_rng(seed)
    start = rng.permutation(agents)[:, None] * 8.0 + rng.uniform(-1, 1, (agents, 2))
    speed, acceleration = rng.normal(0, 2, (agents, 2)), rng.uniform(-1, 1, (agents, 2))
    t_s = np.arange(steps)[:, None, None] * SPEC.dt_s
    return np.concatenate([start + speed * t_s + acceleration * t_s**2 / 2, speed + acceleration * t_s], axis=-1)


@given(st.integers(0, 500))
def test_relative_lines_are_restored(seed: int):
    absolute = walk(seed)
    relative = absolute.copy()
    relative[:, 1:] -= absolute[:, :1]
    plain = EntityRowsReader(COLUMNS[1:], SPEC)
    wanted, found = scenes_of(plain, *absolute), scenes_of(replace(plain, relative=True), *relative)
    for scene, want in zip(found, wanted, strict=True):
        np.testing.assert_allclose(scene.states, want.states, atol=1e-9)
        assert scene.ids.tolist() == want.ids.tolist() == list(range(5))


@given(st.integers(0, 500))
def test_dead_reckoning_restores_the_path_from_the_origin(seed: int):
    """Exact under constant acceleration; y is of frame "world" and keeps what was observed."""
    absolute = walk(seed)
    shown = absolute.copy()
    shown[:, 1:] -= absolute[:, :1]
    shown[:, 0, 0] = 77.0  # the ego's x as an observation shows it that has no place for it
    spec = replace(SPEC, frame=("ego", "world"))
    config = EntityRowsReader(COLUMNS[1:], spec, relative=True, dead_reckoning=True)
    for scene, states in zip(scenes_of(config, *shown), absolute, strict=True):
        want = states.copy()
        want[:, 0] -= absolute[0, 0, 0]
        np.testing.assert_allclose(scene.states, want, atol=1e-9)
        assert scene.ids.tolist() == list(range(5))


def test_dead_reckoning_starts_anew_with_each_episode():
    spec = replace(SPEC, frame=("ego", "ego"))
    config = EntityRowsReader(COLUMNS[1:], spec, relative=True, dead_reckoning=True)
    env = SceneObservation(Table(*[[[0, 0, 3, 0]]] * 3), reader=config)
    for episode in range(2):
        xs = [float(obs["scene_states"][0, 0]) for obs, *_ in play(env, [0, 0], seed=episode)]
        assert xs == [0.0, 1.5, 3.0]


# --- Identity ---------------------------------------------------------------------------------------------------------


def test_an_id_column_is_believed():
    tables = [[[0, 0, 0, 0, 3], [9, 0, 0, 0, 5]], [[50, 0, 0, 0, 3], [0, 90, 0, 0, 5]]]
    config = EntityRowsReader((*COLUMNS[1:], "id"), SPEC)
    assert [scene.ids.tolist() for scene in scenes_of(config, *tables)] == [[3, 5], [3, 5]]


def test_normalised_ids_are_whole_numbers_again():
    table = np.zeros((50, 5), dtype=np.float32)
    table[:, 4] = np.arange(50) / 49  # in float32, some come back a little below
    config = EntityRowsReader((*COLUMNS[1:], "id"), SPEC, scales=(1.0,) * 4 + (49.0,))
    assert scenes_of(config, table)[0].ids.tolist() == list(range(50))


@given(st.integers(0, 500))
def test_without_one_motion_tells_who_is_who(seed: int):
    """Lines in another order at each step; the one that leaves and the one that enters are not the same."""
    rng = np.random.default_rng(seed)
    states = walk(seed)
    config = EntityRowsReader(COLUMNS, SPEC, gate_m=3.0)
    tables, orders = [], []
    for step, lines in enumerate(states):
        order = [0, *rng.permutation(np.arange(1, 5))]
        table = np.concatenate([np.ones((5, 1)), lines], axis=1)
        table[3 if step < 3 else 4, 0] = 0  # agent 4 takes agent 3's place in the scene, somewhere else
        tables.append(table[order])
        orders.append([agent for agent in order if table[agent, 0]])
    number_of: dict[int, int] = {}
    for scene, order in zip(scenes_of(config, *tables), orders, strict=True):
        for agent, number in zip(order, scene.ids.tolist(), strict=True):
            assert number_of.setdefault(agent, number) == number
    assert number_of[0] == 0
    assert sorted(number_of.values()) == list(range(5))


def test_the_ego_is_the_same_wherever_it_jumps():
    first, second = scenes_of(EntityRowsReader(COLUMNS, SPEC), [[1, 0, 0, 0, 0]], [[1, 500, 0, 0, 0]])
    assert first.ids.tolist() == second.ids.tolist() == [0]


def test_constant_features_tell_agents_apart():
    names = (*KINEMATIC_FEATURES, "size_m")
    spec = replace(SPEC, feature_names=names, feature_scales=(1.0,) * 5)
    tables = [[[0, 0, 0, 0, 1], [5, 0, 0, 0, 2]], [[0, 0, 0, 0, 1], [5, 0, 0, 0, 3]]]
    for constant, second in (((), [0, 1]), (("size_m",), [0, 2])):
        config = EntityRowsReader((*COLUMNS[1:], "size_m"), replace(spec, constant_features=constant))
        assert scenes_of(config, *tables)[1].ids.tolist() == second


@pytest.mark.parametrize(("memory_steps", "after"), [(0, 2), (1, 1)])
def test_who_was_out_of_sight_can_be_remembered(memory_steps: int, after: int):
    there, gone = [[1, 0, 0, 0, 0], [1, 9, 0, 0, 0]], [[1, 0, 0, 0, 0], [0, 0, 0, 0, 0]]
    config = EntityRowsReader(COLUMNS, SPEC, memory_steps=memory_steps)
    assert scenes_of(config, there, gone, there)[2].ids.tolist() == [0, after]


# --- In a wrapper -----------------------------------------------------------------------------------------------------


def test_the_wrappers_show_it_each_observation_once():
    states = walk(seed=1)
    tables = [np.concatenate([np.ones((5, 1)), lines], axis=1) for lines in states]
    env = SceneObservation(Table(*tables), reader=EntityRowsReader(COLUMNS, SPEC))
    for episode in range(2):
        for step, (obs, *_) in enumerate(play(env, [0] * 5, seed=episode)):
            np.testing.assert_array_equal(np.sort(obs["scene_ids"]), [-1, 0, 1, 2, 3, 4])
            by_id = np.argsort(obs["scene_ids"])[1:]
            np.testing.assert_array_equal(obs["scene_states"][by_id], states[step])
            assert env.reader.read_all(env) is env.reader.read_all(env)


def test_forecasts_of_straight_motion_are_the_observations_to_come():
    states = np.zeros((4, 2, 4))
    states[:, 1] = [[5.0 + 1.5 * t, 2.0, 3.0, 0.0] for t in range(4)]
    env = ForecastObservation(Table(*states), "constant-velocity", reader=EntityRowsReader(COLUMNS[1:], SPEC))
    obs, _ = env.reset(seed=0)
    np.testing.assert_allclose(obs["forecast"][0, :3], states[1:, 1, :2], atol=1e-5)


def kinematics_env(**kwargs: Any) -> gym.Env:
    observation = {"type": "Kinematics", "vehicles_count": 12, "see_behind": True, "features": list(COLUMNS), **kwargs}
    return make_env("highway-fast-v0", config={"observation": observation, "duration": 12, "lanes_count": 3})


@pytest.mark.parametrize(
    ("shown", "arguments"),
    [
        ({"normalize": False, "absolute": True}, {}),
        ({"normalize": False, "order": "shuffled"}, {"relative": True}),
        ({"order": "shuffled"}, {"relative": True, "dead_reckoning": True, "scales": (1.0, 200.0, 12.0, 80.0, 80.0)}),
    ],
    ids=["absolute", "relative", "as_shipped"],
)
def test_highway_kinematics_tell_what_the_simulator_knows(shown: dict[str, Any], arguments: dict[str, Any]):
    """States and identities of a whole episode, also where the observation clips the ego's own place on the road."""
    env = kinematics_env(**shown)
    reader, truth = EntityRowsReader(COLUMNS, HIGHWAY, **arguments)(env), HighwayReader(env)
    obs, _ = env.reset(seed=3)
    number_of: dict[int, int] = {}
    before: dict[int, int] = {}
    seen = 0
    for action in random_actions(env, 12):
        reader.see(obs)
        scene, full = reader.read_all(env), truth.read_all(env)
        place, motion = scene.states[:, :2] - scene.states[0, :2], scene.states[:, 2:]
        exact, speeds = full.states[:, :2] - full.states[0, :2], full.states[:, 2:]
        unclipped = np.abs(place[:, 0]) < 199
        nearest = np.linalg.norm(place[:, None] - exact, axis=-1).argmin(axis=1)
        np.testing.assert_allclose(place[unclipped], exact[nearest][unclipped], atol=1e-3)
        np.testing.assert_allclose(motion[unclipped], speeds[nearest][unclipped], atol=1e-4)
        np.testing.assert_allclose(scene.states[:, 1], full.states[nearest, 1], atol=1e-3)
        now = dict(zip(full.ids[nearest[unclipped]].tolist(), scene.ids[unclipped].tolist(), strict=True))
        for vehicle, number in now.items():
            assert number_of.setdefault(number, vehicle) == vehicle  # never another's number
            assert before.get(vehicle, number) == number  # and no new one while in sight
        before, seen = now, seen + len(now)
        obs, _, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            break
    assert seen > 40


def test_it_can_be_pickled_and_compared():
    config = EntityRowsReader(COLUMNS, SPEC, relative=True)
    assert pickle.loads(pickle.dumps(config)) == config


# --- Errors -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"columns": ("x", "y", "vx")}, "needs each of the columns x, y, vx, vy once, got .*name columns of no inter"),
        ({"columns": (*COLUMNS, "x")}, "needs each of the columns x, y, vx, vy once"),
        ({"columns": ("presense", *COLUMNS[1:])}, "knows no column 'presense'; there are .*presence, sin_h, .*'No|''"),
        ({"columns": (*COLUMNS, "Id")}, "knows no column 'Id'; there are cos_h, heading, id, presence, sin_h, vx, vy,"),
        ({"columns": (*COLUMNS, "cos_h")}, "the heading is one column 'heading', or 'cos_h' and 'sin_h'"),
        ({"columns": (*COLUMNS, "cos_h", "sin_h", "heading")}, "the heading is one column"),
        ({"scales": (1.0,) * 4}, "one number for each of 5 columns, not 0"),
        ({"scales": (1.0, 0.0, 1.0, 1.0, 1.0)}, "one number for each of 5 columns, not 0"),
        ({"scales": (1.0, np.nan, 1.0, 1.0, 1.0)}, "one number for each of 5 columns, not 0"),
        ({"dead_reckoning": True}, "dead_reckoning needs relative=True and an axis of another frame"),
        ({"dead_reckoning": True, "relative": True}, "got relative=True and frame=.'world', 'world'"),
    ],
)
def test_configs_that_make_no_sense_are_named(arguments: dict[str, Any], message: str):
    with pytest.raises(UserError, match=message):
        EntityRowsReader(**({"columns": COLUMNS, "spec": SPEC} | arguments))


def test_a_feature_without_a_column_is_named():
    spec = replace(SPEC, feature_names=(*KINEMATIC_FEATURES, "radius_m"), feature_scales=(1.0,) * 5)
    with pytest.raises(UserError, match="needs each of the columns x, y, vx, vy, radius_m once"):
        EntityRowsReader(COLUMNS, spec)


@pytest.mark.parametrize("shape", [(3, 4), (5, 3), (14,), (2, 3, 5)])
def test_an_observation_of_other_columns_is_named(shape: tuple[int, ...]):
    with pytest.raises(UserError, match="an observation of entities × 5 columns .* got shape"):
        EntityRowsReader(COLUMNS, SPEC)(Table(np.zeros(shape)))


def test_an_observation_that_is_no_table_is_named():
    with pytest.raises(UserError, match=r"needs a Box of entities × columns as observation, got Discrete\(16\)"):
        SceneObservation(gym.make("FrozenLake-v1"), reader=EntityRowsReader(COLUMNS, SPEC))


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ([[0, 0, 0, 0, 0]], "the first line must hold the ego, but its presence is 0"),
        ([[1, 0, 0, np.nan, 0]], "the observation must be finite"),
    ],
)
def test_observations_that_make_no_scene_are_named(table: Any, message: str):
    with pytest.raises(UserError, match=message):
        scenes_of(EntityRowsReader(COLUMNS, SPEC), table)


def test_lines_without_an_agent_may_hold_anything():
    (scene,) = scenes_of(EntityRowsReader(COLUMNS, SPEC), [[1, 0, 0, 0, 0], [0, np.nan, 0, 0, 0]])
    assert scene.ids.tolist() == [0]


def test_ids_that_are_no_numbers_are_named():
    with pytest.raises(UserError, match=r"ids must be whole numbers, got \[1.5\]"):
        scenes_of(EntityRowsReader((*COLUMNS[1:], "id"), SPEC), [[0, 0, 0, 0, 1.5]])


def test_nothing_is_read_before_it_is_seen():
    env = Table(np.zeros((2, 5)))
    reader = EntityRowsReader(COLUMNS, SPEC)(env)
    with pytest.raises(ProtocolError, match="has seen no observation of this episode; call see"):
        reader.read(env)
    reader.see(np.ones((2, 5)))
    reader.read(env)
    reader.reset()
    with pytest.raises(ProtocolError, match="call see"):
        reader.read_all(env)
