"""Reports of `envs.evaluate --plans`: a table for a terminal and a page, and a figure of the errors and choices."""

import textwrap
from collections.abc import Sequence
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from rich.table import Table

from envs.rollouts.plan_run import EnvPlans, PlanScores
from predictor.evaluation.standard_errors import Estimate
from predictor.reports.looks import STYLE
from predictor.reports.plots import save_figure
from predictor.reports.tables import metres
from predictor.support.markdown import table

HEADS = (
    "forecaster", "others' ADE [m]", "the ego's true plan given", "less by (95 %)", "plans: ADE without [m]", "given",
    "less by (95 %)", "pairs of plans", "right choices (95 %)", "… with margin (95 %)", "Brier score (95 %)",
)  # fmt: skip
"""Columns of the table."""
NAME_WIDTH = 18
"""Largest width of a line of a forecaster's name under the figure [characters]."""


def title(result: EnvPlans) -> str:
    """Returns the title of one environment's table."""
    return (
        f"{result.env}, driven {result.driver}: {result.moments} moments of {result.episodes} episodes, "
        f"{result.horizon_steps} × {result.dt_s:g} s"
    )


def remarks(result: EnvPlans) -> list[str]:
    """Returns how often each plan collides, and which checkpoints were left out."""
    shares = ", ".join(
        f"{name} {100 * share:.0f} %" for name, share in zip(result.plan_names, result.crashed, strict=True)
    )
    return [f"collisions by plan: {shares}", *(f"left out: {name}: {why}" for name, why in result.misfits.items())]


def shown(result: EnvPlans) -> Table:
    """Returns the table of one environment for a terminal."""
    lines = Table(title=title(result))
    for i, heading in enumerate(HEADS):
        lines.add_column(
            heading.replace("[", r"\["), justify="right" if i else "left", no_wrap=heading.endswith("(95 %)")
        )
    for name, found in result.scores.items():
        lines.add_row(*_cells(name, found))
    return lines


def markdown(results: Sequence[EnvPlans]) -> str:
    """Returns all tables as Markdown."""
    parts = []
    for result in results:
        notes = "\n".join(f"* {remark}" for remark in remarks(result))
        cells = [_cells(name, found) for name, found in result.scores.items()]
        parts.append(f"### {title(result)}\n\n{table(HEADS, cells)}\n\n{notes}\n")
    return "\n".join(parts)


def _cells(name: str, found: PlanScores) -> list[str]:
    return [
        name, metres(found.own.without_m), metres(found.own.with_m), _percent(found.own.reduction),
        metres(found.plans.without_m), metres(found.plans.with_m), _percent(found.plans.reduction),
        str(found.choices), _percent(found.right), _percent(found.right_of_planner), _plain(found.brier),
    ]  # fmt: skip


def _percent(estimate: Estimate | None) -> str:
    if estimate is None:
        return "–"
    value = f"{100 * estimate.value:.1f} %".replace("-", "−")
    if estimate.interval is None:
        return value
    low, high = (f"{100 * bound:.1f}".replace("-", "−") for bound in estimate.interval)
    return f"{value} ({low} to {high})"


def _plain(estimate: Estimate | None) -> str:
    if estimate is None or estimate.interval is None:
        return "–" if estimate is None else f"{estimate.value:.3f}"
    return f"{estimate.value:.3f} ({estimate.interval[0]:.3f} to {estimate.interval[1]:.3f})"


@matplotlib.rc_context(STYLE)
def write_picture(out: Path, result: EnvPlans) -> None:
    """Writes `ENV.plans.png` under `out`: errors with and without the plan, and the choices."""
    matplotlib.use("Agg")
    out.mkdir(parents=True, exist_ok=True)
    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4.2), layout="constrained")
    plot_errors(left, result)
    plot_choices(right, result)
    figure.suptitle(title(result), fontsize=11)
    save_figure(figure, out / f"{result.env_id.replace('/', '-')}.plans.png", 130)


def plot_errors(ax: Axes, result: EnvPlans) -> Axes:
    """Plots by how much the plan lowers the error, with intervals: the ego's true plan, and each played plan.

    Forecasters without errors are left out, where another one has some.
    """
    compared = {name: found for name, found in result.scores.items() if found.own.agents or found.plans.agents}
    compared = compared or result.scores
    for shift, kind, label in ((-0.15, "own", "the ego's true plan"), (0.15, "plans", "plans, played")):
        places = np.arange(len(compared)) + shift
        _plot_estimates(ax, places, [getattr(found, kind).reduction for found in compared.values()], label)
    ax.axhline(0, color="0.7", lw=0.8)
    ax.set_ylabel("error less by, with the plan given [%]")
    ax.legend(fontsize=8)
    return _named(ax, [*compared])


def plot_choices(ax: Axes, result: EnvPlans) -> Axes:
    """Plots the share of right choices between a plan that collides and one that does not, with intervals."""
    found = list(result.scores.values())
    _plot_estimates(ax, np.arange(len(found)), [one.right for one in found], f"{found[0].choices} pairs")
    ax.axhline(50, color="0.7", lw=0.8, ls=":", label="chance")
    ax.set(ylabel="right choices [%]", ylim=(0, 102))
    ax.legend(fontsize=8, loc="lower right")
    return _named(ax, [*result.scores])


def _plot_estimates(ax: Axes, places: np.ndarray, estimates: Sequence[Estimate | None], label: str) -> None:
    values = [np.nan if one is None else 100 * one.value for one in estimates]
    spans = [(np.nan, np.nan) if one is None or one.interval is None else one.interval for one in estimates]
    low, high = 100 * np.array(spans).T
    around = np.nan_to_num(np.array([values - low, high - values])).clip(min=0)
    ax.errorbar(places, values, yerr=around, fmt="o", ms=5, capsize=3, label=label)


def _named(ax: Axes, names: Sequence[str]) -> Axes:
    ax.set_xticks(range(len(names)), [textwrap.fill(name, NAME_WIDTH) for name in names], fontsize=8)
    ax.set_xlim(-0.5, len(names) - 0.5)
    ax.grid(False, axis="x")
    return ax
