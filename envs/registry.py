"""Which environments are known, how to make them, and which shipped checkpoint serves which id."""

from typing import Any

import gymnasium as gym
import highway_env  # noqa: F401  (registers the ids)

from envs import scenarios  # noqa: F401  (registers the ids)
from envs.readers.envpool import HIGHWAY_ENV_OF
from predictor.errors import UserError

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
        from envs.native import register_envpool_ids  # needs what needs this module

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
