"""Motions in Acclaim's text format (AMC), and where the joints are: forward kinematics.

Convention of the formats: each bone has a local frame, turned by its `axis` against the global one in the rest pose.
With C that turn and M the turn by the frame's angles, both composed in the bone's axis order (XYZ: x first, then y,
then z, all about fixed axes), a bone turns its children by C·M·C⁻¹; its direction is given in the global frame. So

    R_bone = R_parent · C · M · C⁻¹,    end_bone = end_parent + length · R_bone · direction.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from predictor.data.asf import Skeleton
from predictor.data.common import bad_line, finite, read_lines, whole
from predictor.errors import UserError


@dataclass(frozen=True)
class Motion:
    """Recorded channels, bone by bone in the skeleton's order."""

    values: Float[np.ndarray, "time channels"]
    """Degrees; root translations in the file's unit."""
    first_frame: int
    """Number of the first frame; trials may begin late."""


def read_motion(path: Path, skeleton: Skeleton) -> Motion:
    """Read an .amc file that was recorded with the skeleton.

    Raises:
        UserError: frames that are not consecutive, bones that are unknown, missing or have too few values; names file
            and line.
    """
    columns = _columns(skeleton)
    flags: set[str] = set()
    frames: list[list[float]] = []
    first, seen, number = 0, set(columns), 0
    for number, text in enumerate(read_lines(path), start=1):
        words = text.split()
        if not words or words[0].startswith("#"):
            continue
        if words[0].startswith(":"):
            flags.add(words[0].upper())
        elif len(words) == 1:
            _check_frame(path, number, flags, set(columns) - seen)
            frame = whole(words[0], "a frame number", path, number)
            first = frame if not frames else first
            if frame != first + len(frames):
                expected = first + len(frames)
                raise bad_line(path, number, f"frame numbers must be consecutive: expected {expected}, got {frame}")
            frames.append([0.0] * sum(len(bone.channels) for bone in skeleton.bones))
            seen = set()
        else:
            if not frames:
                raise bad_line(path, number, f"expected a frame number before '{words[0]}'")
            _fill(path, number, words, columns, seen, frames[-1])
    _check_frame(path, number, flags, set(columns) - seen)
    if not frames:
        raise UserError(f"{path} holds no frame; get the file anew")
    return Motion(np.array(frames), first)


def _columns(skeleton: Skeleton) -> dict[str, slice]:
    """Where the channels of each moving bone are."""
    columns, begin = {}, 0
    for bone in skeleton.bones:
        if bone.channels:
            columns[bone.name] = slice(begin, begin + len(bone.channels))
        begin += len(bone.channels)
    return columns


def _check_frame(path: Path, number: int, flags: set[str], missing: set[str]) -> None:
    for flag in (":FULLY-SPECIFIED", ":DEGREES"):
        if flag not in flags:
            raise bad_line(path, number, f"the header must say {flag}", "convert the file")
    if missing:
        raise bad_line(path, number, f"the frame that ends here lacks {', '.join(sorted(missing))}")


def _fill(
    path: Path, number: int, words: list[str], columns: dict[str, slice], seen: set[str], frame: list[float]
) -> None:
    name = words[0]
    if name not in columns:
        raise bad_line(path, number, f"the skeleton has no moving bone '{name}'", "use the .asf of this subject")
    if name in seen:
        raise bad_line(path, number, f"bone '{name}' appears twice in a frame")
    place = columns[name]
    if len(words) - 1 != place.stop - place.start:
        raise bad_line(path, number, f"bone '{name}' needs {place.stop - place.start} values, got {len(words) - 1}")
    frame[place] = [finite(word, f"a value of '{name}'", path, number) for word in words[1:]]
    seen.add(name)


def joint_positions(
    skeleton: Skeleton, values: Float[np.ndarray, "time channels"]
) -> Float[np.ndarray, "time joints 3"]:
    """Where the joints are in each frame [m], in the axes of the files (y is up)."""
    columns = _columns(skeleton)
    positions = np.zeros((len(values), len(skeleton.bones), 3))
    turns: dict[int, np.ndarray] = {}
    for joint in skeleton.parents_first:
        bone, parent = skeleton.bones[joint], skeleton.parents[joint]
        given = dict(zip(bone.channels, values[:, columns.get(bone.name, slice(0))].T, strict=True))
        zero = np.zeros(len(values))
        frame = rotation(np.array(bone.axis_deg)[None], bone.order)
        motion = rotation(np.stack([given.get(f"R{axis}", zero) for axis in bone.order], axis=-1), bone.order)
        local = frame @ motion @ frame.swapaxes(-1, -2)
        if parent < 0:
            turns[joint] = local
            moved = np.stack([given[f"T{axis}"] for axis in "XYZ"], axis=-1)
            positions[:, joint] = np.array(skeleton.position) + moved
        else:
            turns[joint] = turns[parent] @ local
            positions[:, joint] = positions[:, parent] + bone.length * turns[joint] @ np.array(bone.direction)
    return positions * skeleton.metres_per_unit


def rotation(angles_deg: Float[np.ndarray, "time 3"], order: str) -> Float[np.ndarray, "time 3 3"]:
    """Turn about fixed axes, the first letter of `order` first; one angle per letter."""
    total = np.broadcast_to(np.eye(3), (len(angles_deg), 3, 3))
    for angle, axis in zip(np.radians(angles_deg).T, order, strict=True):
        a, b = [(i + "XYZ".index(axis)) % 3 for i in (1, 2)]
        single = np.tile(np.eye(3), (len(angles_deg), 1, 1))
        single[:, a, a] = single[:, b, b] = np.cos(angle)
        single[:, b, a] = np.sin(angle)
        single[:, a, b] = -np.sin(angle)
        total = single @ total
    return total
