"""Checks `VecForecast` for memory leaks and invalid values while agents appear and vanish at every step.

`python -m benchmarks.churn` steps synthetic traffic in which a share of the agents is replaced at each step, with
episodes that end at different times, and reports the slope of the resident memory [bytes per vector step] after a
warm-up.
"""

import gc
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from stable_baselines3.common.vec_env import DummyVecEnv

from envs.readers.function import FunctionReader
from envs.sb3.forecast import VecForecast
from envs.wrappers import SceneObservation
from predictor.checkpoint import load_checkpoint
from predictor.scene import Scene, SceneSpec
from predictor.support.command_line import parse
from predictor.support.config_checks import check_at_least
from predictor.support.errors import UserError, run_entry_point
from predictor.support.files import check_out_file, write_json
from predictor.support.progress import track
from predictor.support.provenance import provenance


@dataclass(frozen=True)
class ChurnConfig:
    """Measures the memory of `VecForecast` while agents are replaced at every step."""

    steps: int = 200_000
    """Number of environment steps, over all environments."""
    num_envs: int = 8
    """Number of parallel environments."""
    num_agents: int = 6
    """Number of agents around the ego, on average."""
    replaced: float = 0.2
    """Share of the agents that is replaced at each step."""
    checkpoint: str = "highway"
    """Forecaster: shipped name, folder or run folder."""
    horizon_steps: int = 2
    """Number of steps to forecast; only observing keeps memory, and short forecasts leave more time for it."""
    measurements: int = 200
    """Number of measurements of memory over the run."""
    out: Path | None = None
    """JSON file to write the result to."""

    def __post_init__(self) -> None:
        """Checks ranges.

        Raises:
            UserError: a value is out of range.
        """
        check_at_least(self, 1, "steps", "num_envs", "num_agents", "horizon_steps", "measurements")
        if not 0 <= self.replaced <= 1:
            raise UserError(f"replaced must lie between 0 and 1, got {self.replaced}")
        least = 2 * self.measurements * self.num_envs
        if self.steps < least:
            raise UserError(f"steps must be at least {least} (2 · measurements · num_envs), got {self.steps}")
        check_out_file(self.out)


class Churning(gym.Env):
    """Road on which some agents vanish at each step and others appear, with ids never used before."""

    observation_space = gym.spaces.Box(-1, 1, (1,), np.float32)
    action_space = gym.spaces.Discrete(2)

    def __init__(self, agents: int, replaced: float) -> None:
        """Sets the mean number of agents around the ego and the share that is replaced at each step."""
        self._mean, self._replaced = agents, replaced
        self._next = 1

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Starts an episode with new agents."""
        super().reset(seed=seed)
        self.states, self.ids = np.array([[0.0, 4.0, 25.0, 0.0]]), np.array([0])
        self._enter(self._mean)
        return np.zeros(1, np.float32), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Moves all agents, replaces some, and ends the episode with probability 0.03."""
        self.states[:, :2] += self.states[:, 2:]
        stays = self.np_random.random(len(self.ids)) > self._replaced
        stays[0] = True
        self.states, self.ids = self.states[stays], self.ids[stays]
        self._enter(int(self.np_random.poisson(max(0.0, self._mean + 1 - len(self.ids)))))
        ended = bool(self.np_random.random() < 0.03)
        return np.zeros(1, np.float32), 0.0, ended, False, {}

    def _enter(self, count: int) -> None:
        near = self.np_random.normal(size=(count, 4)) * (30, 4, 3, 0.1) + self.states[0] * (1, 0, 1, 0)
        self.states = np.concatenate([self.states, near])
        self.ids = np.concatenate([self.ids, self._next + np.arange(count)])
        self._next += count


def read(env: gym.Env) -> Scene:
    """Returns the scene of all agents on the road."""
    inner: Any = env.unwrapped
    return Scene(inner.states.copy(), inner.ids.astype(np.int64), np.ones(len(inner.ids), dtype=np.bool_))


def resident_bytes() -> int:
    """Returns the resident memory of this process [bytes]."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096


def main() -> None:
    """Runs the command."""
    config = parse(ChurnConfig, __doc__)
    torch.set_num_threads(1)
    _, info = load_checkpoint(config.checkpoint)
    spec: SceneSpec = info.spec
    reader = FunctionReader(read, spec)
    venv = VecForecast(
        DummyVecEnv(
            [lambda: SceneObservation(Churning(config.num_agents, config.replaced), reader=reader)] * config.num_envs
        ),
        config.checkpoint,
        horizon_steps=config.horizon_steps,
    )
    venv.seed(0)
    venv.reset()
    actions = np.zeros(config.num_envs, dtype=np.int64)
    measured: list[tuple[int, int]] = []
    tensors: list[int] = []
    began = time.perf_counter()
    vector_steps = config.steps // config.num_envs
    for step in track(range(vector_steps), "churn"):
        observations: Any = venv.step(actions)[0]
        if not all(np.isfinite(value).all() for value in observations.values()):
            raise UserError(f"step {step}: an observation is not finite")
        if (step + 1) % (vector_steps // config.measurements) == 0:
            gc.collect()
            measured.append((step + 1, resident_bytes()))
            tensors.append(sum(type(thing) is torch.Tensor for thing in gc.get_objects()))
    late = measured[len(measured) // 4 :]
    at, resident = np.array(late, dtype=np.float64).T
    slope = float(np.polyfit(at, resident, 1)[0])
    online = venv.stream._online
    seen = sum(env.unwrapped._next for env in venv.unwrapped.envs)  # type: ignore[attr-defined]
    print(
        f"{config.steps} steps in {config.num_envs} environments, {seen} agents, "
        f"{config.steps / (time.perf_counter() - began):.0f} steps/s: resident memory {late[0][1] / 2**20:.1f} to "
        f"{late[-1][1] / 2**20:.1f} MiB after a quarter of the run, slope {slope:.3f} bytes per vector step; "
        f"tensors alive {tensors[0]} then {tensors[-1]}; slots {online._ids.shape}, all observations finite"
    )
    if config.out is not None:
        content = {"slope_bytes_per_step": slope, "memory": measured, "tensors": tensors, "agents": seen}
        write_json(config.out, content | {"provenance": provenance(("stable-baselines3", "torch", "numpy"))})


if __name__ == "__main__":
    run_entry_point(main)
