"""The one table: with lines on a terminal, as plain aligned text elsewhere."""

from collections.abc import Sequence

from rich.table import Table

from benchmarks.results import Row

HEADINGS = ("section", "measured", "shape", "median", "quartiles", "ratio", "GFLOP/s", "% of matmul", "note")
_RIGHT = ("median", "quartiles", "GFLOP/s", "% of matmul")


def cells(row: Row) -> tuple[str, ...]:
    """One line of the table."""
    ratio = "" if row.ratio is None else f"{row.ratio:.2f} "
    return (
        row.section,
        row.name,
        row.shape,
        "–" if row.value is None else f"{number(row.value)} {row.unit}".strip(),
        "" if row.quartiles is None else "–".join(number(q) for q in row.quartiles),
        f"{ratio}of {row.ratio_to}" if row.ratio_to else "",
        "" if row.flops_per_s is None else number(row.flops_per_s / 1e9),
        "" if row.matmul_share is None else f"{100 * row.matmul_share:.0f} %",
        row.note,
    )


def number(value: float) -> str:
    """Three significant digits, thousands with commas."""
    return f"{value:,.0f}" if abs(value) >= 999.5 else f"{value:.3g}"


def plain(rows: Sequence[Row]) -> str:
    """Aligned text without lines."""
    lines = [HEADINGS, *(cells(row) for row in rows)]
    widths = [max(len(line[column]) for line in lines) for column in range(len(HEADINGS))]

    def align(text: str, column: int) -> str:
        return text.rjust(widths[column]) if HEADINGS[column] in _RIGHT else text.ljust(widths[column])

    return "\n".join("  ".join(align(text, i) for i, text in enumerate(line)).rstrip() for line in lines)


def rich_table(rows: Sequence[Row]) -> Table:
    """For a terminal."""
    table = Table(*HEADINGS, title="benchmarks")
    for column in table.columns:
        if column.header in _RIGHT:
            column.justify = "right"
    before = ""
    for row in rows:
        if row.section != before:
            table.add_section()
        before = row.section
        table.add_row(*cells(row))
    return table
