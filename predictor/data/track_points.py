"""Cuts points (step, track, state) of a recording into episodes; agents may appear and disappear."""

from collections import Counter
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from predictor.data.store import Episode
from predictor.support.errors import UserError
from predictor.support.memory import check_memory

FAR_M = 10_000.0
"""Files whose mean position is farther than half of this from zero are moved by a multiple of it [m]."""
MOST_STEPS = 5_000_000
"""Largest number of steps from the first point of a recording to its last."""


@dataclass(frozen=True)
class TrackPoints:
    """Points of a recording, one per track and step, in any order; no pair of step and track occurs twice."""

    steps: Int[np.ndarray, " points"]
    """Number of the step, counted from any origin."""
    tracks: Int[np.ndarray, " points"]
    """Identity of the agent within the recording."""
    states: Float[np.ndarray, "points state"]
    """State of the agent, SI units."""

    def __len__(self) -> int:
        """Returns the number of points."""
        return len(self.steps)


def with_velocities(
    positions: TrackPoints, dt_s: float
) -> tuple[TrackPoints, Float[np.ndarray, "moving 2"], Int[np.ndarray, " moving"]]:
    """Returns the points whose track was present one step before, with the backward difference as their velocity.

    The first point of a track and the first after a gap have no velocity and are left out.

    Args:
        positions: states are positions [m].
        dt_s: time between steps [s].

    Returns:
        The points that are kept, sorted by track and step; their velocities [m/s]; their places among the given points.
    """
    order = np.lexsort((positions.steps, positions.tracks))
    steps, tracks, states = positions.steps[order], positions.tracks[order], positions.states[order]
    follows = np.flatnonzero((np.diff(tracks) == 0) & (np.diff(steps) == 1)) + 1
    velocities_mps = (states[follows] - states[follows - 1]) / dt_s
    return TrackPoints(steps[follows], tracks[follows], states[follows]), velocities_mps, order[follows]


def near_zero(positions_m: Float[np.ndarray, "points 2"]) -> tuple[Float[np.ndarray, "points 2"], bool]:
    """Moves positions by multiples of `FAR_M` in x and y, so that their mean lies near zero, and says if it did.

    Stores and networks compute in float32, which at 5,000 km (coordinates of a map) has steps of half a metre.
    """
    offset_m = FAR_M * np.round(positions_m.mean(axis=0) / FAR_M)
    return positions_m - offset_m, bool(offset_m.any())


def cut_episodes(points: TrackPoints, episode_steps: int, label: str, counts: Counter[str]) -> list[Episode]:
    """Cuts a recording into episodes that do not overlap, from its first step with an agent to its last.

    Within an episode each track has a column; steps without any agent are kept, all invalid. The last episode may be
    shorter. Episodes without any agent and those of one step are left out and counted.

    Raises:
        UserError: the recording spans more than `MOST_STEPS` steps, or an episode does not fit into the memory.
    """
    episodes = []
    first, last = (int(points.steps.min()), int(points.steps.max())) if len(points) else (0, -1)
    if last - first >= MOST_STEPS:
        raise UserError(f"{label}: frames span {last - first + 1:,} steps, at most {MOST_STEPS:,}; a frame is wrong")
    order = np.argsort(points.steps, kind="stable")
    ordered = TrackPoints(points.steps[order], points.tracks[order], points.states[order])
    for begin in range(first, last + 1, episode_steps):
        length = min(episode_steps, last + 1 - begin)
        start, end = np.searchsorted(ordered.steps, (begin, begin + length)).tolist()
        inside = TrackPoints(ordered.steps[start:end], ordered.tracks[start:end], ordered.states[start:end])
        if not len(inside):
            counts["episodes left out: no agent"] += 1
        elif length < 2:
            counts["episodes left out: one step"] += 1
        else:
            episodes.append(_episode(inside, begin, length, label))
    return episodes


def _episode(points: TrackPoints, begin: int, length: int, label: str) -> Episode:
    ids, columns = np.unique(points.tracks, return_inverse=True)
    needed = length * len(ids) * (4 * points.states.shape[1] + 1)
    what = f"{label}: an episode of {length:,} steps with {len(ids):,} tracks"
    check_memory(needed, what, "pass a smaller --episode-steps, not 0")
    states = np.zeros((length, len(ids), points.states.shape[1]), dtype=np.float32)
    valid = np.zeros((length, len(ids)), dtype=np.bool_)
    states[points.steps - begin, columns] = points.states
    valid[points.steps - begin, columns] = True
    return Episode(states, valid, ids.astype(np.int64), label)
