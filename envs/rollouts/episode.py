"""Plays an episode with forecasts and pairs them with the true futures, for `envs.evaluate`, which aggregates them.

Measured is what the deployed wrapper forecasts from its own memory, with K samples; the policy's observation is cut
from the same stream. With one ego, the agents that it perceives are measured, not the ego itself; in a PettingZoo
environment all agents, since none is the ego. Landmarks are not measured. Controls, with as many samples, and
ablations forecast the same scenes.
"""

import functools
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from envs.multiagent_observation import MultiagentStream
from envs.observation import ForecastStream
from envs.readers.highway_labels import SceneLabels
from envs.rollouts.kept_world import kept_world
from envs.rollouts.moving import moving_agents
from envs.rollouts.side_forecasts import SideForecaster, kept_forecaster
from envs.rollouts.world import EgoWorld, MultiagentWorld, World, open_world
from envs.scene_stream import ForecastConfig
from envs.wrappers import ForecastObservation
from predictor.baselines.constant_velocity import ConstantVelocity
from predictor.baselines.nearest_neighbour import K, fit_from_stores
from predictor.dgvae import DGVAE
from predictor.dgvae.edge_ablation import Ablation, EdgeAblation
from predictor.evaluation.controls import fit_noise, fit_residual, training_windows
from predictor.evaluation.displacement import displacement
from predictor.evaluation.outcomes import Outcome
from predictor.forecaster import Forecaster
from predictor.scene import Forecast, Scene, SceneBatch, SceneSpec
from predictor.support.errors import UserError

MODEL, STRAIGHT, NEIGHBOURS = "model", "constant velocity", "nearest neighbours"
NOISY, RESIDUAL = "constant velocity + noise", "model + Gaussian noise"
"""Keys of the forecasters of an episode; `memory_key(steps)` gives those of the memory ablations."""
EDGES: dict[str, Ablation] = {"edges averaged over senders": "averaged", "edges cut": "cut"}
"""Ablations of the model's edges, by key."""
CASE_HISTORY_STEPS = 20
"""Number of past steps shown of a worst case."""


def memory_key(steps: int) -> str:
    """Returns the key of the model whose memory is limited to this number of steps."""
    return f"{MODEL}, history {steps}"


@dataclass(frozen=True)
class EpisodeTask:
    """Settings of one episode; can be pickled."""

    env_id: str
    """Id of the environment."""
    checkpoint: str
    """Checkpoint of the forecasts."""
    driver: str
    """Name of the driver."""
    seed: int
    """Seed of the episode."""
    samples: int
    """Number of forecasts per agent (K)."""
    horizon_steps: int
    """Number of steps forecast."""
    max_steps: int
    """Largest length of an episode [policy steps]."""
    stores: tuple[str, ...] = ()
    """Stores to fit the controls to; empty leaves them out."""
    histories: tuple[int, ...] = ()
    """Numbers of steps to which the model's memory is limited in ablations."""
    edge_ablations: bool = False
    """Whether the model forecasts with changed edges, too."""
    env_kwargs: str = ""
    """Arguments of the environment, as the text of a JSON object."""


@dataclass(frozen=True)
class Case:
    """One forecast with its history and future, world coordinates [m]."""

    error_m: float
    """Mean displacement of the single forecast."""
    seed: int
    """Seed of the episode."""
    step: int
    """Step of the forecast within the episode."""
    agent: int
    """Index of the agent that was forecast worst."""
    history: Float[np.ndarray, "time agents 2"]
    """Positions up to the step of the forecast."""
    history_valid: Bool[np.ndarray, "time agents"]
    """Whether each agent was perceived."""
    forecasts: dict[str, Float[np.ndarray, "horizon 2"]]
    """Forecasts of that agent, by forecaster."""
    future: Float[np.ndarray, "horizon 2"]
    """True future of that agent."""


@dataclass
class Episode:
    """Forecasts and true futures of one episode."""

    outcomes: dict[str, Outcome]
    """Forecasts and true futures, by forecaster."""
    latencies_s: list[float]
    """Time to observe a scene and forecast it (K = 1) at each step [s]."""
    edge_probs: list[Float[np.ndarray, "agents agents types"]] = field(default_factory=list)
    """Edge probabilities of the model at each step; agents as in the perceived scene."""
    edge_types: list[Int[np.ndarray, "agents agents"]] = field(default_factory=list)
    """True edge types, -1 where unknown; empty where the simulator has none."""
    crashed: bool = False
    """Whether the episode ended with a crash of the ego."""
    worst: Case | None = None
    """Worst forecast of the model among those with a whole future."""


def play(task: EpisodeTask) -> Episode:
    """Plays one episode."""
    world = _world(task)
    world.reset(task.seed)
    others = _baselines(task, world.spec)
    probe = _Probe(task, world)
    scenes: list[Scene] = []
    truths = [world.full_scene()]
    forecasts: dict[str, list[Forecast]] = {key: [] for key in (MODEL, *others)}
    episode = Episode({}, [])
    for step in range(task.max_steps + 1):
        scene = world.perceived()
        scenes.append(scene)
        forecasts[MODEL].append(world.forecast(task.samples))
        for key, forecaster in others.items():
            forecasts[key].append(forecaster(scene))
        episode.latencies_s.append(probe())
        _note_edges(episode, world, scene, truths[-1])
        if step == task.max_steps:
            break
        crashed_before = isinstance(world, EgoWorld) and bool(world.crashed)
        ended = world.step()
        truths.append(world.full_scene())
        if ended:
            episode.crashed = isinstance(world, EgoWorld) and bool(world.crashed) and not crashed_before
            break
    future, valid = futures(scenes, truths, task.horizon_steps, world.spec)
    episode.outcomes = {key: _outcome(found, future, valid) for key, found in forecasts.items()}
    episode.worst = _worst(episode.outcomes, scenes, task.seed, world.spec.has_ego)
    return episode


def _world(task: EpisodeTask) -> World:
    """Returns the world of the episode, with forecasts; a process keeps it for its next one."""
    horizon, kwargs = task.horizon_steps, task.env_kwargs
    return kept_world(
        (task.env_id, task.driver, task.checkpoint, horizon, kwargs),
        lambda: open_world(task.env_id, task.driver, task.checkpoint, horizon_steps=horizon, env_kwargs=kwargs),
    )


@functools.lru_cache(maxsize=2)
def _kept_controls(
    stores: tuple[str, ...], checkpoint: str, spec: SceneSpec, source: str, horizon_steps: int, samples: int
) -> dict[str, Forecaster]:
    """Returns the controls that are fitted to recorded data, by key; sample 0 of the neighbours is their mean."""
    paths = [Path(store) for store in stores]
    model = kept_forecaster(checkpoint, spec, source)
    windows = training_windows(paths, spec, horizon_steps, history_steps=1)  # constant velocity remembers nothing
    seen = replace(model.spec, has_ego=spec.has_ego)  # where no agent is the ego, the first is not taken for it
    return {
        RESIDUAL: fit_residual(model, training_windows(paths, seen, horizon_steps), horizon_steps),
        NEIGHBOURS: fit_from_stores(paths, spec, horizon_steps, source, k=max(K, samples - 1)),
        NOISY: fit_noise(windows, horizon_steps),
    }


def _baselines(task: EpisodeTask, spec: SceneSpec) -> dict[str, SideForecaster]:
    """Returns new controls and ablations for an episode, by key."""
    found = {STRAIGHT: SideForecaster(ConstantVelocity(spec), spec, task.horizon_steps)}
    if task.stores:
        fitted = _kept_controls(task.stores, task.checkpoint, spec, task.env_id, task.horizon_steps, task.samples)
        for key, control in fitted.items():
            found[key] = SideForecaster(control, spec, task.horizon_steps, samples=task.samples, seed=task.seed)
    for steps in task.histories:
        model = kept_forecaster(task.checkpoint, spec, task.env_id)
        found[memory_key(steps)] = SideForecaster(model, spec, task.horizon_steps, steps)
    if task.edge_ablations:
        for key, ablated in _kept_ablations(task.checkpoint, spec, task.env_id).items():
            found[key] = SideForecaster(ablated, spec, task.horizon_steps)
    return found


@functools.lru_cache(maxsize=2)
def _kept_ablations(checkpoint: str, spec: SceneSpec, source: str) -> dict[str, Forecaster]:
    """Returns the model with changed edges, by key."""
    model = kept_forecaster(checkpoint, spec, source)
    if not isinstance(model, DGVAE):
        raise UserError(f"edge ablations need the edges of a dG-VAE, and {checkpoint} is {type(model).__name__}")
    return {key: EdgeAblation(model, kind) for key, kind in EDGES.items()}


def _outcome(forecasts: Sequence[Forecast], future: torch.Tensor, valid: torch.Tensor) -> Outcome:
    """Returns the forecasts of an episode's steps with the truth."""

    def joined(name: str) -> torch.Tensor | None:
        found = [getattr(forecast, name) for forecast in forecasts]
        return None if found[0] is None else torch.cat(found).cpu()

    xy = joined("xy")
    assert xy is not None
    return Outcome(xy, future, valid, mode_probs=joined("mode_probs"), scale=joined("xy_scale"))


class _Probe:
    """Measures the time that the deployed wrapper adds to a step, with a second stream of one sample."""

    def __init__(self, task: EpisodeTask, world: World) -> None:
        self._world = world
        forecaster = kept_forecaster(task.checkpoint, world.spec, task.env_id)
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


def futures(
    scenes: Sequence[Scene], truths: Sequence[Scene], horizon_steps: int, spec: SceneSpec
) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns the true future positions (T, A, H, 2) of the agents of each scene, and which of them are measured.

    Positions [m] are relative to the ego's at the scene's step, or in world coordinates without an ego. Not measured
    are the ego, whose future is the policy's choice, landmarks, which do not move, and agents that are gone.

    Args:
        scenes: perceived scenes, padded.
        truths: scenes of all agents, at the same steps and beyond.
        horizon_steps: number of steps ahead.
        spec: layout of the scenes.
    """
    agents = len(scenes[0].ids)
    future = np.zeros((len(scenes), agents, horizon_steps, 2))
    valid = np.zeros((len(scenes), agents, horizon_steps), dtype=np.bool_)
    positions = [dict(zip(t.ids.tolist(), t.states[:, :2], strict=True)) for t in truths]
    for now, scene in enumerate(scenes):
        origin = scene.states[0, :2] if spec.has_ego else np.zeros(2)
        moving = moving_agents(scene, spec)
        for agent in range(int(spec.has_ego), agents):
            for ahead in range(horizon_steps):
                later = now + ahead + 1
                if not moving[agent] or later >= len(positions):
                    continue
                position = positions[later].get(int(scene.ids[agent]))
                if position is not None:
                    future[now, agent, ahead] = position - origin
                    valid[now, agent, ahead] = True
    return torch.from_numpy(future).float(), torch.from_numpy(valid)


def _note_edges(episode: Episode, world: World, scene: Scene, full: Scene) -> None:
    """Adds the inferred and the true edges of the perceived scene to the episode, where the simulator has them."""
    labels = world.labels()
    if labels is None or not isinstance(world, EgoWorld):
        return
    assert isinstance(world.env, ForecastObservation)
    episode.edge_probs.append(world.env.forecast.dense().edge_probs[0].cpu().numpy())
    episode.edge_types.append(_types_of(scene, full, labels))


def _types_of(scene: Scene, full: Scene, labels: SceneLabels) -> Int[np.ndarray, "agents agents"]:
    index = {int(agent): i for i, agent in enumerate(full.ids)}
    known = np.flatnonzero(scene.valid)
    source = np.array([index[int(agent)] for agent in scene.ids[known]], dtype=np.int64)
    types = np.full((len(scene.ids), len(scene.ids)), -1, dtype=np.int64)
    types[np.ix_(known, known)] = labels.edge_types[np.ix_(source, source)]
    return types


def _worst(outcomes: dict[str, Outcome], scenes: Sequence[Scene], seed: int, has_ego: bool) -> Case | None:
    """Returns the worst most-likely forecast of the model, among those whose whole future is known."""
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
        for index in np.flatnonzero(scenes[step].valid):
            if (position := places.get(int(scenes[step].ids[index]))) is not None:
                history[t, index], seen[t, index] = position, True
    forecasts = {key: outcome.forecast[step, 0, agent].numpy() + origin for key, outcome in outcomes.items()}
    truth = model.future[step, agent].numpy() + origin
    return Case(float(mean_m[step, agent]), seed, step, agent, history, seen, forecasts, truth)
