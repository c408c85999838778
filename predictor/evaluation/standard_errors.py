"""Mean and standard error over random subsets of a test set, as the paper reports ("across 20 test subsets", Sec. V).

The windows are dealt at random into subsets of (almost) equal size, the metric is computed on each, and the standard
error is the subsets' standard deviation (n − 1) over √subsets. Equal seeds and numbers of windows give equal subsets,
so rows of one table are compared on the same ones. It says how far a result depends on which windows were tested, not
how far on the seed of training; windows that overlap in time are not independent, and then it is too small.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

NUM_SUBSETS = 20
"""The paper's."""
BOOTSTRAP_DRAWS = 2000
"""Of an interval."""


@dataclass(frozen=True)
class Statistic:
    """A metric over subsets of the test set."""

    mean: float
    """Mean of the subsets' values; for a root or a ratio close to, but not quite, the value on the whole set."""
    standard_error: float | None
    """Standard deviation of the subsets' values (n − 1) / √subsets; None with fewer than two."""
    subsets: int
    """Subsets that held at least one valid entry; fewer than asked for where windows are fewer."""


def subset_statistics(
    values: Float[np.ndarray, " windows *entries"],
    valid: Bool[np.ndarray, " windows *entries"],
    num_subsets: int = NUM_SUBSETS,
    seed: int = 0,
    root: bool = False,
) -> Statistic | None:
    """Mean over the valid entries of each subset of windows, then mean and standard error over subsets.

    Args:
        values: any metric, windows first; looked at where `valid` only.
        valid: which entries count.
        num_subsets: at least 1; never more than there are windows.
        seed: of the deal.
        root: take the root of each subset's mean (squared errors become an RMSE).

    Returns:
        None if nothing is valid.
    """
    rest = tuple(range(1, values.ndim))
    sums = np.where(valid, values, 0.0).astype(np.float64).sum(axis=rest)
    return ratio_statistics(sums, valid.sum(axis=rest).astype(np.float64), num_subsets, seed, root)


def ratio_statistics(
    sums: Float[np.ndarray, " windows"],
    counts: Float[np.ndarray, " windows"],
    num_subsets: int = NUM_SUBSETS,
    seed: int = 0,
    root: bool = False,
) -> Statistic | None:
    """The same from each window's sum and number of valid entries (or any numerator and denominator)."""
    values = subset_ratios(sums, counts, num_subsets, seed)
    values = np.sqrt(values[~np.isnan(values)]) if root else values[~np.isnan(values)]
    if not len(values):
        return None
    error = float(values.std(ddof=1) / np.sqrt(len(values))) if len(values) > 1 else None
    return Statistic(float(values.mean()), error, len(values))


def batch_interval(
    sums: Float[np.ndarray, " batches"], counts: Float[np.ndarray, " batches"], seed: int = 0, root: bool = False
) -> tuple[float, float] | None:
    """95 % percentile bootstrap of Σ sums / Σ counts over batches (episodes), which are drawn whole.

    Equal seeds and numbers of batches give equal draws, so rows of one table are resampled alike.

    Args:
        sums: numerator of each batch.
        counts: denominator of each batch.
        seed: of the draws.
        root: take the root of each draw's ratio.

    Returns:
        None with fewer than two batches that count anything.
    """
    if np.count_nonzero(counts) < 2:
        return None
    drawn = np.random.default_rng(seed).multinomial(len(sums), np.full(len(sums), 1 / len(sums)), size=BOOTSTRAP_DRAWS)
    totals, numbers = drawn @ sums, drawn @ counts
    ratios = totals[numbers > 0] / numbers[numbers > 0]
    low, high = np.percentile(np.sqrt(ratios) if root else ratios, [2.5, 97.5])
    return float(low), float(high)


def subset_ratios(
    sums: Float[np.ndarray, " windows"], counts: Float[np.ndarray, " windows"], num_subsets: int, seed: int
) -> Float[np.ndarray, " subsets"]:
    """Σ sums / Σ counts on each subset; NaN where a subset counts nothing."""
    if num_subsets < 1:
        raise ValueError(f"num_subsets must be at least 1, got {num_subsets}")
    order = np.random.default_rng(seed).permutation(len(sums))
    parts = np.array_split(order, max(1, min(num_subsets, len(sums))))
    numerator = np.array([sums[part].sum() for part in parts])
    denominator = np.array([counts[part].sum() for part in parts])
    return np.where(denominator > 0, numerator / np.where(denominator > 0, denominator, 1.0), np.nan)
