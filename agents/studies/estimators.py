"""Estimators for few runs: interquartile mean, stratified bootstrap, probability of improvement, performance profile.

They are those of Agarwal et al. 2021 (https://arxiv.org/abs/2108.13264). A run is one training under one seed, and its
score is one number: the mean over its test episodes. Runs come as one array per scenario; the bootstrap draws runs
anew within each scenario, never across them.
"""

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float
from scipy import stats

from predictor.evaluation.standard_errors import Estimate
from predictor.support.errors import UserError

Runs = Sequence[Float[np.ndarray, " _"]]
"""Scores of the runs of each scenario; their numbers may differ."""
RESAMPLES = 2_000
CONFIDENCE = 0.95


def interquartile_mean(runs: Runs) -> float:
    """Computes the mean of the middle half of all runs: a quarter, rounded down, is cut off at either end."""
    return float(stats.trim_mean(np.concatenate(list(runs)), 0.25))


def mean(runs: Runs) -> float:
    """Computes the mean over scenarios of the mean over runs."""
    return float(np.mean([np.mean(scores) for scores in runs]))


def mean_with_t_interval(scores: Float[np.ndarray, " runs"]) -> Estimate:
    """Computes the mean with Student's interval; a single run has none."""
    centre = float(np.mean(scores))
    if len(scores) < 2:
        return Estimate(centre, None)
    half = stats.t.ppf(0.5 + CONFIDENCE / 2, len(scores) - 1) * np.std(scores, ddof=1) / np.sqrt(len(scores))
    return Estimate(centre, (float(centre - half), float(centre + half)))


def gain_with_t_interval(ours: Float[np.ndarray, " ours"], theirs: Float[np.ndarray, " theirs"]) -> Estimate:
    """Computes the difference of two means with Welch's interval; without one if a sample has a single run."""
    difference = float(np.mean(ours) - np.mean(theirs))
    if min(len(ours), len(theirs)) < 2:
        return Estimate(difference, None)
    variances = np.array([np.var(each, ddof=1) / len(each) for each in (ours, theirs)])
    if not variances.any():
        return Estimate(difference, (difference, difference))
    freedom = variances.sum() ** 2 / (variances**2 / [len(ours) - 1, len(theirs) - 1]).sum()
    half = stats.t.ppf(0.5 + CONFIDENCE / 2, freedom) * np.sqrt(variances.sum())
    return Estimate(difference, (float(difference - half), float(difference + half)))


def bootstrapped(
    statistic: Callable[..., float], *samples: Runs, generator: np.random.Generator, resamples: int = RESAMPLES
) -> Estimate:
    """Computes a statistic with its percentile interval from a stratified bootstrap.

    Args:
        statistic: function of as many samples as are given.
        *samples: one or more samples, each an array of runs per scenario; each is drawn anew by itself.
        generator: source of the draws.
        resamples: number of draws.

    Returns:
        The estimate; without an interval if a scenario of a sample has less than two runs, which say nothing of how
        much runs differ.
    """
    value = float(statistic(*samples))
    if any(len(scores) < 2 for runs in samples for scores in runs):
        return Estimate(value, None)
    drawn = [statistic(*([_redrawn(s, generator) for s in runs] for runs in samples)) for _ in range(resamples)]
    low, high = np.nanpercentile(drawn, [50 - 50 * CONFIDENCE, 50 + 50 * CONFIDENCE])
    return Estimate(value, (float(low), float(high)))


def probability_of_improvement(ours: Runs, theirs: Runs) -> float:
    """Computes how probable it is that a run of ours beats one of theirs in the same scenario; a tie counts one half.

    It is the mean over scenarios of the Mann-Whitney U statistic, divided by the number of pairs.

    Raises:
        UserError: the samples have different numbers of scenarios.
    """
    if len(ours) != len(theirs):
        raise UserError(f"both samples need the same scenarios, got {len(ours)} and {len(theirs)}")
    return float(np.mean([_share_won(our, their) for our, their in zip(ours, theirs, strict=True)]))


def share_of_headroom(arm: Runs, floor: Runs, ceiling: Runs) -> float:
    """Computes (arm - floor) / (ceiling - floor) of the means; NaN where floor and ceiling are equal."""
    low, high = mean(floor), mean(ceiling)
    return (mean(arm) - low) / (high - low) if high != low else float("nan")


def gain(ours: Runs, theirs: Runs) -> float:
    """Computes the difference of the means."""
    return mean(ours) - mean(theirs)


def performance_profile(runs: Runs, thresholds: Float[np.ndarray, " thresholds"]) -> Float[np.ndarray, " thresholds"]:
    """Computes the share of runs, over all scenarios, whose score is above each threshold."""
    scores = np.sort(np.concatenate(list(runs)))
    return 1.0 - np.searchsorted(scores, thresholds, side="right") / len(scores)


def profile_band(
    runs: Runs, thresholds: Float[np.ndarray, " thresholds"], generator: np.random.Generator, resamples: int = RESAMPLES
) -> tuple[Float[np.ndarray, " thresholds"], Float[np.ndarray, " thresholds"]]:
    """Computes the pointwise 95 % band of a performance profile by a stratified bootstrap."""
    drawn = [performance_profile([_redrawn(s, generator) for s in runs], thresholds) for _ in range(resamples)]
    low, high = np.percentile(drawn, [50 - 50 * CONFIDENCE, 50 + 50 * CONFIDENCE], axis=0)
    return low, high


def _redrawn(scores: Float[np.ndarray, " runs"], generator: np.random.Generator) -> Float[np.ndarray, " runs"]:
    return scores[generator.integers(len(scores), size=len(scores))]


def _share_won(ours: Float[np.ndarray, " ours"], theirs: Float[np.ndarray, " theirs"]) -> float:
    difference = ours[:, None] - theirs[None, :]
    return float(np.mean((difference > 0) + 0.5 * (difference == 0)))
