"""PettingZoo: `ForecastParallelEnv` shows every agent of a parallel environment what the others are about to do.

One forecast per step serves all agents; each gets it in its own frame, with its own edges. For a gymnasium environment
with one ego there is `envs.wrappers.ForecastObservation`.

>>> from mpe2 import simple_tag_v3
>>> from envs.parallel import ForecastParallelEnv
>>> env = ForecastParallelEnv(simple_tag_v3.parallel_env(), "constant-velocity")
>>> observations, infos = env.reset(seed=0)
>>> observations["agent_0"]["forecast"].shape[1:]  # for each other: horizon steps, xy in the agent's frame [m]
(5, 2)
"""

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from pettingzoo import ParallelEnv
from pettingzoo.utils import BaseParallelWrapper

from envs.multiagent_observation import SharedStream, check_multiagent_scene
from envs.observation import FORECAST_KEYS, ForecastConfig
from envs.readers import MakeReader, multiagent_env_id, multiagent_reader_for
from envs.readers.base import MultiagentReader, MultiagentScene, build_multiagent_reader
from envs.registry import checkpoint_for
from envs.simulators.copies import RunningCopy
from predictor.checkpoint import load_forecaster
from predictor.errors import ProtocolError, UserError
from predictor.forecaster import Forecaster
from predictor.scene import Forecast, SceneSpec

_COMPOSED = (gym.spaces.Dict, gym.spaces.Tuple, gym.spaces.Graph, gym.spaces.Sequence, gym.spaces.OneOf)


class ForecastParallelEnv(RunningCopy, BaseParallelWrapper):
    """Shows every agent what the others are about to do.

    Observation of an agent: Dict with `observation` (its own, untouched) and, for the other agents sorted by distance
    from it, `agents` (relative current states), `forecast` (future positions in its frame [m]; a samples axis when
    num_samples > 1), `edge_probs` and `edge_features` (other → agent, then agent → other), `valid`.
    `envs.observation.ego_entries` gives the shapes. Agents may differ in their own spaces, die and join at any step. An
    agent gets its last observation like any other; if the reader no longer sees it, all its entries are zero, `valid`
    too.

    The history is forgotten at reset only. After each step, `scene` and `forecast` hold the same in the world frame.

    Args:
        env: any parallel environment that a shared scene reader knows.
        checkpoint: shipped name, folder, or "constant-velocity"; None takes the one that ships for the env's id.
        horizon_steps: steps to forecast; None takes the checkpoint's.
        num_samples: sampled futures per agent.
        perception_m: how far an agent sees [m]; None takes what the checkpoint was trained with.
        max_agents: rows of an agent's view, itself included, the nearest are kept; None takes everyone.
        device: where the forecaster runs.
        reader: makes a reader for the env; None picks one by env family.
        forecaster: instead of a checkpoint; lives on `device`.

    Raises:
        UserError: not a parallel env, no reader, no checkpoint, one of another spec (features, dt) or relative to an
            ego, or an agent whose own observation is a Dict or Tuple.
    """

    def __init__(
        self,
        env: ParallelEnv,
        checkpoint: str | None = None,
        *,
        horizon_steps: int | None = None,
        num_samples: int = 1,
        perception_m: float | None = None,
        max_agents: int | None = None,
        device: str = "cpu",
        reader: MakeReader | None = None,
        forecaster: Forecaster | None = None,
    ) -> None:
        """Load the forecaster and extend the observation spaces."""
        if not isinstance(env, ParallelEnv):
            raise UserError(
                f"ForecastParallelEnv needs a PettingZoo parallel env, got {type(env).__name__}; make it with "
                "parallel_env(), or convert an AEC env with pettingzoo.utils.conversions.aec_to_parallel"
            )
        super().__init__(env)
        self._source = f"env '{multiagent_env_id(env)}'"
        self._reader: MultiagentReader = (
            build_multiagent_reader(reader, env) if reader is not None else multiagent_reader_for(env, perception_m)
        )
        spec = self._reader.spec
        if forecaster is None:
            name = checkpoint if checkpoint is not None else checkpoint_for(multiagent_env_id(env))
            forecaster = load_forecaster(name, spec, self._source, device)
        elif checkpoint is not None:
            raise UserError(f"give a checkpoint or a forecaster, not both (checkpoint '{checkpoint}')")
        else:
            forecaster.spec.check_compatible(spec, "the forecaster", self._source)
        perception_m = forecaster.spec.perception_m if perception_m is None else perception_m
        config = ForecastConfig(horizon_steps, num_samples, device)
        self._stream = SharedStream(forecaster, spec, config, perception_m, max_agents)
        self._spaces: dict[str, gym.spaces.Dict] = {}
        self._scene: MultiagentScene | None = None
        for agent in getattr(env, "possible_agents", ()):
            self.observation_space(agent)

    @property
    def reader(self) -> MultiagentReader:
        """Who reads the scenes."""
        return self._reader

    @property
    def scene_spec(self) -> SceneSpec:
        """Layout of the scenes."""
        return self._reader.spec

    @property
    def scene(self) -> MultiagentScene:
        """The latest scene, world frame."""
        if self._scene is None:
            raise ProtocolError("there is no scene yet; call reset() first")
        return self._scene

    @property
    def forecast(self) -> Forecast:
        """The latest forecast, a batch of one, rows as in `scene.scene`, world coordinates."""
        if self._stream.forecast is None:
            raise ProtocolError("there is no forecast yet; call reset() first")
        return self._stream.forecast

    def observation_space(self, agent: str) -> gym.spaces.Dict:
        """Its own observation and the forecast entries; the same object at each call.

        Raises:
            UserError: the agent's own observation is a Dict or Tuple.
        """
        if agent not in self._spaces:
            own = self.env.observation_space(agent)
            if isinstance(own, _COMPOSED):
                raise UserError(
                    f"an agent's own observation must be one array, but '{agent}' of {self._source} gives a "
                    f"{type(own).__name__}; pass on the array alone, and an action mask in the agent's info"
                )
            self._spaces[agent] = gym.spaces.Dict({"observation": own, **self._stream.spaces()})
        return self._spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Reset the env and forget the history; a seed also restarts the samples' noise."""
        observations, infos = self.env.reset(seed=seed, options=options)
        self._reader.reset()
        self._stream.reset()
        if seed is not None:
            self._stream.seed(seed)
        return self._observe(observations), infos

    def step(
        self, actions: dict[str, Any]
    ) -> tuple[dict[str, Any], dict[str, Any], dict[str, Any], dict[str, Any], dict[str, Any]]:
        """Step the env, take in the scene, forecast."""
        observations, rewards, terminations, truncations, infos = self.env.step(actions)
        return self._observe(observations), rewards, terminations, truncations, infos

    def _observe(self, observations: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
        scene = self._reader.read(self.env)
        self._scene = check_multiagent_scene(scene, self._reader.spec, f"scene reader of {self._source}")
        entries = self._stream.observe(self._scene)
        return {
            agent: {"observation": own, **(entries[agent] if agent in entries else self._nothing_seen(agent))}
            for agent, own in observations.items()
        }

    def _nothing_seen(self, agent: str) -> dict[str, NDArray[np.float32]]:
        spaces = self.observation_space(agent).spaces
        return {key: np.zeros(spaces[key].shape or (), dtype=np.float32) for key in FORECAST_KEYS}
