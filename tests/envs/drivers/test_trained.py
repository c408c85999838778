import shutil
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file
from stable_baselines3 import PPO

from agents.arena import MultiagentArena
from agents.runs import save_model
from agents.task import Task
from envs.drivers.trained import kept_policy, trained_driver
from envs.parallel import ForecastParallelEnv
from envs.rollouts.own_view import own_view
from envs.rollouts.world import EgoWorld, MultiagentWorld, World, open_world
from envs.seeding import driver_rng
from predictor.checkpoint import PRETRAINED
from predictor.support.errors import UserError
from tests.agents.helpers import policy_for

SPREAD = "simple_spread_v3"
SEED = 7


def save_run(folder: Path, task: Task, noted: bool = True) -> tuple[str, PPO]:
    """A policy as train_policy leaves it."""
    if task.is_multiagent:
        model = policy_for(task)
    else:
        model = PPO("MultiInputPolicy", task.wrapped(task.make()), n_steps=4, batch_size=4, device="cpu", seed=0)
    save_model(model, folder / "policy.zip", note=task.note if noted else None)
    return str(folder / "policy.zip"), model


def forecast_env(env_id: str = SPREAD, **settings: Any) -> ForecastParallelEnv:
    task = Task(env_id, "constant-velocity")
    return ForecastParallelEnv(task.make(), **task.options | settings)


def played(env: ForecastParallelEnv, path: str) -> tuple[dict[str, float], list[dict[str, Any]]]:
    """Returns of the agents and their actions, in the episode of the seed."""
    observations, _ = env.reset(seed=SEED)
    drive = trained_driver(path, env, driver_rng(SEED))
    returns, actions = dict.fromkeys(env.agents, 0.0), []
    while env.agents:
        actions.append(drive(observations))
        observations, rewards, *_ = env.step(actions[-1])
        for agent, reward in rewards.items():
            returns[agent] += reward
    return returns, actions


@pytest.mark.parametrize("observe", ["none", "constant-velocity"])
@pytest.mark.parametrize("learners", [(), ("agent_0", "agent_2")], ids=["all", "two"])
def test_it_acts_as_where_it_was_measured(learners: tuple[str, ...], observe: Any, tmp_path: Path):
    task = Task(SPREAD, observe, learners=learners, driver="varied")
    path, model = save_run(tmp_path, task)
    (expected,) = MultiagentArena(task).play(model, [SEED])
    returns, actions = played(forecast_env(), path)
    assert len(actions) == expected.length
    assert len({acted["agent_0"] for acted in actions}) > 1
    mean = np.mean([value for agent, value in returns.items() if not learners or agent in learners])
    assert mean == pytest.approx(expected.episode_return, rel=1e-5)


def test_unequal_agents_are_padded_as_in_training(tmp_path: Path):
    task = Task("simple_tag_v3", "constant-velocity")
    path, model = save_run(tmp_path, task)
    (expected,) = MultiagentArena(task).play(model, [SEED])
    returns, _ = played(forecast_env("simple_tag_v3"), path)
    assert np.mean(list(returns.values())) == pytest.approx(expected.episode_return, rel=1e-5)
    assert returns["agent_0"] == pytest.approx(expected.returns_by_role["agent"], rel=1e-5)


def test_it_drives_a_world(tmp_path: Path):
    path, _ = save_run(tmp_path, Task(SPREAD, "constant-velocity", learners=("agent_1",)))
    env = forecast_env()
    played(env, path)
    world = MultiagentWorld(forecast_env(), path)
    for _ in range(2):
        world.reset(SEED)
        while not world.step():
            pass
        np.testing.assert_array_equal(world.perceived().states, env.scene.scene.states)


def test_without_a_note_all_agents_are_the_policys(tmp_path: Path):
    path, model = save_run(tmp_path, Task(SPREAD, "none"), noted=False)
    env = forecast_env()
    observations, _ = env.reset(seed=SEED)
    with pytest.warns(UserWarning, match="policy.zip has no note on its forecaster and learners"):
        acted = trained_driver(path, env, np.random.default_rng(0))(observations)
    expected = {a: model.predict(seen["observation"], deterministic=True)[0] for a, seen in observations.items()}
    assert acted == expected


def test_a_damaged_note_is_one_clear_line(tmp_path: Path):
    path, _ = save_run(tmp_path, Task(SPREAD, "none"), noted=False)
    with zipfile.ZipFile(path, "a") as archive, pytest.warns(UserWarning, match="Duplicate name"):
        archive.writestr("note.json", '{"policy": {"learners": []}}')
    with pytest.raises(UserError, match="policy.zip: note: key 'forecaster' is missing; save the policy again"):
        trained_driver(path, forecast_env(), np.random.default_rng(0))


def test_a_policy_refuses_forecasts_of_other_options(tmp_path: Path):
    path, _ = save_run(tmp_path, Task(SPREAD, "constant-velocity"))
    assert open_world(SPREAD, path, "constant-velocity")
    with pytest.raises(UserError, match="was trained on"):
        MultiagentWorld(forecast_env(num_samples=2), path)


@pytest.mark.slow
@pytest.mark.parametrize(
    "task",
    [
        Task("highway-fast-v0", "forecast", "highway", num_samples=2, what_if=True),
        Task("simple_tag_v3", "forecast", "simple-tag", num_samples=2, learners=("adversary",)),
    ],
    ids=["ego", "many"],
)
def test_it_sees_its_own_forecasts_beside_those_that_are_measured(task: Task, tmp_path: Path):
    """The same episode as without a measurement, whatever is measured; and the measured forecasts are as without it."""
    path, _ = save_run(tmp_path, task)
    recorded = played_world(open_world(task.env_id, path))[0]
    for checkpoint, horizon_steps in (("constant-velocity", 2), (task.checkpoint, 3)):
        states, forecasts = played_world(open_world(task.env_id, path, checkpoint, horizon_steps=horizon_steps))
        assert all(np.array_equal(one, other) for one, other in zip(states, recorded, strict=True))
        assert all(forecast.shape[1:4:2] == (1, horizon_steps) for forecast in forecasts)
        if checkpoint == "constant-velocity":
            moved = np.diff(forecasts[-1], axis=3)  # from the first step to the second
            world = open_world(task.env_id, "idle", checkpoint, horizon_steps=horizon_steps)
            world.reset(SEED)
            np.testing.assert_allclose(world.forecast(1).xy.numpy(), forecasts[0], atol=1e-5)
            assert np.abs(moved).max() > 0.01


@pytest.mark.parametrize("measured", [None, "constant-velocity"])
def test_a_forecaster_that_was_trained_anew_in_place_is_noticed(measured: str | None, tmp_path: Path):
    mine = tmp_path / "mine"
    shutil.copytree(PRETRAINED / "simple-tag", mine)
    path, _ = save_run(tmp_path, Task("simple_tag_v3", "forecast", str(mine), learners=("adversary",)))
    open_world("simple_tag_v3", path, measured).close()
    weights = load_file(mine / "model.safetensors")
    save_file({name: 2 * value for name, value in weights.items()}, mine / "model.safetensors")
    with pytest.raises(UserError, match="was trained on forecaster .*mine' .SHA-256 .* but gets '.*mine' .SHA-256"):
        open_world("simple_tag_v3", path, measured)


def played_world(world: World) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """States of all agents in the first steps of the episode of the seed, and the deployed forecasts, if any."""
    world.reset(SEED)
    states, forecasts = [], []
    for _ in range(6):
        if not isinstance(world, EgoWorld) or own_view(world.env) is not None:
            forecasts.append(world.forecast(1).xy.numpy())
        states.append(world.full_scene().states)
        if world.step():
            break
    return states, forecasts


@pytest.mark.filterwarnings("ignore:.* has no note")
@pytest.mark.parametrize("observe", ["none", "constant-velocity"])
def test_another_observation_space_is_one_clear_line(observe: Any, tmp_path: Path):
    path, _ = save_run(tmp_path, Task("simple_tag_v3", observe), noted=False)
    with pytest.raises(UserError, match="was trained on .* but the env gives ") as error:
        MultiagentWorld(forecast_env(), path)
    assert "\n" not in str(error.value)


def test_learners_that_are_not_there_are_named(tmp_path: Path):
    path, _ = save_run(tmp_path, Task("simple_tag_v3", "none", learners=("adversary",)))
    with pytest.raises(UserError, match="learners: 'adversary' is neither an agent nor a role of .*policy.zip"):
        MultiagentWorld(forecast_env(), path)


def test_a_stray_zip_is_one_clear_line(tmp_path: Path):
    with zipfile.ZipFile(tmp_path / "stray.zip", "w") as archive:
        archive.writestr("thesis.tex", "")
    with pytest.raises(UserError, match="stray.zip holds no policy of ppo, dqn, a2c, sac, qrdqn, recurrent-ppo, tqc$"):
        MultiagentWorld(forecast_env(), str(tmp_path / "stray.zip"))
    with pytest.raises(UserError, match="no policy at absent.zip"):
        MultiagentWorld(forecast_env(), "absent.zip")


def test_a_policy_that_was_replaced_is_loaded_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path, loaded = tmp_path / "policy.zip", list[bytes]()
    monkeypatch.setattr(
        "envs.sb3.policy_file.load_policy", lambda file: loaded.append(file.read_bytes()) or len(loaded)
    )
    path.write_bytes(b"first")
    assert kept_policy(str(path)) == kept_policy(str(path)) == 1
    path.write_bytes(b"second")
    assert kept_policy(str(path)) == 2 and loaded == [b"first", b"second"]
