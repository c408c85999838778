"""Runs a trained model on windows and measures its edges: labelled pairs, scores of edge features, graph accuracy."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from predictor.data.causal_edges import known
from predictor.data.windows import WindowBatch, Windows
from predictor.dgvae.config import DGVAEConfig
from predictor.evaluation.edge_scores import (
    Disentanglement,
    FactorScore,
    Separation,
    Stillness,
    StillnessTally,
    disentanglement,
    score_factor,
    separation,
)
from predictor.evaluation.graph_accuracy import GraphAccuracy, GraphTally, graph_accuracy
from predictor.forecaster import Belief, Forecaster
from predictor.graph import pair_mask


@dataclass(frozen=True)
class LinearReading:
    """Linear estimate of an attribute from one feature dimension, for drawn graphs: offset + slope × feature."""

    dimension: int
    """Index of the feature dimension."""
    slope: float = 1.0
    """Slope; 1 if restricted labelling trained the feature to equal the attribute."""
    offset: float = 0.0
    """Offset in the unit of the attribute; 0 in that case."""


@dataclass(frozen=True)
class InferredEdges:
    """Edge features and probabilities of all pairs, inferred at each step of the history from the steps up to it."""

    features: Float[np.ndarray, "batch time agents agents dims"]
    """Edge features, receiver first."""
    edge_probs: Float[np.ndarray, "batch time agents agents types"]
    """Prior probabilities of the edge types."""
    pairs: Bool[np.ndarray, "batch time agents agents"]
    """Whether receiver and sender are different and both present."""


@dataclass(frozen=True)
class LabelledPairs:
    """Pairs whose truth is known, at the last observed step; the pairs of an episode are adjacent."""

    features: Float[np.ndarray, "pairs dims"]
    """Edge features."""
    edge_prob: Float[np.ndarray, " pairs"]
    """Probability of an edge of any type, by the model."""
    exists: Bool[np.ndarray, " pairs"] | None
    """Whether there is an edge; None if the data has attributes only."""
    attributes: Float[np.ndarray, "pairs attributes"]
    """Known properties of the edges; no column if there are none."""
    group: Int[np.ndarray, " pairs"]
    """Index of the episode."""
    distance_m: Float[np.ndarray, " pairs"]
    """Distance between the two agents [m]."""

    def where(self, chosen: Bool[np.ndarray, " pairs"]) -> "LabelledPairs":
        """Returns the chosen pairs."""
        columns: dict[str, Any] = {name: None if x is None else x[chosen] for name, x in vars(self).items()}
        return LabelledPairs(**columns)

    @staticmethod
    def concatenate(parts: "Sequence[LabelledPairs]") -> "LabelledPairs":
        """Joins the pairs of several batches."""
        columns: dict[str, Any] = {}
        for name, first in vars(parts[0]).items():
            columns[name] = None if first is None else np.concatenate([vars(part)[name] for part in parts])
        return LabelledPairs(**columns)


@dataclass(frozen=True)
class Findings:
    """Measurements of a model's edges; those for which the data has no labels are None or empty."""

    windows: int
    """Number of windows measured."""
    episodes: int
    """Number of episodes of these windows."""
    graph: GraphAccuracy | None
    """Accuracy of the inferred graph."""
    edges: FactorScore | None
    """Scores of the features against the existence of an edge, over all pairs."""
    separation: Separation | None
    """Rank statistics of the features against the existence of an edge."""
    attributes: list[FactorScore]
    """Scores of the features against each attribute, on true edges."""
    disentanglement: Disentanglement | None
    """DCI and MIG of the attributes on true edges."""
    stillness: Stillness
    """Change of the features over the whole history."""
    stillness_late: Stillness
    """Change of the features over the second half of the history."""
    reading: LinearReading | None
    """Linear estimate of the first attribute, for drawn graphs."""


@torch.inference_mode()
def infer_edges(forecaster: Forecaster, batch: WindowBatch) -> InferredEdges:
    """Streams histories of equal length and keeps edge features and probabilities of each step.

    Features that learned an attribute are in its unit.
    """
    memory = forecaster.empty_memory(batch.states.shape[0], batch.states.shape[2])
    beliefs: list[Belief] = []
    for step in range(int(batch.last_observed[0]) + 1):
        valid = batch.valid[:, step]
        memory, belief = forecaster.observe(memory, batch.states[:, step] * valid[..., None], valid)
        beliefs.append(belief.dense())
    return InferredEdges(
        _with_units(forecaster, torch.stack([b.edge_features for b in beliefs], dim=1)).cpu().numpy(),
        torch.stack([b.edge_probs for b in beliefs], dim=1).cpu().numpy(),
        pair_mask(batch.valid[:, : len(beliefs)]).cpu().numpy(),
    )


def _with_units(forecaster: Any, features: Tensor) -> Tensor:
    config = getattr(forecaster, "config", None)
    return config.with_units(features) if isinstance(config, DGVAEConfig) else features


def labelled_pairs(
    inferred: InferredEdges, batch: WindowBatch, episodes: Int[np.ndarray, " batch"], axes: int
) -> LabelledPairs | None:
    """Returns the pairs whose truth is known at the last observed step; None without labels."""
    last = int(batch.last_observed[0])
    if batch.edge_types is None and batch.edge_attributes is None:
        return None
    types = None if batch.edge_types is None else batch.edge_types[:, last].numpy()
    known = inferred.pairs[:, -1] & (True if types is None else types >= 0)
    window, receiver, sender = np.nonzero(known)
    # Both directions of a pair are adjacent, so that shuffled values keep their symmetry.
    order = np.lexsort((receiver, np.maximum(receiver, sender), np.minimum(receiver, sender), window))
    at = window[order], receiver[order], sender[order]
    attributes = (
        np.zeros((*known.shape, 0)) if batch.edge_attributes is None else batch.edge_attributes[:, last].numpy()
    )
    positions = batch.states[:, last, :, :axes].numpy()
    return LabelledPairs(
        inferred.features[:, -1][at],
        1 - inferred.edge_probs[:, -1, ..., 0][at],
        None if types is None else types[at] > 0,
        attributes[at],
        episodes[at[0]],
        np.linalg.norm(positions[at[0], at[1]] - positions[at[0], at[2]], axis=-1),
    )


def measure(
    forecaster: Forecaster,
    windows: Windows,
    parts: Iterable[Int[np.ndarray, " _"]],
    names: Sequence[str] = (),
    seed: int = 0,
    device: str = "cpu",
) -> tuple[Findings, Float[np.ndarray, " windows"]]:
    """Computes all findings, and the graph accuracy of each window (NaN without a known truth).

    Args:
        forecaster: model with edge features.
        windows: windows with one length of history.
        parts: numbers of the windows in ascending order, in batches.
        names: names of the attributes.
        seed: random seed of shuffles and halves.
        device: device of the forecaster.
    """
    tally, whole, late = GraphTally(forecaster.num_edge_types), StillnessTally(), StillnessTally()
    pairs_of_batches: list[LabelledPairs] = []
    accuracies: list[float] = []
    episodes: list[np.ndarray] = []
    for indices in parts:
        batch = windows.batch(indices)
        inferred = infer_edges(forecaster, batch.to(torch.device(device)))
        episodes.append(windows.index[indices, 0])
        edges = inferred.pairs[:, -1]
        if batch.edge_types is not None:
            types = batch.edge_types[:, int(batch.last_observed[0])].clamp(max=forecaster.num_edge_types - 1)
            probs, pairs = torch.from_numpy(inferred.edge_probs[:, -1]), torch.from_numpy(edges)
            tally.add(probs, types, pairs)
            found = [graph_accuracy(p[None], t[None], v[None]) for p, t, v in zip(probs, types, pairs, strict=True)]
            accuracies += [np.nan if f is None else f for f in found]
            edges = edges & (types > 0).numpy()
        known = labelled_pairs(inferred, batch, episodes[-1], windows.spec.position_dim)
        pairs_of_batches += [] if known is None else [known]
        for still, begin in ((whole, 0), (late, inferred.pairs.shape[1] // 2)):
            there = edges & inferred.pairs[:, begin:].all(axis=1)
            still.add(np.moveaxis(inferred.features[:, begin:], 1, 3)[there])
    findings = Findings(
        sum(map(len, episodes)),
        len(np.unique(np.concatenate(episodes))),
        graph=tally.results() if accuracies and not np.isnan(accuracies).all() else None,
        stillness=whole.results(),
        stillness_late=late.results(),
        **_scores(pairs_of_batches, names, getattr(getattr(forecaster, "config", None), "feature_labels", ()), seed),
    )
    return findings, np.array(accuracies)


def _scores(
    batches: Sequence[LabelledPairs], names: Sequence[str], learned: Sequence[str], seed: int
) -> dict[str, Any]:
    """Computes the part of `Findings` that needs labels.

    Args:
        batches: pairs whose truth is known.
        names: names of their attributes.
        learned: attributes that the first dimensions learned, in their order; none given, those of the data.
        seed: random seed of shuffles and halves.
    """
    if not sum(len(b.group) for b in batches):
        return {"edges": None, "separation": None, "attributes": [], "disentanglement": None, "reading": None}
    every = LabelledPairs.concatenate(batches)
    edges, relation, apart = every, None, None
    if every.exists is not None:
        exists = every.exists.astype(np.float64)
        leads = _learned_by("leader", learned)
        relation = score_factor("edge exists", every.features, exists, every.group, every.distance_m, leads, seed)
        apart = separation(every.features, every.edge_prob, every.exists)
        edges = every.where(every.exists)
    count = edges.attributes.shape[1]
    titles = [names[i] if i < len(names) else f"attribute {i}" for i in range(count)]
    if count:
        told = np.stack([known(edges.attributes[:, i], title) for i, title in enumerate(titles)], axis=1)
        edges = edges.where(np.isfinite(told).all(axis=1))
    dimensions = [_learned_by(title, learned) if learned else i for i, title in enumerate(titles)]
    attributes = [
        score_factor(title, edges.features, edges.attributes[:, i], edges.group, edges.distance_m, dimension, seed)
        for i, (title, dimension) in enumerate(zip(titles, dimensions, strict=True))
    ]
    return {
        "edges": relation,
        "separation": apart,
        "attributes": attributes,
        "disentanglement": disentanglement(edges.features, edges.attributes, edges.group, seed) if count else None,
        "reading": _reading(attributes[0], edges, dimensions[0]) if count else None,
    }


def _learned_by(name: str, learned: Sequence[str]) -> int | None:
    """Returns the dimension that learned an attribute; None if none did."""
    return learned.index(name) if name in learned else None


def _reading(score: FactorScore, edges: LabelledPairs, labelled: int | None) -> LinearReading | None:
    """Returns the labelled dimension unchanged if it explains the attribute, else the best one with a fitted line."""
    if score.dimension is None or score.correlation is None:
        return None
    if labelled is not None and score.direct_r2 is not None and score.direct_r2 > 0:
        return LinearReading(labelled)
    feature, attribute = edges.features[:, score.dimension].astype(np.float64), edges.attributes[:, 0]
    slope = score.correlation * float(attribute.std() / max(feature.std(), 1e-300))
    return LinearReading(score.dimension, slope, float(attribute.mean() - slope * feature.mean()))
