"""Play an episode with forecasts in the loop and line up what then happened: the raw material of `envs.evaluate`.

The measured forecast is read out of the policy's own observation. Baselines and ablations get the same perceived
scenes. Nothing is aggregated here.
"""

import functools
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from envs.multiagent_observation import MultiagentStream
from envs.observation import ForecastConfig, ForecastStream, into_ego_axes, others_by_distance
from envs.readers.highway_labels import SceneLabels
from envs.rollouts.world import EgoWorld, MultiagentWorld, World, open_world
from envs.wrappers import ForecastObservation
from predictor.baselines.constant_velocity import ConstantVelocity
from predictor.baselines.nearest_neighbour import NearestNeighbour, fit_from_stores
from predictor.checkpoint import load_forecaster
from predictor.evaluation.displacement import displacement
from predictor.evaluation.outcomes import Outcome
from predictor.forecaster import Forecaster
from predictor.online import OnlineForecaster
from predictor.scene import Scene, SceneBatch, SceneSpec

MODEL, STRAIGHT, NEIGHBOURS = "model", "constant velocity", "nearest neighbours"
"""Keys of the forecasters of an episode; ablations of memory are `memory_key(steps)`."""
LANDMARK = "landmark"
"""Feature that marks what never moves."""
CASE_HISTORY_STEPS = 20
"""Past shown of a worst case."""


def memory_key(steps: int) -> str:
    """Key of the model with so many steps of history."""
    return f"{MODEL}, history {steps}"


@dataclass(frozen=True)
class EpisodeTask:
    """What to play; picklable."""

    env_id: str
    """Of the environment."""
    checkpoint: str
    """Whose forecasts are in the observation."""
    driver: str
    """Who drives."""
    seed: int
    """Of the episode."""
    samples: int
    """K."""
    horizon_steps: int
    """Steps forecast."""
    max_steps: int
    """Cut longer episodes here."""
    neighbours: tuple[str, ...] = ()
    """Stores to fit the nearest-neighbour forecaster to; none leaves it out."""
    histories: tuple[int, ...] = ()
    """Also forecast with memories of so many steps only."""


@dataclass(frozen=True)
class Case:
    """One forecast to look at, world coordinates [m]."""

    error_m: float
    """Mean displacement of the most likely forecast."""
    seed: int
    """Of the episode."""
    step: int
    """Instant within the episode."""
    agent: int
    """Row of the agent that was forecast worst."""
    history: Float[np.ndarray, "time agents 2"]
    """Positions until now."""
    history_valid: Bool[np.ndarray, "time agents"]
    """Who was there when."""
    forecasts: dict[str, Float[np.ndarray, "horizon 2"]]
    """Of that agent, by forecaster."""
    future: Float[np.ndarray, "horizon 2"]
    """What it did."""


@dataclass
class Episode:
    """What one episode gives."""

    outcomes: dict[str, Outcome]
    """By forecaster."""
    latencies_s: list[float]
    """Time to observe a scene and forecast it (K = 1) at each step."""
    edge_probs: list[Float[np.ndarray, "agents agents types"]] = field(default_factory=list)
    """Of the model at each step; rows of the perceived scene."""
    edge_types: list[Int[np.ndarray, "agents agents"]] = field(default_factory=list)
    """The true ones, -1 where unknown; empty where the simulator knows none."""
    worst: Case | None = None
    """The model's worst forecast with a whole future."""


class _Baseline:
    """A forecaster that stands beside the measured one: sees the same scenes, keeps all history or the last steps."""

    def __init__(self, forecaster: Forecaster, spec: SceneSpec, horizon_steps: int, history_steps: int = 0) -> None:
        self._front = int(forecaster.spec.has_ego and not spec.has_ego)
        self._online = OnlineForecaster(forecaster, 1, spec.max_agents + self._front)
        self._horizon, self._limit = horizon_steps, history_steps
        self._recent: list[SceneBatch] = []

    def __call__(self, scene: Scene) -> torch.Tensor:
        batch = SceneBatch.stack([scene.behind_absent(self._front)])
        if self._limit:
            self._recent = [*self._recent, batch][-self._limit :]
            self._online.reset()
            for past in self._recent:
                self._online.observe(past)
        else:
            self._online.observe(batch)
        return self._online.forecast(self._horizon).xy[0, :, self._front :]


def play(task: EpisodeTask) -> Episode:
    """Play one episode; see `Episode`."""
    world = _world(task)
    world.reset(task.seed)
    others = _baselines(task, world.spec)
    probe = _Probe(task, world)
    scenes: list[Scene] = []
    truths = [world.full_scene()]
    forecasts: dict[str, list[torch.Tensor]] = {key: [] for key in (MODEL, *others)}
    episode = Episode({}, [])
    for step in range(task.max_steps + 1):
        scene = world.perceived()
        scenes.append(scene)
        forecasts[MODEL].append(_measured(world, task.samples))
        for key, forecaster in others.items():
            forecasts[key].append(forecaster(scene))
        episode.latencies_s.append(probe())
        _note_edges(episode, world, scene, truths[-1])
        if step == task.max_steps:
            break
        ended = world.step()
        truths.append(world.full_scene())
        if ended:
            break
    future, valid = futures(scenes, truths, task.horizon_steps, world.spec)
    episode.outcomes = {key: Outcome(torch.stack(found), future, valid) for key, found in forecasts.items()}
    episode.worst = _worst(episode.outcomes, scenes, task.seed, world.spec.has_ego)
    return episode


@functools.lru_cache(maxsize=4)
def _kept_world(env_id: str, driver: str, checkpoint: str, horizon_steps: int, samples: int) -> World:
    # two samples at least keep the samples axis; the first is the most likely
    return open_world(env_id, driver, checkpoint, horizon_steps=horizon_steps, num_samples=max(2, samples))


def _world(task: EpisodeTask) -> World:
    return _kept_world(task.env_id, task.driver, task.checkpoint, task.horizon_steps, task.samples)


@functools.lru_cache(maxsize=4)
def _kept_forecaster(checkpoint: str, spec: SceneSpec, source: str) -> Forecaster:
    return load_forecaster(checkpoint, spec, source)


@functools.lru_cache(maxsize=2)
def _kept_neighbours(stores: tuple[str, ...], spec: SceneSpec, horizon_steps: int) -> NearestNeighbour:
    return fit_from_stores([Path(store) for store in stores], spec, horizon_steps)


def _baselines(task: EpisodeTask, spec: SceneSpec) -> dict[str, _Baseline]:
    """Fresh ones for an episode, by key."""
    found = {STRAIGHT: _Baseline(ConstantVelocity(spec), spec, task.horizon_steps)}
    if task.neighbours:
        fitted = _kept_neighbours(task.neighbours, spec, task.horizon_steps)
        found[NEIGHBOURS] = _Baseline(fitted, spec, task.horizon_steps)
    for steps in task.histories:
        model = _kept_forecaster(task.checkpoint, spec, task.env_id)
        found[memory_key(steps)] = _Baseline(model, spec, task.horizon_steps, steps)
    return found


class _Probe:
    """A second stream with one sample, timed: what the deployed wrapper adds to a step."""

    def __init__(self, task: EpisodeTask, world: World) -> None:
        self._world = world
        forecaster = _kept_forecaster(task.checkpoint, world.spec, task.env_id)
        config = ForecastConfig(task.horizon_steps)
        self._stream: Any
        if isinstance(world, MultiagentWorld):
            self._stream = MultiagentStream(forecaster, world.spec, config)
        else:
            self._stream = ForecastStream(forecaster, world.spec, 1, config)

    def __call__(self) -> float:
        world = self._world
        scene: Any = world.env.scene if isinstance(world, MultiagentWorld) else SceneBatch.stack([world.perceived()])
        start = time.perf_counter()
        self._stream.observe(scene)
        return time.perf_counter() - start


def _measured(world: World, samples: int) -> torch.Tensor:
    """The deployed forecast (K, A, H, 2) in rows of the perceived scene, world axes, relative to the ego if any."""
    if isinstance(world, MultiagentWorld):
        return world.env.forecast.xy[0, :samples].cpu()
    assert isinstance(world, EgoWorld)
    return world_forecast(world.observation["forecast"], world.perceived())[:samples]


def world_forecast(forecast: Float[np.ndarray, "others samples horizon 2"], scene: Scene) -> torch.Tensor:
    """An observation's forecast, back in the rows of the scene and world axes, relative to the ego: (K, A, H, 2)."""
    batch = SceneBatch.stack([scene])
    world = forecast.astype(np.float64) @ into_ego_axes(batch.heading_rad)[0]
    samples, horizon = world.shape[1], world.shape[2]
    rows = np.zeros((samples, len(scene.ids), horizon, 2))
    rows[:, 1 + others_by_distance(batch)[0]] = world.swapaxes(0, 1)
    return torch.from_numpy(rows).float()


def futures(
    scenes: Sequence[Scene], truths: Sequence[Scene], horizon_steps: int, spec: SceneSpec
) -> tuple[torch.Tensor, torch.Tensor]:
    """Where the agents of each scene then were, and whether they were.

    Relative to the ego's position at the scene's instant, or in world coordinates without an ego. Not counted are the
    ego, whose future is the policy's choice, and landmarks, which have none.

    Args:
        scenes: as perceived, padded.
        truths: all agents, at the same instants and beyond.
        horizon_steps: steps ahead.
        spec: layout of the scenes.
    """
    agents = len(scenes[0].ids)
    fixed = spec.feature_names.index(LANDMARK) if LANDMARK in spec.feature_names else None
    future = np.zeros((len(scenes), agents, horizon_steps, 2))
    valid = np.zeros((len(scenes), agents, horizon_steps), dtype=np.bool_)
    positions = [dict(zip(t.ids.tolist(), t.states[:, :2], strict=True)) for t in truths]
    for now, scene in enumerate(scenes):
        origin = scene.states[0, :2] if spec.has_ego else np.zeros(2)
        moving = scene.valid if fixed is None else scene.valid & (scene.states[:, fixed] == 0)
        for row in range(int(spec.has_ego), agents):
            for ahead in range(horizon_steps):
                later = now + ahead + 1
                if not moving[row] or later >= len(positions):
                    continue
                position = positions[later].get(int(scene.ids[row]))
                if position is not None:
                    future[now, row, ahead] = position - origin
                    valid[now, row, ahead] = True
    return torch.from_numpy(future).float(), torch.from_numpy(valid)


def _note_edges(episode: Episode, world: World, scene: Scene, full: Scene) -> None:
    """The believed and the true graph of the perceived scene, where the simulator knows it."""
    labels = world.labels()
    if labels is None or not isinstance(world, EgoWorld):
        return
    assert isinstance(world.env, ForecastObservation)
    episode.edge_probs.append(world.env.forecast.dense().edge_probs[0].cpu().numpy())
    episode.edge_types.append(_types_of(scene, full, labels))


def _types_of(scene: Scene, full: Scene, labels: SceneLabels) -> Int[np.ndarray, "agents agents"]:
    row = {int(agent): i for i, agent in enumerate(full.ids)}
    known = np.flatnonzero(scene.valid)
    source = np.array([row[int(agent)] for agent in scene.ids[known]], dtype=np.int64)
    types = np.full((len(scene.ids), len(scene.ids)), -1, dtype=np.int64)
    types[np.ix_(known, known)] = labels.edge_types[np.ix_(source, source)]
    return types


def _worst(outcomes: dict[str, Outcome], scenes: Sequence[Scene], seed: int, has_ego: bool) -> Case | None:
    """The model's worst most-likely forecast of the episode, among those whose whole future is known."""
    model = outcomes[MODEL]
    mean_m = displacement(model.forecast[:, :1], model.future)[:, 0].mean(-1)
    mean_m = mean_m.masked_fill(~model.valid.all(-1), -1.0)
    step, agent = divmod(int(mean_m.argmax()), mean_m.shape[1])
    if mean_m[step, agent] < 0:
        return None
    origin = scenes[step].states[0, :2] if has_ego else np.zeros(2)
    past = scenes[max(0, step + 1 - CASE_HISTORY_STEPS) : step + 1]
    history = np.zeros((len(past), len(scenes[step].ids), 2))
    seen = np.zeros(history.shape[:2], dtype=np.bool_)
    for t, scene in enumerate(past):
        places = {int(i): p for i, p in zip(scene.ids[scene.valid], scene.states[scene.valid, :2], strict=True)}
        for row in np.flatnonzero(scenes[step].valid):
            if (position := places.get(int(scenes[step].ids[row]))) is not None:
                history[t, row], seen[t, row] = position, True
    forecasts = {key: outcome.forecast[step, 0, agent].numpy() + origin for key, outcome in outcomes.items()}
    truth = model.future[step, agent].numpy() + origin
    return Case(float(mean_m[step, agent]), seed, step, agent, history, seen, forecasts, truth)
