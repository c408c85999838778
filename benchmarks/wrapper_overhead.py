"""Measures the cost of forecasts: steps/s of plain environments against environments under `VecForecast`, in one run.

`python -m benchmarks.wrapper_overhead` times both in turn, block by block, on the same seeds and actions, and prints
the median ratio. Absolute numbers depend on the machine; the ratio is the result.
"""

import json
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv

from benchmarks.timing import alternate, quartiles
from envs.registry import make_env
from envs.sb3.forecast import VecForecast
from envs.wrappers import SceneObservation
from predictor.dgvae import DGVAE
from predictor.dgvae.config import PRESETS
from predictor.forecaster import Forecaster
from predictor.scene import SceneSpec
from predictor.support.command_line import parse
from predictor.support.config_checks import check_at_least, check_choices
from predictor.support.errors import UserError, run_entry_point
from predictor.support.files import check_out_file, write_json
from predictor.support.provenance import provenance
from predictor.support.runtime import keep_freed_memory, processor


@dataclass(frozen=True)
class OverheadConfig:
    """Compares steps/s without and with forecasts."""

    env_id: str = "highway-fast-v0"
    """Environment to time."""
    checkpoint: str | None = None
    """Forecaster: shipped name, folder or run folder; None takes the checkpoint that ships for the id."""
    paper_size: bool = False
    """Forecast with an untrained network of the paper's size instead of a checkpoint."""
    num_envs: int = 8
    """Number of parallel environments."""
    vec: Literal["dummy", "subproc"] = "dummy"
    """Processes of the environments: dummy (one for all) or subproc (one for each)."""
    steps: int = 40
    """Number of vector steps in a block."""
    blocks: int = 15
    """Number of pairs of blocks; the median of their ratios is reported."""
    threads: int = 1
    """Number of torch threads of the forecaster; more do not pay for scenes this small."""
    out: Path | None = None
    """JSON file to write the result to."""

    def __post_init__(self) -> None:
        """Checks choices and ranges.

        Raises:
            UserError: a value is out of range or does not fit the others.
        """
        check_choices(self)
        check_at_least(self, 1, "num_envs", "steps", "blocks", "threads")
        if self.paper_size and self.checkpoint is not None:
            raise UserError(f"checkpoint '{self.checkpoint}' and --paper-size exclude each other; leave one out")
        check_out_file(self.out)


def run_block(venv: VecEnv, steps: int, seed: int) -> float:
    """Measures the seconds of one block, from a seeded reset; the reset itself is not timed.

    Raises:
        UserError: actions are not discrete.
    """
    if not isinstance(venv.action_space, spaces.Discrete):
        raise UserError(f"blocks are of random discrete actions, the environment has {venv.action_space}; time another")
    rng = np.random.default_rng(seed)
    venv.seed(seed)
    venv.reset()
    count = int(venv.action_space.n)
    actions = [rng.integers(count, size=venv.num_envs) for _ in range(steps)]
    began = time.perf_counter()
    for action in actions:
        venv.step(action)
    return time.perf_counter() - began


def blocks_of(venv: VecEnv, steps: int) -> Callable[[], float]:
    """Returns a function that runs the next block, after a warm-up; the n-th block always has the same seed."""
    seeds = iter(range(1, 2**31))
    run_block(venv, steps, 0)
    return lambda: run_block(venv, steps, next(seeds))


def make_venv(env_id: str, envs: int, vec: Literal["dummy", "subproc"], scenes: bool) -> VecEnv:
    """Makes plain environments, or environments that report scenes for `VecForecast`."""
    vec_class = DummyVecEnv if vec == "dummy" else SubprocVecEnv
    # a function of this project: a worker process that unpickles it has the ids registered
    made, wrapper = partial(make_env, env_id), SceneObservation if scenes else None
    return make_vec_env(made, envs, vec_env_cls=vec_class, wrapper_class=wrapper)


def paper_sized(scenes: VecEnv, horizon_steps: int = 5) -> Forecaster:
    """Makes an untrained network of the paper's size for these scenes; its cost does not depend on its weights."""
    spec: SceneSpec = scenes.get_attr("scene_spec")[0]
    torch.manual_seed(0)
    return DGVAE(spec, PRESETS["paper"], horizon_steps).eval().requires_grad_(False)


def main() -> None:
    """Runs the command."""
    config = parse(OverheadConfig, __doc__)
    keep_freed_memory()
    torch.set_num_threads(config.threads)
    plain, scenes = (make_venv(config.env_id, config.num_envs, config.vec, scenes) for scenes in (False, True))
    paper = paper_sized(scenes) if config.paper_size else None
    forecast = VecForecast(scenes, config.checkpoint, forecaster=paper)
    made = {name: blocks_of(venv, config.steps) for name, venv in (("plain", plain), ("forecast", forecast))}
    seconds = alternate(made, config.blocks)  # changes of the machine's speed affect both
    plain.close()
    forecast.close()
    steps = config.steps * config.num_envs
    ratios = seconds["forecast"] / seconds["plain"]
    result = {
        "env_id": config.env_id,
        "envs": config.num_envs,
        "vec": config.vec,
        "paper_size": config.paper_size,
        "agents": forecast.stream.scene_spec.max_agents,
        "horizon_steps": forecast.stream.horizon_steps,
        "plain_steps_per_s": steps / statistics.median(seconds["plain"].tolist()),
        "forecast_steps_per_s": steps / statistics.median(seconds["forecast"].tolist()),
        "overhead_median": statistics.median(ratios.tolist()) - 1,
        "overhead_quartiles": [q - 1 for q in quartiles(ratios)],
        "machine": processor(),
        "provenance": provenance(("torch", "gymnasium", "highway-env", "stable-baselines3")),
    }
    print(json.dumps(result, indent=2))
    low, high = result["overhead_quartiles"]
    print(
        f"{config.env_id}, {config.num_envs} envs ({config.vec}): plain {result['plain_steps_per_s']:.0f} steps/s, "
        f"with forecasts {result['forecast_steps_per_s']:.0f}; overhead {100 * result['overhead_median']:.1f} % "
        f"(quartiles {100 * low:.1f} to {100 * high:.1f} %)"
    )
    if config.out is not None:
        write_json(config.out, result)


if __name__ == "__main__":
    run_entry_point(main)
