from pathlib import Path

import numpy as np
import pytest

from predictor.data import levelx
from predictor.data.loading import split_of
from tests.predictor.data.helpers import Loader, change_line

CENTRE = (
    "recordingId,trackId,frame,trackLifetime,xCenter,yCenter,heading,width,length,xVelocity,yVelocity,"
    "xAcceleration,yAcceleration,lonVelocity,latVelocity,lonAcceleration,latAcceleration"
)
CENTRE_META = "recordingId,trackId,initialFrame,finalFrame,numFrames,width,length,class"
RECORDING = "recordingId,locationId,frameRate,speedLimit,weekday\n0,{location},{rate},13.9,monday\n"
CORNER = (
    "frame,id,x,y,width,height,xVelocity,yVelocity,xAcceleration,yAcceleration,frontSightDistance,"
    "backSightDistance,dhw,thw,ttc,precedingXVelocity,precedingId,laneId"
)
CORNER_META = "id,width,height,initialFrame,finalFrame,numFrames,class,drivingDirection"
CORNER_RECORDING = "id,frameRate,locationId,speedLimit,month\n1,25,2,-1.00,9.2017\n"


def centre(track: int, frame: int) -> str:
    """A car turns and speeds up; what the loader does not use is no number."""
    return f"0,{track},{frame},?,{frame},{-track},{30 * track},2,4,{10 + frame},-1,?,?,?,?,{track + 0.5},-0.25"


def write_centre(folder: Path, name: str = "00", location: str = "3", rate: str = "25", lines: list[str] | None = None):
    if lines is None:
        # Track 1 from frame 0 to 20, track 3 from 10 to 40 without frames 20–24; track 4 stands from 60 on.
        lines = [centre(1, frame) for frame in range(21)]
        lines += [centre(3, frame) for frame in range(10, 41) if not 20 <= frame < 25]
        lines += [centre(4, frame) for frame in range(60, 66)]
    folder.mkdir(exist_ok=True)
    (folder / f"{name}_tracks.csv").write_text("\n".join([CENTRE, *lines]) + "\n")
    meta = ["0,1,0,20,21,2,4,car", "0,3,10,40,31,2,4,truck_bus", "0,4,60,65,6,0,0,pedestrian", "0,5,0,0,1,0,0,bicycle"]
    (folder / f"{name}_tracksMeta.csv").write_text("\n".join([CENTRE_META, *meta]) + "\n")
    (folder / f"{name}_recordingMeta.csv").write_text(RECORDING.format(location=location, rate=rate))


def write_corner(folder: Path, lines: list[str] | None = None):
    if lines is None:
        lines = [f"{f},7,{100 - f},20,4,2,-25,0.5,0.75,-0.5,0,0,0,0,0,0,0,2" for f in range(1, 12)]
        lines += [f"{f},8,{f},30,10,2.5,20,-1,-0.25,0.125,0,0,0,0,0,0,0,5" for f in range(1, 12)]
    folder.mkdir(exist_ok=True)
    (folder / "01_tracks.csv").write_text("\n".join([CORNER, *lines]) + "\n")
    (folder / "01_tracksMeta.csv").write_text(f"{CORNER_META}\n7,4,2,1,11,11,Car,1\n8,10,2.5,1,11,11,Truck,2\n")
    (folder / "01_recordingMeta.csv").write_text(CORNER_RECORDING)


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    write_centre(tmp_path / "data")
    return tmp_path / "data"


@pytest.fixture
def tracks(dataset: Path) -> Path:
    return dataset / "00_tracks.csv"


@pytest.fixture
def loader(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Loader:
    return Loader(levelx.main, tmp_path / "out", monkeypatch, capsys)


# --- inD, rounD, exiD -------------------------------------------------------------------------------------------------


def test_states_by_hand(dataset: Path, loader: Loader):
    store = loader.load(dataset)
    spec = store.info.spec
    assert (spec.dt_s, spec.frame, spec.has_ego, spec.max_agents) == (0.2, ("world", "world"), False, 128)
    assert spec.feature_names[4:8] == ("heading_cos", "heading_sin", "lon_acceleration_mps2", "lat_acceleration_mps2")
    assert spec.feature_names[8:] == ("is_car", "is_truck_bus", "is_pedestrian", "is_bicycle")
    (episode,) = store.episodes
    assert (episode.label, episode.seed, episode.ids.tolist()) == ("3/00", 0, [1, 3, 4])
    # Frames 0, 5, …, 65 are steps 0–13.
    present = {1: [0, 1, 2, 3, 4], 3: [2, 3, 5, 6, 7, 8], 4: [12, 13]}
    for column, track in enumerate((1, 3, 4)):
        assert np.flatnonzero(episode.valid[:, column]).tolist() == present[track]
    half, root = 0.5, np.sqrt(0.75)
    expected = {
        (1, 0): [5, -1, 15, -1, root, half, 1.5, -0.25, 1, 0, 0, 0],
        (5, 1): [25, -3, 35, -1, 0, 1, 3.5, -0.25, 0, 1, 0, 0],
        (13, 2): [65, -4, 75, -1, -half, root, 4.5, -0.25, 0, 0, 1, 0],
    }
    for (step, column), state in expected.items():
        np.testing.assert_allclose(episode.states[step, column], state, atol=1e-6)
    assert not episode.valid[9:12].any()  # frames without an agent stay
    assert not episode.states[~episode.valid].any()
    assert "| agents per step (min / median / max) | 0 / 1 / 2 |" in loader.card


def test_kinematic_features_need_no_other_columns(dataset: Path, tracks: Path, loader: Loader):
    lines = tracks.read_text().replace("heading", "other").replace("lonAcceleration", "another").splitlines()
    tracks.write_text("\n".join(lines) + "\n")
    store = loader.load(dataset, "--features", "kinematic", "--frame", "centroid")
    assert store.info.spec.feature_names == ("x_m", "y_m", "vx_mps", "vy_mps")
    assert store.info.spec.frame == ("centroid", "centroid")
    np.testing.assert_allclose(store.episodes[0].states[1, 0], [5, -1, 15, -1])


def test_columns_may_stand_in_any_order(dataset: Path, tracks: Path, loader: Loader):
    before = loader.load(dataset).episodes
    lines = [line.split(",") for line in tracks.read_text().splitlines()]
    tracks.write_text("\n".join(",".join(words[::-1]) for words in lines))
    for old, new in zip(before, loader.load(dataset, "--overwrite").episodes, strict=True):
        np.testing.assert_array_equal(old.states, new.states)


def test_recordings_are_cut_and_empty_stretches_left_out(dataset: Path, loader: Loader):
    episodes = loader.load(dataset, "--episode-steps", 3).episodes
    # Steps 0–2, 3–5, 6–8, (9–11), 12–13.
    assert [len(e.states) for e in episodes] == [3, 3, 3, 2]
    assert [e.ids.tolist() for e in episodes] == [[1, 3], [1, 3], [3], [4]]
    assert "| episodes left out: no agent | 1 |" in loader.card


def test_other_rates_and_steps(tmp_path: Path, loader: Loader):
    write_centre(tmp_path / "data", rate="10")
    (episode,) = loader.load(tmp_path / "data", "--dt-s", 0.4).episodes
    assert episode.states[1, 0, 0] == 4.0
    path = tmp_path / "data"
    loader.store.rename(tmp_path / "away")
    (loader.out / "store.md").unlink()
    loader.refuses(path, "dt_s must be a whole number of frames: recording 00 has 10 per second", "--dt-s", 0.25)


def test_locations_and_splits(tmp_path: Path, loader: Loader):
    names = [f"{i:02d}" for i in range(33)]
    for i, name in enumerate(names):
        write_centre(tmp_path / "data", name, location=str(i % 2))
    found = {}
    for split in ("train", "val", "test"):
        episodes = loader.load(tmp_path / "data", "--split", split, "--overwrite").episodes
        found[split] = [e.label.split("/")[1] for e in episodes]
        assert found[split] == [name for name in names if split_of(name, levelx.SPLIT_SEED) == split]
    assert (found["test"], found["val"]) == (["01", "14", "24"], ["03", "11", "22"])  # as documented
    chosen = loader.load(tmp_path / "data", "--locations", "1", "--overwrite").episodes
    assert [e.label for e in chosen] == [f"1/{name}" for name in names[1::2]]
    loader.store.rename(tmp_path / "away")
    (loader.out / "store.md").unlink()
    loader.refuses(
        tmp_path / "data",
        f"{tmp_path / 'data'} has no recording of locations ('9',); there are ['0', '1']",
        "--locations",
        "1",
        "9",
    )


@pytest.mark.parametrize(
    ("kind", "column"),
    [("car", 0), ("van", 0), ("truck", 1), ("bus", 1), ("trailer", 1), ("pedestrian", 2), ("motorcycle", 3)],
)
def test_classes(dataset: Path, loader: Loader, kind: str, column: int):
    change_line(dataset / "00_tracksMeta.csv", 2, f"0,1,0,20,21,2,4,{kind}")
    (episode,) = loader.load(dataset).episodes
    np.testing.assert_array_equal(episode.states[0, 0, 8:], np.eye(4)[column])


# --- highD ------------------------------------------------------------------------------------------------------------


def test_highd_by_hand(tmp_path: Path, loader: Loader):
    write_corner(tmp_path / "highD")
    store = loader.load(tmp_path / "highD")
    (episode,) = store.episodes
    assert (episode.label, episode.ids.tolist(), len(episode.states)) == ("2/01", [7, 8], 2)  # frames 5 and 10
    assert "Recordings in the layout of highD" in loader.card
    # Corner to centre, y up; the car drives to the left, so what speeds it up in x slows it down.
    left = [95 + 2, -21, -25, -0.5, -1, 0, -0.75, -0.5, 1, 0, 0, 0]
    right = [5 + 5, -31.25, 20, 1, 1, 0, -0.25, -0.125, 0, 1, 0, 0]
    np.testing.assert_allclose(episode.states[0], [left, right], atol=1e-6)
    assert store.info.spec.feature_scales[:4] == (100.0, 10.0, 30.0, 1.0)


def test_acceleration_across_points_to_the_left_of_the_heading(tmp_path: Path, loader: Loader):
    """Both cars accelerate upwards in the image (y falls): left for one that drives right, right for the other."""
    lines = [f"{f},{car},50,20,4,2,{v},0,0,-1,0,0,0,0,0,0,0,2" for car, v in ((7, -25), (8, 25)) for f in range(1, 12)]
    write_corner(tmp_path / "highD", lines)
    (episode,) = loader.load(tmp_path / "highD").episodes
    assert episode.states[0, :, 7].tolist() == [-1.0, 1.0]


# --- Refusals ---------------------------------------------------------------------------------------------------------

WHOLE = "must be a whole number from 0 up, of at most 15 digits"
TRACK_ERRORS = {
    "nan": (centre(1, 1).replace(",1,-1,", ",nan,-1,"), "xCenter must be a finite number, got 'nan'"),
    "empty": (centre(1, 1).replace(",1,-1,", ",,-1,"), "xCenter must be a finite number, got ''"),
    "text": (centre(1, 1).replace("-0.25", "left"), "latAcceleration must be a finite number, got 'left'"),
    "short": ("0,1,1,1,2,3", "expected 17 columns, got 6"),
    "frame": (
        centre(1, 1).replace("0,1,1,", "0,1,1.5,", 1),
        f"frame {WHOLE}, got 1.5",
    ),
    "track": (
        centre(1, 1).replace("0,1,1,", "0,-2,1,", 1),
        f"trackId {WHOLE}, got -2",
    ),
    "huge": (
        centre(1, 1).replace("0,1,1,", "0,1e30,1,", 1),
        f"trackId {WHOLE}, got 1e+30",
    ),
    "long": (
        centre(1, 1).replace("0,1,1,", f"0,{2**53},1,", 1),
        f"trackId {WHOLE}, got 9.0072e+15",
    ),
    "twice": (centre(1, 0), "track 1 has frame 0 in line 2 already"),
    "unknown track": (centre(6, 5), "track 6 is not in 00_tracksMeta.csv"),
}


@pytest.mark.parametrize("case", TRACK_ERRORS)
@pytest.mark.parametrize("blank", [0, 2], ids=["", "after blank lines"])
def test_broken_tracks_are_one_line(case: str, blank: int, dataset: Path, tracks: Path, loader: Loader):
    text, message = TRACK_ERRORS[case]
    change_line(tracks, 3, "\n" * blank + text)
    loader.refuses(dataset, f"{tracks}, line {3 + blank}: {message}")


def test_a_line_of_blanks_is_named(dataset: Path, tracks: Path, loader: Loader):
    change_line(tracks, 3, "   ")
    loader.refuses(dataset, f"{tracks}, line 3: it holds only blanks; delete it")


def test_bytes_that_are_no_text(dataset: Path, tracks: Path, loader: Loader):
    tracks.write_bytes(tracks.read_bytes().replace(b"0,1,7,?", b"0,1,7,\xff"))
    loader.refuses(dataset, f"{tracks}, line 9: expected text in UTF-8")


@pytest.mark.parametrize("column", ["frame", "trackId", "yCenter", "xVelocity", "heading", "lonAcceleration"])
def test_missing_columns_are_named(dataset: Path, tracks: Path, loader: Loader, column: str):
    tracks.write_text(tracks.read_text().replace(f",{column}", ",other", 1))
    loader.refuses(dataset, f"{tracks}, line 1: column {column} is missing, got recordingId,")


def test_files_of_another_layout(dataset: Path, tracks: Path, loader: Loader):
    tracks.write_text("a,b,c\n1,2,3\n")
    loader.refuses(dataset, f"{tracks}, line 1: expected the columns of inD, rounD, exiD (frame, trackId,")
    tracks.write_text("")
    loader.refuses(dataset, f"{tracks}, line 1: expected the columns of inD")
    tracks.write_text(CENTRE + "\n\n")
    loader.refuses(dataset, f"{tracks} holds no track")


META_ERRORS = {
    "class": ("00_tracksMeta.csv", 3, "0,3,10,40,31,2,4,tank", 3, "class must be one of car, van, truck, bus,"),
    "no class": ("00_tracksMeta.csv", 1, CENTRE_META.replace("class", "kind"), 1, "column class is missing"),
    "track": ("00_tracksMeta.csv", 3, "0,x,10,40,31,2,4,car", 3, "trackId must be a whole number, got 'x'"),
    "twice": ("00_tracksMeta.csv", 3, "0,1,10,40,31,2,4,car", 3, "trackId 1 is there already"),
    "short": ("00_tracksMeta.csv", 3, "0,3", 3, "the line has too few columns"),
    "rate": ("00_recordingMeta.csv", 2, "0,3,0,1,monday", 2, "frameRate must be positive, got 0"),
    "rate nan": ("00_recordingMeta.csv", 2, "0,3,nan,1,monday", 2, "frameRate must be a finite number, got 'nan'"),
    "no location": ("00_recordingMeta.csv", 1, "recordingId,place,frameRate", 1, "column locationId is missing"),
    "two recordings": (
        "00_recordingMeta.csv",
        2,
        "0,3,25,1,monday\n1,3,25,1,monday",
        3,
        "expected one recording, got 2",
    ),
    "no recording": ("00_recordingMeta.csv", 2, None, 1, "expected one recording, got 0"),
}


@pytest.mark.parametrize("case", META_ERRORS)
def test_broken_meta_files_are_one_line(case: str, dataset: Path, loader: Loader):
    name, changed, text, line, message = META_ERRORS[case]
    change_line(dataset / name, changed, text)
    loader.refuses(dataset, f"{dataset / name}, line {line}: {message}")


def test_highd_without_a_direction(tmp_path: Path, loader: Loader):
    folder = tmp_path / "highD"
    write_corner(folder)
    change_line(folder / "01_tracksMeta.csv", 2, "7,4,2,1,11,11,Car,left")
    path = folder / "01_tracksMeta.csv"
    loader.refuses(folder, f"{path}, line 2: drivingDirection must be a whole number, got 'left'")


def test_folders_that_hold_something_else(tmp_path: Path, dataset: Path, tracks: Path, loader: Loader):
    loader.refuses(tmp_path, f"{tmp_path} holds no recordings (*_tracks.csv)")
    write_corner(dataset)
    both = f"{tracks} and {dataset / '01_tracks.csv'} have different layouts; give each dataset a folder of its own"
    loader.refuses(dataset, both)
    (dataset / "01_tracksMeta.csv").unlink()
    loader.refuses(dataset, f"{dataset / '01_tracks.csv'} needs 01_tracksMeta.csv beside it, which is missing")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--dt-s", 0), "dt_s must be positive, got 0"),
        (("--dt-s", "inf"), "dt_s must be positive, got inf"),
        (("--dt-s", 0.01), "dt_s must be a whole number of frames: recording 00 has 25 per second"),
        (("--episode-steps", 1), "episode_steps must be at least 2, got 1"),
    ],
)
def test_values_that_make_no_sense(dataset: Path, loader: Loader, words: tuple[object, ...], message: str):
    loader.refuses(dataset, message, *words)
