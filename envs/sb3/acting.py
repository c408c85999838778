"""Most likely actions of a policy through episodes; a recurrent policy keeps its state until an episode ends."""

import copy
from typing import Any

import numpy as np
from jaxtyping import Bool
from stable_baselines3.common.base_class import BaseAlgorithm


class ActingPolicy:
    """Policy that acts step by step, in one environment or in several parallel ones.

    Each episode needs a new one, or `starts`. Copies (`copy.deepcopy`) share the policy and have a state of their own.

    Args:
        policy: policy to act with.

    Example:
        >>> from stable_baselines3 import PPO
        >>> model = PPO("MlpPolicy", "CartPole-v1", n_steps=4, batch_size=4)
        >>> act = ActingPolicy(model)
        >>> act(np.zeros((2, 4), np.float32), starts=np.ones(2, bool)).shape
        (2,)
    """

    def __init__(self, policy: BaseAlgorithm) -> None:
        """Begins without a state."""
        self._policy = policy
        self._state: Any = None

    def __call__(self, observations: Any, starts: Bool[np.ndarray, " envs"] | None = None) -> Any:
        """Returns the action of one observation, or those of a batch.

        Args:
            observations: one observation, or a batch of them.
            starts: which observations of a batch are the first of an episode, so that nothing is remembered; None if
                none is, apart from those of the first call.
        """
        actions, self._state = self._policy.predict(observations, self._state, starts, deterministic=True)
        return actions

    def __deepcopy__(self, memo: dict[int, Any]) -> "ActingPolicy":
        """Returns a copy that shares the policy."""
        copied = ActingPolicy(self._policy)
        copied._state = copy.deepcopy(self._state, memo)
        return copied
