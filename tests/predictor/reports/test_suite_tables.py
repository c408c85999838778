"""Tables of a suite, from results with known numbers."""

import math
from copy import deepcopy
from typing import Any

import pytest

from predictor.evaluation.paper_tables import TABLES
from predictor.evaluation.training_seeds import joined
from predictor.reports.suite_tables import _escaped, grids, latex_table, markdown_report
from predictor.support.errors import UserError

LENGTHS = ("ade_m", "fde_m", "min_ade_m", "min_fde_m", "min_joint_ade_m", "energy_m", "overall_rmse_m")


def accuracy(first: float, samples: int = 20) -> dict[str, Any]:
    values = {name: first + i for i, name in enumerate(LENGTHS)}
    statistics = {name: {"mean": value, "standard_error": 0.125} for name, value in values.items()}
    statistics["mixture_nll"] = {"mean": -1.5, "standard_error": 0.25}
    return values | {
        "num_samples": samples, "statistics": statistics, "coverage": [0.875, 0.5, 0.25],
        "mixture_coverage": [0.75, 0.5, 1.0], "overlap": 0.0625,
        "true_overlap": 0.03125,
    }  # fmt: skip


def result(key: str, first: float = 1.0, seed: int = 0, kinds: tuple[str, ...] = ("test",), samples: int = 20) -> Any:
    test = {
        "windows": 7, "agents": {"min": 5, "median": 5.0, "max": 5}, "horizon_only": accuracy(first, samples),
        "whole_sequence": accuracy(first / 2, samples), "graph": {"accuracy": 0.75, "f1": 0.5, "connectivity": 0.25},
        "prior_entropy": None, "features": None,
    }  # fmt: skip
    return {
        "key": key, "name": key.title(), "seed": seed, "train_seconds": 60.0, "measure_seconds": 1.0,
        "parameters": 10, "fitted": {}, "tests": {kind: deepcopy(test) for kind in kinds},
    }  # fmt: skip


def content(rows: list[dict[str, Any]], **changes: Any) -> dict[str, Any]:
    made = {"command": "python", "commit": "abc", "machine": "here"}
    return {
        "title": "Toy", "budget": "smoke", "sizes": {"steps": 1, "batch_size": 2, "max_episodes": 0},
        "num_samples": 20, "seeds": 1, "overlap_m": 0.0, "train_seconds": 60.0, "rows": rows, "paper": {},
        "published": {}, "protocol": {"burn_in_steps": 40, "horizon_steps": 10}, "failed": {}, "provenance": made,
    } | changes  # fmt: skip


def cells(grid: Any, name: str) -> dict[str, str]:
    found = next(line for line in grid.lines if line[0] == name)
    return dict(zip(grid.columns, found, strict=True))


def test_a_line_shows_its_single_forecast_and_its_samples():
    horizon = grids(content([joined([result("model")])]))[0]
    assert cells(horizon, "Model") == {
        "model": "Model", "K": "20", "ADE₁": "1.000 ± 0.125", "FDE₁": "2.000 ± 0.125", "minADE": "3.000 ± 0.125",
        "minFDE": "4.000 ± 0.125", "joint minADE": "5.000 ± 0.125", "energy score": "6.000 ± 0.125",
        "RMSE": "7.000 ± 0.125", "NLL": "-1.50 ± 0.25", "90 % cover": "88 / 25 %", "… of mixture": "75 / 100 %",
    }  # fmt: skip


def test_lines_of_another_k_are_refused():
    rows = [joined([result("a")]), joined([result("b", samples=1)])]
    for write in (markdown_report, latex_table):
        with pytest.raises(UserError, match=r"lines of a table need K = 20, got K = \[1, 20\]"):
            write(content(rows))


def test_each_store_has_a_table_and_the_whole_sequence_has_one_beside_the_papers_figures():
    figures = {"ade": 0.25, "fde": 0.5, "rmse": 0.125, "ood_ade": 2.0}
    made = content([joined([result("model", kinds=("test", "ood"))])], paper={"model": figures})
    first, second, whole, graph = grids(made)
    assert [g.heading for g in (first, second, whole, graph)] == [
        "Horizon-only", "Horizon-only: ood", "Whole sequence", "Graph and edge features",
    ]  # fmt: skip
    assert whole.columns == [
        "model", "K", "minADE", "minFDE", "RMSE", "ood minADE", "ood minFDE", "ood RMSE",
        "paper's minADE / minFDE / RMSE / OOD minADE / OOD minFDE",
    ]  # fmt: skip
    assert whole.lines[0][-1] == "0.250 / 0.500 / 0.125 / 2.000" and whole.lines[0][2] == "2.500 ± 0.125"
    assert "paper" not in " ".join(first.columns)
    assert cells(graph, "Model")["ood graph accuracy"] == "0.750"
    assert latex_table(made).count(r"\begin{tabular}") == 4


def test_overlap_stands_where_agents_have_a_size():
    rows = [joined([result("model")])]
    assert "overlap (truth)" not in grids(content(rows))[0].columns
    grid = grids(content(rows, overlap_m=0.5))[0]
    assert cells(grid, "Model")["overlap (truth)"] == "6.2 (3.1) %" and "agents nearer than 0.5 m" in grid.caption
    assert "players nearer than 0.5 m" in grids(content(rows, overlap_m=0.5, overlap_of="players"))[0].caption


def test_every_name_of_a_line_can_be_set_by_latex():
    """In its own letters or by a macro."""
    names = {line.name for table in TABLES.values() for line in table.lines}
    assert {name for name in names if not _escaped(name).replace("–", "-").isascii()} == set()


def test_seeds_are_shown_by_mean_and_range_and_a_line_without_training_keeps_its_standard_error():
    rows = [
        joined([result("model", first, seed) for seed, first in enumerate((1.0, 2.0, 6.0))]),
        joined([result("cv")]),
    ]
    made = content(rows, seeds=3)
    horizon, whole, graph = grids(made)
    assert cells(horizon, "Model")["ADE₁"] == "3.000 (1.000 to 6.000)"
    assert cells(horizon, "Cv")["ADE₁"] == "1.000 ± 0.125"
    assert cells(horizon, "Model")["NLL"] == "-1.50 (-1.50 to -1.50)"
    assert cells(whole, "Model")["minADE"] == "3.500 (2.500 to 5.000)"
    assert cells(graph, "Model")["F1"] == "0.500 (0.500 to 0.500)" and cells(graph, "Cv")["F1"] == "0.500"
    assert "mean over 3 training seeds (lowest to highest)" in markdown_report(made)
    assert "One seed per line" not in markdown_report(made)
    for run, memory in zip(rows[0]["runs"], (1000.0, 5000.0, 2000.0), strict=True):
        run["tests"]["test"]["peak_memory_mb"] = memory
    assert "training included: 5,000 MB" in markdown_report(made)


def test_what_was_not_measured_is_a_dash():
    one = result("model")
    test = one["tests"]["test"]
    del test["horizon_only"]["statistics"]["mixture_nll"]
    test["horizon_only"]["coverage"], test["graph"] = [], None
    del test["horizon_only"]["mixture_coverage"]  # as in results of version 0.1.0
    horizon, whole = grids(content([joined([one])]))  # no graph, no table of graphs
    assert [cells(horizon, "Model")[head] for head in ("NLL", "90 % cover", "… of mixture")] == ["–"] * 3
    assert whole.heading == "Whole sequence"


def test_the_report_says_what_the_controls_were_fitted_to():
    noisy, near = result("noise"), result("near")
    noisy["fitted"] = {"noise_m": 0.5, "growth": 1.25, "windows": 2000}
    near["fitted"] = {"neighbours": 19, "examples": 200_000}
    text = markdown_report(content([joined([noisy]), joined([near])]))
    assert "Noise: σ = 0.500 m at 1 s, p = 1.25" in text and "fitted to 2,000 training windows" in text
    assert "Near: mean of 19 and each of them, among 200,000 examples" in text


def test_a_suite_whose_lines_all_failed_still_says_why():
    text = markdown_report(content([], failed={"mlp, seed 0": "no luck"}))
    assert "Failed lines: mlp, seed 0: no luck" in text and "|" not in text


def test_seeds_whose_errors_were_not_measured_have_a_dash():
    rows = [joined([result("model", math.nan, 0), result("model", 1.0, 1)])]
    assert cells(grids(content(rows, seeds=2))[0], "Model")["ADE₁"] == "–"
