"""A policy drives by its own forecasts while others are measured: its wrapper is below, what it shows is kept aside.

The wrapper above then sees the environment's own observation, as if there were no other.
"""

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
from pettingzoo.utils import BaseParallelWrapper

from envs.own_observation import space_without_added, without_added


class OwnView(gym.Wrapper[Any, Any, Any, Any]):
    """Shows the environment's own observation of an env with forecasts.

    Attributes:
        whole: latest observation with forecasts, which the driver gets.
    """

    takes_out_forecasts = True

    def __init__(self, env: gym.Env) -> None:
        """Wraps an environment with forecasts."""
        super().__init__(env)
        self.observation_space = space_without_added(env.observation_space)
        self.whole: Any = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Resets the env."""
        self.whole, info = self.env.reset(seed=seed, options=options)
        return without_added(self.whole), info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Steps the env."""
        self.whole, *rest = self.env.step(action)
        return without_added(self.whole), *rest


class OwnParallelView(BaseParallelWrapper):
    """Shows each agent the environment's own observation of a PettingZoo env with forecasts.

    Attributes:
        whole: latest observations with forecasts, by agent, which the driver gets.
    """

    takes_out_forecasts = True

    def __init__(self, env: Any) -> None:
        """Wraps an environment with forecasts."""
        super().__init__(env)
        self.whole: Mapping[str, Any] = {}

    def observation_space(self, agent: str) -> gym.Space:
        """Returns the space of the agent's own observation."""
        return space_without_added(self.env.observation_space(agent))

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Resets the env."""
        self.whole, infos = self.env.reset(seed=seed, options=options)
        return {agent: without_added(seen) for agent, seen in self.whole.items()}, infos

    def step(
        self, actions: dict[str, Any]
    ) -> tuple[dict[str, Any], dict[str, Any], dict[str, Any], dict[str, Any], dict[str, Any]]:
        """Steps the env."""
        self.whole, *rest = self.env.step(actions)
        return {agent: without_added(seen) for agent, seen in self.whole.items()}, *rest


def own_view(env: Any) -> Any:
    """Returns the `OwnView` or `OwnParallelView` below a wrapper; None if there is none."""
    while not isinstance(env, OwnView | OwnParallelView):
        if not isinstance(env, gym.Wrapper | BaseParallelWrapper):
            return None
        env = env.env
    return env
