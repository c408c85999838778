"""What a recurrent policy remembers: its episode, and nothing of the one before, wherever it drives."""

from collections.abc import Callable
from copy import deepcopy
from pathlib import Path
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import pytest
import torch
from pettingzoo import ParallelEnv
from sb3_contrib import RecurrentPPO
from stable_baselines3 import PPO
from stable_baselines3.common.base_class import BaseAlgorithm

from agents.arena import EgoArena, MultiagentArena
from agents.policy import load_policy
from agents.runs import save_model
from agents.task import Task
from agents.vec_envs import make_multiagent_venv
from agents.video import record_task
from envs.drivers.ego import make_ego_driver
from envs.drivers.trained import trained_driver
from envs.parallel import ForecastParallelEnv
from envs.sb3.acting import ActingPolicy, ActingTeam, space_as_stored
from predictor.support.errors import UserError
from tests.agents.helpers import STEERING

SPREAD = "simple_spread_v3"


def recurrent(env: Any) -> RecurrentPPO:
    """Makes an untrained policy whose actions depend on what it saw before."""
    kind = "MultiInputLstmPolicy" if isinstance(env.observation_space, gym.spaces.Dict) else "MlpLstmPolicy"
    sizes: Any = {"net_arch": [8], "lstm_hidden_size": 8}
    model = RecurrentPPO(kind, env, n_steps=4, batch_size=4, policy_kwargs=sizes, seed=0, device="cpu")
    with torch.no_grad():
        for parameter in model.policy.parameters():
            parameter.mul_(4.0)
    return model


@pytest.fixture(scope="module")
def model() -> RecurrentPPO:
    return recurrent(gym.make(STEERING))


@pytest.fixture
def observations() -> np.ndarray:
    return np.random.default_rng(0).uniform(-1, 1, size=(6, 2, 2)).astype(np.float32)


def test_it_remembers_the_episode_and_forgets_at_its_end(model: RecurrentPPO, observations: np.ndarray):
    act = ActingPolicy(model)
    for seen in observations[:4]:
        remembered = act(seen, np.zeros(2, bool))
    fresh = ActingPolicy(model)(observations[3], np.ones(2, bool))
    assert (remembered != fresh).all(), "the policy of this test depends on its state"
    after = act(observations[4], np.array([True, False]))
    first = ActingPolicy(model)(observations[4])
    np.testing.assert_array_equal(after[0], first[0])
    assert after[1] != first[1], "the other environment goes on"


def test_a_copy_goes_on_by_itself(model: RecurrentPPO, observations: np.ndarray):
    act = ActingPolicy(model)
    act(observations[0])
    copied = deepcopy(act)
    assert copied._policy is model
    expected = [act(seen) for seen in observations[1:]]
    np.testing.assert_array_equal([copied(seen) for seen in observations[1:]], expected)


def in_loop(model: BaseAlgorithm, env: gym.Env, seed: int) -> float:
    """Plays an episode as the documentation of sb3-contrib does; returns the sum of rewards."""
    obs, _ = env.reset(seed=seed)
    state, start, total, ended = None, np.ones(1, bool), 0.0, False
    while not ended:
        action, state = model.predict(obs, state, start, deterministic=True)
        obs, reward, terminated, truncated, _ = env.step(action)
        total, start, ended = total + float(reward), np.zeros(1, bool), terminated or truncated
    return total


@pytest.mark.parametrize("num_envs", [1, 2])
def test_an_arena_begins_every_episode_without_a_state(model: RecurrentPPO, num_envs: int):
    arena = EgoArena(Task(STEERING, "none"), num_envs, in_process=True)
    found = [result.episode_return for result in arena.play(model, range(5))]
    arena.close()
    assert found == pytest.approx([in_loop(model, gym.make(STEERING), seed) for seed in range(5)], abs=1e-6)


def test_an_ego_remembers_within_its_episode(model: RecurrentPPO, tmp_path: Path):
    save_model(model, tmp_path / "policy.zip")
    env = gym.make(STEERING)
    for seed in (3, 4):
        obs, _ = env.reset(seed=seed)
        drive = make_ego_driver(str(tmp_path / "policy.zip"), env, np.random.default_rng(0))
        total, ended = 0.0, False
        while not ended:
            obs, reward, terminated, truncated, _ = env.step(drive(obs))
            total, ended = total + float(reward), terminated or truncated
        assert total == pytest.approx(in_loop(model, gym.make(STEERING), seed), abs=1e-6)


@pytest.fixture(scope="module")
def spread() -> tuple[Task, RecurrentPPO]:
    task = Task(SPREAD, "constant-velocity")
    return task, recurrent(make_multiagent_venv(task, 1))


def driven(path: str, task: Task) -> Callable[[int], tuple[list[dict[str, Any]], float]]:
    """Returns a function from a seed to the actions of all agents and their mean return."""
    env = task.wrapped(task.make())
    assert isinstance(env, ForecastParallelEnv)

    def play(seed: int) -> tuple[list[dict[str, Any]], float]:
        observations, _ = env.reset(seed=seed)
        drive, total, actions, names = trained_driver(path, env, np.random.default_rng(0)), 0.0, [], list(env.agents)
        while env.agents:
            actions.append(drive(observations))
            observations, rewards, *_ = env.step(actions[-1])
            total += sum(float(value) for value in rewards.values())
        return actions, total / len(names)

    return play


@pytest.mark.slow
def test_every_agent_remembers_its_own_episode(spread: tuple[Task, RecurrentPPO], tmp_path: Path):
    """Arena and driver agree over two episodes; alone, the second one is as after the first."""
    task, model = spread
    save_model(model, tmp_path / "policy.zip", note=task.note)
    together = [result.episode_return for result in MultiagentArena(task).play(model, [5, 6])]
    alone = [MultiagentArena(task).play(model, [seed])[0].episode_return for seed in (5, 6)]
    assert together == alone
    play = driven(str(tmp_path / "policy.zip"), task)
    assert [play(seed)[1] for seed in (5, 6)] == pytest.approx(alone, rel=1e-5)


def test_a_film_shows_the_episode_that_was_measured(
    spread: tuple[Task, RecurrentPPO], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    task, model = spread
    save_model(model, tmp_path / "policy.zip", note=task.note)
    shown: list[dict[str, Any]] = []

    def play(env: Any, act: Any, seed: int, max_steps: int, num_samples: int) -> None:
        observations, _ = env.reset(seed=seed)
        while env.agents:
            shown.append(act(observations))
            observations, *_ = env.step(shown[-1])

    monkeypatch.setattr("agents.video.record_multiagent_episode", play)
    record_task(task, model, 5, 100)
    assert shown == driven(str(tmp_path / "policy.zip"), task)(5)[0]


PHOTO = gym.spaces.Box(0, 255, (36, 40, 3), np.uint8)
STATE = gym.spaces.Box(-1, 1, (4,), np.float32)
SPACES = {
    "photo": PHOTO,
    "channels first": gym.spaces.Box(0, 255, (3, 36, 40), np.uint8),
    "no photo": gym.spaces.Box(0, 1, (36, 40, 3), np.float32),
    "state": STATE,
    "both": gym.spaces.Dict({"photo": PHOTO, "state": STATE}),
}
PHOTOS = (SPACES["photo"], SPACES["channels first"])


class Seeing(gym.Env):
    """Shows noise of any kind."""

    action_space = gym.spaces.Discrete(3)

    def __init__(self, space: gym.Space) -> None:
        self.observation_space = space
        space.seed(0)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        return self.observation_space.sample(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return self.observation_space.sample(), 0.0, False, False, {}


class Watchers(ParallelEnv):
    """Two agents that see images."""

    metadata: ClassVar[dict[str, Any]] = {"name": "watchers"}
    possible_agents: ClassVar[list[str]] = ["a", "b"]
    agents = possible_agents

    def observation_space(self, agent: str) -> gym.Space:
        return PHOTO

    def action_space(self, agent: str) -> gym.Space:
        return gym.spaces.Discrete(3)


def untrained(env: gym.Env) -> PPO:
    space = env.observation_space
    kind = "MultiInputPolicy" if isinstance(space, gym.spaces.Dict) else "CnnPolicy" if space in PHOTOS else "MlpPolicy"
    return PPO(kind, env, n_steps=4, batch_size=4, seed=0, device="cpu")


@pytest.mark.parametrize("name", SPACES)
def test_a_policy_drives_where_it_was_trained_whatever_it_sees(name: str, tmp_path: Path):
    env = Seeing(SPACES[name])
    model = untrained(env)
    assert space_as_stored(env.observation_space) == model.observation_space
    model.save(tmp_path / "policy.zip")
    policy, loaded = load_policy(tmp_path / "policy.zip", env)
    observation, _ = loaded.reset(seed=0)
    assert policy(observation) == model.predict(observation, deterministic=True)[0]


def test_a_policy_that_sees_other_images_is_refused(tmp_path: Path):
    untrained(Seeing(PHOTO)).save(tmp_path / "policy.zip")
    other = Seeing(gym.spaces.Box(0, 255, (40, 36, 3), np.uint8))
    with pytest.raises(UserError, match=r"was trained on Box\(0, 255, \(3, 36, 40\).*gives Box\(0, 255, \(40, 36, 3\)"):
        load_policy(tmp_path / "policy.zip", other)


def test_a_policy_of_other_actions_is_refused(tmp_path: Path):
    """Its action 0 would be another one here."""
    untrained(Seeing(PHOTO)).save(tmp_path / "policy.zip")
    other = Seeing(PHOTO)
    other.action_space = gym.spaces.Discrete(5)
    with pytest.raises(UserError, match=r"was trained with the actions Discrete\(3\), but the env takes Discrete\(5\)"):
        load_policy(tmp_path / "policy.zip", other)
    watchers = Watchers()
    watchers.action_space = lambda agent: gym.spaces.Discrete(5)  # type: ignore[method-assign]
    with pytest.raises(
        UserError, match=r"policy photo was trained with the actions Discrete\(3\), but the env takes D"
    ):
        ActingTeam(untrained(Seeing(PHOTO)), watchers, (), "policy photo")


def test_a_team_sees_images():
    team = ActingTeam(untrained(Seeing(PHOTO)), Watchers(), (), "policy photo")
    seen = {agent: PHOTO.sample() for agent in Watchers.possible_agents}
    assert team(seen).keys() == seen.keys()
