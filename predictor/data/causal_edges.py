"""Causal edges in place of a store's edge labels, with attributes that say how a pair interacts.

The first feature dimensions of a dG-VAE learn these attributes by restricted labelling (`--label-weight`).
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from predictor.data.store import Episode, EpisodeStore

DRIVER_ATTRIBUTES = ("desired_speed_mps", "time_gap_s")
"""Attributes of a leader's edge, as recorded (docs/datasets/env.md), that become attributes of causal edges."""
CAUSAL_ATTRIBUTES = ("desired_speed_mps", "causal_strength", "leader", "time_gap_s")
"""Attributes of causal edges. First is what does not change within a pair, for pair matching (`static_dim=1`)."""
YIELDED = "desired_speed_mps"
"""Attribute that highway-env sets to 0 while a driver yields."""
STRENGTH = CAUSAL_ATTRIBUTES.index("causal_strength")
"""Column of the strength."""


def causal_types(shift_m: Float[np.ndarray, "*pairs"], threshold_m: float) -> Int[np.ndarray, "*pairs"]:
    """Returns edge types of causal labels: 1 where the shift exceeds the threshold, else 0, -1 where it is unknown."""
    return np.where(np.isnan(shift_m), -1, shift_m > threshold_m).astype(np.int8)


def causal_strength(shift_m: Float[np.ndarray, "*pairs"], threshold_m: float) -> Float[np.ndarray, "*pairs"]:
    """Returns the strength of causal edges, log(1 + shift / threshold); NaN where unknown."""
    return np.log1p(shift_m / threshold_m).astype(np.float32)


def with_causal_edges(store: EpisodeStore, threshold_m: float | None = None) -> EpisodeStore:
    """Returns the store with causal edges in place of its edge labels, for training and scores on them.

    `edge_types` are those of `causal_types`. The attributes are `CAUSAL_ATTRIBUTES`, NaN where unknown: the strength
    (`causal_strength`) of pairs with a causal label; whether the sender leads the receiver, of pairs with a label of
    leaders; wished speed and time gap of the receivers of leaders. In a store without causal labels all edges are
    unknown.

    Args:
        store: a store.
        threshold_m: shift above which an edge counts [m]; None takes the store's.
    """
    given = store.info.causal_threshold_m if threshold_m is None else threshold_m
    names = store.info.edge_attribute_names
    columns = [names.index(name) for name in DRIVER_ATTRIBUTES] if set(DRIVER_ATTRIBUTES) <= set(names) else None
    episodes = [_with_causal_edges(episode, given, columns) for episode in store.episodes]
    info = replace(store.info, edge_attribute_names=CAUSAL_ATTRIBUTES, causal_threshold_m=given)
    return EpisodeStore(info, episodes)


def known(attribute: Float[np.ndarray, "*edges"], name: str) -> Float[np.ndarray, "*edges"]:
    """Returns an attribute with NaN where it is not known: what a driver wishes that yields is not recorded."""
    return np.where(attribute <= 0, np.nan, attribute) if name == YIELDED else attribute


def _with_causal_edges(episode: Episode, threshold_m: float | None, columns: list[int] | None) -> Episode:
    """Returns an episode with causal edges; `columns` are those of the drivers' attributes, None without any."""
    types = None if columns is None else episode.edge_types
    shift_m = None if threshold_m is None else episode.causal_shift_m
    steps = max(1 if labels is None else len(labels) for labels in (types, shift_m))
    pairs = (steps, len(episode.ids), len(episode.ids))
    shift_m = np.broadcast_to(np.float32(np.nan) if shift_m is None else shift_m, pairs)
    attributes = np.full((*pairs, len(CAUSAL_ATTRIBUTES)), np.nan, dtype=np.float32)
    attributes[..., STRENGTH] = causal_strength(shift_m, threshold_m or np.inf)
    if types is not None and columns is not None and episode.edge_attributes is not None:
        attributes[..., CAUSAL_ATTRIBUTES.index("leader")] = np.where(types < 0, np.nan, types > 0)
        for name, column in zip(DRIVER_ATTRIBUTES, columns, strict=True):
            of_driver = known(episode.edge_attributes[..., column], name)
            attributes[..., CAUSAL_ATTRIBUTES.index(name)] = np.where(types > 0, of_driver, np.nan)
    return replace(episode, edge_types=causal_types(shift_m, threshold_m or np.inf), edge_attributes=attributes)
