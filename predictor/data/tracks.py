"""From rows of (step, track, state) to episodes: for recordings in which agents come and go."""

from collections import Counter
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from predictor.data.store import Episode


@dataclass(frozen=True)
class TrackRows:
    """One row per track and step of a recording, in any order; no pair of step and track occurs twice."""

    steps: Int[np.ndarray, " rows"]
    """Time, counted in steps from anywhere."""
    tracks: Int[np.ndarray, " rows"]
    """Identity within the recording."""
    states: Float[np.ndarray, "rows state"]
    """SI units."""

    def __len__(self) -> int:
        """Number of rows."""
        return len(self.steps)

    def where(self, keep: Bool[np.ndarray, " rows"]) -> "TrackRows":
        """The rows to keep."""
        return TrackRows(self.steps[keep], self.tracks[keep], self.states[keep])


def with_velocities(
    positions: TrackRows, dt_s: float
) -> tuple[TrackRows, Float[np.ndarray, "moving 2"], Int[np.ndarray, " moving"]]:
    """Rows whose track was present one step before, with the backward difference as their velocity.

    A track's first row has no velocity, nor has the first after a gap: both are left out, rather than made up.

    Args:
        positions: states are positions [m].
        dt_s: time between steps [s].

    Returns:
        The rows that are kept, sorted by track and step; their velocities [m/s]; which of the given rows they are.
    """
    order = np.lexsort((positions.steps, positions.tracks))
    steps, tracks, states = positions.steps[order], positions.tracks[order], positions.states[order]
    follows = np.flatnonzero((np.diff(tracks) == 0) & (np.diff(steps) == 1)) + 1
    velocities_mps = (states[follows] - states[follows - 1]) / dt_s
    return TrackRows(steps[follows], tracks[follows], states[follows]), velocities_mps, order[follows]


def cut_episodes(rows: TrackRows, episode_steps: int, label: str, counts: Counter[str]) -> list[Episode]:
    """Cut a recording into episodes that do not overlap, from its first step with an agent to its last.

    Within an episode each track has a column; steps without any agent stay, all invalid. The last episode may be
    shorter. Left out and counted are episodes without any agent and those of one step.
    """
    episodes = []
    first, last = (int(rows.steps.min()), int(rows.steps.max())) if len(rows) else (0, -1)
    for begin in range(first, last + 1, episode_steps):
        length = min(episode_steps, last + 1 - begin)
        inside = rows.where((rows.steps >= begin) & (rows.steps < begin + length))
        if not len(inside):
            counts["episodes left out: no agent"] += 1
        elif length < 2:
            counts["episodes left out: one step"] += 1
        else:
            episodes.append(_episode(inside, begin, length, label))
    return episodes


def _episode(rows: TrackRows, begin: int, length: int, label: str) -> Episode:
    ids, columns = np.unique(rows.tracks, return_inverse=True)
    states = np.zeros((length, len(ids), rows.states.shape[1]), dtype=np.float32)
    valid = np.zeros((length, len(ids)), dtype=np.bool_)
    states[rows.steps - begin, columns] = rows.states
    valid[rows.steps - begin, columns] = True
    return Episode(states, valid, ids.astype(np.int64), label)
