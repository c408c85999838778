"""Forecasters that follow a world beside the deployed stream: controls, ablations, several checkpoints at once."""

import functools

import numpy as np

from predictor.checkpoint import load_forecaster
from predictor.forecaster import Forecaster
from predictor.online import OnlineForecaster
from predictor.scene import Forecast, Scene, SceneBatch, SceneSpec


class SideForecaster:
    """Forecaster of the scenes of one world, with all history or the last `history_steps` only.

    A deep copy continues on its own from the same history and noise, and shares the weights. A forecaster with an ego
    gets an ego that is not valid where the scenes have none.

    Args:
        forecaster: any forecaster of such scenes.
        spec: layout of the scenes.
        horizon_steps: number of steps to forecast.
        history_steps: number of steps to which the memory is limited; 0 keeps all.
        samples: number of forecasts.
        seed: random seed of the samples.
    """

    def __init__(
        self,
        forecaster: Forecaster,
        spec: SceneSpec,
        horizon_steps: int,
        history_steps: int = 0,
        samples: int = 1,
        seed: int = 0,
    ) -> None:
        """Starts with empty memory."""
        self._front = int(forecaster.spec.has_ego and not spec.has_ego)
        self._online = OnlineForecaster(forecaster, 1, spec.max_agents + self._front)
        self._horizon, self._limit, self._samples = horizon_steps, history_steps, samples
        self._noise = [np.random.default_rng([seed, samples])]
        self._recent: list[SceneBatch] = []

    def __call__(self, scene: Scene) -> Forecast:
        """Observes the next scene and forecasts it."""
        self.observe(scene)
        return self.forecast()

    def observe(self, scene: Scene) -> None:
        """Observes the next scene, padded."""
        batch = SceneBatch.stack([scene.behind_absent(self._front)])
        if self._limit:
            self._recent = [*self._recent, batch][-self._limit :]
            self._online.reset()
            for past in self._recent:
                self._online.observe(past)
        else:
            self._online.observe(batch)

    def forecast(self) -> Forecast:
        """Forecasts the latest scene, agents as in it; dense."""
        forecast = self._online.forecast(self._horizon, self._samples, self._noise)
        return forecast.without_first(self._front)


@functools.lru_cache(maxsize=8)
def kept_forecaster(checkpoint: str, spec: SceneSpec, source: str) -> Forecaster:
    """Returns the forecaster of a checkpoint (`predictor.checkpoint.load_forecaster`), loaded once in a process."""
    return load_forecaster(checkpoint, spec, source)
