from pathlib import Path

import numpy as np
import pytest

from predictor.data.partial_store import SETTINGS, PartialStore
from predictor.data.store import Episode, StoreInfo, read_store, write_store
from predictor.support.errors import UserError
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


def test_a_short_recording_leaves_no_parts(tmp_path: Path):
    with PartialStore(tmp_path / "store", SETTINGS_A) as partial:
        for episode in episodes():
            partial.add(INFO, episode)
        assert list(tmp_path.iterdir()) == []
        partial.finish(INFO)
    assert [p.name for p in tmp_path.iterdir()] == ["store"]


def test_parts_with_other_settings_are_named_or_discarded(tmp_path: Path):
    stopped(tmp_path / "store", 2)
    with pytest.raises(UserError, match="unfinished recording with another seed; repeat its command to go on"):
        PartialStore(tmp_path / "store", {**SETTINGS_A, "seed": 1})
    assert PartialStore(tmp_path / "store", SETTINGS_A, discard=True).num_done == 2
    assert PartialStore(tmp_path / "store", {**SETTINGS_A, "seed": 1}, discard=True).num_done == 0
    assert list(tmp_path.iterdir()) == []


def test_an_unfinished_part_does_not_count(tmp_path: Path):
    stopped(tmp_path / "store", 2)
    folder = tmp_path / ".store.unfinished"
    (folder / ".00000002+3.abc.partial").mkdir()
    assert PartialStore(tmp_path / "store", SETTINGS_A).num_done == 2
    assert sorted(p.name for p in folder.iterdir()) == ["00000000+1", "00000001+1", SETTINGS]


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
