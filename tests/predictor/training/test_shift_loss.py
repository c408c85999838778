"""The loss on shifts: zero where forecasts move as the truth does, whatever both forecasts have in common."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from predictor.data.twins import Pairs, Twins
from predictor.dgvae.model import DGVAE
from predictor.forecaster import Futures, WindowOutput
from predictor.support.errors import UserError
from predictor.training.config import TrainConfig
from predictor.training.mode_loss import unit
from predictor.training.shift_loss import LARGE, TwinShifts, shift_loss
from tests.predictor.data.test_twins import HISTORY, HORIZON, twins_of
from tests.predictor.helpers import PLURAL, spec

SCALES = torch.tensor(spec(has_ego=True).feature_scales)


@pytest.fixture
def pairs() -> Pairs:
    episodes = [episode for seed in range(2) for episode in twins_of(seed, 3.0)]
    return Twins(episodes, spec(has_ego=True), HISTORY, HORIZON).batch(np.arange(2))


def output(states: torch.Tensor, modes: int = 0) -> WindowOutput:
    """An output whose single forecast, and whose modes' mean, is `states`."""
    nothing = states.new_zeros(len(states), HISTORY, *states.shape[1:2], 4)
    if not modes:
        return WindowOutput(nothing, states)
    apart = torch.arange(float(modes))[:, None, None, None] - (modes - 1) / 2
    probs = torch.full((len(states), modes, states.shape[1]), 1 / modes)
    return WindowOutput(nothing, states, modes=Futures(states[:, None] + apart, probs))


def loss(pairs: Pairs, predicted_m: torch.Tensor, modes: int = 0) -> float:
    """The loss of forecasts that differ by `predicted_m` and are both far from the truth."""
    before = torch.randn(*pairs.counted.shape, 4, generator=torch.Generator().manual_seed(0)) * 20
    after = before.clone()
    after[..., :2] += predicted_m
    return float(shift_loss(output(after, modes), output(before, modes), pairs, SCALES, 2, 5e-5))


@pytest.mark.parametrize("modes", [0, 3])
def test_it_is_zero_for_the_true_shift_alone(pairs: Pairs, modes: int):
    true_m = pairs.true_shift(2)
    assert loss(pairs, true_m, modes) == pytest.approx(0, abs=1e-3)
    assert 0 < loss(pairs, 0.5 * true_m, modes) < loss(pairs, 0 * true_m, modes) < loss(pairs, -true_m, modes)


def test_the_modes_mean_counts_beside_the_single_forecast(pairs: Pairs):
    still_m = 0 * pairs.true_shift(2)
    assert loss(pairs, still_m, 3) == pytest.approx(2 * loss(pairs, still_m), rel=1e-4)


def test_a_large_error_counts_by_its_size(pairs: Pairs):
    """Every moved step is wrong by 30 m: each counts nearly in full, in the unit of the likelihood."""
    wrong_m = pairs.true_shift(2) + torch.where(pairs.true_shift(2).norm(dim=-1, keepdim=True) > 0, 300.0, 0.0)
    error = float(2**0.5 * 300.0 / SCALES[0])
    expected = unit(5e-5) * LARGE * ((1 + (error / LARGE) ** 2) ** 0.5 - 1)
    assert loss(pairs, wrong_m) == pytest.approx(expected, rel=1e-3)


def test_what_does_not_count_has_no_effect(pairs: Pairs):
    wild_m = torch.where(pairs.counted[..., None], pairs.true_shift(2), torch.inf)
    assert loss(pairs, wild_m) == pytest.approx(0, abs=1e-3)


def test_one_observed_step_shows_no_removal(tmp_path: Path):
    with pytest.raises(UserError, match="shift_weight needs history_steps of at least 2"):
        TrainConfig((tmp_path / "data",), tmp_path / "run", shift_weight=1.0, history_steps=1)


def test_several_processes_do_not_share_pairs(tmp_path: Path):
    config = TrainConfig((tmp_path / "data",), tmp_path / "run", shift_weight=1.0, history_steps=HISTORY)
    episodes = list(twins_of(0, 3.0))
    assert TwinShifts.of(config, episodes, spec(has_ego=True), several_processes=False) is not None
    with pytest.raises(UserError, match="shift_weight needs one process; train on one device, or set it to 0"):
        TwinShifts.of(config, episodes, spec(has_ego=True), several_processes=True)


def test_both_windows_of_a_pair_have_equal_noise(tmp_path: Path):
    """Where an intervention changes nothing, forecasts of drawn edges do not differ either."""
    config = TrainConfig((tmp_path / "data",), tmp_path / "run", shift_weight=1.0, history_steps=HISTORY)
    branch, twin = twins_of(0, 0.0)
    same = replace(twin, perturbed=branch.perturbed)
    shifts = TwinShifts.of(config, [same, twin], spec(has_ego=True), several_processes=False)
    assert shifts is not None
    network = DGVAE(spec(has_ego=True), PLURAL, 2).train()
    assert shifts.loss(network, 0, 2, SCALES, num_modes=2).item() == 0


def test_each_step_and_seed_draws_its_own_pairs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    episodes = [episode for seed in range(8) for episode in twins_of(seed, 3.0)]
    draw, drawn = Twins.draw, list[np.ndarray]()

    def watched(twins: Twins, count: int, rng: np.random.Generator) -> np.ndarray:
        drawn.append(draw(twins, count, rng))
        return drawn[-1]

    monkeypatch.setattr(Twins, "draw", watched)
    network = DGVAE(spec(has_ego=True), PLURAL, 2)
    settings = TrainConfig(
        (tmp_path / "data",), tmp_path / "run", shift_weight=1.0, history_steps=HISTORY, batch_size=16
    )
    for seed, step in ((0, 0), (0, 1), (0, 0), (1, 0)):
        shifts = TwinShifts.of(replace(settings, seed=seed), episodes, spec(has_ego=True), several_processes=False)
        assert shifts is not None
        shifts.loss(network, step, 2, SCALES)
    first, later, again, other = (pairs.tolist() for pairs in drawn)
    assert first == again and first != later and first != other
