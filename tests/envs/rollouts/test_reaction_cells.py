from types import SimpleNamespace

import numpy as np
import pytest
from highway_env.road.lane import StraightLane

from envs.rollouts import reaction_cells
from envs.rollouts.interventions import intervene
from envs.rollouts.reaction_cells import (
    BYSTANDER_CELL,
    ELSEWHERE,
    LEADER_CELL,
    NEAR_CELL,
    ON_LANES,
    STILL_CELL,
    Cell,
    cells_of,
    is_moved_as_asked,
    pairs_of,
)
from envs.rollouts.world import EgoWorld, World, open_world
from envs.simulators.interventions import Intervention
from tests.envs.interventions import played, road_world

_, SLIGHT, EGO, _, GONE = ON_LANES


def seen_world(*others_m: tuple[float, float], ego_m: tuple[float, float], speed_mps: float = 20.0) -> EgoWorld:
    """Returns a world whose forecasters see the vehicles where they were put."""
    world = road_world(*others_m, ego_m=ego_m, speed_mps=speed_mps)
    world.env._scene = world.reread()[0]  # type: ignore[union-attr]
    return world


def test_roads_with_an_ego_have_lanes_and_leaders():
    assert cells_of(open_world("two-way-v0", "idle")) == ON_LANES
    assert cells_of(open_world("intersection-multi-agent-v2", "idle")) == ELSEWHERE
    assert cells_of(open_world("simple_spread_v3", "heuristic")) == ELSEWHERE


def test_pairs_are_by_who_follows_whom():
    """Three in a row, ids 1 to 3 from the rear, one beside them (4), and the ego (0) behind that one."""
    world = seen_world((0.0, 4.0), (25.0, 4.0), (50.0, 4.0), (25.0, 12.0), ego_m=(0.0, 12.0))
    for cell in (LEADER_CELL, SLIGHT):
        assert set(pairs_of(cell, world)) == {(1, 2), (2, 3)}
    assert pairs_of(EGO, world) == []
    assert set(pairs_of(BYSTANDER_CELL, world)) == {(1, 4), (2, 4), (3, 4), (4, 1), (4, 2), (4, 3)}
    assert set(pairs_of(GONE, world)) == {(r, s) for r in range(1, 5) for s in range(1, 5) if r != s}


def test_a_later_stretch_of_the_same_lane_is_not_another_lane(monkeypatch: pytest.MonkeyPatch):
    """Where a road is made of stretches, a lane's number changes from one to the next."""
    bodies = {
        0: SimpleNamespace(lane=StraightLane(np.array([0.0, 0.0]), np.array([100.0, 0.0])), lane_index=("a", "b", 0)),
        1: SimpleNamespace(position=np.array([120.0, 0.5]), lane_index=("b", "c", 0)),
        2: SimpleNamespace(position=np.array([120.0, 4.0]), lane_index=("b", "c", 1)),
        3: SimpleNamespace(position=np.array([50.0, 2.5]), lane_index=("a", "b", 0)),
    }
    monkeypatch.setattr(reaction_cells, "body_of", lambda world, agent: bodies[agent])
    world = open_world("two-way-v0", "idle")
    assert [reaction_cells._is_on_another_lane(world, (0, sender)) for sender in (1, 2, 3)] == [False, True, False]


def test_the_ego_leads_and_is_no_receiver():
    world = seen_world((0.0, 4.0), (60.0, 4.0), ego_m=(30.0, 4.0))
    assert pairs_of(EGO, world) == [(1, 0)]
    assert pairs_of(LEADER_CELL, world) == []


def test_neither_far_ones_nor_slow_ones_nor_unseen_ones_brake():
    places = (0.0, 4.0), (59.0, 4.0), (0.0, 12.0), (61.0, 12.0)
    assert pairs_of(LEADER_CELL, seen_world(*places, ego_m=(30.0, 8.0))) == [(1, 2)]
    slow = seen_world(*places, ego_m=(30.0, 8.0), speed_mps=3.9)
    assert pairs_of(LEADER_CELL, slow) == [] != pairs_of(SLIGHT, slow)
    assert pairs_of(GONE, slow) != []
    assert pairs_of(LEADER_CELL, seen_world(*places, ego_m=(-150.0, 8.0))) == []


def test_who_is_perturbed_already_is_left_alone():
    world = seen_world((0.0, 4.0), (25.0, 4.0), ego_m=(0.0, 12.0))
    assert pairs_of(LEADER_CELL, world) == [(1, 2)]
    intervene(world, Intervention(2, "brake", 3))
    assert pairs_of(LEADER_CELL, world) == []


def test_in_an_arena_all_agents_but_obstacles_are_tried():
    world = open_world("simple_tag_v3", "heuristic")
    world.reset(2)
    played(world, 3)
    found = set(pairs_of(NEAR_CELL, world))
    assert found and {agent for pair in found for agent in pair} <= {0, 1, 2, 3}
    positions = {int(i): s[:2] for i, s in zip(world.full_scene().ids, world.full_scene().states, strict=True)}
    for receiver in range(4):
        for sender in set(range(4)) - {receiver}:
            apart = np.linalg.norm(positions[receiver] - positions[sender])
            assert ((receiver, sender) in found) == (apart <= 1.5)


def test_who_stands_in_an_arena_does_not_brake():
    world = open_world("simple_tag_v3", "heuristic")
    world.reset(2)
    senders = {sender for _, sender in pairs_of(NEAR_CELL, world)}
    assert senders == set()  # at the start of an episode all stand
    played(world, 3)
    assert {sender for _, sender in pairs_of(NEAR_CELL, world)} == {0, 1, 2, 3}
    assert {sender for _, sender in pairs_of(ELSEWHERE[2], open_at_start())} == {0, 1, 2, 3}  # but may be taken out


def open_at_start() -> World:
    world = open_world("simple_tag_v3", "heuristic")
    world.reset(2)
    return world


def shift(length_m: float) -> np.ndarray:
    """A shift that is longest in the middle of the horizon."""
    return np.array([[0.0, 0.0], [length_m, 0.0], [0.5 * length_m, 0.0]])


@pytest.mark.parametrize(
    ("env_id", "cell", "right_m", "wrong_m"),
    [
        ("two-way-v0", GONE, 1.1, 0.9),
        ("two-way-v0", BYSTANDER_CELL, 0.09, 0.11),
        ("simple_spread_v3", NEAR_CELL, 0.06, 0.04),
        ("simple_spread_v3", STILL_CELL, 0.004, 0.006),
    ],
)
def test_a_true_shift_is_what_the_cell_asks_for(env_id: str, cell: Cell, right_m: float, wrong_m: float):
    world: World = open_world(env_id, "idle")
    assert is_moved_as_asked(cell, world, shift(right_m))
    assert not is_moved_as_asked(cell, world, shift(wrong_m))


def test_a_leader_counts_whatever_follows():
    world = open_world("two-way-v0", "idle")
    assert all(is_moved_as_asked(LEADER_CELL, world, shift(length_m)) for length_m in (0.0, 30.0))


def test_what_is_done_to_a_sender():
    assert LEADER_CELL.intervention(7, 5) == Intervention(7, "brake", 0, 8.0, at_once=True)
    assert EGO.intervention(0, 5).change_mps == 5.0
    assert GONE.intervention(7, 5) == Intervention(7, "remove", 6)
    assert NEAR_CELL.intervention(7, 5) == Intervention(7, "brake", 0, at_once=True)
