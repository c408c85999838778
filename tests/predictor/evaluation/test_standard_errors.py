import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from predictor.evaluation.standard_errors import (
    Statistic,
    batch_interval,
    bootstrap_interval,
    quotient,
    ratio_statistics,
    subset_ratios,
    sums_without_each,
)


def parts(found: Statistic | None) -> tuple[float, float, int]:
    assert found is not None and found.standard_error is not None
    return found.mean, found.standard_error, found.subsets


def test_one_window_per_subset_is_the_textbook_standard_error():
    values = np.array([1.0, 2.0, 3.0, 4.0])
    found = ratio_statistics(values, np.ones(4), num_subsets=4)
    assert parts(found) == pytest.approx((2.5, np.sqrt(5 / 3) / 2, 4))


def test_each_subset_has_its_own_mean_over_valid_entries():
    sums, counts = np.array([4.0, 10.0, 12.0]), np.array([2.0, 1.0, 2.0])
    assert parts(ratio_statistics(sums, counts, num_subsets=3))[0] == pytest.approx((2 + 10 + 6) / 3)
    assert ratio_statistics(sums, counts, num_subsets=1) == Statistic(26 / 5, None, 1)


def test_root_is_taken_of_each_subset():
    found = ratio_statistics(np.array([4.0, 16.0]), np.ones(2), num_subsets=2, root=True)
    assert parts(found) == pytest.approx((3.0, 1.0, 2))


@pytest.mark.parametrize(("windows", "subsets"), [(1, 1), (19, 19), (20, 20), (21, 20), (1000, 20)])
def test_never_more_subsets_than_windows(windows: int, subsets: int):
    found = ratio_statistics(np.arange(float(windows)), np.ones(windows))
    assert found is not None and found.subsets == subsets
    assert (found.standard_error is None) == (windows == 1)


def test_subsets_without_a_valid_entry_are_left_out():
    counts = np.array([1.0, 0.0, 1.0, 0.0])
    assert ratio_statistics(np.array([1.0, 0.0, 3.0, 0.0]), counts, num_subsets=4) == Statistic(2.0, 1.0, 2)


@pytest.mark.parametrize("windows", [0, 5])
def test_nothing_valid_is_none(windows: int):
    assert ratio_statistics(np.zeros(windows), np.zeros(windows)) is None


def test_at_least_one_subset():
    with pytest.raises(ValueError, match="num_subsets must be at least 1, got 0"):
        ratio_statistics(np.zeros(3), np.ones(3), num_subsets=0)


@given(st.integers(1, 50), st.integers(1, 25), st.integers(0, 5))
def test_windows_are_dealt_evenly_and_all_of_them(windows: int, num_subsets: int, seed: int):
    # powers of two: a subset's sum says which windows it holds
    means = subset_ratios(2.0 ** np.arange(windows), np.ones(windows), num_subsets, seed)
    assert len(means) == min(windows, num_subsets)
    sizes = np.array([len(part) for part in np.array_split(np.arange(windows), len(means))])
    assert (means * sizes).round().sum() == 2.0**windows - 1


def test_equal_seeds_deal_equally_and_others_do_not():
    values, ones = np.random.default_rng(0).normal(size=100), np.ones(100)
    first, again, other = (ratio_statistics(values, ones, seed=seed) for seed in (0, 0, 1))
    assert first == again != other


def test_standard_error_is_about_right():
    """Of means of 500 windows with deviation 2: 2 / √500, whatever the subsets."""
    rng = np.random.default_rng(0)
    errors = [parts(ratio_statistics(rng.normal(size=500) * 2, np.ones(500), seed=i))[1] for i in range(50)]
    assert np.mean(errors) == pytest.approx(2 / np.sqrt(500), rel=0.05)


# --- Intervals over batches -------------------------------------------------------------------------------------------


def test_the_interval_of_two_batches_spans_their_own_ratios():
    """A quarter of the draws takes one batch twice, and a quarter the other."""
    assert batch_interval(np.array([3.0, 30.0]), np.array([3.0, 10.0])) == pytest.approx((1.0, 3.0))
    assert batch_interval(np.array([4.0, 32.0]), np.array([1.0, 2.0]), root=True) == pytest.approx((2.0, 4.0))


@given(st.integers(2, 30), st.floats(0.1, 100), st.integers(0, 5))
def test_equal_batches_leave_no_doubt(batches: int, value: float, seed: int):
    counts = np.random.default_rng(seed).integers(1, 9, batches).astype(np.float64)
    assert batch_interval(value * counts, counts, seed) == pytest.approx((value, value))


@pytest.mark.parametrize("counts", [[], [4.0], [0.0, 4.0, 0.0], [0.0, 0.0]])
def test_fewer_than_two_batches_that_count_have_no_interval(counts: list[float]):
    assert batch_interval(np.ones(len(counts)), np.array(counts)) is None


def test_batches_that_count_nothing_say_nothing():
    """They are drawn like the others; a draw of nothing else has no ratio and is left out."""
    assert batch_interval(np.array([0.0, 2.0, 6.0]), np.array([0.0, 1.0, 2.0])) == pytest.approx((2.0, 3.0))


def test_intervals_depend_on_the_seed_alone_and_are_about_right():
    """±1.96 × 2 / √400 for means of 400 batches of one with deviation 2."""
    values, ones = 2 * np.random.default_rng(0).normal(size=400), np.ones(400)
    first, again, other = (batch_interval(values, ones, seed=seed) for seed in (0, 0, 1))
    assert first == again != other
    assert first is not None
    assert first[0] < values.mean() < first[1]
    assert first[1] - first[0] == pytest.approx(2 * 1.96 * 2 / 20, rel=0.15)


@pytest.mark.parametrize("root", [False, True])
def test_intervals_are_those_of_scipy_up_to_the_draws(root: bool):
    """SciPy draws indices, one set per call; here equal seeds draw equal episodes for every line of a table."""
    stats = pytest.importorskip("scipy.stats")
    rng = np.random.default_rng(0)
    counts = rng.integers(1, 9, 60).astype(np.float64)
    sums = counts * rng.gamma(2.0, size=60)

    def ratio(sums: np.ndarray, counts: np.ndarray, axis: int) -> np.ndarray:
        return (sums.sum(axis) / counts.sum(axis)) ** (0.5 if root else 1.0)

    library = stats.bootstrap(
        (sums, counts), ratio, paired=True, method="percentile", n_resamples=20_000, rng=np.random.default_rng(1)
    ).confidence_interval
    ours = batch_interval(sums, counts, root=root)
    assert ours == pytest.approx((library.low, library.high), abs=0.05 * (library.high - library.low))


def test_the_bootstrap_of_a_function_is_that_of_the_ratio():
    rng = np.random.default_rng(3)
    sums, counts = rng.random(12), rng.integers(1, 9, size=12).astype(np.float64)
    found = bootstrap_interval(np.stack([sums, counts], axis=-1), lambda s: s[:, 0] / s[:, 1], seed=5)
    assert found == pytest.approx(batch_interval(sums, counts, seed=5))


def _share(sums: np.ndarray) -> np.ndarray:
    return quotient(sums[:, 0], sums[:, 1])


def test_draws_in_which_a_function_is_not_defined_are_left_out():
    parts = np.array([[1.0, 1.0], [0.0, 3.0], [0.0, 0.0]])
    assert bootstrap_interval(parts, _share) == (0.0, 1.0)
    assert bootstrap_interval(parts, lambda sums: np.full(len(sums), np.nan)) is None
    assert bootstrap_interval(parts[:1], _share) is None


@pytest.mark.parametrize("place", [0, 1, 49])
def test_what_rests_on_one_batch_has_no_interval(place: int):
    """Every draw that has it has the same value, so the interval would have no width and claim certainty."""
    parts = np.zeros((50, 2))
    parts[place] = 0.2, 0.3
    assert bootstrap_interval(parts, _share) is None
    parts[place - 1] = 0.1, 0.1
    assert bootstrap_interval(parts, _share) == pytest.approx((2 / 3, 1.0))


def test_sums_without_each_are_those_of_all_others():
    parts = np.random.default_rng(0).random((7, 3))
    expected = [np.delete(parts, place, axis=0).sum(axis=0) for place in range(7)]
    np.testing.assert_allclose(sums_without_each(parts), expected)
    assert (sums_without_each(np.array([[0.0], [0.1], [0.0]])) == [[0.1], [0.0], [0.1]]).all()
