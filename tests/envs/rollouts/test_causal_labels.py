from dataclasses import replace

import numpy as np
import pytest

from envs.rollouts import causal_labels as causal_module
from envs.rollouts.branches import Branch, Branches, BranchPoint, copied
from envs.rollouts.causal_labels import (
    IN_ARENAS,
    ON_ROADS,
    CausalLabels,
    causal_labels,
    farthest,
    senders_of,
    shift_in_place_of_ego_m,
    with_causal_labels,
)
from envs.rollouts.interventions import intervene
from envs.rollouts.world import World, open_world
from envs.simulators.interventions import Intervention
from envs.supervision import EnvironmentFailedError
from predictor.data.causal_edges import causal_types
from predictor.data.store import Episode
from predictor.support.errors import UserError
from tests.envs.interventions import assert_same_scenes, played, road_world

SETTINGS = replace(ON_ROADS, horizon_s=5.0, threshold_m=0.5)


@pytest.mark.slow
def test_the_rear_one_depends_on_the_middle_one_and_the_front_one_does_not():
    """Three in one lane, ids 1 to 3 from the rear, and the ego (0) two lanes aside, with nobody ahead."""
    world = road_world((0.0, 4.0), (25.0, 4.0), (50.0, 4.0), ego_m=(25.0, 12.0))
    world.step()
    untouched = world.full_scene()
    labels = causal_labels(world, SETTINGS)
    assert_same_scenes([world.full_scene()], [untouched])
    types = causal_types(labels.shift_m, SETTINGS.threshold_m)
    assert list(labels.ids) == [0, 1, 2, 3]
    assert types.tolist() == [
        [-1, 0, 0, 0],
        [0, -1, 1, 0],  # the leader's leader reaches it through the leader alone
        [0, 0, -1, 1],
        [0, 0, 0, -1],
    ]
    assert labels.shift_m[1, 2] > 2.0
    assert labels.shift_m.dtype == np.float32


def test_a_world_that_cannot_be_copied_has_no_labels_rather_than_unknown_ones(monkeypatch: pytest.MonkeyPatch):
    world = road_world((0.0, 4.0), (25.0, 4.0), ego_m=(25.0, 12.0))
    assert senders_of(world, SETTINGS)

    def refused(world: World) -> World:
        raise UserError("cannot be copied")

    monkeypatch.setattr(causal_module, "copied", refused)
    with pytest.raises(UserError, match="cannot be copied"):
        causal_labels(world, SETTINGS)


def test_an_environment_that_fails_while_it_is_perturbed_is_not_passed_over(monkeypatch: pytest.MonkeyPatch):
    world = road_world((0.0, 4.0), (25.0, 4.0), ego_m=(25.0, 12.0))

    def fails(*_: object) -> None:
        raise EnvironmentFailedError("it raised")

    monkeypatch.setattr(causal_module, "intervene", fails)
    with pytest.raises(EnvironmentFailedError, match="it raised"):
        senders_of(world, SETTINGS)


@pytest.mark.slow
def test_a_driver_in_the_place_of_the_ego_depends_on_who_is_ahead_whatever_the_policy_does():
    """The ego (0) drives idle behind agent 2, which follows agent 3; agent 1 drives behind it."""
    world = road_world((0.0, 4.0), (50.0, 4.0), (75.0, 4.0), ego_m=(25.0, 4.0))
    world.step()
    untouched = copied(world)
    labels = causal_labels(world, SETTINGS)
    assert causal_types(labels.shift_m, SETTINGS.threshold_m)[0].tolist() == [-1, 0, 1, 0]
    assert labels.shift_m[0, 2] > 2.0
    assert_same_scenes(played(world, 5), played(untouched, 5))  # the policy drives the world on


@pytest.mark.slow
def test_a_driver_in_the_place_of_the_ego_yields_at_a_crossing():
    """Policies go straight on at 9 m/s; who has the right of way makes a driver wait."""
    world = open_world("intersection-v2", "idle")
    world.reset(3)
    played(world, 3)
    row = causal_labels(world, ON_ROADS).shift_m[0]
    assert np.isnan(row[0]) and (row[np.isfinite(row)] > 5.0).any()


@pytest.mark.slow
def test_who_is_under_an_intervention_does_not_decide_for_itself():
    """Agent 1 follows agent 2, and the ego (0) agent 1; both are braked."""
    world = road_world((25.0, 4.0), (50.0, 4.0), ego_m=(0.0, 4.0))
    world.step()
    assert np.isfinite(causal_labels(world, SETTINGS).shift_m[[0, 1], 2]).all()
    for agent in (0, 1):
        intervene(world, Intervention(agent, "brake", 5))
    shift_m = causal_labels(world, SETTINGS).shift_m
    assert np.isnan(shift_m[[0, 1]]).all() and np.isfinite(shift_m[2]).sum() == 0


def test_without_an_agent_to_try_nothing_is_known_of_the_place_of_the_ego():
    world = road_world((0.0, 4.0), ego_m=(25.0, 4.0))
    assert np.isnan(shift_in_place_of_ego_m(world, [0, 1], [Intervention(0, "brake", 5)], 1.0)).all()


def test_senders_that_are_not_tried_are_unknown():
    world = road_world((0.0, 4.0), (25.0, 4.0), (50.0, 4.0), (0.0, 0.0), ego_m=(0.0, 12.0))
    world.step()
    assert senders_of(world, replace(ON_ROADS, senders=2))[0] == 0
    labels = causal_labels(world, replace(ON_ROADS, horizon_s=1.0, senders=2))
    known = ~np.isnan(labels.shift_m)
    assert known.any(axis=0).sum() == 2
    intervene(world, Intervention(0, "brake", 5))
    assert 0 not in senders_of(world, ON_ROADS)
    assert senders_of(world, replace(ON_ROADS, near_m=1.0)) == []
    assert np.isnan(causal_labels(world, replace(ON_ROADS, near_m=1.0)).shift_m).all()


def test_steps_that_were_not_sampled_are_unknown():
    valid = np.ones((3, 2), dtype=np.bool_)
    episode = Episode(np.zeros((3, 2, 4), dtype=np.float32), valid, np.array([7, 4]))
    shift = np.array([[np.nan, 2.0], [0.0, np.nan]], dtype=np.float32)
    found = with_causal_labels(episode, {1: CausalLabels([4, 7], shift)}).causal_shift_m
    assert found is not None
    assert np.isnan(found[[0, 2]]).all()
    np.testing.assert_array_equal(found[1], [[np.nan, 0.0], [2.0, np.nan]])  # columns are [7, 4]


def test_agents_of_an_arena_have_labels_and_landmarks_send_nothing():
    world = open_world("simple_tag_v3", "heuristic")
    world.reset(2)
    played(world, 4)
    assert set(senders_of(world, replace(ON_ROADS, near_m=10.0))) == {0, 1, 2, 3}
    labels = causal_labels(world, replace(ON_ROADS, near_m=10.0, horizon_s=0.5, threshold_m=0.02))
    types = causal_types(labels.shift_m, 0.02)
    assert (types[:, 4:] == -1).all()  # landmarks are no senders
    assert (types[4:, :4] == 0).all()  # and do not move
    assert types[0, 3] == 1  # a hunter depends on its prey


@pytest.mark.parametrize(("moved_m", "expected"), [(0.5, np.nan), (3.0, 3.0)])
def test_what_leaves_is_unknown_unless_it_moved(moved_m: float, expected: float):
    """Agent 0 stays, agent 1 is gone at the last step."""
    shift = np.zeros((4, 2, 2))
    shift[1:3, 1, 0] = moved_m
    valid = np.ones((4, 2), dtype=np.bool_)
    valid[3, 1] = False
    found = Branches.__new__(Branches)
    object.__setattr__(found, "shift", lambda: (shift, valid))
    object.__setattr__(found, "plain", Branch(shift, valid, (), frozenset()))
    np.testing.assert_array_equal(farthest(found, 1.0), [0.0, expected])
    np.testing.assert_array_equal(farthest(found, 1.0, steps=2), [0.0, moved_m])


@pytest.mark.parametrize(("steps_before", "known"), [(15, True), (16, False)])
def test_nothing_is_known_where_the_episode_ends_within_the_horizon(steps_before: int, known: bool):
    """An episode has 25 steps, the horizon ten. Else those that moved far would be known, and the others not."""
    world = open_world("simple_tag_v3", "heuristic")
    world.reset(2)
    played(world, steps_before)
    labels = causal_labels(world, replace(IN_ARENAS, near_m=10.0))
    assert (~np.isnan(labels.shift_m)).any() == known
    point = BranchPoint(world, 10)
    pushed = point.perturbed(Intervention(point.ids[0], "brake", 1, 8.0, at_once=True))
    assert (~np.isnan(farthest(pushed, 0.0))).any() == known
    assert (~np.isnan(farthest(pushed, 0.0, steps=9))).any()


@pytest.mark.parametrize("horizon_s", [1.0, 4.0])
def test_what_stays_is_known(horizon_s: float):
    world = road_world((0.0, 4.0), (25.0, 4.0), ego_m=(0.0, 12.0))
    labels = causal_labels(world, replace(SETTINGS, horizon_s=horizon_s))
    assert not np.isnan(labels.shift_m[1, 2])
