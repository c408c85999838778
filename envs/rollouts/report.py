"""Reports of `envs.evaluate`: tables for a terminal and a page, a figure by horizon, a gallery of worst cases."""

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib import pyplot as plt
from matplotlib.axes import Axes

from envs.registry import name_with
from envs.rollouts.episode import MODEL, NEIGHBOURS, RESIDUAL, STRAIGHT, Case
from predictor.evaluation.accuracy import Accuracy
from predictor.evaluation.graph_accuracy import GraphAccuracy
from predictor.reports.fitted_table import FittedTable
from predictor.reports.looks import BLACK, STYLE, looks_of
from predictor.reports.plots import save_figure
from predictor.reports.tables import markdown_table, metres, percent_range
from predictor.support.markdown import table


@dataclass(frozen=True)
class EnvAccuracy:
    """Accuracy of one checkpoint in one environment."""

    env_id: str
    """Id of the environment."""
    checkpoint: str
    """Name of the checkpoint."""
    driver: str
    """Name of the driver."""
    dt_s: float
    """Time step [s]."""
    model: Accuracy
    """Accuracy of the single forecast (K = 1)."""
    model_samples: Accuracy
    """Accuracy of the best of K forecasts."""
    constant_velocity: Accuracy
    """Accuracy of constant velocity on the same scenes."""
    reduction: float | None
    """1 − minADE(K = 1) / ADE of constant velocity; None where that has no error, or no whole horizon was there."""
    reduction_interval: tuple[float, float] | None
    """95 % bootstrap interval of the reduction over episodes; None for a single one."""
    controls: dict[str, Accuracy] = field(default_factory=dict)
    """Accuracy of controls with as many samples, fitted to recorded data, by key; empty without such data."""
    histories: dict[int, Accuracy] = field(default_factory=dict)
    """Accuracy of the model (K = 1) by the number of steps to which its memory is limited."""
    graph: GraphAccuracy | None = None
    """Accuracy of the inferred against the true edges, where the simulator has them."""
    latency_median_ms: float = float("nan")
    """Median time to observe one scene and forecast it (K = 1), one thread, all workers busy [ms]."""
    latency_p95_ms: float = float("nan")
    """95th percentile of that time [ms]."""
    edges: dict[str, Accuracy] = field(default_factory=dict)
    """Accuracy of the model (K = 1) by what was done to its edges; empty unless asked for."""
    to_the_end: tuple[Accuracy, Accuracy] | None = None
    """Accuracy of the model (K = 1) and of constant velocity over all forecasts, also those whose horizon passes the
    episode's end: each counts up to that end."""
    before_crash: tuple[Accuracy, Accuracy] | None = None
    """Accuracy of both over the forecasts of the last `BEFORE_CRASH_S` before a crash; None without a crash."""
    env_kwargs: str = ""
    """Arguments of the environment, as the text of a JSON object; empty if it had none."""

    @property
    def env(self) -> str:
        """Id of the environment, with its arguments where it had some."""
        return name_with(self.env_id, self.env_kwargs)

    @property
    def lines(self) -> list[Accuracy]:
        """All lines of its table, with equal numbers of samples where samples differ."""
        return [self.model_samples, *(self.controls.values() or [self.constant_velocity])]

    @property
    def nearest_neighbours(self) -> Accuracy | None:
        """Accuracy of the memoryless nearest-neighbour forecaster; None without recorded data."""
        return self.controls.get(NEIGHBOURS)


BEFORE_CRASH_S = 5.0
"""Time before a crash whose forecasts are reported on their own [s]."""
HEADS = (
    "env", "checkpoint", "dt [s]", "steps", "ADE₁ [m]", "FDE₁ [m]", "minADE_K [m]", "joint ADE_K [m]", "energy [m]",
    "cover", "model + noise minADE_K [m]", "neighbours ADE₁ [m]", "CV ADE / FDE [m]", "ADE below CV", "95 % interval",
    "forecasts", "latency [ms]",
)  # fmt: skip
"""Columns of the overview."""


def title(result: "EnvAccuracy") -> str:
    """Returns the title of one environment's table."""
    return f"{result.env}, checkpoint {result.checkpoint}, driven {result.driver}"


def remarks(result: "EnvAccuracy") -> str:
    """Returns the remarks under the table: intervals, graph, latency."""
    lines = [f"minADE (K = 1) {result.model.min_ade_m:.3f} m, 95 % over episodes {_interval(result.model)}"]
    for steps, line in result.histories.items():
        lines.append(f"… with {steps} step(s) of history {line.min_ade_m:.3f} m, {_interval(line)}")
    for key, line in result.edges.items():
        more = 100 * (line.min_ade_m / result.model.min_ade_m - 1)
        lines.append(f"… with {key} {line.min_ade_m:.3f} m ({more:+.0f} %), {_interval(line)}")
    for key, pair in (
        ("counting forecasts that pass the episode's end up to it", result.to_the_end),
        (f"the same in the last {BEFORE_CRASH_S:g} s before a crash", result.before_crash),
    ):
        if pair is not None:
            own, straight = pair
            lines.append(
                f"{key}: minADE {own.min_ade_m:.3f} m, {_interval(own)}, constant velocity "
                f"{straight.min_ade_m:.3f} m, {own.agents} forecasts"
            )
    if covered := result.model_samples.mixture_coverage:
        lines.append(
            f"{percent_range(covered)} of the coordinates, by step, within the central 90 % of the predicted mixture "
            "(modes with their spread)"
        )
    graph = result.graph
    if graph is not None and graph.accuracy is not None:
        f1 = "–" if graph.f1 is None else f"{graph.f1:.2f}"
        always = 100 * (graph.commonest or 0)
        lines.append(
            f"graph accuracy {100 * graph.accuracy:.1f} % of {graph.pairs} pairs (always the commoner answer: "
            f"{always:.1f} %), F1 of edges {f1}"
        )
    lines.append(f"latency {result.latency_median_ms:.1f} ms median, {result.latency_p95_ms:.1f} ms p95 (K = 1)")
    return "\n".join(lines)


def _interval(accuracy: Accuracy) -> str:
    found = accuracy.intervals.get("min_ade_m")
    return "–" if found is None else f"{found[0]:.3f} to {found[1]:.3f}"


def overview(results: Sequence["EnvAccuracy"]) -> FittedTable:
    """Returns a table with one line per result."""
    several = len({result.env_id for result in results}) < len(results)
    heads = [textwrap.fill(head, 12) for head in HEADS]
    return FittedTable("in-env accuracy", heads, [_cells(r) for r in results], kept=1 + several)


def markdown(results: Sequence["EnvAccuracy"], misfits: Mapping[tuple[str, str], str]) -> str:
    """Returns overview, transfer matrix (with several checkpoints) and each environment's table as Markdown."""
    parts = [table(HEADS, [_cells(r) for r in results]) + "\n"]
    if len({r.checkpoint for r in results} | {c for _, c in misfits}) > 1:
        cells = _matrix(results, misfits)
        heads = list(next(iter(cells.values())))
        matrix = table(["env", *heads], [[env, *line.values()] for env, line in cells.items()])
        why = [f"* {env} with {name}: {reason}" for (env, name), reason in misfits.items()]
        parts.append("### Transfer: minADE₁ [m] (below constant velocity)\n\n" + "\n".join([matrix, "", *why]) + "\n")
    for result in results:
        text = remarks(result).replace("\n", "\n* ")
        parts.append(f"### {title(result)}\n\n{markdown_table(result.lines, result.dt_s)}\n* {text}\n")
    return "\n".join(parts)


def transfer(results: Sequence["EnvAccuracy"], misfits: Mapping[tuple[str, str], str]) -> FittedTable:
    """Returns the transfer matrix: a column per checkpoint, a line per environment."""
    cells = _matrix(results, misfits)
    lines = [[env_id, *line.values()] for env_id, line in cells.items()]
    title = "transfer: minADE₁ [m] (below constant velocity)"
    caption = "–: not measured, see accuracy.md for the reason" if misfits else ""
    return FittedTable(title, ["env", *next(iter(cells.values()))], lines, caption)


def _matrix(results: Sequence["EnvAccuracy"], misfits: Mapping[tuple[str, str], str]) -> dict[str, dict[str, str]]:
    names = list(dict.fromkeys([r.checkpoint for r in results] + [name for _, name in misfits]))
    envs = list(dict.fromkeys([r.env_id for r in results] + [env for env, _ in misfits]))
    cells = {env: dict.fromkeys(names, "–") for env in envs}
    for r in results:
        cells[r.env_id][r.checkpoint] = f"{metres(r.model.min_ade_m)} ({_percent(r.reduction)})"
    return cells


def _cells(result: "EnvAccuracy") -> list[str]:
    one, many, straight, near = (
        result.model, result.model_samples, result.constant_velocity, result.nearest_neighbours,
    )  # fmt: skip
    noisy, covered = result.controls.get(RESIDUAL), many.statistics.get("coverage")
    return [
        result.env, result.checkpoint, f"{result.dt_s:g}", str(len(one.by_step_m)),
        metres(one.min_ade_m), metres(one.min_fde_m), metres(many.min_ade_m), metres(many.min_joint_ade_m),
        metres(many.energy_m), "–" if covered is None else f"{100 * covered.mean:.0f} %",
        "–" if noisy is None else metres(noisy.min_ade_m), "–" if near is None else metres(near.ade_m),
        f"{metres(straight.min_ade_m)} / {metres(straight.min_fde_m)}",
        _percent(result.reduction), _range(result.reduction_interval), str(one.agents),
        f"{result.latency_median_ms:.1f}",
    ]  # fmt: skip


def _percent(share: float | None) -> str:
    return "–" if share is None else f"{100 * share:.0f} %"


def _range(interval: tuple[float, float] | None) -> str:
    return "–" if interval is None else f"{100 * interval[0]:.0f} to {100 * interval[1]:.0f} %"


@matplotlib.rc_context(STYLE)
def write_pictures(out: Path, result: "EnvAccuracy", cases: Sequence[Case]) -> None:
    """Writes `ENV.CHECKPOINT.by_horizon.png` and `….worst.png` under `out`."""
    matplotlib.use("Agg")
    out.mkdir(parents=True, exist_ok=True)
    stem = f"{result.env_id}.{result.checkpoint}".replace("/", "-")
    figure, axes = plt.subplots(2, 2, figsize=(11, 8), layout="constrained")
    threshold_m = result.model.miss_threshold_m
    for ax, quantity, label in (
        (axes[0, 0], "by_step_m", "displacement of the best sample [m]"),
        (axes[0, 1], "rmse_m", "RMSE of the samples' mean [m]"),
        (axes[1, 0], "coverage", "truths within the samples' central 90 %"),
        (axes[1, 1], "miss_by_step", f"share more than {threshold_m:g} m off"),
    ):
        if measured := [a for a in result.lines if getattr(a, quantity)]:
            plot_by_horizon(ax, measured, result.dt_s, quantity, label)
        else:
            ax.axis("off")  # one sample covers nothing
    entries = {label: line for ax in axes.flat for line, label in zip(*ax.get_legend_handles_labels(), strict=True)}
    figure.legend(entries.values(), entries, loc="outside lower center", ncols=4)
    figure.suptitle(f"{title(result)}; bands are 95 % intervals over episodes")
    save_figure(figure, out / f"{stem}.by_horizon.png", 130)
    if cases:
        lines = -(-len(cases) // 3)
        figure, grid = plt.subplots(lines, 3, figsize=(13, 4 * lines), squeeze=False, layout="constrained")
        for ax, case in zip(grid.flat, cases, strict=False):
            plot_case(ax, case)
        for ax in list(grid.flat)[len(cases) :]:
            ax.axis("off")
        handles, labels = grid.flat[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
        figure.suptitle(f"{title(result)}: the worst forecast of the {len(cases)} worst episodes")
        save_figure(figure, out / f"{stem}.worst.png", 110)


def plot_by_horizon(ax: Axes, accuracies: Sequence[Accuracy], dt_s: float, quantity: str, label: str) -> Axes:
    """Plots a quantity against time ahead, a curve per accuracy with its 95 % band."""
    labels = [a.name if a.name in (STRAIGHT, NEIGHBOURS) else f"{a.name}, K = {a.num_samples}" for a in accuracies]
    for accuracy, entry, look in zip(accuracies, labels, looks_of(labels), strict=True):
        values = np.array(getattr(accuracy, quantity))
        time_s = dt_s * np.arange(1, len(values) + 1)
        ax.plot(time_s, values, marker="o", ms=3, label=entry, **look)
        bounds = [b if b is not None else (np.nan, np.nan) for b in accuracy.step_intervals.get(quantity, [])]
        if bounds:
            low, high = np.array(bounds).T
            ax.fill_between(time_s, low, high, color=look["color"], alpha=0.15, lw=0)
    ax.set_xlabel("time ahead [s]")
    ax.set_ylabel(label)
    return ax


def plot_case(ax: Axes, case: Case) -> Axes:
    """Plots one forecast [m]: the agent's history solid, its forecasts dashed, truth thin; the others grey."""
    for agent in range(case.history.shape[1]):
        seen = case.history_valid[:, agent]
        if not seen.any():
            continue
        color, label = (BLACK, "history") if agent == case.agent else ("0.75", "others")
        known = label in ax.get_legend_handles_labels()[1]
        ax.plot(*case.history[seen, agent].T, color=color, lw=2, label=None if known else label)
        ax.plot(*case.history[seen, agent][-1], marker="s", ms=4, color=color)
    now = case.history[-1, case.agent][None]
    for key, label in ((MODEL, "model"), (STRAIGHT, STRAIGHT), (NEIGHBOURS, NEIGHBOURS)):
        if key in case.forecasts:
            (look,) = looks_of([label])
            path = np.concatenate([now, case.forecasts[key]])
            ax.plot(*path.T, marker=".", ms=4, lw=1.3, label=label, **(look | {"ls": "--"}))
    ax.plot(*np.concatenate([now, case.future]).T, color=BLACK, lw=0.9, marker=".", ms=3, label="what happened")
    ax.set_title(f"seed {case.seed}, step {case.step}: {case.error_m:.2f} m off", fontsize=9)
    ax.set_aspect("equal", adjustable="datalim")
    ax.set_xlabel("x [m]", fontsize=8)
    ax.set_ylabel("y [m]", fontsize=8)
    ax.tick_params(labelsize=7)
    return ax
