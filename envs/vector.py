"""Forecasts for many environments, one batched forward per step: `VecForecast` (SB3), `VectorForecast` (gymnasium).

Each row keeps its own history and forgets it when, and only when, its own episode ends. The observation that closes an
episode carries the forecast made from that episode's history; the one that opens the next starts from one step.
"""

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from envs.observation import (
    ForecastConfig,
    ForecastStream,
    open_forecaster,
    require_scenes,
    scenes_from,
)
from predictor.errors import UserError
from predictor.forecaster import Forecaster
from predictor.scene import SceneBatch, SceneSpec

Observations = dict[str, NDArray[Any]]


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
        spec = _one(venv.get_attr("scene_spec"), "scene spec")
        source = _one(venv.get_attr("scene_source"), "env id")
        config = ForecastConfig(horizon_steps, num_samples, device, seed)
        forecaster = forecaster or open_forecaster(checkpoint, spec, source, device)
        self.stream = ForecastStream(forecaster, spec, venv.num_envs, config)
        super().__init__(venv, observation_space=_forecast_space(space, self.stream))

    def reset(self) -> Any:
        """Reset all environments and forget all histories."""
        observations: Any = self.venv.reset()
        self.stream.reset()
        return _join(observations, self.stream.observe(scenes_from(observations)))

    def step_wait(self) -> VecEnvStepReturn:
        """Step; one batched forward serves running rows, terminal observations and fresh episodes."""
        observations: Any
        observations, rewards, dones, step_infos = self.venv.step_wait()
        infos = list(step_infos)  # a tuple, with SubprocVecEnv
        ended = np.flatnonzero(dones)
        closing = [infos[i]["terminal_observation"] for i in ended]
        entries, closing_entries = _observe_ended(self.stream, observations, ended, closing)
        for i, own, extra in zip(ended, closing, closing_entries, strict=True):
            infos[i]["terminal_observation"] = _join(own, extra)
        return _join(observations, entries), rewards, dones, infos

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Seed the environments and the samples' noise."""
        if seed is not None:
            self.stream.seed(seed)
        return self.venv.seed(seed)


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
        spec: SceneSpec = _one(env.get_attr("scene_spec"), "scene spec")  # type: ignore[attr-defined]
        source: str = _one(env.get_attr("scene_source"), "env id")  # type: ignore[attr-defined]
        config = ForecastConfig(horizon_steps, num_samples, device)
        self.stream = ForecastStream(open_forecaster(checkpoint, spec, source, device), spec, env.num_envs, config)
        self.single_observation_space = _forecast_space(space, self.stream)
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
        return _join(observations, {key: value.copy() for key, value in self._entries.items()}), infos

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step; one batched forward for all rows."""
        observations, rewards, terminations, truncations, infos = self.env.step(actions)
        ended = np.asarray(terminations | truncations)
        if self._mode is AutoresetMode.SAME_STEP:
            rows = np.flatnonzero(ended)
            closing = [infos["final_obs"][i] for i in rows]
            entries, closing_entries = _observe_ended(self.stream, observations, rows, closing)
            for i, own, extra in zip(rows, closing, closing_entries, strict=True):
                infos["final_obs"][i] = _join(own, extra)
        else:
            if self._mode is AutoresetMode.NEXT_STEP:
                self.stream.reset(np.flatnonzero(self._ended))
            entries = self.stream.observe(scenes_from(observations))
        # copies: a later reset writes into the rows that it opens
        self._ended, self._entries = ended, {key: value.copy() for key, value in entries.items()}
        return _join(observations, entries), rewards, terminations, truncations, infos


def _observe_ended(
    stream: ForecastStream, observations: Observations, ended: NDArray[np.int64], closing: list[Observations]
) -> tuple[Observations, list[Observations]]:
    """Forecast entries for each row, and for each closing observation from the old episode's history."""
    opening = scenes_from(observations)
    if not len(ended):
        return dict(stream.observe(opening)), []
    scenes = SceneBatch(*(field.copy() for field in (opening.states, opening.ids, opening.valid, opening.heading_rad)))
    for row, last in zip(ended, closing, strict=True):
        scenes.states[row], scenes.ids[row] = last["scene_states"], last["scene_ids"]
        scenes.valid[row], scenes.heading_rad[row] = last["scene_valid"], last["scene_heading_rad"][0]
    both = stream.observe_boundary(scenes, ended, opening[ended])
    rows = len(opening)
    of_closing = {key: value[ended] for key, value in both.items()}
    for value in both.values():
        value[ended] = value[rows:]
    entries = {key: value[:rows] for key, value in both.items()}
    return entries, [{key: value[i] for key, value in of_closing.items()} for i in range(len(ended))]


def _join(observations: Observations, entries: Observations) -> Observations:
    return {"observation": observations["observation"], **entries}


def _forecast_space(space: gym.spaces.Dict, stream: ForecastStream) -> gym.spaces.Dict:
    return gym.spaces.Dict({"observation": space["observation"], **stream.spaces()})


def _one(values: Any, what: str) -> Any:
    if any(value != values[0] for value in values):
        raise UserError(f"all environments must have the same {what}, got {sorted({str(v) for v in values})}")
    return values[0]
