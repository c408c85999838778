"""Computes how far forecasts react to what is done to an agent: predicted beside true shifts of receivers.

A shift is where a receiver is with an intervention on a sender, minus where it is without: a vector for each step
ahead. The true one comes from a copied simulator, the predicted one from two forecasts of the same moment. Of P pairs
of sender and receiver, with true shifts t and predicted shifts p at steps 1 to H:

* **length**: mean of |t| and of |p| at the last step [m].
* **along**: mean at the last step of p · t / |t|, the predicted shift along the true one [m]; negative where the
  forecast moves the other way. Where a true shift is 0 and has no direction, |p| stands in its place.
* **slope**: Σ p · t / Σ t · t over all pairs and steps, the line of least squares through the origin: 1 is the true
  reaction, 0 none. Pairs with long shifts weigh most.
* **median ratio**: median of p · t / t · t at the last step, over pairs that truly move by more than a metre. All of
  them weigh the same, so it says what is usual where a few shifts are ten times as long as the others.
* **correlation**: Pearson's r between |t| and the predicted shift along t; over the pairs at the last step, and over
  all pairs and steps. The second is higher, since both grow with the time ahead.
* **false reaction**: mean |p| at the last step of receivers that truly do not move, over mean |p| of receivers that do.

Intervals are 95 % percentile bootstraps over episodes, since the pairs of an episode are alike.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from predictor.evaluation.standard_errors import Estimate, bootstrap_draws, central_interval, estimate, quotient, summed

NO_SHIFT_M = 1e-6
"""Length below which a true shift has no direction [m]."""
MOVED_M = 1.0
"""Length from which a true shift counts in the median ratio [m]: of shorter ones the ratio says little."""
FLAT = 1e-9
"""Share of the mean square below which a variance counts as rounding."""


@dataclass(frozen=True)
class Shifts:
    """Shifts of receivers, one for each perturbation."""

    true_m: Float[np.ndarray, "pairs horizon axes"]
    """True shifts [m], world axes."""
    predicted_m: Float[np.ndarray, "pairs horizon axes"]
    """Predicted shifts [m]."""
    episode: Int[np.ndarray, " pairs"]
    """Episode of each pair."""

    def __len__(self) -> int:
        """Number of pairs."""
        return len(self.episode)

    def along(self) -> Float[np.ndarray, "pairs horizon"]:
        """Returns the predicted shifts along the true ones [m]; their lengths where the true ones are 0."""
        length_m = np.linalg.norm(self.true_m, axis=-1)
        still = length_m < NO_SHIFT_M
        along_m = (self.predicted_m * self.true_m).sum(axis=-1) / np.where(still, 1.0, length_m)
        return np.where(still, np.linalg.norm(self.predicted_m, axis=-1), along_m)


@dataclass(frozen=True)
class Reaction:
    """Reaction of one forecaster to one kind of perturbation; None and empty where nothing was found.

    The module's docstring defines the terms.
    """

    pairs: int
    """Number of pairs of sender and receiver, one for each perturbation."""
    episodes: int
    """Number of episodes that they come from."""
    true_m: float | None = None
    """Length of the true shift at the last step [m]."""
    length_m: float | None = None
    """Length of the predicted shift at the last step [m]."""
    along_m: float | None = None
    """Predicted shift along the true one at the last step [m]."""
    slope: Estimate | None = None
    """Slope of the predicted on the true shift; None if all true shifts are 0."""
    median_ratio: Estimate | None = None
    """Median ratio of the predicted to the true shift at the last step; None if nobody moves by more than a metre."""
    correlation: Estimate | None = None
    """Correlation over pairs at the last step; None if one of the two does not vary."""
    correlation_of_steps: Estimate | None = None
    """Correlation over all pairs and steps."""
    true_by_step_m: tuple[float, ...] = ()
    """Length of the true shift at each step [m]."""
    along_by_step_m: tuple[float, ...] = ()
    """Predicted shift along the true one at each step [m]."""
    length_by_step_m: tuple[float, ...] = ()
    """Length of the predicted shift at each step [m]."""


def reaction(shifts: Shifts) -> Reaction:
    """Computes the reaction of a forecaster from its shifts."""
    pairs, episodes = len(shifts), len(np.unique(shifts.episode))
    if not pairs:
        return Reaction(0, 0)
    along_m, true_m = shifts.along(), np.linalg.norm(shifts.true_m, axis=-1)
    length_m = np.linalg.norm(shifts.predicted_m, axis=-1)
    return Reaction(
        pairs,
        episodes,
        float(true_m[:, -1].mean()),
        float(length_m[:, -1].mean()),
        float(along_m[:, -1].mean()),
        _slope(shifts),
        _median_ratio(true_m[:, -1], along_m[:, -1], shifts.episode),
        _correlation(true_m[:, -1:], along_m[:, -1:], shifts.episode),
        _correlation(true_m, along_m, shifts.episode),
        tuple(true_m.mean(axis=0).tolist()),
        tuple(along_m.mean(axis=0).tolist()),
        tuple(length_m.mean(axis=0).tolist()),
    )


def false_reaction(unmoved: Shifts, moved: Shifts) -> Estimate | None:
    """Computes the predicted shift of receivers that do not move, relative to that of receivers that do.

    Args:
        unmoved: shifts of receivers whose true shift is about 0.
        moved: shifts of receivers that the same perturbation moves.

    Returns:
        Ratio of the mean lengths at the last step; None if there are no pairs, or the forecaster moves none.
    """
    parts = []
    for place, shifts in enumerate((unmoved, moved)):
        length_m = np.linalg.norm(shifts.predicted_m[:, -1], axis=-1)
        parts.append(np.zeros((len(shifts), 4)))
        parts[-1][:, 2 * place : 2 * place + 2] = np.stack([length_m, np.ones(len(shifts))], axis=-1)
    episode = np.concatenate([unmoved.episode, moved.episode])
    return estimate(summed(np.concatenate(parts), episode), _ratio_of_means)


def _slope(shifts: Shifts) -> Estimate | None:
    dots = (shifts.predicted_m * shifts.true_m).sum(axis=(1, 2))
    squares = np.square(shifts.true_m).sum(axis=(1, 2))
    return estimate(summed(np.stack([dots, squares], axis=-1), shifts.episode), lambda s: quotient(s[:, 0], s[:, 1]))


def _median_ratio(
    true_m: Float[np.ndarray, " pairs"], along_m: Float[np.ndarray, " pairs"], episode: Int[np.ndarray, " pairs"]
) -> Estimate | None:
    far = true_m > MOVED_M
    if not far.any():
        return None
    ratios = along_m[far] / true_m[far]
    order = np.argsort(ratios)
    episodes, batch = np.unique(episode[far][order], return_inverse=True)
    drawn = bootstrap_draws(len(episodes))[:, batch]
    interval = None if len(episodes) < 2 else central_interval(_medians(ratios[order], drawn))
    return Estimate(float(np.median(ratios)), interval)


def _medians(
    ascending: Float[np.ndarray, " values"], times: Int[np.ndarray, "draws values"]
) -> Float[np.ndarray, " draws"]:
    """Returns the median of values of which each is drawn so many times."""
    up_to = times.cumsum(axis=1)
    lower, upper = (half(2 * up_to, up_to[:, -1:]).argmax(axis=1) for half in (np.greater_equal, np.greater))
    return (ascending[lower] + ascending[upper]) / 2


def _correlation(
    first: Float[np.ndarray, "pairs steps"],
    second: Float[np.ndarray, "pairs steps"],
    episode: Int[np.ndarray, " pairs"],
) -> Estimate | None:
    x, y = first - first.mean(), second - second.mean()  # about the means, so that the squares lose no digits
    parts = np.stack([np.ones_like(x), x, y, x * x, y * y, x * y], axis=-1).sum(axis=1)
    return estimate(summed(parts, episode), _pearson)


def _ratio_of_means(sums: Float[np.ndarray, "draws parts"]) -> Float[np.ndarray, " draws"]:
    return quotient(quotient(sums[:, 0], sums[:, 1]), quotient(sums[:, 2], sums[:, 3]))


def _pearson(sums: Float[np.ndarray, "draws parts"]) -> Float[np.ndarray, " draws"]:
    number, x, y, xx, yy, xy = sums.T
    spread_x, spread_y = number * xx - x * x, number * yy - y * y
    varies = (spread_x > FLAT * number * xx) & (spread_y > FLAT * number * yy)
    together = number * xy - x * y
    r = together / np.sqrt(np.where(varies, spread_x * spread_y, 1.0))
    return np.where(varies, np.clip(r, -1.0, 1.0), np.nan)
