"""Forecasts for many environments of an SB3 VecEnv, with one batched forward per step.

Each environment keeps its own history; the history is cleared when, and only when, its own episode ends. The
observation that closes an episode carries the forecast made from that episode's history; the one that opens the next
starts from one step. `envs.vector` has the same for gymnasium's vector environments.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from envs.observation import (
    ForecastConfig,
    ForecastStream,
    common_value,
    forecast_space,
    observe_ended,
    open_forecaster,
    require_scenes,
    scenes_from,
    with_forecast,
)
from predictor.forecaster import Forecaster


class VecForecast(VecEnvWrapper):
    """`ForecastObservation` for an SB3 VecEnv whose environments are wrapped in `SceneObservation`.

        >>> from stable_baselines3.common.env_util import make_vec_env
        >>> from envs.wrappers import SceneObservation
        >>> venv = make_vec_env("highway-fast-v0", n_envs=8, wrapper_class=SceneObservation)
        >>> venv = VecForecast(venv, "highway")

    Args:
        venv: SB3 vector environment (Dummy or Subproc).
        checkpoint: shipped name, folder, or "constant-velocity"; None takes the one that ships for the env's id.
        horizon_steps: steps to forecast; None takes the checkpoint's.
        num_samples: sampled futures per agent.
        device: where the forecaster runs.
        seed: of the samples' noise.
        forecaster: use this one instead of loading `checkpoint`.

    Raises:
        UserError: the envs report no scenes, differ from each other, or do not fit the checkpoint.
    """

    def __init__(
        self,
        venv: VecEnv,
        checkpoint: str | None = None,
        *,
        horizon_steps: int | None = None,
        num_samples: int = 1,
        device: str = "cpu",
        seed: int = 0,
        forecaster: Forecaster | None = None,
    ) -> None:
        """Load the forecaster and extend the observation space."""
        space = require_scenes(venv.observation_space, "VecForecast")
        spec = common_value(venv.get_attr("scene_spec"), "scene spec")
        source = common_value(venv.get_attr("scene_source"), "env id")
        config = ForecastConfig(horizon_steps, num_samples, device, seed)
        forecaster = forecaster or open_forecaster(checkpoint, spec, source, device)
        self.stream = ForecastStream(forecaster, spec, venv.num_envs, config)
        super().__init__(venv, observation_space=forecast_space(space, self.stream))

    def reset(self) -> Any:
        """Reset all environments and forget all histories."""
        observations: Any = self.venv.reset()
        self.stream.reset()
        return with_forecast(observations, self.stream.observe(scenes_from(observations)))

    def step_wait(self) -> VecEnvStepReturn:
        """Step; one batched forward serves running rows, terminal observations and fresh episodes."""
        observations: Any
        observations, rewards, dones, step_infos = self.venv.step_wait()
        infos = list(step_infos)  # a tuple, with SubprocVecEnv
        ended = np.flatnonzero(dones)
        closing = [infos[i]["terminal_observation"] for i in ended]
        entries, closing_entries = observe_ended(self.stream, observations, ended, closing)
        for i, own, extra in zip(ended, closing, closing_entries, strict=True):
            infos[i]["terminal_observation"] = with_forecast(own, extra)
        return with_forecast(observations, entries), rewards, dones, infos

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Seed the environments and the samples' noise."""
        if seed is not None:
            self.stream.seed(seed)
        return self.venv.seed(seed)
