"""EnvPool's native C++ highway environments: one as a gymnasium env, many as an SB3 VecEnv at native speed.

`EnvPoolEnv` is an ordinary environment for every wrapper and command here; `EnvPoolVecEnv` steps a whole pool at once
and reports scenes as `SceneObservation` does, ready for `VecForecast`. EnvPool is an optional extra and is imported
when the first environment is made. This module only adapts: what the simulation does is EnvPool's.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvObs, VecEnvStepReturn

from envs.observation import scene_spaces
from envs.readers.envpool import HIGHWAY_ENV_OF, PoolReader, native_spec
from predictor.errors import ProtocolError, UserError
from predictor.scene import SceneBatch, SceneSpec

ENV_IDS: dict[str, str] = {f"envpool/{task_id}": task_id for task_id in HIGHWAY_ENV_OF if task_id != "Intersection-v1"}
"""Gymnasium id → EnvPool task."""
# Not a newer version of Intersection-v0, as gymnasium would tell everybody who makes that: its actions are continuous.
ENV_IDS["envpool/IntersectionContinuous-v1"] = "Intersection-v1"

_MAX_SEED = 2**31 - 1
_OWN_SETTINGS = ("num_envs", "batch_size", "seed", "env_seed", "max_num_players", "gym_reset_return_info", "base_path")


@dataclass(frozen=True)
class MetaActions:
    """Names of a task's discrete actions, as highway-env's `action_type` has them."""

    actions_indexes: Mapping[str, int]
    """Action by name."""


_META = MetaActions({"LANE_LEFT": 0, "IDLE": 1, "LANE_RIGHT": 2, "FASTER": 3, "SLOWER": 4})
_META_LONGITUDINAL = MetaActions({"SLOWER": 0, "IDLE": 1, "FASTER": 2})


def register_envpool_ids() -> None:
    """Declare `ENV_IDS` to gymnasium; may be called again, and does not import EnvPool."""
    for env_id, task_id in ENV_IDS.items():
        if env_id not in gym.registry:
            gym.register(env_id, entry_point="envs.native:EnvPoolEnv", kwargs={"task_id": task_id})


def make_pool(task_id: str, seeds: Sequence[int], num_threads: int = 0, **settings: Any) -> Any:
    """An EnvPool pool of one task, one environment per seed.

    Args:
        task_id: a key of `HIGHWAY_ENV_OF`.
        seeds: of each environment; the first `reset` draws from it, later ones carry on.
        num_threads: of the simulation; 0 leaves it to EnvPool.
        settings: of the task (`duration`, `policy_frequency`, … ; docs/envpool.md), or `render_mode`.

    Raises:
        UserError: no EnvPool, an unknown task or setting.
    """
    if task_id not in HIGHWAY_ENV_OF:
        raise UserError(f"no EnvPool task '{task_id}' is known here; known: {', '.join(HIGHWAY_ENV_OF)}")
    try:
        import envpool
    except ImportError as error:
        raise UserError(
            f"EnvPool's environments need the envpool package ({error}); pip install 'dgvae-rl[envpool]'"
        ) from error
    known = [k for k in envpool.make_spec(task_id).config._fields if k not in _OWN_SETTINGS]
    if unknown := set(settings) - {*known, "render_mode"}:
        raise UserError(f"EnvPool's {task_id} has no setting {sorted(unknown)}; it has {', '.join(known)}")
    pool = envpool.make(
        task_id,
        env_type="gymnasium",
        num_envs=len(seeds),
        seed=[seed % _MAX_SEED for seed in seeds],
        num_threads=num_threads,
        **settings,
    )
    if not hasattr(pool, "debug_states"):
        raise UserError(f"EnvPool {envpool.__version__} does not say where the vehicles are; 1.2.5 does")
    return pool


def _ends(terminated: NDArray[np.bool_], truncated: NDArray[np.bool_], crashed: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which environments terminated: EnvPool calls a crash in the very last step a truncation only."""
    return terminated | (truncated & crashed)


class EnvPoolEnv(gym.Env[NDArray[Any], Any]):
    """One of EnvPool's highway environments as an ordinary gymnasium environment.

        >>> register_envpool_ids()
        >>> env = gym.make("envpool/HighwayFast-v0", vehicles_count=10)

    EnvPool seeds when it is built, so a seeded reset builds anew (half a millisecond); a reset without a seed draws the
    next episode from the last one. Row i of an `EnvPoolVecEnv` seeded with s is this environment seeded with s + i.

    Args:
        task_id: a key of `HIGHWAY_ENV_OF`.
        render_mode: None or "rgb_array".
        settings: of the task, see `make_pool`.

    Attributes:
        task_id: as given.
        native_config: EnvPool's settings, defaults included.
        action_type: names of the discrete actions; None where actions are continuous.

    Raises:
        UserError: no EnvPool, an unknown task or setting.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 5}

    def __init__(self, task_id: str, render_mode: str | None = None, **settings: Any) -> None:
        """Build the pool, which tells the spaces."""
        self.task_id, self.render_mode = task_id, render_mode
        self._settings = settings if render_mode is None else {**settings, "render_mode": render_mode}
        self._pool = make_pool(task_id, [0], num_threads=1, **self._settings)
        self.native_config: Mapping[str, Any] = self._pool.config
        self.observation_space = self._pool.observation_space
        self.action_space = self._pool.action_space
        self.action_type = _meta_actions(self.action_space)
        self._seeded, self._running = False, False

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode.

        Raises:
            UserError: options, of which EnvPool has none.
        """
        super().reset(seed=seed)
        if options:
            raise UserError(f"EnvPool takes no options at reset, got {sorted(options)}; pass settings to gym.make")
        if seed is not None or not self._seeded:
            first = int(self.np_random.integers(_MAX_SEED)) if seed is None else seed
            self._pool = make_pool(self.task_id, [first], num_threads=1, **self._settings)
            self._seeded = True
        observations, info = self._pool.reset()
        self._running = True
        return observations[0], _info(info, 0)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """One policy step.

        Raises:
            ProtocolError: before a reset or after the episode's end, where EnvPool would silently begin another.
            UserError: a discrete action that does not exist.
        """
        if not self._running:
            raise ProtocolError("the episode has not begun or is over; call reset() first")
        space = self.action_space
        if isinstance(space, gym.spaces.Discrete) and not 0 <= int(action) < space.n:
            raise UserError(f"action must be in 0…{space.n - 1}, got {action}")
        observations, rewards, terminated, truncated, info = self._pool.step(
            np.asarray(action, dtype=space.dtype)[None]
        )
        over = bool(_ends(terminated, truncated, info["crashed"])[0])
        self._running = not (over or truncated[0])
        return observations[0], float(rewards[0]), over, bool(truncated[0]), _info(info, 0)

    def debug_states(self) -> Sequence[Any]:
        """EnvPool's own description of the environment, drivers' parameters included: for readers and tests.

        Raises:
            ProtocolError: before the first reset.
        """
        if not self._seeded:
            raise ProtocolError("the environment has no vehicles yet; call reset() first")
        states: Sequence[Any] = self._pool.debug_states()
        return states

    def render(self) -> Any:
        """The road around the ego as an image; None without a render mode."""
        return None if self.render_mode is None else self._pool.render()[0]


class EnvPoolVecEnv(VecEnv):
    """Many of EnvPool's highway environments as one SB3 VecEnv, stepped in C++.

        >>> venv = EnvPoolVecEnv("HighwayFast-v0", 64, seed=0)
        >>> venv = VecForecast(VecMonitor(venv), "highway")

    Observations are those of SB3 over `SceneObservation` over `EnvPoolEnv`, row by row; with `scenes=False` they are
    the task's own array, for a policy without foresight. Episodes restart within the step that ends them, as SB3 wants
    it: `infos[i]["terminal_observation"]` closes the old one, scene included.

    Args:
        task_id: a key of `HIGHWAY_ENV_OF`.
        num_envs: rows.
        seed: row i gets seed + i; None draws one.
        num_threads: of the simulation; 0 leaves it to EnvPool.
        scenes: whether observations carry scenes.
        perception_m: how far the egos see [m]; None takes `SceneSpec`'s default.
        max_agents: rows of a scene, the ego included; None takes `SceneSpec`'s default.
        settings: of the task, see `make_pool`.

    Raises:
        UserError: no EnvPool, an unknown task or setting, no rows.
    """

    def __init__(
        self,
        task_id: str,
        num_envs: int,
        *,
        seed: int | None = None,
        num_threads: int = 0,
        scenes: bool = True,
        perception_m: float | None = None,
        max_agents: int | None = None,
        **settings: Any,
    ) -> None:
        """Build the pool."""
        if num_envs < 1:
            raise UserError(f"num_envs must be at least 1, got {num_envs}")
        self.task_id, self._num_threads, self._settings = task_id, num_threads, settings
        first = int(np.random.default_rng().integers(_MAX_SEED)) if seed is None else seed
        self._pool = make_pool(task_id, [first + i for i in range(num_envs)], num_threads, **settings)
        self.scene_source = next(env_id for env_id, task in ENV_IDS.items() if task == task_id)
        self.scene_spec: SceneSpec = native_spec(task_id, self._pool.config, perception_m, max_agents)
        self._reader = PoolReader(self.scene_spec, num_envs) if scenes else None
        space: gym.Space = self._pool.observation_space
        if scenes:
            space = gym.spaces.Dict({"observation": space, **scene_spaces(self.scene_spec)})
        self.action_type = _meta_actions(self._pool.action_space)
        self._actions: NDArray[Any] | None = None
        self._running = False
        super().__init__(num_envs, space, self._pool.action_space)

    render_mode: str | None = None

    def reset(self) -> VecEnvObs:
        """Begin an episode in every row; after `seed(…)`, with those seeds."""
        if any(self._options):
            raise UserError("EnvPool takes no options at reset; pass settings to EnvPoolVecEnv")
        if self._seeds[0] is not None:
            seeds = [seed for seed in self._seeds if seed is not None]
            self._pool = make_pool(self.task_id, seeds, self._num_threads, **self._settings)
            self._reset_seeds()
        observations = self._begin(np.arange(self.num_envs))
        self._running, self._actions = True, None
        return observations if self._reader is not None else observations["observation"]

    def step_async(self, actions: NDArray[Any]) -> None:
        """Note the actions of the step to come.

        Raises:
            UserError: not one action per row.
        """
        if len(actions) != self.num_envs:
            raise UserError(f"a step needs one action for each of {self.num_envs} rows, got {len(actions)}")
        self._actions = np.asarray(actions)

    def step_wait(self) -> VecEnvStepReturn:
        """Step all rows; those whose episode ended begin the next one.

        Raises:
            ProtocolError: before the first reset, or without actions.
        """
        if not self._running or self._actions is None:
            raise ProtocolError("there is nothing to step; call reset() and step_async(actions) first")
        own, rewards, terminated, truncated, info = self._pool.step(self._actions)
        self._actions = None
        observations = self._observe(own, np.arange(self.num_envs))
        over = _ends(terminated, truncated, info["crashed"])
        dones, cut = over | truncated, truncated & ~over
        infos = [
            {"speed": speed, "crashed": crashed, "TimeLimit.truncated": limit}
            for speed, crashed, limit in zip(
                info["speed"].tolist(), info["crashed"].tolist(), cut.tolist(), strict=True
            )
        ]
        ended = np.flatnonzero(dones)
        if len(ended):
            for i in ended:
                closing = {key: value[i].copy() for key, value in observations.items()}
                infos[i]["terminal_observation"] = closing if self._reader is not None else closing["observation"]
            for key, value in self._begin(ended).items():
                observations[key][ended] = value
        return observations if self._reader is not None else observations["observation"], rewards, dones, infos

    def _begin(self, rows: NDArray[np.int64]) -> dict[str, NDArray[Any]]:
        """Start the next episode of some rows; their first observations."""
        own, info = self._pool.reset(rows.astype(np.int32))
        for place, row in enumerate(rows):
            self.reset_infos[row] = _info(info, place)
        return self._observe(own, rows)

    def _observe(self, own: NDArray[Any], rows: NDArray[np.int64]) -> dict[str, NDArray[Any]]:
        """Observations of some rows, in arrays that nobody else holds."""
        observations = {"observation": np.array(own)}
        if self._reader is not None:
            observations |= _batch_entries(self._reader.read(self._pool.debug_states(rows.astype(np.int32)), rows))
        return observations

    def close(self) -> None:
        """Let the pool go."""
        self._pool.close()

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """An attribute of this class, which all rows share (`scene_spec`, `scene_source`, `task_id`, …)."""
        if attr_name.startswith("_") or not hasattr(self, attr_name):
            raise AttributeError(f"the rows of EnvPoolVecEnv have no attribute '{attr_name}'")
        return [getattr(self, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Not possible: the rows live in C++."""
        raise AttributeError(f"cannot set '{attr_name}': the rows of EnvPoolVecEnv live in C++; build it anew")

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """`debug_states` is the only method that rows have: EnvPool's own description of each, for tests."""
        if method_name != "debug_states":
            raise AttributeError(f"the rows of EnvPoolVecEnv have no method '{method_name}', only debug_states")
        rows: Iterable[int] = self._get_indices(indices)
        return [[state] for state in self._pool.debug_states(list(rows))]

    def env_is_wrapped(self, wrapper_class: type[gym.Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        """Rows are never wrapped."""
        return [False for _ in self._get_indices(indices)]


def _meta_actions(space: gym.Space) -> MetaActions | None:
    if not isinstance(space, gym.spaces.Discrete):
        return None
    return _META if space.n == len(_META.actions_indexes) else _META_LONGITUDINAL


def _info(info: Mapping[str, Any], row: int) -> dict[str, Any]:
    return {"speed": float(info["speed"][row]), "crashed": bool(info["crashed"][row])}


def _batch_entries(scenes: SceneBatch) -> dict[str, NDArray[Any]]:
    """As `envs.observation.scene_entries`, for a batch."""
    return {
        "scene_states": scenes.states,
        "scene_ids": scenes.ids,
        "scene_valid": scenes.valid.astype(np.int8),
        "scene_heading_rad": scenes.heading_rad[:, None],
    }
