"""Rewards that guide learning where those of the environment are rare; measurements never count them.

In mpe2's simple_tag a touch pays each predator 10, and of random predators' episodes hardly one in ten has one. `Chase`
adds a reward for each metre that a predator comes closer to its prey. Over an episode these sum to the difference
between first and last distance, so that circling or waiting pays nothing.
"""

from typing import Any

import numpy as np
from pettingzoo import ParallelEnv
from pettingzoo.utils import BaseParallelWrapper

from envs.readers.mpe import mpe_scenario

PER_METRE = 10.0
"""Reward for a metre closer to the prey: across the arena as much as for two touches."""
SHAPED = "simple_tag"
"""Scenario of mpe2 whose rewards are shaped."""


class Chase(BaseParallelWrapper):
    """Adds to each predator's reward how much closer it has come to the nearest prey.

    Args:
        env: mpe2's simple_tag, wrapped or not.
        per_metre: reward for each metre.
    """

    def __init__(self, env: ParallelEnv, per_metre: float = PER_METRE) -> None:
        """Wraps the environment."""
        super().__init__(env)
        self._per_metre = per_metre
        self._apart_m: dict[str, float] = {}

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict[str, Any], Any]:
        """Resets the environment and measures the distances."""
        observations, infos = self.env.reset(seed=seed, options=options)
        self._apart_m = self._distances()
        return observations, infos

    def step(
        self, actions: dict[str, Any]
    ) -> tuple[dict[str, Any], dict[str, Any], dict[str, Any], dict[str, Any], dict[str, Any]]:
        """Steps the environment and adds to the rewards."""
        observations, rewards, terminated, truncated, infos = self.env.step(actions)
        before, self._apart_m = self._apart_m, self._distances()
        closer = {name: before[name] - self._apart_m[name] for name in before}
        rewards = {name: reward + self._per_metre * closer.get(name, 0.0) for name, reward in rewards.items()}
        return observations, rewards, terminated, truncated, infos

    def _distances(self) -> dict[str, float]:
        """Returns the distance of each predator to the nearest prey [m]; nothing where there is none."""
        bodies = self.env.unwrapped.world.agents
        prey = [body.state.p_pos for body in bodies if not body.adversary]
        if not prey:
            return {}
        return {
            body.name: min(float(np.linalg.norm(place - body.state.p_pos)) for place in prey)
            for body in bodies
            if body.adversary
        }


def shaped(env: ParallelEnv) -> ParallelEnv:
    """Returns the environment with shaped rewards; itself, if it is not one whose rewards are rare."""
    return Chase(env) if mpe_scenario(env) == SHAPED else env
