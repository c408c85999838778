"""A report as a list of blocks, written as Markdown or as one HTML page that needs no network."""

import html
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from predictor.support import markdown

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #1a1a1a; max-width: 62rem; margin: 2rem auto; padding: 0 1rem }
h1 { font-size: 1.6rem } h2 { font-size: 1.25rem; margin-top: 2.2rem; border-bottom: 1px solid #ddd }
table { border-collapse: collapse; margin: 1rem 0; display: block; overflow-x: auto }
th, td { padding: .3rem .7rem; text-align: right; border-bottom: 1px solid #e4e4e4; white-space: nowrap }
th:first-child, td:first-child { text-align: left } thead th { border-bottom: 2px solid #999 }
pre { background: #f6f6f6; padding: .8rem; overflow-x: auto; font-size: .85rem }
figure { margin: 1.2rem 0 } svg { max-width: 100%; height: auto } figcaption { color: #555; font-size: .9rem }
"""


@dataclass(frozen=True)
class Heading:
    """Heading of a part of the report."""

    text: str
    """Text of the heading."""
    level: int = 2
    """1 for the report, 2 for its parts."""


@dataclass(frozen=True)
class Paragraph:
    """Sentences."""

    text: str
    """Plain text."""


@dataclass(frozen=True)
class Table:
    """Table of texts."""

    headings: Sequence[str]
    """Headings of the columns."""
    lines: Sequence[Sequence[str]]
    """Cells of each line."""


@dataclass(frozen=True)
class Code:
    """Text that is shown as it is."""

    text: str
    """Content of a file, for example."""
    language: str
    """Language behind the fence in Markdown."""


@dataclass(frozen=True)
class Picture:
    """Picture with its caption."""

    file: str
    """Name of the file, beside the Markdown report in the folder `pictures`."""
    svg: str
    """Content of the file."""
    caption: str
    """Sentence below the picture."""


Block = Heading | Paragraph | Table | Code | Picture
PICTURES = Path("pictures")
"""Folder of the pictures, beside the Markdown report."""


def as_markdown(blocks: Sequence[Block]) -> str:
    """Returns the report as Markdown; pictures are links to their files."""
    return "\n\n".join(_markdown(block) for block in blocks) + "\n"


def as_html(title: str, blocks: Sequence[Block]) -> str:
    """Returns the report as one HTML page, with its style and pictures inside."""
    body = "\n".join(_html(block) for block in blocks)
    return (
        f'<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{html.escape(title)}</title>\n<style>{_STYLE}</style>\n</head>\n<body>\n{body}\n</body>\n</html>\n"
    )


def _markdown(block: Block) -> str:
    match block:
        case Heading():
            return f"{'#' * block.level} {block.text}"
        case Paragraph():
            return block.text
        case Table():
            return markdown.table(block.headings, block.lines, "lr")
        case Code():
            return f"```{block.language}\n{block.text.rstrip()}\n```"
        case Picture():
            return f"![{block.caption}]({PICTURES.as_posix()}/{block.file})"


def _html(block: Block) -> str:
    match block:
        case Heading():
            return f"<h{block.level}>{html.escape(block.text)}</h{block.level}>"
        case Paragraph():
            return f"<p>{html.escape(block.text)}</p>"
        case Table():
            head = "".join(f"<th>{html.escape(text)}</th>" for text in block.headings)
            lines = ("".join(f"<td>{html.escape(cell)}</td>" for cell in line) for line in block.lines)
            body = "\n".join(f"<tr>{line}</tr>" for line in lines)
            return f"<table>\n<thead><tr>{head}</tr></thead>\n<tbody>\n{body}\n</tbody>\n</table>"
        case Code():
            return f"<pre>{html.escape(block.text.rstrip())}</pre>"
        case Picture():
            return f"<figure>\n{block.svg}\n<figcaption>{html.escape(block.caption)}</figcaption>\n</figure>"
