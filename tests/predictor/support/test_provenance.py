import json
import os
import sys
from pathlib import Path

import pytest

from predictor.support.files import write_json
from predictor.support.provenance import provenance


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
