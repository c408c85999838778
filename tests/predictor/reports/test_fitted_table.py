"""Tables for terminals of any width."""

import io

import pytest
from rich.console import Console

from predictor.reports.fitted_table import FittedTable

HEADINGS = ["env", *(f"column {i} [m]" for i in range(9))]
LINES = [[env, *(f"{i}.25 ± 0.1{i}" for i in range(9))] for env in ("highway-fast-v0", "intersection-multi-agent-v2")]


def printed(width: int, **options: object) -> list[str]:
    console = Console(file=io.StringIO(), width=width, color_system=None)
    console.print(FittedTable("a [title]", HEADINGS, LINES, "the caption", **options))  # type: ignore[arg-type]
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue().splitlines()


@pytest.mark.parametrize(("width", "tables"), [(200, 1), (80, 3), (48, 9), (20, 9)])
def test_every_cell_is_whole_in_as_many_tables_as_it_takes(width: int, tables: int):
    lines = printed(width)
    assert sum("━" in line for line in lines if line.startswith("┏")) == tables
    assert max(map(len, lines)) <= width
    if width > 40:
        text = "\n".join(lines)
        for cell in {cell for line in (HEADINGS, *LINES) for cell in line}:
            assert cell in text, cell
        assert text.count("intersection-multi-agent-v2") == tables
        assert text.count("a [title]") == text.count("the caption") == 1


def test_several_columns_can_be_kept():
    text = "\n".join(printed(80, kept=2))
    assert text.count("0.25 ± 0.10") == 2 * text.count("highway-fast-v0") > 2
