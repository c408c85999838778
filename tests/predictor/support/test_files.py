"""Files and folders are replaced whole or not at all."""

import errno
import json
import math
import os
import stat
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from predictor.support import files
from predictor.support.errors import CannotWriteError, UserError
from predictor.support.files import (
    check_out,
    check_out_file,
    check_place,
    copy_file,
    delete_leftovers,
    finite,
    new_file,
    new_folder,
    scratch_folder,
    write_json,
    write_text,
)


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_text_and_json_arrive(tmp_path: Path):
    write_text(tmp_path / "a.md", "ü\n")
    write_json(tmp_path / "a.json", {"path": tmp_path, "n": 1})
    copy_file(tmp_path / "a.md", tmp_path / "b.md")
    assert (tmp_path / "b.md").read_bytes() == "ü\n".encode()
    assert json.loads((tmp_path / "a.json").read_text()) == {"path": str(tmp_path), "n": 1}
    assert names(tmp_path) == ["a.json", "a.md", "b.md"]


def test_a_failed_write_leaves_the_old_file_alone(tmp_path: Path):
    write_text(tmp_path / "a", "old")
    with pytest.raises(RuntimeError), new_file(tmp_path / "a") as partial:
        partial.write_text("half")
        raise RuntimeError
    assert names(tmp_path) == ["a"] and (tmp_path / "a").read_text() == "old"


def test_nothing_stands_under_the_name_before_it_is_whole(tmp_path: Path):
    with new_file(tmp_path / "a.mp4") as partial:
        partial.write_text("half")
        assert not (tmp_path / "a.mp4").exists() and partial.suffix == ".mp4" and partial.name.startswith(".")
    assert (tmp_path / "a.mp4").read_text() == "half"


def test_a_folder_replaces_the_old_one_with_all_it_held(tmp_path: Path):
    for content in ("old", "new"):
        with new_folder(tmp_path / "deep" / "x") as partial:
            (partial / content).write_text(content)
    assert names(tmp_path / "deep") == ["x"] and names(tmp_path / "deep" / "x") == ["new"]


def test_a_folder_behind_a_link_is_replaced_where_it_is(tmp_path: Path):
    (tmp_path / "disk" / "store").mkdir(parents=True)
    (tmp_path / "store").symlink_to(tmp_path / "disk" / "store")
    with new_folder(tmp_path / "store") as partial:
        (partial / "new").touch()
    assert (tmp_path / "store").is_symlink() and names(tmp_path) == ["disk", "store"]
    assert names(tmp_path / "disk") == ["store"] and names(tmp_path / "disk" / "store") == ["new"]


def test_a_failed_folder_leaves_the_old_one_alone(tmp_path: Path):
    with new_folder(tmp_path / "x") as partial:
        (partial / "old").touch()
    with pytest.raises(RuntimeError), new_folder(tmp_path / "x") as partial:
        raise RuntimeError
    assert names(tmp_path) == ["x"] and names(tmp_path / "x") == ["old"]


def test_a_scratch_folder_is_gone_afterwards(tmp_path: Path):
    with scratch_folder(tmp_path / "x") as scratch:
        assert scratch.parent == tmp_path and names(scratch) == []
    assert names(tmp_path) == []


def test_leftovers_of_a_killed_process_are_deleted_and_nothing_else(tmp_path: Path):
    write_text(tmp_path / "a.partial", "the user's own")
    manager = new_file(tmp_path / "a.mp4")
    manager.__enter__().write_text("half")
    folder = scratch_folder(tmp_path / "b")
    folder.__enter__()
    assert len(names(tmp_path)) == 3
    delete_leftovers(tmp_path)
    assert names(tmp_path) == ["a.partial"]


def test_missing_folders_of_a_file_are_made(tmp_path: Path):
    write_text(tmp_path / "deep" / "er" / "a", "x")
    assert (tmp_path / "deep" / "er" / "a").read_text() == "x"


def test_numbers_that_json_does_not_have_become_none():
    content = {"a": [1.5, math.nan, (math.inf, "nan")], "b": {"c": -math.inf, "d": None}, "e": 2, "f": True}
    assert finite(content) == {"a": [1.5, None, [None, "nan"]], "b": {"c": None, "d": None}, "e": 2, "f": True}


@pytest.mark.skipif(os.name != "posix", reason="file modes")
def test_others_may_read_what_the_umask_lets_them_read(tmp_path: Path):
    before = os.umask(0o022)
    try:
        write_text(tmp_path / "a", "x")
        with new_folder(tmp_path / "b"):
            pass
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "a").stat().st_mode) == 0o644
    assert stat.S_IMODE((tmp_path / "b").stat().st_mode) == 0o755


def test_what_json_does_not_have_becomes_none_at_any_depth():
    nested = {"a": float("nan"), "b": {"c": (1.0, float("inf"))}, "d": [{"e": -float("inf")}], "f": "nan", "g": None}
    assert finite(nested) == {"a": None, "b": {"c": [1.0, None]}, "d": [{"e": None}], "f": "nan", "g": None}
    assert finite({"a": np.array([[1.0, np.nan], [np.inf, 2.0]])}) == {"a": [[1.0, None], [None, 2.0]]}


# --- Full and read-only disks -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EROFS, errno.EDQUOT])
def test_a_disk_that_takes_no_more_is_named_and_the_old_version_is_whole(tmp_path: Path, number: int):
    write_text(tmp_path / "a", "old")
    with new_folder(tmp_path / "x") as partial:
        (partial / "old").touch()
    message = rf"^cannot write .*/[ax]: {os.strerror(number)}; what was there before is whole; make room or choose"
    with pytest.raises(CannotWriteError, match=message), new_file(tmp_path / "a") as partial:
        partial.write_text("half")
        raise OSError(number, "full")
    with pytest.raises(CannotWriteError, match=message), new_folder(tmp_path / "x") as partial:
        (partial / "new").touch()
        raise OSError(number, "full")
    assert names(tmp_path) == ["a", "x"] and names(tmp_path / "x") == ["old"]
    assert (tmp_path / "a").read_text() == "old"


@pytest.mark.parametrize(("free", "kind"), [(0, CannotWriteError), (10**9, RuntimeError)])
def test_a_full_disk_is_found_behind_what_a_library_raises(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, free: int, kind: type[Exception]
):
    monkeypatch.setattr(files.os, "statvfs", lambda _: SimpleNamespace(f_bavail=free, f_frsize=1))
    with pytest.raises(kind), new_file(tmp_path / "a"):
        raise RuntimeError("unexpected pos 768 vs 662")


# --- Exchange -----------------------------------------------------------------------------------------------------


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere a folder is absent for a moment")
def test_a_folder_that_is_replaced_is_never_absent(tmp_path: Path):
    missing, over = [], threading.Event()
    with new_folder(tmp_path / "x") as partial:
        (partial / "a").touch()

    def watch() -> None:
        while not over.is_set():
            if not os.path.exists(tmp_path / "x"):
                missing.append(1)

    watcher = threading.Thread(target=watch)
    watcher.start()
    for _ in range(300):
        with new_folder(tmp_path / "x") as partial:
            (partial / "a").touch()
    over.set()
    watcher.join()
    assert missing == [] and names(tmp_path) == ["x"]


def test_where_folders_cannot_be_exchanged_they_are_renamed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(files, "_exchange", lambda first, second: False)
    for content in ("old", "new"):
        with new_folder(tmp_path / "x") as partial:
            (partial / content).touch()
    assert names(tmp_path) == ["x"] and names(tmp_path / "x") == ["new"]


@pytest.mark.parametrize("check", [check_out, check_out_file])
def test_an_output_without_permission_is_refused_before_the_work(
    check: Callable[[Path], None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    check(tmp_path / "new" / "out")
    asked: list[Path] = []
    monkeypatch.setattr("os.access", lambda place, mode: asked.append(place))
    with pytest.raises(UserError, match=f"cannot be used: no permission to write in {tmp_path}; choose another --out"):
        check(tmp_path / "new" / "out")
    assert asked == [tmp_path], "the folder above, which is there"


@pytest.mark.parametrize(("letters", "suffix", "fits"), [(230, "", True), (240, "", False), (233, ".json", False)])
def test_a_name_whose_unfinished_file_is_too_long_is_refused_before_the_work(
    tmp_path: Path, letters: int, suffix: str, fits: bool
):
    out = tmp_path / ("n" * letters + suffix)
    if fits:
        check_place(out)
        with new_folder(out):
            pass
        return
    with pytest.raises(UserError, match="its name is too long; choose another path"):
        check_place(out)
