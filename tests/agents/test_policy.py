"""`load_policy`: one line gives a policy and the environment that it was trained for."""

import json
import shutil
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import PPO

from agents import evaluate
from agents.arena import MultiagentArena
from agents.policy import CountedEpisodes, TrainedPolicy, is_recurrent, load_policy, require_env_of, task_of_policy
from agents.runs import policy_zip, save_model
from agents.task import Observe, Task
from envs.parallel import ForecastParallelEnv
from envs.wrappers import ForecastObservation
from predictor.support.errors import UserError
from tests.agents.helpers import policy_for
from tests.envs.helpers import HIGHWAY_SPEC, save_tiny

FAST, TAG = "highway-fast-v0", "simple_tag_v3"
FEW = json.dumps({"config": {"vehicles_count": 5, "duration": 4}})


def saved(folder: Path, task: Task, noted: bool = True, run: bool = False) -> tuple[Path, PPO]:
    """An untrained policy of an environment with one ego, in a zip or in a run folder."""
    env = task.make() if task.observe == "none" else task.wrapped(task.make())
    kind = "MlpPolicy" if task.observe == "none" else "MultiInputPolicy"
    model = PPO(kind, env, n_steps=4, batch_size=4, policy_kwargs={"net_arch": [4]}, device="cpu", seed=0)
    env.close()
    save_model(model, folder / "policy.zip", note=task.note if noted else None)
    if run:
        config = {"env_id": task.env_id, "observe": task.observe, "checkpoint": task.checkpoint, "algorithm": "ppo"}
        (folder / "config.json").write_text(json.dumps({"config": config | {"env_kwargs": task.env_kwargs}}))
    return folder / "policy.zip", model


@pytest.mark.parametrize("observe", ["forecast", "none", "constant-velocity", "zeros"])
def test_a_zip_brings_its_environment(observe: Any, tmp_path: Path):
    task = Task(FAST, observe, env_kwargs=FEW, **({} if observe == "none" else {"perception_m": 40.0}))
    path, model = saved(tmp_path, task)
    policy, env = load_policy(path)
    assert isinstance(env, ForecastObservation) == (observe != "none")
    assert env.unwrapped.config["vehicles_count"] == 5
    observation, _ = env.reset(seed=1)
    for _ in range(3):
        action = policy(observation)
        assert action == model.predict(observation, deterministic=True)[0]
        observation, *_ = env.step(action)
    env.close()
    found = task_of_policy(path)
    assert (found.env_id, found.observe, found.make_kwargs) == (FAST, observe, json.loads(FEW))
    assert found.note.forecaster == task.note.forecaster


def test_a_zip_beside_the_config_of_another_run_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    saved(tmp_path, Task(FAST, "none", env_kwargs=FEW), run=True)
    other, _ = saved(tmp_path, Task("merge-v1", "none"))
    message = "policy.zip was trained on merge-v1, but config.json beside it is that of a run on highway-fast-v0"
    with pytest.raises(UserError, match=message):
        load_policy(other)
    monkeypatch.setattr("sys.argv", ["evaluate", "--run-dir", str(other), "--out", str(tmp_path / "out")])
    with pytest.raises(UserError, match=message):
        evaluate.main()


def test_a_zip_beside_the_config_of_other_arguments_is_refused(tmp_path: Path):
    saved(tmp_path, Task(FAST, "none", env_kwargs=FEW), run=True)
    other, _ = saved(tmp_path, Task(FAST, "none"))
    message = "trained on highway-fast-v0 with env_kwargs none, but config.json beside it is that of a run on highway"
    with pytest.raises(UserError, match=message):
        load_policy(other)


@pytest.mark.parametrize("other", [{"driver": "random"}, {"learners": ("agent",)}], ids=str)
def test_a_team_beside_the_config_of_other_learners_or_drivers_is_refused(other: dict, tmp_path: Path):
    task = Task(TAG, "none", learners=("adversary",), driver="heuristic")
    save_model(policy_for(task), tmp_path / "policy.zip", note=task.note)
    require_env_of(tmp_path / "policy.zip", task)
    with pytest.raises(UserError, match=f"trained on {TAG} with {next(iter(other))} .*; move the policy into a folder"):
        require_env_of(tmp_path / "policy.zip", replace(task, **other))


@pytest.mark.filterwarnings("ignore:.* has no note")
@pytest.mark.parametrize("noted", [True, False])
def test_a_run_folder_is_enough(noted: bool, tmp_path: Path):
    saved(tmp_path, Task(FAST, "none", env_kwargs=FEW), noted, run=True)
    policy, env = load_policy(str(tmp_path))
    assert env.unwrapped.config["duration"] == 4
    assert env.action_space.contains(policy(env.reset(seed=0)[0]))


@pytest.mark.parametrize("observe", ["none", "constant-velocity"])
def test_a_team_plays_as_it_was_measured(observe: Any, tmp_path: Path):
    task = Task(TAG, observe, learners=("adversary",), driver="heuristic")
    model = policy_for(task)
    save_model(model, tmp_path / "policy.zip", note=task.note)
    (expected,) = MultiagentArena(task).play(model, [4])
    policy, env = load_policy(tmp_path / "policy.zip")
    assert isinstance(env, ForecastParallelEnv) == (observe != "none")
    observations, _ = env.reset(seed=4)
    total, steps = 0.0, 0
    while env.agents:
        actions = policy(observations)
        assert set(actions) == set(env.agents)
        observations, rewards, *_ = env.step(actions)
        total, steps = total + rewards["adversary_0"], steps + 1
    assert steps == expected.length
    assert total == pytest.approx(expected.episode_return, rel=1e-5)


def test_an_environment_can_be_given(tmp_path: Path):
    path, _ = saved(tmp_path, Task(FAST, "none", env_kwargs=FEW), noted=False)
    with pytest.raises(UserError, match="policy.zip does not say which environment it drives; pass env="):
        load_policy(path)
    mine = Task(FAST, "none").make()
    assert load_policy(path, mine).env is mine
    with pytest.raises(UserError, match="render_mode='human' is for a new environment; give it to the env that you"):
        load_policy(path, mine, render_mode="human")
    with pytest.raises(UserError, match="was trained on .* but the env gives"):
        load_policy(path, gym.make("CartPole-v1"))


@pytest.mark.parametrize("observe", ["zeros", "forecast"])
def test_the_sizes_of_another_checkpoint_stand_in_the_run_folder(tmp_path: Path, observe: Observe):
    """A zip alone plays in its environment, but does not say which checkpoint its sizes are from."""
    large = save_tiny(tmp_path / "large", HIGHWAY_SPEC, num_edge_types=4, edge_feature_dim=8)
    path, _ = saved(tmp_path, Task(FAST, observe, sizes_of=large))
    policy, env = load_policy(path)
    observation, _ = env.reset(seed=0)
    assert observation["edge_probs"].shape[-1] == 2 * 3
    assert policy(observation) in env.action_space
    with pytest.raises(UserError, match="trained with the sizes of another checkpoint .*; give its run folder"):
        task_of_policy(path)


@pytest.mark.parametrize("of_one_ego", [True, False])
def test_another_forecaster_is_refused(of_one_ego: bool, tmp_path: Path):
    if of_one_ego:
        path, _ = saved(tmp_path, Task(FAST, "forecast", env_kwargs=FEW))
    else:
        path = shutil.copy(policy_zip("simple-tag"), tmp_path / "policy.zip")
    with zipfile.ZipFile(path) as archive:
        entries = {name: archive.read(name) for name in archive.namelist()}
    note = json.loads(entries["note.json"])
    note["policy"]["forecaster"]["sha256"] = "0" * 64
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in (entries | {"note.json": json.dumps(note).encode()}).items():
            archive.writestr(name, content)
    with pytest.raises(
        UserError, match="was trained on forecaster '(highway|simple-tag)' .* but gets '(highway|simple-tag)'"
    ):
        load_policy(path)


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        (
            "absent",
            "no policy at .*absent: neither a run folder nor a .zip nor one that ships .*; train one with",
        ),
        ("empty", "empty holds no training run \\(config.json is missing\\)"),
        ("stopped", "stopped holds no policy.zip: its training has not ended; continue it with --resume, or name one"),
        ("text.zip", "text.zip is damaged; copy it again, or name another .zip of its run"),
        ("predictor", "config.json is not the config of a policy's run"),
    ],
)
def test_bad_paths_are_one_sentence(name: str, sentence: str, tmp_path: Path):
    for folder in ("empty", "stopped", "predictor"):
        (tmp_path / folder).mkdir()
    (tmp_path / "stopped" / "config.json").write_text(json.dumps({"config": {"env_id": FAST}}))
    (tmp_path / "predictor" / "config.json").write_text(json.dumps({"config": {"steps": 4}}))
    (tmp_path / "text.zip").write_text("text")
    with pytest.raises(UserError, match=sentence) as error:
        load_policy(tmp_path / name)
    assert "\n" not in str(error.value)


def test_actions_are_the_most_likely_ones(tmp_path: Path):
    path, _ = saved(tmp_path, Task(FAST, "none", env_kwargs=FEW))
    policy, env = load_policy(path)
    observation, _ = env.reset(seed=0)
    assert len({int(policy(observation)) for _ in range(10)}) == 1
    sampled = {int(policy.model.predict(np.asarray(observation))[0]) for _ in range(50)}
    assert len(sampled) > 1


def test_a_recurrent_policy_remembers_its_episode_alone():
    contrib = pytest.importorskip("sb3_contrib")
    env = CountedEpisodes(gym.make("CartPole-v1"))
    model = contrib.RecurrentPPO("MlpLstmPolicy", env, n_steps=4, batch_size=4, device="cpu", seed=0)
    assert is_recurrent(model) and not is_recurrent(PPO("MlpPolicy", "CartPole-v1", device="cpu"))
    policy = TrainedPolicy(model, env)
    observation, _ = env.reset(seed=0)
    states = []
    for reset in (False, False, True):
        if reset:
            env.reset(seed=0)
        policy(observation)
        states.append(policy._acting._state[0].copy())
    assert not np.allclose(states[0], states[1])
    np.testing.assert_array_equal(states[0], states[2])
