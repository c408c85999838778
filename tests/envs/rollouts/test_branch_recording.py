from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from envs.collect import CollectConfig, collect
from envs.rollouts import branch_recording
from envs.rollouts.branch_recording import IN_ARENAS as ARENA_MIX
from envs.rollouts.branch_recording import ON_ROADS as ROAD_MIX
from envs.rollouts.branch_recording import (
    BranchRecording,
    _branch,
    _perturbed,
    _play,
    _sender,
    _with_twin,
    record_branches,
)
from envs.rollouts.branches import Branch, Branches, BranchPoint
from envs.rollouts.causal_labels import IN_ARENAS, ON_ROADS, senders_of
from envs.rollouts.recording import Recording, record
from envs.rollouts.world import open_world
from envs.simulators.interventions import Intervention, NotAllowedError
from envs.supervision import EnvironmentFailedError
from predictor.data.store import PERTURBATIONS, Episode
from predictor.data.windows import Windows
from predictor.scene import Scene
from predictor.support.errors import UserError

ROAD, TAG = "highway-fast-v0", "simple_tag_v3"
ON_ROAD = BranchRecording(3, 4, replace(ROAD_MIX, horizon_s=3.0), replace(ON_ROADS, senders=4))
IN_ARENA = BranchRecording(3, 4, replace(ARENA_MIX, horizon_s=0.5), replace(IN_ARENAS, horizon_s=0.5))


def moment_of(episode: Episode) -> tuple[int, int]:
    """Returns the step before the intervention, and the column of its agent."""
    assert episode.perturbed is not None
    ((step, column),) = np.argwhere(episode.perturbed)
    return int(step), int(column)


@pytest.fixture(scope="module")
def branches() -> list[Episode]:
    return record_branches(open_world(ROAD, "idle"), 5, "idle", 9, ON_ROAD)


def test_a_branch_is_the_episode_up_to_its_moment(branches: list[Episode]):
    whole = record(open_world(ROAD, "idle"), 5, "idle", Recording(9, labels=False))
    assert len(branches) == 3 and {e.label for e in branches} == {"idle"} and {e.seed for e in branches} == {5}
    for branch in branches:
        step, agent = moment_of(branch)
        assert len(branch.states) == step + 1 + 4 and step < 4
        begin = next(i for i in range(len(whole.states)) if (whole.states[i, 0] == branch.states[0, 0]).all())
        columns = [whole.ids.tolist().index(i) for i in branch.ids]
        before = whole.states[begin : begin + step + 1][:, columns]
        np.testing.assert_array_equal(branch.states[: step + 1], np.where(branch.valid[: step + 1, :, None], before, 0))
        now = whole.states[begin + step + 1, columns]
        others = np.arange(len(columns)) != agent
        np.testing.assert_array_equal(branch.states[step + 1, others], now[others])


@pytest.mark.slow
def test_a_twin_is_the_same_moment_without_the_intervention(branches: list[Episode]):
    world = open_world(ROAD, "idle")
    both = record_branches(world, 5, "idle", 9, replace(ON_ROAD, twins=True))
    whole = record(world, 5, "idle", Recording(9, labels=False))
    assert len(both) == 2 * len(branches)
    for branch, twin, alone in zip(both[::2], both[1::2], branches, strict=True):
        step, agent = moment_of(branch)
        columns = [branch.ids.tolist().index(i) for i in alone.ids]
        np.testing.assert_array_equal(branch.states[:, columns], alone.states)
        np.testing.assert_array_equal(branch.causal_shift_m[:, columns][:, :, columns], alone.causal_shift_m)  # type: ignore[index]
        np.testing.assert_array_equal(branch.ids, twin.ids)
        assert twin.perturbed is not None and not twin.perturbed.any() and np.isnan(twin.causal_shift_m).all()
        np.testing.assert_array_equal(twin.states[: step + 1], branch.states[: step + 1])
        begin = next(i for i in range(len(whole.states)) if (whole.states[i, 0] == twin.states[0, 0]).all())
        known = [whole.ids.tolist().index(i) for i in twin.ids]
        span = min(len(twin.states), len(whole.states) - begin)
        expected = np.where(twin.valid[:span, :, None], whole.states[begin : begin + span][:, known], 0)
        np.testing.assert_allclose(twin.states[:span], expected, atol=1e-4)
        assert (
            twin.valid[: step + 2].sum() == branch.valid[: step + 1].sum() + whole.valid[begin + step + 1, known].sum()
        )


def test_a_twin_has_the_columns_of_its_branch_and_nobody_who_crashes():
    """Agent 7 crashes in the branch, as does the ego, which stays; agent 9 is in the twin alone."""
    ids = np.array([0, 7, 8, 9])
    states, everybody = np.ones((4, 4, 4)), np.ones((4, 4), dtype=np.bool_)
    there = everybody.copy()
    there[:, 3] = False
    plain, perturbed = Branch(states, everybody, ()), Branch(states, there, (), frozenset({0, 7}))
    found = Branches(Intervention(8, "brake", 0, 5.0, at_once=True), ids, plain, perturbed)
    before = [Scene(states[0, :3], ids[:3], everybody[0, :3])] * 2
    alone = Episode.from_scenes([*before, *(Scene(states[0], ids, there[0]) for _ in range(4))])
    unknown = np.full((*alone.valid.shape, 3), np.nan, dtype=np.float32)
    alone = replace(alone, perturbed=np.zeros(alone.valid.shape, dtype=np.int8), causal_shift_m=unknown)
    branch, twin = _with_twin(alone, found, before, has_ego=True)
    assert branch.ids.tolist() == twin.ids.tolist() == [0, 7, 8, 9]
    assert branch.valid.sum(0).tolist() == [6, 6, 6, 0] and twin.valid.sum(0).tolist() == [6, 3, 6, 4]


def test_twins_need_branches(tmp_path: Path):
    with pytest.raises(UserError, match="twins needs branches above 0, got 0; pass --branches 4"):
        CollectConfig(TAG, tmp_path / "s", 2, ("idle",), twins=True)


def test_at_the_moment_one_agent_is_slower_faster_or_gone(branches: list[Episode]):
    for branch in branches:
        step, agent = moment_of(branch)
        kind = PERTURBATIONS[branch.perturbed[step, agent]]  # type: ignore[index]
        if kind == "remove":
            assert branch.valid[step, agent] and not branch.valid[step + 1 :, agent].any()
            continue
        before, now = (np.linalg.norm(branch.states[t, agent, 2:]) for t in (step, step + 1))
        assert (now - before) * {"brake": -1, "accelerate": 1}[kind] > 1.0


def test_labels_are_of_the_perturbed_agent_alone(branches: list[Episode]):
    for branch in branches:
        step, agent = moment_of(branch)
        shift_m = branch.causal_shift_m
        assert shift_m is not None
        known = ~np.isnan(shift_m)
        assert known[step, :, agent].any() and known[step + 1, :, agent].any()
        assert known.sum() == known[step : step + 2, :, agent].sum()
        assert not known[:, 0].any() and not known[:, agent, agent].any()


@pytest.mark.slow
def test_the_moments_are_spread_over_the_episode():
    world = open_world("simple_spread_v3", "idle")
    drawn = [step for seed in range(20) for step, _ in _play(world, seed, 25, 3, np.random.default_rng(seed))[1]]
    assert len(drawn) == 60 and min(drawn) >= 1 and max(drawn) < 25
    counts, _ = np.histogram(drawn, [1, 9, 17, 25])
    assert min(counts) > 8


def test_no_window_has_an_intervention_that_nobody_could_foresee():
    world = open_world(TAG, "idle")
    found = record_branches(world, 0, "idle", 25, IN_ARENA)
    windows = Windows(found, world.spec, 3, 2)
    for episode, now in windows.index:
        step, _ = moment_of(found[episode])
        assert now > step or now + 2 <= step
    assert any(now == moment_of(found[episode])[0] + 1 for episode, now in windows.index)
    undisturbed = [replace(e, perturbed=None) for e in found]
    assert len(Windows(undisturbed, world.spec, 3, 2)) > len(windows)


@pytest.mark.slow
@pytest.mark.parametrize(("env_id", "settings"), [(ROAD, ON_ROAD), (TAG, IN_ARENA)])
def test_who_is_taken_out_stays_away(env_id: str, settings: BranchRecording):
    """To the last step: mpe2 puts an agent back within the step in which its absence ends."""
    world = open_world(env_id, "varied")
    removed = 0
    for seed in range(12):
        for episode in record_branches(world, seed, "varied", 12, settings):
            step, column = moment_of(episode)
            if PERTURBATIONS[episode.perturbed[step, column]] == "remove":
                assert not episode.valid[step + 1 :, column].any()
                removed += 1
    assert removed >= 3


@pytest.mark.slow
def test_who_has_just_appeared_is_not_perturbed():
    """On the intersection vehicles appear all the time: one that was never seen could not be missed."""
    world = open_world(ROAD, "idle")
    world.reset(5)
    now = world.full_scene()
    near = senders_of(world, ON_ROAD.causal)
    assert len(near) == 4
    for agent in near:
        before = replace(now, valid=now.ids == agent)
        (branch,) = _branch(world, [before], ON_ROAD, np.random.default_rng(agent))
        assert branch.ids[moment_of(branch)[1]] == agent
    nobody = replace(now, valid=np.zeros_like(now.valid))
    assert _branch(world, [nobody], ON_ROAD, np.random.default_rng(0)) == []


def test_a_simulator_that_fails_in_a_branch_is_no_agent_that_allows_nothing(monkeypatch: pytest.MonkeyPatch):
    def fails(point: BranchPoint, intervention: Intervention) -> Branches:
        raise EnvironmentFailedError("it raised")

    monkeypatch.setattr(BranchPoint, "perturbed", fails)
    with pytest.raises(EnvironmentFailedError, match="it raised"):
        _perturbed(BranchPoint.__new__(BranchPoint), 1, 20.0, 3, ROAD_MIX, np.random.default_rng(0))


def test_who_stands_does_not_brake(monkeypatch: pytest.MonkeyPatch):
    def tried(speed_mps: float) -> set[str]:
        kinds: set[str] = set()

        def refuses(point: BranchPoint, intervention: Intervention) -> Branches:
            kinds.add(intervention.kind)
            raise NotAllowedError("not this one")

        monkeypatch.setattr(BranchPoint, "perturbed", refuses)
        for seed in range(9):
            rng = np.random.default_rng(seed)
            assert _perturbed(BranchPoint.__new__(BranchPoint), 1, speed_mps, 3, ROAD_MIX, rng) is None
        return kinds

    assert tried(0.4) == {"accelerate", "remove"} and tried(0.6) == {"brake", "accelerate", "remove"}


@pytest.mark.parametrize("gives", [(True, False, False), (True, True, False)])
def test_the_last_intervention_that_is_possible_is_kept(monkeypatch: pytest.MonkeyPatch, gives: tuple[bool, ...]):
    """Also where none of them moves anybody but the one that is perturbed, and later ones are not possible."""
    world = open_world(ROAD, "idle")
    world.reset(5)
    played, found, possible = branch_recording._perturbed, [], iter(gives)

    def perturbed(*arguments: Any) -> Any:
        found.append(played(*arguments) if next(possible) else None)
        return found[-1]

    monkeypatch.setattr(branch_recording, "_perturbed", perturbed)

    def itself_alone_m(branches: Branches, *_: Any) -> Any:
        return np.where(branches.ids == branches.intervention.agent, 9.0, 0.0)

    monkeypatch.setattr(branch_recording, "farthest", itself_alone_m)
    (branch,) = _branch(world, [world.full_scene()], ON_ROAD, np.random.default_rng(0))
    last = [one for one in found if one is not None][-1]
    assert len(found) == 3 and branch.ids[moment_of(branch)[1]] == last.intervention.agent


@pytest.mark.slow
def test_branches_are_a_function_of_the_seed(branches: list[Episode]):
    again = record_branches(open_world(ROAD, "idle"), 5, "idle", 9, ON_ROAD)
    for one, other in zip(branches, again, strict=True):
        np.testing.assert_array_equal(one.states, other.states)
        np.testing.assert_array_equal(one.causal_shift_m, other.causal_shift_m)


@pytest.mark.slow
def test_collected_branches_come_in_the_order_of_their_seeds(tmp_path):
    config = CollectConfig(TAG, tmp_path / "s", 2, ("idle",), seed=3, max_steps=6, workers=1, branches=2)
    assert [e.seed for e in collect(config)] == [3, 3, 4, 4]


def test_branches_go_with_no_other_disturbance(tmp_path):
    with pytest.raises(UserError, match="branches are of undisturbed episodes"):
        CollectConfig(ROAD, tmp_path / "s", branches=2, perturb=0.2)


def test_the_ego_is_drawn_more_often_than_others():
    rng = np.random.default_rng(0)
    drawn = [_sender([4, 0, 5, 6, 7, 8], 0, rng) for _ in range(1000)]
    assert 250 < drawn.count(0) < 350 and min(drawn.count(agent) for agent in (4, 5, 6, 7, 8)) > 100
    assert {_sender([0], 0, rng) for _ in range(5)} == {0}
    assert {_sender([3], None, rng) for _ in range(5)} == {3}
    assert 0 not in {_sender([3, 4], 0, rng) for _ in range(50)}  # it is under an intervention already
