import math

import numpy as np
import pytest
import torch

from predictor.accuracy import Outcome, fitted_std_m, run_window_batch, run_windows, summarise
from predictor.baselines.constant_velocity import ConstantVelocity
from predictor.data.store import Episode
from predictor.data.windows import WindowBatch, Windows
from tests.predictor.helpers import ROAD, model, random_presence, random_states, spec


def outcome(errors: list[list[list[float]]], valid: list[list[bool]]) -> Outcome:
    """One row; errors along x as [sample][agent][step], of a truth at the origin."""
    forecast = torch.zeros(1, *np.shape(errors), 2)
    forecast[0, ..., 0] = torch.tensor(errors)
    return Outcome(forecast, torch.zeros(1, *np.shape(valid), 2), torch.tensor(valid)[None])


# Three agents over two rows of different size; the second never has its last step, the third has no step at all.
OUTCOMES = [
    outcome([[[1.0, 3.0], [5.0, 9.0]], [[2.0, 6.0], [1.0, 9.0]]], [[True, True], [True, False]]),
    outcome([[[7.0, 7.0]], [[7.0, 7.0]]], [[False, False]]),
    outcome([[[4.0, 0.0]], [[2.0, 0.0]]], [[True, True]]),
]


def test_summary_closed_form():
    row = summarise("model", OUTCOMES, std_m=(1.0, 2.0))
    assert (row.name, row.num_samples, row.agents) == ("model", 2, 2)
    assert row.min_ade_m == pytest.approx((2.0 + 1.0) / 2)  # of agents whose truth is known throughout
    assert row.min_fde_m == pytest.approx((3.0 + 0.0) / 2)
    assert row.by_step_m == pytest.approx([(1 + 1 + 2) / 3, (3 + 0) / 2])  # of each agent's best sample
    # of the samples' mean: 1.5, 3 and 3 at the first step, 4.5 and 0 at the second
    assert row.rmse_m == pytest.approx([math.sqrt((1.5**2 + 9 + 9) / 3), math.sqrt(4.5**2 / 2)])

    def nll(first: float, second: float, std: float) -> float:
        halves = (math.exp(-(e**2) / (2 * std**2)) / (2 * math.pi * std**2) for e in (first, second))
        return -math.log(sum(halves) / 2)

    assert row.nll == pytest.approx(
        [(nll(1, 2, 1) + nll(5, 1, 1) + nll(4, 2, 1)) / 3, (nll(3, 6, 2) + nll(0, 0, 2)) / 2], rel=1e-5
    )


def test_order_of_batches_does_not_matter():
    forwards, backwards = summarise("a", OUTCOMES, (1.0, 2.0)), summarise("a", OUTCOMES[::-1], (1.0, 2.0))
    assert forwards.by_step_m == pytest.approx(backwards.by_step_m)
    assert forwards.min_ade_m == pytest.approx(backwards.min_ade_m)


def test_nothing_known_is_not_a_perfect_score():
    row = summarise("model", [OUTCOMES[1]])
    assert row.agents == 0
    assert math.isnan(row.min_ade_m) and math.isnan(row.min_fde_m)


@pytest.mark.parametrize("std_m", [(), (1.0,)], ids=["none", "too_short"])
def test_no_likelihood_without_a_spread_for_every_step(std_m: tuple[float, ...]):
    assert summarise("model", OUTCOMES, std_m).nll == []


def test_fitted_spread_closed_form():
    # first sample's errors: 1, 5 and 4 at the first step, 3 and 0 at the second; two axes share the squared error
    assert fitted_std_m(OUTCOMES) == pytest.approx([math.sqrt(42 / 6), math.sqrt(9 / 4)])


def test_fitted_spread_minimises_the_likelihood():
    best = fitted_std_m([o := Outcome(OUTCOMES[0].forecast[:, :1], OUTCOMES[0].future, OUTCOMES[0].valid)])
    at_best = summarise("model", [o], best).nll
    for factor in (0.9, 1.1):
        other = summarise("model", [o], [factor * s for s in best]).nll
        assert all(a < b for a, b in zip(at_best, other, strict=True))


def test_perfect_forecasts_have_a_finite_spread():
    perfect = Outcome(torch.zeros(1, 1, 1, 2, 2), torch.zeros(1, 1, 2, 2), torch.ones(1, 1, 2).bool())
    assert fitted_std_m([perfect]) == pytest.approx([1e-3, 1e-3])


# --- Windows ----------------------------------------------------------------------------------------------------------


def windows(frame_seed: int = 0, **kwargs: int) -> Windows:
    present = random_presence(frame_seed, 9, 4, share=0.8).numpy()
    states = random_states(frame_seed, 9, 4, 4).numpy() * present[..., None]
    return Windows(
        [Episode(states, present, np.arange(4))], spec(ROAD), **({"history_steps": 4, "horizon_steps": 3} | kwargs)
    )


def test_streamed_windows_against_a_loop():
    """Windows of every length of history in one batch, against one window at a time."""
    forecaster, cut = model(num_edge_types=3, frame=ROAD), windows()
    batch = cut.batch(np.arange(len(cut)))
    ours = run_window_batch(forecaster, batch, horizon_steps=3)
    assert sorted(set(batch.last_observed.tolist())) == [0, 1, 2, 3]
    for row, last in enumerate(batch.last_observed.tolist()):
        memory = forecaster.empty_memory(1, batch.states.shape[2])
        for t in range(last + 1):
            memory, belief = forecaster.observe(memory, batch.states[row, t][None], batch.valid[row, t][None])
        expected = forecaster.rollout(belief, 3)[0, ..., :2]
        now = batch.valid[row, last]
        torch.testing.assert_close(ours.forecast[row][:, now], expected[:, now], rtol=1e-5, atol=1e-4)
        for agent in range(batch.states.shape[2]):
            for step in range(3):
                truth, known = batch.states[row, last + 1 + step, agent, :2], batch.valid[row, last + 1 + step, agent]
                assert torch.equal(ours.future[row, agent, step], truth)
                assert ours.valid[row, agent, step] == (known and agent > 0)  # the ego is not forecast


def test_without_an_ego_everyone_is_judged():
    batch = WindowBatch(random_states(0, 2, 4, 3, 4), torch.ones(2, 4, 3).bool(), torch.tensor([1, 0]))
    assert run_window_batch(model(has_ego=False), batch, 2).valid.all()


def test_straight_motion_is_forecast_by_constant_velocity():
    states = np.zeros((6, 2, 4), dtype=np.float32)
    states[..., 2:], states[:, 1, 2:] = (3.0, -1.0), (0.5, 2.0)
    states[..., :2] = 0.5 * np.arange(6)[:, None, None] * states[..., 2:]
    cut = Windows([Episode(states, np.ones((6, 2), dtype=np.bool_), np.arange(2))], spec(dt_s=0.5), 2, 3)
    outcomes = list(run_windows(ConstantVelocity(spec(dt_s=0.5)), cut, np.arange(len(cut)), 3))
    row = summarise("constant velocity", outcomes)
    assert row.min_ade_m == pytest.approx(0.0, abs=1e-5)
    assert row.agents == 3  # windows at steps 0, 1, 2 have their whole future


def test_batches_are_aligned_with_the_windows():
    forecaster, cut = model(frame=ROAD), windows()
    indices = np.array([7, 0, 3, 5, 2])
    at_once = summarise("a", list(run_windows(forecaster, cut, indices, 3)))
    in_pieces = list(run_windows(forecaster, cut, indices, 3, batch_size=2))
    assert [len(o.forecast) for o in in_pieces] == [2, 2, 1]
    assert summarise("a", in_pieces).by_step_m == pytest.approx(at_once.by_step_m, rel=1e-5)


def test_samples_depend_on_the_seed_alone():
    forecaster, cut = model(frame=ROAD), windows()

    def forecasts(seed: int, everywhere: int) -> torch.Tensor:
        torch.manual_seed(everywhere)
        return next(run_windows(forecaster, cut, np.arange(4), 3, num_samples=3, seed=seed)).forecast

    assert torch.equal(forecasts(0, everywhere=1), forecasts(0, everywhere=2))
    assert not torch.equal(forecasts(0, everywhere=1), forecasts(1, everywhere=1))
    assert torch.equal(forecasts(0, everywhere=1)[:, 0], forecasts(1, everywhere=1)[:, 0])
