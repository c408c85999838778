"""A planner that needs no training: the plan with the highest expected reward under a bound on the collision risk.

At each step the plan model proposes plans, one batched what-if forecast says what the others do in each, and each plan
gets its probability of surviving every step. A plan's value is the expected sum of its rewards over the horizon, and a
collision ends it:

    value = Σ_t S_t · reward_t + (S_{t−1} − S_t) · crash_reward_t,    S_t: probability of no collision by step t

Rules: among the plans whose risk 1 − S_H is at most `max_risk`, the one with the highest value is taken; of equal ones
that with the least risk, then the first of the plan model. If all are riskier, the one with the least risk is taken; of
equal ones that with the highest value, then the first.
"""

import functools
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from jaxtyping import Float

from envs.plans import PlanModel, Plans, checked_model, checked_plans, plan_model_for
from envs.plans.contact import contacts
from envs.plans.playing import as_forecast, with_true_futures
from envs.readers import reader_for
from envs.readers.base import SceneReader, bounded_spec, perceive, show
from envs.registry import entry_for
from envs.wrappers import SceneObservation, scene_source
from predictor.checkpoint import CONSTANT_VELOCITY, load_forecaster, weights_stamp
from predictor.forecaster import Forecaster, has_scale
from predictor.forecaster_checks import require_forecaster
from predictor.online import OnlineForecaster
from predictor.scene import Scene, SceneBatch
from predictor.support.config_checks import check_at_least, check_types
from predictor.support.errors import UserError
from predictor.support.files import Stamp

PLANNER = "planner"
"""Name of the driver; `planner:CHECKPOINT` names its forecaster too, `planner@RISK` its bound on the risk, and
`planner@RISK:CHECKPOINT` both."""
ORACLE = "oracle"
"""Name in the place of a checkpoint: the planner gets the true futures, an upper bound for measurements."""
MODES = 20
"""Number of futures of a forecaster with modes; others give the planner their single forecast."""
_DEMAND = "plan_model must be None,"
EQUAL = 1e-6
"""Largest difference of values or risks that are taken for equal: float32 forecasts have no more digits."""


@dataclass(frozen=True)
class PlannerConfig:
    """Settings of the planner."""

    max_risk: float = 0.05
    """Largest accepted probability of a collision within the horizon."""
    num_samples: int | None = None
    """Number of futures of each plan; None takes 20 for a forecaster with modes, else the single forecast."""
    horizon_steps: int | None = None
    """Number of steps that are planned; None takes what the checkpoint was trained for."""
    true_futures: bool = False
    """Whether the futures are those that a copy of the simulator plays, instead of the forecaster's."""

    def __post_init__(self) -> None:
        """Checks types and ranges."""
        check_types(self)
        check_at_least(self, 1, "num_samples", "horizon_steps")
        if not 0 <= self.max_risk <= 1:
            raise UserError(f"max_risk must be from 0 to 1, got {self.max_risk}")


def is_planner(name: str) -> bool:
    """Returns whether a driver's name is that of the planner."""
    return name.partition(":")[0].partition("@")[0] == PLANNER


def planner_checkpoint(name: str) -> str:
    """Returns the checkpoint, or `ORACLE`, in the name of a planner; empty where it has none."""
    return name.partition(":")[2]


def planner_config(name: str) -> PlannerConfig:
    """Returns the settings with the bound on the risk that the name of a planner gives.

    Raises:
        UserError: the bound is no number from 0 to 1.
    """
    _, at, risk = name.partition(":")[0].partition("@")
    try:
        return PlannerConfig(max_risk=float(risk)) if at else PlannerConfig()
    except (ValueError, UserError) as error:
        raise UserError(
            f"{PLANNER}@RISK needs a largest probability of a collision from 0 to 1 ({PLANNER}@0.3), got '{name}'"
        ) from error


def planner_driver(name: str, env: gym.Env, rng: np.random.Generator) -> "Planner":
    """Returns the planner as a driver for one episode.

    Args:
        name: "planner", or "planner:CHECKPOINT" with a shipped name, a folder, "constant-velocity" or "oracle"; with
            "@RISK" behind the first word, the bound on the risk is another one.
        env: environment that will be driven.
        rng: source of the samples' noise.

    Raises:
        UserError: no plan model or no checkpoint fits the environment, or the bound is none.
    """
    checkpoint, config = planner_checkpoint(name), planner_config(name)
    model = plan_model_for(env)
    if checkpoint == ORACLE:
        forecaster = forecaster_for(env, entry_for(scene_source(env)).checkpoint or CONSTANT_VELOCITY)
        return Planner(env, forecaster, model, rng, replace(config, true_futures=True))
    return Planner(env, forecaster_for(env, checkpoint or None), model, rng, config)


def forecaster_for(env: gym.Env, checkpoint: str | None) -> Forecaster:
    """Returns the forecaster of a planner: of a checkpoint, else of the wrapper, else the one that ships for the env.

    Raises:
        UserError: none ships, or the checkpoint does not fit the environment.
    """
    if checkpoint is None and env.has_wrapper_attr("forecaster"):
        wrapped: Forecaster = env.get_wrapper_attr("forecaster")
        return wrapped
    spec = env.get_wrapper_attr("scene_spec") if env.has_wrapper_attr("scene_spec") else reader_for(env).spec
    source = scene_source(env)
    checkpoint = checkpoint or entry_for(source).checkpoint
    if checkpoint is None:
        raise UserError(
            f"no checkpoint ships for env '{source}': name the planner's forecaster, as planner:CHECKPOINT (a name or "
            f"a path) or planner:{CONSTANT_VELOCITY}"
        )
    return _loaded(checkpoint, spec, source, weights_stamp(checkpoint))


@functools.lru_cache(maxsize=4)
def _loaded(checkpoint: str, spec: Any, source: str, found: Stamp) -> Forecaster:
    return load_forecaster(checkpoint, spec, f"env '{source}'")


class Planner:
    """Chooses actions of an ego; it is called once per step and keeps the history of its episode.

    Args:
        env: environment that was reset or will be; a scene reader must know it, unless it is in `SceneObservation`.
            There the planner perceives what both the wrapper's reader and the forecaster do.
        forecaster: forecaster of the other agents, or the name or path of a checkpoint.
        plan_model: source of the candidate plans, with rewards; None takes the environment's.
        rng: source of the samples' noise.
        config: settings.

    Attributes:
        plans: candidate plans of the latest step.
        survival: their probabilities of no collision by each step, [plans horizon].
        chosen: index of the plan that was taken.

    Raises:
        UserError: no plan model or no reader knows the environment, a wrapper changes its actions, or the forecaster
            does not fit its scenes.
    """

    def __init__(
        self,
        env: gym.Env,
        forecaster: Forecaster | str | Path,
        plan_model: PlanModel | None = None,
        rng: np.random.Generator | None = None,
        config: PlannerConfig | None = None,
    ) -> None:
        """Starts with an empty history."""
        self.config = config or PlannerConfig()
        self.env = env
        self.plan_model = plan_model_for(env) if plan_model is None else checked_model(plan_model, _DEMAND)
        named = isinstance(forecaster, str | Path)
        forecaster = forecaster_for(env, str(forecaster)) if named else require_forecaster(forecaster)
        trained = forecaster.spec
        self._own_reader = not env.has_wrapper_attr("scene_spec")
        self._reader: SceneReader = (
            reader_for(env, trained.perception_m, trained.max_agents)
            if self._own_reader
            else env.get_wrapper_attr("reader")
        )
        read = self._reader.spec
        self._spec = bounded_spec(
            read, min(read.perception_m, trained.perception_m), min(read.max_agents, trained.max_agents)
        )
        trained.check_compatible(self._spec, "the planner's forecaster", f"env '{scene_source(env)}'")
        self._online = OnlineForecaster(forecaster, 1, self._spec.max_agents)
        self._samples = self.config.num_samples or (MODES if has_scale(forecaster) else 1)
        self._horizon = self.config.horizon_steps or forecaster.horizon_steps
        self._noise = [rng or np.random.default_rng(0)]
        self.plans: Plans | None = None
        self.survival: Float[np.ndarray, "plans horizon"] = np.zeros((0, 0))
        self.chosen = 0

    def __call__(self, obs: Any = None) -> Any:
        """Observes the environment's present scene and returns the best plan's action.

        Args:
            obs: the environment's own observation; only a reader that reads observations (`EntityRowsReader`) needs it.

        Raises:
            UserError: plans of another shape, or without rewards.
        """
        scene = self._scene(obs)
        scenes = SceneBatch.stack([scene])
        self._online.observe(scenes)
        plans = checked_plans(self.plan_model, self.env, self._horizon, self._spec.num_features, scene, self._spec)
        if plans.rewards is None:
            raise UserError(f"the planner needs rewards, but plan model {type(self.plan_model).__name__} gives none")
        forecast = self._online.forecast(self._horizon, self._samples, self._noise, plans.states[None])
        if self.config.true_futures:
            env = self.env if self._own_reader else _below_scenes(self.env)
            true = with_true_futures(plans, env, self._reader, scene).true_xy
            assert true is not None
            forecast = as_forecast(true[None], scenes, forecast)
        length_m, width_m = (size + plans.margin_m for size in plans.size_m)  # half of it around each agent
        survival = contacts(forecast, scenes, (length_m, width_m), self._spec.dt_s).survival()[0]
        self.survival = survival if plans.crashed is None else survival * ~plans.crashed
        self.plans, self.chosen = plans, choose(plans, self.survival, self.config.max_risk)
        return plans.actions[self.chosen]

    def _scene(self, obs: Any) -> Scene:
        if self._own_reader:
            show(self._reader, obs)
            return self._reader.read(self.env)
        scene: Scene = self.env.get_wrapper_attr("scene")
        return scene if self._spec == self._reader.spec else perceive(scene, self._spec)


def _below_scenes(env: gym.Env) -> gym.Env:
    """Returns the environment whose steps and observations a `SceneObservation` shows to its reader."""
    while isinstance(env, gym.Wrapper) and not isinstance(env, SceneObservation):
        env = env.env
    return env.env if isinstance(env, SceneObservation) else env


def expected_rewards(plans: Plans, survival: Float[np.ndarray, "plans horizon"]) -> Float[np.ndarray, " plans"]:
    """Computes the expected sum of rewards of each plan; see the module's formula."""
    assert plans.rewards is not None
    crash = np.zeros_like(plans.rewards) if plans.crash_rewards is None else plans.crash_rewards
    ends = -np.diff(survival, axis=1, prepend=1.0)
    values: Float[np.ndarray, " plans"] = (survival * plans.rewards + ends * crash).sum(axis=1)
    return values


def choose(plans: Plans, survival: Float[np.ndarray, "plans horizon"], max_risk: float) -> int:
    """Returns the index of the plan that the module's rules take.

    Args:
        plans: plans with rewards.
        survival: probability of no collision by each step.
        max_risk: largest accepted probability of a collision within the horizon.
    """
    risk = np.round((1.0 - survival[:, -1]) / EQUAL).astype(np.int64)
    value = np.round(expected_rewards(plans, survival) / EQUAL).astype(np.int64)
    allowed = np.flatnonzero(risk <= round(max_risk / EQUAL))
    if len(allowed):
        return int(min(allowed, key=lambda plan: (-value[plan], risk[plan], plan)))
    return int(min(range(len(risk)), key=lambda plan: (risk[plan], -value[plan], plan)))
