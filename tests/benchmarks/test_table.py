import io

import pytest
from rich.console import Console

from benchmarks.results import Line, skipped
from benchmarks.table import HEADINGS, cells, number, plain, rich_table

FULL = Line(
    "forecast", "roll-out", {"preset": "fast", "batch": 8}, 12.345, "ms", (11.0, 13.0), ratio=0.5, ratio_to="evolving",
    flop=3e9, flops_per_s=2.5e10, matmul_share=0.256, note="a note",
)  # fmt: skip
ABSENT = skipped("ppo", "ratio", "needs envpool")


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.0, "0"), (0.001234, "0.00123"), (0.5, "0.5"), (1.234, "1.23"), (12.34, "12.3"), (123.4, "123"),
     (999.7, "1,000"), (12345.6, "12,346")],
)  # fmt: skip
def test_three_digits(value: float, text: str):
    assert number(value) == text


def test_a_line_says_all_it_knows():
    assert cells(FULL) == (
        "forecast", "roll-out", "preset fast, batch 8", "12.3 ms", "11–13", "0.50 of evolving", "25", "26 %", "a note",
    )  # fmt: skip


def test_a_skipped_line_says_why():
    assert cells(ABSENT) == ("ppo", "ratio", "", "–", "", "", "", "", "skipped: needs envpool")


def test_plain_text_is_aligned_and_without_lines():
    lines = plain([FULL, ABSENT]).split("\n")
    assert len(lines) == 3
    assert lines[0].split() == " ".join(HEADINGS).split()
    assert lines[1].index("a note") == lines[2].index("skipped: needs envpool") == lines[0].index("note")
    assert not set("│┃─━|") & set("".join(lines))


def test_the_terminals_table_holds_the_same_cells():
    console = Console(file=io.StringIO(), width=300)
    console.print(rich_table([FULL, ABSENT]))
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert all(cell in text for line in (FULL, ABSENT) for cell in cells(line))
