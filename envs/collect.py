"""Record what the agents of an environment do: `python -m envs.collect --env-id roundabout-v1 --out data/roundabout`.

Each episode is a function of its seed alone, so the store is the same for any number of workers.
"""

import multiprocessing
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import tyro
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from envs.egos import env_for_ego, make_ego
from envs.readers import reader_for
from envs.readers.highway_labels import ATTRIBUTE_NAMES, read_labels, with_labels
from envs.registry import make_env
from predictor.data.store import Episode, StoreInfo, write_store
from predictor.errors import UserError, run_entry_point
from predictor.provenance import provenance


@dataclass(frozen=True)
class CollectConfig:
    """Record episodes of an environment into an episode store."""

    env_id: str
    """Gymnasium id, for example highway-fast-v0."""
    out: Path
    """Folder of the new store (Zarr)."""
    episodes: int = 400
    """Episodes to record."""
    ego: tuple[str, ...] = ("varied", "random", "idle")
    """Who drives the ego; episodes take turns: random, idle, varied, keep-lane, or the path of a policy .zip."""
    seed: int = 0
    """Episode i is seeded with seed + i; keep test seeds apart from training seeds."""
    max_steps: int = 200
    """Cut longer episodes here [policy steps]."""
    labels: bool = True
    """Record who follows whom at each step, and with what gap: for training on known edges and for scores, never seen
    by a policy. The recorded states are the same without; docs/datasets/env.md has the price in time and bytes."""
    workers: int = os.cpu_count() or 1
    """Parallel processes."""
    overwrite: bool = False
    """Replace an existing store."""

    def check(self) -> None:
        """Check ranges.

        Raises:
            UserError: a value that makes no sense. (In `__post_init__`, tyro would turn it into a box of lines.)
        """
        for name in ("episodes", "max_steps", "workers"):
            if getattr(self, name) < 1:
                raise UserError(f"{name} must be at least 1, got {getattr(self, name)}")
        if self.seed < 0:
            raise UserError(f"seed must not be negative, got {self.seed}")
        if not self.ego:
            raise UserError("ego needs at least one name")


def collect(config: CollectConfig) -> Iterator[Episode]:
    """Record the episodes of a config, in the order of their seeds."""
    tasks = [
        _Task(config.env_id, config.ego[i % len(config.ego)], config.seed + i, config.max_steps, config.labels)
        for i in range(config.episodes)
    ]
    if config.workers == 1:
        yield from map(_record, tasks)
        return
    with multiprocessing.get_context("spawn").Pool(config.workers, initializer=_limit_threads) as pool:
        yield from pool.imap(_record, tasks, chunksize=4)


class _Task(NamedTuple):
    env_id: str
    ego: str
    seed: int
    max_steps: int
    labels: bool


_worker_envs: dict[tuple[str, str], gym.Env] = {}


def _limit_threads() -> None:
    import torch

    torch.set_num_threads(1)  # workers already fill the cores


def _record(task: _Task) -> Episode:
    view = task.ego if task.ego.endswith(".zip") else ""
    if (task.env_id, view) not in _worker_envs:
        _worker_envs[task.env_id, view] = env_for_ego(make_env(task.env_id, disable_env_checker=True), task.ego)
    env = _worker_envs[task.env_id, view]
    reader = reader_for(env)
    obs: Any
    obs, _ = env.reset(seed=task.seed)
    ego = make_ego(task.ego, env, np.random.default_rng(task.seed))
    scenes = [reader.read_all(env)]
    labels = [read_labels(env)] if task.labels else []
    for _ in range(task.max_steps):
        obs, _, terminated, truncated, _ = env.step(ego(obs))
        scenes.append(reader.read_all(env))
        if task.labels:
            labels.append(read_labels(env))
        if terminated or truncated:
            break
    episode = Episode.from_scenes(scenes, label=task.ego, seed=task.seed)
    return with_labels(episode, scenes, labels) if task.labels else episode


def main() -> None:
    """Entry point."""
    config = tyro.cli(CollectConfig, description=__doc__)
    config.check()
    if config.out.exists() and not config.overwrite:
        raise UserError(f"{config.out} exists; choose another path or pass --overwrite")
    env = make_env(config.env_id)
    for name in config.ego:
        make_ego(name, env_for_ego(env, name), np.random.default_rng(0))
    info = StoreInfo(
        reader_for(env).spec,
        config.env_id,
        provenance(("highway-env", "gymnasium", "numpy")) | {"seed": config.seed},
        ATTRIBUTE_NAMES if config.labels else (),
    )
    episodes = []
    columns = (TextColumn(f"collect {config.env_id}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns) as progress:
        task = progress.add_task("", total=config.episodes)
        for episode in collect(config):
            episodes.append(episode)
            progress.advance(task)
    write_store(config.out, info, episodes, config.overwrite)
    steps = sum(len(e.states) for e in episodes)
    print(
        f"{config.out}: {len(episodes)} episodes, {steps} scenes, seeds {config.seed}–{config.seed + len(episodes) - 1}"
    )


if __name__ == "__main__":
    run_entry_point(main)
