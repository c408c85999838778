"""The energy score: closed forms, properness where the truth forks, and its loop against all pairs at once."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from predictor.evaluation.displacement import min_ade
from predictor.evaluation.energy_score import energy_score, weighted_score

STANDING = torch.zeros(1, 1, 3, 2)
ALL = torch.ones(1, 1, 3).bool()


def at(*xs: float, steps: int = 3) -> Tensor:
    """A forecast (1, samples, 1, steps, 2) of samples that stand at these places on the x axis."""
    return torch.tensor([[x, 0.0] for x in xs])[None, :, None, None].expand(-1, -1, -1, steps, -1)


def score(*xs: float, probs: tuple[float, ...] | None = None, valid: Tensor = ALL) -> float:
    mode_probs = None if probs is None else torch.tensor(probs)[None, :, None]
    value, counts = energy_score(at(*xs), STANDING, valid, mode_probs)
    assert counts.all()
    return value.item()


# --- Closed forms -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("xs", "probs", "expected"),
    [
        ((3.0,), None, 3.0),
        ((3.0,), (1.0,), 3.0),
        # (1 + 3) / 2 − 4 / 4: mean distance to the truth, minus half the mean distance of two draws
        ((-1.0, 3.0), None, 1.0),
        ((-1.0, 3.0), (0.5, 0.5), 1.0),
        ((-1.0, 3.0), (0.75, 0.25), 0.75 * 1 + 0.25 * 3 - 0.75 * 0.25 * 4),
        ((-1.0, 3.0), (1.0, 0.0), 1.0),
        # three pairs, of distances 1, 3 and 2, each with the weight 1/9
        ((0.0, 1.0, 3.0), None, 4 / 3 - (1 + 3 + 2) / 9),
        ((2.0, 2.0, 2.0), None, 2.0),
    ],
    ids=["one", "one_weighted", "two", "two_weighted", "unequal", "one_counts", "three", "equal_samples"],
)
def test_closed_form(xs: tuple[float, ...], probs: tuple[float, ...] | None, expected: float):
    assert score(*xs, probs=probs) == pytest.approx(expected)


def test_one_sample_scores_its_ade():
    forecast, future = torch.tensor([[[[[3.0, 4.0], [0.0, 2.0], [9.0, 9.0]]]]]), STANDING
    valid = torch.tensor([[[True, True, False]]])
    value, counts = energy_score(forecast, future, valid)
    assert value.item() == pytest.approx(3.5) == min_ade(forecast, future, valid)[0].item()
    assert counts.item()


def test_two_futures_are_as_far_apart_as_their_steps_on_average():
    """In two dimensions, and by the steps: not by the distance of the whole paths as one vector."""
    forecast = torch.tensor([[[[[3.0, 4.0], [0.0, 0.0]]], [[[0.0, 0.0], [0.0, 2.0]]]]])
    value, _ = energy_score(forecast, STANDING[:, :, :2], ALL[..., :2])
    assert value.item() == pytest.approx((2.5 + 1.0) / 2 - (5 + 2) / 2 / 4)


@pytest.mark.parametrize("hidden", [7.0, math.inf, math.nan])
def test_steps_without_truth_count_neither_to_the_truth_nor_between_samples(hidden: float):
    valid = torch.tensor([[[True, False, True]]])
    forecast, future = at(-1.0, 3.0).clone(), STANDING.clone()
    future[0, 0, 1] = hidden
    forecast[0, 1, 0, 1] = 50.0
    value, _ = energy_score(forecast, future, valid)
    assert value.item() == pytest.approx(score(-1.0, 3.0))


def test_agent_without_a_valid_step_is_invalid():
    valid = torch.tensor([[[True] * 3, [False] * 3]])
    forecast, future = at(1.0, 2.0).expand(-1, -1, 2, -1, -1), STANDING.expand(-1, 2, -1, -1)
    value, counts = energy_score(forecast, future, valid)
    assert counts.tolist() == [[True, False]] and torch.isfinite(value).all()


# --- Properness -------------------------------------------------------------------------------------------------------

TURN = torch.tensor([[1.0, 0.2], [1.8, 1.0], [2.0, 2.0]])
LEFT, RIGHT = TURN, TURN * torch.tensor([1.0, -1.0])


def expected_score(samples: list[Tensor], probs: list[float], share_left: float = 0.5) -> float:
    """Mean score over what may happen: left with this probability, else right."""
    forecast, weights = torch.stack(samples)[None, :, None], torch.tensor(probs)[None, :, None]
    of_left, of_right = (energy_score(forecast, truth[None, None], ALL, weights)[0].item() for truth in (LEFT, RIGHT))
    return share_left * of_left + (1 - share_left) * of_right


@pytest.mark.parametrize("share_left", [0.5, 0.8])
def test_where_the_truth_forks_the_true_distribution_scores_lowest(share_left: float):
    both = [share_left, 1 - share_left]

    def score_of(samples: list[Tensor], probs: list[float]) -> float:
        return expected_score(samples, probs, share_left)

    ideal = score_of([LEFT, RIGHT], both)
    between = share_left * LEFT + (1 - share_left) * RIGHT
    others = {
        "collapsed to the mean": score_of([between], [1.0]),
        "left alone": score_of([LEFT], [1.0]),
        "right alone": score_of([RIGHT], [1.0]),
        "wrong probabilities": score_of([LEFT, RIGHT], [both[0] - 0.2, both[1] + 0.2]),
        "wrong the other way": score_of([LEFT, RIGHT], [both[0] + 0.15, both[1] - 0.15]),
        "too wide": score_of([between + 1.5 * (LEFT - between), between + 1.5 * (RIGHT - between)], both),
        "too narrow": score_of([between + 0.7 * (LEFT - between), between + 0.7 * (RIGHT - between)], both),
        "one more way": score_of([LEFT, RIGHT, between], [0.8 * both[0], 0.8 * both[1], 0.2]),
    }
    assert {name: value for name, value in others.items() if value < ideal + 0.005} == {}
    # the score of the truth's own distribution is half the mean distance of two truths
    apart = torch.linalg.vector_norm(LEFT - RIGHT, dim=-1).mean().item()
    assert ideal == pytest.approx(both[0] * both[1] * apart)


def test_best_of_k_would_choose_the_wide_one():
    """What the score is for: the smallest error of all samples rewards a spread that nothing justifies."""
    true = torch.stack([LEFT, RIGHT])[None, :, None]
    wide = torch.cat([true, true * torch.tensor([1.0, 0.5]), true * torch.tensor([1.0, 2.0])], dim=1)
    equal = [1 / 6] * 6
    assert min_ade(wide, LEFT[None, None], ALL)[0].item() == min_ade(true, LEFT[None, None], ALL)[0].item() == 0.0
    assert expected_score([*wide[0, :, 0]], equal) > expected_score([LEFT, RIGHT], [0.5, 0.5])


# --- Properties -------------------------------------------------------------------------------------------------------


def drawn(seed: int, samples: int, agents: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """A random batch of two scenes and three steps, with probabilities."""
    generator = torch.Generator().manual_seed(seed)
    forecast = 3 * torch.randn(2, samples, agents, 3, 2, generator=generator)
    valid = torch.rand(2, agents, 3, generator=generator) < 0.7
    probs = torch.softmax(2 * torch.randn(2, samples, agents, generator=generator), dim=1)
    return forecast, torch.randn(2, agents, 3, 2, generator=generator), valid, probs


batches = st.builds(drawn, st.integers(0, 10**6), samples=st.integers(1, 6), agents=st.integers(1, 4))


@given(batches, st.randoms(use_true_random=False))
def test_order_of_samples_and_of_agents_does_not_matter(batch: tuple[Tensor, Tensor, Tensor, Tensor], random):
    forecast, future, valid, probs = batch
    samples, agents = (random.sample(range(n), n) for n in forecast.shape[1:3])
    expected, counts = energy_score(forecast, future, valid, probs)
    value, there = energy_score(
        forecast[:, samples][:, :, agents], future[:, agents], valid[:, agents], probs[:, samples][:, :, agents]
    )
    torch.testing.assert_close(value, expected[:, agents], rtol=1e-5, atol=1e-5)
    assert torch.equal(there, counts[:, agents])


@given(batches, st.booleans())
def test_a_row_of_pairs_at_a_time_is_all_pairs_at_once(batch: tuple[Tensor, Tensor, Tensor, Tensor], weighted: bool):
    forecast, future, valid, probs = batch
    probs = probs if weighted else torch.full_like(probs, 1 / probs.shape[1])

    def mean_distance(first: Tensor, second: Tensor) -> Tensor:
        step = (first - second).square().sum(-1).sqrt() * valid[:, None, None]
        return step.sum(-1) / valid.sum(-1).clamp(min=1)[:, None, None]

    to_truth = mean_distance(forecast[:, None], future[:, None, None])[:, 0]
    between = mean_distance(forecast[:, :, None], forecast[:, None])
    expected = (probs * to_truth).sum(1) - 0.5 * (probs[:, :, None] * probs[:, None] * between).sum((1, 2))
    value, _ = energy_score(forecast, future, valid, probs if weighted else None)
    torch.testing.assert_close(value, expected, rtol=1e-5, atol=1e-5)


@given(batches)
def test_a_sample_listed_twice_with_half_its_probability_changes_nothing(batch: tuple[Tensor, Tensor, Tensor, Tensor]):
    forecast, future, valid, probs = batch
    twice = torch.cat([forecast, forecast[:, :1]], dim=1)
    shared = torch.cat([probs[:, :1] / 2, probs[:, 1:], probs[:, :1] / 2], dim=1)
    torch.testing.assert_close(
        energy_score(twice, future, valid, shared)[0], energy_score(forecast, future, valid, probs)[0],
        rtol=1e-5, atol=1e-5,
    )  # fmt: skip


def test_never_more_than_a_row_of_pairs_is_computed_at_once():
    """A thousand samples in each of many scenes: their square would not fit into memory."""
    rows: list[int] = []

    def counting(first: Tensor, second: Tensor) -> Tensor:
        rows.append(max(first.shape[1], second.shape[1]))
        return (first - second).abs()

    samples = torch.arange(5.0)[None]
    value = weighted_score(samples, torch.tensor([1.0]), None, counting)
    assert rows == [5, 4, 3, 2, 1]
    assert value.item() == pytest.approx((1 + 0 + 1 + 2 + 3) / 5 - (4 * 1 + 3 * 2 + 2 * 3 + 1 * 4) / 25)
