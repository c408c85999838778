"""EnvPool's highway environments as one SB3 VecEnv, stepped in C++ (`envs.simulators.envpool` has the simulator)."""

from collections.abc import Iterable
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvObs, VecEnvStepReturn

from envs.observation import batch_entries, scene_spaces
from envs.readers.envpool import PoolReader, native_spec
from envs.simulators.envpool import ENV_IDS, MAX_SEED, info_of, is_terminated, make_pool, meta_actions_of
from predictor.scene import SceneSpec
from predictor.support.errors import ProtocolError, UserError


class EnvPoolVecEnv(VecEnv):
    """Many of EnvPool's highway environments as one SB3 VecEnv, stepped in C++.

        >>> from stable_baselines3.common.vec_env import VecMonitor
        >>> from envs import EnvPoolVecEnv, VecForecast
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
        first = int(np.random.default_rng().integers(MAX_SEED)) if seed is None else seed
        self._pool = make_pool(task_id, [first + i for i in range(num_envs)], num_threads, **settings)
        self.scene_source = next(env_id for env_id, task in ENV_IDS.items() if task == task_id)
        self.scene_spec: SceneSpec = native_spec(task_id, self._pool.config, perception_m, max_agents)
        self._reader = PoolReader(self.scene_spec, num_envs) if scenes else None
        space: gym.Space = self._pool.observation_space
        if scenes:
            space = gym.spaces.Dict({"observation": space, **scene_spaces(self.scene_spec)})
        self.action_type = meta_actions_of(self._pool.action_space)
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
        over = is_terminated(terminated, truncated, info["crashed"])
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
            self.reset_infos[row] = info_of(info, place)
        return self._observe(own, rows)

    def _observe(self, own: NDArray[Any], rows: NDArray[np.int64]) -> dict[str, NDArray[Any]]:
        """Observations of some rows, in arrays that nobody else holds."""
        observations = {"observation": np.array(own)}
        if self._reader is not None:
            observations |= batch_entries(self._reader.read(self._pool.debug_states(rows.astype(np.int32)), rows))
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
