"""Measures reading an episode store, cutting windows, simulating springs, and simulators without forecasts."""

import tempfile
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.optional_packages import missing
from benchmarks.results import Line, skipped
from benchmarks.settings import Settings
from benchmarks.timing import Meter, interpreter, products, rate_line
from predictor.data.springs import SpringsConfig, make_episodes, spring_spec
from predictor.data.store import Episode, EpisodeStore, StoreInfo, read_store, write_store
from predictor.data.windows import Windows
from predictor.scene import SceneSpec

EPISODES: dict[str, int] = {"quick": 300, "full": 3000}
BATCH = 128
POOL_ENVS = 64
STEPS: dict[str, int] = {"quick": 10, "full": 60}
"""Number of simulator steps in a block, by mode."""


def run(settings: Settings) -> list[Line]:
    """Measures stores and windows, then simulators."""
    meter = Meter.of(settings)
    count = EPISODES[settings.mode]
    with tempfile.TemporaryDirectory() as folder:
        springs, traffic = Path(folder) / "springs", Path(folder) / "traffic"
        config = SpringsConfig(Path(folder))
        write_store(springs, StoreInfo(spring_spec(config.physics), "springs"), make_episodes(config, "train", count))
        write_store(traffic, StoreInfo(SceneSpec(1.0), "traffic"), _traffic(count // 4))
        lines = _store(springs, "springs", meter, 40, 10) + _store(traffic, "ego, varying cast", meter, 10, 5)
    lines.append(_springs(config, count, meter))
    return lines + _simulators(settings)


def _store(path: Path, name: str, meter: Meter, history: int, horizon: int) -> list[Line]:
    store = read_store(path)
    windows = Windows(store.episodes, store.info.spec, history, horizon)
    indices = np.random.default_rng(0).integers(len(windows), size=BATCH)
    calls: dict[str, Callable[[], Any]] = {
        "read": partial(read_store, path),
        "cut": partial(windows.batch, indices, history),
    }
    timings = meter.measure(calls, interpreter())
    what = {"data": name, "episodes": len(store.episodes)}
    shape = {"data": name, "batch": BATCH, "history": history, "horizon": horizon}
    read = rate_line("data", "read_store", what, timings["read"], _bytes(store) / 1e6, "MB/s")
    return [
        read.noted("of arrays in memory; files are in the page cache"),
        rate_line("data", "Windows.batch", shape, timings["cut"], BATCH, "windows/s"),
    ]


def _bytes(store: EpisodeStore) -> float:
    arrays = ((e.states, e.valid, e.ids, e.edge_types, e.edge_attributes) for e in store.episodes)
    return float(sum(array.nbytes for episode in arrays for array in episode if array is not None))


def _traffic(count: int, steps: int = 40, agents: int = 24) -> list[Episode]:
    """Returns episodes of cars that appear and vanish, around an ego that stays."""
    rng = np.random.default_rng(0)
    episodes = []
    for seed in range(count):
        speed = rng.normal(25, 3, size=agents)
        states = np.zeros((steps, agents, 4), dtype=np.float32)
        states[..., 0] = rng.normal(0, 60, size=agents) + np.arange(steps)[:, None] * speed
        states[..., 1] = 4.0 * rng.integers(4, size=agents)
        states[..., 2] = speed
        appears, vanishes = rng.integers(0, steps // 2, size=agents), rng.integers(steps // 2, steps, size=agents)
        now = np.arange(steps)[:, None]
        valid = (now >= appears) & (now <= vanishes)
        valid[:, 0] = True
        episodes.append(Episode(states * valid[..., None], valid, np.arange(agents), "traffic", seed))
    return episodes


def _springs(config: SpringsConfig, count: int, meter: Meter) -> Line:
    timing = meter.measure({"springs": partial(make_episodes, config, "train", count)}, products())["springs"]
    return rate_line("data", "springs simulator", {"rollouts at once": count}, timing, count, "rollouts/s")


def _simulators(settings: Settings) -> list[Line]:
    lines = []
    for name, made, absent in (
        ("highway-env, plain", _highway, missing("highway_env", "stable_baselines3")),
        ("EnvPool, plain", _pool, missing("envpool", "stable_baselines3")),
    ):
        if absent:
            lines.append(skipped("data", name, absent, {"env": settings.env_id}))
            continue
        with made(settings) as (block, envs):
            timing = Meter.of(settings).time_blocks({name: block}, interpreter())[name]
        what = {"env": settings.env_id, "envs": envs}
        line = rate_line("data", name, what, timing, STEPS[settings.mode] * envs, "steps/s")
        lines.append(replace(line, compared=None))  # its speed does not depend on this project
    return lines


@contextmanager
def _highway(settings: Settings) -> Iterator[tuple[Callable[[], float], int]]:
    from benchmarks.wrapper_overhead import blocks_of, make_venv

    with closing(make_venv(settings.env_id, 1, "dummy", scenes=False)) as venv:
        yield blocks_of(venv, STEPS[settings.mode]), 1


@contextmanager
def _pool(settings: Settings) -> Iterator[tuple[Callable[[], float], int]]:
    from benchmarks.wrapper_overhead import blocks_of
    from envs.registry import envpool_task_of
    from envs.sb3.envpool import EnvPoolVecEnv

    with closing(EnvPoolVecEnv(envpool_task_of(settings.env_id), POOL_ENVS, seed=0, scenes=False)) as venv:
        yield blocks_of(venv, STEPS[settings.mode]), POOL_ENVS
