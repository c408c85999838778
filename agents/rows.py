"""Parallel environments ("rows") for training and evaluation.

Rows run in spawned processes with one torch thread each, or natively in EnvPool; the forecaster runs once per step for
all rows, in the main process. What a policy sees is decided by the task (`agents.task`), so that training, evaluation
and video cannot differ.
"""

import multiprocessing
from dataclasses import dataclass

import gymnasium as gym
import torch
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, VecMonitor

from agents.episodes import SeededEpisodes
from agents.parallel_rows import make_parallel_rows
from agents.task import Task, resolve_device
from envs.native import EnvPoolVecEnv
from envs.registry import make_env, native_task_of
from envs.vector import VecForecast
from envs.wrappers import SceneObservation
from predictor.scene import SceneSpec


def make_rows(task: Task, num_rows: int, seeded: bool = False) -> VecEnv:
    """Parallel rows of a task, with episode statistics and (unless `observe` is none) forecasts.

    Args:
        task: what to make.
        num_rows: rows; one runs in this process, more in spawned ones. Copies of a PettingZoo environment, each with
            a row per learner. Native environments of EnvPool.
        seeded: wrap each row in `SeededEpisodes`, for evaluation (gymnasium backend only).
    """
    if task.is_parallel:
        return make_parallel_rows(task, num_rows)
    venv: VecEnv
    spec = task.scene_spec
    if task.backend == "envpool":
        venv = EnvPoolVecEnv(
            native_task_of(task.env_id),
            num_rows,
            scenes=spec is not None,
            perception_m=None if spec is None else spec.perception_m,
            max_agents=None if spec is None else spec.max_agents,
        )
    else:
        row = _MakeRow(task.env_id, spec, seeded)
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
