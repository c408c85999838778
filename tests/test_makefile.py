"""`make test-all` and CI leave no test out but those that need a cluster, whatever `make test` leaves out."""

import itertools
import re
import shlex
import subprocess
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
KINDS = [{"slow": slow, "cluster": cluster} for slow, cluster in itertools.product((False, True), repeat=2)]


def chosen(expression: str) -> list[bool]:
    """Returns which kinds of tests an expression of marks takes."""
    return [bool(eval(expression, {}, dict(kind))) for kind in KINDS]


def by_default() -> str:
    options = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["pytest"]["ini_options"]["addopts"]
    return str(options[options.index("-m") + 1])


def last_expression(command: str) -> str:
    words = shlex.split(command)
    return words[len(words) - words[::-1].index("-m")]


def test_make_test_leaves_the_slow_ones_out_and_test_all_has_them():
    listed = subprocess.run(["make", "-n", "test-all"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    (run,) = (line for line in listed.splitlines() if "-m pytest" in line)
    assert chosen(last_expression(run)) == chosen("not cluster")
    assert chosen(by_default()) == chosen("not cluster and not slow")


@pytest.mark.parametrize("target", ["test", "test-all", "test-shapes"])
def test_arguments_with_blanks_reach_pytest_whole(target: str):
    command = ["make", "-n", target, 'TEST_ARGS=-k "a or b"']
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    (run,) = (line for line in listed.splitlines() if "-m pytest" in line)
    assert shlex.split(run)[-2:] == ["-k", "a or b"]


def test_ci_runs_what_make_test_leaves_out():
    runs = re.findall(r'^\s*make test(?: TEST_ARGS="(.*)")?$', (ROOT / ".ci" / "run").read_text(), flags=re.MULTILINE)
    taken = [chosen(last_expression(words) if words else by_default()) for words in runs]
    assert [any(kinds) for kinds in zip(*taken, strict=True)] == chosen("not cluster")
