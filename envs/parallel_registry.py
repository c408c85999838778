"""Which PettingZoo parallel environments are known, how to make and read them, and which checkpoint serves which id.

The simulators themselves are imported when one is made. Environments with one ego are in `envs.registry`.
"""

import functools
import importlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import pettingzoo
from pettingzoo import ParallelEnv
from pettingzoo.env_registry.exceptions import PettingZooRegistryError

from envs.readers.base import SharedSceneReader
from envs.readers.mpe import MpeReader, is_mpe_env, mpe_scenario
from envs.readers.sisl import PursuitReader, is_pursuit_env
from predictor.errors import UserError


@dataclass(frozen=True)
class ParallelEntry:
    """How to make an environment."""

    factory: str
    """"module:function" that returns a ParallelEnv."""
    kwargs: Mapping[str, Any] = field(default_factory=dict)
    """Arguments that belong to the id."""


_MPE = (
    "simple_v3",
    "simple_spread_v3",
    "simple_tag_v3",
    "simple_adversary_v3",
    "simple_push_v3",
    "simple_world_comm_v3",
    "simple_formation_v1",
    "simple_line_v1",
    "simple_reference_v3",
    "simple_speaker_listener_v4",
    "collect_treasure_v1",
)
_HIGHWAY = ("intersection-multi-agent-v2", "intersection-multi-agent-v1", "intersection-multi-agent-v0")

PARALLEL_IDS: dict[str, ParallelEntry] = {
    **{env_id: ParallelEntry(f"mpe2.{env_id}:parallel_env") for env_id in _MPE},
    "pursuit_v5": ParallelEntry("pettingzoo.sisl.pursuit.pursuit:parallel_env"),
    **{env_id: ParallelEntry("envs.highway_parallel:HighwayParallelEnv", {"env_id": env_id}) for env_id in _HIGHWAY},
}
"""Id → how to make it. simple_crypto is left out: nothing moves in it."""

PARALLEL_CHECKPOINTS: dict[str, str] = {
    "simple_tag_v3": "simple-tag",
    "simple_spread_v3": "simple-spread",
    "intersection-multi-agent-v2": "intersection",
}
"""Id → name of the checkpoint under predictor/pretrained."""

MakeSharedReader = Callable[[Any], SharedSceneReader]
"""From a parallel environment to a reader for it."""

_REGISTERED: dict[type, MakeSharedReader] = {}


def is_parallel_id(env_id: str) -> bool:
    """Whether `make_parallel_env` knows the id: listed here, "module:function", or registered with PettingZoo.

    The module of a "module:function" is imported; gymnasium's "module:EnvId" is none of these.
    """
    if ":" not in env_id:
        return env_id in PARALLEL_IDS or _in_pettingzoo(env_id)
    try:
        factory = _load(env_id)
    except UserError:
        return False
    return not isinstance(factory, type) or issubclass(factory, ParallelEnv)


def make_parallel_env(env_id: str, **kwargs: Any) -> ParallelEnv:
    """Make a parallel environment.

    Args:
        env_id: one of `PARALLEL_IDS`, an id in PettingZoo's own registry ("sisl/pursuit_v5"), or "module:function" of
            a function (or class) that gives a ParallelEnv.
        kwargs: for the environment (``max_cycles``, ``continuous_actions``, …).

    Raises:
        UserError: unknown id, a missing package, or arguments that the environment refuses.
    """
    make = _maker(env_id)
    try:
        env = make(**kwargs)
    except (TypeError, ValueError, AssertionError, ImportError, PettingZooRegistryError) as error:
        arguments = f" with {kwargs}" if kwargs else ""
        raise UserError(f"cannot make parallel env '{env_id}'{arguments}: {error}") from error
    if not isinstance(env, ParallelEnv):
        raise UserError(f"'{env_id}' must give a pettingzoo ParallelEnv, got {type(env).__name__}")
    return env


def parallel_env_id(env: Any) -> str:
    """What to call the environment in messages: its id where it is listed here, else its own name."""
    scenario = mpe_scenario(env)
    for env_id in _MPE:
        if scenario and env_id.rpartition("_v")[0] == scenario:
            return env_id
    metadata = getattr(env, "metadata", None) or {}
    return str(metadata.get("name", type(env.unwrapped).__name__))


def parallel_checkpoint_for(env_id: str) -> str:
    """Name of the shipped checkpoint for a parallel id.

    Raises:
        UserError: none ships for the id.
    """
    if env_id not in PARALLEL_CHECKPOINTS:
        raise UserError(
            f"no checkpoint ships for parallel env '{env_id}'; pass one (a name or a path), or 'constant-velocity'. "
            f"Shipped ids: {', '.join(PARALLEL_CHECKPOINTS)}"
        )
    return PARALLEL_CHECKPOINTS[env_id]


def register_shared_reader(env_class: type, make_reader: MakeSharedReader) -> None:
    """Let every wrapper and command know how to read a parallel environment class (and what derives from it).

    Args:
        env_class: class of the unwrapped environment; of the AEC environment where PettingZoo converts one.
        make_reader: from an environment (not reset yet, wrapped or not) to its reader.
    """
    _REGISTERED[env_class] = make_reader


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
        if env_class in _REGISTERED:
            return _REGISTERED[env_class](env)
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


def _maker(env_id: str) -> Callable[..., Any]:
    if env_id in PARALLEL_IDS:
        entry = PARALLEL_IDS[env_id]
        return functools.partial(_load(entry.factory), **entry.kwargs)
    if ":" in env_id:
        return _load(env_id)
    if _in_pettingzoo(env_id):
        return functools.partial(pettingzoo.make, "parallel", env_id)
    raise UserError(
        f"unknown parallel env '{env_id}'; known: {', '.join(PARALLEL_IDS)}; others as 'module:function' or "
        "registered with pettingzoo.register('parallel', id, ...)"
    )


def _load(path: str) -> Callable[..., Any]:
    """What "module:function" names."""
    module, _, name = path.partition(":")
    try:
        factory: Callable[..., Any] | None = getattr(importlib.import_module(module), name, None)
    except (ImportError, ValueError) as error:
        raise UserError(f"cannot import '{module}' for '{path}': {error}; is its package installed?") from error
    if not callable(factory):
        raise UserError(f"module '{module}' has no function '{name}' that could make an environment")
    return factory


def _in_pettingzoo(env_id: str) -> bool:
    try:
        pettingzoo.spec("parallel", env_id)
    except PettingZooRegistryError:
        return False
    return True
