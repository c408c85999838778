"""Stanford Drone Dataset as an episode store: `python -m predictor.data.sdd --source SDD --out data/sdd`.

Reads `<scene>/<video>/annotations.txt` (track, xmin, ymin, xmax, ymax, frame, lost, occluded, generated, "label";
pixels, 30 Hz) and `estimated_scales.yaml` (metres per pixel). The position of an agent is the centre of its box; x to
the right and y down, as in the image. The number of agents varies from step to step.

States: position and velocity [m, m/s], and three columns of which one is 1: pedestrian; biker (also skateboarders:
small wheels, no engine, faster than people on foot); vehicle (cars, buses, golf carts).

Lines that are marked lost are dropped. Every 12th frame is kept (0.4 s). Velocity is the backward difference over one
step, so a track's first step is dropped, and the first after a gap. Splits are by video: the position of
SHA-256("405:<scene>/<video>") in [0, 1) decides, below 0.1 test, below 0.2 validation, else training.
"""

from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from predictor.data.dataset_card import DatasetNotes, most_present, save_dataset, summary
from predictor.data.loading import (
    NO_LIMIT_M,
    LoaderConfig,
    bad_line,
    find_files,
    finite,
    frames_per_step,
    in_split,
    read_lines,
    whole,
)
from predictor.data.store import Episode
from predictor.data.track_points import TrackPoints, cut_episodes, with_velocities
from predictor.scene import KINEMATIC_FEATURES, SceneSpec
from predictor.support.command_line import parse
from predictor.support.config_checks import check_at_least
from predictor.support.errors import UserError, run_entry_point
from predictor.support.progress import track

LARGEST_SCALE = 1e6
"""Largest scale [m/pixel]."""
FRAMES_PER_S = 30.0
"""Frame rate of the videos [Hz]."""
SPLIT_SEED = 405
"""Seed of the split: gives shares near 80/10/10 of all 60 videos, and several scenes in validation and test."""
CLASSES = {"Pedestrian": 0, "Biker": 1, "Skater": 1, "Cart": 2, "Car": 2, "Bus": 2}
"""Class by label: index of its column after the kinematic ones."""
FEATURES = (*KINEMATIC_FEATURES, "is_pedestrian", "is_biker", "is_vehicle")
FEATURE_SCALES = (15.0, 15.0, 1.5, 1.5, 1.0, 1.0, 1.0)
"""Scales of the states: about the standard deviations around the centroid [m, m/s]."""
MAX_AGENTS = 128
"""Least `max_agents` of a store; larger where more agents are present at once."""
SCALES_FILE = "estimated_scales.yaml"
RIGHTS = (
    "Creative Commons Attribution-NonCommercial-ShareAlike 3.0 (CC BY-NC-SA 3.0). Cite Robicquet, Sadeghian, Alahi, "
    "Savarese: Learning social etiquette: human trajectory understanding in crowded scenes, ECCV 2016. A store made "
    "from it falls under the same licence. The scales are estimates by the OpenTraj project."
)


@dataclass(frozen=True)
class SddConfig(LoaderConfig):
    """Turns the annotations of the Stanford Drone Dataset into an episode store."""

    dt_s: float = 0.4
    """Time between steps [s]; whole frames of 1/30 s. 0.4 is customary for this dataset."""
    episode_steps: int = 50
    """Length of the episodes into which videos are cut [steps]."""

    def __post_init__(self) -> None:
        """Checks choices and ranges.

        Raises:
            UserError: a value out of range.
        """
        super().__post_init__()
        frames_per_step(self.dt_s, FRAMES_PER_S, "the dataset")
        check_at_least(self, 2, "episode_steps")


def scene_spec(dt_s: float, agents: int = 0) -> SceneSpec:
    """Returns the layout of the states."""
    return SceneSpec(
        dt_s,
        ("centroid", "centroid"),
        FEATURES,
        FEATURE_SCALES,
        has_ego=False,
        perception_m=NO_LIMIT_M,
        max_agents=max(MAX_AGENTS, agents),
    )


def read_scales(path: Path) -> dict[str, float]:
    """Reads metres per pixel by "scene/video".

    The file has three levels of indentation (scene, video, `scale` and `certainty`); nothing else of YAML is read.

    Raises:
        UserError: a line of another kind, or a scale that is not positive; names file and line.
    """
    scales: dict[str, float] = {}
    scene, video = "", ""
    for number, text in enumerate(read_lines(path), start=1):
        content = text.split("#")[0].rstrip()
        if not content or content == "---":  # YAML's mark of a beginning
            continue
        name, colon, value = (part.strip() for part in content.strip().partition(":"))
        if not colon or not name:
            raise bad_line(path, number, f"expected 'name:' or 'name: number', got '{content.strip()}'")
        if not value:
            if content[0].isspace():
                video = name
            else:
                scene, video = name, ""
        elif not scene or not video:
            raise bad_line(path, number, f"'{name}' belongs to no video")
        elif name == "scale":
            scale = finite(value, "scale", path, number)
            if not 0 < scale <= LARGEST_SCALE:
                least = f"at most {LARGEST_SCALE:g}" if scale > 0 else "positive"
                raise bad_line(path, number, f"scale must be {least}, got {scale:g}")
            if f"{scene}/{video}" in scales:
                raise bad_line(path, number, f"{scene}/{video} has a scale already")
            scales[f"{scene}/{video}"] = scale
    return scales


def read_annotations(path: Path, scale: float, config: SddConfig, counts: Counter[str]) -> TrackPoints:
    """Reads the points of one video: states in metres, at whole steps, without lost points.

    Raises:
        UserError: a line is broken or repeats a track and frame; names file and line.
    """
    stride = frames_per_step(config.dt_s, FRAMES_PER_S, "the dataset")
    steps, tracks, positions, classes = [], [], [], []
    seen: dict[tuple[int, int], int] = {}
    for number, text in enumerate(read_lines(path), start=1):
        words = text.split()
        if not words:
            continue
        track, frame, centre, lost, kind = _read_line(path, number, words)
        counts["lines read"] += 1
        if seen.setdefault((track, frame), number) != number:
            first = seen[track, frame]
            raise bad_line(path, number, f"track {track} has frame {frame} in line {first} already")
        if lost:
            counts["lines dropped: lost"] += 1
        elif frame % stride:
            counts["lines dropped: between steps"] += 1
        else:
            steps.append(frame // stride)
            tracks.append(track)
            positions.append(centre)
            classes.append(kind)
    centres_m = np.array(positions).reshape(-1, 2) * scale
    points = TrackPoints(np.array(steps, dtype=np.int64), np.array(tracks, dtype=np.int64), centres_m)
    moving, velocities_mps, origin = with_velocities(points, config.dt_s)
    counts["lines dropped: no velocity (first of a track or after a gap)"] += len(points) - len(moving)
    one_hot = np.eye(3)[np.array(classes, dtype=np.int64)[origin]]
    return TrackPoints(moving.steps, moving.tracks, np.concatenate([moving.states, velocities_mps, one_hot], axis=-1))


def _read_line(path: Path, number: int, words: list[str]) -> tuple[int, int, tuple[float, float], bool, int]:
    """Returns track, frame, centre of the box [pixels], whether it is lost, and class."""
    if len(words) != 10:
        raise bad_line(path, number, f"expected 10 columns, got {len(words)}")
    left, top, right, bottom = (
        finite(word, name, path, number)
        for word, name in zip(words[1:5], ("xmin", "ymin", "xmax", "ymax"), strict=True)
    )
    if words[6] not in ("0", "1"):
        raise bad_line(path, number, f"lost must be 0 or 1, got '{words[6]}'")
    label = words[9].strip('"')
    if label not in CLASSES:
        raise bad_line(path, number, f"label must be one of {', '.join(CLASSES)}, got '{label}'")
    centre = (left + right) / 2, (top + bottom) / 2
    frame = whole(words[5], "frame", path, number, least=0)
    return whole(words[0], "track id", path, number, least=0), frame, centre, words[6] == "1", CLASSES[label]


def load(config: SddConfig) -> tuple[list[Episode], DatasetNotes, list[Path]]:
    """Reads all videos of the source.

    Returns:
        Episodes of the wanted split, notes for the card, and the files that were read.

    Raises:
        UserError: broken or missing files.
    """
    scales_path = config.source / SCALES_FILE
    if not scales_path.exists():
        raise UserError(f"{config.source} holds no {SCALES_FILE}; pass the folder that has it beside the scenes")
    scales = read_scales(scales_path)
    files = find_files(config.source, "*/*/annotations.txt", "annotations")
    names = {path: f"{path.parts[-3]}/{path.parts[-2]}" for path in files}
    for path, name in names.items():
        if name not in scales:
            raise UserError(f"{scales_path} has no scale for {name}, which {path} needs; add it")
    chosen = [path for path in files if in_split(names[path], config.split, SPLIT_SEED)]
    counts: Counter[str] = Counter({"videos": len(files), f"videos of split '{config.split}'": len(chosen)})
    episodes: list[Episode] = []
    for path in track(chosen, "sdd"):
        points = read_annotations(path, scales[names[path]], config, counts)
        episodes += cut_episodes(points, config.episode_steps, names[path], counts)
    numbered = [replace(episode, seed=i) for i, episode in enumerate(episodes)]
    return numbered, _notes(config, counts), [scales_path, *files]


def _notes(config: SddConfig, counts: Counter[str]) -> DatasetNotes:
    return DatasetNotes(
        "Stanford Drone Dataset",
        "Pedestrians, bikers and vehicles on a campus, annotated in drone videos. An agent's id is its track in the "
        "video; a label is scene/video.",
        RIGHTS,
        (
            "Centre of the box in pixels times the video's estimated scale; x to the right, y down.",
            f"A step is {config.dt_s:g} s: every {frames_per_step(config.dt_s, FRAMES_PER_S, '')}th frame is kept.",
            "Lines marked lost are dropped; occluded and interpolated ones are kept.",
            "Velocity is the backward difference over one step; a track's first step is dropped, and the first after "
            "a gap.",
            "Skaters count as bikers; cars, buses and carts as vehicles.",
            f"Videos are cut into episodes of {config.episode_steps} steps that do not overlap; the last of a video "
            "may be shorter.",
            f"Splits by video, hash with seed {SPLIT_SEED}.",
        ),
        dict(counts),
    )


def main() -> None:
    """Entry point."""
    config = parse(SddConfig, __doc__)
    config.check_paths()
    episodes, notes, files = load(config)
    save_dataset(config, scene_spec(config.dt_s, most_present(episodes)), episodes, notes, files)
    print(summary(config, episodes))


if __name__ == "__main__":
    run_entry_point(main)
