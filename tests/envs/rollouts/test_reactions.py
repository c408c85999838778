import copy
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from envs.rollouts import branches as rollout_branches
from envs.rollouts import reactions
from envs.rollouts.branches import Branch, Branches, BranchPoint
from envs.rollouts.cause_run import FIRST_STEP
from envs.rollouts.foreseen import FORESEEN
from envs.rollouts.reaction_cells import BYSTANDER_CELL, ELSEWHERE, LEADER_CELL, NEAR_CELL, ON_LANES, Cell
from envs.rollouts.reactions import NEIGHBOURS, STRAIGHT, Moment, Perturbation, ReactionTask, play_reactions
from envs.rollouts.side_forecasts import SideForecaster, open_for_checkpoints
from envs.rollouts.world import World, open_world
from envs.simulators.interventions import Intervention
from envs.supervision import EnvironmentFailedError
from predictor.baselines.constant_velocity import ConstantVelocity
from predictor.checkpoint import CheckpointInfo, save_checkpoint
from predictor.evaluation.reactions import Reaction, Shifts, reaction
from predictor.models import build, configure
from predictor.scene import Forecast, Scene, SceneSpec
from tests.envs.evaluation import TAG, forget, save_tag
from tests.envs.helpers import HIGHWAY_SPEC
from tests.envs.interventions import assert_same_scenes, played, road_world, state_of

STEPS = 5
QUEUE = (0.0, 4.0), (25.0, 4.0), (60.0, 4.0), (20.0, 12.0)
"""Three in a row, ids 1 to 3 from the rear, and one beside them (4)."""


@pytest.fixture(autouse=True)
def nothing_is_kept() -> Iterator[None]:
    forget()
    yield
    forget()


class Shortsighted(ConstantVelocity):
    """Constant velocity of three agents within 30 m."""

    def __init__(self, spec: SceneSpec) -> None:
        super().__init__(replace(spec, perception_m=30.0, max_agents=3))


class Replay(SideForecaster):
    """Forecasts what the simulator then does, or a share of it: it looks up the branch that began with its scene."""

    def __init__(self, played: list[tuple[Branch, Any]], share: float = 1.0) -> None:
        self.played, self.share = played, share
        self.seen: list[Scene] = []

    def __deepcopy__(self, memo: Any) -> "Replay":
        twin = Replay(self.played, self.share)
        twin.seen = list(self.seen)
        return twin

    def observe(self, scene: Scene) -> None:
        self.seen.append(scene)

    def forecast(self) -> Forecast:
        scene = self.seen[-1]
        here = [(b, ids) for b, ids in self.played if self._is_here(b.perceived[0], scene)]
        plain, own = here[0], next(one for one in here if np.array_equal(one[0].perceived[0].states, scene.states))
        places = [self._future(branch, ids, scene) for branch, ids in (plain, own)]
        mixed = places[0] + self.share * (places[1] - places[0])
        xy = torch.from_numpy(mixed - scene.states[0, :2])[None, None]
        edges = torch.zeros(1, len(scene.ids), len(scene.ids), 1)
        return Forecast(xy, edges, edges, torch.from_numpy(scene.valid)[None])

    @staticmethod
    def _is_here(first: Scene, scene: Scene) -> bool:
        """Whether a branch began at this moment: some agents stand where they do now."""
        both = set(first.ids[first.valid]) & set(scene.ids[scene.valid])
        return all(np.array_equal(state_of(first, i)[:2], state_of(scene, i)[:2]) for i in both)

    @staticmethod
    def _future(branch: Branch, ids: Any, scene: Scene) -> np.ndarray:
        columns = {int(agent): i for i, agent in enumerate(ids)}
        still = np.zeros((STEPS, 2))
        return np.stack([branch.states[1:, columns[i], :2] if i in columns else still for i in scene.ids.tolist()])


@pytest.fixture
def branches(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Branch, Any]]:
    """All branches that are played from now on, with the agents of their columns."""
    logged: list[tuple[Branch, Any]] = []
    play: Callable[..., Any] = rollout_branches._play

    def play_and_log(world: World, ids: Any, *arguments: Any) -> Any:
        found = play(world, ids, *arguments)
        logged.append((found[0], ids))
        return found

    monkeypatch.setattr(rollout_branches, "_play", play_and_log)
    return logged


def moment(world: World, forecasters: dict[str, Any], steps: int = STEPS) -> Moment:
    """Lets forecasters observe the present scene of a world, and returns that moment."""
    before = copy.deepcopy(forecasters)
    for forecaster in forecasters.values():
        forecaster.observe(world.perceived())
    return Moment(world, before, forecasters, steps)


def queue() -> Any:
    world = road_world(*QUEUE, ego_m=(-40.0, 12.0))
    world.step()
    return world


def measured(moments: int, cell: Cell, make: Callable[[World], dict[str, Any]]) -> dict[str, Reaction]:
    """Reactions of forecasters over some moments of one world."""
    world = queue()
    forecasters = make(world)
    found = []
    for i in range(moments):
        one = moment(world, forecasters).perturbed(cell, np.random.default_rng(i))
        assert one is not None
        found.append(one)
        world.step()
    true_m = np.stack([one.true_m for one in found])
    return {
        name: reaction(Shifts(true_m, np.stack([one.predicted_m[name] for one in found]), np.arange(moments)))
        for name in forecasters
    }


@pytest.mark.slow
def test_an_oracle_has_slope_one_and_half_an_oracle_half(branches: list[tuple[Branch, Any]]):
    found = measured(
        3,
        LEADER_CELL,
        lambda world: {
            "oracle": Replay(branches),
            "half": Replay(branches, 0.5),
            "straight": SideForecaster(ConstantVelocity(world.spec), world.spec, STEPS),
        },
    )
    for name, slope in (("oracle", 1.0), ("half", 0.5), ("straight", 0.0)):
        assert found[name].slope is not None and found[name].slope.value == pytest.approx(slope, abs=1e-6)
        assert found[name].true_m is not None and found[name].true_m > 2.0
    for name in ("oracle", "half"):
        assert found[name].correlation is not None and found[name].correlation.value == pytest.approx(1.0)
    assert found["straight"].correlation is None


def test_both_forecasts_have_one_history_and_differ_in_the_sender_alone(branches: list[tuple[Branch, Any]]):
    shown: list[list[Scene]] = []

    class Recorder(Replay):
        def __deepcopy__(self, memo: Any) -> "Recorder":
            twin = Recorder(self.played)
            twin.seen = list(self.seen)
            return twin

        def forecast(self) -> Forecast:
            shown.append(self.seen)
            return super().forecast()

    world = queue()
    recorder = Recorder(branches)
    for _ in range(3):
        recorder.observe(world.perceived())
        world.step()
    one = moment(world, {"recorder": recorder}).perturbed(LEADER_CELL, np.random.default_rng(0))
    assert one is not None
    perturbed, plain = shown
    assert len(plain) == len(perturbed) == 4
    assert_same_scenes(plain[:-1], perturbed[:-1])
    now, instead = plain[-1], perturbed[-1]
    np.testing.assert_array_equal(now.ids, instead.ids)
    np.testing.assert_array_equal(now.states[:, :2], instead.states[:, :2])
    changed = (now.states != instead.states).any(axis=1)
    assert now.ids[changed].tolist() == [one.sender]
    slower_mps = np.linalg.norm(state_of(now, one.sender)[2:]) - np.linalg.norm(state_of(instead, one.sender)[2:])
    assert slower_mps == pytest.approx(8.0)


def test_true_shifts_are_those_of_the_simulator(branches: list[tuple[Branch, Any]]):
    world = queue()
    one = moment(world, {"oracle": Replay(branches)}).perturbed(LEADER_CELL, np.random.default_rng(0))
    assert one is not None
    ids = world.full_scene().ids.tolist()
    (plain, _), (slow, _) = branches
    column = ids.index(one.receiver)
    np.testing.assert_array_equal(one.true_m, slow.states[1:, column, :2] - plain.states[1:, column, :2])
    assert (one.receiver, one.sender) in ((1, 2), (2, 3)) and one.true_m[-1, 0] < -1.0
    np.testing.assert_allclose(one.predicted_m["oracle"], one.true_m, atol=1e-9)
    assert (one.cell, one.crashed, one.swerved) == (LEADER_CELL.name, False, False)


def test_the_world_goes_on_as_if_nothing_was_asked():
    world, untouched = queue(), queue()
    forecasters = {"straight": SideForecaster(ConstantVelocity(world.spec), world.spec, STEPS)}
    asked = moment(world, forecasters)
    found = [asked.perturbed(cell, np.random.default_rng(3)) for cell in ON_LANES]
    assert sum(one is not None for one in found) >= 3
    assert_same_scenes(played(world, 6), played(untouched, 6))


def test_a_bystander_does_not_move_and_one_taken_out_does():
    world = queue()
    asked = moment(world, {"straight": SideForecaster(ConstantVelocity(world.spec), world.spec, STEPS)})
    for seed in range(4):
        aside = asked.perturbed(BYSTANDER_CELL, np.random.default_rng(seed))
        assert aside is not None and np.abs(aside.true_m).max() < 0.1
        assert 4 in (aside.sender, aside.receiver) and 0 not in (aside.sender, aside.receiver)
        gone = asked.perturbed(ON_LANES[-1], np.random.default_rng(seed))
        assert gone is not None and np.linalg.norm(gone.true_m, axis=-1).max() > 1.0


def test_a_receiver_that_crashes_is_marked():
    """The one behind cannot stop any more; it crashes in the perturbed branch alone."""
    world = road_world((0.0, 4.0), (7.0, 4.0), ego_m=(0.0, 12.0), speed_mps=25.0)
    world.env._scene = world.reread()[0]  # type: ignore[union-attr]
    one = moment(world, {}).perturbed(LEADER_CELL, np.random.default_rng(0))
    assert one is not None and (one.receiver, one.sender, one.crashed) == (1, 2, True)


def test_a_receiver_that_crashes_without_the_intervention_is_marked():
    """Two that collide, unless one of them is taken out."""
    world = road_world((0.0, 4.0), (14.0, 4.0), ego_m=(0.0, 12.0), speed_mps=25.0)
    ahead: Any = world.env.unwrapped.road.vehicles[-1]  # type: ignore[union-attr]
    ahead.speed = ahead.target_speed = 5.0
    world.env._scene = world.reread()[0]  # type: ignore[union-attr]
    one = moment(world, {}).perturbed(ON_LANES[-1], np.random.default_rng(0))
    assert one is not None and {one.receiver, one.sender} == {1, 2} and one.crashed


def branches_of(plain: Any, perturbed: Any) -> Branches:
    """One agent's branches, from its places."""
    both = []
    for places in (plain, perturbed):
        states = np.zeros((len(places), 1, 4))
        states[:, 0, :2] = places
        both.append(Branch(states, np.ones((len(places), 1), dtype=np.bool_), ()))
    return Branches(Intervention(0, "remove", 1), np.array([7]), *both)


@pytest.mark.parametrize(
    ("plain", "perturbed", "swerved"),
    [
        ([(0, 0), (20, 0), (40, 0)], [(0, 0), (11, 0), (19, 1)], False),
        ([(0, 0), (20, 0), (40, 0)], [(0, 0), (30, 0), (60, 1)], False),  # faster, as when one is taken out
        ([(0, 0), (20, 0), (40, 0)], [(0, 0), (20, 2), (38, 4)], True),
        ([(0, 0), (20, 4), (40, 4)], [(0, 0), (15, 0), (28, 0)], True),
        ([(0, 0), (10, 10), (10, 20)], [(0, 0), (4, 4), (8, 8)], False),  # a bend
        ([(0, 0), (0, 0), (0, 0)], [(0, 0), (3, 0), (9, 0)], False),  # waits, and does not
    ],
)
def test_who_only_drives_slower_or_faster_does_not_swerve(plain: Any, perturbed: Any, swerved: bool):
    assert reactions._swerved(branches_of(plain, perturbed), 7) is swerved
    assert reactions._swerved(branches_of(perturbed, plain), 7) is swerved


def test_a_receiver_that_one_branch_loses_has_no_true_shift():
    both = branches_of([(0, 0), (20, 0), (40, 0)], [(0, 0), (15, 0), (28, 0)])
    shift_m = both.shift_of(7)
    assert shift_m is not None and shift_m.tolist() == [[-5, 0], [-12, 0]]
    both.perturbed.valid[-1] = False
    assert both.shift_of(7) is None


def test_drivers_known_stands_beside_the_forecasters_and_changes_nothing_else(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(reactions, "SHARE", 0.5)
    asked = ReactionTask(
        env_id="intersection-v2", driver="idle", checkpoints=("constant-velocity",), seed=3, max_steps=6,
        horizon_steps=3, cells=("taken out",),
    )  # fmt: skip
    without, beside = play_reactions(asked), play_reactions(replace(asked, hidden_draws=2))
    assert without and all(list(one.predicted_m) == [STRAIGHT, *FORESEEN] for one in beside)
    for one, other in zip(without, beside, strict=True):
        assert (one.step, one.sender, one.receiver) == (other.step, other.sender, other.receiver)
        np.testing.assert_array_equal(one.true_m, other.true_m)
        np.testing.assert_array_equal(one.predicted_m[STRAIGHT], other.predicted_m[STRAIGHT])
    again = play_reactions(replace(asked, hidden_draws=2))
    asked_for: list[bool] = []
    monkeypatch.setattr(
        reactions, "foreseen_shift", lambda *_, perceived_only: asked_for.append(perceived_only) or np.zeros((3, 2))
    )
    play_reactions(replace(asked, hidden_draws=2))
    assert asked_for == [False, True] * len(beside)
    for one, other in zip(again, beside, strict=True):
        for name in FORESEEN:
            np.testing.assert_array_equal(one.predicted_m[name], other.predicted_m[name])


def test_what_is_asked_uses_up_no_noise_of_the_forecasters(monkeypatch: pytest.MonkeyPatch):
    world, forecast, asked = queue(), reactions._positions, list[Any]()

    def noting(forecaster: Any) -> Any:
        asked.append(forecaster)
        return forecast(forecaster)

    monkeypatch.setattr(reactions, "_positions", noting)
    straight = SideForecaster(ConstantVelocity(world.spec), world.spec, STEPS)
    assert moment(world, {"straight": straight}).perturbed(LEADER_CELL, np.random.default_rng(0)) is not None
    assert len(asked) == 2 and straight not in asked


def test_a_moment_without_a_pair_costs_no_branch(branches: list[tuple[Branch, Any]]):
    world = road_world((0.0, 4.0), ego_m=(0.0, 12.0))
    world.step()
    asked = moment(world, {})
    assert all(asked.perturbed(cell, np.random.default_rng(0)) is None for cell in ON_LANES)
    assert branches == []


def test_a_simulator_that_fails_ends_the_measurement(monkeypatch: pytest.MonkeyPatch):
    """It is no agent that allows no intervention."""

    def fails(point: BranchPoint, intervention: Intervention) -> Branches:
        raise EnvironmentFailedError("it raised")

    monkeypatch.setattr(BranchPoint, "perturbed", fails)
    monkeypatch.setattr(reactions, "SHARE", 1.0)
    with pytest.raises(EnvironmentFailedError, match="it raised"):
        play_reactions(task(TAG, ("constant-velocity",)))


def test_no_more_is_tried_than_allowed(branches: list[tuple[Branch, Any]], monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(reactions, "is_moved_as_asked", lambda *_: False)
    monkeypatch.setattr(reactions, "MOST_BRANCHES", 2)
    assert moment(queue(), {}).perturbed(ON_LANES[-1], np.random.default_rng(0)) is None
    assert len(branches) == 1 + 2


def task(env_id: str, checkpoints: tuple[str, ...], steps: int = 3, **changes: Any) -> ReactionTask:
    names = tuple(cell.name for cell in ON_LANES + ELSEWHERE)
    driver = "heuristic" if env_id == TAG else "idle"
    settings = {"cells": names, "max_steps": 12, "seed": 900_000, "horizon_steps": steps, **changes}
    return ReactionTask(env_id=env_id, driver=driver, checkpoints=checkpoints, **settings)


def assert_equal(found: list[Perturbation], expected: list[Perturbation]) -> None:
    assert [(p.cell, p.step, p.sender, p.receiver) for p in found] == [
        (p.cell, p.step, p.sender, p.receiver) for p in expected
    ]
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one.true_m, other.true_m)
        for name, shift_m in one.predicted_m.items():
            np.testing.assert_array_equal(shift_m, other.predicted_m[name])


@pytest.mark.slow
def test_an_episode_is_a_function_of_its_seed_and_cells_are_independent(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(reactions, "SHARE", 0.5)
    checkpoint = save_tag(tmp_path / "tag")
    found = play_reactions(task(TAG, (checkpoint,)))
    assert {one.cell for one in found} == {cell.name for cell in ELSEWHERE}
    assert set(found[0].predicted_m) == {"tag", STRAIGHT}
    assert any(np.abs(one.predicted_m["tag"]).max() > 0 for one in found)
    assert all((one.predicted_m[STRAIGHT] == 0).all() for one in found)
    assert_equal(play_reactions(task(TAG, (checkpoint,))), found)
    only = play_reactions(task(TAG, (checkpoint,), cells=(NEAR_CELL.name,)))
    assert_equal(only, [one for one in found if one.cell == NEAR_CELL.name])
    assert all(one.step >= FIRST_STEP and one.seed == 900_000 and one.swerved is None for one in found)


@pytest.mark.parametrize("kind", ["lstm", "dnri"])
def test_other_models_are_measured_too(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(reactions, "SHARE", 1.0)
    changes = {"lstm": ("embed_dim=4", "rnn_dim=4", "joint=true"), "dnri": ("hidden_dim=4", "rnn_dim=4", "head_dim=4")}
    torch.manual_seed(0)
    config = configure(kind, "paper", changes[kind])
    model = build(kind, HIGHWAY_SPEC, config, 2)
    save_checkpoint(tmp_path / kind, model, CheckpointInfo(HIGHWAY_SPEC, config, 2, model=kind))
    found = play_reactions(task("two-way-v0", (str(tmp_path / kind),), 2, max_steps=5))
    assert found and set(found[0].predicted_m) == {kind, STRAIGHT}
    assert any(np.abs(one.predicted_m[kind]).max() > 1e-4 for one in found)


def test_neighbours_forecast_where_there_is_data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    from envs.collect import CollectConfig, collect
    from predictor.data.store import StoreInfo, write_store

    monkeypatch.setattr(reactions, "SHARE", 1.0)
    world = open_world(TAG, "heuristic")
    store = tmp_path / TAG
    write_store(store, StoreInfo(world.spec, TAG), list(collect(CollectConfig(TAG, store, 1, max_steps=6, workers=1))))
    found = play_reactions(task(TAG, ("constant-velocity",), 2, max_steps=5, stores=(str(store),)))
    assert found and set(found[0].predicted_m) == {NEIGHBOURS, STRAIGHT}


def test_an_ego_perceives_what_its_checkpoint_was_trained_on(highway_checkpoint: str):
    world = open_for_checkpoints("two-way-v0", "idle", (highway_checkpoint,))
    spec = world.spec
    assert (spec.perception_m, spec.max_agents) == (HIGHWAY_SPEC.perception_m, HIGHWAY_SPEC.max_agents)
    plain = open_for_checkpoints("two-way-v0", "idle", ("constant-velocity",))
    assert plain.spec.max_agents != HIGHWAY_SPEC.max_agents
    own = open_for_checkpoints("two-way-v0", "idle", ("constant-velocity", f"own:{__name__}:Shortsighted"))
    assert (own.spec.perception_m, own.spec.max_agents) == (30.0, 3)


def test_what_was_tried_is_looked_up_for_other_receivers_when_no_more_may_be_tried(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(reactions, "MOST_BRANCHES", 1)
    monkeypatch.setattr(reactions, "pairs_of", lambda *_: [(4, 2), (1, 2)])  # 4 is on another lane and does not move
    asked = moment(queue(), {})
    found = [asked.perturbed(ON_LANES[-1], np.random.default_rng(seed)) for seed in range(6)]
    assert all(one is not None and one.receiver == 1 for one in found)


def test_a_receiver_is_compared_with_itself_where_one_that_is_taken_out_leaves_a_place():
    """Agents are sorted by distance to the ego, here ahead: those behind one that is gone stand a place earlier."""
    world = road_world(*QUEUE, ego_m=(80.0, 12.0))
    world.step()
    asked = moment(world, {"straight": SideForecaster(ConstantVelocity(world.spec), world.spec, STEPS)})
    found = [asked.perturbed(ON_LANES[-1], np.random.default_rng(seed)) for seed in range(4)]
    shifts = [one.predicted_m["straight"] for one in found if one is not None]
    assert shifts and np.abs(shifts).max() < 1e-6
