"""What several test files of `envs` share: tiny checkpoints, short episodes, readers and references."""

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from highway_env.vehicle.behavior import IDMVehicle
from stable_baselines3 import PPO

from envs.multiagent_observation import AgentEntries, view_entries
from envs.observation import ForecastStream
from envs.readers.base import MultiagentScene
from envs.readers.highway import HighwayReader
from envs.registry import make_env
from envs.sb3.policy_file import PolicyNote, pin_forecaster, write_note
from envs.scene_stream import ForecastConfig
from envs.wrappers import ForecastObservation, SceneObservation
from predictor.checkpoint import CheckpointInfo, save_checkpoint
from predictor.dgvae import DGVAE
from predictor.dgvae.config import DGVAEConfig
from predictor.forecaster import Forecaster
from predictor.scene import Forecast, Scene, SceneBatch, SceneSpec
from predictor.support.errors import run_entry_point

PERCEPTION_M = 60.0
MAX_AGENTS = 6
HORIZON = 3
TOLERANCE = 1e-5
HIGHWAY_SPEC = SceneSpec(dt_s=1.0, frame=("ego", "world"), perception_m=PERCEPTION_M, max_agents=MAX_AGENTS)
MAP_SPEC = replace(HIGHWAY_SPEC, frame=("world", "world"))
RACETRACK_SPEC = replace(MAP_SPEC, dt_s=0.2)

SIZES = DGVAEConfig(
    hidden_dim=8,
    rnn_dim=8,
    head_dim=8,
    message_dim=8,
    decoder_dim=8,
    edge_feature_dim=3,
    residual="constant_velocity",
    delta_scales=(5.0, 5.0, 3.0, 3.0),
)


PLURAL = {"num_modes": 4, "rollout_graph": "frozen"}
"""Changes of `SIZES` that give agents several enumerated futures with probabilities."""


def tiny_model(spec: SceneSpec, num_edge_types: int = 2, **changes: Any) -> DGVAE:
    """Random weights, larger than at initialisation so that the history has a clear say in the forecast."""
    config = replace(SIZES, num_edge_types=num_edge_types, **changes)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        model = DGVAE(spec, config, HORIZON)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.mul_(2.0)
    return model.eval()


def save_tiny(path: Path, spec: SceneSpec, **changes: Any) -> str:
    model = tiny_model(spec, **changes)
    save_checkpoint(path, model, CheckpointInfo(spec, model.config, HORIZON))
    return str(path)


def save_forecast_policy(run_dir: Path, env_id: str, checkpoint: str, noted: bool = True) -> Path:
    """A policy (untrained) with its note, as train_policy leaves it; without one, as SB3 does."""
    env = ForecastObservation(make_env(env_id), checkpoint)
    model = PPO("MultiInputPolicy", env, n_steps=4, batch_size=4, policy_kwargs={"net_arch": [4]}, device="cpu", seed=0)
    path = run_dir / "policy.zip"
    model.save(path)
    space: Any = env.observation_space
    if noted:
        write_note(path, PolicyNote(pin_forecaster(checkpoint, space, env.get_wrapper_attr("scene_spec"))), {})
    return path


def light_env(env_id: str) -> gym.Env:
    """Any registered id; highway-v0 with a quarter of its 50 vehicles, which cost it 0.2 s per step."""
    return make_env(env_id, config={"vehicles_count": 12} if env_id == "highway-v0" else None)


def short_env(duration: int, vehicles: int = 8, **kwargs: Any) -> gym.Env:
    """highway-fast-v0 whose episodes end after `duration` steps (or at a crash)."""
    return make_env("highway-fast-v0", config={"duration": duration, "vehicles_count": vehicles}, **kwargs)


def short_scene_env(duration: int) -> SceneObservation:
    """One environment of a vector env, as the checkpoint's spec wants it; picklable with functools.partial."""
    return SceneObservation(short_env(duration), PERCEPTION_M, MAX_AGENTS)


def assert_same(actual: Any, expected: Any, tolerance: float = TOLERANCE) -> None:
    """Equal observations (Dict or array), to a tolerance for what a network computed."""
    if isinstance(expected, Mapping):
        assert set(actual) == set(expected)
        for key in expected:
            np.testing.assert_allclose(actual[key], expected[key], rtol=tolerance, atol=tolerance, err_msg=key)
    else:
        np.testing.assert_allclose(actual, expected, rtol=tolerance, atol=tolerance)


def largest_difference(first: Mapping[str, Any], second: Mapping[str, Any]) -> float:
    return max(float(np.abs(first[key] - second[key]).max()) for key in ("forecast", "edge_probs", "edge_features"))


def play(env: gym.Env, actions: Sequence[Any], seed: int) -> list[tuple[Any, float, bool, bool]]:
    """The observations, rewards and ends of one episode, or of its beginning."""
    obs, _ = env.reset(seed=seed)
    steps = [(obs, 0.0, False, False)]
    for action in actions:
        obs, reward, terminated, truncated, _ = env.step(action)
        steps.append((obs, float(reward), bool(terminated), bool(truncated)))
        if terminated or truncated:
            break
    return steps


def random_actions(env: gym.Env, count: int, seed: int = 0) -> list[Any]:
    space = env.action_space
    rng = np.random.default_rng(seed)
    if isinstance(space, gym.spaces.Discrete):
        return [int(a) for a in rng.integers(space.n, size=count)]
    assert isinstance(space, gym.spaces.Box)
    return [rng.uniform(space.low, space.high).astype(np.float32) for _ in range(count)]


def forecast_of_history(forecaster: Forecaster, spec: SceneSpec, scenes: Sequence[Scene]) -> dict[str, Any]:
    """The entries after streaming exactly these scenes, from empty memory."""
    stream = ForecastStream(forecaster, spec, 1, ForecastConfig())
    entries: dict[str, Any] = {}
    for scene in scenes:
        entries = stream.observe(SceneBatch.stack([scene]))
    return {key: value[0] for key, value in entries.items()}


def random_scenes(
    rng: np.random.Generator, batch: int, agents: int, features: int = 4, present: Sequence[int] | None = None
) -> SceneBatch:
    """Scenes with the ego at index 0 and, unless said, a random number of others in random places."""
    valid = rng.random((batch, agents)) < 0.7
    if present is not None:
        valid = np.arange(agents) < np.asarray(present)[:, None]
    valid[:, 0] = True
    states = rng.normal(size=(batch, agents, features)) * 20 * valid[..., None]
    ids = np.where(valid, np.argsort(rng.random((batch, agents)), axis=1), -1)
    return SceneBatch(states, ids, valid, rng.uniform(-np.pi, np.pi, batch))


def random_forecast(
    rng: np.random.Generator, scenes: SceneBatch, samples: int, horizon: int, types: int, features: int
) -> Forecast:
    batch, agents = scenes.valid.shape

    def draw(*shape: int) -> torch.Tensor:
        return torch.from_numpy(rng.normal(size=shape).astype(np.float32))

    return Forecast(
        draw(batch, samples, agents, horizon, 2),
        torch.softmax(draw(batch, agents, agents, types), -1),
        draw(batch, agents, agents, features),
        torch.from_numpy(scenes.valid),
    )


def run_command(
    main: Callable[[], None], arguments: Sequence[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> tuple[int, list[str], str]:
    """Exit status, lines on stderr, and stdout of an entry point, run in this process."""
    monkeypatch.setattr(sys, "argv", ["command", *arguments])
    code = 0
    try:
        run_entry_point(main)
    except SystemExit as stop:
        assert isinstance(stop.code, int)
        code = stop.code
    captured = capsys.readouterr()
    return code, captured.err.strip().splitlines(), captured.out


class Cruiser(IDMVehicle):
    """Keeps its speed and its course, whatever happens."""

    def act(self, action: Any = None) -> None:
        self.action = {"steering": 0.0, "acceleration": 0.0}


def cruising_env(**kwargs: Any) -> gym.Env:
    """highway-fast-v0 among cars for which constant velocity is the truth."""
    others = "tests.envs.helpers.Cruiser"
    return make_env("highway-fast-v0", config={"other_vehicles_type": others, "vehicles_count": 6}, **kwargs)


class ShuffledReader(HighwayReader):
    """Sees what `HighwayReader` sees, with the others' places in another order at each step."""

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env, PERCEPTION_M, MAX_AGENTS)
        self._rng = np.random.default_rng(1)

    def read(self, env: gym.Env) -> Scene:
        scene = super().read(env)
        order = np.concatenate([[0], 1 + self._rng.permutation(len(scene.ids) - 1)])
        return Scene(scene.states[order], scene.ids[order], scene.valid[order], scene.heading_rad)


class NamedReader:
    """A reader of any env, with a spec of choice and an ego that never moves."""

    def __init__(self, spec: SceneSpec) -> None:
        self.spec = spec

    def reset(self) -> None:
        pass

    def read(self, env: gym.Env) -> Scene:
        states = np.zeros((self.spec.max_agents, self.spec.num_features))
        ids = np.full(self.spec.max_agents, -1, dtype=np.int64)
        valid = np.zeros(self.spec.max_agents, dtype=np.bool_)
        ids[0], valid[0] = 0, True
        return Scene(states, ids, valid)


def agent_entries(
    scene: MultiagentScene, forecast: Forecast, view: SceneSpec, uncertainty: bool = False
) -> AgentEntries:
    """Returns each agent's forecast entries of one scene."""
    [entries] = view_entries([scene], forecast, view, uncertainty)
    return entries
