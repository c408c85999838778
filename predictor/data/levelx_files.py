"""Reads recordings in the CSV layouts of levelXData: inD, rounD, exiD (one layout) and highD (another).

Three files per recording XX: `XX_tracks.csv`, `XX_tracksMeta.csv`, `XX_recordingMeta.csv`. Columns that are not used
are not read. Both layouts give equal columns: centre of the vehicle [m], velocity [m/s], heading, acceleration along
and across the heading [m/s²], class.

highD gives the upper left corner of a box in the image, whose y points down, and no heading: its y, vy and ay change
sign, and a vehicle heads along its road's direction.
"""

import csv
import os
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from predictor.data.loading import LARGEST_WHOLE, bad_line, finite, read_lines, whole
from predictor.data.track_points import TrackPoints
from predictor.scene import LARGEST
from predictor.support.errors import UserError
from predictor.support.reading import MOST_TEXT_BYTES, check_regular

Layout = Literal["centre", "corner"]
"""Column layout of a recording: "centre" is that of inD, rounD and exiD, "corner" that of highD."""
Features = Literal["kinematic", "full"]

CLASS_FEATURES = ("is_car", "is_truck_bus", "is_pedestrian", "is_bicycle")
CLASSES = {
    "car": 0,
    "van": 0,
    "truck": 1,
    "bus": 1,
    "truck_bus": 1,
    "trailer": 1,
    "pedestrian": 2,
    "bicycle": 3,
    "motorcycle": 3,
}
"""Class in tracksMeta (in lower case) → column of `CLASS_FEATURES`."""

_ID = {"centre": "trackId", "corner": "id"}
_KINEMATIC = {
    "centre": ("frame", "trackId", "xCenter", "yCenter", "xVelocity", "yVelocity"),
    "corner": ("frame", "id", "x", "y", "width", "height", "xVelocity", "yVelocity"),
}
_FULL = {
    "centre": ("heading", "lonAcceleration", "latAcceleration"),
    "corner": ("xAcceleration", "yAcceleration"),
}
_LEFT_DIRECTION = 1
"""Value of highD's drivingDirection for the upper road, where x falls; 2 is the lower one."""


@dataclass(frozen=True)
class Recording:
    """Name and files of one recording, with location and frame rate from its meta file."""

    name: str
    """Name as in the file names, such as "00"."""
    location: str
    """Key of the location; recordings of one location share a map."""
    frames_per_s: float
    """Frame rate [Hz]."""
    tracks: Path
    """Path of XX_tracks.csv."""
    tracks_meta: Path
    """Path of XX_tracksMeta.csv."""
    meta: Path
    """Path of XX_recordingMeta.csv."""


@dataclass(frozen=True)
class TrackInfo:
    """One line of tracksMeta."""

    kind: int
    """Index of the class in `CLASS_FEATURES`."""
    towards_left: bool
    """Whether the vehicle drives on the upper road, against x (highD)."""


def open_recording(tracks: Path) -> Recording:
    """Finds the files that belong to XX_tracks.csv and reads the recording's meta file.

    Raises:
        UserError: a file is missing or broken.
    """
    name = tracks.name.removesuffix("_tracks.csv")
    tracks_meta, meta = tracks.with_name(f"{name}_tracksMeta.csv"), tracks.with_name(f"{name}_recordingMeta.csv")
    for path in (tracks_meta, meta):
        if not os.path.lexists(path):
            raise UserError(f"{tracks} needs {path.name} beside it, which is missing; copy all three files")
    lines = _read_meta(meta, ("frameRate", "locationId"))
    if len(lines) != 1:
        raise bad_line(meta, len(lines) + 1, f"expected one recording, got {len(lines)}")
    line, values = lines[0]
    rate = finite(values["frameRate"], "frameRate", meta, line)
    if rate <= 0:
        raise bad_line(meta, line, f"frameRate must be positive, got {rate:g}")
    return Recording(name, values["locationId"], rate, tracks, tracks_meta, meta)


def layout_of(tracks: Path) -> Layout:
    """Returns the layout that the header shows.

    Raises:
        UserError: the header has neither layout.
    """
    header = _header(tracks)
    if "xCenter" in header or "trackId" in header:
        return "centre"
    if "id" in header and "x" in header:
        return "corner"
    raise bad_line(
        tracks,
        1,
        f"expected the columns of inD, rounD, exiD ({', '.join(_KINEMATIC['centre'])}) or of highD "
        f"({', '.join(_KINEMATIC['corner'])}), got {', '.join(header)}",
        "pass levelXData's own files",
    )


def read_tracks(recording: Recording, features: Features, stride: int) -> TrackPoints:
    """Reads the states of every stride-th frame; columns as `predictor.data.levelx` names them.

    Raises:
        UserError: a missing column, a broken or repeated line, a track without meta data; names file and line.
    """
    path, layout = recording.tracks, layout_of(recording.tracks)
    names = _KINEMATIC[layout] + (_FULL[layout] if features == "full" else ())
    table = _read_table(path, names)
    values = dict(zip(names, table.T, strict=True))
    frames, tracks = (_whole_column(path, values[name], name) for name in ("frame", _ID[layout]))
    _check_unique(path, frames, tracks)
    info = _read_tracks_meta(recording.tracks_meta, layout) if features == "full" else {}
    kept = frames % stride == 0
    frames, tracks, values = frames[kept], tracks[kept], {name: column[kept] for name, column in values.items()}
    if features == "full":
        places = np.flatnonzero(kept)
        for i in np.unique(tracks, return_index=True)[1].tolist():
            if int(tracks[i]) not in info:
                line = _line_of(path, int(places[i]))
                raise bad_line(path, line, f"track {tracks[i]} is not in {recording.tracks_meta.name}")
    known = [info[track] for track in tracks.tolist()] if features == "full" else []
    return TrackPoints(frames // stride, tracks, _states(layout, values, known))


def _states(layout: Layout, values: dict[str, np.ndarray], known: list[TrackInfo]) -> Float[np.ndarray, "points state"]:
    """Returns the kinematic columns; with `known` (one entry per point) all columns."""
    vx, vy = values["xVelocity"], values["yVelocity"]
    if layout == "centre":
        columns = [values["xCenter"], values["yCenter"], vx, vy]
    else:
        x, y = values["x"] + values["width"] / 2, values["y"] + values["height"] / 2
        columns = [x, -y, vx, -vy]
    if known:
        if layout == "centre":
            heading_rad = np.radians(values["heading"])
            cos, sin = np.cos(heading_rad), np.sin(heading_rad)
            along, across = values["lonAcceleration"], values["latAcceleration"]
        else:
            cos = np.array([-1.0 if track.towards_left else 1.0 for track in known])
            sin = np.zeros_like(cos)
            along, across = cos * values["xAcceleration"], -cos * values["yAcceleration"]
        one_hot = np.eye(len(CLASS_FEATURES))[[track.kind for track in known]]
        columns += [cos, sin, along, across, *one_hot.T]
    return np.stack(columns, axis=-1)


def _read_tracks_meta(path: Path, layout: Layout) -> dict[int, TrackInfo]:
    extra = ("drivingDirection",) if layout == "corner" else ()
    info = {}
    for line, values in _read_meta(path, (_ID[layout], "class", *extra)):
        kind = values["class"].strip().lower()
        if kind not in CLASSES:
            raise bad_line(path, line, f"class must be one of {', '.join(CLASSES)}, got '{values['class']}'")
        direction = whole(values["drivingDirection"], "drivingDirection", path, line) if extra else 0
        track = whole(values[_ID[layout]], _ID[layout], path, line)
        if track in info:
            raise bad_line(path, line, f"{_ID[layout]} {track} is there already")
        info[track] = TrackInfo(CLASSES[kind], direction == _LEFT_DIRECTION)
    return info


# --- CSV --------------------------------------------------------------------------------------------------------------


def _header(path: Path) -> list[str]:
    check_regular(path, MOST_TEXT_BYTES)
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        return [name.strip() for name in file.readline().split(",")]


def _check_columns(path: Path, header: list[str], names: tuple[str, ...]) -> None:
    missing = [name for name in names if name not in header]
    if missing:
        raise bad_line(
            path, 1, f"column {', '.join(missing)} is missing, got {', '.join(header)}", "pass levelXData's own files"
        )


def _read_meta(path: Path, names: tuple[str, ...]) -> list[tuple[int, dict[str, str]]]:
    """Returns the lines of a small table by column name, with their line numbers."""
    _check_columns(path, _header(path), names)
    reader = csv.DictReader(read_lines(path), skipinitialspace=True)
    lines = []
    try:
        for values in reader:
            if any(values.get(name) is None for name in names):
                raise bad_line(path, reader.line_num, "the line has too few columns")
            lines.append((reader.line_num, values))
    except csv.Error as error:
        raise bad_line(path, reader.line_num, f"no line of a table ({error})") from error
    return lines


def _read_table(path: Path, names: tuple[str, ...]) -> Float[np.ndarray, "lines columns"]:
    """Reads columns of a large table of numbers at once, and line by line only to find a fault."""
    header = _header(path)
    _check_columns(path, header, names)
    columns = [header.index(name) for name in names]
    try:
        with warnings.catch_warnings(action="ignore"):  # an empty table is an error below
            table = np.loadtxt(
                path, delimiter=",", skiprows=1, usecols=columns, ndmin=2, comments=None, encoding="utf-8"
            )
        if (np.abs(table) <= LARGEST).all() and len(table):
            return table
    except ValueError:  # also text that is not UTF-8
        pass
    raise _find_fault(path, header, names, columns)


def _find_fault(path: Path, header: list[str], names: tuple[str, ...], columns: list[int]) -> UserError:
    """Returns the error that names the first line of a table with something other than numbers."""
    filled = 0
    for number, text in enumerate(read_lines(path)[1:], start=2):
        words = text.split(",")
        if not text:
            continue
        if not text.strip():
            return bad_line(path, number, "it holds only blanks", "delete it")
        filled += 1
        if len(words) <= max(columns):
            return bad_line(path, number, f"expected {len(header)} columns, got {len(words)}")
        for name, column in zip(names, columns, strict=True):
            finite(words[column], name, path, number)
    if not filled:
        return UserError(f"{path} holds no track; get the file anew")
    return UserError(f"{path} is not a table of numbers separated by commas; get the file anew")


def _line_of(path: Path, place: int) -> int:
    """Returns the line number in the file of an entry of the table; blank lines are not entries."""
    filled = [number for number, text in enumerate(read_lines(path)[1:], start=2) if text]
    return filled[place]


def _whole_column(path: Path, column: Float[np.ndarray, " lines"], name: str) -> Int[np.ndarray, " lines"]:
    with np.errstate(invalid="ignore"):  # too large for an integer: caught as not whole
        numbers = column.astype(np.int64)
    wrong = np.flatnonzero((numbers != column) | (numbers < 0) | (numbers > LARGEST_WHOLE))
    if len(wrong):
        value = f"{name} must be a whole number from 0 up, of at most 15 digits, got {column[wrong[0]]:g}"
        raise bad_line(path, _line_of(path, int(wrong[0])), value)
    return numbers


def _check_unique(path: Path, frames: Int[np.ndarray, " lines"], tracks: Int[np.ndarray, " lines"]) -> None:
    order = np.lexsort((frames, tracks))
    again = np.flatnonzero((np.diff(tracks[order]) == 0) & (np.diff(frames[order]) == 0))
    if len(again):
        first, second = sorted(order[again[0] : again[0] + 2].tolist())
        raise bad_line(
            path,
            _line_of(path, second),
            f"track {tracks[first]} has frame {frames[first]} in line {_line_of(path, first)} already",
        )
