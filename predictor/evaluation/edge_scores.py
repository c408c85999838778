"""What edge features know, as pure functions: correlation beside chance, rank separation, disentanglement, stillness.

Arrays in, numbers out; `predictor.interpret` gathers the arrays from a trained model.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from predictor.evaluation.disentanglement import DCI, dci, direct_r2, linear_r2, mig, sklearn

SHUFFLES = 100
CHANCE_QUANTILE = 0.95
"""Of the best |r| that a shuffled factor finds among all dimensions."""
FLAT = 1e-6
"""A dimension whose standard deviation is below this share of its size (or of 1) says nothing: it is float noise."""


@dataclass(frozen=True)
class FactorScore:
    """How well edge features know one property of pairs; None where it never varies or pairs are too few."""

    name: str
    """The attribute, or "edge exists"."""
    rows: int
    """Pairs (at the last observed step of their window) that were scored."""
    dimension: int | None = None
    """Feature dimension with the largest |r|."""
    correlation: float | None = None
    """Its Pearson r, with sign."""
    r2: float | None = None
    """r²: what that one dimension explains after the best straight line."""
    chance: float | None = None
    """Largest |r| over dimensions that a shuffled property reaches, 95th percentile over `SHUFFLES` shuffles."""
    linear_r2: float | None = None
    """Held-out R² of a linear read-out of all dimensions; halves are whole episodes."""
    direct_r2: float | None = None
    """R² of dimension i as it stands against attribute i: what restricted labelling is judged by."""
    distance_correlation: float | None = None
    """r with the distance between the two agents, which anyone can measure."""
    correlations: tuple[float, ...] = ()
    """r of every dimension."""


@dataclass(frozen=True)
class Separation:
    """Ranks statistic: the chance that a pair with an edge has the larger value than a pair without (0.5: no use)."""

    dimension: int
    """Feature dimension furthest from 0.5."""
    auc: float
    """Its statistic; near 0 it separates as well as near 1, the other way round."""
    edge_prob_auc: float
    """The same of the model's own probability of an edge."""


@dataclass(frozen=True)
class Disentanglement:
    """DCI and MIG of the attributes on true edges."""

    rows: int
    """Edges."""
    mig: float | None
    """Mutual information gap."""
    dci: DCI | None
    """None where it could not be had; the note says why."""
    note: str = ""
    """Empty if all went well."""


@dataclass(frozen=True)
class Stillness:
    """How much of each dimension's variance lies within an edge over time; static features have none."""

    edges: int
    """Pairs present at every step of the stretch (only true edges where the data knows them)."""
    steps: int
    """Length of the stretch."""
    spread: tuple[float, ...]
    """Standard deviation over all edges and steps."""
    within: tuple[float | None, ...]
    """Variance within edges over total variance, 0 (static) to 1 (all of it is change); None for flat dimensions."""


def correlations(features: Float[np.ndarray, "rows dims"], factor: Float[np.ndarray, " rows"]) -> tuple[float, ...]:
    """Pearson's r of each dimension with the factor; 0 where one of them is flat."""
    return tuple(((_standardised(features).T @ _standardised(factor[:, None]))[:, 0] / max(1, len(factor))).tolist())


def dealt_out(
    factor: Float[np.ndarray, " rows"], groups: Int[np.ndarray, " rows"], rng: np.random.Generator
) -> Float[np.ndarray, " rows"]:
    """The factor, shuffled between groups: each gets another's values, read round from anywhere, in either direction.

    Rows of a group (an episode) are alike, and shuffling them one by one would make chance look smaller than it is.
    Longer groups repeat the values that they get. Reading begins at an even row, so that both directions of a pair,
    which stand together, stay together.

    Args:
        factor: what to shuffle.
        groups: rows of a group stand together, groups in ascending order.
        rng: source of the shuffle.
    """
    _, first, group, count = np.unique(groups, return_index=True, return_inverse=True, return_counts=True)
    donor = rng.permutation(len(count))
    begin = (2 * rng.integers(0, (count[donor] + 1) // 2))[group]
    backwards = (rng.random(len(count)) < 0.5)[group]
    place = np.arange(len(factor)) - first[group]
    read = np.where(backwards, begin - 1 - place, begin + place) % count[donor][group]
    return factor[first[donor][group] + read]


def chance_correlation(
    features: Float[np.ndarray, "rows dims"],
    factor: Float[np.ndarray, " rows"],
    groups: Int[np.ndarray, " rows"],
    seed: int = 0,
) -> float:
    """95th percentile, over shuffles of the factor, of the largest |r| among the dimensions."""
    rng = np.random.default_rng(seed)
    shuffled = np.stack([dealt_out(factor, groups, rng) for _ in range(SHUFFLES)], axis=1)
    found = _standardised(features).T @ _standardised(shuffled) / max(1, len(factor))
    return float(np.quantile(np.abs(found).max(axis=0), CHANCE_QUANTILE))


def score_factor(
    name: str,
    features: Float[np.ndarray, "rows dims"],
    factor: Float[np.ndarray, " rows"],
    groups: Int[np.ndarray, " rows"],
    distance_m: Float[np.ndarray, " rows"],
    labelled_dimension: int | None = None,
    seed: int = 0,
) -> FactorScore:
    """Everything about one property of pairs.

    Args:
        name: of the property.
        features: edge features, one row per pair.
        factor: the property.
        groups: episode of each row, ascending.
        distance_m: between the two agents.
        labelled_dimension: the dimension that restricted labelling would regress on it.
        seed: of the shuffles and the halves.
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


def rank_statistic(values: Float[np.ndarray, "rows dims"], exists: Bool[np.ndarray, " rows"]) -> list[float]:
    """Area under the ROC curve (AUC) of each dimension: chance that an edge has a larger value than a pair without one.

    Raises:
        ValueError: all rows are edges, or none.
    """
    with_edge, without = int(exists.sum()), int((~exists).sum())
    if not with_edge or not without:
        raise ValueError(f"rows with and without an edge are needed, got {with_edge} with and {without} without")
    area = sklearn("metrics").roc_auc_score
    return [float(area(exists, column)) for column in values.T]


def separation(
    features: Float[np.ndarray, "rows dims"], edge_prob: Float[np.ndarray, " rows"], exists: Bool[np.ndarray, " rows"]
) -> Separation | None:
    """How well the best dimension, and the model's own probability, tell edges from pairs without one."""
    if exists.all() or not exists.any():
        return None
    found = rank_statistic(features, exists)
    best = int(np.argmax(np.abs(np.array(found) - 0.5)))
    return Separation(best, found[best], rank_statistic(edge_prob[:, None], exists)[0])


def disentanglement(
    features: Float[np.ndarray, "rows dims"], factors: Float[np.ndarray, "rows factors"], seed: int = 0
) -> Disentanglement:
    """DCI and MIG of the factors that vary."""
    if len(features) < 4:
        return Disentanglement(len(features), None, None, f"needs at least 4 edges, got {len(features)}")
    factors = factors[:, _standardised(factors).any(axis=0)]
    if not factors.shape[1]:
        return Disentanglement(len(features), None, None, "no attribute varies")
    return Disentanglement(len(features), mig(features, factors), dci(features, factors, seed=seed))


class StillnessTally:
    """Variance within edges and in all, batch by batch.

    Example:
        >>> tally = StillnessTally()
        >>> tally.add(np.array([[[1.0], [1.0]], [[2.0], [2.0]]]))  # two edges, two steps, one dimension: never changes
        >>> tally.results().within
        (0.0,)
    """

    def __init__(self) -> None:
        """Nothing added yet."""
        self._edges = self._steps = 0
        self._within: np.ndarray = np.zeros(0)
        self._sums: list[np.ndarray] = []  # count, Σ and Σ² of every batch

    def add(self, features: Float[np.ndarray, "edges time dims"]) -> None:
        """Takes in edges that are there at all of the steps."""
        values = features.astype(np.float64)
        self._edges, self._steps = self._edges + len(values), values.shape[1]
        within = np.square(values - values.mean(axis=1, keepdims=True)).sum(axis=(0, 1))
        self._within = within + (self._within if len(self._within) else 0.0)
        self._sums.append(
            np.stack([np.full(len(within), values[..., 0].size), values.sum((0, 1)), (values**2).sum((0, 1))])
        )

    def results(self) -> Stillness:
        """The whole set's numbers."""
        count, total, squares = np.sum(self._sums, axis=0) if self._sums else np.zeros((3, 0))
        mean = total / np.maximum(count, 1)
        around = np.maximum(squares - count * mean**2, self._within)
        spread = np.sqrt(around / np.maximum(count, 1))
        flat = (spread <= FLAT * np.maximum(1.0, np.abs(mean))) | (count == 0) | (self._steps < 2)
        within = [
            None if f else float(w / a) for f, w, a in zip(flat, self._within, np.where(flat, 1, around), strict=True)
        ]
        return Stillness(self._edges, self._steps, tuple(spread.tolist()), tuple(within))


def _standardised(values: Float[np.ndarray, "rows columns"]) -> Float[np.ndarray, "rows columns"]:
    """Mean 0 and variance 1 of each column; zeros where it is flat."""
    centred = values.astype(np.float64) - values.mean(axis=0, dtype=np.float64)
    std = centred.std(axis=0)
    live = std > FLAT * np.maximum(1.0, np.abs(values).max(axis=0, initial=0.0))
    return centred * live / np.where(live, std, 1.0)


def _by_group(
    features: Float[np.ndarray, "rows dims"], factor: Float[np.ndarray, " rows"], groups: Int[np.ndarray, " rows"]
) -> tuple[
    Float[np.ndarray, "groups places dims"], Float[np.ndarray, "groups places"], Bool[np.ndarray, "groups places"]
]:
    """Rows of a group side by side, padded."""
    _, first, group, count = np.unique(groups, return_index=True, return_inverse=True, return_counts=True)
    place = np.arange(len(factor)) - first[group]
    valid = np.zeros((len(count), int(count.max(initial=0))), dtype=np.bool_)
    packed, target = np.zeros((*valid.shape, features.shape[1])), np.zeros(valid.shape)
    valid[group, place], packed[group, place], target[group, place] = True, features, factor
    return packed, target, valid
