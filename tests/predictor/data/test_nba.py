import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from predictor.data import nba
from predictor.data.loading import split_of
from tests.predictor.data.helpers import Loader, change_line, possession

PLAYERS = [11, 12, 13, 14, 15, 3, 1004, 1005, 1006, 1007]
"""Two teams; the second's ids are both below and above the first's."""
FOOT_M = 0.3048


def feet(entity: int, t: float) -> tuple[float, float]:
    """The ball (-1) rolls from the middle along x, 1 foot per step; players on parallel lines move slowly along y."""
    if entity == -1:
        return 47.0 + t, 25.0
    place = PLAYERS.index(entity)
    return 10.0 + place, 20.0 + 0.5 * t


def score(frames: int) -> str:
    """A possession in the text layout."""
    return possession(frames, PLAYERS, feet)


@pytest.fixture
def loader(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Loader:
    return Loader(nba.main, tmp_path / "out", monkeypatch, capsys)


@pytest.fixture
def possessions(tmp_path: Path) -> Path:
    folder = tmp_path / "train"
    folder.mkdir()
    (folder / "ATL_BKN_1_1_60.0_50.0.txt").write_text(score(9))
    return folder


def assert_rolls(states: np.ndarray, first_step: int) -> None:
    """The states of steps `first_step`, `first_step` + 1, … of the play that `feet` describes."""
    t = first_step + np.arange(len(states))
    np.testing.assert_allclose(states[:, 0, 0], t * FOOT_M, atol=1e-5)
    np.testing.assert_allclose(states[:, 0, 1], 0.0, atol=1e-5)
    np.testing.assert_allclose(states[:, 0, 2], FOOT_M / 0.12, rtol=1e-4)
    np.testing.assert_allclose(states[:, 1, 0], (10 - 47) * FOOT_M, rtol=1e-5)
    np.testing.assert_allclose(states[:, 1, 1], (-5 + 0.5 * t) * FOOT_M, atol=1e-5)
    np.testing.assert_allclose(states[:, 1:, 3], 0.5 * FOOT_M / 0.12, rtol=1e-4)
    np.testing.assert_array_equal(states[..., 4], np.eye(1, 11).repeat(len(states), axis=0))


# --- Text layout ------------------------------------------------------------------------------------------------------


def test_windows_tile_a_possession(possessions: Path, loader: Loader):
    store = loader.load(possessions, "--episode-steps", 4)
    spec = store.info.spec
    assert (spec.dt_s, spec.max_agents, spec.has_ego, spec.frame) == (0.12, 11, False, ("world", "world"))
    assert spec.feature_names == ("x_m", "y_m", "vx_mps", "vy_mps", "is_ball")
    assert [len(e.states) for e in store.episodes] == [4, 4]  # nine frames give eight velocities
    assert [e.seed for e in store.episodes] == [0, 1]
    for begin, episode in zip((1, 5), store.episodes, strict=True):
        assert episode.ids.tolist() == [0, *PLAYERS]
        assert episode.label == "ATL_BKN_1_1_60.0_50.0"
        assert episode.valid.all()
        assert_rolls(episode.states, begin)


def test_rests_and_short_possessions_are_counted(possessions: Path, loader: Loader):
    (possessions / "ATL_BKN_1_1_40.0_39.0.txt").write_text(score(5))
    store = loader.load(possessions, "--episode-steps", 5)
    assert len(store.episodes) == 1
    assert "| files | 2 |" in loader.card
    assert "| games | 1 |" in loader.card
    assert "| passages skipped, shorter than 5 steps | 1 |" in loader.card
    assert "| steps dropped at the end of passages | 7 |" in loader.card  # 3 of 8, 4 of 4


def test_possessions_can_be_kept_whole(possessions: Path, loader: Loader):
    for quarter, frames in ((2, 5), (3, 3), (4, 2), (5, 1)):
        (possessions / f"ATL_BKN_1_{quarter}_60.0_50.0.txt").write_text(score(frames))
    store = loader.load(possessions, "--episode-steps", 0)
    assert [len(e.states) for e in store.episodes] == [8, 4, 2]  # one less than frames; a single step is no episode
    for episode in store.episodes:
        assert episode.valid.all() and episode.ids.tolist() == [0, *PLAYERS]
        assert_rolls(episode.states, 1)
    assert "| passages skipped, shorter than 2 steps | 2 |" in loader.card
    assert "| steps dropped at the end of passages | 1 |" in loader.card
    assert "* Each passage is one episode, of all its steps." in loader.card


def test_only_short_possessions_are_an_error(possessions: Path, loader: Loader):
    loader.refuses(possessions, f"{possessions} gives no episode for split 'all'; files: 1")


def test_games_are_not_divided(possessions: Path, loader: Loader):
    for game in range(40):
        for quarter in (1, 2):
            (possessions / f"ATL_BKN_{game}_{quarter}_60.0_50.0.txt").write_text(score(5))
    seen: list[str] = []
    for split in ("train", "val", "test"):
        episodes = loader.load(possessions, "--split", split, "--episode-steps", 4, "--overwrite").episodes
        games = {"_".join(e.label.split("_")[:3]) for e in episodes}
        assert all(split_of(game, nba.SPLIT_SEED) == split for game in games)
        seen += games
    assert sorted(seen) == sorted({f"ATL_BKN_{game}" for game in range(40)})
    whole = loader.load(possessions, "--episode-steps", 4, "--overwrite")
    labels = [e.label for e in whole.episodes]
    number = dict(zip(labels, whole.info.provenance["recordings"], strict=True))
    assert len(set(number.values())) == len({"_".join(label.split("_")[:3]) for label in labels})
    assert number["ATL_BKN_7_1_60.0_50.0"] == number["ATL_BKN_7_2_60.0_50.0"] != number["ATL_BKN_8_1_60.0_50.0"]


# Line 4 is the ball of frame 0; frame 12 begins at line 12.
SCORE_ERRORS = {
    "columns": (2, "0 12 1 2", 2, "expected frame, id, x, y, kind, got 4 columns"),
    "kind": (2, "0 12 1 2 COACH", 2, "kind must be BALL or PLAYER, got 'COACH'"),
    "nan": (2, "0 12 nan 2 PLAYER", 2, "x must be a finite number, got 'nan'"),
    "text": (2, "0 12 1 two PLAYER", 2, "y must be a finite number, got 'two'"),
    "id": (2, "0 x 1 2 PLAYER", 2, "id must be a whole number, got 'x'"),
    "id of the ball": (2, "0 0 1 2 PLAYER", 2, "id must be at least 1, got 0"),
    "frame": (2, "0.5 12 1 2 PLAYER", 2, "frame must be a whole number, got '0.5'"),
    "twice": (2, "0 11 1 2 PLAYER", 2, "PLAYER 11 appears twice in frame 0"),
    "two balls": (2, "0 -2 1 2 BALL", 11, "frame 0 must hold 1 ball and 10 players, got 2 and 9"),
    "no ball": (4, "0 99 1 2 PLAYER", 11, "frame 0 must hold 1 ball and 10 players, got 0 and 11"),
    "missing player": (2, None, 10, "frame 0 must hold 1 ball and 10 players, got 1 and 9"),
    "unknown id": (13, "12 99 1 2 PLAYER", 22, "frame 12 holds ids that the first frame does not: [99]"),
}


@pytest.mark.parametrize("case", SCORE_ERRORS)
def test_broken_possessions_are_one_line(case: str, possessions: Path, loader: Loader):
    changed, text, line, message = SCORE_ERRORS[case]
    (path,) = possessions.iterdir()
    change_line(path, changed, text)
    loader.refuses(possessions, f"{path}, line {line}: {message}", "--episode-steps", 4)


def test_a_gap_is_one_line(possessions: Path, loader: Loader):
    (path,) = possessions.iterdir()
    lines = path.read_text().splitlines()
    path.write_text("\n".join(lines[:11] + lines[22:]))
    loader.refuses(possessions, f"{path}, line 12: frames must be 12 apart: expected 12, got 24")
    path.write_text("\n".join(lines[:15]))
    loader.refuses(possessions, f"{path}, line 15: frame 12 must hold 1 ball and 10 players, got 1 and 3")
    path.write_text("\n\n")
    loader.refuses(possessions, f"{path} holds no frame")


def test_broken_files_can_be_left_out(possessions: Path, loader: Loader):
    (possessions / "BOS_MIA_2_1_60.0_50.0.txt").write_text(score(9).replace("PLAYER", "COACH", 1))
    store = loader.load(possessions, "--skip-broken", "--episode-steps", 4)
    assert {e.label for e in store.episodes} == {"ATL_BKN_1_1_60.0_50.0"}
    assert "| broken files left out | 1 |" in loader.card


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--episode-steps", 1), "episode_steps must be 0 or at least 2, got 1"),
        (("--episode-steps", -1), "episode_steps must not be negative, got -1"),
        (("--format", "sportvu"), "{source} holds no files of format 'sportvu' (*.json)"),
    ],
)
def test_values_that_make_no_sense(possessions: Path, loader: Loader, words: tuple[object, ...], message: str):
    loader.refuses(possessions, message.format(source=possessions), *words)


# --- SportVU ----------------------------------------------------------------------------------------------------------


def moment(t: int, late_ms: int = 0, quarter: int = 1, players: list[int] = PLAYERS) -> list[Any]:
    """Moment number `t` (40 ms each) of the play that `feet` describes, three times slower than in the text layout."""
    points = [[-1, -1, *feet(-1, t / 3), 5.0]]
    points += [[100 + (i < 5), player, *feet(PLAYERS[i], t / 3), 0.0] for i, player in enumerate(players)]
    return [quarter, 1_450_000_000_000 + 40 * t + late_ms, 700.0, 20.0, None, points]


def game(*events: list[Any]) -> str:
    return json.dumps({"gameid": "1", "events": [{"eventId": str(i), "moments": m} for i, m in enumerate(events)]})


@pytest.fixture
def games(tmp_path: Path) -> Path:
    folder = tmp_path / "games"
    folder.mkdir()
    return folder


def test_sportvu_is_thinned_and_sorted(games: Path, loader: Loader):
    (games / "0021500001.json").write_text(game([moment(t) for t in range(25)]))
    store = loader.load(games, "--format", "sportvu", "--episode-steps", 4)
    assert [len(e.states) for e in store.episodes] == [4, 4]  # 25 moments, 9 kept, 8 velocities
    for begin, episode in zip((1, 5), store.episodes, strict=True):
        # Team 100 (the second five) stands before team 101; ids ascend in each.
        assert episode.ids.tolist() == [0, *sorted(PLAYERS[5:]), *sorted(PLAYERS[:5])]
        assert episode.label == "0021500001/0"
        back = [0, *(1 + episode.ids[1:].tolist().index(player) for player in PLAYERS)]
        assert_rolls(episode.states[:, back], begin)


def test_events_overlap_and_play_is_interrupted(games: Path, loader: Loader):
    first = [moment(t, late_ms=t % 2) for t in range(10)]  # the clock is a little uneven
    again = [moment(t, late_ms=t % 2) for t in range(5, 13)]  # moments 5–9 were in the first event
    later = [moment(t) for t in range(20, 33)]  # after a gap
    ten = moment(33)
    ten[5] = ten[5][:-1]
    substituted = [moment(t, players=[99, *PLAYERS[1:]]) for t in range(34, 47)]
    next_quarter = [moment(t, quarter=2, players=[99, *PLAYERS[1:]]) for t in range(47, 60)]
    (games / "7.json").write_text(game(first, again, [], [*later, ten, *substituted], next_quarter))
    store = loader.load(games, "--format", "sportvu", "--episode-steps", 4)
    # 13 moments in each passage, 5 kept, 4 velocities.
    assert [e.label for e in store.episodes] == ["7/0", "7/1", "7/2", "7/3"]
    assert store.info.provenance["recordings"] == [0] * 4
    for line in (
        "| moments read | 58 |",
        "| moments without 1 ball and 10 players | 1 |",
        "| moments repeated by a later event | 5 |",
        "| passages without interruption | 4 |",
    ):
        assert line in loader.card
    assert [99 in e.ids for e in store.episodes] == [False, False, True, True]
    np.testing.assert_allclose(store.episodes[1].states[:, 0, 0], (20 / 3 + np.arange(1, 5)) * FOOT_M, rtol=1e-5)


def test_a_substitution_ends_a_passage(games: Path, loader: Loader):
    moments = [moment(t, players=PLAYERS if t < 13 else [99, *PLAYERS[1:]]) for t in range(26)]
    (games / "7.json").write_text(game(moments))
    first, second = loader.load(games, "--format", "sportvu", "--episode-steps", 4).episodes
    assert (11 in first.ids, 99 in first.ids) == (True, False)
    assert (11 in second.ids, 99 in second.ids) == (False, True)


def test_a_late_moment_ends_a_passage_and_an_uneven_one_does_not(games: Path, loader: Loader):
    path = games / "7.json"
    for late_ms, passages in ((15, 1), (16, 2)):
        path.write_text(game([moment(t, late_ms if t >= 7 else 0) for t in range(14)]))
        loader.load(games, "--format", "sportvu", "--episode-steps", 2, "--overwrite")
        assert f"| passages without interruption | {passages} |" in loader.card


def broken_moment(change: Any) -> str:
    content = json.loads(game([moment(0), moment(1)], [moment(2)]))
    change(content["events"][0]["moments"][1])
    return json.dumps(content, indent=0)


def set_to(point: int, column: int, value: Any) -> Any:
    def change(values: list[Any]) -> None:
        values[5][point][column] = value

    return change


SPORTVU_ERRORS = {
    "text": ("not json", ", line 1: no JSON (Expecting value)"),
    "cut off": (game([moment(0)])[:-5].replace('"moments"', '\n"moments"'), ", line 2: no JSON"),
    "a list": ("[]", ", line 1: expected an object with a list 'events'"),
    "no moments": (json.dumps({"events": [{}]}), ", events[0]: expected a list 'moments'"),
    "nan": (broken_moment(set_to(2, 2, float("nan"))), ": numbers must be finite, got nan"),
    "too large": (game([moment(0)]).replace("47.0", "1e999"), ": numbers must be finite, got inf"),
    "word": (broken_moment(set_to(2, 2, "x")), ", events[0].moments[1]: expected [quarter, ms, clock,"),
    "null": (broken_moment(set_to(2, 2, None)), ", events[0].moments[1]: expected [quarter, ms, clock,"),
    "short point": (broken_moment(lambda m: m[5][3].__delitem__(slice(2, 5))), ", events[0].moments[1]: expected ["),
    "no points": (broken_moment(lambda m: m.pop()), ", events[0].moments[1]: expected [quarter, ms, clock,"),
    "half an id": (broken_moment(set_to(2, 1, 100.5)), ", events[0].moments[1]: expected [quarter, ms, clock,"),
    "both teams": (
        broken_moment(lambda m: m[5].append([2, *m[5][1][1:]])),
        ", events[0].moments[1]: a player is in both teams",
    ),
    "id": (broken_moment(set_to(2, 1, 0)), ", events[0].moments[1]: ids of players must be positive"),
}


@pytest.mark.parametrize("case", SPORTVU_ERRORS)
def test_broken_games_are_one_line(case: str, games: Path, loader: Loader):
    text, message = SPORTVU_ERRORS[case]
    path = games / "7.json"
    path.write_text(text)
    loader.refuses(games, f"{path}{message}", "--format", "sportvu")


def test_broken_games_can_be_left_out(games: Path, loader: Loader):
    (games / "7.json").write_text("{")
    (games / "8.json").write_text(game([moment(t) for t in range(13)]))
    arguments = ("--format", "sportvu", "--skip-broken", "--episode-steps", 4)
    assert [e.label for e in loader.load(games, *arguments).episodes] == ["8/0"]
    assert "| broken files left out | 1 |" in loader.card


def test_a_game_without_moments_is_no_error_of_its_own(games: Path, loader: Loader):
    (games / "7.json").write_text(game([], [moment(0)]))
    (games / "8.json").write_text(game())
    loader.refuses(games, f"{games} gives no episode for split 'all'; files: 2", "--format", "sportvu")
