"""Every algorithm: trains behind the features extractor, is saved, goes on, is measured; what does not fit is said."""

import re
import sys
import warnings
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, get_args

import gymnasium as gym
import numpy as np
import pytest
import torch
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from agents.algorithms import CONTINUOUS, check_actions, check_observations, log_interval
from agents.arena import EgoArena
from agents.features import ForecastAttention
from agents.presets import (
    PRESETS,
    Algorithm,
    OffPolicyPreset,
    OnPolicyPreset,
    PPOPreset,
    QRDQNPreset,
    RecurrentPPOPreset,
    SACPreset,
    TQCPreset,
    preset_for,
)
from agents.runs import load_model
from agents.task import EVALUATION_SEED, Task
from agents.training import TrainingPlan, make_model, train
from agents.vec_envs import make_venv
from envs.sb3.algorithms import CONTRIB, algorithm_class, algorithm_of_model
from predictor.support.errors import UserError

# SB3 silences this warning at import, pytest makes it an error again.
pytestmark = pytest.mark.filterwarnings("ignore:rich is experimental")

ALGORITHMS: tuple[Algorithm, ...] = get_args(Algorithm)
ROAD = Task("highway-fast-v0", "constant-velocity", env_kwargs='{"config": {"duration": 3}}')
TRACK = Task("racetrack-oval-v1", "constant-velocity", env_kwargs='{"config": {"duration": 2}}')
"""Short episodes with discrete and with continuous actions."""


def task_for(algorithm: Algorithm) -> Task:
    return TRACK if algorithm in CONTINUOUS else ROAD


def small(algorithm: Algorithm) -> dict[str, Any]:
    """Returns hyperparameters with which a few steps are several updates."""
    preset = PRESETS[algorithm]
    if isinstance(preset, OffPolicyPreset):
        return {"learning_starts": 4, "batch_size": 4, "buffer_size": 50, "net_arch": (8,)}
    return {"n_steps": 6, "net_arch": (8,)} | ({"batch_size": 6} if isinstance(preset, PPOPreset) else {})


def test_every_algorithm_stands_in_every_table():
    assert set(PRESETS) == set(ALGORITHMS)
    for name in ALGORITHMS:
        assert log_interval(name) >= 1
        assert algorithm_class(name).__name__.lower().replace("recurrent", "recurrent-") == name


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_it_trains_goes_on_and_is_measured(algorithm: Algorithm, tmp_path: Path):
    def plan(steps: int) -> TrainingPlan:
        sizes = {"selections": 1, "selection_episodes": 1, "selection_envs": 1, "checkpoint_every": 1}
        return TrainingPlan(
            task_for(algorithm), algorithm, steps, 2, 0, in_process=True, settings=small(algorithm), **sizes
        )

    (tmp_path / "run").mkdir()
    train(plan(12), tmp_path / "run")
    first = load_model(tmp_path / "run" / "checkpoint.zip", algorithm)
    policy = train(plan(24), tmp_path / "run")
    model = load_model(tmp_path / "run" / "checkpoint.zip", algorithm)
    assert (first.num_timesteps, model.num_timesteps) == (12, 24)
    assert algorithm_of_model(model) == algorithm_of_model(load_model(policy, algorithm)) == algorithm
    before, after = first.policy.state_dict(), model.policy.state_dict()
    changed = {name for name in after if not torch.equal(before[name], after[name])}
    assert any("features_extractor" in name for name in changed), "the extractor learns, too"
    assert any(isinstance(part, ForecastAttention) for part in model.policy.modules())
    if isinstance(model, OffPolicyAlgorithm):
        assert model.replay_buffer is not None and model.replay_buffer.size() * 2 == 24
    arena = EgoArena(task_for(algorithm), 1)
    (result,) = arena.play(load_model(policy, algorithm), [EVALUATION_SEED])
    arena.close()
    assert result.length >= 1 and np.isfinite(result.episode_return)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_models_have_the_values_of_their_preset(algorithm: Algorithm):
    task = replace(task_for(algorithm), observe="none")
    venv = make_venv(task, 1)
    model = make_model(TrainingPlan(task, algorithm, 1_000, 1, 0), venv)
    venv.close()
    assert type(model) is algorithm_class(algorithm)
    preset = preset_for(task.env_id, algorithm)
    for name, value in asdict(preset).items():
        if name in ("n_quantiles", "train_freq", *preset.of_policy):
            continue
        assert getattr(model, name) == value, name
    if "train_freq" in asdict(preset):
        assert model.train_freq.frequency == asdict(preset)["train_freq"]
    layers = [tuple(part.weight.shape)[0] for part in model.policy.modules() if isinstance(part, torch.nn.Linear)]
    assert set(preset.net_arch) <= set(layers)


def test_sizes_of_quantiles_and_memories_reach_the_networks():
    def policy(algorithm: Algorithm, **settings: Any) -> Any:
        task = replace(task_for(algorithm), observe="none")
        venv = make_venv(task, 1)
        model = make_model(TrainingPlan(task, algorithm, 1_000, 1, 0, settings=settings), venv)
        venv.close()
        return model.policy

    assert policy("qrdqn", n_quantiles=7).quantile_net.n_quantiles == 7
    tqc = policy("tqc", n_quantiles=7, n_critics=3)
    assert (tqc.critic.n_quantiles, tqc.critic.n_critics) == (7, 3)
    lstm = policy("recurrent-ppo", lstm_hidden_size=5, n_lstm_layers=2).lstm_actor
    assert (lstm.hidden_size, lstm.num_layers) == (5, 2)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_action_spaces(algorithm: Algorithm):
    spaces = {
        "discrete": gym.spaces.Discrete(3),
        "continuous": gym.spaces.Box(-1, 1, (2,), np.float32),
        "unbounded": gym.spaces.Box(-np.inf, np.inf, (2,), np.float32),
        "whole": gym.spaces.Box(0, 9, (2,), np.int64),
        "from one": gym.spaces.Discrete(3, start=1),
        "several": gym.spaces.MultiDiscrete([2, 3]),
        "several from one": gym.spaces.MultiDiscrete([2, 3], start=[0, 1]),
        "switches": gym.spaces.MultiBinary(2),
        "square": gym.spaces.MultiBinary((2, 2)),
        "tuple": gym.spaces.Tuple([gym.spaces.Discrete(2)]),
    }
    several = ("several", "switches")
    refused = {"dqn": ("continuous", *several), "sac": ("discrete", *several)}
    never = ("unbounded", "whole", "from one", "several from one", "square", "tuple")
    refused |= {"qrdqn": refused["dqn"], "tqc": refused["sac"]}
    for name, space in spaces.items():
        if name not in (*refused.get(algorithm, ()), *never):
            check_actions(algorithm, space, "some-v0")
            continue
        with pytest.raises(UserError, match=rf"^{algorithm} .*, some-v0 has .*; (use ppo|give|wrap|flatten)"):
            check_actions(algorithm, space, "some-v0")


def test_observation_spaces():
    box = gym.spaces.Box(-1, 1, (2,), np.float32)
    read = [
        box, gym.spaces.Box(0, 255, (8, 8, 3), np.uint8), gym.spaces.Box(0, 9, (2,), np.int64), gym.spaces.Discrete(3),
        gym.spaces.MultiDiscrete([2, 3]), gym.spaces.MultiBinary((2, 2)),
        gym.spaces.Dict({"near": box, "lane": gym.spaces.Discrete(4)}),
    ]  # fmt: skip
    for space in read:
        check_observations(space, "some-v0")
    refused = [
        gym.spaces.Tuple([box]), gym.spaces.Text(3), gym.spaces.Discrete(3, start=1), gym.spaces.Box(-1, 1, ()),
        gym.spaces.Box(-1, 1, (0,)), gym.spaces.MultiDiscrete([[2, 3], [2, 2]]),
        gym.spaces.MultiDiscrete([2, 3], start=[0, 1]),
    ]  # fmt: skip
    for space in (*refused, *(gym.spaces.Dict({"near": box, "odd": space}) for space in refused)):
        odd = space["odd"] if isinstance(space, gym.spaces.Dict) else space
        with pytest.raises(UserError, match=f"some-v0 has {re.escape(str(odd)[:20])}.*; flatten it, in gymnasium with"):
            check_observations(space, "some-v0")


@pytest.mark.parametrize("algorithm", CONTRIB)
def test_algorithms_of_contrib_say_which_extra_brings_them(algorithm: Algorithm, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "sb3_contrib", None)
    expected = rf"^algorithm {algorithm} needs the sb3-contrib package; pip install 'dgvae-rl\[contrib\]'$"
    with pytest.raises(UserError, match=expected):
        TrainingPlan(task_for(algorithm), algorithm, 10, 1, 0)
    with pytest.raises(UserError, match=expected):
        algorithm_class(algorithm)
    TrainingPlan(ROAD, "ppo", 10, 1, 0)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: PPOPreset(learning_rate=0.0), "learning_rate must be positive, got 0.0"),
        (lambda: PPOPreset(gamma=1.1), r"gamma must lie in \[0, 1\], got 1.1"),
        (lambda: PPOPreset(gamma=-0.1), "gamma must not be negative, got -0.1"),
        (lambda: PPOPreset(n_steps=1), "n_steps must be at least 2, got 1"),
        (lambda: PPOPreset(batch_size=1), "batch_size must be at least 2, got 1"),
        (lambda: PPOPreset(net_arch=(8, 0)), r"net_arch must be at least 1, got \(8, 0\)"),
        (lambda: RecurrentPPOPreset(lstm_hidden_size=0), "lstm_hidden_size must be at least 1, got 0"),
        (lambda: SACPreset(gradient_steps=0), "gradient_steps must be -1 or at least 1, got 0"),
        (lambda: TQCPreset(n_critics=1_001), "n_critics must be at most 1,000, got 1001"),
        (lambda: RecurrentPPOPreset(n_lstm_layers=10**9), "n_lstm_layers must be at most 1,000, got 1000000000"),
        (lambda: SACPreset(tau=0.0), "tau must be positive, got 0.0"),
        (lambda: SACPreset(ent_coef=-1.0), "ent_coef must not be negative, got -1.0"),
        (lambda: QRDQNPreset(exploration_fraction=0.0), "exploration_fraction must be positive, got 0.0"),
        (lambda: TQCPreset(n_quantiles=2), r"top_quantiles_to_drop_per_net must be less than n_quantiles \(2\), got 2"),
    ],
)
def test_values_out_of_range_are_named(make: Any, message: str):
    with pytest.raises(UserError, match=f"^{message}$"):
        make()


def test_presets_of_new_algorithms_follow_the_environment():
    assert preset_for("racetrack-v1", "tqc").gamma == 0.9 and preset_for("merge-v1", "tqc") == TQCPreset()
    assert preset_for("racetrack-v1", "recurrent-ppo") == RecurrentPPOPreset(gamma=0.9)
    assert preset_for("envpool/Racetrack-v0", "ppo").gamma == 0.9 and preset_for("envpool/Merge-v0", "ppo").gamma == 0.8
    assert preset_for("simple_tag_v3", "a2c").gamma == preset_for("intersection-multi-agent-v2", "dqn").gamma == 0.95
    particles = preset_for("simple_tag_v3", "recurrent-ppo")
    assert isinstance(particles, RecurrentPPOPreset)
    assert asdict(preset_for("simple_tag_v3", "ppo")).items() <= asdict(particles).items()
    assert isinstance(preset_for("highway-fast-v0", "a2c", "envpool"), OnPolicyPreset)


def test_bounds_and_weights_of_the_particle_worlds_reach_the_model():
    venv = make_venv(Task("simple_tag_v3", "none", learners=("adversary",)), 1)
    model: Any = make_model(TrainingPlan(Task("simple_tag_v3", "none"), "ppo", 1, 1, 0), venv)
    venv.close()
    assert (model.target_kl, model.vf_coef, model.batch_size, model.n_epochs) == (0.01, 0.005, 75, 5)


def test_few_environments_get_small_batches_without_a_warning():
    settings = {"n_steps": 4, "batch_size": 512}
    task = replace(ROAD, observe="none")
    venv = make_venv(task, 1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model: Any = make_model(TrainingPlan(task, "recurrent-ppo", 10, 1, 0, settings=settings), venv)
    venv.close()
    assert model.batch_size == 4
