"""Reads basketball tracking data: possessions in the text layout of SocialVAE's `score`, and raw SportVU JSON.

Both end up as `Passage`s: ball and ten players without a gap, 0.12 s apart, in metres from the middle of the court.
"""

import json
import math
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from predictor.data.common import bad_line, finite, read_lines, whole
from predictor.errors import UserError

METRES_PER_FOOT = 0.3048
COURT_FEET = (94.0, 50.0)
"""Length and width of an NBA court; both formats count from one corner."""
ENTITIES = 11
"""Ball and ten players."""
BALL_ID = 0
"""In the store; both formats write -1, which the store keeps for padding."""
DT_S = 0.12
"""Three frames of SportVU's 25 Hz."""

SCORE_FRAME_STEP = 12
"""Frame numbers of the text layout count hundredths of a second."""
SPORTVU_MS = 40
"""Between two moments [ms]."""
SPORTVU_JITTER_MS = 15
"""A moment this much too early or late still follows the one before [ms]."""
SPORTVU_STRIDE = 3
"""Keep every third moment."""

_KINDS = ("BALL", "PLAYER")

Entities = dict[tuple[int, int], tuple[float, float]]
"""Position [feet] by team and player; both are -1 for the ball."""


@dataclass(frozen=True)
class Passage:
    """Uninterrupted play: the same ball and ten players throughout."""

    positions_m: Float[np.ndarray, "time 11 2"]
    """From the middle of the court; x along it."""
    ids: Int[np.ndarray, "11"]
    """Ball first, then five players of each team."""
    label: str
    """File, and for SportVU the number of the passage in it."""


def court_metres(feet: Float[np.ndarray, "*shape 2"]) -> Float[np.ndarray, "*shape 2"]:
    """From feet off a corner to metres off the middle."""
    return (feet - np.array(COURT_FEET) / 2) * METRES_PER_FOOT


# --- Text layout ------------------------------------------------------------------------------------------------------


def read_score(path: Path) -> Passage:
    """Read one possession: lines of frame, id, x, y, kind; eleven lines per frame, a frame every 0.12 s.

    Raises:
        UserError: a broken line, a gap, an entity that is missing; names file and line.
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
    """Check the frame that ends at line `number`."""
    present = frames[-1]
    balls = sum(kind == "BALL" for kind, _ in present)
    if len(present) != ENTITIES or balls != 1:
        players = len(present) - balls
        raise bad_line(path, number, f"frame {frame} must hold 1 ball and 10 players, got {balls} and {players}")
    strangers = sorted(player for _, player in present.keys() - frames[0].keys())
    if strangers:
        raise bad_line(path, number, f"frame {frame} holds ids that the first frame does not: {strangers}")


# --- SportVU ----------------------------------------------------------------------------------------------------------


def read_sportvu(path: Path) -> tuple[list[Passage], Counter[str]]:
    """Read one game of raw SportVU JSON; cut where play is interrupted; keep every third moment.

    Events overlap: a moment that an earlier event held already is dropped.

    Returns:
        The passages, and how many moments were read and dropped.

    Raises:
        UserError: no JSON of this layout, or a number that is not finite; names file and line, or event and moment.
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
    """Every moment of a file, with its place."""
    content = _read_json(path)
    events = content.get("events") if isinstance(content, dict) else None
    if not isinstance(events, list):
        raise bad_line(path, 1, "expected an object with a list 'events'", "pass raw SportVU JSON")
    for e, event in enumerate(events):
        moments = event.get("moments") if isinstance(event, dict) else None
        if not isinstance(moments, list):
            raise UserError(f"{path}, events[{e}]: expected a list 'moments'; get the file anew")
        for m, moment in enumerate(moments):
            yield f"events[{e}].moments[{m}]", moment


def _read_json(path: Path) -> Any:
    text = "\n".join(read_lines(path))

    def refuse(constant: str) -> None:
        found = re.search(rf"(?<![\w\"]){re.escape(constant)}", text)
        line = text.count("\n", 0, found.start() if found else 0) + 1
        raise bad_line(path, line, f"numbers must be finite, got {constant}")

    try:
        return json.loads(text, parse_constant=refuse)
    except json.JSONDecodeError as error:
        raise bad_line(path, error.lineno, f"not JSON ({error.msg})") from error


def _moment(path: Path, where: str, moment: Any) -> tuple[int, int, Entities]:
    """Time [ms], quarter, and position [feet] by team and player."""
    try:
        quarter, time_ms, rows = int(moment[0]), int(moment[1]), moment[5]
        entities = {(int(row[0]), int(row[1])): (float(row[2]), float(row[3])) for row in rows}
    except (TypeError, ValueError, IndexError, KeyError) as error:
        raise UserError(
            f"{path}, {where}: expected [quarter, ms, clock, shot clock, null, [[team, player, x, y, z], …]], "
            f"got {json.dumps(moment)[:80]}; repair it or get the file anew"
        ) from error
    if not all(math.isfinite(v) for xy in entities.values() for v in xy):
        raise UserError(f"{path}, {where}: positions must be finite, got {json.dumps(moment)[:80]}; get the file anew")
    if any(player <= BALL_ID for team, player in entities if team != -1):
        raise UserError(f"{path}, {where}: ids of players must be positive; get the file anew")
    return time_ms, quarter, entities


def _uninterrupted(moments: dict[int, tuple[int, Entities]]) -> Iterator[list[int]]:
    """Times of moments that follow each other in one quarter with the same players."""
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
