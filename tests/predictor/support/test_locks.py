"""Locks: one process at a time."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from predictor.support.errors import UserError
from predictor.support.locks import LOCK_FILE, locked, locked_path

HOLD = """
import sys, time
from pathlib import Path
from predictor.support.locks import locked, locked_path
with locked(Path(sys.argv[1]), "training"), locked_path(Path(sys.argv[2])):
    print("held", flush=True)
    time.sleep(600)
"""


def test_a_folder_and_a_store_are_held_by_one_process_until_it_ends_however_it_ends(tmp_path: Path):
    folder, store = tmp_path / "run", tmp_path / "store"
    holder = subprocess.Popen([sys.executable, "-c", HOLD, str(folder), str(store)], stdout=subprocess.PIPE)
    assert holder.stdout is not None
    try:
        assert holder.stdout.readline() == b"held\n"
        with pytest.raises(UserError, match=rf"^another training runs in .*run \(process {holder.pid}\); wait for"):
            locked(folder, "training").__enter__()
        (tmp_path / "link").symlink_to(store)
        for path in (store, tmp_path / "link"):
            with pytest.raises(UserError, match=rf"^another process writes {path} \(process {holder.pid}\); wait for"):
                locked_path(path).__enter__()
        (tmp_path / "link").unlink()
    finally:
        holder.kill()
        holder.wait()
        holder.stdout.close()
    assert (folder / LOCK_FILE).exists(), "what is left of a killed process"
    with locked(folder, "training"), locked_path(store):
        assert (folder / LOCK_FILE).read_text() == str(os.getpid())
    assert list(folder.iterdir()) == [] and [path.name for path in tmp_path.iterdir()] == ["run"]


def test_a_lock_may_be_taken_again_within_a_process_and_leaves_nothing(tmp_path: Path):
    with locked(tmp_path / "run", "training"):
        with locked(tmp_path / "run", "training"):
            pass
        assert (tmp_path / "run" / LOCK_FILE).exists()
    assert list(tmp_path.iterdir()) == []


def test_a_folder_with_content_stays(tmp_path: Path):
    with locked(tmp_path / "run", "training"):
        (tmp_path / "run" / "a").touch()
    assert [path.name for path in (tmp_path / "run").iterdir()] == ["a"]


def test_ctrl_c_while_a_lock_is_taken_leaves_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Else what is written on the way out would wait for this very process."""

    def interrupt(*_: object) -> int:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("predictor.support.locks.os.write", interrupt)
        with pytest.raises(KeyboardInterrupt), locked_path(tmp_path / "store"):
            raise AssertionError
    with locked_path(tmp_path / "store"):
        pass


@pytest.mark.parametrize("planted", ["symlink", "hard link", "pipe"])
def test_a_planted_lock_writes_over_nothing(tmp_path: Path, planted: str):
    """In a stranger's run folder it may lead to a file of the user's."""
    victim, folder = tmp_path / "victim", tmp_path / "run"
    victim.write_text("years of work")
    folder.mkdir()
    for lock in (folder / ".lock", tmp_path / ".store.lock"):
        if planted == "symlink":
            lock.symlink_to(victim)
        elif planted == "hard link":
            os.link(victim, lock)
        else:
            os.mkfifo(lock)
    for held in (lambda: locked(folder, "training"), lambda: locked_path(tmp_path / "store")):
        with pytest.raises(UserError, match="lock must be a file of its own, not a link or a pipe; remove it"), held():
            raise AssertionError
    assert victim.read_text() == "years of work"


def test_the_last_of_several_threads_gives_a_lock_back(tmp_path: Path):
    """Two threads of one process hold it at once; the first to leave takes nothing from the other."""
    first, second = locked_path(tmp_path / "store"), locked_path(tmp_path / "store")
    first.__enter__()
    second.__enter__()
    first.__exit__(None, None, None)
    assert [path.name for path in tmp_path.iterdir()] == [".store.lock"]
    second.__exit__(None, None, None)
    assert list(tmp_path.iterdir()) == []
