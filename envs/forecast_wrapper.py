"""Common base of all wrappers with forecasts: the layout of an observation, the latest forecast, and copies."""

from collections.abc import Mapping
from copy import deepcopy
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from envs.scene_stream import SceneStream
from predictor.forecaster import Forecaster
from predictor.scene import Forecast, SceneBatch
from predictor.support.errors import ProtocolError, UserError


class ForecastWrapper:
    """Base of `ForecastObservation`, `ForecastParallelEnv`, `VecForecast` and `VectorForecast`.

    A deep copy continues exactly as the original would, and shares only the forecaster, which no step changes. A pickle
    continues exactly too, and contains the forecaster's weights. An environment of highway-env that has been rendered
    cannot be pickled until it is closed (highway-env's window cannot); a copy can be made.

    Attributes:
        stream: history and noise of each environment.
    """

    stream: SceneStream

    @property
    def forecaster(self) -> Forecaster:
        """Forecaster of all environments."""
        return self.stream.forecaster

    @property
    def forecast(self) -> Forecast:
        """Forecast of the latest observation: one entry per environment, agents as in `scene`, world axes."""
        if self.stream.forecast is None:
            raise ProtocolError("there is no forecast yet; call reset() first")
        return self.stream.forecast

    def __deepcopy__(self, memo: dict[int, Any]) -> Any:
        """Returns a copy with its own environment, history and noise."""
        memo[id(self.forecaster)] = self.forecaster
        twin = object.__new__(type(self))
        memo[id(self)] = twin
        state: Any = self.__getstate__()
        twin.__setstate__(deepcopy(state, memo))
        return twin

    def __getstate__(self) -> dict[str, Any]:
        """Returns the state of a copy or a pickle."""
        state: Any = super().__getstate__()
        return dict(state)

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restores a copy or a pickle; defined here, because wrappers look missing attributes up in what they wrap."""
        restore = getattr(super(), "__setstate__", self.__dict__.update)
        restore(state)

    def unflatten(self, observation: NDArray[Any]) -> dict[str, NDArray[Any]]:
        """Returns the entries of an observation with `flatten=True`, of one environment or, with two axes, of many.

        Raises:
            UserError: observations are not flattened, or this one has another size.
        """
        layout: ObservationLayout = self._layout  # type: ignore[attr-defined]
        return layout.unflatten(observation)

    def _scenes(self) -> SceneBatch:
        """Returns the scenes of all environments of the latest observation."""
        if self.stream.scenes is None:
            raise ProtocolError("there is no scene yet; call reset() first")
        return self.stream.scenes


class ObservationLayout:
    """Layout of a policy's observation: the environment's own and the forecast entries, as a Dict or as one Box.

    Args:
        own: spaces of the entries that hold the environment's own observation (`envs.own_observation`).
        entries: spaces of the forecast entries.
        flatten: whether the observation is one Box, in the Dict's key order.

    Attributes:
        space: space of one observation.
        dict_space: space of one observation before it is flattened.
    """

    def __init__(self, own: Mapping[str, gym.Space], entries: Mapping[str, gym.Space], flatten: bool) -> None:
        """Builds the space."""
        self._own = tuple(own)
        self.dict_space = gym.spaces.Dict({**own, **entries})
        self._flatten = flatten
        self.space: gym.Space = gym.spaces.flatten_space(self.dict_space) if flatten else self.dict_space

    def one(self, observation: Mapping[str, Any], entries: Mapping[str, NDArray[Any]]) -> Any:
        """Returns one environment's observation: its own entries, out of `observation`, and the forecast entries."""
        full = self._full(observation, entries)
        return gym.spaces.flatten(self.dict_space, full) if self._flatten else full

    def batch(self, observations: Mapping[str, Any], entries: Mapping[str, NDArray[Any]]) -> Any:
        """Returns the observations of many environments, stacked."""
        full = self._full(observations, entries)
        if not self._flatten:
            return full
        return np.concatenate([_flattened(space, full[key]) for key, space in self.dict_space.spaces.items()], axis=1)

    def unflatten(self, observation: NDArray[Any]) -> dict[str, NDArray[Any]]:
        """Returns the entries of a flattened observation, or of many, stacked.

        Raises:
            UserError: observations are not flattened, or this one has another size.
        """
        if not self._flatten:
            raise UserError("observations are a Dict already; unflatten is for wrappers with flatten=True")
        sizes = [gym.spaces.flatdim(space) for space in self.dict_space.spaces.values()]
        flat = np.asarray(observation)
        if flat.ndim not in (1, 2) or flat.shape[-1] != sum(sizes):
            raise UserError(f"a flattened observation has {sum(sizes)} numbers, got an array of shape {flat.shape}")
        parts = np.split(np.atleast_2d(flat), np.cumsum(sizes)[:-1], axis=1)
        entries = {
            key: np.stack([np.asarray(gym.spaces.unflatten(space, row)) for row in part])
            for (key, space), part in zip(self.dict_space.spaces.items(), parts, strict=True)
        }
        return entries if flat.ndim == 2 else {key: value[0] for key, value in entries.items()}

    def _full(self, observation: Mapping[str, Any], entries: Mapping[str, NDArray[Any]]) -> dict[str, Any]:
        return {**{key: observation[key] for key in self._own}, **entries}


def _flattened(space: gym.Space, stacked: Any) -> NDArray[Any]:
    if isinstance(space, gym.spaces.Box):
        return np.asarray(stacked, space.dtype).reshape(len(stacked), -1)
    return np.stack([np.asarray(gym.spaces.flatten(space, one)) for one in stacked])


def unflatten(env: Any, observation: NDArray[Any], agent: str | None = None) -> dict[str, NDArray[Any]]:
    """Returns the entries of an observation that a wrapper with `flatten=True` has made; the inverse of flattening.

        >>> from envs import ForecastObservation, make_env
        >>> env = ForecastObservation(make_env("highway-fast-v0"), "constant-velocity", flatten=True)
        >>> observation, info = env.reset(seed=0)
        >>> unflatten(env, observation)["forecast"].shape
        (11, 5, 2)

    Args:
        env: environment in `ForecastObservation`, `VecForecast`, `VectorForecast` or `ForecastParallelEnv`, possibly in
            further wrappers that leave observations as they are.
        observation: one observation, or with two axes those of many environments.
        agent: name of the agent, in a PettingZoo environment.

    Raises:
        UserError: observations are not flattened, or this one has another size; no such wrapper; an agent is named
            outside PettingZoo, or none within.
    """
    if agent is not None and not hasattr(env, "possible_agents"):
        raise UserError(
            f"unflatten takes the name of an agent in PettingZoo environments alone, got {agent!r}; omit it"
        )
    try:
        get: Any = getattr(env, "get_wrapper_attr", None)
        found: Any = env.unflatten if get is None else get("unflatten")
    except AttributeError as error:
        raise UserError(f"unflatten needs an environment with forecasts, got {type(env).__name__}") from error
    entries: dict[str, NDArray[Any]] = found(observation) if agent is None else found(observation, agent)
    return entries


def refuse_twice(env: Any, kind: type, wrapper: str) -> None:
    """Checks that nothing inside of a wrapper adds forecasts already, which a flattened observation does not show.

    What is below a wrapper with `takes_out_forecasts` is not looked at: that one shows the environment's own
    observation.

    Args:
        env: environment that it wraps.
        kind: class of the wrappers of such environments.
        wrapper: its name, for the message.

    Raises:
        UserError: something does.
    """
    while isinstance(env, kind) and not getattr(type(env), "takes_out_forecasts", False):
        if isinstance(env, ForecastWrapper):
            name = type(env).__name__
            raise UserError(f"{wrapper} would add forecasts to those of {name} inside; leave one of them out")
        env = env.env  # type: ignore[attr-defined]


def refuse_reader(reader: Any, wrapper: str, how: str) -> None:
    """Raises a `UserError` if a wrapper whose environments report their scenes is given a reader; `how` to give it."""
    if reader is not None:
        raise UserError(
            f"{wrapper} takes no reader: its environments report their scenes, possibly from other processes; give "
            f"reader= to SceneObservation, {how}"
        )
