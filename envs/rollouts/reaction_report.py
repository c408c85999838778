"""Reports of `envs.evaluate --reactions`: a table for a terminal and a page, a figure by time ahead."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from rich.table import Table

from envs.rollouts.reaction_cells import FALSE_BESIDE
from envs.rollouts.reaction_run import CellReactions, EnvReactions
from predictor.reports.looks import BLACK, STYLE, looks_of
from predictor.reports.plots import save_figure
from predictor.reports.tables import metres, with_interval
from predictor.support.markdown import table

HEADS = (
    "perturbation", "n (episodes)", "forecaster", "true [m]", "predicted [m]", "slope (95 %)", "median ratio (95 %)",
    "slope on one path (n)", "r at the end (95 %)", "r of all steps", "false reaction (95 %)",
)  # fmt: skip
"""Columns of the table."""


def title(result: EnvReactions) -> str:
    """Returns the title of one environment's table."""
    steps = f"{result.horizon_steps} steps of {result.dt_s:g} s"
    return f"{result.env}, driven {result.driver}: shift of receivers after {steps}"


def remarks(result: EnvReactions) -> list[str]:
    """Returns what a reader of the table should know: cells that are short, checkpoints that do not fit."""
    few = [f"{cell.name} {cell.pairs}" for cell in result.cells if cell.pairs < result.asked]
    found = [f"{result.episodes} episodes; fewer than {result.asked} perturbations: {', '.join(few)}"] if few else []
    crashed = [f"{cell.name} {cell.crashed}" for cell in result.cells if cell.crashed]
    if crashed:
        found.append(f"not counted, because the receiver crashes in one branch: {', '.join(crashed)}")
    return found + [f"left out: {name}: {why}" for name, why in result.misfits.items()]


def shown(result: EnvReactions) -> Table:
    """Returns the table of one environment for a terminal."""
    lines = Table(title=title(result))
    for i, heading in enumerate(HEADS):
        name = heading.replace("[", r"\[")
        lines.add_column(name, justify="left" if i in (0, 2) else "right", overflow="fold")  # nothing is cut off
    for cells in _lines(result):
        lines.add_row(*cells)
    return lines


def markdown(results: Sequence[EnvReactions]) -> str:
    """Returns all tables as Markdown."""
    parts = []
    for result in results:
        notes = "".join(f"\n* {remark}" for remark in remarks(result))
        parts.append(f"### {title(result)}\n\n{table(HEADS, _lines(result))}\n{notes}\n")
    return "\n".join(parts)


def _lines(result: EnvReactions) -> list[list[str]]:
    lines = []
    for cell in result.cells:
        if not cell.pairs:
            lines.append([cell.name, "0", *["–"] * (len(HEADS) - 2)])
        for name, found in cell.reactions.items():
            first = [cell.name, f"{found.pairs} ({found.episodes})"]
            predicted = found.length_m if cell.name in FALSE_BESIDE else found.along_m
            lines.append(
                [
                    *first, name, metres(found.true_m), metres(predicted), with_interval(found.slope),
                    with_interval(found.median_ratio), _on_path(cell, name), with_interval(found.correlation),
                    "–" if found.correlation_of_steps is None else f"{found.correlation_of_steps.value:.2f}",
                    with_interval(cell.false_reactions.get(name)),
                ]
            )  # fmt: skip
    return lines


def _on_path(cell: CellReactions, forecaster: str) -> str:
    found = cell.on_path.get(forecaster)
    return "–" if found is None else f"{with_interval(found.slope)} ({found.pairs})"


@matplotlib.rc_context(STYLE)
def write_picture(out: Path, result: EnvReactions) -> None:
    """Writes `ENV.reactions.png` under `out`: a panel for each cell, a line for each forecaster."""
    matplotlib.use("Agg")
    out.mkdir(parents=True, exist_ok=True)
    cells = [cell for cell in result.cells if cell.pairs]
    if not cells:
        return
    figure, grid = plt.subplots(1, len(cells), figsize=(3.4 * len(cells), 3.8), layout="constrained", squeeze=False)
    panels = dict(zip([cell.name for cell in cells], grid[0], strict=True))
    for cell in cells:
        plot_cell(panels[cell.name], cell, result.dt_s)
    for name, beside in FALSE_BESIDE.items():
        if name in panels and beside in panels:  # what is false is seen beside what is true
            panels[name].set_ylim(panels[beside].get_ylim())
    handles, labels = grid[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
    figure.suptitle(f"{result.env}: mean shift of the receiver [m]", fontsize=11)
    save_figure(figure, out / f"{result.env_id.replace('/', '-')}.reactions.png", 130)


def plot_cell(ax: Axes, cell: CellReactions, dt_s: float) -> Axes:
    """Plots the mean shift [m] against time ahead: the true one black, those of forecasters along it."""
    still = cell.name in FALSE_BESIDE
    looks = looks_of(cell.reactions)
    for i, (name, found) in enumerate(cell.reactions.items()):
        if not i:
            _line(ax, found.true_by_step_m, dt_s, label="true", color=BLACK, lw=2.0)
        predicted = found.length_by_step_m if still else found.along_by_step_m
        _line(ax, predicted, dt_s, label=name, lw=1.3, **(looks[i] | {"ls": "--"}))
    ax.axhline(0.0, color="0.8", lw=0.8, zorder=0)
    ax.set_title(f"{cell.name}\n(n = {cell.pairs})", fontsize=9)
    ax.set_xlabel("time ahead [s]")
    ax.tick_params(labelsize=8)
    return ax


def _line(ax: Axes, values: Sequence[float], dt_s: float, **look: Any) -> None:
    ax.plot(dt_s * np.arange(len(values) + 1), [0.0, *values], marker="o", ms=2.5, **look)
