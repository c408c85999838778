"""Forecasters that follow a world beside the deployed stream: controls, ablations, several checkpoints at once.

Checkpoints that are measured together see one and the same scene, so they must perceive alike.
"""

import functools
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from envs.drivers.trained import sees_forecasts
from envs.rollouts.world import World, open_world
from predictor.checkpoint import CONSTANT_VELOCITY, load_checkpoint, load_forecaster, names_of
from predictor.forecaster import Forecaster
from predictor.online import OnlineForecaster
from predictor.own_forecasters import is_own
from predictor.scene import Forecast, Scene, SceneBatch, SceneSpec
from predictor.support.errors import UserError


class SideForecaster:
    """Forecaster of the scenes of one world, with all history or the last `history_steps` only.

    A deep copy continues on its own from the same history and noise, and shares the weights. A forecaster with an ego
    gets an ego that is not valid where the scenes have none.

    Args:
        forecaster: any forecaster of such scenes.
        spec: layout of the scenes.
        horizon_steps: number of steps to forecast.
        history_steps: number of steps to which the memory is limited; 0 keeps all.
        samples: number of forecasts.
        seed: random seed of the samples.
    """

    def __init__(
        self,
        forecaster: Forecaster,
        spec: SceneSpec,
        horizon_steps: int,
        history_steps: int = 0,
        samples: int = 1,
        seed: int = 0,
    ) -> None:
        """Starts with empty memory."""
        self._front = int(forecaster.spec.has_ego and not spec.has_ego)
        self._online = OnlineForecaster(forecaster, 1, spec.max_agents + self._front)
        self._horizon, self._limit, self._samples = horizon_steps, history_steps, samples
        self._noise = [np.random.default_rng([seed, samples])]
        self._recent: list[SceneBatch] = []

    def __call__(self, scene: Scene) -> Forecast:
        """Observes the next scene and forecasts it."""
        self.observe(scene)
        return self.forecast()

    def observe(self, scene: Scene) -> None:
        """Observes the next scene, padded."""
        batch = SceneBatch.stack([scene.behind_absent(self._front)])
        if self._limit:
            self._recent = [*self._recent, batch][-self._limit :]
            self._online.reset()
            for past in self._recent:
                self._online.observe(past)
        else:
            self._online.observe(batch)

    def forecast(self) -> Forecast:
        """Forecasts the latest scene, agents as in it; dense."""
        forecast = self._online.forecast(self._horizon, self._samples, self._noise)
        return forecast.without_first(self._front)

    def forecast_plans(self, plans: Float[np.ndarray, "plans horizon state"]) -> Forecast:
        """Forecasts the latest scene, which needs an ego, for each plan of the ego [SI, world frame]."""
        return self._online.forecast(self._horizon, self._samples, self._noise, plans[None])


@functools.lru_cache(maxsize=8)
def kept_forecaster(checkpoint: str, spec: SceneSpec, source: str) -> Forecaster:
    """Returns the forecaster of a checkpoint (`predictor.checkpoint.load_forecaster`), loaded once in a process."""
    return load_forecaster(checkpoint, spec, source)


def checkpoint_forecasters(checkpoints: Sequence[str], spec: SceneSpec, env_id: str) -> dict[str, Forecaster]:
    """Returns the forecasters of all checkpoints but constant velocity, by the names of their folders."""
    return {
        names_of(checkpoints)[name]: kept_forecaster(name, spec, f"env '{env_id}'")
        for name in checkpoints
        if name != CONSTANT_VELOCITY
    }


def fitting_checkpoints(
    env_id: str, checkpoints: Sequence[str], spec: SceneSpec
) -> tuple[tuple[str, ...], dict[str, str]]:
    """Returns the checkpoints that fit an environment, to be measured together, and why the others do not, by name.

    Raises:
        UserError: none fits, or those that do perceive differently.
    """
    fitting, misfits, seen = [], {}, {}
    for checkpoint in checkpoints:
        try:
            found = load_forecaster(checkpoint, spec, f"env '{env_id}'")
        except UserError as error:
            if len(checkpoints) == 1:
                raise
            misfits[names_of(checkpoints)[checkpoint]] = str(error)
            continue
        fitting.append(checkpoint)
        if spec.has_ego and checkpoint != CONSTANT_VELOCITY:
            seen[found.spec.perception_m, found.spec.max_agents] = checkpoint
    if not fitting:
        raise UserError(f"no checkpoint fits {env_id}: " + "; ".join(misfits.values()))
    if len(seen) > 1:
        listed = ", ".join(f"'{name}' {agents} agents within {m:g} m" for (m, agents), name in seen.items())
        raise UserError(f"checkpoints measured together must perceive alike, got {listed}; measure them one by one")
    return tuple(fitting), misfits


def open_for_checkpoints(env_id: str, driver: str, checkpoints: tuple[str, ...], env_kwargs: str = "") -> World:
    """Makes an environment whose ego perceives what the first learned checkpoint was trained on.

    Raises:
        UserError: see `envs.rollouts.world.open_world`.
    """
    first = next((name for name in checkpoints if name != CONSTANT_VELOCITY), None)
    if sees_forecasts(driver):
        return open_world(env_id, driver, first or CONSTANT_VELOCITY, env_kwargs=env_kwargs)
    if first is None or not is_own(first):
        perceived_as = None if first is None else load_checkpoint(first)[1].spec
        return open_world(env_id, driver, perceived_as=perceived_as, env_kwargs=env_kwargs)
    world = open_world(env_id, driver, env_kwargs=env_kwargs)
    own = load_forecaster(first, world.spec, f"env '{env_id}'").spec  # may depend on the reader's
    if (own.perception_m, own.max_agents) == (world.spec.perception_m, world.spec.max_agents):
        return world
    world.close()
    return open_world(env_id, driver, perceived_as=own, env_kwargs=env_kwargs)
