"""Fits the scales of a network's inputs and outputs to the training data."""

from collections.abc import Sequence

import numpy as np
import torch

from predictor.data.store import Episode
from predictor.graph import pair_mask
from predictor.layers.state_codec import Residual, StateCodec, drift
from predictor.scene import SceneSpec

_FLAT = 1e-6
"""Standard deviation, as a share of the mean or of 1, below which an attribute never varies."""
_MOST_PAIRS = 10_000_000
"""Largest number of pairs of agents, over steps, whose distances are computed at once."""


def typical_change(episodes: Sequence[Episode], spec: SceneSpec, residual: Residual) -> tuple[float, ...]:
    """Computes the root mean square of the change that the decoder predicts in one step, per feature [SI]."""
    total, count = np.zeros(spec.num_features), 0
    for episode in episodes:
        both = episode.valid[1:] & episode.valid[:-1]
        before, after = (torch.from_numpy(s) for s in (episode.states[:-1], episode.states[1:]))
        change = (after - before).numpy()
        change[..., : spec.position_dim] -= drift(spec, residual, before, after).numpy()
        total += np.square(change[both].astype(np.float64)).sum(axis=0)
        count += int(both.sum())
    scale = np.sqrt(total / max(count, 1))
    return tuple(float(s) for s in np.maximum(scale, 1e-3))


def typical_spread(episodes: Sequence[Episode], spec: SceneSpec) -> tuple[float, ...]:
    """Computes the standard deviation of each input feature over the data [SI], with positions in the spec's frame."""
    states = [_in_frame(episode, spec)[episode.valid] for episode in episodes]
    spread = np.concatenate(states).astype(np.float64).std(axis=0)
    least = 1e-2 * np.array(spec.feature_scales)
    return tuple(float(s) for s in np.maximum(spread, least))


def typical_neighbour(episodes: Sequence[Episode], spec: SceneSpec) -> tuple[float, ...]:
    """Computes the median distance of an agent to the nearest other [m], and their median relative speed [m/s].

    Returns:
        Both, or nothing if no step has two agents: then no pair has a geometry.
    """
    axes, distances, speeds = spec.position_dim, [], []
    for episode in episodes:
        if len(episode.ids) < 2:
            continue
        steps = max(1, _MOST_PAIRS // len(episode.ids) ** 2)  # a whole recording has thousands of ids
        whole = torch.from_numpy(episode.states), torch.from_numpy(episode.valid)
        for states, valid in zip(*(t.split(steps) for t in whole), strict=True):
            place = states[..., :axes]
            apart = torch.cdist(place, place, compute_mode="donot_use_mm_for_euclid_dist")
            found = apart.masked_fill(~pair_mask(valid), torch.inf).min(-1)
            velocity = states[..., axes : 2 * axes]
            other = velocity.gather(1, found.indices[..., None].expand_as(velocity))
            near = found.values < torch.inf
            distances.append(found.values[near])
            speeds.append(torch.linalg.vector_norm(other - velocity, dim=-1)[near])
    if not sum(len(d) for d in distances):
        return ()
    return tuple(max(float(torch.cat(found).median()), 1e-2) for found in (distances, speeds))


def typical_label(episodes: Sequence[Episode], column: int) -> tuple[float, float] | None:
    """Computes mean and standard deviation of an edge attribute over the pairs where it is known.

    Args:
        episodes: episodes with edge attributes, NaN where unknown.
        column: column of the attribute.

    Returns:
        Both; None if it is known nowhere or never varies.
    """
    parts = [e.edge_attributes[..., column].ravel() for e in episodes if e.edge_attributes is not None]
    known = np.concatenate([part[np.isfinite(part)] for part in parts] or [np.zeros(0)]).astype(np.float64)
    if not len(known) or known.std() <= _FLAT * max(1.0, abs(known.mean())):
        return None
    return float(known.mean()), float(known.std())


def _in_frame(episode: Episode, spec: SceneSpec) -> np.ndarray:
    codec = StateCodec(spec)
    inputs = codec.inputs(torch.from_numpy(episode.states), torch.from_numpy(episode.valid))[..., : spec.num_features]
    framed: np.ndarray = (inputs * codec.scales).numpy()
    return framed
