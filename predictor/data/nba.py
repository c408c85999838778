"""NBA tracking data as an episode store: `python -m predictor.data.nba --source score/train --out data/nba_train`.

Ball and ten players as eleven agents, always in the same order: the ball first, then five players of each team.
Position and velocity [m, m/s] from the middle of the court, x along it, and a column that is 1 for the ball. Formats:

* `score`: one text file per possession with lines of frame, id, x, y, kind, in feet, a frame every 0.12 s;
* `sportvu`: raw JSON of one game per file, in feet, 25 Hz; every third moment is kept, so a step is 0.12 s as well.

Velocity is the backward difference over one step, so the first frame of a passage is dropped. Passages are cut into
non-overlapping episodes of `--episode-steps` steps, or kept whole (0), as `python -m predictor.nba_score` needs.
Splits are by game: the position of SHA-256("3:<game>") in [0, 1) decides, below 0.1 test, below 0.2 validation, else
training; the text files' own folders `train` and `test` share games.
"""

import json
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Int

from predictor.data.dataset_card import DatasetNotes, save_dataset, summary
from predictor.data.loading import (
    LARGEST_WHOLE,
    NO_LIMIT_M,
    LoaderConfig,
    bad_line,
    find_files,
    finite,
    in_split,
    read_lines,
    whole,
)
from predictor.data.store import Episode
from predictor.scene import KINEMATIC_FEATURES, LARGEST, SceneSpec
from predictor.support.command_line import parse
from predictor.support.config_checks import check_at_least
from predictor.support.errors import UserError, run_entry_point
from predictor.support.progress import track
from predictor.support.reading import MOST_TEXT_BYTES, read_json

METRES_PER_FOOT = 0.3048

COURT_FEET = (94.0, 50.0)
"""Length and width of an NBA court [ft]; both formats count from one corner."""

ENTITIES = 11
"""Number of agents: the ball and ten players."""

BALL_ID = 0
"""Identity of the ball in the store; both formats write -1, which the store uses for padding."""

DT_S = 0.12
"""Time between steps [s]: three frames of SportVU's 25 Hz."""

SCORE_FRAME_STEP = 12
"""Difference of consecutive frame numbers in the text layout, which count hundredths of a second."""

SPORTVU_MS = 40
"""Time between two moments [ms]."""

SPORTVU_JITTER_MS = 15
"""Largest deviation from `SPORTVU_MS` between two moments of one passage [ms]."""

SPORTVU_STRIDE = 3
"""Number of moments from one kept moment to the next."""

_KINDS = ("BALL", "PLAYER")

Entities = dict[tuple[int, int], tuple[float, float]]
"""Position [feet] by team and player; both are -1 for the ball."""


@dataclass(frozen=True)
class Passage:
    """Uninterrupted play with the ball and an unchanged set of ten players."""

    positions_m: Float[np.ndarray, "time 11 2"]
    """Positions from the middle of the court [m]; x along it."""
    ids: Int[np.ndarray, "11"]
    """Identities: ball first, then five players of each team."""
    label: str
    """Name of the file, and for SportVU the number of the passage in it."""


def court_metres(feet: Float[np.ndarray, "*shape 2"]) -> Float[np.ndarray, "*shape 2"]:
    """Converts feet from a corner to metres from the middle."""
    return (feet - np.array(COURT_FEET) / 2) * METRES_PER_FOOT


def read_score(path: Path) -> Passage:
    """Reads one possession: lines of frame, id, x, y, kind; eleven lines per frame, a frame every 0.12 s.

    Raises:
        UserError: a line is broken, or a frame or an entity is missing; names file and line.
    """
    frames: list[dict[tuple[str, int], tuple[float, float]]] = []
    current, number = 0, 0
    for number, text in enumerate(read_lines(path), start=1):
        words = text.split()
        if not words:
            continue
        frame, entity, xy = _score_line(path, number, words)
        if not frames or frame != current:
            if frames:
                _check_score_frame(path, number - 1, current, frames)
            if frames and frame != current + SCORE_FRAME_STEP:
                expected = current + SCORE_FRAME_STEP
                raise bad_line(
                    path, number, f"frames must be {SCORE_FRAME_STEP} apart: expected {expected}, got {frame}"
                )
            frames.append({})
            current = frame
        if entity in frames[-1]:
            raise bad_line(path, number, f"{entity[0]} {entity[1]} appears twice in frame {frame}")
        frames[-1][entity] = xy
    if not frames:
        raise UserError(f"{path} holds no frame; remove the file or pass --skip-broken")
    _check_score_frame(path, number, current, frames)
    order = sorted(frames[0], key=lambda entity: entity[0] != "BALL")  # stable: players stay in the file's order
    feet = np.array([[frame[entity] for entity in order] for frame in frames])
    ids = np.array([BALL_ID, *(player for _, player in order[1:])], dtype=np.int64)
    return Passage(court_metres(feet), ids, path.stem)


def _score_line(path: Path, number: int, words: list[str]) -> tuple[int, tuple[str, int], tuple[float, float]]:
    if len(words) != 5:
        raise bad_line(path, number, f"expected frame, id, x, y, kind, got {len(words)} columns")
    if words[4] not in _KINDS:
        raise bad_line(path, number, f"kind must be BALL or PLAYER, got '{words[4]}'")
    least = None if words[4] == "BALL" else BALL_ID + 1
    entity = words[4], whole(words[1], "id", path, number, least)
    xy = finite(words[2], "x", path, number), finite(words[3], "y", path, number)
    return whole(words[0], "frame", path, number), entity, xy


def _check_score_frame(path: Path, number: int, frame: int, frames: list[dict[tuple[str, int], Any]]) -> None:
    """Checks the frame that ends at line `number`."""
    present = frames[-1]
    balls = sum(kind == "BALL" for kind, _ in present)
    if len(present) != ENTITIES or balls != 1:
        players = len(present) - balls
        raise bad_line(path, number, f"frame {frame} must hold 1 ball and 10 players, got {balls} and {players}")
    unknown = sorted(player for _, player in present.keys() - frames[0].keys())
    if unknown:
        raise bad_line(path, number, f"frame {frame} holds ids that the first frame does not: {unknown}")


def read_sportvu(path: Path) -> tuple[list[Passage], Counter[str]]:
    """Reads one game of raw SportVU JSON, cuts it where play is interrupted and keeps every third moment.

    Events overlap: a moment that an earlier event holds already is dropped.

    Returns:
        The passages, and the numbers of moments read and dropped.

    Raises:
        UserError: the file is not JSON of this layout or a number is not finite; names file and line, or event
            and moment.
    """
    counts: Counter[str] = Counter()
    moments: dict[int, tuple[int, Entities]] = {}
    for where, moment in _moments(path):
        counts["moments read"] += 1
        time_ms, quarter, entities = _moment(path, where, moment)
        if len(entities) != ENTITIES or sum(player == -1 for _, player in entities) != 1:
            counts["moments without 1 ball and 10 players"] += 1
        elif time_ms in moments:
            counts["moments repeated by a later event"] += 1
        else:
            moments[time_ms] = quarter, entities
    passages = []
    for i, times in enumerate(_uninterrupted(moments)):
        kept = times[::SPORTVU_STRIDE]
        order = sorted(moments[kept[0]][1])  # the ball's team is -1
        feet = np.array([[moments[time][1][entity] for entity in order] for time in kept])
        ids = np.array([BALL_ID, *(player for _, player in order[1:])], dtype=np.int64)
        passages.append(Passage(court_metres(feet), ids, f"{path.stem}/{i}"))
    counts["passages without interruption"] += len(passages)
    return passages, counts


def _moments(path: Path) -> Iterator[tuple[str, Any]]:
    """Yields all moments of a file, each with its path in the JSON."""
    content = read_json(path, MOST_TEXT_BYTES, finite=True)
    events = content.get("events") if isinstance(content, dict) else None
    if not isinstance(events, list):
        raise bad_line(path, 1, "expected an object with a list 'events'", "pass raw SportVU JSON")
    for e, event in enumerate(events):
        moments = event.get("moments") if isinstance(event, dict) else None
        if not isinstance(moments, list):
            raise UserError(f"{path}, events[{e}]: expected a list 'moments'; get the file anew")
        for m, moment in enumerate(moments):
            yield f"events[{e}].moments[{m}]", moment


def _moment(path: Path, where: str, moment: Any) -> tuple[int, int, Entities]:
    """Returns time [ms], quarter, and positions [ft] by team and player."""
    try:
        quarter, time_ms, points = _whole(moment[0]), _whole(moment[1]), moment[5]
        entities = {(_whole(point[0]), _whole(point[1])): (float(point[2]), float(point[3])) for point in points}
    except (TypeError, ValueError, IndexError, KeyError, OverflowError) as error:
        raise UserError(
            f"{path}, {where}: expected [quarter, ms, clock, shot clock, null, [[team, player, x, y, z], …]], "
            f"got {json.dumps(moment)[:80]}; repair it or get the file anew"
        ) from error
    if not all(abs(v) <= LARGEST for xy in entities.values() for v in xy):
        raise UserError(
            f"{path}, {where}: positions must be finite and at most {LARGEST:g}, got {json.dumps(moment)[:80]}; "
            "get the file anew"
        )
    if any(not BALL_ID < player <= LARGEST_WHOLE for team, player in entities if team != -1):
        raise UserError(f"{path}, {where}: ids of players must be positive, of at most 15 digits; get the file anew")
    players = [player for team, player in entities if team != -1]
    if len(set(players)) < len(players):
        raise UserError(f"{path}, {where}: a player is in both teams; get the file anew")
    return time_ms, quarter, entities


def _whole(value: Any) -> int:
    number = int(value)
    if number != float(value):
        raise ValueError(value)
    return number


def _uninterrupted(moments: dict[int, tuple[int, Entities]]) -> Iterator[list[int]]:
    """Yields the times [ms] of consecutive moments in one quarter with unchanged players, passage by passage."""
    passage: list[int] = []
    for time_ms in sorted(moments):
        if passage:
            late_ms = time_ms - passage[-1] - SPORTVU_MS
            before, now = moments[passage[-1]], moments[time_ms]
            if abs(late_ms) > SPORTVU_JITTER_MS or before[0] != now[0] or before[1].keys() != now[1].keys():
                yield passage
                passage = []
        passage.append(time_ms)
    if passage:
        yield passage


SPLIT_SEED = 3
"""Seed of the split; any number would do, since there are hundreds of games."""

FEATURES = (*KINEMATIC_FEATURES, "is_ball")

FEATURE_SCALES = (8.0, 4.0, 2.0, 2.0, 1.0)
"""Scales of the states: about the standard deviations of the text files' training folder [m, m/s]."""

PATTERNS = {"score": "*.txt", "sportvu": "*.json"}
RIGHTS = (
    "Recorded by SportVU cameras in the season 2015-16 and published for a while by the NBA; the text files are the "
    "selection 'score' of the SocialVAE project. The underlying rights are unclear: measure with it, do not "
    "redistribute."
)


@dataclass(frozen=True)
class NbaConfig(LoaderConfig):
    """Turns basketball tracking data into an episode store."""

    format: Literal["score", "sportvu"] = "score"
    """Format of the files: score (text files of possessions) or sportvu (raw JSON of games)."""
    episode_steps: int = 50
    """Length of an episode [steps of 0.12 s]; shorter rests of a passage are dropped. 0 keeps passages whole."""
    skip_broken: bool = False
    """Leave broken files out and count them, instead of stopping at the first."""

    def __post_init__(self) -> None:
        """Checks choices and ranges.

        Raises:
            UserError: a value out of range.
        """
        super().__post_init__()
        check_at_least(self, 0, "episode_steps")
        if self.episode_steps == 1:
            raise UserError("episode_steps must be 0 or at least 2, got 1")


def scene_spec() -> SceneSpec:
    """Returns the layout of the states."""
    return SceneSpec(
        DT_S,
        ("world", "world"),
        FEATURES,
        FEATURE_SCALES,
        has_ego=False,
        perception_m=NO_LIMIT_M,
        max_agents=ENTITIES,
    )


def game_of(name: str, format: str) -> str:
    """Returns the game of a file or label: HOME_VISITOR_GAME_QUARTER_START_END (text files), GAME/passage (SportVU)."""
    return "_".join(name.split("_")[:3]) if format == "score" else name.partition("/")[0]


def episodes_of(passage: Passage, episode_steps: int) -> list[Episode]:
    """Cuts episodes that do not overlap; the first frame of the passage is used for the first velocity only.

    Args:
        passage: positions, of at least one frame.
        episode_steps: length of each episode; 0 gives one episode of all steps, if there are two or more.
    """
    velocities_mps = np.diff(passage.positions_m, axis=0) / DT_S
    is_ball = np.zeros((*velocities_mps.shape[:2], 1))
    is_ball[:, 0] = 1.0
    states = np.concatenate([passage.positions_m[1:], velocities_mps, is_ball], axis=-1).astype(np.float32)
    length = episode_steps or max(2, len(states))
    valid = np.ones((length, ENTITIES), dtype=np.bool_)
    return [
        Episode(states[begin : begin + length], valid, passage.ids, passage.label)
        for begin in range(0, len(states) - length + 1, length)
    ]


def load(config: NbaConfig) -> tuple[list[Episode], DatasetNotes, list[Path]]:
    """Reads all files of the source.

    Returns:
        Episodes of the wanted split, notes for the card, and the files that were read.

    Raises:
        UserError: a file is broken, unless `skip_broken`.
    """
    files = find_files(config.source, PATTERNS[config.format], f"files of format '{config.format}'")
    chosen = [path for path in files if in_split(game_of(path.stem, config.format), config.split, SPLIT_SEED)]
    counts: Counter[str] = Counter({"files": len(files), f"files of split '{config.split}'": len(chosen)})
    counts["games"] = len({game_of(path.stem, config.format) for path in chosen})
    episodes: list[Episode] = []
    for path in track(chosen, "nba"):
        for passage in _passages(path, config, counts):
            found = episodes_of(passage, config.episode_steps)
            counts[f"passages skipped, shorter than {config.episode_steps or 2} steps"] += not found
            kept = sum(len(episode.states) for episode in found)
            counts["steps dropped at the end of passages"] += len(passage.positions_m) - 1 - kept
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
            f"Passages are cut into episodes of {config.episode_steps} steps that do not overlap; rests are dropped."
            if config.episode_steps
            else "Each passage is one episode, of all its steps.",
            f"Splits by game, hash with seed {SPLIT_SEED}; 'all' takes every file of the source.",
        ),
        dict(counts),
    )


def main() -> None:
    """Entry point."""
    config = parse(NbaConfig, __doc__)
    config.check_paths()
    episodes, notes, files = load(config)
    save_dataset(config, scene_spec(), episodes, notes, files, recording=partial(game_of, format=config.format))
    print(summary(config, episodes))


if __name__ == "__main__":
    run_entry_point(main)
