import json
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from stable_baselines3 import DQN, PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from agents.runs import check_forecaster, load_model, open_run, read_config, save_model
from envs.sb3.policy_file import read_note
from predictor.support.errors import UserError

CONFIG = {"env_id": "toy-v0", "steps": 100, "device": "cpu"}
MADE = {"command": "python toy.py"}


class Toy(gym.Env[np.ndarray, np.int64]):
    """Environment with episodes of five steps and a reward for action 1."""

    def __init__(self, size: int = 2) -> None:
        self.observation_space = gym.spaces.Box(-1, 1, (size,), np.float32)
        self.action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self._steps = 0
        return self.observation_space.low, {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self._steps += 1
        return self.observation_space.low, float(action), self._steps == 5, False, {}


@pytest.fixture
def venv() -> VecEnv:
    return DummyVecEnv([Toy])


def make_ppo(venv: VecEnv) -> PPO:
    return PPO("MlpPolicy", venv, n_steps=8, batch_size=8, seed=0, device="cpu")


def test_new_run_holds_its_config(tmp_path: Path):
    run = tmp_path / "deep" / "run"
    open_run(run, CONFIG, MADE, resume=False)
    assert read_config(run) == CONFIG
    assert json.loads((run / "config.json").read_text())["provenance"] == [MADE]


def test_existing_run_is_not_touched_without_resume(tmp_path: Path):
    open_run(tmp_path / "run", CONFIG, MADE, resume=False)
    before = (tmp_path / "run" / "config.json").read_bytes()
    with pytest.raises(UserError, match="exists; choose another --out, or continue it with --resume"):
        open_run(tmp_path / "run", CONFIG | {"steps": 7}, MADE, resume=False)
    assert (tmp_path / "run" / "config.json").read_bytes() == before


def test_hyperparameters_that_older_runs_lack_have_changed_nothing(tmp_path: Path):
    open_run(tmp_path, CONFIG | {"preset": {"gamma": 0.8}}, MADE, resume=False)
    with pytest.raises(UserError, match="preset.gamma was 0.8, now 0.9; pass"):
        open_run(tmp_path, CONFIG | {"preset": {"gamma": 0.9, "vf_coef": 0.5}}, MADE, resume=True)
    open_run(tmp_path, CONFIG | {"preset": {"gamma": 0.8, "vf_coef": 0.5}}, MADE, resume=True)


def test_a_setting_that_older_runs_lack_is_no_difference(tmp_path: Path):
    open_run(tmp_path, CONFIG, MADE, resume=False)
    open_run(tmp_path, CONFIG | {"new_field": 1}, MADE, resume=True)


def test_a_hyperparameter_that_only_a_newer_run_has_is_named(tmp_path: Path):
    open_run(tmp_path, CONFIG | {"preset": {"gamma": 0.8, "clip": None}}, MADE, resume=False)
    with pytest.raises(UserError, match="preset.clip was None, now 'not there'; pass"):
        open_run(tmp_path, CONFIG | {"preset": {"gamma": 0.8}}, MADE, resume=True)


def test_foreign_folder_is_not_resumed(tmp_path: Path):
    (tmp_path / "thesis.tex").write_text("")
    for resume in (False, True):
        with pytest.raises(UserError, match="exists|holds no training run"):
            open_run(tmp_path, CONFIG, MADE, resume=resume)
    assert [p.name for p in tmp_path.iterdir()] == ["thesis.tex"]


def test_file_in_place_of_the_folder_is_named(tmp_path: Path):
    (tmp_path / "run").write_text("")
    with pytest.raises(UserError, match="is a file"):
        open_run(tmp_path / "run", CONFIG, MADE, resume=True)


def test_resume_names_the_field_that_differs(tmp_path: Path):
    open_run(tmp_path / "run", CONFIG, MADE, resume=False)
    with pytest.raises(UserError, match="steps was 100, now 7"):
        open_run(tmp_path / "run", CONFIG | {"steps": 7}, MADE, resume=True, free=("device",))


def test_free_fields_may_differ_and_every_start_is_kept(tmp_path: Path):
    open_run(tmp_path / "run", CONFIG, MADE, resume=True)
    open_run(tmp_path / "run", CONFIG | {"device": "cuda"}, MADE, resume=True, free=("device",))
    assert read_config(tmp_path / "run")["device"] == "cuda"
    assert len(json.loads((tmp_path / "run" / "config.json").read_text())["provenance"]) == 2


def test_killed_before_the_config_was_written(tmp_path: Path):
    """Only a half-written temporary file is there: the run starts anew and the leftover goes."""
    (tmp_path / ".config.json.123.partial").write_text("{")
    open_run(tmp_path, CONFIG, MADE, resume=True)
    assert [p.name for p in tmp_path.iterdir()] == ["config.json"]


def test_truncated_config_is_one_clear_line(tmp_path: Path):
    (tmp_path / "config.json").write_text('{"config": {')
    with pytest.raises(
        UserError,
        match=r"config.json is damaged \(line 1: no JSON \(.*\)\); move it away to use the run's policy.zip alone, or",
    ):
        open_run(tmp_path, CONFIG, MADE, resume=True)


@pytest.mark.parametrize(
    "content",
    [{"config": {"data": "store", "steps": 100}}, {"format": "dgvae-rl"}, ["config"]],
    ids=["a predictor's run", "a checkpoint", "a list"],
)
def test_a_config_of_something_else_is_one_clear_line(tmp_path: Path, content: Any):
    (tmp_path / "config.json").write_text(json.dumps(content))
    for use in (
        read_config,
        lambda run: open_run(run, CONFIG, MADE, resume=True),
        lambda run: check_forecaster(run, None),
    ):
        with pytest.raises(UserError, match="config.json is not the config of a policy's run; move it away to use"):
            use(tmp_path)


def test_model_round_trip_with_note(tmp_path: Path, venv: VecEnv):
    model = make_ppo(venv)
    save_model(model, tmp_path / "model.zip", {"selection_return": 1.5})
    loaded = load_model(tmp_path / "model.zip", "ppo")
    obs = venv.observation_space.sample()
    assert loaded.predict(obs, deterministic=True)[0] == model.predict(obs, deterministic=True)[0]
    assert read_note(tmp_path / "model.zip") == {"selection_return": 1.5}
    assert PPO.load(tmp_path / "model.zip", device="cpu").num_timesteps == 0  # SB3 itself reads the file


def trained(algorithm: str) -> tuple[BaseAlgorithm, list[torch.optim.Optimizer]]:
    if algorithm == "ppo":
        ppo = make_ppo(DummyVecEnv([Toy])).learn(16)
        return ppo, [ppo.policy.optimizer]
    env = DummyVecEnv([lambda: gym.make("Pendulum-v1")])
    sac = SAC("MlpPolicy", env, learning_starts=4, buffer_size=50, batch_size=4, device="cpu").learn(16)
    return sac, [sac.actor.optimizer, sac.critic.optimizer]


@pytest.mark.parametrize("algorithm", ["ppo", "sac"])
def test_what_only_training_needs_is_in_checkpoints_alone(algorithm: Any, tmp_path: Path):
    model, optimizers = trained(algorithm)
    moments = [one.state for one in optimizers]
    assert all(moments)
    final, latest = tmp_path / "final.zip", tmp_path / "latest.zip"
    save_model(model, final)
    save_model(model, latest, to_continue=True)
    assert final.stat().st_size < 0.6 * latest.stat().st_size
    assert [one.state for one in optimizers] == moments, "the model goes on as before"
    obs = model.observation_space.sample()
    for file in (final, latest):
        again = load_model(file, algorithm, model.get_env())
        np.testing.assert_array_equal(
            again.predict(obs, deterministic=True)[0], model.predict(obs, deterministic=True)[0]
        )
        again.learn(8)  # of the final one from fresh moments


def test_replay_buffer_travels_in_the_checkpoint(tmp_path: Path, venv: VecEnv):
    model = DQN("MlpPolicy", venv, buffer_size=50, learning_starts=10, seed=0, device="cpu")
    model.learn(20)
    save_model(model, tmp_path / "model.zip", to_continue=True)
    loaded = load_model(tmp_path / "model.zip", "dqn", venv)
    assert isinstance(loaded, DQN)
    assert loaded.replay_buffer is not None
    assert loaded.replay_buffer.size() == 20
    np.testing.assert_array_equal(loaded.replay_buffer.actions, model.replay_buffer.actions)  # type: ignore[union-attr]
    assert loaded.num_timesteps == 20


def test_failed_save_leaves_the_old_file(tmp_path: Path, venv: VecEnv, monkeypatch: pytest.MonkeyPatch):
    path = tmp_path / "model.zip"
    save_model(make_ppo(venv), path, {"steps": 1})
    before = path.read_bytes()

    def die(*args: Any) -> None:
        raise OSError("killed before the rename")

    monkeypatch.setattr("predictor.support.files.os.replace", die)
    with pytest.raises(OSError, match="killed"):
        save_model(make_ppo(venv), path, {"steps": 2})
    assert path.read_bytes() == before
    assert read_note(path) == {"steps": 1}


def test_missing_policy_is_named(tmp_path: Path):
    assert read_note(tmp_path / "none.zip") == {}
    with pytest.raises(UserError, match="no policy at"):
        load_model(tmp_path / "none.zip", "ppo")


@pytest.mark.parametrize("damage", ["truncated", "foreign"])
def test_damaged_policy_is_one_clear_line(tmp_path: Path, venv: VecEnv, damage: str):
    path = tmp_path / "model.zip"
    save_model(make_ppo(venv), path)
    path.write_bytes(path.read_bytes()[:-2000] if damage == "truncated" else b"not a zip")
    with pytest.raises(UserError, match="is damaged; copy it again, or name another .zip of its run") as error:
        load_model(path, "ppo")
    assert "\n" not in str(error.value)


def test_policy_of_other_spaces_is_refused(tmp_path: Path, venv: VecEnv):
    save_model(make_ppo(venv), tmp_path / "model.zip")
    with pytest.raises(UserError, match="Observation spaces do not match"):
        load_model(tmp_path / "model.zip", "ppo", DummyVecEnv([lambda: Toy(size=3)]))


def test_policy_of_another_algorithm_is_refused(tmp_path: Path, venv: VecEnv):
    save_model(make_ppo(venv), tmp_path / "model.zip")
    with pytest.raises(
        UserError, match="model.zip holds a policy of ppo, where one of dqn is expected; take the file of its own run"
    ):
        load_model(tmp_path / "model.zip", "dqn")


@pytest.mark.parametrize(("name", "option"), [("envs", "num_envs"), ("partner", "driver")])
def test_a_resumed_run_names_the_options_of_today(name: str, option: str, tmp_path: Path):
    open_run(tmp_path, CONFIG | {name: "old"}, MADE, resume=False)
    with pytest.raises(UserError, match=f"cannot resume .*: {option} was 'old', now 'new'; pass the old value"):
        open_run(tmp_path, CONFIG | {name: "new"}, MADE, resume=True)
