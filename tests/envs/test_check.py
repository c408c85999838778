"""`dgvae check-env`: finds planted mistakes, one line each, and nothing where nothing is wrong."""

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from envs import check
from envs.check import CheckConfig, examined, with_option
from envs.collect import CollectConfig, warnings_of
from envs.readers import reader_for
from envs.registry import is_multiagent_id
from envs.testing import examine_reader, store_problems
from envs.testing.playing import Episode as EpisodeOf
from envs.testing.recorded import observation_problems
from predictor.data.store import Episode, StoreInfo
from predictor.scene import Scene
from predictor.support.errors import UserError, one_line, run_entry_point
from tests.envs import planted
from tests.envs.semantics import read_crowd
from tests.envs.testing.test_check_reader import MISTAKES, SPEC, Pushed, by_distance

PLANTED = (
    *("dt_s", "units", "centimetres", "mirrored axis", "swapped axes", "row numbers", "ids change hands"),
    *("id returns", "id of the newcomer", "ego not first", "ego moves", "nan", "degrees", "old scene"),
)


def problems_of(config: CheckConfig) -> list[str]:
    """What is wrong, one line for each thing, as the command prints it."""
    return [one_line(UserError(line)) for line in examined(config).problems]


@pytest.mark.parametrize("mistake", PLANTED)
def test_each_planted_mistake_is_named_in_a_line(mistake: str):
    config = CheckConfig("tests.envs.planted:Walk", f"tests.envs.planted:{mistake.replace(' ', '_')}")
    found = problems_of(config)
    assert any(MISTAKES[mistake][1] in line for line in found), found
    assert all("\n" not in line for line in found)


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("Forgetful", "the environment's own observation never changes within an episode, although agents move"),
        ("Broken", "the environment's own observation is not finite in step 3"),
        ("Priceless", "the environment's own reward is not finite in step 1"),
        ("Unnamed", "the environment's own reward must be one number, got 'high' in step 1"),
        ("Wide", "its space is from -1.5 to 1.5, in step 0: its observation_space must hold all that it shows"),
        ("Longer", "the environment's own observation has the shape (8, 7), its space (3,), in step 0"),
        ("Keyless", "the environment's own observation must be a dict with ['table'], got ndarray, in step 0"),
        ("Old", "step must return 5 values (observation, reward, terminated, truncated, info), got 4 values"),
        ("Bare", "reset must return 2 values (observation, info), got ndarray"),
        ("Silent", "step: info must be a dict, got NoneType"),
        ("Seedless", "Seedless.reset must take seed and options, got reset(); define reset(self, seed=None, options"),
        ("Falling", "the environment's step failed with RuntimeError: it fell"),
        ("Plural", "step: terminated must be True or False, got array([False, False])"),
        ("FewOptions", "FewOptions.reset must take seed and options, got reset(seed); define reset("),
        ("NoInfos", "step: infos must be a dict, got NoneType"),
        ("Chance", "two resets with seed 0 begin different episodes, so nothing can be compared or repeated"),
        ("FastSwarm", "velocities in km/h?"),
    ],
)
def test_mistakes_of_the_environment_are_named_too(name: str, sentence: str):
    found = problems_of(CheckConfig(f"tests.envs.planted:{name}"))
    assert any(sentence in line for line in found), found


@pytest.mark.parametrize("method", ["reset", "see"])
def test_what_a_reader_raises_is_named_whatever_it_does(method: str, monkeypatch: pytest.MonkeyPatch):
    def fail(*_: Any) -> None:
        raise IndexError("of a table")

    walk = planted.Walk()
    reader = reader_for(walk)
    monkeypatch.setattr(type(reader), method, fail, raising=False)
    (found,) = examine_reader(walk, None, episodes=1, max_steps=3, seed=0).problems
    assert f"{method} failed with IndexError: of a table" in found


def test_a_script_without_a_guard_does_not_end_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """sys.exit(0) at its end made the check succeed without a word."""
    (tmp_path / "script_of_mine.py").write_text("import sys\nclass Env: pass\nsys.exit(0)\n")
    monkeypatch.syspath_prepend(tmp_path)
    for env_id in ("script_of_mine:Env", "script_of_mine:Env-v0"):
        with pytest.raises(UserError, match="cannot import 'script_of_mine' for .*: SystemExit: 0"):
            problems_of(CheckConfig(env_id))
    with pytest.raises(UserError, match="cannot import 'script_of_mine'"):
        is_multiagent_id("script_of_mine:Env-v0")
    assert not is_multiagent_id("nowhere_at_all:Env-v0")


@pytest.mark.parametrize(
    ("space", "seen", "sentence"),
    [
        (gym.spaces.Discrete(3), 3, " is 3, its space Discrete(3)"),
        (gym.spaces.Discrete(3), 2, None),
        (gym.spaces.MultiBinary(2), [0, 1], None),
        (gym.spaces.Dict({"a": gym.spaces.Discrete(2)}), {"a": 5}, "['a'] is 5, its space Discrete(2)"),
        (gym.spaces.Box(-1, 1, (2,)), [1.0, -2.0], " has -2 at [1], its space is from -1 to 1"),
        (gym.spaces.Box(-1, 1, (2,)), [1.000001, -1.0], None),
    ],
)
def test_observations_are_compared_with_their_space(space: gym.Space, seen: Any, sentence: str | None):
    found = observation_problems([EpisodeOf([], [{"": seen}])], {"": space})
    assert found == [] if sentence is None else f"own observation{sentence}, in step 0" in found[0]


def test_an_agent_without_a_space_is_named():
    (found,) = observation_problems([EpisodeOf([], [{"second": 0}])], {"first": gym.spaces.Discrete(2)})
    assert "own observation of 'second' has no space, named are ['first'], in step 0" in found


ROADS = ("highway-fast-v0", "intersection-v2", "simple_tag_v3")


@pytest.mark.slow
@pytest.mark.parametrize(
    "env_id", [*ROADS, "tests.envs.planted:Walk", "tests.envs.planted:Lower", "tests.envs.planted:Trembling"]
)
def test_nothing_is_found_where_nothing_is_wrong(env_id: str):
    assert problems_of(CheckConfig(env_id, episodes=2, max_steps=15)) == []


def test_the_command_ends_with_status_1_if_something_is_wrong(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
):
    monkeypatch.setattr(sys, "argv", ["check", "tests.envs.planted:Broken", "--episodes", "1"])
    with pytest.raises(SystemExit) as leaving:
        run_entry_point(check.main)
    assert leaving.value.code == 1
    (line,) = capsys.readouterr().out.splitlines()
    assert "not finite" in line
    monkeypatch.setattr(sys, "argv", ["check", "--env-id", "tests.envs.planted:Walk", "--episodes", "2"])
    run_entry_point(check.main)
    assert capsys.readouterr().out == "nothing found in 2 episodes; 97% of the others' ids last from step to step\n"


@pytest.mark.parametrize(
    ("config", "sentence"),
    [
        ({"env_id": "CartPole-v1"}, "no scene reader knows CartPoleEnv"),
        ({"env_id": "nowhere:Env-v0"}, "cannot import 'nowhere' for 'nowhere:Env-v0'"),
        ({"env_id": "tests.envs.planted:a_number"}, "must give a gymnasium Env or a pettingzoo ParallelEnv, got int"),
        ({"env_id": "tests.envs.planted:Walk", "env_kwargs": '{"size": 3}'}, "unexpected keyword argument 'size'"),
        ({"env_id": "tests.envs.planted:Walk", "env_kwargs": "size=3"}, "env_kwargs must be a JSON object"),
        ({"env_id": "tests.envs.planted:Walk", "reader": "tests.envs.planted:absent"}, "has no function or class"),
    ],
)
def test_bad_values_end_in_one_line(config: dict[str, Any], sentence: str):
    with pytest.raises(UserError, match=sentence):
        problems_of(CheckConfig(**config))


def test_the_environment_may_come_first():
    assert with_option(["highway-v0", "--seed", "1"]) == ["--env-id", "highway-v0", "--seed", "1"]
    assert with_option(["--env-id", "highway-v0"]) == ["--env-id", "highway-v0"]
    assert with_option([]) == []


def recorded(change: Callable[[Scene], Scene] = lambda scene: scene, episodes: int = 3) -> list[Episode]:
    """Episodes of the crowd, as a collection stores them."""
    found = []
    for seed in range(episodes):
        env = Pushed(shift_m=40.0)
        env.reset(seed=seed)
        scenes = [change(read_crowd(env))]
        over = False
        while not over:
            *_, over, _ = env.step(env.np_random.uniform(-1, 1, 2))
            scenes.append(change(read_crowd(env)))
        found.append(Episode.from_scenes(scenes))
    return found


def row_numbers(scene: Scene) -> Scene:
    rows = by_distance(scene)
    return Scene(scene.states[rows], np.arange(len(rows)), scene.valid)


def test_recordings_have_the_same_findings(monkeypatch: pytest.MonkeyPatch):
    assert store_problems(recorded(), SPEC) == []
    fast = recorded(lambda scene: replace(scene, states=scene.states * np.array([1, 1, 3.6, 3.6])))
    assert "velocities in km/h?" in store_problems(fast, SPEC)[0]
    assert "the ids are the row numbers" in store_problems(recorded(row_numbers), SPEC)[0]
    lost = recorded(lambda scene: replace(scene, states=np.where(scene.states > 10, np.nan, scene.states)))
    assert "states are not finite: id " in store_problems(lost, SPEC)[0]
    assert store_problems([], SPEC) == []
    monkeypatch.setattr("envs.testing.recorded.MOST_STATES", 1)
    assert "velocities in km/h?" in store_problems([fast[0], lost[0]], SPEC)[0]  # the first episode alone


def test_a_collection_warns_and_refuses_nothing(tmp_path: Path):
    config = CollectConfig("Mine-v0", tmp_path / "store")
    info = StoreInfo(replace(SPEC, dt_s=1.0), "Mine-v0")
    first, *_, last = warnings_of(config, info, recorded())
    assert "either a step lasts 0.5 s, not dt_s=1" in first and last.endswith("dgvae check-env Mine-v0")
    assert warnings_of(config, StoreInfo(SPEC, "Mine-v0"), recorded()) == []
    assert warnings_of(replace(config, perturb=0.5), info, recorded()) == []
