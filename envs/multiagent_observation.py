"""One forecast for everyone, and every agent's own view of it: for environments with many learners.

The forecaster runs once per step on the shared scene. Each agent then gets what a single ego would get
(`envs.observation.ego_entries`): itself as origin, its heading as x axis, its own edges, the others by distance.
An agent's view is cut to its perception; the forecast behind it is everyone's.
"""

from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from jaxtyping import Bool, Int
from numpy.typing import NDArray

from envs.observation import ForecastConfig, ForecastStream, ego_entries
from envs.readers.base import MultiagentScene
from predictor.errors import UserError
from predictor.forecaster import Forecaster
from predictor.online import OnlineForecaster
from predictor.scene import Forecast, Scene, SceneBatch, SceneSpec, perceived_agents


class SharedStream:
    """Streams one environment's shared scenes and cuts each agent's entries from the one forecast.

    A forecaster trained around an ego serves too, if its frame has no ego axis: nobody carries the ego's mark.

    Args:
        forecaster: who forecasts; lives on `config.device`.
        scene_spec: layout of the shared scenes.
        config: how the forecast enters the observations.
        perception_m: how far an agent sees [m]; None takes the spec's.
        max_agents: rows of a view, the agent itself included; None takes the spec's, which is everyone. More than the
            scene has are padding, so that a policy can move between environments.

    Attributes:
        forecast: the latest forecast, a batch of one, rows as in the shared scene, world coordinates.

    Raises:
        UserError: the forecaster needs an ego, the scenes have one or are not flat, or a bound is out of range.
    """

    def __init__(
        self,
        forecaster: Forecaster,
        scene_spec: SceneSpec,
        config: ForecastConfig,
        perception_m: float | None = None,
        max_agents: int | None = None,
    ) -> None:
        """Start with empty memory."""
        if "ego" in forecaster.spec.frame:
            raise UserError(
                "this forecaster sees positions relative to one ego, but these scenes have many learners; "
                "train one on this environment (frame 'world' or 'centroid')"
            )
        if scene_spec.has_ego or scene_spec.position_dim != 2:
            raise UserError(
                "shared scenes need has_ego=False and positions on two axes, got "
                f"has_ego={scene_spec.has_ego} and {scene_spec.position_dim} axes; change the reader's spec"
            )
        self.forecaster = forecaster
        self.scene_spec = scene_spec
        self.view_spec = replace(
            scene_spec,
            perception_m=scene_spec.perception_m if perception_m is None else perception_m,
            max_agents=scene_spec.max_agents if max_agents is None else max_agents,
        )
        self.config = config
        self.horizon_steps = config.horizon_steps or forecaster.horizon_steps
        self.forecast: Forecast | None = None
        # A forecaster with an ego finds an absent one in row 0.
        self._front = int(forecaster.spec.has_ego)
        self._online = OnlineForecaster(forecaster, 1, scene_spec.max_agents + self._front, config.device)
        self._generator = torch.Generator(device=config.device).manual_seed(config.seed)

    def seed(self, seed: int) -> None:
        """Restart the samples' noise."""
        self._generator.manual_seed(seed)

    def spaces(self) -> dict[str, gym.Space]:
        """Spaces of one agent's entries; new objects at each call, since a space carries its own seed."""
        return ForecastStream(self.forecaster, self.view_spec, 1, self.config).spaces()

    def reset(self) -> None:
        """Forget the history."""
        self._online.reset()

    def observe(self, shared: MultiagentScene) -> dict[str, dict[str, NDArray[np.float32]]]:
        """Take in the scene; the entries of each agent in its `rows`, by name."""
        self._online.observe(SceneBatch.stack([shared.scene.behind_absent(self._front)]))
        forecast = self._online.forecast(self.horizon_steps, self.config.num_samples, self._generator).dense()
        front = self._front
        self.forecast = Forecast(
            forecast.xy[:, :, front:],
            forecast.edge_probs[:, front:, front:],
            forecast.edge_features[:, front:, front:],
            forecast.valid[:, front:],
        )
        return agent_entries(shared, self.forecast, self.view_spec)


def agent_entries(
    shared: MultiagentScene, forecast: Forecast, view: SceneSpec
) -> dict[str, dict[str, NDArray[np.float32]]]:
    """Each agent's forecast entries, cut from one forecast; `envs.observation.ego_entries` gives the shapes.

    Args:
        shared: the scene that was forecast.
        forecast: a batch of one, rows as in the scene, world coordinates.
        view: its `perception_m` and `max_agents` bound what an agent sees.

    Returns:
        The entries of each agent in `shared.rows`, by name.
    """
    names = list(shared.rows)
    if not names:
        return {}
    scene, axes = shared.scene, view.position_dim
    egos = np.array([shared.rows[name] for name in names])
    order, seen = _views(scene, egos, view)
    rows = torch.from_numpy(order).to(forecast.xy.device)
    origin = torch.from_numpy(scene.states[egos, :axes]).to(forecast.xy)
    views = Forecast(
        forecast.xy[0].transpose(0, 1)[rows].transpose(1, 2) - origin[:, None, None, None],
        forecast.edge_probs[0][rows[:, :, None], rows[:, None, :]],
        forecast.edge_features[0][rows[:, :, None], rows[:, None, :]],
        torch.from_numpy(seen).to(forecast.valid.device),
    )
    scenes = SceneBatch(scene.states[order], scene.ids[order], seen, shared.heading_rad[egos])
    entries = ego_entries(scenes, views)
    return {name: {key: value[i] for key, value in entries.items()} for i, name in enumerate(names)}


def check_multiagent_scene(shared: Any, spec: SceneSpec, source: str = "reader") -> MultiagentScene:
    """What a reader gave, which must keep the contract of `envs.readers.base.MultiagentScene`.

    Args:
        shared: a `MultiagentScene`, one hopes.
        spec: the reader's.
        source: who read it, for messages.

    Raises:
        UserError: something else, as `Scene.check`, or the rows or headings of the agents do not fit the scene.
    """
    if not isinstance(shared, MultiagentScene):
        raise UserError(f"{source}: reading must give a MultiagentScene (envs.readers), got {type(shared).__name__}")
    shared.scene.check(source, spec, rows=spec.max_agents)
    heading = shared.heading_rad
    if heading.shape != (spec.max_agents,) or not np.isfinite(heading).all():
        raise UserError(
            f"{source}: heading_rad must hold {spec.max_agents} finite numbers, one per row, got {heading.tolist()}"
        )
    taken = list(shared.rows.values())
    if len(set(taken)) != len(taken):
        raise UserError(f"{source}: every agent needs a row of its own, got {dict(shared.rows)}")
    for name, row in shared.rows.items():
        if not 0 <= row < spec.max_agents or not shared.scene.valid[row]:
            raise UserError(f"{source}: agent '{name}' should be in row {row}, but the scene has nobody there")
    return shared


def _views(
    scene: Scene, egos: Int[np.ndarray, " egos"], view: SceneSpec
) -> tuple[Int[np.ndarray, "egos seen"], Bool[np.ndarray, "egos seen"]]:
    """For each ego the rows it sees, itself first and the nearest next, and which of them are not padding."""
    states = np.broadcast_to(scene.states, (len(egos), *scene.states.shape))
    valid = np.broadcast_to(scene.valid, (len(egos), *scene.valid.shape))
    order, seen = perceived_agents(states, valid, egos, view)
    padding = ((0, 0), (0, view.max_agents - order.shape[1]))
    return np.pad(order, padding), np.pad(seen, padding)
