"""Overlaid scenes: as many agents as asked for, each moving as recorded."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from predictor.data.crowd import CrowdConfig, main, make_crowds, overlay
from predictor.data.store import Episode, StoreInfo, read_store, write_store
from predictor.support.errors import UserError
from tests.predictor.helpers import circling_episode, spec


def store(tmp_path: Path, episodes: list[Episode], has_ego: bool = False) -> Path:
    write_store(tmp_path / "scenes", StoreInfo(spec(has_ego=has_ego), "scenes"), episodes)
    return tmp_path / "scenes"


def config(source: Path, **changes: object) -> CrowdConfig:
    small = CrowdConfig(source, source.with_name("crowd"), num_agents=(2, 7), episodes=2, episode_steps=10, at_step=7)
    return replace(small, **changes)  # type: ignore[arg-type]


def test_crowds_hold_at_least_as_many_agents_as_wanted(tmp_path: Path):
    crowds = make_crowds(config(store(tmp_path, [circling_episode(i, agents=2) for i in range(3)])))
    assert [int(c.valid[7].sum()) for c in crowds] == [2, 2, 8, 8]
    assert all(len(np.unique(c.ids)) == c.states.shape[1] for c in crowds)


def test_a_crowd_has_the_steps_that_were_asked_for_and_a_store_room_for_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    source = store(tmp_path, [circling_episode(i, steps=14, agents=2) for i in range(3)])
    out = tmp_path / "crowd"
    sizes = ("--num-agents", 30, "--episodes", 2, "--episode-steps", 10, "--at-step", 7)
    words = ("--source", source, "--out", out, *sizes)
    monkeypatch.setattr("sys.argv", ["crowd", *map(str, words)])
    main()
    crowds = read_store(out)
    assert [len(e.states) for e in crowds.episodes] == [10, 10]
    assert crowds.info.spec.max_agents == max(int(e.valid.sum(axis=1).max()) for e in crowds.episodes) == 30


def test_all_agents_move_as_recorded_and_scenes_share_a_centre():
    first, second = circling_episode(0, agents=2), circling_episode(1, agents=3)
    second.valid[:4, 1] = False
    crowd = overlay([first, second], 2, seed=5, steps=10)
    assert crowd.states.shape == (10, 5, 4) and crowd.valid[:4].sum() == 4 * 4
    for part, recorded in ((crowd.states[:, :2], first), (crowd.states[:, 2:], second)):
        np.testing.assert_array_equal(part[..., 2:][recorded.valid], recorded.states[..., 2:][recorded.valid])
        moved = (recorded.states[..., :2] - part[..., :2])[recorded.valid]
        np.testing.assert_allclose(moved, np.broadcast_to(moved[0], moved.shape), atol=1e-5)
        np.testing.assert_allclose(part[..., :2][recorded.valid].mean(0), 0.0, atol=1e-5)
    assert not crowd.states[:4, 3].any()  # absent agents hold zeros


def test_no_scene_lies_upon_itself_before_all_are_in(tmp_path: Path):
    scenes = [circling_episode(seed, agents=2) for seed in range(6)]
    for crowd in make_crowds(config(store(tmp_path / "scenes", scenes), num_agents=(12,), episodes=4)):
        now = crowd.states[0, :, :2]
        apart = np.linalg.norm(now[:, None] - now[None], axis=-1)[~np.eye(len(now), dtype=bool)]
        assert len(now) == 12 and apart.min() > 1e-6


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"num_agents": (3, 0)}, r"num_agents must be at least 1, got \(3, 0\)"),
        ({"at_step": 10}, "at_step must lie between 0 and 9, got 10"),
        ({"num_agents": (3, 70_000)}, r"num_agents must be at most 65,536, got \(3, 70000\)"),
    ],
)
def test_refused(tmp_path: Path, changes: dict[str, object], message: str):
    with pytest.raises(UserError, match=message):
        config(tmp_path / "scenes", **changes)


def test_scenes_with_an_ego_or_too_short_ones_are_refused(tmp_path: Path):
    with pytest.raises(UserError, match="has an ego, and an episode has at most one"):
        make_crowds(config(store(tmp_path / "a", [circling_episode(0)], has_ego=True)))
    with pytest.raises(UserError, match="no episode has 10 steps and an agent at step 7"):
        make_crowds(config(store(tmp_path / "b", [circling_episode(0, steps=6)])))


def test_a_store_that_exists_is_said_before_any_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    source = store(tmp_path, [circling_episode(0, agents=2)])
    monkeypatch.setattr("predictor.data.crowd.make_crowds", lambda _: pytest.fail("no crowd is made yet"))
    monkeypatch.setattr("sys.argv", ["crowd", "--source", str(source), "--out", str(source)])
    with pytest.raises(UserError, match="scenes exists; choose another path or pass --overwrite"):
        main()
