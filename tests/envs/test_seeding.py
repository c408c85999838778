"""Drivers draw from streams of their own: what they are like cannot be read off the start of an episode."""

import itertools
from collections.abc import Callable
from dataclasses import astuple
from typing import Any

import numpy as np
import pytest
from pettingzoo import ParallelEnv

from agents.arena import MultiagentArena
from agents.task import Task
from agents.vec_envs import DrivenEnv, SeededEpisodes
from envs.drivers.all_agents import Habits
from envs.parallel import ForecastParallelEnv
from envs.registry import make_env, make_multiagent_env
from envs.rollouts.world import EgoWorld, MultiagentWorld
from envs.seeding import driver_rng
from envs.wrappers import SceneObservation

TAG = "simple_tag_v3"
AGENTS = 4


def in_a_world() -> tuple[ParallelEnv, Callable[[int], Any]]:
    """As accuracy is measured and episodes are recorded."""
    world = MultiagentWorld(
        ForecastParallelEnv(make_multiagent_env(TAG, max_cycles=1), "constant-velocity"), "heuristic"
    )

    def play(seed: int) -> None:
        world.reset(seed)
        world.step()

    return world.env, play


def as_partners() -> tuple[ParallelEnv, Callable[[int], Any]]:
    """As policies are trained beside drivers."""
    env = DrivenEnv(make_multiagent_env(TAG), "heuristic", learners=())

    def play(seed: int) -> None:
        observations, _ = env.reset(seed=seed)
        env.drive_others(observations)

    return env, play


def in_an_arena() -> tuple[ParallelEnv, Callable[[int], Any]]:
    """As baselines stand beside a policy: one driver for the learners, one for the others."""
    arena = MultiagentArena(Task(TAG, "none", learners=("adversary",)))
    return arena._env, lambda seed: arena.play("heuristic", [seed])


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Habits]:
    """All habits in the order of their drawing."""
    found: list[Habits] = []
    draw = Habits.draw

    def note(rng: np.random.Generator) -> Habits:
        found.append(draw(rng))
        return found[-1]

    monkeypatch.setattr(Habits, "draw", staticmethod(note))
    return found


def start_m(env: ParallelEnv) -> np.ndarray:
    """Positions of agents and obstacles."""
    world = env.unwrapped.world
    return np.concatenate([body.state.p_pos for body in (*world.agents, *world.landmarks)])


@pytest.mark.parametrize(
    ("driven", "episodes", "most"), [(in_a_world, 40, 0.6), (as_partners, 200, 0.2), (in_an_arena, 40, 0.6)]
)
def test_habits_do_not_correlate_with_the_start_of_the_episode(
    driven: Callable[[], tuple[ParallelEnv, Callable[[int], Any]]], episodes: int, most: float, drawn: list[Habits]
):
    env, play = driven()
    starts, habits = [], []
    for seed in range(episodes):
        drawn.clear()
        play(seed)
        assert len(drawn) == AGENTS
        habits.append(astuple(drawn[0]))
        env.reset(seed=seed)
        starts.append(start_m(env))
    count = len(starts[0])
    between = np.corrcoef(np.array(starts), np.array(habits), rowvar=False)[:count, count:]
    assert np.abs(between).max() < most


@pytest.mark.parametrize("driven", [in_a_world, as_partners, in_an_arena])
def test_agents_of_an_episode_have_habits_of_their_own(
    driven: Callable[[], tuple[ParallelEnv, Callable[[int], Any]]], drawn: list[Habits]
):
    _, play = driven()
    for seed in range(3):
        play(seed)
    assert len({astuple(habits) for habits in drawn}) == len(drawn) == 3 * AGENTS


def test_streams_of_a_seed_are_uncorrelated():
    streams = [np.random.default_rng, driver_rng, lambda seed: driver_rng(seed, group=1)]
    first = np.array([[stream(seed).random() for stream in streams] for seed in range(1000)])
    between = np.corrcoef(first, rowvar=False)
    assert max(abs(between[i, j]) for i, j in itertools.combinations(range(3), 2)) < 0.1


def test_a_stream_is_a_function_of_its_seed():
    assert driver_rng(5).random() == driver_rng(5).random() != driver_rng(6).random()


@pytest.mark.parametrize("where", ["world", "evaluation"])
def test_the_driver_of_an_ego_draws_from_its_own_stream(where: str, monkeypatch: pytest.MonkeyPatch):
    given: list[np.random.Generator] = []
    module = {"world": "envs.rollouts.world", "evaluation": "agents.vec_envs"}[where]
    monkeypatch.setattr(f"{module}.make_ego_driver", lambda name, env, rng: given.append(rng))
    env = make_env("highway-fast-v0")
    if where == "world":
        EgoWorld(SceneObservation(env), "varied").reset(7)
    else:
        episodes = SeededEpisodes(env)
        episodes.queue([7], "varied")
        episodes.reset()
    assert [rng.random() for rng in given] == [driver_rng(7).random()]
    assert driver_rng(7).random() != np.random.default_rng(7).random()
