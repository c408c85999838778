import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from predictor.subsets import Statistic, ratio_statistics, subset_ratios, subset_statistics


def parts(found: Statistic | None) -> tuple[float, float, int]:
    assert found is not None and found.standard_error is not None
    return found.mean, found.standard_error, found.subsets


def test_one_window_per_subset_is_the_textbook_standard_error():
    values = np.array([1.0, 2.0, 3.0, 4.0])
    found = subset_statistics(values, np.ones(4, dtype=np.bool_), num_subsets=4)
    assert parts(found) == pytest.approx((2.5, np.sqrt(5 / 3) / 2, 4))


def test_each_subset_has_its_own_mean_over_valid_entries():
    values = np.array([[1.0, 3.0], [np.inf, 10.0], [5.0, 7.0]])
    valid = np.array([[True, True], [False, True], [True, True]])
    assert parts(subset_statistics(values, valid, num_subsets=3))[0] == pytest.approx((2 + 10 + 6) / 3)
    assert subset_statistics(values, valid, num_subsets=1) == Statistic(26 / 5, None, 1)


def test_root_is_taken_of_each_subset():
    found = subset_statistics(np.array([4.0, 16.0]), np.ones(2, dtype=np.bool_), num_subsets=2, root=True)
    assert parts(found) == pytest.approx((3.0, 1.0, 2))


@pytest.mark.parametrize(("windows", "subsets"), [(1, 1), (19, 19), (20, 20), (21, 20), (1000, 20)])
def test_never_more_subsets_than_windows(windows: int, subsets: int):
    found = subset_statistics(np.arange(float(windows)), np.ones(windows, dtype=np.bool_))
    assert found is not None and found.subsets == subsets
    assert (found.standard_error is None) == (windows == 1)


def test_subsets_without_a_valid_entry_are_left_out():
    valid = np.array([True, False, True, False])
    assert subset_statistics(np.array([1.0, 9.0, 3.0, 9.0]), valid, num_subsets=4) == Statistic(2.0, 1.0, 2)


@pytest.mark.parametrize("windows", [0, 5])
def test_nothing_valid_is_none(windows: int):
    assert subset_statistics(np.zeros((windows, 2)), np.zeros((windows, 2), dtype=np.bool_)) is None


def test_at_least_one_subset():
    with pytest.raises(ValueError, match="num_subsets must be at least 1, got 0"):
        subset_statistics(np.zeros(3), np.ones(3, dtype=np.bool_), num_subsets=0)


@given(st.integers(1, 50), st.integers(1, 25), st.integers(0, 5))
def test_windows_are_dealt_evenly_and_all_of_them(windows: int, num_subsets: int, seed: int):
    # powers of two: a subset's sum says which windows it holds
    means = subset_ratios(2.0 ** np.arange(windows), np.ones(windows), num_subsets, seed)
    assert len(means) == min(windows, num_subsets)
    sizes = np.array([len(part) for part in np.array_split(np.arange(windows), len(means))])
    assert (means * sizes).round().sum() == 2.0**windows - 1


def test_equal_seeds_deal_equally_and_others_do_not():
    values, valid = np.random.default_rng(0).normal(size=100), np.ones(100, dtype=np.bool_)
    first, again, other = (subset_statistics(values, valid, seed=seed) for seed in (0, 0, 1))
    assert first == again != other


def test_standard_error_is_about_right():
    """Of means of 500 windows with deviation 2: 2 / √500, whatever the subsets."""
    rng = np.random.default_rng(0)
    errors = [parts(ratio_statistics(rng.normal(size=500) * 2, np.ones(500), seed=i))[1] for i in range(50)]
    assert np.mean(errors) == pytest.approx(2 / np.sqrt(500), rel=0.05)
