"""Any object that is a `Forecaster` can stand in the place of a checkpoint's name, in every wrapper."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from stable_baselines3.common.vec_env import DummyVecEnv
from torch import Tensor

from envs.observation import open_forecaster
from envs.parallel import ForecastParallelEnv
from envs.registry import make_env, make_multiagent_env
from envs.sb3.forecast import VecForecast
from envs.vector import VectorForecast
from envs.wrappers import ForecastObservation, SceneObservation
from predictor.baselines.constant_velocity import ConstantVelocity
from predictor.forecaster import Belief, Futures, Memory
from predictor.scene import SceneSpec
from predictor.support.errors import UserError
from tests.envs.helpers import short_env, short_scene_env
from tests.predictor.test_testing import Smooth

ROAD, PARTICLES = SceneSpec(dt_s=1.0, frame=("ego", "world")), SceneSpec(dt_s=0.1, frame=("world", "world"))


class OnRoad(Smooth):
    spec = ROAD


class Particles(Smooth):
    """In simple_spread, whose agents have further features."""

    def __init__(self) -> None:
        self.spec = ForecastParallelEnv(make_multiagent_env("simple_spread_v3"), "constant-velocity").scene_spec


WRAPPED: dict[str, tuple[type[Smooth], Callable[..., Any]]] = {
    "ForecastObservation": (OnRoad, lambda *f, **n: ForecastObservation(make_env("highway-fast-v0"), *f, **n)),
    "VecForecast": (OnRoad, lambda *f, **n: VecForecast(DummyVecEnv([lambda: short_scene_env(4)] * 2), *f, **n)),
    "VectorForecast": (
        OnRoad, lambda *f, **n: VectorForecast(gym.vector.SyncVectorEnv([lambda: short_scene_env(4)] * 2), *f, **n),
    ),
    "ForecastParallelEnv": (
        Particles, lambda *f, **n: ForecastParallelEnv(make_multiagent_env("simple_spread_v3"), *f, **n),
    ),
}  # fmt: skip


def first(env: Any) -> Any:
    env.reset(seed=0) if not isinstance(env, VecForecast) else (env.seed(0), env.reset())
    return env.forecast


@pytest.mark.parametrize("wrapper", WRAPPED)
def test_a_forecaster_stands_where_a_checkpoint_does(wrapper: str):
    make_forecaster, wrap = WRAPPED[wrapper]
    mine = make_forecaster()
    env = wrap(mine)
    assert env.forecaster is mine
    forecast = first(env)
    assert forecast.xy.shape[-2] == Smooth.horizon_steps
    np.testing.assert_array_equal(forecast.xy, first(wrap(forecaster=mine)).xy)
    with pytest.raises(UserError, match="give a checkpoint or a forecaster, not both"):
        wrap("constant-velocity", forecaster=mine)


def test_a_path_is_a_checkpoint(tmp_path: Path):
    with pytest.raises(UserError, match="no checkpoint .*absent.* neither a folder nor a shipped name"):
        ForecastObservation(make_env("highway-fast-v0"), tmp_path / "absent")
    env = ForecastObservation(make_env("highway-fast-v0"), Path(__file__).parents[2] / "predictor/pretrained/highway")
    assert env.spec is not None and env.spec.to_json()
    assert isinstance(env.env, SceneObservation)


def test_a_forecaster_of_another_step_is_refused():
    with pytest.raises(UserError, match="the forecaster was trained at dt_s=0.1 but env .* steps at dt_s=1"):
        open_forecaster(ConstantVelocity(PARTICLES), ROAD, "highway-fast-v0")


class ShortMemory(Smooth):
    def empty_memory(self, batch: int, agents: int) -> Memory:
        return Memory(nodes=(torch.zeros(batch, 3),))


class NoMemory(Smooth):
    def empty_memory(self, batch: int, agents: int) -> Any:
        return torch.zeros(batch, agents)


class NoBelief(Smooth):
    def observe(self, memory: Memory, states: Tensor, valid: Tensor) -> Any:
        return super().observe(memory, states, valid)[0]


class Forgetful(Smooth):
    def observe(self, memory: Memory, states: Tensor, valid: Tensor) -> Any:
        return None, super().observe(memory, states, valid)[1]


class ThreeTypes(Smooth):
    """Says that there are two types of edges."""

    def observe(self, memory: Memory, states: Tensor, valid: Tensor) -> Any:
        memory, belief = super().observe(memory, states, valid)
        return memory, replace(belief, edge_probs=belief.edge_probs.repeat(1, 1, 1, 2)[..., :3])


class NoFeatures(Smooth):
    def observe(self, memory: Memory, states: Tensor, valid: Tensor) -> Any:
        memory, belief = super().observe(memory, states, valid)
        return memory, replace(belief, edge_features=belief.edge_features[..., 0])


class PlacesAlone(Smooth):
    def rollout(self, belief: Belief, *arguments: Any, **named: Any) -> Futures:
        return Futures(super().rollout(belief, *arguments, **named).states[..., :2])


class FewAgents(Smooth):
    def rollout(self, belief: Belief, *arguments: Any, **named: Any) -> Futures:
        return Futures(super().rollout(belief, *arguments, **named).states[:, :, :1])


class NoSamples(Smooth):
    def rollout(self, belief: Belief, *arguments: Any, **named: Any) -> Futures:
        return Futures(super().rollout(belief, *arguments, **named).states[:, 0])


class OneProbability(Smooth):
    def rollout(self, belief: Belief, *arguments: Any, **named: Any) -> Futures:
        futures = super().rollout(belief, *arguments, **named)
        return Futures(futures.states, torch.ones(futures.states.shape[:2]))


class OneScale(Smooth):
    def rollout(self, belief: Belief, *arguments: Any, **named: Any) -> Futures:
        futures = super().rollout(belief, *arguments, **named)
        return Futures(futures.states, scale=torch.ones(futures.states.shape[:4]))


SIZES: dict[type[Smooth], str] = {
    ShortMemory: r"empty_memory .* must begin with \(1, 6\), got \(1, 3\); check_forecaster",
    NoMemory: "empty_memory of a forecaster must return a Memory, got Tensor",
    NoBelief: "observe of a forecaster must return a Memory and a Belief, got Memory",
    Forgetful: "observe of a forecaster must return a Memory first, got NoneType",
    ThreeTypes: r"observe .*: edge_probs of the belief must have the shape \(1, (\d), \1, 2\), got \(1, \1, \1, 3\)",
    NoFeatures: r"observe .*: edge_features of the belief must have the shape \(1, (\d), \1, 3\), got \(1, \1, \1\)",
    PlacesAlone: r"rollout .*: states must have the shape \(1, 1, (\d), 4, 4\), got \(1, 1, \1, 4, 2\); check_fore",
    FewAgents: r"rollout .*: states must have the shape \(1, 1, (\d), 4, 4\), got \(1, 1, 1, 4, 4\)",
    NoSamples: r"rollout .*: states must have the shape \(1, 1, (\d), 4, 4\), got \(1, \1, 4, 4\)",
    OneProbability: r"rollout .*: mode_probs must have the shape \(1, 1, (\d)\), got \(1, 1\)",
    OneScale: r"rollout .*: scale must have the shape \(1, 1, (\d), 4, 2\), got \(1, 1, \1, 4\)",
}


@pytest.mark.unchecked
@pytest.mark.parametrize("kind", SIZES, ids=lambda kind: kind.__name__)
def test_wrong_sizes_are_named_at_the_first_forecast(kind: type[Smooth]):
    mine = kind()
    mine.spec = ROAD
    with pytest.raises(UserError, match=SIZES[kind]):
        ForecastObservation(short_env(4), mine, max_agents=6).reset(seed=0)
