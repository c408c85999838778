"""A plan model of one's own: what the robot of `crossing_env.py` could do next, in 20 lines with imports."""

import numpy as np

from envs.plans import Plans

DT_S = 0.25


class CrossingPlans:
    """Coast, brake or accelerate towards the other wall."""

    names = ("coast", "brake", "go")

    def plans(self, env, horizon_steps):
        """Returns states, first actions, and what the environment's reward would be."""
        state, push, path = np.tile(env.unwrapped.robot, (3, 1)), np.array([0.0, -1.0, 1.0]), []
        actions = tuple(np.array([-state[0, 2], p], dtype=np.float32).clip(-1, 1) for p in push)
        for _ in range(horizon_steps):  # sideways it comes to rest, as by these actions
            change = np.stack([np.clip(-state[:, 2], -1, 1), push], axis=1)
            state[:, 2:] = np.clip(state[:, 2:] + change * DT_S, -2, 2)
            state[:, :2] = np.clip(state[:, :2] + state[:, 2:] * DT_S, [-8, -5], [8, 5])
            path.append(state.copy())
        states = np.stack(path, axis=1)
        rewards = states[..., 3] * DT_S
        return Plans(states, actions, rewards, np.full_like(rewards, -10.0), size_m=(0.5, 0.5))
