"""Forecasts for many environments of an SB3 VecEnv, with one batched forward per step.

Each environment keeps its own history; the history is cleared when, and only when, its own episode ends. The
observation that closes an episode carries the forecast made from that episode's history; the one that opens the next
starts from one step. `envs.vector` serves gymnasium's vector environments.
"""

import inspect
from collections.abc import Sequence
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from envs.forecast_wrapper import ForecastWrapper, ObservationLayout, refuse_reader, refuse_what_if
from envs.observation import (
    ForecastStream,
    common_value,
    observe_ended,
    open_forecaster,
    require_scenes,
    scenes_from,
)
from envs.readers import MakeReader
from envs.scene_stream import ForecastConfig
from predictor.forecaster import Forecaster
from predictor.scene import SceneBatch

_CLASS_NOTES = "class_attributes"


class VecForecast(ForecastWrapper, VecEnvWrapper):
    """`ForecastObservation` for an SB3 VecEnv that reports scenes: of `SceneObservation`s, or an `EnvPoolVecEnv`.

        >>> from stable_baselines3.common.env_util import make_vec_env
        >>> from envs.wrappers import SceneObservation
        >>> venv = make_vec_env("highway-fast-v0", n_envs=8, wrapper_class=SceneObservation)
        >>> venv = VecForecast(venv, "highway")

    After each step, `scene` and `forecast` hold, in the world frame, what `observations[i]` shows of environment i.

    Args:
        venv: SB3 vector environment (Dummy or Subproc) of environments in `SceneObservation`, or an `EnvPoolVecEnv`.
        checkpoint: shipped name, folder, or "constant-velocity"; None takes the one that ships for the env's id.
        horizon_steps: number of steps to forecast; None takes the checkpoint's.
        num_samples: number of sampled futures per agent.
        flatten: whether observations are one Box instead of a Dict.
        device: device of the forecaster.
        forecaster: forecaster on `device`, instead of a checkpoint.
        seed: random seed of the samples' noise: environment i gets seed + i, until `seed(…)` gives others.
        reader: refused, because the environments report their scenes; give it to `SceneObservation`.
        what_if: refused, because plans are made from the running environment; see `ForecastObservation`.

    Raises:
        UserError: the environments report no scenes, differ from each other, or do not fit the forecaster.
    """

    def __init__(
        self,
        venv: VecEnv,
        checkpoint: str | None = None,
        *,
        horizon_steps: int | None = None,
        num_samples: int = 1,
        flatten: bool = False,
        device: str = "cpu",
        forecaster: Forecaster | None = None,
        seed: int = 0,
        reader: MakeReader | None = None,
        what_if: bool = False,
    ) -> None:
        """Loads the forecaster and extends the observation space."""
        refuse_reader(reader, "VecForecast")
        refuse_what_if(what_if, "VecForecast")
        space = require_scenes(venv.observation_space, "VecForecast")
        spec = common_value(venv.get_attr("scene_spec"), "scene spec")
        source = common_value(venv.get_attr("scene_source"), "env id")
        config = ForecastConfig(horizon_steps, num_samples, device, seed, flatten)
        forecaster = open_forecaster(checkpoint, spec, source, device, forecaster)
        self.stream: ForecastStream = ForecastStream(forecaster, spec, venv.num_envs, config)
        self._layout = ObservationLayout(space["observation"], self.stream.spaces(), flatten)
        VecEnvWrapper.__init__(self, venv, observation_space=self._layout.space)

    def __getstate__(self) -> dict[str, Any]:
        """Returns the state of a copy or a pickle, without VecEnvWrapper's notes on its class, which do not pickle."""
        return {name: value for name, value in super().__getstate__().items() if name != _CLASS_NOTES}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restores a copy or a pickle."""
        super().__setstate__({**state, _CLASS_NOTES: dict(inspect.getmembers(type(self)))})

    @property
    def scene(self) -> SceneBatch:
        """Latest scene of each environment, world frame, ego first."""
        return self._scenes()

    def reset(self) -> Any:
        """Resets all environments and clears all histories."""
        observations: Any = self.venv.reset()
        self.stream.reset()
        return self._layout.batch(observations["observation"], self.stream.observe(scenes_from(observations)))

    def step_wait(self) -> VecEnvStepReturn:
        """Steps; one batched forward serves running episodes, terminal observations and new episodes."""
        observations: Any
        observations, rewards, dones, step_infos = self.venv.step_wait()
        infos = list(step_infos)  # a tuple, with SubprocVecEnv
        ended = np.flatnonzero(dones)
        closing = [infos[i]["terminal_observation"] for i in ended]
        entries, closing_entries = observe_ended(self.stream, observations, ended, closing)
        for i, last, extra in zip(ended, closing, closing_entries, strict=True):
            infos[i]["terminal_observation"] = self._layout.one(last["observation"], extra)
        return self._layout.batch(observations["observation"], entries), rewards, dones, infos

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Seeds the environments and their samples' noise; None leaves the noise as it is."""
        seeds = self.venv.seed(seed)
        if seed is not None:
            self.stream.seed(seeds)
        return seeds
