"""Reads skeletons (ASF) and motions (AMC) in Acclaim's text formats, and computes joint positions from them.

Lengths are in the file's unit. Its `:units length` u means that one unit is 1/u inches; the CMU motion capture database
publishes u = 0.45, so one unit is 0.0254 / 0.45 = 0.0564 m.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from predictor.data.loading import bad_line, finite, read_lines, whole
from predictor.support.errors import UserError

LEAST_UNIT = 1e-6
"""Smallest unit of length that is read."""
METRES_PER_INCH = 0.0254
_ROOT_CHANNELS = ("TX", "TY", "TZ", "RX", "RY", "RZ")

Line = tuple[int, list[str]]
"""Line number and words."""


@dataclass(frozen=True)
class Bone:
    """One segment; its end is a joint. The root is a bone of length zero."""

    name: str
    """Name as in the files."""
    direction: tuple[float, float, float]
    """Unit vector along the bone in the rest pose, global frame."""
    length: float
    """Length in the file's unit."""
    axis_deg: tuple[float, float, float]
    """Rotation of the local frame [deg], one angle per letter of `order`."""
    order: str
    """Letters X, Y, Z in the order of the rotations."""
    channels: tuple[str, ...]
    """Channels in the motion file, in its order: some of RX, RY, RZ, and for the root TX, TY, TZ."""


@dataclass(frozen=True)
class Skeleton:
    """Joints (the root, then the end of each bone in the file's order) and the parent of each."""

    bones: tuple[Bone, ...]
    """Bones, the root first."""
    parents: tuple[int, ...]
    """Index of each joint's parent; -1 for the root."""
    position: tuple[float, float, float]
    """Position of the root in the rest pose, in the file's unit."""
    metres_per_unit: float
    """Length of the file's unit [m]."""

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints."""
        return tuple(bone.name for bone in self.bones)

    @property
    def lengths_m(self) -> Float[np.ndarray, " joints"]:
        """Distance of each joint from its parent [m]; 0 for the root."""
        return np.array([bone.length for bone in self.bones]) * self.metres_per_unit

    @property
    def parents_first(self) -> list[int]:
        """Indices of the joints, each parent before its children."""
        order = [0]
        for joint in order:
            order += [child for child, parent in enumerate(self.parents) if parent == joint]
        return order


def read_skeleton(path: Path) -> Skeleton:
    """Reads an .asf file.

    Raises:
        UserError: a part is missing, broken or of a kind that is not supported; names file and line.
    """
    sections = _sections(path)
    for name in ("units", "root", "bonedata", "hierarchy"):
        if name not in sections:
            raise bad_line(path, len(read_lines(path)), f"section :{name} is missing")
    root, position = _read_root(path, sections["root"])
    bones = (root, *_read_bones(path, sections["bonedata"]))
    parents = _read_hierarchy(path, sections["hierarchy"], [bone.name for bone in bones])
    return Skeleton(bones, parents, position, _read_unit(path, sections["units"]))


def _sections(path: Path) -> dict[str, list[Line]]:
    sections: dict[str, list[Line]] = {}
    current: list[Line] = []
    for number, text in enumerate(read_lines(path), start=1):
        words = text.split()
        if not words or words[0].startswith("#"):
            continue
        if words[0].startswith(":"):
            current = sections.setdefault(words[0][1:].lower(), [(number, words)])
        else:
            current.append((number, words))
    return sections


def _read_unit(path: Path, lines: list[Line]) -> float:
    for number, words in lines[1:]:
        if words[0] == "angle" and words[1:] != ["deg"]:
            raise bad_line(path, number, f"angles must be in deg, got {' '.join(words[1:])!r}", "convert the file")
    for number, words in lines[1:]:
        if words[0] == "length":
            unit = _numbers(path, number, words, 1)[0]
            if unit < LEAST_UNIT:
                least = f"at least {LEAST_UNIT:g}" if unit > 0 else "positive"
                raise bad_line(path, number, f"the unit of length must be {least}, got {unit:g}")
            return METRES_PER_INCH / unit
    raise bad_line(path, lines[0][0], ":units gives no length")


def _read_root(path: Path, lines: list[Line]) -> tuple[Bone, tuple[float, float, float]]:
    found = {words[0]: (number, words) for number, words in lines[1:]}
    for name in ("order", "axis", "position", "orientation"):
        if name not in found:
            raise bad_line(path, lines[0][0], f":root gives no {name}")
    number, words = found["order"]
    channels = tuple(word.upper() for word in words[1:])
    if sorted(channels) != sorted(_ROOT_CHANNELS):
        raise bad_line(path, number, f"the root's order must hold {' '.join(_ROOT_CHANNELS)}, got {' '.join(channels)}")
    order = _order(path, found["axis"][0], found["axis"][1][1:])
    position, orientation = (_numbers(path, *found[name], 3) for name in ("position", "orientation"))
    return Bone("root", (0.0, 0.0, 0.0), 0.0, _three(orientation), order, channels), _three(position)


def _read_bones(path: Path, lines: list[Line]) -> list[Bone]:
    bones: list[Bone] = []
    entry: dict[str, Line] | None = None
    for number, words in lines[1:]:
        if words[0] == "begin":
            entry = {"begin": (number, words)}
        elif entry is None:
            raise bad_line(path, number, f"expected 'begin' of a bone, got '{words[0]}'")
        elif words[0] == "end":
            bones.append(_bone(path, entry))
            if bones[-1].name in ("root", *(bone.name for bone in bones[:-1])):
                raise bad_line(path, number, f"bone '{bones[-1].name}' appears twice")
            entry = None
        else:
            entry[words[0]] = (number, words)
    if entry is not None:
        raise bad_line(path, entry["begin"][0], "a bone has no 'end'")
    if not bones:
        raise bad_line(path, lines[0][0], ":bonedata holds no bone")
    return bones


def _bone(path: Path, entry: dict[str, Line]) -> Bone:
    for name in ("name", "direction", "length", "axis"):
        if name not in entry or len(entry[name][1]) < 2:
            raise bad_line(path, entry["begin"][0], f"a bone has no {name}")
    direction = np.array(_numbers(path, *entry["direction"], 3))
    norm = float(np.linalg.norm(direction))
    if norm == 0:
        raise bad_line(path, entry["direction"][0], "a direction must not be zero")
    number, words = entry["axis"]
    axis_deg = _numbers(path, number, words[:4], 3)
    order = _order(path, number, words[4:])
    number, words = entry.get("dof", (number, ["dof"]))
    channels = tuple(word.upper() for word in words[1:])
    if len(set(channels)) != len(channels) or not set(channels) <= {"RX", "RY", "RZ"}:
        raise bad_line(path, number, f"dof must be some of rx ry rz, got {' '.join(words[1:])}", "convert the file")
    length = _numbers(path, *entry["length"], 1)[0]
    name = entry["name"][1][1]
    return Bone(name, _three((direction / norm).tolist()), length, _three(axis_deg), order, channels)


def _read_hierarchy(path: Path, lines: list[Line], names: list[str]) -> tuple[int, ...]:
    index = {name: i for i, name in enumerate(names)}
    parents: dict[int, int] = {0: -1}
    for number, words in lines[1:]:
        if words[0] in ("begin", "end"):
            continue
        for word in words:
            if word not in index:
                raise bad_line(path, number, f"bone '{word}' is not in :bonedata")
        if index[words[0]] not in parents:
            raise bad_line(path, number, f"bone '{words[0]}' must have a parent before it has children")
        for child in words[1:]:
            if index[child] in parents:
                raise bad_line(path, number, f"bone '{child}' has two parents")
            parents[index[child]] = index[words[0]]
    loose = [name for name, i in index.items() if i not in parents]
    if loose:
        raise bad_line(path, lines[0][0], f"no parent is given for {', '.join(loose)}")
    return tuple(parents[i] for i in range(len(names)))


def _order(path: Path, number: int, words: list[str]) -> str:
    order = "".join(words).upper()
    if sorted(order) != ["X", "Y", "Z"]:
        raise bad_line(path, number, f"an axis order must hold X, Y and Z, got '{order}'")
    return order


def _numbers(path: Path, number: int, words: list[str], count: int) -> list[float]:
    if len(words) != count + 1:
        raise bad_line(path, number, f"{words[0]} needs {count} numbers, got {len(words) - 1}")
    return [finite(word, words[0], path, number) for word in words[1:]]


def _three(values: list[float]) -> tuple[float, float, float]:
    x, y, z = values
    return x, y, z


def read_motion(path: Path, skeleton: Skeleton) -> Float[np.ndarray, "time channels"]:
    """Reads an .amc file that was recorded with the skeleton.

    Returns:
        Channels of all bones, in the skeleton's order: angles [deg]; root translations in the file's unit.

    Raises:
        UserError: frames are not consecutive, or bones are unknown, missing or have too few values; names file and
            line.
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
    return np.array(frames)


def _columns(skeleton: Skeleton) -> dict[str, slice]:
    """Returns the columns of the channels of each moving bone."""
    columns, begin = {}, 0
    for bone in skeleton.bones:
        if bone.channels:
            columns[bone.name] = slice(begin, begin + len(bone.channels))
        begin += len(bone.channels)
    return columns


def _check_frame(path: Path, number: int, flags: set[str], missing: set[str]) -> None:
    for flag in (":FULLY-SPECIFIED", ":DEGREES"):
        if flag not in flags:
            raise bad_line(path, number, f"the header must contain {flag}", "convert the file")
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
    """Computes the positions of the joints in each frame [m], in the axes of the files (y is up)."""
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
    """Computes rotations about fixed axes, the first letter of `order` first; one angle per letter."""
    total = np.broadcast_to(np.eye(3), (len(angles_deg), 3, 3))
    for angle, axis in zip(np.radians(angles_deg).T, order, strict=True):
        a, b = [(i + "XYZ".index(axis)) % 3 for i in (1, 2)]
        single = np.tile(np.eye(3), (len(angles_deg), 1, 1))
        single[:, a, a] = single[:, b, b] = np.cos(angle)
        single[:, b, a] = np.sin(angle)
        single[:, a, b] = -np.sin(angle)
        total = single @ total
    return total
