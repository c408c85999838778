"""What somebody foresees who knows the drivers (`envs.rollouts.foreseen`)."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from envs.readers.function import FunctionReader
from envs.registry import make_env
from envs.rollouts import foreseen
from envs.rollouts.branches import Branches, BranchPoint, branch
from envs.rollouts.foreseen import check_can_foresee, foreseen_risk, foreseen_shift, redrawn
from envs.rollouts.world import EgoWorld, World, open_world
from envs.simulators.interventions import Intervention
from envs.wrappers import SceneObservation
from predictor.scene import Scene, SceneSpec
from predictor.support.errors import UserError
from tests.envs.interventions import assert_same_scenes, played, road_world

STEPS = 4
OUT = Intervention(2, "remove", STEPS + 1)


def queue() -> World:
    """Three in one lane, ids 1 to 3 from the rear; none of them changes lane."""
    world = road_world((0.0, 4.0), (25.0, 4.0), (60.0, 4.0), ego_m=(-40.0, 12.0))
    world.step()
    return world


def vehicles_of(world: World) -> list[Any]:
    found: list[Any] = world.env.unwrapped.road.vehicles  # type: ignore[union-attr]
    return found


def crossing() -> World:
    world = open_world("intersection-v2", "slower")
    world.reset(4)
    for _ in range(4):
        world.step()
    return world


def test_where_nothing_is_hidden_what_happens_is_foreseen():
    """On one lane, with drivers that change none, all that is drawn is of no effect."""
    world = queue()
    true_m = branch(world, OUT, STEPS).shift_of(1)
    assert true_m is not None and np.abs(true_m).max() > 0.5
    np.testing.assert_allclose(
        foreseen_shift(world, OUT, 1, STEPS, 3, np.random.default_rng(0)), true_m, rtol=0, atol=1e-9
    )


def test_who_is_not_perceived_may_be_left_out():
    """The one in front of the queue keeps it waiting, and stands beyond what the ego perceives."""
    world = road_world((60.0, 4.0), (85.0, 4.0), (120.0, 4.0), ego_m=(0.0, 12.0))
    ahead: Any = world.env.unwrapped.road.vehicles[-1]  # type: ignore[union-attr]
    ahead.speed = ahead.target_speed = 5.0
    world.env._scene = world.reread()[0]  # type: ignore[union-attr]
    assert [3 in scene.ids[scene.valid] for scene in (world.perceived(), world.full_scene())] == [False, True]
    rng = np.random.default_rng(0)
    known, seen = (redrawn(world, rng, perceived_only) for perceived_only in (False, True))
    assert [known.full_scene().ids.tolist(), seen.full_scene().ids.tolist()] == [[0, 1, 2, 3], [0, 1, 2]]
    shifts_m = [foreseen_shift(world, OUT, 1, STEPS, 1, rng, perceived_only=only) for only in (False, True)]
    assert shifts_m[1][-1, 0] > shifts_m[0][-1, 0] + 0.5  # whoever sees nobody ahead forecasts a free road


def test_worlds_that_are_drawn_look_the_same_now_and_go_on_differently():
    world = crossing()
    rng = np.random.default_rng(0)
    others = [redrawn(world, rng) for _ in range(4)]
    for other in others:
        assert_same_scenes([other.full_scene()], [world.full_scene()])
    streams = [str([own.bit_generator.state for own in one.generators()]) for one in (world, *others)]
    assert len(set(streams)) == 5
    timers = [[one.timer for one in vehicles_of(each) if hasattr(one, "timer")] for each in (world, *others)]
    assert len({str(times) for times in timers}) == 5
    ends = {played(other, STEPS)[-1].states.tobytes() for other in others}
    assert len(ends) == len(others)


def test_the_world_itself_goes_on_as_if_nothing_had_been_drawn():
    world, untouched = crossing(), crossing()
    foreseen_shift(world, OUT, 1, STEPS, 2, np.random.default_rng(0))
    assert_same_scenes(played(world, STEPS), played(untouched, STEPS))


@pytest.mark.parametrize(("lost", "crashed"), [(True, False), (False, True)])
def test_draws_that_lose_the_agent_or_crash_it_do_not_count(monkeypatch: pytest.MonkeyPatch, lost: bool, crashed: bool):
    """Every second draw does."""
    world, drawn = queue(), list[Branches]()
    perturbed = BranchPoint.perturbed

    def spoilt(point: BranchPoint, intervention: Intervention) -> Branches:
        found = perturbed(point, intervention)
        drawn.append(found)
        if len(drawn) % 2:
            return found
        valid = found.perturbed.valid & (not lost)
        gone = frozenset({1}) if crashed else frozenset[int]()
        states = found.perturbed.states + 100.0
        return replace(found, perturbed=replace(found.perturbed, states=states, valid=valid, crashed=gone))

    monkeypatch.setattr(foreseen.BranchPoint, "perturbed", spoilt)
    shift_m = foreseen_shift(world, OUT, 1, STEPS, 4, np.random.default_rng(0))
    np.testing.assert_allclose(shift_m, drawn[0].shift_of(1), rtol=0, atol=1e-9)
    assert len(drawn) == 4


def test_a_risk_is_the_share_of_worlds_in_which_the_ego_collides():
    """The ego closes in on a queue; whether it hits it is its own choice alone, and nothing hidden."""
    world = road_world((30.0, 4.0), (60.0, 4.0), ego_m=(0.0, 4.0))
    ego: Any = world.env.unwrapped.vehicle  # type: ignore[union-attr]
    ego.speed = ego.target_speed = 30.0
    begun: list[int] = []

    def driver(action: int) -> Any:
        def make() -> Any:
            begun.append(action)
            return lambda _: action

        return make

    idle, slower = 1, 4
    risk = foreseen_risk(world, [driver(idle), driver(slower)], STEPS, 3, np.random.default_rng(0))
    assert risk.tolist() == [1.0, 0.0]
    assert begun == [idle, slower] * 3  # a driver that counts its steps begins anew in each world


def test_a_risk_between_0_and_1_is_of_what_is_hidden(monkeypatch: pytest.MonkeyPatch):
    world, played_in = crossing(), list[bool]()
    driven = BranchPoint.driven

    def hits_in_every_second_world(point: BranchPoint, driver: Any) -> Any:
        played_in.append(True)
        gone = frozenset({int(point.ids[0])}) if len(played_in) % 2 else frozenset[int]()
        return replace(driven(point, driver), crashed=gone)

    monkeypatch.setattr(BranchPoint, "driven", hits_in_every_second_world)
    risk = foreseen_risk(world, [lambda: lambda _: 1], 1, 4, np.random.default_rng(0), perceived_only=True)
    assert risk.tolist() == [0.5]


def test_without_a_draw_that_counts_nothing_is_foreseen(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(Branches, "shift_of", lambda self, agent: None)
    shift_m = foreseen_shift(queue(), OUT, 1, STEPS, 2, np.random.default_rng(0))
    np.testing.assert_array_equal(shift_m, np.zeros((STEPS, 2)))


def test_a_reader_that_finds_no_vehicle_is_refused(monkeypatch: pytest.MonkeyPatch):
    def read(env: object) -> Scene:
        return Scene(np.zeros((1, 4)), np.zeros(1, dtype=np.int64), np.ones(1, dtype=np.bool_))

    env = SceneObservation(make_env("highway-fast-v0"), reader=FunctionReader(read, SceneSpec(dt_s=1.0)))
    monkeypatch.setattr(foreseen, "open_to_look", lambda *_: EgoWorld(env, "idle"))
    with pytest.raises(UserError, match="cannot find an agent by its id"):
        check_can_foresee("highway-fast-v0", "idle")


@pytest.mark.parametrize("env_id", ["simple_tag_v3", "intersection-multi-agent-v2"])
def test_where_it_is_not_known_what_is_hidden_the_message_says_so(env_id: str):
    drivers: dict[str, Any] = {"simple_tag_v3": "heuristic"}
    with pytest.raises(UserError, match=f"hidden_draws needs .* with one ego, got '{env_id}'; set it to 0"):
        check_can_foresee(env_id, drivers.get(env_id, "idle"))
