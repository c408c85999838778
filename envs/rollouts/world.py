"""A running environment with its driver and its true scenes, for collection and evaluation.

`EgoWorld` (gymnasium, one ego) and `MultiagentWorld` (PettingZoo, many learners) have one interface. Scenes come out of
the wrappers that a policy is trained with, so that the deployed scenes are recorded and measured.
"""

import functools
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from envs.drivers.all_agents import Driver, has_heuristic, make_driver
from envs.drivers.ego import make_ego_driver
from envs.drivers.trained import (
    env_for_driver,
    parallel_env_for_driver,
    require_view,
    sees_forecasts,
    trained_driver,
    wrapper_options,
)
from envs.own_observation import without_added
from envs.parallel import ForecastParallelEnv, living
from envs.readers import multiagent_env_id, outcome_keys
from envs.readers.base import SceneReader
from envs.readers.highway import is_highway_env
from envs.readers.highway_labels import SceneLabels, read_labels
from envs.registry import (
    ENVS,
    HEURISTIC_DRIVERS,
    arguments_of,
    checkpoint_for,
    entry_for,
    is_multiagent_id,
    make_env,
    make_multiagent_env,
)
from envs.rollouts.own_view import OwnParallelView, OwnView, own_view
from envs.seeding import driver_rng
from envs.simulators.interventions import drop_all, generator_of
from envs.supervision import Place, named
from envs.wrappers import ForecastObservation, SceneObservation
from predictor.checkpoint import CONSTANT_VELOCITY
from predictor.scene import Forecast, Scene, SceneSpec


class EgoWorld:
    """Gymnasium environment with one ego.

    Args:
        env: environment in `SceneObservation` or `ForecastObservation`.
        driver: name of a driver from `envs.drivers.ego`, or the path of a policy .zip.
        env_id: id in messages; None takes the environment's.

    Attributes:
        crashed: whether the environment has reported a crash of the ego in this episode; None if it reports none.
        cut: whether a time limit has ended this episode.
    """

    def __init__(self, env: SceneObservation | ForecastObservation, driver: str, env_id: str | None = None) -> None:
        """Keeps environment and driver; resets nothing."""
        self.env: Any = env
        self._place, self._id = Place(), env_id or (env.spec.id if env.spec else type(env.unwrapped).__name__)
        self._name = driver
        self._reader: SceneReader = env.get_wrapper_attr("reader")
        self._whole = driver.endswith(".zip") and sees_forecasts(driver)
        self.observation: dict[str, Any] = {}
        self._keys = outcome_keys(env)
        self.crashed: bool | None = None
        self.cut = False

    @property
    def spec(self) -> SceneSpec:
        """Layout of the scenes."""
        return self._reader.spec

    def reset(self, seed: int) -> None:
        """Begins the episode of a seed.

        Raises:
            EnvironmentFailedError: the environment raised.
        """
        self._place.begin(seed)
        with named(self._id, self._place):
            self.observation, _ = self.env.reset(seed=seed)
        self.crashed, self.cut = None, False
        self._rng = driver_rng(seed)
        self._ego = make_ego_driver(self._name, self.env, self._rng)

    def drive(self, driver: str) -> None:
        """Lets another driver, one that needs no forecasts, act from the next reset on.

        Raises:
            UserError: see `make_ego_driver`.
        """
        make_ego_driver(driver, self.env, np.random.default_rng(0))
        self._name, self._whole = driver, False

    def hand_over(self, driver: Callable[[Any], Any]) -> None:
        """Lets another driver act from now on, until the next reset: a function from observations to actions."""
        self._ego = driver

    def step(self) -> bool:
        """Lets the ego act; returns whether the episode is over.

        Raises:
            EnvironmentFailedError: the environment raised, or its driver.
        """
        self._place.move()
        with named(self._id, self._place):
            self.observation, _, terminated, truncated, info = self.env.step(self._ego(self._seen()))
        crashed = self._keys.crashed(info)
        if crashed is not None:
            self.crashed = bool(self.crashed) or crashed
        self.cut = bool(truncated and not terminated)
        return bool(terminated or truncated)

    def generators(self) -> list[np.random.Generator]:
        """Random streams of simulator and driver."""
        own = generator_of(self.env)
        return [self._rng] if own is None else [self._rng, own]

    def reread(self) -> tuple[Scene, Scene]:
        """Reads anew what the ego perceives and all agents, without a step: after an intervention at once."""
        return self._reader.read(self.env), _unpadded(self._reader.read_all(self.env))

    def perceived(self) -> Scene:
        """Returns the scene that forecasters get: what the ego perceives, padded."""
        scene: Scene = self.env.scene
        return scene

    def full_scene(self) -> Scene:
        """Returns all agents that are there, ego first, in arrays of its own: a reader may give the simulator's."""
        with named(self._id, self._place):
            return _unpadded(self._reader.read_all(self.env))

    def forecast(self, num_samples: int) -> Forecast:
        """Returns the deployed forecast of the perceived scene, from the wrapper's own stream: a batch of one."""
        assert isinstance(self.env, ForecastObservation)
        return self.env.stream.again(num_samples)

    def labels(self) -> SceneLabels | None:
        """Returns leaders and followers in highway-env; None elsewhere."""
        return read_labels(self.env) if is_highway_env(self.env) else None

    def close(self) -> None:
        """Closes the environment."""
        self.env.close()

    def _seen(self) -> Any:
        """Returns the driver's observation: the env's own, or with the forecasts that it was trained on."""
        if not self._whole:
            return without_added(self.observation)
        aside = own_view(self.env)
        return self.observation if aside is None else aside.whole


class MultiagentWorld:
    """PettingZoo parallel environment with a driver of all agents.

    Args:
        env: environment in `ForecastParallelEnv`.
        driver: name of a driver from `envs.drivers.all_agents`, or the path of a policy .zip.
        env_id: id in messages; None takes the environment's.
    """

    def __init__(self, env: ForecastParallelEnv, driver: str, env_id: str | None = None) -> None:
        """Keeps the environment and checks that the driver fits; resets nothing."""
        self.env: Any = env
        self._place, self._id = Place(), env_id or multiagent_env_id(env)
        self._name = driver
        self._observations: dict[str, Any] = {}
        self._make_driver(np.random.default_rng(0))

    @property
    def spec(self) -> SceneSpec:
        """Layout of the scenes."""
        return self.env.scene_spec

    def reset(self, seed: int) -> None:
        """Begins the episode of a seed.

        Raises:
            EnvironmentFailedError: the environment raised.
        """
        drop_all(self.env)
        self._place.begin(seed)
        with named(self._id, self._place):
            self._observations, _ = self.env.reset(seed=seed)
        self._rng = driver_rng(seed)
        self._driver = self._make_driver(self._rng)

    def drive(self, driver: str) -> None:
        """Lets another driver, one that needs no forecasts, act from the next reset on.

        Raises:
            UserError: see `make_driver`.
        """
        make_driver(driver, self.env, np.random.default_rng(0))
        self._name = driver

    def step(self) -> bool:
        """Lets all agents act; returns whether the episode is over.

        Raises:
            EnvironmentFailedError: the environment raised, or a driver.
        """
        aside, seen = own_view(self.env), self._observations
        if not self._name.endswith(".zip"):
            seen = {name: without_added(entries) for name, entries in seen.items()}
        elif aside is not None:
            seen = aside.whole
        self._place.move()
        with named(self._id, self._place):
            self._observations, _, terminated, truncated, _ = self.env.step(self._driver(seen))
        return not living(self.env, terminated, truncated)

    def generators(self) -> list[np.random.Generator]:
        """Random streams of simulator and drivers; agents have streams of their own beside them."""
        own = generator_of(self.env)
        return [self._rng] if own is None else [self._rng, own]

    def reread(self) -> tuple[Scene, Scene]:
        """Reads all agents anew, padded and unpadded."""
        scene = self.env.reader.read(self.env).scene
        return scene, _unpadded(scene)

    def perceived(self) -> Scene:
        """Returns all agents, padded; none is the ego."""
        return self.env.scene.scene

    def full_scene(self) -> Scene:
        """Returns all agents."""
        return _unpadded(self.env.scene.scene)

    def forecast(self, num_samples: int) -> Forecast:
        """Returns the forecast of all agents, from the wrapper's own stream."""
        return self.env.stream.again(num_samples)

    def labels(self) -> SceneLabels | None:
        """Returns None: no simulator with many learners has true edges."""
        return None

    def close(self) -> None:
        """Closes the environment."""
        self.env.close()

    def _make_driver(self, rng: np.random.Generator) -> Driver:
        if not self._name.endswith(".zip"):
            return make_driver(self._name, self.env, rng)
        aside = own_view(self.env)
        return trained_driver(self._name, self.env if aside is None else aside.env, rng)


World = EgoWorld | MultiagentWorld
"""Environment with its drivers."""


def open_world(
    env_id: str,
    driver: str,
    checkpoint: str | None = None,
    *,
    horizon_steps: int | None = None,
    perceived_as: SceneSpec | None = None,
    env_kwargs: str = "",
) -> World:
    """Makes an environment with a driver, and with forecasts if a checkpoint is given.

    Args:
        env_id: id of a gymnasium or a PettingZoo parallel environment.
        driver: name of a driver of the ego (`envs.drivers.ego`) or of all agents (`envs.drivers.all_agents`); or the
            path of a policy .zip, which gets the forecasts that it was trained on, beside those of `checkpoint`.
        checkpoint: checkpoint of the forecasts; None makes no forecasts for an ego, and for many learners those that
            the driver was trained on, or constant velocity.
        horizon_steps: number of steps to forecast.
        perceived_as: layout whose `perception_m` and `max_agents` bound what an ego perceives, where no forecasts are
            made; None takes the reader's.
        env_kwargs: arguments of the environment, as the text of a JSON object.

    Raises:
        UserError: unknown env, driver or checkpoint, ones that do not fit together, or arguments that the environment
            refuses.
    """
    kwargs = arguments_of(env_kwargs)
    if is_multiagent_id(env_id):
        parallel = parallel_env_for_driver(make_multiagent_env(env_id, **kwargs), driver)
        if checkpoint is None and horizon_steps is None and isinstance(parallel, ForecastParallelEnv):
            return MultiagentWorld(parallel, driver, env_id)
        if isinstance(parallel, ForecastParallelEnv):
            parallel = OwnParallelView(parallel)
        checkpoint = checkpoint or (checkpoint_for(env_id) if sees_forecasts(driver) else CONSTANT_VELOCITY)
        return MultiagentWorld(ForecastParallelEnv(parallel, checkpoint, horizon_steps=horizon_steps), driver, env_id)
    env = make_env(env_id, disable_env_checker=True, **kwargs)
    if checkpoint is None:
        seen = env_for_driver(env, driver)
        if not isinstance(seen, ForecastObservation):
            bounds = () if perceived_as is None else (perceived_as.perception_m, perceived_as.max_agents)
            seen = SceneObservation(seen, *bounds)
        world = EgoWorld(seen, driver, env_id)
    else:
        own = sees_forecasts(driver) and wrapper_options(driver)
        below = OwnView(env_for_driver(env, driver)) if own else env
        measured = ForecastObservation(below, checkpoint, horizon_steps=horizon_steps)
        if not own:  # a policy without a note sees what is measured
            require_view(measured if sees_forecasts(driver) else env, driver)
        world = EgoWorld(measured, driver, env_id)
    make_ego_driver(driver, world.env, np.random.default_rng(0))
    return world


def open_to_look(env_id: str, driver: str, env_kwargs: str = "") -> World:
    """Makes an environment that is looked at and not played: in place of a trained policy an idle ego drives.

    Raises:
        UserError: see `open_world`.
    """
    return open_world(env_id, "idle" if driver.endswith(".zip") else driver, env_kwargs=env_kwargs)


def _unpadded(scene: Scene) -> Scene:
    """Returns the agents that are there, in arrays of their own."""
    there = scene.valid
    return replace(scene, states=scene.states[there], ids=scene.ids[there], valid=there[there])


def default_drivers(env_id: str, env_kwargs: str = "") -> tuple[str, ...]:
    """Returns the drivers that take turns in data collection by default; the first one drives in evaluation.

    Args:
        env_id: id of the environment.
        env_kwargs: arguments of the environment, as the text of a JSON object.

    Raises:
        UserError: a parallel environment cannot be made.
    """
    if env_id in ENVS or not is_multiagent_id(env_id):
        return entry_for(env_id).drivers
    return HEURISTIC_DRIVERS if _has_heuristic(env_id, env_kwargs) else entry_for(env_id).drivers


@functools.cache
def _has_heuristic(env_id: str, env_kwargs: str) -> bool:
    env = make_multiagent_env(env_id, **arguments_of(env_kwargs))
    try:
        return has_heuristic(env)
    finally:
        env.close()
