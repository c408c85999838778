"""What the extractor gets on shipped ids: no entry is constant, and none is only saturated."""

from typing import Any

import numpy as np
import pytest
import torch
from gymnasium.spaces import Discrete

from agents.features import EGO_PATH, AttentionConfig, ForecastAttention
from agents.task import Task
from envs.drivers.ego import make_ego_driver
from envs.registry import CHECKPOINTS, MULTIAGENT_CHECKPOINTS

ONE_GRAPH = {
    "racetrack-v1", "racetrack-oval-v1", "racetrack-large-v1",
    "simple_v3", "simple_spread_v3", "simple_reference_v3", "simple_speaker_listener_v4",
}  # fmt: skip
"""Ids whose checkpoint gives every edge the same probability."""
FEW = {
    "racetrack-oval-v1",
    "racetrack-large-v1",
    "simple_v3",
    "simple_adversary_v3",
    "simple_push_v3",
    "simple_speaker_listener_v4",
}
"""Ids with one or two others, who stay far away or on one side: more of the squashed distances are near 1 or -1."""
LARGEST = {"roundabout-v1": 25}
"""Bound of the largest input where it is not 10: edge features have no scale, and those of this checkpoint reach 20."""
LONG = {"racetrack-large-v1": 60}
"""Steps of an episode, where the ego begins alone."""


def seen_by(task: Task, steps: int = 12) -> tuple[Any, dict[str, torch.Tensor]]:
    """Returns the observation space and a batch of observations of random driving; in PettingZoo, of all agents."""
    env = task.wrapped(task.make())
    steering = not task.is_multiagent and not isinstance(env.action_space, Discrete)
    keep_lane = make_ego_driver("keep-lane", env, np.random.default_rng(0)) if steering else None
    found = []
    for seed in range(4):
        observed, _ = env.reset(seed=seed)
        for step in range(steps):
            found += list(observed.values()) if task.is_multiagent else [observed]
            if task.is_multiagent:
                observed, *_ = env.step(
                    {a: (seed + step + i) % env.action_space(a).n for i, a in enumerate(env.agents)}
                )
                if not env.agents:
                    break
            else:
                action = keep_lane(observed) if keep_lane else (seed + step) % env.action_space.n
                observed, _, terminated, truncated, _ = env.step(action)
                if terminated or truncated:
                    break
    space = env.observation_space(env.possible_agents[0]) if task.is_multiagent else env.observation_space
    env.close()
    same = [one for one in found if one["observation"].shape == space["observation"].shape]
    return space, {key: torch.from_numpy(np.stack([one[key] for one in same])) for key in space}


@pytest.mark.slow
@pytest.mark.parametrize("env_id", [*CHECKPOINTS, *MULTIAGENT_CHECKPOINTS])
def test_no_entry_is_constant_or_only_saturated(env_id: str):
    task = Task(env_id)
    space, observations = seen_by(task, LONG.get(env_id, 12))
    config = AttentionConfig.for_scenes(task.scene_spec)
    extractor = ForecastAttention(space, config)
    env, slot = (observations["valid"] > 0.5).nonzero(as_tuple=True)
    present = {key: observations[key][env, slot] for key in extractor._keys}
    for key, values in present.items():
        assert values.flatten(1).std(0).max() > 0.01 or (key == "edge_probs" and env_id in ONE_GRAPH), key
    present[EGO_PATH] = observations[EGO_PATH][env]
    inputs = extractor._token_inputs(present)
    saturated = ((inputs.abs() > 0.99) & (inputs.abs() <= 1.0)).float().mean(0)
    assert inputs.abs().max() < LARGEST.get(env_id, 10)
    most_saturated, least_moving = (0.25, 0.85) if env_id in FEW else (0.1, 0.9)
    assert (saturated > 0.9).float().mean() < most_saturated
    assert (inputs.std(0) > 1e-3).float().mean() > least_moving


@pytest.mark.slow
def test_the_ego_s_own_path_takes_forecasts_out_of_saturation():
    """Most cars keep pace with the ego: near it all along, far from where it is now."""
    task = Task("highway-fast-v0")
    _, observations = seen_by(task)
    env, slot = (observations["valid"] > 0.5).nonzero(as_tuple=True)
    ahead = observations["forecast"][env, slot][..., 0]
    near_m = AttentionConfig.for_scenes(task.scene_spec).near_m
    relative = ahead - observations[EGO_PATH][env][..., 0]
    now, then = ((torch.tanh(x / near_m).abs() > 0.99).float().mean() for x in (ahead, relative))
    assert now > 0.9 and then < 0.75
