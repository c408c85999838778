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
