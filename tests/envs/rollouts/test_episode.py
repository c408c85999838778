from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from envs.collect import CollectConfig, collect
from envs.drivers.ego import idle_action, make_ego_driver
from envs.readers.highway import HighwayReader
from envs.readers.highway_labels import LEADER, SceneLabels
from envs.readers.mpe import MPE_FEATURES
from envs.registry import make_env
from envs.rollouts import episode as episodes
from envs.rollouts.episode import (
    CASE_HISTORY_STEPS,
    MODEL,
    NEIGHBOURS,
    NOISY,
    RESIDUAL,
    STRAIGHT,
    EpisodeTask,
    _types_of,
    futures,
    memory_key,
    play,
)
from envs.rollouts.world import open_world
from envs.seeding import driver_rng
from envs.wrappers import SceneObservation
from predictor.baselines.constant_velocity import ConstantVelocity
from predictor.checkpoint import load_forecaster
from predictor.data.store import Episode, StoreInfo, write_store
from predictor.evaluation.accuracy import summarise
from predictor.evaluation.outcomes import Outcome
from predictor.forecaster import Belief, Futures
from predictor.online import OnlineForecaster
from predictor.scene import PADDING_ID, Scene, SceneBatch, SceneSpec
from tests.envs.evaluation import TAG, forget, save_tag, tag_spec
from tests.envs.helpers import HIGHWAY_SPEC, HORIZON, MAP_SPEC, PLURAL, cruising_env, save_tiny
from tests.envs.helpers import play as drive

OFFSET_M = torch.tensor([3.0, 4.0])
"""A displacement of exactly 5 m."""


class Drifting(ConstantVelocity):
    """Constant velocity, off by `OFFSET_M` in the first sample, twice that in the second, and so on."""

    def rollout(
        self, belief: Belief, horizon_steps: int, num_samples: int = 1, generator: torch.Generator | None = None
    ) -> Futures:
        future = super().rollout(belief, horizon_steps, num_samples, generator).states.clone()
        future[..., :2] += torch.arange(1.0, num_samples + 1)[:, None, None, None] * OFFSET_M
        return Futures(future)


@pytest.fixture(autouse=True)
def clean_slate() -> Iterator[None]:
    forget()
    yield
    forget()


@pytest.fixture
def drifting(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every env wrapped from here on is forecast by `Drifting`."""

    def open_drifting(checkpoint: str | None, spec: SceneSpec, source: str, *_: object) -> Drifting:
        return Drifting(spec, HORIZON)

    monkeypatch.setattr("envs.wrappers.open_forecaster", open_drifting)


def task(env_id: str = "two-way-v0", **changes: Any) -> EpisodeTask:
    made = EpisodeTask(env_id, "constant-velocity", "idle", seed=3, samples=2, horizon_steps=HORIZON, max_steps=6)
    return replace(made, **changes)


def played(made: EpisodeTask) -> tuple[Outcome, Outcome]:
    """The measured forecasts and those of constant velocity."""
    outcomes = play(made).outcomes
    assert set(outcomes) == {MODEL, STRAIGHT}
    return outcomes[MODEL], outcomes[STRAIGHT]


# --- Truth ------------------------------------------------------------------------------------------------------------


def scene(*agents: tuple[float, ...], size: int = 3, features: int = 4) -> Scene:
    """Agents as (id, x, y, and the last features); padded to `places`."""
    states, ids, valid = np.zeros((size, features)), np.full(size, -1), np.zeros(size, dtype=np.bool_)
    for i, (number, x, y, *rest) in enumerate(agents):
        states[i, :2], ids[i], valid[i] = (x, y), int(number), True
        states[i, 4 : 4 + len(rest)] = rest
    return Scene(states, ids, valid)


def truth(*agents: tuple[float, ...], features: int = 4) -> Scene:
    return scene(*agents, size=len(agents), features=features)


def test_futures_follow_ids_beyond_perception_until_agents_leave_the_road():
    """Agent 5 leaves perception after the first step and the road after the third; agent 6 enters late."""
    scenes = [
        scene((0, 10, 0), (5, 15, 1)),
        scene((0, 20, 0), (6, 21, 2)),
    ]
    truths = [
        truth((0, 10, 0), (5, 15, 1), (6, 500, 2)),
        truth((0, 20, 0), (6, 21, 2), (5, 400, 1)),
        truth((0, 30, 0), (6, 32, 2), (5, 450, 1)),
        truth((0, 40, 0), (6, 43, 2)),
    ]
    future, valid = futures(scenes, truths, 3, HIGHWAY_SPEC)
    assert valid.tolist() == [
        [[False] * 3, [True, True, False], [False] * 3],  # the ego is not counted
        [[False] * 3, [True, True, False], [False] * 3],  # the episode ends before the third step
    ]
    assert future[0, 1].tolist() == [[390, 1], [440, 1], [0, 0]]  # from where the ego is at that step
    assert future[1, 1].tolist() == [[12, 2], [23, 2], [0, 0]]
    assert (future[~valid] == 0).all()


def test_without_an_ego_all_agents_but_landmarks_are_counted_in_world_coordinates():
    """The agent at index 0 moves and counts; the landmark between the two agents is the same at all times."""
    prey, rock, hunter = (1.0, 0.0, 0.05), (0.0, 1.0, 0.2), (0.0, 0.0, 0.1)
    assert MPE_FEATURES[4:] == ("adversary", "landmark", "radius_m")
    moments = [
        ((7, 0.5, 0.1 * t, *prey), (8, -0.5, 0.5, *rock), (9, 0.2 * t, -0.5, *hunter)) for t in range(3)
    ]  # fmt: skip
    scenes = [scene(*agents, size=4, features=7) for agents in moments[:1]]
    future, valid = futures(scenes, [truth(*agents, features=7) for agents in moments], 2, tag_spec())
    assert valid[0].tolist() == [[True, True], [False, False], [True, True], [False, False]]
    torch.testing.assert_close(future[0, 0], torch.tensor([[0.5, 0.1], [0.5, 0.2]]))
    torch.testing.assert_close(future[0, 2], torch.tensor([[0.2, -0.5], [0.4, -0.5]]))


def test_an_episode_has_the_truth_of_its_last_step():
    """The closing scene is no place to forecast from any more, but it is what earlier forecasts are judged by."""
    env = make_env("u-turn-v1")
    steps = drive(env, [idle_action(env)] * 50, seed=3)
    count = len(steps) - 1
    assert steps[-1][2] or steps[-1][3]
    model, baseline = played(task("u-turn-v1", seed=3, max_steps=200))
    assert model.forecast.shape[0] == count
    assert model.valid[count - 1, 1:].any(0).tolist() == [True, False, False]
    assert model.valid[count - 2, 1:].any(0).tolist() == [True, True, False]
    assert torch.equal(model.future, baseline.future)
    assert torch.equal(model.valid, baseline.valid)


def test_an_episode_that_is_cut_keeps_its_last_scene():
    model, _ = played(task("highway-fast-v0", max_steps=4))
    assert model.forecast.shape[0] == 5
    assert model.valid[3, 1:].any(0).tolist() == [True, False, False]
    assert not model.valid[4].any()


def test_out_of_sight_is_not_out_of_truth():
    """No agent leaves this road, so whoever is seen has a future up to the episode's end, seen again or not."""
    steps, seed = 8, 16
    env = SceneObservation(make_env("highway-fast-v0"))
    ego = make_ego_driver("random", env, driver_rng(seed))
    moments = drive(env, [ego(None) for _ in range(steps)], seed)
    seen = [set(obs["scene_ids"].tolist()) for obs, *_ in moments]
    assert any(before - after - {PADDING_ID} for before, after in pairwise(seen))  # some are lost from sight
    model, _ = played(task("highway-fast-v0", seed=seed, driver="random", max_steps=steps))
    assert len(model.valid) == len(seen) == steps + 1
    for t in range(steps):
        known = model.valid[t, :, 0]
        assert int(known.sum()) == len(seen[t] - {0, PADDING_ID})
        assert (model.valid[t, known].sum(-1) == min(HORIZON, steps - t)).all()


# --- Forecasts of the deployed wrapper --------------------------------------------------------------------------------


@pytest.mark.parametrize("env_id", ["highway-fast-v0", "intersection-v2", "racetrack-v1"])
def test_forecasts_come_back_into_scene_order_and_world_axes(env_id: str, drifting: None):
    """Whatever the ego's heading and the order of agents: what returns is what the forecaster said."""
    model, straight = played(task(env_id))
    assert model.forecast.shape[1] == 2
    seen = model.valid.any(-1)
    assert seen.any()
    for sample in range(2):
        offset = (model.forecast[:, sample] - straight.forecast[:, 0])[seen]
        expected = ((sample + 1) * OFFSET_M).expand_as(offset)
        torch.testing.assert_close(offset, expected, rtol=0, atol=1e-3)


def test_errors_in_closed_form(drifting: None, monkeypatch: pytest.MonkeyPatch):
    """Among cars that hold their speed, constant velocity is right and the drifting forecaster 5 m and 10 m off."""
    monkeypatch.setattr("envs.rollouts.world.make_env", lambda env_id, **kwargs: cruising_env(**kwargs))
    episode = play(task())
    assert summarise("straight", [episode.outcomes[STRAIGHT]]).min_ade_m == pytest.approx(0.0, abs=1e-3)
    both = summarise("drifting", [episode.outcomes[MODEL]])
    assert both.agents > 5
    assert both.num_samples == 2
    assert both.min_ade_m == pytest.approx(5.0, abs=1e-3)
    assert both.min_fde_m == pytest.approx(5.0, abs=1e-3)
    assert both.by_step_m == pytest.approx([5.0] * HORIZON, abs=1e-3)
    assert both.rmse_m == pytest.approx([7.5] * HORIZON, abs=1e-3)  # of the samples' mean
    case = episode.worst
    assert case is not None
    assert (case.error_m, case.seed) == (pytest.approx(5.0, abs=1e-3), 3)
    np.testing.assert_allclose(case.forecasts[STRAIGHT], case.future, atol=1e-3)
    np.testing.assert_allclose(case.forecasts[MODEL] - case.future, OFFSET_M.expand(HORIZON, 2), atol=1e-3)
    # in the world: the agent was at its latest place one step before it is at its first future one
    step_m = case.future[1] - case.future[0]
    np.testing.assert_allclose(case.history[-1, case.agent] + step_m, case.future[0], atol=1e-3)
    assert len(case.history) == min(case.step + 1, CASE_HISTORY_STEPS)
    assert case.history_valid[-1, case.agent]


def test_one_sample_is_the_most_likely_one(drifting: None):
    model, straight = played(task(samples=1))
    assert model.forecast.shape[1] == straight.forecast.shape[1] == 1
    seen = model.valid.any(-1)
    offset = (model.forecast - straight.forecast)[:, 0][seen]
    torch.testing.assert_close(offset, OFFSET_M.expand_as(offset), rtol=0, atol=1e-3)


@pytest.mark.parametrize("env_id", ["two-way-v0", TAG])
def test_constant_velocity_in_the_deployed_place_is_the_baseline(env_id: str):
    model, straight = played(task(env_id, driver="varied"))
    assert model.valid.any()
    for sample in range(2):
        difference = (model.forecast[:, sample] - straight.forecast[:, 0])[model.valid.any(-1)]
        torch.testing.assert_close(difference, torch.zeros_like(difference), rtol=0, atol=1e-3)


# --- Memory -----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("who", ["road", "tag", "tag-around-an-ego"])
def test_a_short_memory_forecasts_from_the_last_scenes_alone(who: str, tmp_path: Path, highway_checkpoint: str):
    """With one step it is a fresh memory at each scene; with as many as the episode has, it is the deployed model."""
    if who == "road":
        made = task("highway-fast-v0", checkpoint=highway_checkpoint)
    else:
        made = task(TAG, checkpoint=save_tag(tmp_path / "tag", who != "tag"), driver="heuristic")
    steps = made.max_steps + 1
    outcomes = play(replace(made, histories=(1, 2, steps))).outcomes
    everything = outcomes[MODEL].forecast[:, :1]
    known = outcomes[MODEL].valid.any(-1)
    assert known.any(-1).sum() > 2

    def same(found: torch.Tensor, expected: torch.Tensor) -> bool:
        return torch.allclose(found[:, 0][known], expected[:, 0][known], rtol=1e-4, atol=1e-4)

    assert same(outcomes[memory_key(steps)].forecast, everything)
    for short in (1, 2):
        found = outcomes[memory_key(short)].forecast
        assert not same(found, everything)
        assert same(found, replayed(made, short))


def replayed(made: EpisodeTask, history_steps: int) -> torch.Tensor:
    """The same episode once more; at each scene a new forecaster sees the last ones."""
    world = open_world(made.env_id, made.driver, made.checkpoint)
    world.reset(made.seed)
    model = load_forecaster(made.checkpoint, world.spec, made.env_id)
    front = int(model.spec.has_ego and not world.spec.has_ego)
    scenes: list[Scene] = []
    found = []
    for _ in range(made.max_steps + 1):
        scenes.append(world.perceived())
        online = OnlineForecaster(model, 1, world.spec.max_agents + front)
        for past in scenes[-history_steps:]:
            online.observe(SceneBatch.stack([past.behind_absent(front)]))
        found.append(online.forecast(made.horizon_steps).xy[0, :, front:])
        if world.step():
            break
    return torch.stack(found)


# --- Nearest neighbours -----------------------------------------------------------------------------------------------


def test_neighbours_that_lived_through_this_very_episode_are_exact(tmp_path: Path):
    """The store holds it six times, and five neighbours are averaged."""
    made = task(seed=5)
    config = CollectConfig(made.env_id, tmp_path, 1, ("idle",), made.seed, made.max_steps, False, 1)
    (recorded,) = collect(config)
    store = tmp_path / "store"
    write_store(store, StoreInfo(HighwayReader(make_env(made.env_id)).spec, made.env_id), [recorded] * 6)
    outcomes = play(replace(made, stores=(str(store),))).outcomes
    near, straight = (summarise(key, [outcomes[key]]) for key in (NEIGHBOURS, STRAIGHT))
    assert near.agents == straight.agents > 0
    assert {outcomes[key].forecast.shape[1] for key in (MODEL, NEIGHBOURS, NOISY, RESIDUAL)} == {made.samples}
    assert near.ade_m == pytest.approx(0.0, abs=1e-3)
    assert straight.min_ade_m > 0.1


@pytest.mark.slow
def test_each_sample_of_the_neighbours_is_another_recorded_future(tmp_path: Path):
    """Sample 0 is the mean of all; with few episodes, two may have been the same."""
    made = task(TAG, checkpoint=save_tag(tmp_path / "tag", **PLURAL), driver="heuristic", samples=20)
    recorded = collect(CollectConfig(TAG, tmp_path, 3, ("heuristic",), 50, 12, False, 1))
    write_store(tmp_path / "store", StoreInfo(tag_spec(), TAG), recorded)
    near = play(replace(made, stores=(str(tmp_path / "store"),))).outcomes[NEIGHBOURS]
    futures = near.forecast.transpose(1, 2)[near.valid.all(-1)].flatten(2)
    assert len(futures) and min(len(samples.unique(dim=0)) for samples in futures) > 15
    torch.testing.assert_close(futures[:, 0], futures[:, 1:].mean(1), rtol=1e-4, atol=1e-4)


@pytest.mark.slow
def test_the_residual_of_a_model_with_an_ego_is_fitted_to_recordings_without_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Their first agent is not taken for the ego."""
    crossing = "intersection-multi-agent-v2"
    store = tmp_path / "store"
    recorded = list(collect(CollectConfig(crossing, store, 1, max_steps=5, workers=1)))
    write_store(store, StoreInfo(open_world(crossing, "varied").spec, crossing), recorded)
    checkpoint = save_tiny(tmp_path / "tiny", MAP_SPEC)
    made = task(env_id=crossing, driver="varied", checkpoint=checkpoint, horizon_steps=1, stores=(str(store),))
    cut, original = list[bool](), episodes.training_windows

    def noted(stores: Any, spec: SceneSpec, horizon_steps: int, **history: Any) -> Any:
        cut.append(spec.has_ego)
        return original(stores, spec, horizon_steps, **history)

    monkeypatch.setattr(episodes, "training_windows", noted)
    outcomes = play(made).outcomes
    assert outcomes[RESIDUAL].forecast.shape == outcomes[MODEL].forecast.shape
    assert cut and not any(cut)


# --- Controls at equal K ----------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("who", ["tag", "tag-around-an-ego"])
@pytest.mark.parametrize("samples", [3, PLURAL["num_modes"] + 2])
def test_controls_have_as_many_samples_as_the_model_and_start_from_its_guess(who: str, samples: int, tmp_path: Path):
    made = task(TAG, checkpoint=save_tag(tmp_path / "tag", who != "tag", **PLURAL), driver="heuristic", samples=samples)
    store = tmp_path / "store"
    recorded = collect(CollectConfig(TAG, tmp_path, 2, ("heuristic",), 50, 12, False, 1))
    write_store(store, StoreInfo(tag_spec(), TAG), recorded)
    made = replace(made, stores=(str(store),), histories=(2,))
    outcomes = play(made).outcomes
    several = (MODEL, RESIDUAL, NEIGHBOURS, NOISY)
    assert {key: outcome.forecast.shape[1] for key, outcome in outcomes.items()} == {
        **dict.fromkeys(several, samples), STRAIGHT: 1, memory_key(2): 1,
    }  # fmt: skip
    model, known = outcomes[MODEL], outcomes[MODEL].valid.any(-1)
    assert model.scale is not None and model.scale.shape == model.forecast.shape
    assert (model.mode_probs is None) == (samples > PLURAL["num_modes"])
    if model.mode_probs is not None:
        assert model.mode_probs.shape == model.forecast.shape[:3]
        torch.testing.assert_close(model.mode_probs.sum(1), torch.ones(known.shape))
    for key in (RESIDUAL, NEIGHBOURS, NOISY):
        assert outcomes[key].mode_probs is None and outcomes[key].scale is None
        assert torch.equal(outcomes[key].valid, model.valid) and torch.equal(outcomes[key].future, model.future)
        drawn = outcomes[key].forecast.transpose(1, 2)[known]
        assert (drawn[:, 1:] - drawn[:, :1]).abs().amax((1, 2, 3)).min() > 1e-5

    def first(key: str) -> torch.Tensor:
        return outcomes[key].forecast[:, 0][known]

    torch.testing.assert_close(first(RESIDUAL), first(MODEL), rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(first(NOISY), first(STRAIGHT), rtol=1e-4, atol=1e-4)
    again, other = play(made).outcomes, play(replace(made, seed=made.seed + 1)).outcomes
    for key in several:
        assert torch.equal(again[key].forecast, outcomes[key].forecast)
        assert not torch.equal(other[key].forecast, outcomes[key].forecast)


# --- Edges and time ---------------------------------------------------------------------------------------------------


def test_true_edges_are_moved_to_the_order_of_the_perceived_agents():
    full = truth((0, 0, 0), (4, 10, 0), (2, 20, 0), (9, 30, 0))
    types = np.full((4, 4), -1, dtype=np.int8)
    types[1] = (0, -1, 1, 0)  # 4 follows 2
    types[2] = (0, 0, -1, 1)  # 2 follows 9
    labels = SceneLabels(types, np.zeros((4, 4, 5), dtype=np.float32))
    found = _types_of(scene((0, 0, 0), (9, 30, 0), (2, 20, 0), size=4), full, labels)
    assert found.tolist() == [[-1, -1, -1, -1], [-1, -1, -1, -1], [0, 1, -1, -1], [-1, -1, -1, -1]]


def test_the_graph_is_noted_where_the_simulator_knows_one(highway_checkpoint: str):
    episode = play(task("highway-fast-v0", checkpoint=highway_checkpoint))
    assert len(episode.edge_probs) == len(episode.edge_types) == len(episode.latencies_s) == 7
    agents = HIGHWAY_SPEC.max_agents
    assert all(probs.shape == (agents, agents, 2) for probs in episode.edge_probs)
    types = np.stack(episode.edge_types)
    assert types.shape == (7, agents, agents)
    assert (types == LEADER).any() and (types[:, 0] == -1).all()  # the ego follows no agent that is known


def test_many_learners_have_no_known_graph_and_time_passes(tmp_path: Path):
    episode = play(task(TAG, checkpoint=save_tag(tmp_path / "tag"), driver="heuristic"))
    assert episode.edge_types == episode.edge_probs == []
    assert len(episode.latencies_s) == 7
    assert min(episode.latencies_s) > 0


def test_the_noise_of_a_control_is_that_of_its_episode(tmp_path: Path):
    """Else all episodes would have one noise, and an interval over them would be too narrow."""
    made = task(driver="idle", checkpoint="constant-velocity", samples=3, horizon_steps=2)
    recorded = Episode(
        np.random.default_rng(0).normal(size=(8, 3, 4)), np.ones((8, 3), bool), np.arange(3), "recorded", 0
    )  # fmt: skip
    write_store(tmp_path / "store", StoreInfo(HighwayReader(make_env(made.env_id)).spec, made.env_id), [recorded] * 4)
    noises = []
    for seed in (3, 4, 3):
        found = play(replace(made, seed=seed, stores=(str(tmp_path / "store"),))).outcomes[NOISY].forecast
        noises.append((found - found[:, :1])[0, 1:, 1])
    assert torch.allclose(noises[0], noises[2]) and not torch.allclose(noises[0], noises[1])
    assert noises[0].abs().min() > 0


def test_an_episode_is_a_function_of_its_task(tmp_path: Path):
    """The world is kept from episode to episode, and nothing of one shows in the next."""
    made = task(TAG, checkpoint=save_tag(tmp_path / "tag"), driver="mixed")
    first, other, again = (play(replace(made, seed=seed)).outcomes for seed in (3, 4, 3))
    for key in first:
        assert torch.equal(first[key].forecast, again[key].forecast)
        assert torch.equal(first[key].future, again[key].future)
    assert not torch.equal(first[MODEL].future, other[MODEL].future)


@pytest.mark.parametrize("crash_in_step", [1, 3])
def test_an_episode_that_goes_on_after_a_crash_has_not_ended_with_it(
    crash_in_step: int, monkeypatch: pytest.MonkeyPatch
):
    """What is measured before a crash are the last steps of an episode that ends with one."""
    world, steps = open_world("two-way-v0", "idle", "constant-velocity", horizon_steps=2), iter(range(1, 4))
    step_world = world.step

    def step() -> bool:
        step_world()
        now = next(steps)
        world.crashed = now >= crash_in_step
        return now == 3

    monkeypatch.setattr(world, "step", step)
    monkeypatch.setattr(episodes, "_world", lambda task: world)
    assert play(EpisodeTask("two-way-v0", "constant-velocity", "idle", 0, 1, 2, 9)).crashed == (crash_in_step == 3)
    world.close()
