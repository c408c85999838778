import json
import os
import re
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from predictor.support.command_line import parse
from predictor.support.files import write_json
from predictor.support.provenance import commit_at_start, provenance


@dataclass
class Nothing:
    """Command without options."""


def test_provenance_says_how_a_result_was_made(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(sys, "argv", ["train_policy.py", "--run-dir", "a folder"])
    made = provenance(("torch", "no-such-package"))
    assert made["command"].endswith("--run-dir 'a folder'")
    assert made["versions"]["no-such-package"] == "not installed"
    assert made["versions"]["torch"][0].isdigit()
    assert made["versions"]["python"] == sys.version.split()[0]
    assert json.loads(json.dumps(made)) == made


def test_a_command_of_dgvae_is_written_as_it_was_typed(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(sys, "argv", ["dgvae collect", "--env-id", "merge-v1"])
    assert provenance(())["command"] == "dgvae collect --env-id merge-v1"


def test_a_command_with_bytes_that_are_no_text_can_be_written(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(sys, "argv", ["dgvae collect", "--out", os.fsdecode(b"caf\xe9")])
    assert provenance(())["command"].encode() == rb"dgvae collect --out 'caf\udce9'"


def test_given_command_is_kept():
    assert (
        provenance((), command="python -m predictor.train --steps 3")["command"]
        == "python -m predictor.train --steps 3"
    )


def test_written_json_is_whole(tmp_path: Path):
    write_json(tmp_path / "a.json", {"path": tmp_path, "number": 1})
    assert json.loads((tmp_path / "a.json").read_text()) == {"path": str(tmp_path), "number": 1}
    assert [p.name for p in tmp_path.iterdir()] == ["a.json"]


def test_crash_while_writing_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def crash(*_: object) -> None:
        raise KeyboardInterrupt

    write_json(tmp_path / "a.json", 1)
    monkeypatch.setattr(os, "replace", crash)
    with pytest.raises(KeyboardInterrupt):
        write_json(tmp_path / "a.json", 2)
    assert (tmp_path / "a.json").read_text() == "1\n"


def test_the_commit_is_the_one_that_was_checked_out_at_the_start(monkeypatch: pytest.MonkeyPatch):
    """Hours later another may be: results are written at the end, by code that was loaded at the start."""
    checked_out = ["aaa", "bbb"]

    def git(words: list[str], **_: Any) -> subprocess.CompletedProcess[str]:
        return subprocess.CompletedProcess(words, 0, checked_out.pop(0) if "rev-parse" in words else "")

    commit_at_start.cache_clear()
    monkeypatch.setattr("predictor.support.provenance.subprocess.run", git)
    try:
        parse(Nothing, args=[])
        assert provenance(())["commit"] == provenance(())["commit"] == "aaa" and checked_out == ["bbb"]
    finally:
        commit_at_start.cache_clear()


def test_an_installed_package_does_not_take_the_commit_of_the_project_around_it(tmp_path: Path):
    folder = tmp_path / "lib"
    folder.mkdir()
    shutil.copy(sys.modules["predictor.support.provenance"].__file__ or "", folder / "copied.py")

    def git(*words: str) -> None:
        own = {"GIT_CONFIG_GLOBAL": os.devnull, "PATH": os.environ["PATH"]}
        names = ("-c", "user.name=a", "-c", "user.email=b@c")
        subprocess.run(["git", *names, *words], cwd=tmp_path, check=True, capture_output=True, env=own)

    def commit() -> str:
        code = "import copied; print(copied.commit_at_start())"
        environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(folder), *sys.path])}
        return subprocess.run(
            [sys.executable, "-c", code], env=environment, check=True, capture_output=True, text=True
        ).stdout.strip()

    assert commit() == "unknown"
    git("init", "-q")
    git("commit", "-q", "--allow-empty", "-m", "theirs")
    assert commit() == "unknown"
    git("add", "lib/copied.py")
    git("commit", "-q", "-m", "ours")
    assert re.fullmatch("[0-9a-f]{12}", commit())
