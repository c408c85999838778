"""What all streams keep apart: the noise, history and latest forecast of each environment."""

from copy import deepcopy
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest

from envs.observation import ForecastStream
from envs.plans.batch import PlanBatch
from envs.scene_stream import ForecastConfig, SceneStream
from predictor.baselines.constant_velocity import ConstantVelocity
from predictor.scene import Forecast, SceneBatch
from predictor.support.errors import ProtocolError, UserError
from tests.envs.helpers import HIGHWAY_SPEC, PLURAL, assert_same, random_scenes, tiny_model

ENVS, SAMPLES = 3, 4


def stream(envs: int = ENVS, seed: int = 0, samples: int = SAMPLES) -> ForecastStream:
    return ForecastStream(tiny_model(HIGHWAY_SPEC), HIGHWAY_SPEC, envs, ForecastConfig(num_samples=samples, seed=seed))


def scenes(seed: int, envs: int = ENVS) -> SceneBatch:
    return random_scenes(np.random.default_rng(seed), envs, 6, present=[4] * envs)


def of(entries: dict[str, Any], env: int) -> dict[str, Any]:
    return {key: value[env] for key, value in entries.items()}


def assert_shows(made: ForecastStream, env: int, alone: ForecastStream) -> None:
    """The public forecast and scene of an environment are those of a stream that has only this one."""
    assert made.forecast is not None and alone.forecast is not None
    for field in fields(Forecast):
        if (expected := getattr(alone.forecast, field.name)) is not None:
            assert_same(getattr(made.forecast, field.name)[env].numpy(), expected[0].numpy())
    assert made.scenes is not None and alone.scenes is not None
    np.testing.assert_array_equal(made.scenes.states[env], alone.scenes.states[0])


def test_an_environment_draws_what_it_draws_alone():
    together, now = stream(seed=10), [scenes(t) for t in range(3)]
    found = [together.observe(each) for each in now]
    for env in range(ENVS):
        alone = stream(envs=1, seed=10 + env)
        for each, entries in zip(now, found, strict=True):
            assert_same(of(entries, env), of(alone.observe(each[np.array([env])]), 0))


def test_environments_draw_different_noise():
    made = stream()
    same = scenes(0, 1)[np.zeros(ENVS, dtype=np.int64)]
    samples = made.observe(same)["forecast"]
    np.testing.assert_allclose(samples[0, :, 0], samples[1, :, 0], atol=1e-4)
    for one, other in ((0, 1), (0, 2), (1, 2)):
        assert np.abs(samples[one, :, 1:] - samples[other, :, 1:]).max() > 1e-2


@pytest.mark.parametrize("seed", [-1, 1.5, None, [1, 2], [1, 2, 3, 4], [1.5, 2, 3], [1, -2, 3]])
def test_seeds_are_whole_numbers_one_for_each_environment(seed: Any):
    made, untouched = stream(), stream()
    with pytest.raises(
        UserError, match=r"seed needs a whole number from 0 on, or a list of 3 such numbers or None, got"
    ):
        made.seed(seed)
    assert_same(made.observe(scenes(0)), untouched.observe(scenes(0)))


def test_a_seed_restarts_the_noise_of_its_environment_only():
    made, untouched = stream(), stream()
    for each in (made, untouched):
        each.observe(scenes(0))
    made.seed([None, 77, None])
    found, expected = made.observe(scenes(1)), untouched.observe(scenes(1))
    assert_same(of(found, 0), of(expected, 0), tolerance=0.0)
    assert_same(of(found, 2), of(expected, 2), tolerance=0.0)
    assert np.abs(found["forecast"][1] - expected["forecast"][1]).max() > 1e-3
    fresh = stream(seed=77 - 1)
    fresh.observe(scenes(0))
    fresh.seed(77 - 1)
    assert_same(of(found, 1), of(fresh.observe(scenes(1)), 1), tolerance=0.0)


def test_noise_is_not_what_an_environment_draws_from_the_same_seed():
    """Gymnasium's generator of an environment with seed 5 is default_rng(5)."""
    [noise] = stream(envs=1, seed=5)._noise
    assert not np.intersect1d(noise.random(100), np.random.default_rng(5).random(100)).size


def test_over_a_boundary_scene_and_forecast_are_those_of_the_new_episode():
    made, first, last, opening = stream(), scenes(0), scenes(1), scenes(2, 1)
    made.observe(first)
    entries = made.observe_boundary(last, np.array([1]), opening)
    alone = [stream(envs=1, seed=env) for env in range(ENVS)]
    for env, single in enumerate(alone):
        single.observe(first[np.array([env])])
        assert_same(of(entries, env), of(single.observe(last[np.array([env])]), 0))
    alone[1].reset()
    assert_same(of(entries, ENVS), of(alone[1].observe(opening), 0))
    for env, single in enumerate(alone):
        assert_shows(made, env, single)
    assert made.forecast is not None and len(made.forecast.xy) == ENVS


def test_over_a_boundary_a_seed_restarts_the_noise_of_the_new_episode_alone():
    made, untouched, fresh = stream(), stream(), stream(envs=1, seed=77)
    first, last, opening = scenes(0), scenes(1), scenes(2, 2)
    for each in (made, untouched):
        each.observe(first)
    ended = np.array([1, 2])
    found = made.observe_boundary(last, ended, opening, seeds=[77, None])
    expected = untouched.observe_boundary(last, ended, opening)
    for env in (0, 1, 2, ENVS + 1):
        assert_same(of(found, env), of(expected, env), tolerance=0.0)
    assert np.abs(found["forecast"][ENVS] - expected["forecast"][ENVS]).max() > 1e-3
    assert_same(of(found, ENVS), of(fresh.observe(opening[np.array([0])]), 0))
    following = scenes(3)
    assert_same(of(made.observe(following), 1), of(fresh.observe(following[np.array([1])]), 0))


def test_after_some_environments_scene_and_forecast_of_the_others_stay():
    made, first, second = stream(), scenes(0), scenes(1, 2)
    alone = [stream(envs=1, seed=env) for env in range(ENVS)]
    made.observe(first)
    made.observe(second, np.array([2, 0]))
    for env, single in enumerate(alone):
        single.observe(first[np.array([env])])
    alone[2].observe(second[np.array([0])])
    alone[0].observe(second[np.array([1])])
    for env, single in enumerate(alone):
        assert_shows(made, env, single)


def test_environments_may_come_one_by_one_from_the_start():
    made, alone = stream(), stream(envs=1, seed=2)
    made.observe(scenes(0, 1), np.array([2]))
    alone.observe(scenes(0, 1))
    assert_shows(made, 2, alone)
    assert made.forecast is not None and not made.forecast.xy[:2].any()


def test_a_copy_continues_by_itself_and_shares_the_network():
    made = stream()
    made.observe(scenes(0))
    copy = deepcopy(made)
    assert copy.forecaster is made.forecaster
    expected = [made.observe(scenes(t)) for t in (1, 2)]
    for t, entries in zip((1, 2), expected, strict=True):
        assert_same(copy.observe(scenes(t)), entries, tolerance=0.0)


def test_a_copy_is_not_touched_by_a_reset_of_the_original():
    made, kept = stream(), stream()
    for each in (made, kept):
        each.observe(scenes(0))
    copy = deepcopy(made)
    made.reset()
    made.seed(9)
    assert_same(copy.observe(scenes(1)), kept.observe(scenes(1)), tolerance=0.0)


# --- Again, with other samples ----------------------------------------------------------------------------------------


def plural(envs: int = ENVS, samples: int = 1) -> ForecastStream:
    model = tiny_model(HIGHWAY_SPEC, **PLURAL)
    return ForecastStream(model, HIGHWAY_SPEC, envs, ForecastConfig(num_samples=samples))


@pytest.mark.parametrize("make", [plural, stream], ids=["modes", "draws"])
@pytest.mark.parametrize("samples", [1, 3, 4, 9])
def test_forecasting_again_changes_no_observation(make: Any, samples: int):
    made, untouched = make(samples=1), make(samples=1)
    for t in range(3):
        assert_same(made.observe(scenes(t)), untouched.observe(scenes(t)), tolerance=0.0)
        shown, taken = made.forecast, made.scenes
        kept = deepcopy(made.forecast)
        again = made.again(samples)
        assert made.forecast is shown and made.scenes is taken
        for field in fields(Forecast):
            before, after = getattr(kept, field.name), getattr(shown, field.name)
            assert (before is None and after is None) or bool((before == after).all()), field.name
        assert again.xy.shape[:2] == (ENVS, samples)
        assert_same(again.xy[:, :1].numpy(), shown.xy.numpy())
        assert (again.mode_probs is not None) == (make is plural and samples <= PLURAL["num_modes"])
        assert (again.xy_scale is not None) == (make is plural)


def test_forecasting_again_gives_what_a_stream_with_as_many_samples_shows():
    one, many = plural(samples=1), plural(samples=3)
    for t in range(2):
        one.observe(scenes(t)), many.observe(scenes(t))
    again, shown = one.again(3), many.forecast
    assert shown is not None
    for field in fields(Forecast):
        if (expected := getattr(shown, field.name)) is not None:
            assert_same(getattr(again, field.name).numpy(), expected.numpy())


def test_forecasting_again_draws_from_the_noise_of_each_environment():
    made, alone = stream(samples=1), stream(envs=1, seed=2, samples=1)
    made.observe(scenes(0))
    alone.observe(scenes(0)[np.array([2])])
    assert_same(made.again(SAMPLES).xy[2:].numpy(), alone.again(SAMPLES).xy.numpy())
    first, second = made.again(SAMPLES).xy, made.again(SAMPLES).xy
    assert (first[:, 1:] - second[:, 1:]).abs().max() > 1e-2
    assert_same(first[:, :1].numpy(), second[:, :1].numpy())


@pytest.mark.parametrize("make", [plural, stream], ids=["modes", "draws"])
def test_over_a_boundary_forecasting_again_is_of_the_new_episodes(make: Any):
    made, plain = make(), make()
    for each in (made, plain):
        each.observe(scenes(0))
        each.observe_boundary(scenes(1), np.array([0, 2]), scenes(2, 2))
    for again in (made.pictured(3), made.again(3)):
        assert len(again.xy) == ENVS and made.forecast is not None
        assert_same(again.xy[:, :1].numpy(), made.forecast.xy[:, :1].numpy())
    assert_same(plain.again(3).xy.numpy(), again.xy.numpy())
    if make is stream:  # closing scenes take nothing of the noise of the episodes that follow
        for env in (1, 2):
            alone = make(envs=1, seed=env)
            for each in (scenes(0), scenes(1)):
                alone.observe(each[np.array([env])])
            if env == 2:
                alone.reset()
                alone.observe(scenes(2, 2)[np.array([1])])
            alone.pictured(3)
            assert_same(again.xy[env : env + 1].numpy(), alone.again(3).xy.numpy())


def test_without_an_ego_no_agent_is_taken_for_it():
    """A forecaster with an ego gets one that is absent: no agent is its origin, and none is left out."""
    layout = replace(HIGHWAY_SPEC, has_ego=False, frame=("world", "world"))
    forecaster = ConstantVelocity(replace(layout, has_ego=True))
    found = SceneStream(forecaster, layout, ENVS, ForecastConfig()).take(scenes(0))
    expected = scenes(0).states[:, :, :2] + layout.dt_s * scenes(0).states[:, :, 2:4]
    there = scenes(0).valid
    np.testing.assert_allclose(found.xy[:, 0, :, 0].numpy()[there], expected[there], rtol=1e-4)
    with pytest.raises(UserError, match="observations need scenes with an ego and positions in a plane, got has_ego=F"):
        ForecastStream(forecaster, layout, ENVS, ForecastConfig())


def test_a_forecaster_of_another_time_step_is_refused():
    """Its forecast would be of other times than the ego's path."""
    with pytest.raises(UserError, match="forecaster was trained at dt_s=1 but the stream of scenes steps at dt_s=0.1"):
        ForecastStream(tiny_model(HIGHWAY_SPEC), replace(HIGHWAY_SPEC, dt_s=0.1), ENVS, ForecastConfig())


def test_samples_of_all_agents_and_environments_must_fit_into_memory(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("predictor.support.memory.memory_bytes", lambda: 10**6)
    needed = 8 * HIGHWAY_SPEC.max_agents * tiny_model(HIGHWAY_SPEC).horizon_steps
    fits = 10**6 // needed
    ForecastStream(tiny_model(HIGHWAY_SPEC), HIGHWAY_SPEC, 1, ForecastConfig(num_samples=fits))
    with pytest.raises(UserError, match="pass a smaller --num-samples"):
        ForecastStream(tiny_model(HIGHWAY_SPEC), HIGHWAY_SPEC, 2, ForecastConfig(num_samples=fits))


def test_over_a_boundary_plans_are_those_of_the_new_episode():
    config = ForecastConfig(num_plans=2)
    made = ForecastStream(tiny_model(HIGHWAY_SPEC), HIGHWAY_SPEC, ENVS, config)
    first, last, opening = scenes(0), scenes(1), scenes(2, 1)
    made.observe(first, plans=plans_of(first))
    assert made.planned is not None and len(made.planned.xy) == ENVS
    made.observe_boundary(last, np.array([1]), opening, plans_of(SceneBatch.concatenate(last, opening)))
    alone = ForecastStream(tiny_model(HIGHWAY_SPEC), HIGHWAY_SPEC, 1, config)
    alone.observe(opening, plans=plans_of(opening))
    assert alone.planned is not None and len(made.planned.xy) == ENVS
    assert_same(made.planned.xy[1].numpy(), alone.planned.xy[0].numpy())


def plans_of(batch: SceneBatch) -> PlanBatch:
    """Two plans of each ego: it keeps its velocity, or stands."""
    horizon = tiny_model(HIGHWAY_SPEC).horizon_steps
    states = np.repeat(np.repeat(batch.states[:, None, None, 0], horizon, axis=2), 2, axis=1)
    states[:, 0, :, :2] += np.arange(1, horizon + 1)[:, None] * states[:, 0, :, 2:4] * HIGHWAY_SPEC.dt_s
    states[:, 1, :, 2:4] = 0.0
    return PlanBatch(states, np.full((len(batch), 2), 5.0))


def test_where_some_environments_came_alone_nothing_is_forecast_again():
    made = stream()
    made.observe(scenes(0))
    made.take(scenes(1)[np.array([1])], np.array([1]))
    with pytest.raises(ProtocolError, match="only some environments gave the latest scenes"):
        made.again(2)
    made.observe(scenes(2))
    assert len(made.pictured(2).xy) == ENVS


@pytest.mark.parametrize("samples", [1, SAMPLES, 9])
def test_what_is_drawn_uses_up_no_noise(samples: int):
    """An episode that is filmed is the one that is not."""
    filmed, plain = stream(), stream()
    for t in range(3):
        assert_same(filmed.observe(scenes(t)), plain.observe(scenes(t)), tolerance=0.0)
        pictured = filmed.pictured(samples)
        assert pictured.xy.shape[1] == samples and filmed.forecast is not None
        assert_same(pictured.xy[:, :1].numpy(), filmed.forecast.xy[:, :1].numpy())


def test_a_negative_seed_is_named():
    assert ForecastConfig(seed=0).seed == 0
    with pytest.raises(UserError, match="seed must not be negative, got -1"):
        ForecastConfig(seed=-1)


@pytest.mark.parametrize("num_plans", [0, 2])
def test_forecasts_for_plans_use_up_no_noise(num_plans: int):
    config = ForecastConfig(num_samples=SAMPLES, num_plans=num_plans)
    asked, plain = (SceneStream(tiny_model(HIGHWAY_SPEC), HIGHWAY_SPEC, ENVS, config) for _ in range(2))
    for t in range(3):
        assert_same(asked.take(scenes(t)).xy.numpy(), plain.take(scenes(t)).xy.numpy(), tolerance=0.0)
        first, second = (asked.what_if(plans_of(scenes(t)).states) for _ in range(2))
        assert_same(first.xy.numpy(), second.xy.numpy(), tolerance=0.0)
