"""One forecast of a scene, and each agent's own view of it: for environments with many learners.

The forecaster runs once per step for the scenes of all environments. Each agent then gets what a single ego would get
(`envs.observation.ego_entries`): itself as origin, its heading as x axis, its own edges, the others by distance.
An agent's view is cut to its perception; the forecast behind it is everyone's.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import reduce
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from jaxtyping import Bool, Int
from numpy.typing import NDArray

from envs.observation import ego_entries, entry_spaces
from envs.readers.base import MultiagentScene
from envs.scene_stream import ForecastConfig, SceneStream
from predictor.forecaster import Forecaster
from predictor.scene import PADDING_ID, Forecast, Scene, SceneBatch, SceneSpec, perceived_agents
from predictor.support.errors import UserError

AgentEntries = dict[str, dict[str, NDArray[np.float32]]]
"""Forecast entries by agent."""


class MultiagentStream(SceneStream):
    """Streams scenes with many learners and cuts each agent's entries from the one forecast of its scene.

    A forecaster trained around an ego serves too, if its frame has no ego axis: no agent carries the ego's mark.

    Args:
        forecaster: lives on `config.device`.
        scene_spec: layout of the scenes.
        config: how the forecast enters the observations.
        perception_m: how far an agent sees [m]; None takes the spec's.
        max_agents: agents of a view, the viewer included; None takes the spec's, which is all of them. More than the
            scene has are padding, so that a policy can move between environments.
        envs: number of parallel environments, forecast in one batch.

    Attributes:
        forecast: the latest forecast, one entry per environment, agents as in its scene, world coordinates.

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
        self.scene_spec = scene_spec
        self.view_spec = replace(
            scene_spec,
            perception_m=scene_spec.perception_m if perception_m is None else perception_m,
            max_agents=scene_spec.max_agents if max_agents is None else max_agents,
        )
        # A forecaster with an ego finds an absent one in front.
        self._front = int(forecaster.spec.has_ego)
        super().__init__(forecaster, envs, scene_spec.max_agents + self._front, config)

    def spaces(self) -> dict[str, gym.Space]:
        """Returns the spaces of one agent's entries; new objects at each call, since a space carries its own seed."""
        return entry_spaces(self.forecaster, self.view_spec, self.config)

    def nothing_seen(self) -> dict[str, NDArray[np.float32]]:
        """Returns the entries of an agent that the reader does not see: zeros."""
        return {key: np.zeros(space.shape or (), dtype=np.float32) for key, space in self.spaces().items()}

    def observe(self, shared: MultiagentScene) -> AgentEntries:
        """Take in the scene of the only environment; returns the entries of each of its learners, by name."""
        [entries] = self.observe_each([shared])
        return entries

    def observe_each(
        self, shared: Sequence[MultiagentScene], envs: Int[np.ndarray, " some"] | None = None
    ) -> list[AgentEntries]:
        """Take in one scene for each environment (of `envs`, if given); returns the learners' entries for each."""
        return view_entries(shared, self.take(_batch(shared), envs), self.view_spec)

    def observe_boundary(
        self, shared: Sequence[MultiagentScene], ended: Int[np.ndarray, " ended"], successors: Sequence[MultiagentScene]
    ) -> list[AgentEntries]:
        """As `observe_each`, with the last scenes of ended episodes; entries of their successors follow at the end."""
        forecast = self.take_boundary(_batch(shared), ended, _batch(successors))
        return view_entries([*shared, *successors], forecast, self.view_spec)

    def _given(self, scenes: SceneBatch) -> SceneBatch:
        front = (0, 0), (self._front, 0)
        return SceneBatch(
            np.pad(scenes.states, (*front, (0, 0))),
            np.pad(scenes.ids, front, constant_values=PADDING_ID),
            np.pad(scenes.valid, front),
            scenes.heading_rad,
        )

    def _shown(self, forecast: Forecast) -> Forecast:
        dense, front = forecast.dense(), self._front
        return Forecast(
            dense.xy[:, :, front:],
            dense.edge_probs[:, front:, front:],
            dense.edge_features[:, front:, front:],
            dense.valid[:, front:],
        )


def _batch(shared: Sequence[MultiagentScene]) -> SceneBatch:
    return SceneBatch.stack([one.scene for one in shared])


def agent_entries(shared: MultiagentScene, forecast: Forecast, view: SceneSpec) -> AgentEntries:
    """Returns each agent's forecast entries, cut from one forecast; `envs.observation.ego_entries` gives the shapes.

    Args:
        shared: the scene that was forecast.
        forecast: a batch of one, agents as in the scene, world coordinates.
        view: its `perception_m` and `max_agents` bound what an agent sees.

    Returns:
        The entries of each agent in `shared.rows`, by name.
    """
    [entries] = view_entries([shared], forecast, view)
    return entries


def view_entries(shared: Sequence[MultiagentScene], forecast: Forecast, view: SceneSpec) -> list[AgentEntries]:
    """Returns `agent_entries` for each of several scenes, whose forecasts are one batch."""
    named = [(env, name) for env, one in enumerate(shared) for name in one.rows]
    entries: list[AgentEntries] = [{} for _ in shared]
    if not named:
        return entries
    origins, scenes, orders = [], [], []
    for one in shared:
        egos = np.array(list(one.rows.values()), dtype=np.int64)
        order, seen = _views(one.scene, egos, view)
        orders.append(order)
        origins.append(one.scene.states[egos, : view.position_dim])
        scenes.append(SceneBatch(one.scene.states[order], one.scene.ids[order], seen, one.heading_rad[egos]))
    views = reduce(SceneBatch.concatenate, scenes)
    device = forecast.xy.device
    env = torch.tensor([env for env, _ in named], device=device)
    agents = torch.from_numpy(np.concatenate(orders)).to(device)
    origin = torch.from_numpy(np.concatenate(origins)).to(forecast.xy)
    pairs = env[:, None, None], agents[:, :, None], agents[:, None, :]
    seen_by_each = Forecast(
        forecast.xy.transpose(1, 2)[env[:, None], agents].transpose(1, 2) - origin[:, None, None, None],
        forecast.edge_probs[pairs],
        forecast.edge_features[pairs],
        torch.from_numpy(views.valid).to(device),
    )
    for key, values in ego_entries(views, seen_by_each).items():
        for (place, name), value in zip(named, values, strict=True):
            entries[place].setdefault(name, {})[key] = value
    return entries


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
    shared.scene.check(source, spec, agents=spec.max_agents)
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
