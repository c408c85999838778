"""Checks the links inside a built site: `python -m docs.check_links build/site`.

Every `href` and `src` that stays within the site must lead to a file, and its part after `#` to an id of that page.
Links to other hosts are not followed.
"""

import sys
from collections.abc import Iterator
from functools import cache
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

from predictor.support.errors import UserError, run_entry_point

WRITTEN_BY_SCRIPT = ("genindex.html", "search.html")
"""Pages whose targets a script makes when they are open."""


class _Page(HTMLParser):
    """Collects the links and the ids of a page."""

    def __init__(self) -> None:
        super().__init__()
        self.links: list[tuple[int, str]] = []
        self.ids: set[str] = set()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Notes the attributes of a tag that are links or names."""
        for name, value in attrs:
            if name in ("href", "src") and value:
                self.links.append((self.getpos()[0], value))
            elif name in ("id", "name") and value:
                self.ids.add(value)


@cache
def _read(path: Path) -> _Page:
    page = _Page()
    page.feed(path.read_text(encoding="utf-8"))
    return page


def dead_links(site: Path) -> Iterator[str]:
    """Yields a line for each link within the site that leads nowhere: page, line of the page, link, what is missing.

    Raises:
        UserError: the folder holds no page.
    """
    pages = sorted(site.rglob("*.html"))
    if not pages:
        raise UserError(f"{site} must be the folder of a built site, but it has no .html file; run make docs")
    for path in pages:
        for line, link in _read(path).links:
            missing = _missing(path, link, site.resolve())
            if missing:
                yield f"{path.relative_to(site)}:{line}: {link}: {missing}"


def _missing(page: Path, link: str, site: Path) -> str:
    """Returns what a link of a page lacks; empty for a good one and for one to another host."""
    try:
        parts = urlsplit(link)
    except ValueError:
        return "no address"
    if parts.scheme or parts.netloc:
        return ""
    target = (page.parent / unquote(parts.path)).resolve() if parts.path else page
    if not target.resolve().is_relative_to(site):
        return "leaves the site"
    target = target / "index.html" if target.is_dir() else target
    if not target.is_file():
        return "no such file"
    known = target.suffix != ".html" or target.name in WRITTEN_BY_SCRIPT
    if not parts.fragment or known or unquote(parts.fragment) in _read(target).ids:
        return ""
    return f"{target.name} has no id '{parts.fragment}'"


def main() -> None:
    """Runs the command."""
    if len(sys.argv) != 2:
        raise UserError(f"check_links takes the folder of a built site, got {' '.join(sys.argv[1:]) or 'nothing'}")
    site = Path(sys.argv[1])
    found = list(dead_links(site))
    if found:
        raise UserError(f"{len(found)} dead links\n" + "\n".join(found))
    pages = sorted(site.rglob("*.html"))
    print(f"{sum(len(_read(page).links) for page in pages):,} links of {len(pages)} pages: none is dead")


if __name__ == "__main__":
    run_entry_point(main)
