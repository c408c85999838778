"""Entries of an observation with forecasts, as one ego sees them: their spaces, and their values.

The other agents stand in the order of their distance, along the ego's axes; padded agents are zero.
"""

from typing import Any

import gymnasium as gym
import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray
from torch import Tensor

from envs.plans.contact import FAR_M, contacts
from envs.scene_stream import ForecastConfig
from predictor.forecaster import Forecaster
from predictor.scene import Forecast, SceneBatch, SceneSpec

SCENE_KEYS = ("scene_states", "scene_ids", "scene_valid", "scene_heading_rad")
"""Entries of every observation that carries a scene, from `envs.observation.scene_entries`."""
FORECAST_KEYS = ("agents", "forecast", "edge_probs", "edge_features", "valid")
"""Entries of every observation with forecasts, from `ego_entries`."""
PATH_KEYS = ("ego_path", "closest")
"""Entries of every observation with forecasts, from `path_entries`."""
UNCERTAINTY_KEYS = ("mode_probs", "xy_scale")
"""Entries with several samples, or on request (`ForecastConfig.uncertainty`); the second, if the forecaster has it."""
SAME_M = 1e-4
"""Difference of two distances that is rounding [m]."""
WHAT_IF_KEYS = ("what_if_gap", "what_if_contact", "what_if_risk")
"""Entries for candidate plans of the ego (`ForecastConfig.num_plans`)."""


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
        "ego_path": unbounded(horizon, 2),
        "closest": unbounded(others, 2),
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


def path_entries(
    scenes: SceneBatch, forecast: Float[np.ndarray, "batch others ... 2"], dt_s: float
) -> dict[str, NDArray[np.float32]]:
    """Returns the ego's own path at constant velocity, and how close each forecast comes to it.

    Args:
        scenes: observed scenes.
        forecast: entry `forecast` of these scenes; of several futures of an agent the first, most probable one counts.
        dt_s: time of one step [s].

    Returns:
        ego_path: (B, H, 2) positions of the ego along its axes [m].
        closest: (B, A−1, 2) smallest distance to the agent at one time, now included [m], and its first time as a share
            of the horizon; zero where there is no agent.
    """
    velocity = into_ego_axes(scenes.heading_rad) @ scenes.states[:, 0, 2:4, None]
    horizon = forecast.shape[-2]
    times_s = dt_s * np.arange(horizon + 1)
    path = velocity[:, None, :, 0] * times_s[:, None]
    order = others_by_distance(scenes)
    envs = np.arange(len(order))[:, None]
    now = scenes.states[envs, 1 + order, :2] - scenes.states[:, :1, :2]
    future = forecast if forecast.ndim == 4 else forecast[:, :, 0]
    apart = future - path[:, None, 1:]
    gap_m = np.concatenate([np.hypot(*np.moveaxis(now, -1, 0))[..., None], np.hypot(apart[..., 0], apart[..., 1])], -1)
    first = (gap_m <= gap_m.min(-1, keepdims=True) + SAME_M).argmax(-1)  # of two that stand, now, whatever is rounded
    closest = np.stack([gap_m.min(-1), first / horizon], -1)
    closest *= scenes.valid[envs, 1 + order][..., None]
    return {"ego_path": path[:, 1:].astype(np.float32), "closest": closest.astype(np.float32)}


def what_if_entries(
    scenes: SceneBatch,
    forecast: Forecast,
    size_m: tuple[float, float] | Float[np.ndarray, "batch 2"],
    dt_s: float,
) -> dict[str, NDArray[np.float32]]:
    """Returns what a forecast with plans says of the ego and each other agent of this size, agents as in `ego_entries`.

    Steps are `dt_s` seconds long.

    Returns:
        what_if_gap: (B, A−1, P) smallest gap between both vehicles in the single forecast of each plan [m], negative
            where they overlap (`envs.plans.contact`).
        what_if_contact: (B, A−1, P) time of their first contact there, as a share of the horizon; 1 without any.
        what_if_risk: (B, A−1, P) probability of a contact over the forecast's samples.
    """
    found = contacts(forecast, scenes, size_m, dt_s)
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
