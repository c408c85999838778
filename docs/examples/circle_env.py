"""A robot crosses a square that people cross too: a crowd as in studies of crowd navigation, written from scratch.

People start on a circle, each on the way to the opposite side, and are pushed away from whom they come near (a social
force); the robot is one of those whom they avoid. It imports gymnasium and nothing of this project: `circle_reader.py`
is all that it takes to see its agents.
"""

from typing import Any

import gymnasium as gym
import numpy as np

DT_S, RADIUS_M, BODY_M, ROBOT_MPS, LIMIT_S = 0.25, 5.0, 0.3, 1.2, 20.0


class CircleEnv(gym.Env):
    """Choose one of eight directions, or stand still, until the robot has crossed or touched someone."""

    def __init__(self, people: int = 6, courtesy: float = 1.0, render_mode: str | None = None) -> None:
        """Say how many people there are, and how much they mind the robot (0: they do not see it)."""
        if people < 1:
            raise ValueError(f"people must be at least 1, got {people}")
        self.people, self.courtesy = people, courtesy
        boxes = {"robot": gym.spaces.Box(-50.0, 50.0, (6,)), "people": gym.spaces.Box(-50.0, 50.0, (people, 4))}
        self.observation_space = gym.spaces.Dict(boxes)
        self.action_space = gym.spaces.Discrete(9)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict, dict]:
        """Put the robot at the bottom of the circle and the people around it."""
        super().reset(seed=seed)
        self.time_s = 0.0
        self.robot, self.goal = np.array([0.0, -RADIUS_M, 0.0, 0.0]), np.array([0.0, RADIUS_M])
        gaps = 2 * np.pi / (self.people + 1)
        angles = -np.pi / 2 + gaps * np.arange(1, self.people + 1) + self.np_random.uniform(-0.2, 0.2, self.people)
        places = RADIUS_M * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        self.goals = -places + self.np_random.normal(0.0, 0.5, places.shape)
        self.pace = self.np_random.uniform(0.7, 1.5, (self.people, 1))
        self.walkers = np.hstack([places, self._wishes(places)])
        return self._observe(), {}

    def step(self, action: int) -> tuple[dict, float, bool, bool, dict]:
        """Move everybody by DT_S."""
        before = np.linalg.norm(self.robot[:2] - self.goal)
        way = np.array([np.cos(action * np.pi / 4), np.sin(action * np.pi / 4)]) if action < 8 else np.zeros(2)
        self.robot[2:] = ROBOT_MPS * way
        pull = (self._wishes(self.walkers[:, :2]) - self.walkers[:, 2:]) / 0.5
        self.walkers[:, 2:] += (pull + self._pushes()) * DT_S
        self.walkers[:, 2:] *= np.minimum(1.0, 2.0 / np.linalg.norm(self.walkers[:, 2:], axis=1, keepdims=True))
        for bodies in (self.robot[None], self.walkers):
            bodies[:, :2] += bodies[:, 2:] * DT_S
        self.time_s += DT_S
        gap = np.linalg.norm(self.walkers[:, :2] - self.robot[:2], axis=1).min() - 2 * BODY_M
        left = np.linalg.norm(self.robot[:2] - self.goal)
        outcome = {"collided": bool(gap < 0), "reached": bool(left < BODY_M) and gap >= 0}
        reward = float(before - left) - 10.0 * outcome["collided"] + 5.0 * outcome["reached"] - 0.05
        return self._observe(), reward, any(outcome.values()), self.time_s >= LIMIT_S, {"outcome": outcome}

    def _wishes(self, places: np.ndarray) -> np.ndarray:
        way = self.goals - places
        return self.pace * way / np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1.0)

    def _pushes(self) -> np.ndarray:
        others = np.vstack([self.robot, self.walkers])[:, :2]
        away = self.walkers[:, None, :2] - others
        distance = np.linalg.norm(away, axis=-1, keepdims=True)
        force = 4.0 * np.exp((2 * BODY_M - distance) / 0.4) * away / np.maximum(distance, 1e-6)
        force[:, 0] *= self.courtesy
        return force.sum(axis=1)

    def _observe(self) -> dict[str, np.ndarray]:
        seen = {"robot": np.concatenate([self.robot, self.goal - self.robot[:2]]), "people": self.walkers - self.robot}
        return {name: values.astype(np.float32) for name, values in seen.items()}


gym.register("Circle-v0", "circle_env:CircleEnv")
