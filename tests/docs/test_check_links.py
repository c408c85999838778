"""Dead links of a built site are found: missing files and missing ids, of `href` and of `src`."""

from pathlib import Path

import pytest

from docs import check_links
from predictor.support.errors import UserError

GOOD = """<h1 id="top">A</h1><a href="#top">x</a><a href="sub/b.html#there">x</a><a href="sub/">x</a>
<a href="https://example.org/nowhere#x">x</a><a href="mailto:a@b.org">x</a>
<img src="a%20picture.png"><a href="b.py#L3">x</a>"""


@pytest.fixture
def site(tmp_path: Path) -> Path:
    (tmp_path / "sub").mkdir()
    (tmp_path / "a.html").write_text(GOOD)
    (tmp_path / "sub" / "b.html").write_text('<p id="there">b</p><a href="../a.html#top">x</a>')
    (tmp_path / "sub" / "index.html").write_text("index")
    (tmp_path / "a picture.png").write_text("")
    (tmp_path / "b.py").write_text("")
    check_links._read.cache_clear()
    return tmp_path


def test_good_links_and_links_to_other_hosts_pass(site: Path, monkeypatch: pytest.MonkeyPatch, capsys):
    monkeypatch.setattr("sys.argv", ["check_links", str(site)])
    check_links.main()
    assert capsys.readouterr().out == "8 links of 3 pages: none is dead\n"


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ('<a href="none.html">x</a>', "c.html:1: none.html: no such file"),
        ('\n<img src="none.png">', "c.html:2: none.png: no such file"),
        ('<a href="sub/b.html#here">x</a>', "c.html:1: sub/b.html#here: b.html has no id 'here'"),
        ('<a href="http://[bad">x</a>', "c.html:1: http://[bad: no address"),
        ('<a href="../outside.html">x</a>', "c.html:1: ../outside.html: leaves the site"),
        ('<a href="/etc/hostname">x</a>', "c.html:1: /etc/hostname: leaves the site"),
        ('<a href="#here">x</a>', "c.html:1: #here: c.html has no id 'here'"),
    ],
)
def test_a_dead_link_is_named_with_its_place(site: Path, text: str, found: str, monkeypatch: pytest.MonkeyPatch):
    (site / "c.html").write_text(text)
    (site.parent / "outside.html").write_text("a file beside the site, which is not served")
    assert list(check_links.dead_links(site)) == [found]
    monkeypatch.setattr("sys.argv", ["check_links", str(site)])
    with pytest.raises(UserError, match="1 dead links"):
        check_links.main()


def test_a_folder_without_pages_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    with pytest.raises(UserError, match="must be the folder of a built site, but it has no .html file; run make docs"):
        list(check_links.dead_links(tmp_path))
    monkeypatch.setattr("sys.argv", ["check_links"])
    with pytest.raises(UserError, match="takes the folder of a built site, got nothing"):
        check_links.main()
