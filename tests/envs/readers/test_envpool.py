from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip("envpool")

from envs.readers import reader_for  # noqa: E402
from envs.readers.base import perceive
from envs.readers.envpool import (
    GATE_M,
    EnvPoolReader,
    PoolIdentity,
    PoolReader,
    envpool_spec,
    is_envpool_env,
    vehicles_of,
)
from envs.readers.highway import HighwayReader
from envs.readers.identity import IdentityTracker  # noqa: E402
from envs.registry import make_env  # noqa: E402
from envs.simulators.envpool import (  # noqa: E402
    HIGHWAY_ENV_OF,
    EnvPoolEnv,
    begins_alike,
    known_tasks,
    make_pool,
)  # noqa: E402
from predictor.scene import Scene, SceneSpec  # noqa: E402
from predictor.support.errors import ProtocolError, UserError  # noqa: E402

DT_S = 0.5
BUSY_TASKS = tuple(
    task_id
    for task_id in known_tasks()
    if not task_id.startswith("Racetrack") and (begins_alike(task_id) or not task_id.startswith("Intersection"))
)
"""Tasks with other vehicles, whose list keeps its order: an intersection with arrivals does not."""
EXPECTED_SPLITS = {"Roundabout-v0": 1, "Roundabout-v1": 1}
"""Vehicles that turn away by more than the gate in a step; one in 1,000 vehicle steps."""


@dataclass
class Seen:
    """A vehicle with nothing but what a perception system could see of it."""

    x: float
    y: float
    speed: float
    heading: float


@dataclass
class State:
    """The part of EnvPool's debug state that a reader may use."""

    vehicles: list[Any]
    elapsed_step: int


def shown(state: Any, order: Sequence[int]) -> State:
    vehicles = state.vehicles
    return State([Seen(*(getattr(vehicles[i], k) for k in Seen.__annotations__)) for i in order], state.elapsed_step)


def actions_of(pool: Any, rng: np.random.Generator) -> np.ndarray:
    count, space = len(pool), pool.action_space
    if isinstance(space, gym.spaces.Discrete):
        return rng.integers(space.n, size=count)
    return rng.uniform(-1, 1, (count, *space.shape)).astype(np.float32)


def started(task_id: str, envs: int, seed: int = 0, **settings: Any) -> Any:
    pool = make_pool(task_id, [seed + i for i in range(envs)], num_threads=1, **settings)
    pool.reset()
    return pool


# --- Layout -----------------------------------------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore:.*is out of date")
@pytest.mark.parametrize("task_id", known_tasks())
def test_a_spec_is_that_of_the_mirrored_env(task_id: str):
    """So a checkpoint that was trained on the one fits the other."""
    mirrored = make_env(HIGHWAY_ENV_OF[task_id], disable_env_checker=True)
    env = EnvPoolEnv(task_id)
    assert EnvPoolReader(env).spec == HighwayReader(mirrored).spec
    assert EnvPoolReader(env, 60.0, 6).spec == HighwayReader(mirrored, 60.0, 6).spec
    assert isinstance(reader_for(env), EnvPoolReader) and reader_for(env, 60.0, 6).spec.max_agents == 6
    assert env.observation_space.shape == mirrored.observation_space.shape
    assert isinstance(env.action_space, type(mirrored.action_space))
    assert getattr(env.action_space, "n", env.action_space.shape) == getattr(
        mirrored.action_space, "n", mirrored.action_space.shape
    )


def test_dt_counts_whole_simulation_frames():
    """As the simulation does: 15 Hz of frames at 4 Hz of decisions are 3 frames, not 3.75."""
    assert envpool_spec("Merge-v0", {"simulation_frequency": 15, "policy_frequency": 4}).dt_s == pytest.approx(0.2)
    assert envpool_spec("Merge-v0", {"simulation_frequency": 15, "policy_frequency": 1}).dt_s == 1.0


@pytest.mark.parametrize(("simulated", "decided"), [(15, 0), (0, 1), (15, "often"), (15, 100), (15, -1)])
def test_frequencies_without_a_frame_for_each_decision_are_named(simulated: Any, decided: Any):
    with pytest.raises(UserError, match=f"the first not below the second, got {simulated} and {decided}"):
        envpool_spec("Merge-v0", {"simulation_frequency": simulated, "policy_frequency": decided})


@pytest.mark.parametrize("task_id", known_tasks())
def test_which_tasks_always_begin_alike(task_id: str):
    pools = [vehicles_of(started(task_id, 2, seed).debug_states())[0] for seed in (0, 7)]
    alike = np.array_equal(pools[0], pools[1]) and np.array_equal(pools[0][0], pools[0][1])
    assert alike == begins_alike(task_id)


# --- What is seen -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("task_id", ["HighwayFast-v0", "Intersection-v0", "Racetrack-v0"])
def test_states_are_those_of_the_simulator(task_id: str):
    env = EnvPoolEnv(task_id)
    reader = EnvPoolReader(env)
    env.reset(seed=3)
    for _ in range(3):
        scene, (state,) = reader.read_all(env), env.debug_states()
        for one, vehicle in zip(scene.states, state.vehicles, strict=True):
            velocity = vehicle.speed * np.array([np.cos(vehicle.heading), np.sin(vehicle.heading)])
            np.testing.assert_allclose(one, [vehicle.x, vehicle.y, *velocity], rtol=1e-15)
        assert scene.heading_rad == state.vehicles[0].heading
        scene.check("test", reader.spec)
        env.step(np.zeros(1) if task_id == "Racetrack-v0" else 1)


@pytest.mark.parametrize("task_id", known_tasks())
def test_the_ego_has_index_0(task_id: str):
    """Its speed is the one that EnvPool reports for the controlled vehicle, and no other vehicle's."""
    pool, rng = started(task_id, 8), np.random.default_rng(0)
    for _ in range(5):
        _, _, _, _, info = pool.step(actions_of(pool, rng))
        kinematics, _ = vehicles_of(pool.debug_states())
        np.testing.assert_allclose(kinematics[:, 0, 2], info["speed"], rtol=1e-6)


@pytest.mark.parametrize(("perception_m", "max_agents"), [(100.0, 12), (60.0, 6), (1.0, 3), (400.0, 40)])
@pytest.mark.parametrize("task_id", ["HighwayFast-v0", "Roundabout-v0"])
def test_perception_is_that_of_one_env(task_id: str, perception_m: float, max_agents: int):
    """The whole pool at once sees what `perceive` sees one by one, bit for bit."""
    pool, rng, envs = started(task_id, 5), np.random.default_rng(0), np.arange(5)
    spec = envpool_spec(task_id, pool.config, perception_m, max_agents)
    reader = PoolReader(spec, 5)
    for _ in range(4):
        batch, full = reader.read(pool.debug_states(), envs), reader.read_all(pool.debug_states(), envs)
        for i in envs:
            one = Scene(full.states[i], full.ids[i], full.valid[i], float(full.heading_rad[i]))
            expected = perceive(one, spec)
            np.testing.assert_array_equal(batch.states[i], expected.states)
            np.testing.assert_array_equal(batch.ids[i], expected.ids)
            np.testing.assert_array_equal(batch.valid[i], expected.valid)
            assert batch.heading_rad[i] == expected.heading_rad
        pool.step(actions_of(pool, rng))


def test_scenes_of_different_size_are_padded():
    states = [State([Seen(0, 0, 1, 0), Seen(9, 0, 2, np.pi / 2)], 0), State([Seen(5, 5, 3, 0)], 0)]
    reader = PoolReader(SceneSpec(dt_s=1.0, max_agents=2), 2)
    full = reader.read_all(states, np.arange(2))
    assert full.valid.tolist() == [[True, True], [True, False]]
    assert full.ids.tolist() == [[0, 1], [0, -1]]
    np.testing.assert_allclose(full.states[0, 1], [9, 0, 0, 2], atol=1e-15)
    assert (full.states[1, 1] == 0).all()
    assert reader.read(states, np.arange(2)).ids.tolist() == [[0, 1], [0, -1]]


# --- Who is who -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("task_id", BUSY_TASKS)
def test_identities_survive_a_hidden_order(task_id: str):
    """EnvPool's list keeps its order, so its index is the truth; the reader gets it shuffled, and kinematics only."""
    pool, rng, envs = started(task_id, 4, duration=12), np.random.default_rng(1), np.arange(4)
    reader = PoolReader(envpool_spec(task_id, pool.config), 4)
    count = len(pool.debug_states()[0].vehicles)
    before, clock, pairs, wrong = np.zeros((4, count), dtype=np.int64), np.full(4, 99), 0, 0
    for _ in range(20):
        states, order = pool.debug_states(), np.r_[0, 1 + rng.permutation(count - 1)]
        now = np.empty((4, count), dtype=np.int64)
        now[:, order] = reader.read_all([shown(s, order) for s in states], envs).ids
        for i, state in enumerate(states):
            if state.elapsed_step > clock[i]:
                wrong += int((now[i] != before[i]).sum())
                pairs += count - 1
            else:
                assert sorted(now[i]) == list(range(count))  # a new episode numbers anew
        before, clock = now, np.array([s.elapsed_step for s in states])
        pool.step(actions_of(pool, rng))
    assert pairs > 150
    assert wrong <= EXPECTED_SPLITS.get(task_id, 0)


def test_the_nearest_vehicle_is_often_another():
    """What the test above would not notice if vehicles hardly moved: where they were tells little."""
    pool = started("HighwayFast-v0", 4)
    was, _ = vehicles_of(pool.debug_states())
    pool.step(np.ones(4, dtype=np.int64))
    now, _ = vehicles_of(pool.debug_states())
    gaps_m = np.linalg.norm(now[:, 1:, None, :2] - was[:, None, 1:, :2], axis=-1)
    wrong = gaps_m.argmin(axis=2) != np.arange(gaps_m.shape[1])
    assert wrong.mean() > 0.5


def drifting(rng: np.random.Generator, agents: int, steps: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Vehicles in a small place with sudden changes of speed, so that some are taken for others."""
    place, motion = rng.uniform(0, 40, (agents, 2)), rng.normal(0, 8, (agents, 2))
    path = []
    for _ in range(steps):
        path.append((place.copy(), motion.copy()))
        motion = motion + rng.normal(0, 6, motion.shape)
        place = place + motion * DT_S
    return path


@settings(max_examples=40)
@given(st.integers(0, 10_000), st.integers(1, 9), st.sampled_from([3.0, GATE_M, 100.0]))
def test_many_envs_at_once_are_as_one_by_one(seed: int, agents: int, gate_m: float):
    """`PoolIdentity` against `IdentityTracker`, with absences, shuffles, resets and steps of some environments only."""
    rng, envs = np.random.default_rng(seed), 3
    pool, single = PoolIdentity(envs, gate_m), [IdentityTracker(DT_S, gate_m) for _ in range(envs)]
    paths = [drifting(rng, agents, 6) for _ in range(envs)]
    for t in range(6):
        some = np.flatnonzero(rng.random(envs) < 0.8) if t else np.arange(envs)
        for i in some[rng.random(len(some)) < 0.2]:
            pool.reset(np.array([i]))
            single[i].reset()
        orders = [rng.permutation(agents) for _ in some]
        width = int(rng.integers(1, agents + 1))
        place, motion = (np.stack([paths[i][t][k][o[:width]] for i, o in zip(some, orders, strict=True)]) if len(some)
                         else np.zeros((0, width, 2)) for k in (0, 1))  # fmt: skip
        present = rng.random(place.shape[:2]) < 0.8
        found = pool.update(place, motion, present, some, np.full(len(some), DT_S))
        for n, i in enumerate(some):
            assert found[n].tolist() == single[i].update(place[n], motion[n], present[n]).tolist()


def test_who_comes_after_nobody_was_there_is_new():
    pool, single = PoolIdentity(1, GATE_M), IdentityTracker(DT_S, GATE_M)
    here, still, there = np.array([[10.0, 0.0]]), np.zeros((1, 2)), np.ones(1, dtype=bool)
    for place, motion, valid in ((here, still, there), (here[:0], still[:0], there[:0]), (here + 1, still, there)):
        found = pool.update(place[None], motion[None], valid[None], np.arange(1), np.array([DT_S]))
        assert found[0].tolist() == single.update(place, motion, valid).tolist()
    assert found.tolist() == [[1]]


def test_a_skipped_step_is_part_of_the_motion():
    pool, envs, order = started("HighwayFast-v0", 2), np.arange(2), np.r_[0, 20:0:-1]
    reader = PoolReader(envpool_spec("HighwayFast-v0", pool.config), 2)
    reader.read_all(pool.debug_states(), envs)
    for _ in range(3):
        for _ in range(2):
            pool.step(np.ones(2, dtype=np.int64))
        found = reader.read_all([shown(s, order) for s in pool.debug_states()], envs).ids
        np.testing.assert_array_equal(found, np.broadcast_to(order, (2, 21)))


def test_reading_twice_changes_nothing():
    env = EnvPoolEnv("HighwayFast-v0")
    reader, once = EnvPoolReader(env), EnvPoolReader(env)
    env.reset(seed=0)
    for _ in range(4):
        expected = once.read(env)
        for _ in range(2):
            full, perceived = reader.read_all(env), reader.read(env)
            assert full.ids.tolist() == list(range(21))
            np.testing.assert_array_equal(perceived.ids, expected.ids)
            np.testing.assert_array_equal(perceived.states, expected.states)
        env.step(1)


def test_a_new_episode_numbers_anew_without_a_reset():
    env = EnvPoolEnv("HighwayFast-v0", vehicles_count=6)
    reader = EnvPoolReader(env)
    env.reset(seed=0)
    reader.read_all(env)
    env.step(1)
    reader.read_all(env)
    env.reset()
    assert reader.read_all(env).ids.tolist() == list(range(7))
    env.reset()
    env.step(1)
    reader.reset()
    assert reader.read_all(env).ids.tolist() == list(range(7))


# --- Errors -----------------------------------------------------------------------------------------------------------


def test_only_envpool_is_taken_for_envpool():
    highway, native = make_env("highway-fast-v0", disable_env_checker=True), EnvPoolEnv("Merge-v0")
    assert is_envpool_env(native) and is_envpool_env(gym.wrappers.FlattenObservation(native))
    assert not is_envpool_env(highway)
    with pytest.raises(
        UserError, match=r"EnvPoolReader needs an EnvPoolEnv \(envs.simulators.envpool\), got HighwayEnvFast"
    ):
        EnvPoolReader(highway)


def test_a_task_without_a_reader_is_named():
    with pytest.raises(UserError, match="no scene reader knows EnvPool's task 'Parking-v0'; known: Highway-v0"):
        envpool_spec("Parking-v0", {"simulation_frequency": 15, "policy_frequency": 5})


def test_a_vehicle_that_is_nowhere_is_named():
    states = [State([Seen(0, 0, 1, 0), Seen(float("nan"), 0, 2, 0)], 0)]
    with pytest.raises(UserError, match="vehicle whose position, speed or heading is not finite"):
        vehicles_of(states)


def test_reading_before_the_first_reset_is_named():
    env = EnvPoolEnv("Merge-v0")
    with pytest.raises(ProtocolError, match=r"no vehicles yet; call reset\(\) first"):
        EnvPoolReader(env).read(env)
