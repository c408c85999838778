"""Draws edges for `predictor.interpret`: graphs, edge-feature matrices, forecasts.

Functions take arrays and return an axis or a figure; they compute the layout only.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from predictor.evaluation.edge_findings import LinearReading
from predictor.evaluation.graph_accuracy import GraphAccuracy
from predictor.reports.looks import AS_TEXT, BLUE, ORANGE, STYLE, YELLOW
from predictor.reports.plots import plot_scene
from predictor.reports.tables import plain

GRAPH_QUANTILES = (0.0, 0.1, 0.5)
"""Quantiles of graph accuracy whose windows graph.png shows, the least accurate first."""

NUM_TRAJECTORIES = 4
"""Number of windows in trajectories.png."""

DIMENSIONS_SHOWN = 4
"""Number of feature dimensions per block of features.png."""

RIGHT, MISSED, INVENTED, TRUE = BLUE, ORANGE, YELLOW, "#404040"

WIDTHS = (1.0, 5.0)
"""Line widths of drawn edges [points], from the smallest true value to the largest."""

ROAD_RATIO = 6.0
"""Least ratio of length to width of a scene that is drawn not to scale, so that a road is not a thin line."""

MAX_NUMBERED = 9
"""Largest number of agents with numbers on drawn edges."""

MAX_NAMED = 40
"""Largest number of agents with names beside matrices."""

CROWD, SAMPLES_IN_CROWD = 12, 5
"""Number of agents above which fewer samples are drawn, and the number of these samples."""


@dataclass(frozen=True)
class WindowShown:
    """One window with the arrays of all pictures, receiver first."""

    place: str
    """Episode and step of the window in the store."""
    names: Sequence[str]
    """Names of the agents."""
    history: Float[np.ndarray, "time agents axes"]
    """Observed positions [m]."""
    history_valid: Bool[np.ndarray, "time agents"]
    """Whether the agent is present."""
    features: Float[np.ndarray, "time agents agents dims"]
    """Edge features at each observed step."""
    edge_prob: Float[np.ndarray, "agents agents"]
    """Probability of an edge at the last observed step, by the model."""
    pairs: Bool[np.ndarray, "time agents agents"]
    """Whether both agents of the pair are present."""
    forecast: Float[np.ndarray, "samples agents horizon axes"]
    """Predicted positions [m]."""
    future: Float[np.ndarray, "agents horizon axes"]
    """True positions [m]."""
    future_valid: Bool[np.ndarray, "agents horizon"]
    """Whether the true position is known."""
    types: Int[np.ndarray, "agents agents"] | None = None
    """True edge types at the last observed step, -1 where unknown."""
    attributes: Float[np.ndarray, "agents agents attributes"] | None = None
    """Known properties of edges at that step."""


def circle(agents: int) -> Float[np.ndarray, "agents 2"]:
    """Returns places on a unit circle, the first at the top, clockwise."""
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
    """Draws edges with their values as numbers and widths; a symmetric graph as lines, others as arrows to receivers.

    Args:
        ax: axis to draw on.
        places: positions of the agents.
        edges: whether there is an edge, receiver first.
        names: names of the agents.
        values: numbers on the edges; among arrows, which may be many, on true edges only.
        truth: true edges; right, missed (dotted) and invented edges get a colour each; None draws all in one colour.
        value_range: values of the thinnest and the thickest line.
    """
    both = edges if truth is None else edges | truth
    directed = not np.array_equal(both, both.T) or not np.array_equal(edges, edges.T)
    for receiver, sender in np.argwhere(both):
        if not directed and receiver > sender:
            continue
        missed = not edges[receiver, sender]
        real = truth is None or bool(truth[receiver, sender])
        color = TRUE if truth is None else MISSED if missed else RIGHT if real else INVENTED
        width = 1.5
        if values is not None and not missed and (real or not directed):
            share = (values[receiver, sender] - value_range[0]) / max(value_range[1] - value_range[0], 1e-12)
            width = WIDTHS[0] + (WIDTHS[1] - WIDTHS[0]) * float(np.clip(share, 0, 1))
            if len(places) <= MAX_NUMBERED:
                x, y = places[sender] + (places[receiver] - places[sender]) * (0.5 if len(places) % 2 else 0.4)
                box = {"boxstyle": "round,pad=0.12", "fc": "white", "ec": "none"}
                number = f"{values[receiver, sender]:.2f}"
                ax.text(x, y, number, fontsize=8.5, color=color, ha="center", va="center", bbox=box, zorder=2)
        style: dict[str, Any] = {"color": color, "lw": width, "ls": ":" if missed else "-"}
        if directed:
            style |= {"arrowstyle": "-|>", "shrinkA": 10, "shrinkB": 10, "connectionstyle": "arc3,rad=0.12"}
            ax.annotate("", places[receiver], places[sender], arrowprops=style, zorder=1.5 if real else 1)
        else:
            ax.plot(*places[[sender, receiver]].T, zorder=1, **style)
    ax.scatter(places[:, 0], places[:, 1], s=290, color="white", edgecolors="black", zorder=3)
    for (x, y), name in zip(places.tolist(), names, strict=True):
        ax.text(x, y, name, fontsize=8, ha="center", va="center", zorder=4)
    return ax


@rc_context(STYLE)
def graphs_figure(
    windows: Sequence[WindowShown],
    reading: LinearReading | None,
    attribute_names: Sequence[str],
    graph: GraphAccuracy,
    where: str,
    on_circle: bool = True,
) -> Figure:
    """Draws true graphs above, inferred ones below, one column per window."""
    figure = Figure(figsize=(4.3 * len(windows), 8.4), layout="constrained")
    axes = figure.subplots(2, len(windows), squeeze=False)
    every = [w.types > 0 for w in windows if w.types is not None]
    drawn = [w.attributes[..., 0][w.types > 0] for w in windows if w.attributes is not None and w.types is not None]
    known_values = np.concatenate([*drawn, np.zeros(0)])
    spread = (float(known_values.min()), float(known_values.max())) if reading and len(known_values) else (0.0, 1.0)
    symmetric = any(edges.any() for edges in every) and all(np.array_equal(edges, edges.T) for edges in every)
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
        if symmetric:  # one line per pair: the mean of both directions
            prob = (prob + prob.T) / 2
            inferred = None if inferred is None else (inferred + inferred.T) / 2
        found = (prob > 0.5) & known
        numbers = prob if inferred is None else inferred
        places = circle(int(there.sum())) if on_circle else window.history[-1, there, :2]
        names = [name for name, present in zip(window.names, there, strict=True) if present]
        plot_graph(axes[0, column], places, truth, names, true_values, value_range=spread)
        plot_graph(axes[1, column], places, found, names, numbers, truth, spread)
        counted = np.triu(known) if symmetric else known
        right, all_pairs = int((found == truth)[counted].sum()), int(counted.sum())
        axes[0, column].set_title(f"{_percentile(column)} window: {window.place}\ntruth", fontsize=10)
        share, what = right / max(1, all_pairs), "pairs" if symmetric else "ordered pairs"
        found_line = f"inferred: edge or none right for\n{right} of {all_pairs} {what} ({share:.2f})"
        axes[1, column].set_title(found_line, fontsize=10)
        for ax in axes[:, column]:
            _frame(ax, on_circle)
    figure.legend(handles=_edge_legend(), loc="outside lower center", ncols=4, frameon=False, fontsize=9)
    figure.suptitle(
        f"{where}: accuracy {plain(graph.accuracy)} over all ordered pairs (always the commonest type: "
        f"{plain(graph.commonest)})\nnumbers and widths: {_value_name(reading, attribute_names)}"
        + ("" if on_circle else "; arrows go from sender to receiver"),
        fontsize=10,
    )
    return figure


def _percentile(column: int) -> str:
    quantile = GRAPH_QUANTILES[column]
    return {0.0: "least accurate", 0.5: "median"}.get(quantile, f"{100 * quantile:.0f}th percentile")


def _value_name(reading: LinearReading | None, names: Sequence[str]) -> str:
    if reading is None or not names:
        return "the model's probability of an edge (truth: none)"
    if (reading.slope, reading.offset) == (1.0, 0.0):
        return f"{names[0]}; inferred: feature {reading.dimension}, unchanged"
    return f"{names[0]}; inferred: feature {reading.dimension}, scaled by a line fitted to the truth"


def _frame(ax: Axes, on_circle: bool) -> None:
    if on_circle:
        ax.set_aspect("equal")
        ax.set(xlim=(-1.15, 1.15), ylim=(-1.1, 1.15))
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


def plot_matrix(
    ax: Axes,
    matrix: Float[np.ndarray, "agents agents"],
    limits: tuple[float, float],
    names: Sequence[str],
    crossed: Bool[np.ndarray, "agents agents"] | None = None,
) -> Axes:
    """Draws receivers × senders as a heat map; NaN (no pair, no edge) is grey; `crossed` pairs have a small cross."""
    ax.set_facecolor("0.85")
    low, high = limits
    if high - low <= 1e-6 * max(1.0, abs(low), abs(high)):  # flat: float noise must not look like contrast
        low, high = low - 0.5, high + 0.5
    ax.imshow(np.ma.masked_invalid(matrix), vmin=low, vmax=high, cmap="viridis")
    few = len(names) <= 12
    if crossed is not None:
        receivers, senders = np.nonzero(crossed)
        ax.plot(senders, receivers, ls="", marker="x", color="white", ms=5 if few else 1.5, mew=1.0 if few else 0.4)
    if len(names) <= MAX_NAMED:
        size = 8 if few else 5.5
        ax.set_xticks(range(len(names)), names, fontsize=size, rotation=90 if max(map(len, names)) > 3 else 0)
        ax.set_yticks(range(len(names)), names, fontsize=size)
    return ax


@rc_context(AS_TEXT)
def features_figure(
    window: WindowShown, static_dim: int, dt_s: float, attribute_names: Sequence[str], where: str
) -> Figure:
    """Draws matrices of the first dimensions at the first and last observed step, static and dynamic ones apart."""
    there = window.history_valid[-1]
    among = np.ix_(there, there)
    names = [name for name, present in zip(window.names, there, strict=True) if present]
    last, dims = len(window.features) - 1, window.features.shape[-1]
    steps = {0: "first step", last: f"last step, {last * dt_s:.3g} s later"}
    matrices = {step: np.where(window.pairs[step, ..., None], window.features[step], np.nan)[among] for step in steps}
    blocks: list[tuple[str, range]] = []
    if static_dim:
        title = f"static (pair matching): features 0 to {static_dim - 1}, averaged over the past"
        blocks.append((title, range(static_dim)))
    if static_dim < dims:
        title = f"dynamic: features {static_dim} to {dims - 1}, free to change at every step"
        blocks.append((title, range(static_dim, dims)))
    truths = _true_matrices(window, attribute_names)
    side = float(np.clip(0.14 * len(names), 2.2, 4.4))
    columns = min(DIMENSIONS_SHOWN, max(len(block) for _, block in blocks)) + len(truths)
    size = (0.6 + 1.15 * side * columns, len(blocks) * (2.35 * side + 1.1) + 0.8)
    figure = Figure(figsize=size, layout="constrained")
    figure.suptitle(
        f"Edge features: {where}, {window.place}\nrow: receiver (which is influenced), column: sender; grey: no pair"
        + (", or in the truth no edge" if truths else "")
        + "; cross: no edge inferred, so the feature has little effect",
        fontsize=10,
    )
    unlinked = (window.edge_prob <= 0.5)[among] & window.pairs[-1][among]
    parts = figure.subfigures(len(blocks), 1, squeeze=False)[:, 0]
    for (title, block), part in zip(blocks, parts, strict=True):
        part.suptitle(title, fontsize=11, fontweight="bold")
        axes = part.subplots(len(steps), columns, squeeze=False)
        _feature_block(part, axes, block[:DIMENSIONS_SHOWN], matrices, steps, names, unlinked)
        _truth_columns(part, axes[:, columns - len(truths) :], truths, names)
        for ax in axes.flat:
            ax.set_axis_off() if not ax.images else None
    return figure


def _true_matrices(window: WindowShown, names: Sequence[str]) -> dict[str, np.ndarray]:
    """Returns the known attributes on true edges (existence of an edge without attributes), NaN elsewhere."""
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
    part: Any,
    axes: Any,
    dimensions: range,
    matrices: dict[int, np.ndarray],
    steps: dict[int, str],
    names: Sequence[str],
    unlinked: Bool[np.ndarray, "agents agents"],
) -> None:
    """Draws a grid with one column per dimension, the steps below each other, one scale per column."""
    for column, dimension in enumerate(dimensions):
        both = np.stack([matrix[..., dimension] for matrix in matrices.values()])
        limits = (float(np.nanmin(both)), float(np.nanmax(both)))
        for place, (step, label) in enumerate(steps.items()):
            ax = axes[place, column]
            plot_matrix(
                ax, matrices[step][..., dimension], limits, names, unlinked if place == len(steps) - 1 else None
            )
            ax.set_title(f"feature {dimension}" if not place else "", fontsize=10)
            ax.set_ylabel(label if not column else "", fontsize=10)
        _scale(part, axes[:, column])


def _truth_columns(part: Any, axes: Any, truths: dict[str, np.ndarray], names: Sequence[str]) -> None:
    """Draws the truth at the last step, beside the features of that step."""
    for column, (name, matrix) in zip(axes.T, truths.items(), strict=True):
        finite = matrix[np.isfinite(matrix)]
        limits = (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 1.0)
        plot_matrix(column[-1], matrix, limits, names)
        column[-1].set_title(f"truth: {name}", fontsize=10, color="darkgreen")
        _scale(part, column)


def _scale(part: Any, column: Any) -> None:
    bar = part.colorbar(column[-1].images[0], ax=column, location="bottom", shrink=0.8, pad=0.02, aspect=25)
    bar.ax.tick_params(labelsize=7)
    bar.locator = MaxNLocator(4)
    bar.update_ticks()


@rc_context(STYLE)
def trajectories_figure(windows: Sequence[WindowShown], feature_names: Sequence[str], where: str) -> Figure:
    """Draws samples beside the truth; of three axes, the one with the least variance is not shown."""
    axes_shown = shown_axes(np.concatenate([w.history[w.history_valid] for w in windows]))
    past = 1 + windows[0].future.shape[1]  # as long as the forecast; more hides it
    extents = [np.ptp(w.history[-past:][w.history_valid[-past:]][:, axes_shown], axis=0) for w in windows]
    longest = np.max(extents, axis=0)
    on_road = longest[0] > ROAD_RATIO * longest[1]
    figure = Figure(figsize=(11, 9), layout="constrained")
    panels = figure.subplots(len(windows), 1, squeeze=False) if on_road else figure.subplots(2, 2)
    names = [feature_names[axis].removesuffix("_m") for axis in axes_shown]
    drawn = min(len(windows[0].forecast), SAMPLES_IN_CROWD if windows[0].future.shape[0] > CROWD else 1_000)
    for ax, window in itertools.zip_longest(panels.flat, windows):
        if window is None:
            ax.set_axis_off()
            continue
        plot_scene(
            ax,
            window.history[-past:, :, axes_shown],
            window.history_valid[-past:],
            window.forecast[:drawn][..., axes_shown],
            window.future[..., axes_shown],
            window.future_valid,
        )
        ax.set_xlabel(f"{names[0]} [m]")
        ax.set_ylabel(f"{names[1]} [m]" + (f", not to {names[0]}'s scale" if on_road else ""))
        if on_road:
            ax.set_aspect("auto")
            ax.margins(0.02, 0.2)
        ax.set_title(f"{window.place}{_error(window)}", fontsize=10)
    view = "" if windows[0].history.shape[-1] == 2 else "; the axis with the least variance is not shown"
    figure.suptitle(
        f"{where}\nlast {min(past, len(windows[0].history))} observed steps solid (square: now), "
        f"{drawn} forecast{'s' * (drawn > 1)} dashed, truth thin black{view}",
        fontsize=11,
    )
    return figure


def shown_axes(positions: Float[np.ndarray, "points axes"]) -> list[int]:
    """Returns the axes that are drawn: x and y, or of three the two with the largest variance, the larger one first."""
    axes: list[int] = np.argsort(-positions.var(axis=0), kind="stable")[:2].tolist()
    return axes if positions.shape[1] > 2 else [0, 1]


def _error(window: WindowShown) -> str:
    """Returns the mean over agents of the best sample's mean displacement [m], as text."""
    whole = window.future_valid.all(axis=-1)
    if not whole.any():
        return ""
    distance = np.linalg.norm(window.forecast - window.future, axis=-1).mean(axis=-1)[:, whole]
    return f"; error: best of {len(distance)} {distance.min(axis=0).mean():.3g} m, first {distance[0].mean():.3g} m"
