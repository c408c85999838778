"""One forecast for everyone, and every agent's own view of it: for environments with many learners.

The forecaster runs once per step on the shared scene. Each agent then gets what a single ego would get
(`envs.observation.ego_entries`): itself as origin, its heading as x axis, its own edges, the others by distance.
An agent's view is cut to its perception; the forecast behind it is everyone's.
"""

from collections.abc import Mapping
from dataclasses import replace

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray

from envs.observation import ForecastConfig, ForecastStream, ego_entries
from envs.readers.base import SharedScene
from predictor.errors import UserError
from predictor.forecaster import Forecaster
from predictor.online import OnlineForecaster
from predictor.scene import Forecast, Scene, SceneBatch, SceneSpec


class SharedStream:
    """Streams one environment's shared scenes and cuts each agent's entries from the one forecast.

    A forecaster trained around an ego serves too, if its frame has no ego axis: nobody carries the ego's mark.

    Args:
        forecaster: who forecasts; lives on `config.device`.
        scene_spec: layout of the shared scenes.
        config: how the forecast enters the observations.
        perception_m: how far an agent sees [m]; None takes the spec's.
        max_agents: rows of a view, the agent itself included; None takes the spec's.

    Attributes:
        forecast: the latest forecast, rows as in the shared scene, world coordinates.

    Raises:
        UserError: the forecaster needs an ego.
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
        self.forecaster = forecaster
        self.scene_spec = scene_spec
        self.view_spec = replace(
            scene_spec,
            perception_m=scene_spec.perception_m if perception_m is None else perception_m,
            max_agents=min(scene_spec.max_agents, max_agents or scene_spec.max_agents),
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
        """Spaces of one agent's entries."""
        return ForecastStream(self.forecaster, self.view_spec, 1, self.config).spaces()

    def reset(self) -> None:
        """Forget the history."""
        self._online.reset()

    def observe(self, shared: SharedScene) -> dict[str, dict[str, NDArray[np.float32]]]:
        """Take in the scene; the entries of each living agent, by its name."""
        self._online.observe(SceneBatch.stack([_behind_absent_ego(shared.scene, self._front)]))
        forecast = self._online.forecast(self.horizon_steps, self.config.num_samples, self._generator)
        front = self._front
        self.forecast = Forecast(
            forecast.xy[:, :, front:],
            forecast.edge_probs[:, front:, front:],
            forecast.edge_features[:, front:, front:],
            forecast.valid[:, front:],
        )
        return agent_entries(shared, self.forecast, self.view_spec)


def agent_entries(
    shared: SharedScene, forecast: Forecast, view: SceneSpec
) -> dict[str, dict[str, NDArray[np.float32]]]:
    """Each living agent's forecast entries, cut from one forecast.

    Args:
        shared: the scene that was forecast.
        forecast: a batch of one, world coordinates.
        view: its `perception_m` and `max_agents` bound what an agent sees.
    """
    names = list(shared.rows)
    if not names:
        return {}
    scene = shared.scene
    egos = np.array([shared.rows[name] for name in names])
    axes = view.position_dim
    offsets = scene.states[None, :, :axes] - scene.states[egos, None, :axes]
    distance_m = np.where(scene.valid, np.linalg.norm(offsets, axis=-1), np.inf)
    distance_m[np.arange(len(egos)), egos] = -1.0
    order = np.argsort(distance_m, axis=1, kind="stable")[:, : view.max_agents]
    seen = np.take_along_axis(distance_m, order, axis=1) <= view.perception_m
    scenes = SceneBatch(scene.states[order], scene.ids[order], seen, shared.heading_rad[egos])
    rows = torch.from_numpy(order).to(forecast.xy.device)
    origin = torch.from_numpy(scene.states[egos, :axes]).to(forecast.xy)
    views = Forecast(
        forecast.xy[0].transpose(0, 1)[rows].transpose(1, 2) - origin[:, None, None, None],
        forecast.edge_probs[0][rows[:, :, None], rows[:, None, :]],
        forecast.edge_features[0][rows[:, :, None], rows[:, None, :]],
        torch.from_numpy(seen).to(forecast.valid.device),
    )
    entries: Mapping[str, NDArray[np.float32]] = ego_entries(scenes, views)
    return {name: {key: value[i] for key, value in entries.items()} for i, name in enumerate(names)}


def _behind_absent_ego(scene: Scene, rows: int) -> Scene:
    """The scene with `rows` absent rows in front."""
    return Scene(
        np.pad(scene.states, ((rows, 0), (0, 0))),
        np.pad(scene.ids, (rows, 0), constant_values=-1),
        np.pad(scene.valid, (rows, 0)),
    )
