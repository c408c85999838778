"""Forecasts the scenes of parallel environments with one forecaster; each environment has its own history and noise."""

from collections.abc import Callable, Iterable, Sequence
from copy import deepcopy
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from envs.arms import Arm
from predictor.forecaster import Forecaster
from predictor.online import MAX_ROWS, Chosen, OnlineForecaster
from predictor.scene import PADDING_ID, Forecast, SceneBatch, SceneSpec
from predictor.scene_checks import MOST_STEPS, chosen_envs
from predictor.support.config_checks import check_at_least, check_at_most, check_types
from predictor.support.errors import ProtocolError, UserError, short
from predictor.support.memory import check_count
from predictor.support.runtime import resolve_device

NOISE_STREAM = 0x6E6F697365
"""Key that makes the samples' noise independent of what environment and drivers draw from the same seed."""

NOISE_SEED_INFO = "noise_seed"
"""Key of the infos of a reset under which an environment may give the seed of the noise of the episode that begins."""


@dataclass(frozen=True)
class ForecastConfig:
    """Settings of a forecast in the observation."""

    horizon_steps: int | None = None
    """Number of steps to forecast; None takes what the checkpoint was trained for."""
    num_samples: int = 1
    """Number of futures per agent, sorted by probability; 1 gives the single forecast, without a samples axis."""
    device: str = "cpu"
    """Device of the forecaster: cpu, cuda or auto."""
    seed: int = 0
    """Random seed of the samples' noise: environment i gets seed + i, until a reset gives another seed."""
    flatten: bool = False
    """Whether an observation is one Box instead of a Dict, in the Dict's key order."""
    uncertainty: bool | None = None
    """Whether probabilities of the samples and their standard deviations are in the observation; None: with several
    samples."""

    num_plans: int = 0
    """Number of candidate plans of the ego whose what-if forecasts are in the observation."""
    arm: Arm = Arm()
    """Part of the forecast that the observation shows."""
    max_rows: int = MAX_ROWS
    """Largest number of environments in one call of the forecaster: bounds the memory that a step needs."""

    @property
    def shows_uncertainty(self) -> bool:
        """Whether probabilities and standard deviations are in the observation."""
        return self.num_samples > 1 if self.uncertainty is None else self.uncertainty

    def __post_init__(self) -> None:
        """Checks ranges, and replaces `device="auto"` by the device that it stands for."""
        check_types(self)
        check_at_least(self, 1, "num_samples", "horizon_steps", "max_rows")
        check_at_most(self, MOST_STEPS, "horizon_steps")
        each_bytes = 8 * (self.horizon_steps or 1)
        check_count(self.num_samples, "num_samples", each_bytes)
        check_at_least(self, 0, "seed", "num_plans")
        self.arm.check_room(self.num_samples, self.num_plans > 0)
        object.__setattr__(self, "device", resolve_device(self.device))


class SceneStream:
    """Takes in a scene of each environment per step and forecasts all of them in one batch.

    A deep copy or a pickle continues exactly; a deep copy shares the forecaster, which no step changes.

    Args:
        forecaster: forecaster on `config.device`; one with an ego gets an absent one where the scenes have none.
        scene_spec: layout of the scenes that will arrive.
        envs: number of parallel environments.
        config: settings of the forecast.

    Raises:
        UserError: the forecaster is of another spec (features, dt).

    Attributes:
        scene_spec: layout of the scenes.
        config: settings of the forecast.
        horizon_steps: number of steps of a forecast.
        scenes: latest scene of each environment; None before the first. Where an episode just ended, the one that
            opens the next episode.
        forecast: forecast of each of `scenes`.
        seen: scenes that were taken in last; where an episode just ended, its last.
    """

    def __init__(self, forecaster: Forecaster, scene_spec: SceneSpec, envs: int, config: ForecastConfig) -> None:
        """Starts with empty memory."""
        forecaster.spec.check_compatible(scene_spec, "the forecaster", "the stream of scenes")
        self.scene_spec = scene_spec
        self.config = config
        self.horizon_steps = config.horizon_steps or forecaster.horizon_steps
        self.scenes: SceneBatch | None = None
        self.forecast: Forecast | None = None
        self.seen: SceneBatch | None = None
        self._front = int(forecaster.spec.has_ego and not scene_spec.has_ego)
        agents = self._front + scene_spec.max_agents
        check_count(config.num_samples, "num_samples", 8 * envs * agents * self.horizon_steps)
        self._online = OnlineForecaster(forecaster, envs, agents, config.device, config.max_rows)
        self._noise = EnvNoise([config.seed + env for env in range(envs)])
        self._before: Sequence[np.random.Generator] = self._noise
        self._rows: Int[np.ndarray, " envs"] | None = np.arange(envs)

    @property
    def forecaster(self) -> Forecaster:
        """Forecaster of all environments."""
        return self._online.forecaster

    @property
    def num_envs(self) -> int:
        """Number of parallel environments."""
        return len(self._noise)

    def forecast_of(self, env: int) -> Forecast | None:
        """Returns the latest forecast of one environment, a batch of one; None before the first."""
        return None if self.forecast is None else _changed(lambda field: field[env : env + 1], self.forecast)

    def again(self, num_samples: int) -> Forecast:
        """Forecasts the latest scene of each environment again, with another number of samples.

        What observations hold does not change; draws, if the forecaster draws, come from the same noise.

        Raises:
            ProtocolError: only some environments gave the latest scenes.
        """
        return self._latest(num_samples, self._noise)

    def pictured(self, num_samples: int) -> Forecast:
        """Returns a forecast of the latest scene of each environment with this number of samples, to be drawn.

        No noise is used up: an episode that is filmed is the one that is not.

        Raises:
            ProtocolError: only some environments gave the latest scenes.
        """
        return self._latest(num_samples, deepcopy(self._noise))

    def what_if(self, plans: Float[np.ndarray, "entries plans horizon state"]) -> Forecast:
        """Forecasts each scene of the latest forecast again, for each plan of its ego, in the frame of `Forecast`.

        What observations hold does not change, and no noise is used up. With `config.num_plans`, samples are drawn from
        the same noise as those of the latest forecast.
        """
        noise = deepcopy(self._before)
        return self._online.forecast(self.horizon_steps, self.config.num_samples, noise, plans)

    def continue_noise(self, streams: "Sequence[SceneStream]") -> None:
        """Takes over the noise generators of one stream per environment, in their current state."""
        self._noise = EnvNoise([0] * len(streams))
        for env, stream in enumerate(streams):
            self._noise.put(env, stream._noise[0])

    def seed(self, seed: int | Sequence[int | None]) -> None:
        """Restarts the samples' noise: environment i from seed + i, or from entry i unless that is None.

        Raises:
            UserError: a seed that is no whole number from 0 on, or another number of seeds than of environments.
        """
        envs = len(self._noise)
        if isinstance(seed, int | np.integer):
            seeds: list[Any] = [seed + env for env in range(envs)]
        else:
            seeds = list(seed) if isinstance(seed, Iterable) else []
        wrong = [own for own in seeds if own is not None and (not isinstance(own, int | np.integer) or own < 0)]
        if wrong or len(seeds) != envs:
            wanted = f"a whole number from 0 on, or a list of {envs} such numbers or None"
            raise UserError(f"seed needs {wanted}, got {short(seed)}")
        for env, own in enumerate(seeds):
            if own is not None:
                self._noise.restart(env, own)

    def reset(self, envs: Chosen | None = None) -> None:
        """Forgets the history of some environments (all, if None)."""
        self._online.reset(envs)

    def take(self, scenes: SceneBatch, envs: Chosen | None = None) -> Forecast:
        """Takes in one scene for each environment (of `envs`, if given); returns their forecasts."""
        envs = None if envs is None else chosen_envs(envs, len(self._noise))
        self._online.observe(self._given(scenes), envs)
        forecast = self._forecast_for(self._noise.of(np.arange(len(self._noise)) if envs is None else envs))
        if envs is None:
            self.scenes, self.forecast, self._rows = scenes, forecast, np.arange(len(scenes))
        else:
            self._keep_some(scenes, forecast, envs)
            self._rows = None
        self.seen = self.scenes
        return forecast

    def take_boundary(
        self,
        scenes: SceneBatch,
        ended: Int[np.ndarray, " ended"],
        successors: SceneBatch,
        seeds: Sequence[int | None] = (),
    ) -> Forecast:
        """Takes in scenes like `take`, ended episodes with their last; appends their successors' forecasts.

        Args:
            scenes: scene of each environment, the last one of an episode that ended.
            ended: indices of the environments whose episodes ended.
            successors: scene that opens the next episode of each of `ended`.
            seeds: seed of the noise of each next episode; None, or none at all, goes on with the noise of before.
        """
        ended = chosen_envs(ended, len(self._noise))
        self._online.observe_boundary(self._given(scenes), ended, self._given(successors))
        forecast = self._forecast_for(self._noise.over(ended, seeds))
        kept = np.arange(len(scenes))
        kept[ended] = len(scenes) + np.arange(len(ended))
        self.scenes, self.seen = SceneBatch.concatenate(scenes, successors)[kept], scenes
        self._rows = kept
        self.forecast = self._of_envs(forecast)
        return forecast

    def _of_envs(self, forecast: Forecast) -> Forecast:
        """Returns a forecast of all scenes that were taken in last as one of each environment's latest."""
        index = torch.from_numpy(self._rows).to(forecast.xy.device)
        return _changed(lambda field: field[index], forecast)

    def _latest(self, num_samples: int, noise: Sequence[np.random.Generator]) -> Forecast:
        """Returns a forecast of the latest scene of each environment; closing scenes draw from a noise of their own."""
        if self._rows is None:
            raise ProtocolError("only some environments gave the latest scenes; take in a scene of each one first")
        rows = int(self._rows.max()) + 1
        if rows == len(self._rows):
            return self._shown(self._online.forecast(self.horizon_steps, num_samples, noise))
        of_row = {int(row): noise[env] for env, row in enumerate(self._rows)}
        drawn = [of_row.get(row) or np.random.default_rng(row) for row in range(rows)]
        return self._of_envs(self._shown(self._online.forecast(self.horizon_steps, num_samples, drawn)))

    def _forecast_for(self, noise: Sequence[np.random.Generator]) -> Forecast:
        """Returns the forecasts of the latest scenes; an ended episode draws its noise before its successor does."""
        self._before = deepcopy(noise) if self.config.num_plans else noise
        return self._shown(self._online.forecast(self.horizon_steps, self.config.num_samples, noise))

    def _given(self, scenes: SceneBatch) -> SceneBatch:
        """Returns the scenes in the layout of the forecaster."""
        if not self._front:
            return scenes
        front = (0, 0), (self._front, 0)
        return SceneBatch(
            np.pad(scenes.states, (*front, (0, 0))),
            np.pad(scenes.ids, front, constant_values=PADDING_ID),
            np.pad(scenes.valid, front),
            scenes.heading_rad,
        )

    def _shown(self, forecast: Forecast) -> Forecast:
        """Returns the forecast in the layout of the scenes that were given."""
        return forecast.without_first(self._front)

    def _keep_some(self, scenes: SceneBatch, forecast: Forecast, envs: Int[np.ndarray, " some"]) -> None:
        count, index = len(self._noise), torch.from_numpy(np.asarray(envs, dtype=np.int64)).to(forecast.xy.device)
        before = self.forecast or _changed(lambda field: field.new_zeros(count, *field.shape[1:]), forecast)
        self.forecast = _changed(lambda old, new: old.index_copy(0, index, new), before, forecast)
        arrays = []
        for field in fields(SceneBatch):
            new = getattr(scenes, field.name)
            blank = np.zeros((count, *new.shape[1:]), new.dtype)
            arrays.append(blank if self.scenes is None else getattr(self.scenes, field.name).copy())
            arrays[-1][envs] = new
        self.scenes = SceneBatch(*arrays)


class EnvNoise(Sequence[np.random.Generator]):
    """Noise generator of each environment, made when something is drawn from it: most forecasters never draw.

    Args:
        seeds: random seed of each environment.
    """

    def __init__(self, seeds: list[int]) -> None:
        """Makes no generator yet."""
        self._seeds = seeds
        self._made: dict[int, np.random.Generator] = {}

    def __len__(self) -> int:
        """Number of environments."""
        return len(self._seeds)

    def __getitem__(self, env: Any) -> Any:
        """Returns the generator of an environment, or those of a slice."""
        if isinstance(env, slice):
            return self.of(np.arange(len(self))[env])
        env = range(len(self))[env]
        if env not in self._made:
            self.put(env, _generator(self._seeds[env]))
        return self._made[env]

    def put(self, env: int, generator: np.random.Generator) -> None:
        """Sets the generator of an environment."""
        self._made[env] = generator

    def restart(self, env: int, seed: int) -> None:
        """Starts the noise of an environment anew."""
        self._seeds[env] = seed
        self._made.pop(env, None)

    def of(self, envs: Int[np.ndarray, " some"]) -> "SomeNoise":
        """Returns the generators of some environments, in this order."""
        return SomeNoise(self, envs)

    def over(self, ended: Int[np.ndarray, " ended"], seeds: Sequence[int | None]) -> Sequence[np.random.Generator]:
        """Returns the generators of all environments, then those of the next episodes, anew where there is a seed."""
        both = self.of(np.concatenate((np.arange(len(self)), ended)))
        if all(seed is None for seed in seeds):
            return both
        now = list(both[: len(self)])  # made before they are replaced
        for env, seed in zip(ended, seeds, strict=True):
            if seed is not None:
                self.restart(int(env), seed)
        return [*now, *both[len(self) :]]


class SomeNoise(Sequence[np.random.Generator]):
    """Noise generators of some environments, one of which may be listed twice.

    Args:
        every: generators of all environments.
        envs: index of each environment.
    """

    def __init__(self, every: EnvNoise, envs: Int[np.ndarray, " some"]) -> None:
        """Stores both; makes no generator."""
        self._every, self._envs = every, np.asarray(envs)

    def __len__(self) -> int:
        """Number of generators."""
        return len(self._envs)

    def __getitem__(self, place: Any) -> Any:
        """Returns a generator, or those of a slice."""
        if isinstance(place, slice):
            return SomeNoise(self._every, self._envs[place])
        return self._every[int(self._envs[place])]


def _generator(seed: int) -> np.random.Generator:
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(NOISE_STREAM,)))


def _changed(change: Callable[..., Tensor], *forecasts: Forecast) -> Forecast:
    """Returns a forecast of changed tensors: `change` of each tensor, with those of the other forecasts."""
    changed: dict[str, Any] = {}
    for field in fields(Forecast):
        tensors = [getattr(forecast, field.name) for forecast in forecasts]
        changed[field.name] = None if tensors[0] is None else change(*tensors)
    return Forecast(**changed)
