"""Text files of tracks as an episode store: `python -m predictor.data.tracks --source eth --out data/eth`.

Reads lines of frame, id, x, y, the form in which ETH/UCY and much other pedestrian data is published. Columns are
separated by spaces or tabs, by commas, or by semicolons; further columns are ignored unless they are asked for. Empty
lines and comments (from "#" or "%" on) are skipped, and so is a first line of names. Frames and ids are whole numbers,
also if they are written as 780.0. Each file is a recording with frames and ids of its own.

A source with folders `train`, `val` or `test` gives a store for each, `<out>/train` and so on; files beside these
folders are named, and left out. A source without them gives one store, and `--split` divides its files: the position
of SHA-256("0:<name>") in [0, 1) decides, below 0.1 test, below 0.2 validation, else training.

States: position and velocity [m, m/s], then the extra columns. Positions far from zero, as in coordinates of a map, are
moved by multiples of 10 km, file by file. Velocity is the backward difference over one step, so
a track's first step is dropped, and the first after a gap. Agents appear and disappear.
"""

import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from predictor.data.dataset_card import DatasetNotes, check_not_empty, most_present, save_dataset, summary
from predictor.data.loading import (
    LARGEST_WHOLE,
    NO_LIMIT_M,
    LoaderConfig,
    Split,
    bad_line,
    find_files,
    finite,
    in_split,
    read_lines,
)
from predictor.data.store import Episode
from predictor.data.track_doubts import doubts
from predictor.data.track_points import FAR_M, TrackPoints, cut_episodes, near_zero, with_velocities
from predictor.scene import KINEMATIC_FEATURES, SceneSpec
from predictor.support.command_line import parse
from predictor.support.config_checks import check_at_least, check_positive
from predictor.support.errors import UserError, run_entry_point
from predictor.support.files import check_out
from predictor.support.progress import track

FOLDERS: tuple[Split, ...] = ("train", "val", "test")
"""Folders of a source, each of which becomes a store."""
SPLIT_SEED = 0
"""Seed of the split of files that are in no such folders."""
MAX_AGENTS = 128
"""Least `max_agents` of a store; larger where more agents are present at once."""
COARSEST_M = 0.01
"""Largest distance between neighbouring numbers of float32 at which positions are kept [m]."""
RIGHTS = "Those of the source, which the files do not name: a store made from it falls under the same terms."

_COMMENT = re.compile("[#%]")


@dataclass(frozen=True)
class TracksConfig(LoaderConfig):
    """Turns text files of tracks (lines of frame, id, x, y) into an episode store."""

    pattern: str = "*.txt"
    """Pattern of the files' names, in the source or in each of its folders train, val and test."""
    columns: tuple[int, int, int, int] = (1, 2, 3, 4)
    """Numbers of the columns of frame, id, x and y, counted from 1."""
    extra_columns: tuple[int, ...] = ()
    """Numbers of further columns that the state keeps, unchanged; they hold numbers."""
    scale: float = 1.0
    """Length of one unit of x and y [m]."""
    frame_step: int = 0
    """Number of frames from one step to the next; 0 takes the distance of the frames in the files, if all agree."""
    dt_s: float = 0.4
    """Time between steps [s]; 0.4 is customary for pedestrians."""
    episode_steps: int = 50
    """Length of the episodes into which recordings are cut [steps]; 0 keeps each recording whole."""
    network_scales: tuple[float, float] = (5.0, 1.0)
    """Scales of positions [m] and velocities [m/s] for networks, equal for all stores of a dataset: about their
    standard deviations, which the card has."""

    def __post_init__(self) -> None:
        """Checks choices and ranges.

        Raises:
            UserError: a value out of range.
        """
        super().__post_init__()
        check_at_least(self, 1, "columns", "extra_columns")
        check_at_least(self, 0, "frame_step", "episode_steps")
        check_positive(self, "scale", "dt_s")
        if self.episode_steps == 1:
            raise UserError("episode_steps must be 0 or at least 2, got 1")
        if len(set(self.columns + self.extra_columns)) < len(self.columns + self.extra_columns):
            raise UserError(
                f"columns and extra_columns must differ from each other, got {self.columns} and {self.extra_columns}"
            )
        if not all(0 < scale < math.inf for scale in self.network_scales):
            raise UserError(f"network_scales must be positive, got {self.network_scales}")


@dataclass(frozen=True)
class Recording:
    """Lines of one file."""

    frames: Int[np.ndarray, " lines"]
    """Numbers of the frames."""
    ids: Int[np.ndarray, " lines"]
    """Identity of the agent within the file."""
    values: Float[np.ndarray, "lines values"]
    """x and y in the file's unit, then the extra columns."""

    @property
    def frame_distance(self) -> int:
        """Greatest number of which all distances between frames are multiples; 0 with fewer than two frames."""
        return int(np.gcd.reduce(np.diff(np.unique(self.frames)), initial=0))

    @property
    def track_distance(self) -> int:
        """The commonest number of frames from one line of a track to its next; 0 if no track has two lines."""
        order = np.lexsort((self.frames, self.ids))
        apart = np.diff(self.frames[order])[np.diff(self.ids[order]) == 0]
        values, counts = np.unique(apart, return_counts=True)
        return int(values[counts.argmax()]) if len(values) else 0


def read_recording(path: Path, config: TracksConfig, counts: Counter[str]) -> Recording:
    """Reads one file.

    Raises:
        UserError: a line is broken or repeats an id in a frame; names file and line.
    """
    keys: list[tuple[int, int]] = []
    values: list[list[float]] = []
    seen: dict[tuple[int, int], int] = {}
    begun = False
    for number, text in enumerate(read_lines(path), start=1):
        words = _words(_COMMENT.split(text, maxsplit=1)[0])
        if not words:
            continue
        chosen = _chosen(path, number, words, config)
        first, begun = not begun, True
        if first and not any(_is_number(word) for word in chosen[:4]):
            counts["lines of names skipped"] += 1
            continue
        frame, agent = _whole(chosen[0], "frame", path, number), _whole(chosen[1], "id", path, number)
        if agent < 0:
            raise bad_line(path, number, f"id must be at least 0, got {agent}")
        if seen.setdefault((agent, frame), number) != number:
            raise bad_line(path, number, f"agent {agent} has frame {frame} in line {seen[agent, frame]} already")
        names = ("x", "y", *(f"column {column}" for column in config.extra_columns))
        values.append([finite(word, name, path, number) for name, word in zip(names, chosen[2:], strict=True)])
        keys.append((frame, agent))
    if not keys:
        raise UserError(f"{path} holds no line of a track; remove the file or choose others with --pattern")
    counts["lines read"] += len(keys)
    frames, ids = np.array(keys, dtype=np.int64).T
    return Recording(frames, ids, np.array(values))


def _words(text: str) -> list[str]:
    """Returns the columns of a line without quotes; an empty one between two commas, semicolons or tabs stays one."""
    separator = next((sign for sign in (";", ",") if sign in text), "\t" if "\t\t" in text.strip() else None)
    return [word.strip().strip('"') for word in text.split(separator)]


def _chosen(path: Path, number: int, words: list[str], config: TracksConfig) -> list[str]:
    wanted = config.columns + config.extra_columns
    if len(words) < max(wanted):
        hint = (
            "; commas separate columns: numbers need a decimal point" if any(len(w.split()) > 1 for w in words) else ""
        )
        raise bad_line(
            path, number, f"expected at least {max(wanted)} columns (frame, id, x, y are {config.columns}), "
            f"got {len(words)}{hint}",
        )  # fmt: skip
    return [words[column - 1] for column in wanted]


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _whole(text: str, name: str, path: Path, number: int) -> int:
    """Returns a whole number from text such as 780, 780.0 or 7.8e+02."""
    value = finite(text, name, path, number)
    if value != round(value) or abs(value) > LARGEST_WHOLE:
        raise bad_line(path, number, f"{name} must be a whole number of at most 15 digits, got '{text}'")
    return round(value)


def common_frame_step(recordings: Mapping[Path, Recording]) -> int:
    """Returns the number of frames from one step to the next, which all recordings have in common.

    Raises:
        UserError: they differ, or the tracks of one go on in other steps.
    """
    for path, recording in recordings.items():
        distance, common = recording.frame_distance, recording.track_distance
        if common not in (0, distance):
            raise UserError(
                f"frames of {path} are {distance} apart, but most lines of its tracks follow after {common}; pass "
                f"--frame-step {common}, or the number of frames in a step of dt_s"
            )
    found = {path: r.frame_distance for path, r in recordings.items() if r.frame_distance}
    for path, distance in found.items():
        first = next(iter(found))
        if distance != found[first]:
            raise UserError(
                f"frames of {first} are {found[first]} apart, those of {path} {distance}; pass --frame-step, "
                "the number of frames in a step of dt_s"
            )
    return next(iter(found.values()), 1)


def points_of(recording: Recording, frame_step: int, config: TracksConfig, counts: Counter[str]) -> TrackPoints:
    """Returns the states of a recording at every `frame_step`-th frame, counted from its first one.

    Raises:
        UserError: positions are so far apart that float32 does not tell neighbouring ones apart.
    """
    since = recording.frames - recording.frames.min()
    kept = since % frame_step == 0
    counts["lines dropped: between steps"] += int((~kept).sum())
    positions_m, moved = near_zero(recording.values[kept, :2] * config.scale)
    if moved:
        counts[f"files moved towards zero by multiples of {FAR_M / 1000:g} km"] += 1
    farthest_m = np.abs(positions_m).max(initial=0.0)
    coarse_m = np.spacing(np.float32(farthest_m))
    if coarse_m > COARSEST_M:
        raise UserError(
            f"positions lie up to {farthest_m:.3g} m from their mean, where float32 has steps of {coarse_m:.2g} m; "
            "check --scale and --columns, or split the file by place"
        )
    points = TrackPoints(since[kept] // frame_step, recording.ids[kept], positions_m)
    moving, velocities_mps, origin = with_velocities(points, config.dt_s)
    counts["lines dropped: no velocity (first of a track or after a gap)"] += len(points) - len(moving)
    extra = recording.values[kept, 2:][origin]
    return TrackPoints(moving.steps, moving.tracks, np.concatenate([moving.states, velocities_mps, extra], axis=-1))


def scene_spec(config: TracksConfig, agents: int = 0) -> SceneSpec:
    """Returns the layout of the states."""
    extra = tuple(f"column_{column}" for column in config.extra_columns)
    position, velocity = config.network_scales
    return SceneSpec(
        config.dt_s,
        ("centroid", "centroid"),
        KINEMATIC_FEATURES + extra,
        (position, position, velocity, velocity, *(1.0 for _ in extra)),
        has_ego=False,
        perception_m=NO_LIMIT_M,
        max_agents=max(MAX_AGENTS, agents),
    )


@dataclass(frozen=True)
class Part:
    """One store that is to be written."""

    config: TracksConfig
    """Options, with the paths and the split of this store."""
    files: tuple[Path, ...]
    """All files of its source."""
    chosen: tuple[Path, ...]
    """Files of its split."""
    others: tuple[Path, ...] = ()
    """Files of the source's other splits, whose frames must be as far apart; they go into other stores."""


def parts_of(config: TracksConfig) -> list[Part]:
    """Returns what is to be written: a store for each of the source's folders train, val and test, or one for all.

    Raises:
        UserError: no source, no files, an output that may not be replaced, or a split that is no folder.
    """
    folders = [name for name in FOLDERS if (config.source / name).is_dir()]
    if not folders:
        config.check_paths()
        files = tuple(find_files(config.source, config.pattern, "files of tracks"))
        chosen = [path for path in files if in_split(label_of(path, config.source), config.split, SPLIT_SEED)]
        return [Part(config, files, tuple(chosen), tuple(path for path in files if path not in chosen))]
    if config.split not in ("all", *folders):
        raise UserError(f"{config.source} has the folders {', '.join(folders)}, no {config.split}; leave out --split")
    check_out(config.out, only_stores=True)
    parts = []
    for name in folders:
        if config.split in ("all", name):
            part = replace(config, source=config.source / name, out=config.out / name, split=name)
            part.check_paths()
            files = tuple(find_files(part.source, part.pattern, "files of tracks"))
            beside = [p for n in folders if n not in ("all", name) for p in (config.source / n).glob(config.pattern)]
            parts.append(Part(part, files, files, () if config.split == "all" else tuple(sorted(beside))))
    return parts


def files_beside(config: TracksConfig) -> list[Path]:
    """Returns the files of a source that stand beside its folders train, val and test, and go into no store."""
    if not any((config.source / name).is_dir() for name in FOLDERS):
        return []
    found = [path for path in config.source.glob(config.pattern) if path.is_file()]
    return sorted(path for path in found if path.relative_to(config.source).parts[0] not in FOLDERS)


def load(parts: Sequence[Part]) -> list[tuple[list[Episode], DatasetNotes]]:
    """Reads all files.

    Returns:
        For each part, its episodes and the notes for its card.

    Raises:
        UserError: a file is broken, files differ in the distance of their frames, positions are too far apart, or a
            part has no episode.
    """
    counts: list[Counter[str]] = [
        Counter({"files": len(part.files), f"files of split '{part.config.split}'": len(part.chosen)}) for part in parts
    ]
    files = [(i, path) for i, part in enumerate(parts) for path in part.chosen]
    recordings = {path: read_recording(path, parts[i].config, counts[i]) for i, path in track(files, "tracks")}
    frame_step = parts[0].config.frame_step
    if not frame_step:
        others = {path: read_recording(path, part.config, Counter()) for part in parts for path in part.others}
        frame_step = common_frame_step(recordings | others)
    loaded = []
    for part, found in zip(parts, counts, strict=True):
        episodes: list[Episode] = []
        for path in part.chosen:
            try:
                points = points_of(recordings[path], frame_step, part.config, found)
            except UserError as error:
                raise UserError(f"{path}: {error}") from error
            label = label_of(path, part.config.source)
            episodes += cut_episodes(points, part.config.episode_steps or _whole_length(points), label, found)
        numbered = [replace(episode, seed=i) for i, episode in enumerate(episodes)]
        notes = _notes(part.config, frame_step, found)
        check_not_empty(part.config, numbered, notes)
        loaded.append((numbered, notes))
    return loaded


def label_of(path: Path, source: Path) -> str:
    """Returns what a recording is called: its path in the source, which may be the file itself, without the suffix."""
    return path.relative_to(source).with_suffix("").as_posix() if path != source else path.stem


def _whole_length(points: TrackPoints) -> int:
    return int(np.ptp(points.steps)) + 1 if len(points) else 1


def _notes(config: TracksConfig, frame_step: int, counts: Counter[str]) -> DatasetNotes:
    name = config.source.resolve()
    title = f"{name.parent.name}/{name.name}" if name.name in FOLDERS else name.stem
    steps = config.episode_steps
    cut = f"Recordings are cut into episodes of {steps} steps that do not overlap; the last of each may be shorter."
    return DatasetNotes(
        f"Tracks, {title}",
        "Positions of agents by frame, read from text files. An agent's id is that of the file; a label is the "
        "file's path in the source, without its suffix.",
        RIGHTS,
        (
            f"Columns {', '.join(map(str, config.columns))} are frame, id, x and y; one unit is {config.scale:g} m.",
            f"A step is {config.dt_s:g} s. Of each file, frames that are a multiple of {frame_step} after the first "
            "one are kept.",
            "Velocity is the backward difference over one step; a track's first step is dropped, and the first after "
            "a gap.",
            cut if steps else "Each recording is one episode, from its first step with an agent to its last.",
        ),
        dict(counts),
        "check --columns (are frame and id swapped?), --frame-step and --split",
    )


def main() -> None:
    """Entry point."""
    config = parse(TracksConfig, __doc__)
    parts = parts_of(config)
    loaded = load(parts)
    agents = max(most_present(episodes) for episodes, _ in loaded)
    for part, (episodes, notes) in zip(parts, loaded, strict=True):
        save_dataset(part.config, scene_spec(part.config, agents), episodes, notes, part.files)
        print(summary(part.config, episodes))
        for doubt in doubts(episodes, notes.counts):
            print(f"warning: {doubt}")
        labels = {episode.label for episode in episodes}
        for path in part.chosen:
            if label_of(path, part.config.source) not in labels:
                print(f"warning: {path} has no episode: nobody is there in two frames a step apart, from its first on")
    for path in files_beside(config):
        print(f"warning: {path} is in none of the folders {', '.join(FOLDERS)}, and in no store")


if __name__ == "__main__":
    run_entry_point(main)
