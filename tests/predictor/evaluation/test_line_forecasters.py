"""Forecasters of a table's lines: what they are fitted to, and that each has samples."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from predictor.baselines.gaussian_residual import GaussianResidual
from predictor.baselines.nearest_neighbour import NearestNeighbour
from predictor.data.store import Episode, StoreInfo, write_store
from predictor.evaluation.line_forecasters import batch_size, fit_windows, line_forecaster
from predictor.evaluation.paper_tables import CONTROLS, NUM_SAMPLES, SPRINGS, Line, Protocol, Sizes
from predictor.support.errors import UserError
from tests.predictor.evaluation.test_controls import STEP_M, walk
from tests.predictor.helpers import spec

LAYOUT = spec(has_ego=False)
TABLE = replace(SPRINGS, train="walks", val=None, tests={"test": "walks"}, protocol=Protocol(4, 3, 4, 3))
SIZES = Sizes(1, 1, 0, 1, 300, 1)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data")
    write_store(folder / "walks", StoreInfo(LAYOUT, "walk"), [walk(i) for i in range(60)])
    return folder


def line(model: str) -> Line:
    return next(each for each in (*CONTROLS, Line("majority", "", "majority")) if each.model == model)


def test_constant_velocity_draws_from_a_gaussian_of_the_errors_of_training(data: Path):
    made = line_forecaster(TABLE, line("constant-velocity"), data, SIZES, None, LAYOUT, "cpu")
    assert isinstance(made.forecaster, GaussianResidual)
    grown = STEP_M * np.sqrt([[1, 1], [2, 2], [3, 3]])  # of a random walk
    np.testing.assert_allclose(made.fitted["std_m"], grown, rtol=0.1)
    assert made.fitted["windows"] == 300 and np.shape(made.fitted["covariance_m2"]) == (6, 6)
    assert made.parameters == 0


def test_noise_of_constant_velocity_is_fitted_to_the_same_windows(data: Path):
    made = line_forecaster(TABLE, line("constant-velocity-noise"), data, SIZES, None, LAYOUT, "cpu")
    assert made.fitted["noise_m"] == pytest.approx(STEP_M, rel=0.1)
    assert made.fitted["growth"] == pytest.approx(0.5, abs=0.1)
    assert made.fitted["windows"] == 300


def test_neighbours_are_as_many_as_there_are_samples_beside_their_mean(data: Path):
    made = line_forecaster(TABLE, line("nearest-neighbours"), data, SIZES, None, LAYOUT, "cpu")
    near = made.forecaster
    assert isinstance(near, NearestNeighbour) and made.fitted == {
        "neighbours": NUM_SAMPLES - 1,
        "examples": 60 * 11 * 4,
    }
    states, there = torch.zeros(1, 2, 4), torch.ones(1, 2).bool()
    _, belief = near.observe(near.empty_memory(1, 2), states, there)
    ends = near.rollout(belief, 3, NUM_SAMPLES).states[0, :, 0, -1, :2]
    assert len({tuple(end.tolist()) for end in ends}) == NUM_SAMPLES


def test_training_episodes_are_those_of_the_budget(data: Path):
    few = line_forecaster(TABLE, line("nearest-neighbours"), data, replace(SIZES, max_episodes=2), None, LAYOUT, "cpu")
    assert few.fitted["examples"] == 2 * 11 * 4


@pytest.mark.parametrize(("steps", "history"), [(7, 4), (30, 4), (5, 2), (4, 1)])
def test_windows_have_the_tables_lengths_or_the_longest_history_that_fits(steps: int, history: int):
    windows = fit_windows([walk(0, steps=steps), walk(1, steps=4)], LAYOUT, TABLE.protocol)
    assert (windows.history_steps, windows.horizon_steps) == (history, 3)
    observed, ahead = windows.index[:, 1] + 1, np.array([steps, 4])[windows.index[:, 0]] - windows.index[:, 1] - 1
    assert observed.min() >= history and ahead.min() >= 3


def test_episodes_not_longer_than_the_horizon_are_refused():
    with pytest.raises(UserError, match="no window fits"):
        fit_windows([walk(0, steps=3)], LAYOUT, TABLE.protocol)


def test_fits_are_bounded_by_the_number_of_test_windows():
    assert SIZES.fit_windows == 300
    assert replace(SIZES, test_windows=0).fit_windows == replace(SIZES, test_windows=10**6).fit_windows == 2000


def test_batches_get_smaller_with_pairs_and_samples():
    assert (
        batch_size(5, 20) == 120 and batch_size(5, 1) == 256 and batch_size(1000, 20) == 1 and batch_size(0, 1) == 256
    )


def test_the_ego_is_not_fitted(tmp_path: Path):
    around, episodes = spec(perception_m=1e6), [walk(i) for i in range(60)]
    for episode in episodes:
        episode.states[:, 0, :2] *= 100
    write_store(tmp_path / "walks", StoreInfo(around, "walk"), episodes)
    made = line_forecaster(TABLE, line("constant-velocity"), tmp_path, SIZES, None, around, "cpu")
    assert np.max(made.fitted["std_m"]) < 2 * STEP_M


def test_agents_without_true_types_have_no_majority(tmp_path: Path):
    present = np.ones((9, 2), dtype=np.bool_)
    write_store(
        tmp_path / "walks", StoreInfo(LAYOUT, "walk"), [Episode(np.zeros((9, 2, 4), np.float32), present, np.arange(2))]
    )
    with pytest.raises(UserError, match="the majority class needs true edge types"):
        line_forecaster(TABLE, line("majority"), tmp_path, SIZES, None, LAYOUT, "cpu")
