"""The pages of the site: messages that are quoted exist, every public name is documented, README is short."""

import ast
import http.server
import importlib.util
import os
import re
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import dgvae_rl
from dgvae_rl import testing

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
MOST_LINES_OF_README = 200


def texts_of_code() -> Iterator[str]:
    """Every string of the packages; a value that is put in stands as one character that no message has."""
    folders = ("predictor", "envs", "agents", "dgvae_rl")
    for path in [p for folder in folders for p in (ROOT / folder).rglob("*.py")]:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.JoinedStr):
                yield "".join(str(v.value) if isinstance(v, ast.Constant) else "\0" for v in node.values)
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                yield node.value


def quoted_messages(page: str) -> list[str]:
    """Messages of the page, each on one line."""
    section = page.split("\n## Messages\n")[1]
    return [" ".join(block.split()) for block in re.findall(r"```text\n(.*?)```", section, re.DOTALL)]


def is_said(message: str, texts: list[str]) -> bool:
    """Whether one string of the code has all fixed parts of a message in their order."""
    pattern = re.compile(".*?".join(re.escape(part.strip()) for part in message.split("…") if part.strip()), re.DOTALL)
    return any(pattern.search(text) for text in texts)


def test_every_message_that_is_quoted_is_one_of_the_code():
    messages, texts = quoted_messages((DOCS / "troubleshooting.md").read_text()), list(texts_of_code())
    assert len(messages) > 15
    assert [message for message in messages if not is_said(message, texts)] == []
    assert not is_said("no scene reader knows … and none will", texts)


@pytest.mark.parametrize("module", [dgvae_rl, testing], ids=lambda m: m.__name__)
def test_every_public_name_is_in_the_reference_once(module):
    pages = "".join(path.read_text() for path in (DOCS / "api").glob("*.md"))
    named = re.findall(r"^\.\. auto(?:class|function|data):: (?:[\w.]+\.)?(\w+)$", pages, re.MULTILINE)
    known = set(dgvae_rl.__all__) | set(testing.__all__)
    assert sorted(named) == sorted(set(named)) and set(named) <= known
    assert set(module.__all__) - {"__version__"} <= set(named)


def test_the_first_page_is_short():
    assert len((ROOT / "README.md").read_text().splitlines()) < MOST_LINES_OF_README


def test_every_page_of_the_site_is_in_the_contents():
    """Sphinx says this too, but only where it is installed."""
    listed = set()
    for page in DOCS.rglob("*.md"):
        for body in re.findall(r"```\{toctree\}\n(.*?)```", page.read_text(), re.DOTALL):
            entries = [line.strip() for line in body.splitlines() if line.strip() and not line.startswith(":")]
            names = [re.sub(r"^.*<(.*)>$", r"\1", entry).removesuffix(".md") for entry in entries]
            names = [name for name in names if name != "self"]
            listed |= {(page.parent / name).resolve().with_suffix(".md") for name in names}
    pages = {path.resolve() for path in DOCS.rglob("*.md")} - {(DOCS / "index.md").resolve()}
    assert pages - listed == set()
    assert {path for path in listed if not path.exists()} == set()


@pytest.fixture
def conf(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Settings of the site, loaded where no other project can be reached and no environment is changed."""
    spec = importlib.util.spec_from_file_location("docs_conf", DOCS / "conf.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setattr("os.environ", dict(os.environ))
    monkeypatch.setattr("sys.path", list(sys.path))
    monkeypatch.setattr("urllib.request.urlopen", unreachable)
    spec.loader.exec_module(module)
    monkeypatch.undo()
    return module


def unreachable(*_: object, **__: object) -> None:
    raise OSError("no network")


def test_the_settings_are_read_without_the_extra_of_the_site():
    """Type checks and these tests read the file where only the other extras are installed."""
    body = ast.parse((DOCS / "conf.py").read_text()).body
    imported = [alias.name for line in body if isinstance(line, ast.Import) for alias in line.names]
    imported += [str(line.module) for line in body if isinstance(line, ast.ImportFrom)]
    assert imported and {name.partition(".")[0] for name in imported} <= sys.stdlib_module_names


def test_the_site_builds_without_a_network(conf: Any):
    assert conf.PROJECTS and conf.intersphinx_mapping == {}


def test_only_projects_with_an_inventory_are_linked(conf: Any, tmp_path: Path):
    (tmp_path / "good").mkdir()
    (tmp_path / "good" / "objects.inv").write_bytes(b"# Sphinx inventory version 2\n")
    (tmp_path / "sign_in").mkdir()
    (tmp_path / "sign_in" / "objects.inv").write_bytes(b"<html>who are you?</html>")

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def __init__(self, *args: Any) -> None:
            super().__init__(*args, directory=str(tmp_path))

        def log_message(self, *args: Any) -> None:
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Quiet)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    here = f"http://127.0.0.1:{server.server_port}/"
    try:
        found = conf.reachable({"good": here + "good/", "sign_in": here + "sign_in/", "missing": here + "none/"})
    finally:
        server.shutdown()
        server.server_close()
    assert found == {"good": (here + "good/", None)}


def test_a_letter_behind_a_code_span_is_separated(conf: Any):
    lines = ["Base of `SceneReader`s and `Scene`, `x`", "plain"]
    conf.separate_spans(None, "class", "name", None, None, lines)
    assert lines == ["Base of `SceneReader`\\ s and `Scene`, `x`", "plain"]
