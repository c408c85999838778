"""What the extractor gets on shipped ids: no entry is constant, and none is only saturated."""

from typing import Any

import numpy as np
import pytest
import torch

from agents.features import EGO_PATH, AttentionConfig, ForecastAttention
from agents.task import Task


def seen_by(task: Task, steps: int = 12) -> tuple[Any, dict[str, torch.Tensor]]:
    """Returns the observation space and a batch of observations of random driving; in PettingZoo, of all agents."""
    env = task.wrapped(task.make())
    found = []
    for seed in range(4):
        observed, _ = env.reset(seed=seed)
        for step in range(steps):
            found += list(observed.values()) if task.is_multiagent else [observed]
            if task.is_multiagent:
                observed, *_ = env.step({a: (seed + step + i) % 5 for i, a in enumerate(env.agents)})
                if not env.agents:
                    break
            else:
                observed, _, terminated, truncated, _ = env.step((seed + step) % env.action_space.n)
                if terminated or truncated:
                    break
    space = env.observation_space(env.possible_agents[0]) if task.is_multiagent else env.observation_space
    env.close()
    same = [one for one in found if one["observation"].shape == space["observation"].shape]
    return space, {key: torch.from_numpy(np.stack([one[key] for one in same])) for key in space}


@pytest.mark.parametrize("env_id", ["highway-fast-v0", "merge-v1", "intersection-v2", "simple_tag_v3"])
def test_no_entry_is_constant_or_only_saturated(env_id: str):
    task = Task(env_id)
    space, observations = seen_by(task)
    config = AttentionConfig.for_scenes(task.scene_spec)
    extractor = ForecastAttention(space, config)
    env, slot = (observations["valid"] > 0.5).nonzero(as_tuple=True)
    present = {key: observations[key][env, slot] for key in extractor._keys}
    for key, values in present.items():
        assert values.flatten(1).std(0).max() > 0.01, key
    present[EGO_PATH] = observations[EGO_PATH][env]
    inputs = extractor._token_inputs(present)
    saturated = ((inputs.abs() > 0.99) & (inputs.abs() <= 1.0)).float().mean(0)
    assert inputs.abs().max() < 10
    assert (saturated > 0.9).float().mean() < 0.1
    assert (inputs.std(0) > 1e-3).float().mean() > 0.9


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
