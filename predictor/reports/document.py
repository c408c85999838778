"""A report as a list of blocks, written as Markdown or as one HTML page that needs no network."""

import base64
import html
import urllib.parse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from predictor.support import markdown

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #1a1a1a; max-width: 62rem; margin: 2rem auto; padding: 0 1rem }
h1 { font-size: 1.6rem } h2 { font-size: 1.25rem; margin-top: 2.2rem; border-bottom: 1px solid #ddd }
p, figcaption { overflow-wrap: anywhere }
table { border-collapse: collapse; margin: 1rem 0; display: block; overflow-x: auto }
th, td { padding: .3rem .7rem; text-align: right; border-bottom: 1px solid #e4e4e4 } td { white-space: nowrap }
th { vertical-align: bottom } th:first-child, td:first-child { text-align: left; padding-left: 0 }
thead th { border-bottom: 2px solid #999 }
.texts th, .texts td { text-align: left; white-space: normal; overflow-wrap: anywhere }
pre { background: #f6f6f6; padding: .8rem; overflow-x: auto; font-size: .85rem }
figure { margin: 1.2rem 0 } svg, img, video { max-width: 100%; height: auto }
figcaption { color: #555; font-size: .9rem }
@media (max-width: 40rem) { body { margin: 1rem auto } th, td { padding: .25rem .4rem; font-size: .85rem } }
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
    numbers: bool = True
    """Whether cells are numbers, at the right and on one line; others are texts, at the left."""


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
    png: bytes = b""
    """Picture as PNG, for a file beside the page; empty if there is none."""


@dataclass(frozen=True)
class Photo:
    """Picture of pixels with its caption."""

    data: bytes
    """Content of a PNG or JPEG file."""
    caption: str
    """Sentence below the picture."""


@dataclass(frozen=True)
class Film:
    """Film with its caption: inside the page if its content is given, else linked."""

    path: str
    """Path of the file, relative to the page."""
    caption: str
    """Sentence below the film."""
    still: bytes = b""
    """Content of a JPEG file that is shown before the film is played; empty shows none."""
    data: bytes = b""
    """Content of the MP4 file; empty links it."""


PNG, JPEG = b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff"
"""Beginnings of files of pictures."""
Block = Heading | Paragraph | Table | Code | Picture | Photo | Film
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
            return markdown.table(block.headings, block.lines, "lr" if block.numbers else "l")
        case Code():
            return f"```{block.language}\n{block.text.rstrip()}\n```"
        case Picture():
            return f"![{block.caption}]({PICTURES.as_posix()}/{block.file})"
        case Film():
            return f"[{block.caption}]({urllib.parse.quote(block.path)})"
        case Photo():
            return block.caption


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
            kind = "" if block.numbers else ' class="texts"'
            return f"<table{kind}>\n<thead><tr>{head}</tr></thead>\n<tbody>\n{body}\n</tbody>\n</table>"
        case Code():
            return f"<pre>{html.escape(block.text.rstrip())}</pre>"
        case Picture():
            return _figure(block.svg, html.escape(block.caption))
        case Photo():
            shown = f'<img src="{_inside(block.data)}" alt="{html.escape(block.caption)}">'
            return _figure(shown, html.escape(block.caption))
        case Film():
            return _film(block)


def _figure(content: str, caption: str) -> str:
    return f"<figure>\n{content}\n<figcaption>{caption}</figcaption>\n</figure>"


def _film(film: Film) -> str:
    """Returns a player of the film, with a link to its file below."""
    link = html.escape(urllib.parse.quote(film.path))
    source = _inside(film.data) if film.data else link
    still = f' poster="{_inside(film.still)}"' if film.still else ""
    shown = f'<video controls preload="none"{still} src="{source}"></video>'
    return _figure(shown, f'{html.escape(film.caption)} <a href="{link}">{html.escape(film.path)}</a>')


def _inside(data: bytes) -> str:
    """Returns the address that holds the content of a picture or film itself."""
    kind = "image/png" if data.startswith(PNG) else "image/jpeg" if data.startswith(JPEG) else "video/mp4"
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"
