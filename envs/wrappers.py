"""Gymnasium wrappers for one environment: `SceneObservation` adds the scene, `ForecastObservation` forecasts.

>>> import gymnasium as gym
>>> from envs.wrappers import ForecastObservation
>>> env = ForecastObservation(gym.make("highway-fast-v0"), "highway")
>>> obs, info = env.reset(seed=0)
>>> obs["forecast"].shape  # other agents, horizon steps, xy in the ego's frame [m]
(11, 5, 2)
"""

import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
from gymnasium.utils import RecordConstructorArgs

from envs.arms import Arm, arm_of
from envs.forecast_wrapper import ForecastWrapper, ObservationLayout, refuse_reader, refuse_twice
from envs.kinds import SINGLE, refuse_autoreset, require_kind
from envs.observation import ForecastStream, carries_scenes, open_forecaster, scene_entries, scene_spaces
from envs.own_observation import check_own, check_returned, check_reward, own_entries, own_part, own_spaces
from envs.plans import PlanModel, Plans, checked_model, checked_plans, plan_model_for
from envs.plans.batch import PlanBatch, plans_info
from envs.plans.playing import with_true_futures
from envs.readers import MakeReader, reader_for
from envs.readers.base import Reader, bounded, build_reader, require_scene, show
from envs.scene_stream import ForecastConfig
from envs.simulators.copies import RunningCopy
from envs.simulators.idm_constants import restore_idm_constants
from predictor.forecaster import Forecaster
from predictor.scene import Forecast, Scene, SceneBatch, SceneSpec
from predictor.support.errors import ProtocolError, UserError


def scene_source(env: gym.Env) -> str:
    """Returns the name of an env, for messages and for picking its checkpoint: its id, else its class."""
    spec = env.unwrapped.spec
    return str(getattr(spec, "id", type(env.unwrapped).__name__))


def _reader_of(env: gym.Env, make_reader: MakeReader | None, perception_m: float | None, max_agents: int | None) -> Any:
    if make_reader is None:
        return reader_for(env, perception_m, max_agents)
    return bounded(build_reader(make_reader, env), perception_m, max_agents)


def scenes_inside(env: gym.Env) -> "SceneObservation | None":
    """Returns the `SceneObservation` inside of an env, down to a wrapper that takes forecasts out; else None."""
    while isinstance(env, gym.Wrapper) and not getattr(type(env), "takes_out_forecasts", False):
        if isinstance(env, SceneObservation):
            return env
        env = env.env
    return None


class SceneObservation(RunningCopy, gym.Wrapper[dict[str, Any], Any, Any, Any], RecordConstructorArgs):
    """Adds the scene around the ego to the observation.

    Observation: Dict with `observation` (the env's own, untouched; of a Dict, its entries under their own names),
    `scene_states` (max_agents, F) in the world frame, `scene_ids`, `scene_valid`, `scene_heading_rad` (the ego's). The
    ego has index 0. `VecForecast` needs these entries from each environment; for a policy use `ForecastObservation`.

    Args:
        env: any environment that a scene reader knows.
        perception_m: range of the ego's perception [m]; None takes the reader's default.
        max_agents: size of a scene, the ego included; None takes the reader's default.
        reader: function or class that makes a reader for the env; None picks one by env family.

    Attributes:
        reader: reader of the scenes.
        plans_paused: whether infos have no plans for now, although `propose_plans` asked for some.

    Raises:
        UserError: not one gymnasium environment, or one with Autoreset inside; no reader knows the env; or its
            observation is a Tuple, a Dict of Dicts, or has an entry of an added one's name.
    """

    def __init__(
        self,
        env: gym.Env,
        perception_m: float | None = None,
        max_agents: int | None = None,
        reader: MakeReader | None = None,
    ) -> None:
        """Picks the reader and extends the observation space."""
        require_kind(env, SINGLE, "SceneObservation")
        refuse_autoreset(env, "SceneObservation")
        RecordConstructorArgs.__init__(self, perception_m=perception_m, max_agents=max_agents, reader=reader)
        gym.Wrapper.__init__(self, env)
        own = own_spaces(env.observation_space, f"env '{scene_source(env)}'")
        self._own_spaces, self._unchecked = own, {"reset", "step"}
        self.reader = _reader_of(env, reader, perception_m, max_agents)
        self._scene: Scene | None = None
        self._ego_id: int | None = None
        self._plan_model: PlanModel | None = None
        self._plan_steps = 0
        self._played: int | None = 0
        self.plans_paused = self._over = self._warned = False
        self.observation_space = gym.spaces.Dict({**own, **scene_spaces(self.reader.spec)})

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restores a copy or a pickle; a copy may look ahead past the end, so it warns of nothing."""
        super().__setstate__(state)
        self._warned = True

    @property
    def scene_spec(self) -> SceneSpec:
        """Layout of the scenes."""
        return self.reader.spec

    @property
    def scene_source(self) -> str:
        """Name of the env, for messages and for picking its checkpoint: its id, else its class."""
        return scene_source(self.env)

    @property
    def scene(self) -> Scene:
        """Latest scene."""
        if self._scene is None:
            raise ProtocolError("there is no scene yet; call reset() first")
        return self._scene

    def propose_plans(
        self, what_if: bool | PlanModel, horizon_steps: int, played: int | None = 0
    ) -> tuple[str, ...] | UserError:
        """Puts candidate plans of the ego into all later infos, for vector wrappers with `what_if`.

        Args:
            what_if: True for the env's own plan model; or a `PlanModel`.
            horizon_steps: number of steps of a plan.
            played: number of plans that are played in a copy of the simulator, the first ones; None plays all.

        Returns:
            Names of the plans; or the error that there is no plan model, which another process could not raise.
        """
        try:
            self._plan_model = plan_model_for(self) if isinstance(what_if, bool) else what_if
        except UserError as error:
            return error
        self._plan_steps, self._played = horizon_steps, played
        return tuple(self._plan_model.names)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Resets the env; identities start anew.

        Raises:
            UserError: the first observation does not lie in the env's own space.
        """
        restore_idm_constants(self.env)
        returned = self.env.reset(seed=seed, options=options)
        if "reset" in self._unchecked:
            check_returned(returned, "reset", f"env '{self.scene_source}'")
        obs, info = returned
        if "reset" in self._unchecked:
            check_own(self._own_spaces, obs, f"env '{self.scene_source}'")
            self._unchecked.remove("reset")
        self.reader.reset()
        self._over, self._ego_id = False, None
        return self._observe(obs), self._with_plans(info)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Steps the env and reads the scene."""
        if self._over and not self._warned:
            self._warned = True
            warnings.warn(
                f"step() of env '{self.scene_source}' was called after an episode's end, without reset(): what follows "
                "is forecast with the history of the episode that ended",
                stacklevel=2,
            )
        returned = self.env.step(action)
        if "step" in self._unchecked:
            check_returned(returned, "step", f"env '{self.scene_source}'")
        obs, reward, terminated, truncated, info = returned
        if "step" in self._unchecked:
            check_reward(reward, f"env '{self.scene_source}'")
            self._unchecked.remove("step")
        self._over = bool(terminated or truncated)
        # some highway-env ids return NumPy's bool, which SB3 refuses
        return self._observe(obs), reward, bool(terminated), bool(truncated), self._with_plans(info)

    def _with_plans(self, info: dict[str, Any]) -> dict[str, Any]:
        if self._plan_model is None or self.plans_paused:
            return info
        return {**info, **plans_info(self.make_plans(self._plan_model, self._plan_steps, self._played))}

    def make_plans(self, plan_model: PlanModel, horizon_steps: int, played: int | None = 0) -> Plans:
        """Returns the checked plans of a model from the present state.

        Args:
            plan_model: plan model.
            horizon_steps: number of steps of a plan.
            played: number of plans that are played in a copy of the simulator, the first ones; None plays all.

        Raises:
            UserError: see `envs.plans.checked_plans` and `envs.plans.playing.with_true_futures`.
        """
        spec = self.reader.spec
        plans = checked_plans(plan_model, self, horizon_steps, spec.num_features, self.scene, spec)
        return plans if played == 0 else with_true_futures(plans, self.env, self.reader, self.scene, played, self._over)

    def _observe(self, obs: Any) -> dict[str, Any]:
        show(self.reader, obs)
        name, spec = f"scene reader of '{self.scene_source}'", self.reader.spec
        scene = require_scene(self.reader.read(self.env), name)
        scene.check(name, spec, agents=spec.max_agents)
        if spec.has_ego:
            first = int(scene.ids[0])
            if self._ego_id not in (None, first):
                raise UserError(
                    f"{name}: the first agent was {self._ego_id} and is now {first}; it must be the ego until the "
                    "episode ends: leave an ego that is gone where it was, at rest, or end the episode, and begin the "
                    "next by the reset() of this wrapper"
                )
            self._ego_id = first
        self._scene = scene.copy()  # a reader may give the simulator's own arrays, into which the next reset writes
        return {**own_entries(obs), **scene_entries(self._scene)}


class ForecastObservation(ForecastWrapper, RunningCopy, gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Adds forecasts of the other agents to the observation.

    Observation: Dict with `observation` (the env's own, untouched; of a Dict, its entries under their own names)
    and, for the other agents sorted by distance, `agents` (relative current states), `forecast` (future positions in
    the ego's frame [m]; a samples axis when num_samples > 1), `edge_probs` and `edge_features` (agent → ego, then
    ego → agent), `closest` (how close each comes, and when), `ego_path`, `valid`; with samples `mode_probs` and
    `xy_scale`. `envs.entries` gives the shapes. With `flatten=True` it is one Box, in the Dict's key order.

    The history is cleared at reset. After each step, `scene` holds the observed scene in the world frame,
    `forecast` its forecast: along the world's axes, relative to the ego's position.

    Args:
        env: any environment that a scene reader knows, or one that is already a `SceneObservation`.
        checkpoint: shipped name, folder, "constant-velocity", or any `Forecaster` on `device`; None takes the
            checkpoint that ships for the env's id.
        horizon_steps: number of steps to forecast; None takes the checkpoint's.
        num_samples: number of sampled futures per agent.
        flatten: whether the observation is one Box instead of a Dict, for MlpPolicy; combine it with VecNormalize,
            since the entries are in metres.
        perception_m: range of the ego's perception [m]; None takes what the checkpoint was trained with.
        max_agents: size of a scene, the ego included; None takes what the checkpoint was trained with.
        device: device of the forecaster.
        forecaster: forecaster on `device`, instead of a checkpoint; the same as giving it as `checkpoint`.
        seed: random seed of the samples' noise, until `reset(seed=…)` gives another.
        reader: function or class that makes a reader for the env; None picks one by env family. Refused over a
            `SceneObservation`, which has its own.
        what_if: whether the observation also holds what the others are forecast to do for each candidate plan of the
            ego: `what_if_gap`, `what_if_contact`, `what_if_risk` (`envs.entries.what_if_entries`). True takes the
            environment's plan model; or a `PlanModel` (docs/what_if.md).
        arm: part of the forecast that observations show, for controlled comparisons (`envs.arms`, docs/arms.md).

    Attributes:
        plans: candidate plans of the latest step; None without `what_if`.
        what_if: forecast for these plans, world axes, with an axis of plans; None without `what_if`.

    Raises:
        UserError: not one gymnasium environment, or one with Autoreset inside; no reader, or one although
            the env is a `SceneObservation`; no checkpoint, or a forecaster of another spec (features, dt); no plan
            model for `what_if=True`; no room for what the arm shows.
    """

    def __init__(
        self,
        env: gym.Env,
        checkpoint: str | Path | Forecaster | None = None,
        *,
        horizon_steps: int | None = None,
        num_samples: int = 1,
        flatten: bool = False,
        perception_m: float | None = None,
        max_agents: int | None = None,
        device: str = "cpu",
        forecaster: Forecaster | None = None,
        seed: int = 0,
        reader: MakeReader | None = None,
        what_if: bool | PlanModel = False,
        arm: Arm | None = None,
    ) -> None:
        """Loads the forecaster and extends the observation space."""
        require_kind(env, SINGLE, "ForecastObservation")
        refuse_autoreset(env, "ForecastObservation")
        refuse_twice(env, gym.Wrapper, "ForecastObservation")
        checkpoint = str(checkpoint) if isinstance(checkpoint, Path) else checkpoint  # a spec is JSON
        RecordConstructorArgs.__init__(
            self, checkpoint=checkpoint, horizon_steps=horizon_steps, num_samples=num_samples, flatten=flatten,
            perception_m=perception_m, max_agents=max_agents, device=device, forecaster=forecaster, seed=seed,
            what_if=what_if, arm=arm, _disable_deepcopy=True,
        )  # the reader is recorded by the SceneObservation below  # fmt: skip
        arm = arm_of(arm)
        self._played = arm.plays(bool(what_if))
        needs_plans = bool(what_if) or self._played != 0
        plan_model = (
            (plan_model_for(env) if needs_plans else None) if isinstance(what_if, bool) else checked_model(what_if)
        )
        num_plans = len(plan_model.names) if plan_model is not None and what_if else 0
        config = ForecastConfig(horizon_steps, num_samples, device, seed, flatten, num_plans=num_plans, arm=arm)
        ready = carries_scenes(env.observation_space)
        if not ready and scenes_inside(env) is not None:
            raise UserError(
                "a wrapper around SceneObservation hides its scenes from ForecastObservation; put it inside of "
                "SceneObservation, or around ForecastObservation"
            )
        source = scene_source(env)
        if ready:
            refuse_reader(reader, "ForecastObservation over a SceneObservation", "SceneObservation(env, reader=...)")
            spec: SceneSpec = env.get_wrapper_attr("scene_spec")
            if perception_m not in (None, spec.perception_m) or max_agents not in (None, spec.max_agents):
                raise UserError(
                    f"perception_m={perception_m} and max_agents={max_agents} do not fit the SceneObservation below "
                    f"({spec.perception_m:g}, {spec.max_agents}); give them to that wrapper"
                )
        else:
            made = _reader_of(env, reader, perception_m, max_agents)
            spec = made.spec
        forecaster = open_forecaster(checkpoint, spec, source, device, forecaster)
        if not ready:
            trained = forecaster.spec if isinstance(made, Reader) else spec  # others cannot be bounded
            env = SceneObservation(env, perception_m or trained.perception_m, max_agents or trained.max_agents, reader)
            spec = env.scene_spec
        gym.Wrapper.__init__(self, env)
        self.stream: ForecastStream = ForecastStream(forecaster, spec, envs=1, config=config)
        self.plan_model = plan_model
        self.plans: Plans | None = None
        self.what_if: Forecast | None = None
        extended: Any = env.observation_space
        self._layout = ObservationLayout(own_part(extended), self.stream.spaces(), flatten)
        self.observation_space = self._layout.space

    @property
    def scene(self) -> Scene:
        """Latest scene, world frame, the ego at index 0."""
        scene: Scene = self.env.get_wrapper_attr("scene")
        return scene

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Resets the env and clears the history; a seed also restarts the samples' noise."""
        obs, info = self.env.reset(seed=seed, options=options)
        self.stream.reset()
        if seed is not None:
            self.stream.seed(seed)
        return self._observe(obs), info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Steps the env, takes in the scene and forecasts."""
        obs, reward, terminated, truncated, info = self.env.step(action)
        return self._observe(obs), reward, terminated, truncated, info

    def _observe(self, obs: dict[str, Any]) -> Any:
        plans = None
        if self.plan_model is not None:
            make: Any = self.env.get_wrapper_attr("make_plans")
            self.plans = make(self.plan_model, self.stream.horizon_steps, self._played)
            plans = PlanBatch.stack([self.plans])
        entries = self.stream.observe(SceneBatch.stack([self.scene]), plans=plans)
        self.what_if = self.stream.planned
        return self._layout.one(obs, {key: value[0] for key, value in entries.items()})
