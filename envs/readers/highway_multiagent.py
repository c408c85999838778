"""Reads scenes out of highway-env's intersection with several learners (`envs.simulators.highway_multiagent`)."""

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from pettingzoo import ParallelEnv

from envs.readers.base import MultiagentScene, pad_multiagent_scene
from envs.readers.highway import HighwayReader
from envs.simulators.highway_multiagent import HighwayParallelEnv
from predictor.scene import SceneSpec
from predictor.support.errors import UserError


class HighwayMultiagentReader:
    """Reads every vehicle on the road of a `HighwayParallelEnv`, learners and traffic; none is the ego.

    `index_of` names an agent as long as it is observed, its last observation included; its vehicle stays in the scene.

    Args:
        env: the environment, wrapped or not.
        perception_m: range of an agent's perception [m]; None takes `SceneSpec`'s default.
        max_agents: size of a scene; None takes as many as the config can bring into one episode.

    Raises:
        UserError: not a `HighwayParallelEnv`.
    """

    def __init__(self, env: ParallelEnv, perception_m: float | None = None, max_agents: int | None = None) -> None:
        """Derives the spec from the environment."""
        if not isinstance(env.unwrapped, HighwayParallelEnv):
            raise UserError(f"HighwayMultiagentReader needs a HighwayParallelEnv, got {type(env.unwrapped).__name__}")
        highway = env.unwrapped.highway
        size = most_vehicles(highway.config) if max_agents is None else max_agents
        self._reader = HighwayReader(highway, perception_m, size)
        self._spec = replace(self._reader.spec, has_ego=False)

    @property
    def spec(self) -> SceneSpec:
        """Returns the layout of the scenes."""
        return self._spec

    def reset(self) -> None:
        """Forgets all identities; numbering starts anew, so equal seeds give equal ids."""
        self._reader.reset()

    def read(self, env: ParallelEnv) -> MultiagentScene:
        """Returns all vehicles on the road now."""
        inner: HighwayParallelEnv = env.unwrapped
        vehicles = inner.highway.road.vehicles
        index = {vehicle: i for i, vehicle in enumerate(vehicles)}
        indices = {agent: index[vehicle] for agent, vehicle in inner.vehicles.items()}
        headings = np.array([float(vehicle.heading) for vehicle in vehicles])
        full = self._reader.read_vehicles(inner.highway, vehicles)
        return pad_multiagent_scene(full, indices, headings, self._spec, type(self).__name__)

    def body_of(self, env: ParallelEnv, agent: int) -> Any:
        """Returns the vehicle on the road with this id; None if there is none."""
        return self._reader.body_of(env.unwrapped.highway, agent)


def most_vehicles(config: Mapping[str, Any]) -> int:
    """Returns the most vehicles that a config can bring to the intersection: those at the start, one more per step."""
    spawned = math.ceil(config["duration"] * config["policy_frequency"]) + 1  # highway-env's clock rounds
    return int(config["initial_vehicle_count"] + config["controlled_vehicles"] + spawned)
