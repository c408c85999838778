"""A plan model of one's own: what the robot of `crossing_env.py` could do next, in 20 lines with imports."""

import numpy as np

from envs.plans import Plans

DT_S = 0.25


class CrossingPlans:
    """Coast, brake or accelerate towards the other wall."""

    names = ("coast", "brake", "go")

    def plans(self, env, horizon_steps):
        """Returns states, first actions, and what the environment's reward would be."""
        x, y, vx, vy = env.unwrapped.robot
        push = np.array([0.0, -1.0, 1.0])
        v = np.clip(vy + push[:, None] * DT_S * np.arange(1, horizon_steps + 1), -2.0, 2.0)
        states = np.stack([np.full_like(v, x), y + np.cumsum(v * DT_S, axis=1), 0 * v, v], axis=-1)
        actions = tuple(np.array([-vx, p], dtype=np.float32).clip(-1, 1) for p in push)
        return Plans(states, actions, rewards=v * DT_S, crash_rewards=np.full_like(v, -10.0), size_m=(0.5, 0.5))
