"""Parallel environments ("rows") for training and evaluation, and episodes on given seeds.

One place decides what a policy sees (`Task.observe`), so that training, evaluation and video cannot differ. Rows run in
spawned processes with one torch thread each; the forecaster runs once per step for all rows, in the main process.
"""

import multiprocessing
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import gymnasium as gym
import numpy as np
import torch
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, VecMonitor

from envs.egos import Ego, make_ego
from envs.registry import make_env
from envs.vector import VecForecast
from envs.wrappers import ForecastObservation, SceneObservation
from predictor.errors import UserError
from predictor.scene import SceneSpec

Observe = Literal["forecast", "none", "constant-velocity"]

EPISODE_INFO = "seeded_episode"
"""Key under which `SeededEpisodes` leaves the result of an episode in its last info."""


@dataclass(frozen=True)
class Task:
    """What is driven and what the policy sees of it."""

    env_id: str
    """Gymnasium id, for example highway-fast-v0."""
    observe: Observe = "forecast"
    """Learned forecasts, the env's own observation alone, or constant-velocity forecasts in the same shape."""
    checkpoint: str | None = None
    """Forecaster for `observe="forecast"`: shipped name or path; None takes the one that ships for the id."""
    device: str = "cpu"
    """Where the forecaster runs: cpu, cuda or auto."""

    def __post_init__(self) -> None:
        """Check that the fields fit together."""
        if self.checkpoint is not None and self.observe != "forecast":
            raise UserError(f"checkpoint '{self.checkpoint}' has no effect with observe={self.observe}; leave one out")
        resolve_device(self.device)

    @property
    def forecaster(self) -> str | None:
        """What to pass as `checkpoint` to the wrappers."""
        return "constant-velocity" if self.observe == "constant-velocity" else self.checkpoint

    @property
    def scene_spec(self) -> SceneSpec | None:
        """Scenes as the forecaster was trained on them; None if the policy sees none.

        Raises:
            UserError: unknown env, missing checkpoint, or a checkpoint that does not fit the env.
        """
        if self.observe == "none":
            return None
        env = ForecastObservation(make_env(self.env_id), self.forecaster, device=resolve_device(self.device))
        spec: SceneSpec = env.get_wrapper_attr("scene_spec")
        env.close()
        return spec

    def check(self) -> gym.Space:
        """Make the environment, with its forecaster, and return its action space.

        Raises:
            UserError: as `scene_spec`.
        """
        env = make_env(self.env_id)
        env.close()
        _ = self.scene_spec
        return env.action_space


def resolve_device(device: str) -> str:
    """The torch device of a name; auto takes cuda where there is one.

    Raises:
        UserError: no such device here.
    """
    if device == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    try:
        usable = torch.device(device).type != "cuda" or torch.cuda.is_available()
    except RuntimeError as error:
        raise UserError(f"device must be cpu, cuda or auto, got '{device}'") from error
    if not usable:
        raise UserError(f"device '{device}' was asked for but torch finds no CUDA device; use --device cpu")
    return device


def make_rows(task: Task, num_rows: int, seeded: bool = False) -> VecEnv:
    """Parallel rows of a task, with episode statistics and (unless `observe` is none) forecasts.

    Args:
        task: what to make.
        num_rows: rows; one runs in this process, more in spawned ones.
        seeded: wrap each row in `SeededEpisodes`, for evaluation.
    """
    row = _MakeRow(task.env_id, task.scene_spec, seeded)
    venv: VecEnv
    venv = DummyVecEnv([row]) if num_rows == 1 else SubprocVecEnv([row] * num_rows, start_method="spawn")
    if task.observe != "none":
        venv = VecForecast(venv, task.forecaster, device=resolve_device(task.device))
    return VecMonitor(venv)


@dataclass(frozen=True)
class _MakeRow:
    """Picklable constructor of one row."""

    env_id: str
    scene_spec: SceneSpec | None
    seeded: bool

    def __call__(self) -> gym.Env:
        if multiprocessing.parent_process() is not None:
            torch.set_num_threads(1)  # the rows already fill the cores
        env = make_env(self.env_id, disable_env_checker=True)
        if self.scene_spec is not None:
            env = SceneObservation(env, self.scene_spec.perception_m, self.scene_spec.max_agents)
        return SeededEpisodes(env) if self.seeded else env


@dataclass(frozen=True)
class EpisodeResult:
    """What happened in one episode."""

    seed: int
    """Seed it was reset with."""
    episode_return: float
    """Undiscounted sum of rewards."""
    length: int
    """Policy steps."""
    crashed: bool
    """Whether the env reported a crash of the ego at any step."""
    mean_speed_mps: float
    """Mean over steps of the ego's speed [m/s]; NaN where the env reports none."""


class SeededEpisodes(gym.Wrapper):
    """Plays queued seeds one after another and leaves an `EpisodeResult` in the last info of each episode.

    Episodes beyond the queue go on unseeded and leave no result. An ego from `envs.egos` may drive in place of the
    actions that arrive, with its own generator per seed, so its episodes do not depend on the number of rows.

    Args:
        env: one row.
    """

    def __init__(self, env: gym.Env) -> None:
        """Nothing is queued yet."""
        super().__init__(env)
        self._seeds: list[int] = []
        self._ego_name: str | None = None
        self._ego: Ego | None = None
        self._seed: int | None = None

    def queue(self, seeds: Sequence[int], ego: str | None = None) -> None:
        """Seeds of the next episodes, from the next reset on; `ego` drives them if given."""
        self._seeds, self._ego_name = list(seeds), ego

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start the next queued episode."""
        self._seed = self._seeds.pop(0) if self._seeds else None
        obs, info = self.env.reset(seed=seed if self._seed is None else self._seed, options=options)
        self._ego = None
        if self._ego_name is not None:
            self._ego = make_ego(self._ego_name, self.env, np.random.default_rng(self._seed))
        self._rewards: list[float] = []
        self._speeds_mps: list[float] = []
        self._crashed = False
        self._obs = obs
        return obs, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step, and note what the result needs."""
        if self._ego is not None:
            action = self._ego(self._obs)
        obs, reward, terminated, truncated, info = self.env.step(action)
        self._obs = obs
        self._rewards.append(float(reward))
        self._speeds_mps.append(float(info.get("speed", np.nan)))
        self._crashed |= bool(info.get("crashed", False))
        if (terminated or truncated) and self._seed is not None:
            speed = float(np.mean(self._speeds_mps))
            info[EPISODE_INFO] = EpisodeResult(
                self._seed, float(np.sum(self._rewards)), len(self._rewards), self._crashed, speed
            )
        return obs, reward, terminated, truncated, info


def run_episodes(
    venv: VecEnv,
    policy: Callable[[Any], Any] | str,
    seeds: Sequence[int],
    on_episode: Callable[[], None] = lambda: None,
) -> list[EpisodeResult]:
    """Play one episode per seed, all rows in parallel.

    Args:
        venv: from `make_rows(..., seeded=True)`.
        policy: from a batch of observations to a batch of actions, or the name of an ego from `envs.egos`.
        seeds: one per episode, all different.
        on_episode: called after each episode (progress bars).

    Returns:
        Results in the order of the seeds.
    """
    ego = policy if isinstance(policy, str) else None
    if ego is not None:
        venv = venv.unwrapped  # nobody looks at the forecasts, so none are made
    for row in range(venv.num_envs):
        venv.env_method("queue", list(seeds[row :: venv.num_envs]), ego, indices=[row])
    no_actions = np.zeros((venv.num_envs, *(venv.action_space.shape or ())), dtype=venv.action_space.dtype)
    results: dict[int, EpisodeResult] = {}
    obs = venv.reset()
    while len(results) < len(seeds):
        actions = no_actions if isinstance(policy, str) else policy(obs)
        obs, _, _, infos = venv.step(actions)
        for info in infos:
            if EPISODE_INFO in info:
                result = info[EPISODE_INFO]
                results[result.seed] = result
                on_episode()
    return [results[seed] for seed in seeds]
