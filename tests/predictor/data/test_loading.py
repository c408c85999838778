import hashlib
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from predictor.data.dataset_card import DatasetNotes, most_present, save_dataset
from predictor.data.loading import (
    LoaderConfig,
    bad_line,
    checksum,
    find_files,
    finite,
    frames_per_step,
    in_split,
    read_lines,
    split_of,
    whole,
)
from predictor.data.store import Episode, StoreInfo, read_store, write_store
from predictor.scene import SceneSpec
from predictor.support.errors import UserError

FILE = Path("a.txt")
NOTES = DatasetNotes("Toy", "Two agents.", "Free.", ("It was read.",), {"files": 1})


# --- Reading ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("text", ["nan", "inf", "-inf", "1e999", "", "x", "1,5"])
def test_only_finite_numbers_pass(text: str):
    assert finite("-1.5e-016", "x", FILE, 3) == -1.5e-16
    with pytest.raises(UserError, match=r"^a.txt, line 3: x must be a finite number, got '.*'; repair the line"):
        finite(text, "x", FILE, 3)


def test_whole_numbers():
    assert whole("0", "id", FILE, 1, least=0) == 0
    with pytest.raises(UserError, match=r"a.txt, line 7: id must be at least 0, got -1"):
        whole("-1", "id", FILE, 7, least=0)
    for text in ("1.0", "nan", ""):
        with pytest.raises(UserError, match=r"a.txt, line 7: id must be a whole number, got"):
            whole(text, "id", FILE, 7)


def test_text_that_is_no_text_is_named_with_its_line(tmp_path: Path):
    path = tmp_path / "a.txt"
    path.write_bytes("über\n".encode() + b"\xff\xfe\n")
    with pytest.raises(UserError, match=r"a.txt, line 2: expected text in UTF-8"):
        read_lines(path)
    path.write_bytes(b"\xef\xbb\xbfone\r\ntwo")
    assert read_lines(path) == ["one", "two"]
    with pytest.raises(UserError, match="cannot be read"):
        read_lines(tmp_path)


def test_bad_line_says_what_to_do():
    assert str(bad_line(FILE, 4, "no", "do this")) == "a.txt, line 4: no; do this"


def test_steps_are_whole_frames():
    assert frames_per_step(0.4, 30.0, "it") == 12
    assert frames_per_step(1 / 30, 30.0, "it") == 1
    for dt_s in (0.41, 0.01, 0.0, -0.4, float("nan"), float("inf")):
        with pytest.raises(UserError, match=r"whole number of frames: it has 30 per second"):
            frames_per_step(dt_s, 30.0, "it")


def test_missing_files_are_named(tmp_path: Path):
    with pytest.raises(UserError, match=r"holds no trials \(\*.amc\); pass the folder"):
        find_files(tmp_path, "*.amc", "trials")
    (tmp_path / "b.amc").touch()
    (tmp_path / "a.amc").touch()
    (tmp_path / "c.amc").mkdir()
    assert [path.name for path in find_files(tmp_path, "*.amc", "trials")] == ["a.amc", "b.amc"]


# --- Splits and checksums ---------------------------------------------------------------------------------------------


def test_splits_are_shares_of_a_hash():
    names = [f"trial {i}" for i in range(4000)]
    splits = [split_of(name, 5) for name in names]
    for split, share in (("test", 0.1), ("val", 0.1), ("train", 0.8)):
        assert splits.count(split) / len(names) == pytest.approx(share, abs=0.02)
    position = int.from_bytes(hashlib.sha256(b"5:trial 0").digest()[:8], "big") / 2**64
    assert splits[0] == ("test" if position < 0.1 else "val" if position < 0.2 else "train")
    assert splits != [split_of(name, 6) for name in names]


def test_each_name_is_in_one_split_and_in_all():
    for name in map(str, range(100)):
        assert sum(in_split(name, split, 1) for split in ("train", "val", "test")) == 1
        assert in_split(name, "all", 1)


def test_checksum_sees_names_and_contents_but_not_the_order(tmp_path: Path):
    (tmp_path / "sub").mkdir()
    files = [tmp_path / "b", tmp_path / "sub" / "a"]
    for path, text in zip(files, ("one", "two"), strict=True):
        path.write_text(text)
    expected = hashlib.sha256()
    for name, text in (("b", b"one"), ("sub/a", b"two")):
        expected.update(name.encode() + b"\0" + hashlib.sha256(text).digest())
    assert checksum(tmp_path, files) == checksum(tmp_path, files[::-1]) == expected.hexdigest()
    files[0].rename(tmp_path / "c")
    assert checksum(tmp_path, [tmp_path / "c", files[1]]) != expected.hexdigest()
    assert checksum(tmp_path / "c", [tmp_path / "c"]) == checksum(tmp_path, [tmp_path / "c"])


# --- Store and card ---------------------------------------------------------------------------------------------------


def episode() -> Episode:
    states = np.zeros((3, 2, 4), dtype=np.float32)
    states[:, 1, 0] = 2.0
    states[:, :, 2] = [[1.0, 3.0]] * 3
    valid = np.array([[True, True], [True, False], [False, False]])
    return Episode(states * valid[..., None], valid, np.array([0, 1]), "toy")


def spec() -> SceneSpec:
    return SceneSpec(0.5, ("centroid", "world"), has_ego=False)


def test_the_card_says_what_was_measured(tmp_path: Path):
    source = tmp_path / "source"
    source.write_text("data")
    config = LoaderConfig(source, tmp_path / "deep" / "store")
    save_dataset(config, spec(), [episode()], NOTES, [source], {"joints": ("a", "b")})
    card = config.card_path.read_text()
    assert sorted(p.name for p in (tmp_path / "deep").iterdir()) == ["store", "store.md"]
    for line in (
        "| episodes | 1 |",
        "| labels | toy |",
        "| steps | 3 (0.0 min) |",
        "| agents per step (min / median / max) | 0 / 1 / 2 |",
        "| steps without an agent | 1 |",
        "| time step | 0.5 s |",
        "| files | 1 |",
        # x about the centroid: −1, 1 and 0; vx: 1, 3 and 1.
        "| `x_m` | 100 | 0.816 |",
        "| `vx_mps` | 30 | 0.943 |",
    ):
        assert line in card
    facts = read_store(config.out).info.provenance
    assert facts["source_sha256"] == checksum(source, [source])
    assert facts["source_sha256"] in card
    assert facts["joints"] == ["a", "b"]
    assert facts["split"] == "all"
    assert most_present([episode()]) == 2
    assert most_present([]) == 0


def test_names_that_are_no_text_make_a_store_that_can_be_read(tmp_path: Path):
    source = tmp_path / os.fsdecode(b"caf\xe9")
    source.write_text("data")
    config = LoaderConfig(source, tmp_path / "store")
    named = replace(NOTES, title=source.name)
    save_dataset(config, spec(), [replace(episode(), label=source.name)], named, [source], {"name": source.name})
    store = read_store(config.out)
    assert (store.episodes[0].label, store.info.source, store.info.provenance["name"]) == ("caf?",) * 3
    assert config.card_path.read_text().startswith("# caf\\udce9\n")
    assert split_of(source.name, 0) in ("train", "val", "test")


def test_no_episodes_leave_nothing(tmp_path: Path):
    config = LoaderConfig(tmp_path, tmp_path / "store", split="val")
    with pytest.raises(UserError, match=r"gives no episode for split 'val'; files: 1"):
        save_dataset(config, spec(), [], NOTES, [])
    assert list(tmp_path.iterdir()) == []


def test_a_store_that_cannot_be_written_leaves_no_card(tmp_path: Path):
    config = LoaderConfig(tmp_path, tmp_path / "store")
    broken = episode()
    broken.states[0, 0, 0] = np.nan
    with pytest.raises(UserError, match="states must be finite"):
        save_dataset(config, spec(), [broken], NOTES, [])
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["store", "store.md"])
def test_what_is_in_the_way_stays(tmp_path: Path, name: str):
    config = LoaderConfig(tmp_path, tmp_path / "store")
    config.check_paths()
    (tmp_path / name).write_text("mine")
    with pytest.raises(UserError, match=rf"{name} exists; choose another path or pass --overwrite"):
        config.check_paths()
    replacing = LoaderConfig(tmp_path, tmp_path / "store", overwrite=True)
    why = "is not an episode store and will not" if name == "store" else "belongs to no store; delete it, or choose"
    with pytest.raises(UserError, match=f"{name} {why}"):
        replacing.check_paths()
    assert (tmp_path / name).read_text() == "mine"
    with pytest.raises(UserError, match="no source at"):
        LoaderConfig(tmp_path / "absent", tmp_path / "other").check_paths()


@pytest.mark.parametrize("out", [".", "/", "deep/.."])
@pytest.mark.parametrize("overwrite", [False, True])
def test_a_store_needs_a_name(tmp_path: Path, out: str, overwrite: bool):
    """Card, lock and unfinished files are beside it, under names that begin with its own."""
    with pytest.raises(UserError, match=f"^a store needs a path that ends in its name, got {out}; pass that of a new"):
        LoaderConfig(tmp_path, Path(out), overwrite=overwrite).check_paths()
    with pytest.raises(UserError, match="^a store needs a path that ends in its name"):
        write_store(Path(out), StoreInfo(spec(), "toy"), [episode()], overwrite)


def test_overwrite_replaces_both(tmp_path: Path):
    config = LoaderConfig(tmp_path, tmp_path / "store", overwrite=True)
    save_dataset(config, spec(), [episode()], NOTES, [])
    save_dataset(config, spec(), [episode(), episode()], NOTES, [])
    assert len(read_store(config.out).episodes) == 2
    assert "| episodes | 2 |" in config.card_path.read_text()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["store", "store.md"]
