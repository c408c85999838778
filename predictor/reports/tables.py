"""A suite's results as Markdown and LaTeX: ours beside the paper's, both views, graph and features."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from rich.table import Table

from predictor.evaluation.accuracy import Accuracy
from predictor.evaluation.displacement import COVERAGE_SHARE
from predictor.support import markdown

SCALARS = (
    "minADE [m]",
    "minFDE [m]",
    "joint ADE [m]",
    "joint FDE [m]",
    "RMSE [m]",
    "missed",
    "cover",
)
"""Columns of both tables between K and the steps."""

ROW_NAMES = {"dgvae": "dG-VAE", "dnri": "dNRI", "imma": "IMMA", "lstm": "LSTM", "mlp": "MLP"}
"""What a table calls a model; others go by their own name."""

MAX_STEPS_SHOWN = 6
"""Steps of the horizon that fit on a screen, the first and the last among them; accuracy.json has all."""

VIEWS = {"horizon_only": "Horizon-only", "whole_sequence": "Whole sequence"}
EXPLAINED = {
    "horizon_only": "Errors on the 10 future steps after a burn-in of 40, best of K samples",
    "whole_sequence": "Errors over all predicted steps of the sequence, one-step errors of the burn-in included",
}
METRICS = {"overall_rmse_m": ("RMSE", "rmse"), "min_ade_m": ("minADE", "ade"), "min_fde_m": ("minFDE", "fde")}


def markdown_report(content: dict[str, Any]) -> str:
    """The whole table: one part per view, then graph and features."""
    sizes = content["sizes"]
    parts = [
        f"# {content['title']}, budget `{content['budget']}`",
        f"{sizes['steps']:,} optimiser steps of {sizes['batch_size']} windows, "
        f"{sizes['max_episodes'] or 'all'} training episodes, the same for every row; selected on free-run minADE. "
        f"Training took {content['train_seconds'] / 60:.0f} core-minutes or device-minutes in all. "
        "Mean ± standard error over 20 random subsets of the test windows. Metres. One seed per row.",
    ]
    for view, heading in VIEWS.items():
        parts += [f"## {heading}", EXPLAINED[view] + ".", _accuracy_table(content, view)]
    graph = _graph_table(content)
    if graph:
        parts += ["## Graph and edge features", graph]
    parts.append(_size_line(content))
    if content["failed"]:
        parts.append("Failed rows: " + "; ".join(f"{k}: {v}" for k, v in content["failed"].items()))
    made = content["provenance"]
    parts.append(f"`{made['command']}`, commit {made['commit']}, {made['machine']}.")
    return "\n\n".join(parts) + "\n"


def latex_table(content: dict[str, Any]) -> str:
    """Both views as one booktabs table."""
    kinds = _kinds(content)
    columns = [(view, kind, metric) for view in VIEWS for kind in kinds for metric in METRICS]
    lines = [
        f"% {content['provenance']['command']}, commit {content['provenance']['commit']}",
        r"\begin{tabular}{l" + "r" * (1 + len(columns)) + "}",
        r"\toprule",
        " & ".join(["Model", "$K$", *(f"{VIEWS[v]}, {k}: {METRICS[m][0]} [m]" for v, k, m in columns)]) + r" \\",
        r"\midrule",
    ]
    for row in content["rows"]:
        cells = [_cell(row, v, k, m).replace("±", r"$\pm$") for v, k, m in columns]
        lines.append(" & ".join([row["name"], _samples_of(row), *cells]) + r" \\")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}"]) + "\n"


def _kinds(content: dict[str, Any]) -> list[str]:
    return list(content["rows"][0]["tests"]) if content["rows"] else []


def _accuracy_table(content: dict[str, Any], view: str) -> str:
    kinds = _kinds(content)
    headings, paper_keys = ["model", "K"], []
    for kind in kinds:
        for name, key in METRICS.values():
            headings.append(name if kind == "test" else f"{kind} {name}")
            paper_keys.append(key if kind == "test" else f"{kind}_{key}")
    headings.append(
        "paper's " + " / ".join(name for name, _ in METRICS.values()) + (" / OOD" if "ood" in kinds else "")
    )
    lines = []
    for row in content["rows"]:
        cells = [_cell(row, view, kind, metric) for kind in kinds for metric in METRICS]
        figures = content["paper"].get(row["key"], {})
        beside = " / ".join(f"{figures[key]:.3f}" for key in paper_keys if key in figures)
        lines.append([row["name"], _samples_of(row), *cells, beside or "–"])
    return markdown.table(headings, lines, "-" + "r" * (len(headings) - 2) + "-")


def _samples_of(row: dict[str, Any]) -> str:
    """Returns K, the number of forecasts per window that the best-of-K errors choose from."""
    return str(next(iter(row["tests"].values()))["horizon_only"]["num_samples"])


def _cell(row: dict[str, Any], view: str, kind: str, metric: str) -> str:
    accuracy = row["tests"][kind][view]
    statistic = accuracy["statistics"].get(metric)
    if statistic is None:
        return f"{accuracy[metric]:.3f}"
    digits = 4 if accuracy[metric] < 0.02 else 3
    error = statistic["standard_error"]
    return f"{accuracy[metric]:.{digits}f}" + (f" ± {error:.{digits}f}" if error is not None else "")


def _graph_table(content: dict[str, Any]) -> str:
    """Graph accuracy, F1, connectivity; R² of the first attribute on true edges; calibration of the samples."""
    kinds = _kinds(content)
    lines = []
    for row in content["rows"]:
        cells: list[str] = []
        for kind in kinds:
            test = row["tests"][kind]
            graph, scores = test["graph"] or {}, test["features"] or {}
            coverage = test["horizon_only"]["statistics"].get("coverage")
            numbers = [graph.get("accuracy"), graph.get("f1"), graph.get("connectivity"), test.get("prior_entropy")]
            numbers += [scores.get("direct_r2"), scores.get("linear_r2"), coverage and coverage["mean"]]
            cells += [_number(x) for x in numbers]
        if any(c != "–" for c in cells):
            lines.append([row["name"], _samples_of(row), *cells])
    if not lines:
        return ""
    names = [
        "graph accuracy",
        "F1",
        "connectivity",
        "prior entropy [nats]",
        "R² (first dimension)",
        "R² (linear)",
        "coverage of 90 %",
    ]
    headings = ["model", "K", *(n if kind == "test" else f"{kind} {n}" for kind in kinds for n in names)]
    return markdown.table(headings, lines, "-r")


def _number(value: Any) -> str:
    return "–" if value is None else f"{value:.3f}"


def _size_line(content: dict[str, Any]) -> str:
    trained = [r for r in content["rows"] if r["parameters"]]
    sizes = [f"{r['name']} {r['parameters']:,} ({r['train_seconds'] / 60:.1f} min)" for r in trained]
    tests = [
        f"{kind}: {t['windows']:,} windows of {t['agents']['min']} to {t['agents']['max']} agents"
        for kind, t in (content["rows"][0]["tests"].items() if content["rows"] else ())
    ]
    memory = max((t.get("peak_memory_mb", 0.0) for r in content["rows"] for t in r["tests"].values()), default=0.0)
    return (
        f"Measured on {'; '.join(tests)}. Parameters (training time): {', '.join(sizes)}. "
        f"Largest memory of any row's process, training included: {memory:,.0f} MB."
    )


def scores_markdown(content: dict[str, Any]) -> str:
    """What scores.json holds, as tables and sentences."""
    parts = [
        f"# What the edges of `{content['config']['checkpoint']}` say about {content['source']}",
        f"{content['windows']} windows of {content['episodes']} episodes; features are read at the last of "
        f"{content['config']['burn_in_steps']} observed steps.",
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
            plain(s["r2"]),
            plain(s["chance"]),
            _signed(s["distance_correlation"]),
            plain(s["linear_r2"]),
            plain(s["direct_r2"]),
        ]
        for s in scores
    ]
    header = ["property", "pairs", "best", "r", "r²", "chance", "distance", "linear R²", "direct R²"]
    return markdown.table(header, rows)


def _graph_lines(content: dict[str, Any]) -> str:
    graph, apart = content["graph"], content["separation"]
    lines = [
        f"* accuracy {plain(graph['accuracy'])}, F1 {plain(graph['f1'])} over {graph['pairs']} ordered pairs; "
        f"always saying 'edge' has accuracy {plain(graph['true_connectivity'])}, always 'no edge' "
        f"{plain(None if graph['true_connectivity'] is None else 1 - graph['true_connectivity'])}"
    ]
    if apart is not None:
        lines.append(
            f"* chance that an edge has the larger value than a non-edge (AUC; 0.5 is chance, near 0 is as good as "
            f"near 1): feature {apart['dimension']} {plain(apart['auc'])}, the model's own probability "
            f"{plain(apart['edge_prob_auc'])}"
        )
    return "\n".join(lines)


def _disentanglement_lines(content: dict[str, Any]) -> str:
    found = content["disentanglement"]
    lines = [
        f"* MIG {plain(found['mig'])} over {found['rows']} true edges (1: each attribute is held by one dimension "
        "alone, 0: by none, or by two alike)"
    ]
    if found["dci"] is not None:
        dci = found["dci"]
        one = "" if dci["disentanglement"] is not None else " (not defined for one attribute)"
        lines.append(
            f"* DCI: disentanglement {plain(dci['disentanglement'])}{one}, completeness "
            f"{plain(dci['completeness'])}, informativeness {plain(dci['informativeness'])}"
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
        row = [str(d), kind, f"{spread:.3g}", plain(whole["within"][d], 2), plain(late["within"][d], 2)]
        rows.append(row + [_signed(s["correlations"][d]) for s in scored])
    header = ["feature", "kind", "spread", "changing", "changing, 2nd half", *(f"r: {s['name']}" for s in scored)]
    return markdown.table(header, rows)


def _stillness_note(content: dict[str, Any]) -> str:
    whole, late = content["stillness"], content["stillness_late"]
    which = "true edges" if content["edges"] is not None else "pairs"
    return (
        f"changing: variance within a pair over time / variance over pairs and time; 0 stands still, 1 is all change. "
        f"Over all {whole['steps']} observed steps ({whole['edges']} {which} that are there throughout), and over the "
        f"second half ({late['edges']}). static: averaged over the past (pair matching), so stiller by construction. "
        f"spread: standard deviation in the second half; a dash beside it is a dimension that never changes at all."
    )


def plain(value: float | None, places: int = 3) -> str:
    """A number to so many places, or a dash."""
    return "–" if value is None else f"{value:.{places}f}"


def _signed(value: float | None) -> str:
    return "–" if value is None else f"{value:+.2f}"


def accuracy_table(rows: Sequence[Accuracy], dt_s: float, title: str) -> Table:
    """One line per row; the columns by horizon hold displacement, RMSE and NLL, for `MAX_STEPS_SHOWN` of its steps."""
    table = Table(title=title, show_lines=True)
    table.add_column("forecaster")
    for heading in ("K", *SCALARS, "forecasts"):
        table.add_column("\n".join(heading.split()).replace("[", r"\["), justify="right")
    shown = _steps_shown(rows)
    for step in shown:
        table.add_column(f"{dt_s * (step + 1):g} s", justify="right")
    for row in rows:
        stacks = [(row.by_step_m[i], row.rmse_m[i], *([row.nll[i]] if row.nll else [])) for i in shown]
        cells = ["\n".join(_rounded_number(value, 2) for value in stack) for stack in stacks]
        scalars = [cell.replace(" ± ", "\n±") for cell in _scalar_cells(row)]
        table.add_row(row.name, str(row.num_samples), *scalars, str(row.agents), *cells)
    table.caption = (
        r"by time ahead: displacement of the best sample \[m] / RMSE of the mean \[m] / NLL \[nats], top to bottom; "
        f"± standard error over subsets of the windows; missed: ends more than {rows[0].miss_threshold_m:g} m off; "
        f"cover: truths within the central {100 * COVERAGE_SHARE:g} % of the samples"
    )
    return table


def markdown_table(rows: Sequence[Accuracy], dt_s: float) -> str:
    """The same as Markdown; by time ahead the displacement alone."""
    shown = _steps_shown(rows)
    steps = [f"{dt_s * (i + 1):g} s" for i in shown]
    lines = [
        [row.name, str(row.num_samples), *_scalar_cells(row), *(_rounded_number(row.by_step_m[i], 2) for i in shown)]
        for row in rows
    ]
    return markdown.table(["forecaster", "K", *SCALARS, *steps], lines) + "\n"


def _steps_shown(rows: Sequence[Accuracy]) -> list[int]:
    horizon = len(rows[0].by_step_m)
    return np.linspace(0, horizon - 1, min(horizon, MAX_STEPS_SHOWN)).round().astype(int).tolist()


def _rounded_number(value: float, places: int) -> str:
    """Fixed places, or two digits where those would show fewer; springs err by millimetres, traffic by metres."""
    if math.isnan(value):
        return "–"
    return f"{value:.{places}f}" if value == 0 or abs(value) >= 10 ** (1 - places) else f"{value:.2g}"


def _scalar_cells(row: Accuracy) -> list[str]:
    """Cells under `SCALARS`; what was not measured is a dash."""

    def metres(name: str) -> str:
        value: float = getattr(row, name)
        error = row.statistics[name].standard_error if name in row.statistics else None
        return _rounded_number(value, 3) + ("" if error is None else f" ± {_rounded_number(error, 3)}")

    lengths = [
        metres(name) for name in ("min_ade_m", "min_fde_m", "min_joint_ade_m", "min_joint_fde_m", "overall_rmse_m")
    ]
    miss = "–" if math.isnan(row.miss_rate) else f"{100 * row.miss_rate:.1f} %"
    covered = f"{100 * row.statistics['coverage'].mean:.0f} %" if "coverage" in row.statistics else "–"
    return [*lengths, miss, covered]
