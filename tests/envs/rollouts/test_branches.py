import numpy as np
import pytest

from envs.rollouts import branches as rollout_branches
from envs.rollouts.branches import BranchPoint, branch, copied
from envs.rollouts.interventions import intervene
from envs.rollouts.world import World, open_world
from envs.simulators.interventions import Intervention, Kind
from predictor.support.errors import UserError
from tests.envs.interventions import assert_same_scenes, played, road_world, state_of

CARS = ((0.0, 4.0), (40.0, 4.0), (80.0, 4.0), (40.0, 12.0))
"""Three in a row, ids 1 to 3, and one two lanes away, id 4."""
WORLDS = [
    ("highway-fast-v0", "varied"),
    ("intersection-v2", "random"),
    ("roundabout-mixed-v0", "varied"),
    ("racetrack-v1", "keep-lane"),
    ("highway-fast-v0", "planner:constant-velocity"),
    ("highway-fast-v0", "own:tests.envs.own_code:wavers"),
    ("simple_tag_v3", "mixed"),
    ("simple_tag_v3", "own:tests.envs.own_code:shoves"),
    ("simple_spread_v3", "heuristic"),
    ("intersection-multi-agent-v2", "varied"),
]


def test_a_follower_is_held_back_and_no_one_else():
    found = branch(road_world(*CARS), Intervention(2, "brake", 4, change_mps=8.0), 4)
    shift, valid = found.shift()
    assert found.ids.tolist() == [0, 1, 2, 3, 4] and valid.all() and shift.shape == (5, 5, 2)
    assert (shift[0] == 0).all()
    assert shift[4, 2, 0] < -15.0
    assert shift[4, 1, 0] < -4.0
    assert np.abs(shift[:, [0, 3, 4]]).max() < 1e-9


def test_what_never_acts_cannot_be_the_receiver_of_a_direct_effect():
    """A landmark of mpe2."""
    world = open_world("simple_tag_v3", "idle")
    world.reset(0)
    point = BranchPoint(world, 2)
    with pytest.raises(UserError, match="only agents that act can be free of a log, got landmark 0"):
        point.direct(Intervention(1, "brake", 1, change_mps=1.0), 4)


def test_a_measurement_at_once_starts_from_the_slower_scene():
    world = road_world(*CARS, ego_m=(0.0, 12.0))
    found = branch(world, Intervention(2, "brake", 0, change_mps=8.0, at_once=True), 5)
    assert found.plain.states[0, 2, 2] == 20.0 and found.perturbed.states[0, 2, 2] == 12.0
    assert state_of(found.perturbed.perceived[0], 2)[2] == 12.0
    shift, _ = found.shift()
    assert shift[5, 1, 0] < -2.0 and abs(shift[5, 3, 0]) < 1e-9


@pytest.mark.parametrize("kind", ["brake", "remove"])
def test_what_reaches_an_agent_through_another_is_not_direct(kind: Kind):
    """Three in a row: what the first does reaches the last through the middle one."""
    point = BranchPoint(road_world((0.0, 4.0), (25.0, 4.0), (50.0, 4.0)), 5)
    first = Intervention(3, kind, 5)
    whole, _ = point.perturbed(first).shift()
    assert abs(whole[5, 1, 0]) > 0.3 and abs(whole[5, 2, 0]) > 1.0
    last, _ = point.direct(first, 1).shift()
    assert np.abs(last[:, [0, 1, 2]]).max() < 1e-9
    middle, _ = point.direct(first, 2).shift()
    assert np.abs(middle[:, [0, 1]]).max() < 1e-9
    assert middle[5, 2, 0] == pytest.approx(whole[5, 2, 0])


@pytest.mark.slow
@pytest.mark.parametrize(("env_id", "seed"), [("intersection-v2", 900_006), ("intersection-multi-agent-v2", 900_003)])
def test_an_intervention_that_does_nothing_moves_no_one_directly(env_id: str, seed: int):
    """Vehicles that are held lead the others to foresee the same of them as without it: their routes go on."""
    world = open_world(env_id, "varied")
    world.reset(seed)
    farthest = []
    for _ in range(4):
        played(world, 2)
        point = BranchPoint(world, 3)
        others = [int(agent) for agent in point.ids if not world.spec.has_ego or agent != point.ids[0]]
        for sender, receiver in zip(others[:6], others[1:7], strict=False):
            nothing = Intervention(sender, "brake", 0, change_mps=1e-12, at_once=True)
            farthest.append(np.abs(point.direct(nothing, receiver).shift()[0]).max())
    assert len(farthest) > 10 and max(farthest) < 1e-5


def test_in_an_arena_others_are_held_too():
    world = open_world("simple_tag_v3", "heuristic")
    world.reset(2)
    played(world, 4)
    point = BranchPoint(world, 8)
    gone = Intervention(3, "remove", 9)
    alone, valid = point.direct(gone, 0).shift()
    whole, _ = point.perturbed(gone).shift()
    assert valid[:, :3].all() and not valid[:, 3].any()
    assert np.abs(alone[:, 1:]).max() < 1e-9 < 0.05 < np.abs(alone[:, 0]).max()
    assert np.abs(whole[:, 1]).max() > 0.05


def test_an_agent_that_is_taken_out_has_no_shift():
    found = branch(road_world(*CARS), Intervention(2, "remove", 4), 4)
    shift, valid = found.shift()
    assert not valid[:, 2].any() and (shift[:, 2] == 0).all()
    assert found.plain.valid.all() and valid[:, [0, 1, 3, 4]].all()


@pytest.mark.slow
@pytest.mark.parametrize(("env_id", "driver"), WORLDS)
@pytest.mark.filterwarnings("ignore:step.. of env .* after an episode's end")
def test_the_original_continues_as_if_it_was_never_copied(env_id: str, driver: str):
    world, untouched = (open_world(env_id, driver) for _ in range(2))
    for one in (world, untouched):
        one.reset(7)
        played(one, 2)
    agent = int(world.full_scene().ids[1])
    branch(world, Intervention(agent, "brake", 2), 3)
    assert_same_scenes([world.full_scene(), *played(world, 5)], [untouched.full_scene(), *played(untouched, 5)])


@pytest.mark.slow
@pytest.mark.parametrize(("env_id", "driver"), WORLDS)
@pytest.mark.filterwarnings("ignore:step.. of env .* after an episode's end")
def test_the_plain_branch_is_what_then_happens(env_id: str, driver: str):
    world = open_world(env_id, driver)
    world.reset(11)
    played(world, 2)
    agent = int(world.full_scene().ids[1])
    first, second = (branch(world, Intervention(agent, "brake", 2), 4) for _ in range(2))
    np.testing.assert_array_equal(first.perturbed.states, second.perturbed.states)
    assert not np.array_equal(first.perturbed.states, first.plain.states)
    for step, scene in enumerate([world.full_scene(), *played(world, 4)]):
        for agent, state in zip(scene.ids, scene.states, strict=True):
            if agent in first.ids and first.plain.valid[step, first.ids.tolist().index(agent)]:
                np.testing.assert_array_equal(first.plain.states[step, first.ids.tolist().index(agent)], state)


def test_both_branches_draw_the_same_noise(monkeypatch: pytest.MonkeyPatch):
    """Also where the intervention makes the simulator or a driver draw more often."""

    def intervene_and_draw(world: World, intervention: Intervention) -> None:
        intervene(world, intervention)
        for generator in world.generators():
            generator.random(7)

    monkeypatch.setattr(rollout_branches, "intervene", intervene_and_draw)
    world = open_world("highway-fast-v0", "random")
    world.reset(4)
    assert len(world.generators()) == 2
    farthest = int(world.full_scene().states[:, 0].argmax())
    found = branch(world, Intervention(farthest, "brake", 4), 4)
    shift, _ = found.shift()
    assert np.abs(shift[4, farthest]).max() > 1.0
    np.testing.assert_array_equal(found.perturbed.states[:, 0], found.plain.states[:, 0])


def test_a_world_under_an_intervention_can_branch():
    world = road_world(*CARS)
    intervene(world, Intervention(3, "brake", 9, change_mps=8.0))
    played(world, 1)
    found = branch(world, Intervention(2, "brake", 3), 3)
    scenes = played(world, 3)
    np.testing.assert_array_equal(found.plain.states[3], scenes[-1].states)
    with pytest.raises(UserError, match="agent 3 is under an intervention already"):
        branch(world, Intervention(3, "brake", 3), 3)


def test_copies_share_the_road_network_alone():
    world = open_world("highway-fast-v0", "idle")
    world.reset(0)
    other = copied(world)
    ours, theirs = world.env.unwrapped.road, other.env.unwrapped.road
    assert ours.network is theirs.network
    assert not set(map(id, ours.vehicles)) & set(map(id, theirs.vehicles))


def test_branches_end_where_the_environment_cannot_go_on():
    world = open_world("simple_tag_v3", "idle")
    world.reset(0)
    played(world, 23)
    found = branch(world, Intervention(0, "brake", 1), 5)
    assert found.plain.valid.all(1).tolist() == [True, True, True, False, False, False]
    assert len(found.plain.perceived) == 3
    with pytest.raises(UserError, match="horizon_steps must be at least 1, got 0"):
        branch(world, Intervention(0, "brake", 1), 0)


def test_a_running_envpool_environment_cannot_branch():
    pytest.importorskip("envpool")
    world = open_world("envpool/HighwayFast-v0", "idle")
    world.reset(0)
    with pytest.raises(UserError, match="EnvPoolEnv cannot be perturbed"):
        branch(world, Intervention(1, "brake", 1), 2)
    with pytest.raises(UserError, match="EnvPoolEnv cannot be perturbed"):
        intervene(world, Intervention(1, "brake", 1))
