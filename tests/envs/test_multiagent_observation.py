import math
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from envs.entries import FORECAST_KEYS, PATH_KEYS
from envs.multiagent_observation import MultiagentStream, check_multiagent_scene
from envs.readers.base import MultiagentScene
from envs.scene_stream import ForecastConfig
from predictor.baselines.constant_velocity import ConstantVelocity
from predictor.scene import KINEMATIC_FEATURES_3D, PADDING_ID, Forecast, Scene, SceneSpec
from predictor.support.errors import UserError
from tests.envs.helpers import HORIZON, TOLERANCE, agent_entries, assert_same, largest_difference, tiny_model

WORLD = SceneSpec(dt_s=0.5, has_ego=False, perception_m=60.0, max_agents=6)
CENTROID = replace(WORLD, frame=("centroid", "centroid"))
AROUND_EGO = replace(WORLD, has_ego=True)
FRAMES = [WORLD, CENTROID, AROUND_EGO]
FRAME_NAMES = ["world", "centroid", "absent-ego"]


def multiagent_scene(
    *states: tuple[float, float, float, float],
    names: dict[str, int] | None = None,
    headings_rad: tuple[float, ...] = (),
    ids: tuple[int, ...] | None = None,
    size: int = 6,
) -> MultiagentScene:
    """These agents in the first places; all are learners "0", "1", … unless said."""
    count = len(states)
    full = np.zeros((size, 4))
    full[:count] = np.array(states).reshape(count, 4)
    numbers = np.full(size, PADDING_ID)
    numbers[:count] = range(count) if ids is None else ids
    heading = np.zeros(size)
    heading[: len(headings_rad)] = headings_rad
    learners = {str(i): i for i in range(count)} if names is None else names
    return MultiagentScene(Scene(full, numbers, np.arange(size) < count), learners, heading)


def random_multiagent_scene(rng: np.random.Generator, size: int = 6) -> MultiagentScene:
    """A random number of agents in random places; some of them learn."""
    valid = rng.random(size) < 0.7
    states = rng.normal(size=(size, 4)) * 30 * valid[:, None]
    ids = np.where(valid, rng.permutation(size), PADDING_ID)
    learners = [int(index) for index in np.flatnonzero(valid) if rng.random() < 0.7]
    return MultiagentScene(
        Scene(states, ids, valid), {f"agent_{index}": index for index in learners}, rng.uniform(-np.pi, np.pi, size)
    )


def random_world_forecast(
    rng: np.random.Generator, size: int, samples: int, horizon: int, types: int, features: int
) -> Forecast:
    """Numbers everywhere, also where no agent is."""

    def draw(*shape: int) -> torch.Tensor:
        return torch.from_numpy(rng.normal(size=shape).astype(np.float32))

    return Forecast(
        30 * draw(1, samples, size, horizon, 2),
        torch.softmax(draw(1, size, size, types), -1),
        draw(1, size, size, features),
        torch.ones(1, size, dtype=torch.bool),
    )


def view_by_loops(multi: MultiagentScene, forecast: Forecast, index: int, view: SceneSpec) -> dict[str, np.ndarray]:
    """What the agent in an environment sees, one agent, sample, step and edge type at a time."""
    states, valid = multi.scene.states, multi.scene.valid
    xy, probs, features = (t[0].cpu().numpy() for t in (forecast.xy, forecast.edge_probs, forecast.edge_features))
    samples, _, horizon, _ = xy.shape
    cos, sin = math.cos(multi.heading_rad[index]), math.sin(multi.heading_rad[index])

    def turned(x: float, y: float) -> tuple[float, float]:
        return cos * x + sin * y, -sin * x + cos * y

    near = []
    for other in range(len(valid)):
        if other != index and valid[other]:
            distance_m = math.dist(states[other, :2], states[index, :2])
            if distance_m <= view.perception_m:
                near.append((distance_m, other))
    places = view.max_agents - 1
    entries = {
        "agents": np.zeros((places, states.shape[1])),
        "forecast": np.zeros((places, samples, horizon, 2)),
        "edge_probs": np.zeros((places, 2 * (probs.shape[2] - 1))),
        "edge_features": np.zeros((places, 2 * features.shape[2])),
        "valid": np.zeros(places),
        "ego_path": np.array([[view.dt_s * (t + 1) * v for v in turned(*states[index, 2:4])] for t in range(horizon)]),
        "closest": np.zeros((places, 2)),
    }
    for place, (distance_m, other) in enumerate(sorted(near)[:places]):
        relative = states[other] - states[index]
        entries["agents"][place] = [*turned(*relative[:2]), *turned(*relative[2:4]), *states[other, 4:]]
        for k in range(samples):
            for t in range(horizon):
                entries["forecast"][place, k, t] = turned(*(xy[k, other, t] - states[index, :2]))
        entries["edge_probs"][place] = [*probs[index, other, 1:], *probs[other, index, 1:]]
        entries["edge_features"][place] = [*features[index, other], *features[other, index]]
        entries["valid"][place] = 1
        path, first = entries["ego_path"], entries["forecast"][place, 0]
        apart = [distance_m, *(math.dist(first[t], path[t]) for t in range(horizon))]
        entries["closest"][place] = [min(apart), apart.index(min(apart)) / horizon]
    if samples == 1:
        entries["forecast"] = entries["forecast"][:, 0]
    return entries


def moved(rng: np.random.Generator, multi: MultiagentScene) -> MultiagentScene:
    """The same agents a step later."""
    scene = multi.scene
    states = (scene.states + rng.normal(size=scene.states.shape)) * scene.valid[:, None]
    return replace(multi, scene=replace(scene, states=states))


def reordered(multi: MultiagentScene, order: np.ndarray) -> MultiagentScene:
    """The same agents in other places: index i holds what was at index order[i]."""
    scene = multi.scene
    place = np.argsort(order)
    index_of = {name: int(place[index]) for name, index in multi.index_of.items()}
    return MultiagentScene(
        Scene(scene.states[order], scene.ids[order], scene.valid[order]), index_of, multi.heading_rad[order]
    )


def stream(spec: SceneSpec, perception_m: float | None = None, max_agents: int | None = None, **config: Any):
    model = tiny_model(spec)
    return MultiagentStream(model, replace(spec, has_ego=False), ForecastConfig(**config), perception_m, max_agents)


def straight(multi: MultiagentScene, spec: SceneSpec = WORLD, horizon: int = 2) -> dict[str, dict[str, np.ndarray]]:
    return MultiagentStream(ConstantVelocity(spec, horizon), spec, ForecastConfig()).observe(multi)


# --- view_entries: one forecast, each agent's own view ---------------------------------------------------------------


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
    multi = random_multiagent_scene(rng)
    forecast = random_world_forecast(rng, 6, samples, 3, types, 2)
    view = replace(WORLD, perception_m=perception_m, max_agents=max_agents)
    entries = agent_entries(multi, forecast, view)
    assert list(entries) == list(multi.index_of)
    for name, index in multi.index_of.items():
        assert_same(entries[name], view_by_loops(multi, forecast, index, view), 1e-4)
        assert all(value.dtype == np.float32 for value in entries[name].values())


@settings(max_examples=20)
@given(seed=st.integers(0, 10_000))
def test_the_order_of_agents_does_not_matter(seed: int):
    rng = np.random.default_rng(seed)
    multi, forecast = random_multiagent_scene(rng), random_world_forecast(rng, 6, 2, 3, 2, 2)
    order = rng.permutation(6)
    elsewhere = Forecast(
        forecast.xy[:, :, order],
        forecast.edge_probs[:, order][:, :, order],
        forecast.edge_features[:, order][:, :, order],
        forecast.valid[:, order],
    )
    expected, actual = agent_entries(multi, forecast, WORLD), agent_entries(reordered(multi, order), elsewhere, WORLD)
    assert set(actual) == set(expected)
    for name in expected:
        assert_same(actual[name], expected[name])


def test_each_agent_looks_along_its_own_heading():
    """One drives north at 10 m/s; 30 m ahead of it another drives east at 4 m/s."""
    multi = multiagent_scene((100, 200, 0, 10), (100, 230, 4, 0), headings_rad=(np.pi / 2, 0.0))
    entries = straight(multi)
    np.testing.assert_allclose(entries["0"]["agents"][0], [30, 0, -10, -4], atol=1e-4)
    np.testing.assert_allclose(entries["0"]["forecast"][0], [[30, -2], [30, -4]], atol=1e-4)
    np.testing.assert_allclose(entries["1"]["agents"][0], [0, -30, -4, 10], atol=1e-4)
    np.testing.assert_allclose(entries["1"]["forecast"][0], [[0, -25], [0, -20]], atol=1e-4)


def test_perception_includes_its_boundary_and_is_each_agents_own():
    multi = multiagent_scene((0, 0, 0, 0), (60, 0, 0, 0), (-60.001, 0, 0, 0))
    seen = {name: entry["valid"].sum() for name, entry in straight(multi).items()}
    assert seen == {"0": 1, "1": 1, "2": 0}


def test_the_nearest_are_kept_when_there_is_no_room():
    multi = multiagent_scene((0, 0, 0, 0), (30, 0, 0, 0), (10, 0, 0, 0), (20, 0, 0, 0))
    forecast = random_world_forecast(np.random.default_rng(0), 6, 1, 2, 2, 1)
    entries = agent_entries(multi, forecast, replace(WORLD, max_agents=3))
    np.testing.assert_allclose(entries["0"]["agents"][:, 0], [10, 20])
    np.testing.assert_allclose(entries["1"]["agents"][:, 0], [-10, -20])


def test_agents_on_the_same_spot_see_each_other_and_not_themselves():
    """Index 0 is a body at the same place as the learners in places 1 and 2; their velocities tell them apart."""
    multi = multiagent_scene((5, 5, 1, 0), (5, 5, 2, 0), (5, 5, 3, 0), names={"second": 1, "third": 2})
    entries = straight(multi)
    np.testing.assert_allclose(entries["second"]["agents"][:2, 2], [-1, 1], atol=1e-6)
    np.testing.assert_allclose(entries["third"]["agents"][:2, 2], [-2, -1], atol=1e-6)


def test_padding_is_not_seen_however_far_an_agent_sees():
    multi = multiagent_scene((1, 2, 3, 4), (2, 2, 3, 4))
    forecast = random_world_forecast(np.random.default_rng(0), 6, 1, 2, 2, 1)
    entries = agent_entries(multi, forecast, replace(WORLD, perception_m=np.inf))
    assert entries["0"]["valid"].tolist() == [1, 0, 0, 0, 0]
    assert all((value[1:] == 0).all() for key, value in entries["0"].items() if key != "ego_path")


def test_views_wider_than_the_scene_are_padded():
    multi = multiagent_scene((0, 0, 0, 0), (9, 0, 0, 0), size=2)
    forecast = random_world_forecast(np.random.default_rng(0), 2, 2, 2, 2, 1)
    wide = agent_entries(multi, forecast, replace(WORLD, max_agents=9))["0"]
    narrow = agent_entries(multi, forecast, replace(WORLD, max_agents=2))["0"]
    np.testing.assert_array_equal(wide.pop("ego_path"), narrow.pop("ego_path"))
    assert_same({key: value[:1] for key, value in wide.items()}, narrow)
    assert all(len(value) == 8 and (value[1:] == 0).all() for value in wide.values())


def test_without_learners_there_are_no_entries():
    rng = np.random.default_rng(0)
    multi = replace(random_multiagent_scene(rng), index_of={})
    assert agent_entries(multi, random_world_forecast(rng, 6, 1, 2, 2, 1), WORLD) == {}


# --- MultiagentStream ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("spec", FRAMES, ids=FRAME_NAMES)
def test_forecast_is_in_world_coordinates(spec: SceneSpec):
    multi = multiagent_scene((100, 200, 4, 0), (-50, 30, 0, -8))
    made = MultiagentStream(ConstantVelocity(spec, 2), replace(spec, has_ego=False), ForecastConfig())
    made.observe(multi)
    assert made.forecast is not None
    expected = [[[102, 200], [104, 200]], [[-50, 26], [-50, 22]]]
    np.testing.assert_allclose(made.forecast.xy[0, 0, :2], expected, rtol=1e-6)
    assert made.forecast.xy.shape == (1, 1, 6, 2, 2)
    assert made.forecast.edge_probs.shape == (1, 6, 6, 2)
    assert made.forecast.valid[0].tolist() == multi.scene.valid.tolist()


@pytest.mark.parametrize("spec", FRAMES, ids=FRAME_NAMES)
@pytest.mark.parametrize("samples", [1, 3])
def test_every_agent_is_served_by_the_one_forecast(spec: SceneSpec, samples: int):
    rng = np.random.default_rng(1)
    made = stream(spec, num_samples=samples)
    multi = random_multiagent_scene(rng)
    for _ in range(3):
        multi = moved(rng, multi)
        entries = made.observe(multi)
        assert made.forecast is not None
        for name, index in multi.index_of.items():
            own = dict(entries[name])
            if samples > 1:  # draws are equally likely
                np.testing.assert_allclose(own.pop("mode_probs"), own["valid"][:, None] / samples * np.ones(samples))
            assert_same(own, view_by_loops(multi, made.forecast, index, WORLD), 1e-4)
    assert len(entries) > 1


@pytest.mark.parametrize("spec", FRAMES, ids=FRAME_NAMES)
def test_memory_follows_ids_when_agents_are_sorted_anew(spec: SceneSpec):
    rng = np.random.default_rng(3)
    fixed, sorted_anew, by_place = stream(spec), stream(spec), stream(spec)
    multi = multiagent_scene(*(tuple(rng.normal(size=4) * 20) for _ in range(5)))
    for _ in range(4):
        multi = moved(rng, multi)
        shuffled = reordered(multi, rng.permutation(6))
        expected, actual = fixed.observe(multi), sorted_anew.observe(shuffled)
        for name in expected:
            assert_same(actual[name], expected[name])
        ids = np.where(shuffled.scene.valid, np.arange(6), PADDING_ID)
        wrong = by_place.observe(replace(shuffled, scene=replace(shuffled.scene, ids=ids)))
    assert largest_difference(wrong["0"], expected["0"]) > 100 * TOLERANCE  # places for ids would have been noticed


def test_a_newcomer_inherits_nothing_from_the_leaver_of_its_place():
    rng = np.random.default_rng(9)
    multi = multiagent_scene(*(tuple(rng.normal(size=4) * 20) for _ in range(3)))
    seasoned, fresh = stream(WORLD), stream(WORLD)
    for _ in range(2):
        multi = moved(rng, multi)
        seasoned.observe(multi)
    last = replace(multi, scene=replace(multi.scene, ids=np.array([0, 1, 77, -1, -1, -1])))
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
    multi = random_multiagent_scene(rng)
    for made in (kept, cut):
        made.observe(multi)
    cut.reset()
    later = moved(rng, multi)
    remembered, actual, forgotten = kept.observe(later), cut.observe(later), fresh.observe(later)
    name = next(iter(later.index_of))
    assert_same(actual[name], forgotten[name])
    assert largest_difference(remembered[name], forgotten[name]) > 1e-3


@pytest.mark.parametrize("spec", FRAMES, ids=FRAME_NAMES)
def test_the_others_forecast_does_not_depend_on_who_learns(spec: SceneSpec):
    rng = np.random.default_rng(2)
    all_learn, one_learns = stream(spec), stream(spec)
    multi = multiagent_scene(*(tuple(rng.normal(size=4) * 20) for _ in range(4)))
    for _ in range(3):
        multi = moved(rng, multi)
        expected, actual = all_learn.observe(multi), one_learns.observe(replace(multi, index_of={"2": 2}))
    assert list(actual) == ["2"]
    assert_same(actual["2"], expected["2"])


@pytest.mark.parametrize("spec", FRAMES, ids=FRAME_NAMES)
@pytest.mark.parametrize("samples", [1, 2])
def test_an_empty_scene_is_no_accident(spec: SceneSpec, samples: int):
    rng = np.random.default_rng(4)
    made, fresh = stream(spec, num_samples=samples), stream(spec, num_samples=samples)
    full, empty = multiagent_scene((1, 2, 3, 4), (5, 6, 7, 8)), multiagent_scene()
    assert made.observe(empty) == {}
    made.observe(full)
    assert made.observe(empty) == {}
    assert made.forecast is not None
    assert not made.forecast.valid.any()
    assert (made.forecast.xy == 0).all()
    for noise in (made, fresh):
        noise.seed(0)
    later = moved(rng, full)
    actual, expected = made.observe(later), fresh.observe(later)  # who was away has no past
    for name in expected:
        assert_same(actual[name], expected[name])


@pytest.mark.parametrize("spec", FRAMES, ids=FRAME_NAMES)
def test_alone_is_an_empty_view(spec: SceneSpec):
    multi = multiagent_scene((1, 2, 3, 4), size=1)
    entries = stream(replace(spec, max_agents=1)).observe(multi)["0"]
    of_others = {key: len(value) for key, value in entries.items() if key != "ego_path"}
    assert of_others == dict.fromkeys((*FORECAST_KEYS, "closest"), 0)
    assert (stream(spec).observe(multiagent_scene((1, 2, 3, 4)))["0"]["valid"] == 0).all()


def test_samples_repeat_with_the_seed_and_the_first_is_the_most_likely():
    multi = multiagent_scene(*(tuple(np.random.default_rng(i).normal(size=4) * 20) for i in range(5)))
    first, again, other = (stream(WORLD, num_samples=4, seed=s).observe(multi)["0"]["forecast"] for s in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert (first[0, 1] != other[0, 1]).any()
    likely = stream(WORLD).observe(multi)["0"]["forecast"]
    np.testing.assert_allclose(first[:, 0], likely, rtol=TOLERANCE, atol=TOLERANCE)
    reseeded = stream(WORLD, num_samples=4, seed=2)
    reseeded.seed(1)
    np.testing.assert_array_equal(reseeded.observe(multi)["0"]["forecast"], first)


@pytest.mark.parametrize(("samples", "horizon_steps", "max_agents"), [(1, None, None), (3, 7, 3), (1, 2, 9), (2, 2, 1)])
def test_spaces_hold_the_entries(samples: int, horizon_steps: int | None, max_agents: int | None):
    made = stream(WORLD, max_agents=max_agents, num_samples=samples, horizon_steps=horizon_steps)
    entries, spaces = made.observe(multiagent_scene((1, 2, 3, 4), (5, 6, 7, 8)))["0"], made.spaces()
    assert set(spaces) == {*FORECAST_KEYS, *PATH_KEYS, *(("mode_probs",) if samples > 1 else ())}
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

GOOD = multiagent_scene((1, 2, 3, 4), (5, 6, 7, 8))


def test_a_good_scene_passes():
    assert check_multiagent_scene(GOOD, WORLD) is GOOD
    assert check_multiagent_scene(multiagent_scene(), WORLD).index_of == {}


@pytest.mark.parametrize(
    ("multi", "message"),
    [
        (GOOD.scene, r"toy: reading must give a MultiagentScene .* got Scene"),
        (None, r"toy: reading must give a MultiagentScene .* got NoneType"),
        (
            multiagent_scene((1, 2, 3, 4), size=3),
            r"toy: a scene needs 6 agents \(max_agents\), padding included, got 3",
        ),
        (multiagent_scene((1, 2, 3, 4), (5, 6, 7, 8), ids=(4, 4)), "toy: ids must be unique"),
        (replace(GOOD, heading_rad=np.zeros(5)), "toy: heading_rad must hold 6 finite numbers"),
        (replace(GOOD, heading_rad=np.full(6, np.nan)), "toy: heading_rad must hold 6 finite numbers"),
        (replace(GOOD, index_of={"a": 0, "b": 0}), "toy: every agent needs an index of its own, got {'a': 0, 'b': 0}"),
        (replace(GOOD, index_of={"a": 2}), "toy: agent 'a' has index 2, but the scene has no agent there"),
        (replace(GOOD, index_of={"a": 6}), "toy: agent 'a' has index 6"),
        (replace(GOOD, index_of={"a": -6}), "toy: agent 'a' has index -6"),
    ],
)
def test_a_bad_scene_is_named(multi: Any, message: str):
    with pytest.raises(UserError, match=message):
        check_multiagent_scene(multi, WORLD, "toy")


@pytest.mark.unchecked
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"heading_rad": [0.0]}, r"heading_rad must hold 6 finite numbers, one per agent, got \[0.0\]"),
        ({"heading_rad": None}, "heading_rad must hold 6 finite numbers, one per agent, got None"),
        ({"index_of": ["a"]}, r"index_of must be a dict of whole numbers by agents' names, got \['a'\]"),
        ({"index_of": {"a": "b"}}, r"index_of must be a dict of whole numbers by agents' names, got {'a': 'b'}"),
    ],
)
def test_a_scene_of_wrong_types_is_named(changes: dict[str, Any], message: str):
    with pytest.raises(UserError, match=f"toy: {message}"):
        check_multiagent_scene(replace(GOOD, **changes), WORLD, "toy")
