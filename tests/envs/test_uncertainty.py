"""Probabilities and standard deviations of futures in observations: when they are there, and what they say, to all."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.vec_env import DummyVecEnv

from envs.entries import FORECAST_KEYS, PATH_KEYS, ego_entries
from envs.multiagent_observation import MultiagentStream
from envs.observation import ForecastStream
from envs.sb3.agents_as_rows import ParallelVecEnv
from envs.sb3.forecast import VecForecast
from envs.scene_stream import ForecastConfig
from envs.vector import VectorForecast
from envs.wrappers import ForecastObservation
from predictor.baselines.constant_velocity import ConstantVelocity
from predictor.forecaster import Forecaster, Futures
from predictor.scene import Forecast, Scene, SceneBatch, SceneSpec
from predictor.support.errors import UserError
from predictor.testing import forecaster_problems
from tests.envs.helpers import (
    HIGHWAY_SPEC,
    HORIZON,
    PLURAL,
    assert_same,
    random_forecast,
    random_scenes,
    save_tiny,
    short_env,
    short_scene_env,
    tiny_model,
)
from tests.envs.test_batched_forward import copies
from tests.envs.test_multiagent_observation import AROUND_EGO, CENTROID, WORLD, multiagent_scene
from tests.envs.test_parallel import Toy, wrap
from tests.envs.test_parallel import play as play_toy

MODES = PLURAL["num_modes"]
BOTH = {"mode_probs", "xy_scale"}


def uncertain_forecast(
    rng: np.random.Generator, scenes: SceneBatch, samples: int, modes: bool = True, scale: bool = True
) -> Forecast:
    drawn = random_forecast(rng, scenes, samples, HORIZON, 2, 1)
    probs = torch.from_numpy(rng.dirichlet(np.ones(samples), size=scenes.valid.shape)).float().movedim(-1, 1)
    spread = torch.from_numpy(rng.uniform(0.1, 3, size=drawn.xy.shape)).float()
    return replace(drawn, mode_probs=probs if modes else None, xy_scale=spread if scale else None)


def two_others(heading_rad: float = 0.0) -> SceneBatch:
    """The ego, someone 20 m ahead, and someone 10 m ahead, who comes first."""
    states = np.array([[0, 0, 0, 0], [20, 0, 0, 0], [10, 0, 0, 0]], dtype=np.float64)
    return SceneBatch.stack([Scene(states, np.arange(3), np.ones(3, dtype=np.bool_), heading_rad)])


# --- What the entries say ---------------------------------------------------------------------------------------------


def test_futures_of_each_agent_are_sorted_by_its_own_probabilities():
    scenes = two_others()
    forecast = random_forecast(np.random.default_rng(0), scenes, 3, HORIZON, 2, 1)
    probs = torch.tensor([[0.3, 0.2, 0.6], [0.3, 0.5, 0.1], [0.4, 0.3, 0.3]])[None]  # samples × agents
    scale = torch.arange(3.0)[None, :, None, None, None].expand_as(forecast.xy)
    entries = ego_entries(scenes, replace(forecast, mode_probs=probs, xy_scale=scale), uncertainty=True)
    order = [[0, 2, 1], [1, 2, 0]]  # of the nearer agent, 2, then of agent 1
    np.testing.assert_allclose(entries["mode_probs"][0], [[0.6, 0.3, 0.1], [0.5, 0.3, 0.2]])
    for place, agent in enumerate((2, 1)):
        np.testing.assert_allclose(entries["forecast"][0, place], forecast.xy[0, order[place], agent], atol=1e-6)
        assert entries["xy_scale"][0, place, :, 0, 0].tolist() == order[place]


def test_draws_are_equally_likely_and_keep_their_order():
    scenes = two_others()
    forecast = random_forecast(np.random.default_rng(0), scenes, 5, HORIZON, 2, 1)
    entries = ego_entries(scenes, forecast, uncertainty=True)
    np.testing.assert_allclose(entries["mode_probs"], 0.2)
    np.testing.assert_allclose(entries["forecast"][0, 0], forecast.xy[0, :, 2], atol=1e-6)


@pytest.mark.parametrize(
    ("heading_rad", "expected"),
    [
        (0.0, (3.0, 1.0)),
        (np.pi / 2, (1.0, 3.0)),
        (-np.pi / 2, (1.0, 3.0)),
        (np.pi, (3.0, 1.0)),
        (np.pi / 4, (np.sqrt(5), np.sqrt(5))),
        (np.pi / 6, (np.sqrt(0.75 * 9 + 0.25), np.sqrt(0.25 * 9 + 0.75))),
    ],
    ids=["east", "north", "south", "west", "north-east", "30 degrees"],
)
def test_scales_are_along_the_axes_of_the_ego(heading_rad: float, expected: tuple[float, float]):
    """Three metres of uncertainty from west to east, one from south to north."""
    scenes = two_others(heading_rad)
    forecast = random_forecast(np.random.default_rng(0), scenes, 2, HORIZON, 2, 1)
    scale = torch.tensor([3.0, 1.0]).expand_as(forecast.xy)
    found = ego_entries(scenes, replace(forecast, xy_scale=scale), uncertainty=True)["xy_scale"]
    np.testing.assert_allclose(found[0], np.broadcast_to(expected, found[0].shape), rtol=1e-5)


@settings(max_examples=30)
@given(
    seed=st.integers(0, 2**16),
    batch=st.integers(1, 3),
    agents=st.integers(1, 6),
    samples=st.integers(1, 4),
    modes=st.booleans(),
)
def test_entries_equal_a_plain_loop(seed: int, batch: int, agents: int, samples: int, modes: bool):
    rng = np.random.default_rng(seed)
    scenes = random_scenes(rng, batch, agents)
    forecast = uncertain_forecast(rng, scenes, samples, modes)
    entries, plain = ego_entries(scenes, forecast, uncertainty=True), ego_entries(scenes, forecast)
    assert entries.keys() - plain.keys() == BOTH
    shares, scale = forecast.sample_probs(), forecast.xy_scale
    assert scale is not None
    for b in range(batch):
        cos, sin = np.cos(scenes.heading_rad[b]), np.sin(scenes.heading_rad[b])
        turn = np.array([[cos, sin], [-sin, cos]])
        distance = np.hypot(*(scenes.states[b, :, :2] - scenes.states[b, 0, :2]).T)
        present = sorted((a for a in range(1, agents) if scenes.valid[b, a]), key=lambda a, d=distance: d[a])
        for place in range(agents - 1):
            found = {key: entries[key][b, place].reshape(samples, -1) for key in ("forecast", *BOTH)}
            if place >= len(present):
                assert not any(value.any() for value in found.values())
                continue
            a = present[place]
            order = sorted(range(samples), key=lambda k, b=b, a=a: -float(shares[b, k, a]))
            for rank, k in enumerate(order):
                assert found["mode_probs"][rank, 0] == pytest.approx(float(shares[b, k, a]))
                for h in range(HORIZON):
                    step = slice(2 * h, 2 * h + 2)
                    moved = turn @ forecast.xy[b, k, a, h].numpy()
                    np.testing.assert_allclose(found["forecast"][rank, step], moved, atol=1e-5)
                    spread = turn @ np.diag(scale[b, k, a, h].numpy() ** 2) @ turn.T  # covariance in turned axes
                    np.testing.assert_allclose(found["xy_scale"][rank, step] ** 2, np.diag(spread), rtol=1e-4)
    assert {value.dtype for value in entries.values()} == {np.dtype(np.float32)}


def test_padding_is_zero_whatever_the_forecast_holds():
    rng = np.random.default_rng(0)
    scenes = random_scenes(rng, 2, 5, present=[1, 3])
    forecast = uncertain_forecast(rng, scenes, 2)
    assert forecast.mode_probs is not None and forecast.xy_scale is not None
    absent = ~torch.from_numpy(scenes.valid)
    forecast.mode_probs.transpose(1, 2)[absent] = forecast.xy_scale.transpose(1, 2)[absent] = torch.nan
    entries = ego_entries(scenes, forecast, uncertainty=True)
    for key in BOTH:
        assert (entries[key][0] == 0).all() and (entries[key][1, 2:] == 0).all() and (entries[key][1, :2] > 0).all()


# --- When they are there ----------------------------------------------------------------------------------------------

FORECASTERS: dict[str, tuple[Forecaster, bool]] = {
    "plural": (tiny_model(HIGHWAY_SPEC, **PLURAL), True),
    "draws": (tiny_model(HIGHWAY_SPEC), False),
    "straight": (ConstantVelocity(HIGHWAY_SPEC, HORIZON), False),
}


@pytest.mark.parametrize("kind", FORECASTERS)
@pytest.mark.parametrize("samples", [1, 3, MODES, MODES + 2])
@pytest.mark.parametrize("uncertainty", [None, True, False])
def test_entries_are_there_with_several_samples_or_on_request(kind: str, samples: int, uncertainty: bool | None):
    forecaster, has_scale = FORECASTERS[kind]
    config = ForecastConfig(num_samples=samples, uncertainty=uncertainty)
    stream = ForecastStream(forecaster, HIGHWAY_SPEC, 2, config)
    scenes = random_scenes(np.random.default_rng(0), 2, HIGHWAY_SPEC.max_agents, present=[4, 2])
    entries, spaces = stream.observe(scenes), stream.spaces()
    shown = samples > 1 if uncertainty is None else uncertainty
    expected = {"mode_probs", *(("xy_scale",) if has_scale else ())} if shown else set()
    assert set(entries) == set(spaces) == {*FORECAST_KEYS, *PATH_KEYS, *expected}
    others, axis = HIGHWAY_SPEC.max_agents - 1, (samples,) * (samples > 1)
    for key, space in spaces.items():
        assert all(space.contains(one) for one in entries[key]), key
    if not shown:
        return
    assert spaces["mode_probs"].shape == (others, *axis)
    np.testing.assert_allclose(entries["mode_probs"].reshape(2, others, samples).sum(-1), entries["valid"], rtol=1e-5)
    assert not spaces["mode_probs"].contains(np.full((others, *axis), 1.1, np.float32))
    if has_scale:
        assert spaces["xy_scale"].shape == (others, *axis, HORIZON, 2)
        assert not spaces["xy_scale"].contains(np.full((others, *axis, HORIZON, 2), -0.1, np.float32))
        assert (entries["xy_scale"][entries["valid"] == 1] > 0).all()


class Undeclared(ConstantVelocity):
    """Returns a scale, or says that it does."""

    def __init__(self, says: bool, gives: bool) -> None:
        super().__init__(HIGHWAY_SPEC, HORIZON)
        self.has_scale, self.gives = says, gives

    def rollout(self, *args: Any, **kwargs: Any) -> Futures:
        futures = super().rollout(*args, **kwargs)
        return futures._replace(scale=torch.ones_like(futures.states[..., :2])) if self.gives else futures


@pytest.mark.parametrize(("says", "given"), [(False, "a scale"), (True, "no scale")])
def test_a_forecaster_must_say_whether_it_has_a_scale(says: bool, given: str):
    forecaster = Undeclared(says, gives=not says)
    message = f"rollout of a forecaster gave {given}, and its has_scale is {says}; set has_scale = {not says}"
    stream = ForecastStream(forecaster, HIGHWAY_SPEC, 1, ForecastConfig(num_samples=3))
    with pytest.raises(UserError, match=message):
        stream.observe(random_scenes(np.random.default_rng(0), 1, HIGHWAY_SPEC.max_agents, present=[4]))
    assert any(message in problem for problem in forecaster_problems(forecaster))
    assert not forecaster_problems(Undeclared(not says, gives=not says))


@pytest.mark.parametrize("uncertainty", [None, False])
def test_futures_are_sorted_also_where_their_probabilities_are_not_shown(uncertainty: bool | None):
    config = ForecastConfig(num_samples=MODES, uncertainty=uncertainty)
    stream = ForecastStream(FORECASTERS["plural"][0], HIGHWAY_SPEC, 1, config)
    scenes = random_scenes(np.random.default_rng(0), 1, HIGHWAY_SPEC.max_agents, present=[5])
    entries = stream.observe(scenes)
    assert stream.forecast is not None
    shown = ego_entries(scenes, stream.forecast, uncertainty=True)
    np.testing.assert_array_equal(entries["forecast"], shown["forecast"])
    assert (np.diff(shown["mode_probs"], axis=-1) <= 0).all() and np.ptp(shown["mode_probs"][0, 0]) > 1e-3


def test_one_future_is_mode_0_whatever_its_probability():
    plural, _ = FORECASTERS["plural"]
    one, many = (ForecastStream(plural, HIGHWAY_SPEC, 1, ForecastConfig(num_samples=k)) for k in (1, MODES))
    scenes = random_scenes(np.random.default_rng(0), 1, HIGHWAY_SPEC.max_agents, present=[5])
    single = one.observe(scenes)["forecast"]
    many.observe(scenes)
    assert many.forecast is not None
    first = replace(many.forecast, xy=many.forecast.xy[:, :1], mode_probs=None, xy_scale=None)
    np.testing.assert_allclose(single, ego_entries(scenes, first)["forecast"], atol=1e-4)


# --- Many learners ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("spec", [WORLD, CENTROID, AROUND_EGO], ids=["world", "centroid", "absent-ego"])
@pytest.mark.parametrize("samples", [1, 3, MODES + 2])
def test_every_view_has_the_numbers_of_the_one_forecast(spec: SceneSpec, samples: int):
    """Probabilities are the same for all who look; scales are turned to the axes of each."""
    rng = np.random.default_rng(1)
    headings = (0.0, np.pi / 2, 0.7, -2.0)
    multi = multiagent_scene(*(tuple(rng.normal(size=4) * 10) for _ in range(4)), headings_rad=headings)
    config = ForecastConfig(num_samples=samples, uncertainty=True)
    stream = MultiagentStream(tiny_model(spec, **PLURAL), replace(spec, has_ego=False), config)
    for _ in range(2):
        entries = stream.observe(multi)
    forecast = stream.forecast
    assert forecast is not None and forecast.xy_scale is not None
    shares = forecast.sample_probs()[0].T.numpy()
    for name, index in multi.index_of.items():
        assert set(entries[name]) == {*FORECAST_KEYS, *PATH_KEYS, *BOTH} == set(stream.spaces())
        distance = np.linalg.norm(multi.scene.states[:4, :2] - multi.scene.states[index, :2], axis=1)
        cos, sin = np.cos(headings[index]), np.sin(headings[index])
        for place, other in enumerate(np.argsort(distance)[1:]):
            order = np.argsort(-shares[other], kind="stable")
            found = {key: entries[name][key][place].reshape(samples, -1) for key in BOTH}
            np.testing.assert_array_equal(found["mode_probs"][:, 0], shares[other, order])
            x, y = (forecast.xy_scale[0, :, other, :, axis].numpy()[order] ** 2 for axis in (0, 1))
            turned = np.stack([cos**2 * x + sin**2 * y, sin**2 * x + cos**2 * y], -1) ** 0.5
            np.testing.assert_allclose(found["xy_scale"], turned.reshape(samples, -1), rtol=1e-4)
        assert not any(entries[name][key][3:].any() for key in BOTH)


def test_who_sees_nothing_has_zeros_for_every_entry():
    config = ForecastConfig(num_samples=3)
    stream = MultiagentStream(tiny_model(WORLD, **PLURAL), WORLD, config)
    nothing = stream.nothing_seen()
    assert set(nothing) == {*FORECAST_KEYS, *PATH_KEYS, *BOTH}
    assert all(space.contains(nothing[key]) and not nothing[key].any() for key, space in stream.spaces().items())


# --- Wrappers ---------------------------------------------------------------------------------------------------------

DURATIONS, STEPS, SEED = (2, 4), 5, 20
ACTIONS = np.random.default_rng(0).integers(5, size=(STEPS, len(DURATIONS)))


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> str:
    return save_tiny(tmp_path_factory.mktemp("checkpoints") / "tiny-plural", HIGHWAY_SPEC, **PLURAL)


def alone(checkpoint: str, place: int) -> list[dict[str, Any]]:
    """What an environment shows by itself: the opening, then each step, and the successor after each end."""
    env = ForecastObservation(short_env(DURATIONS[place]), checkpoint, num_samples=3)
    seen = [env.reset(seed=SEED + place)[0]]
    for action in ACTIONS[:, place]:
        observation, _, terminated, truncated, _ = env.step(int(action))
        seen.append(observation)
        if terminated or truncated:
            seen.append(env.reset()[0])
    assert len(seen) > 1 + STEPS
    assert all(env.observation_space.contains(observation) for observation in seen)
    return seen


def assert_all_same(found: Sequence[Sequence[dict[str, Any]]], checkpoint: str) -> None:
    for place, sequence in enumerate(found):
        expected = alone(checkpoint, place)
        assert BOTH < set(expected[0]) and expected[0]["xy_scale"].any()
        assert len(sequence) == len(expected)
        for one, other in zip(sequence, expected, strict=True):
            assert_same(one, other)


def one_of(observations: dict[str, Any], place: int) -> dict[str, Any]:
    return {key: value[place] for key, value in observations.items()}


def test_vector_environments_of_sb3_show_what_single_ones_do(checkpoint: str):
    venv = VecForecast(DummyVecEnv([partial(short_scene_env, d) for d in DURATIONS]), checkpoint, num_samples=3)
    venv.seed(SEED)
    observations: Any = venv.reset()
    found = [[one_of(observations, i)] for i in range(len(DURATIONS))]
    for actions in ACTIONS:
        observations, _, dones, infos = venv.step(actions)
        for i, sequence in enumerate(found):
            sequence += [infos[i]["terminal_observation"]] if dones[i] else []
            sequence.append(one_of(observations, i))
    assert_all_same(found, checkpoint)


@pytest.mark.slow
def test_vector_environments_of_gymnasium_show_what_single_ones_do(checkpoint: str):
    makers = [partial(short_scene_env, d) for d in DURATIONS]
    env = VectorForecast(SyncVectorEnv(makers, autoreset_mode=AutoresetMode.SAME_STEP), checkpoint, num_samples=3)
    observations, _ = env.reset(seed=SEED)
    assert env.observation_space.contains(observations)
    found = [[one_of(observations, i)] for i in range(len(DURATIONS))]
    for actions in ACTIONS:
        observations, _, terminated, truncated, infos = env.step(actions)
        for i, sequence in enumerate(found):
            sequence += [infos["final_obs"][i]] if (terminated | truncated)[i] else []
            sequence.append(one_of(observations, i))
    assert_all_same(found, checkpoint)


def test_a_flat_observation_holds_them_too(checkpoint: str):
    env, flat = (
        ForecastObservation(short_env(3), checkpoint, num_samples=3, flatten=flatten) for flatten in (False, True)
    )
    whole, _ = env.reset(seed=0)
    found, _ = flat.reset(seed=0)
    np.testing.assert_array_equal(found, gym.spaces.flatten(env.observation_space, whole))
    back: Any = gym.spaces.unflatten(env.observation_space, found)
    for key in BOTH:
        np.testing.assert_array_equal(back[key], whole[key])


@pytest.mark.parametrize("spec", [WORLD, CENTROID], ids=["world", "centroid"])
def test_parallel_environments_show_what_their_own_stream_does(spec: SceneSpec):
    """Over deaths and joins; each observation is in its space."""
    toy_spec = replace(spec, dt_s=1.0, perception_m=25.0, max_agents=8)
    model = tiny_model(toy_spec, **PLURAL)
    env = wrap(Toy(), toy_spec, forecaster=model, num_samples=3)
    stream = MultiagentStream(model, env.scene_spec, ForecastConfig(num_samples=3), 25.0)
    shown: list[Any] = []
    observe = env.stream.observe
    env.stream.observe = lambda scene: shown.append(scene) or observe(scene)
    episode = play_toy(env)
    assert len(episode) == len(shown)
    for observations, scene in zip(episode, shown, strict=True):
        expected = stream.observe(scene)
        for name, observation in observations.items():
            assert BOTH < set(observation)
            assert_same({key: observation[key] for key in expected[name]}, expected[name])


def test_copies_that_share_a_forward_show_what_they_show_alone(monkeypatch: pytest.MonkeyPatch):
    model = tiny_model(replace(WORLD, dt_s=1.0, perception_m=25.0, max_agents=8), **PLURAL)
    together = ParallelVecEnv(copies(forecaster=model, num_samples=3))
    monkeypatch.setattr("envs.sb3.agents_as_rows.batch_forwards", lambda envs: None)
    apart = ParallelVecEnv(copies(forecaster=model, num_samples=3))
    assert [venv.envs[0]._forward is not None for venv in (together, apart)] == [True, False]
    sequences: list[list[Any]] = []
    for venv in (together, apart):
        venv.seed(5)
        sequences.append([venv.reset()])
        for t in range(8):
            observations, _, _, _ = venv.step(np.full(venv.num_envs, t % 2))
            sequences[-1].append(observations)
    for one, other in zip(*sequences, strict=True):
        assert BOTH < set(one) and one["xy_scale"].any()
        assert_same(one, other, 1e-3)


def test_an_environment_takes_as_many_samples_as_there_are_modes_and_more(checkpoint: str):
    for samples in (MODES, MODES + 3):
        env = ForecastObservation(short_env(3), checkpoint, num_samples=samples)
        observation, _ = env.reset(seed=0)
        assert observation["mode_probs"].shape[1] == samples
        shares = observation["mode_probs"][observation["valid"] == 1]
        assert np.allclose(shares, 1 / samples) == (samples > MODES)  # draws are equally likely
        assert env.observation_space.contains(observation)
