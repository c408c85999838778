"""Reports of `envs.evaluate --graph`: a table for a terminal and a page, precision against recall, calibration."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from rich.console import Group
from rich.table import Table

from envs.rollouts.graph_run import DISTANCE, LEADERS, MAJORITY, TREES, EnvGraph
from predictor.evaluation.causal_graph import CausalScores
from predictor.evaluation.standard_errors import Estimate
from predictor.reports.looks import BLACK, GREEN, GREY, STYLE, YELLOW, looks_of
from predictor.reports.plots import save_figure
from predictor.reports.tables import with_interval
from predictor.support.markdown import table

HEADS = (
    "edges by", "accuracy", "precision", "recall", "recall: leaders / others", "F1 (95 %)", "F1, fitted bound",
    "AUC (95 %)", "average precision", "calibration error", "r with shift (95 %)", "spread over senders",
)  # fmt: skip
"""Columns of the table."""
RULES = {DISTANCE: YELLOW, LEADERS: BLACK, MAJORITY: GREY, TREES: GREEN}
"""Colors of the rules that need no network."""


def title(result: EnvGraph) -> str:
    """Returns the title of one environment's table."""
    first = next(iter(result.scores.values()))
    return (
        f"{result.env}, driven {result.driver}: {first.pairs} pairs of {first.episodes} episodes, "
        f"{100 * first.share:.0f} % are edges"
    )


def title_to_ego(result: EnvGraph) -> str:
    """Returns the title of the table of edges to the ego; empty without any."""
    if not result.to_ego:
        return ""
    first = next(iter(result.to_ego.values()))
    return (
        f"{result.env}, edges to the ego, as a driver in its place would have them: {first.pairs} pairs, "
        f"{100 * first.share:.0f} % are edges"
    )


def remarks(result: EnvGraph) -> list[str]:
    """Returns which checkpoints were left out, and why."""
    return [f"left out: {name}: {why}" for name, why in result.misfits.items()]


def shown(result: EnvGraph) -> Group:
    """Returns the tables of one environment for a terminal."""
    tables = []
    for heading, scores in ((title(result), result.scores), (title_to_ego(result), result.to_ego)):
        if not scores:
            continue
        lines = Table(title=heading)
        for i, column in enumerate(HEADS):
            lines.add_column(column, justify="right" if i else "left", no_wrap=column.endswith("(95 %)"))
        for cells in _lines(scores):
            lines.add_row(*cells)
        tables.append(lines)
    return Group(*tables)


def markdown(results: Sequence[EnvGraph]) -> str:
    """Returns all tables as Markdown."""
    parts = []
    for result in results:
        notes = "".join(f"\n* {remark}" for remark in remarks(result))
        parts.append(f"### {title(result)}\n\n{table(HEADS, _lines(result.scores))}\n{notes}\n")
        if result.to_ego:
            parts.append(f"#### {title_to_ego(result)}\n\n{table(HEADS, _lines(result.to_ego))}\n")
    return "\n".join(parts)


def _lines(scores: Mapping[str, CausalScores]) -> list[list[str]]:
    lines = []
    for name, found in scores.items():
        spread = found.spread_between_senders
        lines.append(
            [
                name, _value(found.accuracy), _value(found.precision), _value(found.recall),
                f"{_value(found.recall_of_leaders)} / {_value(found.recall_of_others)}", with_interval(found.f1),
                _value(found.fitted), with_interval(found.auc), _value(found.average_precision),
                _value(found.calibration_error), with_interval(found.strength),
                "–" if spread is None or not found.bins else f"{spread:.2f}",
            ]
        )  # fmt: skip
    return lines


def _value(estimate: Estimate | None) -> str:
    return "–" if estimate is None else f"{estimate.value:.2f}"


@matplotlib.rc_context(STYLE)
def write_picture(out: Path, result: EnvGraph) -> None:
    """Writes `ENV.graph.png` under `out`: precision against recall, and calibration."""
    matplotlib.use("Agg")
    out.mkdir(parents=True, exist_ok=True)
    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4.4), layout="constrained")
    models = [name for name in result.scores if name not in RULES]
    colors = RULES | {name: look["color"] for name, look in zip(models, looks_of(models), strict=True)}
    for name, found in result.scores.items():
        line = "--" if name in RULES else "-"  # a checkpoint may have the colour of a rule
        plot_curve(left, name, found, colors[name], line)
        plot_calibration(right, name, found, colors[name], line)
    right.plot([0, 1], [0, 1], color="0.8", lw=0.8, zorder=0)
    for ax, x, y in ((left, "recall", "precision"), (right, "probability of an edge", "share of causal edges")):
        ax.set(xlabel=x, ylabel=y, xlim=(-0.02, 1.02), ylim=(-0.02, 1.02))
    left.legend(fontsize=8)
    figure.suptitle(title(result), fontsize=11)
    save_figure(figure, out / f"{result.env_id.replace('/', '-')}.graph.png", 130)


def plot_curve(ax: Axes, name: str, found: CausalScores, color: str, line: str = "-") -> Axes:
    """Plots precision against recall over all bounds, with a mark at the rule's own bound."""
    if name != MAJORITY and found.curve:
        own = [float("nan") if one is None else one.value for one in (found.recall, found.precision)]
        ax.plot(own[0], own[1], marker="o", ms=6, color=color, ls=line, label=name)
        if len(found.curve) > 2:  # a rule that only says yes or no is one place
            ax.plot(*zip(*found.curve, strict=True), lw=1.3, color=color, ls=line)
    if name == MAJORITY:
        ax.axhline(found.share, color=color, lw=0.8, ls=":", label="share of edges")
    return ax


def plot_calibration(ax: Axes, name: str, found: CausalScores, color: str, line: str = "-") -> Axes:
    """Plots the share of edges against the probability, by bin; the area of a mark shows the number of pairs."""
    filled = [(one.mean_prob, one.share, one.pairs) for one in found.bins if one.pairs]
    if filled:
        prob, share, pairs = zip(*filled, strict=True)
        ax.plot(prob, share, lw=1.0, color=color, ls=line, label=name)
        ax.scatter(prob, share, s=[8 + 300 * count / found.pairs for count in pairs], color=color, alpha=0.6)
    return ax
