"""Figures of reports in one style: panels side by side, one legend below, colours safe for colour-blind readers.

Files are SVG, and equal from run to run.
"""

import io
import re
from collections.abc import Sequence
from typing import Any

import matplotlib
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from predictor.reports.looks import AS_TEXT, STYLE

_WIDTH_IN, _HEIGHT_IN, _DPI = 5.4, 4.0, 130


@matplotlib.rc_context(STYLE)
def panels(count: int) -> tuple[Figure, list[Axes]]:
    """Returns a figure and its axes, at most two in a line."""
    matplotlib.use("Agg")
    columns = min(count, 2)
    lines = -(-count // columns)
    figure, grid = plt.subplots(
        lines, columns, figsize=(_WIDTH_IN * columns, _HEIGHT_IN * lines + 0.6), squeeze=False, layout="constrained"
    )
    axes = list(grid.flat)
    for spare in axes[count:]:
        spare.set_axis_off()
    return figure, axes[:count]


def svg_of(figure: Figure, axes: Sequence[Axes]) -> str:
    """Returns a figure as SVG without XML header, with one legend below the panels, and closes it."""
    return files_of(figure, axes)[0]


def files_of(figure: Figure, axes: Sequence[Axes]) -> tuple[str, bytes]:
    """Returns a figure as SVG without XML header and as PNG, with one legend below the panels, and closes it."""
    _finish(figure, axes)
    written, pixels = io.StringIO(), io.BytesIO()
    with matplotlib.rc_context({"svg.hashsalt": "dgvae-rl"}):
        figure.savefig(written, format="svg", metadata={"Date": None, "Creator": None})
    figure.savefig(pixels, format="png", dpi=_DPI)
    plt.close(figure)
    return re.sub(r"^.*?(?=<svg)", "", written.getvalue(), flags=re.DOTALL).strip(), pixels.getvalue()


@matplotlib.rc_context(AS_TEXT)
def _finish(figure: Figure, axes: Sequence[Axes]) -> None:
    """Draws one legend below the panels, in as many columns as fit the width."""
    entries: dict[str, Any] = {}
    for ax in axes:
        handles, labels = ax.get_legend_handles_labels()
        entries |= {label: entries.get(label, handle) for handle, label in zip(handles, labels, strict=True)}
    for columns in (3, 2, 1) if entries else ():
        legend = figure.legend(
            entries.values(), entries, loc="outside lower center", ncols=columns, frameon=False, fontsize=9
        )
        if columns == 1 or legend.get_window_extent().width <= figure.bbox.width:
            break
        legend.remove()
