from typing import Any

import gymnasium as gym
import pytest

from envs.registry import CHECKPOINTS, make_any_env, make_env, make_multiagent_env
from predictor.support.errors import UserError


@pytest.mark.parametrize(
    ("env_id", "name", "advice"),
    [
        ("highway-fast-v0", "vehicle_count", r"did you mean vehicles_count\?"),
        ("merge-v1", "vehicles_density", "it has action, centering_position, "),
        ("highway-mixed-v0", "duratoin", r"did you mean duration\?"),
        ("intersection-multi-agent-v2", "controlled_vehicle", r"did you mean controlled_vehicles\?"),
    ],
)
def test_a_setting_that_the_environment_does_not_have_is_refused(env_id: str, name: str, advice: str):
    settings = {name: 3} if "multi" in env_id else {"config": {name: 3}}
    with pytest.raises(UserError, match=f"'{env_id}' has no setting '{name}' in its config; {advice}"):
        make_any_env(env_id, **settings)


@pytest.mark.parametrize(
    ("env_id", "config", "message"),
    [
        (
            "highway-fast-v0",
            {"observation": {"type": "Kinematics", "vehicle_count": 9}},
            r"KinematicObservation of 'highway-fast-v0' has no setting 'vehicle_count' in its observation; "
            r"did you mean vehicles_count\?",
        ),
        (
            "highway-fast-v0",
            {"observation": {"type": "TimeToCollision", "vehicles_count": 9}},
            "TimeToCollisionObservation of 'highway-fast-v0' has no setting 'vehicles_count' in its observation; it "
            "has horizon, type",
        ),
        (
            "merge-v1",
            {"action": {"type": "DiscreteMetaAction", "target_speed": [20, 30]}},
            r"DiscreteMetaAction of 'merge-v1' has no setting 'target_speed' in its action; did you mean target_speeds",
        ),
        (
            "intersection-multi-agent-v2",
            {"action": {"type": "MultiAgentAction", "action_config": {"type": "DiscreteMetaAction", "laterel": False}}},
            r"DiscreteMetaAction of 'intersection-multi-agent-v2' has no setting 'laterel' in its "
            r"action.action_config; did you mean lateral",
        ),
    ],
)
def test_a_setting_that_an_observation_or_action_does_not_have_is_refused(
    env_id: str, config: dict[str, Any], message: str
):
    with pytest.raises(UserError, match=message):
        make_any_env(env_id, **(config if "multi" in env_id else {"config": config}))


@pytest.mark.parametrize(
    "observation",
    [
        {"type": "Kinematics", "features": ["x", "y"], "absolute": True, "order": "shuffled"},
        {"type": "OccupancyGrid", "features": ["presence"], "grid_step": [5, 5]},
        {"type": "LidarObservation", "cells": 8},
    ],
)
def test_settings_of_a_type_that_the_config_chooses_are_taken(observation: dict[str, Any]):
    env = make_env("highway-fast-v0", config={"observation": observation})
    assert env.unwrapped.config["observation"] == observation  # type: ignore[attr-defined]


@pytest.mark.parametrize("env_id", CHECKPOINTS)
def test_all_settings_that_an_environment_has_are_taken(env_id: str):
    config = make_env(env_id).unwrapped.config  # type: ignore[attr-defined]
    assert make_env(env_id, config=config).unwrapped.config == config  # type: ignore[attr-defined]


def test_a_setting_reaches_the_environment():
    merge = make_env("merge-v1", config={"collision_reward": -7})
    assert merge.unwrapped.config["collision_reward"] == -7  # type: ignore[attr-defined]
    assert len(make_multiagent_env("intersection-multi-agent-v2", controlled_vehicles=3).possible_agents) == 3


def test_a_config_of_another_environment_is_its_own_matter():
    class Other(gym.Env):
        def __init__(self, config: dict[str, int]) -> None:
            self.config = config

    gym.register("Other-v0", Other)
    try:
        other = make_env("Other-v0", config={"anything": 1}, disable_env_checker=True)
        assert other.unwrapped.config == {"anything": 1}  # type: ignore[attr-defined]
    finally:
        del gym.registry["Other-v0"]
