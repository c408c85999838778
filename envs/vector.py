"""Forecasts for many environments, one batched forward per step: `VecForecast` (SB3), `VectorForecast` (gymnasium).

Each row keeps its own history and forgets it when, and only when, its own episode ends. The observation that closes an
episode carries the forecast made from that episode's history; the one that opens the next starts from one step.
"""

import importlib
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from envs.observation import (
    ForecastConfig,
    ForecastStream,
    Observations,
    common_value,
    forecast_space,
    observe_ended,
    open_forecaster,
    require_scenes,
    scenes_from,
    with_forecast,
)
from predictor.scene import SceneSpec

if TYPE_CHECKING:
    from envs.sb3.forecast import VecForecast  # noqa: F401  (an alias at run time)


def __getattr__(name: str) -> Any:
    """Finds `VecForecast`, which stood here before it moved to `envs.sb3.forecast`; only then SB3 is imported."""
    if name == "VecForecast":
        return importlib.import_module("envs.sb3.forecast").VecForecast
    raise AttributeError(f"module '{__name__}' has no attribute '{name}'")


class VectorForecast(gym.vector.VectorWrapper):
    """`ForecastObservation` for a gymnasium vector env whose environments are wrapped in `SceneObservation`.

    Knows both autoreset modes and no autoreset: with NEXT_STEP the closing observation is the step's own and the next
    step opens the new episode; with SAME_STEP the closing observation is `infos["final_obs"]`; with DISABLED, rows
    are forgotten when `reset(options={"reset_mask": …})` names them.

    Args:
        env: gymnasium vector environment.
        checkpoint: shipped name, folder, or "constant-velocity"; None takes the one that ships for the env's id.
        horizon_steps: steps to forecast; None takes the checkpoint's.
        num_samples: sampled futures per agent.
        device: where the forecaster runs.

    Raises:
        UserError: the envs report no scenes, differ from each other, or do not fit the checkpoint.
    """

    def __init__(
        self,
        env: gym.vector.VectorEnv,
        checkpoint: str | None = None,
        *,
        horizon_steps: int | None = None,
        num_samples: int = 1,
        device: str = "cpu",
    ) -> None:
        """Load the forecaster and extend the observation space."""
        super().__init__(env)
        space = require_scenes(env.single_observation_space, "VectorForecast")
        spec: SceneSpec = common_value(env.get_attr("scene_spec"), "scene spec")  # type: ignore[attr-defined]
        source: str = common_value(env.get_attr("scene_source"), "env id")  # type: ignore[attr-defined]
        config = ForecastConfig(horizon_steps, num_samples, device)
        self.stream = ForecastStream(open_forecaster(checkpoint, spec, source, device), spec, env.num_envs, config)
        self.single_observation_space = forecast_space(space, self.stream)
        self.observation_space = batch_space(self.single_observation_space, env.num_envs)
        self._mode = env.metadata.get("autoreset_mode", AutoresetMode.NEXT_STEP)
        self._ended = np.zeros(env.num_envs, dtype=np.bool_)
        self._entries: Observations = {}

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Reset all environments, or those of `options["reset_mask"]`, and forget their histories."""
        mask = (options or {}).get("reset_mask")
        observations, infos = self.env.reset(seed=seed, options=options)  # type: ignore[arg-type]
        rows = np.arange(self.num_envs) if mask is None else np.flatnonzero(mask)
        self.stream.reset(rows)
        seeds = [s for s in (seed if isinstance(seed, list) else [seed]) if s is not None]
        if mask is None and seeds:
            self.stream.seed(seeds[0])
        self._ended[rows] = False
        # A partial reset repeats the other rows' observations, which were taken in already and must not count twice.
        entries = self.stream.observe(scenes_from(observations)[rows], rows)
        for key, value in entries.items():
            self._entries.setdefault(key, np.zeros((self.num_envs, *value.shape[1:]), value.dtype))[rows] = value
        return with_forecast(observations, {key: value.copy() for key, value in self._entries.items()}), infos

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step; one batched forward for all rows."""
        observations, rewards, terminations, truncations, infos = self.env.step(actions)
        ended = np.asarray(terminations | truncations)
        if self._mode is AutoresetMode.SAME_STEP:
            rows = np.flatnonzero(ended)
            closing = [infos["final_obs"][i] for i in rows]
            entries, closing_entries = observe_ended(self.stream, observations, rows, closing)
            for i, own, extra in zip(rows, closing, closing_entries, strict=True):
                infos["final_obs"][i] = with_forecast(own, extra)
        else:
            if self._mode is AutoresetMode.NEXT_STEP:
                self.stream.reset(np.flatnonzero(self._ended))
            entries = self.stream.observe(scenes_from(observations))
        # copies: a later reset writes into the rows that it opens
        self._ended, self._entries = ended, {key: value.copy() for key, value in entries.items()}
        return with_forecast(observations, entries), rewards, terminations, truncations, infos
