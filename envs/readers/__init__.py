"""Scene readers: how to see the agents of an environment. One module per family; `envs.readers.base` has the rules."""

from collections.abc import Callable
from typing import Any

import gymnasium as gym

from envs.readers.base import Reader, SceneReader, SharedScene, SharedSceneReader, build_reader, perceive, share
from envs.readers.entities import EntityRowsReader
from envs.readers.envpool import EnvPoolReader, is_envpool_env
from envs.readers.function import FunctionReader
from envs.readers.highway import HighwayReader, is_highway_env
from envs.readers.mpe import MPE_IDS, MpeReader, is_mpe_env, mpe_scenario
from envs.readers.pursuit import PursuitReader, is_pursuit_env
from predictor.errors import UserError

MakeSharedReader = Callable[[Any], SharedSceneReader]
"""From a parallel environment to a reader for it."""

_SHARED_REGISTERED: dict[type, MakeSharedReader] = {}
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


def parallel_env_id(env: Any) -> str:
    """What to call the environment in messages: its id where it is listed here, else its own name."""
    scenario = mpe_scenario(env)
    for env_id in MPE_IDS:
        if scenario and env_id.rpartition("_v")[0] == scenario:
            return env_id
    metadata = getattr(env, "metadata", None) or {}
    return str(metadata.get("name", type(env.unwrapped).__name__))


def register_shared_reader(env_class: type, make_reader: MakeSharedReader) -> None:
    """Let every wrapper and command know how to read a parallel environment class (and what derives from it).

    Args:
        env_class: class of the unwrapped environment; of the AEC environment where PettingZoo converts one.
        make_reader: from an environment (not reset yet, wrapped or not) to its reader.
    """
    _SHARED_REGISTERED[env_class] = make_reader


def shared_reader_for(env: Any, perception_m: float | None = None, max_agents: int | None = None) -> SharedSceneReader:
    """The reader that knows this environment: registered for its class, its own, or of a known family.

    Args:
        env: a parallel environment, wrapped or not.
        perception_m: how far an agent sees [m]; None takes the family's default. A registered reader sets its own.
        max_agents: rows of a scene; None takes the family's default. A registered reader sets its own.

    Raises:
        UserError: no reader knows the environment.
    """
    for env_class in type(env.unwrapped).__mro__:
        if env_class in _SHARED_REGISTERED:
            return _SHARED_REGISTERED[env_class](env)
    from envs.readers.highway_multiagent import (
        HighwaySharedReader,
    )  # brings PettingZoo, which other readers do not need
    from envs.simulators.highway_multiagent import HighwayParallelEnv

    if isinstance(env.unwrapped, HighwayParallelEnv):
        return HighwaySharedReader(env, perception_m, max_agents)
    own = getattr(env, "make_scene_reader", None)
    if own is not None:
        given = {"perception_m": perception_m, "max_agents": max_agents}
        reader: SharedSceneReader = own(**{name: value for name, value in given.items() if value is not None})
        return reader
    if is_mpe_env(env):
        return MpeReader(env, max_agents=max_agents, perception_m=perception_m)
    if is_pursuit_env(env):
        return PursuitReader(env, max_agents=max_agents, perception_m=perception_m)
    raise UserError(
        f"no scene reader knows {parallel_env_id(env)}; pass reader= (any SharedSceneReader), give the environment a "
        "make_scene_reader() method, or call register_shared_reader for its class; see docs/wrap_your_env.md"
    )
