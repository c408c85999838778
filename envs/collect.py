"""Records the agents of an environment: `python -m envs.collect --env-id roundabout-v1 --out data/roundabout`.

Each episode is a function of its seed alone, so the store is the same for any number of workers.
"""

import multiprocessing
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, NamedTuple

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from envs.readers.highway_labels import ATTRIBUTE_NAMES, SceneLabels, with_labels
from envs.rollouts.world import World, default_drivers, open_world
from predictor.data.store import Episode, StoreInfo, write_store
from predictor.scene import Scene
from predictor.support.command_line import Renamed, parse
from predictor.support.config_checks import check_at_least
from predictor.support.errors import UserError, run_entry_point
from predictor.support.provenance import provenance

PACKAGES = ("highway-env", "mpe2", "pettingzoo", "envpool", "gymnasium", "numpy")


@dataclass(frozen=True)
class CollectConfig:
    """Records episodes of an environment into an episode store."""

    env_id: str
    """Environment to record: gymnasium id (highway-fast-v0, envpool/HighwayFast-v0) or PettingZoo parallel id
    (simple_tag_v3)."""
    out: Path
    """Folder of the new store (Zarr)."""
    episodes: int = 400
    """Number of episodes to record."""
    driver: Annotated[tuple[str, ...], Renamed("ego")] = ()
    """Driver; several take turns, one per episode. One ego: random, idle, varied, keep-lane, planner, or the path of a
    policy .zip. Many learners: random, idle, varied, heuristic, mixed. None given: varied random idle, or heuristic
    mixed varied."""
    seed: int = 0
    """Random seed: episode i is reset with seed + i; keep test seeds apart from training seeds."""
    max_steps: int = 200
    """Largest length of an episode; longer ones are cut there [policy steps]."""
    labels: bool = True
    """Whether to record leaders and followers with their gaps at each step: for training on known edges and for scores,
    never part of an observation. Recorded states do not depend on it; docs/datasets/env.md has its cost in time and
    bytes."""
    workers: int = os.cpu_count() or 1
    """Number of parallel processes; the store does not depend on it."""
    overwrite: bool = False
    """Whether to replace an existing store."""

    def __post_init__(self) -> None:
        """Checks ranges.

        Raises:
            UserError: a value out of range.
        """
        check_at_least(self, 1, "episodes", "max_steps", "workers")
        check_at_least(self, 0, "seed")

    @property
    def drivers(self) -> tuple[str, ...]:
        """Drivers that take turns, one per episode."""
        return self.driver or default_drivers(self.env_id)


def collect(config: CollectConfig) -> Iterator[Episode]:
    """Records the episodes of a config, in the order of their seeds."""
    drivers = config.drivers
    tasks = [
        _Task(config.env_id, drivers[i % len(drivers)], config.seed + i, config.max_steps, config.labels)
        for i in range(config.episodes)
    ]
    if config.workers == 1:
        yield from map(_record, tasks)
        return
    with multiprocessing.get_context("spawn").Pool(config.workers, initializer=_limit_threads) as pool:
        yield from pool.imap(_record, tasks, chunksize=4)


class _Task(NamedTuple):
    env_id: str
    driver: str
    seed: int
    max_steps: int
    labels: bool


_worlds: dict[tuple[str, str], World] = {}


def _limit_threads() -> None:
    import torch

    torch.set_num_threads(1)  # workers already fill the cores


def _record(task: _Task) -> Episode:
    if (task.env_id, task.driver) not in _worlds:
        _worlds[task.env_id, task.driver] = open_world(task.env_id, task.driver)
    world = _worlds[task.env_id, task.driver]
    world.reset(task.seed)
    scenes: list[Scene] = []
    labels: list[SceneLabels] = []

    def note() -> None:
        scenes.append(world.full_scene())
        if task.labels and (found := world.labels()) is not None:
            labels.append(found)

    note()
    for _ in range(task.max_steps):
        ended = world.step()
        note()
        if ended:
            break
    episode = Episode.from_scenes(scenes, label=task.driver, seed=task.seed)
    return with_labels(episode, scenes, labels) if labels else episode


def main() -> None:
    """Entry point."""
    config = parse(CollectConfig, __doc__)
    if config.out.exists() and not config.overwrite:
        raise UserError(f"{config.out} exists; choose another path or pass --overwrite")
    worlds = [open_world(config.env_id, name) for name in config.drivers]
    worlds[0].reset(config.seed)
    labelled = config.labels and worlds[0].labels() is not None
    info = StoreInfo(
        worlds[0].spec,
        config.env_id,
        provenance(PACKAGES) | {"seed": config.seed},
        ATTRIBUTE_NAMES if labelled else (),
    )
    for world in worlds:
        world.close()
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
