from itertools import permutations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from envs.readers.identity import IdentityTracker, best_pairs
from predictor.support.errors import UserError

DT_S = 0.5


def random_costs(seed: int, rows: int, columns: int, ties: bool) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.integers(0, 4, (rows, columns)).astype(np.float64) if ties else rng.random((rows, columns)) * 10


def cheapest(cost: np.ndarray) -> float:
    """Every assignment of rows to columns, tried out."""
    rows, columns = cost.shape
    return min(sum(cost[i, j] for i, j in enumerate(chosen)) for chosen in permutations(range(columns), rows))


def largest_gain(cost: np.ndarray, gate: float) -> float:
    """The same for pairings that may leave anybody out: a pair beyond the gate brings nothing."""
    if cost.shape[0] > cost.shape[1]:
        cost = cost.T
    return gate * cost.shape[0] - cheapest(np.minimum(cost, gate))


# --- The assignment ---------------------------------------------------------------------------------------------------


def test_on_a_line_the_best_pairing_keeps_the_order():
    rng = np.random.default_rng(0)
    for agents in (10, 40):
        first, second = rng.random(agents), rng.random(agents)
        wanted = np.empty(agents, dtype=np.int64)
        wanted[np.argsort(first)] = np.argsort(second)
        rows, columns = best_pairs((first[:, None] - second) ** 2, 2.0)
        np.testing.assert_array_equal(columns[np.argsort(rows)], wanted)


@given(st.integers(0, 10_000), st.integers(1, 4), st.integers(1, 4), st.booleans(), st.sampled_from([0.5, 2.0, 5.0]))
def test_no_pairing_gains_more(seed: int, rows: int, columns: int, ties: bool, gate: float):
    cost = random_costs(seed, rows, columns, ties)
    cost[np.random.default_rng(seed).random(cost.shape) < 0.2] = np.inf
    chosen_rows, chosen = best_pairs(cost, gate)
    assert len(set(chosen.tolist())) == len(chosen) == len(set(chosen_rows.tolist()))
    assert (cost[chosen_rows, chosen] < gate).all()
    gain = gate * len(chosen) - cost[chosen_rows, chosen].sum()
    assert gain == pytest.approx(largest_gain(cost, gate), abs=1e-9)


def test_a_pair_at_the_gate_is_none():
    for cost, pairs in ((1.999, 1), (2.0, 0)):
        assert len(best_pairs(np.array([[cost]]), 2.0)[0]) == pairs


def test_a_pair_beyond_the_gate_does_not_decide_who_else_is_paired():
    rows, columns = best_pairs(np.array([[0.0, 1.9], [1.0, 100.0]]), 2.0)
    assert rows.tolist() == columns.tolist() == [0]  # the dearer two pairs gain 1.1, this one 2


def test_first_choices_need_no_search(monkeypatch: pytest.MonkeyPatch):
    """One leaves or one enters: still everybody's nearest is the answer."""
    monkeypatch.setattr("scipy.optimize.linear_sum_assignment", None)
    cost = np.abs(np.arange(6.0)[:, None] * 3 - np.arange(6.0) * 3 - 0.5)
    for part in (cost, cost[:, 1:], cost[1:]):
        rows, columns = best_pairs(part, 10.0)
        assert len(rows) == min(part.shape)


# --- The tracker ------------------------------------------------------------------------------------------------------


def crowd(seed: int, agents: int, steps: int, dt_s: float = DT_S) -> tuple[np.ndarray, np.ndarray]:
    """Positions and velocities (steps, agents, 2) of walkers with constant accelerations of up to 1 m/s²."""
    rng = np.random.default_rng(seed)
    start, speed = rng.uniform(-10, 10, (agents, 2)), rng.normal(0, 1.5, (agents, 2))
    acceleration = rng.uniform(-1, 1, (agents, 2))
    t_s = np.arange(steps)[:, None, None] * dt_s
    return start + speed * t_s + acceleration * t_s**2 / 2, speed + acceleration * t_s


@given(st.integers(0, 1000))
def test_numbers_stay_in_any_order_of_agents(seed: int):
    rng = np.random.default_rng(seed)
    positions, velocities = crowd(seed, agents=12, steps=8)
    tracker = IdentityTracker(DT_S, gate_m=3.0)
    for step, (place, motion) in enumerate(zip(positions, velocities, strict=True)):
        order = rng.permutation(12)
        ids = tracker.update(place[order], motion[order])
        if step == 0:
            name = ids[np.argsort(order)]
        np.testing.assert_array_equal(ids, name[order])
    assert sorted(name.tolist()) == list(range(12))


def test_mean_velocity_tells_apart_what_the_last_velocity_confuses():
    """One brakes to a halt and one starts off; each ends nearer to where the other's last velocity would have led."""
    tracker = IdentityTracker(dt_s=1.0, gate_m=10.0)
    ids = tracker.update(np.array([[0.0, 0.0], [2.0, 0.0]]), np.array([[6.0, 0.0], [0.0, 0.0]]))
    after, speeds = np.array([[3.0, 0.0], [5.0, 0.0]]), np.array([[0.0, 0.0], [6.0, 0.0]])
    straight = np.array([[6.0, 0.0], [2.0, 0.0]])
    errors = np.linalg.norm(after[:, None] - straight, axis=-1)
    assert errors[0, 1] + errors[1, 0] < errors[0, 0] + errors[1, 1]  # what position + velocity · dt would choose
    np.testing.assert_array_equal(tracker.update(after, speeds), ids)


def test_a_reversal_is_not_free():
    """Where two drive through each other, mean velocities alone would also fit two that turn round on the spot."""
    tracker = IdentityTracker(dt_s=1.0, gate_m=15.0)
    place, motion = np.array([[0.0, 0.0], [10.0, 0.0]]), np.array([[10.0, 0.0], [-10.0, 0.0]])
    first = tracker.update(place, motion)
    np.testing.assert_array_equal(tracker.update(place[::-1].copy(), motion), first)
    np.testing.assert_array_equal(tracker.update(place, motion[::-1].copy()), first[::-1])


def test_two_that_claim_the_same_place_are_settled_for_all():
    """The nearest pair is not part of the best pairing."""
    tracker = IdentityTracker(dt_s=1.0, gate_m=6.5)
    still = np.zeros((2, 2))
    tracker.update(np.array([[0.0, 0.0], [2.0, 0.0]]), still)
    assert tracker.update(np.array([[1.9, 0.0], [6.0, 0.0]]), still).tolist() == [0, 1]


def test_beyond_the_gate_is_a_newcomer():
    for step_m, known in ((0.99, True), (1.0, False)):
        tracker = IdentityTracker(dt_s=1.0, gate_m=1.0)
        tracker.update(np.zeros((1, 2)), np.zeros((1, 2)))
        assert tracker.update(np.array([[step_m, 0.0]]), np.zeros((1, 2))).tolist() == [0 if known else 1]


def test_keys_must_match():
    tracker = IdentityTracker(dt_s=1.0, gate_m=5.0)
    still, place = np.zeros((2, 2)), np.array([[0.0, 0.0], [3.0, 0.0]])
    kinds = np.array(["car", "bus"])
    assert tracker.update(place, still, keys=kinds).tolist() == [0, 1]
    assert tracker.update(place, still, keys=kinds[::-1]).tolist() == [1, 0]
    several = np.array([[1, 7], [1, 8]])
    tracker.reset()
    assert tracker.update(place, still, keys=several).tolist() == [0, 1]
    assert tracker.update(place, still, keys=several + [[0, 0], [0, 1]]).tolist() == [0, 2]


def test_entries_that_are_not_valid_are_no_agents():
    tracker = IdentityTracker(dt_s=1.0, gate_m=1.0)
    place, still = np.array([[0.0, 0.0], [np.nan, 0.0], [9.0, 0.0]]), np.zeros((3, 2))
    assert tracker.update(place, still, np.array([True, False, True])).tolist() == [0, -1, 1]
    assert tracker.update(place[[1, 2, 0]], still, np.array([False, True, True])).tolist() == [-1, 1, 0]
    assert tracker.update(np.zeros((0, 2)), np.zeros((0, 2))).tolist() == []
    assert tracker.update(place[:1], still[:1]).tolist() == [2]
    for keys in (np.zeros(0), np.zeros((0, 3))):
        tracker.reset()
        assert tracker.update(np.zeros((0, 2)), np.zeros((0, 2)), keys=keys).tolist() == []


@pytest.mark.parametrize(("memory_steps", "hidden_steps", "known"), [(0, 1, False), (2, 2, True), (2, 3, False)])
def test_memory_bridges_steps_out_of_sight(memory_steps: int, hidden_steps: int, known: bool):
    tracker = IdentityTracker(dt_s=1.0, gate_m=1.0, memory_steps=memory_steps)
    place, motion = np.array([[0.0, 0.0], [0.0, 50.0]]), np.array([[4.0, 0.0], [4.0, 0.0]])
    tracker.update(place, motion)
    for step in range(1, hidden_steps + 1):
        assert tracker.update(place[1:] + motion[1:] * step, motion[1:]).tolist() == [1]
    ids = tracker.update(place + motion * (hidden_steps + 1), motion)
    assert ids.tolist() == ([0, 1] if known else [2, 1])


def test_reset_forgets():
    tracker = IdentityTracker(dt_s=1.0, gate_m=100.0)
    place, still = np.array([[0.0, 0.0], [9.0, 0.0]]), np.zeros((2, 2))
    tracker.update(place, still)
    tracker.update(place[1:], still[1:])
    tracker.reset()
    assert tracker.update(place, still).tolist() == [0, 1]


def test_three_axes():
    """Only the third axis tells them apart."""
    tracker = IdentityTracker(DT_S, gate_m=2.0)
    place, climb = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 3.0]]), np.array([[0.0, 0.0, 2.0], [0.0, 0.0, -2.0]])
    tracker.update(place, climb)
    assert tracker.update((place + climb * DT_S)[::-1].copy(), climb[::-1].copy()).tolist() == [1, 0]


@pytest.mark.parametrize(("dt_s", "gate_m", "memory"), [(0.0, 1.0, 0), (1.0, 0.0, 0), (1.0, np.inf, 0), (1.0, 1.0, -1)])
def test_impossible_settings_are_named(dt_s: float, gate_m: float, memory: int):
    with pytest.raises(UserError, match=f"positive dt_s and gate_m .* got {dt_s}, {gate_m}, {memory}"):
        IdentityTracker(dt_s, gate_m, memory)


def test_what_does_not_fit_is_named():
    tracker = IdentityTracker(dt_s=1.0, gate_m=1.0)
    flat, high = np.zeros((2, 2)), np.zeros((2, 3))
    with pytest.raises(UserError, match="finite positions and velocities"):
        tracker.update(flat * np.nan, flat)
    tracker.update(flat, flat)
    with pytest.raises(UserError, match="same axes and keys at every step, got 3 and 0 after 2 and 0"):
        tracker.update(high, high)
    with pytest.raises(UserError, match="got 2 and 1 after 2 and 0"):
        tracker.update(flat, flat, keys=np.zeros(2))
