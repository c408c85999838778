"""Pictures of reports: the legend below the panels lies inside the picture, whatever its words."""

import io
import re

import numpy as np
import pytest
from PIL import Image

from predictor.reports.figures import files_of, panels, svg_of


def drawn(count: int, labels: list[str]) -> tuple[str, bytes, list[int]]:
    """Returns the pictures of panels with a line per label, and the columns of their legends."""
    figure, axes = panels(count)
    for label in labels:
        axes[0].plot([0, 1], [0, 1], label=label)
    written, pixels = files_of(figure, axes)
    return written, pixels, [legend._ncols for legend in figure.legends]


@pytest.mark.parametrize(
    ("count", "labels", "columns"),
    [
        (2, ["zeros", "forecast", "planner"], 3),
        (1, ["constant-velocity (n = 10)", "forecast (n = 10)", "best constant action"], 2),
        (1, ["a name that is nearly as long as the picture is wide", "and another one"], 1),
        (1, [], None),
    ],
)
def test_a_legend_has_as_many_columns_as_fit(count: int, labels: list[str], columns: int | None):
    written, pixels, found = drawn(count, labels)
    assert found == ([] if columns is None else [columns])
    assert written.startswith("<svg")
    picture = np.asarray(Image.open(io.BytesIO(pixels)).convert("L"))
    assert (picture[:, [0, -1]] > 250).all(), "nothing reaches the border"


def test_pictures_of_equal_content_are_equal():
    first, second = (svg_of(*panels(2)) for _ in range(2))
    assert first == second and not re.search(r"<\?xml|<!DOCTYPE", first)
