"""Most likely actions of a policy through episodes; a recurrent policy keeps its state until an episode ends."""

import copy
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from jaxtyping import Bool
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.preprocessing import is_image_space, is_image_space_channels_first
from stable_baselines3.common.vec_env import VecTransposeImage

from envs.own_observation import carries_forecasts, space_without_added, without_added
from envs.sb3.padded_spaces import PaddedObservation, learners_named, own_action, roles_of, shared_action
from predictor.support.errors import UserError


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


class ActingTeam:
    """Policy that acts for all learners of one PettingZoo environment, their observations padded as in training.

    An agent that leaves and comes back remembers nothing. Copies (`copy.deepcopy`) share the policy.

    Args:
        policy: policy to act with.
        env: environment whose observations it gets; a policy that was trained without forecasts may get some.
        names: names or roles of the learners; none stands for all agents.
        source: name of the policy, for messages.

    Attributes:
        actions: own action space of each learner, by name.

    Raises:
        UserError: a name is unknown, or the policy was trained on other observations or actions.
    """

    def __init__(self, policy: BaseAlgorithm, env: Any, names: Sequence[str], source: str) -> None:
        """Finds the padded spaces."""
        wanted: Any = policy.observation_space
        self._strips = not carries_forecasts(wanted)
        learners = learners_named(env.possible_agents, names, source)
        spaces = {agent: self._seen_space(env.observation_space(agent)) for agent in learners}
        self.actions: dict[str, gym.Space] = {agent: env.action_space(agent) for agent in learners}
        self._padded = PaddedObservation(spaces, roles_of(spaces, self.actions), None)
        if space_as_stored(self._padded.space) != wanted:
            raise UserError(f"{source} was trained on {_line(wanted)}, but the env gives {_line(self._padded.space)}")
        require_actions(policy, shared_action(self.actions), source)
        self._fresh = ActingPolicy(policy)
        self._acting: dict[str, ActingPolicy] = {}

    def __call__(self, observations: Mapping[str, Any]) -> dict[str, Any]:
        """Returns the own action of each learner among the observations of the agents that live."""
        for gone in self._acting.keys() - observations.keys():
            del self._acting[gone]
        chosen = {}
        for agent in (name for name in observations if name in self.actions):
            if agent not in self._acting:
                self._acting[agent] = copy.deepcopy(self._fresh)
            seen = without_added(observations[agent]) if self._strips else observations[agent]
            chosen[agent] = own_action(self._acting[agent](self._padded.one(agent, seen)), self.actions[agent])
        return chosen

    def forget(self) -> None:
        """Begins an episode: nothing is remembered."""
        self._acting = {}

    def _seen_space(self, space: gym.Space) -> gym.Space:
        return space_without_added(space) if self._strips else space


def require_actions(policy: BaseAlgorithm, space: gym.Space, source: str) -> None:
    """Raises a `UserError` if a policy, called `source` in the message, was trained with actions of other sizes."""
    trained: gym.Space = policy.action_space
    if sizes_of_space(trained) != sizes_of_space(space):
        raise UserError(f"{source} was trained with the actions {_line(trained)}, but the env takes {_line(space)}")


def sizes_of_space(space: gym.Space) -> Any:
    """Returns what must be equal for a policy to act in a space, or to read it."""
    if isinstance(space, gym.spaces.Discrete):
        return int(space.n)
    return space.nvec.tolist() if isinstance(space, gym.spaces.MultiDiscrete) else space.shape


def space_as_stored(space: gym.Space) -> gym.Space:
    """Returns the space that a policy has which was trained on another one: Stable-Baselines3 puts channels first.

    A policy takes observations of either; it moves the axes of images itself.
    """
    if isinstance(space, gym.spaces.Dict):
        return gym.spaces.Dict({key: space_as_stored(part) for key, part in space.items()})
    if isinstance(space, gym.spaces.Box) and is_image_space(space) and not is_image_space_channels_first(space):
        return VecTransposeImage.transpose_space(space)
    return space


def _line(space: gym.Space) -> str:
    return " ".join(str(space).split())
