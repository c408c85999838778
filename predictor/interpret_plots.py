"""Pictures and tables of what edges mean (`predictor.interpret`): graphs, edge-feature matrices, forecasts, scores.

Functions take arrays (or what scores.json holds) and return an axis, a figure or text; nothing is computed here but
where things go on the page.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from jaxtyping import Bool, Float, Int
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.lines import Line2D

from predictor.graph_metrics import GraphAccuracy
from predictor.plots import plot_scene

GRAPH_QUANTILES = (0.1, 0.5, 0.9)
"""Of graph accuracy over windows: the ones that graph.png shows."""
NUM_TRAJECTORIES = 4
"""Windows in trajectories.png."""
DIMENSIONS_SHOWN = 4
"""Feature dimensions per block of features.png."""
RIGHT, MISSED, INVENTED, TRUE = "#1f5fa8", "#c0392b", "#e08e0b", "#404040"
WIDTHS = (1.0, 5.0)
"""Of a drawn edge [points], from the smallest true value to the largest."""
MAX_NUMBERED = 9
"""Agents up to which drawn edges bear numbers."""


class Reads(Protocol):
    """How a value is read off the features: offset + slope × dimension (`predictor.interpret.Reading`)."""

    @property
    def dimension(self) -> int:
        """Which feature."""

    @property
    def slope(self) -> float:
        """1 for the feature as it is."""

    @property
    def offset(self) -> float:
        """0 likewise."""


@dataclass(frozen=True)
class WindowShown:
    """One window with all that the pictures need; arrays are receiver first."""

    place: str
    """Where it is in the store."""
    names: Sequence[str]
    """Of the agents."""
    history: Float[np.ndarray, "time agents axes"]
    """Observed positions [m]."""
    history_valid: Bool[np.ndarray, "time agents"]
    """Who is there."""
    features: Float[np.ndarray, "time agents agents dims"]
    """Edge features at each observed step."""
    edge_prob: Float[np.ndarray, "agents agents"]
    """The model's probability of an edge at the last observed step."""
    pairs: Bool[np.ndarray, "time agents agents"]
    """Which pairs are there."""
    forecast: Float[np.ndarray, "samples agents horizon axes"]
    """Predicted positions [m]."""
    future: Float[np.ndarray, "agents horizon axes"]
    """True ones [m]."""
    future_valid: Bool[np.ndarray, "agents horizon"]
    """Which of them are known."""
    types: Int[np.ndarray, "agents agents"] | None = None
    """True edge types at the last observed step, -1 where unknown."""
    attributes: Float[np.ndarray, "agents agents attributes"] | None = None
    """Known properties of edges at that step."""


# --- Graphs -----------------------------------------------------------------------------------------------------------


def circle(agents: int) -> Float[np.ndarray, "agents 2"]:
    """Places on a circle, the first at the top, clockwise."""
    angle = np.pi / 2 - 2 * np.pi * np.arange(agents) / max(agents, 1)
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


def plot_graph(
    ax: Axes,
    places: Float[np.ndarray, "agents 2"],
    edges: Bool[np.ndarray, "agents agents"],
    names: Sequence[str],
    values: Float[np.ndarray, "agents agents"] | None = None,
    truth: Bool[np.ndarray, "agents agents"] | None = None,
    value_range: tuple[float, float] = (0.0, 1.0),
) -> Axes:
    """Edges with their values as numbers and widths; symmetric graphs as lines, others as arrows sender → receiver.

    Args:
        ax: where to draw.
        places: of the agents.
        edges: receiver first.
        names: of the agents.
        values: numbers on the edges.
        truth: right, missed (dotted) and invented edges get their own colour; None draws all in one.
        value_range: values that get the thinnest and the thickest line.
    """
    both = edges if truth is None else edges | truth
    directed = not np.array_equal(both, both.T) or not np.array_equal(edges, edges.T)
    numbered = values is not None and len(places) <= MAX_NUMBERED
    for receiver, sender in np.argwhere(both):
        if not directed and receiver > sender:
            continue
        color, missed = TRUE, False
        if truth is not None:
            missed = not edges[receiver, sender]
            color = MISSED if missed else RIGHT if truth[receiver, sender] else INVENTED
        width = 1.5
        if values is not None and not missed:
            share = (values[receiver, sender] - value_range[0]) / max(value_range[1] - value_range[0], 1e-12)
            width = WIDTHS[0] + (WIDTHS[1] - WIDTHS[0]) * float(np.clip(share, 0, 1))
        style = ":" if missed else "-"
        start, end = places[sender], places[receiver]
        if directed:
            ax.annotate(
                "", end, start, zorder=1,
                arrowprops={"arrowstyle": "-|>", "color": color, "lw": width, "ls": style, "shrinkA": 9, "shrinkB": 9,
                            "connectionstyle": "arc3,rad=0.12"},
            )  # fmt: skip
        else:
            ax.plot(*np.stack([start, end]).T, color=color, lw=width, ls=style, zorder=1)
        if numbered and not missed:
            assert values is not None
            middle = start + (end - start) * (0.5 if len(places) % 2 else 0.4)
            box = {"boxstyle": "round,pad=0.12", "fc": "white", "ec": "none", "alpha": 0.85}
            number = f"{values[receiver, sender]:.2f}"
            x, y = middle.tolist()
            ax.text(x, y, number, fontsize=7.5, color=color, ha="center", va="center", bbox=box, zorder=2)
    ax.scatter(places[:, 0], places[:, 1], s=210, color="white", edgecolors="black", zorder=3)
    for (x, y), name in zip(places.tolist(), names, strict=True):
        ax.text(x, y, name, fontsize=8, ha="center", va="center", zorder=4)
    return ax


def graphs_figure(
    windows: Sequence[WindowShown],
    reading: Reads | None,
    attribute_names: Sequence[str],
    graph: GraphAccuracy,
    where: str,
    on_circle: bool = True,
) -> Figure:
    """True graphs above, inferred ones below; one column per window."""
    figure = Figure(figsize=(4.3 * len(windows), 8.6), layout="constrained")
    axes = figure.subplots(2, len(windows), squeeze=False)
    for column, window in enumerate(windows):
        assert window.types is not None
        there = window.history_valid[-1]
        among = np.ix_(there, there)
        truth, prob = window.types[among] > 0, window.edge_prob[among]
        known = (window.types[among] >= 0) & ~np.eye(int(there.sum()), dtype=np.bool_)
        true_values = inferred = None
        if reading is not None and window.attributes is not None:
            true_values = window.attributes[..., 0][among]
            inferred = reading.offset + reading.slope * window.features[-1, ..., reading.dimension][among]
        symmetric = np.array_equal(truth, truth.T)
        if symmetric:  # one line per pair: the mean of both directions
            prob = (prob + prob.T) / 2
            inferred = None if inferred is None else (inferred + inferred.T) / 2
        said = (prob > 0.5) & known
        numbers = prob if inferred is None else inferred
        spread = (0.0, 1.0)
        if true_values is not None and truth.any():
            spread = (float(true_values[truth].min()), float(true_values[truth].max()))
        places = circle(int(there.sum())) if on_circle else window.history[-1, there, :2]
        names = [name for name, present in zip(window.names, there, strict=True) if present]
        plot_graph(axes[0, column], places, truth, names, true_values, value_range=spread)
        plot_graph(axes[1, column], places, said, names, numbers, truth, spread)
        counted = np.triu(known) if symmetric else known
        right, all_pairs = int((said == truth)[counted].sum()), int(counted.sum())
        axes[0, column].set_title(f"{_percentile(column)} window: {window.place}\ntruth", fontsize=10)
        what = "pairs" if symmetric else "ordered pairs"
        axes[1, column].set_title(
            f"inferred: {right} of {all_pairs} {what} right ({right / all_pairs:.2f})", fontsize=10
        )
        for ax in axes[:, column]:
            _frame(ax, on_circle)
    figure.legend(handles=_edge_legend(), loc="outside lower center", ncols=4, frameon=False, fontsize=9)
    figure.suptitle(
        f"{where}: accuracy {graph.accuracy:.3f} over all ordered pairs (saying 'edge' everywhere: "
        f"{graph.true_connectivity:.3f})\nnumbers and widths: {_value_name(reading, attribute_names)}",
        fontsize=10,
    )
    return figure


def _percentile(column: int) -> str:
    quantile = GRAPH_QUANTILES[column]
    return "median" if quantile == 0.5 else f"{100 * quantile:.0f}th percentile"


def _value_name(reading: Reads | None, names: Sequence[str]) -> str:
    if reading is None or not names:
        return "the model's probability of an edge (truth: none)"
    if (reading.slope, reading.offset) == (1.0, 0.0):
        return f"{names[0]}; inferred: feature {reading.dimension} as it is"
    return f"{names[0]}; inferred: feature {reading.dimension}, brought to its unit by a line fitted to the truth"


def _frame(ax: Axes, on_circle: bool) -> None:
    if on_circle:
        ax.set_aspect("equal")
        ax.set(xlim=(-1.25, 1.25), ylim=(-1.25, 1.25))
        ax.set_axis_off()
        return
    ax.margins(0.12, 0.25)
    ax.set_xlabel("x [m]")
    ax.set_ylabel("y [m], not to x's scale")


def _edge_legend() -> list[Line2D]:
    kinds = (
        ("true edge", TRUE, "-"),
        ("inferred, right", RIGHT, "-"),
        ("missed", MISSED, ":"),
        ("invented", INVENTED, "-"),
    )
    return [Line2D([], [], color=color, ls=style, lw=2.5, label=label) for label, color, style in kinds]


# --- Edge features ----------------------------------------------------------------------------------------------------


def plot_matrix(
    ax: Axes, matrix: Float[np.ndarray, "agents agents"], limits: tuple[float, float], names: Sequence[str]
) -> Axes:
    """Receivers × senders as a heat map; NaN (no pair, no edge) is grey."""
    ax.set_facecolor("0.85")
    low, high = limits
    ax.imshow(np.ma.masked_invalid(matrix), vmin=low, vmax=high if high > low else low + 1e-6, cmap="viridis")
    size = 8 if len(names) <= 12 else 4.5
    ax.set_xticks(range(len(names)), names, fontsize=size, rotation=90 if max(map(len, names)) > 2 else 0)
    ax.set_yticks(range(len(names)), names, fontsize=size)
    return ax


def features_figure(
    window: WindowShown, static_dim: int, dt_s: float, attribute_names: Sequence[str], where: str
) -> Figure:
    """Matrices of the first dimensions at the first and the last observed step; static and dynamic ones apart."""
    there = window.history_valid[-1]
    among = np.ix_(there, there)
    names = [name for name, present in zip(window.names, there, strict=True) if present]
    steps = {0: "first step", len(window.features) - 1: f"last step ({(len(window.features) - 1) * dt_s:.3g} s later)"}
    matrices = {step: np.where(window.pairs[step, ..., None], window.features[step], np.nan)[among] for step in steps}
    dims = window.features.shape[-1]
    blocks: list[tuple[str, range]] = []
    if static_dim:
        blocks.append((f"static: dimensions 0–{static_dim - 1} are averaged over the past", range(static_dim)))
    if static_dim < dims:
        held = "free to change at every step"
        blocks.append((f"dynamic: dimensions {static_dim}–{dims - 1} are {held}", range(static_dim, dims)))
    truths = _true_matrices(window, attribute_names)
    side = float(np.clip(0.14 * len(names), 2.0, 4.4))
    columns = DIMENSIONS_SHOWN + len(truths)
    figure = Figure(
        figsize=(1.0 + 1.18 * side * columns, len(blocks) * (2.15 * side + 0.9) + 0.7), layout="constrained"
    )
    figure.suptitle(
        f"Edge features, {where}, {window.place}\nrow: receiver (who is influenced); column: sender; grey: no pair"
        + (", or no edge in the true matrices" if truths else ""),
        fontsize=11,
    )
    parts = figure.subfigures(len(blocks), 1, squeeze=False)[:, 0]
    for (title, block), part in zip(blocks, parts, strict=True):
        part.suptitle(title, fontsize=11, fontweight="bold")
        _feature_block(part, block[:DIMENSIONS_SHOWN], matrices, steps, names, truths)
    return figure


def _true_matrices(window: WindowShown, names: Sequence[str]) -> dict[str, np.ndarray]:
    """The known attributes on true edges (existence where there are none), as the heat maps need them."""
    there = window.history_valid[-1]
    among = np.ix_(there, there)
    pairs = window.pairs[-1][among]
    found = {}
    if window.types is not None and (window.types[among] >= 0).any():
        pairs = pairs & (window.types[among] >= 0)
        if not names:
            found["edge exists"] = np.where(pairs, window.types[among] > 0, np.nan)
        pairs = pairs & (window.types[among] > 0)
    if window.attributes is not None:
        for column, name in enumerate(names[:2]):
            found[name] = np.where(pairs, window.attributes[..., column][among], np.nan)
    return found


def _feature_block(
    part: SubFigure | Figure,
    dimensions: range,
    matrices: dict[int, np.ndarray],
    steps: dict[int, str],
    names: Sequence[str],
    truths: dict[str, np.ndarray],
) -> None:
    axes = part.subplots(2, DIMENSIONS_SHOWN + len(truths), squeeze=False)
    for row, (step, label) in enumerate(steps.items() if len(steps) == 2 else [*steps.items()] * 2):
        for column, dimension in enumerate(dimensions):
            ax = axes[row, column]
            both = np.stack([m[..., dimension] for m in matrices.values()])
            limits = (float(np.nanmin(both)), float(np.nanmax(both)))
            plot_matrix(ax, matrices[step][..., dimension], limits, names)
            ax.set_title(f"feature {dimension}, {label}", fontsize=9)
            if row:
                part.colorbar(ax.images[0], ax=axes[:, column], shrink=0.6, pad=0.02).ax.tick_params(labelsize=7)
    for column, (name, matrix) in enumerate(truths.items(), DIMENSIONS_SHOWN):
        ax = axes[1, column]
        finite = matrix[np.isfinite(matrix)]
        limits = (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 1.0)
        plot_matrix(ax, matrix, limits, names)
        ax.set_title(f"truth: {name}", fontsize=9, color="darkgreen")
        part.colorbar(ax.images[0], ax=axes[:, column], shrink=0.6, pad=0.02).ax.tick_params(labelsize=7)
    for ax in axes.flat:
        if not ax.images:
            ax.set_axis_off()


# --- Forecasts --------------------------------------------------------------------------------------------------------


def trajectories_figure(windows: Sequence[WindowShown], feature_names: Sequence[str], where: str) -> Figure:
    """Samples beside the truth; three axes are seen along the one with the least variance."""
    axes_shown = shown_axes(np.concatenate([w.history[w.history_valid] for w in windows]))
    figure = Figure(figsize=(11, 9), layout="constrained")
    for ax, window in zip(
        figure.subplots(2, 2).flat, [*windows, *[None] * (NUM_TRAJECTORIES - len(windows))], strict=True
    ):
        if window is None:
            ax.set_axis_off()
            continue
        plot_scene(
            ax,
            window.history[..., axes_shown],
            window.history_valid,
            window.forecast[..., axes_shown],
            window.future[..., axes_shown],
            window.future_valid,
        )
        names = [feature_names[axis].removesuffix("_m") for axis in axes_shown]
        ax.set_xlabel(f"{names[0]} [m]")
        ax.set_ylabel(f"{names[1]} [m]")
        ax.set_title(f"{window.place}{_error(window)}", fontsize=10)
    view = "" if windows[0].history.shape[-1] == 2 else "; seen along the axis that varies least"
    samples = len(windows[0].forecast)
    figure.suptitle(
        f"{where}\nhistory solid (square: now), {samples} forecasts dashed, truth thin black{view}", fontsize=11
    )
    return figure


def shown_axes(positions: Float[np.ndarray, "points axes"]) -> list[int]:
    """The two axes with the largest variance, in their own order."""
    return sorted(np.argsort(-positions.var(axis=0), kind="stable")[:2].tolist())


def _error(window: WindowShown) -> str:
    """Mean over agents of the best sample's mean displacement."""
    whole = window.future_valid.all(axis=-1)
    if not whole.any():
        return ""
    distance = np.linalg.norm(window.forecast - window.future, axis=-1).mean(axis=-1)[:, whole]
    return f"; minADE {distance.min(axis=0).mean():.3g} m, first sample {distance[0].mean():.3g} m"


# --- Table ------------------------------------------------------------------------------------------------------------


def scores_markdown(content: dict[str, Any]) -> str:
    """What scores.json holds, as tables and sentences."""
    parts = [
        f"# What the edges of `{content['config']['checkpoint']}` say about {content['source']}",
        f"{content['windows']} windows of {content['episodes']} episodes; features are read at the last of "
        f"{content['config']['history_steps']} observed steps.",
    ]
    relation = content["edges"]
    if content["has_ego"] and relation is not None:
        parts.append("An edge exists where the sender is the receiver's leader.")
    scores = [score for score in [relation, *content["attributes"]] if score is not None]
    if scores:
        parts += ["## In words", "\n".join(f"* {_sentence(score)}" for score in scores)]
        parts += ["## What features know", _factor_table(scores), FACTOR_NOTE]
    if content["graph"] is not None:
        parts += ["## Graph", _graph_lines(content)]
    if content["disentanglement"] is not None:
        parts += ["## Disentanglement", _disentanglement_lines(content)]
    parts += ["## Dimension by dimension", _dimension_table(content, scores), _stillness_note(content)]
    made = content["provenance"]
    parts.append(f"Made by `{made['command']}`, commit {made['commit']}, {made['time']}.")
    return "\n\n".join(parts) + "\n"


FACTOR_NOTE = (
    "best: dimension with the largest |r|. chance: the largest |r| among all dimensions that 95 of 100 shuffled "
    "properties stay below. distance: r of the property with the distance between the two agents, for comparison. "
    "linear R²: all dimensions, fitted on half of the episodes, scored on the other half. direct R²: dimension i as it "
    "is against attribute i; only restricted labelling aims at it (negative: worse than the mean)."
)


def _sentence(score: dict[str, Any]) -> str:
    name, r, chance = f"**{score['name']}**", score["correlation"], score["chance"]
    if r is None:
        return f"{name}: nothing to say; {score['rows']} pairs, or all of them are alike."
    if abs(r) <= chance:
        return f"{name}: no feature goes with it beyond chance (best |r| {abs(r):.2f}, chance {chance:.2f})."
    by_hand = abs(score["distance_correlation"]) >= abs(r)
    ruler = f"; the distance alone does no worse (r = {score['distance_correlation']:+.2f})" if by_hand else ""
    return f"{name}: feature {score['dimension']} goes with it, r = {r:+.2f} (chance {chance:.2f}){ruler}."


def _factor_table(scores: Sequence[dict[str, Any]]) -> str:
    rows = [
        [
            s["name"],
            str(s["rows"]),
            "–" if s["dimension"] is None else str(s["dimension"]),
            _signed(s["correlation"]),
            _plain(s["r2"]),
            _plain(s["chance"]),
            _signed(s["distance_correlation"]),
            _plain(s["linear_r2"]),
            _plain(s["direct_r2"]),
        ]
        for s in scores
    ]
    header = ["property", "pairs", "best", "r", "r²", "chance", "distance", "linear R²", "direct R²"]
    return _table(header, rows)


def _graph_lines(content: dict[str, Any]) -> str:
    graph, apart = content["graph"], content["separation"]
    lines = [
        f"* accuracy {_plain(graph['accuracy'])}, F1 {_plain(graph['f1'])} over {graph['pairs']} ordered pairs; "
        f"always saying 'edge' has accuracy {_plain(graph['true_connectivity'])}, always 'no edge' "
        f"{_plain(None if graph['true_connectivity'] is None else 1 - graph['true_connectivity'])}"
    ]
    if apart is not None:
        lines.append(
            f"* chance that an edge has the larger value than a non-edge (AUC; 0.5 knows nothing, near 0 is as good as "
            f"near 1): feature {apart['dimension']} {_plain(apart['auc'])}, the model's own probability "
            f"{_plain(apart['edge_prob_auc'])}"
        )
    return "\n".join(lines)


def _disentanglement_lines(content: dict[str, Any]) -> str:
    found = content["disentanglement"]
    lines = [
        f"* MIG {_plain(found['mig'])} over {found['rows']} true edges (1: each attribute is held by one dimension alone, "
        "0: by none, or by two alike)"
    ]
    if found["dci"] is not None:
        dci = found["dci"]
        one = "" if dci["disentanglement"] is not None else " (not defined for one attribute)"
        lines.append(
            f"* DCI: disentanglement {_plain(dci['disentanglement'])}{one}, completeness "
            f"{_plain(dci['completeness'])}, informativeness {_plain(dci['informativeness'])}"
        )
    if found["note"]:
        lines.append(f"* DCI not available: {found['note']}")
    return "\n".join(lines)


def _dimension_table(content: dict[str, Any], scores: Sequence[dict[str, Any]]) -> str:
    scored = [s for s in scores if s["correlations"]]
    whole, late = content["stillness"], content["stillness_late"]
    rows = []
    for d, spread in enumerate(late["spread"]):
        kind = "static" if d < content["static_dim"] else "dynamic"
        row = [str(d), kind, f"{spread:.3g}", _plain(whole["within"][d], 2), _plain(late["within"][d], 2)]
        rows.append(row + [_signed(s["correlations"][d]) for s in scored])
    header = ["feature", "kind", "spread", "changing", "changing, 2nd half", *(f"r: {s['name']}" for s in scored)]
    return _table(header, rows)


def _stillness_note(content: dict[str, Any]) -> str:
    whole, late = content["stillness"], content["stillness_late"]
    which = "true edges" if content["edges"] is not None else "pairs"
    return (
        f"changing: variance within a pair over time / variance over pairs and time; 0 stands still, 1 is all change. "
        f"Over all {whole['steps']} observed steps ({whole['edges']} {which} that are there throughout), and over the "
        f"second half ({late['edges']}). static: averaged over the past (pair matching), so stiller by construction. "
        f"spread: standard deviation in the second half; a dash beside it is a dimension that never changes at all."
    )


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    return "\n".join(f"| {' | '.join(cells)} |" for cells in [header, ["---"] * len(header), *rows])


def _plain(value: float | None, places: int = 3) -> str:
    return "–" if value is None else f"{value:.{places}f}"


def _signed(value: float | None) -> str:
    return "–" if value is None else f"{value:+.2f}"
