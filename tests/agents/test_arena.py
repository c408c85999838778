from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv

from agents import vec_envs
from agents.arena import Arena, EgoArena, MultiagentArena, open_arena
from agents.task import Observe, Task
from agents.vec_envs import make_venv
from envs.drivers.trained import EgoDriver
from envs.registry import make_env


def test_every_task_has_its_arena():
    for task, kind in ((Task("highway-fast-v0", "none"), EgoArena), (Task("simple_tag_v3", "none"), MultiagentArena)):
        arena = open_arena(task, 1)
        assert isinstance(arena, kind)
        assert isinstance(arena, Arena)
        arena.close()


def test_policies_of_envpool_are_measured_on_the_original(monkeypatch: pytest.MonkeyPatch):
    pytest.importorskip("envpool")
    asked: list[tuple[Task, int, bool]] = []

    def note(task: Task, num_envs: int, seeded: bool, in_process: bool) -> Any:
        asked.append((task, num_envs, seeded))
        return make_venv(task, num_envs, seeded)

    monkeypatch.setattr("agents.arena.make_venv", note)
    arena = open_arena(Task("highway-fast-v0", "none", backend="envpool"), 1)
    assert asked == [(Task("highway-fast-v0", "none"), 1, True)]
    arena.close()


def test_an_ego_is_played_as_in_a_plain_loop():
    arena = EgoArena(Task("highway-fast-v0", "none"), 1)
    env = make_env("highway-fast-v0")
    model = PPO("MlpPolicy", DummyVecEnv([lambda: make_env("highway-fast-v0")]), n_steps=4, batch_size=4, seed=1)
    obs, _ = env.reset(seed=11)
    rewards, crashed, ended = [], False, False
    while not ended:
        obs, reward, terminated, truncated, info = env.step(int(model.predict(obs, deterministic=True)[0]))
        rewards.append(reward)
        crashed |= info["crashed"]
        ended = terminated or truncated
    (result,) = arena.play(model, [11])
    assert (result.length, result.crashed) == (len(rewards), crashed)
    assert result.episode_return == pytest.approx(float(np.sum(rewards)))
    assert result.returns_by_role == {}
    arena.close()


def test_random_and_idle_stand_beside_an_ego():
    arena = EgoArena(Task("highway-fast-v0", "none"), 1)
    random, idle = (arena.play(name, [2])[0] for name in arena.baselines)
    assert random.episode_return != idle.episode_return
    assert arena.play("random", [2]) == [random]
    arena.close()


def test_drivers_play_beside_every_option_of_forecasts():
    """The arena plays drivers without forecasts, whatever the policy of the task is shown."""
    task = Task("simple_tag_v3", checkpoint="constant-velocity", learners=("adversary",), perception_m=1.0)
    arena = MultiagentArena(task)
    (result,) = arena.play("random", [7])
    assert result.length == 25
    arena.close()


@pytest.mark.parametrize("observe", ["none", "constant-velocity"])
def test_a_driver_sees_the_environments_own_observation(observe: Observe, monkeypatch: pytest.MonkeyPatch):
    """Whatever the policy beside it is shown."""
    seen: list[Any] = []

    def driver(name: str, env: gym.Env, rng: np.random.Generator) -> EgoDriver:
        return lambda observation: seen.append(observation) or 1

    monkeypatch.setattr(vec_envs, "make_ego_driver", driver)
    arena = EgoArena(Task("merge-v1", observe), 1)
    arena.play("idle", [2])
    arena.close()
    assert seen and all(isinstance(each, np.ndarray) and each.shape == (5, 5) for each in seen)
