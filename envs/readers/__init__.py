"""Scene readers: how to see the agents of an environment. One module per family; `envs.readers.base` has the rules."""

from collections.abc import Callable
from typing import Any

import gymnasium as gym

from envs.readers.base import (
    Reader,
    SceneReader,
    SharedScene,
    SharedSceneReader,
    build_reader,
    perceive,
    share,
)
from envs.readers.entities import EntityRowsReader
from envs.readers.envpool import EnvPoolReader, is_envpool_env
from envs.readers.function import FunctionReader
from envs.readers.highway import HighwayReader, is_highway_env
from predictor.errors import UserError

__all__ = [
    "EntityRowsReader",
    "EnvPoolReader",
    "FunctionReader",
    "HighwayReader",
    "MakeReader",
    "Reader",
    "SceneReader",
    "SharedScene",
    "SharedSceneReader",
    "perceive",
    "reader_for",
    "register_reader",
    "share",
]

MakeReader = Callable[[Any], SceneReader]
"""From an environment to a reader for it."""

_REGISTERED: dict[type, MakeReader] = {}


def register_reader(env_class: type, make_reader: MakeReader) -> None:
    """Let every wrapper and command know how to read an environment class (and what derives from it).

    Args:
        env_class: class of the unwrapped environment.
        make_reader: from an environment (not reset yet) to its reader.
    """
    _REGISTERED[env_class] = make_reader


def reader_for(env: gym.Env, perception_m: float | None = None, max_agents: int | None = None) -> SceneReader:
    """The reader that knows this environment: registered for its class, or of a known family.

    Args:
        env: any gymnasium environment, wrapped or not.
        perception_m: how far the ego sees [m]; None takes the family's default. A registered reader sets its own.
        max_agents: rows of a scene, the ego included; None takes the family's default.

    Raises:
        UserError: no reader knows the environment.
    """
    for env_class in type(env.unwrapped).__mro__:
        if env_class in _REGISTERED:
            reader: SceneReader = build_reader(_REGISTERED[env_class], env)
            return reader
    if is_highway_env(env):
        return HighwayReader(env, perception_m=perception_m, max_agents=max_agents)
    if is_envpool_env(env):
        return EnvPoolReader(env, perception_m=perception_m, max_agents=max_agents)
    raise UserError(
        f"no scene reader knows {type(env.unwrapped).__name__}; pass reader= (FunctionReader for a function "
        "read(env) -> Scene, EntityRowsReader for observations whose rows are entities, or an own Reader), or call "
        "register_reader for its class; see docs/wrap_your_env.md"
    )
