import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from predictor.evaluation.displacement import (
    LEAST_STD_M,
    coverage,
    displacement,
    min_ade,
    min_displacement,
    min_fde,
    min_joint_ade,
    min_joint_fde,
    miss_rate,
    mixture_coverage,
    mixture_nll,
    overlap,
    squared_error,
)
from predictor.evaluation.graph_accuracy import edge_entropy

Metric = Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor]]


def along_x(*xs: float) -> Tensor:
    """Positions (horizon, 2) on the x axis."""
    return torch.tensor([[x, 0.0] for x in xs])


def one_agent(*samples: Tensor) -> Tensor:
    """A forecast (1, samples, 1, horizon, 2)."""
    return torch.stack(samples)[None, :, None]


def nll_of_equal_samples(forecast: Tensor, future: Tensor, valid: Tensor, std_m: Tensor) -> tuple[Tensor, Tensor]:
    """Likelihood under equal isotropic Gaussians around the samples; `std_m` is that of each step."""
    probs = torch.full(forecast.shape[:3], 1 / forecast.shape[1])
    return mixture_nll(forecast, future, valid, probs, std_m[:, None].expand_as(forecast))


STANDING = along_x(0, 0, 0)[None, None]
ALL = torch.ones(1, 1, 3).bool()


@pytest.mark.parametrize(
    ("forecast", "ade", "fde"),
    [
        (one_agent(along_x(0, 0, 0)), 0.0, 0.0),
        (one_agent(along_x(1, 1, 1)), 1.0, 1.0),
        (one_agent(along_x(1, 2, 3)), 2.0, 3.0),
        (one_agent(torch.tensor([[3.0, 4.0]] * 3)), 5.0, 5.0),
        (one_agent(along_x(9, 9, 9), along_x(1, 2, 3)), 2.0, 3.0),
        # the sample with the best mean (2.0) and the one with the best end (1.0) are different samples
        (one_agent(along_x(1, 2, 3), along_x(9, 9, 1)), 2.0, 1.0),
        (one_agent(along_x(-1, 0, 0), along_x(1, 2, 3), along_x(2, 2, 2)), 1 / 3, 0.0),
    ],
    ids=["exact_k1", "stationary_k1", "linear_k1", "diagonal_k1", "best_is_second_k2", "best_differs_k2", "best_of_k3"],
)
def test_min_ade_and_min_fde_closed_form(forecast: Tensor, ade: float, fde: float):
    value, counts = min_ade(forecast, STANDING, ALL)
    assert value.item() == pytest.approx(ade) and counts.item()
    value, counts = min_fde(forecast, STANDING, ALL)
    assert value.item() == pytest.approx(fde) and counts.item()


def test_best_sample_is_chosen_per_agent():
    forecast = torch.zeros(1, 2, 2, 1, 2)
    forecast[0, 0, 0] += torch.tensor([5.0, 0.0])  # sample 0 is bad for agent 0
    forecast[0, 1, 1] += torch.tensor([7.0, 0.0])  # sample 1 is bad for agent 1
    value, _ = min_ade(forecast, torch.zeros(1, 2, 1, 2), torch.ones(1, 2, 1).bool())
    assert value.tolist() == [[0.0, 0.0]]


def test_steps_without_truth_do_not_count():
    valid = torch.tensor([[[True, False, True]]])
    forecast = one_agent(along_x(1, 1000, 3))
    value, counts = min_ade(forecast, STANDING, valid)
    assert value.item() == pytest.approx(2.0) and counts.item()


def test_unknown_truth_does_not_choose_the_best_sample():
    valid = torch.tensor([[[True, True, False]]])
    forecast = one_agent(along_x(1, 1, 1000), along_x(2, 2, 0))
    assert min_ade(forecast, STANDING, valid)[0].item() == pytest.approx(1.0)
    assert min_displacement(forecast, STANDING, valid)[0][0, 0, :2].tolist() == [1.0, 1.0]


def test_agent_with_no_valid_step_is_invalid():
    none = torch.zeros(1, 1, 3).bool()
    forecast = one_agent(along_x(0, 0, 0))
    assert not min_ade(forecast, STANDING, none)[1].any()
    assert not min_fde(forecast, STANDING, none)[1].any()
    assert not min_displacement(forecast, STANDING, none)[1].any()


def test_min_fde_is_invalid_where_the_agent_left_early():
    valid = torch.tensor([[[True, True, False]]])
    assert not min_fde(one_agent(along_x(0, 0, 0)), STANDING, valid)[1].any()


@pytest.mark.parametrize("metric", [min_ade, min_displacement], ids=["min_ade", "min_displacement"])
def test_infinite_truth_that_does_not_count_leaves_no_trace(metric: Metric):
    future = STANDING.clone()
    future[0, 0, 1] = math.inf
    valid = torch.tensor([[[True, False, True]]])
    value, counts = metric(one_agent(along_x(1, 1, 1)), future, valid)
    assert value[counts].tolist() == pytest.approx([1.0] * int(counts.sum()))


def test_displacement_by_step_is_that_of_the_best_sample():
    forecast = one_agent(along_x(0, 0, 9), along_x(1, 2, 3))  # means 3 and 2: the second is followed throughout
    value, counts = min_displacement(forecast, STANDING, ALL)
    assert value.tolist() == [[[1.0, 2.0, 3.0]]]
    assert torch.equal(counts, ALL)


def test_squared_error_is_that_of_the_mean_of_the_samples():
    forecast = one_agent(along_x(-1, 0, 4), along_x(1, 4, 4))
    assert squared_error(forecast, STANDING, ALL)[0].tolist() == [[[0.0, 4.0, 16.0]]]


@pytest.mark.parametrize(
    ("probs", "expected"),
    [((0.5, 0.5), [0.0, 4.0, 16.0]), ((0.25, 0.75), [0.25, 9.0, 16.0]), ((1.0, 0.0), [1.0, 0.0, 16.0])],
)
def test_squared_error_is_that_of_the_weighted_mean_of_the_modes(probs: tuple[float, ...], expected: list[float]):
    forecast = one_agent(along_x(-1, 0, 4), along_x(1, 4, 4))
    value, counts = squared_error(forecast, STANDING, ALL, torch.tensor(probs)[None, :, None])
    assert value[0, 0].tolist() == pytest.approx(expected)
    assert torch.equal(counts, ALL)


def test_each_agent_weighs_modes_by_its_own_probabilities():
    forecast = one_agent(along_x(-1), along_x(5)).expand(-1, -1, 2, -1, -1)
    probs = torch.tensor([[0.5, 1.0], [0.5, 0.0]])[None]
    value, _ = squared_error(forecast, torch.zeros(1, 2, 1, 2), torch.ones(1, 2, 1).bool(), probs)
    assert value[0, :, 0].tolist() == [4.0, 1.0]


def test_displacement_keeps_samples_apart():
    forecast = one_agent(along_x(1, 2, 3), along_x(4, 5, 6))
    assert displacement(forecast, STANDING)[0, :, 0].tolist() == [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]


@pytest.mark.parametrize(
    ("forecast", "expected"),
    [
        # one Gaussian: d²/(2σ²) + 2 log σ + log 2π
        (one_agent(along_x(0, 2, 3)), [math.log(2 * math.pi), 2 + math.log(2 * math.pi), 0.5 + math.log(18 * math.pi)]),
        # two equal halves: the logarithm of the mean density
        (
            one_agent(along_x(0, 2, 0), along_x(0, 0, 3)),
            [
                math.log(2 * math.pi),
                -math.log((math.exp(-2) + 1) / 2 / (2 * math.pi)),
                -math.log((1 + math.exp(-0.5)) / 2 / (18 * math.pi)),
            ],
        ),
    ],
    ids=["k1", "k2"],
)
def test_nll_closed_form(forecast: Tensor, expected: list[float]):
    value, counts = nll_of_equal_samples(forecast, STANDING, ALL, torch.tensor([1.0, 1.0, 3.0]))
    assert value[0, 0].tolist() == pytest.approx(expected, rel=1e-5)
    assert torch.equal(counts, ALL)


def test_nll_of_a_far_miss_is_large_but_finite():
    value, _ = nll_of_equal_samples(one_agent(along_x(1e4, 1e4, 1e4)), STANDING, ALL, torch.full((3,), 0.1))
    assert value[0, 0, 0].item() == pytest.approx(1e8 / 0.02, rel=1e-3)


def test_mixture_nll_is_that_of_a_mixture_of_normal_distributions():
    generator = torch.Generator().manual_seed(0)
    forecast, scale = 2 * torch.randn(2, 5, 3, 4, 2, generator=generator), torch.rand(2, 5, 3, 4, 2) + 0.2
    future, probs = torch.randn(2, 3, 4, 2), torch.softmax(torch.randn(2, 5, 3, generator=generator), dim=1)
    mean, std_m = (t.permute(0, 2, 3, 1, 4) for t in (forecast, scale))
    mixture = torch.distributions.MixtureSameFamily(
        torch.distributions.Categorical(probs.transpose(1, 2)[:, :, None].expand(-1, -1, 4, -1)),
        torch.distributions.Independent(torch.distributions.Normal(mean, std_m), 1),
    )
    value, counts = mixture_nll(forecast, future, torch.ones(2, 3, 4).bool(), probs, scale)
    torch.testing.assert_close(value, -mixture.log_prob(future))
    assert counts.all()


def test_mixture_nll_of_a_mode_without_scale_has_the_least_one():
    narrow, least = (torch.full((1, 1, 1, 3, 2), std_m) for std_m in (0.0, LEAST_STD_M))
    value, _ = mixture_nll(STANDING[:, None], STANDING, ALL, torch.ones(1, 1, 1), narrow)
    assert torch.equal(value, mixture_nll(STANDING[:, None], STANDING, ALL, torch.ones(1, 1, 1), least)[0])
    assert value[0, 0].tolist() == pytest.approx([math.log(2 * math.pi * LEAST_STD_M**2)] * 3, rel=1e-5)


def test_mixture_nll_of_a_mode_without_probability_is_that_of_the_others():
    """Even if it alone is where the truth is."""
    forecast, probs = one_agent(along_x(3, 3, 3), along_x(0, 0, 0)), torch.tensor([1.0, 0.0])[None, :, None]
    value, _ = mixture_nll(forecast, STANDING, ALL, probs, torch.ones_like(forecast))
    assert value[0, 0].tolist() == pytest.approx([4.5 + math.log(2 * math.pi)] * 3)


def test_mixture_coverage_of_one_mode_is_that_of_a_normal_distribution():
    """The central 90 % of a normal distribution end at 1.645 standard deviations; each axis counts by itself."""
    future = torch.tensor([[[[3.28, -3.28], [3.28, 3.30], [-3.30, 3.30]]]])
    value, counts = mixture_coverage(
        STANDING[:, None], future, ALL, torch.ones(1, 1, 1), torch.full((1, 1, 1, 3, 2), 2.0)
    )
    assert value[0, 0].tolist() == [1.0, 0.5, 0.0] and counts.all()


def test_mixture_coverage_of_truth_from_the_mixture_is_90_percent():
    """Whereas narrower modes cover less of it, and wider ones more."""
    generator = torch.Generator().manual_seed(0)
    windows, probs = 20_000, torch.tensor([0.6, 0.3, 0.1])
    means, std_m = torch.tensor([[-3.0, 0.0], [2.0, 1.0], [0.5, -4.0]]), torch.tensor([0.2, 1.0, 3.0])
    mode = torch.multinomial(probs, windows, replacement=True, generator=generator)
    future = means[mode] + std_m[mode, None] * torch.randn(windows, 2, generator=generator)
    forecast, scale = (t.expand(windows, 3, 2)[:, :, None, None] for t in (means, std_m[:, None].expand(3, 2)))
    found = [
        mixture_coverage(
            forecast, future[:, None, None], torch.ones(windows, 1, 1).bool(), probs.expand(windows, 3)[..., None], s
        )[0].mean()
        for s in (0.5 * scale, scale, 2 * scale)
    ]
    assert found[1].item() == pytest.approx(0.9, abs=0.005) and found[0] < 0.85 and found[2] > 0.95


def test_mixture_coverage_of_a_mode_without_scale_has_the_least_one():
    future = torch.tensor([[[[1.6, 1.7], [-1.6, -1.7], [0.0, 0.0]]]]) * LEAST_STD_M
    value, _ = mixture_coverage(STANDING[:, None], future, ALL, torch.ones(1, 1, 1), torch.zeros(1, 1, 1, 3, 2))
    assert value[0, 0].tolist() == [0.5, 0.5, 1.0]


def test_mixture_coverage_leaves_out_a_mode_without_probability():
    forecast, probs = one_agent(along_x(3, 3, 3), along_x(0, 0, 0)), torch.tensor([1.0, 0.0])[None, :, None]
    value, _ = mixture_coverage(forecast, STANDING, ALL, probs, torch.ones_like(forecast))
    assert value[0, 0].tolist() == [0.5] * 3  # the other axis is right


def test_mixture_nll_does_not_see_truth_that_does_not_count():
    future, valid = STANDING.clone(), torch.tensor([[[True, False, True]]])
    future[0, 0, 1] = math.nan
    forecast = one_agent(along_x(1, 2, 3)).requires_grad_()
    value, counts = mixture_nll(forecast, future, valid, torch.ones(1, 1, 1), torch.ones(1, 1, 1, 3, 2))
    value[counts].sum().backward()
    assert value[counts].tolist() == pytest.approx([0.5 + math.log(2 * math.pi), 4.5 + math.log(2 * math.pi)])
    assert forecast.grad is not None and torch.isfinite(forecast.grad).all()


@pytest.mark.parametrize(
    ("probs", "entropy"),
    [([1.0, 0.0], 0.0), ([0.5, 0.5], math.log(2)), ([0.25, 0.75], 0.25 * math.log(4) + 0.75 * math.log(4 / 3))],
    ids=["decided", "uninformative", "leaning"],
)
def test_edge_entropy_closed_form(probs: list[float], entropy: float):
    value, valid = edge_entropy(torch.tensor([probs, probs]), torch.tensor([True, False]))
    assert value.tolist() == pytest.approx([entropy, entropy], abs=1e-6)
    assert valid.tolist() == [True, False]


# --- Joint metrics ----------------------------------------------------------------------------------------------------

BEST_DIFFERS = torch.zeros(1, 2, 2, 2, 2)
"""Two samples, two agents, two steps: each sample is good for one agent."""
BEST_DIFFERS[0, 0, 0, :, 0] = torch.tensor([1.0, 3.0])
BEST_DIFFERS[0, 0, 1, :, 0] = torch.tensor([4.0, 4.0])
BEST_DIFFERS[0, 1, 0, :, 0] = torch.tensor([6.0, 6.0])
BEST_DIFFERS[0, 1, 1, :, 0] = torch.tensor([2.0, 1.0])
ORIGIN = torch.zeros(1, 2, 2, 2)


@pytest.mark.parametrize(
    ("valid", "ade", "fde"),
    [
        # samples: (2 + 4) / 2 and (6 + 1.5) / 2; at the end (3 + 4) / 2 and (6 + 1) / 2
        ([[True, True], [True, True]], 3.0, 3.5),
        ([[True, True], [False, False]], 2.0, 3.0),
        # the second agent's mean is over its one step: (2 + 4) / 2 and (6 + 2) / 2; at the end it is not there
        ([[True, True], [True, False]], 3.0, 3.0),
        ([[False, True], [False, True]], 3.5, 3.5),
    ],
    ids=["all", "one_agent", "left_early", "last_step_only"],
)
def test_joint_metrics_closed_form(valid: list[list[bool]], ade: float, fde: float):
    mask = torch.tensor(valid)[None]
    value, counts = min_joint_ade(BEST_DIFFERS, ORIGIN, mask)
    assert value.tolist() == pytest.approx([ade]) and counts.tolist() == [True]
    value, counts = min_joint_fde(BEST_DIFFERS, ORIGIN, mask)
    assert value.tolist() == pytest.approx([fde]) and counts.tolist() == [True]


def test_scene_without_a_valid_agent_is_invalid():
    absent = torch.zeros(1, 2, 2).bool()
    assert min_joint_ade(BEST_DIFFERS, ORIGIN, absent)[1].tolist() == [False]
    gone = torch.tensor([[[True, False], [True, False]]])
    assert min_joint_ade(BEST_DIFFERS, ORIGIN, gone)[1].tolist() == [True]
    assert min_joint_fde(BEST_DIFFERS, ORIGIN, gone)[1].tolist() == [False]


@pytest.mark.parametrize("metric", [min_joint_ade, min_joint_fde], ids=["ade", "fde"])
def test_joint_metrics_do_not_see_infinite_truth_that_does_not_count(metric: Metric):
    future, valid = ORIGIN.clone(), torch.tensor([[[True, True], [False, False]]])
    future[0, 1] = math.inf
    assert torch.equal(metric(BEST_DIFFERS, future, valid)[0], metric(BEST_DIFFERS, ORIGIN, valid)[0])


# --- Misses -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("final", "threshold_m", "missed"),
    [(2.0, 2.0, 0.0), (2.001, 2.0, 1.0), (1.999, 2.0, 0.0), (0.3, 0.25, 1.0), (0.0, 0.0, 0.0)],
    ids=["at", "above", "below", "own_threshold", "exact"],
)
def test_miss_at_the_threshold(final: float, threshold_m: float, missed: float):
    value, counts = miss_rate(one_agent(along_x(9, 9, final)), STANDING, ALL, threshold_m)
    assert value.item() == missed and counts.item()


def test_miss_is_of_the_best_sample_and_two_metres_by_default():
    assert miss_rate(one_agent(along_x(0, 0, 9), along_x(9, 9, 1.9)), STANDING, ALL)[0].item() == 0.0
    assert miss_rate(one_agent(along_x(0, 0, 9), along_x(0, 0, 2.1)), STANDING, ALL)[0].item() == 1.0


def test_agent_that_left_early_is_neither_hit_nor_miss():
    assert not miss_rate(one_agent(along_x(0, 0, 0)), STANDING, torch.tensor([[[True, True, False]]]))[1].any()


# --- Coverage ---------------------------------------------------------------------------------------------------------


def spread_of(*xs: float, truth: float, share: float) -> tuple[float, bool]:
    """One agent, one step, samples and truth on the x axis."""
    value, counts = coverage(one_agent(*(along_x(x) for x in xs)), along_x(truth)[None, None], ALL[..., :1], share)
    return value.item(), bool(counts.item())


@pytest.mark.parametrize(
    ("truth", "share", "covered"),
    [
        # mean 0, distances to the mean of the others 4/3 · (1, 1, 3, 3); the quantile of share q is at rank 5 q
        (1.33, 0.4, 1.0),
        (-1.34, 0.4, 0.0),
        (2.66, 0.5, 1.0),  # rank 2.5: half-way between 4/3 and 4
        (2.68, 0.5, 0.0),
        (-3.99, 0.8, 1.0),
        (4.01, 0.8, 0.0),
    ],
    ids=["inside_40", "outside_40", "inside_50", "outside_50", "inside_80", "outside_80"],
)
def test_coverage_closed_form(truth: float, share: float, covered: float):
    assert spread_of(-3, -1, 1, 3, truth=truth, share=share) == (covered, True)


def test_coverage_is_by_distance_not_by_axis():
    # samples on a circle of radius 3, whose mean is its centre
    circle = one_agent(*(torch.tensor([p]) for p in [[3.0, 0.0], [-3.0, 0.0], [0.0, 3.0], [0.0, -3.0]]))
    for truth, covered in (([3.9, 0.0], 1.0), ([2.7, 2.7], 1.0), ([2.9, 2.9], 0.0)):
        given_ = coverage(circle, torch.tensor(truth)[None, None, None], ALL[..., :1], share=0.5)
        assert given_[0].item() == covered


@pytest.mark.parametrize(
    ("samples", "share", "known"),
    [(1, 0.5, False), (2, 0.5, True), (8, 0.9, False), (9, 0.9, True), (20, 0.9, True), (20, 0.04, False)],
    ids=["k1", "k2", "too_few", "just_enough", "paper", "too_fine"],
)
def test_coverage_is_known_only_where_the_quantile_is(samples: int, share: float, known: bool):
    value, counts = coverage(torch.zeros(1, samples, 1, 3, 2), STANDING, ALL, share)
    assert counts.all().item() == counts.any().item() == known
    assert torch.isfinite(value).all()


@pytest.mark.parametrize("share", [0.0, 1.0, -0.1, 90.0])
def test_share_must_be_a_share(share: float):
    with pytest.raises(ValueError, match=f"share must be between 0 and 1, got {share}"):
        coverage(torch.zeros(1, 20, 1, 3, 2), STANDING, ALL, share)


@pytest.mark.parametrize("axes", [2, 3])
@pytest.mark.parametrize("samples", [9, 20])
def test_samples_spread_like_the_truth_cover_it_as_often_as_they_should(samples: int, axes: int):
    generator = torch.Generator().manual_seed(0)
    forecast = 3 + torch.randn(20000, samples, 1, 1, axes, generator=generator)
    truth = 3 + torch.randn(20000, 1, 1, axes, generator=generator)
    valid = torch.ones(20000, 1, 1).bool()
    for share in (0.5, 0.9):
        assert coverage(forecast, truth, valid, share)[0].mean().item() == pytest.approx(share, abs=0.015)
    assert coverage(3 + 0.5 * (forecast - 3), truth, valid, 0.9)[0].mean().item() < 0.7
    assert coverage(3 + 2 * (forecast - 3), truth, valid, 0.5)[0].mean().item() > 0.8


@pytest.mark.parametrize(
    ("truth", "share", "covered"),
    [
        # weighted mean 0.6, distances 4.6 (0.2), 0.4 (0.5), 2.4 (0.3): nearer than the truth is 0, 0.5, 0.8 or all
        (0.9, 0.4, 1.0),
        (0.1, 0.4, 0.0),
        (0.1, 0.6, 1.0),
        (2.9, 0.6, 1.0),
        (-1.9, 0.6, 0.0),
        (-1.9, 0.9, 1.0),
        (5.1, 0.9, 1.0),
        (5.3, 0.9, 0.0),
    ],
    ids=["in_40", "out_40", "in_60", "edge_60", "out_60", "in_90", "edge_90", "out_90"],
)
def test_coverage_by_probability_closed_form(truth: float, share: float, covered: float):
    probs, modes = torch.tensor([0.2, 0.5, 0.3])[None, :, None], one_agent(along_x(-4), along_x(1), along_x(3))
    value, counts = coverage(modes, along_x(truth)[None, None], ALL[..., :1], share, probs)
    assert (value.item(), counts.item()) == (covered, True)


def test_one_mode_has_no_spread_to_judge():
    assert not coverage(torch.zeros(1, 1, 1, 3, 2), STANDING, ALL, 0.5, torch.ones(1, 1, 1))[1].any()


def test_few_modes_are_a_distribution_although_as_many_draws_would_not_do():
    modes, equal = one_agent(along_x(-1), along_x(2)), torch.full((1, 2, 1), 0.5)
    assert coverage(modes, along_x(0)[None, None], ALL[..., :1], 0.9, equal)[1].all()
    assert not coverage(modes, along_x(0)[None, None], ALL[..., :1], 0.9)[1].any()


def test_a_mixture_covers_its_own_draws_as_often_as_it_should():
    """Modes far from the middle are rare here: an unweighted quantile would be far too wide."""
    generator = torch.Generator().manual_seed(0)
    scenes, modes = 3000, 300
    forecast = 3 + 6 * (torch.rand(scenes, modes, 1, 1, 2, generator=generator) - 0.5)
    probs = torch.softmax(-(forecast[..., 0, :] - 3).square().sum(-1), dim=1)
    drawn = torch.multinomial(probs[..., 0], 1, generator=generator)
    truth = forecast[torch.arange(scenes), drawn[:, 0]]
    valid = torch.ones(scenes, 1, 1).bool()

    def covered(positions: Tensor, share: float) -> float:
        return coverage(positions, truth, valid, share, probs)[0].mean().item()

    for share in (0.5, 0.9):  # the mode at the boundary is inside: a little more than the share
        assert covered(forecast, share) == pytest.approx(share + 0.01, abs=0.02)
    centre = (probs[..., None, None] * forecast).sum(1, keepdim=True)
    assert covered(centre + 0.6 * (forecast - centre), 0.9) < 0.75
    assert covered(centre + 1.5 * (forecast - centre), 0.5) > 0.7
    assert coverage(forecast, truth, valid, 0.5)[0].mean().item() > 0.8


# --- Overlap ----------------------------------------------------------------------------------------------------------


def in_a_row(*samples: tuple[float, ...]) -> Tensor:
    """Agents at these places on the x axis, in each sample, at one step: (1, samples, agents, 1, 2)."""
    return torch.stack([along_x(*xs) for xs in samples])[None, :, :, None]


@pytest.mark.parametrize(
    ("positions", "probs", "expected"),
    [
        (in_a_row((0, 1, 9)), None, [1.0, 1.0, 0.0]),
        (in_a_row((0, 2, 9)), None, [0.0, 0.0, 0.0]),  # at the distance is not nearer than it
        (in_a_row((0, 1.99, 3.9)), None, [1.0, 1.0, 1.0]),
        (in_a_row((0, 1, 9), (0, 5, 9)), None, [0.5, 0.5, 0.0]),
        # agents meet in the same sample or not at all
        (in_a_row((0, 5, 9), (5, 0, 9)), None, [0.0, 0.0, 0.0]),
        (in_a_row((0, 1, 9), (0, 5, 6)), [[0.8, 0.6, 0.5], [0.2, 0.4, 0.5]], [0.8, 1.0, 0.5]),
    ],
    ids=["near", "at_the_distance", "chain", "one_of_two", "not_across_samples", "weighted"],
)
def test_overlap_closed_form(positions: Tensor, probs: Any, expected: list[float]):
    mode_probs = None if probs is None else torch.tensor(probs)[None]
    value, counts = overlap(positions, torch.ones(1, 3, 1).bool(), 2.0, mode_probs)
    assert value[0].tolist() == pytest.approx(expected)
    assert counts.all()


@pytest.mark.parametrize("where", [0.0, math.nan, math.inf])
def test_nobody_overlaps_with_an_absent_agent(where: float):
    positions = in_a_row((0, where, 9))
    value, counts = overlap(positions, torch.tensor([[[True], [False], [True]]]), 2.0)
    assert value[0, [0, 2]].tolist() == [0.0, 0.0]
    assert counts[0].tolist() == [True, False, True]


def test_overlap_is_the_share_of_the_steps_at_which_an_agent_is_there():
    """Both are near at the first and the third step; the second agent is not there at the last two of four."""
    positions = torch.cat([in_a_row((0, 1)), in_a_row((0, 5)), in_a_row((0, 1)), in_a_row((0, 1))], dim=3)
    value, _ = overlap(positions, torch.tensor([[[True] * 4, [True, True, False, False]]]), 2.0)
    assert value[0].tolist() == [0.25, 0.5]
    value, _ = overlap(positions, torch.ones(1, 2, 4).bool(), 2.0)
    assert value[0].tolist() == [0.75, 0.75]


@pytest.mark.parametrize("agents", [1, 2])
def test_who_is_alone_overlaps_with_nobody(agents: int):
    valid = torch.zeros(1, agents, 1).bool()
    valid[0, 0] = True
    assert overlap(torch.zeros(1, 3, agents, 1, 2), valid, 2.0)[0][0, 0].item() == 0.0


# --- Three axes -------------------------------------------------------------------------------------------------------


def test_distances_have_all_three_axes():
    forecast, future, valid = torch.zeros(1, 1, 1, 1, 3), torch.tensor([[[[2.0, 3.0, 6.0]]]]), ALL[..., :1]
    for metric in (min_ade, min_fde, min_displacement, min_joint_ade, min_joint_fde):
        assert metric(forecast, future, valid)[0].item() == pytest.approx(7.0)
    assert squared_error(forecast, future, valid)[0].item() == pytest.approx(49.0)


@pytest.mark.parametrize("axes", [2, 3])
def test_nll_is_that_of_a_normal_distribution_of_so_many_axes(axes: int):
    generator = torch.Generator().manual_seed(0)
    forecast, future = torch.randn(2, 1, 3, 4, axes, generator=generator), torch.zeros(2, 3, 4, axes)
    std_m = torch.tensor([0.5, 1.0, 2.0, 4.0])
    normal = torch.distributions.Normal(forecast[:, 0], std_m[:, None])
    value, _ = nll_of_equal_samples(forecast, future, torch.ones(2, 3, 4).bool(), std_m)
    torch.testing.assert_close(value, -normal.log_prob(future).sum(-1))


# --- Properties of all metrics ----------------------------------------------------------------------------------------

PER_SCENE = {"min_joint_ade": min_joint_ade, "min_joint_fde": min_joint_fde}
PER_AGENT: dict[str, Metric] = {
    "min_ade": min_ade,
    "min_fde": min_fde,
    "miss_rate": miss_rate,
    "min_displacement": min_displacement,
    "squared_error": squared_error,
    "coverage": lambda f, t, v: coverage(f, t, v, share=0.5),
    "nll": lambda f, t, v: nll_of_equal_samples(f, t, v, torch.full(t.shape[2:3], 1.5)),
    "mixture_nll": lambda f, t, v: mixture_nll(f, t, v, torch.full(f.shape[:3], 1 / f.shape[1]), 1 + f.abs()),
    "mixture_coverage": lambda f, t, v: mixture_coverage(
        f, t, v, torch.full(f.shape[:3], 1 / f.shape[1]), torch.ones_like(f)
    ),
    "overlap": lambda f, t, v: overlap(f, v, 2.0),
}
METRICS = PER_AGENT | PER_SCENE


def drawn(seed: int, samples: int, agents: int, axes: int) -> tuple[Tensor, Tensor, Tensor]:
    """A random batch of two scenes and three steps."""
    generator = torch.Generator().manual_seed(seed)
    forecast = 3 * torch.randn(2, samples, agents, 3, axes, generator=generator)
    valid = torch.rand(2, agents, 3, generator=generator) < 0.7
    return forecast, torch.randn(2, agents, 3, axes, generator=generator), valid


batches = st.builds(
    drawn, st.integers(0, 10**6), samples=st.integers(2, 5), agents=st.integers(1, 4), axes=st.integers(2, 3)
)
every_metric = pytest.mark.parametrize("metric", METRICS.values(), ids=METRICS)


def assert_same(first: tuple[Tensor, Tensor], second: tuple[Tensor, Tensor]) -> None:
    assert torch.equal(first[1], second[1])
    torch.testing.assert_close(first[0][first[1]], second[0][second[1]], rtol=1e-5, atol=1e-5)


@every_metric
@given(batches, st.randoms(use_true_random=False))
def test_order_of_samples_does_not_matter(metric: Metric, batch: tuple[Tensor, Tensor, Tensor], random):
    forecast, future, valid = batch
    order = list(range(forecast.shape[1]))
    random.shuffle(order)
    assert_same(metric(forecast[:, order], future, valid), metric(forecast, future, valid))


@every_metric
@given(batches, st.randoms(use_true_random=False))
def test_order_of_agents_does_not_matter(metric: Metric, batch: tuple[Tensor, Tensor, Tensor], random):
    forecast, future, valid = batch
    order = list(range(forecast.shape[2]))
    random.shuffle(order)
    given_ = metric(forecast[:, :, order], future[:, order], valid[:, order])
    value, counts = metric(forecast, future, valid)
    assert_same(given_, (value, counts) if value.ndim == 1 else (value[:, order], counts[:, order]))


@every_metric
@given(batches)
def test_padded_agents_change_nothing(metric: Metric, batch: tuple[Tensor, Tensor, Tensor]):
    forecast, future, valid = batch
    wider = (
        torch.cat([forecast, 100 * torch.ones_like(forecast)], dim=2),
        torch.cat([future, torch.zeros_like(future)], dim=1),
        torch.cat([valid, torch.zeros_like(valid)], dim=1),
    )
    value, counts = metric(*wider)
    agents = valid.shape[1]
    if value.ndim > 1:
        assert not counts[:, agents:].any()
        value, counts = value[:, :agents], counts[:, :agents]
    assert_same((value, counts), metric(forecast, future, valid))


@pytest.mark.parametrize("name", ["min_ade", "min_fde", "miss_rate", "min_joint_ade", "min_joint_fde"])
@given(batches, st.integers(1, 4))
def test_more_samples_are_never_worse(name: str, batch: tuple[Tensor, Tensor, Tensor], fewer: int):
    forecast, future, valid = batch
    all_of_them, counts = METRICS[name](forecast, future, valid)
    some, _ = METRICS[name](forecast[:, :fewer], future, valid)
    assert (all_of_them <= some + 1e-6)[counts].all()


@given(batches)
def test_choosing_jointly_is_never_better(batch: tuple[Tensor, Tensor, Tensor]):
    for joint, alone in ((min_joint_ade, min_ade), (min_joint_fde, min_fde)):
        together, counts = joint(*batch)
        value, agents = alone(*batch)
        mean = torch.where(agents, value, 0.0).sum(1) / agents.sum(1).clamp(min=1)
        assert (together >= mean - 1e-5)[counts].all()
        if batch[0].shape[2] == 1:
            torch.testing.assert_close(together[counts], mean[counts])


@given(batches)
def test_joint_ade_against_a_loop(batch: tuple[Tensor, Tensor, Tensor]):
    forecast, future, valid = batch
    value, counts = min_joint_ade(forecast, future, valid)
    for scene in range(len(forecast)):
        there = [a for a in range(forecast.shape[2]) if valid[scene, a].any()]
        assert counts[scene] == bool(there)
        if there:
            errors = [
                sum(
                    sum(math.dist(f, t) for f, t, v in zip(*per_agent, strict=True) if v) / int(valid[scene, a].sum())
                    for a in there
                    for per_agent in [
                        (forecast[scene, k, a].tolist(), future[scene, a].tolist(), valid[scene, a].tolist())
                    ]
                )
                / len(there)
                for k in range(forecast.shape[1])
            ]
            assert value[scene].item() == pytest.approx(min(errors), rel=1e-5)


@given(batches, st.sampled_from([0.35, 0.5, 0.6]))
def test_coverage_against_a_loop(batch: tuple[Tensor, Tensor, Tensor], share: float):
    forecast, future, valid = batch
    samples = forecast.shape[1]
    value, counts = coverage(forecast, future, valid, share)
    assert torch.equal(counts, valid & (1 <= share * (samples + 1) <= samples))
    for scene, agent, step in counts.nonzero().tolist():
        points = forecast[scene, :, agent, step].double()
        others = [torch.cat([points[:k], points[k + 1 :]]).mean(0) for k in range(samples)]
        spread = sorted(float((p - o).norm()) for p, o in zip(points, others, strict=True))
        rank = share * (samples + 1)
        below, rest = int(rank), rank - int(rank)
        limit = spread[below - 1] + (rest * (spread[below] - spread[below - 1]) if rest > 1e-9 else 0.0)
        distance = float((future[scene, agent, step].double() - points.mean(0)).norm())
        if abs(distance - limit) > 1e-4:
            assert value[scene, agent, step].item() == float(distance < limit)


def test_truth_beyond_exactly_the_share_of_the_probability_is_outside():
    modes, probs = one_agent(along_x(0), along_x(2)), torch.tensor([0.75, 0.25])[None, :, None]
    value, _ = coverage(modes, along_x(-0.75)[None, None], ALL[..., :1], 0.75, probs)
    assert value.item() == 0.0, "0.75 of the probability is nearer, not less"
