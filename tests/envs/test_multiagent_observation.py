import math
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from envs.multiagent_observation import MultiagentStream, agent_entries, check_multiagent_scene
from envs.observation import FORECAST_KEYS, ForecastConfig
from envs.readers.base import MultiagentScene
from predictor.baselines.constant_velocity import ConstantVelocity
from predictor.scene import KINEMATIC_FEATURES_3D, PADDING_ID, Forecast, Scene, SceneSpec
from predictor.support.errors import UserError
from tests.envs.helpers import HORIZON, TOLERANCE, assert_same, largest_difference, tiny_model

WORLD = SceneSpec(dt_s=0.5, has_ego=False, perception_m=60.0, max_agents=6)
CENTROID = replace(WORLD, frame=("centroid", "centroid"))
AROUND_EGO = replace(WORLD, has_ego=True)
FRAMES = [WORLD, CENTROID, AROUND_EGO]
FRAME_NAMES = ["world", "centroid", "absent-ego"]


def shared_scene(
    *states: tuple[float, float, float, float],
    names: dict[str, int] | None = None,
    headings_rad: tuple[float, ...] = (),
    ids: tuple[int, ...] | None = None,
    rows: int = 6,
) -> MultiagentScene:
    """These agents in the first rows; all are learners "0", "1", … unless said."""
    count = len(states)
    full = np.zeros((rows, 4))
    full[:count] = np.array(states).reshape(count, 4)
    numbers = np.full(rows, PADDING_ID)
    numbers[:count] = range(count) if ids is None else ids
    heading = np.zeros(rows)
    heading[: len(headings_rad)] = headings_rad
    learners = {str(i): i for i in range(count)} if names is None else names
    return MultiagentScene(Scene(full, numbers, np.arange(rows) < count), learners, heading)


def random_shared(rng: np.random.Generator, rows: int = 6) -> MultiagentScene:
    """A random number of agents in random rows; some of them learn."""
    valid = rng.random(rows) < 0.7
    states = rng.normal(size=(rows, 4)) * 30 * valid[:, None]
    ids = np.where(valid, rng.permutation(rows), PADDING_ID)
    learners = [int(row) for row in np.flatnonzero(valid) if rng.random() < 0.7]
    return MultiagentScene(
        Scene(states, ids, valid), {f"agent_{row}": row for row in learners}, rng.uniform(-np.pi, np.pi, rows)
    )


def random_world_forecast(
    rng: np.random.Generator, rows: int, samples: int, horizon: int, types: int, features: int
) -> Forecast:
    """Numbers everywhere, also where nobody is."""

    def draw(*shape: int) -> torch.Tensor:
        return torch.from_numpy(rng.normal(size=shape).astype(np.float32))

    return Forecast(
        30 * draw(1, samples, rows, horizon, 2),
        torch.softmax(draw(1, rows, rows, types), -1),
        draw(1, rows, rows, features),
        torch.ones(1, rows, dtype=torch.bool),
    )


def view_by_loops(shared: MultiagentScene, forecast: Forecast, row: int, view: SceneSpec) -> dict[str, np.ndarray]:
    """What the agent in a row sees, one agent, sample, step and edge type at a time."""
    states, valid = shared.scene.states, shared.scene.valid
    xy, probs, features = (t[0].cpu().numpy() for t in (forecast.xy, forecast.edge_probs, forecast.edge_features))
    samples, _, horizon, _ = xy.shape
    cos, sin = math.cos(shared.heading_rad[row]), math.sin(shared.heading_rad[row])

    def turned(x: float, y: float) -> tuple[float, float]:
        return cos * x + sin * y, -sin * x + cos * y

    near = []
    for other in range(len(valid)):
        if other != row and valid[other]:
            distance_m = math.dist(states[other, :2], states[row, :2])
            if distance_m <= view.perception_m:
                near.append((distance_m, other))
    places = view.max_agents - 1
    entries = {
        "agents": np.zeros((places, states.shape[1])),
        "forecast": np.zeros((places, samples, horizon, 2)),
        "edge_probs": np.zeros((places, 2 * (probs.shape[2] - 1))),
        "edge_features": np.zeros((places, 2 * features.shape[2])),
        "valid": np.zeros(places),
    }
    for place, (_, other) in enumerate(sorted(near)[:places]):
        relative = states[other] - states[row]
        entries["agents"][place] = [*turned(*relative[:2]), *turned(*relative[2:4]), *states[other, 4:]]
        for k in range(samples):
            for t in range(horizon):
                entries["forecast"][place, k, t] = turned(*(xy[k, other, t] - states[row, :2]))
        entries["edge_probs"][place] = [*probs[row, other, 1:], *probs[other, row, 1:]]
        entries["edge_features"][place] = [*features[row, other], *features[other, row]]
        entries["valid"][place] = 1
    if samples == 1:
        entries["forecast"] = entries["forecast"][:, 0]
    return entries


def moved(rng: np.random.Generator, shared: MultiagentScene) -> MultiagentScene:
    """The same agents a step later."""
    scene = shared.scene
    states = (scene.states + rng.normal(size=scene.states.shape)) * scene.valid[:, None]
    return replace(shared, scene=replace(scene, states=states))


def reordered(shared: MultiagentScene, order: np.ndarray) -> MultiagentScene:
    """The same agents in other rows: row i holds what was in row order[i]."""
    scene = shared.scene
    place = np.argsort(order)
    rows = {name: int(place[row]) for name, row in shared.index_of.items()}
    return MultiagentScene(
        Scene(scene.states[order], scene.ids[order], scene.valid[order]), rows, shared.heading_rad[order]
    )


def stream(spec: SceneSpec, perception_m: float | None = None, max_agents: int | None = None, **config: Any):
    model = tiny_model(spec)
    return MultiagentStream(model, replace(spec, has_ego=False), ForecastConfig(**config), perception_m, max_agents)


def straight(shared: MultiagentScene, spec: SceneSpec = WORLD, horizon: int = 2) -> dict[str, dict[str, np.ndarray]]:
    return MultiagentStream(ConstantVelocity(spec, horizon), spec, ForecastConfig()).observe(shared)


# --- agent_entries: one forecast, everyone's own view -----------------------------------------------------------------


@settings(max_examples=60)
@given(
    seed=st.integers(0, 10_000),
    samples=st.integers(1, 3),
    types=st.integers(2, 3),
    perception_m=st.sampled_from([5.0, 40.0, np.inf]),
    max_agents=st.integers(1, 9),
)
def test_equals_a_plain_loop(seed: int, samples: int, types: int, perception_m: float, max_agents: int):
    rng = np.random.default_rng(seed)
    shared = random_shared(rng)
    forecast = random_world_forecast(rng, 6, samples, 3, types, 2)
    view = replace(WORLD, perception_m=perception_m, max_agents=max_agents)
    entries = agent_entries(shared, forecast, view)
    assert list(entries) == list(shared.index_of)
    for name, row in shared.index_of.items():
        assert_same(entries[name], view_by_loops(shared, forecast, row, view), 1e-4)
        assert all(value.dtype == np.float32 for value in entries[name].values())


@settings(max_examples=20)
@given(seed=st.integers(0, 10_000))
def test_rows_do_not_matter(seed: int):
    rng = np.random.default_rng(seed)
    shared, forecast = random_shared(rng), random_world_forecast(rng, 6, 2, 3, 2, 2)
    order = rng.permutation(6)
    elsewhere = Forecast(
        forecast.xy[:, :, order],
        forecast.edge_probs[:, order][:, :, order],
        forecast.edge_features[:, order][:, :, order],
        forecast.valid[:, order],
    )
    expected, actual = agent_entries(shared, forecast, WORLD), agent_entries(reordered(shared, order), elsewhere, WORLD)
    assert set(actual) == set(expected)
    for name in expected:
        assert_same(actual[name], expected[name])


def test_each_agent_looks_along_its_own_heading():
    """One drives north at 10 m/s; 30 m ahead of it another drives east at 4 m/s."""
    shared = shared_scene((100, 200, 0, 10), (100, 230, 4, 0), headings_rad=(np.pi / 2, 0.0))
    entries = straight(shared)
    np.testing.assert_allclose(entries["0"]["agents"][0], [30, 0, -10, -4], atol=1e-4)
    np.testing.assert_allclose(entries["0"]["forecast"][0], [[30, -2], [30, -4]], atol=1e-4)
    np.testing.assert_allclose(entries["1"]["agents"][0], [0, -30, -4, 10], atol=1e-4)
    np.testing.assert_allclose(entries["1"]["forecast"][0], [[0, -25], [0, -20]], atol=1e-4)


def test_perception_includes_its_boundary_and_is_each_agents_own():
    shared = shared_scene((0, 0, 0, 0), (60, 0, 0, 0), (-60.001, 0, 0, 0))
    seen = {name: entry["valid"].sum() for name, entry in straight(shared).items()}
    assert seen == {"0": 1, "1": 1, "2": 0}


def test_the_nearest_are_kept_when_there_is_no_room():
    shared = shared_scene((0, 0, 0, 0), (30, 0, 0, 0), (10, 0, 0, 0), (20, 0, 0, 0))
    forecast = random_world_forecast(np.random.default_rng(0), 6, 1, 2, 2, 1)
    entries = agent_entries(shared, forecast, replace(WORLD, max_agents=3))
    np.testing.assert_allclose(entries["0"]["agents"][:, 0], [10, 20])
    np.testing.assert_allclose(entries["1"]["agents"][:, 0], [-10, -20])


def test_agents_on_the_same_spot_see_each_other_and_not_themselves():
    """Row 0 is a body at the same place as the learners in rows 1 and 2; their velocities tell them apart."""
    shared = shared_scene((5, 5, 1, 0), (5, 5, 2, 0), (5, 5, 3, 0), names={"second": 1, "third": 2})
    entries = straight(shared)
    np.testing.assert_allclose(entries["second"]["agents"][:2, 2], [-1, 1], atol=1e-6)
    np.testing.assert_allclose(entries["third"]["agents"][:2, 2], [-2, -1], atol=1e-6)


def test_padding_is_not_seen_however_far_an_agent_sees():
    shared = shared_scene((1, 2, 3, 4), (2, 2, 3, 4))
    forecast = random_world_forecast(np.random.default_rng(0), 6, 1, 2, 2, 1)
    entries = agent_entries(shared, forecast, replace(WORLD, perception_m=np.inf))
    assert entries["0"]["valid"].tolist() == [1, 0, 0, 0, 0]
    assert all((value[1:] == 0).all() for value in entries["0"].values())


def test_views_wider_than_the_scene_are_padded():
    shared = shared_scene((0, 0, 0, 0), (9, 0, 0, 0), rows=2)
    forecast = random_world_forecast(np.random.default_rng(0), 2, 2, 2, 2, 1)
    wide = agent_entries(shared, forecast, replace(WORLD, max_agents=9))["0"]
    narrow = agent_entries(shared, forecast, replace(WORLD, max_agents=2))["0"]
    assert_same({key: value[:1] for key, value in wide.items()}, narrow)
    assert all(len(value) == 8 and (value[1:] == 0).all() for value in wide.values())


def test_nobody_who_learns_gets_nothing():
    rng = np.random.default_rng(0)
    shared = replace(random_shared(rng), index_of={})
    assert agent_entries(shared, random_world_forecast(rng, 6, 1, 2, 2, 1), WORLD) == {}


# --- MultiagentStream ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("spec", FRAMES, ids=FRAME_NAMES)
def test_forecast_is_in_world_coordinates(spec: SceneSpec):
    shared = shared_scene((100, 200, 4, 0), (-50, 30, 0, -8))
    made = MultiagentStream(ConstantVelocity(spec, 2), replace(spec, has_ego=False), ForecastConfig())
    made.observe(shared)
    assert made.forecast is not None
    expected = [[[102, 200], [104, 200]], [[-50, 26], [-50, 22]]]
    np.testing.assert_allclose(made.forecast.xy[0, 0, :2], expected, rtol=1e-6)
    assert made.forecast.xy.shape == (1, 1, 6, 2, 2)
    assert made.forecast.edge_probs.shape == (1, 6, 6, 2)
    assert made.forecast.valid[0].tolist() == shared.scene.valid.tolist()


@pytest.mark.parametrize("spec", FRAMES, ids=FRAME_NAMES)
@pytest.mark.parametrize("samples", [1, 3])
def test_every_agent_is_served_by_the_one_forecast(spec: SceneSpec, samples: int):
    rng = np.random.default_rng(1)
    made = stream(spec, num_samples=samples)
    shared = random_shared(rng)
    for _ in range(3):
        shared = moved(rng, shared)
        entries = made.observe(shared)
        assert made.forecast is not None
        for name, row in shared.index_of.items():
            assert_same(entries[name], view_by_loops(shared, made.forecast, row, WORLD), 1e-4)
    assert len(entries) > 1


@pytest.mark.parametrize("spec", FRAMES, ids=FRAME_NAMES)
def test_memory_follows_ids_when_rows_are_sorted_anew(spec: SceneSpec):
    rng = np.random.default_rng(3)
    fixed, sorted_anew, by_row = stream(spec), stream(spec), stream(spec)
    shared = shared_scene(*(tuple(rng.normal(size=4) * 20) for _ in range(5)))
    for _ in range(4):
        shared = moved(rng, shared)
        other_rows = reordered(shared, rng.permutation(6))
        expected, actual = fixed.observe(shared), sorted_anew.observe(other_rows)
        for name in expected:
            assert_same(actual[name], expected[name])
        ids = np.where(other_rows.scene.valid, np.arange(6), PADDING_ID)
        wrong = by_row.observe(replace(other_rows, scene=replace(other_rows.scene, ids=ids)))
    assert largest_difference(wrong["0"], expected["0"]) > 100 * TOLERANCE  # rows for ids would have been noticed


def test_a_newcomer_inherits_nothing_from_the_leaver_of_its_row():
    rng = np.random.default_rng(9)
    shared = shared_scene(*(tuple(rng.normal(size=4) * 20) for _ in range(3)))
    seasoned, fresh = stream(WORLD), stream(WORLD)
    for _ in range(2):
        shared = moved(rng, shared)
        seasoned.observe(shared)
    last = replace(shared, scene=replace(shared.scene, ids=np.array([0, 1, 77, -1, -1, -1])))
    actual, first_sight = seasoned.observe(last), fresh.observe(last)
    for name in ("0", "1", "2"):
        nearest = np.argsort(np.linalg.norm(last.scene.states[:3, :2] - last.scene.states[int(name), :2], axis=1))[1:]
        difference = np.abs(actual[name]["edge_features"] - first_sight[name]["edge_features"]).max(axis=1)
        for place, other in enumerate(nearest):
            new = name == "2" or other == 2
            assert (difference[place] < TOLERANCE) if new else (difference[place] > 1e-3)


def test_reset_forgets():
    rng = np.random.default_rng(5)
    kept, cut, fresh = stream(WORLD), stream(WORLD), stream(WORLD)
    shared = random_shared(rng)
    for made in (kept, cut):
        made.observe(shared)
    cut.reset()
    later = moved(rng, shared)
    remembered, actual, forgotten = kept.observe(later), cut.observe(later), fresh.observe(later)
    name = next(iter(later.index_of))
    assert_same(actual[name], forgotten[name])
    assert largest_difference(remembered[name], forgotten[name]) > 1e-3


@pytest.mark.parametrize("spec", FRAMES, ids=FRAME_NAMES)
def test_the_others_forecast_does_not_depend_on_who_learns(spec: SceneSpec):
    rng = np.random.default_rng(2)
    all_learn, one_learns = stream(spec), stream(spec)
    shared = shared_scene(*(tuple(rng.normal(size=4) * 20) for _ in range(4)))
    for _ in range(3):
        shared = moved(rng, shared)
        expected, actual = all_learn.observe(shared), one_learns.observe(replace(shared, index_of={"2": 2}))
    assert list(actual) == ["2"]
    assert_same(actual["2"], expected["2"])


@pytest.mark.parametrize("spec", FRAMES, ids=FRAME_NAMES)
@pytest.mark.parametrize("samples", [1, 2])
def test_an_empty_scene_is_no_accident(spec: SceneSpec, samples: int):
    rng = np.random.default_rng(4)
    made, fresh = stream(spec, num_samples=samples), stream(spec, num_samples=samples)
    someone, nobody = shared_scene((1, 2, 3, 4), (5, 6, 7, 8)), shared_scene()
    assert made.observe(nobody) == {}
    made.observe(someone)
    assert made.observe(nobody) == {}
    assert made.forecast is not None
    assert not made.forecast.valid.any()
    assert (made.forecast.xy == 0).all()
    for noise in (made, fresh):
        noise.seed(0)
    later = moved(rng, someone)
    actual, expected = made.observe(later), fresh.observe(later)  # who was away has no past
    for name in expected:
        assert_same(actual[name], expected[name])


@pytest.mark.parametrize("spec", FRAMES, ids=FRAME_NAMES)
def test_alone_is_an_empty_view(spec: SceneSpec):
    shared = shared_scene((1, 2, 3, 4), rows=1)
    entries = stream(replace(spec, max_agents=1)).observe(shared)["0"]
    assert {key: len(value) for key, value in entries.items()} == dict.fromkeys(FORECAST_KEYS, 0)
    assert (stream(spec).observe(shared_scene((1, 2, 3, 4)))["0"]["valid"] == 0).all()


def test_samples_repeat_with_the_seed_and_the_first_is_the_most_likely():
    shared = shared_scene(*(tuple(np.random.default_rng(i).normal(size=4) * 20) for i in range(5)))
    first, again, other = (stream(WORLD, num_samples=4, seed=s).observe(shared)["0"]["forecast"] for s in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert (first[0, 1] != other[0, 1]).any()
    likely = stream(WORLD).observe(shared)["0"]["forecast"]
    np.testing.assert_allclose(first[:, 0], likely, rtol=TOLERANCE, atol=TOLERANCE)
    reseeded = stream(WORLD, num_samples=4, seed=2)
    reseeded.seed(1)
    np.testing.assert_array_equal(reseeded.observe(shared)["0"]["forecast"], first)


@pytest.mark.parametrize(("samples", "horizon_steps", "max_agents"), [(1, None, None), (3, 7, 3), (1, 2, 9), (2, 2, 1)])
def test_spaces_hold_the_entries(samples: int, horizon_steps: int | None, max_agents: int | None):
    made = stream(WORLD, max_agents=max_agents, num_samples=samples, horizon_steps=horizon_steps)
    entries, spaces = made.observe(shared_scene((1, 2, 3, 4), (5, 6, 7, 8)))["0"], made.spaces()
    assert tuple(spaces) == FORECAST_KEYS
    assert set(entries) == set(spaces)
    for key, space in spaces.items():
        assert space.contains(entries[key]), key
        assert space is not made.spaces()[key]  # seeding one agent's must not seed another's
    axis = () if samples == 1 else (samples,)
    assert entries["forecast"].shape == ((max_agents or 6) - 1, *axis, horizon_steps or HORIZON, 2)
    assert gym.spaces.Dict(spaces).contains(entries)


def test_a_view_is_what_was_asked_for():
    assert stream(WORLD).view_spec == WORLD
    assert stream(WORLD, perception_m=7.5, max_agents=2).view_spec == replace(WORLD, perception_m=7.5, max_agents=2)


def test_a_forecaster_that_needs_an_ego_is_refused():
    model = tiny_model(replace(AROUND_EGO, frame=("ego", "world")))
    with pytest.raises(UserError, match="relative to one ego, but these scenes have many learners"):
        MultiagentStream(model, WORLD, ForecastConfig())


def test_scenes_with_an_ego_or_a_height_are_refused():
    high = SceneSpec(
        0.5, ("world",) * 3, KINEMATIC_FEATURES_3D, feature_scales=(1.0,) * 6, has_ego=False, perception_m=60.0
    )
    for spec, found in ((AROUND_EGO, "has_ego=True and 2 axes"), (high, "has_ego=False and 3 axes")):
        with pytest.raises(UserError, match=f"need has_ego=False and positions on two axes, got {found}"):
            MultiagentStream(ConstantVelocity(spec), spec, ForecastConfig())


@pytest.mark.parametrize(("perception_m", "max_agents"), [(0.0, None), (-1.0, None), (None, 0)])
def test_bounds_out_of_range_are_refused(perception_m: float | None, max_agents: int | None):
    with pytest.raises(UserError, match="max_agents must be at least 1 and perception_m positive"):
        stream(WORLD, perception_m, max_agents)


# --- check_multiagent_scene -------------------------------------------------------------------------------------------

GOOD = shared_scene((1, 2, 3, 4), (5, 6, 7, 8))


def test_a_good_scene_passes():
    assert check_multiagent_scene(GOOD, WORLD) is GOOD
    assert check_multiagent_scene(shared_scene(), WORLD).index_of == {}


@pytest.mark.parametrize(
    ("shared", "message"),
    [
        (GOOD.scene, r"toy: reading must give a MultiagentScene .* got Scene"),
        (None, r"toy: reading must give a MultiagentScene .* got NoneType"),
        (shared_scene((1, 2, 3, 4), rows=3), r"toy: a scene needs 6 agents \(max_agents\), padding included, got 3"),
        (shared_scene((1, 2, 3, 4), (5, 6, 7, 8), ids=(4, 4)), "toy: ids must be unique"),
        (replace(GOOD, heading_rad=np.zeros(5)), "toy: heading_rad must hold 6 finite numbers"),
        (replace(GOOD, heading_rad=np.full(6, np.nan)), "toy: heading_rad must hold 6 finite numbers"),
        (replace(GOOD, index_of={"a": 0, "b": 0}), "toy: every agent needs an index of its own, got {'a': 0, 'b': 0}"),
        (replace(GOOD, index_of={"a": 2}), "toy: agent 'a' has index 2, but the scene has no agent there"),
        (replace(GOOD, index_of={"a": 6}), "toy: agent 'a' has index 6"),
        (replace(GOOD, index_of={"a": -6}), "toy: agent 'a' has index -6"),
    ],
)
def test_a_bad_scene_is_named(shared: Any, message: str):
    with pytest.raises(UserError, match=message):
        check_multiagent_scene(shared, WORLD, "toy")
