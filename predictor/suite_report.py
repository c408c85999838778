"""A suite's results as Markdown and LaTeX: ours beside the paper's, both views, graph and features."""

from typing import Any

VIEWS = {"horizon_only": "Horizon-only", "whole_sequence": "Whole sequence"}
EXPLAINED = {
    "horizon_only": "Errors on the 10 future steps after a burn-in of 40, best of K = 20 samples",
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
        r"\begin{tabular}{l" + "r" * len(columns) + "}",
        r"\toprule",
        " & ".join(["Model", *(f"{VIEWS[v]}, {k}: {METRICS[m][0]} [m]" for v, k, m in columns)]) + r" \\",
        r"\midrule",
    ]
    for row in content["rows"]:
        cells = [_cell(row, v, k, m).replace("±", r"$\pm$") for v, k, m in columns]
        lines.append(" & ".join([row["name"], *cells]) + r" \\")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}"]) + "\n"


def _kinds(content: dict[str, Any]) -> list[str]:
    return list(content["rows"][0]["tests"]) if content["rows"] else []


def _accuracy_table(content: dict[str, Any], view: str) -> str:
    kinds = _kinds(content)
    headings, paper_keys = ["model"], []
    for kind in kinds:
        for name, key in METRICS.values():
            headings.append(name if kind == "test" else f"{kind} {name}")
            paper_keys.append(key if kind == "test" else f"{kind}_{key}")
    headings.append(
        "paper's " + " / ".join(name for name, _ in METRICS.values()) + (" / OOD" if "ood" in kinds else "")
    )
    lines = ["| " + " | ".join(headings) + " |", "|---|" + "---:|" * (len(headings) - 2) + "---|"]
    for row in content["rows"]:
        cells = [_cell(row, view, kind, metric) for kind in kinds for metric in METRICS]
        figures = content["paper"].get(row["key"], {})
        beside = " / ".join(f"{figures[key]:.3f}" for key in paper_keys if key in figures)
        lines.append("| " + " | ".join([row["name"], *cells, beside or "–"]) + " |")
    return "\n".join(lines)


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
            lines.append("| " + " | ".join([row["name"], *cells]) + " |")
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
    headings = ["model", *(n if kind == "test" else f"{kind} {n}" for kind in kinds for n in names)]
    return "\n".join(["| " + " | ".join(headings) + " |", "|---|" + "---:|" * (len(headings) - 1), *lines])


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
