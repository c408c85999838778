"""Under which keys environments report crashes and success: known, registered or given ones, none that is guessed."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from envs.readers import OutcomeKeys, outcome_keys, register_reader
from envs.readers.outcomes import register_outcomes
from envs.registry import make_env
from envs.rollouts.world import EgoWorld
from envs.wrappers import SceneObservation
from predictor.support.errors import UserError
from tests.envs.dict_crowd import DictCrowd
from tests.envs.semantics import Crowd, Swarm, SwarmReader, read_crowd
from tests.envs.testing.test_check_reader import SPEC, FunctionReader

INFO = {"outcome": {"collided": True}, "crashed": False, "outcome.late": 1}


class Named(DictCrowd):
    """A crowd whose keys are named."""


class Heir(Named):
    """Inherits them."""


@pytest.mark.parametrize(
    ("key", "crashed"),
    [
        ("outcome.collided", True), ("crashed", False), ("outcome.late", True), ("outcome.absent", None),
        ("collided", None), ("crashed.deep", None),
    ],
)  # fmt: skip
def test_a_point_leads_into_a_nested_dict(key: str, crashed: bool | None):
    assert OutcomeKeys((key,)).crashed(INFO) is crashed


def test_of_several_egos_one_may_crash_and_all_must_succeed():
    keys = OutcomeKeys(("hit",), ("done",))
    assert keys.crashed({"hit": np.array([False, True])}) is True
    assert keys.succeeded({"done": (True, False)}) is False
    assert keys.succeeded({"done": np.array([1.0])}) is True
    assert keys.succeeded({}) is None
    for value in ({"speed": 3.0}, "no", ((True, False), True)):  # the first two would be true
        with pytest.raises(UserError, match="info hit must be true or false, or so for each ego, got"):
            keys.crashed({"hit": value})


def test_shares_of_egos_count_and_other_numbers_are_refused():
    keys = OutcomeKeys(("hit",), ("done",))
    assert [keys.crashed({"hit": share}) for share in (0, 0.5, 1)] == [False, True, True]
    assert [keys.succeeded({"done": share}) for share in (0.0, 0.5, 1.0)] == [False, False, True]
    for value in (20.5, -1, float("nan"), [0.0, 2.0]):
        with pytest.raises(UserError, match="info hit must be true or false"):
            keys.crashed({"hit": value})
        with pytest.raises(UserError, match="info done must be true or false"):
            keys.succeeded({"done": value})


def test_registered_keys_serve_all_that_derives():
    register_reader(Named, FunctionReader(read_crowd, SPEC), crash_key="outcome.collided", success_key="goal")
    for env in (Named(), Heir(), gym.Wrapper(Heir())):
        assert outcome_keys(env) == OutcomeKeys(("outcome.collided",), ("goal",))
    assert outcome_keys(Heir(), crash_key="hit") == OutcomeKeys(("hit",), ("goal",))
    assert outcome_keys(DictCrowd()) == OutcomeKeys((), ("is_success",))  # registered without keys
    assert outcome_keys(Crowd()).crashed(INFO) is None


@pytest.mark.parametrize(("env_id", "reports"), [("intersection-v2", True), ("exit-v1", True), ("merge-v1", False)])
def test_those_of_highway_env_are_known(env_id: str, reports: bool):
    env = make_env(env_id)
    env.reset(seed=0)
    info = env.step(env.action_space.sample())[-1]
    keys = outcome_keys(env)
    assert keys.crashed(info) is False
    assert (keys.succeeded(info) is not None) == reports
    assert keys.succeeded({"rewards": {"arrived_reward": 1.0}}) is True
    assert keys.succeeded({"rewards": 3.0}) is None


def test_a_world_knows_crashes_by_the_named_key():
    register_outcomes(Named, "outcome.collided")
    found: list[Any] = []
    for env in (Named(), DictCrowd()):
        world = EgoWorld(SceneObservation(env, reader=FunctionReader(read_crowd, SPEC)), "random")
        world.reset(0)
        found.append([world.crashed for _ in range(4) if not world.step()])
    assert found == [[False, False, True, True], [None] * 4]


def test_a_key_is_a_text():
    with pytest.raises(UserError, match="crash_key must be the name of a key of the infos, got"):
        outcome_keys(Crowd(), crash_key="")


def test_keys_of_outcomes_are_refused_for_pettingzoo_which_counts_none():
    with pytest.raises(UserError, match="crash_key and success_key are for .* one ego, but Swarm is PettingZoo's"):
        register_reader(Swarm, SwarmReader, crash_key="collided")
