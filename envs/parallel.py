"""PettingZoo wrapper `ForecastParallelEnv`: adds forecasts of the other agents to each agent's observation.

One forecast per step serves all agents; each gets it in its own frame, with its own edges. For a gymnasium environment
with one ego, use `envs.wrappers.ForecastObservation`.

>>> from mpe2 import simple_tag_v3
>>> from envs.parallel import ForecastParallelEnv
>>> env = ForecastParallelEnv(simple_tag_v3.parallel_env(), "constant-velocity")
>>> observations, infos = env.reset(seed=0)
>>> observations["agent_0"]["forecast"].shape[1:]  # for each other agent: horizon steps, xy in the agent's frame [m]
(5, 2)
"""

from collections.abc import Iterable, Mapping, Sequence
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from pettingzoo import AECEnv, ParallelEnv
from pettingzoo.utils import BaseParallelWrapper

from envs.arms import Arm, arm_of
from envs.batched_forward import BatchedForward, can_share
from envs.forecast_wrapper import ForecastWrapper, ObservationLayout, refuse_twice
from envs.kinds import require_kind
from envs.multiagent_observation import MultiagentStream, check_multiagent_scene, require_indexed
from envs.observation import open_forecaster
from envs.own_observation import check_own, check_reward, own_entries, own_spaces
from envs.plans.keeping_on import all_keeping_on
from envs.readers import MakeReader, multiagent_env_id, multiagent_reader_for
from envs.readers.base import MultiagentReader, MultiagentScene, build_multiagent_reader, check_bounds
from envs.scene_stream import ForecastConfig
from envs.simulators.copies import RunningCopy
from predictor.forecaster import Forecaster
from predictor.scene import Forecast, SceneSpec
from predictor.support.errors import ProtocolError, UserError


def living(env: ParallelEnv, terminated: Mapping[str, Any], truncated: Mapping[str, Any]) -> list[str]:
    """Returns the agents that are left after a step, also where the environment keeps those that ended in `agents`."""
    return [agent for agent in env.agents if not (terminated.get(agent) or truncated.get(agent))]


class ForecastParallelEnv(ForecastWrapper, RunningCopy, BaseParallelWrapper):
    """Adds forecasts of the other agents to each agent's observation.

    Observation of an agent: Dict with `observation` (its own, untouched; of a Dict, its entries under their own names)
    and, for the other agents sorted by distance from it, `agents` (relative current states), `forecast` (future
    positions in its frame [m]; a samples axis when num_samples > 1), `edge_probs` and `edge_features` (other → agent,
    then agent → other), `closest` (how close each comes, and when), `ego_path`, `valid`; with samples `mode_probs` and
    `xy_scale`. `envs.entries` gives the shapes. Agents may differ in their own spaces, die and join at any step. An
    agent's last observation has forecasts too; if the reader no longer reports the agent, all its entries are zero,
    `valid` too. At a reset the reader must report each. With `flatten=True` an observation is one Box, in the
    Dict's key order.

    The history is cleared at reset only. After each step, `scene` and `forecast` hold all agents in the world frame.

    Args:
        env: any parallel environment that a multiagent scene reader knows.
        checkpoint: shipped name, folder, "constant-velocity", or any `Forecaster` on `device`; None takes the
            checkpoint that ships for the env's id.
        horizon_steps: number of steps to forecast; None takes the checkpoint's.
        num_samples: number of sampled futures per agent.
        flatten: whether an agent's observation is one Box instead of a Dict.
        perception_m: range of an agent's perception [m]; None takes what the checkpoint was trained with.
        max_agents: size of an agent's view, itself included; the nearest agents are kept. None takes all agents.
        device: device of the forecaster.
        forecaster: forecaster on `device`, instead of a checkpoint; the same as giving it as `checkpoint`.
        seed: random seed of the samples' noise, until `reset(seed=…)` gives another.
        reader: function or class that makes a reader for the env; None picks one by env family.
        arm: part of the forecast that observations show, for controlled comparisons (`envs.arms`, docs/arms.md). With
            true futures each learner repeats its last action in them.

    Raises:
        UserError: not a parallel env, no reader, no checkpoint, a forecaster of another spec (features, dt) or relative
            to an ego, or an agent whose own observation is a Tuple, a Dict of Dicts, or has an entry of an added one's
            name; no room for what the arm shows.
    """

    def __init__(
        self,
        env: ParallelEnv,
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
        arm: Arm | None = None,
    ) -> None:
        """Loads the forecaster and extends the observation spaces."""
        if isinstance(env, AECEnv):
            raise UserError(
                f"ForecastParallelEnv needs a PettingZoo parallel env, got {type(env).__name__}; make it with "
                "parallel_env(), or convert an AEC env with pettingzoo.utils.conversions.aec_to_parallel"
            )
        require_kind(env, (ParallelEnv, "a PettingZoo parallel env"), "ForecastParallelEnv")
        refuse_twice(env, BaseParallelWrapper, "ForecastParallelEnv")
        BaseParallelWrapper.__init__(self, env)
        check_bounds(perception_m, max_agents)
        self._source = f"env '{multiagent_env_id(env)}'"
        self._reader: MultiagentReader = (
            build_multiagent_reader(reader, env) if reader is not None else multiagent_reader_for(env, perception_m)
        )
        spec = self._reader.spec
        env_id = multiagent_env_id(env)
        forecaster = open_forecaster(checkpoint, spec, env_id, device, forecaster)
        perception_m = forecaster.spec.perception_m if perception_m is None else perception_m
        config = ForecastConfig(horizon_steps, num_samples, device, seed, flatten, arm=arm_of(arm))
        self.stream: MultiagentStream = MultiagentStream(forecaster, spec, config, perception_m, max_agents)
        self._layouts: dict[str, ObservationLayout] = {}
        self._forward: BatchedForward | None = None
        self._place = 0
        self._scene: MultiagentScene | None = None
        self._last_actions: Mapping[str, Any] = {}
        self._unchecked = {"reset", "step"}
        for agent in getattr(env, "possible_agents", ()):
            self.observation_space(agent)

    def pictured(self, num_samples: int) -> Forecast:
        """Returns a forecast of the latest scene with this number of samples, to be drawn; no noise is used up.

        Raises:
            UserError: copies share a forward, which has the number of samples of their observations.
        """
        if self._forward is not None:
            own = self.stream.config.num_samples
            raise UserError(
                f"this environment shares its forecasts with other copies (ParallelVecEnv), with num_samples={own}; "
                f"film with num_samples={own}, or an environment of its own"
            )
        return self.stream.pictured(num_samples)

    @property
    def reader(self) -> MultiagentReader:
        """Reader of the scenes."""
        return self._reader

    @property
    def scene_spec(self) -> SceneSpec:
        """Layout of the scenes."""
        return self._reader.spec

    @property
    def scene(self) -> MultiagentScene:
        """Latest scene, world frame."""
        if self._scene is None:
            raise ProtocolError("there is no scene yet; call reset() first")
        return self._scene

    @property
    def forecast(self) -> Forecast:
        """Forecast of the latest observations: a batch of one, agents as in `scene.scene`, world axes."""
        if self._forward is None:
            return super().forecast
        forecast = self._forward.forecast_of(self._place)
        if forecast is None or self._scene is None:
            raise ProtocolError("there is no forecast yet; call reset() first")
        return forecast

    @property
    def observation_spaces(self) -> dict[str, gym.Space]:
        """Space of each agent's observation, by its name."""
        return {agent: self.observation_space(agent) for agent in self.possible_agents}

    def observation_space(self, agent: str) -> gym.Space:
        """Returns the space of the agent's own observation and the forecast entries, the same object at each call.

        Raises:
            UserError: the agent's own observation is a Tuple, a Dict of Dicts, or has an entry of an added one's name.
        """
        return self._layout(agent).space

    def unflatten(self, observation: Any, agent: str | None = None) -> dict[str, Any]:
        """Returns the entries of an agent's observation with `flatten=True`.

        Raises:
            UserError: no agent is named, observations are not flattened, or this one has another size.
        """
        if agent is None:
            raise UserError(f"unflatten needs the name of the agent, one of {', '.join(self.env.possible_agents)}")
        return self._layout(agent).unflatten(observation)

    def _layout(self, agent: str) -> ObservationLayout:
        if agent not in self._layouts:
            own = own_spaces(self.env.observation_space(agent), f"'{agent}' of {self._source}")
            self._layouts[agent] = ObservationLayout(own, self.stream.spaces(), self.stream.config.flatten)
        return self._layouts[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Resets the env and clears the history; a seed also restarts the samples' noise."""
        observations, infos = self.env.reset(seed=seed, options=options)
        if "reset" in self._unchecked:
            for agent, seen in observations.items():
                source = f"'{agent}' of {self._source}"
                check_own(own_spaces(self.env.observation_space(agent), source), seen, source)
            self._unchecked.remove("reset")
        self._reader.reset()
        self._last_actions = {}
        # a wrapper may show agents that are not there yet, but none of a name that the environment does not have
        inside = getattr(self.env.unwrapped, "agents", observations)
        possible = getattr(self.env.unwrapped, "possible_agents", observations)
        scene = self._read(observations, [agent for agent in observations if agent in inside or agent not in possible])
        shown = self._own(observations)
        if self._forward is not None:
            self._forward.begin(self._place, scene, shown, seed)
            return shown, infos
        self.stream.reset()
        if seed is not None:
            self.stream.seed(seed)
        return self._with_views(scene, shown), infos

    def step(
        self, actions: dict[str, Any]
    ) -> tuple[dict[str, Any], dict[str, Any], dict[str, Any], dict[str, Any], dict[str, Any]]:
        """Steps the env, takes in the scene and forecasts."""
        if self.stream.config.arm.shown.true_futures:
            self._last_actions = deepcopy(dict(actions))  # the environment may change them
        observations, rewards, terminations, truncations, infos = self.env.step(actions)
        if "step" in self._unchecked:
            for agent, reward in rewards.items():
                check_reward(reward, f"'{agent}' of {self._source}")
            self._unchecked.remove("step")
        scene, shown = self._read(observations), self._own(observations)
        if self._forward is not None:
            self._forward.go_on(self._place, scene, shown)
        else:
            shown = self._with_views(scene, shown)
        return shown, rewards, terminations, truncations, infos

    def _read(self, observations: Mapping[str, Any], required: Iterable[str] = ()) -> MultiagentScene:
        source = f"scene reader of {self._source}"
        scene = check_multiagent_scene(self._reader.read(self.env), self._reader.spec, source)
        require_indexed(scene, required, source)
        # a reader may give the simulator's own arrays, into which the next reset writes
        scene = replace(scene, scene=scene.scene.copy(), heading_rad=np.array(scene.heading_rad))
        if self.stream.config.arm.shown.true_futures:
            horizon_steps = self.stream.horizon_steps
            xy_m = all_keeping_on(self.env, self._reader, scene.scene, observations, self._last_actions, horizon_steps)
            scene = replace(scene, true_xy=xy_m)
        self._scene = scene
        return scene

    def _own(self, observations: Mapping[str, Any]) -> dict[str, Any]:
        return {agent: own_entries(own) for agent, own in observations.items()}

    def _with_views(self, scene: MultiagentScene, shown: dict[str, Any]) -> dict[str, Any]:
        entries = self.stream.observe(scene)
        return {
            agent: self._layout(agent).one(seen, entries.get(agent) or self.stream.nothing_seen())
            for agent, seen in shown.items()
        }


def batch_forwards(envs: Sequence[ParallelEnv]) -> BatchedForward | None:
    """Makes copies of one environment share one batched forward, if there are several and their wrappers are equal.

    Within `envs.batched_forward.collected`, their observations lack forecasts until the end of the block. Their
    histories are empty: reset them.

    Args:
        envs: copies of the environment.

    Returns:
        The forward, for `collected`; None if each copy forecasts by itself.
    """
    copies = [env for env in envs if type(env) is ForecastParallelEnv and not env.stream.config.flatten]
    if len(copies) < len(envs) or len(copies) < 2 or not can_share([copy.stream for copy in copies]):
        return None
    forward = BatchedForward([copy.stream for copy in copies])
    for place, copy in enumerate(copies):
        copy._forward, copy._place = forward, place
    return forward
