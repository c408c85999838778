"""Scene readers, and which one reads an environment. One module per family; `envs.readers.base` has the interfaces.

A `SceneReader` serves a Gymnasium environment with one ego, a `MultiagentReader` a PettingZoo environment. Both kinds
are registered with `register_reader`, and checked alike when they are made.
"""

from importlib.metadata import EntryPoint, entry_points
from types import ModuleType
from typing import Any

import gymnasium as gym

from envs.readers.base import (
    MakeReader,
    MultiagentReader,
    MultiagentScene,
    Reader,
    SceneReader,
    bounded,
    build_multiagent_reader,
    build_reader,
    check_bounds,
    check_registration,
    comes_from,
    pad_multiagent_scene,
    perceive,
)
from envs.readers.entities import EntityRowsReader
from envs.readers.envpool import EnvPoolReader, is_envpool_env
from envs.readers.function import FunctionReader
from envs.readers.highway import HighwayReader, is_highway_env
from envs.readers.mpe import MPE_IDS, MpeReader, is_mpe_env, mpe_scenario
from envs.readers.outcomes import OutcomeKeys, outcome_keys, register_outcomes
from envs.readers.pursuit import PursuitReader, is_pursuit_env
from envs.simulators import costly_collisions, mixed_traffic  # noqa: F401  (register ids, as highway-env does)
from predictor.support.errors import UserError

__all__ = [
    "EntityRowsReader",
    "EnvPoolReader",
    "FunctionReader",
    "HighwayReader",
    "MakeReader",
    "MultiagentReader",
    "MultiagentScene",
    "OutcomeKeys",
    "Reader",
    "SceneReader",
    "multiagent_env_id",
    "multiagent_reader_for",
    "outcome_keys",
    "pad_multiagent_scene",
    "perceive",
    "reader_for",
    "register_reader",
]

_REGISTERED: dict[type, MakeReader] = {}
GROUP = "dgvae_rl.readers"
"""Group of entry points under which installed packages register readers."""


def register_reader(
    env_class: type, make_reader: MakeReader, *, crash_key: str | None = None, success_key: str | None = None
) -> None:
    """Registers a reader for an environment class and what derives from it, for every wrapper and command.

    Args:
        env_class: class of the unwrapped environment; of the AEC environment where PettingZoo converts one.
        make_reader: takes an environment (not reset yet, wrapped or not) and returns its reader: a `SceneReader` for
            Gymnasium environments, a `MultiagentReader` for PettingZoo's.
        crash_key: key of the infos that says whether the ego has crashed; a point leads into a nested dict
            ("outcome.collided"). None: tables say "not reported", since no key is guessed.
        success_key: key that says, in an episode's last step, whether the ego has succeeded; None takes "is_success".

    Raises:
        UserError: the class is none, the reader's maker cannot be called, a key is empty, or one is given for a
            PettingZoo environment, of which no crashes are counted.
    """
    check_registration(env_class, make_reader, "reader")
    packages = {kind.__module__.partition(".")[0] for kind in env_class.__mro__}
    if "pettingzoo" in packages and (crash_key, success_key) != (None, None):
        raise UserError(
            f"crash_key and success_key are for environments with one ego, but {env_class.__name__} is PettingZoo's, "
            "of which results have returns alone; leave them out"
        )
    register_outcomes(env_class, crash_key, success_key)
    _REGISTERED[env_class] = make_reader


def reader_for(env: gym.Env, perception_m: float | None = None, max_agents: int | None = None) -> SceneReader:
    """Returns the reader for an environment with one ego: the one registered for its class, or of a known family.

    Args:
        env: any Gymnasium environment, wrapped or not.
        perception_m: range of the ego's perception [m]; None takes the family's or the registered reader's.
        max_agents: size of a scene, the ego included; None takes the family's or the registered reader's.

    Raises:
        UserError: no reader knows the environment, the registered one is a `MultiagentReader`, or it is no `Reader` and
            has other bounds.
    """
    check_bounds(perception_m, max_agents)
    make_reader = _registered(env)
    if make_reader is not None:
        reader: SceneReader = bounded(build_reader(make_reader, env), perception_m, max_agents)
        return reader
    if is_highway_env(env):
        return HighwayReader(env, perception_m=perception_m, max_agents=max_agents)
    if is_envpool_env(env):
        return EnvPoolReader(env, perception_m=perception_m, max_agents=max_agents)
    if _find_plugged(env):
        return reader_for(env, perception_m, max_agents)
    raise UserError(
        f"no scene reader knows {type(env.unwrapped).__name__}; pass reader= (FunctionReader for a function "
        "read(env) -> Scene, EntityRowsReader for observations whose rows are entities, or an own Reader), or call "
        "register_reader for its class; see docs/wrap_your_env.md, or do without forecasts (--observe none)"
    )


def multiagent_reader_for(
    env: Any, perception_m: float | None = None, max_agents: int | None = None
) -> MultiagentReader:
    """Returns the reader for a PettingZoo environment: registered for its class, its own, or of a known family.

    Args:
        env: a parallel environment, wrapped or not.
        perception_m: range of an agent's perception [m]; None takes the family's default. A registered reader sets its
            own.
        max_agents: size of a scene; None takes the family's default. A registered reader sets its own.

    Raises:
        UserError: no reader knows the environment, or the registered one is for an environment with one ego.
    """
    check_bounds(perception_m, max_agents)
    make_reader = _registered(env)
    if make_reader is not None:
        reader: MultiagentReader = build_multiagent_reader(make_reader, env)
        return reader
    if comes_from(env, f"{__package__.rpartition('.')[0]}.simulators.highway_multiagent"):
        from envs.readers.highway_multiagent import HighwayMultiagentReader  # needs PettingZoo

        return HighwayMultiagentReader(env, perception_m, max_agents)
    if getattr(env, "make_scene_reader", None) is not None:
        given = {"perception_m": perception_m, "max_agents": max_agents}

        def make_scene_reader(env: Any) -> Any:
            return env.make_scene_reader(**{name: value for name, value in given.items() if value is not None})

        reader = build_multiagent_reader(make_scene_reader, env)
        return reader
    if is_mpe_env(env):
        return MpeReader(env, max_agents=max_agents, perception_m=perception_m)
    if is_pursuit_env(env):
        return PursuitReader(env, max_agents=max_agents, perception_m=perception_m)
    if _find_plugged(env):
        return multiagent_reader_for(env, perception_m, max_agents)
    raise UserError(
        f"no scene reader knows {multiagent_env_id(env)}; pass reader= (any MultiagentReader), give the environment a "
        "make_scene_reader() method, or call register_reader for its class; see docs/wrap_your_env.md"
    )


def multiagent_env_id(env: Any) -> str:
    """Returns the name of a PettingZoo environment for messages: its id where it is listed here, else its own name."""
    scenario = mpe_scenario(env)
    for env_id in MPE_IDS:
        if scenario and env_id.rpartition("_v")[0] == scenario:
            return env_id
    metadata = getattr(env, "metadata", None) or {}
    return str(metadata.get("name", type(env.unwrapped).__name__))


def _find_plugged(env: Any) -> bool:
    """Registers the reader that an installed package has for the environment's class; returns whether there is one.

    The name of the entry point is the class or a module or package above it ("crossing_env", "crossing_env.Crossing"),
    so that no package is imported but for its environments. It leads to what `register_reader` takes, or to a module
    that registers its readers.

    Raises:
        UserError: it cannot be imported.
    """
    known = {point.name: point for point in entry_points(group=GROUP)}
    for kind in type(env.unwrapped).__mro__:
        path = f"{kind.__module__}.{kind.__qualname__}"
        while path:
            if path in known:
                _load_plugged(known[path], kind)
                return _registered(env) is not None
            path = path.rpartition(".")[0]
    return False


def _load_plugged(point: EntryPoint, kind: type) -> None:
    try:
        found = point.load()
    except (ImportError, AttributeError) as error:
        raise UserError(
            f"the reader for {kind.__name__} cannot be imported from {point.value} (entry point '{point.name}' of the "
            f"group {GROUP}): {error}"
        ) from error
    if not isinstance(found, ModuleType):
        register_reader(kind, found)


def _registered(env: Any) -> MakeReader | None:
    return next((_REGISTERED[kind] for kind in type(env.unwrapped).__mro__ if kind in _REGISTERED), None)
