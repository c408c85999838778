import itertools
from typing import Any

import numpy as np
import pytest
from scipy import stats

from agents.studies.estimators import (
    bootstrapped,
    gain,
    gain_with_t_interval,
    interquartile_mean,
    mean,
    mean_with_t_interval,
    performance_profile,
    probability_of_improvement,
    profile_band,
    share_of_headroom,
)
from predictor.evaluation.standard_errors import Estimate
from predictor.support.errors import UserError

RNG = np.random.default_rng(3)
TWO = [RNG.normal(size=7), RNG.normal(1.0, size=5)]
OTHER = [RNG.normal(0.5, size=4), RNG.normal(0.5, size=9)]


def runs(*scenarios: list[float]) -> list[np.ndarray]:
    return [np.array(scores, dtype=np.float64) for scores in scenarios]


def test_the_middle_half_is_averaged():
    assert interquartile_mean(runs([0, 10, 20, 1000])) == 15.0
    assert interquartile_mean(runs([-100, 1, 2], [3, 4, 5, 6, 700])) == pytest.approx(3.5)
    assert interquartile_mean(runs([1, 2, 6])) == 3.0, "a quarter of three runs is less than one: none is cut off"


def test_the_middle_half_is_that_of_a_plain_loop():
    pooled = sorted(np.concatenate(TWO))
    cut = len(pooled) // 4
    assert interquartile_mean(TWO) == pytest.approx(sum(pooled[cut:-cut]) / (len(pooled) - 2 * cut))


def test_means_count_scenarios_alike():
    assert mean(runs([0, 0, 0, 4], [3])) == 2.0


def test_the_interval_of_a_mean_is_that_of_students_test():
    scores = np.array([1.0, 2.0, 4.0])
    found = mean_with_t_interval(scores)
    assert found.value == pytest.approx(7 / 3)
    assert found.interval == pytest.approx(stats.ttest_1samp(scores, 0).confidence_interval(0.95))
    assert mean_with_t_interval(np.array([5.0])).interval is None


def test_the_interval_of_a_difference_is_that_of_welchs_test():
    ours, theirs = np.array([1.0, 2.0, 4.0, 4.5]), np.array([0.0, 0.1, 0.4])
    found = gain_with_t_interval(ours, theirs)
    expected = stats.ttest_ind(ours, theirs, equal_var=False).confidence_interval(0.95)
    assert (found.value, found.interval) == (pytest.approx(ours.mean() - theirs.mean()), pytest.approx(expected))
    same = gain_with_t_interval(np.full(3, 5.27), theirs)
    half = stats.t.ppf(0.975, 2) * stats.sem(theirs)
    assert same.interval == pytest.approx((same.value - half, same.value + half)), "one of them is constant"
    assert gain_with_t_interval(np.array([2.0, 2.0]), np.array([1.5, 1.5, 1.5])) == Estimate(0.5, (0.5, 0.5))
    for few in ((ours, theirs[:1]), (ours[:1], theirs)):
        assert gain_with_t_interval(*few).value == few[0].mean() - few[1].mean()
        assert gain_with_t_interval(*few).interval is None


def test_improvement_in_closed_form():
    assert probability_of_improvement(runs([3, 4]), runs([1, 2])) == 1.0
    assert probability_of_improvement(runs([1, 2]), runs([3, 4])) == 0.0
    assert probability_of_improvement(runs([1, 1]), runs([1, 1])) == 0.5
    assert probability_of_improvement(runs([1, 2]), runs([1, 2])) == 0.5
    assert probability_of_improvement(runs([2], [0]), runs([1], [1])) == 0.5, "the mean over scenarios"


def test_improvement_is_that_of_a_plain_loop_and_of_scipy():
    loop = []
    for ours, theirs in zip(TWO, OTHER, strict=True):
        won = [1.0 if a > b else 0.5 if a == b else 0.0 for a, b in itertools.product(ours, theirs)]
        loop.append(sum(won) / len(won))
        assert loop[-1] == pytest.approx(stats.mannwhitneyu(ours, theirs).statistic / (len(ours) * len(theirs)))
    assert probability_of_improvement(TWO, OTHER) == pytest.approx(np.mean(loop))
    with pytest.raises(UserError, match="both samples need the same scenarios, got 2 and 1"):
        probability_of_improvement(TWO, OTHER[:1])


def test_the_bootstrap_stays_within_scenarios():
    """Scores differ between scenarios alone: whatever is drawn within one, the mean is the same."""
    found = bootstrapped(mean, runs([1, 1, 1], [5, 5]), generator=np.random.default_rng(0))
    assert found == Estimate(3.0, (3.0, 3.0))


def test_the_bootstrap_is_that_of_a_plain_loop():
    found = bootstrapped(gain, TWO, OTHER, generator=np.random.default_rng(5), resamples=200)
    draws, values = np.random.default_rng(5), []
    for _ in range(200):
        means = []
        for sample in (TWO, OTHER):
            drawn = [scores[draws.integers(len(scores), size=len(scores))] for scores in sample]
            means.append(np.mean([np.mean(scores) for scores in drawn]))
        values.append(means[0] - means[1])
    assert found.value == pytest.approx(mean(TWO) - mean(OTHER))
    assert found.interval == pytest.approx(np.percentile(values, [2.5, 97.5]))


def test_the_bootstrap_of_many_runs_is_the_normal_interval():
    scores = np.random.default_rng(1).normal(size=400)
    found = bootstrapped(mean, [scores], generator=np.random.default_rng(2))
    half = 1.96 * scores.std() / 20
    assert found.interval == pytest.approx((found.value - half, found.value + half), abs=0.01)


def test_a_single_run_has_no_interval():
    assert bootstrapped(mean, runs([1], [2]), generator=np.random.default_rng(0)).interval is None


@pytest.mark.parametrize("samples", [(runs([1, 2, 3]), runs([2])), (runs([1, 2], [3]), runs([1, 2], [3, 4]))])
def test_beside_a_single_run_nothing_has_an_interval(samples: tuple[Any, Any]):
    """How much runs differ is not known of it."""
    assert bootstrapped(gain, *samples, generator=np.random.default_rng(0)).interval is None


def test_the_share_of_headroom():
    assert share_of_headroom(runs([3]), runs([2]), runs([6])) == 0.25
    assert np.isnan(share_of_headroom(runs([3]), runs([2]), runs([2])))


def test_profiles_count_runs_above_a_threshold():
    sample, thresholds = runs([0, 1], [1, 3]), np.array([-1.0, 0.0, 0.5, 1.0, 2.0, 3.0])
    loop = [np.mean([score > t for scores in sample for score in scores]) for t in thresholds]
    assert performance_profile(sample, thresholds).tolist() == loop == [1, 0.75, 0.75, 0.25, 0.25, 0]
    low, high = profile_band(sample, thresholds, np.random.default_rng(0), resamples=100)
    assert np.all(low <= loop) and np.all(high >= loop) and np.any(low < high)
