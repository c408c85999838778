"""Identities from motion: what is counted in highway-env's own episodes."""

import sys
from types import SimpleNamespace
from typing import Any

import numpy as np
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


class Reads:
    """A reader that numbers vehicles by where they are."""

    def read_all(self, states: list[Any], envs: np.ndarray) -> SimpleNamespace:
        longest = max(len(state.vehicles) for state in states)
        ids = np.full((len(states), longest), -1)
        for env, state in enumerate(states):
            ids[env, : len(state.vehicles)] = [vehicle.x for vehicle in state.vehicles]
        return SimpleNamespace(ids=ids)


def test_vehicles_are_known_by_exponent_and_order_whatever_the_length_of_the_list():
    def state(*vehicles: tuple[float, int]) -> SimpleNamespace:
        return SimpleNamespace(elapsed_step=0, vehicles=[SimpleNamespace(idm_delta=e, x=x) for e, x in vehicles])

    states = [state((4.0, 9), (3.9, 1), (4.1, 2)), state((4.0, 9), (4.0, 5), (4.0, 6), (3.7, 7))]
    numbers = envpool_identity._numbers(Reads(), states, np.arange(2), np.random.default_rng(1))  # type: ignore[arg-type]
    assert numbers == [{(3.9, 0): 1, (4.1, 0): 2}, {(4.0, 0): 5, (4.0, 1): 6, (3.7, 0): 7}]
