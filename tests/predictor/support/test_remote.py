"""Addresses on other file systems: what is written there comes back, and what is wrong there is one line."""

import fcntl
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from uuid import uuid4

import fsspec
import numpy as np
import pytest
import torch

from envs import collect
from predictor.card import CardConfig, write_card
from predictor.checkpoint import (
    CheckpointInfo,
    load_checkpoint,
    name_of_folder,
    require_known,
    resolve,
    save_checkpoint,
)
from predictor.data.partial_store import PartialStore, beside
from predictor.data.springs import SpringsConfig, make
from predictor.data.store import EpisodeStore, StoreInfo, read_info_of, read_store, write_store
from predictor.dgvae.config import PRESETS
from predictor.support import remote
from predictor.support.errors import UserError
from predictor.support.files import write_json, write_text
from predictor.support.locks import locked
from predictor.support.reading import NoSuchFile, check_regular, read_json, read_text
from predictor.support.remote import address, exists, is_remote
from predictor.train import train
from predictor.training.config import TrainConfig
from tests.predictor.helpers import FAST_LIKE, circling_episode, model, spec

INFO = StoreInfo(spec(), "circles", {"command": "python -m envs.collect"})


@pytest.fixture(params=["memory", "file"])
def there(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Path]:
    """An empty folder on another file system."""
    if request.param == "file":
        yield Path(f"file://{tmp_path}/far")
        return
    name = f"memory://{uuid4().hex}"
    yield Path(name)
    system = fsspec.filesystem("memory")
    if system.exists(name):
        system.rm(name, recursive=True)


def episodes(count: int = 3) -> list[Any]:
    return [circling_episode(i, steps=6 + i) for i in range(count)]


def files_of(there: Path) -> dict[str, bytes]:
    system, key = fsspec.core.url_to_fs(address(there))
    return {str(name)[len(str(key)) :].strip("/"): system.cat_file(name) for name in system.find(key)}


def put(there: Path, content: bytes) -> None:
    system, key = fsspec.core.url_to_fs(address(there))
    system.makedirs(key.rpartition("/")[0], exist_ok=True)
    system.pipe_file(key, content)


def same(ours: EpisodeStore, expected: list[Any]) -> bool:
    pairs = zip(ours.episodes, expected, strict=True)
    return all(np.array_equal(a.states, b.states) and np.array_equal(a.ids, b.ids) for a, b in pairs)


# --- Addresses --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "url", ["s3://bucket/a/b", "gs://bucket/a", "memory://a/b", "file:///data/a", "https://host/a/b.json"]
)
def test_an_address_survives_a_path(url: str):
    assert is_remote(url) and is_remote(Path(url)) and address(Path(url)) == url
    assert address(Path(url) / "more") == f"{url}/more"


@pytest.mark.parametrize("path", ["data/store", "/data/a", "own:module:function", "C:/data", "a:b", "1s:/a", ""])
def test_other_paths_are_local(path: str):
    assert not is_remote(path) and address(path) == path


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("s3://bucket/a", "s3://bucket/a cannot be reached: install the package s3fs"),
        ("gs://bucket/a", "gs://bucket/a cannot be reached: install the package gcsfs"),
        ("nope://bucket/a", "nope://bucket/a: there is no file system 'nope'; pass a path, or one of s3://"),
        ("s3://bucket/../a", "s3://bucket/../a: an address has no '..'; pass the folder itself"),
        ("zip://a::s3://bucket/a.zip", "addresses inside others (::) are not read; pass a plain one"),
    ],
)
def test_what_is_missing_is_one_sentence(monkeypatch: pytest.MonkeyPatch, url: str, message: str):
    def missing(url: str) -> Any:
        raise ImportError("Install it to use it")

    monkeypatch.setattr(remote.fsspec.core, "url_to_fs", missing)
    for call in (exists, read_store, read_info_of, resolve, require_known, load_checkpoint):
        with pytest.raises(UserError, match=re.escape(message)):
            call(Path(url))  # type: ignore[operator]


def test_any_error_of_a_file_system_is_one_sentence(monkeypatch: pytest.MonkeyPatch):
    class NoCredentialsError(Exception):
        pass

    def refused(*args: Any, **kwargs: Any) -> Any:
        raise NoCredentialsError("Unable to locate\ncredentials")

    system = fsspec.filesystem("memory")
    for method in ("exists", "info", "find", "put_file", "open"):
        monkeypatch.setattr(type(system), method, refused)
    path = Path("memory://bucket/a")
    message = "memory://bucket/a.* cannot be reached: Unable to locate credentials; check address, rights and network"
    for call in (exists, read_store, load_checkpoint, read_text, lambda p: write_text(p, "text")):
        with pytest.raises(UserError, match=message):
            call(path)  # type: ignore[operator]


# --- Files ------------------------------------------------------------------------------------------------------------


def test_small_files_are_read_where_they_are(there: Path):
    write_json(there / "deep" / "facts.json", {"a": [1, 2]})
    assert read_json(there / "deep" / "facts.json") == {"a": [1, 2]}
    assert check_regular(there / "deep" / "facts.json", 100) == len(files_of(there)["deep/facts.json"])
    with pytest.raises(
        UserError, match=f"{address(there)}/deep/facts.json is too large: a file of its kind has at most 3"
    ):
        read_json(there / "deep" / "facts.json", 3)
    with pytest.raises(NoSuchFile, match=f"{address(there)}/none.json cannot be read: there is no such file"):
        read_json(there / "none.json")
    with pytest.raises(UserError, match=f"{address(there)}/deep cannot be read: it is a folder"):
        read_json(there / "deep")


def test_what_fails_while_it_is_made_leaves_nothing(there: Path):
    def broken() -> Iterator[Any]:
        yield circling_episode(0)
        raise UserError("the simulator failed")

    with pytest.raises(UserError, match="the simulator failed"):
        write_store(there / "store", INFO, broken())
    assert not exists(there / "store") and files_of(there) == {}


# --- Stores -----------------------------------------------------------------------------------------------------------


def test_a_store_comes_back(there: Path):
    write_store(there / "store", INFO, episodes())
    assert exists(there / "store") and same(read_store(there / "store"), episodes())
    assert read_info_of(there / "store").num_steps == sum(len(e.states) for e in episodes())
    with pytest.raises(UserError, match=f"{address(there)}/store exists; choose another path or pass --overwrite"):
        write_store(there / "store", INFO, episodes())
    with pytest.raises(UserError, match=f"no episode store at {address(there)}/none"):
        read_store(there / "none")


def test_a_store_is_replaced_file_by_file_and_nothing_of_the_old_one_stays(there: Path, tmp_path: Path):
    labelled = [e.__class__(e.states, e.valid, e.ids, perturbed=np.zeros(e.valid.shape, np.int8)) for e in episodes()]
    write_store(there / "store", INFO, labelled)
    write_store(there / "store", INFO, episodes(2), overwrite=True)
    write_store(tmp_path / "store", INFO, episodes(2))
    assert files_of(there / "store") == files_of(Path(f"file://{tmp_path}/store"))


def test_a_store_is_whole_or_none(there: Path, monkeypatch: pytest.MonkeyPatch):
    """What makes it a store is written last and removed first."""
    write_store(there / "store", INFO, episodes())
    put_, count = remote._put, 0

    def dies(*args: Any) -> None:
        nonlocal count
        count += 1
        if count == 5:
            raise KeyboardInterrupt
        put_(*args)

    monkeypatch.setattr(remote, "_put", dies)
    with pytest.raises(KeyboardInterrupt):
        write_store(there / "store", INFO, episodes(2), overwrite=True)
    with pytest.raises(UserError, match=f"{address(there)}/store is not an episode store"):
        read_store(there / "store")
    monkeypatch.setattr(remote, "_put", put_)
    write_store(there / "store", INFO, episodes(), overwrite=True)
    assert same(read_store(there / "store"), episodes())


def test_files_that_are_no_part_of_a_store_or_checkpoint_stay(there: Path):
    for name in ("notes.txt", "other/data.bin"):
        put(there / "both" / name, b"mine")
    save_checkpoint(there / "both", model(), CHECKPOINT)
    save_checkpoint(there / "both", model(), CHECKPOINT)
    kept = files_of(there / "both")
    assert sorted(kept) == ["config.json", "model.safetensors", "notes.txt", "other/data.bin"]
    assert load_checkpoint(there / "both")[1] == CHECKPOINT


def test_pipes_are_refused_before_anything_waits(tmp_path: Path):
    write_store(tmp_path / "store", INFO, episodes())
    os.mkfifo(tmp_path / "store" / "states" / "c" / "pipe")
    with pytest.raises(UserError, match="'.*/pipe' is no regular file"):
        read_store(Path(f"file://{tmp_path}/store"))
    (tmp_path / "model").mkdir()
    os.mkfifo(tmp_path / "model" / "config.json")
    with pytest.raises(UserError, match="config.json cannot be read: it is no regular file"):
        load_checkpoint(f"file://{tmp_path}/model")


def test_another_group_is_not_replaced(there: Path):
    put(there / "store" / "zarr.json", b'{"zarr_format": 3, "node_type": "group", "attributes": {"format": "else"}}')
    with pytest.raises(UserError, match="is not an episode store and will not be replaced"):
        write_store(there / "store", INFO, episodes(), overwrite=True)
    assert list(files_of(there)) == ["store/zarr.json"]


def test_damage_is_found_and_named(there: Path):
    write_store(there / "store", INFO, episodes())
    chunk = next(name for name in files_of(there) if name.startswith("store/states/c/"))
    content = bytearray(files_of(there)[chunk])
    content[len(content) // 2] ^= 1
    put(there / chunk, bytes(content))
    with pytest.raises(UserError, match=f"{address(there)}/store: chunk c/0/0/0 of 'states' is damaged"):
        read_store(there / "store")
    put(there / "store" / "zarr.json", b"{" * 99)
    with pytest.raises(UserError, match=f"{address(there)}/store/zarr.json, line 1: no JSON"):
        read_store(there / "store")


def test_sizes_are_checked_before_anything_is_copied(there: Path, monkeypatch: pytest.MonkeyPatch):
    write_store(there / "store", INFO, episodes())
    save_checkpoint(there / "model", model(), CHECKPOINT)
    monkeypatch.setattr(remote, "_copy", lambda *args: pytest.fail("it was copied"))
    monkeypatch.setattr("predictor.data.store_files.MOST_METADATA_BYTES", 10)
    with pytest.raises(UserError, match=r"store/\S*zarr.json is too large: [\d,]+ of at most 10 bytes"):
        read_store(there / "store")
    monkeypatch.setitem(__import__("predictor.checkpoint").checkpoint.MOST_BYTES, "config.json", 10)
    with pytest.raises(UserError, match=r"model/config.json is too large: [\d,]+ of at most 10 bytes"):
        load_checkpoint(there / "model")
    monkeypatch.setattr(remote, "MOST_FILES", 3)
    with pytest.raises(UserError, match="store has [0-9]+ files, at most 3 are read"):
        read_store(there / "store")


@pytest.mark.parametrize("name", ["../../outside", "a//b", "./a", "x" * 300])
def test_names_that_lead_elsewhere_are_refused(monkeypatch: pytest.MonkeyPatch, name: str):
    system = fsspec.filesystem("memory")
    listed = {f"/bucket/{name}": {"size": 1, "type": "file"}}
    monkeypatch.setattr(type(system), "find", lambda *args, **kwargs: listed)
    monkeypatch.setattr(type(system), "exists", lambda *args: True)
    with pytest.raises(UserError, match="memory://bucket has a file '.*', which has no place in a folder"):
        read_store(Path("memory://bucket"))


def test_a_file_that_grows_while_it_is_read_is_refused(there: Path, tmp_path: Path):
    put(there / "a", b"12345")
    system, key = remote._system(there / "a")
    with pytest.raises(UserError, match="changed while it was read; try again"):
        remote._copy(system, key, tmp_path / "a", 4, there)
    assert (tmp_path / "a").stat().st_size <= 5


# --- Checkpoints ------------------------------------------------------------------------------------------------------


CHECKPOINT = CheckpointInfo(model().spec, model().config, 3, (1.0, 1.0, 1.0), ("circles",))


def test_a_checkpoint_comes_back_by_its_folder_and_by_its_run(there: Path):
    save_checkpoint(there / "runs" / "one" / "checkpoint", model(), CHECKPOINT)
    for name in (there / "runs" / "one", there / "runs" / "one" / "checkpoint"):
        loaded, info = load_checkpoint(address(name))
        assert info == CHECKPOINT and name_of_folder(name) == name_of_folder(resolve(name)) == "one"
        for key, value in model().state_dict().items():
            assert torch.equal(loaded.state_dict()[key], value), key
    with pytest.raises(UserError, match=f"{address(there)}/none is not a predictor checkpoint"):
        load_checkpoint(there / "none")


def test_a_checkpoint_that_changes_is_read_anew(there: Path):
    save_checkpoint(there / "model", model(), CHECKPOINT)
    first = resolve(there / "model")
    assert resolve(there / "model") == first
    save_checkpoint(there / "model", model("paper"), CheckpointInfo(model("paper").spec, model("paper").config, 3))
    assert resolve(there / "model") != first and load_checkpoint(there / "model")[1].config == model("paper").config


def test_errors_of_a_checkpoint_name_its_address(there: Path):
    save_checkpoint(there / "model", model(), CHECKPOINT)
    put(there / "model" / "config.json", b'{"format": "else"}')
    with pytest.raises(UserError, match=f"{address(there)}/model is not a predictor checkpoint"):
        load_checkpoint(there / "model")


# --- Commands ---------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_training_reads_stores_and_starts_from_checkpoints_there(
    there: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setitem(PRESETS, "fast", FAST_LIKE)
    options: dict[str, Any] = {"steps": 2, "batch_size": 4, "history_steps": 3, "horizon_steps": 3, "val_windows": 4}
    for place in (there, tmp_path):
        write_store(place / "train", INFO, episodes(4))
        write_store(place / "val", INFO, episodes(6)[4:])
    weights = []
    for place, name in ((there, "run-far"), (tmp_path, "run-near")):
        config = TrainConfig(
            data=(place / "train",), val_data=(place / "val",), out=tmp_path / name, preset="fast", **options
        )
        weights.append(load_checkpoint(train(config))[0].state_dict())
    assert all(torch.equal(weights[0][key], value) for key, value in weights[1].items())
    assert read_json(tmp_path / "run-far" / "config.json")["config"]["data"] == [f"{address(there)}/train"]
    save_checkpoint(there / "begin", *load_checkpoint(tmp_path / "run-far"))
    data: dict[str, Any] = {"data": (there / "train",), "val_data": (there / "val",)}
    train(TrainConfig(**data, out=tmp_path / "on", init=address(there / "begin"), **options))


def test_simulated_stores_are_written_there(there: Path):
    make(SpringsConfig(out=there / "springs", train=2, val=1, test=0, ood=0))
    assert len(read_store(there / "springs" / "train").episodes) == 2
    with pytest.raises(UserError, match=f"{address(there)}/springs/train exists"):
        make(SpringsConfig(out=there / "springs", train=2, val=1, test=0, ood=0))


def test_an_unfinished_recording_is_kept_where_the_command_runs(
    there: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    with PartialStore(there / "store", {"seed": 1}, part_s=0.0) as partial:
        partial.add(INFO, circling_episode(0))
    (kept,) = tmp_path.glob(".store-*.unfinished")
    assert kept.is_dir() and not exists(there / "store")
    with PartialStore(there / "store", {"seed": 1}) as partial:
        assert partial.num_done == 1
        partial.add(INFO, circling_episode(1))
        partial.finish(INFO)
    assert same(read_store(there / "store"), [circling_episode(0), circling_episode(1)])
    assert not kept.exists()


def test_one_process_at_a_time_records_to_an_address(there: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    words = ["collect", "--env-id", "two-way-v0", "--out", address(there / "store"), "--episodes", "1"]
    monkeypatch.setattr("sys.argv", [*words, "--max-steps", "2", "--workers", "1"])
    parts = beside(there / "store")
    with (tmp_path / f".{parts}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # as another process
        with pytest.raises(UserError, match=f"another process writes {parts} "):
            collect.main()
    assert not exists(there / "store")


def test_folders_with_locks_stay_here(there: Path, tmp_path: Path):
    message = f"--out must be a local folder, got {address(there)}/run: it is locked"
    write_store(tmp_path / "store", INFO, episodes(4))
    with pytest.raises(UserError, match=message):
        train(TrainConfig(data=(tmp_path / "store",), out=there / "run"))
    with pytest.raises(UserError, match=message), locked(there / "run", "training"):
        pass
    save_checkpoint(there / "model", model(), CHECKPOINT)
    with pytest.raises(UserError, match=f"checkpoint must be a local folder, got {address(there)}/model"):
        write_card(CardConfig(there / "model", (tmp_path / "store",), tmp_path / "accuracy.json"))
    assert set(files_of(there)) == {"model/config.json", "model/model.safetensors"}


def test_a_collection_that_exists_is_refused_before_it_begins(there: Path, monkeypatch: pytest.MonkeyPatch):
    write_store(there / "store", INFO, episodes())
    words = ["collect", "--env-id", "highway-fast-v0", "--out", address(there / "store")]
    monkeypatch.setattr("sys.argv", words)
    with pytest.raises(UserError, match=f"{address(there)}/store exists; choose another path or pass --overwrite"):
        collect.main()


LEFT = """
import multiprocessing, sys
from predictor.checkpoint import resolve

def load():
    resolve(sys.argv[1])

if __name__ == "__main__":
    process = multiprocessing.get_context(sys.argv[2]).Process(target=load)
    process.start()
    process.join()
    sys.exit(process.exitcode)
"""


@pytest.mark.slow
@pytest.mark.parametrize("method", ["fork", "spawn"])
def test_no_process_leaves_its_copies(tmp_path: Path, method: str):
    save_checkpoint(tmp_path / "model", model(), CHECKPOINT)
    (tmp_path / "script.py").write_text(LEFT)
    (tmp_path / "tmp").mkdir()
    subprocess.run(
        [sys.executable, "-W", "ignore", str(tmp_path / "script.py"), f"file://{tmp_path / 'model'}", method],
        env=os.environ | {"TMPDIR": str(tmp_path / "tmp"), "PYTHONPATH": os.pathsep.join(sys.path)}, check=True,
    )  # fmt: skip
    assert not list((tmp_path / "tmp").glob("dgvae-rl-*"))


def test_the_copy_of_a_checkpoint_that_changed_is_deleted(there: Path):
    save_checkpoint(there / "model", model(), CHECKPOINT)
    first = resolve(there / "model")
    save_checkpoint(there / "model", model("paper"), CheckpointInfo(model("paper").spec, model("paper").config, 3))
    second = resolve(there / "model")
    assert second.is_dir() and not first.parents[1].exists()
