"""The check of the documentation's blocks fails where a block is wrong, with its place and the reason."""

import importlib.util
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

FILE = Path(__file__).resolve().parents[1] / ".ci" / "docs_check.py"
SPEC = importlib.util.spec_from_file_location("docs_check", FILE)
assert SPEC is not None and SPEC.loader is not None
docs_check: Any = importlib.util.module_from_spec(SPEC)
sys.modules["docs_check"] = docs_check
SPEC.loader.exec_module(docs_check)


def results(folder: Path, text: str, limit_s: float = 60.0) -> Sequence[Any]:
    """Runs the blocks of a page with this text."""
    (folder / "page.md").write_text(text.replace("~~~", "```"))
    page = docs_check.Page(folder, limit_s)
    try:
        return [page.run(block) for block in docs_check.blocks_of(folder / "page.md", folder)]
    finally:
        page.close()


def repository(folder: Path, **pages: str) -> Path:
    """Returns a repository with the command and some pages; `README` is its README.md, others are in docs/."""
    (folder / ".ci").mkdir(parents=True)
    (folder / ".ci" / "docs_check.py").write_text(FILE.read_text())
    (folder / "docs").mkdir()
    for name, text in pages.items():
        (folder / ("README.md" if name == "README" else f"docs/{name}.md")).write_text(text)
    subprocess.run(["git", "init", "-q"], cwd=folder, check=True)
    return folder


def test_blocks_build_on_each_other_across_languages(tmp_path: Path):
    text = """
~~~bash
export GREETING=hello  # also for Python
mkdir made && echo one > made/file.txt
~~~
~~~python
import os, pathlib
read = pathlib.Path("made/file.txt").read_text()
~~~
1. In a list:
   ~~~python
   assert read == "one\\n" and os.environ["GREETING"] == "hello"
   ~~~
~~~bash
test "$GREETING" = hello
python -c "import sys; assert sys.argv == ['-c', 'a']" a
~~~
"""
    done = results(tmp_path, text)
    assert [(result.block.line, result.block.language) for result in done] == [
        (2, "bash"), (6, "python"), (11, "python"), (14, "bash"),
    ]  # fmt: skip
    assert [result.error for result in done] == [""] * 4
    assert all(result.seconds > 0 for result in done)


@pytest.mark.parametrize(
    ("block", "said"),
    [
        ("bash\npython -m no_such_module --option 1", "No module named no_such_module"),
        ("bash\nfalse\ntrue", "exit status 1"),
        ("bash\nfalse | cat", "exit status 1"),
        ("bash\necho $NOT_SET", "NOT_SET: unbound variable"),
        ("python\nfrom math import no_such_name", "cannot import name 'no_such_name'"),
        ("python\nraise SystemExit(0)", "SystemExit"),
        ("python\nimport os\nprint('last words', flush=True)\nos._exit(3)", "last words"),
    ],
)
def test_a_broken_block_fails_with_its_place_and_its_output(tmp_path: Path, block: str, said: str):
    broken, after = results(tmp_path, f"# Title\n\n~~~{block}\n~~~\n\n~~~bash\ntrue\n~~~\n")
    assert said in broken.error
    shown = str(broken)
    assert shown.startswith("page.md:3 ") and "FAILED" in shown and block.partition("\n")[2].splitlines()[0] in shown
    assert after.error == "" and str(after).endswith("s  ok")


def test_directives_of_the_site_are_left_to_it(tmp_path: Path):
    """Their closing fence must not open a block: the one after them would be lost."""
    text = """
~~~{include} ../README.md
:start-after: "## Citation"
~~~
~~~{code-cell}
%%bash
python -m no_such_module
~~~
~~~bash
false
~~~
"""
    (done,) = results(tmp_path, text)
    assert done.block.line == 9 and "exit status 1" in done.error


@pytest.mark.slow
def test_a_block_that_takes_too_long_is_stopped(tmp_path: Path):
    done = results(
        tmp_path, "~~~bash\nsleep 2 && touch late\n~~~\n~~~python\nimport time\ntime.sleep(30)\n~~~\n", limit_s=0.5
    )
    assert ["took more than 0 s: give the block a short form" in result.error for result in done] == [True, True]
    assert all(result.seconds < 4 for result in done)
    time.sleep(2.5)
    assert not (tmp_path / "late").exists()  # what the block had started is stopped as well


def test_a_short_form_runs_instead(tmp_path: Path):
    text = """
<!-- docs-check: short: python train.py --steps 2 --out a -->
~~~bash
python train.py --steps 100000 \\
    --out a   # hours
~~~
"""
    (tmp_path / "train.py").write_text("import sys\nassert sys.argv[1:] == ['--steps', '2', '--out', 'a']\n")
    (done,) = results(tmp_path, text)
    assert done.error == "" and str(done).endswith("ok, short form")


@pytest.mark.parametrize(
    ("short", "missing"),
    [
        ("python train.py --steps 2", "--out"),
        ("python other.py --steps 2 --out a", "train.py"),
        ("true", "--out, --steps, train.py"),
    ],
)
def test_a_short_form_leaves_no_program_and_no_option_out(tmp_path: Path, short: str, missing: str):
    text = f"<!-- docs-check: short: {short} -->\n~~~bash\npython train.py --steps 9 --out a\n~~~\n"
    (done,) = results(tmp_path, text)
    assert f"page.md:2: the short form must also have {missing}, as the block does" in done.error


def test_a_short_form_of_python_imports_the_same_names(tmp_path: Path):
    block = '~~~python\nfrom math import tau, pi\nprint("it\'s", tau)\n~~~\n'
    good, bad = results(
        tmp_path,
        f"<!-- docs-check: short:\nfrom math import pi, tau\nassert tau == 2 * pi\n-->\n{block}\n"
        f"<!-- docs-check: short: from math import pi -->\n{block}",
    )
    assert good.error == ""
    assert "the short form must also have math.tau" in bad.error


def test_a_skipped_block_is_listed_with_its_reason(tmp_path: Path):
    (done,) = results(tmp_path, "<!-- docs-check: skip because it needs a GPU -->\n~~~bash\nexit 1\n~~~\n")
    assert done.error == "" and str(done).endswith("skipped because it needs a GPU")


@pytest.mark.parametrize("note", ["skip", "shrot: true", "short:", "skip because"])
def test_an_unknown_annotation_fails(tmp_path: Path, note: str):
    (done,) = results(tmp_path, f"<!-- docs-check: {note} -->\n~~~bash\ntrue\n~~~\n")
    assert f"unknown annotation '{note}'" in done.error


@pytest.mark.parametrize(
    ("fence", "said"),
    [
        ("~~~\npython -m envs.collect\n~~~", "page.md:1: a block with commands needs a language"),
        (
            "<!-- docs-check: skip because -->\n\n~~~bash\nls\n~~~",
            "page.md: a docs-check comment must stand",
        ),
        ("~~~sh\nls\n~~~", "page.md:1: blocks of 'sh' are not known; write bash, python or text"),
    ],
)
def test_no_block_escapes_by_its_language(tmp_path: Path, fence: str, said: str):
    with pytest.raises(docs_check.DocsError, match=said.replace("(", r"\(")):
        results(tmp_path, fence + "\n")
    assert results(tmp_path, "~~~text\npython -m envs.collect\n~~~\n~~~\nx = 1\n~~~\n") == []


def test_every_page_of_this_repository_is_understood():
    root = FILE.parents[1]
    pages = [root / "README.md", *(root / "docs").rglob("*.md")]
    blocks = [block for page in pages for block in docs_check.blocks_of(page)]
    assert len(blocks) > 15
    fences = sum(page.read_text().count("```bash") + page.read_text().count("```python") for page in pages)
    assert len(blocks) == fences
    for block in blocks:
        assert block.skipped or block.to_run  # an option that a short form lacks is found here, in a second


def test_the_command_fails_with_the_block(tmp_path: Path):
    """Runs it like `make docs-check`, on a repository of its own: status 1, and the place of the block."""
    repository(tmp_path, README="```bash\ntest -f README.md && touch left\n```\n")
    command = [sys.executable, ".ci/docs_check.py"]
    good = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert good.returncode == 0 and "1 blocks in" in good.stdout and "0 failed" in good.stdout, good
    assert not (tmp_path / "left").exists()  # it ran in a copy
    (tmp_path / "README.md").write_text("```bash\ntest -f NO_SUCH_FILE\n```\n")
    bad = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert bad.returncode == 1 and "1 failed" in bad.stdout
    assert bad.stdout.count("README.md:1 ") == 2 and bad.stdout.endswith("exit status 1\n"), (
        "the end of a log tells why"
    )


def test_pages_run_side_by_side_and_are_told_in_their_order(tmp_path: Path):
    """The first page waits for the second."""
    began = tmp_path / "began"
    first, second = f"```bash\nuntil test -e {began}; do sleep 0.1; done\n```\n", f"```bash\ntouch {began}\n```\n"
    place = repository(tmp_path / "repository", README=first, second=second)
    command = [sys.executable, ".ci/docs_check.py", "--limit-s", "30", "--jobs", "2"]
    done = subprocess.run(command, cwd=place, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done
    assert done.stdout.index("README.md:1 ") < done.stdout.index("docs/second.md:1 ")


@pytest.mark.parametrize(
    ("jobs", "own", "threads"), [(1, None, "unset"), (2, None, "2"), (8, None, "1"), (2, "3", "3")]
)
def test_pages_side_by_side_share_the_cores(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, jobs: int, own: str | None, threads: str
):
    """Two processes with a thread on every core wait for each other; who sets the number gets it."""
    monkeypatch.setattr("os.cpu_count", lambda: 4)
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    if own is not None:
        monkeypatch.setenv("OMP_NUM_THREADS", own)
    monkeypatch.setattr(docs_check, "copy_tree", lambda target: None)
    page = tmp_path / "page.md"
    page.write_text(f"```bash\ntest ${{OMP_NUM_THREADS-unset}} = {threads}\n```\n")
    blocks = docs_check.blocks_of(page, tmp_path)
    assert [result.error for result in docs_check._run_page(blocks, 30.0, jobs, [])] == [""]


def test_pages_that_find_no_time_are_read_and_not_run(tmp_path: Path):
    ran = "```bash\ntouch ran\n```\n"
    (tmp_path / "first.md").write_text(ran)
    (tmp_path / "wrong.md").write_text(
        f"<!-- docs-check: short: python -m a -->\n{ran.replace('touch', 'python -m b')}"
    )
    for name, last_start, said in [
        ("first", time.monotonic() - 1, "skipped because no time was left"),
        ("wrong", time.monotonic() - 1, "FAILED"),
    ]:
        blocks = docs_check.blocks_of(tmp_path / f"{name}.md", tmp_path)
        (found,) = docs_check._run_page(blocks, 30.0, 1, [], last_start)
        assert said in str(found)


@pytest.mark.slow
def test_a_time_limit_leaves_other_pages_out_at_other_commits(tmp_path: Path):
    """The first two pages begin at once, and no other one before the limit."""
    text = "```bash\nsleep 2\n```\n"
    place = repository(tmp_path / "repository", **{name: text for name in "abcdef"}, README=text)
    orders = []
    for message in ("one", "two"):
        who = ["-c", "user.name=a", "-c", "user.email=a@b"]
        dates = {"GIT_AUTHOR_DATE": "2026-01-01T00:00Z", "GIT_COMMITTER_DATE": "2026-01-01T00:00Z"}
        subprocess.run(
            ["git", *who, "commit", "-q", "--allow-empty", "-m", message],
            cwd=place, env=os.environ | dates, check=True,
        )  # fmt: skip
        command = [sys.executable, ".ci/docs_check.py", "--jobs", "2", "--within", "1"]
        done = subprocess.run(command, cwd=place, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done
        assert done.stdout.count(" ok") == 2 and done.stdout.count("skipped because no time was left") == 5
        orders.append([line.split()[0] for line in done.stdout.splitlines()[:7]])
    assert orders[0] != orders[1]


@pytest.mark.parametrize("language", ["bash", "python"])
def test_ctrl_c_ends_the_blocks_that_run(tmp_path: Path, language: str):
    began, after = tmp_path / "began", tmp_path / "after"
    block = {
        "bash": f"touch {began}\nsleep 300",
        "python": f"import pathlib, time\npathlib.Path('{began}').touch()\ntime.sleep(300)",
    }[language]
    page = f"```{language}\n{block}\n```\n\n```bash\ntouch {after}\n```\n"
    place = repository(tmp_path / "repository", README=page)
    running = subprocess.Popen([sys.executable, ".ci/docs_check.py"], cwd=place, stderr=subprocess.DEVNULL)
    try:
        while not began.exists():
            assert running.poll() is None
            time.sleep(0.05)
        running.send_signal(signal.SIGINT)
        assert running.wait(timeout=120) not in (0, 1)
    finally:
        running.kill()
        running.wait()
    assert not after.exists()


def test_a_block_that_exits_leaves_the_next_its_environment(tmp_path: Path):
    text = '~~~bash\nexit 0\n~~~\n~~~bash\ntest -n "$PATH" && ls\n~~~\n~~~python\nimport os; os.environ["PATH"]\n~~~\n'
    assert [result.error for result in results(tmp_path, text)] == ["", "", ""]


def test_ctrl_c_while_a_page_is_copied_ends_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    opened: list[Any] = []
    monkeypatch.setattr(docs_check, "copy_tree", lambda _: opened[0].stop())
    (tmp_path / "page.md").write_text("```bash\ntouch ran\n```\n")
    blocks = docs_check.blocks_of(tmp_path / "page.md", tmp_path)
    assert docs_check._run_page(blocks, 60.0, 1, opened) == []


def test_a_page_of_another_folder_is_one_clear_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    (tmp_path / "page.md").write_text("no blocks")
    monkeypatch.setattr(sys, "argv", ["docs_check.py", str(tmp_path / "page.md")])
    with pytest.raises(SystemExit) as ended:
        docs_check.main()
    assert ended.value.code == 2
    assert f"error: pages must be of this repository, {tmp_path / 'page.md'} is not" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["docs/nosuch.md"], "pages must be files, "),
        (["docs"], "pages must be files, "),
        (["README.md", "--jobs", "0"], "--jobs must be at least 1, got 0"),
        (["README.md", "--limit-s", "-1"], "--limit-s must be positive, got -1"),
        (["README.md", "--within", "nan"], "--within must be positive, got nan"),
    ],
)
def test_no_page_and_no_job_are_one_clear_line(
    words: list[str], message: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.chdir(docs_check.ROOT)
    monkeypatch.setattr(sys, "argv", ["docs_check.py", *words])
    with pytest.raises(SystemExit) as ended:
        docs_check.main()
    assert ended.value.code == 2 and f"error: {message}" in capsys.readouterr().err
