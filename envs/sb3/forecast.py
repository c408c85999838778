"""Forecasts for many environments of an SB3 VecEnv, with one batched forward per step.

Each environment keeps its own history; the history is cleared when, and only when, its own episode ends. The
observation that closes an episode carries the forecast made from that episode's history; the one that opens the next
starts from one step. `envs.vector` serves gymnasium's vector environments.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from envs.arms import Arm, arm_of
from envs.forecast_wrapper import ForecastWrapper, ObservationLayout, refuse_reader
from envs.kinds import require_kind
from envs.observation import (
    ForecastStream,
    common_value,
    observe_ended,
    open_forecaster,
    require_scenes,
    require_scenes_of,
    scenes_from,
)
from envs.own_observation import own_part
from envs.plans import PlanModel
from envs.plans.batch import PLANS_INFO, PlanBatch, ask_for_plans
from envs.readers import MakeReader
from envs.sb3.copies import with_notes, without_notes
from envs.scene_stream import NOISE_SEED_INFO, ForecastConfig
from predictor.forecaster import Forecaster
from predictor.scene import SceneBatch

_WITH_SCENES = "make them with make_vec_env(..., wrapper_class=SceneObservation)"
_WITH_READER = "for example with wrapper_kwargs={'reader': ...} of make_vec_env"


class VecForecast(ForecastWrapper, VecEnvWrapper):
    """`ForecastObservation` for an SB3 VecEnv that reports scenes: of `SceneObservation`s, or an `EnvPoolVecEnv`.

        >>> from stable_baselines3.common.env_util import make_vec_env
        >>> from envs.wrappers import SceneObservation
        >>> venv = make_vec_env("highway-fast-v0", n_envs=8, wrapper_class=SceneObservation)
        >>> venv = VecForecast(venv, "highway")

    After each step, `scene` (world frame) and `forecast` (world axes, relative to each ego's position) hold what
    `observations[i]` shows of environment i.

    Args:
        venv: SB3 vector environment (Dummy or Subproc) of environments in `SceneObservation`, or an `EnvPoolVecEnv`.
        checkpoint: shipped name, folder, "constant-velocity", or any `Forecaster` on `device`; None takes the
            checkpoint that ships for the env's id.
        horizon_steps: number of steps to forecast; None takes the checkpoint's.
        num_samples: number of sampled futures per agent.
        flatten: whether observations are one Box instead of a Dict.
        device: device of the forecaster.
        forecaster: forecaster on `device`, instead of a checkpoint; the same as giving it as `checkpoint`.
        seed: random seed of the samples' noise: environment i gets seed + i, until `seed(…)` gives others, or the infos
            of a reset (`NOISE_SEED_INFO`) that of an episode.
        reader: refused, because the environments report their scenes; give it to `SceneObservation`.
        what_if: whether observations also hold what the others are forecast to do for each candidate plan of the ego,
            as in `ForecastObservation`. True takes the environments' plan model; or a `PlanModel`, of which each
            process in which environments run has one.
        arm: part of the forecast that observations show, for controlled comparisons (`envs.arms`, docs/arms.md).

    Attributes:
        plan_names: names of the candidate plans; none without `what_if`, but of an arm that plays plans.

    Raises:
        UserError: no VecEnv; the environments report no scenes, differ from each other,
            or do not fit the forecaster; no plan model for `what_if=True`.
    """

    def __init__(
        self,
        venv: VecEnv,
        checkpoint: str | Path | Forecaster | None = None,
        *,
        horizon_steps: int | None = None,
        num_samples: int = 1,
        flatten: bool = False,
        device: str = "cpu",
        forecaster: Forecaster | None = None,
        seed: int = 0,
        reader: MakeReader | None = None,
        what_if: bool | PlanModel = False,
        arm: Arm | None = None,
    ) -> None:
        """Loads the forecaster and extends the observation space."""
        require_kind(venv, (VecEnv, "a Stable-Baselines3 VecEnv (make_vec_env)"), "VecForecast")
        refuse_reader(reader, "VecForecast", _WITH_READER)
        space = require_scenes(venv.observation_space, "VecForecast", _WITH_SCENES)
        spec = common_value(venv.get_attr("scene_spec"), "scene spec")
        require_scenes_of(spec, space, "VecForecast")
        source = common_value(venv.get_attr("scene_source"), "env id")
        forecaster = open_forecaster(checkpoint, spec, source, device, forecaster)
        steps = horizon_steps or forecaster.horizon_steps
        arm = arm_of(arm)
        self.plan_names = ask_for_plans(
            venv.env_method, what_if, steps, "VecForecast", venv.unwrapped, arm.plays(bool(what_if))
        )
        num_plans = len(self.plan_names) if what_if else 0
        config = ForecastConfig(horizon_steps, num_samples, device, seed, flatten, num_plans=num_plans, arm=arm)
        self.stream: ForecastStream = ForecastStream(forecaster, spec, venv.num_envs, config)
        self._layout = ObservationLayout(own_part(space), self.stream.spaces(), flatten)
        VecEnvWrapper.__init__(self, venv, observation_space=self._layout.space)

    def __getstate__(self) -> dict[str, Any]:
        """Returns the state of a copy or a pickle, without VecEnvWrapper's notes on its class, which do not pickle."""
        return without_notes(super().__getstate__())

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restores a copy or a pickle."""
        super().__setstate__(with_notes(type(self), state))

    @property
    def scene(self) -> SceneBatch:
        """Latest scene of each environment, world frame, ego first."""
        return self._scenes()

    def reset(self) -> Any:
        """Resets all environments and clears all histories."""
        observations: Any = self.venv.reset()
        self.stream.reset()
        self.stream.seed(self._noise_seeds(range(self.num_envs)))
        plans = PlanBatch.from_infos(self.venv.unwrapped.reset_infos) if self.plan_names else None
        entries = self.stream.observe(scenes_from(observations), plans=plans)
        return self._layout.batch(observations, entries)

    def step_wait(self) -> VecEnvStepReturn:
        """Steps; one batched forward serves running episodes, terminal observations and new episodes."""
        observations: Any
        observations, rewards, dones, step_infos = self.venv.step_wait()
        infos = list(step_infos)  # a tuple, with SubprocVecEnv
        ended = np.flatnonzero(dones)
        closing = [infos[i]["terminal_observation"] for i in ended]
        plans = self._plans(infos, ended) if self.plan_names else None
        entries, closing_entries = observe_ended(
            self.stream, observations, ended, closing, plans, self._noise_seeds(ended)
        )
        for i, last, extra in zip(ended, closing, closing_entries, strict=True):
            infos[i]["terminal_observation"] = self._layout.one(last, extra)
        return self._layout.batch(observations, entries), rewards, dones, infos

    def _plans(self, infos: list[dict[str, Any]], ended: NDArray[np.int64]) -> PlanBatch:
        """Returns the plans of a step, those of closing observations in their places; takes them out of the infos."""
        latest, opening = PlanBatch.from_infos(infos), self.venv.unwrapped.reset_infos
        for i, info in enumerate(infos):
            infos[i] = {key: value for key, value in info.items() if key != PLANS_INFO}
        if not len(ended):
            return latest
        return latest.followed_by(PlanBatch.from_infos([opening[i] for i in ended]))

    def _noise_seeds(self, envs: range | NDArray[np.int64]) -> list[int | None]:
        """Returns the seeds of the noise of the episodes that just began, where the environments gave one."""
        return [self.venv.unwrapped.reset_infos[env].get(NOISE_SEED_INFO) for env in envs]

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Seeds the environments and their samples' noise; None leaves the noise as it is."""
        seeds = self.venv.seed(seed)
        if seed is not None:
            self.stream.seed(seeds)
        return seeds
