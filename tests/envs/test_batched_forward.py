"""Copies in one vector environment share a forward, and each sees what it would see by itself."""

from copy import deepcopy
from dataclasses import replace
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from envs.batched_forward import can_share
from envs.parallel import ForecastParallelEnv, batch_forwards
from envs.readers.base import MultiagentScene
from envs.sb3 import agents_as_rows
from envs.sb3.agents_as_rows import ParallelVecEnv
from envs.video.moments import bodies_now
from predictor.baselines.constant_velocity import ConstantVelocity
from predictor.scene import Scene
from predictor.support.errors import ProtocolError, UserError
from tests.envs.helpers import assert_same, tiny_model
from tests.envs.test_parallel import WORLD, Life, Toy, ToyReader, act, wrap

LASTS = (2, 6, 3)
"""Steps per episode of each copy, so that copies end at different times, alone and together."""
STEPS = 12


class Vectors(Toy):
    """Agents whose own observations are vectors of one length."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self._spaces = {name: gym.spaces.Box(-np.inf, np.inf, (2,), np.float32) for name in self.possible_agents}


def copies(lasts: tuple[int, ...] = LASTS, **options: Any) -> list[Any]:
    lives = [{"one": Life(last=last), "other": Life(last=last), "traffic": Life(learns=False)} for last in lasts]
    return [partial(wrap, Vectors(own), shuffle=False, **options) for own in lives]


def alone(monkeypatch: pytest.MonkeyPatch, **options: Any) -> ParallelVecEnv:
    """A vector environment whose copies forecast one by one."""
    with monkeypatch.context() as patch:
        patch.setattr(agents_as_rows, "batch_forwards", lambda envs: None)
        return ParallelVecEnv(copies(**options))


def play(venv: ParallelVecEnv, steps: int = STEPS) -> list[Any]:
    sequence: list[Any] = []
    for t in range(steps):
        obs, _, dones, infos = venv.step(np.full(venv.num_envs, t % 2))
        sequence += [obs, *(infos[i]["terminal_observation"] for i in np.flatnonzero(dones) if infos[i]["alive"])]
    return sequence


def assert_same_sequences(found: list[Any], expected: list[Any], tolerance: float = 1e-3) -> None:
    assert len(found) == len(expected) > STEPS
    for one, other in zip(found, expected, strict=True):
        assert_same(one, other, tolerance)


@pytest.mark.slow
@pytest.mark.parametrize("samples", [1, 4])
@pytest.mark.parametrize("has_ego", [False, True], ids=["world", "absent ego"])
def test_copies_together_see_what_they_see_alone(samples: int, has_ego: bool, monkeypatch: pytest.MonkeyPatch):
    """Over the ends of episodes, with other environments at other times, and with own noise."""
    options: dict[str, Any] = {"num_samples": samples}
    if has_ego:
        options["forecaster"] = tiny_model(replace(WORLD, has_ego=True))
    together, apart = ParallelVecEnv(copies(**options)), alone(monkeypatch, **options)
    for venv in (together, apart):
        venv.seed(5)
    assert_same(together.reset(), apart.reset(), 1e-3)
    assert_same_sequences(play(together), play(apart))
    for one, other in zip(together.envs, apart.envs, strict=True):
        assert_same(one.forecast.xy.numpy(), other.forecast.xy.numpy(), 1e-3)
        np.testing.assert_array_equal(one.scene.scene.states, other.scene.scene.states)


@pytest.mark.slow
def test_noise_goes_on_and_restarts_with_a_seed(monkeypatch: pytest.MonkeyPatch):
    """Without seeds the copies draw on from where they stand; a seeded reset repeats."""
    together, apart = ParallelVecEnv(copies(num_samples=4)), alone(monkeypatch, num_samples=4)
    found = []
    for venv in (together, apart):
        venv.seed(1)
        venv.reset()
        play(venv, 3)
        found.append([venv.reset(), *play(venv, 3)])
        venv.seed(1)
        found[-1] += [venv.reset(), *play(venv)]
    assert_same_sequences(found[0], found[1])


def test_one_step_is_one_forward(monkeypatch: pytest.MonkeyPatch):
    venv = ParallelVecEnv(copies())
    batches: list[int] = []
    forecaster = venv.envs[0].forecaster
    observe = forecaster.observe
    monkeypatch.setattr(
        forecaster, "observe", lambda memory, *scene: batches.append(len(scene[0])) or observe(memory, *scene)
    )
    venv.reset()
    assert batches == [3]
    ended = [sum((t + 1) % last == 0 for last in LASTS) for t in range(STEPS)]
    play(venv)
    assert batches[1:] == [3 + over for over in ended]


def test_a_copy_of_the_vector_environment_continues():
    venv = ParallelVecEnv(copies(num_samples=4))
    venv.seed(0)
    venv.reset()
    play(venv, 3)
    copy = deepcopy(venv)
    assert_same_sequences(play(copy), play(venv), tolerance=0.0)


def stepped_together() -> ParallelVecEnv:
    venv = ParallelVecEnv(copies(num_samples=4))
    venv.seed(0)
    venv.reset()
    play(venv, 3)
    return venv


def test_a_film_of_one_of_several_copies_shows_their_forecast_or_none():
    """Its own stream is of before they shared one: another number of futures was one of an earlier episode."""
    together = stepped_together()
    one = together.envs[1]
    drawn = bodies_now(one, None, {}, one.forecast.xy.shape[1])
    assert all(np.isfinite(body.forecast_m).all() for body in drawn.values()) and drawn
    with pytest.raises(UserError, match=r"shares its forecasts with other copies .*; film with num_samples=4, or an"):
        bodies_now(one, None, {}, 7)


@pytest.mark.parametrize("copied", [False, True], ids=["itself", "a deep copy"])
@pytest.mark.parametrize("place", [0, 1])
def test_an_environment_of_the_vector_environment_forecasts_when_it_is_stepped_directly(
    place: int, copied: bool, monkeypatch: pytest.MonkeyPatch
):
    """Nobody else would fill its observations: a planner steps copies, a user `venv.envs[0]`."""
    together, apart = stepped_together(), alone(monkeypatch, num_samples=4)
    apart.seed(0)
    apart.reset()
    play(apart, 3)
    one, other = together.envs[place], apart.envs[place]
    if copied:
        one = deepcopy(one)
    for seen, expected in [
        (one.step(act(one))[0], other.step(act(other))[0]),
        (one.reset()[0], other.reset()[0]),
        (one.reset(seed=3)[0], other.reset(seed=3)[0]),
        (one.step(act(one))[0], other.step(act(other))[0]),
    ]:
        assert seen.keys() == expected.keys()
        for agent in expected:
            assert_same(seen[agent], expected[agent], 1e-3)


def test_a_copy_that_is_made_within_a_step_forecasts_when_it_is_stepped():
    """A partner may look ahead while the vector environment still collects."""
    ahead: list[Any] = []

    def partner(env: Any, observations: dict[str, Any], generator: np.random.Generator) -> dict[str, Any]:
        twin = deepcopy(env)
        ahead.append(twin.step(act(twin))[0])
        return dict.fromkeys(observations, 0)

    venv = ParallelVecEnv(copies(), agents=["one"], partner=partner)
    venv.reset()
    venv.step(np.zeros(venv.num_envs, dtype=np.int64))
    assert len(ahead) == len(LASTS)
    assert all(set(seen["one"]) == set(venv.observation_space) for seen in ahead)


def test_after_an_error_within_a_step_each_environment_forecasts_again(monkeypatch: pytest.MonkeyPatch):
    venv = stepped_together()
    with monkeypatch.context() as patch:
        patch.setattr(venv.envs[1], "step", lambda actions: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            venv.step(np.zeros(venv.num_envs, dtype=np.int64))
    assert "forecast" in venv.envs[2].step(act(venv.envs[2]))[0]["one"]


def test_an_environment_that_steps_twice_while_others_wait_lacks_nothing():
    first, second = (make() for make in copies((6, 6)))
    forward = batch_forwards([first, second])
    assert forward is not None
    forward.collecting = True
    with pytest.raises(ProtocolError, match="no forecast yet"):
        _ = first.forecast
    first.reset(seed=0)
    observations = [first.step(act(first))[0] for _ in range(2)]  # the second one first fills what is still open
    assert set(observations[0]["one"]) > {"forecast"} and set(observations[1]["one"]) == {"observation"}
    forward.fill()
    reference = copies((6, 6))[0]()
    reference.reset(seed=0)
    for seen in observations:
        expected = reference.step(act(reference))[0]
        for agent in expected:
            assert_same(seen[agent], expected[agent], 1e-3)


def test_a_seeded_reset_leaves_the_noise_of_what_came_before_alone():
    first, second, reference = (make() for make in copies((6, 6, 6), num_samples=4))
    forward = batch_forwards([first, second])
    assert forward is not None
    forward.collecting = True
    found, expected = [], []
    for env, seen in ((first, found), (reference, expected)):
        seen.append(env.reset(seed=0)[0])
        for seed in (7, 8):  # nothing is filled before the next seed arrives
            seen.append(env.step(act(env))[0])
            seen.append(env.reset(seed=seed)[0])
    forward.fill()
    for one, other in zip(found, expected, strict=True):
        for agent in other:
            assert_same(one[agent], other[agent], 1e-3)


def streams(*envs: Any) -> list[Any]:
    return [env.stream for env in envs]


def test_only_equal_copies_share():
    one, other = (make() for make in copies((6, 6)))
    assert can_share(streams(one, other))
    moved = tiny_model(WORLD)
    next(iter(moved.parameters())).data.add_(1e-3)
    for options in ({"forecaster": moved}, {"num_samples": 2}, {"perception_m": 9.0}, {"max_agents": 3}):
        assert not can_share(streams(one, wrap(Toy(), **options)))
    straight = [wrap(Toy(), forecaster=ConstantVelocity(WORLD, steps)) for steps in (2, 2, 3)]
    assert can_share(streams(*straight[:2])) and not can_share(streams(*straight[1:]))
    assert not can_share(streams(one, straight[0]))


def test_what_cannot_share_forecasts_by_itself():
    class Own(ForecastParallelEnv):
        """May change what it shows."""

    assert batch_forwards([make() for make in copies((6,))]) is None
    assert batch_forwards([make() for make in copies((6, 6), flatten=True)]) is None
    derived = [Own(Toy(), reader=ToyReader, forecaster=tiny_model(WORLD)) for _ in range(2)]
    assert batch_forwards(derived) is None
    assert batch_forwards([Toy(), Toy()]) is None


class InPlace(Vectors):
    """Keeps all states in one array, into which each step and reset writes."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        count = len(self.lives)
        self.full = MultiagentScene(
            Scene(np.zeros((count, 4)), np.arange(count), np.ones(count, np.bool_)),
            {name: i for i, name in enumerate(self.lives) if self.lives[name].learns},
            np.zeros(count),
        )

    def _observations(self) -> Any:
        self.full.scene.states[:] = self.tracks[self.t]
        self.full.heading_rad[:] = self.headings[self.t]
        return super()._observations()


class GivesTheSimulators:
    """Hands over the simulator's own arrays."""

    def __init__(self, env: Any) -> None:
        self.spec = replace(WORLD, max_agents=len(env.unwrapped.lives))

    def reset(self) -> None:
        """Numbers are places."""

    def read(self, env: Any) -> MultiagentScene:
        full: MultiagentScene = env.unwrapped.full
        return full


class GivesCopies(GivesTheSimulators):
    def read(self, env: Any) -> MultiagentScene:
        return deepcopy(super().read(env))


def test_the_last_observation_is_of_its_episode_when_the_simulator_writes_in_place():
    """A copy is reset before the others have stepped, so before the scene that closed its episode is forecast."""
    lives = {"one": Life(last=9), "other": Life(last=9), "traffic": Life(learns=False, last=9)}

    def played(reader: Any) -> list[Any]:
        makers = [lambda: ForecastParallelEnv(InPlace(lives), "constant-velocity", reader=reader)] * 2
        venv = ParallelVecEnv(makers)
        venv.seed(0)
        venv.reset()
        return play(venv)

    found, expected = played(GivesTheSimulators), played(GivesCopies)
    assert_same_sequences(found, expected)
