"""Markdown tables: the one place that knows how a line of cells is written."""

from collections.abc import Iterable, Sequence

_RULES = {"-": "---", "l": ":---", "r": "---:"}


def table(headings: Sequence[str], lines: Iterable[Sequence[str]], align: str = "") -> str:
    """Writes a table; no newline at its end.

    Args:
        headings: of the columns.
        lines: cells of each line, as many as there are headings; a ``|`` in a cell is escaped.
        align: a letter for each column: ``l`` left, ``r`` right, ``-`` as the page has it; the last letter stands for
            all columns that follow, nothing for ``-``.

    Raises:
        ValueError: a line has more or fewer cells than there are headings.
    """
    letters = (align or "-").ljust(len(headings), (align or "-")[-1])[: len(headings)]
    written = [_line(headings), f"|{'|'.join(_RULES[letter] for letter in letters)}|"]
    for cells in lines:
        if len(cells) != len(headings):
            raise ValueError(f"a line needs {len(headings)} cells, got {len(cells)}: {list(cells)}")
        written.append(_line([cell.replace("|", r"\|") for cell in cells]))
    return "\n".join(written)


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"
