import re
import shutil
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from predictor.data import partial_store
from predictor.data.partial_store import SETTINGS, PartialStore, beside
from predictor.data.store import Episode, StoreInfo, read_store, write_store
from predictor.support.errors import UserError
from predictor.support.files import write_json
from tests.predictor.helpers import circling_episode, spec

INFO = StoreInfo(spec(), "circle")
SETTINGS_A = {"seed": 0, "env_id": "circle"}


def episodes(count: int = 5) -> list[Episode]:
    return [circling_episode(steps=6 + i, seed=i) for i in range(count)]


def stopped(path: Path, upto: int, first: int = 0, part_s: float = 0.0) -> None:
    """Records some episodes and is stopped then."""
    with pytest.raises(KeyboardInterrupt), PartialStore(path, SETTINGS_A, part_s=part_s) as partial:
        assert partial.num_done == first
        for episode in episodes()[first:upto]:
            partial.add(INFO, episode)
        raise KeyboardInterrupt


@pytest.mark.parametrize("part_s", [0.0, 1e6])
def test_a_recording_that_was_stopped_twice_equals_one_that_was_not(tmp_path: Path, part_s: float):
    stopped(tmp_path / "store", 2, part_s=part_s)
    assert [p.name for p in tmp_path.iterdir()] == [".store.unfinished"]
    stopped(tmp_path / "store", 3, first=2, part_s=part_s)
    with PartialStore(tmp_path / "store", SETTINGS_A) as partial:
        assert partial.num_done == 3
        for episode in episodes()[3:]:
            partial.add(INFO, episode)
        assert len(partial.finish(INFO)) == 5
    write_store(tmp_path / "whole", INFO, episodes())
    assert sorted(p.name for p in tmp_path.iterdir()) == ["store", "whole"]
    ours, whole = (read_store(tmp_path / name).episodes for name in ("store", "whole"))
    for found, expected in zip(ours, whole, strict=True):
        assert (found.seed, found.label) == (expected.seed, expected.label)
        for name in ("states", "valid", "ids"):
            np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))


def test_a_signal_while_a_part_is_written_waits_until_it_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Else the part was written again on the way out, which the one that is there refused."""
    written = partial_store.write_store

    def interrupted(*arguments: Any) -> None:
        written(*arguments)
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(partial_store, "write_store", interrupted)
    with pytest.raises(KeyboardInterrupt), PartialStore(tmp_path / "store", SETTINGS_A, part_s=0.0) as partial:
        partial.add(INFO, episodes()[0])
    monkeypatch.undo()
    assert PartialStore(tmp_path / "store", SETTINGS_A).num_done == 1


def test_a_short_recording_leaves_no_parts(tmp_path: Path):
    with PartialStore(tmp_path / "store", SETTINGS_A) as partial:
        for episode in episodes():
            partial.add(INFO, episode)
        assert list(tmp_path.iterdir()) == []
        partial.finish(INFO)
    assert [p.name for p in tmp_path.iterdir()] == ["store"]


def test_parts_with_other_settings_are_named_or_discarded(tmp_path: Path):
    stopped(tmp_path / "store", 2)
    with pytest.raises(UserError, match="unfinished recording that differs in seed; repeat its command to go on"):
        PartialStore(tmp_path / "store", {**SETTINGS_A, "seed": 1})
    versions = {"versions": {"numpy": "2"}}
    for found, differs in (
        ({"numpy": "2"}, "versions"),
        (versions, "versions (torch, numpy)"),
        ({}, "settings that cannot"),
    ):
        write_json(tmp_path / ".store.unfinished" / SETTINGS, found)
        with pytest.raises(UserError, match=re.escape(f"differs in {differs}")):
            PartialStore(tmp_path / "store", {"versions": {"torch": "3"}})
    write_json(tmp_path / ".store.unfinished" / SETTINGS, SETTINGS_A)
    assert PartialStore(tmp_path / "store", SETTINGS_A, discard=True).num_done == 2
    assert PartialStore(tmp_path / "store", {**SETTINGS_A, "seed": 1}, discard=True).num_done == 0
    assert list(tmp_path.iterdir()) == []


def test_an_unfinished_part_does_not_count(tmp_path: Path):
    stopped(tmp_path / "store", 2)
    folder = tmp_path / ".store.unfinished"
    (folder / ".00000002+3.abc.partial").mkdir()
    assert PartialStore(tmp_path / "store", SETTINGS_A).num_done == 2
    assert sorted(p.name for p in folder.iterdir()) == ["00000000+1", "00000001+1", SETTINGS]


def test_what_a_kill_while_parts_are_deleted_leaves_is_no_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Else the parts that are left would be taken for the first ones."""
    stopped(tmp_path / "store", 3)

    delete = shutil.rmtree

    def killed(folder: Path, **options: Any) -> None:
        if "unfinished" not in Path(folder).name:
            return delete(folder, **options)
        delete(folder / "00000000+1")
        raise KeyboardInterrupt

    monkeypatch.setattr(shutil, "rmtree", killed)
    with pytest.raises(KeyboardInterrupt), PartialStore(tmp_path / "store", SETTINGS_A) as partial:
        partial.finish(INFO)
    monkeypatch.undo()
    assert len(read_store(tmp_path / "store").episodes) == 3
    assert PartialStore(tmp_path / "store", SETTINGS_A).num_done == 0
    assert [p.name for p in tmp_path.iterdir()] == ["store"]


def test_a_recording_begins_anew_if_the_disk_was_full_before_its_first_part(tmp_path: Path):
    (tmp_path / ".store.unfinished").mkdir()
    assert PartialStore(tmp_path / "store", SETTINGS_A).num_done == 0
    assert list(tmp_path.iterdir()) == []


def test_unfinished_files_of_other_stores_stay(tmp_path: Path):
    names = [".store.0123abcd.partial", ".store.b.0123abcd.partial", ".other.0123abcd.partial"]
    for name in names:
        (tmp_path / name).mkdir()
    PartialStore(tmp_path / "store", SETTINGS_A)
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(names[1:])


@pytest.mark.parametrize("part_s", [0.0, 1e6])
def test_skipped_seeds_at_the_end_of_a_stopped_recording_are_kept(tmp_path: Path, part_s: float):
    """Each may have cost the whole time that a seed is given."""
    first, *_ = episodes()
    with pytest.raises(KeyboardInterrupt), PartialStore(tmp_path / "store", SETTINGS_A, part_s=part_s) as partial:
        partial.skip(0, "it hangs")
        partial.add(INFO, first)
        partial.skip(2, "it dies")
        partial.skip(3, "it hangs")
        raise KeyboardInterrupt
    with PartialStore(tmp_path / "store", SETTINGS_A) as partial:
        assert partial.num_done == 4 and partial.skipped == {0: "it hangs", 2: "it dies", 3: "it hangs"}
        assert len(partial.finish(INFO)) == 1
    assert read_store(tmp_path / "store").info.provenance["skipped"]["episodes"] == 3


def test_a_seed_was_skipped_only_if_its_part_is_there(tmp_path: Path):
    """The episode of a seed that failed by chance may be recorded by the next attempt."""
    first, second, *_ = episodes()
    with pytest.raises(KeyboardInterrupt), PartialStore(tmp_path / "store", SETTINGS_A, part_s=1e6) as partial:
        partial.skip(0, "it hangs")
        partial.add(INFO, second)
        raise KeyboardInterrupt
    assert PartialStore(tmp_path / "store", SETTINGS_A).skipped == {0: "it hangs"}
    shutil.rmtree(tmp_path / ".store.unfinished" / "00000000+2")  # as after a kill before the part was written
    with PartialStore(tmp_path / "store", SETTINGS_A) as partial:
        assert partial.num_done == 0 and partial.skipped == {}
        partial.add(INFO, first, second)
        partial.finish(INFO)
    assert "skipped" not in read_store(tmp_path / "store").info.provenance


def test_stores_at_different_addresses_have_parts_of_their_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    one, other = (Path(f"memory://{place}/store") for place in ("a", "b"))
    stopped(one, 2)
    assert PartialStore(other, SETTINGS_A).num_done == 0
    assert PartialStore(one, SETTINGS_A).num_done == 2
    assert beside(one) != beside(other) and beside(tmp_path / "store") == tmp_path / "store"


def test_a_step_of_the_recording_may_bring_several_episodes_or_none(tmp_path: Path):
    first, second, third, *_ = episodes()
    with pytest.raises(KeyboardInterrupt), PartialStore(tmp_path / "store", SETTINGS_A, part_s=1e6) as partial:
        partial.add(INFO, first, second)
        partial.add(INFO)
        raise KeyboardInterrupt
    with PartialStore(tmp_path / "store", SETTINGS_A) as partial:
        assert partial.num_done == 2
        partial.add(INFO, third)
        assert [len(e.states) for e in partial.finish(INFO)] == [6, 7, 8]


def test_a_recording_without_any_episode_says_why(tmp_path: Path):
    with PartialStore(tmp_path / "store", SETTINGS_A) as partial:
        partial.add(INFO)
        with pytest.raises(UserError, match="no agent could be perturbed in any episode.*raise --max-steps"):
            partial.finish(INFO)
    assert list(tmp_path.iterdir()) == []


def test_a_recording_without_any_episode_says_what_failed_and_what_had_nobody(tmp_path: Path):
    with (
        pytest.raises(UserError, match="1 of 3 episodes failed, the first so: it hangs; in the others .* --max-steps"),
        PartialStore(tmp_path / "store", SETTINGS_A, part_s=0.0) as partial,
    ):
        partial.add(INFO)
        partial.skip(1, "it hangs")
        partial.add(INFO)
        partial.finish(INFO)
    assert list(tmp_path.iterdir()) == []


def test_a_recording_of_which_all_seeds_were_skipped_keeps_nothing(tmp_path: Path):
    """The next attempt plays them, perhaps in an environment that was mended."""
    with (
        pytest.raises(UserError, match="all 2 episodes failed, the first so: it hangs"),
        PartialStore(tmp_path / "store", SETTINGS_A, part_s=0.0) as partial,
    ):
        partial.skip(0, "it hangs")
        partial.skip(1, "it dies")
        partial.finish(INFO)
    assert list(tmp_path.iterdir()) == []
