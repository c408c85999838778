"""`what_if=` over vector environments gives each environment what `ForecastObservation` gives it alone."""

from collections.abc import Callable
from copy import deepcopy
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, VecMonitor

from envs.entries import FORECAST_KEYS, WHAT_IF_KEYS
from envs.plans import Plans
from envs.plans.batch import PLANS_INFO
from envs.registry import make_env
from envs.sb3.forecast import VecForecast
from envs.vector import VectorForecast
from envs.wrappers import SceneObservation
from predictor.support.errors import UserError
from tests.envs.helpers import MAX_AGENTS, assert_same
from tests.envs.played_alone import ACTIONS, DURATIONS, MAKERS, SEED, STEPS, Played, one_of, play_alone


class SizedPlans:
    """Two plans; how large vehicles are depends on how fast the ego is, so that scenes of a batch differ in it."""

    names = ("stay", "go")

    def plans(self, env: gym.Env, horizon_steps: int) -> Plans:
        x_m, y_m, vx_mps, vy_mps = env.get_wrapper_attr("scene").states[0]
        ahead_m = np.array([0.0, vx_mps])[:, None] * np.arange(1, horizon_steps + 1)
        fields = (x_m + ahead_m, y_m + 0 * ahead_m, vx_mps + 0 * ahead_m, vy_mps + 0 * ahead_m)
        return Plans(np.stack(fields, axis=-1), (1, 1), size_m=(float(vx_mps) / 2, 2.0))


OPTIONS: dict[str, dict[str, Any]] = {
    "draws": {"what_if": True, "num_samples": 3},
    "own-model": {"what_if": SizedPlans(), "horizon_steps": 2},
}
"""The tiny checkpoint draws its samples, from each environment's own noise."""


@pytest.fixture(scope="module", params=OPTIONS)
def options(request: pytest.FixtureRequest) -> dict[str, Any]:
    return OPTIONS[request.param]


@pytest.fixture(scope="module")
def alone(highway_checkpoint: str, options: dict[str, Any]) -> list[Played]:
    return [play_alone(i, highway_checkpoint, **options) for i in range(len(DURATIONS))]


def test_what_the_tests_rely_on(alone: list[Played]):
    """Every environment ends; what plans lead to differs between its closing observation and its next opening."""
    for played in alone:
        assert set(played.opening) >= set(WHAT_IF_KEYS) and any(played.ends)
        for step, opening in played.successors.items():
            assert np.abs(played.steps[step]["what_if_gap"] - opening["what_if_gap"]).max() > 0.5


SB3_KINDS: dict[str, Callable[[], VecEnv]] = {
    "dummy": lambda: VecMonitor(DummyVecEnv(MAKERS)),
    "fork": lambda: SubprocVecEnv(MAKERS[:2], start_method="fork"),
}


# Python 3.12 warns of every fork of a process with threads; that it works is what is tested.
@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*use of fork.. may lead to deadlocks:DeprecationWarning")
@pytest.mark.parametrize("kind", SB3_KINDS)
def test_sb3_envs_are_as_if_alone(kind: str, alone: list[Played], options: dict[str, Any], highway_checkpoint: str):
    venv = VecForecast(SB3_KINDS[kind](), highway_checkpoint, **options)
    episodes = alone[: venv.num_envs]
    try:
        venv.seed(SEED)
        obs: Any = venv.reset()
        for i, played in enumerate(episodes):
            assert_same(one_of(obs, i), played.opening)
            assert venv.observation_space.contains(one_of(obs, i))
        for t in range(STEPS):
            obs, _, dones, infos = venv.step(ACTIONS[t, : len(episodes)])
            assert dones.tolist() == [played.ends[t] for played in episodes]
            assert not any(PLANS_INFO in info for info in infos)
            for i, played in enumerate(episodes):
                if played.ends[t]:
                    assert_same(infos[i]["terminal_observation"], played.steps[t])
                    assert_same(one_of(obs, i), played.successors[t])
                else:
                    assert_same(one_of(obs, i), played.steps[t])
    finally:
        venv.close()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*use of fork.. may lead to deadlocks:DeprecationWarning")
@pytest.mark.parametrize("kind", [SyncVectorEnv, AsyncVectorEnv], ids=["sync", "async"])
def test_same_step_envs_are_as_if_alone(
    kind: Any, alone: list[Played], options: dict[str, Any], highway_checkpoint: str
):
    env = VectorForecast(kind(MAKERS, autoreset_mode=AutoresetMode.SAME_STEP), highway_checkpoint, **options)
    try:
        obs, infos = env.reset(seed=SEED)
        assert obs in env.observation_space and PLANS_INFO not in infos
        for i, played in enumerate(alone):
            assert_same(one_of(obs, i), played.opening)
        for t in range(STEPS):
            obs, _, _, _, infos = env.step(ACTIONS[t])
            assert not {PLANS_INFO, f"_{PLANS_INFO}"} & {*infos, *infos.get("final_info", {})}
            for i, played in enumerate(alone):
                if played.ends[t]:
                    assert_same(infos["final_obs"][i], played.steps[t])
                    assert_same(one_of(obs, i), played.successors[t])
                else:
                    assert_same(one_of(obs, i), played.steps[t])
    finally:
        env.close()


@pytest.mark.slow
def test_next_step_envs_are_as_if_alone(highway_checkpoint: str, options: dict[str, Any]):
    alone = [play_alone(i, highway_checkpoint, idle_steps=True, **options) for i in range(len(DURATIONS))]
    made = SyncVectorEnv(MAKERS, autoreset_mode=AutoresetMode.NEXT_STEP)
    env = VectorForecast(made, highway_checkpoint, **options)
    obs, _ = env.reset(seed=SEED)
    for t in range(STEPS):
        obs = env.step(ACTIONS[t])[0]
        for i, played in enumerate(alone):
            assert_same(one_of(obs, i), played.steps[t])


@pytest.mark.slow
def test_disabled_envs_are_as_if_alone(alone: list[Played], options: dict[str, Any], highway_checkpoint: str):
    """Also where some environments are reset and the others are shown again as they were."""
    made = SyncVectorEnv(MAKERS, autoreset_mode=AutoresetMode.DISABLED)
    env = VectorForecast(made, highway_checkpoint, **options)
    env.reset(seed=SEED)
    for t in range(STEPS):
        obs, _, terminations, truncations, _ = env.step(ACTIONS[t])
        ended = terminations | truncations
        for i, played in enumerate(alone):
            assert_same(one_of(obs, i), played.steps[t])
        if ended.any():
            obs, _ = env.reset(options={"reset_mask": ended})
            for i, played in enumerate(alone):
                assert_same(one_of(obs, i), played.successors[t] if ended[i] else played.steps[t])


@pytest.mark.slow
def test_other_entries_are_as_without_it(highway_checkpoint: str):
    """Bit for bit, with drawn samples too: plans use up no noise."""
    plain, asked = (
        VecForecast(DummyVecEnv(MAKERS), highway_checkpoint, num_samples=3, what_if=what_if)
        for what_if in (False, True)
    )
    assert plain.plan_names == () and asked.plan_names == ("IDLE", "SLOWER", "FASTER", "LANE_LEFT", "LANE_RIGHT")
    for venv in (plain, asked):
        venv.seed(SEED)
    without: Any = plain.reset()
    found: Any = asked.reset()
    for t in range(3):
        assert set(found) == {*without, *WHAT_IF_KEYS} and set(without) > set(FORECAST_KEYS)
        assert_same({key: found[key] for key in without}, without, tolerance=0.0)
        without, found = (venv.step(ACTIONS[t])[0] for venv in (plain, asked))


@pytest.mark.slow
def test_flat_observations_and_copies_continue(highway_checkpoint: str):
    venv = VecForecast(DummyVecEnv(MAKERS), highway_checkpoint, what_if=True, flatten=True)
    venv.seed(SEED)
    venv.reset()
    twin = deepcopy(venv)
    for t in range(3):
        found, expected = (each.step(ACTIONS[t])[0] for each in (twin, venv))
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5)
    assert venv.observation_space.shape == found.shape[1:]


class WithoutInfo(gym.Wrapper[Any, Any, Any, Any]):
    """A wrapper that keeps infos to itself."""

    def reset(self, **kwargs: Any) -> Any:
        return self.env.reset(**kwargs)[0], {}


def test_environments_that_make_no_plans_are_refused(highway_checkpoint: str):
    discrete = partial(make_env, "highway-fast-v0", config={"action": {"type": "DiscreteAction"}})

    def unplanned() -> gym.Env:
        return SceneObservation(discrete(), 60.0, MAX_AGENTS)

    message = "plans are known for DiscreteMetaAction and ContinuousAction"
    with pytest.raises(UserError, match=message):
        VecForecast(DummyVecEnv([unplanned]), highway_checkpoint, what_if=True)
    with pytest.raises(UserError, match=message):
        VectorForecast(SyncVectorEnv([unplanned]), highway_checkpoint, what_if=True)
    venv = DummyVecEnv(MAKERS[:2])
    venv.envs[0].propose_plans = lambda what_if, steps, played: ("other",)  # type: ignore[attr-defined]
    with pytest.raises(UserError, match="all environments must have the same plans"):
        VecForecast(venv, highway_checkpoint, what_if=True)
    silent = VecForecast(DummyVecEnv([lambda: WithoutInfo(MAKERS[0]())]), highway_checkpoint, what_if=True)
    with pytest.raises(UserError, match="an environment reported no plans: its info has no 'ego_plans'"):
        silent.reset()


def test_envpool_makes_no_plans():
    pytest.importorskip("envpool")
    from envs.sb3.envpool import EnvPoolVecEnv

    venv = EnvPoolVecEnv("HighwayFast-v0", 2, seed=0)
    with pytest.raises(UserError, match=r"EnvPoolVecEnv has none \(EnvPool has no plan model\): leave what_if out"):
        VecForecast(VecMonitor(venv), "highway", what_if=True)
    venv.close()
