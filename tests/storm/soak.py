"""Soak: `python -m tests.storm.soak --steps 1000000`.

Steps vector environments with forecasts for a long time while agents come and go, episodes end, and environments are
seeded and reset. Memory, file descriptors, threads, and entries of all dictionaries, lists and sets are counted as it
goes on. Each must be flat: from the second quarter of the run to the last one, its median may grow by no more than a
fixed amount and a rate (`LIMITS`). The exit status is 1 if one is not.
"""

import gc
import os
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, fields
from multiprocessing import get_context
from pathlib import Path
from types import ModuleType
from typing import Any, Literal, get_args

import numpy as np
import torch
from stable_baselines3.common.vec_env import VecEnv

from predictor.support.command_line import parse
from predictor.support.config_checks import check_at_least, check_choices
from predictor.support.errors import UserError, run_entry_point
from predictor.support.files import write_json
from predictor.support.provenance import provenance
from tests.storm.soak_subjects import SUBJECTS

Name = Literal["egos", "multiagent", "envpool"]
NAMES: tuple[Name, ...] = get_args(Name)
"""Vector environments: `VecForecast`, `ForecastParallelEnv` and EnvPool's."""
PER = 100_000
"""Number of environment steps that rates are given for."""
RESETS = 10
"""Number of times that a run seeds and resets all environments."""
LEAST_SAMPLES = 8


@dataclass(frozen=True)
class SoakConfig:
    """Steps vector environments for a long time and checks that nothing grows."""

    steps: int = 1_000_000
    """Number of environment steps of each vector environment: vector steps times environments."""
    rows: int = 96
    """Number of environments that step at once; of agents, where all learn."""
    samples: int = 80
    """Number of times that memory and the like are measured."""
    only: tuple[Name, ...] = NAMES
    """Vector environments to step."""
    seed: int = 0
    """Random seed of environments and actions."""
    out: Path | None = None
    """JSON file to write all samples to."""

    def __post_init__(self) -> None:
        """Checks ranges."""
        check_choices(self)
        check_at_least(self, 1, "rows")
        check_at_least(self, LEAST_SAMPLES, "samples")
        if self.steps < 2 * self.rows * self.samples:
            raise UserError(
                f"steps must be at least {2 * self.rows * self.samples} (2 · rows · samples), got {self.steps}"
            )


@dataclass(frozen=True)
class Sample:
    """What a process holds at one moment."""

    steps: int
    """Environment steps so far."""
    memory_mb: float
    """Resident memory [MB]."""
    files: int
    """Open file descriptors."""
    threads: int
    """Threads, those of C++ included."""
    entries: int
    """Entries of all dictionaries, lists, sets and queues of Python."""


@dataclass(frozen=True)
class Limit:
    """Largest growth that still counts as flat."""

    amount: float
    """Growth that is allowed at any length of a run: noise of the allocator, or of how many agents there are."""
    rate: float
    """Growth that is allowed in addition, for each `PER` environment steps."""


LIMITS = {
    "memory_mb": Limit(4.0, 1.0),
    "files": Limit(0.0, 0.0),
    "threads": Limit(0.0, 0.0),
    "entries": Limit(500.0, 1000.0),
}


@dataclass(frozen=True)
class Finding:
    """Growth of one quantity from the second quarter of a run to the last."""

    before: float
    """Median over the second quarter."""
    after: float
    """Median over the last quarter."""
    allowed: float
    """Largest growth that counts as flat."""

    @property
    def is_flat(self) -> bool:
        """Whether it did not grow by more."""
        return self.after - self.before <= self.allowed


def take_sample(steps: int) -> Sample:
    """Measures this process, after collecting garbage."""
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    status = Path("/proc/self/status").read_text()
    threads = int(status.split("\nThreads:")[1].split()[0])
    memory_mb = pages * os.sysconf("SC_PAGE_SIZE") / 1e6
    return Sample(steps, memory_mb, len(os.listdir("/proc/self/fd")), threads, count_entries())


def count_entries() -> int:
    """Counts the entries of all containers: those that the collector tracks, and those that they hold untracked."""
    kinds = (dict, list, set, frozenset)
    counted, total = set[int](), 0
    every = gc.get_objects()
    for thing in every:
        if type(thing) is tuple:
            continue
        # After gc.get_referents(_asyncio) the collector hangs on Python 3.12.0 to 3.12.5 and 3.13.0 (gh-122695).
        held = (vars(thing),) if issubclass(type(thing), ModuleType) else gc.get_referents(thing)
        for found in (thing, *held):
            if issubclass(type(found), kinds) and id(found) not in counted and found is not every:
                counted.add(id(found))
                total += len(found)
    return total


def soak(
    venv: VecEnv, steps: int, samples: int, seed: int = 0, each: Callable[[int], None] | None = None
) -> list[Sample]:
    """Steps a vector environment with random actions; seeds and resets it now and then.

    Args:
        venv: vector environment.
        steps: number of environment steps.
        samples: number of times to measure.
        seed: random seed.
        each: called after each vector step, for leaks that are planted.

    Raises:
        UserError: an observation is not finite.
    """
    rng, vector_steps = np.random.default_rng(seed), steps // venv.num_envs
    measured: list[Sample] = []
    anew = max(1, vector_steps // RESETS)
    for step in range(vector_steps):
        if step % anew == 0:
            venv.seed(int(rng.integers(2**30)))
            venv.reset()
        observations: Any = venv.step(rng.integers(2, size=venv.num_envs))[0]
        if each is not None:
            each(step)
        if (step + 1) * samples // vector_steps > len(measured):
            if not all(np.isfinite(value).all() for value in observations.values()):
                raise UserError(f"vector step {step}: an observation is not finite")
            measured.append(take_sample((step + 1) * venv.num_envs))
    return measured


def judge(measured: Sequence[Sample], limits: Mapping[str, Limit] = LIMITS) -> dict[str, Finding]:
    """Compares the second quarter of a run with its last, for each quantity that has a limit."""
    quarter = len(measured) // 4
    before, after = measured[quarter : 2 * quarter], measured[-quarter:]
    between = float(np.median([s.steps for s in after]) - np.median([s.steps for s in before]))
    found = {}
    for name, limit in limits.items():
        low, high = (float(np.median([getattr(s, name) for s in part])) for part in (before, after))
        found[name] = Finding(low, high, limit.amount + limit.rate * between / PER)
    return found


def run_subject(name: Name, config: SoakConfig) -> list[Sample]:
    """Steps one vector environment in this process."""
    torch.set_num_threads(1)
    venv = SUBJECTS[name](config.rows)
    try:
        return soak(venv, config.steps, config.samples, config.seed)
    finally:
        venv.close()


def main() -> None:
    """Entry point."""
    config, all_flat, results = parse(SoakConfig, __doc__), True, {}
    for name in config.only:
        began = time.monotonic()
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as own_process:
            measured = own_process.submit(run_subject, name, config).result()
        seconds = time.monotonic() - began
        found = judge(measured)
        print(f"{name}: {measured[-1].steps:,} environment steps in {seconds / 60:.1f} min", flush=True)
        for what, one in found.items():
            verdict = "flat" if one.is_flat else "NOT FLAT"
            grown = f"{one.before:,.1f} to {one.after:,.1f}, at most {one.allowed:,.1f} more allowed"
            print(f"  {what:10} {verdict}: {grown}", flush=True)
        all_flat &= all(one.is_flat for one in found.values())
        results[name] = {"seconds": seconds, "samples": [asdict(s) for s in measured]}
    if config.out is not None:
        write_json(
            config.out, {**results, "provenance": provenance(("torch", "numpy", "stable-baselines3", "envpool"))}
        )
    if not all_flat:
        sys.exit(1)


assert set(LIMITS) < {f.name for f in fields(Sample)}

if __name__ == "__main__":
    run_entry_point(main)
