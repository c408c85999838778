"""The NRI family written out for one scene, pair by pair, with the weights of a model: slow, and easy to check."""

import torch
from torch import Tensor, nn
from torch.nn import functional

from predictor.baselines.nri_blocks import FrameEncoder, HiddenDecoder, PairLSTM
from predictor.layers.pairs import PairLinear

Pair = tuple[int, int]


def present(valid: Tensor) -> list[int]:
    return [i for i, here in enumerate(valid.tolist()) if here]


def pairs_of(valid: Tensor) -> list[Pair]:
    """(receiver, sender) of all present agents."""
    return [(i, j) for i in present(valid) for j in present(valid) if i != j]


def joined(layer: PairLinear, receiver: Tensor, sender: Tensor, part: slice = slice(None)) -> Tensor:
    """The layer as one matrix on the concatenation."""
    matrix = torch.cat([layer.receiver.weight, layer.sender.weight], dim=1)[part]
    return matrix @ torch.cat([receiver, sender]) + layer.receiver.bias[part]


def embed(encoder: FrameEncoder, inputs: Tensor, valid: Tensor) -> dict[Pair, Tensor]:
    """Embedding of each present pair in one frame."""
    nodes = {i: encoder.node(inputs[i]) for i in present(valid)}
    first = {
        (i, j): functional.elu(encoder.pair_out(functional.elu(joined(encoder.pair, nodes[i], nodes[j]))))
        for i, j in pairs_of(valid)
    }
    again, others = {}, max(len(nodes) - 1, 1)
    for i in nodes:
        incoming = sum((first[i, j] for j in nodes if j != i), inputs.new_zeros(encoder.pair_out.out_features))
        again[i] = encoder.again_node(incoming / others)
    return {
        (i, j): functional.elu(
            encoder.again_out(
                functional.elu(joined(encoder.again_pair, again[i], again[j]) + encoder.again_skip.weight @ first[i, j])
            )
        )
        for i, j in pairs_of(valid)
    }


def lstm_of_pairs(
    rnn: PairLSTM, embeddings: list[dict[Pair, Tensor]], reverse: bool = False
) -> list[dict[Pair, Tensor]]:
    """Hidden state of each present pair after each step, by torch's own cell; absence means starting anew."""
    kind = rnn.inputs.weight.dtype
    cell = nn.LSTMCell(rnn.inputs.in_features, rnn.hidden.in_features, dtype=kind).requires_grad_(False)
    cell.weight_ih.copy_(rnn.inputs.weight), cell.bias_ih.copy_(rnn.inputs.bias)
    cell.weight_hh.copy_(rnn.hidden.weight), cell.bias_hh.zero_()
    state: dict[Pair, tuple[Tensor, Tensor]] = {}
    hiddens = []
    for frame in embeddings[::-1] if reverse else embeddings:
        state = {pair: cell(x[None], state.get(pair)) for pair, x in frame.items()}
        hiddens.append({pair: hidden[0] for pair, (hidden, _) in state.items()})
    return hiddens[::-1] if reverse else hiddens


def decode(
    decoder: HiddenDecoder, inputs: Tensor, valid: Tensor, weights: dict[Pair, list[float]], hidden: dict[int, Tensor]
) -> dict[int, Tensor]:
    """Memory of each present agent one step on; `weights` has one number per kind of message, ready to be added."""
    width, after = decoder.message_out[0].in_features, {}
    zero = inputs.new_zeros(decoder.readout[0].in_features)
    for i in present(valid):
        messages = inputs.new_zeros(width)
        for j in present(valid):
            for k, out in enumerate(decoder.message_out):
                if i != j:
                    part = slice(k * width, (k + 1) * width)
                    first = joined(decoder.message_pair, hidden.get(i, zero), hidden.get(j, zero), part)
                    messages = messages + weights[i, j][k] * torch.tanh(out(torch.tanh(first)))
        x, m = decoder.input_gates(inputs[i]).chunk(3), decoder.message_gates(messages).chunk(3)
        reset, keep = torch.sigmoid(x[0] + m[0]), torch.sigmoid(x[1] + m[1])
        new = torch.tanh(x[2] + reset * m[2])
        after[i] = (1 - keep) * new + keep * hidden.get(i, zero)
    return after
