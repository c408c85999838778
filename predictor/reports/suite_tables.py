"""Writes the tables of a suite as Markdown and LaTeX.

Each test store has a table of the horizon alone, with all metrics of a set of samples; one table has the whole
sequence, the paper's view, beside the paper's figures; one has graph and edge features. All lines have the same K.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from predictor.evaluation.training_seeds import limits
from predictor.reports.tables import plain
from predictor.support import markdown
from predictor.support.errors import UserError

WHOLE = {"min_ade_m": ("minADE", "ade"), "min_fde_m": ("minFDE", "fde"), "overall_rmse_m": ("RMSE", "rmse")}
"""Columns of the whole sequence: heading, and name of the paper's figure."""
HORIZON = {
    "ade_m": "ADE₁",
    "fde_m": "FDE₁",
    "min_ade_m": "minADE",
    "min_fde_m": "minFDE",
    "min_joint_ade_m": "joint minADE",
    "energy_m": "energy score",
    "overall_rmse_m": "RMSE",
}
"""Columns of the horizon that are lengths."""
GRAPH: dict[str, tuple[str, ...]] = {
    "graph accuracy": ("graph", "accuracy"),
    "F1": ("graph", "f1"),
    "connectivity": ("graph", "connectivity"),
    "prior entropy [nats]": ("prior_entropy",),
    "R² (first dimension)": ("features", "direct_r2"),
    "R² (linear)": ("features", "linear_r2"),
}
"""Columns of graph and features: where each number stands in a result."""
LEGEND = (
    "ADE₁, FDE₁: the single forecast, sample 0. minADE, minFDE: each agent's best sample; joint minADE: the best "
    "sample of the scene. Energy score, a proper score, and NLL [nats], of the predicted density (modes with their "
    "standard deviations, or the fitted Gaussian): lower is better. 90 % cover: share of truths within the central "
    "90 % of the samples, at the first and the last step; … of mixture: share of true coordinates within the central "
    "90 % of the predicted density"
)


class Grid(NamedTuple):
    """One table."""

    heading: str
    """Heading."""
    caption: str
    """Sentence below the heading."""
    columns: list[str]
    """Headings of the columns."""
    lines: list[list[str]]
    """Cells of each line."""
    align: str
    """Alignment, as in `predictor.support.markdown.table`."""


def markdown_report(content: dict[str, Any]) -> str:
    """Returns the report of a suite as Markdown.

    Raises:
        UserError: lines differ in K.
    """
    sizes, seeds = content["sizes"], content["seeds"]
    spread = "Mean ± standard error over 20 random subsets of the test episodes (of fewer, over these)"
    if seeds > 1:
        others = spread[0].lower() + spread[1:]
        spread = f"Trained lines: mean over {seeds} training seeds (lowest to highest). Others: {others}"
    parts = [
        f"# {content['title']}, budget `{content['budget']}`",
        f"{sizes['steps']:,} optimiser steps of {sizes['batch_size']} windows, "
        f"{sizes['max_episodes'] or 'all'} training episodes, equal for all lines; selected on the energy score of "
        f"free runs. Training took {content['train_seconds'] / 60:.0f} core-minutes or device-minutes in all. "
        f"K = {content['num_samples']} for every line. {spread}. Metres. "
        + ("One seed per line." if seeds == 1 else ""),
    ]
    for grid in grids(content):
        parts += [f"## {grid.heading}", *([f"{grid.caption}."] if grid.caption else [])]
        parts.append(markdown.table(grid.columns, grid.lines, grid.align))
    parts += [_fitted_line(content), _size_line(content)]
    if content["failed"]:
        parts.append("Failed lines: " + "; ".join(f"{k}: {v}" for k, v in content["failed"].items()))
    made = content["provenance"]
    parts.append(f"`{made['command']}`, commit {made['commit']}, {made['machine']}.")
    return "\n\n".join(part.strip() for part in parts if part) + "\n"


def latex_table(content: dict[str, Any]) -> str:
    """Returns the tables of errors as booktabs tables.

    Raises:
        UserError: lines differ in K.
    """
    texts = [f"% {content['provenance']['command']}, commit {content['provenance']['commit']}"]
    for grid in grids(content):
        lines = [grid.columns, *grid.lines]
        first, *others = [" & ".join(_escaped(cell) for cell in line) + r" \\" for line in lines]
        texts += [
            f"% {grid.heading}",
            r"\begin{tabular}{l" + "r" * (len(grid.columns) - 1) + "}",
            r"\toprule",
            first,
            r"\midrule",
            *others,
            r"\bottomrule",
            r"\end{tabular}",
        ]
    return "\n".join(texts) + "\n"


def grids(content: dict[str, Any]) -> list[Grid]:
    """Returns the tables of a suite's content.

    Raises:
        UserError: lines differ in K.
    """
    if not content["rows"]:
        return []
    kinds = list(content["rows"][0]["tests"])
    samples = {row["tests"][kind]["horizon_only"]["num_samples"] for row in content["rows"] for kind in kinds}
    if samples != {content["num_samples"]}:
        raise UserError(f"lines of a table need K = {content['num_samples']}, got K = {sorted(samples)}; run them anew")
    found = [*(_horizon(content, kind) for kind in kinds), _whole(content, kinds)]
    graph = _graph(content, kinds)
    return [*found, graph] if graph.lines else found


def _horizon(content: dict[str, Any], kind: str) -> Grid:
    overlap_m = content["overlap_m"]
    caption = "Errors on the {horizon_steps} future steps after a burn-in of {burn_in_steps}. ".format(
        **content["protocol"]
    )
    columns = ["model", "K", *HORIZON.values(), "NLL", "90 % cover", "… of mixture"]
    if overlap_m:
        columns.append("overlap (truth)")
        of = content.get("overlap_of", "agents")
        caption += f"Overlap: {of} nearer than {overlap_m:g} m to another one of the same sample. "
    lines = []
    for row in content["rows"]:
        accuracy = row["tests"][kind]["horizon_only"]
        cells = [_length(row, kind, "horizon_only", name) for name in HORIZON]
        cells.append(_statistic(row, kind, "mixture_nll", 2))
        for figure in ("coverage", "mixture_coverage"):
            covered = accuracy.get(figure)  # version 0.1.0 did not measure the mixture's
            cells.append(f"{_percent(covered[0])} / {_percent(covered[-1])} %" if covered else "–")
        if overlap_m:
            cells.append(f"{_percent(accuracy['overlap'], 1)} ({_percent(accuracy['true_overlap'], 1)}) %")
        lines.append([row["name"], str(accuracy["num_samples"]), *cells])
    name = "" if kind == "test" else f": {kind}"
    return Grid(f"Horizon-only{name}", caption + LEGEND, columns, lines, "-r")


def _whole(content: dict[str, Any], kinds: Sequence[str]) -> Grid:
    columns, keys = ["model", "K"], []
    for kind in kinds:
        for heading, key in WHOLE.values():
            columns.append(heading if kind == "test" else f"{kind} {heading}")
            keys.append(key if kind == "test" else f"{kind}_{key}")
    ood = " / OOD minADE / OOD minFDE" if "ood" in kinds else ""
    lines = []
    for row in content["rows"]:
        cells = [_length(row, kind, "whole_sequence", name) for kind in kinds for name in WHOLE]
        figures = content["paper"].get(row["key"], {})
        beside = " / ".join(f"{figures[key]:.3f}" for key in keys if key in figures)
        lines.append([row["name"], str(content["num_samples"]), *cells, beside or "–"])
    columns.append("paper's " + " / ".join(name for name, _ in WHOLE.values()) + ood)
    caption = (
        "Errors over all predicted steps of the sequence: one-step errors of the burn-in, which all samples share, and "
        "the horizon"
    )
    return Grid("Whole sequence", caption, columns, lines, "-" + "r" * (len(columns) - 2) + "-")


def _graph(content: dict[str, Any], kinds: Sequence[str]) -> Grid:
    """Returns graph accuracy, F1, connectivity, and R² of the first attribute on true edges."""
    lines = []
    for row in content["rows"]:
        cells = [_number(row, ("tests", kind, *path), plain) for kind in kinds for path in GRAPH.values()]
        if any(c != "–" for c in cells):
            lines.append([row["name"], str(content["num_samples"]), *cells])
    for name, accuracy in content["published"].items():
        lines.append([f"{name} (published)", "–", plain(accuracy), *["–"] * (len(GRAPH) * len(kinds) - 1)])
    columns = ["model", "K", *(n if kind == "test" else f"{kind} {n}" for kind in kinds for n in GRAPH)]
    return Grid("Graph and edge features", "", columns, lines, "-r")


def _length(row: dict[str, Any], kind: str, view: str, name: str) -> str:
    accuracy = row["tests"][kind][view]
    value = accuracy[name]
    digits = 4 if value < 0.02 else 3
    found = limits(row, "tests", kind, view, name)
    if found is not None:
        if not all(map(math.isfinite, (value, *found))):
            return "–"
        return f"{value:.{digits}f} ({found[0]:.{digits}f} to {found[1]:.{digits}f})"
    error = accuracy["statistics"].get(name, {}).get("standard_error")
    return _finite(value, digits) + (f" ± {error:.{digits}f}" if error is not None else "")


def _statistic(row: dict[str, Any], kind: str, name: str, digits: int) -> str:
    """Returns a number over all steps of the horizon; a dash where it was not measured."""
    statistic = row["tests"][kind]["horizon_only"]["statistics"].get(name)
    if statistic is None:
        return "–"
    found = limits(row, "tests", kind, "horizon_only", "statistics", name, "mean")
    if found is not None:
        return f"{statistic['mean']:.{digits}f} ({found[0]:.{digits}f} to {found[1]:.{digits}f})"
    error = statistic["standard_error"]
    return _finite(statistic["mean"], digits) + (f" ± {error:.{digits}f}" if error is not None else "")


def _number(row: dict[str, Any], path: Sequence[str], shown: Callable[[float | None], str]) -> str:
    value: Any = row
    for key in path:
        value = None if value is None else value.get(key)
    found = limits(row, *path)
    return shown(value) if found is None else f"{shown(value)} ({shown(found[0])} to {shown(found[1])})"


def _finite(value: float, digits: int) -> str:
    return "–" if math.isnan(value) else f"{value:.{digits}f}"


def _percent(share: float, digits: int = 0) -> str:
    return _finite(100 * share, digits)


def _escaped(cell: str) -> str:
    signs = {"%": r"\%", "±": r"$\pm$", "₁": "$_1$", "²": "$^2$", "σ": r"$\sigma$", "…": r"\ldots{}"}
    for plain_text, latex in signs.items():
        cell = cell.replace(plain_text, latex)
    return cell


def _fitted_line(content: dict[str, Any]) -> str:
    """Returns what the controls were fitted to."""
    parts = []
    for row in content["rows"]:
        fitted = row["fitted"]
        if "noise_m" in fitted:
            parts.append(f"{row['name']}: σ = {fitted['noise_m']:.3f} m at 1 s, p = {fitted['growth']:.2f}")
        if "examples" in fitted:
            parts.append(
                f"{row['name']}: mean of {fitted['neighbours']:.0f} and each of them, among {fitted['examples']:,.0f} "
                "examples, without memory"
            )
    windows = {row["fitted"]["windows"] for row in content["rows"] if "windows" in row["fitted"]}
    if windows:
        parts.append(f"noise is fitted to {max(windows):,.0f} training windows; table.json has covariances")
    return f"Controls: {'; '.join(parts)}." if parts else ""


def _size_line(content: dict[str, Any]) -> str:
    trained = [r for r in content["rows"] if r["parameters"]]
    sizes = [f"{r['name']} {r['parameters']:,} ({r['train_seconds'] / 60:.1f} min)" for r in trained]
    tests = [
        f"{kind}: {t['windows']:,} windows of {t['agents']['min']} to {t['agents']['max']} agents"
        for kind, t in (content["rows"][0]["tests"].items() if content["rows"] else ())
    ]
    runs = [run for row in content["rows"] for run in row.get("runs", [row])]  # a row has the mean of its runs
    memory = max((t.get("peak_memory_mb", 0.0) for run in runs for t in run["tests"].values()), default=0.0)
    return (
        f"Measured on {'; '.join(tests)}. Parameters (training time): {', '.join(sizes)}. "
        f"Largest memory of any line's process, training included: {memory:,.0f} MB."
    )
