"""Forecasts for many environments of a Gymnasium vector environment, with one batched forward per step.

Each environment keeps its own history; the history is cleared when, and only when, its own episode ends. The
observation that closes an episode carries the forecast made from that episode's history; the one that opens the next
starts from one step. `envs.sb3.forecast` serves Stable-Baselines3, which this module does not import.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from gymnasium.wrappers.vector import DictInfoToList

from envs.arms import Arm, arm_of
from envs.forecast_wrapper import ForecastWrapper, ObservationLayout, refuse_reader
from envs.kinds import VECTOR, require_kind
from envs.observation import (
    ForecastStream,
    Observations,
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
from envs.scene_stream import ForecastConfig
from predictor.forecaster import Forecaster
from predictor.scene import SceneBatch, SceneSpec
from predictor.support.errors import UserError

_WITH_SCENES = "make them with gym.make_vec(id, num_envs, wrappers=[SceneObservation])"
_WITH_READER = "with wrappers=[functools.partial(SceneObservation, reader=...)] of gym.make_vec"


class VectorForecast(ForecastWrapper, gym.vector.VectorWrapper):
    """`ForecastObservation` for a gymnasium vector env whose environments are wrapped in `SceneObservation`.

    Handles both autoreset modes and no autoreset: with NEXT_STEP the closing observation is the step's own and the next
    step opens the new episode; with SAME_STEP the closing observation is `infos["final_obs"]`; with DISABLED,
    histories are cleared when `reset(options={"reset_mask": …})` names their environments. After each step, `scene`
    (world frame) and `forecast` (world axes, relative to each ego's position) hold what `observations[i]` shows of
    environment i.

    Args:
        env: Gymnasium vector environment, wrapped or not.
        checkpoint: shipped name, folder, "constant-velocity", or any `Forecaster` on `device`; None takes the
            checkpoint that ships for the env's id.
        horizon_steps: number of steps to forecast; None takes the checkpoint's.
        num_samples: number of sampled futures per agent.
        flatten: whether observations are one Box instead of a Dict.
        device: device of the forecaster.
        forecaster: forecaster on `device`, instead of a checkpoint; the same as giving it as `checkpoint`.
        seed: random seed of the samples' noise: environment i gets seed + i, until `reset(seed=…)` gives others.
        reader: refused, because the environments report their scenes; give it to `SceneObservation`.
        what_if: whether observations also hold what the others are forecast to do for each candidate plan of the ego,
            as in `ForecastObservation`. True takes the environments' plan model; or a `PlanModel`, of which each
            process in which environments run has one.
        arm: part of the forecast that observations show, for controlled comparisons (`envs.arms`, docs/arms.md).

    Attributes:
        plan_names: names of the candidate plans; none without `what_if`, but of an arm that plays plans.

    Raises:
        UserError: no vector environment; the environments report no scenes, differ from
            each other, or do not fit the forecaster; no plan model for `what_if=True`; no room for what the arm shows.
    """

    def __init__(
        self,
        env: gym.vector.VectorEnv,
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
        require_kind(env, VECTOR, "VectorForecast")
        gym.vector.VectorWrapper.__init__(self, env)
        refuse_reader(reader, "VectorForecast", _WITH_READER)
        _refuse_lists(env)
        space = require_scenes(env.single_observation_space, "VectorForecast", _WITH_SCENES)
        spec: SceneSpec = common_value(_attribute_of_each(env, "scene_spec"), "scene spec")
        require_scenes_of(spec, space, "VectorForecast")
        source: str = common_value(_attribute_of_each(env, "scene_source"), "env id")
        forecaster = open_forecaster(checkpoint, spec, source, device, forecaster)
        steps = horizon_steps or forecaster.horizon_steps
        base: Any = env.unwrapped  # vector wrappers do not pass calls on
        arm = arm_of(arm)
        self.plan_names = ask_for_plans(
            lambda *a: base.call(*a), what_if, steps, "VectorForecast", base, arm.plays(bool(what_if))
        )
        num_plans = len(self.plan_names) if what_if else 0
        config = ForecastConfig(horizon_steps, num_samples, device, seed, flatten, num_plans=num_plans, arm=arm)
        self.stream: ForecastStream = ForecastStream(forecaster, spec, env.num_envs, config)
        self._layout = ObservationLayout(own_part(space), self.stream.spaces(), flatten)
        self.single_observation_space = self._layout.space
        self.observation_space = batch_space(self.single_observation_space, env.num_envs)
        # Gymnasium before 1.4 writes the mode into metadata that all environments of a class share.
        told = env.metadata.get("autoreset_mode", AutoresetMode.NEXT_STEP)
        self._mode = getattr(base, "autoreset_mode", told)
        self._ended = np.zeros(env.num_envs, dtype=np.bool_)
        self._entries: Observations = {}

    def __deepcopy__(self, memo: dict[int, Any]) -> Any:
        """Returns a copy with its own environments, history and noise.

        Raises:
            UserError: the environments run in processes of their own.
        """
        if isinstance(self.unwrapped, gym.vector.AsyncVectorEnv):
            raise UserError(
                "environments in processes of their own (AsyncVectorEnv) cannot be copied; use SyncVectorEnv"
            )
        return super().__deepcopy__(memo)

    @property
    def scene(self) -> SceneBatch:
        """Latest scene of each environment, world frame, ego first."""
        return self._scenes()

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Resets all environments, or those of `options["reset_mask"]`, and clears their histories."""
        chosen = (options or {}).get("reset_mask")  # inner wrappers may remove it from the options
        observations, infos = self.env.reset(seed=seed, options=options)  # type: ignore[arg-type]
        envs = np.arange(self.num_envs) if chosen is None else np.flatnonzero(chosen)
        self.stream.reset(envs)
        if seed is not None:
            seeds = [seed + env for env in range(self.num_envs)] if isinstance(seed, int | np.integer) else list(seed)
            self.stream.seed([own if env in envs else None for env, own in enumerate(seeds)])
        self._ended[envs] = False
        # A partial reset repeats the others' observations, which were taken in already and must not count twice.
        plans = self._plans(infos)
        entries = self.stream.observe(scenes_from(observations)[envs], envs, None if plans is None else plans[envs])
        for key, value in entries.items():
            self._entries.setdefault(key, np.zeros((self.num_envs, *value.shape[1:]), value.dtype))[envs] = value
        shown = {key: value.copy() for key, value in self._entries.items()}
        return self._layout.batch(observations, shown), infos

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Steps all environments and forecasts them in one batch."""
        observations, rewards, terminations, truncations, infos = self.env.step(actions)
        ended = np.asarray(terminations | truncations)
        if self._mode is AutoresetMode.SAME_STEP:
            over = np.flatnonzero(ended)
            closing = [infos["final_obs"][i] for i in over]
            plans = self._plans(infos)
            if plans is not None and len(over):
                last_plans = self._plans(infos["final_info"])
                assert last_plans is not None
                plans = plans.replaced(over, last_plans[over]).followed_by(plans[over])
            entries, closing_entries = observe_ended(self.stream, observations, over, closing, plans)
            for i, last, extra in zip(over, closing, closing_entries, strict=True):
                infos["final_obs"][i] = self._layout.one(last, extra)
        else:
            if self._mode is AutoresetMode.NEXT_STEP:
                self.stream.reset(np.flatnonzero(self._ended))
            entries = self.stream.observe(scenes_from(observations), plans=self._plans(infos))
        # copies: a later reset writes into the entries of the environments that it opens
        self._ended, self._entries = ended, {key: value.copy() for key, value in entries.items()}
        shown = self._layout.batch(observations, entries)
        return shown, rewards, terminations, truncations, infos

    def _plans(self, infos: dict[str, Any]) -> PlanBatch | None:
        """Returns the plans that infos carry and takes them out of there; None without `what_if`."""
        if not self.plan_names:
            return None
        plans = PlanBatch.from_vector_info(infos)
        del infos[PLANS_INFO]
        infos.pop(f"_{PLANS_INFO}", None)
        return plans


def _refuse_lists(env: gym.vector.VectorEnv) -> None:
    """Raises a `UserError` if a wrapper makes a list of the infos, in which no last observation is found."""
    while isinstance(env, gym.vector.VectorWrapper):
        if isinstance(env, DictInfoToList):
            raise UserError("VectorForecast reads infos as a dict; put DictInfoToList around it, not inside")
        env = env.env


def _attribute_of_each(env: gym.vector.VectorEnv, name: str) -> Any:
    """Returns an attribute of each environment of a vector environment, since vector wrappers do not pass it on.

    Raises:
        UserError: the vector environment has no `get_attr`.
    """
    base = env.unwrapped
    if not hasattr(base, "get_attr"):
        raise UserError(
            f"VectorForecast asks each environment for its {name}, but {type(base).__name__} has no get_attr; use "
            "SyncVectorEnv or AsyncVectorEnv"
        )
    return base.get_attr(name)
