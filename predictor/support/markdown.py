"""Markdown tables."""

from collections.abc import Iterable, Sequence

_RULES = {"-": "---", "l": ":---", "r": "---:"}


def table(headings: Sequence[str], lines: Iterable[Sequence[str]], align: str = "") -> str:
    """Returns a table as text, without a newline at its end.

    Args:
        headings: headings of the columns.
        lines: cells of each line, as many as there are headings; a ``|`` in a cell is escaped.
        align: letter for each column: ``l`` left, ``r`` right, ``-`` the page's default; the last letter holds for all
            further columns, and an empty text is ``-``.

    Raises:
        ValueError: a line does not have as many cells as there are headings.
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
