"""A robot crosses a corridor among walkers who steer around each other: an environment as third parties write them.

It imports gymnasium and nothing of this project; `crossing_reader.py` is all that it takes to see its agents.
"""

from typing import Any

import gymnasium as gym
import numpy as np

DT_S, LENGTH_M, WIDTH_M, ROWS = 0.25, 20.0, 10.0, 9


class CrossingEnv(gym.Env):
    """Accelerate [m/s²] a robot from one wall to the other; touching a walker ends the episode.

    Observation: ROWS rows (presence, x, y, vx, vy), the robot's first; walkers, nearest first, relative to it.
    """

    def __init__(self) -> None:
        """Set the spaces."""
        self.observation_space = gym.spaces.Box(-LENGTH_M, LENGTH_M, (ROWS, 5), np.float32)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """Put the robot at one wall and some walkers on their way."""
        super().reset(seed=seed)
        self.robot = np.array([0.0, -WIDTH_M / 2, 0.0, 0.0])
        self.walkers = np.zeros((0, 4))  # x, y, vx, vy
        self.wishes = np.zeros((0, 2))  # the velocity each would like
        self.numbers = np.zeros(0, dtype=int)
        self.entered = 0
        for _ in range(6):
            self._enter(x=self.np_random.uniform(-0.4, 0.4) * LENGTH_M)
        return self._observe(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        """Move everybody by DT_S."""
        self.robot[2:] = np.clip(self.robot[2:] + np.asarray(action) * DT_S, -2.0, 2.0)
        self.robot[:2] = np.clip(self.robot[:2] + self.robot[2:] * DT_S, [-8.0, -WIDTH_M / 2], [8.0, WIDTH_M / 2])
        self.walkers[:, 2:] = np.clip(self.walkers[:, 2:] + self._accelerations() * DT_S, -2.5, 2.5)
        self.walkers[:, :2] += self.walkers[:, 2:] * DT_S
        inside = (np.abs(self.walkers[:, :2]) <= [LENGTH_M / 2, WIDTH_M / 2]).all(axis=1)
        self.walkers, self.wishes, self.numbers = self.walkers[inside], self.wishes[inside], self.numbers[inside]
        if self.np_random.random() < 0.3:
            self._enter(x=self.np_random.choice([-0.5, 0.5]) * LENGTH_M)
        touched = bool((np.linalg.norm(self.walkers[:, :2] - self.robot[:2], axis=1) < 0.5).any())
        arrived = bool(self.robot[1] >= WIDTH_M / 2)
        reward = float(self.robot[3] * DT_S) - 10.0 * touched
        return self._observe(), reward, touched or arrived, False, {"touched": touched, "arrived": arrived}

    def _enter(self, x: float) -> None:
        side = np.sign(x) if abs(x) == LENGTH_M / 2 else self.np_random.choice([-1.0, 1.0])
        wish = [-side * self.np_random.uniform(0.8, 1.6), 0.0]
        y = self.np_random.uniform(-0.3, 0.4) * WIDTH_M
        self.walkers = np.vstack([self.walkers, [x, y, *wish]])
        self.wishes = np.vstack([self.wishes, wish])
        self.numbers = np.append(self.numbers, self.entered)
        self.entered += 1

    def _accelerations(self) -> np.ndarray:
        away = self.walkers[:, None, :2] - np.vstack([self.robot, self.walkers])[:, :2]
        distance = np.linalg.norm(away, axis=-1, keepdims=True) + 1e-6
        steer = (away / distance * 6.0 * np.exp(-distance)).sum(axis=1)
        return (self.wishes - self.walkers[:, 2:]) / 0.5 + steer

    def _observe(self) -> np.ndarray:
        rows = np.zeros((ROWS, 5), dtype=np.float32)
        rows[0] = [1.0, *self.robot]
        relative = self.walkers - self.robot
        nearest = np.argsort(np.linalg.norm(relative[:, :2], axis=1))[: ROWS - 1]
        rows[1 : 1 + len(nearest), 0] = 1.0
        rows[1 : 1 + len(nearest), 1:] = relative[nearest]
        return rows


gym.register("Crossing-v0", "crossing_env:CrossingEnv", max_episode_steps=60)
