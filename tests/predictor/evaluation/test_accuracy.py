import json
import math
from dataclasses import asdict, replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from predictor.baselines.constant_velocity import ConstantVelocity, NoisyConstantVelocity
from predictor.data.store import Episode
from predictor.data.windows import WindowBatch, Windows
from predictor.evaluation import displacement as metrics
from predictor.evaluation.accuracy import Accuracy, Tally, fitted_std_m, summarise
from predictor.evaluation.outcomes import Outcome, run_window_batch, run_windows
from predictor.evaluation.standard_errors import Statistic
from predictor.support.errors import UserError
from tests.predictor.helpers import ROAD, model, random_presence, random_states, spec


def outcome(errors: list[list[list[float]]], valid: list[list[bool]]) -> Outcome:
    """One window; errors along x as [sample][agent][step], of a truth at the origin."""
    forecast = torch.zeros(1, *np.shape(errors), 2)
    forecast[0, ..., 0] = torch.tensor(errors)
    return Outcome(forecast, torch.zeros(1, *np.shape(valid), 2), torch.tensor(valid)[None])


# Three agents over two windows of different size; the second never has its last step, the third has no step at all.
OUTCOMES = [
    outcome([[[1.0, 3.0], [5.0, 9.0]], [[2.0, 6.0], [1.0, 9.0]]], [[True, True], [True, False]]),
    outcome([[[7.0, 7.0]], [[7.0, 7.0]]], [[False, False]]),
    outcome([[[4.0, 0.0]], [[2.0, 0.0]]], [[True, True]]),
]


def test_summary_closed_form():
    accuracy = summarise("model", OUTCOMES, std_m=(1.0, 2.0))
    assert (accuracy.name, accuracy.num_samples, accuracy.agents) == ("model", 2, 2)
    assert accuracy.min_ade_m == pytest.approx((2.0 + 1.0) / 2)  # of agents whose truth is known throughout
    assert accuracy.min_fde_m == pytest.approx((3.0 + 0.0) / 2)
    assert accuracy.by_step_m == pytest.approx([(1 + 1 + 2) / 3, (3 + 0) / 2])  # of each agent's best sample
    # of the samples' mean: 1.5, 3 and 3 at the first step, 4.5 and 0 at the second
    assert accuracy.rmse_m == pytest.approx([math.sqrt((1.5**2 + 9 + 9) / 3), math.sqrt(4.5**2 / 2)])

    def nll(first: float, second: float, std: float) -> float:
        halves = (math.exp(-(e**2) / (2 * std**2)) / (2 * math.pi * std**2) for e in (first, second))
        return -math.log(sum(halves) / 2)

    assert accuracy.nll == pytest.approx(
        [(nll(1, 2, 1) + nll(5, 1, 1) + nll(4, 2, 1)) / 3, (nll(3, 6, 2) + nll(0, 0, 2)) / 2], rel=1e-5
    )


def test_joint_and_overall_numbers_closed_form():
    accuracy = summarise("model", OUTCOMES)
    # the agents known throughout are one per scene here: the first of the first scene, that of the third
    assert (accuracy.scenes, accuracy.axes) == (2, 2)
    assert accuracy.min_joint_ade_m == pytest.approx((2.0 + 1.0) / 2)
    assert accuracy.min_joint_fde_m == pytest.approx((3.0 + 0.0) / 2)
    assert accuracy.miss_rate == pytest.approx(0.5)  # 3 m misses, 0 m does not
    assert accuracy.overall_rmse_m == pytest.approx(math.sqrt((1.5**2 + 9 + 9 + 4.5**2 + 0) / 5))
    assert summarise("model", OUTCOMES, miss_threshold_m=3.0).miss_rate == 0.0


def test_one_sample_serves_all_agents_of_a_scene():
    both = outcome([[[1.0, 1.0], [5.0, 5.0]], [[4.0, 4.0], [3.0, 3.0]]], [[True, True], [True, True]])
    accuracy = summarise("model", [both])
    assert accuracy.min_ade_m == pytest.approx((1 + 3) / 2)
    assert accuracy.min_joint_ade_m == accuracy.min_joint_fde_m == pytest.approx((1 + 5) / 2)


def test_agents_known_in_part_count_where_asked_for():
    tally = Tally(partial_agents=True)
    for o in OUTCOMES:
        tally.add(o)
    accuracy = tally.accuracy("model")
    assert accuracy.agents == 3
    assert accuracy.min_ade_m == pytest.approx((2.0 + 1.0 + 1.0) / 3)  # the second agent: 1 m at its only step
    assert accuracy.min_fde_m == pytest.approx((3.0 + 0.0) / 2)
    assert accuracy.by_step_m == summarise("model", OUTCOMES).by_step_m


def gaussian(seed: int, samples: int = 20, windows: int = 400, spread: float = 1.0, axes: int = 2) -> Outcome:
    """Samples and truths from one distribution (but for `spread`)."""
    generator = torch.Generator().manual_seed(seed)
    forecast = spread * torch.randn(windows, samples, 3, 2, axes, generator=generator)
    truth = torch.randn(windows, 3, 2, axes, generator=generator)
    return Outcome(forecast, truth, torch.rand(windows, 3, 2, generator=generator) < 0.9)


def test_coverage_says_whether_the_samples_are_spread_like_the_truth():
    calibrated, sure = summarise("a", [gaussian(0)]), summarise("a", [gaussian(0, spread=0.3)])
    assert calibrated.coverage == pytest.approx([0.9, 0.9], abs=0.03)
    assert max(sure.coverage) < 0.5
    known = calibrated.statistics["coverage"]
    assert known.mean == pytest.approx(np.mean(calibrated.coverage), abs=0.01)
    assert len(calibrated.step_errors["coverage"]) == 2


@pytest.mark.parametrize("samples", [1, 8])
def test_too_few_samples_have_no_coverage(samples: int):
    accuracy = summarise("a", [gaussian(0, samples)])
    assert accuracy.coverage == [] and "coverage" not in accuracy.statistics and "coverage" not in accuracy.step_errors


def test_statistics_are_those_of_the_subsets():
    """Against plain loops over the same subsets."""
    whole = gaussian(0, samples=4, windows=90)
    accuracy = summarise("a", [whole])
    parts = np.array_split(np.random.default_rng(0).permutation(90), 20)
    of_parts = [summarise("a", [Outcome(whole.forecast[p], whole.future[p], whole.valid[p])]) for p in parts]
    names = (
        "ade_m", "fde_m", "min_ade_m", "min_fde_m", "min_joint_ade_m", "min_joint_fde_m", "energy_m", "miss_rate",
        "overall_rmse_m", "overlap", "true_overlap",
    )  # fmt: skip
    assert set(accuracy.statistics) == set(names)
    for name in names:
        values = [getattr(r, name) for r in of_parts]
        found = accuracy.statistics[name]
        assert found.mean == pytest.approx(np.mean(values), rel=1e-5)
        assert found.standard_error == pytest.approx(np.std(values, ddof=1) / math.sqrt(20), rel=1e-4)
        assert found.subsets == 20
    for name in ("by_step_m", "rmse_m"):
        for step in range(2):
            values = [getattr(r, name)[step] for r in of_parts]
            assert accuracy.step_errors[name][step] == pytest.approx(np.std(values, ddof=1) / math.sqrt(20), rel=1e-4)


def test_windows_of_an_episode_stay_together_in_the_subsets():
    """Copies of a window say nothing new: the standard error stays that of the episodes, in whatever order they are."""
    once = gaussian(0, samples=4, windows=90)
    alone = summarise("a", [replace(once, episode=np.arange(90) + 7)])
    windows = summarise("a", [once]).statistics
    for name, found in alone.statistics.items():
        assert found.standard_error == windows[name].standard_error, "an episode with one window is a window"
        assert found.mean == pytest.approx(getattr(alone, name), rel=1e-6), "the value over all entries"
    numbered = np.random.default_rng(1).permutation(90)
    assert summarise("a", [replace(once, episode=numbered)]).statistics == alone.statistics, "whatever their numbers"
    copied = np.concatenate([np.arange(90), np.arange(90)[::-1]])
    again = Outcome(once.forecast[copied], once.future[copied], once.valid[copied], episode=copied)
    together = summarise("a", [again.last_windows(180)])
    assert together.statistics["ade_m"].standard_error == pytest.approx(
        alone.statistics["ade_m"].standard_error, rel=0.5
    )
    first_order = summarise("a", [replace(again, episode=copied), again])
    for name, found in first_order.statistics.items():
        assert found.standard_error == pytest.approx(together.statistics[name].standard_error, rel=1e-6), name
    apart = summarise("a", [replace(again, episode=None)])
    assert apart.statistics["ade_m"].standard_error < 0.85 * together.statistics["ade_m"].standard_error


def test_rows_on_the_same_windows_have_the_same_subsets():
    first = gaussian(0, windows=60)
    shifted = replace(first, forecast=first.future[:, None] + torch.tensor([2.0, 0.0]))
    doubled = replace(first, forecast=first.future[:, None] + torch.tensor([4.0, 0.0]))
    a, b = (summarise("a", [o]).statistics["min_ade_m"] for o in (shifted, doubled))
    assert (a.mean, b.mean) == pytest.approx((2.0, 4.0))
    assert a.standard_error == pytest.approx(0.0, abs=1e-6)


def test_one_window_has_no_standard_error():
    accuracy = summarise("a", [OUTCOMES[0]])
    assert accuracy.statistics["min_ade_m"] == Statistic(2.0, None, 1)
    assert accuracy.step_errors["by_step_m"] == [None, None]


def tallied(outcomes: list[Outcome], batch_intervals: bool = True) -> Accuracy:
    tally = Tally((1.0, 2.0))
    for o in outcomes:
        tally.add(o)
    return tally.accuracy("model", batch_intervals=batch_intervals)


def test_intervals_over_batches_closed_form():
    """Two of the three batches count something: the intervals end at what each of them says alone."""
    accuracy = tallied(OUTCOMES)
    assert accuracy.intervals["min_ade_m"] == pytest.approx((1.0, 2.0))
    assert accuracy.intervals["min_fde_m"] == pytest.approx((0.0, 3.0))
    assert accuracy.intervals["miss_rate"] == (0.0, 1.0)
    assert accuracy.intervals["overall_rmse_m"] == pytest.approx(
        (math.sqrt(9 / 2), math.sqrt((1.5**2 + 9 + 4.5**2) / 3))
    )
    assert accuracy.step_intervals["by_step_m"] == [pytest.approx((1.0, 2.0)), pytest.approx((0.0, 3.0))]
    assert accuracy.step_intervals["rmse_m"] == [
        pytest.approx((math.sqrt((1.5**2 + 9) / 2), 3.0)),
        pytest.approx((0.0, 4.5)),
    ]
    assert len(accuracy.step_intervals["nll"]) == 2
    alone = [tallied([o]) for o in (OUTCOMES[0], OUTCOMES[2])]
    assert accuracy.step_intervals["nll"][0] == pytest.approx(sorted(one.nll[0] for one in alone))


def test_equal_batches_have_intervals_without_width():
    accuracy = tallied([gaussian(0, windows=20)] * 3)
    for name, (low, high) in accuracy.intervals.items():
        whole = np.mean(accuracy.coverage) if name == "coverage" else getattr(accuracy, name)
        assert low == pytest.approx(high) == pytest.approx(whole, rel=1e-2)
    for name, found in accuracy.step_intervals.items():
        assert found == [pytest.approx((value, value)) for value in getattr(accuracy, name)]


def test_one_batch_has_no_interval():
    accuracy = tallied([gaussian(0)])
    assert accuracy.intervals == {}
    assert all(found == [None, None] for found in accuracy.step_intervals.values())
    assert tallied(OUTCOMES, batch_intervals=False).intervals == {}
    assert tallied(OUTCOMES, batch_intervals=False).step_intervals == {}


def test_a_row_is_json():
    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} is not JSON")

    content = json.loads(json.dumps(asdict(summarise("a", [gaussian(0)], (1.0, 1.0)))), parse_constant=refuse)
    assert content["statistics"]["min_ade_m"]["subsets"] == 20
    assert set(content["step_errors"]) == {"by_step_m", "miss_by_step", "rmse_m", "nll", "coverage"}


@pytest.mark.slow
@given(st.integers(0, 10**6), st.integers(1, 11), st.permutations(range(3)))
def test_batches_agents_and_padding_do_not_matter(seed: int, cut: int, order: list[int]):
    whole = gaussian(seed, samples=3, windows=12)
    expected = summarise("a", [whole], (1.0, 2.0))
    padded = Outcome(
        torch.cat([whole.forecast[:, :, order], 50 * torch.ones_like(whole.forecast)], dim=2),
        torch.cat([whole.future[:, order], torch.zeros_like(whole.future)], dim=1),
        torch.cat([whole.valid[:, order], torch.zeros_like(whole.valid)], dim=1),
    )
    pieces = [Outcome(o.forecast, o.future, o.valid) for o in (slices(padded, 0, cut), slices(padded, cut, 12))]
    found = summarise("a", pieces, (1.0, 2.0))
    for name in ("min_ade_m", "min_fde_m", "min_joint_ade_m", "min_joint_fde_m", "miss_rate", "overall_rmse_m"):
        assert getattr(found, name) == pytest.approx(getattr(expected, name), rel=1e-5, nan_ok=True)
    assert found.by_step_m == pytest.approx(expected.by_step_m, rel=1e-5)
    assert found.nll == pytest.approx(expected.nll, rel=1e-5)
    for name, statistic in expected.statistics.items():
        assert found.statistics[name].mean == pytest.approx(statistic.mean, rel=1e-5)


def slices(outcome_: Outcome, begin: int, end: int) -> Outcome:
    return Outcome(outcome_.forecast[begin:end], outcome_.future[begin:end], outcome_.valid[begin:end])


def test_an_iterator_is_enough_and_forecasts_are_not_kept():
    assert summarise("a", iter(OUTCOMES)).by_step_m == summarise("a", OUTCOMES).by_step_m
    assert fitted_std_m(iter(OUTCOMES)) == fitted_std_m(OUTCOMES)
    tally = Tally()
    for _ in range(3):
        tally.add(gaussian(0, windows=50))
    kept = [a for parts in (*tally._sums.values(), *tally._counts.values()) for a in parts]
    assert sum(a.size for a in kept) < 3 * 50 * 2 * 25  # far fewer numbers than the 240 per window of a forecast


def test_a_step_that_nobody_reaches_has_no_spread_and_no_likelihood():
    short = outcome([[[1.0, 2.0, 0.0]]], [[True, True, False]])
    std_m = fitted_std_m([short])
    assert std_m[:2] == pytest.approx((math.sqrt(0.5), math.sqrt(2.0))) and math.isnan(std_m[2])
    whole = outcome([[[1.0, 2.0, 3.0]]], [[True, True, True]])
    assert summarise("a", [whole], std_m).nll == []
    assert np.isfinite(summarise("a", [whole], (1.0, 1.0, 1.0)).nll).all()
    noisy = NoisyConstantVelocity.fit(spec(), std_m)  # fitted to the two steps that are known
    assert noisy.growth == pytest.approx(1.0) and noisy.noise_m > 0


def test_outcomes_of_different_shape_are_refused():
    tally = Tally()
    tally.add(gaussian(0, samples=3))
    with pytest.raises(ValueError, match=r"same samples, horizon and axes \(3, 2, 2\), got \(4, 2, 2\)"):
        tally.add(gaussian(0, samples=4))


def test_no_outcome_is_refused():
    with pytest.raises(ValueError, match="an accuracy needs at least one outcome, got none"):
        summarise("a", [])
    with pytest.raises(ValueError, match="a spread needs at least one outcome, got none"):
        fitted_std_m([])


def test_three_axes():
    accuracy = summarise("a", [gaussian(0, axes=3)], (1.0, 1.0))
    assert accuracy.axes == 3
    assert accuracy.overall_rmse_m == pytest.approx(math.sqrt(3 * (1 + 1 / 20)), rel=0.03)
    first = gaussian(0, samples=1, axes=3)
    assert fitted_std_m([first]) == pytest.approx([math.sqrt(2)] * 2, rel=0.05)


def test_numbers_are_those_of_the_metrics():
    o = gaussian(0, samples=5)
    accuracy, whole = summarise("a", [o]), o.valid & o.valid.all(-1, keepdim=True)
    for name, metric in (("min_joint_ade_m", metrics.min_joint_ade), ("miss_rate", metrics.miss_rate)):
        value, known = metric(o.forecast, o.future, whole)
        assert getattr(accuracy, name) == pytest.approx(value[known].mean().item(), rel=1e-5)


def test_order_of_batches_does_not_matter():
    forwards, backwards = summarise("a", OUTCOMES, (1.0, 2.0)), summarise("a", OUTCOMES[::-1], (1.0, 2.0))
    assert forwards.by_step_m == pytest.approx(backwards.by_step_m)
    assert forwards.min_ade_m == pytest.approx(backwards.min_ade_m)


def test_nothing_known_is_not_a_perfect_score():
    accuracy = summarise("model", [OUTCOMES[1]])
    assert accuracy.agents == accuracy.scenes == 0
    numbers = (
        accuracy.min_ade_m,
        accuracy.min_fde_m,
        accuracy.min_joint_ade_m,
        accuracy.min_joint_fde_m,
        accuracy.miss_rate,
    )
    assert all(math.isnan(x) for x in (*numbers, accuracy.overall_rmse_m, *accuracy.by_step_m, *accuracy.rmse_m))
    assert accuracy.statistics == {} and accuracy.coverage == []


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
    for window, last in enumerate(batch.last_observed.tolist()):
        memory = forecaster.empty_memory(1, batch.states.shape[2])
        for t in range(last + 1):
            memory, belief = forecaster.observe(memory, batch.states[window, t][None], batch.valid[window, t][None])
        expected = forecaster.rollout(belief, 3).states[0, ..., :2]
        now = batch.valid[window, last]
        torch.testing.assert_close(ours.forecast[window][:, now], expected[:, now], rtol=1e-5, atol=1e-4)
        for agent in range(batch.states.shape[2]):
            for step in range(3):
                at = window, last + 1 + step, agent
                truth, known = batch.states[at][:2], batch.valid[at]
                assert torch.equal(ours.future[window, agent, step], truth)
                assert ours.valid[window, agent, step] == (known and agent > 0)  # the ego is not forecast


def test_without_an_ego_all_agents_count():
    batch = WindowBatch(random_states(0, 2, 4, 3, 4), torch.ones(2, 4, 3).bool(), torch.tensor([1, 0]))
    assert run_window_batch(model(has_ego=False), batch, 2).valid.all()


def test_straight_motion_is_forecast_by_constant_velocity():
    states = np.zeros((6, 2, 4), dtype=np.float32)
    states[..., 2:], states[:, 1, 2:] = (3.0, -1.0), (0.5, 2.0)
    states[..., :2] = 0.5 * np.arange(6)[:, None, None] * states[..., 2:]
    cut = Windows([Episode(states, np.ones((6, 2), dtype=np.bool_), np.arange(2))], spec(dt_s=0.5), 2, 3)
    outcomes = list(run_windows(ConstantVelocity(spec(dt_s=0.5)), cut, np.arange(len(cut)), 3))
    accuracy = summarise("constant velocity", outcomes)
    assert accuracy.min_ade_m == pytest.approx(0.0, abs=1e-5)
    assert accuracy.agents == 3  # windows at steps 0, 1, 2 have their whole future


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


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"mode_probs": torch.ones(1, 2, 2)}, "mode_probs must be at least 0 and sum to 1"),
        ({"mode_probs": torch.tensor([[[1.5, 0.5], [-0.5, 0.5]]])}, "mode_probs must be at least 0 and sum to 1"),
        ({"mode_probs": torch.full((1, 2, 2), math.nan)}, "mode_probs must be at least 0 and sum to 1"),
        ({"scale": torch.full((1, 2, 2, 2, 2), -1.0)}, "xy_scale must be finite and at least 0"),
        ({"scale": torch.full((1, 2, 2, 2, 2), math.nan)}, "xy_scale must be finite and at least 0"),
        ({"scale": torch.full((1, 2, 2, 2, 2), math.inf)}, "xy_scale must be finite and at least 0"),
    ],
)
def test_probabilities_and_scales_that_are_none_are_refused(changes: dict[str, torch.Tensor], words: str):
    with pytest.raises(UserError, match=words):
        Tally().add(replace(OUTCOMES[0], **changes))  # type: ignore[arg-type]


def test_probabilities_of_absent_agents_do_not_matter():
    probs = torch.tensor([[[0.25], [0.75]]])
    found = []
    for shown in (0 * probs, probs):
        tally = Tally()
        tally.add(replace(OUTCOMES[1], forecast=OUTCOMES[0].forecast[:, :, :1], mode_probs=shown))
        found.append(tally)
    assert str(found[0].accuracy("x")) == str(found[1].accuracy("x"))


def test_the_energy_score_is_of_agents_that_are_known_throughout():
    """As the other means, so that all are over forecasts of equal length."""
    first = outcome([[[1.0, 3.0], [5.0, 9.0]]], [[True, True], [True, False]])
    assert summarise("model", [first]).energy_m == summarise("model", [first]).ade_m == 2.0
