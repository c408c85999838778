"""EnvPool's C++ highway environments as gymnasium environments: `EnvPoolEnv`, which every wrapper and command takes.

`envs.sb3.envpool.EnvPoolVecEnv` steps many at once, as an SB3 VecEnv. EnvPool is an optional extra and is imported when
the first environment is made. This module only adapts: the simulation itself is EnvPool's.
"""

import functools
import importlib.metadata
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from predictor.support.errors import ProtocolError, UserError, short

HIGHWAY_ENV_OF: dict[str, str] = {
    "Highway-v0": "highway-v0",
    "HighwayFast-v0": "highway-fast-v0",
    "Exit-v0": "exit-v0",
    "Exit-v1": "exit-v1",
    "Intersection-v0": "intersection-v0",
    "Intersection-v1": "intersection-v1",
    "Intersection-v2": "intersection-v2",
    "Merge-v0": "merge-v0",
    "Merge-v1": "merge-v1",
    "MergeGeneric-v0": "merge-generic-v0",
    "MergeGeneric-v1": "merge-generic-v1",
    "Racetrack-v0": "racetrack-v0",
    "Racetrack-v1": "racetrack-v1",
    "RacetrackLarge-v0": "racetrack-large-v0",
    "RacetrackLarge-v1": "racetrack-large-v1",
    "RacetrackOval-v0": "racetrack-oval-v0",
    "RacetrackOval-v1": "racetrack-oval-v1",
    "Roundabout-v0": "roundabout-v0",
    "Roundabout-v1": "roundabout-v1",
    "RoundaboutGeneric-v0": "roundabout-generic-v0",
    "RoundaboutGeneric-v1": "roundabout-generic-v1",
    "TwoWay-v0": "two-way-v0",
    "UTurn-v0": "u-turn-v0",
    "UTurn-v1": "u-turn-v1",
}
"""EnvPool task → the highway-env id that it re-implements; docs/envpool.md says where the two differ."""

VARIED_SINCE = (1, 2, 7)
"""First release with the tasks of `ADDED`, and in which every task begins anew with each seed (Python ≥ 3.12)."""
ADDED = frozenset(task for task, copied in HIGHWAY_ENV_OF.items() if "generic" in copied or task.endswith("-v1")) - {
    "Intersection-v1"
} | {"Intersection-v2"}
"""Tasks that earlier releases do not have."""
_ONE_START = frozenset(HIGHWAY_ENV_OF) - ADDED - {"Highway-v0", "HighwayFast-v0", "Merge-v0"}

ENV_IDS: dict[str, str] = {f"envpool/{task_id}": task_id for task_id in HIGHWAY_ENV_OF if task_id != "Intersection-v1"}
"""Gymnasium id → EnvPool task."""


# Named otherwise, since gymnasium would call it a newer version of Intersection-v0: its actions are continuous.
ENV_IDS["envpool/IntersectionContinuous-v1"] = "Intersection-v1"
MAX_SEED = 2**31 - 1
_OWN_SETTINGS = (
    "num_envs", "num_threads", "batch_size", "seed", "env_seed", "max_num_players", "gym_reset_return_info",
    "base_path",
)  # fmt: skip


@dataclass(frozen=True)
class MetaActions:
    """Names of a task's discrete actions, as highway-env's `action_type` has them."""

    actions_indexes: Mapping[str, int]
    """Action by name."""


_META = MetaActions({"LANE_LEFT": 0, "IDLE": 1, "LANE_RIGHT": 2, "FASTER": 3, "SLOWER": 4})
_META_LONGITUDINAL = MetaActions({"SLOWER": 0, "IDLE": 1, "FASTER": 2})


@functools.cache
def envpool_release() -> tuple[int, ...]:
    """Returns the release of the installed EnvPool, such as (1, 2, 7); that of `VARIED_SINCE` where there is none."""
    try:
        version = importlib.metadata.version("envpool")
    except importlib.metadata.PackageNotFoundError:
        return VARIED_SINCE
    return tuple(int(part) for part in re.findall(r"\d+", version)[:3])


def known_tasks() -> tuple[str, ...]:
    """Returns the tasks of `HIGHWAY_ENV_OF` that the installed release of EnvPool has."""
    return tuple(t for t in HIGHWAY_ENV_OF if t not in ADDED or envpool_release() >= VARIED_SINCE)


def begins_alike(task_id: str) -> bool:
    """Returns whether a task begins in the same state whatever the seed: all its variety comes from the ego."""
    return task_id in _ONE_START and envpool_release() < VARIED_SINCE


def register_envpool_ids() -> None:
    """Registers the `ENV_IDS` of `known_tasks()` with gymnasium; may be called again, and does not import EnvPool."""
    tasks = known_tasks()
    for env_id, task_id in ENV_IDS.items():
        if env_id not in gym.registry and task_id in tasks:
            gym.register(env_id, entry_point=f"{__name__}:EnvPoolEnv", kwargs={"task_id": task_id})


def make_pool(task_id: str, seeds: Sequence[int], num_threads: int = 0, **settings: Any) -> Any:
    """Makes an EnvPool pool of one task, one environment per seed.

    Args:
        task_id: one of `known_tasks()`.
        seeds: seed of each environment; the first `reset` draws from it, later ones carry on.
        num_threads: number of threads of the simulation; 0 leaves it to EnvPool.
        settings: settings of the task (`duration`, `policy_frequency`, … ; docs/envpool.md), or `render_mode`.

    Raises:
        UserError: no EnvPool, an unknown task or setting, a value that a setting cannot have, or fewer than 0 threads.
    """
    if num_threads < 0:
        raise UserError(f"num_threads must be at least 0, got {num_threads}")
    if task_id not in HIGHWAY_ENV_OF:
        raise UserError(f"no EnvPool task '{task_id}' is known here; known: {', '.join(known_tasks())}")
    try:
        import envpool
    except ImportError as error:
        raise UserError(
            f"EnvPool's environments need the envpool package ({error}); pip install 'dgvae-rl[envpool]'"
        ) from error
    if task_id not in known_tasks():
        raise UserError(
            f"EnvPool {envpool.__version__} has no {task_id}; install 1.2.7 or later (Python 3.12 or later)"
        )
    known = [k for k in envpool.make_spec(task_id).config._fields if k not in _OWN_SETTINGS]
    if unknown := set(settings) - {*known, "render_mode"}:
        raise UserError(f"EnvPool's {task_id} has no setting {sorted(unknown)}; it has {', '.join(known)}")
    shown = settings.get("observation_vehicles_count", 1)
    if isinstance(shown, int) and shown < 1:  # EnvPool itself ends the process at 0
        raise UserError(f"observation_vehicles_count must be at least 1, got {shown}")
    try:
        pool = envpool.make(
            task_id,
            env_type="gymnasium",
            num_envs=len(seeds),
            seed=[seed % MAX_SEED for seed in seeds],
            num_threads=num_threads,
            **settings,
        )
    except (TypeError, ValueError) as error:
        said = "their types do not fit" if isinstance(error, TypeError) else short(error, 120)
        raise UserError(f"EnvPool's {task_id} does not take the settings {short(settings)}: {said}") from error
    if not hasattr(pool, "debug_states"):
        raise UserError(
            f"EnvPool {envpool.__version__} does not report the vehicles' positions; install 1.2.5 or later"
        )
    return pool


def checked_actions(space: gym.Space, actions: Any, num_envs: int) -> NDArray[Any]:
    """Returns one action for each environment in the type of the space; EnvPool itself ends the process at some others.

    Raises:
        UserError: another shape, numbers that are not finite, or a discrete action that does not exist.
    """
    given = np.asarray(actions)
    shape = (num_envs, *(space.shape or ()))
    if given.shape != shape:
        raise UserError(f"a step needs one action for each of {num_envs} envs, of shape {shape}, got {given.shape}")
    if isinstance(space, gym.spaces.Discrete):
        if given.dtype.kind not in "iu" or ((given < 0) | (given >= space.n)).any():
            raise UserError(f"an action must be a whole number in 0…{space.n - 1}, got {short(given.tolist())}")
    elif given.dtype.kind not in "fiu" or not np.isfinite(given).all():
        raise UserError(f"actions must be finite numbers, got {short(given.tolist())}")
    return given.astype(space.dtype)


def check_rewards(task_id: str, rewards: NDArray[Any]) -> None:
    """Checks that rewards are finite; EnvPool gives others for some states.

    Raises:
        UserError: they are not.
    """
    if not np.isfinite(rewards).all():
        raise UserError(f"EnvPool's {task_id} gave rewards that are not finite: {short(rewards.tolist())}")


def is_terminated(
    terminated: NDArray[np.bool_], truncated: NDArray[np.bool_], crashed: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Returns which environments terminated: EnvPool calls a crash in the very last step a truncation only."""
    return terminated | (truncated & crashed)


class EnvPoolEnv(gym.Env[NDArray[Any], Any]):
    """One of EnvPool's highway environments as an ordinary gymnasium environment.

        >>> register_envpool_ids()
        >>> env = gym.make("envpool/HighwayFast-v0", vehicles_count=10)

    EnvPool seeds when it is built, so a seeded reset builds anew (half a millisecond); a reset without a seed draws the
    next episode from the last one. Environment i of an `EnvPoolVecEnv` seeded with s is this one seeded with s + i.

    Args:
        task_id: a key of `HIGHWAY_ENV_OF`.
        render_mode: None or "rgb_array".
        settings: settings of the task, see `make_pool`.

    Attributes:
        task_id: as given.
        envpool_config: EnvPool's settings, defaults included.
        action_type: names of the discrete actions; None where actions are continuous.

    Raises:
        UserError: no EnvPool, an unknown task or setting.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 5}

    def __init__(self, task_id: str, render_mode: str | None = None, **settings: Any) -> None:
        """Builds the pool, which has the spaces."""
        self.task_id, self.render_mode = task_id, render_mode
        self._settings = settings if render_mode is None else {**settings, "render_mode": render_mode}
        self._pool = make_pool(task_id, [0], num_threads=1, **self._settings)
        self.envpool_config: Mapping[str, Any] = self._pool.config
        self.observation_space = self._pool.observation_space
        self.action_space = self._pool.action_space
        self.action_type = meta_actions_of(self.action_space)
        self._seeded, self._running = False, False

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begins an episode.

        Raises:
            UserError: options, of which EnvPool has none.
        """
        super().reset(seed=seed)
        if options:
            raise UserError(f"EnvPool takes no options at reset, got {sorted(options)}; pass settings to gym.make")
        if seed is not None or not self._seeded:
            first = int(self.np_random.integers(MAX_SEED)) if seed is None else seed
            self._pool = make_pool(self.task_id, [first], num_threads=1, **self._settings)
            self._seeded = True
        observations, info = self._pool.reset()
        self._running = True
        return observations[0], info_of(info, 0)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Steps the environment once at the policy's frequency.

        Raises:
            ProtocolError: before a reset or after the episode's end, where EnvPool would silently begin another.
            UserError: see `checked_actions` and `check_rewards`.
        """
        if not self._running:
            raise ProtocolError("the episode has not begun or is over; call reset() first")
        actions = checked_actions(self.action_space, np.asarray(action)[None], 1)
        observations, rewards, terminated, truncated, info = self._pool.step(actions)
        check_rewards(self.task_id, rewards)
        over = bool(is_terminated(terminated, truncated, info["crashed"])[0])
        self._running = not (over or truncated[0])
        return observations[0], float(rewards[0]), over, bool(truncated[0]), info_of(info, 0)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickles and copies an environment that was not reset yet, as the arguments of its constructor.

        Raises:
            UserError: it is running, and EnvPool's C++ state cannot be copied.
        """
        if self._seeded:
            raise UserError(
                f"a running EnvPool environment cannot be copied or pickled (its state is in C++), got {self.task_id}; "
                "copy it before the first reset, or use highway-env's own environment"
            )
        return functools.partial(EnvPoolEnv, self.task_id, **self._settings), (), {"spec": self.spec}

    def debug_states(self) -> Sequence[Any]:
        """Returns EnvPool's own description of the environment, drivers' parameters included: for readers and tests.

        Raises:
            ProtocolError: before the first reset.
        """
        if not self._seeded:
            raise ProtocolError("the environment has no vehicles yet; call reset() first")
        states: Sequence[Any] = self._pool.debug_states()
        return states

    def render(self) -> Any:
        """Returns an image of the road around the ego; None without a render mode."""
        return None if self.render_mode is None else self._pool.render()[0]


def meta_actions_of(space: gym.Space) -> MetaActions | None:
    """Returns the names of discrete actions; None where actions are continuous."""
    if not isinstance(space, gym.spaces.Discrete):
        return None
    return _META if space.n == len(_META.actions_indexes) else _META_LONGITUDINAL


def info_of(info: Mapping[str, Any], env: int) -> dict[str, Any]:
    """Returns the info of one environment of a pool."""
    return {"speed": float(info["speed"][env]), "crashed": bool(info["crashed"][env])}
