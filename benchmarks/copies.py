"""Measures what forecasts for several copies of a PettingZoo environment cost, batched and one by one, in one run.

`python -m benchmarks.copies` steps one copy and several copies in turns, without forecasts, with one batched forward
for all copies, and with a forward for each. A cost is the CPU time of a vector step beyond that of the plain
environments; the ratios to the cost for one copy are the result.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from pettingzoo import ParallelEnv

from benchmarks.timing import alternate, quartiles
from envs.parallel import ForecastParallelEnv
from envs.registry import make_multiagent_env
from envs.sb3.agents_as_rows import ParallelVecEnv
from predictor.support.command_line import parse
from predictor.support.config_checks import check_at_least
from predictor.support.errors import UserError, run_entry_point
from predictor.support.files import check_out_file, write_json
from predictor.support.provenance import provenance
from predictor.support.runtime import keep_freed_memory


@dataclass(frozen=True)
class CopiesConfig:
    """Compares the cost of forecasts for several copies with the cost for one."""

    env_id: str = "simple_tag_v3"
    """PettingZoo environment to time."""
    checkpoint: str | None = None
    """Forecaster: shipped name, folder or run folder; None takes the checkpoint that ships for the id."""
    copies: int = 8
    """Number of copies; they are compared with one."""
    steps: int = 10
    """Number of vector steps in a block."""
    blocks: int = 15
    """Number of rounds of blocks; medians over them are reported."""
    out: Path | None = None
    """JSON file to write the result to."""

    def __post_init__(self) -> None:
        """Checks ranges.

        Raises:
            UserError: a value is out of range.
        """
        check_at_least(self, 1, "steps", "blocks")
        check_at_least(self, 2, "copies")
        check_out_file(self.out)


@dataclass(frozen=True)
class Cost:
    """Cost of forecasts in a vector step."""

    ms: float
    """Median CPU time beyond that of the plain environments [ms]."""
    ratio: float
    """Median over blocks of the cost, divided by that for one copy."""
    quartiles: tuple[float, float]
    """Quartiles of the ratio over blocks."""


def make_copies(config: CopiesConfig, copies: int, forecasts: bool) -> ParallelVecEnv:
    """Makes copies of the environment in one vector environment, whose agents all learn.

    Raises:
        UserError: unknown id, no checkpoint, or actions that are not discrete.
    """

    def one() -> ParallelEnv:
        env = make_multiagent_env(config.env_id)
        return ForecastParallelEnv(env, config.checkpoint) if forecasts else env

    venv = ParallelVecEnv([one] * copies)
    if not isinstance(venv.action_space, spaces.Discrete):
        raise UserError(f"blocks are of discrete actions, {config.env_id} has {venv.action_space}; time another")
    return venv


def cpu_block(venvs: Sequence[ParallelVecEnv], steps: int) -> Callable[[], float]:
    """Returns a function that measures the CPU time of one step of all vector environments over the next block [s]."""
    rng = np.random.default_rng(0)
    for venv in venvs:
        venv.seed(0)
        venv.reset()
    space = venvs[0].action_space
    assert isinstance(space, spaces.Discrete)
    count = int(space.n)

    def block() -> float:
        actions = [[rng.integers(count, size=venv.num_envs) for venv in venvs] for _ in range(steps)]
        began = time.process_time()
        for of_step in actions:
            for venv, action in zip(venvs, of_step, strict=True):
                venv.step(action)
        return (time.process_time() - began) / steps

    block()  # warms up
    return block


def measure(config: CopiesConfig) -> dict[str, Cost]:
    """Returns the costs for one copy, for all copies in one vector environment, and for all in one each."""
    plain = partial(make_copies, config, forecasts=False)
    forecast = partial(make_copies, config, forecasts=True)
    kinds = {
        "plain, one": [plain(1)],
        "plain, all": [plain(config.copies)],
        "one": [forecast(1)],
        "batched": [forecast(config.copies)],
        "one by one": [forecast(1) for _ in range(config.copies)],
    }
    seconds = alternate({name: cpu_block(venvs, config.steps) for name, venvs in kinds.items()}, config.blocks)
    for venvs in kinds.values():
        for venv in venvs:
            venv.close()
    costs = {name: seconds[name] - np.median(seconds["plain, all"]) for name in ("batched", "one by one")}
    costs = {"one": seconds["one"] - np.median(seconds["plain, one"])} | costs
    base = np.median(costs["one"])
    return {
        name: Cost(1e3 * float(np.median(cost)), float(np.median(cost / base)), quartiles(cost / base))
        for name, cost in costs.items()
    }


def main() -> None:
    """Runs the command."""
    config = parse(CopiesConfig, __doc__)
    keep_freed_memory()
    torch.set_num_threads(1)
    costs = measure(config)
    print(f"forecasts for one copy of {config.env_id}: {costs['one'].ms:.1f} ms CPU per vector step")
    for name in ("batched", "one by one"):
        cost, (low, high) = costs[name], costs[name].quartiles
        print(
            f"{config.copies} copies, {name}: {cost.ms:.1f} ms, {cost.ratio:.2f} times that "
            f"(quartiles {low:.2f} to {high:.2f})"
        )
    if config.out is not None:
        result: dict[str, Any] = {"env_id": config.env_id, "copies": config.copies}
        result |= {name: asdict(cost) for name, cost in costs.items()}
        result |= {"provenance": provenance(("torch", "pettingzoo", "mpe2", "stable-baselines3"))}
        write_json(config.out, result)


if __name__ == "__main__":
    run_entry_point(main)
