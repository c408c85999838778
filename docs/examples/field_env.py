"""Runners on a field, each towards a place of its own: a PettingZoo environment as third parties write them.

It imports gymnasium and PettingZoo and nothing of this project; `field_reader.py` is all that it takes to see its
agents.
"""

from typing import Any

import gymnasium as gym
import numpy as np
from pettingzoo import ParallelEnv

DT_S, RUNNERS, STEPS = 0.2, 3, 40


class FieldEnv(ParallelEnv):
    """Accelerate [m/s²] each runner to its place; runners that come close slow each other down."""

    metadata = {"name": "field_v0"}

    def __init__(self) -> None:
        """Name the runners."""
        self.possible_agents = [f"runner_{i}" for i in range(RUNNERS)]
        self.agents: list[str] = []
        self.seen = {a: gym.spaces.Box(-np.inf, np.inf, (6,), np.float32) for a in self.possible_agents}
        self.pushes = {a: gym.spaces.Box(-1.0, 1.0, (2,), np.float32) for a in self.possible_agents}
        self.rng = np.random.default_rng()

    def observation_space(self, agent: str) -> gym.Space:
        """Where the runner is, how fast, and where its place is."""
        return self.seen[agent]

    def action_space(self, agent: str) -> gym.Space:
        """Acceleration along x and y."""
        return self.pushes[agent]

    def reset(self, seed: int | None = None, options: Any = None) -> tuple[dict, dict]:
        """Put the runners and their places anywhere; without a seed, go on with the random numbers of before."""
        if seed is not None:
            self.rng = np.random.default_rng(seed)
        rng = self.rng
        self.time, self.agents = 0, list(self.possible_agents)
        self.bodies = {a: np.concatenate([rng.uniform(-8, 8, 2), rng.normal(size=2)]) for a in self.agents}
        self.places = {a: rng.uniform(-8, 8, 2) for a in self.agents}
        return self._seen(), {a: {} for a in self.agents}

    def step(self, actions: dict[str, Any]) -> tuple[dict, dict, dict, dict, dict]:
        """Move every runner by DT_S."""
        self.time += 1
        for agent, push in actions.items():
            body = self.bodies[agent]
            near = sum(np.linalg.norm(body[:2] - other[:2]) < 1.0 for other in self.bodies.values()) - 1
            body[2:] = np.clip((body[2:] + np.asarray(push) * DT_S) * 0.8**near, -3.0, 3.0)
            body[:2] += body[2:] * DT_S
        rewards = {a: -float(np.linalg.norm(self.bodies[a][:2] - self.places[a])) for a in self.agents}
        seen, infos = self._seen(), {a: {} for a in self.agents}
        ended, over = dict.fromkeys(self.agents, False), dict.fromkeys(self.agents, self.time == STEPS)
        self.agents = [] if self.time == STEPS else self.agents
        return seen, rewards, ended, over, infos

    def _seen(self) -> dict[str, np.ndarray]:
        return {a: np.concatenate([self.bodies[a], self.places[a]]).astype(np.float32) for a in self.agents}
