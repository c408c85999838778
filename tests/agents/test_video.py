from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from highway_env.envs.highway_env import HighwayEnvFast
from stable_baselines3 import PPO

from agents.arena import MultiagentArena
from agents.task import Task
from agents.vec_envs import EpisodeResult
from agents.video import _in_highway_env, _with_forecasts, film, film_extremes, record_task, recorded
from envs import readers
from envs.readers import FunctionReader, register_reader
from predictor.scene import Scene, SceneSpec
from tests.agents.helpers import TOY, Meadow, policy_for

SPREAD, TAG = "simple_spread_v3", "simple_tag_v3"


@pytest.mark.parametrize(("env_id", "learners"), [(SPREAD, ()), (TAG, ("adversary",))])
@pytest.mark.parametrize("observe", ["none", "constant-velocity"])
def test_the_film_shows_the_episode_that_is_measured(env_id: str, learners: tuple[str, ...], observe: Any):
    task = Task(env_id, observe, learners=learners)
    model = policy_for(task)
    (result,) = MultiagentArena(task).play(model, [4])
    recording = record_task(task, model, 4, max_steps=100)
    assert recording is not None
    assert recording.num_steps == result.length
    by_role = recording._moments[-1].returns
    assert by_role[learners[0] if learners else "agent"] == pytest.approx(result.episode_return, rel=1e-5)


def test_where_the_shipped_forecasts_do_not_fit_those_of_constant_velocity_are_drawn():
    """`highway` forecasts steps of 1 s; the policy sees no forecasts and may have other steps."""
    task = Task("highway-fast-v0", "none", env_kwargs='{"config": {"policy_frequency": 5, "vehicles_count": 5}}')
    recording = recorded(task, PPO("MlpPolicy", task.make(), device="cpu"), 4, max_steps=3)
    assert recording is not None and len(recording) > 0
    assert _with_forecasts(task) == replace(task, observe="forecast", checkpoint="constant-velocity")
    assert _with_forecasts(Task("highway-fast-v0", "none")) == Task("highway-fast-v0", "forecast")


def test_an_environment_without_reader_is_not_filmed():
    task = Task(TOY, "none")
    assert record_task(task, policy_for(task), 0, max_steps=5) is None


def test_the_film_is_of_the_environment_with_its_arguments(monkeypatch: pytest.MonkeyPatch):
    task = Task(f"{__name__}:grown", "none", env_kwargs='{"legs": 6}')
    assert record_task(task, policy_for(task), 0, max_steps=5) is None


@pytest.mark.parametrize(
    ("observe", "checkpoint", "sizes"),
    [("none", None, None), ("constant-velocity", None, "exit"), ("zeros", "exit", "exit"), ("forecast", "exit", None)],
)
def test_films_of_envpools_ids_keep_their_forecaster(observe: Any, checkpoint: str | None, sizes: str | None):
    """exit-v0, of which EnvPool's Exit-v0 is a copy, has no checkpoint in the list; exit-v1 has."""
    shown = _in_highway_env(Task("envpool/Exit-v0", observe))
    assert (shown.env_id, shown.checkpoint, shown.sizes_of) == ("exit-v0", checkpoint, sizes)


def grown(legs: int, **kwargs: Any) -> Meadow:
    """Environment that needs an argument."""
    assert legs == 6
    return Meadow(**kwargs)


def test_what_cannot_be_drawn_gives_no_video_and_no_error(tmp_path: Path):
    path = tmp_path / "video.mp4"
    assert film(Task("CartPole-v1", "none"), PPO("MlpPolicy", "CartPole-v1", device="cpu"), path) is None
    toy = Task(TOY, "none")
    assert film(toy, policy_for(toy), path) is None
    assert not list(tmp_path.iterdir())


def played(*returns: float) -> list[EpisodeResult]:
    """Returns episodes with these returns, of the seeds 10, 11, …"""
    return [EpisodeResult(10 + i, value, 3, None, float("nan")) for i, value in enumerate(returns)]


@pytest.mark.parametrize(
    ("returns", "seeds"),
    [((1.0, 5.0, 3.0), (11, 12, 10)), ((4.0, 1.0, 9.0, 6.0), (12, 10, 11)), ((2.0,), (10, 10, 10))],
)
def test_best_median_and_worst_are_filmed(
    returns: tuple[float, ...], seeds: tuple[int, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    filmed: list[tuple[str, int]] = []

    def note(task: Task, model: Any, path: Path, seed: int) -> Path:
        filmed.append((path.name, seed))
        return path

    monkeypatch.setattr("agents.video.film", note)
    films = film_extremes(Task(TOY, "none"), policy_for(Task(TOY, "none")), played(*returns), tmp_path)
    assert filmed == [(f"{name}.mp4", seed) for name, seed in zip(("best", "median", "worst"), seeds, strict=True)]
    assert [(film["seed"], film["file"]) for film in films.values()] == [(seed, name) for name, seed in filmed]
    assert (films["best"]["return"], films["worst"]["return"]) == (max(returns), min(returns))


def test_what_cannot_be_drawn_has_no_films(tmp_path: Path):
    toy = Task(TOY, "none")
    assert film_extremes(toy, policy_for(toy), played(1.0, 2.0, 3.0), tmp_path) == {}
    assert not list(tmp_path.iterdir())


def test_episodes_of_envpool_have_no_films_for_highway_env_does_not_have_them(tmp_path: Path):
    task = Task("envpool/HighwayFast-v0", "none")
    assert film_extremes(task, policy_for(Task(TOY, "none")), played(1.0, 2.0), tmp_path) == {}
    assert not list(tmp_path.iterdir())


class OwnHighway(HighwayEnvFast):
    """An environment that derives from highway-env's and has a reader of its own."""


def read_cars(env: Any) -> Scene:
    cars = env.unwrapped.road.vehicles
    states = np.array([[*car.position, *car.velocity] for car in cars])
    return Scene(states, np.arange(len(cars)), np.ones(len(cars), dtype=np.bool_))


def test_an_environment_of_highway_env_with_a_reader_of_its_own_is_filmed(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(readers, "_REGISTERED", dict(readers._REGISTERED))
    gym.register("OwnHighway-v0", entry_point=OwnHighway)
    try:
        register_reader(OwnHighway, FunctionReader(read_cars, SceneSpec(dt_s=1.0, frame=("ego", "world"))))
        task = Task("OwnHighway-v0", "forecast", checkpoint="highway")
        model = PPO("MultiInputPolicy", task.wrapped(task.make()), n_steps=4, batch_size=4)
        shown = recorded(task, model, max_steps=2)
    finally:
        gym.registry.pop("OwnHighway-v0")
    assert shown is not None and len(shown) > 2
