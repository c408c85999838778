"""Causal edges of a store, and the attributes that the first feature dimensions learn."""

from dataclasses import replace

import numpy as np
import pytest

from predictor.data.causal_edges import CAUSAL_ATTRIBUTES, STRENGTH, with_causal_edges
from predictor.data.store import Episode, EpisodeStore, StoreInfo
from tests.predictor.helpers import circling_episode, spec

DRIVERS = ("time_gap_s", "headway_m", "desired_speed_mps")


def shifted(steps: int = 4) -> Episode:
    """At step 1, an intervention on agent 0 moves the agents by 0, 0.5, 1 and 1.5 m; its own shift is unknown."""
    plain = circling_episode(0, steps=steps, agents=4)
    shift_m = np.full((steps, len(plain.ids), len(plain.ids)), np.nan, dtype=np.float32)
    shift_m[1, :, 0] = np.arange(len(plain.ids)) / 2
    shift_m[1, 0, 0] = np.nan
    return replace(plain, causal_shift_m=shift_m)


def led(episode: Episode, steps: int = 4) -> Episode:
    """Agent 1 follows agent 0: a gap of 2 s, a wished speed of 25 m/s, 0 at step 2. Who leads agent 0 is unknown."""
    agents = len(episode.ids)
    types = np.zeros((steps, agents, agents), dtype=np.int8)
    types[:, 0] = -1
    types[:, 1, 0] = 1
    attributes = np.zeros((steps, agents, agents, len(DRIVERS)), dtype=np.float32)
    attributes[:, 1, 0] = (2.0, 40.0, 25.0)
    attributes[2, 1, 0, 2] = 0.0
    return replace(episode, edge_types=types, edge_attributes=attributes)


def causal(episode: Episode, threshold_m: float | None = None, **info: object) -> Episode:
    store = EpisodeStore(StoreInfo(spec(), "circle", **info), [episode])
    (found,) = with_causal_edges(store, threshold_m).episodes
    return found


def attribute(episode: Episode, name: str) -> np.ndarray:
    assert episode.edge_attributes is not None
    return episode.edge_attributes[..., CAUSAL_ATTRIBUTES.index(name)]


def test_causal_edges_are_unknown_wherever_nothing_was_tried():
    episode = causal(shifted(), causal_threshold_m=0.75)
    assert episode.edge_types is not None and episode.edge_attributes is not None
    assert episode.edge_types[1, :, 0].tolist() == [-1, 0, 1, 1]
    assert (episode.edge_types[[0, 2, 3]] == -1).all() and (episode.edge_types[1, :, 1:] == -1).all()
    strength = episode.edge_attributes[..., STRENGTH]
    np.testing.assert_allclose(strength[1, 1:, 0], np.log1p(np.array([0.5, 1.0, 1.5]) / 0.75), rtol=1e-6)
    assert np.isfinite(episode.edge_attributes).sum() == 3
    strict = causal(shifted(), 1.2, causal_threshold_m=0.75)
    assert strict.edge_types is not None and strict.edge_types[1, :, 0].tolist() == [-1, 0, 0, 1]


def test_all_edges_are_unknown_in_a_store_without_causal_labels():
    episode = causal(circling_episode(0, steps=4, agents=4))
    assert episode.edge_types is not None and (episode.edge_types == -1).all()
    assert episode.edge_attributes is not None and np.isnan(episode.edge_attributes).all()


@pytest.mark.parametrize("with_shifts", [True, False])
def test_leaders_and_their_gaps_become_attributes(with_shifts: bool):
    """Beside causal labels and without any, which are other edges."""
    before = led(shifted() if with_shifts else circling_episode(0, steps=4, agents=4))
    episode = causal(before, edge_attribute_names=DRIVERS, causal_threshold_m=0.75)
    leader = attribute(episode, "leader")
    assert np.isnan(leader[:, 0]).all() and (leader[:, 1, 0] == 1).all()
    assert not leader[:, 1, 1:].any() and not leader[:, 2:].any()
    gap, speed = attribute(episode, "time_gap_s"), attribute(episode, "desired_speed_mps")
    assert gap[:, 1, 0].tolist() == [2.0] * 4 and np.isfinite(gap).sum() == 4
    np.testing.assert_array_equal(speed[:, 1, 0], [25.0, 25.0, np.nan, 25.0])  # what it wishes while it yields
    assert np.isfinite(speed).sum() == 3
    assert np.isfinite(attribute(episode, "causal_strength")).sum() == (3 if with_shifts else 0)
    assert episode.edge_types is not None and (episode.edge_types >= 0).sum() == (3 if with_shifts else 0)


def test_a_store_whose_attributes_are_other_ones_has_no_leaders():
    """Springs have edges that lead nobody."""
    episode = causal(led(shifted()), edge_attribute_names=("spring_constant", "b", "c"), causal_threshold_m=0.75)
    assert episode.edge_attributes is not None and np.isfinite(episode.edge_attributes).sum() == 3


def test_all_stores_get_equal_names():
    for names in (DRIVERS, ()):
        store = EpisodeStore(
            StoreInfo(spec(), "circle", edge_attribute_names=names), [circling_episode(0, steps=4, agents=4)]
        )
        assert with_causal_edges(store).info.edge_attribute_names == CAUSAL_ATTRIBUTES
