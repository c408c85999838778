"""Tables for a terminal of any width: one that is too wide is shown as several below each other."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from rich.cells import cell_len
from rich.console import Console, ConsoleOptions
from rich.table import Table
from rich.text import Text

_AROUND = 3  # cells beside the content of a column: a space at each side and a border


@dataclass(frozen=True)
class FittedTable:
    """Table of texts, cut into tables that fit; each has the first columns."""

    title: str
    """Text above the first table."""
    headings: Sequence[str]
    """Headings of the columns, which may have several lines."""
    lines: Sequence[Sequence[str]]
    """Cells of each line, which may have several lines of text."""
    caption: str = ""
    """Text below the last table."""
    kept: int = 1
    """Number of columns, from the left, that every table has; they are texts, all others numbers."""
    ruled: bool = False
    """Whether there are rules between the lines."""

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[Table]:
        """Yields the tables for the width of a console."""
        groups = self.groups(options.max_width)
        for number, columns in enumerate(groups):
            table = Table(title=Text(self.title) if number == 0 else None, show_lines=self.ruled)
            if number == len(groups) - 1 and self.caption:
                table.caption = Text(self.caption)
            for column in columns:
                justify = "left" if column < self.kept else "right"
                table.add_column(Text(self.headings[column]), justify=justify, overflow="fold")  # type: ignore[arg-type]
            for line in self.lines:
                table.add_row(*(Text(line[column]) for column in columns))
            yield table

    def groups(self, width: int) -> list[list[int]]:
        """Returns the columns of each table; a column that fits beside the kept ones is never cut."""
        widths = [
            _AROUND + max(cell_len(part) for cell in cells for part in cell.split("\n"))
            for cells in zip(self.headings, *self.lines, strict=True)
        ]
        kept = list(range(self.kept))
        groups, room = [list(kept)], width - 1 - sum(widths[: self.kept])
        for column in range(self.kept, len(widths)):
            used = sum(widths[other] for other in groups[-1][self.kept :])
            if used + widths[column] > room and len(groups[-1]) > self.kept:
                groups.append(list(kept))
            groups[-1].append(column)
        return groups
