"""Which environments are known, how to make them, and which shipped checkpoint serves which id."""

import functools
import importlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import highway_env  # noqa: F401  (registers the ids)

from envs.readers.mpe import MPE_IDS
from envs.simulators import (
    HIGHWAY_MULTIAGENT_IDS,
    mixed_traffic,  # noqa: F401  (registers the ids)
)
from envs.simulators.envpool import HIGHWAY_ENV_OF, register_envpool_ids
from predictor.errors import UserError

if TYPE_CHECKING:
    import pettingzoo  # at run time only where such an environment is made: gymnasium users need not have it

CHECKPOINTS: dict[str, str] = {
    "highway-v0": "highway",
    "highway-fast-v0": "highway",
    "two-way-v0": "two-way",
    "merge-v1": "merge",
    "merge-generic-v1": "merge-generic",
    "roundabout-v1": "roundabout",
    "roundabout-generic-v1": "roundabout-generic",
    "intersection-v2": "intersection",
    "exit-v1": "exit",
    "racetrack-v1": "racetrack",
    "racetrack-large-v1": "racetrack-large",
    "racetrack-oval-v1": "racetrack-oval",
    "u-turn-v1": "u-turn",
    "highway-mixed-v0": "highway-mixed",
}
"""Env id → name of the checkpoint under predictor/pretrained."""

ENVPOOL = "envpool/"
"""Namespace of EnvPool's native environments."""


def make_env(env_id: str, **kwargs: Any) -> gym.Env:
    """`gym.make` with a one-line error for an unknown id."""
    if env_id.startswith(ENVPOOL):
        register_envpool_ids()
    try:
        return gym.make(env_id, **kwargs)
    except (gym.error.UnregisteredEnv, gym.error.Error, ModuleNotFoundError) as error:
        raise UserError(f"cannot make env '{env_id}': {error}; known here: {', '.join(CHECKPOINTS)}") from error


def native_task_of(env_id: str) -> str:
    """EnvPool's task that re-implements a highway-env id: its own version, else the first one it has.

    Raises:
        UserError: it has none.
    """
    exact = [task for task, copied in HIGHWAY_ENV_OF.items() if copied == env_id]
    near = [task for task, copied in HIGHWAY_ENV_OF.items() if copied.rpartition("-v")[0] == env_id.rpartition("-v")[0]]
    if not exact + near:
        raise UserError(
            f"EnvPool has no copy of '{env_id}'; it has {', '.join(HIGHWAY_ENV_OF.values())}: train without "
            "--backend envpool"
        )
    return (exact + near)[0]


def checkpoint_for(env_id: str) -> str:
    """Name of the shipped checkpoint for an env id.

    Raises:
        UserError: none ships for the id.
    """
    if env_id.startswith(ENVPOOL):
        copied = HIGHWAY_ENV_OF.get(env_id.removeprefix(ENVPOOL), "").rpartition("-v")[0]
        env_id = next((known for known in CHECKPOINTS if copied and known.rpartition("-v")[0] == copied), env_id)
    if env_id not in CHECKPOINTS:
        raise UserError(
            f"no checkpoint ships for env '{env_id}'; pass one (a name or a path), or 'constant-velocity'. "
            f"Shipped ids: {', '.join(CHECKPOINTS)}"
        )
    return CHECKPOINTS[env_id]


@dataclass(frozen=True)
class ParallelEntry:
    """How to make an environment."""

    factory: str
    """"module:function" that returns a ParallelEnv."""
    kwargs: Mapping[str, Any] = field(default_factory=dict)
    """Arguments that belong to the id."""


PARALLEL_IDS: dict[str, ParallelEntry] = {
    **{env_id: ParallelEntry(f"mpe2.{env_id}:parallel_env") for env_id in MPE_IDS},
    "pursuit_v5": ParallelEntry("pettingzoo.sisl.pursuit.pursuit:parallel_env"),
    **{
        env_id: ParallelEntry("envs.simulators.highway_multiagent:HighwayParallelEnv", {"env_id": env_id})
        for env_id in HIGHWAY_MULTIAGENT_IDS
    },
}
"""Id → how to make it. simple_crypto is left out: nothing moves in it."""

PARALLEL_CHECKPOINTS: dict[str, str] = {
    "simple_tag_v3": "simple-tag",
    "simple_spread_v3": "simple-spread",
    "intersection-multi-agent-v2": "intersection",
}
"""Id → name of the checkpoint under predictor/pretrained."""


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
    from pettingzoo import ParallelEnv

    return not isinstance(factory, type) or issubclass(factory, ParallelEnv)


def make_parallel_env(env_id: str, **kwargs: Any) -> "pettingzoo.ParallelEnv":
    """Make a parallel environment.

    Args:
        env_id: one of `PARALLEL_IDS`, an id in PettingZoo's own registry ("sisl/pursuit_v5"), or "module:function" of
            a function (or class) that gives a ParallelEnv.
        kwargs: for the environment (``max_cycles``, ``continuous_actions``, …).

    Raises:
        UserError: unknown id, a missing package, or arguments that the environment refuses.
    """
    from pettingzoo import ParallelEnv
    from pettingzoo.env_registry.exceptions import PettingZooRegistryError

    make = _maker(env_id)
    try:
        env = make(**kwargs)
    except (TypeError, ValueError, AssertionError, ImportError, PettingZooRegistryError) as error:
        arguments = f" with {kwargs}" if kwargs else ""
        raise UserError(f"cannot make parallel env '{env_id}'{arguments}: {error}") from error
    if not isinstance(env, ParallelEnv):
        raise UserError(f"'{env_id}' must give a pettingzoo ParallelEnv, got {type(env).__name__}")
    return env


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


def _maker(env_id: str) -> Callable[..., Any]:
    if env_id in PARALLEL_IDS:
        entry = PARALLEL_IDS[env_id]
        return functools.partial(_load(entry.factory), **entry.kwargs)
    if ":" in env_id:
        return _load(env_id)
    if _in_pettingzoo(env_id):
        import pettingzoo

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
    import pettingzoo
    from pettingzoo.env_registry.exceptions import PettingZooRegistryError

    try:
        pettingzoo.spec("parallel", env_id)
    except PettingZooRegistryError:
        return False
    return True
