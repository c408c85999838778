"""Compares PPO with forecasts on EnvPool and plain PPO on highway-env: steps/s of whole training loops, in one run.

`python -m benchmarks.envpool_training` trains both in turn, block by block (rollouts and updates, no evaluation), each
with the preset that `train_policy.py` uses for it, and prints the median ratio and the shares of time of the first.
Absolute numbers depend on the machine; the ratio is the result.
"""

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from stable_baselines3.common.base_class import BaseAlgorithm

from agents.task import Task
from agents.training import TrainingPlan, make_model
from agents.vec_envs import make_venv
from predictor.support.command_line import parse
from predictor.support.config_checks import check_at_least
from predictor.support.errors import run_entry_point
from predictor.support.files import check_out_file, write_json
from predictor.support.provenance import provenance
from predictor.support.runtime import keep_freed_memory, processor


@dataclass(frozen=True)
class TrainingSpeedConfig:
    """Compares steps/s of two PPO trainings."""

    env_id: str = "highway-fast-v0"
    """Environment by highway-env's id; EnvPool trains on its own copy of it."""
    num_envpool_envs: int = 64
    """Number of parallel environments in EnvPool."""
    num_plain_envs: int = 6
    """Number of parallel environments of highway-env; the default is that of train_policy.py."""
    blocks: int = 5
    """Number of pairs of blocks; the median of their ratios is reported."""
    plain_steps: int = 768
    """Number of environment steps in a plain block (one rollout of 128 steps and its update)."""
    envpool_steps: int = 8192
    """Number of environment steps in a block with forecasts."""
    threads: int = 2
    """Number of torch threads of the forecaster and of both policies."""
    out: Path | None = None
    """JSON file to write the result to."""

    def __post_init__(self) -> None:
        """Checks ranges.

        Raises:
            UserError: a value is out of range.
        """
        check_at_least(
            self, 1, "num_envpool_envs", "num_plain_envs", "blocks", "plain_steps", "envpool_steps", "threads"
        )
        check_out_file(self.out)


class Timed:
    """Adds up the time spent in chosen methods.

    Attributes:
        seconds: time by name; that of a method includes the methods it calls.
    """

    def __init__(self) -> None:
        """Starts with no method."""
        self.seconds: dict[str, float] = {}

    def watch(self, owner: Any, method: str, name: str) -> None:
        """Times a method of an object from now on, under a name."""
        call = getattr(owner, method)

        def timed(*args: Any, **kwargs: Any) -> Any:
            began = time.perf_counter()
            try:
                return call(*args, **kwargs)
            finally:
                self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - began

        setattr(owner, method, timed)


def make(task: Task, num_envs: int, seed: int) -> BaseAlgorithm:
    """Makes a model with its environments, as train_policy.py does."""
    return make_model(TrainingPlan(task, "ppo", 1_000_000, num_envs, seed), make_venv(task, num_envs))


def run_block(model: BaseAlgorithm, steps: int) -> float:
    """Measures environment steps per second over whole rollouts and updates."""
    before, began = model.num_timesteps, time.perf_counter()
    model.learn(steps, reset_num_timesteps=False)
    return (model.num_timesteps - before) / (time.perf_counter() - began)


def profile(model: BaseAlgorithm, steps: int) -> dict[str, float]:
    """Measures the share of a block's time by part."""
    timed = Timed()
    forecast = model.env.venv  # type: ignore[union-attr]
    timed.watch(forecast.venv, "step_wait", "simulation and scenes")
    timed.watch(forecast, "step_wait", "_step")
    timed.watch(model.policy, "forward", "policy")
    timed.watch(model, "train", "update")
    began = time.perf_counter()
    run_block(model, steps)
    total = time.perf_counter() - began
    seconds = timed.seconds
    seconds["forecasts"] = seconds.pop("_step") - seconds["simulation and scenes"]
    seconds["rest of SB3"] = total - sum(seconds.values())
    return {name: value / total for name, value in sorted(seconds.items(), key=lambda item: -item[1])}


def measure(config: TrainingSpeedConfig, report: Callable[[str], None]) -> dict[str, Any]:
    """Measures steps/s of both, their ratio, and the shares of time of the training with forecasts.

    Args:
        config: shapes and repetitions.
        report: receives a line of text after each pair of blocks.
    """
    plain = make(Task(config.env_id, "none"), config.num_plain_envs, 0)
    envpool = make(Task(config.env_id, "forecast", backend="envpool"), config.num_envpool_envs, 0)
    try:
        run_block(plain, config.plain_steps)
        run_block(envpool, config.envpool_steps)
        pairs = []
        for _ in range(config.blocks):
            pairs.append((run_block(plain, config.plain_steps), run_block(envpool, config.envpool_steps)))
            report(f"plain {pairs[-1][0]:.0f} steps/s, EnvPool with forecasts {pairs[-1][1]:.0f}")
        shares = profile(envpool, config.envpool_steps)
    finally:
        for model in (plain, envpool):
            model.env.close()  # type: ignore[union-attr]
    ratios = [fast / slow for slow, fast in pairs]
    return {
        "plain_steps_per_s": statistics.median(slow for slow, _ in pairs),
        "envpool_forecast_steps_per_s": statistics.median(fast for _, fast in pairs),
        "ratio": statistics.median(ratios),
        "ratios": ratios,
        "shares": shares,
        "machine": processor(),
    }


def main() -> None:
    """Runs the command."""
    config = parse(TrainingSpeedConfig, __doc__)
    keep_freed_memory()
    torch.set_num_threads(config.threads)
    result = measure(config, partial(print, flush=True))
    ratios = result["ratios"]
    print(
        f"{config.env_id}: plain PPO on highway-env ({config.num_plain_envs} processes) "
        f"{result['plain_steps_per_s']:.0f} steps/s, PPO with forecasts on EnvPool "
        f"({config.num_envpool_envs} environments) {result['envpool_forecast_steps_per_s']:.0f} steps/s, "
        f"ratio {result['ratio']:.1f} ({min(ratios):.1f} to {max(ratios):.1f})"
    )
    shares = result["shares"].items()
    print("shares of its time: " + ", ".join(f"{name} {100 * share:.0f} %" for name, share in shares))
    if config.out is not None:
        made = provenance(("envpool", "highway-env", "stable-baselines3", "torch"))
        write_json(config.out, result | {"provenance": made})


if __name__ == "__main__":
    run_entry_point(main)
