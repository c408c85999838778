"""Compares PPO training with forecasts on EnvPool and plain PPO on highway-env (`benchmarks.envpool_training`)."""

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
"""Values for fields of `TrainingSpeedConfig`, by mode."""
NAME = "PPO with forecasts on EnvPool / plain PPO on highway-env"
TOLERANCE = 1.6
"""Tolerance of the ratio: wide, as blocks are few and the processes share the cores."""


def run(settings: Settings) -> list[Line]:
    """Measures steps/s of both, their ratio, and the shares of time."""
    absent = missing("envpool")
    if absent:
        return [skipped("ppo", NAME, absent, {"env": settings.env_id})]
    config = TrainingSpeedConfig(settings.env_id, threads=settings.threads, **SHAPES[settings.mode])
    result = measure(config, lambda _: None)
    what = {"env": settings.env_id}
    plain, envpool = what | {"processes": config.num_plain_envs}, what | {"envs": config.num_envpool_envs}
    both = envpool | {"processes": config.num_plain_envs}
    lines = [
        Line("ppo", "plain PPO on highway-env", plain, result["plain_steps_per_s"], "steps/s"),
        Line("ppo", "PPO with forecasts on EnvPool", envpool, result["envpool_forecast_steps_per_s"], "steps/s"),
        ratio_line(
            "ppo", NAME, both, np.array(result["ratios"]), "plain, steps/s", better="higher", tolerance=TOLERANCE
        ),
    ]
    shares = result["shares"].items()
    return lines + [Line("ppo", f"share of time: {name}", envpool, 100 * share, "%") for name, share in shares]
