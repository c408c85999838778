"""Trees learn edges that the geometry of a pair tells, from the receiver's point of view, and nothing else."""

import numpy as np
import pytest

from predictor.evaluation.pair_trees import pair_features, tree_scores

NORTH, EAST = (0.0, 5.0), (5.0, 0.0)


def features(positions: list[tuple[float, ...]], velocities: list[tuple[float, ...]], valid: list[bool]) -> np.ndarray:
    """Features of the pair of the first agent, which receives, and the second."""
    states = np.concatenate([np.array(positions), np.array(velocities), np.ones((len(positions), 1))], axis=-1)
    axes = len(positions[0])
    return pair_features(states, np.array(valid), np.array([0]), np.array([1]), axes)[0]


def test_what_the_receiver_sees():
    """It drives north; the sender is 10 m ahead and 2 m to the left, and drives as fast, east."""
    found = features([(0.0, 0.0), (-2.0, 10.0)], [NORTH, EAST], [True, True])
    apart, faster, where, ahead, of_sender, seen, closing_in = np.split(found[:16], [2, 4, 6, 8, 10, 14])
    assert apart.tolist() == [-2.0, 10.0] and faster.tolist() == [5.0, -5.0] and where.tolist() == [0.0, 0.0]
    fade = 5 / np.hypot(5, 0.5)
    assert ahead == pytest.approx([0.0, fade]) and of_sender == pytest.approx([fade, 0.0])
    assert seen == pytest.approx([10 * fade, 2 * fade, -5 * fade, -5 * fade]), "along and to the left"
    assert closing_in == pytest.approx([0.0, -(fade**2)]), "the sender's heading is to the right"
    distance = np.hypot(2, 10)
    assert found[16:] == pytest.approx([distance, 60 / distance, 60 / distance**2, 5.0, 5.0, 0.0, 0.0])


@pytest.mark.parametrize(
    ("third", "there", "nearer", "between"),
    [
        ((0.0, 5.0), True, 1, 1),
        ((2.0, 5.0), True, 1, 1),
        ((3.0, 5.0), True, 1, 0),
        ((0.0, -5.0), True, 1, 0),
        ((0.0, 11.0), True, 0, 0),
        ((0.0, 5.0), False, 0, 0),
    ],
)
def test_who_else_is_there(third: tuple[float, float], there: bool, nearer: int, between: int):
    found = features([(0.0, 0.0), (0.0, 10.0), third], [NORTH, NORTH, NORTH], [True, True, there])
    assert found[-2:].tolist() == [nearer, between]


def test_agents_at_rest_and_at_one_place_have_features():
    found = features([(0.0, 0.0), (0.0, 0.0)], [(0.0, 0.0), (0.0, 0.0)], [True, True])
    assert np.isfinite(found).all()


def test_in_space_there_is_no_left():
    found = features([(0.0, 0.0, 0.0), (3.0, 0.0, 4.0)], [(5.0, 0.0, 0.0), (0.0, 0.0, 0.0)], [True, True])
    fade = 5 / np.hypot(5, 0.5)
    assert found[15] == pytest.approx(3 * fade)
    assert found[16] == pytest.approx(np.linalg.norm([3 - 3 * fade**2, 0, 4]))


def scenes(rng: np.random.Generator, number: int) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of which those are edges whose sender is in front and approaches, whichever way the receiver drives."""
    turn = rng.uniform(0, 2 * np.pi, number)
    along = np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    front = rng.uniform(-30, 30, number)
    speed, other = rng.uniform(2, 10, number), rng.uniform(2, 10, number)
    found = [
        pair_features(
            np.array([[0, 0, *(speed[i] * along[i])], [*(front[i] * along[i]), *(other[i] * along[i])]]),
            np.ones(2, dtype=np.bool_), np.array([0]), np.array([1]), 2,
        )[0]
        for i in range(number)
    ]  # fmt: skip
    return np.stack(found), (front > 0) & (other < speed)


@pytest.mark.slow
def test_trees_learn_an_edge_that_geometry_tells():
    rng = np.random.default_rng(0)
    geometry, exists = scenes(rng, 1200)
    fit = np.arange(1200) < 800
    found = tree_scores(geometry, exists, fit)
    assert found is not None and ((found[~fit] > 0.5) == exists[~fit]).mean() > 0.97
    guessed = tree_scores(geometry, rng.permutation(exists), fit)
    assert guessed is not None and ((guessed[~fit] > 0.5) == exists[~fit]).mean() < 0.85


def test_without_both_answers_there_is_nothing_to_fit():
    geometry, exists = scenes(np.random.default_rng(0), 50)
    assert tree_scores(geometry, exists, ~exists) is None
