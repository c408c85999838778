"""`what_if=` puts what happens in each candidate plan into the observation; without it nothing changes."""

import pickle
from copy import deepcopy
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from agents.features import ForecastAttention
from envs.drivers.ego import make_ego_driver
from envs.drivers.planner import Planner
from envs.entries import FORECAST_KEYS, PATH_KEYS, WHAT_IF_KEYS, others_by_distance, what_if_entries
from envs.plans import Plans
from envs.plans.contact import contacts
from envs.registry import make_env
from envs.rollouts import plan_moments
from envs.video.highway import plans_shown
from envs.wrappers import ForecastObservation, SceneObservation
from predictor.baselines.constant_velocity import ConstantVelocity
from predictor.scene import Forecast, SceneBatch
from predictor.support.errors import UserError
from tests.envs.helpers import assert_same

STEPS = 4


def episode(env: gym.Env, seed: int = 0) -> list[Any]:
    found = [env.reset(seed=seed)[0]]
    for _ in range(STEPS):
        found.append(env.step(1)[0])
    return found


def wrapped(**options: Any) -> ForecastObservation:
    return ForecastObservation(make_env("highway-fast-v0"), "highway", **options)


@pytest.mark.parametrize("samples", [1, 3])
def test_every_other_entry_is_as_without_it(samples: int):
    """Bit for bit, with drawn samples too: asking what if uses up no noise."""
    plain, asked = (episode(wrapped(num_samples=samples, what_if=w)) for w in (False, True))
    for without, with_plans in zip(plain, asked, strict=True):
        assert set(with_plans) == {*without, *WHAT_IF_KEYS}
        assert_same({key: with_plans[key] for key in without}, without, tolerance=0.0)


def test_entries_are_bounded_masked_and_sorted():
    env = wrapped(what_if=True, num_samples=2)
    for obs in episode(env):
        assert env.observation_space.contains(obs)
        for key in WHAT_IF_KEYS:
            assert obs[key].shape == (11, 5) and np.isfinite(obs[key]).all()
            assert not obs[key][obs["valid"] == 0].any()
        assert (obs["what_if_contact"][obs["valid"] == 1] > 0).all()
    assert env.plan_model is not None and env.what_if is not None and env.plans is not None
    assert env.plan_model.names == ("IDLE", "SLOWER", "FASTER", "LANE_LEFT", "LANE_RIGHT")
    assert env.what_if.num_plans == 5
    scenes = SceneBatch.stack([env.scene])
    dt_s, order = env.get_wrapper_attr("scene_spec").dt_s, others_by_distance(scenes)[0]
    found = contacts(env.what_if, scenes, env.plans.size_m, dt_s)
    there = obs["valid"] == 1
    np.testing.assert_allclose(obs["what_if_gap"][there], found.gap_m[0, :, 0].T[order][there], rtol=1e-5)
    np.testing.assert_allclose(obs["what_if_risk"][there], found.risk()[0].T[order][there], rtol=1e-5)
    assert len(np.unique(obs["what_if_gap"][0])) > 2  # braking and accelerating differ


def test_a_turned_scene_has_the_same_entries():
    """Gaps and times belong to no frame."""
    env = wrapped(what_if=True)
    env.reset(seed=0)
    assert env.what_if is not None
    scenes, forecast = SceneBatch.stack([env.scene]), env.what_if
    turn = np.array([[0.0, -1.0], [1.0, 0.0]])
    states = scenes.states.copy()
    states[..., :2], states[..., 2:4] = states[..., :2] @ turn.T, states[..., 2:4] @ turn.T
    turned = SceneBatch(states, scenes.ids, scenes.valid, scenes.heading_rad + np.pi / 2)
    xy = forecast.xy @ forecast.xy.new_tensor(turn).T
    other = what_if_entries(
        turned, type(forecast)(xy, forecast.edge_probs, forecast.edge_features, forecast.valid), (5.0, 2.0), 1.0
    )
    for key, value in what_if_entries(scenes, forecast, (5.0, 2.0), 1.0).items():
        np.testing.assert_allclose(other[key], value, atol=1e-3, err_msg=key)


def test_flat_observations_copies_and_pickles_continue():
    env = wrapped(what_if=True, flatten=True)
    env.reset(seed=1)
    env.step(1)
    twins = [deepcopy(env), pickle.loads(pickle.dumps(env))]
    expected = env.step(3)[0]
    assert env.observation_space.contains(expected)
    for twin in twins:
        np.testing.assert_allclose(twin.step(3)[0], expected, rtol=1e-5, atol=1e-5)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::UserWarning")  # of the checker: boxes without bounds
def test_gymnasium_accepts_it():
    check_env(wrapped(what_if=True), skip_render_check=True)


def test_the_policy_reads_it():
    env = wrapped(what_if=True)
    extractor = ForecastAttention(env.observation_space)
    assert set(extractor._keys) == {*WHAT_IF_KEYS, *FORECAST_KEYS, *PATH_KEYS} - {"valid", "ego_path"}


class Stay:
    names = ("stay",)

    def plans(self, env: gym.Env, horizon_steps: int) -> Plans:
        state = env.get_wrapper_attr("scene").states[0].copy()
        return Plans(np.repeat(state[None, None], horizon_steps, axis=1), (1,))


def test_a_plan_model_of_ones_own():
    env = wrapped(what_if=Stay())
    obs = episode(env)[-1]
    assert obs["what_if_gap"].shape == (11, 1)
    assert env.what_if is not None
    np.testing.assert_allclose(env.what_if.xy[:, :, :, 0].numpy(), 0.0, atol=1e-4)  # it stays where it is


class Elsewhere(Stay):
    """Plans in a frame with another origin than the reader's."""

    def plans(self, env: gym.Env, horizon_steps: int) -> Plans:
        plans = super().plans(env, horizon_steps)
        plans.states[..., 0] += 300.0
        return plans


def test_plans_in_another_frame_are_refused():
    env = wrapped(what_if=Elsewhere())
    with pytest.raises(UserError, match="plan model Elsewhere: plans must begin at the ego.*the nearest is 300 m from"):
        env.reset(seed=0)
    scenes = SceneObservation(make_env("highway-fast-v0"))
    scenes.reset(seed=0)
    planner = Planner(scenes, ConstantVelocity(scenes.scene_spec), Elsewhere())
    with pytest.raises(UserError, match="plan model Elsewhere: plans must begin at the ego"):
        planner(None)


def test_environments_without_a_plan_model_are_refused():
    env = make_env("highway-fast-v0", config={"action": {"type": "DiscreteAction"}})
    with pytest.raises(UserError, match="plans are known for DiscreteMetaAction and ContinuousAction"):
        ForecastObservation(env, "highway", what_if=True)


def test_contacts_know_how_long_a_step_is(monkeypatch: pytest.MonkeyPatch):
    """So that slow agents turn where steps are short: in observations, of the planner, in films and measures."""
    lengths: list[float] = []

    def noted(forecast: Forecast, scenes: SceneBatch, size_m: Any, dt_s: float = 1.0) -> Any:
        lengths.append(dt_s)
        return contacts(forecast, scenes, size_m, dt_s)

    for module in ("envs.entries", "envs.drivers.planner", "envs.video.highway", "envs.rollouts.plan_moments"):
        monkeypatch.setattr(f"{module}.contacts", noted)
    plain = make_env("highway-fast-v0", config={"policy_frequency": 5})
    env = ForecastObservation(plain, "constant-velocity", what_if=True)
    obs, _ = env.reset(seed=0)
    assert lengths == [0.2]
    make_ego_driver("planner:constant-velocity", env, np.random.default_rng(0))(obs)
    assert lengths == [0.2, 0.2]
    assert env.plans is not None and env.what_if is not None
    assert len(plans_shown(env)) == env.what_if.num_plans and lengths == [0.2] * 3
    plan_moments._risk(env.what_if, env.scene, replace(env.plans, crashed=None), 0.3, 0.0)
    assert lengths[3:] == [0.3]
