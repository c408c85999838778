import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from envs.drivers.all_agents import make_driver
from envs.drivers.ego import make_ego_driver
from envs.readers.base import role_of
from envs.registry import (
    CHECKPOINTS,
    ENVS,
    MULTIAGENT_CHECKPOINTS,
    MULTIAGENT_IDS,
    EnvEntry,
    checkpoint_for,
    entry_for,
    envpool_task_of,
    is_multiagent_id,
    make_env,
    make_multiagent_env,
)
from envs.simulators.envpool import ENV_IDS as ENVPOOL_IDS
from envs.simulators.envpool import HIGHWAY_ENV_OF, known_tasks
from envs.wrappers import SceneObservation
from predictor.checkpoint import resolve
from predictor.support.errors import UserError


@pytest.mark.parametrize("env_id", ["nonsense", "envpool/Nonsense-v0", "highway-v99", "no_such_module:Env-v0"])
def test_an_unknown_id_is_one_clear_line(env_id: str):
    with pytest.raises(UserError, match=f"cannot make env '{env_id}'.*known here: highway-v0, ") as error:
        make_env(env_id)
    assert "\n" not in str(error.value)


@pytest.mark.slow
def test_an_env_of_envpool_without_envpool_says_what_to_install():
    code = """
import sys
sys.modules["envpool"] = sys.modules["stable_baselines3"] = None  # importing them raises ImportError
from envs.registry import make_env
from predictor.support.errors import UserError
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


def test_envpool_environments_are_made_by_id():
    pytest.importorskip("envpool")
    env = make_env("envpool/HighwayFast-v0", vehicles_count=7)
    assert env.unwrapped.task_id == "HighwayFast-v0"  # type: ignore[attr-defined]
    assert env.unwrapped.envpool_config["vehicles_count"] == 7  # type: ignore[attr-defined]
    assert env.action_space == gym.spaces.Discrete(5)
    env.close()


@pytest.mark.parametrize(
    ("env_id", "before", "since"),
    [
        ("highway-fast-v0", "HighwayFast-v0", "HighwayFast-v0"),
        ("merge-v1", "Merge-v0", "Merge-v1"),
        ("racetrack-oval-v1", "RacetrackOval-v0", "RacetrackOval-v1"),
        ("intersection-v1", "Intersection-v1", "Intersection-v1"),
        ("intersection-v2", "Intersection-v0", "Intersection-v2"),
    ],
)
def test_the_envpool_copy_has_the_version_or_else_the_name(
    env_id: str, before: str, since: str, monkeypatch: pytest.MonkeyPatch
):
    """EnvPool 1.2.7 has the newer versions; releases before it have the first ones alone."""
    for release, task in (((1, 2, 5), before), ((1, 2, 7), since), ((1, 2, 10), since)):
        monkeypatch.setattr("envs.simulators.envpool.envpool_release", lambda release=release: release)
        assert envpool_task_of(env_id) == task


def test_every_copy_is_found():
    tasks = known_tasks()
    assert {envpool_task_of(HIGHWAY_ENV_OF[task]) for task in tasks} == set(tasks)


@pytest.mark.parametrize("env_id", ["lane-keeping-v0", "nonsense", ""])
def test_what_was_not_copied_is_named(env_id: str):
    with pytest.raises(UserError, match=f"EnvPool has no copy of '{env_id}'; it has highway-v0, .*without --backend"):
        envpool_task_of(env_id)


@pytest.mark.parametrize(
    ("env_id", "checkpoint"),
    [
        ("envpool/HighwayFast-v0", "highway"),
        ("envpool/Merge-v0", "merge"),
        ("envpool/Intersection-v0", "intersection"),
        ("envpool/RacetrackLarge-v0", "racetrack-large"),
        ("envpool/IntersectionContinuous-v1", "intersection"),
        ("highway-fast-v0", "highway"),
        ("racetrack-v1", "racetrack"),
    ],
)
def test_an_envpool_environment_has_the_checkpoint_of_its_original(env_id: str, checkpoint: str):
    assert checkpoint_for(env_id) == checkpoint


@pytest.mark.parametrize("env_id", ["envpool/Nonsense-v0", "envpool/", "CartPole-v1", "merge-v0"])
def test_where_no_checkpoint_ships_the_others_are_named(env_id: str):
    with pytest.raises(UserError, match=f"no checkpoint ships for env '{env_id}'.*Shipped ids: highway-v0, "):
        checkpoint_for(env_id)


def test_every_known_id_has_its_checkpoint():
    for env_id, checkpoint in (CHECKPOINTS | MULTIAGENT_CHECKPOINTS).items():
        assert checkpoint_for(env_id) == checkpoint
        assert resolve(checkpoint).is_dir()


def test_one_entry_tells_which_kind_an_id_is():
    assert set(MULTIAGENT_CHECKPOINTS) < set(MULTIAGENT_IDS)
    assert not set(CHECKPOINTS) & set(MULTIAGENT_IDS)
    assert {env_id for env_id in ENVS if is_multiagent_id(env_id)} == set(MULTIAGENT_IDS)


@pytest.mark.parametrize("env_id", [env_id for env_id in ENVS if env_id not in ENVPOOL_IDS])
def test_every_listed_id_is_made_and_driven_by_its_default_drivers(env_id: str):
    """An entry that names a heuristic where there is none, or none where there is one, is wrong."""
    entry = entry_for(env_id)
    rng = np.random.default_rng(0)
    if not entry.multiagent:
        env = make_env(env_id)
        for name in entry.drivers:
            make_ego_driver(name, SceneObservation(env), rng)
        env.close()
        return
    multiagent = make_multiagent_env(env_id)
    for name in entry.drivers:
        make_driver(name, multiagent, rng)
    assert set(entry.learners) <= {role_of(agent) for agent in multiagent.possible_agents}
    if "heuristic" not in entry.drivers:
        with pytest.raises(UserError, match="no heuristic drives"):
            make_driver("heuristic", multiagent, rng)
    multiagent.close()


def test_an_id_that_is_not_listed_has_an_entry_without_a_checkpoint():
    assert entry_for("CartPole-v1") == EnvEntry()


@pytest.mark.slow
@pytest.mark.parametrize("door", ["envs.readers", "envs.wrappers"])  # both import envs.registry
def test_gymnasium_environments_are_made_without_pettingzoo(door: str):
    code = f"""
import sys
sys.modules["pettingzoo"] = sys.modules["mpe2"] = sys.modules["envpool"] = None  # importing them raises ImportError
import {door}
import gymnasium, envs.registry
envs.registry.make_env("highway-mixed-v0").close()
assert not envs.registry.is_multiagent_id("highway-v0") and envs.registry.is_multiagent_id("pursuit_v5")
"""
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.slow
def test_importing_the_wrappers_registers_our_ids():
    code = "import envs.wrappers, gymnasium; gymnasium.make('highway-mixed-v0'); gymnasium.make('highway-fast-v0')"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_render_mode_is_a_text():
    with pytest.raises(UserError, match="cannot make env 'merge-v1': render_mode must be a text, got 5"):
        make_env("merge-v1", render_mode=5)
