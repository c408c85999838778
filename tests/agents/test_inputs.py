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
LARGEST = {"roundabout-v1": 25, "roundabout-mixed-v0": 25}
"""Bound of the largest input where it is not 10: edge features have no scale, and those of `roundabout` and of
`roundabout-mixed`, which was trained from it, reach 20."""
WITH_PLANS = (
    *("highway-fast-v0", "merge-v1", "roundabout-v1", "intersection-v2"),
    *("highway-mixed-costly-v0", "intersection-costly-v0"),
)
"""Ids of the studies of policies that score their plans."""
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


def read_by(task: Task, steps: int = 12) -> tuple[dict[str, torch.Tensor], torch.Tensor]:
    """Returns entries of present agents by key, and what the extractor makes of them, (agents, inputs)."""
    space, observations = seen_by(task, steps)
    extractor = ForecastAttention(space, AttentionConfig.for_scenes(task.scene_spec))
    env, slot = (observations["valid"] > 0.5).nonzero(as_tuple=True)
    present = {key: observations[key][env, slot] for key in extractor._keys}
    return present, extractor._token_inputs(present | {EGO_PATH: observations[EGO_PATH][env]})


def check_inputs(inputs: torch.Tensor, env_id: str) -> None:
    """Checks that few inputs are saturated, and few at rest."""
    saturated = ((inputs.abs() > 0.99) & (inputs.abs() <= 1.0)).float().mean(0)
    assert inputs.abs().max() < LARGEST.get(env_id, 10)
    most_saturated, least_moving = (0.25, 0.85) if env_id in FEW else (0.1, 0.9)
    assert (saturated > 0.9).float().mean() < most_saturated
    assert (inputs.std(0) > 1e-3).float().mean() > least_moving


@pytest.mark.slow
@pytest.mark.parametrize("env_id", [*CHECKPOINTS, *MULTIAGENT_CHECKPOINTS])
def test_no_entry_is_constant_or_only_saturated(env_id: str):
    present, inputs = read_by(Task(env_id), LONG.get(env_id, 12))
    for key, values in present.items():
        assert values.flatten(1).std(0).max() > 0.01 or (key == "edge_probs" and env_id in ONE_GRAPH), key
    check_inputs(inputs, env_id)


@pytest.mark.slow
@pytest.mark.parametrize("env_id", WITH_PLANS)
def test_with_futures_and_plans_every_number_of_an_entry_moves(env_id: str):
    present, inputs = read_by(Task(env_id, num_samples=6, what_if=True))
    assert {"mode_probs", "xy_scale", "what_if_gap", "what_if_contact", "what_if_risk"} <= set(present)
    for key, values in present.items():
        assert values.flatten(1).std(0).min() > 0.005, key
    check_inputs(inputs, env_id)


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
