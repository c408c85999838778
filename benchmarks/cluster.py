"""Measures what a Ray cluster adds to a task and an episode, and its speed-up on two cores.

`python -m benchmarks.cluster` runs two nodes with one CPU each on this machine. The same episodes are recorded in turns
by one process, by two, and by the cluster; all have imported what they need before. Episodes are the same in all three,
so times can be divided.
"""

import contextlib
import dataclasses
import importlib
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.timing import alternate, quartiles
from envs.collect import CollectConfig, open_pool, recorded
from envs.rollouts.cluster_pool import ClusterPool
from envs.rollouts.workers import EpisodePool
from predictor.support.cluster import INSTALL, Cluster, connected
from predictor.support.command_line import parse
from predictor.support.config_checks import check_at_least
from predictor.support.errors import UserError, run_entry_point
from predictor.support.files import check_out_file, write_json
from predictor.support.markdown import table
from predictor.support.provenance import provenance

NODES = 2
"""Number of nodes, with one CPU each."""
OBJECT_STORE_BYTES = 80_000_000


@dataclass(frozen=True)
class ClusterConfig:
    """Compares a cluster of two nodes on this machine with one and with two processes."""

    env_id: str = "highway-fast-v0"
    """Environment whose episodes are recorded."""
    episodes: int = 8
    """Number of episodes in a block."""
    tasks: int = 100
    """Number of tasks that do nothing, in a block."""
    rounds: int = 3
    """Number of rounds of blocks; medians over them are reported."""
    out: Path | None = None
    """JSON file to write the result to."""

    def __post_init__(self) -> None:
        """Checks ranges.

        Raises:
            UserError: a value is out of range.
        """
        check_at_least(self, 1, "tasks", "rounds")
        check_at_least(self, NODES, "episodes")
        check_out_file(self.out)


@contextlib.contextmanager
def two_nodes() -> Iterator[str]:
    """Yields the address of a cluster of two nodes on this machine, and ends them.

    Raises:
        UserError: Ray is not installed.
    """
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    os.environ["RAY_worker_niceness"] = "0"  # 15 by default; the processes that are compared have 0
    try:
        utils: Any = importlib.import_module("ray.cluster_utils")
    except ImportError as error:
        raise UserError(INSTALL) from error
    settings = {"num_cpus": 1, "object_store_memory": OBJECT_STORE_BYTES}
    nodes = utils.Cluster(initialize_head=True, head_node_args=settings | {"include_dashboard": False})
    try:
        for _ in range(NODES - 1):
            nodes.add_node(**settings)
        yield nodes.address
    finally:
        nodes.shutdown()


def block_of_episodes(config: ClusterConfig, pool: EpisodePool[Any]) -> Callable[[], float]:
    """Returns a function that measures the time of the episodes of one block [s], in a pool that has begun."""
    recording = CollectConfig(config.env_id, Path("unused"), config.episodes)

    def block() -> float:
        began = time.perf_counter()
        assert len(list(recorded(recording, 0, pool))) == config.episodes
        return time.perf_counter() - began

    block()  # imports everything
    return block


def with_own_cpu(block: Callable[[], float], cpu_s: list[float]) -> Callable[[], float]:
    """Returns the block; it adds the processor time of this process, all of Ray's threads in it included, to a list."""

    def measured() -> float:
        began = time.process_time()
        seconds = block()
        cpu_s.append(time.process_time() - began)
        return seconds

    return measured


def block_of_tasks(config: ClusterConfig, cluster: Cluster) -> Callable[[], float]:
    """Returns a function that measures the time of tasks that do nothing [s]."""

    def block() -> float:
        began = time.perf_counter()
        assert len(list(cluster.results(bool, [True] * config.tasks))) == config.tasks
        return time.perf_counter() - began

    block()
    return block


def measure(config: ClusterConfig, address: str) -> dict[str, np.ndarray]:
    """Returns the seconds of each kind of block, round by round, and those of this process's processors ("…, here").

    Args:
        config: settings.
        address: address of a cluster of two nodes.
    """
    alone = CollectConfig(config.env_id, Path("unused"), config.episodes, workers=1, on_error="skip")
    both = dataclasses.replace(alone, workers=NODES)
    with (
        connected(address, ()) as cluster,
        open_pool(alone) as one,
        open_pool(both) as two,
        open_pool(dataclasses.replace(alone, cluster=address)) as there,
    ):
        assert cluster is not None and one is not None and two is not None and isinstance(there, ClusterPool)
        episodes_s, tasks_s = list[float](), list[float]()
        blocks = {
            "one process": block_of_episodes(config, one),
            "two processes": block_of_episodes(config, two),
            "cluster": with_own_cpu(block_of_episodes(config, there), episodes_s),
            "tasks": with_own_cpu(block_of_tasks(config, cluster), tasks_s),
        }
        found = alternate(blocks, config.rounds)
        return found | {"cluster, here": np.array(episodes_s), "tasks, here": np.array(tasks_s)}


def lines_of(config: ClusterConfig, seconds: dict[str, np.ndarray]) -> list[list[str]]:
    """Returns the lines of the table: what was measured, its median and its quartiles over rounds."""
    one, two, cluster = (seconds[name] for name in ("one process", "two processes", "cluster"))
    task_ms = 1e3 * seconds["tasks"] / config.tasks
    values = {
        "time of an episode in one process [ms]": 1e3 * one / config.episodes,
        "speed-up, two processes": one / two,
        "speed-up, cluster of two nodes": one / cluster,
        "time on the cluster / in two processes": cluster / two,
        "time of a task that does nothing [ms]": task_ms,
        "processor time of the command for it [ms]": 1e3 * seconds["tasks, here"] / config.tasks,
        "processor time of the command for an episode [ms]": 1e3 * seconds["cluster, here"] / config.episodes,
        "time of a task that does nothing / of an episode in one process": task_ms / (1e3 * one / config.episodes),
    }
    return [
        [name, f"{np.median(found):.3g}", "{:.3g} to {:.3g}".format(*quartiles(found))]
        for name, found in values.items()
    ]


def main() -> None:
    """Runs the command."""
    config = parse(ClusterConfig, __doc__)
    with two_nodes() as address:
        seconds = measure(config, address)
    lines = lines_of(config, seconds)
    load = f"load {os.getloadavg()[0]:.1f}"
    print(f"{config.env_id}, {config.episodes} episodes in a block, {config.rounds} rounds; {load}")
    print(table(["", "median", "quartiles"], lines))
    if config.out is not None:
        made = provenance(("ray", "highway-env", "gymnasium", "numpy"))
        content = {"config": asdict(config), "seconds": {name: list(found) for name, found in seconds.items()}}
        write_json(config.out, content | {"lines": lines, "load": os.getloadavg(), "provenance": made})


if __name__ == "__main__":
    run_entry_point(main)
