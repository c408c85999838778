"""Environments that raise, hang, die or return NaN at one step of some seeds, read like any third party's.

Registered ids are `tests.envs.misbehaving:KIND-v0`, with a kind of `KINDS`. Multiples of three misbehave as seeds, at
step `AT_STEP`; with the kinds that end in "Reset", at the reset.
"""

import os
import signal
import time
from typing import Any

import gymnasium as gym
import numpy as np

from envs.readers import register_reader
from envs.readers.function import FunctionReader
from predictor.scene import Scene, SceneSpec

AT_STEP, NUM_STEPS = 2, 5
KINDS = (
    "Fine", "Raise", "RaiseReset", "Hang", "HangReset", "Exit", "ExitReset", "Kill", "NanState", "NanObservation",
    "NanReward", "Slow",
)  # fmt: skip
HERE = f"{__name__}:"


def env_id(kind: str) -> str:
    """Returns the id of a kind."""
    return f"{HERE}{kind}-v0"


class Misbehaving(gym.Env[np.ndarray, np.int64]):
    """Two agents on a line; the reward is 1 for action 1."""

    observation_space = gym.spaces.Box(-100, 100, (3,), np.float32)
    action_space = gym.spaces.Discrete(2)

    def __init__(self, kind: str = "Fine") -> None:
        self.kind = kind

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self._bad = seed is not None and seed % 3 == 0
        self.steps = 0
        self.states = np.array([[0.0, 0.0, 1.0, 0.0], [5.0, float(self.np_random.normal()), 1.0, 0.0]])
        if self.kind.endswith("Reset"):
            self._misbehave(self.kind.removesuffix("Reset"))
        return self._look(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.steps += 1
        self.states[:, 0] += 1.0
        if self.kind == "Slow":
            time.sleep(0.2)
        reward = float(int(action) == 1)
        if self.steps == AT_STEP:
            self._misbehave(self.kind)
            if self._bad and self.kind == "NanReward":
                reward = float("nan")
        return self._look(), reward, False, self.steps == NUM_STEPS, {}

    def _misbehave(self, kind: str) -> None:
        if not self._bad:
            return
        if kind == "Raise":
            raise RuntimeError("the simulator\nbroke")
        if kind == "Hang":
            time.sleep(10_000)
        if kind == "Exit":
            os._exit(3)
        if kind == "Kill":
            os.kill(os.getpid(), signal.SIGKILL)
        if kind == "NanState":
            self.states[1, 1] = np.nan

    def _look(self) -> np.ndarray:
        seen = np.array([self.states[1, 0], self.np_random.normal(), self.steps], dtype=np.float32)
        if self._bad and self.kind == "NanObservation" and self.steps == AT_STEP:
            seen[1] = np.nan
        return seen


def _read(env: gym.Env) -> Scene:
    states = env.unwrapped.states.copy()  # type: ignore[attr-defined]
    return Scene(states, np.arange(2), np.ones(2, dtype=bool))


SPEC = SceneSpec(dt_s=0.5, feature_scales=(10.0, 10.0, 1.0, 1.0), perception_m=50.0, max_agents=2)
register_reader(Misbehaving, FunctionReader(_read, SPEC))
for kind in KINDS:
    if f"{kind}-v0" not in gym.registry:
        gym.register(f"{kind}-v0", entry_point=Misbehaving, kwargs={"kind": kind})
