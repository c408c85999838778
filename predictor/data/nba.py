"""NBA tracking data as an episode store: `python -m predictor.data.nba --source score/train --out data/nba_train`.

Ball and ten players as eleven agents, always in the same order: the ball first, then five players of each team.
Position and velocity [m, m/s] from the middle of the court, x along it, and a column that is 1 for the ball. Formats:

* `score`: one text file per possession with lines of frame, id, x, y, kind, in feet, a frame every 0.12 s;
* `sportvu`: raw JSON of one game per file, in feet, 25 Hz; every third moment is kept, so a step is 0.12 s, too.

Velocity is the backward difference over one step, so the first frame of a passage is dropped. Passages are cut into
non-overlapping windows of `--window-steps` steps. Splits are by game: the position of SHA-256("3:<game>") in [0, 1)
decides, below 0.1 test, below 0.2 validation, else training; the text files' own folders `train` and `test` share
games.
"""

from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import tyro

from predictor.data.basketball import DT_S, ENTITIES, Passage, read_score, read_sportvu
from predictor.data.cards import DatasetNotes, save_dataset, summary
from predictor.data.common import NO_LIMIT_M, LoaderConfig, find_files, in_split, progressed
from predictor.data.store import Episode
from predictor.errors import UserError, run_entry_point
from predictor.scene import KINEMATIC_FEATURES, SceneSpec

SPLIT_SEED = 3
"""Any number would do: there are hundreds of games."""
FEATURES = (*KINEMATIC_FEATURES, "is_ball")
FEATURE_SCALES = (8.0, 4.0, 2.0, 2.0, 1.0)
"""About the standard deviations of the text files' training folder [m, m/s]."""
PATTERNS = {"score": "*.txt", "sportvu": "*.json"}
RIGHTS = (
    "Recorded by SportVU cameras in the season 2015-16 and published for a while by the NBA; the text files are the "
    "selection 'score' of the SocialVAE project. The underlying rights are unclear: measure with it, do not "
    "redistribute."
)


@dataclass(frozen=True)
class NbaConfig(LoaderConfig):
    """Turn basketball tracking data into an episode store."""

    format: Literal["score", "sportvu"] = "score"
    """Text files of possessions, or raw SportVU JSON of games."""
    window_steps: int = 50
    """Length of an episode [steps of 0.12 s]; shorter rests of a passage are dropped."""
    skip_broken: bool = False
    """Leave broken files out and count them, instead of stopping at the first."""

    def check(self) -> None:
        """Refuse values that make no sense.

        Raises:
            UserError: names the field.
        """
        super().check()
        if self.window_steps < 2:
            raise UserError(f"window_steps must be at least 2, got {self.window_steps}")


def scene_spec() -> SceneSpec:
    """Layout of the states."""
    return SceneSpec(
        DT_S,
        ("world", "world"),
        FEATURES,
        FEATURE_SCALES,
        has_ego=False,
        perception_m=NO_LIMIT_M,
        max_agents=ENTITIES,
    )


def game_of(path: Path, format: str) -> str:
    """The game a file belongs to: text files are named HOME_VISITOR_GAME_QUARTER_START_END."""
    return "_".join(path.stem.split("_")[:3]) if format == "score" else path.stem


def windows_of(passage: Passage, window_steps: int) -> list[Episode]:
    """Non-overlapping windows; the first frame of the passage serves for the first velocity only."""
    velocities_mps = np.diff(passage.positions_m, axis=0) / DT_S
    is_ball = np.zeros((*velocities_mps.shape[:2], 1))
    is_ball[:, 0] = 1.0
    states = np.concatenate([passage.positions_m[1:], velocities_mps, is_ball], axis=-1).astype(np.float32)
    valid = np.ones((window_steps, ENTITIES), dtype=np.bool_)
    return [
        Episode(states[begin : begin + window_steps], valid, passage.ids, passage.label)
        for begin in range(0, len(states) - window_steps + 1, window_steps)
    ]


def load(config: NbaConfig) -> tuple[list[Episode], DatasetNotes, list[Path]]:
    """Read all files of the source.

    Returns:
        Episodes of the wanted split, notes for the card, and the files that were read.

    Raises:
        UserError: a broken file, unless `skip_broken`.
    """
    files = find_files(config.source, PATTERNS[config.format], f"files of format '{config.format}'")
    chosen = [path for path in files if in_split(game_of(path, config.format), config.split, SPLIT_SEED)]
    counts: Counter[str] = Counter({"files": len(files), f"files of split '{config.split}'": len(chosen)})
    counts["games"] = len({game_of(path, config.format) for path in chosen})
    episodes: list[Episode] = []
    for path in progressed(chosen, "nba"):
        for passage in _passages(path, config, counts):
            found = windows_of(passage, config.window_steps)
            counts[f"passages skipped, shorter than {config.window_steps} steps"] += not found
            counts["steps dropped at the end of passages"] += (len(passage.positions_m) - 1) % config.window_steps
            episodes += found
    numbered = [replace(episode, seed=i) for i, episode in enumerate(episodes)]
    return numbered, _notes(config, counts), files


def _passages(path: Path, config: NbaConfig, counts: Counter[str]) -> list[Passage]:
    try:
        if config.format == "score":
            return [read_score(path)]
        passages, found = read_sportvu(path)
    except UserError:
        if not config.skip_broken:
            raise
        counts["broken files left out"] += 1
        return []
    counts.update(found)
    return passages


def _notes(config: NbaConfig, counts: Counter[str]) -> DatasetNotes:
    return DatasetNotes(
        f"NBA 2015-16 player and ball tracking, format {config.format}",
        "Ball and ten players of NBA games. The ball is agent 0 with id 0; players keep the league's ids. A label is "
        "the file (and passage) an episode was cut from.",
        RIGHTS,
        (
            "Feet off a corner became metres off the middle of the court (94 × 50 ft); x runs along the court. "
            "The ball's height is not kept.",
            f"A step is {DT_S} s (25/3 Hz).",
            "Velocity is the backward difference over one step; the first frame of each passage is dropped.",
            f"Passages are cut into windows of {config.window_steps} steps that do not overlap; rests are dropped.",
            f"Splits by game, hash with seed {SPLIT_SEED}; 'all' takes every file of the source.",
        ),
        dict(counts),
    )


def main() -> None:
    """Entry point."""
    config = tyro.cli(NbaConfig, description=__doc__)
    config.check()
    episodes, notes, files = load(config)
    save_dataset(config, scene_spec(), episodes, notes, files)
    print(summary(config, episodes))


if __name__ == "__main__":
    run_entry_point(main)
