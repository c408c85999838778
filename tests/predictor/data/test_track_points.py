from collections import Counter

import numpy as np
import pytest

from predictor.data.track_points import TrackPoints, cut_episodes, with_velocities
from predictor.support.errors import UserError


def points(*entries: tuple[int, int, float]) -> TrackPoints:
    """From (step, track, x); y is 10 x."""
    steps, tracks, x = (np.array(column) for column in zip(*entries, strict=True))
    return TrackPoints(
        steps.astype(np.int64), tracks.astype(np.int64), np.stack([x, 10 * x], axis=-1).astype(np.float64)
    )


def test_velocities_look_back_and_gaps_have_none():
    given = points((3, 7, 1.0), (4, 7, 1.5), (6, 7, 9.0), (7, 7, 8.0), (5, 2, 0.0), (4, 2, 1.0))
    kept, velocities_mps, origin = with_velocities(given, 0.5)
    assert kept.tracks.tolist() == [2, 7, 7]
    assert kept.steps.tolist() == [5, 4, 7]
    np.testing.assert_allclose(velocities_mps, [[-2.0, -20.0], [1.0, 10.0], [-2.0, -20.0]])
    assert origin.tolist() == [4, 1, 3]
    np.testing.assert_array_equal(kept.states, given.states[origin])


def test_a_recording_without_consecutive_points_gives_nothing():
    kept, velocities_mps, origin = with_velocities(points((0, 1, 0.0), (0, 2, 0.0), (2, 1, 0.0)), 0.1)
    assert (len(kept), velocities_mps.shape, origin.tolist()) == (0, (0, 2), [])


def test_an_episode_that_cannot_fit_into_the_memory_is_refused(monkeypatch: pytest.MonkeyPatch):
    """A recording that is kept whole has a column for each track at each of its steps."""
    monkeypatch.setattr("predictor.support.memory.memory_bytes", lambda: 2**20)
    given = points(*((100 * track, track, 1.0) for track in range(400)))
    with pytest.raises(UserError, match=r"^here: an episode of 39,901 steps with 400 tracks needs .* --episode-steps"):
        cut_episodes(given, 39_901, "here", Counter())
    assert cut_episodes(given, 50, "here", Counter())


def test_episodes_tile_a_recording():
    counts: Counter[str] = Counter()
    # Steps 10–18 in episodes of 4: 10–13, 14–17 (empty), 18–21 of which only 18 and 19 exist.
    given = points((10, 5, 1.0), (12, 5, 2.0), (12, 3, 3.0), (18, 9, 4.0), (19, 9, 5.0))
    first, last = cut_episodes(given, 4, "here", counts)
    assert (first.ids.tolist(), last.ids.tolist()) == ([3, 5], [9])
    assert first.valid.tolist() == [[False, True], [False, False], [True, True], [False, False]]
    assert first.states[2].tolist() == [[3.0, 30.0], [2.0, 20.0]]
    assert first.states[~first.valid].tolist() == [[0.0, 0.0]] * 5
    assert first.states.dtype == np.float32
    assert last.states[:, 0, 0].tolist() == [4.0, 5.0]
    assert (first.label, last.label) == ("here", "here")
    assert counts == {"episodes left out: no agent": 1}


def test_the_order_of_points_does_not_matter():
    rng = np.random.default_rng(0)
    present = np.argwhere(rng.random((40, 6)) < 0.5)
    given = TrackPoints(present[:, 0] - 9, present[:, 1], rng.normal(size=(len(present), 2)))
    order = rng.permutation(len(given))
    shuffled = TrackPoints(given.steps[order], given.tracks[order], given.states[order])
    pairs = zip(*(cut_episodes(each, 7, "here", Counter()) for each in (given, shuffled)), strict=True)
    for one, other in pairs:
        for name in ("states", "valid", "ids"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


@pytest.mark.parametrize("steps", [3, 4, 5])
def test_every_point_is_in_one_episode(steps: int):
    rng = np.random.default_rng(steps)
    present = np.argwhere(rng.random((40, 6)) < 0.3)
    given = points(*((int(step), int(track), float(step + track)) for step, track in present))
    found = cut_episodes(given, steps, "", Counter())
    assert all(len(episode.states) <= steps for episode in found)
    lost = len(given) - sum(int(episode.valid.sum()) for episode in found)
    assert lost <= 6  # a last episode of one step
    assert sum(episode.states[episode.valid][:, 0].sum() for episode in found) <= given.states[:, 0].sum()


def test_an_episode_of_one_step_is_counted():
    counts: Counter[str] = Counter()
    assert len(cut_episodes(points((0, 1, 0.0), (1, 1, 0.0), (2, 1, 0.0)), 2, "", counts)) == 1
    assert counts == {"episodes left out: one step": 1}


def test_nothing_gives_nothing():
    empty = TrackPoints(np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64), np.zeros((0, 2)))
    assert cut_episodes(empty, 5, "", Counter()) == []
