"""Runs every fenced bash and python block of README.md and docs/ as written: `python .ci/docs_check.py`.

Each page runs in a fresh copy of the repository, so that nothing here is overwritten and no page relies on files that
another one left. The blocks of a page run in order and build on each other: Python's names and the shell's exported
variables are kept. Every block is timed; a comment on the line before a block says what else to do with it:

    <!-- docs-check: skip because it needs a GPU -->
    <!-- docs-check: short: python -m envs.collect --env-id roundabout-v1 --out data --episodes 2 -->

A short form (one or several lines) runs instead of its block. It must call the same programs with at least the same
options, or import the same names, so that a renamed option or module is still found in the text.

`--within SECONDS` begins no page after that time and names those that are left, for a machine that may be slow; each
commit has an order of its own, so that the pages that are left differ.
"""

import argparse
import ast
import contextlib
import json
import math
import os
import random
import re
import select
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
LIMIT_S = 600.0
"""Longest time of a block [s]; longer ones need a short form."""
TAIL_LINES = 25
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""Variables that say how many threads the libraries of a process use."""
OTHER_LANGUAGES = ("text", "json", "toml", "yaml", "bibtex", "mermaid", "markdown", "diff", "make", "csv")
"""Languages of blocks that are not run."""

_BLOCK = re.compile(
    r"(?:^[ \t]*<!--\s*docs-check:(?P<note>(?:(?!-->).)*)-->[ \t]*\n)?"
    r"^(?P<indent>[ \t]*)```(?P<language>\{[^\n]*|\S*)[ \t]*\n(?P<code>.*?)^[ \t]*```[ \t]*$",
    flags=re.MULTILINE | re.DOTALL,
)
_COMMAND = re.compile(r"^\s*(?:\$ |>>> |python3? |pip |make |git |export |tensorboard )", flags=re.MULTILINE)
_WORKER = """
import contextlib, json, os, sys, traceback
names, answers = {"__name__": "__docs__"}, os.fdopen(os.dup(1), "w")
os.dup2(2, 1)
for line in sys.stdin:
    request = json.loads(line)
    os.environ.clear(), os.environ.update(request["environment"])
    sys.path[:0] = [p for p in os.environ.get("PYTHONPATH", "").split(os.pathsep) if p and p not in sys.path]
    try:
        exec(compile(request["code"], request["where"], "exec"), names)
        error = ""
    except BaseException:
        error = traceback.format_exc()
    print(json.dumps(error), file=answers, flush=True)
"""
"""Code of the process that runs Python blocks in one namespace: their output goes to stderr, the answers to stdout."""


class DocsError(Exception):
    """Raised for a block or an annotation that cannot be understood."""


@dataclass(frozen=True)
class Block:
    """Fenced block of a page."""

    page: str
    """Path of the page."""
    line: int
    """Line of the opening fence."""
    language: str
    """Language behind the fence."""
    code: str
    """Text of the block."""
    note: str = ""
    """Annotation on the line before the fence, without "docs-check:"."""

    @property
    def where(self) -> str:
        """Page and line of the block, as "page:line"."""
        return f"{self.page}:{self.line}"

    @property
    def skipped(self) -> str:
        """Reason for which the block is not run; empty if it is run."""
        return self.note.removeprefix("skip because ") if self.note.startswith("skip because ") else ""

    @property
    def to_run(self) -> str:
        """Code to run: the block, or its short form.

        Raises:
            DocsError: the annotation is unknown, or the short form leaves out a program or an option of the block.
        """
        if not self.note:
            return self.code
        kind, _, short = self.note.partition("short:")
        if kind or not short.strip():
            raise DocsError(f"{self.where}: unknown annotation '{self.note}'; write 'short: …' or 'skip because …'")
        needs = programs_and_options if self.language == "bash" else imported_names
        try:
            missing = sorted(needs(self.code) - needs(short.strip()))
        except (SyntaxError, ValueError) as error:
            raise DocsError(f"{self.where}: the block or its short form cannot be read: {error}") from error
        if missing:
            raise DocsError(f"{self.where}: the short form must also have {', '.join(missing)}, as the block does")
        return short.strip() + "\n"


@dataclass(frozen=True)
class Result:
    """Result of a block."""

    block: Block
    """Block that was run or skipped."""
    seconds: float
    """Time that it took [s]."""
    error: str = ""
    """Error message; empty if the block ran to its end."""

    def __str__(self) -> str:
        """Returns one line; for a failure, the end of its output as well."""
        if self.block.skipped:
            return f"{self.block.where:32} {self.block.language:6}   skipped because {self.block.skipped}"
        short = ", short form" if self.block.note else ""
        verdict = f"FAILED\n{self.error}" if self.error else f"ok{short}"
        return f"{self.block.where:32} {self.block.language:6} {self.seconds:6.1f} s  {verdict}"


def programs_and_options(code: str) -> set[str]:
    """Returns the modules and scripts that bash code runs, and the names of their options."""
    words = shlex.split(code.replace("\\\n", " "), comments=True)
    options = {word.partition("=")[0] for word in words if re.match(r"--[a-z]", word)}
    modules = {after for word, after in zip(words, words[1:], strict=False) if word in ("-m", "make", "dgvae")}
    return options | modules | {word for word in words if word.endswith((".py", ".sh"))}


def imported_names(code: str) -> set[str]:
    """Returns the names that Python code imports, as "module.name"."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def blocks_of(page: Path, root: Path = ROOT) -> list[Block]:
    """Returns the fenced bash and python blocks of a page.

    Raises:
        DocsError: a block with commands has no language, or a language is unknown here.
    """
    text, name, found = page.read_text(encoding="utf-8"), page.relative_to(root).as_posix(), []
    for match in _BLOCK.finditer(text):
        indent, language, code = match["indent"], match["language"], match["code"]
        fence = text.count("\n", 0, match.start("language")) + 1
        if language in ("bash", "python"):
            dedented = re.sub(f"^{indent}", "", code, flags=re.MULTILINE)
            found.append(Block(name, fence, language, dedented, (match["note"] or "").strip()))
        elif language.startswith("{"):
            continue  # a directive of the site; `make docs` builds it, and runs what is in a code cell
        elif language and language not in OTHER_LANGUAGES:
            raise DocsError(f"{name}:{fence}: blocks of '{language}' are not known; write bash, python or text")
        elif not language and _COMMAND.search(code):
            raise DocsError(f"{name}:{fence}: a block with commands needs a language (bash or python) behind its fence")
    if text.count("<!-- docs-check:") != sum(bool(block.note) for block in found):
        raise DocsError(f"{name}: a docs-check comment must stand on the line before a bash or python block")
    return found


class Page:
    """Keeps the state that the blocks of a page share: a folder, exported variables, Python's names."""

    def __init__(self, folder: Path, limit_s: float = LIMIT_S, jobs: int = 1) -> None:
        """Takes the folder to run in; `python` on the path is the interpreter that runs this check.

        A page that runs beside others gets its share of the cores: two processes with a thread on every core wait for
        each other, which was measured to take twenty times as long as one after the other.
        """
        path = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
        self.folder, self.limit_s, self.stopped = folder, limit_s, False
        threads = dict.fromkeys(THREADS, str(max(1, (os.cpu_count() or 1) // jobs))) if jobs > 1 else {}
        self.environment = threads | {k: v for k, v in os.environ.items() if k != "PYTHONPATH"} | {"PATH": path}
        self._bash: subprocess.Popen[str] | None = None
        self._python: subprocess.Popen[str] | None = None
        self._printed = tempfile.TemporaryFile("w+")

    def run(self, block: Block) -> Result:
        """Runs a block; a failure is part of the result."""
        if block.skipped:
            return Result(block, 0.0)
        began, code = time.monotonic(), block.code
        try:
            code = block.to_run
            error = self._run_bash(code) if block.language == "bash" else self._run_python(code, block.where)
        except DocsError as wrong:
            error = str(wrong)
        tail = "\n".join(error.splitlines()[-TAIL_LINES:])
        return Result(block, time.monotonic() - began, f"{code}{tail}" if error else "")

    def stop(self) -> None:
        """Ends the block that runs, from another thread; `stopped` tells that no further one is to be run."""
        self.stopped = True
        for process in (self._bash, self._python):
            if process is not None and process.returncode is None:
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)

    def close(self) -> None:
        """Ends Python."""
        self._stop_python()
        self._printed.close()

    def _stop_python(self) -> None:
        if self._python is not None:
            _stop(self._python)
            self._python = None

    def _run_bash(self, code: str) -> str:
        with tempfile.NamedTemporaryFile() as exported:
            command = ["bash", "-euo", "pipefail", "-c", f"{code}\nenv -0 > {shlex.quote(exported.name)}"]
            process = self._bash = subprocess.Popen(
                command, cwd=self.folder, env=self.environment, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT, text=True, start_new_session=True,
            )  # fmt: skip
            try:
                printed, _ = process.communicate(timeout=self.limit_s)
            except subprocess.TimeoutExpired:
                _stop(process)
                return self._too_long
            if process.returncode:
                return f"{printed}\nexit status {process.returncode}"
            pairs = [line.partition("=") for line in Path(exported.name).read_text().split("\0") if line]
            if pairs:  # none after a block that ends with `exit`
                self.environment = {name: value for name, _, value in pairs}
        return ""

    def _run_python(self, code: str, where: str) -> str:
        if self._python is None:
            self._python = subprocess.Popen(
                [sys.executable, "-c", _WORKER], cwd=self.folder, env=self.environment, text=True,
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._printed, start_new_session=True,
            )  # fmt: skip
        assert self._python.stdin is not None and self._python.stdout is not None
        request = {"code": code, "where": where, "environment": self.environment}
        print(json.dumps(request), file=self._python.stdin, flush=True)
        answered = bool(select.select([self._python.stdout], [], [], self.limit_s)[0])
        answer = self._python.stdout.readline() if answered else ""
        if answer:
            return str(json.loads(answer))
        self._stop_python()
        if not answered:
            return self._too_long
        self._printed.seek(0)
        return f"{self._printed.read()}\nPython died"

    @property
    def _too_long(self) -> str:
        return f"took more than {self.limit_s:.0f} s: give the block a short form"


def _stop(process: subprocess.Popen[str]) -> None:
    """Ends a process and all processes that it started."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.communicate()


def copy_tree(target: Path, root: Path = ROOT) -> None:
    """Copies the files that a clone would hold, uncommitted changes included."""
    listed = ["git", "-C", str(root), "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    for name in filter(None, subprocess.check_output(listed, text=True).split("\0")):
        if (root / name).is_file():  # a file may be deleted and not committed yet
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(root / name, target / name)


def shuffled(pages: Sequence[Path], root: Path = ROOT) -> list[Path]:
    """Returns pages in the order of the present commit."""
    commit = subprocess.check_output(["git", "-C", str(root), "rev-parse", "HEAD"], text=True)
    return random.Random(commit).sample(pages, len(pages))


def check(
    pages: Sequence[Path], limit_s: float = LIMIT_S, jobs: int = 1, within_s: float = math.inf
) -> Iterator[Result]:
    """Runs the blocks of pages of this repository, each page in its own copy; yields the results in the pages' order.

    Args:
        pages: pages.
        limit_s: longest time of a block [s].
        jobs: number of pages that run at the same time.
        within_s: time after which no page begins [s]; the blocks of those that are left are skipped.

    Raises:
        DocsError: a page has a block that cannot be understood.
    """
    every = [blocks_of(page) for page in pages]  # errors of the pages are raised before any block runs
    opened: list[Page] = []
    last_start = time.monotonic() + within_s
    with ThreadPoolExecutor(jobs) as pool:
        try:
            for results in pool.map(
                lambda blocks: _run_page(blocks, limit_s, jobs, opened, last_start), filter(None, every)
            ):
                yield from results
        except BaseException:  # Ctrl-C, which blocks do not get: they run in sessions of their own
            pool.shutdown(wait=False, cancel_futures=True)
            for page in opened:
                page.stop()
            raise


def _run_page(
    blocks: Sequence[Block], limit_s: float, jobs: int, opened: list[Page], last_start: float = math.inf
) -> list[Result]:
    """Runs the blocks of one page, until it is stopped; adds the page to those that were opened.

    From `last_start` (`time.monotonic`) on its blocks are read and not run.
    """
    if time.monotonic() >= last_start:
        return [_left_out(block) for block in blocks]
    with tempfile.TemporaryDirectory() as folder:
        page = Page(Path(folder), limit_s, jobs)
        opened.append(page)  # so that Ctrl-C finds it while it is being copied
        try:
            copy_tree(Path(folder))
            return [page.run(block) for block in blocks if not page.stopped]
        finally:
            page.close()


def _left_out(block: Block) -> Result:
    """Returns the result of a block that is read and not run."""
    if block.skipped:
        return Result(block, 0.0)
    try:
        block.to_run  # noqa: B018
    except DocsError as wrong:
        return Result(block, 0.0, str(wrong))
    return Result(replace(block, note="skip because no time was left"), 0.0)


def main() -> int:
    """Runs the command; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pages", nargs="*", type=Path, help="pages to check; all of README.md and docs/ if left out")
    parser.add_argument("--jobs", type=int, default=1, help="number of pages that run at the same time")
    parser.add_argument("--within", type=float, help="seconds after which no page begins", metavar="SECONDS")
    parser.add_argument("--limit-s", type=float, default=LIMIT_S, help="seconds that a block may take")
    arguments = parser.parse_args()
    pages = [page.resolve() for page in arguments.pages] or [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    outside = [str(page) for page in pages if not page.is_relative_to(ROOT)]
    if outside:
        parser.error(f"pages must be of this repository, {', '.join(outside)} is not")
    if missing := [str(page) for page in pages if not page.is_file()]:
        parser.error(f"pages must be files, {', '.join(missing)} is none")
    if arguments.jobs < 1:
        parser.error(f"--jobs must be at least 1, got {arguments.jobs}")
    within_s = math.inf if arguments.within is None else arguments.within
    for option, value in (("--limit-s", arguments.limit_s), ("--within", within_s)):
        if not value > 0:
            parser.error(f"{option} must be positive, got {value:g}")
    if arguments.within is not None:
        pages = shuffled(pages)
    results = []
    try:
        for result in check(pages, arguments.limit_s, arguments.jobs, within_s):
            print(result, flush=True)
            results.append(result)
    except DocsError as error:
        print(error)
        return 1
    failed, skipped = [r for r in results if r.error], sum(bool(r.block.skipped) for r in results)
    ran, seconds = len(results) - len(failed) - skipped, sum(result.seconds for result in results)
    print(f"{len(results)} blocks in {seconds:.0f} s: {ran} ran, {skipped} skipped, {len(failed)} failed")
    for result in failed:  # again, where the end of a log is read
        print(result)
    return 1 if failed or not results else 0


if __name__ == "__main__":
    sys.exit(main())
