from dataclasses import replace
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from matplotlib import pyplot as plt
from rich.console import Console

from envs.rollouts import report
from envs.rollouts.episode import MODEL, NEIGHBOURS, RESIDUAL, STRAIGHT, Case, memory_key
from envs.rollouts.report import EnvAccuracy
from predictor.evaluation.accuracy import Accuracy
from predictor.evaluation.graph_accuracy import GraphAccuracy
from predictor.reports.looks import GREY


def accuracy(name: str, ade_m: float, samples: int = 1) -> Accuracy:
    """Three steps; the interval at the second one is missing."""
    steps = [ade_m / 2, ade_m, 2 * ade_m]
    band = [(0.4 * ade_m, 0.6 * ade_m), None, (1.5 * ade_m, 2.5 * ade_m)]
    return Accuracy(
        name, samples, ade_m, 2 * ade_m, steps, steps, [1.0, 2.0, 3.0], 40,
        intervals={"min_ade_m": (0.9 * ade_m, 1.1 * ade_m)}, step_intervals={"by_step_m": band},
        miss_by_step=[0.0, 0.5, 1.0], min_joint_ade_m=ade_m, energy_m=ade_m, ade_m=ade_m,
    )  # fmt: skip


def result(env_id: str = "tag", checkpoint: str = "mine", reduction: float = 0.5) -> EnvAccuracy:
    return EnvAccuracy(
        env_id, checkpoint, "heuristic", 0.1,
        accuracy("dG-VAE", 1.0), accuracy("dG-VAE", 0.5, 20), accuracy(STRAIGHT, 2.0),
        reduction, (0.4, 0.6), latency_median_ms=1.25, latency_p95_ms=4.5,
    )  # fmt: skip


def full() -> EnvAccuracy:
    graph = GraphAccuracy(120, 0.3, accuracy=0.875, f1=0.5, true_connectivity=0.25, commonest=0.75)
    histories = {1: accuracy("dG-VAE, 1 step of history", 1.5)}
    controls = {RESIDUAL: accuracy(RESIDUAL, 0.75, 20), NEIGHBOURS: accuracy(NEIGHBOURS, 1.25, 20)}
    many = replace(accuracy("dG-VAE", 0.5, 20), mixture_coverage=[0.75, 1.0, 0.875])
    return replace(result(), model_samples=many, controls=controls, histories=histories, graph=graph)


def case(error_m: float = 1.0, agents: int = 3) -> Case:
    """Agent 1 goes straight up; agent 2 was never seen."""
    time = np.arange(4.0)
    history = np.zeros((4, agents, 2))
    history[:, :, 1] = time[:, None]
    history[:, :, 0] = np.arange(agents)
    seen = np.ones((4, agents), dtype=np.bool_)
    seen[:, 2:] = False
    future = np.stack([np.full(3, 1.0), [4.0, 5.0, 6.0]], axis=-1)
    forecasts = {MODEL: future + 0.5, STRAIGHT: future - 0.5, memory_key(1): future + 9.0}
    return Case(error_m, 77, 3, 1, history, seen, forecasts, future)


def test_remarks_say_what_there_is():
    lines = report.remarks(full()).splitlines()
    assert lines == [
        "minADE (K = 1) 1.000 m, 95 % over episodes 0.900 to 1.100",
        "… with 1 step(s) of history 1.500 m, 1.350 to 1.650",
        "75 to 100 % of the coordinates, by step, within the central 90 % of the predicted mixture (modes with their "
        "spread)",
        "graph accuracy 87.5 % of 120 pairs (always the commoner answer: 75.0 %), F1 of edges 0.50",
        "latency 1.2 ms median, 4.5 ms p95 (K = 1)",
    ]
    assert len(report.remarks(result()).splitlines()) == 2


def cells_of(line: str) -> list[str]:
    return [cell.strip() for cell in line.strip("|").split("|")]


def test_a_single_episode_has_no_interval():
    one = replace(accuracy("dG-VAE", 1.0), intervals={})
    lines = report.remarks(replace(result(), model=one, histories={1: one}, edges={"edges cut": one})).splitlines()
    assert [line.rpartition(" ")[2] for line in lines[:3]] == ["–"] * 3 and "nan" not in "".join(lines)


def test_markdown_has_an_overview_and_a_table_per_environment():
    lines = report.markdown([full(), result("spread")], {}).splitlines()
    assert cells_of(lines[0]) == list(report.HEADS)
    assert cells_of(lines[2]) == [
        "tag", "mine", "0.1", "3", "1.00", "2.00", "0.500", "0.500", "0.500", "–", "0.750", "1.25", "2.00 / 4.00",
        "50 %", "40 to 60 %", "40", "1.2",
    ]  # fmt: skip
    assert cells_of(lines[3])[:2] == ["spread", "mine"] and cells_of(lines[3])[11] == "–"
    titles = [line for line in lines if line.startswith("### ")]
    assert titles == [
        "### tag, checkpoint mine, driven heuristic",
        "### spread, checkpoint mine, driven heuristic",
    ]  # one checkpoint is no transfer


def test_a_transfer_matrix_is_by_env_and_checkpoint():
    results = [result("a", "x", 0.25), result("a", "y", -0.5), result("b", "y", 1.0)]
    misfits = {("b", "x"): "another dt"}
    lines = report.markdown(results, misfits).split("### Transfer")[1].splitlines()
    assert [cells_of(line) for line in (lines[2], lines[4], lines[5])] == [
        ["env", "x", "y"],
        ["a", "1.00 (25 %)", "1.00 (-50 %)"],
        ["b", "–", "1.00 (100 %)"],
    ]
    assert lines[7] == "* b with x: another dt"


def shown(table: object) -> str:
    text = StringIO()
    Console(width=200, file=text).print(table)
    return text.getvalue()


def test_tables_of_a_terminal_have_units_and_dashes():
    text = shown(report.overview([full()]))
    assert "dt [s]" in text and "1.25" in text and "40 to 60 %" in text  # no unit is taken for markup
    matrix = shown(report.transfer([result("a", "x"), result("a", "y")], {("b", "x"): "another dt"}))
    (line,) = [line for line in matrix.splitlines() if line.split("│")[1:2] == [" b   "]]
    assert line.count("–") == 2 and "–: not measured, see accuracy.md" in matrix
    assert "not measured" not in shown(report.transfer([result("a", "x"), result("a", "y")], {}))


def test_long_names_are_broken_and_not_cut():
    name = "metadrive_reader:MetaDriveRoad-v0"
    for table in (report.overview([result(name, "a-long-name")]), report.transfer([result(name, "a")] * 2, {})):
        text = StringIO()
        Console(width=60, file=text).print(table)
        assert "…" not in text.getvalue()
    cells = [line.split("│")[1].strip() for line in shown(report.overview([result(name)])).splitlines() if "│" in line]
    assert set("".join(cells).split(name)) == {""}  # once in each part of the table


def test_lines_by_horizon_carry_the_numbers():
    figure, ax = plt.subplots()
    report.plot_by_horizon(ax, [*full().lines, full().constant_velocity], 0.1, "by_step_m", "displacement [m]")
    lines = {str(line.get_label()): line for line in ax.get_lines()}
    assert list(lines) == [
        "dG-VAE, K = 20", "model + Gaussian noise, K = 20", "nearest neighbours", "constant velocity",
    ]  # fmt: skip
    np.testing.assert_allclose(lines["constant velocity"].get_xdata(), [0.1, 0.2, 0.3])
    np.testing.assert_allclose(lines["constant velocity"].get_ydata(), [1.0, 2.0, 4.0])
    assert lines["constant velocity"].get_color() == GREY
    assert len(ax.collections) == 4  # a band each
    assert ax.get_ylabel() == "displacement [m]"
    plt.close(figure)


def test_a_case_shows_history_forecasts_and_what_happened():
    figure, ax = plt.subplots()
    report.plot_case(ax, case())
    lines = {str(line.get_label()): line for line in ax.get_lines() if not str(line.get_label()).startswith("_")}
    assert set(lines) == {"history", "others", "model", "constant velocity", "what happened"}  # no ablations
    np.testing.assert_allclose(lines["history"].get_xydata(), [[1, 0], [1, 1], [1, 2], [1, 3]])
    np.testing.assert_allclose(lines["what happened"].get_xydata(), [[1, 3], [1, 4], [1, 5], [1, 6]])
    np.testing.assert_allclose(lines["model"].get_xydata(), [[1, 3], [1.5, 4.5], [1.5, 5.5], [1.5, 6.5]])
    assert (lines["model"].get_linestyle(), lines["what happened"].get_linestyle()) == ("--", "-")
    assert ax.get_title() == "seed 77, step 3: 1.00 m off"
    assert ax.get_aspect() == 1.0
    plt.close(figure)


@pytest.mark.slow
@pytest.mark.parametrize("cases", [0, 1, 6])
def test_pictures_are_files_named_by_env_and_checkpoint(cases: int, tmp_path: Path):
    found = replace(full(), env_id="envpool/HighwayFast-v0")
    report.write_pictures(tmp_path / "new" / "folder", found, [case(float(i)) for i in range(cases)])
    names = {p.name for p in (tmp_path / "new" / "folder").iterdir()}
    gallery = {"envpool-HighwayFast-v0.mine.worst.png"} if cases else set()
    assert names == {"envpool-HighwayFast-v0.mine.by_horizon.png", *gallery}
    for name in names:
        pixels = plt.imread(tmp_path / "new" / "folder" / name)
        assert min(pixels.shape[:2]) > 300
        assert pixels[..., :3].std() > 0.05
    assert plt.get_fignums() == []


@pytest.mark.parametrize(("coverage", "shown_panels"), [([], 3), ([0.9, 0.9, 0.9], 4)])
def test_a_picture_has_no_empty_panel(
    coverage: list[float], shown_panels: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    panels: list[bool] = []
    monkeypatch.setattr(report, "save_figure", lambda figure, *_: panels.extend(ax.axison for ax in figure.axes))
    report.write_pictures(tmp_path, replace(result(), model_samples=replace(full().model, coverage=coverage)), [])
    plt.close("all")
    assert sum(panels) == shown_panels and len(panels) == 4
