"""Where an environment keeps agents that have ended in `agents`, episodes end all the same."""

from pathlib import Path

import pytest

from agents import watch
from agents.arena import MultiagentArena
from agents.task import Task
from envs.entry_bank import record_bank
from envs.parallel import ForecastParallelEnv
from envs.rollouts.world import MultiagentWorld
from envs.testing import reader_problems
from envs.video.multiagent import record_multiagent_episode
from tests.envs.keeping import STEPS, Keeping, KeepingReader


def forecasting() -> ForecastParallelEnv:
    return ForecastParallelEnv(Keeping(), "constant-velocity", reader=KeepingReader)


def test_rollouts_end():
    world = MultiagentWorld(forecasting(), "random")
    world.reset(0)
    assert [world.step() for _ in range(STEPS)] == [False, False, True]


def test_drivers_episodes_end():
    arena = MultiagentArena(Task("tests.envs.keeping:Keeping", "none", driver="random"))
    (result,) = arena.play("random", [5])
    assert (result.length, result.episode_return) == (STEPS, STEPS)
    arena.close()


def test_films_end():
    def act(observations: dict) -> dict:
        return dict.fromkeys(observations, 0)

    assert record_multiagent_episode(forecasting(), act, seed=0).num_steps == STEPS


def test_windows_close(monkeypatch: pytest.MonkeyPatch):
    def act(observations: dict) -> dict:
        return dict.fromkeys(observations, 0)

    monkeypatch.setattr(watch, "load_policy", lambda *given, **options: (act, Keeping()))
    assert watch._play_in_own_window(watch.WatchConfig(Path("policy.zip"), max_steps=9), Path("policy.zip")) == STEPS


def test_banks_of_entries_have_whole_episodes():
    bank = record_bank(forecasting(), "keeping", episodes=2)
    assert len(bank.entries["valid"]) == 2 * 2 * STEPS  # both agents' of each step, of two episodes


def test_it_is_a_mistake_that_is_found():
    problems = reader_problems(Keeping(), KeepingReader)
    assert problems == ["step: one has ended but is still in env.agents; take it out there"]
