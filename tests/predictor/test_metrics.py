import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from predictor.metrics import (
    displacement,
    edge_entropy,
    gaussian_mixture_nll,
    min_ade,
    min_displacement,
    min_fde,
    squared_error,
)

Metric = Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor]]


def along_x(*xs: float) -> Tensor:
    """Positions (horizon, 2) on the x axis."""
    return torch.tensor([[x, 0.0] for x in xs])


def one_agent(*samples: Tensor) -> Tensor:
    """A forecast (1, samples, 1, horizon, 2)."""
    return torch.stack(samples)[None, :, None]


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
    value, counts = gaussian_mixture_nll(forecast, STANDING, ALL, torch.tensor([1.0, 1.0, 3.0]))
    assert value[0, 0].tolist() == pytest.approx(expected, rel=1e-5)
    assert torch.equal(counts, ALL)


def test_nll_of_a_far_miss_is_large_but_finite():
    value, _ = gaussian_mixture_nll(one_agent(along_x(1e4, 1e4, 1e4)), STANDING, ALL, torch.full((3,), 0.1))
    assert value[0, 0, 0].item() == pytest.approx(1e8 / 0.02, rel=1e-3)


@pytest.mark.parametrize(
    ("probs", "entropy"),
    [([1.0, 0.0], 0.0), ([0.5, 0.5], math.log(2)), ([0.25, 0.75], 0.25 * math.log(4) + 0.75 * math.log(4 / 3))],
    ids=["decided", "uninformative", "leaning"],
)
def test_edge_entropy_closed_form(probs: list[float], entropy: float):
    value, valid = edge_entropy(torch.tensor([probs, probs]), torch.tensor([True, False]))
    assert value.tolist() == pytest.approx([entropy, entropy], abs=1e-6)
    assert valid.tolist() == [True, False]
