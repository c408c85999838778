"""Makes observations of scenes and forecasts, for single environments and vector environments of gymnasium and SB3."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from torch import Tensor

from envs.plans.batch import PlanBatch
from envs.plans.contact import FAR_M, contacts
from envs.registry import checkpoint_for
from envs.scene_stream import ForecastConfig, SceneStream
from predictor.checkpoint import load_forecaster
from predictor.forecaster import Forecaster
from predictor.online import use_one_thread_after_fork
from predictor.scene import Forecast, Scene, SceneBatch, SceneSpec
from predictor.support.errors import UserError

Observations = dict[str, NDArray[Any]]


SCENE_KEYS = ("scene_states", "scene_ids", "scene_valid", "scene_heading_rad")
FORECAST_KEYS = ("agents", "forecast", "edge_probs", "edge_features", "valid")
"""Entries of every observation with forecasts."""
UNCERTAINTY_KEYS = ("mode_probs", "xy_scale")
"""Entries with several samples, or on request (`ForecastConfig.uncertainty`); the second, if the forecaster has it."""
WHAT_IF_KEYS = ("what_if_gap", "what_if_contact", "what_if_risk")
"""Entries for candidate plans of the ego (`ForecastConfig.num_plans`)."""


def scene_spaces(spec: SceneSpec) -> dict[str, gym.Space]:
    """Returns the spaces of the entries that carry a scene; float64 because x on a highway has no bound."""
    agents = spec.max_agents
    return {
        "scene_states": gym.spaces.Box(-np.inf, np.inf, (agents, spec.num_features), np.float64),
        "scene_ids": gym.spaces.Box(-1, np.iinfo(np.int64).max, (agents,), np.int64),
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


def require_scenes(space: gym.Space, wrapper: str) -> gym.spaces.Dict:
    """Returns the space, which must be a Dict that carries scenes.

    Raises:
        UserError: it is not; the message says how to add scenes.
    """
    if not isinstance(space, gym.spaces.Dict) or not carries_scenes(space):
        raise UserError(
            f"{wrapper} needs environments that report scenes, got {type(space).__name__} observations; "
            "make them with wrapper_class=SceneObservation (envs.wrappers)"
        )
    return space


def open_forecaster(
    checkpoint: str | None,
    scene_spec: SceneSpec,
    source: str,
    device: str = "cpu",
    forecaster: Forecaster | None = None,
) -> Forecaster:
    """Returns the forecaster of a checkpoint, or the given one, after checking that it fits the scenes.

    Args:
        checkpoint: shipped name, folder, or "constant-velocity"; None takes the one that ships for `source`.
        scene_spec: layout of the scenes that it will get.
        source: id of the environment.
        device: device of the forecaster.
        forecaster: forecaster on `device`, instead of a checkpoint.

    Raises:
        UserError: no checkpoint ships, both are given, or the forecaster is of another spec (features, dt).
    """
    use_one_thread_after_fork()
    if forecaster is None:
        name = checkpoint if checkpoint is not None else checkpoint_for(source)
        return load_forecaster(name, scene_spec, f"env '{source}'", device)
    if checkpoint is not None:
        raise UserError(f"give a checkpoint or a forecaster, not both (checkpoint '{checkpoint}')")
    forecaster.spec.check_compatible(scene_spec, "the forecaster", f"env '{source}'")
    return forecaster


class ForecastStream(SceneStream):
    """Forecasts the scenes of parallel environments with one ego each and makes their observation entries.

    Args:
        forecaster: forecaster on `config.device`.
        scene_spec: layout of the scenes that will arrive.
        envs: number of parallel environments.
        config: settings of the forecast.

    Attributes:
        planned: latest forecast for plans, with an axis of plans; None before the first.

    Raises:
        UserError: scenes that do not lie in a plane.
    """

    def __init__(self, forecaster: Forecaster, scene_spec: SceneSpec, envs: int, config: ForecastConfig) -> None:
        """Starts with empty memory."""
        if scene_spec.position_dim != 2:
            raise UserError(f"observations need positions in a plane, got {scene_spec.position_dim} axes")
        super().__init__(forecaster, envs, scene_spec.max_agents, config)
        self.scene_spec = scene_spec
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
    ) -> dict[str, NDArray[np.float32]]:
        """Takes in scenes like `observe`, ended episodes with their last; appends their successors' entries.

        Plans are those of the scenes, then those of the successors.
        """
        forecast = self.take_boundary(scenes, ended, successors)
        return self._entries(SceneBatch.concatenate(scenes, successors), forecast, plans)

    def _entries(
        self, scenes: SceneBatch, forecast: Forecast, plans: PlanBatch | None
    ) -> dict[str, NDArray[np.float32]]:
        arm = self.config.arm
        true = plans.true_xy if plans is not None and arm.shown.true_futures else None
        if true is not None:
            forecast = _with_positions(forecast, scenes, true[:, :1]).of_plan(0)
        entries = ego_entries(scenes, forecast, self.config.shows_uncertainty)
        if plans is not None and self.config.num_plans:
            planned = self.what_if(plans.states) if true is None else _with_positions(forecast, scenes, true)
            entries |= what_if_entries(scenes, planned, plans.size_m)
            self.planned = planned
        return entries if arm.changes_nothing else arm.filled(entries, self._spaces)


def _with_positions(
    forecast: Forecast, scenes: SceneBatch, xy: Float[np.ndarray, "batch plans agents horizon 2"]
) -> Forecast:
    """Returns a forecast that says these positions [m], world frame, and nothing of their spread."""
    local = (xy - scenes.states[:, None, :1, None, :2]) * scenes.valid[:, None, :, None, None]
    positions = torch.from_numpy(local.astype(np.float32)).to(forecast.xy.device)
    return replace(forecast, xy=positions[:, :, None], mode_probs=None, xy_scale=None)


def entry_spaces(forecaster: Forecaster, view: SceneSpec, config: ForecastConfig) -> dict[str, gym.Space]:
    """Returns the spaces of the forecast entries, new objects at each call; only probabilities have finite bounds.

    Args:
        forecaster: forecaster that sets the sizes of edges and, unless `config` does, the horizon.
        view: layout of the view of one policy.
        config: settings of the forecast.
    """
    others, layout = view.max_agents - 1, config.arm.layout_for(forecaster)
    samples = (config.num_samples,) if config.num_samples > 1 else ()

    def unbounded(*shape: int) -> gym.Space:
        return gym.spaces.Box(-np.inf, np.inf, shape, np.float32)

    horizon = config.horizon_steps or forecaster.horizon_steps
    uncertain: dict[str, gym.Space] = {}
    if config.shows_uncertainty:
        uncertain["mode_probs"] = gym.spaces.Box(0, 1, (others, *samples), np.float32)
        if layout.has_scale:
            uncertain["xy_scale"] = gym.spaces.Box(0, np.inf, (others, *samples, horizon, 2), np.float32)
    supposed: dict[str, gym.Space] = {}
    if config.num_plans:
        of_plans = (others, config.num_plans)
        supposed["what_if_gap"] = gym.spaces.Box(-FAR_M, FAR_M, of_plans, np.float32)
        supposed["what_if_contact"] = gym.spaces.Box(0, 1, of_plans, np.float32)
        supposed["what_if_risk"] = gym.spaces.Box(0, 1, of_plans, np.float32)
    return {
        "agents": unbounded(others, view.num_features),
        "forecast": unbounded(others, *samples, horizon, 2),
        **uncertain,
        "edge_probs": gym.spaces.Box(0, 1, (others, 2 * (layout.num_edge_types - 1)), np.float32),
        "edge_features": unbounded(others, 2 * layout.edge_feature_dim),
        "valid": gym.spaces.Box(0, 1, (others,), np.float32),
        **supposed,
    }


def ego_entries(scenes: SceneBatch, forecast: Forecast, uncertainty: bool = False) -> dict[str, NDArray[np.float32]]:
    """Returns the ego's view of scenes and forecasts: origin at the ego, x along its heading, others by distance.

    Each agent's K futures are sorted by their probability, the most probable first; draws keep their order.

    Returns:
        agents: (B, A−1, F) relative states [m, m/s]; features beyond velocity are not changed.
        forecast: (B, A−1, [K,] H, 2) future positions relative to the ego's position now [m].
        mode_probs: (B, A−1, [K]) probability of each future; only with `uncertainty`.
        xy_scale: (B, A−1, [K,] H, 2) standard deviation around each future along the ego's axes [m]; only with
            `uncertainty`, and if the forecaster estimates it.
        edge_probs: (B, A−1, 2(E−1)) probability of each edge type but "no edge": agent → ego, then ego → agent.
        edge_features: (B, A−1, 2D) in the same order.
        valid: (B, A−1) 1 where there is an agent; all other entries are zero where it is 0.
    """
    order = others_by_distance(scenes)
    valid = scenes.valid[np.arange(len(order))[:, None], 1 + order]
    env, place = valid.nonzero()  # the rest is computed for agents, not for padding
    agent = 1 + order[env, place]
    cos, sin = np.cos(scenes.heading_rad)[env], np.sin(scenes.heading_rad)[env]
    agents = scenes.states[env, agent]
    agents[:, :4] -= scenes.states[env, 0, :4]
    agents[:, :4] = _turned(agents[:, :4].reshape(-1, 2, 2), cos, sin).reshape(-1, 4)
    xy = forecast.xy.cpu().numpy()[env, :, agent]
    share = forecast.sample_probs().cpu().numpy()[env, :, agent]
    by_probability = np.argsort(-share, axis=1, kind="stable")
    listed = np.arange(len(xy))[:, None]
    xy = _turned(xy[listed, by_probability], cos, sin)

    def of_edges(edges: Tensor) -> NDArray[np.float32]:
        both: NDArray[np.float32] = edges.flatten(2).cpu().numpy()[env, agent]
        return both

    def padded(values: NDArray[Any]) -> NDArray[np.float32]:
        entries = np.zeros((*valid.shape, *values.shape[1:]), dtype=np.float32)
        entries[env, place] = values
        return entries

    def of_samples(values: NDArray[Any]) -> NDArray[np.float32]:
        return padded(values[:, 0] if values.shape[1] == 1 else values)

    uncertain: dict[str, NDArray[np.float32]] = {}
    if uncertainty:
        uncertain["mode_probs"] = of_samples(share[listed, by_probability])
        if forecast.xy_scale is not None:
            scale = forecast.xy_scale.cpu().numpy()[env, :, agent][listed, by_probability]
            uncertain["xy_scale"] = of_samples(_turned_scale(scale, cos, sin))
    probs, features = forecast.ego_edges()
    return {
        "agents": padded(agents),
        "forecast": of_samples(xy),
        **uncertain,
        "edge_probs": padded(of_edges(probs[..., 1:])),
        "edge_features": padded(of_edges(features)),
        "valid": valid.astype(np.float32),
    }


def what_if_entries(
    scenes: SceneBatch, forecast: Forecast, size_m: tuple[float, float] | Float[np.ndarray, "batch 2"] = (5.0, 2.0)
) -> dict[str, NDArray[np.float32]]:
    """Returns what a forecast with plans says of the ego and each other agent of this size, agents as in `ego_entries`.

    Returns:
        what_if_gap: (B, A−1, P) smallest gap between both vehicles in the single forecast of each plan [m], negative
            where they overlap (`envs.plans.contact`).
        what_if_contact: (B, A−1, P) time of their first contact there, as a share of the horizon; 1 without any.
        what_if_risk: (B, A−1, P) probability of a contact over the forecast's samples.
    """
    found = contacts(forecast, scenes, size_m)
    order = others_by_distance(scenes)
    envs = np.arange(len(order))[:, None]
    valid = scenes.valid[envs, 1 + order][..., None]

    def sorted_entries(values: Float[np.ndarray, "batch plans others"]) -> NDArray[np.float32]:
        return (values.transpose(0, 2, 1)[envs, order] * valid).astype(np.float32)

    risk = found.risk().clip(0.0, 1.0)
    return dict(zip(WHAT_IF_KEYS, map(sorted_entries, (found.gap_m[:, :, 0], found.share[:, :, 0], risk)), strict=True))


def _turned(
    vectors: Float[np.ndarray, "agents *_ 2"], cos: Float[np.ndarray, " agents"], sin: Float[np.ndarray, " agents"]
) -> Float[np.ndarray, "agents *_ 2"]:
    """Returns each agent's vectors in axes that are turned by the angle with this cosine and sine."""
    cos, sin = (part.astype(vectors.dtype).reshape(-1, *(1,) * (vectors.ndim - 2)) for part in (cos, sin))
    x, y = vectors[..., 0], vectors[..., 1]
    turned = np.empty_like(vectors)
    np.add(cos * x, sin * y, out=turned[..., 0])
    np.subtract(cos * y, sin * x, out=turned[..., 1])
    return turned


def _turned_scale(
    scale: Float[np.ndarray, "agents *_ 2"], cos: Float[np.ndarray, " agents"], sin: Float[np.ndarray, " agents"]
) -> Float[np.ndarray, "agents *_ 2"]:
    """Returns standard deviations along turned axes, of errors that are independent along the given ones."""
    cos, sin = (part.astype(scale.dtype).reshape(-1, *(1,) * (scale.ndim - 2)) for part in (cos, sin))
    x, y = np.square(scale[..., 0]), np.square(scale[..., 1])
    turned: Float[np.ndarray, "agents *_ 2"] = np.sqrt(
        np.stack([cos**2 * x + sin**2 * y, sin**2 * x + cos**2 * y], axis=-1)
    )
    return turned


def others_by_distance(scenes: SceneBatch) -> Int[np.ndarray, "batch others"]:
    """Returns the order of the forecast entries: indices into the scene's agents without the ego, nearest first."""
    offsets = scenes.states[:, 1:, :2] - scenes.states[:, :1, :2]
    distance_m = np.where(scenes.valid[:, 1:], np.hypot(offsets[..., 0], offsets[..., 1]), np.inf)
    return np.argsort(distance_m, axis=1, kind="stable")


def into_ego_axes(heading_rad: Float[np.ndarray, " batch"]) -> Float[np.ndarray, "batch 2 2"]:
    """Returns rotations from world axes to axes along each ego's heading; the transpose rotates back."""
    cos, sin = np.cos(heading_rad), np.sin(heading_rad)
    return np.stack([np.stack([cos, sin], -1), np.stack([-sin, cos], -1)], -2)


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
) -> tuple[Observations, list[Observations]]:
    """Returns forecast entries of each environment, and of each closing observation with its own episode's history.

    Plans are ordered as in `ForecastStream.observe_boundary`: the closing ones in their places, then the opening ones.
    """
    opening = scenes_from(observations)
    if not len(ended):
        return dict(stream.observe(opening, plans=plans)), []
    scenes = SceneBatch(*(field.copy() for field in (opening.states, opening.ids, opening.valid, opening.heading_rad)))
    for env, last in zip(ended, closing, strict=True):
        scenes.states[env], scenes.ids[env] = last["scene_states"], last["scene_ids"]
        scenes.valid[env], scenes.heading_rad[env] = last["scene_valid"], last["scene_heading_rad"][0]
    both = stream.observe_boundary(scenes, ended, opening[ended], plans)
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
        raise UserError(f"all environments must have the same {what}, got {sorted({str(v) for v in values})}")
    return values[0]
