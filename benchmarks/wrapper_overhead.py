"""What foresight costs: steps/s of plain environments against the same ones under `VecForecast`, in one run.

`python benchmarks/wrapper_overhead.py` times both in turn, block by block, on the same seeds and actions, and prints
the median ratio. Absolute numbers depend on the machine; the ratio is the result.
"""

import json
import platform
import statistics
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
import tyro
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv

from envs.vector import VecForecast
from envs.wrappers import SceneObservation
from predictor.errors import UserError, run_entry_point
from predictor.provenance import provenance, write_json


@dataclass(frozen=True)
class OverheadConfig:
    """Compare steps/s without and with forecasts."""

    env_id: str = "highway-fast-v0"
    """Environment."""
    checkpoint: str | None = None
    """Shipped name or folder; None takes the one that ships for the id."""
    envs: int = 8
    """Parallel environments."""
    vec: Literal["dummy", "subproc"] = "dummy"
    """One process, or one process per environment."""
    steps: int = 40
    """Vector steps in a block."""
    blocks: int = 15
    """Pairs of blocks; the median of their ratios is reported."""
    threads: int = 1
    """torch threads of the forecaster; more do not pay for scenes this small."""
    out: Path | None = None
    """JSON file for the result."""

    def check(self) -> None:
        """Check ranges.

        Raises:
            UserError: a value that makes no sense. (In `__post_init__`, tyro would turn it into a box of lines.)
        """
        for name in ("envs", "steps", "blocks", "threads"):
            if getattr(self, name) < 1:
                raise UserError(f"{name} must be at least 1, got {getattr(self, name)}")


def run_block(venv: VecEnv, config: OverheadConfig, seed: int) -> float:
    """Seconds for one block, from a seeded reset; the reset itself is not timed."""
    rng = np.random.default_rng(seed)
    venv.seed(seed)
    venv.reset()
    actions = [np.array([rng.integers(venv.action_space.n) for _ in range(config.envs)]) for _ in range(config.steps)]  # type: ignore[attr-defined]
    began = time.perf_counter()
    for action in actions:
        venv.step(action)
    return time.perf_counter() - began


def main() -> None:
    """Entry point."""
    config = tyro.cli(OverheadConfig, description=__doc__)
    config.check()
    torch.set_num_threads(config.threads)
    vec_class = DummyVecEnv if config.vec == "dummy" else SubprocVecEnv
    plain = make_vec_env(config.env_id, config.envs, vec_env_cls=vec_class)
    scenes = make_vec_env(config.env_id, config.envs, vec_env_cls=vec_class, wrapper_class=SceneObservation)
    forecast = VecForecast(scenes, config.checkpoint)
    run_block(plain, config, 0)
    run_block(forecast, config, 0)
    pairs = []
    for block in range(config.blocks):
        order = [plain, forecast] if block % 2 == 0 else [forecast, plain]  # a drifting machine favours neither
        times = {id(venv): run_block(venv, config, block + 1) for venv in order}
        pairs.append((times[id(plain)], times[id(forecast)]))
    plain.close()
    forecast.close()
    steps = config.steps * config.envs
    ratios = [with_ / without for without, with_ in pairs]
    result = {
        "env_id": config.env_id,
        "envs": config.envs,
        "vec": config.vec,
        "agents": forecast.stream.scene_spec.max_agents,
        "horizon_steps": forecast.stream.horizon_steps,
        "plain_steps_per_s": steps / statistics.median(p for p, _ in pairs),
        "forecast_steps_per_s": steps / statistics.median(f for _, f in pairs),
        "overhead_median": statistics.median(ratios) - 1,
        "overhead_quartiles": [q - 1 for q in statistics.quantiles(ratios, n=4)[::2]],
        "machine": platform.processor() or platform.machine(),
        "provenance": provenance(("torch", "gymnasium", "highway-env", "stable-baselines3")),
    }
    print(json.dumps(result, indent=2))
    low, high = result["overhead_quartiles"]
    print(
        f"{config.env_id}, {config.envs} envs ({config.vec}): plain {result['plain_steps_per_s']:.0f} steps/s, "
        f"with forecasts {result['forecast_steps_per_s']:.0f}; overhead {100 * result['overhead_median']:.1f} % "
        f"(quartiles {100 * low:.1f} to {100 * high:.1f} %)"
    )
    if config.out is not None:
        write_json(config.out, result)


if __name__ == "__main__":
    run_entry_point(main)
