"""Types that both directions of a pair share: the mean of the two logits, in training and in streaming."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from predictor.dgvae import DGVAE
from predictor.dgvae.config import DGVAEConfig
from predictor.graph import pair_mask
from predictor.support.errors import UserError
from tests.predictor.helpers import precise, random_presence, random_states

BATCH, TIME, AGENTS, TYPES = 2, 5, 4, 3
sizes = pytest.mark.parametrize("size", ["fast", "rich"])


def scenes(seed: int) -> tuple[Tensor, Tensor]:
    valid = random_presence(seed, BATCH, TIME, AGENTS)
    return random_states(seed, BATCH, TIME, AGENTS, 4).double() * valid[..., None], valid


def window_logits(model: DGVAE, states: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
    output = model.window(states, valid, torch.full((BATCH,), TIME - 1), 0, torch.Generator().manual_seed(0))
    assert output.prior_logits is not None and output.posterior_logits is not None
    return output.prior_logits, output.posterior_logits


@sizes
@settings(max_examples=5, deadline=None)
@given(seed=st.integers(0, 2**16))
def test_logits_are_the_mean_of_both_directions(size: str, seed: int):
    states, valid = scenes(seed)
    plain, pairs = precise(size, TYPES), pair_mask(valid)
    shared = plain.variant(symmetric_types=True)
    for found, single in zip(window_logits(shared, states, valid), window_logits(plain, states, valid), strict=True):
        expected = (single + single.transpose(-2, -3)) / 2
        torch.testing.assert_close(found[pairs], expected[pairs], rtol=0, atol=1e-10)
        assert torch.equal(found.softmax(-1)[~pairs][:, 0], torch.ones(int((~pairs).sum())).double())
        assert not torch.allclose(single[pairs], expected[pairs], atol=1e-3)


@sizes
def test_streaming_has_the_windows_types_and_they_are_symmetric(size: str):
    states, valid = scenes(0)
    model = precise(size, TYPES).variant(symmetric_types=True)
    prior, _ = window_logits(model, states, valid)
    memory = model.empty_memory(BATCH, AGENTS)
    for t in range(TIME):
        memory, belief = model.observe(memory, states[:, t], valid[:, t])
        probs = belief.dense().edge_probs
        torch.testing.assert_close(probs, prior[:, t].softmax(-1), rtol=0, atol=1e-10)
        torch.testing.assert_close(probs, probs.transpose(1, 2), rtol=0, atol=1e-12)
        assert probs[pair_mask(valid[:, t])][:, 0].std() > 1e-3


def test_absent_agents_leave_no_trace():
    """Garbage in a padded agent reaches no logit, not even through a reverse pair."""
    states, valid = scenes(3)
    model = precise("fast", TYPES).variant(symmetric_types=True)
    dirty = torch.where(valid[..., None], states, 1e3)
    for clean, found in zip(window_logits(model, states, valid), window_logits(model, dirty, valid), strict=True):
        assert torch.equal(clean, found)


def test_it_needs_every_pair_and_its_reverse():
    with pytest.raises(UserError, match="symmetric_types needs every pair and its reverse; set num_neighbours to 0"):
        DGVAEConfig(num_neighbours=1, symmetric_types=True)
