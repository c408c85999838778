"""Finds what is probably wrong with a store that was made from text files of tracks, and is no error."""

from collections.abc import Mapping, Sequence

import numpy as np

from predictor.data.store import Episode

FASTEST_MPS = 100.0
"""Speed of an agent above which a line, or the unit, is probably wrong [m/s]."""
SLOWEST_MPS = 0.01
"""Speed of the fastest agent below which the unit is probably wrong [m/s]."""


def doubts(episodes: Sequence[Episode], counts: Mapping[str, int]) -> list[str]:
    """Returns what is probably wrong, one line for each thing: lines that are in no episode, and high speeds.

    Args:
        episodes: episodes of one store, at least one; position and velocity are the first four features.
        counts: numbers of lines, by what became of them.
    """
    found = []
    kept, read = sum(int(episode.valid.sum()) for episode in episodes), counts["lines read"]
    if 2 * kept < read:
        dropped = "; ".join(f"{name}: {count:,}" for name, count in counts.items() if "dropped" in name and count)
        found.append(f"only {kept:,} of {read:,} lines are in episodes ({dropped}); check --columns and --frame-step")
    speeds_mps = [np.where(e.valid, np.linalg.norm(e.states[..., 2:4], axis=-1), 0.0) for e in episodes]
    number = max(range(len(episodes)), key=lambda i: float(speeds_mps[i].max(initial=0.0)))
    fastest_mps, episode = speeds_mps[number], episodes[number]
    if fastest_mps.max(initial=0.0) > FASTEST_MPS:
        step, agent = np.unravel_index(fastest_mps.argmax(), fastest_mps.shape)
        found.append(
            f"agent {episode.ids[agent]} of '{episode.label}' moves at {fastest_mps.max():,.0f} m/s (episode {number}, "
            f"step {step}); check its lines, --columns, --scale and --dt-s"
        )
    elif fastest_mps.max(initial=0.0) < SLOWEST_MPS:
        found.append(
            f"nobody moves faster than {fastest_mps.max(initial=0.0):.1e} m/s; are positions degrees, or of another "
            "unit? Project them to metres, and check --columns, --scale and --dt-s"
        )
    return found
