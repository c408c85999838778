"""Scores edge features: correlation beside chance, rank separation, disentanglement, change over time.

All functions are pure; `predictor.evaluation.edge_findings` gathers the arrays from a trained model.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from predictor.evaluation.causal_graph import roc_auc
from predictor.evaluation.disentanglement import DCI, dci, direct_r2, linear_r2, mig

SHUFFLES = 100
CHANCE_QUANTILE = 0.95
"""Quantile of the largest |r| among all dimensions with a shuffled factor that counts as chance."""
FLAT = 1e-6
"""Share of a dimension's magnitude (or of 1) below which its standard deviation counts as float noise."""


@dataclass(frozen=True)
class FactorScore:
    """Scores of edge features against one property of pairs; None if it never varies or pairs are too few."""

    name: str
    """Name of the attribute, or "edge exists"."""
    pairs: int
    """Number of pairs that were scored, at the last observed step of their window."""
    dimension: int | None = None
    """Feature dimension with the largest |r|."""
    correlation: float | None = None
    """Its Pearson r, with sign."""
    r2: float | None = None
    """r²: share of the variance that this dimension explains with a fitted line."""
    chance: float | None = None
    """Largest |r| over dimensions that a shuffled property reaches, 95th percentile over `SHUFFLES` shuffles."""
    linear_r2: float | None = None
    """Held-out R² of a linear regression on all dimensions; halves are whole episodes."""
    direct_r2: float | None = None
    """R² of dimension i, unchanged, against attribute i: the measure of restricted labelling."""
    distance_correlation: float | None = None
    """r of the property with the distance between the two agents, for comparison."""
    correlations: tuple[float, ...] = ()
    """r of every dimension."""


@dataclass(frozen=True)
class Separation:
    """Rank statistic (AUC): probability that a pair with an edge has a larger value than one without; 0.5 is chance."""

    dimension: int
    """Feature dimension with the AUC furthest from 0.5."""
    auc: float
    """AUC of this dimension; 0 separates as well as 1, with the opposite sign."""
    edge_prob_auc: float
    """AUC of the model's probability of an edge."""


@dataclass(frozen=True)
class Disentanglement:
    """DCI and MIG of the attributes on true edges."""

    edges: int
    """Number of true edges."""
    mig: float | None
    """Mutual information gap."""
    dci: DCI | None
    """DCI; None if it is not defined, with the reason in `note`."""
    note: str = ""
    """Reason why a score is missing; empty if none is."""


@dataclass(frozen=True)
class Stillness:
    """Share of each dimension's variance that lies within edges over time; 0 for static features."""

    edges: int
    """Number of pairs present at every step (only true edges if the data has them)."""
    steps: int
    """Number of steps."""
    spread: tuple[float, ...]
    """Standard deviation over all edges and steps."""
    within: tuple[float | None, ...]
    """Variance within edges over total variance, 0 (static) to 1 (all variance is change); None for flat dimensions."""


def correlations(features: Float[np.ndarray, "pairs dims"], factor: Float[np.ndarray, " pairs"]) -> tuple[float, ...]:
    """Computes Pearson's r of each dimension with the factor; 0 if one of them is flat."""
    return tuple(((_standardised(features).T @ _standardised(factor[:, None]))[:, 0] / max(1, len(factor))).tolist())


def shuffled_by_group(
    factor: Float[np.ndarray, " pairs"], groups: Int[np.ndarray, " pairs"], rng: np.random.Generator
) -> Float[np.ndarray, " pairs"]:
    """Shuffles a factor between groups: each group takes the values of another one, from a random start, cyclically.

    The pairs of a group (an episode) are alike, and shuffling them one by one would underestimate chance. A group that
    is longer than the other one repeats its values. The direction is random. The start is an even place, so that both
    directions of a pair, which are adjacent, stay adjacent.

    Args:
        factor: values to shuffle.
        groups: group of each pair, ascending.
        rng: random generator of the shuffle.
    """
    _, first, group, count = np.unique(groups, return_index=True, return_inverse=True, return_counts=True)
    donor = rng.permutation(len(count))
    begin = (2 * rng.integers(0, (count[donor] + 1) // 2))[group]
    backwards = (rng.random(len(count)) < 0.5)[group]
    place = np.arange(len(factor)) - first[group]
    read = np.where(backwards, begin - 1 - place, begin + place) % count[donor][group]
    return factor[first[donor][group] + read]


def chance_correlation(
    features: Float[np.ndarray, "pairs dims"],
    factor: Float[np.ndarray, " pairs"],
    groups: Int[np.ndarray, " pairs"],
    seed: int = 0,
) -> float:
    """Computes the 95th percentile, over shuffles of the factor, of the largest |r| among the dimensions."""
    rng = np.random.default_rng(seed)
    shuffled = np.stack([shuffled_by_group(factor, groups, rng) for _ in range(SHUFFLES)], axis=1)
    found = _standardised(features).T @ _standardised(shuffled) / max(1, len(factor))
    return float(np.quantile(np.abs(found).max(axis=0), CHANCE_QUANTILE))


def score_factor(
    name: str,
    features: Float[np.ndarray, "pairs dims"],
    factor: Float[np.ndarray, " pairs"],
    groups: Int[np.ndarray, " pairs"],
    distance_m: Float[np.ndarray, " pairs"],
    labelled_dimension: int | None = None,
    seed: int = 0,
) -> FactorScore:
    """Computes all scores of one property of pairs.

    Args:
        name: name of the property.
        features: edge features of the pairs.
        factor: value of the property.
        groups: episode of each pair, ascending.
        distance_m: distance between the two agents [m].
        labelled_dimension: dimension that restricted labelling regresses on the property.
        seed: random seed of the shuffles and the halves.
    """
    if len(factor) < 3 or not _standardised(factor[:, None]).any():
        return FactorScore(name, len(factor))
    found = correlations(features, factor)
    best = int(np.argmax(np.abs(found)))
    everything = np.ones(len(factor), dtype=np.bool_)
    direct = None
    if labelled_dimension is not None and labelled_dimension < features.shape[1]:
        direct = direct_r2(features[:, labelled_dimension], factor, everything)
    packed, target, valid = _by_group(features, factor, groups)
    return FactorScore(
        name,
        len(factor),
        best,
        found[best],
        found[best] ** 2,
        chance_correlation(features, factor, groups, seed),
        linear_r2(packed, target, valid, seed=seed),
        direct,
        correlations(distance_m[:, None], factor)[0],
        found,
    )


def rank_statistic(values: Float[np.ndarray, "pairs dims"], exists: Bool[np.ndarray, " pairs"]) -> list[float]:
    """Computes the area under the ROC curve (AUC) of each dimension; an edge is the positive class.

    Raises:
        ValueError: all pairs are edges, or none is.
    """
    with_edge, without = int(exists.sum()), int((~exists).sum())
    if not with_edge or not without:
        raise ValueError(f"pairs with and without an edge are needed, got {with_edge} with and {without} without")
    return [float(roc_auc(column, exists, np.ones((1, len(column))))[0]) for column in values.T]


def separation(
    features: Float[np.ndarray, "pairs dims"],
    edge_prob: Float[np.ndarray, " pairs"],
    exists: Bool[np.ndarray, " pairs"],
) -> Separation | None:
    """Computes how well the best dimension and the model's probability separate edges from other pairs."""
    if exists.all() or not exists.any():
        return None
    found = rank_statistic(features, exists)
    best = int(np.argmax(np.abs(np.array(found) - 0.5)))
    return Separation(best, found[best], rank_statistic(edge_prob[:, None], exists)[0])


def disentanglement(
    features: Float[np.ndarray, "pairs dims"],
    factors: Float[np.ndarray, "pairs factors"],
    groups: Int[np.ndarray, " pairs"],
    seed: int = 0,
) -> Disentanglement:
    """Computes DCI and MIG of the factors that vary; the halves of DCI are of groups (episodes)."""
    if len(features) < 4:
        return Disentanglement(len(features), None, None, f"needs at least 4 edges, got {len(features)}")
    factors = factors[:, _standardised(factors).any(axis=0)]
    if not factors.shape[1]:
        return Disentanglement(len(features), None, None, "no attribute varies")
    try:
        found = dci(features, factors, seed, groups)
    except ValueError as error:
        return Disentanglement(len(features), mig(features, factors), None, str(error))
    return Disentanglement(len(features), mig(features, factors), found)


class StillnessTally:
    """Collects variance within edges and in total, batch by batch.

    Example:
        >>> tally = StillnessTally()
        >>> tally.add(np.array([[[1.0], [1.0]], [[2.0], [2.0]]]))  # two edges, two steps, one dimension: never changes
        >>> tally.results().within
        (0.0,)
    """

    def __init__(self) -> None:
        """Begins without edges."""
        self._edges = self._steps = 0
        self._within: np.ndarray = np.zeros(0)
        self._sums: list[np.ndarray] = []  # count, Σ and Σ² of every batch

    def add(self, features: Float[np.ndarray, "edges time dims"]) -> None:
        """Adds edges that are present at all steps."""
        values = features.astype(np.float64)
        self._edges, self._steps = self._edges + len(values), values.shape[1]
        within = np.square(values - values.mean(axis=1, keepdims=True)).sum(axis=(0, 1))
        self._within = within + (self._within if len(self._within) else 0.0)
        self._sums.append(
            np.stack([np.full(len(within), values[..., 0].size), values.sum((0, 1)), (values**2).sum((0, 1))])
        )

    def results(self) -> Stillness:
        """Returns the result over all batches that were added."""
        count, total, squares = np.sum(self._sums, axis=0) if self._sums else np.zeros((3, 0))
        mean = total / np.maximum(count, 1)
        around = np.maximum(squares - count * mean**2, self._within)
        spread = np.sqrt(around / np.maximum(count, 1))
        flat = (spread <= FLAT * np.maximum(1.0, np.abs(mean))) | (count == 0) | (self._steps < 2)
        within = [
            None if f else float(w / a) for f, w, a in zip(flat, self._within, np.where(flat, 1, around), strict=True)
        ]
        return Stillness(self._edges, self._steps, tuple(spread.tolist()), tuple(within))


def _standardised(values: Float[np.ndarray, "pairs columns"]) -> Float[np.ndarray, "pairs columns"]:
    """Scales each column to mean 0 and variance 1; a flat one to zeros."""
    centred = values.astype(np.float64) - values.mean(axis=0, dtype=np.float64)
    std = centred.std(axis=0)
    live = std > FLAT * np.maximum(1.0, np.abs(values).max(axis=0, initial=0.0))
    return centred * live / np.where(live, std, 1.0)


def _by_group(
    features: Float[np.ndarray, "pairs dims"], factor: Float[np.ndarray, " pairs"], groups: Int[np.ndarray, " pairs"]
) -> tuple[
    Float[np.ndarray, "groups places dims"], Float[np.ndarray, "groups places"], Bool[np.ndarray, "groups places"]
]:
    """Returns features, factor and mask of the pairs, one group after the other, padded to equal length."""
    _, first, group, count = np.unique(groups, return_index=True, return_inverse=True, return_counts=True)
    place = np.arange(len(factor)) - first[group]
    valid = np.zeros((len(count), int(count.max(initial=0))), dtype=np.bool_)
    packed, target = np.zeros((*valid.shape, features.shape[1])), np.zeros(valid.shape)
    valid[group, place], packed[group, place], target[group, place] = True, features, factor
    return packed, target, valid
