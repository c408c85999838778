"""The encoder's corrections against a loop over pairs, and gradients of all pairwise blocks against differences."""

from collections.abc import Callable
from dataclasses import replace
from itertools import product

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor, nn
from torch.func import functional_call
from torch.nn import functional

from predictor.dgvae.config import DGVAEConfig
from predictor.dgvae.innovation import Innovation
from predictor.dgvae.networks import Decoder, Encoder
from predictor.graph import pair_mask
from predictor.layers.pairs import PairLinear
from tests.predictor.helpers import precise, random_presence

BATCH, AGENTS, INPUTS, MEMORY, WIDTH = 2, 4, 3, 5, 6


def block(rounds: int, inputs: int = INPUTS, memory: int = MEMORY, width: int = WIDTH) -> Innovation:
    torch.manual_seed(7)
    return Innovation(inputs, memory, width, rounds).double()


def drawn(seed: int, *shape: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def corrections(innovation: Innovation, memory: Tensor, inputs: Tensor, pairs: Tensor) -> Tensor:
    out: Tensor = innovation(memory, *innovation.prepare(inputs, pairs))
    return out


# --- Against a loop ---------------------------------------------------------------------------------------------------


def on_pair(layer: PairLinear, receiver: Tensor, sender: Tensor) -> Tensor:
    """A linear layer on the concatenation of two agents."""
    weight = torch.cat([layer.receiver.weight, layer.sender.weight], dim=1)
    return functional.linear(torch.cat([receiver, sender]), weight, layer.receiver.bias)


def loop(innovation: Innovation, memory: Tensor, inputs: Tensor, pairs: Tensor) -> Tensor:
    """One scene, one pair at a time; pairs that are not there are left out of every sum and get no correction."""
    agents = range(len(inputs))
    regressor = {
        (i, j): on_pair(innovation.regressor_linear, inputs[i], inputs[j])
        + innovation.regressor_out(functional.elu(on_pair(innovation.regressor_pair, inputs[i], inputs[j])))
        for i, j in product(agents, agents)
        if pairs[i, j]
    }
    believed = {pair: memory[pair] for pair in regressor}
    for own, other in zip(innovation.correct_own, innovation.correct_other, strict=True):
        innovations = []
        for i in agents:
            expected = torch.zeros(WIDTH).double()
            for j in agents:
                if (i, j) in regressor:
                    expected = expected + innovation.weigh(believed[i, j]) * regressor[i, j]
            innovations.append(innovation.target(inputs[i]) - expected)
        gradient = {(i, j): regressor[i, j] * innovations[i] for i, j in regressor}
        believed = {(i, j): h + own(gradient[i, j]) + other(gradient[j, i]) for (i, j), h in believed.items()}
    after = torch.zeros_like(memory)
    for pair, value in believed.items():
        after[pair] = value - memory[pair]
    return after


@pytest.mark.parametrize("rounds", [1, 2, 3])
@settings(max_examples=6)
@given(seed=st.integers(0, 2**16), share=st.sampled_from([0.4, 0.7, 1.0]))
def test_against_a_loop(rounds: int, seed: int, share: float):
    innovation = block(rounds)
    inputs, memory = drawn(seed, BATCH, AGENTS, INPUTS), drawn(seed + 1, BATCH, AGENTS, AGENTS, MEMORY)
    pairs = pair_mask(random_presence(seed, BATCH, AGENTS, ego=False, share=share))
    ours = corrections(innovation, memory, inputs, pairs)
    for scene in range(BATCH):
        expected = loop(innovation, memory[scene], inputs[scene], pairs[scene])
        torch.testing.assert_close(ours[scene][pairs[scene]], expected[pairs[scene]], rtol=0, atol=1e-10)


def test_hand_computed():
    """One number for everything: φ = x_i + 2 x_j, τ = 3 x + 1, w(h) = h / 2 + 1 / 4, W = (2 ‖ −1), bias 1 / 8."""
    innovation = block(1, inputs=1, memory=1, width=1)
    fixed = {
        "regressor_linear.receiver": (1.0, 0.0),
        "regressor_linear.sender": (2.0, None),
        "regressor_out": (0.0, 0.0),
        "target": (3.0, 1.0),
        "weigh": (0.5, 0.25),
        "correct_own.0": (2.0, 0.125),
        "correct_other.0": (-1.0, None),
    }
    for name, (weight, bias) in fixed.items():
        layer = innovation.get_submodule(name)
        assert isinstance(layer, nn.Linear)
        layer.weight.data.fill_(weight)
        if bias is not None:
            layer.bias.data.fill_(bias)
    inputs, memory = torch.tensor([[[1.0], [2.0]]]).double(), torch.zeros(1, 2, 2, 1).double()
    memory[0, 0, 1], memory[0, 1, 0] = 4.0, -2.0
    ours = corrections(innovation, memory, inputs, pair_mask(torch.ones(1, 2).bool()))
    # agent 0: φ = 5, w = 2.25, ε = 4 − 11.25 = −7.25, φ ε = −36.25; agent 1: φ = 4, w = −0.75, ε = 7 + 3 = 10, φ ε = 40
    assert ours[0, 0, 1].item() == pytest.approx(2 * -36.25 - 40 + 0.125)
    assert ours[0, 1, 0].item() == pytest.approx(2 * 40 + 36.25 + 0.125)


# --- What is masked ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rounds", [1, 2])
def test_masked_pairs_contribute_nothing(rounds: int):
    """Whatever an absent agent shows and whatever its pairs remember, no other memory changes; nor do copies of
    oneself."""
    innovation = block(rounds)
    valid = torch.tensor([[True, True, False, True], [True, False, False, True]])
    pairs = pair_mask(valid)
    inputs, memory = drawn(0, BATCH, AGENTS, INPUTS), drawn(1, BATCH, AGENTS, AGENTS, MEMORY)
    littered_inputs = torch.where(valid[..., None], inputs, 1e3)
    littered_memory = torch.where(pairs[..., None], memory, -1e3)
    plain, littered = (
        corrections(innovation, m, x, pairs) for m, x in ((memory, inputs), (littered_memory, littered_inputs))
    )
    assert torch.equal(plain[pairs], littered[pairs])


def test_who_is_alone_expects_nothing():
    innovation = block(1)
    pairs = pair_mask(torch.tensor([[True, False, False, False]]))
    regressors, targets = innovation.prepare(drawn(0, 1, AGENTS, INPUTS), pairs)
    assert not regressors.any() and targets.any()


def test_what_the_others_explain_is_not_explained_again():
    """A pair's correction depends on what the receiver's other pairs remember: that is what the block is for."""
    innovation, pairs = block(1), pair_mask(torch.ones(1, AGENTS).bool())
    inputs, memory = drawn(0, 1, AGENTS, INPUTS), drawn(1, 1, AGENTS, AGENTS, MEMORY)
    other = memory.clone()
    other[0, 0, 2] += 1.0
    one, two = (corrections(innovation, m, inputs, pairs) for m in (memory, other))
    assert (one[0, 0, 1] - two[0, 0, 1]).abs().max() > 1e-3  # same receiver
    assert (one[0, 1, 0] - two[0, 1, 0]).abs().max() > 1e-3  # told the other way round
    assert torch.equal(one[0, 1, 3], two[0, 1, 3])  # another receiver, another sender


def test_corrections_enter_the_gates_of_the_forward_lstm():
    """The encoder's LSTM with corrections is a plain cell whose gates get them added, step by step."""
    encoder = precise("rich").encoder
    valid = random_presence(0, BATCH, 3, AGENTS)
    pairs = pair_mask(valid)
    inputs = drawn(0, BATCH, 3, AGENTS, encoder.embed.in_features)
    hidden = cell = torch.zeros(BATCH, AGENTS, AGENTS, 5).double()
    edges = encoder(inputs, pairs, hidden, cell)
    for t in range(3):
        embedding = encoder.edge_out(encoder.embed_edges(inputs[:, t], pairs[:, t]))
        gates = encoder.forward_input(embedding) + encoder.forward_hidden(hidden)
        added = encoder.innovation_gates(corrections(encoder.innovation, hidden, inputs[:, t], pairs[:, t]))
        assert added.abs().max() > 1e-2
        i, f, g, o = (gates + added).chunk(4, dim=-1)
        cell = (f.sigmoid() * cell + i.sigmoid() * g.tanh()) * pairs[:, t, ..., None]
        hidden = o.sigmoid() * cell.tanh() * pairs[:, t, ..., None]
        torch.testing.assert_close(edges.hidden[:, t], hidden, rtol=0, atol=1e-12)


# --- Gradients --------------------------------------------------------------------------------------------------------

SMALL = DGVAEConfig(2, 2, 2, 2, 2, num_edge_types=3, edge_feature_dim=2)
THREE = pair_mask(torch.tensor([True, True, False, True]))  # one of four is not there


def check_gradients(module: nn.Module, call: Callable[..., Tensor], *inputs: Tensor) -> None:
    """`torch.autograd.gradcheck` with respect to the inputs and to every weight that the call uses."""
    named = dict(module.named_parameters())
    used = torch.autograd.grad(call(*inputs).sum(), list(named.values()), allow_unused=True)
    names = [name for name, gradient in zip(named, used, strict=True) if gradient is not None]
    assert names

    class Called(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.module = module

        def forward(self, *arguments: Tensor) -> Tensor:
            return call(*arguments)

    def of_everything(*arguments: Tensor) -> Tensor:
        weights = {f"module.{n}": w for n, w in zip(names, arguments[len(inputs) :], strict=True)}
        out: Tensor = functional_call(Called(), weights, arguments[: len(inputs)])
        return out

    leaves = [t.detach().clone().requires_grad_() for t in (*inputs, *(named[n] for n in names))]
    assert torch.autograd.gradcheck(of_everything, tuple(leaves))


@pytest.mark.parametrize("rounds", [1, 2])
def test_gradients_of_the_corrections(rounds: int):
    innovation = block(rounds, inputs=2, memory=2, width=2)
    memory, inputs = drawn(0, 1, 4, 4, 2), drawn(1, 1, 4, 2)
    check_gradients(innovation, lambda m, x: corrections(innovation, m, x, THREE[None])[:, THREE], memory, inputs)


def test_gradients_of_the_graph_block():
    torch.manual_seed(0)
    encoder = Encoder(SMALL, 2).double()
    check_gradients(encoder, lambda x: encoder.embed_edges(x, THREE), drawn(0, 4, 2))


@pytest.mark.parametrize("gated", [False, True], ids=["plain", "gated"])
def test_gradients_of_messages(gated: bool):
    torch.manual_seed(0)
    decoder = Decoder(replace(SMALL, gated_messages=gated), 2, 4).double()
    graph = torch.softmax(drawn(1, 4, 4, 3), dim=-1)
    check_gradients(decoder, lambda x, z, e: decoder.messages(x, THREE, z, e), drawn(0, 4, 2), graph, drawn(2, 4, 4, 2))


def test_gated_messages_against_a_loop():
    """Σ_j Σ_k z_ijk W_k (elu(V_k (x_i ‖ x_j)) ⊙ (1 + U_k e_ij)): without features, messages are the plain ones."""
    torch.manual_seed(0)
    decoder = Decoder(replace(SMALL, gated_messages=True), 2, 4).double()
    inputs, features = drawn(0, 4, 2), drawn(2, 4, 4, 2)
    graph = torch.softmax(drawn(1, 4, 4, 3), dim=-1)
    messages = decoder.messages(inputs, THREE, graph, features)
    for i in range(4):
        expected = decoder.own(inputs[i])
        for j, k in product(range(4), (1, 2)):
            if THREE[i, j]:
                part = slice(2 * (k - 1), 2 * k)
                curved = functional.elu(on_pair(decoder.message_pair, inputs[i], inputs[j]))
                curved = (curved * (1 + decoder.message_feature(features[i, j])))[part]
                second = functional.linear(curved, decoder.message_out.weight[part], decoder.message_out.bias[part])
                expected = expected + graph[i, j, k] * second
        torch.testing.assert_close(messages[i], expected, rtol=0, atol=1e-12)
    plain = Decoder(SMALL, 2, 4).double()
    plain.load_state_dict(decoder.state_dict())
    silent = torch.zeros_like(features)
    assert torch.equal(decoder.messages(inputs, THREE, graph, silent), plain.messages(inputs, THREE, graph, silent))
