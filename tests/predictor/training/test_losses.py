import math

import pytest
import torch

from predictor.layers.pairs import masked_mean
from predictor.training.config import Likelihood
from predictor.training.objective import kl_categorical, nll

ONES = torch.ones(2)


@pytest.mark.parametrize(
    ("likelihood", "expected"),
    # errors 3 and 4 in scaled units, variance 2: (9 + 16) / (2·2) and (3 + 4) / √(2 / 2)
    [("gaussian", 6.25), ("laplace", 7.0)],
)
def test_nll_closed_form(likelihood: Likelihood, expected: float):
    predicted, target, scales = torch.tensor([[30.0, 0.0]]), torch.tensor([[0.0, 8.0]]), torch.tensor([10.0, 2.0])
    value = nll(predicted, target, torch.tensor([True]), scales, variance=2.0, likelihood=likelihood)
    assert value.item() == pytest.approx(expected)


@pytest.mark.parametrize("likelihood", ["gaussian", "laplace"])
def test_nll_of_the_truth_is_zero(likelihood: Likelihood):
    states = torch.randn(3, 4, 2, generator=torch.Generator().manual_seed(0))
    assert nll(states, states, torch.ones(3, 4).bool(), ONES, 5e-5, likelihood).item() == 0.0


@pytest.mark.parametrize("likelihood", ["gaussian", "laplace"])
def test_nll_differences_are_those_of_the_density(likelihood: Likelihood):
    """The constant that is left out is the same everywhere, so differences are exact."""
    variance, points = 0.3, torch.tensor([[0.2, -1.0], [1.5, 0.4]])
    if likelihood == "gaussian":
        density: torch.distributions.Distribution = torch.distributions.Normal(0.0, math.sqrt(variance))
    else:
        density = torch.distributions.Laplace(0.0, math.sqrt(variance / 2))
    assert density.variance.item() == pytest.approx(variance)
    expected = -density.log_prob(points).sum(-1)
    ours = [nll(p[None], torch.zeros(1, 2), torch.tensor([True]), ONES, variance, likelihood) for p in points]
    assert (ours[1] - ours[0]).item() == pytest.approx((expected[1] - expected[0]).item(), rel=1e-5)


def test_nll_is_a_mean_over_valid_entries():
    predicted, target = torch.tensor([[1.0, 0.0], [3.0, 0.0], [100.0, 0.0]]), torch.zeros(3, 2)
    value = nll(predicted, target, torch.tensor([True, True, False]), ONES, variance=0.5)
    assert value.item() == pytest.approx((1 + 9) / 2)


@pytest.mark.parametrize("likelihood", ["gaussian", "laplace"])
def test_invalid_infinite_entries_do_not_count(likelihood: Likelihood):
    target = torch.tensor([[1.0, 0.0], [math.inf, math.inf]])
    value = nll(torch.zeros(2, 2), target, torch.tensor([True, False]), ONES, 0.5, likelihood)
    assert value.item() == pytest.approx(1.0 if likelihood == "gaussian" else 2.0)


def test_kl_of_equal_distributions_is_zero():
    logits = torch.randn(5, 3, generator=torch.Generator().manual_seed(0))
    # logits mean the same whatever constant is added to them
    assert kl_categorical(logits, logits + 7.0, torch.ones(5).bool()).item() == pytest.approx(0.0, abs=1e-6)


def test_kl_closed_form():
    posterior, prior = torch.tensor([[0.8, 0.2]]).log(), torch.tensor([[0.4, 0.6]]).log()
    expected = 0.8 * math.log(0.8 / 0.4) + 0.2 * math.log(0.2 / 0.6)
    assert kl_categorical(posterior, prior, torch.tensor([True])).item() == pytest.approx(expected, rel=1e-5)
    backwards = 0.4 * math.log(0.4 / 0.8) + 0.6 * math.log(0.6 / 0.2)
    assert kl_categorical(prior, posterior, torch.tensor([True])).item() == pytest.approx(backwards, rel=1e-5)


def test_kl_is_a_mean_over_valid_pairs():
    posterior = torch.tensor([[0.8, 0.2], [0.5, 0.5], [1e-30, 1.0]]).log()
    prior = torch.tensor([[0.4, 0.6], [0.5, 0.5], [1.0, 1e-30]]).log()
    expected = (0.8 * math.log(0.8 / 0.4) + 0.2 * math.log(0.2 / 0.6)) / 2
    value = kl_categorical(posterior, prior, torch.tensor([True, True, False]))
    assert value.item() == pytest.approx(expected, rel=1e-5)


def test_decided_logits_give_a_finite_kl_and_gradient():
    posterior = torch.tensor([[0.0, -1e4]], requires_grad=True)
    value = kl_categorical(posterior, torch.zeros(1, 2), torch.tensor([True]))
    value.backward()
    assert value.item() == pytest.approx(math.log(2))
    assert posterior.grad is not None and torch.isfinite(posterior.grad).all()


@pytest.mark.parametrize(
    ("values", "valid", "expected"),
    [
        ([1.0, 3.0, 5.0], [True, True, True], 3.0),
        ([1.0, math.inf, 5.0], [True, False, True], 3.0),
        ([1.0, math.nan, 5.0], [True, False, True], 3.0),
        ([1.0, 3.0], [False, False], 0.0),
    ],
    ids=["all", "infinite_is_left_out", "nan_is_left_out", "none"],
)
def test_masked_mean(values: list[float], valid: list[bool], expected: float):
    assert masked_mean(torch.tensor(values), torch.tensor(valid)).item() == expected
