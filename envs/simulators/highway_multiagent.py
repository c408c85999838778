"""highway-env's intersection with several learners, as a PettingZoo parallel environment.

highway-env packs all agents into one tuple and ends the episode for all of them at the first crash. Here an agent that
crashes or arrives leaves, with its own reward, and the others go on.

>>> from envs.simulators.highway_multiagent import HighwayParallelEnv
>>> from envs.parallel import ForecastParallelEnv
>>> env = HighwayParallelEnv(controlled_vehicles=4)
>>> env.possible_agents
['vehicle_0', 'vehicle_1', 'vehicle_2', 'vehicle_3']
>>> observations, infos = ForecastParallelEnv(env, "intersection").reset(seed=0)
"""

import warnings
from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from highway_env.envs.intersection_env import MultiAgentIntersectionEnv
from highway_env.vehicle.kinematics import Vehicle
from pettingzoo import ParallelEnv

from envs.simulators.highway_settings import check_settings
from predictor.support.errors import ProtocolError, UserError, short

INTERSECTION = "intersection-multi-agent-v2"
"""Id whose drivers react to vehicles on connected lanes, as on intersection-v2."""


class HighwayParallelEnv(ParallelEnv):
    """An intersection where "vehicle_0", "vehicle_1", … learn among highway-env's own drivers.

    **Ends.** An agent terminates when it crashes or arrives (25 m into its exit); all others are truncated at
    `duration`. A vehicle whose agent is gone keeps the idle action until it leaves the map, as traffic does; after a
    crash it stays as an obstacle. **Reward**: highway-env's for each agent. **Info**: `speed_mps`, `crashed`,
    `arrived`.

    Vehicle i comes from arm i mod 4; with more than four, two start on the same stretch of 20 m or so.

    Args:
        env_id: "intersection-multi-agent-v2", or -v1 and -v0, which differ in the vehicles that drivers react to.
        render_mode: "rgb_array", "human" or None.
        config: settings of highway-env, for example `controlled_vehicles=4` or `duration=20`; nested entries replace
            the whole default, as in highway-env.

    Attributes:
        highway: gymnasium environment that is adapted.

    Raises:
        UserError: not an id of an intersection with several agents, or a setting that it does not have.
    """

    def __init__(self, env_id: str = INTERSECTION, *, render_mode: str | None = None, **config: Any) -> None:
        """Makes the intersection; agents appear at reset."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # an older id is a choice: results are tied to it
            made = _make(env_id, config=config, render_mode=render_mode)
        if not isinstance(made, MultiAgentIntersectionEnv):
            raise UserError(f"HighwayParallelEnv needs an intersection with several agents, got '{env_id}'")
        check_settings(made, config)
        self.highway = made
        self.render_mode = render_mode
        self.metadata = {
            "name": env_id,
            "render_modes": made.metadata["render_modes"],
            "render_fps": made.config["policy_frequency"],
            "is_parallelizable": True,
        }
        self.possible_agents = [f"vehicle_{i}" for i in range(len(made.controlled_vehicles))]
        self.agents: list[str] = []
        self._observed: list[str] = []
        self._observation_spaces = dict(zip(self.possible_agents, made.observation_space, strict=True))
        self._action_spaces = dict(zip(self.possible_agents, made.action_space, strict=True))

    @property
    def vehicles(self) -> dict[str, Vehicle]:
        """Returns the vehicle of each agent of the last observations: agents that live or ended with them."""
        all_vehicles = dict(zip(self.possible_agents, self.highway.controlled_vehicles, strict=True))
        return {agent: all_vehicles[agent] for agent in self._observed}

    def observation_space(self, agent: str) -> gym.Space:
        """Returns highway-env's space for this agent, the same object at each call."""
        return self._observation_spaces[agent]

    def action_space(self, agent: str) -> gym.Space:
        """Returns highway-env's space for this agent, the same object at each call."""
        return self._action_spaces[agent]

    def idle_action(self, agent: str) -> Any:
        """Returns the action that changes nothing: highway-env's IDLE, or the middle of steering and acceleration."""
        space = self._action_spaces[agent]
        if isinstance(space, gym.spaces.Discrete):
            action_type = self.highway.action_type.agents_action_types[self.possible_agents.index(agent)]
            return getattr(action_type, "actions_indexes", {}).get("IDLE", int(space.n) // 2)
        return np.zeros(space.shape, dtype=space.dtype)

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begins an episode with all agents.

        Raises:
            UserError: `options["config"]` changed the number of agents.
        """
        observations, _ = self.highway.reset(seed=seed, options=options)
        if len(observations) != len(self.possible_agents):
            raise UserError(
                f"the environment was made with {len(self.possible_agents)} agents but its config now has "
                f"{len(observations)}; pass controlled_vehicles to HighwayParallelEnv, not to reset"
            )
        self.agents = list(self.possible_agents)
        self._observed = list(self.agents)
        return dict(zip(self.possible_agents, observations, strict=True)), self._infos()

    def step(
        self, actions: Mapping[str, Any]
    ) -> tuple[dict[str, Any], dict[str, float], dict[str, bool], dict[str, bool], dict[str, Any]]:
        """Steps all vehicles once at the policy's frequency; ignores actions of agents that are gone.

        Raises:
            ProtocolError: no agent lives: before the first reset, or after the last one is gone.
            UserError: a living agent has no action, or one that it does not have.
        """
        if not self.agents:
            raise ProtocolError("no agent is on the road; call reset() first")
        missing = [agent for agent in self.agents if agent not in actions]
        if missing:
            raise UserError(f"step needs an action for each living agent, {', '.join(missing)} had none")
        for agent in self.agents:
            space, given = self.action_space(agent), np.asarray(actions[agent])
            if isinstance(space, gym.spaces.Discrete) and not (given.size == 1 and given.item() in range(int(space.n))):
                raise UserError(f"{agent} has no action {short(repr(actions[agent]), 60)}; it has {space}")
        joint = tuple(
            actions[agent] if agent in self.agents else self.idle_action(agent) for agent in self.possible_agents
        )
        observations, _, _, truncated, info = self.highway.step(joint)
        self._clear_abandoned()
        self._observed = self.agents
        index = {agent: self.possible_agents.index(agent) for agent in self._observed}
        terminations = {agent: self._terminated(i, info) for agent, i in index.items()}
        self.agents = [agent for agent in self._observed if not (terminations[agent] or truncated)]
        return (
            {agent: observations[i] for agent, i in index.items()},
            {agent: float(info["agents_rewards"][i]) for agent, i in index.items()},
            terminations,
            dict.fromkeys(index, bool(truncated)),
            self._infos(),
        )

    def render(self) -> Any:
        """Draws the road from above, as `render_mode` says."""
        return self.highway.render()

    def close(self) -> None:
        """Closes the window, if there is one."""
        self.highway.close()

    def _terminated(self, index: int, info: dict[str, Any]) -> bool:
        off_road = self.highway.config["offroad_terminal"] and not self.highway.controlled_vehicles[index].on_road
        return bool(info["agents_terminated"][index] or off_road)

    def _clear_abandoned(self) -> None:
        """Removes vehicles without an agent at the end of the road; highway-env keeps all that had one."""
        alive = dict(zip(self.possible_agents, self.highway.controlled_vehicles, strict=True))
        for agent, vehicle in alive.items():
            end_m = vehicle.lane.length - 4 * vehicle.LENGTH  # where highway-env removes traffic
            if agent not in self.agents and self.highway.has_arrived(vehicle, end_m):
                self.highway.road.vehicles = [v for v in self.highway.road.vehicles if v is not vehicle]

    def _infos(self) -> dict[str, Any]:
        return {
            agent: {
                "speed_mps": float(vehicle.speed),
                "crashed": bool(vehicle.crashed),
                "arrived": bool(self.highway.has_arrived(vehicle)),
            }
            for agent, vehicle in self.vehicles.items()
        }


def _make(env_id: str, **kwargs: Any) -> gym.Env:
    """Returns `gym.make`'s unwrapped environment; turns Gymnasium's errors into a `UserError`."""
    try:
        return gym.make(env_id, disable_env_checker=True, **kwargs).unwrapped
    except (gym.error.Error, ModuleNotFoundError) as error:
        raise UserError(
            f"cannot make env '{env_id}': {error}; pass an intersection with several agents, such as '{INTERSECTION}'"
        ) from error
