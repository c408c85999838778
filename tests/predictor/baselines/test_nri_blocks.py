"""The blocks of the NRI family against plain loops, their gradients, their initial weights."""

import pytest
import torch
from hypothesis import given, settings
from torch import nn

from predictor.baselines.base import mean_weight
from predictor.baselines.nri_blocks import FrameEncoder, HiddenDecoder, PairLSTM, elu_head, initialise
from predictor.graph import pair_mask
from tests.predictor.baselines import loops
from tests.predictor.baselines.helpers import AGENTS, BATCH, TIME, TOLERANCE, presence, seeds
from tests.predictor.helpers import random_presence


def noise(seed: int, *shape: int, dtype: torch.dtype = torch.float32) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


@settings(max_examples=8)
@given(valid=presence(ego=False), seed=seeds)
def test_frame_encoder_against_a_loop(valid: torch.Tensor, seed: int):
    torch.manual_seed(0)
    encoder = FrameEncoder(5, 9).requires_grad_(False)
    inputs = noise(seed, BATCH, TIME, AGENTS, 5) * valid[..., None]
    embedding = encoder(inputs, valid)
    for b in range(BATCH):
        for t in range(TIME):
            for (i, j), expected in loops.embed(encoder, inputs[b, t], valid[b, t]).items():
                torch.testing.assert_close(embedding[b, t, i, j], expected, **TOLERANCE)


@pytest.mark.parametrize("reverse", [False, True])
@settings(max_examples=6)
@given(valid=presence(ego=False), seed=seeds)
def test_lstm_of_each_pair_is_torchs(reverse: bool, valid: torch.Tensor, seed: int):
    torch.manual_seed(0)
    rnn = PairLSTM(9, 5).requires_grad_(False)
    embedding, zeros = noise(seed, BATCH, TIME, AGENTS, AGENTS, 9), torch.zeros(BATCH, AGENTS, AGENTS, 5)
    hiddens, cells = rnn(embedding, valid, zeros, zeros, reverse=reverse)
    assert not hiddens[~pair_mask(valid)].any() and not cells[~pair_mask(valid)].any()
    for b in range(BATCH):
        frames = [{(i, j): embedding[b, t, i, j] for i, j in loops.pairs_of(valid[b, t])} for t in range(TIME)]
        for t, frame in enumerate(loops.lstm_of_pairs(rnn, frames, reverse)):
            for (i, j), expected in frame.items():
                torch.testing.assert_close(hiddens[b, t, i, j], expected, **TOLERANCE)


@pytest.mark.parametrize("kinds", [1, 3])
def test_decoder_against_a_loop(kinds: int):
    torch.manual_seed(0)
    decoder = HiddenDecoder(5, 13, 11, kinds, 4).requires_grad_(False)
    for seed in range(3):
        valid = random_presence(seed, AGENTS, ego=False)
        inputs, hidden = noise(seed, AGENTS, 5), noise(seed + 9, AGENTS, 13) * valid[:, None]
        weights = noise(seed + 99, AGENTS, AGENTS, kinds).abs() * pair_mask(valid)[..., None]
        ours = decoder.step(inputs, valid, weights, hidden)
        by_pair = {(i, j): weights[i, j].tolist() for i, j in loops.pairs_of(valid)}
        expected = loops.decode(decoder, inputs, valid, by_pair, dict(enumerate(hidden)))
        for i in range(AGENTS):
            torch.testing.assert_close(ours[i], expected.get(i, torch.zeros(13)), **TOLERANCE)


def test_messages_hand_computed():
    """Two agents, one-wide everything: agent 0 receives 0.5 · tanh(3 · tanh(h₀ + 2 h₁)), agent 1 receives nothing."""
    decoder = HiddenDecoder(1, 1, 1, 1, 1).requires_grad_(False)
    decoder.message_pair.receiver.weight.fill_(1.0)
    decoder.message_pair.receiver.bias.zero_()
    decoder.message_pair.sender.weight.fill_(2.0)
    decoder.message_out[0].weight.fill_(3.0)
    decoder.message_out[0].bias.zero_()
    hidden, weights = torch.tensor([[0.1], [0.2]]), torch.tensor([[[0.0], [0.5]], [[0.0], [0.0]]])
    received = 0.5 * torch.tanh(3 * torch.tanh(torch.tensor(0.5)))
    torch.testing.assert_close(decoder.messages(hidden, weights), torch.stack([received, received * 0])[:, None])


def test_gradients_of_messages_and_update():
    torch.manual_seed(0)
    decoder = HiddenDecoder(2, 3, 4, 2, 1).double()
    valid = torch.tensor([True, True, False])
    weights = (noise(1, 3, 3, 2, dtype=torch.float64).abs() * pair_mask(valid)[..., None]).requires_grad_()
    inputs, hidden = (noise(s, 3, w, dtype=torch.float64).requires_grad_() for s, w in ((2, 2), (3, 3)))
    assert torch.autograd.gradcheck(decoder.messages, (hidden, weights))
    assert torch.autograd.gradcheck(lambda x, w, h: decoder.step(x, valid, w, h), (inputs, weights, hidden))


def test_gradients_of_the_frame_encoder():
    torch.manual_seed(0)
    encoder, valid = FrameEncoder(2, 3).double(), torch.tensor([True, False, True])
    inputs = noise(0, 3, 2, dtype=torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: encoder(x, valid)[pair_mask(valid)], (inputs,))


def test_means_are_over_the_others_who_are_present():
    assert mean_weight(torch.tensor([True, False, True, True]), torch.float32).tolist() == [
        [0.0, 0.0, 0.5, 0.5], [0.0] * 4, [0.5, 0.0, 0.0, 0.5], [0.5, 0.0, 0.5, 0.0],
    ]  # fmt: skip
    assert not mean_weight(torch.tensor([True, False]), torch.float64).any()
    assert not mean_weight(torch.tensor([False, False]), torch.float64).any()


def test_split_layers_start_like_whole_ones():
    """Xavier's variance is that of the layer on the concatenation, 2 / (3·64 + 200), not that of its blocks."""
    torch.manual_seed(0)
    parts = [nn.Linear(64, 200), nn.Linear(64, 200, bias=False), nn.Linear(64, 200, bias=False)]
    initialise(*parts)
    for part in parts:
        assert part.weight.var().item() == pytest.approx(2 / (3 * 64 + 200), rel=0.05)
    assert (parts[0].bias == 0.1).all()
    bias = torch.cat([layer.bias for layer in elu_head(4, 5, 6) if isinstance(layer, nn.Linear)])
    assert (bias == 0.1).all() and len(bias) == 16
