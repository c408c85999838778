import hashlib
import json
import shutil
import subprocess
import sys
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import google_crc32c
import numpy as np
import pytest
import zarr
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numcodecs.zstd import compress

from predictor.data.store import (
    PERTURBATIONS,
    Episode,
    StoreInfo,
    _check_arrays,
    content_id,
    read_info_of,
    read_store,
    write_store,
)
from predictor.data.store_files import METADATA, digest_of
from predictor.scene import SceneSpec
from predictor.support.errors import UserError
from tests.predictor.helpers import ROAD, circling_episode, random_presence, random_states, scene, spec

EDGE_LABELS = ("edge_types", "edge_attributes")
INFO = StoreInfo(spec(ROAD), "toy-v0", {"command": "python -m envs.collect", "seeds": [3, 4]})


def episode(seed: int, steps: int = 4, agents: int = 3) -> Episode:
    return Episode(
        random_states(seed, steps, agents, 4).numpy(),
        random_presence(seed, steps, agents).numpy(),
        10 * np.arange(agents) + seed,
        f"driven by {seed}",
        seed,
    )


def assert_equal(ours: Episode, expected: Episode) -> None:
    np.testing.assert_array_equal(ours.states, expected.states)
    np.testing.assert_array_equal(ours.valid, expected.valid)
    np.testing.assert_array_equal(ours.ids, expected.ids)
    assert (ours.label, ours.seed) == (expected.label, expected.seed)


@st.composite
def episodes(draw: st.DrawFn) -> Episode:
    steps, agents = draw(st.integers(1, 5)), draw(st.integers(1, 4))
    finite = st.floats(-3e4, 3e4, width=32)  # farther ones are refused
    return Episode(
        draw(hnp.arrays(np.float32, (steps, agents, 4), elements=finite)),
        draw(hnp.arrays(np.bool_, (steps, agents))),
        np.array(draw(st.lists(st.integers(0, 2**40), min_size=agents, max_size=agents, unique=True))),
        draw(st.text(st.characters(codec="utf-8"), max_size=8)),
        draw(st.integers(0, 2**60)),
    )


@pytest.mark.slow
@settings(max_examples=20)
@given(written=st.lists(episodes(), min_size=1, max_size=4))
def test_round_trip(tmp_path_factory: pytest.TempPathFactory, written: list[Episode]):
    path = tmp_path_factory.mktemp("stores") / "store"
    write_store(path, INFO, written)
    store = read_store(path)
    steps = sum(len(e.states) for e in written)
    assert store.info == read_info_of(path) == replace(INFO, num_steps=steps)
    assert store.num_steps == steps
    for ours, expected in zip(store.episodes, written, strict=True):
        assert_equal(ours, expected)


def test_every_field_of_the_spec_comes_back(tmp_path: Path):
    names, scales = (*spec().feature_names, "heading_rad"), (1.0, 2.0, 3.0, 4.0, 5.0)
    unusual = SceneSpec(0.2, ROAD, names, scales, perception_m=33.0, max_agents=7)
    states, valid = np.zeros((2, 1, 5), dtype=np.float32), np.ones((2, 1), dtype=np.bool_)
    write_store(tmp_path / "store", StoreInfo(unusual, "toy"), [Episode(states, valid, np.array([0]))])
    assert read_store(tmp_path / "store").info.spec == unusual


def test_episode_from_scenes_gives_each_id_a_column():
    first = scene({0: (1.0,) * 4, 7: (2.0,) * 4}, size=4)
    second = scene({0: (3.0,) * 4, 9: (4.0,) * 4}, size=4, order=[0, -1, -1, 9])
    third = scene({0: (5.0,) * 4, 9: (6.0,) * 4, 7: (7.0,) * 4}, size=4)
    joined = Episode.from_scenes([first, second, third], "idle", 5)
    assert joined.ids.tolist() == [0, 7, 9]
    assert joined.valid.tolist() == [[True, True, False], [True, False, True], [True, True, True]]
    assert joined.states[..., 0].tolist() == [[1.0, 2.0, 0.0], [3.0, 0.0, 4.0], [5.0, 7.0, 6.0]]
    assert (joined.label, joined.seed) == ("idle", 5)


# --- Edge labels ------------------------------------------------------------------------------------------------------


def labelled(seed: int, steps: int = 4, agents: int = 3, label_steps: int = 1, width: int = 2) -> Episode:
    """Random types in -1 … 2 and attributes of random size."""
    rng = np.random.default_rng([seed, 5])
    types = rng.integers(-1, 3, size=(label_steps, agents, agents)).astype(np.int8)
    attributes = rng.normal(size=(label_steps, agents, agents, width)).astype(np.float32)
    return replace(episode(seed, steps, agents), edge_types=types, edge_attributes=attributes)


def assert_same_labels(ours: Episode, expected: Episode) -> None:
    for name in EDGE_LABELS:
        given, wanted = getattr(ours, name), getattr(expected, name)
        assert (given is None) == (wanted is None)
        if wanted is not None:
            np.testing.assert_array_equal(given, wanted)
            assert given.dtype == wanted.dtype


@pytest.mark.parametrize("only", [None, "edge_types", "edge_attributes"])
def test_edge_labels_come_back(tmp_path: Path, only: str | None):
    """Episodes of different lengths and casts; labels of one step and of every step, side by side."""
    written = [labelled(1), labelled(2, steps=6, agents=5, label_steps=6), labelled(3, steps=1, agents=2)]
    if only:
        written = [replace(e, **{name: None for name in EDGE_LABELS if name != only}) for e in written]
    info = replace(INFO, edge_attribute_names=("gap_m", "time_s"))
    write_store(tmp_path / "store", info, written)
    store = read_store(tmp_path / "store")
    assert store.info.edge_attribute_names == ("gap_m", "time_s")
    for ours, expected in zip(store.episodes, written, strict=True):
        assert_equal(ours, expected)
        assert_same_labels(ours, expected)


def test_stores_without_labels_have_none(tmp_path: Path):
    write_store(tmp_path / "store", INFO, [episode(1)])
    store = read_store(tmp_path / "store")
    assert (store.episodes[0].edge_types, store.episodes[0].edge_attributes) == (None, None)
    assert store.info.edge_attribute_names == ()
    group = zarr.open_group(tmp_path / "store", mode="r")
    assert sorted(group) == ["ids", "seeds", "starts", "states", "valid"]


def test_what_is_not_labelled_is_unknown(tmp_path: Path):
    """Columns that an episode does not have are stored as type -1 and attribute 0."""
    write_store(tmp_path / "store", INFO, [labelled(1, agents=2), labelled(2, agents=3)])
    group = zarr.open_group(tmp_path / "store", mode="r")
    types, attributes = (np.asarray(group[name])[0] for name in EDGE_LABELS)
    assert (types[2] == -1).all() and (types[:, 2] == -1).all()
    assert not attributes[2].any() and not attributes[:, 2].any()
    np.testing.assert_array_equal(types[:2, :2], labelled(1, agents=2).edge_types[0])


def of_different_steps() -> Episode:
    mixed = labelled(1, label_steps=4)
    object.__setattr__(mixed, "edge_attributes", labelled(1).edge_attributes)  # shape checks would refuse it earlier
    return mixed


@pytest.mark.parametrize(
    ("broken", "message"),
    [
        (
            lambda: [labelled(1), episode(2)],
            "store: either all episodes have edge_types or none, got both",
        ),
        (
            lambda: [labelled(1), replace(labelled(2), edge_attributes=None)],
            "store: either all episodes have edge_attributes or none, got both",
        ),
        (
            lambda: [labelled(1), labelled(2, steps=4, label_steps=3)],
            "store: edge_types of episode 1 need one step or every step, got 3",
        ),
        (
            lambda: [labelled(1, steps=4, label_steps=5)],
            "store: edge_types of episode 0 need one step or every step, got 5",
        ),
        (
            lambda: [of_different_steps()],
            "store: edge_types and edge_attributes need equal numbers of steps in each episode",
        ),
    ],
    ids=["some_without", "some_without_attributes", "too_few_steps", "too_many_steps", "different_steps"],
)
def test_labels_that_do_not_fit_are_refused(tmp_path: Path, broken: Any, message: str):
    with pytest.raises(UserError) as error:
        write_store(tmp_path / "store", INFO, broken())
    assert str(error.value).endswith(message)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", EDGE_LABELS)
def test_missing_labels_are_not_read_as_no_edge(tmp_path: Path, name: str):
    """Zarr reads a missing chunk as zeros, which as a type means "no edge"; labels that are all zero are no damage."""
    nothing = replace(labelled(1), edge_types=np.zeros((1, 3, 3), np.int8), edge_attributes=np.zeros((1, 3, 3, 2)))
    write_store(tmp_path / "store", INFO, [nothing])
    assert not read_store(tmp_path / "store").episodes[0].edge_types.any()
    next(f for f in (tmp_path / "store" / name).rglob("*") if f.is_file() and f.name != "zarr.json").unlink()
    with pytest.raises(UserError, match=f"store: chunks of '{name}' are missing; copy or collect it anew"):
        read_store(tmp_path / "store")


def test_info_is_read_without_the_arrays(tmp_path: Path):
    write_store(tmp_path / "store", INFO, [episode(1, steps=4), episode(2, steps=3)])
    for name in ("states", "valid"):
        shutil.rmtree(tmp_path / "store" / name / "c")
    assert read_info_of(tmp_path / "store") == replace(INFO, num_steps=7)
    with pytest.raises(UserError, match=r"no episode store at .*nowhere; make one"):
        read_info_of(tmp_path / "nowhere")


# --- Refusals ---------------------------------------------------------------------------------------------------------


def broken(value: float, visible: bool) -> Episode:
    bad = episode(3)
    states, valid = bad.states.copy(), bad.valid.copy()
    states[2, 1, 3], valid[2, 1] = value, visible
    return replace(bad, states=states, valid=valid)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("visible", [True, False], ids=["visible", "hidden"])
def test_non_finite_states_are_refused_with_their_place(tmp_path: Path, value: float, visible: bool):
    with pytest.raises(
        UserError, match=rf"states must be finite, got \[.*{value}\] \(episode seed 3, step 2, agent 13\)"
    ):
        write_store(tmp_path / "store", INFO, [episode(1), broken(value, visible)])
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "place", "value", "message"),
    [
        ("label_starts", 1, 3, "an episode's edges need one step or every step"),
        ("edge_types", (5, 0, 1), -7, "'edge_types' must lie between -1 and 1023, got -7"),
        ("edge_attributes", (0, 0, 1, 0), np.nan, "'edge_attributes' must be finite, got nan"),
    ],
)
def test_labels_of_edges_that_fit_no_episode_are_refused(
    tmp_path: Path, name: str, place: Any, value: float, message: str
):
    """Else training would read labels of the next episode, or beyond the last."""
    write_store(tmp_path / "store", INFO, [labelled(i, label_steps=4) for i in range(2)])
    array: Any = zarr.open_group(tmp_path / "store", mode="r+")[name]
    array[place] = value
    with pytest.raises(UserError, match=f"store: {message}; collect it anew"):
        read_store(tmp_path / "store")


@pytest.mark.unchecked
def test_states_that_single_precision_cannot_hold_are_refused(tmp_path: Path):
    large = broken(0.0, True)
    large = replace(large, states=large.states.astype(np.float64) + 1e300)
    with pytest.raises(UserError, match=r"states must be at most 1e\+30 in size, got \[1e\+300, .* step 0, agent"):
        write_store(tmp_path / "store", INFO, [large])
    assert list(tmp_path.iterdir()) == []


def test_positions_that_single_precision_cannot_tell_apart_are_refused(tmp_path: Path):
    near, far = episode(3), episode(4)
    states = far.states.copy()
    states[..., 1] -= 5_400_000.0
    with pytest.raises(UserError, match=r"store, episode seed 4: y_m lies up to 54000[.\d]* .* steps of 0.5; "):
        write_store(tmp_path / "store", INFO, [near, replace(far, states=states)])
    assert list(tmp_path.iterdir()) == []


def test_non_finite_states_in_a_store_are_refused_with_their_place(tmp_path: Path):
    write_store(tmp_path / "store", INFO, [episode(1), episode(3)])
    states: Any = zarr.open_group(tmp_path / "store", mode="r+")["states"]
    states[4 + 2, 1, 0] = np.nan
    with pytest.raises(
        UserError, match=r"store: states must be finite, got \[nan.*\(episode seed 3, step 2, agent 13\)"
    ):
        read_store(tmp_path / "store")


def test_zero_episodes_are_refused(tmp_path: Path):
    with pytest.raises(UserError, match="a store needs at least one episode, got none"):
        write_store(tmp_path / "store", INFO, iter([]))
    assert list(tmp_path.iterdir()) == []


def test_an_existing_store_is_not_overwritten_unasked(tmp_path: Path):
    path = tmp_path / "store"
    write_store(path, INFO, [episode(1)])
    with pytest.raises(UserError, match=r"store exists; choose another path or pass --overwrite"):
        write_store(path, INFO, [episode(2)])
    assert_equal(read_store(path).episodes[0], episode(1))
    write_store(path, INFO, [episode(2)], overwrite=True)
    assert_equal(read_store(path).episodes[0], episode(2))
    assert [p.name for p in tmp_path.iterdir()] == ["store"]


def test_missing_store(tmp_path: Path):
    with pytest.raises(UserError, match=r"no episode store at .*/nowhere; make one with python -m envs.collect"):
        read_store(tmp_path / "nowhere")


def foreign_folder(path: Path) -> None:
    path.mkdir()
    (path / "notes.txt").write_text("mine")


def foreign_file(path: Path) -> None:
    path.write_text("mine")


def foreign_group(path: Path) -> None:
    zarr.open_group(path, mode="w").attrs["format"] = "something else"


def newer_version(path: Path) -> None:
    write_store(path, INFO, [episode(1)])
    zarr.open_group(path, mode="r+").attrs["version"] = 99


def without_an_array(path: Path) -> None:
    write_store(path, INFO, [episode(1)])
    shutil.rmtree(path / "ids")


def with_broken_metadata(path: Path) -> None:
    write_store(path, INFO, [episode(1)])
    (path / "zarr.json").write_text((path / "zarr.json").read_text()[:50])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (foreign_folder, r"store is not an episode store \(it has no zarr.json\)"),
        (foreign_file, "store/zarr.json cannot be read: a part of the path is a file"),
        (foreign_group, "store is not an episode store; make one with python -m envs.collect"),
        (newer_version, "store has version 99, this release reads 1; make it anew"),
        (without_an_array, "ids/zarr.json cannot be read: there is no such file"),
        (with_broken_metadata, "store/zarr.json, line 3: no JSON"),
    ],
)
def test_what_is_no_store_is_refused(tmp_path: Path, make: Any, message: str):
    make(tmp_path / "store")
    with pytest.raises(UserError, match=message):
        read_store(tmp_path / "store")


# --- Crashes ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("stage", [0, 1, 4, 5])
@pytest.mark.parametrize("existing", [False, True], ids=["new", "overwriting"])
def test_crash_while_writing_leaves_what_was_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stage: int, existing: bool
):
    path = tmp_path / "store"
    if existing:
        write_store(path, INFO, [episode(1)])
    calls = 0
    create = zarr.Group.create_array

    def crash(group: zarr.Group, *args: Any, **kwargs: Any) -> Any:
        nonlocal calls
        calls += 1
        if calls > stage:
            raise KeyboardInterrupt
        return create(group, *args, **kwargs)

    monkeypatch.setattr(zarr.Group, "create_array", crash)
    if stage == 5:  # all arrays are there, the attributes that make them a store are not
        monkeypatch.setattr("predictor.data.store.asdict", lambda _: crash(None))  # type: ignore[arg-type]
    with pytest.raises(KeyboardInterrupt):
        write_store(path, INFO, [episode(2)], overwrite=True)
    monkeypatch.undo()
    assert [p.name for p in tmp_path.iterdir()] == ["store"] * existing
    if existing:
        assert_equal(read_store(path).episodes[0], episode(1))


# --- Interventions ----------------------------------------------------------------------------------------------------


def shifted_episode(seed: int, agents: int) -> Episode:
    """One step of four has causal labels, for one sender."""
    plain = circling_episode(seed, steps=4, agents=agents)
    shift = np.full((4, agents, agents), np.nan, dtype=np.float32)
    shift[1, :, 0] = np.arange(agents) / 2
    shift[1, 0, 0] = np.nan
    done = np.zeros(plain.valid.shape, dtype=np.int8)
    done[2, 1] = PERTURBATIONS.index("brake")
    return replace(plain, causal_shift_m=shift, perturbed=done)


def test_causal_labels_and_marks_come_back_as_they_were(tmp_path: Path):
    written = [shifted_episode(0, 3), shifted_episode(1, 5)]
    write_store(tmp_path / "s", StoreInfo(spec(), "circle", causal_threshold_m=0.75), written)
    store = read_store(tmp_path / "s")
    assert store.info.causal_threshold_m == 0.75
    for found, expected in zip(store.episodes, written, strict=True):
        np.testing.assert_array_equal(found.causal_shift_m, expected.causal_shift_m)
        np.testing.assert_array_equal(found.perturbed, expected.perturbed)
    group = zarr.open_group(tmp_path / "s", mode="r")
    assert np.isnan(np.asarray(group["causal_shift_m"])[:4, 3:]).all()  # padding is unknown, too


def test_marks_are_for_all_episodes_or_for_none(tmp_path: Path):
    with pytest.raises(UserError, match="either all episodes have perturbed or none, got both"):
        marked = replace(shifted_episode(0, 3), causal_shift_m=None)
        write_store(tmp_path / "s", StoreInfo(spec(), "circle"), [marked, circling_episode(0, steps=4)])
    assert not (tmp_path / "s").exists()


# --- Checksums and foreign groups -------------------------------------------------------------------------------------


def test_every_flipped_bit_is_found(tmp_path: Path):
    """One bit at each place of each chunk, and of the attributes' values."""
    write_store(tmp_path / "store", INFO, [episode(1, steps=3)])
    chunks = [f for f in (tmp_path / "store").rglob("c/**/*") if f.is_file()]
    assert len(chunks) == 5
    for chunk in chunks:
        whole = chunk.read_bytes()
        for place in range(0, len(whole), 7):
            chunk.write_bytes(whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :])
            name = chunk.relative_to(tmp_path / "store").parts[0]
            with pytest.raises(UserError, match=rf"store: chunk c/0\S* of '{name}' is damaged \(.*\); copy or collect"):
                read_store(tmp_path / "store")
        chunk.write_bytes(whole)
    metadata = tmp_path / "store" / "zarr.json"
    metadata.write_text(metadata.read_text().replace(INFO.source, f"{INFO.source}!"))
    for read in (read_store, read_info_of):
        with pytest.raises(UserError, match="zarr.json is damaged"):
            read(tmp_path / "store")


def test_the_damaged_chunk_of_many_is_named(tmp_path: Path):
    write_store(tmp_path / "store", INFO, [episode(1, steps=9000)])
    chunk = tmp_path / "store" / "states" / "c" / "1" / "0" / "0"
    chunk.write_bytes(chunk.read_bytes()[:-1] + b"\0")
    with pytest.raises(UserError, match="chunk c/1/0/0 of 'states' is damaged"):
        read_store(tmp_path / "store")


def test_a_store_without_its_checksum_is_refused(tmp_path: Path):
    write_store(tmp_path / "store", INFO, [episode(1), episode(2)])
    metadata = tmp_path / "store" / "zarr.json"
    content = json.loads(metadata.read_text())
    del content["attributes"]["sha256"]
    metadata.write_text(json.dumps(content))
    with pytest.raises(UserError, match="zarr.json is damaged"):
        read_store(tmp_path / "store")


def test_missing_chunks_of_small_arrays_are_no_zeros(tmp_path: Path):
    write_store(tmp_path / "store", INFO, [episode(1), episode(2)])
    shutil.rmtree(tmp_path / "store" / "seeds" / "c")
    with pytest.raises(UserError, match="chunks of 'seeds' are missing"):
        read_store(tmp_path / "store")


def zeros(size: int) -> bytes:
    """One frame of zstd."""
    return bytes(compress(np.zeros(size, np.uint8), 1))


def without_size(blocks: int) -> bytes:
    """One frame that does not name its size: blocks that repeat a zero 131,072 times, with a window of 1 MiB."""
    kinds = [2**17 << 3 | 1 << 1 | (block == blocks - 1) for block in range(blocks)]
    return bytes.fromhex("28b52ffd0050") + b"".join(kind.to_bytes(3, "little") + b"\0" for kind in kinds)


BOMBS = {
    "one frame": (zeros(10**7), "it unpacks to 10000000 bytes, not 192"),
    "many frames": (zeros(192) + zeros(10**7), "it is not one whole frame of zstd"),
    "after another": (zeros(192) * 9, "it is not one whole frame of zstd"),
    "no size": (without_size(99), "it is not one whole frame of zstd"),
    "cut": (zeros(10**7)[:-3], "it is not one whole frame of zstd"),
    "empty": (b"", "it is not one whole frame of zstd"),
}


@pytest.mark.parametrize("case", BOMBS)
def test_a_chunk_that_unpacks_to_more_than_its_array_is_refused_before_it_is_unpacked(case: str, tmp_path: Path):
    content, reason = BOMBS[case]
    write_store(tmp_path / "store", INFO, [episode(1)])
    checksum = google_crc32c.value(content).to_bytes(4, "little")
    (tmp_path / "store" / "states" / "c" / "0" / "0" / "0").write_bytes(content + checksum)
    with pytest.raises(UserError, match=rf"chunk c/0/0/0 of 'states' is damaged \({reason}\); copy or collect"):
        read_store(tmp_path / "store")


DECLARED = {
    "gzip": ("codecs", [{"name": "bytes"}, {"name": "gzip"}], "codecs must be bytes, zstd, crc32c, got"),
    "twice": ("codecs", [{"name": "bytes"}, {"name": "zstd"}, {"name": "zstd"}], "codecs must be bytes, zstd, crc32c"),
    "keys": (
        "chunk_key_encoding",
        {"name": "default", "configuration": {"separator": "."}},
        "chunk_key_encoding must be default with /, got",
    ),
}


@pytest.mark.parametrize("case", DECLARED)
def test_only_what_a_store_has_is_unpacked(case: str, tmp_path: Path):
    key, value, message = DECLARED[case]
    write_store(tmp_path / "store", INFO, [episode(1)])
    metadata = tmp_path / "store" / "states" / "zarr.json"
    metadata.write_text(json.dumps(json.loads(metadata.read_text()) | {key: value}))
    with pytest.raises(UserError, match=message):
        read_store(tmp_path / "store")


def test_a_link_to_a_folder_is_refused(tmp_path: Path):
    """A pipe behind it would be waited for."""
    write_store(tmp_path / "store", INFO, [episode(1)])
    (tmp_path / "store" / "seeds" / "c").rename(tmp_path / "elsewhere")
    (tmp_path / "store" / "seeds" / "c").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(UserError, match="store/seeds/c is a link to a folder, and a store has none; copy the store"):
        read_store(tmp_path / "store")
    (tmp_path / "link").symlink_to(tmp_path / "store")
    (tmp_path / "store" / "seeds" / "c").unlink()
    (tmp_path / "elsewhere").rename(tmp_path / "store" / "seeds" / "c")
    assert len(read_store(tmp_path / "link").episodes) == 1


@pytest.mark.parametrize("make", [foreign_folder, foreign_file, foreign_group])
def test_what_is_no_store_is_never_replaced(tmp_path: Path, make: Any):
    make(tmp_path / "store")
    before = {path: path.read_bytes() for path in (tmp_path / "store", *tmp_path.rglob("*")) if path.is_file()}
    with pytest.raises(UserError, match="store is not an episode store and will not be replaced; choose another path"):
        write_store(tmp_path / "store", INFO, [episode(1)], overwrite=True)
    assert {path: path.read_bytes() for path in before} == before


@pytest.mark.parametrize("beside", ["notes.txt", ".other.unfinished", "highway"])
def test_what_lies_in_a_store_s_folder_is_not_lost(tmp_path: Path, beside: str):
    write_store(tmp_path / "store", INFO, [episode(1)])
    if beside == "notes.txt":
        (tmp_path / "store" / beside).write_text("mine")
    else:
        write_store(tmp_path / "store" / beside, INFO, [episode(2)])
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(UserError, match=f"store also holds {beside}, which is no part of the store and would be lost"):
        write_store(tmp_path / "store", INFO, [episode(3)], overwrite=True)
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize(
    ("name", "places"),
    [
        ("starts", np.array([0, 100, -56, 44], np.int8)),
        ("starts", np.array([0, 2**62, -(2**63), 44], np.int64)),
        ("starts", np.array([0, 20, 20, 44])),
        ("label_starts", np.array([0, 100, -56, 44], np.int8)),
    ],
)
def test_where_episodes_begin_must_rise(name: str, places: np.ndarray):
    """Also where differences of their type wrap around: 44 steps would be read as 88."""
    arrays = {
        "states": np.zeros((44, 3, 4)), "starts": np.array([0, 4, 24, 44]), "ids": np.arange(9).reshape(3, 3),
        "edge_types": np.zeros((44, 3, 3), np.int8), "label_starts": np.array([0, 4, 24, 44]),
    }  # fmt: skip
    _check_arrays(Path("store"), arrays)
    with pytest.raises(UserError, match=f"store: '{name}' must rise from 0 to 44"):
        _check_arrays(Path("store"), arrays | {name: places})


STOPPED_WHILE_ZARR_STARTS = """
import asyncio, os, signal, sys
from pathlib import Path
from predictor.data.store_files import open_group
from predictor.support.errors import run_entry_point

begin = asyncio.base_events.BaseEventLoop.__init__

def asked_to_stop(loop):
    os.kill(os.getpid(), signal.SIGTERM)
    begin(loop)

asyncio.base_events.BaseEventLoop.__init__ = asked_to_stop
run_entry_point(lambda: open_group(Path(sys.argv[1]), mode="w") and print("went on"))
"""


def test_a_stop_while_zarr_starts_its_event_loop_is_one_line(tmp_path: Path):
    """A loop that is half made complains when it is deleted."""
    words = [sys.executable, "-c", STOPPED_WHILE_ZARR_STARTS, str(tmp_path / "store")]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (143, "")
    assert done.stderr == "stopped: what was not written yet is lost; the same command begins anew\n"


@pytest.mark.unchecked
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"edge_types": np.zeros((1, 3, 3))},
            "edge_types of an episode must be an array of integers for each pair",
        ),
        ({"edge_types": np.zeros((1, 2, 2), np.int8)}, r"pair of the 3 agents, got int8 \(1, 2, 2\)"),
        ({"edge_types": np.zeros((1, 5, 5), np.int8)}, r"pair of the 3 agents, got int8 \(1, 5, 5\)"),
        ({"edge_attributes": np.zeros((1, 3, 3))}, r"edge_attributes .* pair of the 3 agents, got float64 \(1, 3, 3\)"),
        ({"perturbed": np.zeros((1, 3), np.int8)}, r"perturbed .* integers of shape \(4, 3\), got int8 \(1, 3\)"),
        ({"perturbed": np.zeros((4, 3))}, r"perturbed .* integers of shape \(4, 3\), got float64 \(4, 3\)"),
        ({"perturbed": np.full((4, 3), 99)}, "perturbed must lie between 0 and 6"),
        ({"edge_types": np.full((1, 3, 3), -2)}, "'edge_types' must lie between -1 and 1023, got -2"),
        ({"edge_attributes": np.full((1, 3, 3, 1), np.inf)}, "'edge_attributes' must be finite, got inf"),
        (
            {"causal_shift_m": np.full((1, 3, 3), -1.0)},
            "'causal_shift_m' must lie between 0 and 1e.30, or be NaN, got -1",
        ),
        ({"causal_shift_m": np.full((1, 3, 3), np.inf)}, "'causal_shift_m' must lie between .* got inf"),
        ({"edge_attributes": np.zeros((1, 3, 3, 0))}, "edge_attributes need .* got 0"),
    ],
)
def test_labels_and_marks_of_another_kind_are_not_written(changes: dict[str, Any], message: str, tmp_path: Path):
    """What is written can be read, and no label is of another pair."""
    with pytest.raises(UserError, match=message):
        write_store(tmp_path / "store", INFO, [replace(episode(1), **changes)])
    assert not (tmp_path / "store").exists()


def test_attributes_fit_their_names_and_types_of_episodes_are_kept(tmp_path: Path):
    wide, narrow = (replace(episode(1), edge_attributes=np.zeros((1, 3, 3, width))) for width in (2, 1))
    with pytest.raises(
        UserError, match="edge_attributes need one number of them, at least 1, in all episodes, got 1, 2"
    ):
        write_store(tmp_path / "store", replace(INFO, edge_attribute_names=()), [narrow, wide])
    with pytest.raises(UserError, match="edge_attributes need the 1 of edge_attribute_names, got 2"):
        write_store(tmp_path / "store", replace(INFO, edge_attribute_names=("a",)), [wide])
    few, many = (replace(episode(1), edge_types=np.full((1, 3, 3), n, kind)) for n, kind in ((1, np.int8), (300, int)))
    write_store(tmp_path / "store", INFO, [few, many])
    types = [found.edge_types for found in read_store(tmp_path / "store").episodes]
    assert [int(t.max()) for t in types if t is not None] == [1, 300]


@pytest.mark.unchecked
def test_a_store_without_agents_is_not_written(tmp_path: Path):
    nobody = Episode(np.zeros((6, 0, 4), np.float32), np.zeros((6, 0), bool), np.zeros(0, np.int64), "", 0)
    with pytest.raises(UserError, match="a store needs at least one agent, got none"):
        write_store(tmp_path / "store", INFO, [nobody])


def test_the_hash_of_a_store_is_that_of_what_it_holds(tmp_path: Path):
    """Simulators note their seed in the command alone, which does not count."""
    info = StoreInfo(spec(), "circles", {"command": "one", "time": "now"})
    write_store(tmp_path / "a", info, [circling_episode(7), circling_episode(9)])
    write_store(tmp_path / "b", replace(info, provenance={"command": "two"}), read_store(tmp_path / "a").episodes)
    assert content_id(tmp_path / "a") == content_id(tmp_path / "b")
    moved = circling_episode(7)
    moved.states[3, 0, 0] += 1e-3
    absent = circling_episode(7)
    absent.valid[-1, 0] = False
    for number, first in enumerate((moved, absent, replace(circling_episode(7), seed=5))):
        write_store(tmp_path / str(number), info, [first, circling_episode(9)])
        assert content_id(tmp_path / str(number)) != content_id(tmp_path / "a"), number


def test_a_store_of_before_the_hash_keeps_its_own(tmp_path: Path):
    write_store(tmp_path / "a", StoreInfo(spec(), "circles"), [circling_episode(7)])
    file = tmp_path / "a" / METADATA
    content = json.loads(file.read_text())
    del content["attributes"]["content_sha256"]
    content["attributes"]["sha256"] = digest_of(content["attributes"])
    now = content_id(tmp_path / "a")
    file.write_text(json.dumps(content))
    parts = [asdict(spec()), "circles", {}, 10]
    assert content_id(tmp_path / "a") == hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest() != now


def test_numbers_of_numpy_come_back_as_numbers(tmp_path: Path):
    scales = tuple(np.float32([20.5, 20.5, 4.0, 4.0]))
    layout = replace(INFO.spec, dt_s=np.float32(0.5), max_agents=np.int64(8), feature_scales=scales)
    assert type(layout.dt_s) is float and type(layout.max_agents) is int
    noted = {"seed": np.int64(3), "share": np.float32(0.25), "done": np.bool_(True)}
    info = StoreInfo(layout, "toy-v0", noted, causal_threshold_m=np.float32(0.5))  # type: ignore[arg-type]
    write_store(tmp_path / "store", info, [episode(1)])
    found = read_info_of(tmp_path / "store")
    assert found.spec == layout and found.causal_threshold_m == 0.5
    assert found.provenance == {"seed": 3, "share": 0.25, "done": True}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"ids": np.array([2**64 - 1, 5, 6], np.uint64)}, "ids of an episode must be different, not negative, and at"),
        ({"seed": 2**70}, "the seed of an episode must be a whole number of 64 bits, got 1180591620717411303424"),
        ({"label": 3}, "the label of an episode must be a text, got 3"),
        ({"edge_types": [[[0]]]}, r"edge_types of an episode must be an array of integers .*, got \[\[\[0\]\]\]"),
    ],
)
@pytest.mark.unchecked
def test_what_no_reader_takes_does_not_replace_a_store(changes: dict[str, Any], message: str, tmp_path: Path):
    write_store(tmp_path / "store", INFO, [episode(7)])
    with pytest.raises(UserError, match=message):
        write_store(tmp_path / "store", INFO, [replace(episode(1), **changes)], overwrite=True)
    assert_equal(read_store(tmp_path / "store").episodes[0], episode(7))


def test_provenance_that_no_reader_takes_does_not_replace_a_store(tmp_path: Path):
    write_store(tmp_path / "store", INFO, [episode(7)])
    entropy = replace(INFO, provenance={"entropy": 2**127})
    with pytest.raises(UserError, match=r"store.*: integers have at most 19 digits .*; nothing was written"):
        write_store(tmp_path / "store", entropy, [episode(1)], overwrite=True)
    assert_equal(read_store(tmp_path / "store").episodes[0], episode(7))
    assert [path.name for path in tmp_path.iterdir()] == ["store"]


@pytest.mark.parametrize(
    ("name", "kind", "read"),
    [
        ("edge_types", np.uint8, np.int16),
        ("edge_types", np.int8, np.int8),
        ("edge_attributes", np.float16, np.float32),
        ("causal_shift_m", np.float16, np.float32),
        ("causal_shift_m", np.float64, np.float64),
    ],
)
def test_labels_of_types_that_stores_do_not_have_are_converted(name: str, kind: type, read: type, tmp_path: Path):
    labels = np.ones((1, 3, 3, *((1,) if name == "edge_attributes" else ())), kind)
    write_store(tmp_path / "store", INFO, [replace(episode(1), **{name: labels})])
    found = getattr(read_store(tmp_path / "store").episodes[0], name)
    assert found.dtype == read and (found == 1).all()


@pytest.mark.parametrize("name", ["d", "s", "c", "ids", "states", "data"])
def test_a_relative_folder_with_a_short_name_is_read(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Zarr cut letters out of the names of its arrays."""
    monkeypatch.chdir(tmp_path)
    write_store(Path(name), INFO, [episode(1)])
    assert_equal(read_store(Path(name)).episodes[0], episode(1))
