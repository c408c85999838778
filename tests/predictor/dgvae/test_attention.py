"""Shares of attention: what they are in closed form, and that an edge depends on the other senders through them."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from predictor.dgvae import DGVAE
from predictor.dgvae.attention import SHARPEST, Attention, shares, weights
from predictor.dgvae.config import DGVAEConfig
from predictor.support.errors import UserError
from tests.predictor.helpers import FAST_LIKE, spec

WIDTH, HEADS, AGENTS = 9, 3, 4


def attention() -> Attention:
    torch.manual_seed(3)
    return Attention(WIDTH, HEADS).double()


def test_shares_in_closed_form():
    """Two senders with equal scores of 0 get a third each, and the third third is nobody's."""
    layer = attention()
    with torch.no_grad():
        layer.out.weight.copy_(torch.eye(WIDTH, HEADS))
        layer.score.weight.zero_()
    pairs = torch.tensor([True, True, False, False])
    added = layer(torch.randn(AGENTS, WIDTH).double(), pairs)
    expected = torch.zeros(AGENTS, WIDTH).double()
    expected[:2, :HEADS] = 1 / 3
    torch.testing.assert_close(added, expected)


def test_a_score_wins_by_its_exponential():
    score = torch.tensor([[0.5], [-0.25]]).double()
    weight = weights(score)
    expected = [math.exp(SHARPEST * math.tanh(value / SHARPEST)) for value in (0.5, -0.25)]
    assert weight[:, 0].tolist() == pytest.approx(expected)
    found = shares(weight, weight.sum(0, keepdim=True))[:, 0].tolist()
    assert found == pytest.approx([value / (1 + sum(expected)) for value in expected])


def test_the_largest_scores_stay_finite():
    for dtype in (torch.float32, torch.float16):
        weight = weights(torch.tensor([[1e4], [-1e4]], dtype=dtype))
        assert shares(weight, weight.sum(0, keepdim=True)).isfinite().all() and weight[0] > 2000 > 0.01 > weight[1] > 0


def edge_of_the_first_pair(config: DGVAEConfig, states: Tensor, valid: Tensor) -> Tensor:
    """Features of the edge from agent 1 to agent 0, with the sum over senders held fixed."""
    torch.manual_seed(5)
    model = DGVAE(spec(), config).double().eval()
    with torch.no_grad():
        model.encoder.conv_out.weight.zero_()  # no other way to an edge from a third agent
        model.encoder.conv_out.bias.zero_()
        _, belief = model.observe(model.empty_memory(1, AGENTS), states, valid)
    return belief.edge_features[0, 0, 1]


@pytest.mark.parametrize("heads", [0, HEADS])
@pytest.mark.parametrize("there", [False, True])
def test_an_edge_depends_on_the_other_senders_that_are_there(heads: int, there: bool):
    config = replace(FAST_LIKE, attention_heads=heads, geometry_scales=(2.0, 1.5))
    valid = torch.tensor([[True, True, there, False]])
    here = torch.randn(1, AGENTS, 4, generator=torch.Generator().manual_seed(0)).double()
    moved = here.clone()
    moved[0, 2] += 3
    same = torch.equal(edge_of_the_first_pair(config, here, valid), edge_of_the_first_pair(config, moved, valid))
    assert same == (not (heads and there))


def test_heads_are_counted_from_zero():
    with pytest.raises(UserError, match="attention_heads must not be negative, got -1"):
        DGVAEConfig(attention_heads=-1)
