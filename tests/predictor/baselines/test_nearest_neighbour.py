import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from jaxtyping import TypeCheckError
from torch import Tensor
from torch.nn import functional

from predictor.baselines.nearest_neighbour import (
    BLOCK,
    ROLE_WEIGHT,
    Examples,
    NearestNeighbour,
    collect_examples,
    feature_scales,
    fit_from_stores,
    query_features,
)
from predictor.data.store import Episode, StoreInfo, write_store
from predictor.data.windows import Windows
from predictor.evaluation.accuracy import summarise
from predictor.evaluation.outcomes import run_windows
from predictor.forecaster import Belief, Forecaster, Memory
from predictor.online import OnlineForecaster
from predictor.scene import KINEMATIC_FEATURES, KINEMATIC_FEATURES_3D, SceneSpec
from predictor.support.errors import UserError
from tests.predictor.helpers import (
    ROAD,
    WORLD,
    batch,
    circling_episode,
    random_presence,
    random_states,
    scene,
    spec,
    write_circles,
)

HORIZON = 3
METRES = {"rtol": 1e-5, "atol": 1e-4}
LAYOUTS = {
    "world": spec(),
    "road": spec(ROAD),
    "no ego": spec(has_ego=False),
    "centroid": SceneSpec(0.5, ("centroid", "world"), has_ego=False),
    "near": spec(max_agents=3, perception_m=25.0),
    "near centroid": spec(("centroid", "ego"), max_agents=3, perception_m=25.0),
    "roles": SceneSpec(
        0.5, ROAD, (*KINEMATIC_FEATURES, "heading_rad", "role"), (1.0,) * 6, constant_features=("role",)
    ),
    "space": SceneSpec(1.0, ("world", "ego", "world"), KINEMATIC_FEATURES_3D, (1.0,) * 6),
}
every_layout = pytest.mark.parametrize("layout", LAYOUTS.values(), ids=LAYOUTS.keys())


def episode(states: Any, valid: Any = None) -> Episode:
    states = np.asarray(states, dtype=np.float32)
    valid = np.ones(states.shape[:2], dtype=np.bool_) if valid is None else np.asarray(valid, dtype=np.bool_)
    return Episode(states * valid[..., None], valid, np.arange(states.shape[1]))


def random_episode(seed: int, layout: SceneSpec, first_stays: bool = False) -> Episode:
    """Noise; agents come and go, and the first one (the ego) less often than the others or never."""
    steps, agents = 9, 5
    rng = np.random.default_rng(seed)
    states = rng.uniform(-20, 20, size=(steps, agents, layout.num_features))
    if layout.constant_features:
        states[..., -1] = rng.integers(0, 2, size=agents)
    valid = rng.random((steps, agents)) < 0.85
    valid[:, 0] |= rng.random(steps) < (1.0 if first_stays else 0.7)
    return episode(states, valid)


@pytest.fixture(scope="module")
def fitted() -> NearestNeighbour:
    return fit_random(spec())


def fit_random(layout: SceneSpec, episodes: int = 8, **kwargs: Any) -> NearestNeighbour:
    return NearestNeighbour.fit([random_episode(i, layout) for i in range(episodes)], layout, HORIZON, **kwargs)


def observe(forecaster: NearestNeighbour, states: Tensor, valid: Tensor | None = None) -> Belief:
    valid = torch.ones(states.shape[:2]).bool() if valid is None else valid
    return forecaster.observe(forecaster.empty_memory(len(states), states.shape[1]), states, valid)[1]


def scene_of(layout: SceneSpec, seed: int, scenes: int = 2, agents: int = 4) -> Tensor:
    drawn = np.random.default_rng([seed, 7]).uniform(-20, 20, size=(scenes, agents, layout.num_features))
    return torch.from_numpy(drawn.astype(np.float32))


# --- Interface --------------------------------------------------------------------------------------------------------


def test_is_a_forecaster_without_edges():
    forecaster = fit_random(spec())
    assert isinstance(forecaster, Forecaster)
    assert (forecaster.spec, forecaster.horizon_steps) == (spec(), HORIZON)
    belief = observe(forecaster, random_states(0, 2, 3, 4))
    assert torch.equal(belief.edge_probs, torch.tensor([1.0, 0.0]).expand(2, 3, 3, 2))
    assert torch.equal(belief.edge_features, torch.zeros(2, 3, 3, 1))


@pytest.mark.shapes
def test_axes_in_the_wrong_order_raise(fitted: NearestNeighbour):
    with pytest.raises(TypeCheckError):
        fitted.observe(Memory(), random_states(0, 2, 3, 4), torch.ones(3, 2).bool())


def test_history_leaves_no_trace(fitted: NearestNeighbour):
    states, valid = random_states(0, 4, 1, 3, 4), random_presence(0, 4, 1, 3)
    memory = fitted.empty_memory(1, 3)
    for now, present in zip(states, valid, strict=True):
        memory, belief = fitted.observe(memory, now, present)
    assert memory == Memory()
    alone = fitted.rollout(observe(fitted, states[-1], valid[-1]), HORIZON).states
    assert torch.equal(fitted.rollout(belief, HORIZON).states, alone)


def test_forecasting_leaves_the_belief_alone(fitted: NearestNeighbour):
    states = random_states(0, 2, 3, 4)
    fitted.rollout(observe(fitted, states), HORIZON, 4)
    assert torch.equal(states, random_states(0, 2, 3, 4))


# --- Closed forms -----------------------------------------------------------------------------------------------------


def test_what_is_repeated_is_forecast_exactly():
    """Five recordings of the same two agents on circles: the mean of five equal futures."""
    recorded = circling_episode(3)
    forecaster = NearestNeighbour.fit([recorded] * 5, spec(), HORIZON)
    future = forecaster.rollout(observe(forecaster, torch.from_numpy(recorded.states[2:3])), HORIZON).states[0, 0, 1]
    positions = torch.from_numpy(recorded.states[2:6, 1, :2])
    torch.testing.assert_close(future[:, :2], positions[1:], **METRES)
    torch.testing.assert_close(future[:, 2:], positions.diff(dim=0), **METRES)
    assert (future[:, 2:] - torch.from_numpy(recorded.states[3:6, 1, 2:])).abs().max() > 0.1


@every_layout
def test_the_nearest_example_of_recorded_data_is_itself(layout: SceneSpec):
    episodes = [random_episode(i, layout, first_stays=True) for i in range(6)]
    forecaster = NearestNeighbour.fit(episodes, layout, HORIZON, k=1)
    windows = Windows(episodes, layout, 1, HORIZON, min_future_steps=HORIZON)
    outcomes = list(run_windows(forecaster, windows, np.arange(len(windows)), HORIZON))
    found = summarise("itself", outcomes)
    assert found.agents > 20
    assert found.min_ade_m < 1e-5
    five = NearestNeighbour.fit(episodes, layout, HORIZON)
    assert summarise("5", run_windows(five, windows, np.arange(len(windows)), HORIZON)).min_ade_m > 1


def test_straight_motion_between_two_examples():
    """Examples at 4 and 6 m/s on both sides of an agent at 5 m/s; a third, going back, is far."""
    layout = spec(dt_s=0.5, has_ego=False)
    speeds = np.array([4.0, 6.0, -30.0])
    time_s = 0.5 * np.arange(3)[:, None]
    states = np.stack([speeds * time_s, 0 * speeds * time_s, speeds + 0 * time_s, 0 * speeds * time_s], axis=-1)
    forecaster = NearestNeighbour.fit([episode(states)], layout, 2, k=2)
    assert forecaster.num_examples == 3
    future = forecaster.rollout(observe(forecaster, torch.tensor([[[100.0, 7.0, 5.0, 0.0]]])), 2).states
    torch.testing.assert_close(future[0, 0, 0], torch.tensor([[102.5, 7.0, 5.0, 0.0], [105.0, 7.0, 5.0, 0.0]]))


def one_dimensional(*moves_m: float, horizon_steps: int = 1, k: int = 5) -> NearestNeighbour:
    """Examples at x = 0, 1, 2, … that move along y by the given lengths per step."""
    count = len(moves_m)
    features = torch.zeros(count, 4)
    features[:, 0] = torch.arange(count)
    steps = torch.arange(1, horizon_steps + 1.0)
    moves = torch.stack([torch.zeros(count, horizon_steps), torch.tensor(moves_m)[:, None] * steps], dim=-1)
    return NearestNeighbour(spec(has_ego=False), Examples(features, moves), k)


def test_samples_are_the_mean_and_then_single_neighbours_over_and_over():
    forecaster = one_dimensional(10.0, 20.0, 40.0, 80.0, k=3)
    belief = observe(forecaster, torch.tensor([[[1.9, 0.0, 0.0, 0.0]]]))
    assert forecaster.rollout(belief, 1, 6).states[0, :, 0, 0, 1].tolist() == pytest.approx(
        [140 / 3, 40, 20, 80, 40, 20]
    )
    assert forecaster.rollout(belief, 1, 1).states.shape == (1, 1, 1, 1, 4)
    assert torch.equal(
        forecaster.rollout(belief, 1, 6).states, forecaster.rollout(belief, 1, 6, torch.Generator()).states
    )


def test_with_fewer_examples_than_k_all_are_averaged():
    forecaster = one_dimensional(10.0, 30.0)
    belief = observe(forecaster, torch.tensor([[[50.0, 0.0, 0.0, 0.0]]]))
    assert forecaster.rollout(belief, 1, 4).states[0, :, 0, 0, 1].tolist() == [20.0, 30.0, 10.0, 30.0]


def test_other_features_stay_as_they_are():
    layout = LAYOUTS["roles"]
    forecaster, states = fit_random(layout), scene_of(LAYOUTS["roles"], 0)
    future = forecaster.rollout(observe(forecaster, states), HORIZON, 3).states
    assert torch.equal(future[..., 4:], states[:, None, :, None, 4:].expand(-1, 3, -1, HORIZON, -1))
    assert not torch.equal(future[..., :2], states[:, None, :, None, :2].expand(-1, 3, -1, HORIZON, -1))


def test_another_role_is_far_away():
    """Of two examples the nearer one has another role."""
    layout = replace(LAYOUTS["roles"], has_ego=False, frame=WORLD)
    states = np.zeros((2, 2, 6))
    states[:, :, 0], states[:, :, 5] = [0, 10], [0, 1]
    states[1, :, 0] += [1, 2]
    forecaster = NearestNeighbour.fit([episode(states)], layout, 1, k=1)
    query = torch.tensor([[[1.0, 0, 0, 0, 0, 1.0], [1.0, 0, 0, 0, 0, 0.0]]])
    assert forecaster.rollout(observe(forecaster, query), 1).states[0, 0, :, 0, 0].tolist() == [3.0, 2.0]


def test_scales_are_mean_absolute_deviations_but_never_noise():
    layout = replace(LAYOUTS["roles"], feature_scales=(1.0, 1.0, 1.0, 10.0, 1.0, 1.0))
    #                           y    vx      vy    dx    dy   role
    features = torch.tensor([[0.0, -1.0, 1.001, -60.0, -4.0, 0.0], [4.0, 0.0, 1.0, 0.0, 0.0, 0.0]])
    features = torch.cat([features, torch.tensor([[2.0, 4.0, 1.0, 0.0, 4.0, 1.0]])])
    expected = [4 / 3, 5 / 3, 0.01, 20.0, 8 / 3, 1 / 3 / ROLE_WEIGHT]
    torch.testing.assert_close(feature_scales(layout, features), torch.tensor(expected))


def test_a_horizon_goes_as_far_as_it_was_fitted(fitted: NearestNeighbour):
    belief = observe(fitted, random_states(0, 2, 3, 4))
    longest = fitted.rollout(belief, HORIZON, 2).states
    for steps in range(HORIZON):
        assert torch.equal(longest[..., :steps, :], fitted.rollout(belief, steps, 2).states)
    with pytest.raises(UserError, match="fitted to horizon_steps=3 but 4 steps were asked for; fit them with"):
        fitted.rollout(belief, HORIZON + 1)


# --- Against plain loops ----------------------------------------------------------------------------------------------


def loop_features(layout: SceneSpec, states: np.ndarray, valid: np.ndarray, agent: int) -> list[float]:
    axes = layout.position_dim
    present = [s for s, v in zip(states, valid, strict=True) if v]
    features = []
    for axis, frame in enumerate(layout.frame):
        if frame != "ego":
            middle = sum(s[axis] for s in present) / len(present) if frame == "centroid" else 0.0
            features.append(states[agent][axis] - middle)
    features += list(states[agent][axes : 2 * axes])
    if layout.has_ego:
        features += [states[agent][a] - states[0][a] if valid[0] else 0.0 for a in range(axes)]
    return features + [states[agent][layout.feature_names.index(n)] for n in layout.constant_features]


def loop_examples(layout: SceneSpec, episodes: list[Episode]) -> tuple[list[list[float]], list[np.ndarray]]:
    features, moves = [], []
    for e in episodes:
        states, axes = e.states.astype(np.float64), layout.position_dim
        for t in range(len(states) - HORIZON):
            if layout.has_ego and not e.valid[t, 0]:
                continue
            seen = e.valid[t].copy()
            if layout.has_ego:
                apart = [math.dist(s[:2], states[t, 0, :2]) if v else math.inf for s, v in zip(states[t], seen)]  # noqa: B905
                nearest = sorted(range(1, len(apart)), key=lambda i: apart[i])[: layout.max_agents - 1]
                seen = np.array(
                    [i == 0 or (i in nearest and apart[i] <= layout.perception_m) for i in range(len(seen))]
                )
            for agent in range(int(layout.has_ego), len(seen)):
                if seen[agent] and all(e.valid[t + h, agent] for h in range(HORIZON + 1)):
                    features.append(loop_features(layout, states[t], seen, agent))
                    after = [states[t + h, agent, :axes] - states[t, agent, :axes] for h in range(1, HORIZON + 1)]
                    moves.append(np.stack(after))
    return features, moves


@every_layout
@settings(max_examples=8, deadline=None)
@given(seed=st.integers(0, 2**16), k=st.integers(1, 7))
def test_forecasts_are_those_of_plain_loops(layout: SceneSpec, seed: int, k: int):
    episodes = [random_episode(seed + i, layout) for i in range(6)]
    features, moves = loop_examples(layout, episodes)
    table = np.array(features)
    middle = np.sort(table, axis=0)[(len(table) - 1) // 2]
    scales = np.abs(table - middle).mean(axis=0)
    scales[-1] /= ROLE_WEIGHT if layout.constant_features else 1.0
    forecaster = NearestNeighbour.fit(episodes, layout, HORIZON, k)
    assert forecaster.num_examples == len(features)
    states, valid, axes = scene_of(layout, seed), random_presence(seed, 2, 4), layout.position_dim
    valid[1, 0] = False  # of the second scene, the ego where there is one
    states[..., -1] = states[..., -1].round().clamp(0, 1) if layout.constant_features else states[..., -1]
    ours = forecaster.rollout(observe(forecaster, states * valid[..., None], valid), HORIZON, 3).states.numpy()
    for env, agent in valid.nonzero().tolist():
        now = states[env].numpy().astype(np.float64) * valid[env].numpy()[:, None]
        query = np.array(loop_features(layout, now, valid[env].numpy(), agent))
        distances = [math.dist(example / scales, query / scales) for example in table]
        order = sorted(range(len(distances)), key=distances.__getitem__)[:k]
        expected = [sum(moves[i] for i in order) / len(order)] + [moves[order[s % len(order)]] for s in range(2)]
        for sample, moved in enumerate(expected):
            places = np.concatenate([np.zeros((1, axes)), moved])
            np.testing.assert_allclose(ours[env, sample, agent, :, :axes] - now[agent, :axes], moved, atol=1e-4)
            velocities = (places[1:] - places[:-1]) / layout.dt_s
            np.testing.assert_allclose(ours[env, sample, agent, :, axes : 2 * axes], velocities, atol=1e-3)


@pytest.mark.parametrize("count", [1, 4, BLOCK - 1, BLOCK, BLOCK + 1, 5 * BLOCK, 1000])
@pytest.mark.parametrize("grid", [False, True], ids=["apart", "many equal"])
def test_no_example_is_nearer_than_the_nearest(count: int, grid: bool, monkeypatch: pytest.MonkeyPatch):
    for name, parts in (("MAX_QUERIES", 5), ("MAX_DISTANCES", 1500)):  # several parts of either
        monkeypatch.setattr(f"predictor.baselines.nearest_neighbour.{name}", parts)
    rng = np.random.default_rng(count)
    features = torch.from_numpy(rng.uniform(-20, 20, size=(count, 4)))
    features = (features / 8).round() if grid else features
    forecaster = NearestNeighbour(spec(has_ego=False), Examples(features, torch.zeros(count, 1, 2)))
    queries = torch.cat([features[:7], torch.from_numpy(rng.uniform(-30, 30, size=(5, 4)))])
    index, distances = forecaster.nearest(queries)
    scales = feature_scales(forecaster.spec, features)
    for query_index, query in enumerate(queries):
        expected = sorted(float(((x - query) / scales).norm()) for x in features)[:5]
        np.testing.assert_allclose(distances[query_index], expected, atol=1e-9)
        found = [float(((features[i] - query) / scales).norm()) for i in index[query_index]]
        np.testing.assert_allclose(found, expected, atol=1e-9)
        assert len(set(index[query_index].tolist())) == len(expected)


def test_near_examples_far_from_the_middle_are_told_apart():
    """Two examples 1 mm apart, a thousand spreads from the middle of many: beyond float32's squares."""
    features = torch.zeros(300, 4, dtype=torch.float64)
    features[:, 0] = torch.linspace(-1, 1, 300)
    features[[70, 200], 0] = torch.tensor([1000.0, 1000.001], dtype=torch.float64)
    forecaster = NearestNeighbour(spec(has_ego=False), Examples(features, torch.zeros(300, 1, 2)), k=1)
    queries = torch.zeros(2, 4, dtype=torch.float64)
    queries[:, 0] = torch.tensor([1000.0004, 1000.0006], dtype=torch.float64)
    assert forecaster.nearest(queries)[0].tolist() == [[70], [200]]


# --- Examples ---------------------------------------------------------------------------------------------------------


def standing(steps: int, *x_m: float) -> np.ndarray:
    states = np.zeros((steps, len(x_m), 4))
    states[..., 0] = x_m
    return states


def who(valid: Any, layout: SceneSpec | None = None, x_m: tuple[float, ...] = (0.0, 1.0, 2.0)) -> list[float]:
    """x of each example of agents that stand still, for a horizon of two steps."""
    found = collect_examples([episode(standing(len(valid), *x_m), valid)], layout or spec(), 2)
    return sorted(found.features[:, 0].tolist())


def test_an_example_is_there_for_the_whole_horizon():
    ones = [1, 1, 1]
    assert who([ones, ones, ones]) == [1.0, 2.0]
    assert who([ones, ones, ones, ones]) == [1.0, 1.0, 2.0, 2.0]
    assert who([ones, ones, [1, 1, 0], ones]) == [1.0, 1.0]  # the last one left, and came back
    assert who([[1, 0, 1], ones, ones]) == [2.0]
    with pytest.raises(UserError, match="there for horizon_steps=2, but 1 episodes of at most 2 steps have none"):
        who([ones, ones])


def test_the_ego_is_no_example_and_no_agent_is_while_it_is_absent():
    ones = [1, 1, 1]
    assert who([ones, [0, 1, 1], [0, 1, 1], ones]) == [1.0, 2.0]
    with pytest.raises(UserError, match="an agent other than the ego that is perceived"):
        who([[0, 1, 1]] * 3)
    assert who([ones] * 3, spec(has_ego=False)) == [0.0, 1.0, 2.0]
    assert who([[0, 1, 1]] * 3, spec(has_ego=False)) == [1.0, 2.0]


def test_who_is_beyond_perception_is_no_example_but_who_leaves_it_is():
    x_m = (0.0, 10.0, 30.0)
    assert who([[1, 1, 1]] * 3, spec(perception_m=30.0), x_m) == [10.0, 30.0]
    assert who([[1, 1, 1]] * 3, spec(perception_m=29.0), x_m) == [10.0]
    assert who([[1, 1, 1]] * 3, spec(max_agents=2), x_m) == [10.0]
    leaving = standing(3, 0.0, 10.0)
    leaving[1:, 1, 0] = 1000.0
    found = collect_examples([episode(leaving)], spec(), 2)
    assert found.displacements.tolist() == [[[990.0, 0.0], [990.0, 0.0]]]


def test_features_closed_form():
    states = torch.tensor([[1.0, 2.0, 3.0, 4.0], [5.0, 8.0, 7.0, 9.0], [0.0, 11.0, 0.0, 0.0], [9.0, 9.0, 9.0, 9.0]])
    valid = torch.tensor([True, True, True, False])
    absent = [0.0] * 6
    ego = query_features(spec(), states, valid)
    assert ego[1:].tolist() == [[5, 8, 7, 9, 4, 6], [0, 11, 0, 0, -1, 9], absent]
    assert query_features(spec(ROAD), states, valid)[1].tolist() == [8, 7, 9, 4, 6]
    assert query_features(spec(has_ego=False), states, valid)[1].tolist() == [5, 8, 7, 9]
    assert query_features(LAYOUTS["centroid"], states, valid)[1].tolist() == [3, 8, 7, 9]
    blind = query_features(spec(), states, torch.tensor([False, True, True, False]))
    assert blind.tolist() == [absent, [5, 8, 7, 9, 0, 0], [0, 11, 0, 0, 0, 0], absent]


def test_as_many_examples_as_allowed_are_drawn():
    layout = spec()
    episodes = [random_episode(i, layout) for i in range(8)]
    all_examples = collect_examples(episodes, layout, HORIZON)
    some, same, other = (collect_examples(episodes, layout, HORIZON, 20, seed) for seed in (0, 0, 1))
    assert len(all_examples.features) > 60 and len(some.features) == len(some.displacements) == 20
    assert torch.equal(some.features, same.features) and not torch.equal(some.features, other.features)
    places = (some.features[:, None] == all_examples.features).all(-1).nonzero()[:, 1]
    assert torch.equal(some.displacements, all_examples.displacements[places])
    assert len(set(places.tolist())) == 20 and places.max() > len(all_examples.features) / 2
    assert len(collect_examples(episodes, layout, HORIZON, len(all_examples.features)).features) == len(
        all_examples.features
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"horizon_steps": 0}, "horizon_steps and max_examples must be at least 1, got 0 and 200000"),
        ({"max_examples": 0}, "horizon_steps and max_examples must be at least 1, got 3 and 0"),
        ({"k": 0}, "need examples, steps and k of at least 1, got .*, 3 and 0"),
        ({"episodes": []}, "there for horizon_steps=3, but 0 episodes of at most 0 steps have none"),
        ({"episodes": [episode(np.zeros((9, 0, 4)))]}, "horizon_steps=3, but 1 episodes of at most 9 steps"),
        ({"episodes": [episode(np.zeros((9, 1, 4)))]}, "lower horizon_steps or record longer episodes"),
    ],
)
def test_what_cannot_be_fitted_says_why(arguments: dict[str, Any], message: str):
    with pytest.raises(UserError, match=message):
        NearestNeighbour.fit(**({"episodes": [circling_episode(0)], "spec": spec(), "horizon_steps": 3} | arguments))


def test_an_episode_without_anyone_does_not_matter():
    layout = spec()
    with_gaps = [circling_episode(0), episode(np.zeros((9, 0, 4))), episode(np.zeros((0, 2, 4))), circling_episode(1)]
    expected = collect_examples([circling_episode(0), circling_episode(1)], layout, HORIZON)
    assert torch.equal(collect_examples(with_gaps, layout, HORIZON).features, expected.features)


def test_arrays_may_lie_in_memory_as_they_will():
    layout, plain = spec(), circling_episode(0)
    expected = collect_examples([plain], layout, HORIZON)
    mirrored = replace(
        plain,
        states=np.ascontiguousarray(plain.states[:, ::-1])[:, ::-1],
        valid=np.ascontiguousarray(plain.valid[::-1])[::-1],
    )
    for episodes in ([mirrored], [replace(plain, states=plain.states.astype(">f4"))]):
        assert torch.equal(collect_examples(episodes, layout, HORIZON).features, expected.features)


# --- Which agents are there, and where --------------------------------------------------------------------------------


@every_layout
@settings(max_examples=8, deadline=None)
@given(seed=st.integers(0, 2**16), padding=st.integers(1, 3), ego=st.booleans())
def test_padding_is_invisible_and_absent_agents_are_zeros(layout: SceneSpec, seed: int, padding: int, ego: bool):
    forecaster, states = fit_random(layout), scene_of(layout, seed)
    valid = random_presence(seed, 2, 4, ego=ego)
    padded_valid = functional.pad(valid, (0, padding))
    padded_states = torch.full((2, 4 + padding, layout.num_features), torch.nan)
    padded_states[:, :4][valid] = states[valid]
    plain = forecaster.rollout(observe(forecaster, states, valid), HORIZON, 2).states
    padded = forecaster.rollout(observe(forecaster, padded_states, padded_valid), HORIZON, 2).states
    torch.testing.assert_close(padded[:, :, :4], plain, **METRES)
    assert not padded.transpose(1, 2)[~padded_valid].any()
    assert padded.transpose(1, 2)[padded_valid].any() or not valid.any()


@every_layout
@settings(max_examples=8, deadline=None)
@given(seed=st.integers(0, 2**16), order=st.permutations(range(1, 4)))
def test_permuting_agents_permutes_forecasts(layout: SceneSpec, seed: int, order: list[int]):
    forecaster, states, valid = fit_random(layout), scene_of(layout, seed), random_presence(seed, 2, 4)
    order = [0, *order] if layout.has_ego else [order[0], 0, *order[1:]]
    plain = forecaster.rollout(observe(forecaster, states, valid), HORIZON, 2).states
    permuted = forecaster.rollout(observe(forecaster, states[:, order], valid[:, order]), HORIZON, 2).states
    torch.testing.assert_close(permuted, plain[:, :, order], **METRES)


def test_scenes_of_a_batch_are_independent(fitted: NearestNeighbour):
    states, valid = random_states(0, 3, 4, 4), random_presence(0, 3, 4)
    together = fitted.rollout(observe(fitted, states, valid), HORIZON).states
    for env in range(3):
        alone = fitted.rollout(observe(fitted, states[[env]], valid[[env]]), HORIZON).states
        torch.testing.assert_close(alone[0], together[env], **METRES)


def test_no_agents_have_empty_forecasts(fitted: NearestNeighbour):
    states = random_states(0, 2, 3, 4)
    assert not fitted.rollout(observe(fitted, states, torch.zeros(2, 3).bool()), HORIZON, 2).states.any()
    assert fitted.rollout(observe(fitted, states[:, :0]), HORIZON, 2).states.shape == (2, 2, 0, HORIZON, 4)


# --- Frames -----------------------------------------------------------------------------------------------------------


def live(forecaster: NearestNeighbour, shift_m: float) -> Tensor:
    agents = {0: (0.0, 0.0, 9.0, 0.0), 4: (12.5, 4.0, 7.0, 0.5), 7: (-6.25, 0.0, 11.0, 0.0)}
    moved = {i: (x + shift_m, *rest) for i, (x, *rest) in agents.items()}
    online = OnlineForecaster(forecaster, 1, 5)
    online.observe(batch(scene(moved, 5)))
    return online.forecast(HORIZON, 2).xy


def test_a_shift_along_an_unbounded_road_changes_nothing():
    road = [random_episode(i, spec(ROAD)) for i in range(8)]
    forecaster = NearestNeighbour.fit(road, spec(ROAD), HORIZON)
    assert torch.equal(live(forecaster, 1e4), live(forecaster, 0.0))
    far = [replace(e, states=e.states + np.float32([16384, 0, 0, 0]) * e.valid[..., None]) for e in road]
    shifted = NearestNeighbour.fit(far, spec(ROAD), HORIZON)
    torch.testing.assert_close(live(shifted, 0.0), live(forecaster, 0.0), rtol=0, atol=0.05)
    place = NearestNeighbour.fit(road, spec(), HORIZON)
    assert (live(place, 1e4) - live(place, 0.0)).abs().max() > 0.1


def test_streamed_scenes_are_forecast_as_given_ones():
    for frame in (WORLD, ROAD):
        forecaster = fit_random(spec(frame))
        states = torch.tensor([[[0.0, 0.0, 9.0, 0.0], [12.5, 4.0, 7.0, 0.5], [-6.25, 0.0, 11.0, 0.0]]])
        expected = forecaster.rollout(observe(forecaster, states), HORIZON, 2).states[..., :2]
        torch.testing.assert_close(live(forecaster, 0.0)[:, :, :3], expected, **METRES)


# --- From a store -----------------------------------------------------------------------------------------------------


def test_a_store_is_fitted_with_the_perception_asked_for(tmp_path: Path):
    path = write_circles(tmp_path / "store", agents=3)
    forecaster = fit_from_stores([path], spec(), HORIZON, max_examples=1000)
    expected = NearestNeighbour.fit([circling_episode(i, agents=3) for i in range(6)], spec(), HORIZON)
    assert torch.equal(forecaster.points, expected.points)
    assert forecaster.num_examples == 6 * 2 * 7
    assert fit_from_stores([path], spec(max_agents=2), HORIZON).num_examples == 6 * 7
    small = fit_from_stores([path], spec(), HORIZON, "here", 2, 10, 1)
    assert (small.k, small.num_examples) == (2, 10)


def test_a_store_of_another_kind_is_refused(tmp_path: Path):
    path = write_circles(tmp_path / "store")
    with pytest.raises(UserError, match=r"nearest neighbours in .*store was .* dt_s=1 but env 'x' steps at dt_s=0.2;"):
        fit_from_stores([path], spec(dt_s=0.2), HORIZON, "env 'x'")
    with pytest.raises(UserError, match=r"on features .*'vy_mps'\) but env 'x' gives .*'role'"):
        fit_from_stores([path], LAYOUTS["roles"], HORIZON, "env 'x'")
    with pytest.raises(UserError, match="store has has_ego=True but env 'x' has has_ego=False; record a store of the"):
        fit_from_stores([path], spec(has_ego=False), HORIZON, "env 'x'")
    with pytest.raises(UserError, match="there for horizon_steps=10, but 6 episodes of at most 10 steps have none"):
        fit_from_stores([path], spec(), 10)
    assert fit_from_stores([path], spec(), 9).num_examples == 6
    with pytest.raises(UserError, match="no episode store at"):
        fit_from_stores([tmp_path / "nothing"], spec(), HORIZON)


def test_a_store_without_an_ego_is_fitted(tmp_path: Path):
    layout = spec(has_ego=False)
    write_store(tmp_path / "store", StoreInfo(layout, "circles"), [circling_episode(i, agents=3) for i in range(4)])
    forecaster = fit_from_stores([tmp_path / "store"], layout, HORIZON)
    assert forecaster.num_examples == 4 * 3 * 7
    assert torch.isfinite(forecaster.rollout(observe(forecaster, random_states(0, 1, 3, 4)), HORIZON).states).all()


def test_no_example_has_an_intervention_ahead():
    """As in windows: what nobody could foresee is no future to recall."""
    marks = np.zeros((9, 2), dtype=np.int8)
    marks[4, 1] = 1
    recorded = episode(standing(9, 0.0, 5.0))
    plain = collect_examples([recorded], spec(), HORIZON)
    disturbed = collect_examples([replace(recorded, perturbed=marks)], spec(), HORIZON)
    assert (len(plain.features), len(disturbed.features)) == (6, 3)  # after steps 0 to 5; not after 2, 3 and 4
