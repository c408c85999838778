"""What a dG-VAE's edges mean, in pictures and numbers: `python -m predictor.interpret --checkpoint DIR --data STORE`.

Watches windows with a trained model and writes `graph.png` (inferred graph beside the truth), `features.png` (edge
features as matrices), `trajectories.png` (samples beside the truth), `scores.json` and `scores.md`: which feature
dimension goes with which known property of an edge, beside what chance and a ruler would give, how disentangled the
features are (DCI, MIG), how still they stand over time. Stores without labels get what needs none.

Everything is read off at the last observed step, from the past alone. A correlation says that the number is there, not
that the decoder uses it (docs/interpretability.md).
"""

import os
import shutil
import uuid
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from jaxtyping import Bool, Float, Int
from rich.console import Console
from rich.markdown import Markdown
from rich.progress import track

from predictor import interpret_plots as pictures
from predictor.checkpoint import CONSTANT_VELOCITY, CheckpointInfo, load_checkpoint
from predictor.data.store import StoreInfo, read_store
from predictor.data.windows import WindowBatch, Windows
from predictor.errors import UserError, run_entry_point
from predictor.feature_scores import DCI, dci, direct_r2, linear_r2, mig
from predictor.forecaster import Belief, Forecaster
from predictor.graph import pair_mask
from predictor.graph_metrics import GraphAccuracy, GraphTally, graph_accuracy
from predictor.interpret_plots import Reading
from predictor.outcomes import run_window_batch
from predictor.provenance import provenance, write_json
from predictor.scene import SceneSpec

SHUFFLES = 100
CHANCE_QUANTILE = 0.95
"""Of the best |r| that a shuffled factor finds among all dimensions."""
FLAT = 1e-6
"""A dimension whose standard deviation is below this share of its size (or of 1) says nothing: it is float noise."""
BATCH_BYTES = 64_000_000
"""Of a batch's features over time."""
FEATURED = ("dgvae",)
"""Models whose edge features mean something; the others fill in zeros."""
FILES = ("graph.png", "features.png", "trajectories.png", "scores.json", "scores.md")


@dataclass(frozen=True)
class InterpretConfig:
    """Draw and measure what a checkpoint's edges and edge features say."""

    checkpoint: str
    """A dG-VAE: shipped name or folder."""
    data: Path
    """Episode store that was not trained on; edge labels are used where it has them."""
    out: Path
    """Folder for the three pictures, scores.json and scores.md."""
    windows: int = 300
    """Windows to measure on, drawn evenly from the store (fewer if it has fewer)."""
    history_steps: int = 40
    """Steps observed before features are read and the forecast begins."""
    horizon_steps: int = 10
    """Steps that are forecast in trajectories.png; a window has so many after its history."""
    samples: int = 20
    """Forecasts drawn per agent."""
    seed: int = 0
    """Of the drawn windows, samples and shuffles."""
    device: str = "cpu"
    """"cpu" or "cuda"."""

    def check(self) -> None:
        """Check ranges.

        Raises:
            UserError: a value that makes no sense. (In `__post_init__`, tyro would turn it into a box of lines.)
        """
        if self.device.startswith("cuda") and not torch.cuda.is_available():
            raise UserError(f"device '{self.device}' asked for but torch sees no CUDA device; use --device cpu")
        for name in ("windows", "history_steps", "horizon_steps", "samples"):
            if getattr(self, name) < 1:
                raise UserError(f"{name} must be at least 1, got {getattr(self, name)}")
        if self.out.exists() and not self.out.is_dir():
            raise UserError(f"out must be a folder, but {self.out} is a file; choose another path")


# --- Pure functions: arrays in, numbers out ---------------------------------------------------------------------------


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
    """Rank statistic: the chance that a pair with an edge has the larger value than a pair without (0.5: no use)."""

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
    """Share of (edge, no edge) couples in which the edge has the larger value, ties half; 0.5 knows nothing.

    Raises:
        ValueError: all rows are edges, or none.
    """
    with_edge, without = int(exists.sum()), int((~exists).sum())
    if not with_edge or not without:
        raise ValueError(f"rows with and without an edge are needed, got {with_edge} with and {without} without")
    found = []
    for column in values.T:
        _, kind, count = np.unique(column, return_inverse=True, return_counts=True)
        ranks = (np.cumsum(count) - (count - 1) / 2)[kind]
        found.append(float((ranks[exists].sum() - with_edge * (with_edge + 1) / 2) / (with_edge * without)))
    return found


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
    """DCI (where scikit-learn is installed) and MIG of the factors that vary."""
    if len(features) < 4:
        return Disentanglement(len(features), None, None, f"needs at least 4 edges, got {len(features)}")
    factors = factors[:, _standardised(factors).any(axis=0)]
    if not factors.shape[1]:
        return Disentanglement(len(features), None, None, "no attribute varies")
    found, note = None, ""
    try:
        found = dci(features, factors, seed=seed)
    except UserError as error:
        note = str(error)
    return Disentanglement(len(features), mig(features, factors), found, note)


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
        """Take in edges that are there at all of the steps."""
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


# --- Watching a model -------------------------------------------------------------------------------------------------


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
        beliefs.append(belief)
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


# --- Entry point ------------------------------------------------------------------------------------------------------


def interpret(config: InterpretConfig) -> Findings:
    """Measure, draw and write everything under `config.out`; nothing is written if anything is refused.

    Raises:
        UserError: a model without edge features, a store that does not fit it, or no window that is long enough.
    """
    model, info = _load_model(config.checkpoint, config.device)
    store = read_store(config.data)
    info.spec.check_compatible(store.info.spec, f"checkpoint '{config.checkpoint}'", f"store {config.data}")
    try:
        lengths = (config.history_steps, config.horizon_steps)
        windows = Windows(
            store.episodes, info.spec, *lengths, min_future_steps=lengths[1], min_history_steps=lengths[0]
        )
    except UserError as error:
        raise UserError(f"store {config.data}: {error}; lower --history-steps or --horizon-steps") from error
    drawn = np.random.default_rng(config.seed).permutation(len(windows))[: config.windows]
    first = _with_pairs(windows, drawn)
    if not first:
        raise UserError(f"store {config.data}: in {len(drawn)} windows there are never two agents at once, so no edges")
    columns = max(e.states.shape[1] for e in store.episodes)
    size = max(1, BATCH_BYTES // (4 * config.history_steps * columns**2 * model.edge_feature_dim))
    parts = np.array_split(np.sort(drawn), -(-len(drawn) // size))
    findings, accuracies = measure(
        model, windows, track(parts, description="watch"), store.info.edge_attribute_names, config.seed, config.device
    )
    content = _content(config, info, store.info, findings)
    out = config.out.resolve()
    partial = out.with_name(f".{out.name}.{uuid.uuid4().hex[:8]}.partial")
    partial.mkdir(parents=True)
    try:
        shown = _shown(config, model, windows, first, store.info)
        graphs = _shown(config, model, windows, _by_accuracy(np.sort(drawn), accuracies), store.info)
        _draw(partial, config, content, findings, shown, graphs, info.spec)
        write_json(partial / "scores.json", content)
        (partial / "scores.md").write_text(pictures.scores_markdown(content), encoding="utf-8")
        out.mkdir(exist_ok=True)
        for name in FILES:
            if (partial / name).exists():
                os.replace(partial / name, out / name)
            else:  # of an earlier run; it would mislead beside the new ones
                (out / name).unlink(missing_ok=True)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return findings


def _load_model(name: str, device: str) -> tuple[Any, CheckpointInfo]:
    if name == CONSTANT_VELOCITY:
        raise UserError("'constant-velocity' has no edge features to interpret; pass a dG-VAE checkpoint")
    model, info = load_checkpoint(name, device)
    if info.model not in FEATURED or not model.edge_feature_dim:
        what = "was trained with edge_feature_dim=0" if info.model in FEATURED else f"is a model '{info.model}'"
        raise UserError(
            f"checkpoint '{name}' {what} and has no edge features to interpret; pass a dG-VAE with edge_feature_dim > 0"
        )
    return model, info


def _with_pairs(windows: Windows, drawn: Int[np.ndarray, " drawn"]) -> list[int]:
    """The first few drawn windows in which there is a pair at the last observed step."""
    found: list[int] = []
    for index in drawn.tolist():
        batch = windows.batch(np.array([index]))
        if int(batch.valid[0, int(batch.last_observed[0])].sum()) > 1:
            found.append(index)
        if len(found) == pictures.NUM_TRAJECTORIES:
            break
    return found


def _by_accuracy(indices: Int[np.ndarray, " windows"], accuracies: Float[np.ndarray, " known"]) -> list[int]:
    """Windows at the quantiles of graph accuracy that are drawn; none where no truth is known."""
    if not len(accuracies):
        return []
    order = indices[np.argsort(accuracies, kind="stable")][: int((~np.isnan(accuracies)).sum())]  # NaN is last
    return [int(order[int(round(q * (len(order) - 1)))]) for q in pictures.GRAPH_QUANTILES] if len(order) else []


def _content(config: InterpretConfig, info: CheckpointInfo, store: StoreInfo, findings: Findings) -> dict[str, Any]:
    """What scores.json holds and scores.md is made of."""
    return {
        "source": store.source,
        "dt_s": info.spec.dt_s,
        "has_ego": info.spec.has_ego,
        "static_dim": info.config.static_dim,
        "config": asdict(config),
        **asdict(findings),
        "provenance": provenance(("torch", "numpy", "scikit-learn")),
    }


def _shown(
    config: InterpretConfig, model: Any, windows: Windows, indices: Iterable[int], store: StoreInfo
) -> list[pictures.WindowShown]:
    """Some windows with all that the pictures need."""
    device, made = torch.device(config.device), []
    for index in indices:
        batch = windows.batch(np.array([index]))
        watched = watch(model, batch.to(device))
        generator = torch.Generator(device).manual_seed(config.seed)
        outcome = run_window_batch(model, batch.to(device), config.horizon_steps, config.samples, generator)
        episode, last = windows.index[index].tolist()
        now = int(batch.last_observed[0])
        made.append(
            pictures.WindowShown(
                f"episode {episode}, step {last}",
                _agent_names(batch.states.shape[2], store),
                batch.states[0, : now + 1, :, : windows.spec.position_dim].numpy(),
                batch.valid[0, : now + 1].numpy(),
                watched.features[0],
                1 - watched.edge_probs[0, -1, ..., 0],
                watched.pairs[0],
                outcome.forecast[0].cpu().numpy(),
                outcome.future[0].cpu().numpy(),
                outcome.valid[0].cpu().numpy(),
                None if batch.edge_types is None else batch.edge_types[0, now].numpy(),
                None if batch.edge_attributes is None else batch.edge_attributes[0, now].numpy(),
            )
        )
    return made


def _agent_names(agents: int, store: StoreInfo) -> list[str]:
    """Joint names where the store has them (and everybody is there), else numbers."""
    joints = store.provenance.get("joints", ())
    if len(joints) == agents:
        return [str(joint) for joint in joints]
    return ["ego" if store.spec.has_ego and not i else str(i) for i in range(agents)]


def _draw(
    folder: Path,
    config: InterpretConfig,
    content: dict[str, Any],
    findings: Findings,
    shown: Sequence[pictures.WindowShown],
    graphs: Sequence[pictures.WindowShown],
    spec: SceneSpec,
) -> None:
    """The pictures."""
    where = f"{config.checkpoint} on {content['source']}"
    names = [score.name for score in findings.attributes]
    figures = {
        "features.png": pictures.features_figure(shown[0], content["static_dim"], spec.dt_s, names, where),
        "trajectories.png": pictures.trajectories_figure(shown, spec.feature_names, where),
    }
    if graphs and findings.graph is not None:
        figures["graph.png"] = pictures.graphs_figure(
            graphs, findings.reading, names, findings.graph, where, on_circle=not spec.has_ego
        )
    for name, figure in figures.items():
        figure.savefig(folder / name, dpi=110)


def main() -> None:
    """Entry point."""
    config = tyro.cli(InterpretConfig, description=__doc__)
    config.check()
    interpret(config)
    Console(width=160).print(Markdown((config.out / "scores.md").read_text(encoding="utf-8")))


if __name__ == "__main__":
    run_entry_point(main)
