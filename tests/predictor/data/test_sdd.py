from pathlib import Path

import numpy as np
import pytest

from predictor.data import sdd
from predictor.data.loading import split_of
from predictor.data.sdd import read_scales
from predictor.support.errors import UserError
from tests.predictor.data.helpers import Loader, change_line

SCALES = """quad:
   video0:
      scale: 0.5   # metres per pixel
      certainty: 1.0

   video1:
      scale: 0.25
      certainty: 0.0
"""


def line(track: int, frame: int, x: float, y: float, label: str = "Pedestrian", lost: bool = False) -> str:
    """A box of 4 × 6 pixels around (x, y)."""
    return f'{track} {x - 2:g} {y - 3:g} {x + 2:g} {y + 3:g} {frame} {int(lost)} 0 0 "{label}"'


ROWS = [
    # A pedestrian walks along x, 2 pixels per frame; frame 30 is none of the kept ones.
    *(line(4, frame, 100 + 2 * frame, 50) for frame in (0, 12, 24, 30, 36)),
    # A biker is lost at frame 24.
    *(line(2, frame, 10, 5 * frame, "Biker", lost=frame == 24) for frame in (0, 12, 24, 36, 48)),
    # A cart stands from frame 96 on; no agent is present in between.
    *(line(9, frame, 300, 200, "Cart") for frame in (84, 96, 108)),
]


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    folder = tmp_path / "SDD"
    (folder / "quad" / "video0").mkdir(parents=True)
    (folder / "quad" / "video0" / "annotations.txt").write_text("\n".join(ROWS) + "\n")
    (folder / "estimated_scales.yaml").write_text(SCALES)
    return folder


@pytest.fixture
def annotations(dataset: Path) -> Path:
    return dataset / "quad" / "video0" / "annotations.txt"


@pytest.fixture
def loader(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Loader:
    return Loader(sdd.main, tmp_path / "out", monkeypatch, capsys)


def test_states_by_hand(dataset: Path, loader: Loader):
    store = loader.load(dataset)
    spec = store.info.spec
    assert (spec.dt_s, spec.frame, spec.has_ego, spec.max_agents) == (0.4, ("centroid",) * 2, False, 128)
    assert spec.feature_names[4:] == ("is_pedestrian", "is_biker", "is_vehicle")
    (episode,) = store.episodes
    assert (episode.label, episode.seed, episode.ids.tolist()) == ("quad/video0", 0, [2, 4, 9])
    # Steps 1–9 (frames 12–108). The biker has a velocity at frames 12 and 48 only; the cart from frame 96 on.
    present = {2: [1, 4], 4: [1, 2, 3], 9: [8, 9]}
    for column, track in enumerate((2, 4, 9)):
        assert (np.flatnonzero(episode.valid[:, column]) + 1).tolist() == present[track]
    # 24 pixels per step of 0.4 s at 0.5 m per pixel.
    np.testing.assert_allclose(episode.states[1, 1], [(100 + 48) * 0.5, 25.0, 30.0, 0.0, 1, 0, 0], rtol=1e-6)
    np.testing.assert_allclose(episode.states[3, 0], [5.0, 120.0, 0.0, 75.0, 0, 1, 0], rtol=1e-6)
    np.testing.assert_allclose(episode.states[7, 2], [150.0, 100.0, 0.0, 0.0, 0, 0, 1], rtol=1e-6)
    assert not episode.states[~episode.valid].any()
    assert not episode.valid[4:7].any()  # frames without an agent stay
    for line in (
        "| agents per step (min / median / max) | 0 / 1 / 2 |",
        "| steps without an agent | 3 |",
        "| lines read | 13 |",
        "| lines dropped: lost | 1 |",
        "| lines dropped: between steps | 1 |",
        "| lines dropped: no velocity (first of a track or after a gap) | 4 |",
    ):
        assert line in loader.card


def test_videos_are_cut_and_empty_stretches_left_out(dataset: Path, loader: Loader):
    episodes = loader.load(dataset, "--episode-steps", 2).episodes
    assert [e.ids.tolist() for e in episodes] == [[2, 4], [2, 4], [9]]  # steps 1–2, 3–4, (5–6,) 7–8, (9)
    assert [e.seed for e in episodes] == [0, 1, 2]
    assert "| episodes left out: no agent | 1 |" in loader.card
    assert "| episodes left out: one step | 1 |" in loader.card
    np.testing.assert_allclose(episodes[1].states[0, 1, 2], 30.0)  # the velocity looks back over the cut


def test_another_time_step(dataset: Path, annotations: Path, loader: Loader):
    with annotations.open("a") as file:
        file.write(line(4, 48, 172, 50) + "\n")
    store = loader.load(dataset, "--dt-s", 0.8)
    assert store.info.spec.dt_s == 0.8
    (episode,) = store.episodes
    # Frames 24 and 48. The biker's frame 24 is lost; the cart has no two frames that are 0.8 s apart.
    assert episode.ids.tolist() == [4]
    np.testing.assert_allclose(episode.states[0, 0, :4], [74.0, 25.0, 30.0, 0.0], rtol=1e-6)
    np.testing.assert_allclose(episode.states[1, 0, :4], [86.0, 25.0, 15.0, 0.0], rtol=1e-6)


@pytest.mark.parametrize(
    ("label", "column"), [("Pedestrian", 0), ("Biker", 1), ("Skater", 1), ("Cart", 2), ("Car", 2), ("Bus", 2)]
)
def test_classes(dataset: Path, annotations: Path, loader: Loader, label: str, column: int):
    annotations.write_text("".join(line(0, frame, 1, 2, label) + "\n" for frame in (0, 12, 24)))
    (episode,) = loader.load(dataset).episodes
    np.testing.assert_array_equal(episode.states[:, 0, 4:], np.eye(3)[[column] * 2])


def test_splits_are_by_video(dataset: Path, loader: Loader):
    scales = []
    for video in range(30):
        folder = dataset / "hyang" / f"video{video}"
        folder.mkdir(parents=True)
        (folder / "annotations.txt").write_text("".join(line(0, frame, 1, 2) + "\n" for frame in (0, 12, 24)))
        scales.append(f"   video{video}:\n      scale: 0.1\n")
    (dataset / "estimated_scales.yaml").write_text(SCALES + "hyang:\n" + "".join(scales))
    found = []
    for split in ("train", "val", "test"):
        episodes = loader.load(dataset, "--split", split, "--overwrite").episodes
        assert all(split_of(e.label, sdd.SPLIT_SEED) == split for e in episodes)
        found += [e.label for e in episodes]
    assert sorted(found) == sorted(["quad/video0", *(f"hyang/video{i}" for i in range(30))])


def test_the_documented_splits():
    assert [
        name
        for name in ("hyang/video12", "quad/video1", "deathCircle/video4", "gates/video2", "little/video0")
        if split_of(name, sdd.SPLIT_SEED) == "test"
    ] == ["hyang/video12", "quad/video1", "deathCircle/video4"]
    for name in ("deathCircle/video2", "hyang/video13", "nexus/video5", "quad/video2"):
        assert split_of(name, sdd.SPLIT_SEED) == "val"


def test_a_video_without_a_moving_agent_gives_nothing(dataset: Path, annotations: Path, loader: Loader):
    annotations.write_text(line(0, 0, 1, 2) + "\n" + line(1, 12, 1, 2, lost=True) + "\n")
    loader.refuses(dataset, f"{dataset} gives no episode for split 'all'; videos: 1")
    annotations.write_text("")
    loader.refuses(dataset, f"{dataset} gives no episode for split 'all'; videos: 1")


# --- Refusals ---------------------------------------------------------------------------------------------------------

ROW_ERRORS = {
    "columns": ('4 1 2 3 4 12 0 0 "Pedestrian"', "expected 10 columns, got 9"),
    "nan": ('4 1 nan 3 4 12 0 0 0 "Pedestrian"', "ymin must be a finite number, got 'nan'"),
    "text": ('4 1 2 3 x 12 0 0 0 "Pedestrian"', "ymax must be a finite number, got 'x'"),
    "frame": ('4 1 2 3 4 12.5 0 0 0 "Pedestrian"', "frame must be a whole number, got '12.5'"),
    "negative frame": ('4 1 2 3 4 -12 0 0 0 "Pedestrian"', "frame must be at least 0, got -12"),
    "track": ('a 1 2 3 4 12 0 0 0 "Pedestrian"', "track id must be a whole number, got 'a'"),
    "negative track": ('-1 1 2 3 4 12 0 0 0 "Pedestrian"', "track id must be at least 0, got -1"),
    "lost": ('4 1 2 3 4 12 2 0 0 "Pedestrian"', "lost must be 0 or 1, got '2'"),
    "label": ('4 1 2 3 4 12 0 0 0 "Dog"', "label must be one of Pedestrian, Biker, Skater, Cart, Car, Bus, got 'Dog'"),
    "twice": (line(4, 0, 1, 1), "track 4 has frame 0 in line 1 already"),
}


@pytest.mark.parametrize("case", ROW_ERRORS)
def test_broken_annotations_are_one_line(case: str, dataset: Path, annotations: Path, loader: Loader):
    text, message = ROW_ERRORS[case]
    change_line(annotations, 2, text)
    loader.refuses(dataset, f"{annotations}, line 2: {message}")


SCALE_ERRORS = {
    "nan": (3, "      scale: nan", 3, "scale must be a finite number, got 'nan'"),
    "zero": (3, "      scale: 0", 3, "scale must be positive, got 0"),
    "no colon": (3, "      scale 0.5", 3, "expected 'name:' or 'name: number', got 'scale 0.5'"),
    "no video": (2, "", 3, "'scale' belongs to no video"),
    "no scene": (1, "", 3, "'scale' belongs to no video"),
    "twice": (3, "    scale: 0.5\n    scale: 0.6", 4, "quad/video0 has a scale already"),
}


@pytest.mark.parametrize("case", SCALE_ERRORS)
def test_broken_scales_are_one_line(case: str, dataset: Path, loader: Loader):
    changed, text, line, message = SCALE_ERRORS[case]
    path = dataset / "estimated_scales.yaml"
    change_line(path, changed, text)
    loader.refuses(dataset, f"{path}, line {line}: {message}")


def test_scales(tmp_path: Path):
    path = tmp_path / "scales.yaml"
    path.write_text("---\n" + SCALES)
    assert read_scales(path) == {"quad/video0": 0.5, "quad/video1": 0.25}
    path.write_text("quad:\n  video0:\n    scale: 1\ngates:\n  scale: 2\n")
    with pytest.raises(UserError, match=r"line 5: 'scale' belongs to no video"):
        read_scales(path)


def test_folders_that_hold_something_else(tmp_path: Path, dataset: Path, annotations: Path, loader: Loader):
    loader.refuses(tmp_path, f"{tmp_path} holds no estimated_scales.yaml")
    path = dataset / "estimated_scales.yaml"
    path.write_text(SCALES.replace("video0", "video7"))
    loader.refuses(dataset, f"{path} has no scale for quad/video0, which {annotations} needs; add it")
    annotations.unlink()
    loader.refuses(dataset, f"{dataset} holds no annotations (*/*/annotations.txt)")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ("--dt-s", 0.41),
            "dt_s must be a whole number of frames: the dataset has 30 per second, so dt_s=0.41 would be",
        ),
        (("--dt-s", 0), "dt_s must be a whole number of frames"),
        (("--episode-steps", 1), "episode_steps must be at least 2, got 1"),
    ],
)
def test_values_that_make_no_sense(dataset: Path, loader: Loader, words: tuple[object, ...], message: str):
    loader.refuses(dataset, message, *words)
