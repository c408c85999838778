"""The seven semantics of docs/architecture.md, each over every reader, as a policy meets them through the wrappers."""

import itertools
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from envs.entries import FORECAST_KEYS
from envs.readers.base import MultiagentScene
from envs.readers.mpe import MPE_FEATURES
from envs.readers.pursuit import PURSUIT_FEATURES
from predictor.scene import KINEMATIC_FEATURES, Scene
from tests.envs.helpers import assert_same, largest_difference
from tests.envs.semantics import EGO, MODES, SUBJECTS, Bodies, Moment, Session, Views, named

TURN = 3
"""The step from which on an alternative future differs."""
TOLERANCE = 2e-4
"""Between a stream and a window: float32 in other orders."""


@dataclass(frozen=True)
class Take:
    """Two episodes in a row of one wrapper."""

    session: Session
    episodes: tuple[list[Moment], list[Moment]]


@pytest.fixture(scope="module", autouse=True)
def one_thread() -> Iterator[None]:
    """These networks are too small to share; threads would only wait for each other."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def fresh(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Session]:
    """Makes a session of a subject."""

    def make(name: str, **bounds: Any) -> Session:
        folder: Path = tmp_path_factory.mktemp("semantics") / "tiny"
        return Session(SUBJECTS[name], folder, **bounds)

    return make


@pytest.fixture(scope="module")
def take(fresh: Callable[..., Session]) -> Callable[[str], Take]:
    """What was recorded of a subject, once for all tests."""
    takes: dict[str, Take] = {}

    def record(name: str) -> Take:
        if name not in takes:
            session = fresh(name)
            first = session.play(SUBJECTS[name].seed)
            assert session.ended
            takes[name] = Take(session, (first, session.play(SUBJECTS[name].seed + 1, steps=2)))
        return takes[name]

    return record


def assert_same_views(actual: Views, expected: Views, tolerance: float = TOLERANCE) -> None:
    assert set(actual) == set(expected)
    for name in expected:
        assert_same(actual[name], expected[name], tolerance)


def assert_same_agents(actual: Mapping[str, Any], expected: Mapping[str, Any]) -> None:
    """The same agents in a view, in any order: on a grid many are at the same distance."""
    ours, theirs = (
        np.concatenate([view[key].reshape(len(view["valid"]), -1) for key in FORECAST_KEYS], axis=1)
        for view in (actual, expected)
    )
    left = list(range(len(ours)))
    for state in theirs:
        nearest = min(left, key=lambda i: float(np.abs(ours[i] - state).max()))
        np.testing.assert_allclose(ours[nearest], state, rtol=TOLERANCE, atol=TOLERANCE)
        left.remove(nearest)
    assert not left


def difference(actual: Views, expected: Views) -> float:
    return max(largest_difference(actual[name], expected[name]) for name in expected)


# --- 1. Episode boundaries --------------------------------------------------------------------------------------------


@named()
def test_an_episode_opens_with_one_step_of_history(name: str, take: Callable[[str], Take]):
    session, (old, new) = take(name).session, take(name).episodes
    assert_same_views(new[0].views, session.windowed(new[:1]))
    stale = session.stream()
    for moment in old[:4]:
        stale.observe(moment.multi)
    leaks = [difference(stale.observe(moment.multi), moment.views) for moment in new]
    assert max(leaks) > 1e-3  # a history that stays would be noticed


@named()
def test_an_episode_closes_with_its_own_history(name: str, take: Callable[[str], Take]):
    session, (old, new) = take(name).session, take(name).episodes
    for episode in (old, new):
        assert_same_views(episode[-1].views, session.windowed(episode))
        forgotten = session.stream().observe(episode[-1].multi)
        assert difference(forgotten, episode[-1].views) > 1e-3


# --- 2. Identity ------------------------------------------------------------------------------------------------------


def nearby(bodies: Bodies, state: np.ndarray, tolerance_m: float) -> set[Any]:
    return {key for key, place in bodies if np.abs(state[:2] - place).max() <= tolerance_m}


@named()
def test_an_id_is_a_body(name: str, take: Callable[[str], Take]):
    """Bodies in one place cannot be told apart at that step; over an episode they can."""
    subject, episode = SUBJECTS[name], take(name).episodes[0]
    could_be: dict[int, set[Any]] = {}
    for moment in episode:
        scene = moment.multi.scene
        for state, number in zip(scene.states[scene.valid], scene.ids[scene.valid].tolist(), strict=True):
            there = nearby(moment.bodies, state, subject.tolerance_m)
            could_be[number] = could_be.get(number, there) & there
            assert could_be[number], f"{number} jumps from one body to another"
    certain = [key for keys in could_be.values() if len(keys) == 1 for key in keys]
    assert len(set(certain)) == len(certain), "a body got a second number"
    assert len(certain) >= len(could_be) - 2
    pairs = list(itertools.pairwise(episode))
    changes = [(before.present, after.present) for before, after in pairs]
    assert any(after - before for before, after in changes) == subject.enters
    assert any(before - after for before, after in changes) == subject.leaves
    assert any(set(before.views) - set(after.views) for before, after in pairs) == subject.dies


def sorted_anew(multi: MultiagentScene, rng: np.random.Generator) -> MultiagentScene:
    """The same scene with all agents in another place; a single ego keeps the first."""
    fixed = int(EGO in multi.index_of)
    order = np.r_[np.arange(fixed), fixed + rng.permutation(len(multi.scene.ids) - fixed)]
    place, scene = np.argsort(order), multi.scene
    moved = Scene(scene.states[order], scene.ids[order], scene.valid[order], scene.heading_rad)
    index_of = {name: int(place[index]) for name, index in multi.index_of.items()}
    return MultiagentScene(moved, index_of, multi.heading_rad[order])


@named()
def test_results_do_not_depend_on_the_order_of_agents(name: str, take: Callable[[str], Take]):
    session, episode = take(name).session, take(name).episodes[0]
    stream, rng = session.stream(), np.random.default_rng(0)
    for moment in episode:
        views = stream.observe(sorted_anew(moment.multi, rng))
        assert set(views) == set(moment.views)
        for viewer, view in moment.views.items():
            assert_same_agents(views[viewer], view)


@named(lambda subject: subject.enters)
def test_a_newcomer_inherits_nothing(name: str, take: Callable[[str], Take]):
    """An edge's features come from the memory of its pair alone: a newcomer's are those of a first sight."""
    session, episode = take(name).session, take(name).episodes[0]
    newcomers, remembered = 0, 0.0
    for before, now in itertools.pairwise(episode):
        scene = now.multi.scene
        fresh = scene.valid & ~np.isin(scene.ids, list(before.present))
        pairs = scene.valid[:, None] & scene.valid & ~np.eye(len(fresh), dtype=np.bool_)
        new = pairs & (fresh[:, None] | fresh)
        first_sight = session.first_sight(now.multi).forecast.edge_features[0].numpy()
        features = now.forecast.edge_features[0].numpy()
        np.testing.assert_allclose(features[new], first_sight[new], rtol=TOLERANCE, atol=TOLERANCE)
        newcomers += int(fresh.sum())
        remembered = max(remembered, float(np.abs(features - first_sight)[pairs & ~new].max(initial=0.0)))
    assert newcomers
    assert remembered > 1e-3


@pytest.mark.parametrize(("name", "step"), [("function", 4), ("own-reader", 4), ("table-crowd-ids", 4), ("swarm", 5)])
def test_the_toys_newcomer_stands_where_the_leaver_would_be(name: str, step: int, take: Callable[[str], Take]):
    """So that the test above is about an agent that motion alone would take for the leaver."""
    before, now = take(name).episodes[0][step - 1 : step + 1]
    ((gone, was),) = [(i, s) for i, s in states_of(before).items() if i not in now.present]
    ((come, state),) = [(i, s) for i, s in states_of(now).items() if i not in before.present]
    assert come != gone
    mean_mps = (was[2:4] + state[2:4]) / 2
    np.testing.assert_allclose(state[:2], was[:2] + mean_mps * take(name).session.spec.dt_s, atol=1e-9)


def states_of(moment: Moment) -> dict[int, np.ndarray]:
    scene = moment.multi.scene
    return dict(zip(scene.ids[scene.valid].tolist(), scene.states[scene.valid], strict=True))


# --- 3. Streaming ≡ full window ---------------------------------------------------------------------------------------


@named()
def test_streaming_is_the_full_window(name: str, take: Callable[[str], Take]):
    session, episode = take(name).session, take(name).episodes[0]
    for steps in range(2, len(episode) + 1, 3):
        assert_same_views(episode[steps - 1].views, session.windowed(episode[:steps]))


# --- 4. No peeking ----------------------------------------------------------------------------------------------------


@named()
def test_another_future_leaves_the_past_alone(name: str, take: Callable[[str], Take], fresh: Callable[..., Session]):
    episode = take(name).episodes[0]
    other = fresh(name).play(SUBJECTS[name].seed, steps=TURN + 6, turn=TURN)
    for seen, wanted in zip(other[: TURN + 1], episode, strict=False):
        assert_same_views(seen.views, wanted.views, tolerance=0.0)
    later = list(zip(other, episode, strict=False))[TURN + 1 :]
    assert any((seen.multi.scene.states != wanted.multi.scene.states).any() for seen, wanted in later)


# --- 5. Padding is invisible ------------------------------------------------------------------------------------------


@named()
def test_larger_max_agents_are_padding(name: str, take: Callable[[str], Take], fresh: Callable[..., Session]):
    session, episode = take(name).session, take(name).episodes[0]
    size = session.view.max_agents
    wide = fresh(name, size=size + 5).play(SUBJECTS[name].seed, steps=3)
    for seen, wanted in zip(wide, episode, strict=False):
        for viewer, view in wanted.views.items():
            common = {key: value[: size - 1] for key, value in seen.views[viewer].items()}
            assert_same(common, view)
            assert all((value[size - 1 :] == 0).all() for value in seen.views[viewer].values())
    assert len(wide) > 2


@named()
@pytest.mark.parametrize("bounds", [{"sight_m": 1e-6}, {"size": 1}], ids=["sees no agent", "room for no agent"])
def test_the_viewer_alone_works(name: str, bounds: dict[str, Any], fresh: Callable[..., Session]):
    session = fresh(name, **bounds)
    for moment in session.play(SUBJECTS[name].seed, steps=2):
        for view in moment.views.values():
            assert view["valid"].shape == (session.view.max_agents - 1,)
            if name != "pursuit":  # where several stand in one cell
                assert not any(value.any() for key, value in view.items() if key != "ego_path")


# --- 6. Frame ---------------------------------------------------------------------------------------------------------


def shifted(multi: MultiagentScene, axis: int, shift_m: float) -> MultiagentScene:
    states = multi.scene.states.copy()
    states[multi.scene.valid, axis] += shift_m
    return replace(multi, scene=replace(multi.scene, states=states))


@named()
@pytest.mark.parametrize("axis", [0, 1])
def test_a_shift_matters_only_where_there_is_a_map(name: str, axis: int, take: Callable[[str], Take]):
    session, episode = take(name).session, take(name).episodes[0]
    frame, scale = session.spec.frame[axis], session.spec.feature_scales[axis]
    shift_m = 10_000.0 if frame == "ego" else scale
    stream = session.stream()
    for moment in episode:
        views = stream.observe(shifted(moment.multi, axis, shift_m))
    if frame == "world":
        assert difference(views, episode[-1].views) > 1e-3
    else:
        for viewer, view in episode[-1].views.items():
            assert_same_agents(views[viewer], view)


@named()
def test_views_turn_with_the_viewer_and_start_from_it(name: str, take: Callable[[str], Take]):
    """Turned back and moved back, what a viewer sees are the scene's positions and the world's forecasts."""
    session, compared = take(name).session, 0
    for moment in take(name).episodes[0][::2]:
        scene, shares = moment.multi.scene, moment.forecast.mode_probs
        assert shares is not None
        order = np.argsort(-shares[0].numpy(), axis=0, kind="stable")  # (samples, agents)
        xy = np.take_along_axis(moment.forecast.xy[0].numpy(), order[..., None, None], axis=0)
        for viewer, view in moment.views.items():
            index = moment.multi.index_of[viewer]
            heading_rad, own = moment.multi.heading_rad[index], scene.states[index]
            origin = 0.0 if session.spec.has_ego else own[:2]  # of the forecast behind the views
            cos, sin = np.cos(heading_rad), np.sin(heading_rad)
            back = np.array([[cos, sin], [-sin, cos]])
            for k in np.flatnonzero(view["valid"]):
                seen = np.r_[view["agents"][k, :2] @ back, view["agents"][k, 2:4] @ back] + own[:4]
                future = view["forecast"][k] @ back + origin
                misses = np.abs(scene.states[:, :4] - seen).max(axis=1) + np.abs(xy - future[:, None]).max(
                    axis=(0, 2, 3)
                )
                assert misses[scene.valid].min() < 1e-2
                compared += 1
    assert compared > 5


# --- 7. Privilege -----------------------------------------------------------------------------------------------------


@named()
@pytest.mark.parametrize("size", [None, 3], ids=["near", "near and few"])
def test_views_hold_the_nearest_within_perception(name: str, size: int | None, fresh: Callable[..., Session]):
    """Against a plain loop over the simulator's own bodies."""
    subject = SUBJECTS[name]
    session, dropped = fresh(name, sight_m=subject.near_m, size=size), 0
    for moment in session.play(subject.seed, steps=4):
        places = np.array([place for _, place in moment.bodies])
        for viewer, view in moment.views.items():
            own = moment.multi.scene.states[moment.multi.index_of[viewer], :2]
            around_m = np.sort(np.linalg.norm(places - own, axis=1))[1:]  # the first is the viewer
            expected = around_m[around_m <= subject.near_m][: session.view.max_agents - 1]
            seen_m = np.linalg.norm(view["agents"][view["valid"] == 1, :2], axis=1)
            np.testing.assert_allclose(seen_m, expected, atol=1e-3)
            assert (seen_m <= subject.near_m * (1 + 1e-6)).all()
            dropped += len(around_m) - len(expected)
    assert dropped


KNOWN = {KINEMATIC_FEATURES, MPE_FEATURES, PURSUIT_FEATURES}
"""All that any reader tells of an agent: motion, and what a look tells."""


@named()
def test_views_hold_nothing_but_features_and_forecasts(name: str, take: Callable[[str], Take]):
    session, episode = take(name).session, take(name).episodes[0]
    others, model = session.view.max_agents - 1, session.model
    assert session.spec.feature_names in KNOWN
    for moment in episode:
        for view in moment.views.values():
            assert {key: value.shape for key, value in view.items()} == {
                "agents": (others, session.spec.num_features),
                "forecast": (others, MODES, model.horizon_steps, 2),
                "mode_probs": (others, MODES),
                "xy_scale": (others, MODES, model.horizon_steps, 2),
                "edge_probs": (others, 2 * (model.num_edge_types - 1)),
                "edge_features": (others, 2 * model.edge_feature_dim),
                "valid": (others,),
                "ego_path": (model.horizon_steps, 2),
                "closest": (others, 2),
            }
