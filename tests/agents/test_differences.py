from dataclasses import replace

import numpy as np
import pytest

from agents.differences import reference_policy, return_differences
from agents.vec_envs import EpisodeResult
from tests.agents.helpers import EPISODES


def played(*returns: float, **steps: int) -> list[EpisodeResult]:
    """Returns episodes with these returns, each with so many steps of each action."""
    return [replace(EPISODES[0], seed=i, episode_return=r, action_counts=steps) for i, r in enumerate(returns)]


def test_the_best_constant_action_is_the_reference():
    results = {
        "ppo": played(9.0, slower=30),  # one action, but not a driver that is named after it
        "random": played(8.0, slower=10, faster=20),
        "faster": played(3.0, faster=30),
        "slower": played(5.0, slower=30),
        "idle": played(4.0, idle=30),
    }
    assert reference_policy(results) == "slower"
    assert reference_policy(results | {"idle": played(6.0, **{"action-0": 30})}) == "idle"


def test_without_a_constant_action_the_first_policy_is_the_reference():
    assert reference_policy({"ppo": played(1.0), "idle": played(2.0)}) == "ppo"  # continuous actions are not counted
    assert reference_policy({}) is None


def test_differences_are_of_pairs():
    """Both policies differ by 100 between the seeds, and by 1 and 3 on each: the interval knows of the latter only."""
    reference = played(0.0, 100.0)
    found = return_differences({"a": reference, "b": [*reversed(played(1.0, 103.0))]}, "a")
    assert list(found) == ["b"]
    assert found["b"].value == 2.0
    assert found["b"].interval == (1.0, 3.0)  # a quarter of the draws has twice the one, a quarter twice the other


def test_intervals_do_not_depend_on_how_many_are_drawn_at_once(monkeypatch: pytest.MonkeyPatch):
    results = {"a": played(*range(30)), "b": played(*np.random.default_rng(0).normal(size=30))}
    expected = return_differences(results, "a")
    monkeypatch.setattr("predictor.evaluation.standard_errors.MOST_DRAWN", 100)
    found = return_differences(results, "a")
    assert found["b"].interval == pytest.approx(expected["b"].interval)


def test_the_interval_is_that_of_a_normal_mean():
    """Of 400 differences with spread 2 it has half the width 1.96 · 2 / 20."""
    noise = np.random.default_rng(0).standard_normal(400)
    noise = 2 * (noise - noise.mean()) / noise.std()
    found = return_differences({"a": played(*[5.0] * 400), "b": played(*(5.5 + noise))}, "a")["b"]
    assert found.value == pytest.approx(0.5)
    assert found.interval == pytest.approx((0.5 - 0.196, 0.5 + 0.196), abs=0.01)
    assert return_differences({"a": played(*[5.0] * 400), "b": played(*(5.5 + noise))}, "a")["b"] == found


def test_seeds_that_one_of_both_has_not_played_are_left_out():
    found = return_differences({"a": played(1.0, 2.0), "b": played(4.0, 6.0, 99.0), "c": EPISODES}, "a")
    assert list(found) == ["b"] and found["b"].value == 3.5
    single = return_differences({"a": played(1.0), "b": played(4.0, 6.0)}, "a")["b"]
    assert (single.value, single.interval) == (3.0, None)
