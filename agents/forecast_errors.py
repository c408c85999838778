"""Measures, during a training, the forecasts that the policy acts on: it meets other scenes as it learns."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper

from envs.observation import ForecastStream
from envs.rollouts.loop_errors import LoopErrors
from envs.sb3.forecast import VecForecast

FORECAST_ERROR, CONSTANT_ERROR = "forecast_error_m", "constant_velocity_error_m"
"""Names of the errors in TensorBoard and in the curve."""


class ForecastErrors(BaseCallback):
    """Compares the forecasts of a `VecForecast` with what then happens; other environments have no errors.

    Args:
        before: what `sums` returned when the training was stopped.
    """

    def __init__(self, before: Mapping[str, list[Any]] | None = None) -> None:
        """Finds the forecasts when the training starts."""
        super().__init__()
        self._before = before
        self._stream: ForecastStream | None = None
        self._errors: LoopErrors | None = None

    def begin(self) -> None:
        """Begins with the present scenes, as all environments were reset; keeps what was compared before."""
        stream = None if self.model.env is None else _stream_of(self.model.env)
        if stream is None or stream.scenes is None or stream.forecast is None:
            return
        self._stream = stream
        if self._errors is None:
            self._errors = LoopErrors(stream.horizon_steps, stream.scene_spec.dt_s)
            if self._before:
                self._errors.go_on(self._before)
        self._errors.drop_pending()
        self._errors.add(stream.scenes, np.zeros(stream.num_envs, dtype=bool), stream.scenes, stream.forecast)

    def sums(self) -> dict[str, list[Any]]:
        """Returns what was compared since the last call of `scalars`, as content of JSON."""
        return {} if self._errors is None else self._errors.sums()

    def scalars(self) -> dict[str, float]:
        """Returns the mean errors [m] since the last call, of the forecasts and of constant velocity."""
        found = None if self._errors is None else self._errors.errors_m()
        return {} if found is None else dict(zip((FORECAST_ERROR, CONSTANT_ERROR), found, strict=True))

    def _on_training_start(self) -> None:
        self.begin()

    def _on_step(self) -> bool:
        stream = self._stream
        if self._errors is not None and stream is not None:
            assert stream.seen is not None and stream.scenes is not None and stream.forecast is not None
            self._errors.add(stream.seen, self.locals["dones"], stream.scenes, stream.forecast)
        return True


def _stream_of(venv: VecEnv) -> ForecastStream | None:
    """Returns the forecasts of the outermost `VecForecast`; None if there is none."""
    while isinstance(venv, VecEnvWrapper):
        if isinstance(venv, VecForecast):
            return venv.stream
        venv = venv.venv
    return None
