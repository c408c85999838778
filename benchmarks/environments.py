"""Measures the cost of forecasts: plain steps against steps under `VecForecast`, for highway-env and EnvPool.

The default checkpoint and an untrained network of the paper's size take turns on the same seeds and actions
(`benchmarks.wrapper_overhead` measures one such pair at length).
"""

from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import replace
from typing import Any, Literal, NamedTuple

import torch
from stable_baselines3.common.vec_env import VecEnv

from benchmarks.optional_packages import missing
from benchmarks.results import Line, skipped
from benchmarks.settings import Settings
from benchmarks.timing import Meter, Timing, interpreter, rate_line, ratio_line
from benchmarks.wrapper_overhead import blocks_of, make_venv, paper_sized
from envs.registry import envpool_task_of
from envs.sb3.envpool import EnvPoolVecEnv
from envs.sb3.forecast import VecForecast


class Case(NamedTuple):
    """Kind and size of a vector environment."""

    simulator: Literal["highway-env", "EnvPool"]
    envs: int
    vec: Literal["dummy", "subproc", "envpool"]
    paper: bool
    steps: int
    rounds: int


CASES: dict[str, tuple[Case, ...]] = {
    "quick": (
        Case("highway-env", 1, "dummy", False, 15, 5),
        Case("highway-env", 8, "dummy", True, 5, 5),
        Case("EnvPool", 1, "envpool", False, 40, 7),
        Case("EnvPool", 8, "envpool", False, 40, 7),
        Case("EnvPool", 64, "envpool", False, 20, 7),
    ),
    "full": (
        Case("highway-env", 1, "dummy", False, 40, 15),
        Case("highway-env", 8, "dummy", True, 40, 11),
        Case("highway-env", 16, "dummy", False, 40, 7),
        Case("highway-env", 8, "subproc", False, 40, 11),
        Case("EnvPool", 1, "envpool", False, 200, 15),
        Case("EnvPool", 8, "envpool", True, 200, 15),
        Case("EnvPool", 64, "envpool", False, 100, 15),
    ),
}
FEW = 16
"""Number of environments up to which the forecaster gets one thread; for so few scenes a second one does not pay."""
TOLERANCES = {"highway-env": 1.15, "EnvPool": 1.6}
"""Tolerance of the ratio with forecasts / plain: wide for EnvPool, whose plain steps are too short to be steady."""


def run(settings: Settings) -> list[Line]:
    """Measures every case whose simulator is installed."""
    lines = []
    for case in CASES[settings.mode]:
        absent = missing("envpool") if case.simulator == "EnvPool" else ""
        if absent:
            lines.append(skipped("wrappers", "overhead of forecasts", absent, _what(case, settings)))
        else:
            lines += _overhead(case, settings)
    return lines


def _what(case: Case, settings: Settings) -> dict[str, Any]:
    return {"env": settings.env_id, "simulator": case.simulator, "envs": case.envs, "vec": case.vec}


def _overhead(case: Case, settings: Settings) -> list[Line]:
    meter = Meter(case.rounds)
    with _environments(case, settings.env_id) as venvs, _threads(settings.threads if case.envs > FEW else 1):
        blocks = {name: blocks_of(venv, case.steps) for name, venv in venvs.items()}
        timings = meter.time_blocks(blocks, interpreter())
    what, count = _what(case, settings), case.steps * case.envs
    rates = [rate_line("wrappers", name, what, timing, count, "steps/s") for name, timing in timings.items()]
    # The speed of a plain simulator does not depend on this project.
    rates = [replace(line, compared=None) if line.name == "plain" else line for line in rates]
    plain = timings.pop("plain")
    return rates + [_ratio(name, what, timing, plain) for name, timing in timings.items()]


@contextmanager
def _threads(count: int) -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _ratio(name: str, what: dict[str, Any], timing: Timing, plain: Timing) -> Line:
    ratios = timing.seconds / plain.seconds
    tolerance = TOLERANCES[what["simulator"]]
    return ratio_line("wrappers", f"{name} / plain", what, ratios, "plain, time", tolerance=tolerance)


@contextmanager
def _environments(case: Case, env_id: str) -> Iterator[dict[str, VecEnv]]:
    """Yields the environments plain, with the default checkpoint and, if asked for, with a paper-size network."""
    with ExitStack() as opened:

        def opening(scenes: bool) -> VecEnv:
            return opened.enter_context(closing(_venv(case, env_id, scenes)))

        venvs = {"plain": opening(scenes=False), "with forecasts": VecForecast(opening(scenes=True))}
        if case.paper:
            scenes = opening(scenes=True)
            venvs["with forecasts, paper size"] = VecForecast(scenes, forecaster=paper_sized(scenes))
        yield venvs


def _venv(case: Case, env_id: str, scenes: bool) -> VecEnv:
    if case.vec == "envpool":
        return EnvPoolVecEnv(envpool_task_of(env_id), case.envs, seed=0, scenes=scenes)
    return make_venv(env_id, case.envs, case.vec, scenes)
