import math
from collections.abc import Mapping
from dataclasses import asdict, replace
from itertools import product
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from predictor.graph import NO_AGENT
from predictor.scene import (
    KINEMATIC_FEATURES,
    KINEMATIC_FEATURES_3D,
    Forecast,
    Scene,
    SceneBatch,
    SceneSpec,
    dense_edges,
    perceived_agents,
)
from predictor.support.errors import UserError
from tests.predictor.helpers import batch, scene

IN_SPACE: dict[str, Any] = {
    "frame": ("world", "centroid", "world"),
    "feature_names": KINEMATIC_FEATURES_3D,
    "feature_scales": (1.0,) * 6,
}
THREE = {0: (1.0, 2.0, 3.0, 4.0), 8: (5.0, 6.0, 7.0, 8.0), 3: (9.0, 10.0, 11.0, 12.0)}


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"dt_s": 0.0}, "dt_s must be positive, got 0.0"),
        ({"feature_names": ("y_m", "x_m", "vx_mps", "vy_mps")}, "the first features must be"),
        ({"feature_scales": (1.0, 1.0, 1.0)}, r"one positive number per feature \(4\), got \(1.0, 1.0, 1.0\)"),
        ({"feature_scales": (1.0, 1.0, 0.0, 1.0)}, "one positive number per feature"),
        ({"feature_scales": (1.0, math.nan, 1.0, 1.0)}, "one positive number per feature"),
        ({"feature_scales": (1.0, math.inf, 1.0, 1.0)}, "one positive number per feature"),
        ({"max_agents": 0}, "max_agents must be at least 1 and perception_m positive, got 0, 100.0"),
        ({"perception_m": 0.0}, "max_agents must be at least 1 and perception_m positive, got 12, 0.0"),
        ({"perception_m": math.nan}, "max_agents must be at least 1 and perception_m positive, got 12, nan"),
        ({"frame": ("ego", "world"), "has_ego": False}, "an 'ego' frame needs has_ego=True; use 'world' or 'centroid'"),
        (
            {"frame": ("world", "world", "world")},
            r"'ego', 'world' or 'centroid' for each of two axes, got \('world', 'world', 'world'\)",
        ),
        (IN_SPACE | {"frame": ("world", "world")}, r"for each of three axes, got \('world', 'world'\)"),
        (IN_SPACE | {"feature_scales": (1.0,) * 4}, r"one positive number per feature \(6\)"),
        (
            {"feature_names": (*KINEMATIC_FEATURES_3D[:5], "heading_rad"), "feature_scales": (1.0,) * 6},
            r"the first features must be \('x_m', 'y_m', 'vx_mps', 'vy_mps'\) or \('x_m', 'y_m', 'z_m', .*'heading",
        ),
    ],
    ids=[
        "dt",
        "feature_order",
        "scales_short",
        "scales_zero",
        "scales_nan",
        "scales_infinite",
        "no_agents",
        "blind",
        "perception_nan",
        "ego_frame_without_ego",
        "third_axis_in_the_plane",
        "two_axes_in_space",
        "scales_short_in_space",
        "half_of_space",
    ],  # fmt: skip
)
def test_spec_refuses(fields: Mapping[str, object], message: str):
    with pytest.raises(UserError, match=message):
        SceneSpec(**({"dt_s": 1.0} | fields))


def test_axes_follow_from_the_feature_names():
    assert SceneSpec(dt_s=1.0).position_dim == 2
    space = SceneSpec(dt_s=1.0, **IN_SPACE)
    assert (space.position_dim, space.num_features) == (3, 6)
    more = IN_SPACE | {"feature_names": (*KINEMATIC_FEATURES_3D, "heading_rad"), "feature_scales": (1.0,) * 7}
    assert SceneSpec(dt_s=1.0, **more).position_dim == 3


def test_centroid_frame_needs_no_ego():
    assert SceneSpec(dt_s=1.0, frame=("centroid", "world"), has_ego=False).frame == ("centroid", "world")


def test_plane_and_space_do_not_mix():
    with pytest.raises(
        UserError, match=r"trained on features \('x_m', 'y_m', 'vx_mps', 'vy_mps'\) but env 'b' gives .*'z_m'"
    ):
        SceneSpec(dt_s=1.0).check_compatible(SceneSpec(dt_s=1.0, **IN_SPACE), "checkpoint 'a'", "env 'b'")


def test_smallest_spec_is_accepted():
    smallest = SceneSpec(dt_s=1e-6, max_agents=1, perception_m=1e-6)
    assert asdict(smallest)["max_agents"] == 1
    assert smallest.num_features == 4


def test_features_beyond_the_kinematic_ones_count():
    names, scales = (*KINEMATIC_FEATURES, "heading_rad"), (1.0,) * 5
    assert SceneSpec(dt_s=1.0, feature_names=names, feature_scales=scales).num_features == 5


def test_another_time_step_is_named_with_both_numbers():
    with pytest.raises(UserError) as error:
        SceneSpec(dt_s=1.0).check_compatible(SceneSpec(dt_s=0.2), "checkpoint 'highway'", "env 'racetrack-v1'")
    assert str(error.value) == (
        "checkpoint 'highway' was trained at dt_s=1 but env 'racetrack-v1' steps at dt_s=0.2; "
        "retrain on its data, or change the step (policy_frequency, your SceneSpec, --frame-step of tracks)"
    )


def test_other_features_are_named():
    other = SceneSpec(dt_s=1.0, feature_names=(*KINEMATIC_FEATURES, "heading_rad"), feature_scales=(1.0,) * 5)
    with pytest.raises(UserError, match=r"trained on features \(.*'vy_mps'\) but env 'b' gives \(.*'heading_rad'\)"):
        SceneSpec(dt_s=1.0).check_compatible(other, "checkpoint 'a'", "env 'b'")


def test_a_forecaster_without_an_ego_is_refused_where_there_is_one():
    """Its positions are in the world frame, those of scenes with an ego relative to it."""
    without, with_ego = SceneSpec(dt_s=1.0, has_ego=False), SceneSpec(dt_s=1.0)
    with pytest.raises(UserError, match="checkpoint 'tracks' was trained on scenes without an ego but env 'b' has one"):
        without.check_compatible(with_ego, "checkpoint 'tracks'", "env 'b'")
    with_ego.check_compatible(without, "checkpoint 'a'", "env 'c'")


def test_what_a_perception_system_sees_may_differ():
    mine = SceneSpec(dt_s=1.0, perception_m=50.0, max_agents=3, frame=("ego", "world"))
    mine.check_compatible(SceneSpec(dt_s=1.0 + 1e-7), "a", "b")


def test_good_scene_passes_its_check():
    scene(THREE, size=5).check()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"valid": np.array([False, True, True])}, "my reader: agent 0 must be the ego"),
        ({"ids": np.array([0, 8, 8])}, r"my reader: ids must be unique within a scene, got \[0, 8, 8\]"),
        ({"ids": np.array([0, 8, -3])}, r"my reader: ids of valid agents must be non-negative, got \[0, 8, -3\]"),
        ({"states": np.full((3, 4), np.inf)}, "my reader: states must be finite"),
        ({"states": np.full((3, 4), -1e39)}, r"my reader: states must be at most 1e\+30 in size, got"),
    ],
    ids=["no_ego", "twice", "negative", "infinite", "too large"],
)
def test_broken_scene_is_refused(change: Mapping[str, np.ndarray], message: str):
    good = {"states": np.zeros((3, 4)), "ids": np.array([0, 8, 3]), "valid": np.ones(3, dtype=np.bool_)}
    with pytest.raises(UserError, match=message):
        Scene(**(good | change)).check("my reader")


def test_padding_may_repeat_ids_and_hold_any_finite_number():
    states = np.array([[0.0] * 4, [-3.0] * 4, [1e9] * 4])
    Scene(states, np.array([0, -1, -1]), np.array([True, False, False])).check()


@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_padding_that_is_not_finite_is_refused(number: float):
    """A network multiplies padding by zero, which makes a NaN of it."""
    states = np.array([[0.0] * 4, [number] * 4])
    with pytest.raises(UserError, match=r"reader: states must be finite, those of padded agents too \(zeros\), got"):
        Scene(states, np.array([0, -1]), np.array([True, False])).check()


def perceived_by_loop(states: np.ndarray, valid: np.ndarray, ego: int, spec: SceneSpec) -> list[int]:
    """Indices of the agents that one ego perceives, the nearest first."""
    axes = spec.position_dim
    distances = {
        agent: math.sqrt(sum(float(d) ** 2 for d in states[agent, :axes] - states[ego, :axes]))
        for agent in range(len(states))
        if valid[agent] and agent != ego
    }
    others = sorted((agent for agent in distances), key=lambda agent: (distances[agent], agent))
    nearest = ([ego] if valid[ego] else []) + others
    limit = spec.max_agents if valid[ego] else spec.max_agents - 1  # an absent ego keeps its place
    return [agent for agent in nearest[:limit] if agent == ego or distances[agent] <= spec.perception_m]


def crowd(seed: int, perception_m: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, SceneSpec]:
    """States and presence of some scenes, an ego in each, and a spec; on a grid, ties and overlaps are frequent."""
    rng = np.random.default_rng(seed)
    axes, batch, agents, max_agents = rng.integers([2, 1, 1, 1], [4, 5, 10, 11])
    grid = rng.integers(-2, 3, size=(batch, agents, 2 * axes)).astype(np.float64)
    states = grid if rng.random() < 0.5 else rng.normal(size=grid.shape) * 30
    layout = {} if axes == 2 else IN_SPACE | {"frame": ("world",) * 3}
    spec = SceneSpec(dt_s=1.0, perception_m=perception_m, max_agents=int(max_agents), **layout)
    return states, rng.random((batch, agents)) < 0.7, rng.integers(agents, size=batch), spec


seeds, ranges = st.integers(0, 2**16), st.sampled_from([1.0, 2.0, 25.0, float("inf")])


@given(seed=seeds, perception_m=ranges)
def test_an_ego_perceives_itself_and_the_nearest_within_range(seed: int, perception_m: float):
    states, valid, egos, spec = crowd(seed, perception_m)
    order, seen = perceived_agents(states, valid, egos, spec)
    assert order.shape == seen.shape == (len(states), min(spec.max_agents, states.shape[1]))
    for scene_, present, ego, agents, kept in zip(states, valid, egos, order, seen, strict=True):
        assert agents[kept].tolist() == perceived_by_loop(scene_, present, int(ego), spec)
        assert agents[0] == ego


@given(seed=seeds, perception_m=ranges)
def test_one_ego_for_all_scenes_is_that_ego_for_each(seed: int, perception_m: float):
    states, valid, egos, spec = crowd(seed, perception_m)
    found = perceived_agents(states, valid, 0, spec), perceived_agents(states, valid, np.zeros_like(egos), spec)
    for one, other in zip(*found, strict=True):
        np.testing.assert_array_equal(one, other)


def test_an_ego_that_sees_everything_sees_no_padding():
    everything = SceneSpec(dt_s=1.0, perception_m=float("inf"), max_agents=4)
    valid = np.array([True, False, True])
    order, seen = perceived_agents(np.zeros((3, 4)), valid, 0, everything)
    assert order[seen].tolist() == [0, 2]


def test_stacking_keeps_the_order_of_scenes():
    first, second = scene(THREE, size=4), scene({0: (0.5,) * 4}, size=4)
    both = batch(first, second)
    assert len(both) == 2
    for env, each in enumerate((first, second)):
        np.testing.assert_array_equal(both.states[env], each.states)
        np.testing.assert_array_equal(both.ids[env], each.ids)
        np.testing.assert_array_equal(both.valid[env], each.valid)


def test_scenes_of_a_batch():
    scenes = [Scene(np.full((2, 4), float(i)), np.array([i, -1]), np.array([True, False]), float(i)) for i in range(4)]
    chosen = batch(*scenes)[np.array([3, 1])]
    assert chosen.heading_rad.tolist() == [3.0, 1.0]
    assert chosen.ids.tolist() == [[3, -1], [1, -1]]
    joined = SceneBatch.concatenate(chosen, batch(scenes[0]))
    assert joined.heading_rad.tolist() == [3.0, 1.0, 0.0]
    assert joined.states[:, 0, 0].tolist() == [3.0, 1.0, 0.0]
    assert joined.valid.tolist() == [[True, False]] * 3


# --- Forecasts --------------------------------------------------------------------------------------------------------

BATCH, AGENTS, SLOTS, NO_EDGE = 2, 5, 3, (1.0, 0.0, 0.0)


def forecast(seed: int, agents: int = AGENTS, slots: int = SLOTS) -> Forecast:
    """With a list of senders; an empty slot has no edge, as a forecaster gives it."""
    generator = torch.Generator().manual_seed(seed)
    score = torch.rand(BATCH, agents, agents, generator=generator) + 9 * torch.eye(agents)
    senders = score.argsort(-1)[..., :slots]
    senders[torch.rand(senders.shape, generator=generator) > 0.7] = NO_AGENT
    received = (senders != NO_AGENT)[..., None]
    probs = torch.randn(BATCH, agents, slots, 3, generator=generator).softmax(-1)
    features = torch.randn(BATCH, agents, slots, 2, generator=generator)
    xy, valid = torch.zeros(BATCH, 1, agents, 4, 2), torch.ones(BATCH, agents).bool()
    return Forecast(xy, torch.where(received, probs, torch.tensor(NO_EDGE)), features * received, valid, senders)


def test_dense_edges_against_a_loop():
    sparse = forecast(0)
    assert sparse.senders is not None
    garbage = torch.where((sparse.senders == NO_AGENT)[..., None], torch.tensor(7.0), sparse.edge_features)
    probs, features = dense_edges(sparse.edge_probs, garbage, sparse.senders)
    for b, i, j in product(range(BATCH), range(AGENTS), range(AGENTS)):
        slot = sparse.senders[b, i].tolist().index(j) if j in sparse.senders[b, i] else None
        expected = torch.tensor(NO_EDGE) if slot is None else sparse.edge_probs[b, i, slot]
        assert torch.equal(probs[b, i, j], expected)
        assert torch.equal(features[b, i, j], torch.zeros(2) if slot is None else sparse.edge_features[b, i, slot])


def test_dense_forecast():
    sparse = forecast(0)
    dense = sparse.dense()
    assert dense.senders is None and dense.dense() is dense
    assert dense.xy is sparse.xy and dense.valid is sparse.valid
    assert sparse.senders is not None
    expected = dense_edges(sparse.edge_probs, sparse.edge_features, sparse.senders)
    assert torch.equal(dense.edge_probs, expected[0]) and torch.equal(dense.edge_features, expected[1])


def test_edges_of_the_ego_against_a_loop():
    dense = forecast(0).dense()
    probs, features = dense.ego_edges()
    assert probs.shape == (BATCH, AGENTS, 2, 3) and features.shape == (BATCH, AGENTS, 2, 2)
    for b, i in product(range(BATCH), range(AGENTS)):
        assert torch.equal(probs[b, i], torch.stack([dense.edge_probs[b, 0, i], dense.edge_probs[b, i, 0]]))
        assert torch.equal(features[b, i], torch.stack([dense.edge_features[b, 0, i], dense.edge_features[b, i, 0]]))


@settings(max_examples=10)
@given(seed=st.integers(0, 2**16), agents=st.integers(1, 6), slots=st.integers(1, 6))
def test_edges_of_the_ego_are_those_of_the_dense_forecast(seed: int, agents: int, slots: int):
    sparse = forecast(seed, agents, min(slots, agents))
    for ours, expected in zip(sparse.ego_edges(), sparse.dense().ego_edges(), strict=True):
        torch.testing.assert_close(ours, expected, rtol=0, atol=1e-6)


def test_where_there_is_no_slot_the_ego_has_no_edge():
    full = forecast(0)
    lonely = replace(full, senders=torch.full_like(full.senders, NO_AGENT))
    for one in (lonely, lonely.dense()):
        probs, features = one.ego_edges()
        assert torch.equal(probs, torch.tensor(NO_EDGE).expand(BATCH, AGENTS, 2, 3)) and not features.any()


def test_messages_on_many_agents_are_short():
    many = 300
    states, ids, valid = np.zeros((many, 4)), np.arange(many), np.ones(many, dtype=np.bool_)
    with pytest.raises(UserError, match=r"got (\[\[.*nan.*\]\]) and 297 more of ids \[0, 1, 2\] and") as caught:
        Scene(states + np.nan, ids, valid).check()
    assert str(caught.value).count("[nan") == 3
    with pytest.raises(UserError, match="states must be finite") as one:
        Scene(np.where(np.arange(many)[:, None] == 7, np.inf, states), ids, valid).check()
    assert str(one.value).endswith("got [[inf, inf, inf, inf]] of ids [7]")
    for wrong in (ids * 0, -ids):
        with pytest.raises(UserError) as caught:
            Scene(states, wrong, valid).check()
        assert len(str(caught.value)) < 400


def test_lists_and_arrays_become_tuples():
    names = [*KINEMATIC_FEATURES, "size_m"]
    made = SceneSpec(0.1, ["ego", "ego"], names, np.array([1.0, 1.0, 2.0, 2.0, 3.0]), constant_features=["size_m"])
    assert made == SceneSpec(
        0.1, ("ego", "ego"), tuple(names), (1.0, 1.0, 2.0, 2.0, 3.0), constant_features=("size_m",)
    )
    assert len({made, made}) == 1
