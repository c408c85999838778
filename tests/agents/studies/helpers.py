"""Helpers of the tests of studies: an environment whose optimum is known, study files, made-up results."""

import os
import signal
import time
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from agents.studies.results import Result

TOY = f"{__name__}:Corridor-v0"
SLOW_TOY = f"{__name__}:SlowCorridor-v0"
DEADLY_TOY = f"{__name__}:DeadlyCorridor-v0"
NUM_STEPS = 6


class Corridor(gym.Env[np.ndarray, np.int64]):
    """Environment whose reward is 1 for the action that the observation shows, with noise in what is shown."""

    observation_space = gym.spaces.Box(-5, 5, (2,), np.float32)
    action_space = gym.spaces.Discrete(2)

    def __init__(self, sleep_s: float = 0.0) -> None:
        self.sleep_s = sleep_s

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self._steps = 0
        return self._look(), {"crashed": False, "speed": 1.0}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        time.sleep(self.sleep_s)
        self._steps += 1
        reward = float(int(action) == self._right)
        crashed = bool(self.np_random.random() < 0.05)
        return self._look(), reward, crashed, self._steps == NUM_STEPS, {"crashed": crashed, "speed": 1.0}

    def _look(self) -> np.ndarray:
        self._right = int(self.np_random.integers(2))
        shown = np.eye(2)[self._right] + self.np_random.normal(scale=0.5, size=2)
        return np.clip(shown, -5, 5).astype(np.float32)


class DeadlyCorridor(Corridor):
    """Corridor in which the first step kills the process, as a system without memory does."""

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        os.kill(os.getpid(), signal.SIGKILL)
        raise AssertionError("unreachable")


if "DeadlyCorridor-v0" not in gym.registry:
    gym.register("DeadlyCorridor-v0", entry_point=DeadlyCorridor)
for name, sleep_s in (("Corridor-v0", 0.0), ("SlowCorridor-v0", 0.004)):
    if name not in gym.registry:
        gym.register(name, entry_point=Corridor, kwargs={"sleep_s": sleep_s})

STUDY = """
title = "A corridor"
arms = ["none"]
algorithms = ["ppo"]
seeds = 2
steps = 512
num_envs = 1
episodes = 4
selections = 4
selection_episodes = 3
checkpoint_every = 128
references = ["random", "constant-actions"]

[scenarios.corridor]
env_id = "{env_id}"
"""


def study_text(env_id: str = TOY, **changes: str) -> str:
    """Returns a study of the corridor, with other values for some keys."""
    lines = STUDY.format(env_id=env_id).splitlines()
    for key, value in changes.items():
        kept = [line for line in lines if not line.startswith(f"{key} = ")]
        lines = [f"{key} = {value}", *kept] if key != "env_id" else kept
    return "\n".join(lines) + "\n"


def study_path(folder: Path, text: str) -> Path:
    """Writes a study file and returns its path."""
    path = folder / "corridor.toml"
    path.write_text(text)
    return path


def result(arm: str, returns: list[float], seed: int | None = None, scenario: str = "one", **changes: Any) -> Result:
    """Returns a result with these returns; a seed makes it one of a training, with two points of a curve."""
    trained = seed is not None
    episodes = [
        {"seed": i, "episode_return": value, "length": 10, "crashed": i == 0, "mean_speed_mps": 20.0,
         "action_counts": {"slower": 1, "faster": 1}}
        for i, value in enumerate(returns)
    ]  # fmt: skip
    curve = [{"steps": 100, "return": returns[0], "episodes": 1, "seconds": 6.0}] if trained else []
    curve += [{"steps": 200, "return": returns[-1], "episodes": 1, "seconds": 12.0}] if trained else []
    values: dict[str, Any] = {
        "scenario": scenario, "env_id": "toy-v0", "arm": arm, "algorithm": "ppo" if trained else None, "seed": seed,
        "episodes": tuple(episodes), "curve": tuple(curve), "train_seconds": 12.0 if trained else 0.0,
        "measure_seconds": 6.0, "provenance": {},
    }  # fmt: skip
    return Result(**(values | changes))
