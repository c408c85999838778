"""Pair matching and restricted labelling: in closed form, against loops, and inside the dG-VAE."""

import math
from dataclasses import replace
from functools import cache
from itertools import product
from typing import Literal

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from predictor.dgvae import DGVAE
from predictor.dgvae.config import DGVAEConfig
from predictor.dgvae.pair_matching import running_mean, window_mean
from predictor.forecaster import Belief
from predictor.graph import pair_mask
from predictor.support.errors import UserError
from predictor.training.objective import restricted_labelling
from tests.predictor.helpers import FAST_LIKE, random_presence, random_states, spec

BATCH, TIME, AGENTS, STATIC = 2, 6, 3, 2
EXACT = {"rtol": 0.0, "atol": 1e-12}
seeds = st.integers(0, 2**16)


def values_and_pairs(seed: int, share: float = 0.7) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    values = torch.randn(BATCH, TIME, AGENTS, AGENTS, STATIC, generator=generator, dtype=torch.float64)
    return values, pair_mask(random_presence(seed, BATCH, TIME, AGENTS, ego=False, share=share))


def nothing_yet() -> Tensor:
    return torch.zeros(BATCH, AGENTS, AGENTS, STATIC + 1).double()


def unbroken(pairs: Tensor, b: int, t: int, i: int, j: int) -> list[int]:
    """The steps up to `t` since which a pair has been there without a break."""
    steps = []
    for step in range(t, -1, -1):
        if not pairs[b, step, i, j]:
            break
        steps.append(step)
    return steps


# --- Running mean -----------------------------------------------------------------------------------------------------


@settings(max_examples=8)
@given(seed=seeds, share=st.sampled_from([0.5, 0.8, 1.0]))
def test_running_mean_is_the_mean_over_the_unbroken_presence(seed: int, share: float):
    values, pairs = values_and_pairs(seed, share)
    ours = running_mean(values, pairs, nothing_yet())
    for b, t, i, j in product(range(BATCH), range(TIME), range(AGENTS), range(AGENTS)):
        steps = unbroken(pairs, b, t, i, j)
        expected = torch.stack([values[b, s, i, j] for s in steps]).mean(0) if steps else torch.zeros(STATIC).double()
        torch.testing.assert_close(ours[b, t, i, j, :STATIC], expected, **EXACT)
        assert ours[b, t, i, j, STATIC] == len(steps)


def test_running_mean_starts_anew_after_an_absence():
    values = torch.tensor([2.0, 4.0, 100.0, 10.0, 20.0]).view(1, 5, 1, 1, 1)
    there = torch.tensor([True, True, False, True, True]).view(1, 5, 1, 1)
    after = running_mean(values, there, torch.zeros(1, 1, 1, 2))
    assert after.view(5, 2).tolist() == [[2.0, 1.0], [3.0, 2.0], [0.0, 0.0], [10.0, 1.0], [15.0, 2.0]]


@settings(max_examples=8)
@given(seed=seeds, cut=st.integers(1, TIME - 1))
def test_running_mean_in_two_stretches_is_that_at_once(seed: int, cut: int):
    values, pairs = values_and_pairs(seed)
    whole = running_mean(values, pairs, nothing_yet())
    first = running_mean(values[:, :cut], pairs[:, :cut], nothing_yet())
    second = running_mean(values[:, cut:], pairs[:, cut:], first[:, -1])
    assert torch.equal(torch.cat([first, second], dim=1), whole)


def test_running_mean_of_a_constant_is_the_constant():
    """However long: the update adds a share of the difference, not a growing sum."""
    after = running_mean(torch.full((1, 200, 1, 1, 1), 0.1), torch.ones(1, 200, 1, 1).bool(), torch.zeros(1, 1, 1, 2))
    assert torch.equal(after[..., 0], torch.full((1, 200, 1, 1), 0.1))


def test_running_mean_passes_gradients_to_every_step_of_the_stay():
    values = torch.zeros(1, 4, 1, 1, 1, dtype=torch.float64, requires_grad=True)
    there = torch.tensor([True, False, True, True]).view(1, 4, 1, 1)
    running_mean(values, there, torch.zeros(1, 1, 1, 2).double())[0, 3, 0, 0, 0].backward()
    assert values.grad is not None
    assert values.grad.flatten().tolist() == [0.0, 0.0, 0.5, 0.5]


# --- Mean over the window ---------------------------------------------------------------------------------------------


@settings(max_examples=8)
@given(seed=seeds)
def test_window_mean_against_a_loop(seed: int):
    """Over all steps at which the pair is there, with or without a break; zero where it is not."""
    values, pairs = values_and_pairs(seed)
    ours = window_mean(values, pairs)
    for b, i, j in product(range(BATCH), range(AGENTS), range(AGENTS)):
        there = pairs[b, :, i, j]
        assert not ours[b, ~there, i, j].any()
        if there.any():
            expected = values[b, there, i, j].mean(0).expand(int(there.sum()), STATIC)
            torch.testing.assert_close(ours[b, there, i, j], expected, **EXACT)


def test_window_mean_is_the_same_at_every_step():
    values, pairs = values_and_pairs(0, share=1.0)
    ours = window_mean(values, pairs)
    assert torch.equal(ours, ours[:, :1].expand_as(ours))


# --- Restricted labelling ---------------------------------------------------------------------------------------------


def test_labelling_closed_form():
    """Two attributes of three features; errors 1 and 2 on one pair, 3 and 0 on the other; a third has no label."""
    features, truth, labelled = torch.zeros(1, 1, 3, 3, 3), torch.zeros(1, 1, 3, 3, 2), torch.zeros(1, 1, 3, 3).bool()
    features[0, 0, 0] = torch.tensor([[7.0, 7.0, 7.0], [1.0, 2.0, 99.0], [3.0, 5.0, 99.0]])
    truth[0, 0, 0] = torch.tensor([[math.inf, math.nan], [0.0, 4.0], [0.0, 5.0]])
    labelled[0, 0, 0, 1:] = True
    assert restricted_labelling(features, truth, labelled).item() == pytest.approx(((1 + 4) / 2 + (9 + 0) / 2) / 2)
    assert restricted_labelling(features, truth, torch.zeros_like(labelled)).item() == 0.0


def test_labelling_pulls_at_the_labelled_dimensions_of_labelled_pairs_only():
    features = torch.zeros(1, 1, 2, 2, 3, requires_grad=True)
    labelled = torch.zeros(1, 1, 2, 2).bool()
    labelled[0, 0, 0, 1] = True
    attributes = torch.full((1, 1, 2, 2, 2), math.nan)  # unknown
    attributes[0, 0, 0, 1] = 1.0
    restricted_labelling(features, attributes, labelled).backward()
    assert features.grad is not None
    assert features.grad[0, 0, 0, 1].tolist() == [-1.0, -1.0, 0.0]
    features.grad[0, 0, 0, 1] = 0.0
    assert not features.grad.any()


# --- In the dG-VAE ----------------------------------------------------------------------------------------------------


@cache
def matched(static_dim: int, matching: Literal["window", "causal"] = "causal", horizon_steps: int = 3) -> DGVAE:
    """Equal weights whatever is averaged: averaging adds no layers."""
    torch.manual_seed(7)
    config = replace(FAST_LIKE, static_dim=static_dim, pair_matching=matching)
    made = DGVAE(spec(), config, horizon_steps).double()
    with torch.no_grad():
        for parameter in made.parameters():
            parameter.mul_(1.7)
    return made.eval().requires_grad_(False)


def features_of(forecaster: DGVAE, states: Tensor, valid: Tensor) -> Tensor:
    now = torch.full((len(states),), states.shape[1] - 1)
    features = forecaster.window(states, valid, now, 0, torch.Generator().manual_seed(0)).features
    assert features is not None
    return features


def stream(forecaster: DGVAE, states: Tensor, valid: Tensor) -> list[Belief]:
    memory, beliefs = forecaster.empty_memory(states.shape[0], states.shape[2]), []
    for now, present in zip(states.unbind(1), valid.unbind(1), strict=True):
        memory, belief = forecaster.observe(memory, now, present)
        beliefs.append(belief)
    return beliefs


@settings(max_examples=5)
@given(seed=seeds)
def test_static_features_are_running_means_and_the_others_are_left_alone(seed: int):
    states, valid = random_states(seed, BATCH, TIME, AGENTS, 4).double(), random_presence(seed, BATCH, TIME, AGENTS)
    pairs = pair_mask(valid)
    raw, ours = features_of(matched(0), states, valid), features_of(matched(3), states, valid)
    means = running_mean(raw[..., :3], pairs, torch.zeros(BATCH, AGENTS, AGENTS, 4).double())[..., :3]
    torch.testing.assert_close(ours[..., :3], means, **EXACT)
    assert torch.equal(ours[..., 3:], raw[..., 3:])
    assert (raw[..., :3] - ours[..., :3]).abs().max() > 1e-3


@settings(max_examples=5)
@given(seed=seeds)
def test_static_features_of_the_paper_are_constant_over_the_window(seed: int):
    states, valid = random_states(seed, BATCH, TIME, AGENTS, 4).double(), random_presence(seed, BATCH, TIME, AGENTS)
    pairs = pair_mask(valid)
    raw, ours = features_of(matched(0), states, valid), features_of(matched(3, "window"), states, valid)
    torch.testing.assert_close(ours[..., :3], window_mean(raw[..., :3], pairs), **EXACT)
    assert torch.equal(ours[..., 3:], raw[..., 3:])
    for b, i, j in product(range(BATCH), range(AGENTS), range(AGENTS)):
        there = ours[b, pairs[b, :, i, j], i, j, :3]
        assert torch.equal(there, there[:1].expand_as(there))


@pytest.mark.parametrize("matching", ["causal", "window"])
@settings(max_examples=5)
@given(seed=seeds)
def test_streaming_knows_the_running_mean(matching: Literal["window", "causal"], seed: int):
    """Whatever was averaged in training, what is deployed is the mean of what was seen."""
    forecaster = matched(3, matching)
    states, valid = random_states(seed, BATCH, TIME, AGENTS, 4).double(), random_presence(seed, BATCH, TIME, AGENTS)
    at_once = features_of(matched(3, "causal"), states, valid)
    for t, belief in enumerate(stream(forecaster, states, valid)):
        torch.testing.assert_close(belief.edge_features, at_once[:, t], **EXACT)


def test_window_mean_does_not_leak_into_the_rollout():
    """The paper's average sees the future, and so do the features of the teacher-forced pass; the free run does not."""
    forecaster, now = matched(3, "window"), 2
    states, valid = random_states(0, BATCH, TIME, AGENTS, 4).double(), torch.ones(BATCH, TIME, AGENTS).bool()
    other_states, other_valid = states.clone(), valid.clone()
    other_states[:, now + 1 :] += 5.0
    other_valid[:, now + 2 :, 2] = False
    one, two = (
        forecaster.window(s, v, torch.full((BATCH,), now), 3, torch.Generator().manual_seed(0))
        for s, v in ((states, valid), (other_states, other_valid))
    )
    assert torch.equal(one.rollout, two.rollout)
    assert one.features is not None and two.features is not None
    assert (one.features[:, : now + 1, :, :, :3] - two.features[:, : now + 1, :, :, :3]).abs().max() > 1e-3
    assert torch.equal(one.features[:, : now + 1, :, :, 3:], two.features[:, : now + 1, :, :, 3:])


def test_both_ways_of_matching_roll_out_alike():
    """They differ in what the teacher-forced pass shows to the decoder, and in nothing else."""
    states, valid = random_states(0, BATCH, TIME, AGENTS, 4).double(), random_presence(0, BATCH, TIME, AGENTS)
    causal, window = (
        matched(3, matching).window(states, valid, torch.tensor([2, 4]), 3, torch.Generator().manual_seed(0))
        for matching in ("causal", "window")
    )
    assert torch.equal(causal.rollout, window.rollout)
    assert not torch.allclose(causal.one_step, window.one_step, atol=1e-3)


def test_static_features_move_less_than_the_others():
    """Over a stay, a running mean settles."""
    states, valid = random_states(0, BATCH, 12, AGENTS, 4).double(), torch.ones(BATCH, 12, AGENTS).bool()
    raw, ours = (features_of(matched(n), states, valid)[..., :3] for n in (0, 3))
    late = slice(6, None)
    assert ours[:, late].diff(dim=1).abs().mean() < 0.3 * raw[:, late].diff(dim=1).abs().mean()


def test_static_dimensions_are_features():
    DGVAEConfig(edge_feature_dim=4, static_dim=4)
    with pytest.raises(UserError, match=r"static_dim must be at most edge_feature_dim \(4\), got 5"):
        DGVAEConfig(edge_feature_dim=4, static_dim=5)
