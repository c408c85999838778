import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import pytest

from envs.registry import CHECKPOINTS, checkpoint_for, make_env, native_task_of
from envs.simulators.envpool import HIGHWAY_ENV_OF
from predictor.errors import UserError


@pytest.mark.parametrize("env_id", ["nonsense", "envpool/Nonsense-v0", "highway-v99", "no_such_module:Env-v0"])
def test_an_unknown_id_is_one_clear_line(env_id: str):
    with pytest.raises(UserError, match=f"cannot make env '{env_id}'.*known here: highway-v0, ") as error:
        make_env(env_id)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("absent", ["envpool", "envpool stable_baselines3"])
def test_an_env_of_envpool_without_envpool_says_what_to_install(absent: str):
    code = f"""
import sys
for name in {absent.split()!r}:
    sys.modules[name] = None  # importing it raises ImportError
from envs.registry import make_env
from predictor.errors import UserError
try:
    make_env("envpool/HighwayFast-v0")
except UserError as error:
    print(error)
"""
    root = Path(__file__).resolve().parents[2]
    command = [sys.executable, "-W", "ignore", "-c", code]
    done = subprocess.run(command, cwd=root, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    (line,) = done.stdout.splitlines()
    assert "need the envpool package" in line and "pip install 'dgvae-rl[envpool]'" in line


def test_native_environments_are_made_by_id():
    pytest.importorskip("envpool")
    env = make_env("envpool/HighwayFast-v0", vehicles_count=7)
    assert env.unwrapped.task_id == "HighwayFast-v0"  # type: ignore[attr-defined]
    assert env.unwrapped.native_config["vehicles_count"] == 7  # type: ignore[attr-defined]
    assert env.action_space == gym.spaces.Discrete(5)
    env.close()


@pytest.mark.parametrize(
    ("env_id", "task"),
    [
        ("highway-fast-v0", "HighwayFast-v0"),
        ("merge-v1", "Merge-v0"),
        ("racetrack-oval-v1", "RacetrackOval-v0"),
        ("intersection-v1", "Intersection-v1"),
        ("intersection-v2", "Intersection-v0"),
    ],
)
def test_the_native_copy_has_the_version_or_else_the_name(env_id: str, task: str):
    assert native_task_of(env_id) == task


def test_every_copy_is_found():
    assert {native_task_of(env_id) for env_id in HIGHWAY_ENV_OF.values()} == set(HIGHWAY_ENV_OF)


@pytest.mark.parametrize("env_id", ["merge-generic-v1", "roundabout-generic-v1", "nonsense", ""])
def test_what_was_not_copied_is_named(env_id: str):
    with pytest.raises(UserError, match=f"EnvPool has no copy of '{env_id}'; it has highway-v0, .*without --backend"):
        native_task_of(env_id)


@pytest.mark.parametrize(
    ("env_id", "checkpoint"),
    [
        ("envpool/HighwayFast-v0", "highway"),
        ("envpool/Merge-v0", "merge"),
        ("envpool/Intersection-v0", "intersection"),
        ("envpool/RacetrackLarge-v0", "racetrack-large"),
        ("highway-fast-v0", "highway"),
        ("racetrack-v1", "racetrack"),
    ],
)
def test_a_native_environment_has_the_checkpoint_of_its_original(env_id: str, checkpoint: str):
    assert checkpoint_for(env_id) == checkpoint


@pytest.mark.parametrize("env_id", ["envpool/Nonsense-v0", "envpool/", "CartPole-v1", "merge-v0"])
def test_where_no_checkpoint_ships_the_others_are_named(env_id: str):
    with pytest.raises(UserError, match=f"no checkpoint ships for env '{env_id}'.*Shipped ids: highway-v0, "):
        checkpoint_for(env_id)


def test_every_known_id_has_its_checkpoint():
    for env_id, checkpoint in CHECKPOINTS.items():
        assert checkpoint_for(env_id) == checkpoint
