from collections.abc import Iterator

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from predictor.evaluation import paper_tables
from predictor.evaluation.accuracy import Accuracy
from predictor.evaluation.paper_tables import PaperTable
from predictor.reports.looks import GREY
from predictor.reports.plots import PlainLogFormatter, figure_by_step, plot_error_by_horizon, plot_scene


@pytest.fixture
def ax() -> Iterator[Axes]:
    yield Figure().add_subplot()


def accuracy(name: str, samples: int, errors: list[float]) -> Accuracy:
    return Accuracy(name, samples, 0.0, 0.0, errors, errors, [], 1)


def test_error_curves_are_drawn_over_seconds(ax: Axes):
    assert (
        plot_error_by_horizon(
            ax, [accuracy("dG-VAE", 20, [1.0, 2.0]), accuracy("constant velocity", 1, [3.0, 4.0])], 0.5
        )
        is ax
    )
    model, straight = ax.lines
    assert model.get_xdata().tolist() == straight.get_xdata().tolist() == [0.5, 1.0]
    assert (list(model.get_ydata()), list(straight.get_ydata())) == ([1.0, 2.0], [3.0, 4.0])
    assert straight.get_color() == GREY != model.get_color()
    assert [text.get_text() for text in ax.get_legend().get_texts()] == ["dG-VAE, K = 20", "constant velocity, K = 1"]


def test_scene_has_solid_history_dashed_forecast_and_thin_truth(ax: Axes):
    history = np.zeros((3, 3, 2))
    history[:, :, 0] = np.arange(3)[:, None] + 10 * np.arange(3)
    history_valid = np.array([[True, False, False], [True, True, False], [True, True, False]])
    forecast, future = np.full((2, 3, 2, 2), 7.0), np.full((3, 2, 2), 5.0)
    future_valid = np.array([[True, False], [False, False], [True, True]])
    plot_scene(ax, history, history_valid, forecast, future, future_valid)
    solid = [
        line
        for line in ax.lines
        if line.get_linestyle() == "-" and line.get_color() != "black" and line.get_marker() == "."
    ]
    dashed = [line for line in ax.lines if line.get_linestyle() == "--"]
    thin = [line for line in ax.lines if line.get_color() == "black"]
    assert [line.get_xdata().tolist() for line in solid] == [[0.0, 1.0, 2.0], [11.0, 12.0]]  # the third was never seen
    assert [line.get_xdata().tolist() for line in dashed] == [[2.0, 7.0, 7.0]] * 2  # from where the first one is now
    assert [line.get_xdata().tolist() for line in thin] == [[2.0, 5.0]]
    assert {line.get_color() for line in dashed} == {solid[0].get_color()}
    assert thin[0].get_linewidth() < solid[0].get_linewidth()
    assert ax.get_aspect() == 1.0


@pytest.mark.parametrize("name", ["SPRINGS", "NBA"])
def test_figures_by_step_have_room_for_the_names_of_their_lines(name: str):
    table: PaperTable = getattr(paper_tables, name)
    view = {"by_step_m": [1.0, 2.0], "step_errors": {"by_step_m": [0.1, None]}, "num_samples": 7}
    tests = {kind: {"horizon_only": view} for kind in table.tests}
    results = [{"key": line.key, "name": line.name, "tests": tests} for line in table.lines]
    figure = figure_by_step(results, list(table.tests), 0.1, "headline")
    figure.canvas.draw()
    legend, page = figure.legends[0].get_window_extent(), figure.bbox
    assert page.x0 <= legend.x0 and legend.x1 <= page.x1 and page.y0 <= legend.y0
    drawn = [text.get_text() for text in figure.legends[0].get_texts()]
    assert drawn == [line.name for line in table.lines if line.key != "least-squares"]
    assert "best of 7" in figure.axes[0].get_ylabel()
    labels = [text.get_text() for text in figure.axes[0].get_yticklabels(which="both")]
    assert "1" in labels and not any("$" in label for label in labels)


def test_a_logarithmic_axis_over_decades_has_labels_at_powers_of_ten_alone():
    figure = Figure()
    ax = figure.subplots()
    ax.set_yscale("log")
    ax.set_ylim(1e-4, 2.0)
    ax.yaxis.set_major_formatter(PlainLogFormatter())
    ax.yaxis.set_minor_formatter(PlainLogFormatter())
    figure.canvas.draw()
    labels = {text.get_text() for text in ax.get_yticklabels(which="both")} - {""}
    assert {"0.001", "0.1", "1"} <= labels and not labels & {"0.002", "0.03", "0.5"}
