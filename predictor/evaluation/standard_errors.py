"""Computes mean and standard error over random subsets of a test set (paper Sec. V: "across 20 test subsets").

Episodes (windows, where these are not known) are divided at random into subsets of (almost) equal size, the metric is
computed on each, and the standard error is the subsets' standard deviation (n − 1) over √subsets. Equal seeds and
numbers of episodes give equal subsets, so all lines of a table are compared on equal subsets. The error measures the
dependence on the choice of test episodes, not on the seed of training; it is too small where only windows are known and
overlap in time, since they are not independent.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

NUM_SUBSETS = 20
"""Number of subsets, as in the paper."""
BOOTSTRAP_DRAWS = 2000
"""Number of bootstrap draws of an interval."""
MOST_DRAWN = 4_000_000
"""Largest number of values that are drawn at once."""
SMALLEST = 1e-12
"""Denominators up to this one count as 0."""


@dataclass(frozen=True)
class Statistic:
    """A metric over subsets of the test set."""

    mean: float
    """Mean of the subsets' values; for a root or a ratio it differs slightly from the value on the whole set."""
    standard_error: float | None
    """Standard deviation of the subsets' values (n − 1) / √subsets; None with fewer than two."""
    subsets: int
    """Number of subsets with at least one valid entry; fewer than requested if there are fewer windows."""


@dataclass(frozen=True)
class Estimate:
    """A number with its interval."""

    value: float
    """Value over all that was measured."""
    interval: tuple[float, float] | None
    """95 %, by default a bootstrap over episodes; None with fewer than two, or where all rests on one."""


def ratio_statistics(
    sums: Float[np.ndarray, " windows"],
    counts: Float[np.ndarray, " windows"],
    num_subsets: int = NUM_SUBSETS,
    seed: int = 0,
    root: bool = False,
    pooled: bool = False,
) -> Statistic | None:
    """Computes Σ sums / Σ counts of each subset of windows, then mean and standard error over subsets.

    Args:
        sums: sum of the metric over the valid entries of each window.
        counts: number of valid entries of each window.
        num_subsets: number of subsets, at least 1; limited to the number of windows.
        seed: random seed of the subsets.
        root: whether to take the root of each subset's ratio (squared errors become an RMSE).
        pooled: whether the mean is over all entries instead: that of subsets with few entries would count as much.

    Returns:
        Mean and standard error, or None if nothing is valid.
    """
    values = subset_ratios(sums, counts, num_subsets, seed)
    values = np.sqrt(values[~np.isnan(values)]) if root else values[~np.isnan(values)]
    if not len(values):
        return None
    error = float(values.std(ddof=1) / np.sqrt(len(values))) if len(values) > 1 else None
    whole = sums.sum() / counts.sum()
    mean = values.mean() if not pooled else np.sqrt(whole) if root else whole
    return Statistic(float(mean), error, len(values))


def batch_interval(
    sums: Float[np.ndarray, " batches"], counts: Float[np.ndarray, " batches"], seed: int = 0, root: bool = False
) -> tuple[float, float] | None:
    """Computes the 95 % percentile bootstrap of Σ sums / Σ counts over whole batches (episodes).

    Equal seeds and numbers of batches give equal draws, so all lines of a table have equal draws.

    Args:
        sums: numerator of each batch.
        counts: denominator of each batch.
        seed: random seed of the draws.
        root: whether to take the root of each draw's ratio.

    Returns:
        Lower and upper limit, or None with fewer than two batches with a count above 0.
    """

    def value(totals: Float[np.ndarray, "draws 2"]) -> Float[np.ndarray, " draws"]:
        ratio = quotient(totals[:, 0], totals[:, 1])
        return np.sqrt(ratio) if root else ratio

    return bootstrap_interval(np.stack([sums, counts], axis=1), value, seed)


def summed(
    parts: Float[np.ndarray, "entries parts"], episode: Int[np.ndarray, " entries"]
) -> Float[np.ndarray, "episodes parts"]:
    """Returns the sums over the entries of each episode."""
    _, batch = np.unique(episode, return_inverse=True)
    sums = np.zeros((int(batch.max(initial=-1)) + 1, parts.shape[1]))
    np.add.at(sums, batch, parts)
    return sums


def quotient(top: Float[np.ndarray, "*draws"], bottom: Float[np.ndarray, "*draws"]) -> Float[np.ndarray, "*draws"]:
    """Returns the quotient; NaN where the denominator is not above 0."""
    return np.where(bottom > SMALLEST, top / np.where(bottom > SMALLEST, bottom, 1.0), np.nan)


def estimate(
    sums: Float[np.ndarray, "episodes parts"],
    value: Callable[[Float[np.ndarray, "draws parts"]], Float[np.ndarray, " draws"]],
) -> Estimate | None:
    """Returns a function of sums over episodes with its `bootstrap_interval`; None where it is not defined."""
    found = float(value(sums.sum(axis=0, keepdims=True))[0])
    return Estimate(found, bootstrap_interval(sums, value)) if np.isfinite(found) else None


def bootstrap_interval(
    sums: Float[np.ndarray, "batches parts"],
    value: Callable[[Float[np.ndarray, "draws parts"]], Float[np.ndarray, " draws"]],
    seed: int = 0,
) -> tuple[float, float] | None:
    """Computes the 95 % percentile bootstrap of a function of sums over whole batches (episodes).

    Equal seeds and numbers of batches give equal draws, those of `batch_interval`.

    Args:
        sums: sums of each batch.
        value: the function, of the sums of each draw; NaN where it is not defined.
        seed: random seed of the draws.

    Returns:
        Lower and upper limit over the draws where the function is defined; None with fewer than two batches, or if
        the function rests on one of them: is not defined without it.
    """
    if len(sums) < 2 or not np.isfinite(value(sums_without_each(sums))).all():
        return None
    return central_interval(value(bootstrap_sums(sums, seed)))


def sums_without_each(sums: Float[np.ndarray, "batches parts"]) -> Float[np.ndarray, "batches parts"]:
    """Returns the sums over all batches but each one in turn; what is 0 in all others is exactly 0."""
    nothing = np.zeros((1, sums.shape[1]))
    before = np.concatenate([nothing, sums[:-1].cumsum(axis=0)])
    after = np.concatenate([sums[:0:-1].cumsum(axis=0)[::-1], nothing])
    return before + after


def bootstrap_sums(
    sums: Float[np.ndarray, "batches parts"], seed: int = 0, draws: int = BOOTSTRAP_DRAWS
) -> Float[np.ndarray, "draws parts"]:
    """Returns the sums over the batches of each of the draws of a bootstrap, those of `bootstrap_draws`."""
    generator, batches = np.random.default_rng(seed), len(sums)
    rows = max(1, MOST_DRAWN // batches)
    return np.concatenate(
        [
            generator.multinomial(batches, np.full(batches, 1 / batches), size=min(rows, draws - first)) @ sums
            for first in range(0, draws, rows)
        ]
    )


def bootstrap_draws(batches: int, seed: int = 0, draws: int = BOOTSTRAP_DRAWS) -> Int[np.ndarray, "draws batches"]:
    """Returns how often each batch is drawn in each of the draws of a bootstrap."""
    return np.random.default_rng(seed).multinomial(batches, np.full(batches, 1 / batches), size=draws)


def central_interval(values: Float[np.ndarray, " draws"]) -> tuple[float, float] | None:
    """Returns the central 95 % of the draws that are defined; None if none is."""
    defined = values[np.isfinite(values)]
    if not len(defined):
        return None
    low, high = np.percentile(defined, [2.5, 97.5])
    return float(low), float(high)


def subset_ratios(
    sums: Float[np.ndarray, " windows"], counts: Float[np.ndarray, " windows"], num_subsets: int, seed: int
) -> Float[np.ndarray, " subsets"]:
    """Computes Σ sums / Σ counts on each subset; NaN if the count is 0."""
    if num_subsets < 1:
        raise ValueError(f"num_subsets must be at least 1, got {num_subsets}")
    order = np.random.default_rng(seed).permutation(len(sums))
    parts = np.array_split(order, max(1, min(num_subsets, len(sums))))
    numerator = np.array([sums[part].sum() for part in parts])
    denominator = np.array([counts[part].sum() for part in parts])
    return quotient(numerator, denominator)
