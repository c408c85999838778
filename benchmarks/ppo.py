"""Whole PPO training with forecasts on EnvPool against plain PPO on highway-env (`benchmarks.envpool_training`)."""

from typing import Any

import numpy as np

from benchmarks.envpool_training import TrainingSpeedConfig, measure
from benchmarks.optional_packages import missing
from benchmarks.results import Line, skipped
from benchmarks.settings import Settings
from benchmarks.timing import ratio_line

SHAPES: dict[str, dict[str, Any]] = {
    "quick": {"num_envpool_envs": 64, "num_plain_envs": 2, "blocks": 2, "plain_steps": 256, "envpool_steps": 4096},
    "full": {"blocks": 5},
}
"""Fields of `TrainingSpeedConfig`."""
NAME = "PPO with forecasts on EnvPool / plain PPO on highway-env"
TOLERANCE = 1.6
"""Few blocks, and processes that share the cores."""


def run(settings: Settings) -> list[Line]:
    """Steps/s of both, their ratio, and where the time goes."""
    absent = missing("envpool")
    if absent:
        return [skipped("ppo", NAME, absent, {"env": settings.env_id})]
    config = TrainingSpeedConfig(settings.env_id, threads=settings.threads, **SHAPES[settings.mode])
    result = measure(config, lambda _: None)
    what = {"env": settings.env_id}
    plain, native = what | {"processes": config.num_plain_envs}, what | {"envs": config.num_envpool_envs}
    both = native | {"processes": config.num_plain_envs}
    lines = [
        Line("ppo", "plain PPO on highway-env", plain, result["plain_steps_per_s"], "steps/s"),
        Line("ppo", "PPO with forecasts on EnvPool", native, result["native_forecast_steps_per_s"], "steps/s"),
        ratio_line(
            "ppo", NAME, both, np.array(result["ratios"]), "plain, steps/s", better="higher", tolerance=TOLERANCE
        ),
    ]
    shares = result["shares"].items()
    return lines + [Line("ppo", f"share of time: {name}", native, 100 * share, "%") for name, share in shares]
