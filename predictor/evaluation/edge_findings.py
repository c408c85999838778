"""Watch a trained model on windows and gather what its edges say: rows of pairs, their truth, scores, graph."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from predictor.data.windows import WindowBatch, Windows
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
class Reading:
    """How a drawn graph gets the value of an attribute from the features: offset + slope × dimension."""

    dimension: int
    """Which feature."""
    slope: float = 1.0
    """1 where restricted labelling made the feature the attribute itself."""
    offset: float = 0.0
    """0 likewise."""


@dataclass(frozen=True)
class Watched:
    """What a model says of every pair at each step of the history, from the steps up to it."""

    features: Float[np.ndarray, "batch time agents agents dims"]
    """Edge features, receiver first."""
    edge_probs: Float[np.ndarray, "batch time agents agents types"]
    """Prior over edge types."""
    pairs: Bool[np.ndarray, "batch time agents agents"]
    """Pairs of two different agents that are there."""


@dataclass(frozen=True)
class PairRows:
    """Pairs of which the truth is known, at the last observed step; rows of an episode stand together."""

    features: Float[np.ndarray, "rows dims"]
    """Edge features."""
    edge_prob: Float[np.ndarray, " rows"]
    """The model's probability of an edge of any type."""
    exists: Bool[np.ndarray, " rows"] | None
    """Whether there is one; None where the data has attributes only."""
    attributes: Float[np.ndarray, "rows attributes"]
    """Known properties; no column where there are none."""
    group: Int[np.ndarray, " rows"]
    """Episode."""
    distance_m: Float[np.ndarray, " rows"]
    """Between the two agents."""

    def where(self, chosen: Bool[np.ndarray, " rows"]) -> "PairRows":
        """Some of the rows."""
        columns: dict[str, Any] = {name: None if rows is None else rows[chosen] for name, rows in vars(self).items()}
        return PairRows(**columns)

    @staticmethod
    def concatenate(parts: "Sequence[PairRows]") -> "PairRows":
        """The rows of several batches."""
        columns: dict[str, Any] = {}
        for name, first in vars(parts[0]).items():
            columns[name] = None if first is None else np.concatenate([vars(part)[name] for part in parts])
        return PairRows(**columns)


@dataclass(frozen=True)
class Findings:
    """All numbers; parts are None (or empty) where the data has no labels for them."""

    windows: int
    """Measured."""
    episodes: int
    """That they come from."""
    graph: GraphAccuracy | None
    """The inferred graph against the true one."""
    edges: FactorScore | None
    """Features against the existence of an edge, over all pairs."""
    separation: Separation | None
    """The same by ranks."""
    attributes: list[FactorScore]
    """Features against each attribute, on true edges."""
    disentanglement: Disentanglement | None
    """Of the attributes on true edges."""
    stillness: Stillness
    """Over the whole history."""
    stillness_late: Stillness
    """Over its second half, when the model has seen enough to make up its mind."""
    reading: Reading | None
    """Of the first attribute."""


@torch.inference_mode()
def watch(forecaster: Forecaster, batch: WindowBatch) -> Watched:
    """Stream the histories of windows that are all equally long, and keep what is believed at each step."""
    memory = forecaster.empty_memory(batch.states.shape[0], batch.states.shape[2])
    beliefs: list[Belief] = []
    for step in range(int(batch.last_observed[0]) + 1):
        valid = batch.valid[:, step]
        memory, belief = forecaster.observe(memory, batch.states[:, step] * valid[..., None], valid)
        beliefs.append(belief.dense())
    return Watched(
        torch.stack([b.edge_features for b in beliefs], dim=1).cpu().numpy(),
        torch.stack([b.edge_probs for b in beliefs], dim=1).cpu().numpy(),
        pair_mask(batch.valid[:, : len(beliefs)]).cpu().numpy(),
    )


def labelled_rows(
    watched: Watched, batch: WindowBatch, episodes: Int[np.ndarray, " batch"], axes: int
) -> PairRows | None:
    """The pairs whose truth is known at the last observed step; None without labels."""
    last = int(batch.last_observed[0])
    if batch.edge_types is None and batch.edge_attributes is None:
        return None
    types = None if batch.edge_types is None else batch.edge_types[:, last].numpy()
    known = watched.pairs[:, -1] & (True if types is None else types >= 0)
    window, receiver, sender = np.nonzero(known)
    # Both directions of a pair stand together, so that shuffled values keep their symmetry.
    order = np.lexsort((receiver, np.maximum(receiver, sender), np.minimum(receiver, sender), window))
    at = window[order], receiver[order], sender[order]
    attributes = (
        np.zeros((*known.shape, 0)) if batch.edge_attributes is None else batch.edge_attributes[:, last].numpy()
    )
    positions = batch.states[:, last, :, :axes].numpy()
    return PairRows(
        watched.features[:, -1][at],
        1 - watched.edge_probs[:, -1, ..., 0][at],
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
    """All numbers, and the graph accuracy of each window (NaN where no truth is known).

    Args:
        forecaster: with edge features.
        windows: of one length of history.
        parts: which windows, in ascending order, cut into batches.
        names: of the attributes.
        seed: of shuffles and halves.
        device: where the forecaster lives.
    """
    tally, whole, late = GraphTally(forecaster.num_edge_types), StillnessTally(), StillnessTally()
    rows: list[PairRows] = []
    accuracies: list[float] = []
    episodes: list[np.ndarray] = []
    for indices in parts:
        batch = windows.batch(indices)
        watched = watch(forecaster, batch.to(torch.device(device)))
        episodes.append(windows.index[indices, 0])
        edges = watched.pairs[:, -1]
        if batch.edge_types is not None:
            types = batch.edge_types[:, int(batch.last_observed[0])].clamp(max=forecaster.num_edge_types - 1)
            probs, pairs = torch.from_numpy(watched.edge_probs[:, -1]), torch.from_numpy(edges)
            tally.add(probs, types, pairs)
            found = [graph_accuracy(p[None], t[None], v[None]) for p, t, v in zip(probs, types, pairs, strict=True)]
            accuracies += [np.nan if f is None else f for f in found]
            edges = edges & (types > 0).numpy()
        known = labelled_rows(watched, batch, episodes[-1], windows.spec.position_dim)
        rows += [] if known is None else [known]
        for still, begin in ((whole, 0), (late, watched.pairs.shape[1] // 2)):
            there = edges & watched.pairs[:, begin:].all(axis=1)
            still.add(np.moveaxis(watched.features[:, begin:], 1, 3)[there])
    findings = Findings(
        sum(map(len, episodes)),
        len(np.unique(np.concatenate(episodes))),
        graph=tally.results() if accuracies and not np.isnan(accuracies).all() else None,
        stillness=whole.results(),
        stillness_late=late.results(),
        **_scores(rows, names, seed),
    )
    return findings, np.array(accuracies)


def _scores(rows: Sequence[PairRows], names: Sequence[str], seed: int) -> dict[str, Any]:
    """The labelled part of `Findings`."""
    if not sum(len(r.group) for r in rows):
        return {"edges": None, "separation": None, "attributes": [], "disentanglement": None, "reading": None}
    every = PairRows.concatenate(rows)
    edges, relation, apart = every, None, None
    if every.exists is not None:
        exists = every.exists.astype(np.float64)
        relation = score_factor("edge exists", every.features, exists, every.group, every.distance_m, seed=seed)
        apart = separation(every.features, every.edge_prob, every.exists)
        edges = every.where(every.exists)
    edges = edges.where(np.isfinite(edges.attributes).all(axis=1))
    count = edges.attributes.shape[1]
    titles = [names[i] if i < len(names) else f"attribute {i}" for i in range(count)]
    attributes = [
        score_factor(title, edges.features, edges.attributes[:, i], edges.group, edges.distance_m, i, seed)
        for i, title in enumerate(titles)
    ]
    return {
        "edges": relation,
        "separation": apart,
        "attributes": attributes,
        "disentanglement": disentanglement(edges.features, edges.attributes, seed) if count else None,
        "reading": _reading(attributes[0], edges) if count else None,
    }


def _reading(score: FactorScore, edges: PairRows) -> Reading | None:
    """Dimension 0 as it is where that explains the attribute; else the best dimension after a straight line."""
    if score.dimension is None or score.correlation is None:
        return None
    if score.direct_r2 is not None and score.direct_r2 > 0:
        return Reading(0)
    feature, attribute = edges.features[:, score.dimension].astype(np.float64), edges.attributes[:, 0]
    slope = score.correlation * float(attribute.std() / max(feature.std(), 1e-300))
    return Reading(score.dimension, slope, float(attribute.mean() - slope * feature.mean()))
