"""Scenes of parallel environments through one forecaster: each environment with its own history and its own noise."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor

from predictor.forecaster import Forecaster
from predictor.online import OnlineForecaster
from predictor.scene import Forecast, SceneBatch
from predictor.support.config_checks import check_at_least
from predictor.support.runtime import resolve_device

NOISE_STREAM = 0x6E6F697365
"""Sets the samples' noise apart from what environment and drivers draw from the same seed."""


@dataclass(frozen=True)
class ForecastConfig:
    """How a forecast enters the observation."""

    horizon_steps: int | None = None
    """Steps to forecast; None takes what the checkpoint was trained for."""
    num_samples: int = 1
    """Sampled futures per agent; 1 gives the most likely one and drops the axis."""
    device: str = "cpu"
    """Where the forecaster runs: cpu, cuda or auto."""
    seed: int = 0
    """Seeds the samples' noise of environment i with seed + i, until a reset gives another seed."""
    flatten: bool = False
    """One Box instead of a Dict, in the Dict's key order."""

    def __post_init__(self) -> None:
        """Check ranges; `device="auto"` becomes the device that is taken."""
        check_at_least(self, 1, "num_samples", "horizon_steps")
        check_at_least(self, 0, "seed")
        object.__setattr__(self, "device", resolve_device(self.device))


class SceneStream:
    """Takes in a scene of each environment per step and forecasts all of them in one batch.

    A deep copy or a pickle continues exactly; a deep copy shares the forecaster, which no step changes.

    Args:
        forecaster: lives on `config.device`.
        envs: number of parallel environments.
        agents: agents of each scene, padding included.
        config: how the forecast enters the observation.

    Attributes:
        config: as given.
        horizon_steps: steps of a forecast.
        scenes: the latest scene of each environment; None before the first.
        forecast: the forecast from it, in the same order: of environments whose episode just ended, the one that
            opens the next episode, as `scenes`.
    """

    def __init__(self, forecaster: Forecaster, envs: int, agents: int, config: ForecastConfig) -> None:
        """Start with empty memory."""
        self.config = config
        self.horizon_steps = config.horizon_steps or forecaster.horizon_steps
        self.scenes: SceneBatch | None = None
        self.forecast: Forecast | None = None
        self._online = OnlineForecaster(forecaster, envs, agents, config.device)
        self._noise: list[np.random.Generator] = [_noise(config.seed + env) for env in range(envs)]

    @property
    def forecaster(self) -> Forecaster:
        """The network, or what stands in for it."""
        return self._online.forecaster

    @property
    def num_envs(self) -> int:
        """Number of parallel environments."""
        return len(self._noise)

    def forecast_of(self, env: int) -> Forecast | None:
        """Returns the latest forecast of one environment, a batch of one; None before the first."""
        return None if self.forecast is None else _changed(lambda field: field[env : env + 1], self.forecast)

    def continue_noise(self, streams: "Sequence[SceneStream]") -> None:
        """Let each environment draw on from where the stream that had it alone stands."""
        self._noise = [stream._noise[0] for stream in streams]

    def seed(self, seed: int | Sequence[int | None]) -> None:
        """Restart the samples' noise: of environment i from seed + i, or from its entry unless that is None."""
        seeds = [seed + env for env in range(len(self._noise))] if isinstance(seed, int | np.integer) else seed
        for env, own in enumerate(seeds):
            if own is not None:
                self._noise[env] = _noise(own)

    def reset(self, envs: Int[np.ndarray, " some"] | None = None) -> None:
        """Forget the history of some environments (all, if None)."""
        self._online.reset(envs)

    def take(self, scenes: SceneBatch, envs: Int[np.ndarray, " some"] | None = None) -> Forecast:
        """Take in one scene for each environment (of `envs`, if given); returns their forecasts."""
        self._online.observe(self._given(scenes), envs)
        forecast = self._forecast_for(np.arange(len(self._noise)) if envs is None else envs)
        if envs is None:
            self.scenes, self.forecast = scenes, forecast
        else:
            self._keep_some(scenes, forecast, envs)
        return forecast

    def take_boundary(self, scenes: SceneBatch, ended: Int[np.ndarray, " ended"], successors: SceneBatch) -> Forecast:
        """As `take`, with the last scenes of ended episodes; forecasts of their successors follow at the end."""
        self._online.observe_boundary(self._given(scenes), ended, self._given(successors))
        both = np.arange(len(scenes) + len(ended))
        both[len(scenes) :] = ended
        forecast = self._forecast_for(both)
        kept = np.arange(len(scenes))
        kept[ended] = len(scenes) + np.arange(len(ended))
        index = torch.from_numpy(kept).to(forecast.xy.device)
        self.scenes = SceneBatch.concatenate(scenes, successors)[kept]
        self.forecast = _changed(lambda field: field[index], forecast)
        return forecast

    def _forecast_for(self, envs: Int[np.ndarray, " entries"]) -> Forecast:
        """The forecasts of what was taken in last; an ended episode draws before its successor does."""
        noise = [self._noise[env] for env in envs]
        return self._shown(self._online.forecast(self.horizon_steps, self.config.num_samples, noise))

    def _given(self, scenes: SceneBatch) -> SceneBatch:
        """The scenes as the forecaster wants them."""
        return scenes

    def _shown(self, forecast: Forecast) -> Forecast:
        """The forecast as it belongs to the scenes that were given."""
        return forecast

    def _keep_some(self, scenes: SceneBatch, forecast: Forecast, envs: Int[np.ndarray, " some"]) -> None:
        count, index = len(self._noise), torch.from_numpy(np.asarray(envs, dtype=np.int64)).to(forecast.xy.device)
        before = self.forecast or _changed(lambda field: field.new_zeros(count, *field.shape[1:]), forecast)
        self.forecast = _changed(lambda old, new: old.index_copy(0, index, new), before, forecast)
        arrays = []
        for field in fields(SceneBatch):
            new = getattr(scenes, field.name)
            blank = np.zeros((count, *new.shape[1:]), new.dtype)
            arrays.append(blank if self.scenes is None else getattr(self.scenes, field.name).copy())
            arrays[-1][envs] = new
        self.scenes = SceneBatch(*arrays)


def _noise(seed: int) -> np.random.Generator:
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(NOISE_STREAM,)))


def _changed(change: Callable[..., Tensor], *forecasts: Forecast) -> Forecast:
    """A forecast whose every tensor is changed, together with those of other forecasts."""
    changed: dict[str, Any] = {}
    for field in fields(Forecast):
        tensors = [getattr(forecast, field.name) for forecast in forecasts]
        changed[field.name] = None if tensors[0] is None else change(*tensors)
    return Forecast(**changed)
