"""What the fuzzer found once is replayed: each input of the corpus is read, or refused in one line, within a second."""

import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest

from predictor.support.errors import UserError
from tests.fuzz.__main__ import FuzzConfig, run
from tests.fuzz.entries import CORPUS, ENTRIES, ENTRY_NAMES, MOST_BYTES, EntryName, Slow, Target, stored, target


@pytest.mark.parametrize("name", ENTRY_NAMES)
def test_the_corpus_breaks_nothing(name: EntryName):
    inputs = stored(name)
    assert inputs, "an entry without inputs"
    with target(name) as give:
        for path in inputs:
            give(path.read_bytes())


def test_the_corpus_is_small_and_of_entries():
    assert {path.name for path in CORPUS.iterdir()} == set(ENTRIES) == set(ENTRY_NAMES)
    sizes = [path.stat().st_size for path in CORPUS.rglob("*.bin")]
    assert len(sizes) > 15 and max(sizes) <= MOST_BYTES and sum(sizes) < 200_000


@pytest.mark.parametrize(
    ("error", "seen"),
    [(KeyError("x"), KeyError), (UserError("ok"), None), (UserError("\x07" * 3), AssertionError)],
    ids=["another error", "one line", "an empty line"],
)
def test_only_one_line_may_come_out(error: Exception, seen: type[Exception] | None, tmp_path: Path):
    give = object.__new__(Target)

    def read() -> None:
        raise error

    give._readers = [(tmp_path / "x", read)]
    if seen is None:
        give(b"a")
    else:
        with pytest.raises(seen):
            give(b"a")


def test_a_slow_reader_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    times = iter([0.0, 1.5])
    monkeypatch.setattr("tests.fuzz.entries.time.process_time", lambda: next(times))
    give = object.__new__(Target)
    give._readers = [(tmp_path / "x", lambda: None)]
    with pytest.raises(Slow, match="took 1.5 s"):
        give(b"a")


def test_without_atheris_a_line_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    with pytest.raises(UserError, match=r"install it with pip install .*fuzz"):
        run(FuzzConfig("json", 1, out=tmp_path))


@pytest.mark.slow
def test_the_command_says_what_is_wrong():
    done = subprocess.run([sys.executable, "-m", "tests.fuzz", "moon"], capture_output=True, text=True, check=False)
    assert done.returncode == 2 and "moon" in done.stderr and done.stderr.count("\n") == 1


def test_findings_of_earlier_runs_are_not_counted_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Nor do they hide that the fuzzer ended before it tried anything."""
    found = tmp_path / "json" / "findings"
    found.mkdir(parents=True)
    (found / "KeyError-old.bin").write_bytes(b"x")
    said, new = "stat::number_of_executed_units: 5000", []

    def child(words: list[str], **_: object) -> subprocess.CompletedProcess[str]:
        for name in new:
            (found / name).write_bytes(b"y")
        return subprocess.CompletedProcess(words, 0, stderr=said)

    monkeypatch.setattr(importlib.util, "find_spec", lambda name: name)
    monkeypatch.setattr(subprocess, "run", child)
    assert run(FuzzConfig("json", out=tmp_path)) == (5000, [])
    new.append("KeyError-new.bin")
    assert run(FuzzConfig("json", out=tmp_path)) == (5000, [found / "KeyError-new.bin"])
    new.clear()
    said = "ImportError"
    with pytest.raises(UserError, match="the fuzzer ended early: ImportError"):
        run(FuzzConfig("json", out=tmp_path))
