"""Cuts each agent's own view from the one forecast of a scene, for environments with many learners.

The forecaster runs once per step for the scenes of all environments. Each agent then gets what a single ego would get
(`envs.entries.ego_entries`): itself as origin, its heading as x axis, its own edges, the others by distance.
An agent's view is cut to its perception; the forecast itself is made from all agents.
"""

import functools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from torch import Tensor

from envs.entries import ego_entries, entry_spaces, path_entries
from envs.readers.base import MultiagentScene
from envs.scene_stream import ForecastConfig, SceneStream
from predictor.forecaster import Forecaster
from predictor.scene import Forecast, SceneBatch, SceneSpec, perceived_agents
from predictor.support.errors import UserError, short

Entries = dict[str, NDArray[np.float32]]
"""Entries of many views, by key."""
AgentEntries = dict[str, dict[str, NDArray[np.float32]]]
"""Forecast entries by agent."""


class MultiagentStream(SceneStream):
    """Streams scenes with many learners and cuts each agent's entries from the one forecast of its scene.

    A forecaster trained around an ego can be used, if its frame has no ego axis: no agent is then marked as the ego.

    Args:
        forecaster: forecaster on `config.device`.
        scene_spec: layout of the scenes.
        config: settings of the forecast.
        perception_m: range of an agent's perception [m]; None takes the spec's.
        max_agents: agents of a view, the viewer included; None takes the spec's, which is all of them. A larger
            number is padded, so that a policy fits several environments.
        envs: number of parallel environments, forecast in one batch.

    Attributes:
        forecast: latest forecast, one entry per environment, agents as in its scene, world coordinates.

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
        envs: int = 1,
    ) -> None:
        """Starts with empty memory."""
        if "ego" in forecaster.spec.frame:
            raise UserError(
                "this forecaster needs positions relative to one ego, but these scenes have many learners; "
                "train one on this environment (frame 'world' or 'centroid')"
            )
        if scene_spec.has_ego or scene_spec.position_dim != 2:
            raise UserError(
                "multiagent scenes need has_ego=False and positions on two axes, got "
                f"has_ego={scene_spec.has_ego} and {scene_spec.position_dim} axes; change the reader's spec"
            )
        self.view_spec = replace(
            scene_spec,
            perception_m=scene_spec.perception_m if perception_m is None else perception_m,
            max_agents=scene_spec.max_agents if max_agents is None else max_agents,
        )
        super().__init__(forecaster, scene_spec, envs, config)
        self._spaces = self.spaces()

    def spaces(self) -> dict[str, gym.Space]:
        """Returns the spaces of one agent's entries; new objects at each call, since a space has its own generator."""
        return entry_spaces(self.forecaster, self.view_spec, self.config)

    def nothing_seen(self) -> dict[str, NDArray[np.float32]]:
        """Returns the entries of an agent that is not in the scene: zeros."""
        return {key: np.zeros(space.shape or (), dtype=np.float32) for key, space in self.spaces().items()}

    def observe(self, scene: MultiagentScene) -> AgentEntries:
        """Takes in the scene of the only environment; returns the entries of each of its learners, by name."""
        [entries] = self.observe_each([scene])
        return entries

    def observe_each(
        self, scenes: Sequence[MultiagentScene], envs: Int[np.ndarray, " some"] | None = None
    ) -> list[AgentEntries]:
        """Takes in one scene for each environment (of `envs`, if given); returns the learners' entries for each."""
        return self._views(scenes, self.take(_batch(scenes), envs))

    def observe_boundary(
        self, scenes: Sequence[MultiagentScene], ended: Int[np.ndarray, " ended"], successors: Sequence[MultiagentScene]
    ) -> list[AgentEntries]:
        """Takes in scenes like `observe_each`, ended episodes with their last; appends their successors' entries."""
        forecast = self.take_boundary(_batch(scenes), ended, _batch(successors))
        return self._views([*scenes, *successors], forecast)

    def _views(self, scenes: Sequence[MultiagentScene], forecast: Forecast) -> list[AgentEntries]:
        arm = self.config.arm
        if arm.shown.true_futures:
            forecast = _as_told(scenes, forecast)
        fill = None if arm.changes_nothing else functools.partial(arm.filled, spaces=self._spaces)
        return view_entries(scenes, forecast, self.view_spec, self.config.shows_uncertainty, fill)


def _as_told(scenes: Sequence[MultiagentScene], like: Forecast) -> Forecast:
    """Returns a forecast that says the true positions of the scenes and nothing of their spread.

    Raises:
        UserError: a scene has none.
    """
    told = [scene.true_xy for scene in scenes if scene.true_xy is not None]
    if len(told) < len(scenes):
        raise UserError("an oracle needs scenes with true_xy, which ForecastParallelEnv adds")
    xy = torch.from_numpy(np.stack(told)[:, None]).to(like.xy)
    return replace(like, xy=xy, mode_probs=None, xy_scale=None)


def _batch(scenes: Sequence[MultiagentScene]) -> SceneBatch:
    return SceneBatch.stack([one.scene for one in scenes])


def view_entries(
    scenes: Sequence[MultiagentScene],
    forecast: Forecast,
    view: SceneSpec,
    uncertainty: bool = False,
    fill: Callable[[Entries], Entries] | None = None,
) -> list[AgentEntries]:
    """Returns each agent's forecast entries, by scene and name; `envs.entries.ego_entries` gives the shapes.

    Args:
        scenes: scenes that were forecast; entries are those of each agent in their `index_of`.
        forecast: forecasts of them, one batch, agents as in the scenes, world coordinates.
        view: spec whose `perception_m` and `max_agents` bound an agent's view.
        uncertainty: whether probabilities and standard deviations of the samples are among the entries.
        fill: function that changes the entries of all views at once.
    """
    named = [(env, name) for env, one in enumerate(scenes) for name in one.index_of]
    entries: list[AgentEntries] = [{} for _ in scenes]
    if not named:
        return entries
    egos = np.array([index for one in scenes for index in one.index_of.values()], dtype=np.int64)
    views, order, origins = _views(scenes, np.array([env for env, _ in named]), egos, view)
    device = forecast.xy.device
    env = torch.tensor([env for env, _ in named], device=device)
    agents = torch.from_numpy(order).to(device)
    origin = torch.from_numpy(origins).to(forecast.xy)
    pairs = env[:, None, None], agents[:, :, None], agents[:, None, :]

    def of_views(samples: Tensor | None) -> Tensor | None:
        return None if samples is None else samples.transpose(1, 2)[env[:, None], agents].transpose(1, 2)

    xy = of_views(forecast.xy)
    assert xy is not None
    seen_by_each = Forecast(
        xy - origin[:, None, None, None],
        forecast.edge_probs[pairs],
        forecast.edge_features[pairs],
        torch.from_numpy(views.valid).to(device),
        mode_probs=of_views(forecast.mode_probs),
        xy_scale=of_views(forecast.xy_scale),
    )
    found = ego_entries(views, seen_by_each, uncertainty)
    found |= path_entries(views, found["forecast"], view.dt_s)
    for key, values in (fill(found) if fill else found).items():
        for (place, name), value in zip(named, values, strict=True):
            entries[place].setdefault(name, {})[key] = value
    return entries


def check_multiagent_scene(scene: Any, spec: SceneSpec, source: str = "reader") -> MultiagentScene:
    """Returns `scene`, which must keep the contract of `envs.readers.base.MultiagentScene`.

    Args:
        scene: what a reader returned.
        spec: the reader's spec.
        source: name of the reader, for messages.

    Raises:
        UserError: not a `MultiagentScene`, refused by `Scene.check`, or indices or headings that do not fit the scene.
    """
    if not isinstance(scene, MultiagentScene):
        raise UserError(f"{source}: reading must give a MultiagentScene (envs.readers), got {type(scene).__name__}")
    scene.scene.check(source, spec, agents=spec.max_agents)
    heading: Any = scene.heading_rad
    if np.shape(heading) != (spec.max_agents,) or not np.isfinite(heading).all():
        raise UserError(
            f"{source}: heading_rad must hold {spec.max_agents} finite numbers, one per agent, got "
            f"{short(np.asarray(heading).tolist())}"
        )
    index_of: Any = scene.index_of
    if not isinstance(index_of, Mapping) or not all(isinstance(i, int | np.integer) for i in index_of.values()):
        raise UserError(f"{source}: index_of must be a dict of whole numbers by agents' names, got {short(index_of)}")
    taken = list(scene.index_of.values())
    if len(set(taken)) != len(taken):
        raise UserError(f"{source}: every agent needs an index of its own, got {short(dict(scene.index_of))}")
    for name, index in scene.index_of.items():
        if not 0 <= index < spec.max_agents or not scene.scene.valid[index]:
            raise UserError(f"{source}: agent '{name}' has index {index}, but the scene has no agent there")
    return scene


def require_indexed(scene: MultiagentScene, agents: Iterable[str], source: str = "reader") -> None:
    """Checks that a scene says where these agents are; the view of one that it does not name would be all zeros.

    Raises:
        UserError: some are not in `index_of`.
    """
    missing = [agent for agent in agents if agent not in scene.index_of]
    if missing:
        known = short([*scene.index_of], 100)
        raise UserError(
            f"{source}: index_of must have the index of each agent that is observed at a reset, but lacks "
            f"{short(missing, 100)} of the environment; its names are {known}; name agents as the environment does"
        )


def _views(
    scenes: Sequence[MultiagentScene],
    envs: Int[np.ndarray, " egos"],
    egos: Int[np.ndarray, " egos"],
    view: SceneSpec,
) -> tuple[SceneBatch, Int[np.ndarray, "egos seen"], Float[np.ndarray, "egos axes"]]:
    """Returns each ego's view, itself first, then the nearest; the indices of its agents, and where the ego is [m].

    Args:
        scenes: scenes of all environments.
        envs: index of each ego's scene.
        egos: index of each ego in its scene.
        view: spec whose `perception_m` and `max_agents` bound a view.
    """
    every = _batch(scenes)[envs]
    order, seen = perceived_agents(every.states, every.valid, egos, view)
    padding = ((0, 0), (0, view.max_agents - order.shape[1]))
    order, seen = np.pad(order, padding), np.pad(seen, padding)
    here = np.arange(len(egos))
    heading_rad = np.stack([scene.heading_rad for scene in scenes])[envs, egos]
    views = SceneBatch(every.states[here[:, None], order], every.ids[here[:, None], order], seen, heading_rad)
    return views, order, every.states[here, egos, : view.position_dim]
