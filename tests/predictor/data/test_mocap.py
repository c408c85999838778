import os
from pathlib import Path

import numpy as np
import pytest

from predictor.data import mocap
from predictor.data.loading import split_of
from predictor.data.mocap_files import Bone, Skeleton, joint_positions, read_motion, read_skeleton, rotation
from predictor.scene import KINEMATIC_FEATURES_3D
from tests.predictor.data.helpers import Loader, change_line

# One unit is 0.0254 / 0.5 = 0.0508 m. `upper` turns about z; `lower` hangs on it, its own frame turned by 90° about z;
# `side` cannot turn.
ASF = """# made by hand
:version 1.10
:units
  mass 1.0
  length 0.5
  angle deg
:root
  order TX TY TZ RX RY RZ
  axis XYZ
  position 0 0 0
  orientation 0 0 0
:bonedata
  begin
    id 1
    name upper
    direction 1 0 0
    length 2
    axis 0 0 0 XYZ
    dof rz
    limits (-180 180)
  end
  begin
    id 2
    name lower
    direction 1 0 0
    length 1
    axis 0 0 90 XYZ
    dof rx
  end
  begin
    id 3
    name side
    direction 0 2 0
    length 3
    axis 0 0 0 XYZ
  end
:hierarchy
  begin
    root upper side
    upper lower
  end
"""
UNIT_M = 0.0508
STILL = "root 0 0 0 0 0 0\nupper 0\nlower 0\n"


def amc(*frames: str, first: int = 1) -> str:
    numbered = "".join(f"{first + i}\n{frame}" for i, frame in enumerate(frames))
    return f"#!OML:ASF by hand\n:FULLY-SPECIFIED\n:DEGREES\n{numbered}"


def walk(frames: int) -> str:
    """The root moves along z by one unit per frame, faster and faster."""
    return amc(*(f"root 0 0 {t * t} 0 0 0\nupper 0\nlower 0\n" for t in range(frames)), first=135)


@pytest.fixture
def subject(tmp_path: Path) -> Path:
    folder = tmp_path / "07"
    folder.mkdir()
    (folder / "07.asf").write_text(ASF)
    (folder / "07_01.amc").write_text(walk(13))
    return folder


@pytest.fixture
def loader(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Loader:
    return Loader(mocap.main, tmp_path / "out", monkeypatch, capsys)


def pose(folder: Path, frame: str) -> np.ndarray:
    """Joints in units of the file."""
    path = folder / "pose.amc"
    path.write_text(amc(frame))
    skeleton = read_skeleton(folder / "07.asf")
    return joint_positions(skeleton, read_motion(path, skeleton))[0] / UNIT_M


# --- Forward kinematics -----------------------------------------------------------------------------------------------


def test_the_skeleton_is_read(subject: Path):
    skeleton = read_skeleton(subject / "07.asf")
    assert skeleton.joint_names == ("root", "upper", "lower", "side")
    assert skeleton.parents == (-1, 0, 1, 0)
    assert skeleton.metres_per_unit == pytest.approx(UNIT_M)
    np.testing.assert_allclose(skeleton.lengths_m, np.array([0, 2, 1, 3]) * UNIT_M)
    assert skeleton.bones[3].direction == (0.0, 1.0, 0.0)
    assert [bone.channels for bone in skeleton.bones[1:]] == [("RZ",), ("RX",), ()]


POSES = {
    "rest": (STILL, [[0, 0, 0], [2, 0, 0], [3, 0, 0], [0, 3, 0]]),
    "moved": ("root 1 2 3 0 0 0\nupper 0\nlower 0\n", [[1, 2, 3], [3, 2, 3], [4, 2, 3], [1, 5, 3]]),
    # The arm points up, and all that hangs on it turns with it.
    "arm up": ("root 0 0 0 0 0 0\nupper 90\nlower 0\n", [[0, 0, 0], [0, 2, 0], [0, 3, 0], [0, 3, 0]]),
    # The lower bone's own x axis is y at rest: x turns to −z.
    "axis": ("root 0 0 0 0 0 0\nupper 0\nlower 90\n", [[0, 0, 0], [2, 0, 0], [2, 0, -1], [0, 3, 0]]),
    "both": ("root 0 0 0 0 0 0\nupper 90\nlower 90\n", [[0, 0, 0], [0, 2, 0], [0, 2, -1], [0, 3, 0]]),
    "root about x": ("root 0 0 0 90 0 0\nupper 0\nlower 0\n", [[0, 0, 0], [2, 0, 0], [3, 0, 0], [0, 0, 3]]),
    # x first, then y: up (y) goes to z, then to x; the arm (x) stays, then goes to −z.
    "root about x, y": ("root 0 0 0 90 90 0\nupper 0\nlower 0\n", [[0, 0, 0], [0, 0, -2], [0, 0, -3], [3, 0, 0]]),
}


@pytest.mark.parametrize("name", POSES)
def test_poses_by_hand(subject: Path, name: str):
    frame, expected = POSES[name]
    np.testing.assert_allclose(pose(subject, frame), expected, atol=1e-12)


def test_channels_may_come_in_another_order(subject: Path):
    change_line(subject / "07.asf", 8, "order RZ RX RY TZ TX TY")
    found = pose(subject, "root 0 90 90 3 1 2\nupper 0\nlower 0\n")
    np.testing.assert_allclose(found, np.array(POSES["root about x, y"][1]) + [1, 2, 3], atol=1e-12)


def test_rest_position_and_orientation_of_the_root_count(subject: Path):
    change_line(subject / "07.asf", 10, "position 0 5 0")
    change_line(subject / "07.asf", 11, "orientation 0 0 90")
    # The root's own x axis is y: turning about it moves x to −z and leaves y.
    found = pose(subject, "root 1 0 0 90 0 0\nupper 0\nlower 0\n")
    np.testing.assert_allclose(found, [[1, 5, 0], [1, 5, -2], [1, 5, -3], [1, 8, 0]], atol=1e-12)


def test_rotation_order():
    y = np.array([0.0, 1.0, 0.0])
    quarter = np.array([[90.0, 90.0, 0.0]])
    np.testing.assert_allclose(rotation(quarter, "XYZ")[0] @ y, [1, 0, 0], atol=1e-12)  # y → z → x
    np.testing.assert_allclose(rotation(quarter, "YXZ")[0] @ y, [0, 0, 1], atol=1e-12)  # y → y → z


def about(axis: np.ndarray, angle_deg: float) -> np.ndarray:
    """Rodrigues' formula."""
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = np.radians(angle_deg)
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def test_against_a_plain_loop_on_random_skeletons():
    """C·M·C⁻¹ is a turn about the local axes as they stand in the rest pose; here each is turned about on its own."""
    rng = np.random.default_rng(3)
    bones = [Bone("root", (0.0, 0.0, 0.0), 0.0, (10.0, 20.0, 30.0), "XYZ", ("TX", "TY", "TZ", "RX", "RY", "RZ"))]
    parents = [-1, 0, 3, 0, 2, 3]  # a child may stand before its parent
    for i in range(1, 6):
        direction = rng.standard_normal(3)
        x, y, z = direction / np.linalg.norm(direction)
        angles = rng.uniform(-180, 180, size=3)
        order = ("XYZ", "ZYX", "YZX", "ZXY", "XZY")[i - 1]
        bones.append(Bone(f"b{i}", (x, y, z), i * 1.0, tuple(angles.tolist()), order, ("RX", "RY", "RZ")))
    skeleton = Skeleton(tuple(bones), tuple(parents), (0.0, 0.0, 0.0), 1.0)
    values = rng.uniform(-180, 180, size=(4, 6 + 15))
    found = joint_positions(skeleton, values)
    for t in range(len(values)):
        turns: dict[int, np.ndarray] = {}
        for joint in (0, 1, 3, 2, 4, 5):
            bone = bones[joint]
            frame = np.eye(3)
            for letter, angle in zip(bone.order, bone.axis_deg, strict=True):
                frame = about(np.eye(3)["XYZ".index(letter)], angle) @ frame
            begin = 3 if joint == 0 else 6 + 3 * (joint - 1)
            angles = dict(zip("XYZ", values[t, begin : begin + 3], strict=True))
            local = np.eye(3)
            for letter in bone.order:
                local = about(frame[:, "XYZ".index(letter)], angles[letter]) @ local
            if joint == 0:
                turns[joint], expected = local, values[t, :3]
            else:
                turns[joint] = turns[parents[joint]] @ local
                expected = found[t, parents[joint]] + bone.length * turns[joint] @ np.array(bone.direction)
            np.testing.assert_allclose(found[t, joint], expected, atol=1e-9)
    lengths = [np.linalg.norm(found[:, i] - found[:, parents[i]], axis=-1) for i in range(1, 6)]
    np.testing.assert_allclose(lengths, np.repeat(np.arange(1.0, 6)[:, None], 4, axis=1), atol=1e-9)


# --- The store --------------------------------------------------------------------------------------------------------


def test_velocities_are_backward_differences(subject: Path, loader: Loader):
    store = loader.load(subject, "--stride", 4, "--min-steps", 2)
    (episode,) = store.episodes
    spec = store.info.spec
    assert (episode.label, episode.seed, episode.ids.tolist()) == ("07_01", 0, [0, 1, 2, 3])
    assert spec.feature_names == KINEMATIC_FEATURES_3D
    assert (spec.frame, spec.has_ego, spec.max_agents) == (("centroid",) * 3, False, 4)
    assert spec.dt_s == pytest.approx(4 / 120)
    assert store.info.provenance["joints"] == ["root", "upper", "lower", "side"]
    assert store.info.provenance["parents"] == [-1, 0, 1, 0]
    # Frames 0, 4, 8, 12 at z = 0, 16, 64, 144 units; the first has no velocity.
    np.testing.assert_allclose(episode.states[:, 0, 2], np.array([16, 64, 144]) * UNIT_M, rtol=1e-6)
    np.testing.assert_allclose(episode.states[:, 0, 5], np.array([16, 48, 80]) * UNIT_M * 30, rtol=1e-6)
    np.testing.assert_allclose(episode.states[:, 2, 0], 3 * UNIT_M, rtol=1e-6)
    assert episode.states.dtype == np.float32
    assert episode.valid.all()
    assert "| agents per step (min / median / max) | 4 / 4 / 4 |" in loader.card


def test_all_phases_are_the_ways_to_begin(subject: Path, loader: Loader):
    episodes = loader.load(subject, "--all-phases", "--min-steps", 2).episodes
    assert [len(e.states) for e in episodes] == [3, 2, 2, 2]
    assert [e.seed for e in episodes] == [0, 1, 2, 3]
    assert {e.label for e in episodes} == {"07_01"}
    for phase, episode in enumerate(episodes):
        squares = (phase + 4 * np.arange(1, len(episode.states) + 1)) ** 2
        np.testing.assert_allclose(episode.states[:, 0, 2], squares * UNIT_M, rtol=1e-6)


def test_short_trials_are_skipped_and_counted(subject: Path, loader: Loader):
    (subject / "07_02.amc").write_text(walk(12))
    assert [e.label for e in loader.load(subject, "--min-steps", 3).episodes] == ["07_01"]
    assert "| trials skipped, shorter than 3 steps | 1 |" in loader.card


def test_only_short_trials_are_an_error(subject: Path, loader: Loader):
    loader.refuses(subject, f"{subject} gives no episode for split 'all'; trials in the folder: 1")


def test_splits_are_by_trial(subject: Path, loader: Loader):
    names = [f"07_{i:02d}" for i in range(1, 31)]
    for name in names:
        (subject / f"{name}.amc").write_text(walk(13))
    found = {}
    for split in ("train", "val", "test"):
        arguments = ("--split", split, "--min-steps", 2, "--overwrite")
        found[split] = [e.label for e in loader.load(subject, *arguments).episodes]
        assert found[split] == [name for name in names if split_of(name, mocap.SPLIT_SEED) == split]
    assert sorted(sum(found.values(), [])) == names


def test_the_documented_split_of_subject_35():
    names = [f"35_{i:02d}" for i in (*range(1, 17), *range(28, 35))]
    splits = {name: split_of(name, mocap.SPLIT_SEED) for name in names}
    assert [name for name in names if splits[name] == "test"] == ["35_12", "35_34"]
    assert [name for name in names if splits[name] == "val"] == ["35_04", "35_14", "35_29"]


# --- Refusals ---------------------------------------------------------------------------------------------------------

AMC_ERRORS = {
    "number": (5, "root 0 0 abc 0 0 0", 5, "a value of 'root' must be a finite number, got 'abc'"),
    "nan": (6, "upper nan", 6, "a value of 'upper' must be a finite number, got 'nan'"),
    "too few": (5, "root 0 0 0 0 0", 5, "bone 'root' needs 6 values, got 5"),
    "unknown bone": (6, "tail 1", 6, "the skeleton has no moving bone 'tail'; use the .asf of this subject"),
    "still bone": (6, "side 1", 6, "the skeleton has no moving bone 'side'"),
    "twice": (7, "upper 0", 7, "bone 'upper' appears twice in a frame"),
    "missing bone": (6, None, 7, "the frame that ends here lacks upper"),
    "gap": (8, "137", 8, "frame numbers must be consecutive: expected 136, got 137"),
    "repeated": (8, "135", 8, "frame numbers must be consecutive: expected 136, got 135"),
    "frame": (8, "136.5", 8, "a frame number must be a whole number, got '136.5'"),
    "radians": (3, ":RADIANS", 4, "the header must contain :DEGREES"),
    "no frame number": (4, None, 4, "expected a frame number before 'root'"),
}


@pytest.mark.parametrize("case", AMC_ERRORS)
def test_broken_motions_are_one_line(case: str, subject: Path, loader: Loader):
    changed, text, line, message = AMC_ERRORS[case]
    change_line(subject / "07_01.amc", changed, text)
    loader.refuses(subject, f"{subject / '07_01.amc'}, line {line}: {message}", "--min-steps", 2)


def test_a_motion_that_breaks_off_is_refused(subject: Path, loader: Loader):
    path = subject / "07_01.amc"
    path.write_text(amc(STILL, "root 0 0 0 0 0 0\nupper 0\n"))
    loader.refuses(subject, f"{path}, line 10: the frame that ends here lacks lower")
    path.write_text(":FULLY-SPECIFIED\n:DEGREES\n")
    loader.refuses(subject, f"{path} holds no frame; get the file anew")
    path.write_text("")
    loader.refuses(subject, f"{path}, line 0: the header must contain :FULLY-SPECIFIED")


ASF_ERRORS = {
    "unit": (5, "length 0", 5, "the unit of length must be positive, got 0"),
    "no unit": (5, None, 3, ":units gives no length"),
    "radians": (6, "angle rad", 6, "angles must be in deg, got 'rad'"),
    "root order": (8, "order TX TY TZ RX RY", 8, "the root's order must hold TX TY TZ RX RY RZ"),
    "root axis": (9, "axis XYX", 9, "an axis order must hold X, Y and Z, got 'XYX'"),
    "no position": (10, None, 7, ":root gives no position"),
    "direction": (16, "direction 1 0", 16, "direction needs 3 numbers, got 2"),
    "zero direction": (16, "direction 0 0 0", 16, "a direction must not be zero"),
    "nan": (17, "length nan", 17, "length must be a finite number, got 'nan'"),
    "no length": (17, None, 13, "a bone has no length"),
    "axis": (18, "axis 0 0 XYZ", 18, "axis must be a finite number, got 'XYZ'"),
    "axis letters": (18, "axis 0 0 0", 18, "an axis order must hold X, Y and Z, got ''"),
    "dof": (19, "dof rz l", 19, "dof must be some of rx ry rz, got rz l"),
    "dof twice": (19, "dof rz rz", 19, "dof must be some of rx ry rz"),
    "no begin": (13, None, 13, "expected 'begin' of a bone, got 'id'"),
    "same name": (24, "name upper", 29, "bone 'upper' appears twice"),
    "unknown child": (39, "root upper tail", 39, "bone 'tail' is not in :bonedata"),
    "orphan": (39, "root upper", 37, "no parent is given for side"),
    "two parents": (40, "upper lower side", 40, "bone 'side' has two parents"),
    "no way up": (39, "lower upper side", 39, "bone 'lower' must have a parent before it has children"),
    "no hierarchy": (37, "# gone", 36, "a bone has no"),
}


@pytest.mark.parametrize("case", ASF_ERRORS)
def test_broken_skeletons_are_one_line(case: str, subject: Path, loader: Loader):
    changed, text, line, message = ASF_ERRORS[case]
    path = subject / "07.asf"
    change_line(path, changed, text)
    if case == "no hierarchy":
        path.write_text("\n".join(path.read_text().splitlines()[:36]) + "\n")
        line, message = 36, "section :hierarchy is missing"
    loader.refuses(subject, f"{path}, line {line}: {message}", "--min-steps", 2)


def test_an_unfinished_bone_is_refused(subject: Path, loader: Loader):
    path = subject / "07.asf"
    change_line(path, 36, None)
    loader.refuses(subject, f"{path}, line 30: a bone has no 'end'")


def test_folders_that_hold_something_else(tmp_path: Path, subject: Path, loader: Loader):
    loader.refuses(tmp_path / "absent", f"no source at {tmp_path / 'absent'}")
    loader.refuses(subject / "07.asf", "source must be one subject's folder, got the file")
    loader.refuses(tmp_path, f"{tmp_path} holds no skeleton (*.asf)")
    (subject / "08.asf").write_text(ASF)
    loader.refuses(subject, f"{subject} must hold one skeleton, got 2")
    (subject / "08.asf").unlink()
    (subject / "07_01.amc").unlink()
    loader.refuses(subject, f"{subject} holds no trials (*.amc)")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--stride", 0), "stride must be at least 1, got 0"),
        (("--min-steps", 1), "min_steps must be at least 2, got 1"),
    ],
)
def test_values_that_make_no_sense(subject: Path, loader: Loader, words: tuple[object, ...], message: str):
    loader.refuses(subject, message, *words)


# --- The real recordings ----------------------------------------------------------------------------------------------


@pytest.mark.skipif("DGVAE_MOCAP" not in os.environ, reason="DGVAE_MOCAP names no folder with subjects 35 and 39")
@pytest.mark.parametrize(("subject", "trials", "frames"), [("35", 20, 7766), ("39", 12, 4621)])
def test_the_real_recordings_stand_on_the_ground(subject: str, trials: int, frames: int):
    folder = Path(os.environ["DGVAE_MOCAP"]) / subject
    skeleton = read_skeleton(folder / f"{subject}.asf")
    paths = sorted(folder.glob("*.amc"))
    assert (len(paths), len(skeleton.bones)) == (trials, 31)
    total = 0
    for path in paths:
        joints_m = joint_positions(skeleton, read_motion(path, skeleton))
        total += len(joints_m)
        for i, parent in enumerate(skeleton.parents[1:], start=1):
            length_m = np.linalg.norm(joints_m[:, i] - joints_m[:, parent], axis=-1)
            np.testing.assert_allclose(length_m, skeleton.lengths_m[i], atol=1e-9)
        height_m = dict(zip(skeleton.joint_names, joints_m[..., 1].T, strict=True))
        lowest_m = np.minimum(height_m["ltoes"], height_m["rtoes"])
        assert abs(lowest_m.min()) < 0.03  # a foot has touched the ground
        assert lowest_m.max() < 0.12  # and never are both far above it
        assert (height_m["head"] > height_m["root"] + 0.5).all()
        assert (1.3 < height_m["head"]).all() and (height_m["head"] < 2.0).all()
    assert total == frames
