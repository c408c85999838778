"""Formats the table: with rules on a terminal, as plain aligned text elsewhere."""

from collections.abc import Sequence

from rich.table import Table

from benchmarks.results import Line

HEADINGS = ("section", "measured", "shape", "median", "quartiles", "ratio", "GFLOP/s", "% of matmul", "note")
_RIGHT = ("median", "quartiles", "GFLOP/s", "% of matmul")


def cells(line: Line) -> tuple[str, ...]:
    """Returns the cells of a line of the table."""
    ratio = "" if line.ratio is None else f"{line.ratio:.2f} "
    return (
        line.section,
        line.name,
        line.shape,
        "–" if line.value is None else f"{number(line.value)} {line.unit}".strip(),
        "" if line.quartiles is None else "–".join(number(q) for q in line.quartiles),
        f"{ratio}of {line.ratio_to}" if line.ratio_to else "",
        "" if line.flops_per_s is None else number(line.flops_per_s / 1e9),
        "" if line.matmul_share is None else f"{100 * line.matmul_share:.0f} %",
        line.note,
    )


def number(value: float) -> str:
    """Formats a number with three significant digits, thousands with commas."""
    return f"{value:,.0f}" if abs(value) >= 999.5 else f"{value:.3g}"


def plain(lines: Sequence[Line]) -> str:
    """Formats the table as aligned text without rules."""
    table = [HEADINGS, *(cells(line) for line in lines)]
    widths = [max(len(texts[column]) for texts in table) for column in range(len(HEADINGS))]

    def align(text: str, column: int) -> str:
        return text.rjust(widths[column]) if HEADINGS[column] in _RIGHT else text.ljust(widths[column])

    return "\n".join("  ".join(align(text, i) for i, text in enumerate(texts)).rstrip() for texts in table)


def rich_table(lines: Sequence[Line]) -> Table:
    """Formats the table for a terminal."""
    table = Table(*HEADINGS, title="benchmarks")
    for column in table.columns:
        if column.header in _RIGHT:
            column.justify = "right"
    before = ""
    for line in lines:
        if line.section != before:
            table.add_section()
        before = line.section
        table.add_row(*cells(line))
    return table
