"""Identities from motion: what is counted in highway-env's own episodes."""

import sys

import pytest

from benchmarks import envpool_identity
from benchmarks.envpool_identity import IdentityConfig, count_replay
from predictor.support.errors import UserError


def test_a_replay_counts_the_vehicles_of_highway_env():
    assert count_replay("merge-v1", IdentityConfig(replay_vehicle_steps=20)).pairs >= 20


def test_an_unknown_replay_is_said_before_anything_is_counted(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(sys, "argv", ["envpool_identity", "--replay", "nonsense-v0"])
    monkeypatch.setattr(envpool_identity, "count_envpool", lambda *_: pytest.fail("counted"))
    with pytest.raises(UserError, match="nonsense-v0"):
        envpool_identity.main()


def test_a_replay_without_other_vehicles_is_an_error():
    with pytest.raises(UserError, match="parking-v0 had no other vehicle in 3 episodes; leave it out of --replay"):
        count_replay("parking-v0", IdentityConfig(replay_vehicle_steps=20))
