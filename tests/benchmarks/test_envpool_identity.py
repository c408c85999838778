"""Identities from motion: what is counted in highway-env's own episodes."""

import pytest

from benchmarks.envpool_identity import IdentityConfig, count_replay
from predictor.support.errors import UserError


def test_a_replay_counts_the_vehicles_of_highway_env():
    assert count_replay("merge-v1", IdentityConfig(replay_vehicle_steps=20)).pairs >= 20


def test_a_replay_without_other_vehicles_is_an_error():
    with pytest.raises(UserError, match="parking-v0 had no other vehicle in 3 episodes; leave it out of --replay"):
        count_replay("parking-v0", IdentityConfig(replay_vehicle_steps=20))
