"""CMU motion capture as an episode store: `python -m predictor.data.mocap --source cmu_mocap/35 --out data/mocap35`.

Reads one subject's folder (one .asf skeleton, one .amc file per trial, 120 Hz) and gives the 31 joints as agents with
position and velocity on three axes [m, m/s]; y is up, as in the files. One unit of the files is 0.0254 / 0.45 m (see
`predictor.data.mocap_files`). Velocity is the backward difference over one step, so the first step of a trial is
dropped and no state depends on the future.

Splits are by trial: the position of SHA-256("12:<trial>") in [0, 1) decides, below 0.1 test, below 0.2 validation, else
training. Of the 23 walking trials of subject 35 that are usually used (01–16, 28–34), 35_12 and 35_34 are for testing,
35_04, 35_14 and 35_29 for validation.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from predictor.data.dataset_card import DatasetNotes, save_dataset, summary
from predictor.data.loading import NO_LIMIT_M, LoaderConfig, find_files, in_split
from predictor.data.mocap_files import Skeleton, joint_positions, read_motion, read_skeleton
from predictor.data.store import Episode
from predictor.scene import KINEMATIC_FEATURES_3D, SceneSpec
from predictor.support.command_line import parse
from predictor.support.config_checks import check_at_least
from predictor.support.errors import UserError, run_entry_point
from predictor.support.progress import track

FRAMES_PER_S = 120.0
"""Frame rate of the database [Hz]."""
SPLIT_SEED = 12
"""Seed of the split: the first one that gives shares near 80/10/10 on subject 35."""
FEATURE_SCALES = (0.2, 0.5, 0.2, 1.0, 0.5, 1.0)
"""Scales of the states: about the standard deviations of subject 35 around the centroid, equal on both level axes
[m, m/s]."""
RIGHTS = (
    "CMU Graphics Lab Motion Capture Database: free for use in research, may be part of products, may not be resold "
    "directly, even converted. It asks for this acknowledgment: 'The data used in this project was obtained from "
    "mocap.cs.cmu.edu. The database was created with funding from NSF EIA-0196217.'"
)


@dataclass(frozen=True)
class MocapConfig(LoaderConfig):
    """Turns one subject of the CMU motion capture database into an episode store."""

    stride: int = 4
    """Number of frames from one kept frame to the next; 4 gives 30 Hz."""
    all_phases: bool = False
    """Make one episode for each of the `stride` ways to begin, instead of the first only; for training."""
    min_steps: int = 50
    """Least length of an episode; shorter ones are skipped [steps]."""

    def __post_init__(self) -> None:
        """Checks choices and ranges.

        Raises:
            UserError: a value out of range.
        """
        super().__post_init__()
        check_at_least(self, 1, "stride")
        check_at_least(self, 2, "min_steps")

    def check_paths(self) -> None:
        """Checks the paths of every loader, and that the source is a folder.

        Raises:
            UserError: a path is missing, exists already or is not a folder.
        """
        super().check_paths()
        if not self.source.is_dir():
            raise UserError(f"source must be one subject's folder, got the file {self.source}")

    @property
    def dt_s(self) -> float:
        """Time between two steps [s]."""
        return self.stride / FRAMES_PER_S


def scene_spec(config: MocapConfig, joints: int) -> SceneSpec:
    """Returns the layout of the states."""
    return SceneSpec(
        config.dt_s,
        ("centroid", "centroid", "centroid"),
        KINEMATIC_FEATURES_3D,
        FEATURE_SCALES,
        has_ego=False,
        perception_m=NO_LIMIT_M,
        max_agents=joints,
    )


def moving_states(
    positions_m: Float[np.ndarray, "frames joints 3"], dt_s: float
) -> Float[np.ndarray, "frames-1 joints 6"]:
    """Returns positions and backward differences; the first frame has no difference and is dropped."""
    velocities_mps = np.diff(positions_m, axis=0) / dt_s
    return np.concatenate([positions_m[1:], velocities_mps], axis=-1).astype(np.float32)


def read_trial(path: Path, skeleton: Skeleton, config: MocapConfig) -> list[Episode]:
    """Reads the episodes of one trial; those shorter than `min_steps` are left out.

    Raises:
        UserError: the file is broken; names file and line.
    """
    positions_m = joint_positions(skeleton, read_motion(path, skeleton))
    episodes = []
    for phase in range(config.stride if config.all_phases else 1):
        kept = positions_m[phase :: config.stride]
        if len(kept) - 1 >= config.min_steps:
            states = moving_states(kept, config.dt_s)
            valid = np.ones(states.shape[:2], dtype=np.bool_)
            episodes.append(Episode(states, valid, np.arange(states.shape[1]), path.stem))
    return episodes


def load(config: MocapConfig) -> tuple[Skeleton, list[Episode], DatasetNotes, list[Path]]:
    """Reads a subject's folder.

    Returns:
        The skeleton, the episodes of the wanted split, notes for the card, and the files that were read.

    Raises:
        UserError: broken or missing files.
    """
    skeletons = find_files(config.source, "*.asf", "skeleton")
    if len(skeletons) > 1:
        raise UserError(f"{config.source} must hold one skeleton, got {len(skeletons)}; pass one subject's folder")
    skeleton = read_skeleton(skeletons[0])
    trials = find_files(config.source, "*.amc", "trials")
    chosen = [path for path in trials if in_split(path.stem, config.split, SPLIT_SEED)]
    episodes: list[Episode] = []
    skipped = 0
    for path in track(chosen, "mocap"):
        found = read_trial(path, skeleton, config)
        skipped += not found
        episodes += found
    counts = {
        "trials in the folder": len(trials),
        f"trials of split '{config.split}'": len(chosen),
        f"trials skipped, shorter than {config.min_steps} steps": skipped,
    }
    numbered = [replace(episode, seed=i) for i, episode in enumerate(episodes)]
    return skeleton, numbered, _notes(config, skeleton, counts), [*skeletons, *trials]


def _notes(config: MocapConfig, skeleton: Skeleton, counts: dict[str, int]) -> DatasetNotes:
    phases = f"each of the {config.stride} phases is an episode" if config.all_phases else "only the first phase"
    return DatasetNotes(
        f"CMU motion capture, subject {config.source.resolve().name}",
        f"Joints of a walking person, {len(skeleton.bones)} per step, recorded at {FRAMES_PER_S:g} Hz with infrared "
        "cameras. Each joint is an agent; its id is its index in the list of joints in the store's provenance.",
        RIGHTS,
        (
            f"Forward kinematics of the ASF/AMC files; one unit of length is {skeleton.metres_per_unit:.5f} m.",
            "Axes as in the files: y is up. Positions are not centred in the store.",
            f"Every {config.stride}th frame is kept ({FRAMES_PER_S / config.stride:g} Hz); {phases}.",
            "Velocity is the backward difference over one step; the first step of each episode is dropped.",
            f"Splits by trial, hash with seed {SPLIT_SEED}.",
        ),
        counts,
    )


def main() -> None:
    """Entry point."""
    config = parse(MocapConfig, __doc__)
    config.check_paths()
    skeleton, episodes, notes, files = load(config)
    extra = {"joints": skeleton.joint_names, "parents": skeleton.parents, "lengths_m": skeleton.lengths_m.tolist()}
    save_dataset(config, scene_spec(config, len(skeleton.bones)), episodes, notes, files, extra)
    print(summary(config, episodes))


if __name__ == "__main__":
    run_entry_point(main)
