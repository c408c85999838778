"""A running environment, who drives it, and what is true in it: for collection and for evaluation.

Hides whether there is one ego (gymnasium) or many learners (PettingZoo). Scenes come out of the same wrappers that a
policy is trained with, so what is recorded and measured is what is deployed.
"""

import functools
from typing import Any, Protocol, runtime_checkable

import numpy as np

from envs.drivers.all_agents import Driver, make_driver
from envs.drivers.ego import make_ego_driver
from envs.drivers.trained import (
    env_for_driver,
    forecaster_of,
    require_forecaster,
    require_view,
    sees_forecasts,
    trained_driver,
)
from envs.parallel import ForecastParallelEnv
from envs.readers.base import SceneReader
from envs.readers.highway import is_highway_env
from envs.readers.highway_labels import SceneLabels, read_labels
from envs.registry import (
    ENVS,
    HEURISTIC_DRIVERS,
    checkpoint_for,
    entry_for,
    is_multiagent_id,
    make_env,
    make_multiagent_env,
)
from envs.seeding import driver_rng
from envs.wrappers import ForecastObservation, SceneObservation
from predictor.checkpoint import CONSTANT_VELOCITY
from predictor.scene import Scene, SceneSpec
from predictor.support.errors import UserError


@runtime_checkable
class World(Protocol):
    """One environment with its drivers."""

    @property
    def spec(self) -> SceneSpec:
        """Layout of its scenes."""

    def reset(self, seed: int) -> None:
        """Begin the episode of a seed: environment and drivers are a function of it."""

    def step(self) -> bool:
        """Let all agents act once; returns whether the episode is over."""

    def perceived(self) -> Scene:
        """The scene as forecasters get it, padded."""

    def full_scene(self) -> Scene:
        """Returns all agents that are there, unpadded: the truth."""

    def labels(self) -> SceneLabels | None:
        """True edges between the agents of `full_scene`, where the simulator knows them."""

    def close(self) -> None:
        """Close the environment."""


class EgoWorld:
    """A gymnasium environment with one ego.

    Args:
        env: wrapped in `SceneObservation` or `ForecastObservation`.
        ego: name of an ego from `envs.drivers.ego`, or the path of a policy .zip.
    """

    def __init__(self, env: SceneObservation | ForecastObservation, ego: str) -> None:
        """Nothing is reset yet."""
        self.env = env
        self._name = ego
        self._reader: SceneReader = env.get_wrapper_attr("reader")
        self._whole = ego.endswith(".zip") and sees_forecasts(ego)
        self.observation: dict[str, Any] = {}

    @property
    def spec(self) -> SceneSpec:
        """Layout of its scenes."""
        return self._reader.spec

    def reset(self, seed: int) -> None:
        """Begin the episode of a seed."""
        self.observation, _ = self.env.reset(seed=seed)
        self._ego = make_ego_driver(self._name, self.env, driver_rng(seed))

    def step(self) -> bool:
        """Let the ego act."""
        self.observation, _, terminated, truncated, _ = self.env.step(self._ego(self._seen()))
        return bool(terminated or truncated)

    def perceived(self) -> Scene:
        """What the ego perceives."""
        scene: Scene = self.env.scene
        return scene

    def full_scene(self) -> Scene:
        """Returns all agents, ego first."""
        return self._reader.read_all(self.env)

    def labels(self) -> SceneLabels | None:
        """Who follows whom, in highway-env."""
        return read_labels(self.env) if is_highway_env(self.env) else None

    def close(self) -> None:
        """Close the environment."""
        self.env.close()

    def _seen(self) -> Any:
        """What the ego was trained on: the env's own observation, or forecasts (the most likely of several)."""
        if not self._whole:
            return self.observation["observation"]
        forecast = self.observation["forecast"]
        return {**self.observation, "forecast": forecast[:, 0] if forecast.ndim == 4 else forecast}


class MultiagentWorld:
    """A PettingZoo parallel environment; all its agents are driven.

    Args:
        env: wrapped in `ForecastParallelEnv`.
        driver: name of a driver from `envs.drivers.all_agents`, or the path of a policy .zip.
    """

    def __init__(self, env: ForecastParallelEnv, driver: str) -> None:
        """Nothing is reset yet; a driver that cannot drive this complains now."""
        self.env = env
        self._name = driver
        self._observations: dict[str, Any] = {}
        self._make_driver(np.random.default_rng(0))

    @property
    def spec(self) -> SceneSpec:
        """Layout of its scenes."""
        return self.env.scene_spec

    def reset(self, seed: int) -> None:
        """Begin the episode of a seed."""
        self._observations, _ = self.env.reset(seed=seed)
        self._driver = self._make_driver(driver_rng(seed))

    def step(self) -> bool:
        """Let all agents act."""
        seen = self._observations
        if not self._name.endswith(".zip"):
            seen = {name: entries["observation"] for name, entries in seen.items()}
        self._observations, *_ = self.env.step(self._driver(seen))
        return not self.env.agents

    def perceived(self) -> Scene:
        """Returns all agents, padded; none is the ego."""
        return self.env.scene.scene

    def full_scene(self) -> Scene:
        """Returns all agents."""
        scene = self.env.scene.scene
        return Scene(scene.states[scene.valid], scene.ids[scene.valid], scene.valid[scene.valid])

    def labels(self) -> SceneLabels | None:
        """No simulator with many learners knows its edges."""
        return None

    def close(self) -> None:
        """Close the environment."""
        self.env.close()

    def _make_driver(self, rng: np.random.Generator) -> Driver:
        make = trained_driver if self._name.endswith(".zip") else make_driver
        return make(self._name, self.env, rng)


def open_world(
    env_id: str,
    driver: str,
    checkpoint: str | None = None,
    *,
    horizon_steps: int | None = None,
    num_samples: int = 1,
) -> World:
    """Make an environment, with forecasts if a checkpoint is given, and put a driver into it.

    Args:
        env_id: of a gymnasium or a PettingZoo parallel environment.
        driver: an ego (`envs.drivers.ego`) or a driver of all agents (`envs.drivers.all_agents`); or the path of a
            policy .zip.
        checkpoint: of the forecasts; None makes none.
        horizon_steps: of the forecasts.
        num_samples: of the forecasts.

    Raises:
        UserError: unknown env, driver or checkpoint, or things that do not belong together.
    """
    if is_multiagent_id(env_id):
        checkpoint = checkpoint or _forecaster_for(env_id, driver)
        shared = ForecastParallelEnv(
            make_multiagent_env(env_id), checkpoint, horizon_steps=horizon_steps, num_samples=num_samples
        )
        multiagent = MultiagentWorld(shared, driver)
        if sees_forecasts(driver):
            space: Any = shared.observation_space(shared.possible_agents[0])
            require_forecaster(driver, checkpoint, space, shared.scene_spec)
        return multiagent
    env = make_env(env_id, disable_env_checker=True)
    if checkpoint is None:
        seen = env_for_driver(env, driver)
        world = EgoWorld(seen if isinstance(seen, ForecastObservation) else SceneObservation(seen), driver)
    else:
        if sees_forecasts(driver):
            seen = ForecastObservation(env, checkpoint, horizon_steps=horizon_steps)
            require_view(seen, driver)
            space = seen.observation_space
            require_forecaster(driver, checkpoint, space, seen.get_wrapper_attr("scene_spec"))
        else:
            require_view(env, driver)
        world = EgoWorld(
            ForecastObservation(env, checkpoint, horizon_steps=horizon_steps, num_samples=num_samples), driver
        )
    make_ego_driver(driver, world.env, np.random.default_rng(0))
    return world


def _forecaster_for(env_id: str, driver: str) -> str:
    """Whose forecasts a PettingZoo environment is recorded with: those that its driver was trained on, if any."""
    if not sees_forecasts(driver):
        return CONSTANT_VELOCITY
    return forecaster_of(driver) or checkpoint_for(env_id)


def default_drivers(env_id: str) -> tuple[str, ...]:
    """Who takes turns in data collection if nobody is named; the first one drives where accuracy is measured.

    Raises:
        UserError: a parallel environment that cannot be made.
    """
    if env_id in ENVS or not is_multiagent_id(env_id):
        return entry_for(env_id).drivers
    return HEURISTIC_DRIVERS if _has_heuristic(env_id) else entry_for(env_id).drivers


@functools.cache
def _has_heuristic(env_id: str) -> bool:
    env = make_multiagent_env(env_id)
    try:
        make_driver("heuristic", env, np.random.default_rng(0))
    except UserError:
        return False
    finally:
        env.close()
    return True
