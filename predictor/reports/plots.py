"""Plots forecasts and their accuracy; functions take arrays and an axis and return the axis."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import pyplot as plt
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatter
from numpy.typing import NDArray

from predictor.evaluation.accuracy import Accuracy
from predictor.reports.looks import STYLE, looks_of
from predictor.support.files import new_file


class PlainLogFormatter(LogFormatter):
    """Writes 0.2 at the ticks that matplotlib labels, where its own formatters write formulas (`looks.AS_TEXT`)."""

    def __call__(self, x: float, pos: int | None = None) -> str:
        """Returns the label of the tick at `x`, empty where matplotlib leaves it out."""
        return f"{x:g}" if super().__call__(x, pos) else ""


def save_figure(figure: Figure, path: Path, dpi: int) -> None:
    """Writes a figure, as a whole file or not at all, and closes it."""
    with new_file(path) as partial:
        figure.savefig(partial, dpi=dpi)
    plt.close(figure)


def plot_error_by_horizon(ax: Axes, accuracies: Sequence[Accuracy], dt_s: float) -> Axes:
    """Draws displacement against time ahead, a line per forecaster."""
    for accuracy, look in zip(accuracies, looks_of(a.name for a in accuracies), strict=True):
        time_s = dt_s * np.arange(1, len(accuracy.by_step_m) + 1)
        label = f"{accuracy.name}, K = {accuracy.num_samples}"
        ax.plot(time_s, accuracy.by_step_m, marker="o", ms=3, label=label, **look)
    ax.set_xlabel("time ahead [s]")
    ax.set_ylabel("displacement of the best sample [m]")
    ax.set_ylim(bottom=0)
    ax.legend()
    return ax


def plot_results_by_step(ax: Axes, results: Sequence[dict[str, Any]], kind: str, dt_s: float) -> Axes:
    """Draws the displacement of the best sample at each step of the free run with standard errors; log scale.

    Args:
        ax: axis to draw on.
        results: results of a suite's table.json, one per line of the table.
        kind: test store, "test", "ood" or "crowd".
        dt_s: length of a step [s].
    """
    shown = [result for result in results if result["key"] != "least-squares"]  # the limit, orders of magnitude below
    for result, look in zip(shown, looks_of(result["name"] for result in shown), strict=True):
        view = result["tests"][kind]["horizon_only"]
        ours = result["key"].startswith(("dgvae", "dvae", "plural")) and not result["key"].endswith("-gaussian")
        time_s = dt_s * np.arange(1, len(view["by_step_m"]) + 1)
        errors = [error or 0.0 for error in view["step_errors"]["by_step_m"]]
        style: dict[str, Any] = {"lw": 2.0 if ours else 1.2, "marker": "o", "ms": 3, **look}
        ax.errorbar(time_s, view["by_step_m"], yerr=errors, label=result["name"], **style)
    ax.set_yscale("log")
    ax.yaxis.set_major_formatter(PlainLogFormatter())
    ax.yaxis.set_minor_formatter(PlainLogFormatter())
    ax.set_xlabel("time ahead [s]")
    return ax


@rc_context(STYLE)
def figure_by_step(results: Sequence[dict[str, Any]], kinds: Sequence[str], dt_s: float, headline: str) -> Figure:
    """Draws `plot_results_by_step` for several test stores side by side, under one headline.

    Args:
        results: results of a suite's table.json, one per line of the table, of as many samples each.
        kinds: test stores.
        dt_s: length of a step [s].
        headline: text above.
    """
    figure, axes = plt.subplots(
        1, len(kinds), figsize=(1 + 5 * max(2, len(kinds)), 5.2), sharey=True, squeeze=False, layout="constrained"
    )
    for ax, kind in zip(axes[0], kinds, strict=True):
        plot_results_by_step(ax, results, kind, dt_s).set_title(kind)
    samples = results[0]["tests"][kinds[0]]["horizon_only"]["num_samples"]
    axes[0, 0].set_ylabel(f"displacement of the best of {samples} samples [m]")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2 * len(kinds), fontsize=7.5)
    figure.suptitle(headline, fontsize=9)
    return figure


def plot_scene(
    ax: Axes,
    history: NDArray[np.floating],
    history_valid: NDArray[np.bool_],
    forecast: NDArray[np.floating],
    future: NDArray[np.floating],
    future_valid: NDArray[np.bool_],
) -> Axes:
    """Draws one scene in metres: history solid, forecast dashed, truth thin.

    Args:
        ax: axis to draw on.
        history: observed positions [m] (time, agents, 2).
        history_valid: presence (time, agents).
        forecast: predicted positions [m] (samples, agents, horizon, 2).
        future: true positions [m] (agents, horizon, 2).
        future_valid: presence (agents, horizon); agents without a valid step get no forecast drawn.
    """
    for agent in range(history.shape[1]):
        seen = history_valid[:, agent]
        if not seen.any():
            continue
        (line,) = ax.plot(*history[seen, agent].T, lw=2, marker=".", ms=3)
        color = line.get_color()
        now = history[seen, agent][-1:]
        ax.plot(*now.T, marker="s", color=color, ms=5)
        if not future_valid[agent].any():
            continue
        ax.plot(*np.concatenate([now, future[agent, future_valid[agent]]]).T, color="black", lw=0.8)
        for sample in forecast[:, agent]:
            ax.plot(*np.concatenate([now, sample]).T, color=color, ls="--", lw=1.3, alpha=max(0.15, 1 / len(forecast)))
    ax.set_aspect("equal", adjustable="datalim")
    ax.set_xlabel("x [m]")
    ax.set_ylabel("y [m]")
    return ax
