"""Makes observations of scenes and forecasts, for single environments and vector environments of gymnasium and SB3."""

from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from jaxtyping import Int
from numpy.typing import NDArray

from envs.entries import SCENE_KEYS, ego_entries, entry_spaces, path_entries, what_if_entries
from envs.own_observation import carries_forecasts
from envs.plans.batch import PlanBatch
from envs.plans.playing import as_forecast
from envs.registry import checkpoint_for
from envs.scene_stream import ForecastConfig, SceneStream
from predictor.checkpoint import load_forecaster
from predictor.forecaster import Forecaster
from predictor.forecaster_checks import require_forecaster
from predictor.online import use_one_thread_after_fork
from predictor.scene import Forecast, Scene, SceneBatch, SceneSpec
from predictor.support.errors import UserError, short

Observations = dict[str, NDArray[Any]]


def scene_spaces(spec: SceneSpec) -> dict[str, gym.Space]:
    """Returns the spaces of the entries that carry a scene; float64 because x on a highway has no bound."""
    agents = spec.max_agents
    return {
        "scene_states": gym.spaces.Box(-np.inf, np.inf, (agents, spec.num_features), np.float64),
        "scene_ids": gym.spaces.Box(-1, np.iinfo(np.int64).max - 1, (agents,), np.int64),  # or it has no samples
        "scene_valid": gym.spaces.MultiBinary(agents),
        "scene_heading_rad": gym.spaces.Box(-np.inf, np.inf, (1,), np.float64),
    }


def scene_entries(scene: Scene) -> dict[str, NDArray[Any]]:
    """Returns a scene as observation entries."""
    return {
        "scene_states": scene.states,
        "scene_ids": scene.ids,
        "scene_valid": scene.valid.astype(np.int8),
        "scene_heading_rad": np.array([scene.heading_rad], dtype=np.float64),
    }


def scenes_from(observations: Mapping[str, NDArray[Any]]) -> SceneBatch:
    """Returns the scenes of a batch of observations that carry them."""
    return SceneBatch(
        observations["scene_states"],
        observations["scene_ids"],
        observations["scene_valid"].astype(np.bool_),
        observations["scene_heading_rad"][:, 0],
    )


def carries_scenes(space: gym.Space) -> bool:
    """Returns whether observations of this space hold scenes."""
    return isinstance(space, gym.spaces.Dict) and all(key in space.spaces for key in SCENE_KEYS)


def require_scenes(space: gym.Space, wrapper: str, how: str) -> gym.spaces.Dict:
    """Returns the space, which must be a Dict that carries scenes.

    Args:
        space: observation space of the environments.
        wrapper: name of the wrapper, for the message.
        how: how to make environments that report scenes, for the message.

    Raises:
        UserError: it is not.
    """
    if carries_forecasts(space):
        raise UserError(
            f"{wrapper} makes the forecasts of all environments itself, but these have theirs already; give each "
            "SceneObservation in the place of ForecastObservation, or leave one of two such wrappers out"
        )
    if not isinstance(space, gym.spaces.Dict) or not carries_scenes(space):
        raise UserError(
            f"{wrapper} needs environments that report scenes, got {type(space).__name__} observations without them; "
            f"{how}, with wrappers that change observations inside of SceneObservation"
        )
    return space


def require_scenes_of(spec: SceneSpec, space: gym.spaces.Dict, wrapper: str) -> None:
    """Checks that scenes arrive as `SceneObservation` made them.

    Raises:
        UserError: a wrapper has changed their spaces.
    """
    for key, made in scene_spaces(spec).items():
        if space[key].shape != made.shape:
            raise UserError(
                f"{wrapper}: a wrapper around SceneObservation changed '{key}' from the shape {made.shape} to "
                f"{space[key].shape}; put it inside of SceneObservation, or around {wrapper}"
            )


def open_forecaster(
    checkpoint: str | Path | Forecaster | None,
    scene_spec: SceneSpec,
    source: str,
    device: str = "cpu",
    forecaster: Forecaster | None = None,
) -> Forecaster:
    """Returns the forecaster of a checkpoint, or the given one, after checking that it fits the scenes.

    Args:
        checkpoint: shipped name, folder, "constant-velocity", or a forecaster on `device`; None takes the checkpoint
            that ships for `source`.
        scene_spec: layout of the scenes that it will get.
        source: id of the environment.
        device: device of the forecaster.
        forecaster: forecaster on `device`, instead of a checkpoint.

    Raises:
        UserError: no checkpoint ships, both are given, the object is no forecaster, or the forecaster is of another
            spec (features, dt).
    """
    use_one_thread_after_fork()
    if forecaster is not None and checkpoint is not None:
        raise UserError(f"give a checkpoint or a forecaster, not both (checkpoint '{checkpoint}')")
    given = forecaster if checkpoint is None else checkpoint
    if given is None or isinstance(given, str | Path):
        name = checkpoint_for(source) if given is None else given
        return load_forecaster(name, scene_spec, f"env '{source}'", device)
    require_forecaster(given).spec.check_compatible(scene_spec, "the forecaster", f"env '{source}'")
    return given


class ForecastStream(SceneStream):
    """Forecasts the scenes of parallel environments with one ego each and makes their observation entries.

    Args:
        forecaster: forecaster on `config.device`.
        scene_spec: layout of the scenes that will arrive.
        envs: number of parallel environments.
        config: settings of the forecast.

    Attributes:
        planned: latest forecast for plans, with an axis of plans, of the environments whose scenes were taken in last;
            where an episode just ended, of the scene that opens the next one. None before the first.

    Raises:
        UserError: scenes without an ego, or that do not lie in a plane.
    """

    def __init__(self, forecaster: Forecaster, scene_spec: SceneSpec, envs: int, config: ForecastConfig) -> None:
        """Starts with empty memory."""
        if not scene_spec.has_ego or scene_spec.position_dim != 2:
            raise UserError(
                "observations need scenes with an ego and positions in a plane, got "
                f"has_ego={scene_spec.has_ego} and {scene_spec.position_dim} axes; SceneStream forecasts others"
            )
        super().__init__(forecaster, scene_spec, envs, config)
        self.planned: Forecast | None = None
        self._spaces = self.spaces()

    def spaces(self) -> dict[str, gym.Space]:
        """Returns the spaces of the forecast entries."""
        return entry_spaces(self.forecaster, self.scene_spec, self.config)

    def observe(
        self, scenes: SceneBatch, envs: Int[np.ndarray, " some"] | None = None, plans: PlanBatch | None = None
    ) -> dict[str, NDArray[np.float32]]:
        """Takes in one scene for each environment (of `envs`, if given); returns the forecast entries for each.

        With candidate plans, one of each scene, they include those of `what_if_entries`.
        """
        return self._entries(scenes, self.take(scenes, envs), plans)

    def observe_boundary(
        self,
        scenes: SceneBatch,
        ended: Int[np.ndarray, " ended"],
        successors: SceneBatch,
        plans: PlanBatch | None = None,
        seeds: Sequence[int | None] = (),
    ) -> dict[str, NDArray[np.float32]]:
        """Takes in scenes like `observe`, ended episodes with their last; appends their successors' entries.

        Plans are those of the scenes, then those of the successors; `seeds` are those of `take_boundary`.
        """
        forecast = self.take_boundary(scenes, ended, successors, seeds)
        entries = self._entries(SceneBatch.concatenate(scenes, successors), forecast, plans)
        if plans is not None and self.planned is not None:
            self.planned = self._of_envs(self.planned)
        return entries

    def _entries(
        self, scenes: SceneBatch, forecast: Forecast, plans: PlanBatch | None
    ) -> dict[str, NDArray[np.float32]]:
        arm = self.config.arm
        true = plans.true_xy if plans is not None and arm.shown.true_futures else None
        if true is not None:
            forecast = as_forecast(true[:, :1], scenes, forecast).of_plan(0)
        entries = ego_entries(scenes, forecast, self.config.shows_uncertainty)
        entries |= path_entries(scenes, entries["forecast"], self.scene_spec.dt_s)
        if plans is not None and self.config.num_plans:
            planned = self.what_if(plans.states) if true is None else as_forecast(true, scenes, forecast)
            entries |= what_if_entries(scenes, planned, plans.size_m, self.scene_spec.dt_s)
            self.planned = planned
        return entries if arm.changes_nothing else arm.filled(entries, self._spaces)


def batch_entries(scenes: SceneBatch) -> dict[str, NDArray[Any]]:
    """Returns the scenes of a batch as observation entries (`scene_entries` for many)."""
    return {
        "scene_states": scenes.states,
        "scene_ids": scenes.ids,
        "scene_valid": scenes.valid.astype(np.int8),
        "scene_heading_rad": scenes.heading_rad[:, None],
    }


def observe_ended(
    stream: ForecastStream,
    observations: Observations,
    ended: NDArray[np.int64],
    closing: list[Observations],
    plans: PlanBatch | None = None,
    seeds: Sequence[int | None] = (),
) -> tuple[Observations, list[Observations]]:
    """Returns forecast entries of each environment, and of each closing observation with its own episode's history.

    Plans are ordered as in `ForecastStream.observe_boundary`: the closing ones in their places, then the opening ones.
    `seeds` are those of the noise of the episodes that begin (`SceneStream.take_boundary`).
    """
    opening = scenes_from(observations)
    if not len(ended):
        return dict(stream.observe(opening, plans=plans)), []
    scenes = SceneBatch(*(field.copy() for field in (opening.states, opening.ids, opening.valid, opening.heading_rad)))
    for env, last in zip(ended, closing, strict=True):
        scenes.states[env], scenes.ids[env] = last["scene_states"], last["scene_ids"]
        scenes.valid[env], scenes.heading_rad[env] = last["scene_valid"], last["scene_heading_rad"][0]
    both = stream.observe_boundary(scenes, ended, opening[ended], plans, seeds)
    envs = len(opening)
    of_closing = {key: value[ended] for key, value in both.items()}
    for value in both.values():
        value[ended] = value[envs:]
    entries = {key: value[:envs] for key, value in both.items()}
    return entries, [{key: value[i] for key, value in of_closing.items()} for i in range(len(ended))]


def common_value(values: Any, what: str) -> Any:
    """Returns the value that all environments share.

    Raises:
        UserError: they differ.
    """
    if any(value != values[0] for value in values):
        raise UserError(f"all environments must have the same {what}, got {_differences(values)}")
    return values[0]


def _differences(values: Any) -> str:
    """Returns in what values differ: of scene specs the fields that do."""
    if not all(isinstance(value, SceneSpec) for value in values):
        return short(sorted({str(value) for value in values}))
    names = [one.name for one in fields(SceneSpec) if len({getattr(value, one.name) for value in values}) > 1]
    each = dict.fromkeys(", ".join(f"{name}={getattr(value, name)}" for name in names) for value in values)
    return short(" and ".join(each))
