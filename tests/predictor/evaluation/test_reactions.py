import numpy as np
import pytest

from predictor.evaluation.reactions import Shifts, false_reaction, reaction
from predictor.evaluation.standard_errors import Estimate, bootstrap_draws


def shifts(true_m: object, predicted_m: object, episode: object = None) -> Shifts:
    """Shifts along x of one step each, unless they have more axes."""
    arrays = [np.asarray(values, dtype=np.float64) for values in (true_m, predicted_m)]
    arrays = [a if a.ndim == 3 else np.stack([a, np.zeros_like(a)], axis=-1)[:, None] for a in arrays]
    count = len(arrays[0])
    return Shifts(*arrays, np.arange(count) if episode is None else np.asarray(episode))


def random_shifts(seed: int = 0, pairs: int = 30, horizon: int = 5) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(pairs, horizon, 2)).cumsum(axis=1)


def value(estimate: Estimate | None) -> float:
    assert estimate is not None
    return estimate.value


@pytest.mark.parametrize("share", [1.0, 0.5, -0.3])
def test_a_share_of_the_true_reaction_is_the_slope(share: float):
    true_m = random_shifts()
    found = reaction(shifts(true_m, share * true_m, np.arange(30) // 3))
    assert (found.pairs, found.episodes) == (30, 10)
    assert found.slope is not None and found.slope.interval == pytest.approx((share, share))
    assert value(found.slope) == pytest.approx(share)
    assert value(found.median_ratio) == pytest.approx(share)
    assert value(found.correlation) == pytest.approx(np.sign(share))
    assert value(found.correlation_of_steps) == pytest.approx(np.sign(share))
    length_m = np.linalg.norm(true_m, axis=-1).mean(axis=0)
    np.testing.assert_allclose(found.true_by_step_m, length_m)
    np.testing.assert_allclose(found.along_by_step_m, share * length_m)
    np.testing.assert_allclose(found.length_by_step_m, abs(share) * length_m)
    for last, by_step in (
        ("true_m", "true_by_step_m"),
        ("along_m", "along_by_step_m"),
        ("length_m", "length_by_step_m"),
    ):
        assert getattr(found, last) == pytest.approx(getattr(found, by_step)[-1])


def test_no_reaction_has_slope_zero_and_no_correlation():
    true_m = random_shifts()
    found = reaction(shifts(true_m, np.zeros_like(true_m)))
    assert found.slope == Estimate(0.0, (0.0, 0.0))
    assert found.correlation is None and found.correlation_of_steps is None
    assert found.along_m == found.length_m == 0.0 and found.true_m != 0.0


def test_one_long_shift_rules_the_slope_and_not_the_median_ratio():
    found = reaction(shifts([2.0, 2.0, 4.0, 4.0, 40.0, 0.5], [2.0, 1.8, 3.8, 4.0, 0.0, 9.0]))
    assert value(found.slope) < 0.05
    assert value(found.median_ratio) == pytest.approx(0.95)  # of 1, 0.9, 0.95, 1 and 0; half a metre does not count


@pytest.mark.parametrize("pairs", [40, 41])
def test_the_interval_of_the_median_ratio_is_a_bootstrap_over_episodes(pairs: int):
    rng = np.random.default_rng(4)
    episode, true_m = rng.integers(12, size=pairs), rng.uniform(2.0, 9.0, size=pairs)
    ratios = rng.normal(0.8, 0.5, size=pairs) + 0.1 * episode
    found = reaction(shifts(true_m, ratios * true_m, episode)).median_ratio
    assert found is not None and found.value == pytest.approx(np.median(ratios))
    present = np.unique(episode)
    drawn = [
        np.median(np.concatenate([np.repeat(ratios[episode == one], n) for one, n in zip(present, times, strict=True)]))
        for times in bootstrap_draws(len(present))
    ]
    assert found.interval == pytest.approx(tuple(np.percentile(drawn, [2.5, 97.5])))


def test_the_median_ratio_needs_someone_who_moves():
    assert reaction(shifts([0.9, 0.2], [0.9, 0.1])).median_ratio is None
    assert reaction(shifts([0.9, 3.0], [0.9, 1.5])).median_ratio == Estimate(0.5, None)  # one episode moves


def test_a_shift_across_the_true_one_is_no_reaction():
    true_m = random_shifts()
    across = np.stack([-true_m[..., 1], true_m[..., 0]], axis=-1)
    found = reaction(shifts(true_m, across))
    assert value(found.slope) == pytest.approx(0.0, abs=1e-12)
    assert found.along_m == pytest.approx(0.0, abs=1e-12)
    assert found.length_m == pytest.approx(found.true_m)


def test_slope_is_least_squares_and_correlation_is_pearsons():
    """Of one axis and positive true shifts, where both are the textbook's."""
    true_m, predicted_m = np.array([1.0, 2.0, 4.0, 3.0]), np.array([0.5, -1.0, 3.0, 2.0])
    found = reaction(shifts(true_m, predicted_m))
    assert value(found.slope) == pytest.approx(np.linalg.lstsq(true_m[:, None], predicted_m, rcond=None)[0][0])
    assert value(found.correlation) == pytest.approx(np.corrcoef(true_m, predicted_m)[0, 1])


def test_the_correlation_at_the_end_is_of_the_last_step():
    true_m, noise = random_shifts(1), random_shifts(2)
    predicted_m = np.concatenate([noise[:, :-1], true_m[:, -1:]], axis=1)
    found = reaction(shifts(true_m, predicted_m))
    assert value(found.correlation) == pytest.approx(1.0)
    assert value(found.correlation_of_steps) < 0.95


def test_directions_do_not_cancel():
    """One receiver is moved ahead and one back; both reactions are right."""
    found = reaction(shifts([2.0, -4.0], [1.0, -2.0]))
    assert (found.true_m, found.along_m) == (3.0, 1.5)
    assert reaction(shifts([2.0, -4.0], [-1.0, 2.0])).along_m == -1.5


def test_where_nothing_truly_moves_any_prediction_counts():
    found = reaction(shifts([0.0, 0.0], [-0.5, 1.5]))
    assert (found.true_m, found.along_m, found.length_m) == (0.0, 1.0, 1.0)
    assert found.slope is None and found.correlation is None


def test_intervals_are_over_episodes():
    """All pairs of an episode alike: of two episodes of slope 1 and 0, a quarter of the draws is either twice."""
    true_m, predicted_m = np.ones(20), np.repeat([1.0, 0.0], 10)
    both = reaction(shifts(true_m, predicted_m, np.repeat([7, 3], 10)))
    assert both.slope == Estimate(0.5, (0.0, 1.0))
    apart = reaction(shifts(true_m, predicted_m)).slope
    assert apart is not None and apart.interval is not None
    assert 0.2 < apart.interval[0] < 0.35 and 0.65 < apart.interval[1] < 0.8
    assert reaction(shifts(true_m, predicted_m, np.zeros(20, dtype=int))).slope == Estimate(0.5, None)


def test_false_reaction_is_relative_to_that_of_the_moved():
    moved = shifts([-5.0, -6.0], [-4.0, -4.0])
    unmoved = shifts([0.0, 0.0, 0.0], [0.3, -0.6, 0.3])
    assert value(false_reaction(unmoved, moved)) == pytest.approx(0.4 / 4.0)
    alike = false_reaction(shifts([0.0] * 4, [0.4] * 4), shifts([-5.0] * 4, [-4.0] * 4))
    assert alike is not None and alike.interval == pytest.approx((0.1, 0.1))


def test_what_was_not_found_has_no_numbers():
    nothing = shifts(np.zeros((0, 5, 2)), np.zeros((0, 5, 2)))
    found = reaction(nothing)
    assert (found.pairs, found.episodes, found.slope, found.true_m, found.true_by_step_m) == (0, 0, None, None, ())
    assert false_reaction(nothing, shifts(random_shifts(), random_shifts())) is None
    assert false_reaction(shifts(random_shifts(), random_shifts()), nothing) is None
    still = shifts([1.0, 2.0], [0.0, 0.0])
    assert false_reaction(still, still) is None  # a forecaster that moves none has no scale
