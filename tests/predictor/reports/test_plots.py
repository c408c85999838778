from collections.abc import Iterator

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from predictor.evaluation.accuracy import Accuracy
from predictor.reports.looks import GREY
from predictor.reports.plots import plot_error_by_horizon, plot_scene


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
