"""Controls fitted to recorded data: from random walks, whose errors are known, to the parameters that made them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from predictor.baselines.constant_velocity import ConstantVelocity
from predictor.baselines.gaussian_residual import GaussianResidual
from predictor.data.store import Episode, StoreInfo, write_store
from predictor.evaluation import controls
from predictor.evaluation.controls import HISTORY_STEPS, fit_noise, fit_residual, training_windows
from predictor.scene import SceneSpec
from predictor.support.errors import UserError
from tests.predictor.helpers import spec

HORIZON, STEP_M = 3, 0.5
LAYOUT = spec(has_ego=False)


def walk(seed: int, steps: int = 14, agents: int = 4) -> Episode:
    """Agents that state to stand, and are displaced by N(0, `STEP_M`²) in each step and axis."""
    states = np.zeros((steps, agents, 4), dtype=np.float32)
    states[..., :2] = np.cumsum(np.random.default_rng(seed).normal(0, STEP_M, (steps, agents, 2)), axis=0)
    return Episode(states, np.ones((steps, agents), dtype=np.bool_), np.arange(agents), "walk", seed)


def store(path: Path, episodes: list[Episode], layout: SceneSpec = LAYOUT) -> Path:
    write_store(path, StoreInfo(layout, "walk"), episodes)
    return path


@pytest.fixture(scope="module")
def walks(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return store(tmp_path_factory.mktemp("data") / "walks", [walk(i) for i in range(120)])


def covariance(control: GaussianResidual) -> Tensor:
    """Covariance of the noise that the control adds, steps × axes."""
    now = control.observe(control.empty_memory(1, 1), torch.zeros(1, 1, 4), torch.ones(1, 1).bool())[1]
    samples = control.rollout(now, HORIZON, 20_001, torch.Generator().manual_seed(0)).states
    noise: Tensor = (samples[0, 1:, 0, :, :2] - samples[0, :1, 0, :, :2]).flatten(1).T.cov()
    return noise


TIME = torch.arange(1.0, 1 + HORIZON)
EXPECTED = torch.kron(torch.minimum(TIME[:, None], TIME), torch.eye(2))
"""Covariance of a random walk with steps of 1 m: min(s, t) between steps s and t, none between axes."""


def test_residual_noise_is_the_random_walk_that_the_forecaster_misses(walks: Path):
    windows = training_windows([walks], LAYOUT, HORIZON)
    straight = ConstantVelocity(LAYOUT, HORIZON)
    control = fit_residual(straight, windows, HORIZON)
    assert control.forecaster is straight and control.horizon_steps == HORIZON
    torch.testing.assert_close(covariance(control), STEP_M**2 * EXPECTED, rtol=0.15, atol=0.06)


def test_noise_of_constant_velocity_is_that_of_the_walk(walks: Path):
    """It grows with the root of time."""
    control = fit_noise(training_windows([walks], LAYOUT, HORIZON), HORIZON)
    assert (control.noise_m, control.growth) == (pytest.approx(STEP_M, rel=0.1), pytest.approx(0.5, abs=0.1))
    assert (control.spec, control.horizon_steps) == (LAYOUT, HORIZON)


def test_the_ego_is_not_fitted(tmp_path: Path):
    """It is not forecast; here it jumps by a hundred times as much."""
    around, episodes = spec(perception_m=1e6), [walk(i) for i in range(120)]
    for episode in episodes:
        episode.states[:, 0, :2] *= 100
    windows = training_windows([store(tmp_path / "ego", episodes, around)], around, HORIZON)
    found = covariance(fit_residual(ConstantVelocity(around, HORIZON), windows, HORIZON))
    torch.testing.assert_close(found, STEP_M**2 * EXPECTED, rtol=0.15, atol=0.06)
    assert fit_noise(windows, HORIZON).noise_m == pytest.approx(STEP_M, rel=0.1)


def test_landmarks_are_not_fitted(tmp_path: Path):
    """They never move; here half of the agents are such."""
    names = (*LAYOUT.feature_names, "landmark")
    layout = replace(LAYOUT, feature_names=names, feature_scales=(*LAYOUT.feature_scales, 1.0))
    episodes = []
    for i in range(120):
        moving = walk(i, agents=8)
        states = np.concatenate([moving.states, np.zeros((14, 8, 1), dtype=np.float32)], axis=-1)
        states[:, 4:, :2], states[:, 4:, 4] = 3.0, 1.0
        episodes.append(replace(moving, states=states))
    windows = training_windows([store(tmp_path / "tag", episodes, layout)], layout, HORIZON)
    found = covariance(fit_residual(ConstantVelocity(layout, HORIZON), windows, HORIZON))
    torch.testing.assert_close(found, STEP_M**2 * EXPECTED, rtol=0.15, atol=0.06)
    assert fit_noise(windows, HORIZON).noise_m == pytest.approx(STEP_M, rel=0.1)


def test_windows_have_a_whole_future_and_come_from_all_stores(walks: Path, tmp_path: Path):
    other = store(tmp_path / "other", [walk(1000, steps=6)])
    windows = training_windows([walks, other], LAYOUT, HORIZON)
    assert len(windows) == 120 * (14 - HORIZON) + 6 - HORIZON
    assert windows.history_steps == HISTORY_STEPS and windows.horizon_steps == HORIZON
    assert windows.batch(np.arange(len(windows))).valid[:, -1].any(-1).any()
    with pytest.raises(UserError, match="no window fits: episodes have at most 6 steps, a window needs 7"):
        training_windows([other], LAYOUT, 6)


def test_agents_that_leave_within_the_horizon_are_left_out(tmp_path: Path):
    """Where they are not, states are zeros: 50 m from where they were."""
    episodes = [walk(i) for i in range(120)]
    for episode in episodes:
        episode.states[:, 1, :2] += 50.0
        episode.valid[8:, 1] = False
        episode.states[8:, 1] = 0.0
    windows = training_windows([store(tmp_path / "leaving", episodes)], LAYOUT, HORIZON)
    found = covariance(fit_residual(ConstantVelocity(LAYOUT, HORIZON), windows, HORIZON))
    torch.testing.assert_close(found, STEP_M**2 * EXPECTED, rtol=0.15, atol=0.06)


def test_of_many_windows_some_are_drawn_by_the_seed(walks: Path, monkeypatch: pytest.MonkeyPatch):
    windows, straight = training_windows([walks], LAYOUT, HORIZON), ConstantVelocity(LAYOUT, HORIZON)
    monkeypatch.setattr(controls, "MOST_WINDOWS", 20)
    drawn: list[int] = []
    run = controls.run_windows

    def counting(forecaster: object, found: object, indices: np.ndarray, *arguments: object, **named: object) -> object:
        drawn.append(len(set(indices.tolist())))
        return run(forecaster, found, indices, *arguments, **named)

    monkeypatch.setattr(controls, "run_windows", counting)
    roots = [fit_residual(straight, windows, HORIZON, seed)._root for seed in (0, 0, 1)]
    noises = [fit_noise(windows, HORIZON, seed).noise_m for seed in (0, 0, 1)]
    assert drawn == [20] * 6
    assert torch.equal(roots[0], roots[1]) and not torch.equal(roots[0], roots[2])
    assert noises[0] == noises[1] != noises[2]


def test_too_little_data_for_a_covariance_is_named(tmp_path: Path):
    """One agent and six windows, for six coordinates."""
    windows = training_windows([store(tmp_path / "few", [walk(0, steps=6 + HORIZON, agents=1)])], LAYOUT, HORIZON)
    with pytest.raises(UserError, match="a covariance of 6 coordinates needs more examples, got 6"):
        fit_residual(ConstantVelocity(LAYOUT, HORIZON), windows, HORIZON)
