import copy

import numpy as np
import pytest

from envs.rollouts.interventions import intervene, interventions_of, kinds_of
from envs.rollouts.world import World, open_world
from envs.simulators.intervention import Intervention, Kind, NotAllowedError
from envs.simulators.mpe_interventions import AWAY_M
from tests.envs.interventions import assert_same_scenes, played, state_of

TAG = "simple_tag_v3"
HUNTER, PREY, LANDMARK = 0, 3, 4


def chase(steps: int = 4) -> World:
    world = open_world(TAG, "heuristic")
    world.reset(2)
    played(world, steps)
    return world


def speed(world: World, agent: int) -> float:
    return float(np.linalg.norm(state_of(world.full_scene(), agent)[2:4]))


def test_an_agent_brakes_to_rest_and_drives_on_afterwards():
    world = chase()
    assert speed(world, HUNTER) > 0.2
    intervene(world, Intervention(HUNTER, "brake", 6))
    played(world, 6)
    assert speed(world, HUNTER) < 1e-6
    assert interventions_of(world) == {}
    played(world, 3)
    assert speed(world, HUNTER) > 0.1


def test_an_agent_brakes_by_what_is_asked():
    world = chase()
    before = speed(world, HUNTER)
    intervene(world, Intervention(HUNTER, "brake", 3, change_mps=0.1))
    played(world, 3)
    assert speed(world, HUNTER) == pytest.approx(before - 0.1, abs=1e-6)
    once = chase()
    intervene(once, Intervention(HUNTER, "brake", 0, change_mps=0.1, at_once=True))
    assert speed_now(once, HUNTER) == pytest.approx(before - 0.1, abs=1e-6)


def speed_now(world: World, agent: int) -> float:
    _, full = world.reread()
    return float(np.linalg.norm(state_of(full, agent)[2:4]))


def test_an_agent_accelerates_along_its_way():
    world, free = chase(1), chase(1)
    before = state_of(world.full_scene(), HUNTER)[2:4]
    intervene(world, Intervention(HUNTER, "accelerate", 3, change_mps=0.3))
    played(world, 3)
    played(free, 3)
    now = state_of(world.full_scene(), HUNTER)[2:4]
    assert np.dot(now, before) > 0.999 * np.linalg.norm(now) * np.linalg.norm(before)
    assert np.linalg.norm(now) > np.linalg.norm(before) + 0.2


def test_an_agent_that_is_taken_out_comes_back_where_it_was():
    world = chase()
    before = state_of(world.full_scene(), PREY).copy()
    intervene(world, Intervention(PREY, "remove", 3))
    assert [PREY in scene.ids for scene in played(world, 3)] == [False, False, True]
    np.testing.assert_allclose(state_of(world.full_scene(), PREY), before)
    assert AWAY_M > 10.0
    assert interventions_of(world) == {}
    played(world, 1)
    assert not np.array_equal(state_of(world.full_scene(), PREY)[:2], before[:2])


def test_hunters_react_to_a_prey_that_is_taken_out():
    world, free = chase(), chase()
    intervene(world, Intervention(PREY, "remove", 5))
    gone, there = played(world, 4)[-1], played(free, 4)[-1]
    assert np.linalg.norm(state_of(gone, HUNTER)[:2] - state_of(there, HUNTER)[:2]) > 0.05


@pytest.mark.parametrize("kind", ["brake", "accelerate", "remove"])
def test_a_copy_of_a_world_under_an_intervention_continues_exactly(kind: Kind):
    world = chase()
    intervene(world, Intervention(HUNTER, kind, 4))
    played(world, 2)
    copied = copy.deepcopy(world)
    again = copy.deepcopy(copied)
    expected = played(world, 8)
    assert_same_scenes(played(copied, 8), expected)
    assert_same_scenes(played(again, 8), expected)


def test_a_reset_drops_interventions():
    world = chase()
    expected = [world.full_scene(), *played(world, 2)]
    intervene(world, Intervention(HUNTER, "remove", 20))
    played(world, 1)
    world.reset(2)
    assert interventions_of(world) == {}
    played(world, 4)
    assert_same_scenes([world.full_scene(), *played(world, 2)], expected)


@pytest.mark.parametrize(
    ("agent", "kind", "message"),
    [
        (HUNTER, "left", "mpe2's arenas have no lanes"),
        (LANDMARK, "brake", r"agent 4 \(landmark 0\) does not move by actions"),
        (77, "brake", "no agent 77 is present; present are 0, 1, 2, 3, 4, 5"),
    ],
)
def test_what_is_not_possible_is_named(agent: int, kind: Kind, message: str):
    with pytest.raises(NotAllowedError, match=f"^{message}"):
        intervene(chase(1), Intervention(agent, kind, 2))


def test_kinds_are_those_that_are_possible():
    assert kinds_of(chase(0)) == ("brake", "accelerate", "remove")
