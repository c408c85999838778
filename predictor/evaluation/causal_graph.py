"""Scores inferred edges against causal labels: whose future changes when an agent brakes or is taken out.

A pair is a receiver and a sender whose label is known. Its label is an edge if the shift exceeds the threshold of the
labels. A rule gives each pair a score; a model's is its probability of an edge.

* **Decision**: score above a bound. Accuracy, precision, recall, F1 of the edges. `fitted` is the F1 of the bound that
  is best on other pairs, those of the first half of the episodes; for a rule without a bound of its own it is the one.
* **Which edges are found**: the recall among edges from a receiver's leader, and among all others, where leaders are
  known.
* **Ranking**: AUC is the probability that an edge scores higher than another pair, ties count half; average precision
  is the mean, over edges, of the precision where each is found.
* **Strength**: Spearman's correlation of the score with the shift, over all pairs.
* **Calibration**: expected calibration error, the mean over pairs of |mean probability − share of edges| of the tenth
  of [0, 1] that its probability lies in.
* **Spread between senders**: standard deviation of a receiver's scores over its senders, mean over receivers with at
  least two; 0 if it makes no difference whose edge it is.

Intervals are 95 % percentile bootstraps over episodes.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from predictor.evaluation.standard_errors import Estimate, bootstrap_draws, central_interval, estimate, quotient, summed

BINS = 10
"""Number of bins of the calibration."""
RANKING_DRAWS = 400
"""Number of bootstrap draws of what is computed from ranks."""
CURVE_POINTS = 60
"""Largest number of points of a curve."""

Weights = Float[np.ndarray, "draws pairs"]
"""How often each pair is drawn."""


@dataclass(frozen=True)
class CausalPairs:
    """Pairs whose causal label is known, in the order of their episodes."""

    shift_m: Float[np.ndarray, " pairs"]
    """Causal shift of the receiver by the sender [m]."""
    exists: Bool[np.ndarray, " pairs"]
    """Whether the label is an edge."""
    episode: Int[np.ndarray, " pairs"]
    """Episode of each pair."""
    receiver: Int[np.ndarray, " pairs"]
    """Number of each pair's receiver at its step, unique in its episode."""
    leads: Bool[np.ndarray, " pairs"] | None = None
    """Whether the simulator says that the receiver follows the sender; None where it says nothing."""

    def __len__(self) -> int:
        """Number of pairs."""
        return len(self.exists)

    def where(self, chosen: Bool[np.ndarray, " pairs"]) -> "CausalPairs":
        """Returns the chosen pairs."""
        columns = [getattr(self, field.name) for field in fields(self)]
        parts: list[Any] = [None if column is None else column[chosen] for column in columns]
        return CausalPairs(*parts)

    @staticmethod
    def concatenate(parts: "Sequence[CausalPairs]") -> "CausalPairs":
        """Joins the pairs of several episodes; leaders are known if all parts know them."""
        columns = [[getattr(part, field.name) for part in parts] for field in fields(CausalPairs)]
        joined: list[Any] = [None if any(x is None for x in found) else np.concatenate(found) for found in columns]
        return CausalPairs(*joined)


@dataclass(frozen=True)
class Bin:
    """Pairs of one tenth of the probabilities."""

    lower: float
    """Least probability."""
    upper: float
    """Largest probability."""
    pairs: int
    """Number of pairs."""
    mean_prob: float | None
    """Mean probability; None without pairs."""
    share: float | None
    """Share of edges; None without pairs."""


@dataclass(frozen=True)
class CausalScores:
    """Scores of one rule; None where a measure is not defined."""

    pairs: int
    """Number of pairs."""
    episodes: int
    """Number of their episodes."""
    share: float
    """Share of edges among the labels."""
    bound: float | None
    """Score above which an edge is inferred."""
    accuracy: Estimate | None = None
    """Share of right decisions."""
    precision: Estimate | None = None
    """Share of edges among those inferred."""
    recall: Estimate | None = None
    """Share of the edges that are inferred."""
    recall_of_leaders: Estimate | None = None
    """Share of the edges from a receiver's leader that are inferred; None without one, or where leaders are unknown."""
    recall_of_others: Estimate | None = None
    """Share of all other edges that are inferred; None without one, or where leaders are unknown."""
    f1: Estimate | None = None
    """Harmonic mean of both."""
    fitted: Estimate | None = None
    """F1 with the bound that is best on the first half of the episodes."""
    fitted_bound: float | None = None
    """That bound."""
    auc: Estimate | None = None
    """Area under the ROC curve."""
    average_precision: Estimate | None = None
    """Average precision."""
    strength: Estimate | None = None
    """Spearman's correlation of score and shift."""
    calibration_error: Estimate | None = None
    """Expected calibration error; None for a score that is no probability."""
    bins: tuple[Bin, ...] = ()
    """Calibration by bin."""
    spread_between_senders: float | None = None
    """Spread of a receiver's scores over its senders."""
    curve: tuple[tuple[float, float], ...] = ()
    """Recall and precision at some bounds, from the highest on."""


def halves(pairs: CausalPairs) -> tuple[Bool[np.ndarray, " pairs"], Bool[np.ndarray, " pairs"]]:
    """Returns which pairs are of the first half of the episodes, and which of the second.

    Of an odd number of episodes the second half has one more.
    """
    first = np.isin(pairs.episode, np.unique(pairs.episode)[: len(np.unique(pairs.episode)) // 2])
    return first, ~first


def score_rule(
    score: Float[np.ndarray, " pairs"],
    pairs: CausalPairs,
    bound: float | None,
    probability: bool = False,
) -> CausalScores:
    """Scores a rule on the second half of the episodes, with bounds fitted on the first half.

    Args:
        score: score of each pair, higher for an edge.
        pairs: labels, of both halves.
        bound: score above which an edge is inferred; None takes the fitted one.
        probability: whether the score is a probability, which has a calibration.
    """
    fit, test = halves(pairs)
    score = score.astype(np.float64)  # in float32 the middle of two neighbouring scores is one of them
    fitted_bound = best_bound(score[fit], pairs.exists[fit])
    bound = fitted_bound if bound is None else bound
    score, pairs = score[test], pairs.where(test)
    if not len(pairs):
        return CausalScores(0, 0, 0.0, bound)
    decisions = {} if bound is None else _decisions(score, pairs, bound)
    return CausalScores(
        len(pairs),
        len(np.unique(pairs.episode)),
        float(pairs.exists.mean()),
        bound,
        **decisions,
        fitted=None if fitted_bound is None else _decisions(score, pairs, fitted_bound)["f1"],
        fitted_bound=fitted_bound,
        auc=_ranked(lambda weights: roc_auc(score, pairs.exists, weights), pairs),
        average_precision=_ranked(lambda weights: average_precision(score, pairs.exists, weights), pairs),
        strength=_ranked(lambda weights: spearman(score, pairs.shift_m, weights), pairs),
        calibration_error=_calibration_error(score, pairs) if probability else None,
        bins=_bins(score, pairs.exists) if probability else (),
        spread_between_senders=_spread(score, pairs),
        curve=_curve(score, pairs.exists),
    )


def best_bound(score: Float[np.ndarray, " pairs"], exists: Bool[np.ndarray, " pairs"]) -> float | None:
    """Returns the bound above which scores have the highest F1; None without an edge."""
    if not exists.any():
        return None
    found, hits, taken = _by_score(score, exists, np.ones((1, len(score))))
    f1 = 2 * hits[0].cumsum() / (taken[0].cumsum() + exists.sum())
    best = int(np.argmax(f1))
    below = found[best + 1] if best + 1 < len(found) else found[best] - 1.0
    return float((found[best] + below) / 2)


def roc_auc(
    score: Float[np.ndarray, " pairs"], exists: Bool[np.ndarray, " pairs"], weights: Weights
) -> Float[np.ndarray, " draws"]:
    """Computes the area under the ROC curve for each row of weights; NaN where all weight is on one class."""
    _, hits, taken = _by_score(score, exists, weights)
    misses = taken - hits
    edges, others = hits.sum(axis=1), misses.sum(axis=1)
    below = others[:, None] - misses.cumsum(axis=1)
    area = (hits * (below + misses / 2)).sum(axis=1)
    return quotient(area, edges * others)


def average_precision(
    score: Float[np.ndarray, " pairs"], exists: Bool[np.ndarray, " pairs"], weights: Weights
) -> Float[np.ndarray, " draws"]:
    """Computes the average precision for each row of weights; NaN without an edge."""
    _, hits, taken = _by_score(score, exists, weights)
    precision = quotient(hits.cumsum(axis=1), taken.cumsum(axis=1))
    return quotient((hits * np.nan_to_num(precision)).sum(axis=1), hits.sum(axis=1))


def spearman(
    first: Float[np.ndarray, " pairs"], second: Float[np.ndarray, " pairs"], weights: Weights
) -> Float[np.ndarray, " draws"]:
    """Computes Spearman's correlation for each row of weights; NaN where one of the two does not vary."""
    ranks = [_ranks(values, weights) for values in (first, second)]
    total = weights.sum(axis=1, keepdims=True)
    x, y = (rank - (weights * rank).sum(axis=1, keepdims=True) / total for rank in ranks)
    together, xx, yy = ((weights * product).sum(axis=1) for product in (x * y, x * x, y * y))
    return quotient(together, np.sqrt(xx * yy))


def _ranks(values: Float[np.ndarray, " pairs"], weights: Weights) -> Float[np.ndarray, "draws pairs"]:
    """Returns the mean rank of each pair among those drawn."""
    _, group = np.unique(values, return_inverse=True)
    order = np.argsort(group, kind="stable")
    begins = np.flatnonzero(np.diff(group[order], prepend=-1))
    held = np.add.reduceat(weights[:, order], begins, axis=1)
    return (held.cumsum(axis=1) - held / 2)[:, group]


def _by_score(
    score: Float[np.ndarray, " pairs"], exists: Bool[np.ndarray, " pairs"], weights: Weights
) -> tuple[Float[np.ndarray, " scores"], Float[np.ndarray, "draws scores"], Float[np.ndarray, "draws scores"]]:
    """Returns the distinct scores from the highest on, and for each the weight of its edges and of all its pairs."""
    order = np.argsort(-score, kind="stable")
    begins = np.flatnonzero(np.diff(score[order], prepend=np.inf))
    drawn = weights[:, order]
    hits, taken = (np.add.reduceat(part, begins, axis=1) for part in (drawn * exists[order], drawn))
    return score[order][begins], hits, taken


def _ranked(value: Callable[[Weights], Float[np.ndarray, " draws"]], pairs: CausalPairs) -> Estimate | None:
    """Returns a function of weights with its interval; None where it is not defined."""
    found = float(value(np.ones((1, len(pairs))))[0])
    if not np.isfinite(found):
        return None
    _, batch = np.unique(pairs.episode, return_inverse=True)
    batches = int(batch.max()) + 1
    if batches < 2:
        return Estimate(found, None)
    drawn = np.concatenate([1.0 - np.eye(batches), bootstrap_draws(batches, draws=RANKING_DRAWS)])
    parts = np.array_split(drawn, max(1, drawn.shape[0] * len(pairs) // 2_000_000))
    values = np.concatenate([value(part[:, batch]) for part in parts])
    rests_on_one = not np.isfinite(values[:batches]).all()
    return Estimate(found, None if rests_on_one else central_interval(values[batches:]))


def _decisions(score: Float[np.ndarray, " pairs"], pairs: CausalPairs, bound: float | None) -> dict[str, Any]:
    """Returns accuracy, precision, recall, of edges from leaders and of others too, and F1 of a bound."""
    inferred = np.zeros(len(pairs), dtype=np.bool_) if bound is None else score > bound
    leads = np.zeros(len(pairs), dtype=np.bool_) if pairs.leads is None else pairs.leads
    found, led = inferred & pairs.exists, leads & pairs.exists
    counts = [found, inferred, pairs.exists, inferred == pairs.exists, np.ones(len(pairs)), found & leads, led]
    sums = summed(np.stack(counts, axis=-1).astype(np.float64), pairs.episode)
    by_leader = pairs.leads is not None
    return {
        "recall_of_leaders": estimate(sums, lambda s: quotient(s[:, 5], s[:, 6])) if by_leader else None,
        "recall_of_others": (
            estimate(sums, lambda s: quotient(s[:, 0] - s[:, 5], s[:, 2] - s[:, 6])) if by_leader else None
        ),
        "accuracy": estimate(sums, lambda s: quotient(s[:, 3], s[:, 4])),
        "precision": estimate(sums, lambda s: quotient(s[:, 0], s[:, 1])),
        "recall": estimate(sums, lambda s: quotient(s[:, 0], s[:, 2])),
        "f1": estimate(sums, lambda s: quotient(2 * s[:, 0], s[:, 1] + s[:, 2])),
    }


def _bin_of(score: Float[np.ndarray, " pairs"]) -> Int[np.ndarray, " pairs"]:
    return np.clip((score * BINS).astype(np.int64), 0, BINS - 1)


def _calibration_error(score: Float[np.ndarray, " pairs"], pairs: CausalPairs) -> Estimate | None:
    inside = (_bin_of(score)[:, None] == np.arange(BINS)).astype(np.float64)
    gap = inside * (score - pairs.exists)[:, None]
    sums = summed(np.concatenate([gap, inside], axis=-1), pairs.episode)
    return estimate(sums, lambda s: quotient(np.abs(s[:, :BINS]).sum(axis=1), s[:, BINS:].sum(axis=1)))


def _bins(score: Float[np.ndarray, " pairs"], exists: Bool[np.ndarray, " pairs"]) -> tuple[Bin, ...]:
    place, found = _bin_of(score), []
    for i in range(BINS):
        inside = place == i
        means = (float(score[inside].mean()), float(exists[inside].mean())) if inside.any() else (None, None)
        found.append(Bin(i / BINS, (i + 1) / BINS, int(inside.sum()), *means))
    return tuple(found)


def _spread(score: Float[np.ndarray, " pairs"], pairs: CausalPairs) -> float | None:
    _, receiver = np.unique(np.stack([pairs.episode, pairs.receiver]), axis=1, return_inverse=True)
    receiver = receiver.reshape(-1)
    number, total, squares = (np.bincount(receiver, weights=w) for w in (np.ones_like(score), score, score**2))
    several = number > 1
    if not several.any():
        return None
    variance = squares / number - (total / number) ** 2
    return float(np.sqrt(np.maximum(variance[several], 0.0)).mean())


def _curve(score: Float[np.ndarray, " pairs"], exists: Bool[np.ndarray, " pairs"]) -> tuple[tuple[float, float], ...]:
    if not exists.any():
        return ()
    _, hits, taken = _by_score(score, exists, np.ones((1, len(score))))
    recall, precision = hits[0].cumsum() / exists.sum(), hits[0].cumsum() / taken[0].cumsum()
    kept = np.unique(np.linspace(0, len(recall) - 1, CURVE_POINTS).round().astype(np.int64))
    return tuple((float(recall[i]), float(precision[i])) for i in kept)
