"""EnvPool's highway environments as one SB3 VecEnv, stepped in C++ (`envs.simulators.envpool` has the simulator)."""

from collections.abc import Iterable
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvObs, VecEnvStepReturn

from envs.observation import batch_entries, scene_spaces
from envs.readers.envpool import PoolReader, envpool_spec
from envs.simulators.envpool import (
    ENV_IDS,
    MAX_SEED,
    check_rewards,
    checked_actions,
    info_of,
    is_terminated,
    make_pool,
    meta_actions_of,
)
from predictor.scene import SceneSpec
from predictor.support.config_checks import is_whole
from predictor.support.errors import ProtocolError, UserError


class EnvPoolVecEnv(VecEnv):
    """Many of EnvPool's highway environments as one SB3 VecEnv, stepped in C++.

        >>> from stable_baselines3.common.vec_env import VecMonitor
        >>> from envs import EnvPoolVecEnv, VecForecast
        >>> venv = EnvPoolVecEnv("HighwayFast-v0", 64, seed=0)
        >>> venv = VecForecast(VecMonitor(venv), "highway")

    The observation of each env equals that of `SceneObservation` over `EnvPoolEnv`; with `scenes=False` it is the
    task's own array, for a policy without forecasts. Episodes restart within the step that ends them, as in all of
    SB3's VecEnvs: `infos[i]["terminal_observation"]` closes the old one, scene included.

    Args:
        task_id: one of `envs.simulators.envpool.known_tasks()`.
        num_envs: number of environments.
        seed: random seed: env i gets seed + i; None draws one.
        num_threads: number of threads of the simulation; 0 leaves it to EnvPool.
        scenes: whether observations carry scenes.
        perception_m: range of the egos' perception [m]; None takes `SceneSpec`'s default.
        max_agents: size of a scene, the ego included; None takes `SceneSpec`'s default.
        settings: settings of the task, see `make_pool`.

    Raises:
        UserError: no EnvPool, an unknown task or setting, num_envs below 1, or a seed below 0; numbers must be whole.
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
        """Builds the pool."""
        if not is_whole(num_envs) or num_envs < 1:
            raise UserError(f"num_envs must be a whole number from 1 on, got {num_envs!r}")
        if seed is not None and (not is_whole(seed) or seed < 0):
            raise UserError(f"seed must be a whole number from 0 on, got {seed!r}")
        self.task_id, self._num_threads, self._settings = task_id, num_threads, settings
        first = int(np.random.default_rng().integers(MAX_SEED)) if seed is None else seed
        self._pool = make_pool(task_id, [first + i for i in range(num_envs)], num_threads, **settings)
        self.scene_source = next(env_id for env_id, task in ENV_IDS.items() if task == task_id)
        self.scene_spec: SceneSpec = envpool_spec(task_id, self._pool.config, perception_m, max_agents)
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
        """Begins an episode in every env; after `seed(…)`, with those seeds."""
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
        """Keeps the actions of the next step.

        Raises:
            UserError: see `checked_actions`.
        """
        self._actions = checked_actions(self.action_space, actions, self.num_envs)

    def step_wait(self) -> VecEnvStepReturn:
        """Steps all envs; those whose episode ended begin the next one.

        Raises:
            ProtocolError: before the first reset, or without actions.
            UserError: rewards that are not finite.
        """
        if not self._running or self._actions is None:
            raise ProtocolError("there is nothing to step; call reset() and step_async(actions) first")
        own, rewards, terminated, truncated, info = self._pool.step(self._actions)
        self._actions = None
        check_rewards(self.task_id, rewards)
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

    def _begin(self, envs: NDArray[np.int64]) -> dict[str, NDArray[Any]]:
        """Begins the next episode of some envs; returns their first observations."""
        own, info = self._pool.reset(envs.astype(np.int32))
        for place, env in enumerate(envs):
            self.reset_infos[env] = info_of(info, place)
        return self._observe(own, envs)

    def _observe(self, own: NDArray[Any], envs: NDArray[np.int64]) -> dict[str, NDArray[Any]]:
        """Returns the observations of some envs, in new arrays."""
        observations = {"observation": np.array(own)}
        if self._reader is not None:
            observations |= batch_entries(self._reader.read(self._pool.debug_states(envs.astype(np.int32)), envs))
        return observations

    def close(self) -> None:
        """Closes the pool."""
        self._pool.close()

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Returns an attribute of this object, which all envs share (`scene_spec`, `scene_source`, `task_id`, …)."""
        if attr_name.startswith("_") or not hasattr(self, attr_name):
            raise AttributeError(f"the envs of EnvPoolVecEnv have no attribute '{attr_name}'")
        return [getattr(self, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Raises an AttributeError: the envs' state is in C++."""
        raise AttributeError(
            f"cannot set '{attr_name}': the envs of EnvPoolVecEnv are in C++; make a new EnvPoolVecEnv"
        )

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Calls `debug_states`, the only method of the envs: returns EnvPool's own description of each, for tests."""
        if method_name != "debug_states":
            raise AttributeError(f"the envs of EnvPoolVecEnv have no method '{method_name}', only debug_states")
        envs: Iterable[int] = self._get_indices(indices)
        return [[state] for state in self._pool.debug_states(list(envs))]

    def env_is_wrapped(self, wrapper_class: type[gym.Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        """Returns False for each env: they are never wrapped."""
        return [False for _ in self._get_indices(indices)]
