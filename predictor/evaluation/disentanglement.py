"""Scores features against known factors: R² of attributes, and disentanglement (DCI, MIG), on NumPy arrays.

For edges, a point is a pair (pairs without an edge are masked out, since their spring constant has no meaning), columns
of `features` are the edge-feature dimensions, columns of `factors` the known attributes. A negative R² is worse than
the mean alone. A number that is not defined (nothing valid, a constant target) is None.

Sources: DCI, Eastwood & Williams, "A Framework for the Quantitative Evaluation of Disentangled Representations", ICLR
2018; MIG, Chen et al., "Isolating Sources of Disentanglement in VAEs", NeurIPS 2018 (histograms as in Locatello et al.,
ICML 2019). All functions but `direct_r2` need scikit-learn (the `scores` extra).
"""

import importlib
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from predictor.support.errors import UserError

MIN_R2 = 0.01
"""Least held-out R² of a factor that `dci` counts as predictable."""
PENALTY = 0.05
"""Penalty of the Lasso of `dci`; correlations below it count as zero."""


def sklearn(module: str) -> Any:
    """Returns a module of scikit-learn, which is loaded only where it is needed.

    Raises:
        UserError: scikit-learn is not installed.
    """
    try:
        return importlib.import_module(f"sklearn.{module}")
    except ImportError as error:
        raise UserError("scores of edge features need scikit-learn: pip install 'dgvae-rl[scores]'") from error


def direct_r2(
    prediction: Float[np.ndarray, "*entries"],
    target: Float[np.ndarray, "*entries"],
    valid: Bool[np.ndarray, "*entries"],
) -> float | None:
    """Computes 1 − SSE/SST of unchanged predictions, without a fit: the measure of restricted labelling.

    Args:
        prediction: predictions in the unit of the target.
        target: true values.
        valid: which entries count.

    Returns:
        R², or None if fewer than two targets count or all are equal.
    """
    given, truth = prediction[valid].astype(np.float64), target[valid].astype(np.float64)
    total = float(np.square(truth - truth.mean()).sum()) if len(truth) > 1 else 0.0
    return 1.0 - float(np.square(truth - given).sum()) / total if total > 0 else None


def linear_r2(
    features: Float[np.ndarray, "*entries dims"],
    target: Float[np.ndarray, "*entries"],
    valid: Bool[np.ndarray, "*entries"],
    ridge: float = 1e-3,
    seed: int = 0,
    groups: Int[np.ndarray, " entries"] | None = None,
) -> float | None:
    """Computes R² of a linear regression on all dimensions, fitted on one half and scored on the other.

    The halves are drawn over groups of the first axis, so that with (windows, receivers, senders) both directions of a
    spring, and all windows of an episode, fall into the same half.

    Args:
        features: edge features.
        target: attribute to predict.
        valid: which entries count.
        ridge: penalty per point on the weights of standardised features; small, for equal dimensions.
        seed: random seed of the halves.
        groups: group of each entry of the first axis (its episode); None makes each one a group of its own.

    Returns:
        R², or None if a half has fewer than two valid entries or the targets of the scored half are all equal.
    """
    fit = _first_half(len(valid), groups, seed)
    score = ~fit
    known, answers = features[fit][valid[fit]].astype(np.float64), target[fit][valid[fit]].astype(np.float64)
    if min(len(answers), int(valid[score].sum())) < 2:
        return None
    scaler, penalty = sklearn("preprocessing").StandardScaler(), ridge * len(known)
    model = sklearn("pipeline").make_pipeline(scaler, sklearn("linear_model").Ridge(penalty)).fit(known, answers)
    prediction, truth = model.predict(features[score][valid[score]]), target[score][valid[score]]
    return direct_r2(prediction, truth, np.ones(len(truth), dtype=np.bool_))


def _first_half(entries: int, groups: Int[np.ndarray, " entries"] | None, seed: int) -> Bool[np.ndarray, " entries"]:
    """Draws half of the groups; returns which entries are of it."""
    group = np.arange(entries) if groups is None else np.unique(groups, return_inverse=True)[1]
    order = np.random.default_rng(seed).permutation(group.max(initial=-1) + 1)
    return np.isin(group, order[: len(order) // 2])


@dataclass(frozen=True)
class DCI:
    """Disentanglement, completeness, informativeness; the first two lie between 0 and 1."""

    disentanglement: float | None
    """1 if every dimension predicts one factor at most; None with one factor (it would be 1 by definition)."""
    completeness: float | None
    """1 if every factor is predicted by one dimension; None with one dimension."""
    informativeness: float | None
    """Mean over factors of the held-out R² of the regressor (the paper gives its error; 1 is perfect in either)."""
    importance: list[list[float]]
    """Importance of each dimension (outer list) for each factor (inner list); all zero if no factor is predictable."""


def dci(
    features: Float[np.ndarray, "points dims"],
    factors: Float[np.ndarray, "points factors"],
    seed: int = 0,
    groups: Int[np.ndarray, " points"] | None = None,
) -> DCI:
    """Computes DCI of features, with factors and features standardised; fitted on one half, scored on the other.

    Importance is a Lasso's absolute weight. A factor that it cannot predict (held-out R² below `MIN_R2`) has importance
    0: it would be noise, and noise in a single dimension looks perfectly disentangled. If informativeness is low, the
    other two have little meaning.

    Halves are drawn over groups, as those of `linear_r2`: points of one episode are alike, so the half that is scored
    must not have any of an episode that was fitted.

    Args:
        features: features of the points, such as pairs.
        factors: known attributes of the points.
        seed: random seed of the halves.
        groups: group of each point (its episode); None makes each one a group of its own.

    Raises:
        UserError: scikit-learn is not installed.
        ValueError: a half has fewer than two points.
    """
    fit = _first_half(len(features), groups, seed)
    score = ~fit
    if min(fit.sum(), score.sum()) < 2:
        raise ValueError(f"dci needs at least 2 points in each half, got {fit.sum()} and {score.sum()}")
    scale = sklearn("preprocessing").StandardScaler
    inputs, outputs = (scale().fit(values[fit]).transform(values) for values in (features, factors))
    importance = np.zeros((features.shape[1], factors.shape[1]))
    everything = np.ones(score.sum(), dtype=np.bool_)
    scores = []
    for factor in range(factors.shape[1]):
        model = sklearn("linear_model").Lasso(alpha=PENALTY).fit(inputs[fit], outputs[fit, factor])
        r2 = direct_r2(model.predict(inputs[score]), outputs[score, factor], everything)
        scores.append(r2)
        if r2 is not None and r2 >= MIN_R2:
            importance[:, factor] = np.abs(model.coef_)
    known = [s for s in scores if s is not None]
    return DCI(
        _decided(importance) if factors.shape[1] > 1 else None,
        _decided(importance.T) if features.shape[1] > 1 else None,
        float(np.mean(known)) if known else None,
        importance.tolist(),
    )


def mig(
    features: Float[np.ndarray, "points dims"], factors: Float[np.ndarray, "points factors"], bins: int = 20
) -> float | None:
    """Computes the mutual information gap: (largest − second largest information about a factor) / its entropy.

    The gap is a mean over factors that vary, from 0 to 1: about 1 if one dimension alone holds each factor, 0 if two
    dimensions hold it equally or none does. A single dimension is compared with 0. None if no factor varies.
    """
    information = np.sort(mutual_information(features, factors, bins), axis=0)[::-1]
    second = information[1] if len(information) > 1 else np.zeros_like(information[0])
    entropy = np.array([_information(label, label) for label in _labels(factors, bins).T])
    vary = entropy > 0
    gaps = np.clip((information[0] - second)[vary] / entropy[vary], 0.0, 1.0)
    return float(gaps.mean()) if len(gaps) else None


def mutual_information(
    features: Float[np.ndarray, "points dims"], factors: Float[np.ndarray, "points factors"], bins: int = 20
) -> Float[np.ndarray, "dims factors"]:
    """Computes mutual information of each dimension and factor [nats], from histograms; never negative.

    Bins hold equal numbers of points, so the result is invariant to monotone rescaling; a column with few distinct
    values (edge types) has one bin for each. Miller & Madow's correction subtracts the bias of finite samples,
    (cells − rows − columns + 1) / 2n of the contingency table.
    """
    if bins < 2:
        raise ValueError(f"bins must be at least 2, got {bins}")
    dims, kinds = _labels(features, bins).T, _labels(factors, bins).T
    return np.array([[_information(dim, kind) for kind in kinds] for dim in dims])


def _decided(importance: Float[np.ndarray, "one other"]) -> float:
    """Returns 1 − entropy of shares over the second axis (base: its length), weighted by importance; 0 if all are 0."""
    total = importance.sum(1)
    if not total.any():
        return 0.0
    shares = importance / np.where(total > 0, total, 1.0)[:, None]
    entropy = -(shares * np.log(np.where(shares > 0, shares, 1.0))).sum(1) / np.log(importance.shape[1])
    return float(((1 - entropy) * total).sum() / total.sum())


def _labels(values: Float[np.ndarray, "points columns"], bins: int) -> Int[np.ndarray, "points columns"]:
    """Returns the bin of each value, column by column."""
    labels = np.empty(values.shape, dtype=np.int64)
    for column in range(values.shape[1]):
        kinds, labels[:, column] = np.unique(values[:, column], return_inverse=True)
        if len(kinds) > bins:
            edges = np.quantile(values[:, column], np.linspace(0, 1, bins + 1)[1:-1])
            labels[:, column] = np.searchsorted(edges, values[:, column], side="right")
    return labels


def _information(first: Int[np.ndarray, " points"], second: Int[np.ndarray, " points"]) -> float:
    """Computes mutual information of two labels [nats]; of a label with itself its entropy."""
    cluster = sklearn("metrics.cluster")
    joint = cluster.contingency_matrix(first, second, sparse=True)
    excess = joint.nnz - joint.shape[0] - joint.shape[1] + 1
    return max(0.0, float(cluster.mutual_info_score(None, None, contingency=joint)) - excess / (2 * len(first)))
