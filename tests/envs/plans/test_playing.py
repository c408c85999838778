"""True futures: what a copy of the simulator does is what then happens."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils import EzPickle
from highway_env.envs.common.observation import LidarObservation, OccupancyGridObservation
from stable_baselines3.common.env_util import make_vec_env

from envs import ForecastObservation, make_env
from envs.arms import Arm
from envs.plans import Plans
from envs.plans.playing import followed, with_true_futures
from envs.readers import EntityRowsReader, FunctionReader
from envs.sb3.forecast import VecForecast
from envs.wrappers import SceneObservation
from predictor.scene import Scene, SceneSpec
from predictor.support.errors import UserError


def positions_m(env: SceneObservation | ForecastObservation) -> dict[int, np.ndarray]:
    """Returns the present position of every agent by its id."""
    scene = env.get_wrapper_attr("reader").read_all(env)
    return {int(i): s[:2] for i, s, v in zip(scene.ids, scene.states, scene.valid, strict=True) if v}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("env_id", "plan"),
    [("highway-fast-v0", 1), ("merge-v1", 0), ("intersection-v2", 1), ("roundabout-v1", 0), ("racetrack-v1", 1)],
)
def test_the_oracle_is_what_then_happens(env_id: str, plan: int):
    env = ForecastObservation(make_env(env_id), what_if=True, arm=Arm("oracle-what-if"))
    env.reset(seed=3)
    idle = env.plans.actions[0]
    env.step(idle)
    true, plans, scene = env.plans.true_xy, env.plans, env.scene
    assert true.shape == (len(plans.actions), len(scene.ids), env.stream.horizon_steps, 2)
    moved = 0
    for step, action in enumerate((plans.actions[plan], *plans.later_actions[plan])):
        _, _, terminated, truncated, _ = env.step(action)
        now = positions_m(env)
        for place in np.flatnonzero(scene.valid):
            if int(scene.ids[place]) in now:
                np.testing.assert_allclose(true[plan, place, step], now[int(scene.ids[place])], atol=1e-9)
                moved += 1
        if terminated or truncated:
            break
    assert moved > 3
    env.close()


@pytest.mark.parametrize("env_id", ["highway-fast-v0", pytest.param("intersection-v2", marks=pytest.mark.slow)])
def test_an_observation_shows_what_then_happens(env_id: str):
    """Agents are told apart by where they are now; gaps follow the distances that the ego has in each plan."""
    apart_m, gap_m = list[np.ndarray](), np.zeros((0, 1))
    while len(apart_m) < gap_m.shape[1]:
        plan = len(apart_m)
        env = ForecastObservation(make_env(env_id), what_if=True, arm=Arm("oracle-what-if"))
        env.reset(seed=3)
        shown, *_ = env.step(env.plans.actions[0])
        plans, ego, heading, ego_id = env.plans, env.scene.states[0, :2], env.scene.heading_rad, int(env.scene.ids[0])
        turn = np.array([[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]])
        before = positions_m(env)
        slots = np.flatnonzero(shown["valid"])
        there = ego + shown["agents"][slots, :2] @ turn.T
        ids = [min(before, key=lambda i, xy=xy: np.hypot(*(before[i] - xy))) for xy in there]
        assert len(set(ids)) == len(ids) > 3
        distances = [[np.hypot(*(before[i] - ego)) for i in ids]]
        for step, action in enumerate((plans.actions[plan], *plans.later_actions[plan])):
            env.unwrapped.step(action)  # on after a collision, as the copies
            now = positions_m(env)
            if not set(ids) <= set(now):
                break
            if plan == 0:
                expected = np.array([now[i] for i in ids])
                np.testing.assert_allclose(ego + shown["forecast"][slots, step] @ turn.T, expected, atol=1e-3)
            distances.append([np.hypot(*(now[i] - now[ego_id])) for i in ids])
        assert len(distances) > 3
        apart_m.append(np.min(distances, axis=0))
        gap_m = shown["what_if_gap"][slots]
        env.close()
    apart, gap = np.transpose(apart_m), gap_m
    assert (gap < apart - 1.9).all()  # vehicles are 2 m wide
    of_plans = [values - values.mean(axis=1, keepdims=True) for values in (apart, gap)]
    assert np.corrcoef(*(values.ravel() for values in of_plans))[0, 1] > 0.9


@pytest.mark.slow
def test_a_wrapper_that_counts_the_end_of_an_episode_lets_copies_go_on():
    """Stable-Baselines3's Monitor refuses steps after the end, and highway-env's copies are played past it."""
    venv = VecForecast(
        make_vec_env("highway-fast-v0", 1, wrapper_class=SceneObservation, seed=0), "constant-velocity",
        arm=Arm("oracle"),
    )  # fmt: skip
    venv.reset()
    for _ in range(6):
        observation = venv.step(np.array([3]))[0]
    assert np.isfinite(observation["forecast"]).all()
    venv.close()


def test_an_environment_that_cannot_be_copied_is_a_sentence(tmp_path: Path):
    venv = make_vec_env("highway-fast-v0", 1, wrapper_class=SceneObservation, monitor_dir=str(tmp_path))
    with pytest.raises(UserError, match="the environment cannot be copied, which true futures need: cannot pickle"):
        VecForecast(venv, "constant-velocity", arm=Arm("oracle")).reset()
    venv.close()


@pytest.mark.slow
def test_plans_have_different_futures_of_the_others():
    """Others react: behind an ego that brakes, they brake."""
    env = ForecastObservation(make_env("highway-fast-v0"), what_if=True, arm=Arm("oracle-what-if"))
    env.reset(seed=3)
    others = env.plans.true_xy[:, 1:]
    assert np.abs(others[0] - others[1]).max() > 1.0
    env.close()


@pytest.mark.slow
def test_the_environment_is_not_touched():
    plain, watched = (make_env("intersection-v2") for _ in range(2))
    watched = ForecastObservation(watched, arm=Arm("oracle"))
    seen, _ = plain.reset(seed=1)
    shown, _ = watched.reset(seed=1)
    for _ in range(4):
        np.testing.assert_array_equal(seen, shown["observation"])
        seen, *_ = plain.step(1)
        shown, *_ = watched.step(1)
    plain.close()
    watched.close()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "kind"), [("OccupancyGrid", OccupancyGridObservation), ("LidarObservation", LidarObservation)]
)
def test_costly_observations_are_not_drawn_in_copies(name: str, kind: type, monkeypatch: pytest.MonkeyPatch):
    """The environment's own goes on being drawn."""
    env = ForecastObservation(
        make_env("highway-fast-v0", config={"observation": {"type": name}}), arm=Arm("oracle-what-if"), what_if=True
    )
    first, _ = env.reset(seed=3)
    drawn, observe = [], kind.observe
    monkeypatch.setattr(kind, "observe", lambda self: drawn.append(1) or observe(self))
    second, *_ = env.step(env.plans.actions[0])
    assert len(drawn) == 1
    assert not np.array_equal(first["observation"], second["observation"])
    env.close()


@pytest.mark.slow
def test_vector_observations_are_those_of_one_environment():
    from stable_baselines3.common.vec_env import DummyVecEnv

    def make() -> gym.Env:
        return SceneObservation(make_env("merge-v1", disable_env_checker=True))

    env = ForecastObservation(make_env("merge-v1"), arm=Arm("oracle"))
    venv = VecForecast(DummyVecEnv([make, make]), arm=Arm("oracle"))
    venv.seed(7)
    shown: Any = venv.reset()
    one, _ = env.reset(seed=8)
    for _ in range(4):
        np.testing.assert_allclose(shown["forecast"][1], one["forecast"], atol=1e-5)
        shown, _, dones, _ = venv.step(np.array([1, 1]))
        one, _, terminated, *_ = env.step(1)
        assert dones[1] == terminated
        if terminated:
            break
    env.close()
    venv.close()


def test_an_agent_that_leaves_goes_on_at_its_last_velocity():
    env = SceneObservation(make_env("merge-v1"))
    env.reset(seed=0)
    model_plans = ForecastObservation(make_env("merge-v1"), what_if=True)
    model_plans.reset(seed=0)
    scene = env.scene
    ghost = scene.ids.copy()
    place = int(np.flatnonzero(scene.valid)[-1])
    ghost[place] = 10**6  # no such agent in the copy: as one that has left
    unknown = type(scene)(scene.states, ghost, scene.valid, scene.heading_rad)
    plans = with_true_futures(model_plans.plans, env.env, env.reader, unknown, played=1)
    steps = np.arange(1, 6)[:, None] * env.reader.spec.dt_s
    expected = scene.states[place, :2] + steps * scene.states[place, 2:4]
    np.testing.assert_allclose(plans.true_xy[0, place], expected)
    for each in (env, model_plans):
        each.close()


def test_plans_without_later_actions_are_refused():
    env = ForecastObservation(make_env("highway-fast-v0"), what_if=True)
    env.reset(seed=0)
    from dataclasses import replace

    with pytest.raises(UserError, match="true futures need plans with later_actions"):
        with_true_futures(replace(env.plans, later_actions=None), env.env, env.env.reader, env.scene)
    env.close()


def test_readers_of_observations_see_what_then_happens():
    """A table of entities is the reader's only source: the copy shows it every observation."""
    columns = ("presence", "x", "y", "vx", "vy")
    table = {"type": "Kinematics", "features": [*columns], "absolute": True, "normalize": False, "see_behind": True}
    reader = EntityRowsReader(columns, SceneSpec(dt_s=1.0))
    made = make_env("highway-fast-v0", config={"observation": table})
    env = ForecastObservation(made, "highway", reader=reader, arm=Arm("oracle"))
    env.reset(seed=3)
    true, scene = env.plans.true_xy, env.scene
    env.step(env.plans.actions[0])
    now = positions_m(env)
    seen = [place for place in np.flatnonzero(scene.valid) if int(scene.ids[place]) in now]
    assert len(seen) > 2
    for place in seen:
        np.testing.assert_allclose(true[0, place, 0], now[int(scene.ids[place])], atol=1e-3)
    env.close()


class Pair(gym.Env, EzPickle):
    """Another agent walks ahead of the ego; copies and pickles as its constructor's arguments, as mpe2 does."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (1,))
    action_space = gym.spaces.Discrete(2)

    def __init__(self, steps: int = 3) -> None:
        EzPickle.__init__(self, steps)
        self._steps, self._left = steps, 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.states = np.array([[0.0, 0.0, 1.0, 0.0], [10.0, 0.0, 2.0, 0.0]])
        self._left = self._steps
        return np.zeros(1, np.float32), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        if not self._left:
            raise RuntimeError("the episode is over")
        self._left -= 1
        self.states[:, 0] += self.states[:, 2] * [1.0, 1.0 + (self._left == 1)]  # hurries in its last but one step
        return np.zeros(1, np.float32), 0.0, not self._left, False, {}


class TwoPlans:
    """Plans of the pair's ego."""

    names = ("keep", "stop")

    def plans(self, env: gym.Env, horizon_steps: int) -> Plans:
        states = np.zeros((2, horizon_steps, 4))
        return Plans(states, (0, 1), later_actions=((0,) * (horizon_steps - 1),) * 2)


def read_pair(env: gym.Env) -> Scene:
    states = env.unwrapped.states  # type: ignore[attr-defined]
    return Scene(states.copy(), np.arange(2), np.ones(2, bool))


def test_a_simulator_that_copies_as_it_was_made_is_played_from_where_it_is():
    env = SceneObservation(Pair(), reader=FunctionReader(read_pair, SceneSpec(dt_s=1.0, max_agents=2)))
    env.reset(seed=0)
    found = []
    for _ in range(3):
        found.append(env.make_plans(TwoPlans(), 2, None).true_xy[:, 1, :, 0].tolist())
        env.step(0)
    assert found == [[[12.0, 16.0]] * 2, [[16.0, 18.0]] * 2, [[18.0, 20.0]] * 2]
    assert env.scene.states[1, 0] == 18.0
    over = env.make_plans(TwoPlans(), 2, None)  # after the end nothing is played: on at the last velocity
    assert over.true_xy[:, 1, :, 0].tolist() == [[20.0, 22.0]] * 2
    env.reset(seed=0)
    assert env.make_plans(TwoPlans(), 2, None).true_xy[0, 1, :, 0].tolist() == [12.0, 16.0]


def test_an_agent_that_is_not_valid_any_more_goes_on_at_its_last_velocity_although_its_id_stays():
    states = np.array([[0.0, 0.0, 1.0, 0.0], [5.0, 0.0, 0.0, 2.0]])
    now = Scene(states, np.array([3, 4]), np.array([True, True]))
    later = np.array([[0.5, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 0.0]])
    gone = Scene(later, np.array([3, 4]), np.array([True, False]))
    np.testing.assert_array_equal(followed(now, 0.5, [gone, None])[1], [[5.0, 1.0], [5.0, 2.0]])
