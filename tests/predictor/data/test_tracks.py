import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from predictor.data import tracks
from predictor.data.loading import split_of
from predictor.data.store import EpisodeStore, read_store
from tests.predictor.data.helpers import Loader, change_line

Row = tuple[float, ...]

WALK: list[Row] = [
    # Agent 4 walks along x, 2 units per step of 10 frames; agent 2 comes later, is away at frame 820, and returns.
    *((frame, 4, 100 + (frame - 780) / 5, 50) for frame in (780, 790, 800, 810)),
    *((frame, 2, 10, (frame - 780) / 10) for frame in (790, 800, 810, 830, 840)),
]
"""Lines of frame, id, x, y; in frame 820 there is no agent."""


def text_of(rows: Sequence[Row], separator: str = " ", form: str = "g") -> str:
    return "".join(separator.join(format(value, form) for value in row) + "\n" for row in rows)


@pytest.fixture
def source(tmp_path: Path) -> Path:
    folder = tmp_path / "eth"
    folder.mkdir()
    (folder / "walk.txt").write_text(text_of(WALK))
    return folder


@pytest.fixture
def walk(source: Path) -> Path:
    return source / "walk.txt"


@pytest.fixture
def loader(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Loader:
    return Loader(tracks.main, tmp_path / "out", monkeypatch, capsys)


def test_states_by_hand(source: Path, loader: Loader):
    store = loader.load(source, "--scale", 0.5)
    spec = store.info.spec
    assert (spec.dt_s, spec.frame, spec.has_ego, spec.max_agents) == (0.4, ("centroid",) * 2, False, 128)
    assert (spec.feature_names, spec.feature_scales) == (("x_m", "y_m", "vx_mps", "vy_mps"), (5.0, 5.0, 1.0, 1.0))
    assert store.info.source == "Tracks, eth"
    (episode,) = store.episodes
    assert (episode.label, episode.seed, episode.ids.tolist()) == ("walk", 0, [2, 4])
    # Steps 1–6 (frames 790–840). No velocity: agent 4 at 780, agent 2 at 790 and, after its absence, at 830.
    assert episode.valid.T.tolist() == [[False, True, True, False, False, True], [True] * 3 + [False] * 3]
    np.testing.assert_allclose(episode.states[0, 1], [51.0, 25.0, 1 / 0.4, 0.0], rtol=1e-6)
    np.testing.assert_allclose(episode.states[2, 1], [53.0, 25.0, 1 / 0.4, 0.0], rtol=1e-6)
    np.testing.assert_allclose(episode.states[5, 0], [5.0, 3.0, 0.0, 0.5 / 0.4], rtol=1e-6)
    assert not episode.states[~episode.valid].any()
    for line in (
        "| agents per step (min / median / max) | 0 / 1 / 2 |",
        "| steps without an agent | 2 |",
        "| lines read | 9 |",
        "| lines dropped: between steps | 0 |",
        "| lines dropped: no velocity (first of a track or after a gap) | 3 |",
        "* Columns 1, 2, 3, 4 are frame, id, x and y; one unit is 0.5 m.",
        "* A step is 0.4 s. Of each file, frames that are a multiple of 10 after the first one are kept.",
    ):
        assert line in loader.card


WRITTEN = {
    "tabs": text_of(WALK, "\t"),
    "many spaces": text_of(WALK, "   ").replace("\n", "  \n"),
    "commas": text_of(WALK, ","),
    "commas and spaces": text_of(WALK, " , "),
    "semicolons": text_of(WALK, ";"),
    "floats": text_of(WALK, " ", ".1f"),
    "exponents": text_of(WALK, " ", ".7e"),
    "any order": text_of(WALK[::-1]),
    "more columns": text_of([(*row, -7.0) for row in WALK]).replace(" -7", " PLAYER"),
    "a comma at the end": text_of(WALK, ",").replace("\n", ",\n"),
    "comments": "# frame id x y\n\n% more\n" + text_of(WALK).replace("\n", " # said\n\n"),
    "names": "frame,id,x,y\n" + text_of(WALK, ","),
    "quotes": '"' + text_of(WALK, '","').replace("\n", '"\n"').removesuffix('"'),
    "Windows": text_of(WALK).replace("\n", "\r\n"),
    "a byte order mark": "\ufeff" + text_of(WALK),
    "no last end of line": text_of(WALK).rstrip("\n"),
}


def assert_equal(found: EpisodeStore, expected: EpisodeStore) -> None:
    assert len(found.episodes) == len(expected.episodes)
    for one, other in zip(found.episodes, expected.episodes, strict=True):
        np.testing.assert_array_equal(one.states, other.states)
        np.testing.assert_array_equal(one.valid, other.valid)
        np.testing.assert_array_equal(one.ids, other.ids)


@pytest.mark.parametrize("case", WRITTEN)
def test_a_recording_may_be_written_in_many_ways(case: str, source: Path, walk: Path, loader: Loader):
    expected = loader.load(source)
    walk.write_bytes(WRITTEN[case].encode())
    assert_equal(loader.load(source, "--overwrite"), expected)
    assert "| lines read | 9 |" in loader.card
    assert ("| lines of names skipped | 1 |" in loader.card) == (case == "names")


def test_columns_are_chosen(source: Path, walk: Path, loader: Loader):
    """As in the original annotations of ETH: frame, id, x, height, y, velocities."""
    expected = loader.load(source)
    walk.write_text(text_of([(frame, i, x, 1.7, y, 0.25 * i, frame) for frame, i, x, y in WALK]))
    assert_equal(loader.load(source, "--overwrite", "--columns", 1, 2, 3, 5), expected)
    store = loader.load(source, "--overwrite", "--columns", 1, 2, 3, 5, "--extra-columns", 7, 6)
    assert store.info.spec.feature_names == ("x_m", "y_m", "vx_mps", "vy_mps", "column_7", "column_6")
    assert store.info.spec.feature_scales[4:] == (1.0, 1.0)
    (episode,), (plain,) = store.episodes, expected.episodes
    np.testing.assert_array_equal(episode.states[..., :4], plain.states)
    assert episode.states[:, 0, 4:].tolist() == [[0, 0], [800, 0.5], [810, 0.5], [0, 0], [0, 0], [840, 0.5]]
    assert episode.states[:3, 1, 4:].tolist() == [[790, 1], [800, 1], [810, 1]]


def test_frames_between_steps_are_dropped(source: Path, walk: Path, loader: Loader):
    with walk.open("a") as file:
        file.write("820 4 108 50\n")
    store = loader.load(source, "--frame-step", 20, "--dt-s", 0.8)
    assert store.info.spec.dt_s == 0.8
    # Frames 780, 800, 820, 840, 860: agent 2 is there at 800 and 840, which are two steps apart.
    (episode,) = store.episodes
    assert (episode.ids.tolist(), episode.valid.tolist()) == ([4], [[True], [True]])
    np.testing.assert_allclose(episode.states[0, 0], [104.0, 50.0, 4 / 0.8, 0.0], rtol=1e-6)
    assert "| lines dropped: between steps | 5 |" in loader.card


def test_recordings_are_cut_or_whole(source: Path, walk: Path, loader: Loader):
    walk.write_text(text_of([(10 * t, 1, t, 0) for t in range(60)]))
    episodes = loader.load(source, "--episode-steps", 25).episodes
    assert [len(e.states) for e in episodes] == [25, 25, 9]
    assert [e.seed for e in episodes] == [0, 1, 2]
    np.testing.assert_allclose(episodes[1].states[0, 0, 2], 1 / 0.4)  # the velocity looks back over the cut
    (whole,) = loader.load(source, "--overwrite", "--episode-steps", 0).episodes
    np.testing.assert_array_equal(whole.states, np.concatenate([e.states for e in episodes]))
    assert "* Each recording is one episode, from its first step with an agent to its last." in loader.card


def test_files_in_coordinates_of_a_map_keep_their_precision(source: Path, loader: Loader):
    rows = [(780 + 10 * t, 1, 691_234.56 + 0.013 * t, 5_334_001.07 - 0.02 * t) for t in range(6)]
    (source / "map.txt").write_text(text_of(rows, form=".3f"))
    moved, near = loader.load(source).episodes
    assert (moved.label, near.label) == ("map", "walk")
    expected = np.array(rows)[1:, 2:] - (690_000, 5_330_000)
    np.testing.assert_allclose(moved.states[:, 0, :2], expected, atol=6e-4)  # the file has millimetres
    np.testing.assert_allclose(moved.states[:, 0, 2:], [[0.013 / 0.4, -0.02 / 0.4]] * 5, atol=3e-3)
    np.testing.assert_allclose(near.states[0, 1, :2], [102, 50])
    assert "| files moved towards zero by multiples of 10 km | 1 |" in loader.card


def test_files_have_frames_and_ids_of_their_own(source: Path, loader: Loader):
    (source / "later.txt").write_text(text_of([(5003 + 10 * t, 4, 7, t) for t in range(4)]))
    (source / "alone.txt").write_text(text_of([(3, 1, 0, 0)]))  # one frame has no distance to another
    episodes = loader.load(source).episodes
    assert [(e.label, e.ids.tolist()) for e in episodes] == [("later", [4]), ("walk", [2, 4])]
    assert len(episodes[0].states) == 3


# --- Folders and splits -----------------------------------------------------------------------------------------------


@pytest.fixture
def folders(tmp_path: Path) -> Path:
    folder = tmp_path / "ucy"
    for i, name in enumerate(("train", "test")):
        (folder / name).mkdir(parents=True)
        (folder / name / f"{name}.txt").write_text(text_of([(10 * t, 1, t, i) for t in range(8)]))
    (folder / "train" / "more.txt").write_text(text_of([(10 * t, n, 0, 0) for t in range(3) for n in range(140)]))
    (folder / "README.txt").write_text("not a track")
    return folder


def test_each_folder_becomes_a_store(folders: Path, loader: Loader):
    assert loader.run(folders) == (0, [])
    assert sorted(p.name for p in loader.store.iterdir()) == ["test", "test.md", "train", "train.md"]
    train, test = (read_store(loader.store / name) for name in ("train", "test"))
    assert [e.label for e in train.episodes] == ["more", "train"]
    assert [e.label for e in test.episodes] == ["test"]
    assert train.info.spec == test.info.spec and train.info.spec.max_agents == 140
    assert (train.info.source, train.info.provenance["split"]) == ("Tracks, ucy/train", "train")
    assert (train.info.provenance["source_files"], test.info.provenance["source_files"]) == (2, 1)
    assert "| split | test |" in (loader.store / "test.md").read_text()


def test_a_file_beside_the_folders_is_named(folders: Path, loader: Loader, capsys: pytest.CaptureFixture[str]):
    loader.monkeypatch.setattr(sys, "argv", ["tracks", "--source", str(folders), "--out", str(loader.store)])
    tracks.main()
    *_, last = capsys.readouterr().out.splitlines()
    assert last == f"warning: {folders / 'README.txt'} is in none of the folders train, val, test, and in no store"
    loader.monkeypatch.setattr(sys, "argv", [*sys.argv, "--overwrite", "--pattern", "**/*.txt"])
    tracks.main()
    assert capsys.readouterr().out.count("warning") == 1
    (folders / "README.txt").unlink()
    tracks.main()
    assert "warning" not in capsys.readouterr().out


def test_one_folder_can_be_chosen(folders: Path, loader: Loader):
    assert loader.run(folders, "--split", "test") == (0, [])
    assert sorted(p.name for p in loader.store.iterdir()) == ["test", "test.md"]
    assert loader.run(folders, "--split", "train") == (0, [])  # beside it
    code, errors = loader.run(folders)
    assert (code, len(errors)) == (2, 1) and "train exists; choose another path or pass --overwrite" in errors[0]
    assert loader.run(folders, "--overwrite") == (0, [])


def test_folders_are_written_all_or_none(folders: Path, loader: Loader):
    loader.refuses(folders, f"{folders} has the folders train, test, no val; leave out --split", "--split", "val")
    change_line(folders / "test" / "test.txt", 3, "20 1 2")
    loader.refuses(folders, f"{folders / 'test' / 'test.txt'}, line 3: expected at least 4 columns")
    (folders / "test" / "test.txt").write_text("0 1 2 3\n")
    loader.refuses(folders, f"{folders / 'test'} gives no episode for split 'test'; files: 1")
    (folders / "test" / "test.txt").unlink()
    loader.refuses(folders, f"{folders / 'test'} holds no files of tracks (*.txt)")


def test_outputs_are_checked_before_anything_is_read(source: Path, walk: Path, folders: Path, loader: Loader):
    walk.write_text("broken")
    (folders / "test" / "test.txt").write_text("broken")
    loader.store.write_text("mine")
    code, errors = loader.run(folders)
    assert code == 2 and errors[0].startswith(f"error: {loader.store} is a file; choose another --out")
    for existing in (loader.store, loader.store / "test"):
        loader.store.unlink(missing_ok=True)
        existing.mkdir(parents=True, exist_ok=True)
        code, errors = loader.run(walk if existing == loader.store else folders)
        assert code == 2 and errors == [f"error: {existing} exists; choose another path or pass --overwrite"]
        existing.rmdir()


def test_files_outside_of_folders_are_divided_by_name(source: Path, loader: Loader):
    for i in range(30):
        (source / f"video{i}.txt").write_text(text_of(WALK))
    found = []
    for split in ("train", "val", "test"):
        episodes = loader.load(source, "--split", split, "--overwrite").episodes
        assert all(split_of(e.label, tracks.SPLIT_SEED) == split for e in episodes)
        found += [e.label for e in episodes]
    assert sorted(found) == sorted(["walk", *(f"video{i}" for i in range(30))])


@pytest.mark.parametrize("in_folders", [False, True])
def test_a_split_alone_has_the_frames_of_all(in_folders: bool, tmp_path: Path, loader: Loader):
    """Else the steps of train and test would be of other lengths, under one dt_s."""
    source = tmp_path / "rates"
    names = {split: next(f"r{i}" for i in range(99) if split_of(f"r{i}", tracks.SPLIT_SEED) == split)
             for split in ("train", "test")}  # fmt: skip
    for split, name in names.items():
        folder = source / split if in_folders else source
        folder.mkdir(parents=True, exist_ok=True)
        apart = 10 if split == "train" else 5
        (folder / f"{name}.txt").write_text(text_of([(apart * t, 1, t, 0) for t in range(8)]))
    for split in ("all", "train", "test"):
        code, errors = loader.run(source, "--split", split)
        assert code == 2 and "apart, those of" in errors[0] and "pass --frame-step" in errors[0], split
        assert not loader.store.exists()
    assert loader.run(source, "--split", "test", "--frame-step", "5") == (0, [])


def test_files_of_one_name_in_folders_are_recordings_of_their_own(source: Path, loader: Loader):
    for i in range(30):
        (source / f"video{i}").mkdir()
        (source / f"video{i}" / "tracks.txt").write_text(text_of(WALK))
    found = []
    for split in ("train", "val", "test"):
        words = ("--pattern", "video*/tracks.txt", "--split", split, "--overwrite")
        found += [e.label for e in loader.load(source, *words).episodes]
    assert sorted(found) == sorted(f"video{i}/tracks" for i in range(30))


def test_one_file_or_another_pattern(source: Path, walk: Path, loader: Loader):
    expected = loader.load(source)
    assert_equal(loader.load(walk, "--overwrite"), expected)
    walk.rename(source / "walk.csv")
    assert_equal(loader.load(source, "--overwrite", "--pattern", "*.csv"), expected)


# --- Refusals ---------------------------------------------------------------------------------------------------------

ROW_ERRORS = {
    "columns": ("790 4 102", "expected at least 4 columns (frame, id, x, y are (1, 2, 3, 4)), got 3"),
    "mixed separators": ("790 4,102 50", "expected at least 4 columns (frame, id, x, y are (1, 2, 3, 4)), got 2"),
    "decimal commas": (
        "790 4 102,5 50,5",
        "expected at least 4 columns (frame, id, x, y are (1, 2, 3, 4)), got 3; commas",
    ),
    "too few with commas": (
        "790,4,102",
        "expected at least 4 columns (frame, id, x, y are (1, 2, 3, 4)), got 3; repair",
    ),
    "empty column": ("790,4,,50", "x must be a finite number, got ''"),
    "empty column between tabs": ("790\t4\t\t50\t1", "x must be a finite number, got ''"),
    "names in the middle": ("frame id x y", "frame must be a finite number, got 'frame'"),
    "nan": ("790 4 nan 50", "x must be a finite number, got 'nan'"),
    "text": ("790 4 102 five", "y must be a finite number, got 'five'"),
    "decimal comma": ("790;4;102,0;50", "x must be a finite number, got '102,0'"),
    "frame": ("790.5 4 102 50", "frame must be a whole number of at most 15 digits, got '790.5'"),
    "large frame": ("1e30 4 102 50", "frame must be a whole number of at most 15 digits, got '1e30'"),
    "infinite frame": ("inf 4 102 50", "frame must be a finite number, got 'inf'"),
    "id": ("790 4.25 102 50", "id must be a whole number of at most 15 digits, got '4.25'"),
    "negative id": ("790 -1 102 50", "id must be at least 0, got -1"),
    "twice": ("780.0 4.0 102 50", "agent 4 has frame 780 in line 1 already"),
}


@pytest.mark.parametrize("case", ROW_ERRORS)
def test_broken_lines_are_one_line(case: str, source: Path, walk: Path, loader: Loader):
    text, message = ROW_ERRORS[case]
    change_line(walk, 2, text)
    loader.refuses(source, f"{walk}, line 2: {message}")


def test_there_is_one_line_of_names(source: Path, walk: Path, loader: Loader):
    """Others would be lines of tracks that are lost."""
    walk.write_text("frame id x y\na b c d\n" + text_of(WALK))
    loader.refuses(source, f"{walk}, line 2: frame must be a finite number, got 'a'")


def test_an_extra_column_holds_numbers(source: Path, walk: Path, loader: Loader):
    walk.write_text(text_of([(*row, -7.0) for row in WALK]).replace(" -7", " PLAYER"))
    message = f"{walk}, line 1: column 5 must be a finite number, got 'PLAYER'"
    loader.refuses(source, message, "--extra-columns", 5)
    loader.refuses(source, f"{walk}, line 1: expected at least 6 columns", "--extra-columns", 6)


def test_files_need_a_frame_step_in_common(source: Path, walk: Path, loader: Loader):
    other = source / "other.txt"
    other.write_text(text_of([(6 * t, 1, t, 0) for t in range(6)]))
    message = f"frames of {other} are 6 apart, those of {walk} 10; pass --frame-step"
    loader.refuses(source, message)
    assert len(loader.load(source, "--frame-step", 10).episodes) == 1  # of the other file, frames 0 and 30 are kept


@pytest.mark.parametrize("where", [785, 815])
def test_one_frame_between_the_others_does_not_change_the_step(where: int, source: Path, walk: Path, loader: Loader):
    """The greatest common divisor of all frames would be 5: nearly every line would have no predecessor."""
    walk.write_text(text_of([*WALK, (where, 7, 0, 0)]))
    message = f"frames of {walk} are 5 apart, but most lines of its tracks follow after 10; pass --frame-step 10"
    loader.refuses(source, message)
    (episode,) = loader.load(source, "--frame-step", 10).episodes
    assert episode.ids.tolist() == [2, 4]


@pytest.mark.parametrize("far", [1e6, 1e30])
def test_positions_that_float32_cannot_tell_apart_are_refused(far: float, source: Path, walk: Path, loader: Loader):
    walk.write_text(text_of([*WALK, *((780 + 10 * t, 9, far + t, 0) for t in range(4))], form=".9g"))
    loader.refuses(source, f"{walk}: positions lie up to ")


def test_what_is_probably_wrong_is_said(source: Path, walk: Path, loader: Loader, capsys: pytest.CaptureFixture[str]):
    def said(rows: Sequence[Row]) -> list[str]:
        walk.write_text(text_of(rows))
        words = ["tracks", "--source", str(source), "--out", str(loader.store), "--overwrite"]
        loader.monkeypatch.setattr(sys, "argv", words)
        tracks.main()
        return [line for line in capsys.readouterr().out.splitlines() if line.startswith("warning: ")]

    loader.run(source)
    assert said(WALK) == []
    (jump,) = said([(f, i, x + 100 * (f == 800) * (i == 4), y) for f, i, x, y in WALK])
    assert jump.startswith(
        "warning: agent 4 of 'walk' moves at 255 m/s (episode 0, step 1); check its lines, --columns"
    )
    (slow,) = said([(f, i, 1e-5 * x, 1e-5 * y) for f, i, x, y in WALK])
    assert slow.startswith("warning: nobody moves faster than ") and "are positions degrees, or of another" in slow
    (lost,) = said([(f, i + f * (f > 800), x, y) for f, i, x, y in WALK])
    assert lost.startswith(
        "warning: only 3 of 9 lines are in episodes (lines dropped: no velocity (first of a track or"
    )


def test_a_file_of_which_nothing_is_kept_is_named(
    source: Path, walk: Path, loader: Loader, capsys: pytest.CaptureFixture[str]
):
    """Steps are counted from a file's first frame: one that is early by half a step leaves no other."""
    stray = walk.with_name(f"stray{walk.suffix}")
    stray.write_text(text_of([(WALK[0][0] - 5, 99, 0, 0), *WALK]))
    words = ["tracks", "--source", str(source), "--out", str(loader.store), "--frame-step", "10"]
    loader.monkeypatch.setattr(sys, "argv", words)
    tracks.main()
    said = [line for line in capsys.readouterr().out.splitlines() if line.startswith("warning: ")]
    assert any(line.startswith(f"warning: {stray} has no episode: nobody is there in two frames") for line in said), (
        said
    )


def test_files_without_tracks(source: Path, walk: Path, loader: Loader):
    walk.write_text("# nothing\n\n")
    loader.refuses(source, f"{walk} holds no line of a track; remove the file or choose others with --pattern")
    walk.write_text("0 1 2 3\n10 2 2 3\n")
    loader.refuses(source, f"{source} gives no episode for split 'all'; files: 1")
    assert loader.run(source)[1][0].endswith("; check --columns (are frame and id swapped?), --frame-step and --split")
    loader.refuses(source, f"{source} holds no files of tracks (*.csv)", "--pattern", "*.csv")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--episode-steps", 1), "episode_steps must be 0 or at least 2, got 1"),
        (("--episode-steps", -1), "episode_steps must not be negative, got -1"),
        (("--frame-step", -1), "frame_step must not be negative, got -1"),
        (("--dt-s", 0), "dt_s must be positive, got 0.0"),
        (("--scale", 0), "scale must be positive, got 0.0"),
        (("--network-scales", 5, 0), "network_scales must be positive, got (5.0, 0.0)"),
        (("--columns", 0, 1, 2, 3), "columns must be at least 1, got (0, 1, 2, 3)"),
        (("--columns", 1, 2, 3, 3), "columns and extra_columns must differ from each other, got (1, 2, 3, 3) and ()"),
        (("--extra-columns", 4), "columns and extra_columns must differ from each other, got (1, 2, 3, 4) and (4,)"),
    ],
)
def test_values_that_make_no_sense(source: Path, loader: Loader, words: tuple[object, ...], message: str):
    loader.refuses(source, message, *words)
