"""A user's own environment with a plan model and a reader that knows no bodies: "tests.envs.own_plans:Planned-v0"."""

from typing import Any

import gymnasium as gym
import numpy as np

from envs.plans import Plans, register_plan_model
from envs.readers import FunctionReader, register_reader
from predictor.scene import SceneSpec
from tests.envs.semantics import DT_S, Crowd, read_crowd

SPEC = SceneSpec(dt_s=DT_S, feature_scales=(10.0, 10.0, 1.0, 1.0), perception_m=1000.0, max_agents=8)


class Planned(Crowd):
    """A crowd whose ego has crashed as soon as it moves downwards, by its second action."""

    def __init__(self) -> None:
        super().__init__(duration=30)

    def step(self, action: Any) -> Any:
        *others, _ = super().step(action)
        return *others, {"hit": bool(action[1] < -0.5)}


class Mute(Planned):
    """Reports no crashes."""


class Uncopied(Planned):
    """Refuses to be copied."""

    def __deepcopy__(self, memo: Any) -> Any:
        raise TypeError("cannot pickle 'Socket' object")


class UpAndDown:
    """Two plans."""

    names = ("up", "down")

    def plans(self, env: gym.Env, horizon_steps: int) -> Plans:
        """Returns plans that go straight on, each with one action throughout."""
        x, y, vx, vy = env.unwrapped.people[0].state  # type: ignore[attr-defined]
        times = DT_S * np.arange(1, horizon_steps + 1)
        straight = np.stack([x + vx * times, y + vy * times, 0 * times + vx, 0 * times + vy], axis=-1)
        actions = tuple(np.array([0, push], dtype=np.float32) for push in (1, -1))
        later = tuple((action,) * (horizon_steps - 1) for action in actions)
        return Plans(np.stack([straight] * 2), actions, size_m=(0.5, 0.5), later_actions=later)


for kind in (Planned, Mute, Uncopied):
    crash_key = None if kind is Mute else "hit"
    register_reader(kind, FunctionReader(read_crowd, SPEC), crash_key=crash_key)
    register_plan_model(kind, lambda env: UpAndDown())
    gym.register(f"{kind.__name__}-v0", kind)
gym.register("Short-v0", Planned, max_episode_steps=9)
