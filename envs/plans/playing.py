"""True futures: plays plans of the ego in a copy of the running simulator and reports where every agent goes.

This is what a perfect forecaster would say: the copy has the simulator's state and random streams, so that the others
do in it exactly what they will do if the ego takes the plan's actions. It is the upper bound of what forecasts can
bring, for measurements; an agent in the world has no such copy. Of several learners: `envs.plans.keeping_on`.
"""

import pickle
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from highway_env.envs.common.abstract import AbstractEnv
from highway_env.envs.common.observation import LidarObservation, OccupancyGridObservation
from jaxtyping import Float

from envs.plans.base import Plans
from envs.readers.base import SceneReader, show
from envs.readers.highway import HighwayReader
from envs.simulators.copies import RunningCopy, running_copy
from predictor.scene import Forecast, Scene, SceneBatch
from predictor.support.errors import UserError

_DRAWN = (LidarObservation, OccupancyGridObservation)
"""Observations that cost more than a step of traffic; they draw no random numbers and change nothing."""


class _Copyable(RunningCopy, gym.Wrapper[Any, Any, Any, Any]):
    """Wrapper whose copies go on exactly."""


def with_true_futures(
    plans: Plans, env: gym.Env, reader: SceneReader, scene: Scene, played: int | None = None, over: bool = False
) -> Plans:
    """Returns the plans with the positions of all agents of the scene when they are played.

    An agent that leaves, or that the simulator no longer steps because the episode is over, goes on at its last
    velocity.

    Args:
        plans: plans with the actions of every step.
        env: the environment, which is not changed.
        reader: its reader, which is not changed.
        scene: scene that the reader has just read.
        played: number of plans that are played, the first ones; None plays all.
        over: whether the episode is over.

    Raises:
        UserError: the plans lack later actions, or the environment cannot be copied.
    """
    if plans.later_actions is None:
        raise UserError("true futures need plans with later_actions, the actions of every step after the first")
    actions = [(first, *later) for first, later in zip(plans.actions, plans.later_actions, strict=True)][:played]
    return replace(plans, true_xy=np.stack([_played(env, reader, scene, each, over) for each in actions]))


def as_forecast(
    true_xy: Float[np.ndarray, "batch plans agents horizon 2"], scenes: SceneBatch, like: Forecast
) -> Forecast:
    """Returns a forecast that says the true positions and nothing of their spread.

    Args:
        true_xy: positions of all agents of each scene for each plan [m], world frame.
        scenes: the scenes.
        like: a forecast of them, for everything else.
    """
    local = (true_xy - scenes.states[:, None, :1, None, :2]) * scenes.valid[:, None, :, None, None]
    positions = torch.from_numpy(local.astype(np.float32)).to(like.xy.device)
    return replace(like, xy=positions[:, :, None], mode_probs=None, xy_scale=None)


def followed(scene: Scene, dt_s: float, moments: Iterable[Scene | None]) -> Float[np.ndarray, "agents horizon 2"]:
    """Returns where the agents of a scene are in each of the next moments [m], world frame.

    Args:
        scene: scene before the first moment.
        dt_s: time between moments [s].
        moments: all agents at each; an agent that is missing goes on at its last velocity, at a None all do.
    """
    place_of = {int(agent): i for i, agent in enumerate(scene.ids) if scene.valid[i]}
    states = np.where(scene.valid[:, None], scene.states, 0.0)
    xy_m = []
    for now in moments:
        states = states.copy()
        states[:, :2] += dt_s * states[:, 2:4]
        if now is not None:
            for agent, state, valid in zip(now.ids, now.states, now.valid, strict=True):
                if valid and (place := place_of.get(int(agent))) is not None:
                    states[place] = state
        xy_m.append(states[:, :2])
    return np.stack(xy_m, axis=1)


def _played(
    env: gym.Env, reader: SceneReader, scene: Scene, actions: tuple[Any, ...], over: bool
) -> Float[np.ndarray, "agents horizon 2"]:
    """Returns where each agent of the scene goes while the ego takes these actions."""
    try:
        copied, reader = running_copy((_Copyable(env), reader), env.unwrapped)
    except (TypeError, pickle.PicklingError) as error:  # an open file, a lock
        raise UserError(
            f"the environment cannot be copied, which true futures need: {error}; leave out the wrapper that holds it, "
            "or put it outside"
        ) from error
    env = copied.env
    goes_on = isinstance(env.unwrapped, AbstractEnv)  # highway-env simulates on after the end of an episode
    if goes_on and isinstance(reader, HighwayReader):  # which reads no observations
        _leave_undrawn(env.unwrapped)

    def moments() -> Iterator[Scene | None]:
        ended = over and not goes_on
        for action in actions:
            if ended:
                yield None
                continue
            if goes_on:
                _go_on(env)
            observation, _, terminated, truncated, _ = env.step(action)
            show(reader, observation)
            ended = bool(terminated or truncated) and not goes_on
            yield reader.read_all(env)

    return followed(scene, reader.spec.dt_s, moments())


def _go_on(env: gym.Env) -> None:
    """Lets wrappers that count an episode's end (Stable-Baselines3's `Monitor`) step on."""
    while isinstance(env, gym.Wrapper):
        if "needs_reset" in vars(env):
            env.needs_reset = False  # type: ignore[attr-defined]
        env = env.env


def _leave_undrawn(copy: Any) -> None:
    """Makes a copy of highway-env return zeros in place of a costly observation, which nobody reads."""
    observation_type = copy.observation_type
    if isinstance(observation_type, _DRAWN):
        space = observation_type.space()
        observation_type.observe = np.zeros(space.shape, space.dtype).copy
