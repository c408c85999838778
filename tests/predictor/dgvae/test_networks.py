"""The layers of the dG-VAE against plain loops, and the concrete distribution."""

import math
from collections.abc import Mapping
from dataclasses import replace
from itertools import product
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor, nn
from torch.nn import functional

from predictor.dgvae.config import PRESETS, DGVAEConfig
from predictor.dgvae.networks import Decoder, Encoder, concrete_sample
from predictor.graph import pair_mask
from predictor.support.errors import UserError
from tests.predictor.helpers import FAST_LIKE, model, random_presence, random_states

BATCH, TIME, AGENTS = 2, 6, 4
TOLERANCE = {"rtol": 0.0, "atol": 1e-5}

# --- Recurrences and messages --------------------------------------------------------------------------------------


def lstm_cell(input_map: nn.Linear, hidden_map: nn.Linear) -> nn.LSTMCell:
    """torch's own cell with our weights."""
    cell = nn.LSTMCell(input_map.in_features, hidden_map.in_features)
    cell.weight_ih.data, cell.bias_ih.data = input_map.weight.data, input_map.bias.data
    cell.weight_hh.data, cell.bias_hh.data = hidden_map.weight.data, torch.zeros_like(input_map.bias.data)
    return cell.requires_grad_(False)


def loop_over_pairs(cell: nn.LSTMCell, embedding: Tensor, pairs: Tensor, reverse: bool) -> tuple[Tensor, Tensor]:
    batch, time, agents = pairs.shape[:3]
    hiddens = embedding.new_zeros(batch, time, agents, agents, cell.hidden_size)
    cells = torch.zeros_like(hiddens)
    for b, i, j in product(range(batch), range(agents), range(agents)):
        state = None  # nothing is known of this pair
        for t in reversed(range(time)) if reverse else range(time):
            state = cell(embedding[b, t, i, j][None], state) if pairs[b, t, i, j] else None
            if state is not None:
                hiddens[b, t, i, j], cells[b, t, i, j] = state[0][0], state[1][0]
    return hiddens, cells


@settings(max_examples=5)
@given(seed=st.integers(0, 2**16), share=st.sampled_from([0.5, 0.8, 1.0]))
def test_recurrence_of_each_pair_is_a_plain_lstm(seed: int, share: float):
    encoder = model("paper", 3).encoder
    inputs = functional.pad(random_states(seed, BATCH, TIME, AGENTS, 4) / 10, (0, 1))
    pairs = pair_mask(random_presence(seed, BATCH, TIME, AGENTS, ego=False, share=share))
    zeros = torch.zeros(BATCH, AGENTS, AGENTS, 7)
    edges = encoder(inputs, pairs, zeros, zeros)
    embedding = encoder.edge_out(edges.hidden_layer)
    forward = loop_over_pairs(lstm_cell(encoder.forward_input, encoder.forward_hidden), embedding, pairs, False)
    torch.testing.assert_close((edges.hidden, edges.cell), forward, **TOLERANCE)
    backward, _ = loop_over_pairs(lstm_cell(encoder.backward_input, encoder.backward_hidden), embedding, pairs, True)
    expected = encoder.posterior_head(functional.elu(torch.cat([forward[0], backward], dim=-1)))
    posterior = encoder.posterior_logits(edges, pairs)
    torch.testing.assert_close(posterior[pairs], expected[pairs], **TOLERANCE)
    assert torch.equal(posterior[~pairs].softmax(-1)[:, 0], torch.ones(int((~pairs).sum())))
    prior, features = encoder.prior_head(functional.elu(forward[0])), encoder.feature_head(functional.elu(forward[0]))
    torch.testing.assert_close(edges.prior_logits[pairs], prior[pairs], **TOLERANCE)
    torch.testing.assert_close(edges.features[pairs], features[pairs], **TOLERANCE)


def test_graph_block_against_a_loop():
    """x_i ← Σ_j h(x_i ‖ x_j − x_i), then h(x_i ‖ x_j), with two-layer h."""
    encoder = model("paper").encoder
    generator = torch.Generator().manual_seed(0)
    inputs, valid = torch.randn(AGENTS, 5, generator=generator), torch.tensor([True, True, False, True])
    pairs = pair_mask(valid)
    nodes = encoder.embed(inputs)
    conv, edge = encoder.conv_pair, encoder.edge_pair
    updated = []
    for i in range(AGENTS):
        total = torch.zeros(12)
        for j in range(AGENTS):
            if pairs[i, j]:
                first = conv.receiver(nodes[i]) + conv.sender(nodes[j] - nodes[i])
                total = total + encoder.conv_out(functional.elu(first))
        updated.append(functional.elu(total))
    embedding = encoder.edge_out(encoder.embed_edges(inputs, pairs))
    for i, j in product(range(AGENTS), range(AGENTS)):
        first = edge.receiver(updated[i]) + edge.sender(updated[j])
        torch.testing.assert_close(embedding[i, j], encoder.edge_out(functional.elu(first)), **TOLERANCE)


@pytest.mark.parametrize("types", [2, 3])
def test_messages_against_a_loop(types: int):
    """x_i's own term plus Σ_j Σ_k z_ijk h_k(x_i ‖ x_j ‖ e_ij) over all types but "no edge"."""
    decoder, width = model("fast", types).decoder, 11
    generator = torch.Generator().manual_seed(0)
    inputs, features = torch.randn(AGENTS, 5, generator=generator), torch.randn(AGENTS, AGENTS, 6, generator=generator)
    graph = torch.rand(AGENTS, AGENTS, types, generator=generator)
    pairs = pair_mask(torch.tensor([True, True, False, True]))
    messages = decoder.messages(inputs, pairs, graph, features)
    for i in range(AGENTS):
        expected = decoder.own(inputs[i])
        for j, k in product(range(AGENTS), range(1, types)):
            if pairs[i, j]:
                part = slice((k - 1) * width, k * width)
                first = decoder.message_pair.receiver(inputs[i]) + decoder.message_pair.sender(inputs[j])
                first = functional.elu(first + decoder.message_feature(features[i, j]))[part]
                second = functional.linear(first, decoder.message_out.weight[part], decoder.message_out.bias[part])
                expected = expected + graph[i, j, k] * second
        torch.testing.assert_close(messages[i], expected, **TOLERANCE)


def test_recurrence_of_each_agent_is_a_plain_gru():
    decoder = model().decoder
    valid = random_presence(0, BATCH, TIME, AGENTS, ego=False)
    messages = torch.randn(BATCH, TIME, AGENTS, 11, generator=torch.Generator().manual_seed(0))
    hidden = torch.zeros(BATCH, AGENTS, 13)
    ours = []
    for t in range(TIME):
        hidden = decoder.step(messages[:, t], hidden) * valid[:, t, :, None]
        ours.append(hidden)
    for b, i in product(range(BATCH), range(AGENTS)):
        state = torch.zeros(13)
        for t in range(TIME):
            state = decoder.gru(messages[b, t, i][None], state[None])[0] if valid[b, t, i] else torch.zeros(13)
            torch.testing.assert_close(ours[t][b, i], state, **TOLERANCE)


def test_a_type_without_weight_is_silent():
    decoder = model().decoder
    inputs, pairs = torch.randn(3, 5, generator=torch.Generator().manual_seed(0)), pair_mask(torch.ones(3).bool())
    no_edge = torch.tensor([1.0, 0.0]).expand(3, 3, 2)
    messages = decoder.messages(inputs, pairs, no_edge, torch.zeros(3, 3, 6))
    torch.testing.assert_close(messages, decoder.own(inputs))


# --- The concrete distribution --------------------------------------------------------------------------------------


def test_concrete_samples_follow_their_probabilities():
    """At any temperature the largest entry is type k with probability softmax(logits)_k (the Gumbel-max identity)."""
    probs = torch.tensor([0.2, 0.5, 0.3])
    drawn = concrete_sample(probs.log().expand(20_000, 3), 0.5, torch.Generator().manual_seed(0))
    torch.testing.assert_close(drawn.sum(-1), torch.ones(20_000))
    share = torch.bincount(drawn.argmax(-1), minlength=3) / 20_000
    torch.testing.assert_close(share, probs, rtol=0, atol=0.015)  # four standard errors


def test_cold_concrete_samples_are_one_hot_and_hot_ones_even():
    logits = torch.zeros(1000, 3)
    cold, hot = (concrete_sample(logits, t, torch.Generator().manual_seed(0)) for t in (1e-3, 1e3))
    assert (cold.amax(-1) > 0.99).float().mean() > 0.98
    assert (hot - 1 / 3).abs().max() < 0.01


def test_concrete_samples_pass_gradients():
    logits = torch.zeros(4, 3, requires_grad=True)
    concrete_sample(logits, 0.5, torch.Generator().manual_seed(0))[:, 0].sum().backward()
    assert logits.grad is not None and torch.isfinite(logits.grad).all() and logits.grad.abs().min() > 0


def test_hard_samples_are_one_hot_and_pass_the_soft_gradient():
    logits = torch.randn(50, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    weight = torch.tensor([1.0, 2.0, 4.0], dtype=torch.float64)
    samples, gradients = [], []
    for hard in (False, True):
        leaf = logits.clone().requires_grad_()
        sample = concrete_sample(leaf, 0.5, torch.Generator().manual_seed(1), hard)
        (sample * weight).sum().backward()
        samples.append(sample.detach())
        gradients.append(leaf.grad)
    soft, one_hot = samples
    assert torch.equal(one_hot, functional.one_hot(soft.argmax(-1), 3).double())
    torch.testing.assert_close(gradients[1], gradients[0])
    assert gradients[0] is not None and gradients[0].abs().max() > 1e-3


# --- Config ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"rnn_dim": 0}, "rnn_dim must be at least 1, got 0"),
        ({"num_edge_types": 1}, r"num_edge_types must be at least 2 \(the first is 'no edge'\), got 1"),
        ({"temperature": 0.0}, "need 0 < temperature < inf and 0 <= dropout < 1, got 0.0, 0.0"),
        ({"temperature": math.inf}, "need 0 < temperature < inf and 0 <= dropout < 1, got inf, 0.0"),
        ({"dropout": 1.0}, "need 0 < temperature < inf and 0 <= dropout < 1, got 0.5, 1.0"),
        ({"innovation_dim": 0}, "innovation_dim must be at least 1, got 0"),
        ({"innovation_rounds": -1}, "innovation_rounds must not be negative, got -1"),
        ({"substeps": -1}, "substeps must not be negative, got -1"),
        ({"edge_feature_dim": -1}, "edge_feature_dim must not be negative, got -1"),
        ({"static_dim": 33}, r"static_dim must be at most edge_feature_dim \(32\), got 33"),
        (
            {"feature_labels": ("a", "b"), "edge_feature_dim": 1},
            "feature_labels needs an edge feature for each of a, b, got",
        ),
        ({"feature_labels": ("a",), "label_means": (1.0, 2.0), "label_scales": (1.0, 2.0)}, "one number for each of 1"),
        ({"feature_labels": ("a",), "label_means": (1.0,)}, "label_means needs as many finite numbers as label_scales"),
        ({"feature_labels": ("a",), "label_means": (1.0,), "label_scales": (0.0,)}, "label_scales must be positive"),
    ],
)
def test_config_refuses(fields: Mapping[str, Any], message: str):
    with pytest.raises(UserError, match=message):
        DGVAEConfig(**fields)


def test_forget_bias_lengthens_the_first_memory():
    """It is added to the forget gates' initial bias and to nothing else."""
    made = []
    for forget_bias in (0.0, 2.0):
        torch.manual_seed(0)
        made.append(Encoder(replace(FAST_LIKE, forget_bias=forget_bias), 4))
    plain, biased = (dict(encoder.named_parameters()) for encoder in made)
    for name, weight in plain.items():
        added = torch.zeros_like(weight)
        if name in ("forward_input.bias", "backward_input.bias"):
            added[5:10] = 2.0  # gates are input, forget, cell, output; the LSTM is 5 wide
        assert torch.equal(biased[name], weight + added), name


def test_without_edge_features_there_are_no_layers_for_them():
    """The ablation dVAE: messages are those of features that are all zero."""
    torch.manual_seed(0)
    encoder, decoder = (
        Encoder(replace(FAST_LIKE, edge_feature_dim=0), 5),
        Decoder(replace(FAST_LIKE, edge_feature_dim=0), 5, 4),
    )
    assert not any("feature" in name for part in (encoder, decoder) for name, _ in part.named_parameters())
    inputs, pairs = torch.randn(1, 1, 3, 5), pair_mask(torch.ones(1, 1, 3).bool())
    zeros = torch.zeros(1, 3, 3, 5)
    assert encoder(inputs, pairs, zeros, zeros).features.shape == (1, 1, 3, 3, 0)
    full = Decoder(FAST_LIKE, 5, 4)
    full.load_state_dict(decoder.state_dict(), strict=False)
    graph = torch.full((3, 3, 2), 0.5)
    ours = decoder.messages(inputs[0, 0], pairs[0, 0], graph, torch.zeros(3, 3, 0))
    assert torch.equal(ours, full.messages(inputs[0, 0], pairs[0, 0], graph, torch.zeros(3, 3, 6)))


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("residual", "midpoint", "residual must be one of state, constant_velocity, trapezoid, got 'midpoint'"),
        ("pair_matching", "future", "pair_matching must be one of window, causal, got 'future'"),
    ],
)
def test_config_refuses_unknown_choices(field: str, value: str, message: str):
    """As when a checkpoint is read where types are not checked; here they would be refused earlier."""
    config = DGVAEConfig()
    object.__setattr__(config, field, value)
    with pytest.raises(UserError, match=message):
        config.__post_init__()


def test_paper_preset_has_the_sizes_of_the_paper():
    paper = PRESETS["paper"]
    assert (paper.hidden_dim, paper.rnn_dim, paper.head_dim, paper.decoder_dim) == (128, 64, 256, 256)
    assert (paper.num_edge_types, paper.temperature, paper.residual) == (2, 0.5, "state")


@pytest.mark.parametrize("kind", [torch.bfloat16, torch.float16])
def test_rare_types_are_drawn_in_full_precision(kind: torch.dtype):
    """The noise of half precision has no tails that are fine enough."""
    logits = torch.tensor([0.0, -7.0]).expand(100_000, 2).to(kind)
    drawn, exact = (
        concrete_sample(x, 0.5, torch.Generator().manual_seed(0), hard=True) for x in (logits, logits.float())
    )
    assert torch.equal(drawn, exact) and 50 < drawn[:, 1].sum() < 140
