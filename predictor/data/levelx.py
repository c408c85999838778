"""inD, rounD, highD, exiD as an episode store: `python -m predictor.data.levelx --source inD/data --out data/ind`.

Reads recordings in the CSV layouts of levelXData (see `predictor.data.levelx_files`); the data itself needs a licence
from levelxdata.com. `python -m envs.export_levelx` writes highway-env rollouts in the same layout.

States (`--features full`): position, velocity [m, m/s], heading as cosine and sine, acceleration along and across the
heading [m/s²], and four columns of which one is 1: car (also vans), truck or bus (also trailers), pedestrian, bicycle
(also motorcycles). `--features kinematic` keeps position and velocity. Velocities and accelerations are the dataset's
own; they were smoothed over the whole track and therefore contain some information about the future.

The number of agents varies from step to step. Splits are by recording: the position of SHA-256("360:<recording>") in
[0, 1) decides, below 0.1 test, below 0.2 validation, else training; for inD 01, 14, 24 are for testing, 03, 11, 22 for
validation.
"""

from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from predictor.data.dataset_card import DatasetNotes, most_present, save_dataset, summary
from predictor.data.levelx_files import CLASS_FEATURES, Features, Layout, layout_of, open_recording, read_tracks
from predictor.data.loading import NO_LIMIT_M, LoaderConfig, find_files, frames_per_step, in_split
from predictor.data.store import Episode
from predictor.data.track_points import cut_episodes
from predictor.scene import KINEMATIC_FEATURES, SceneSpec
from predictor.support.command_line import parse
from predictor.support.config_checks import check_at_least, check_positive
from predictor.support.errors import UserError, run_entry_point
from predictor.support.progress import track

SPLIT_SEED = 360
"""Seed of the split: gives shares near 80/10/10 in all four datasets, and different locations of inD in each split."""
MOTION_FEATURES = ("heading_cos", "heading_sin", "lon_acceleration_mps2", "lat_acceleration_mps2")
KINEMATIC_SCALES: dict[Layout, tuple[float, ...]] = {
    "centre": (50.0, 50.0, 10.0, 10.0),
    "corner": (100.0, 10.0, 30.0, 1.0),
}
"""Scales of position and velocity [m, m/s]: a junction and town speeds; a section of motorway and its speeds."""
MAX_AGENTS = 128
"""Least `max_agents` of a store; larger where more agents are present at once."""
RIGHTS = (
    "inD, rounD, highD and exiD: free for research that is not commercial, on application at levelxdata.com; not to be "
    "passed on. A store made from them falls under the same terms."
)


@dataclass(frozen=True)
class LevelxConfig(LoaderConfig):
    """Turns recordings in levelXData's CSV layouts into an episode store."""

    features: Features = "full"
    """Features of a state: kinematic (position and velocity) or full (also heading, acceleration and class)."""
    frame: Literal["world", "centroid"] = "world"
    """Origin of the positions that networks see: world keeps the map (one location), centroid removes it."""
    dt_s: float = 0.2
    """Time between steps [s]; whole frames of the recordings (25 Hz). 0.2 as in the dG-VAE paper."""
    episode_steps: int = 50
    """Length of the episodes into which recordings are cut [steps]."""
    locations: tuple[str, ...] = ()
    """Keys (locationId) of the locations whose recordings are kept; none given keeps all. Each location has its
    own coordinates."""

    def __post_init__(self) -> None:
        """Checks choices and ranges.

        Raises:
            UserError: a value out of range.
        """
        super().__post_init__()
        check_positive(self, "dt_s")
        check_at_least(self, 2, "episode_steps")


def scene_spec(config: LevelxConfig, layout: Layout, agents: int = 0) -> SceneSpec:
    """Returns the layout of the states."""
    names: tuple[str, ...] = KINEMATIC_FEATURES
    scales = KINEMATIC_SCALES[layout]
    if config.features == "full":
        names, scales = (
            (*names, *MOTION_FEATURES, *CLASS_FEATURES),
            scales + (1.0,) * (len(MOTION_FEATURES) + len(CLASS_FEATURES)),
        )
    return SceneSpec(
        config.dt_s,
        (config.frame, config.frame),
        names,
        scales,
        has_ego=False,
        perception_m=NO_LIMIT_M,
        max_agents=max(MAX_AGENTS, agents),
    )


def load(config: LevelxConfig) -> tuple[Layout, list[Episode], DatasetNotes, list[Path]]:
    """Reads all recordings of the source.

    Returns:
        The layout, the episodes of the wanted split, notes for the card, and the files that were read.

    Raises:
        UserError: broken or missing files, or both layouts in one folder.
    """
    recordings = [open_recording(path) for path in find_files(config.source, "*_tracks.csv", "recordings")]
    layouts = {layout_of(recording.tracks): recording.tracks for recording in recordings}
    if len(layouts) > 1:
        both = " and ".join(str(path) for path in layouts.values())
        raise UserError(f"{both} have different layouts; give each dataset a folder of its own")
    wanted = [r for r in recordings if not config.locations or r.location in config.locations]
    known = {r.location for r in recordings}
    missing = tuple(location for location in config.locations if location not in known)
    if missing:
        raise UserError(f"{config.source} has no recording of locations {missing}; there are {sorted(known)}")
    chosen = [r for r in wanted if in_split(r.name, config.split, SPLIT_SEED)]
    counts: Counter[str] = Counter(
        {"recordings": len(recordings), f"recordings of split '{config.split}'": len(chosen)}
    )
    episodes: list[Episode] = []
    for recording in track(chosen, "levelx"):
        stride = frames_per_step(config.dt_s, recording.frames_per_s, f"recording {recording.name}")
        points = read_tracks(recording, config.features, stride)
        counts["points kept"] += len(points)
        episodes += cut_episodes(points, config.episode_steps, f"{recording.location}/{recording.name}", counts)
    numbered = [replace(episode, seed=i) for i, episode in enumerate(episodes)]
    files = [path for r in recordings for path in (r.tracks, r.tracks_meta, r.meta)]
    return next(iter(layouts)), numbered, _notes(config, next(iter(layouts)), counts), files


def _notes(config: LevelxConfig, layout: Layout, counts: Counter[str]) -> DatasetNotes:
    axes = {
        "centre": "Local coordinates of the recording's location, as in the files.",
        "corner": "Centre of the box; y, its velocity and acceleration change sign, so that y points up.",
    }
    return DatasetNotes(
        {"centre": "Recordings in the CSV layout of inD, rounD, exiD", "corner": "Recordings in the layout of highD"}[
            layout
        ],
        "Road users filmed by drones from above. An agent's id is its track in the recording; a label is "
        "location/recording.",
        RIGHTS,
        (
            axes[layout],
            f"A step is {config.dt_s:g} s: every n-th frame is kept, the frames in between are dropped.",
            "Velocities and accelerations are the dataset's own; they were smoothed over whole tracks.",
            f"Recordings are cut into episodes of {config.episode_steps} steps that do not overlap; the last of a "
            "recording may be shorter.",
            f"Splits by recording, hash with seed {SPLIT_SEED}.",
            f"Locations: {', '.join(config.locations) or 'all'}.",
        ),
        dict(counts),
    )


def main() -> None:
    """Entry point."""
    config = parse(LevelxConfig, __doc__)
    config.check_paths()
    layout, episodes, notes, files = load(config)
    save_dataset(config, scene_spec(config, layout, most_present(episodes)), episodes, notes, files)
    print(summary(config, episodes))


if __name__ == "__main__":
    run_entry_point(main)
