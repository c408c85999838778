"""IMMA against a scene-by-scene, pair-by-pair loop, its attention, and training layer by layer."""

import pytest
import torch
from hypothesis import given, settings
from torch import Tensor

from predictor.baselines.imma import IMMA, masked_attention
from predictor.graph import pair_mask
from tests.predictor.baselines import loops
from tests.predictor.baselines.helpers import (
    AGENTS,
    BATCH,
    HORIZON,
    TIME,
    fresh,
    last,
    presence,
    seeds,
    tiny,
)
from tests.predictor.helpers import random_presence, random_states

METRES = {"rtol": 1e-5, "atol": 1e-4}


def attention(
    layer: torch.nn.Module, embeddings: list[dict[loops.Pair, Tensor]], valid: Tensor
) -> dict[loops.Pair, float]:
    """Attention of the latest frame from all frames so far, receiver by receiver."""
    hidden = loops.lstm_of_pairs(layer.rnn, embeddings)[-1]
    weights = {}
    for i in loops.present(valid):
        senders = [j for j in loops.present(valid) if j != i]
        if senders:
            scores = torch.stack([layer.score.weight[0] @ hidden[i, j] for j in senders])
            weights |= {(i, j): w for j, w in zip(senders, scores.softmax(0).tolist(), strict=True)}
    return weights


@pytest.mark.parametrize("kind", ["imma", "imma-dynamic"])
@settings(max_examples=6)
@given(valid=presence(ego=False), seed=seeds)
def test_against_a_loop(kind: str, valid: Tensor, seed: int):
    forecaster, states, now = tiny(kind), random_states(seed, BATCH, TIME, AGENTS, 4), (1, 3)
    window = forecaster.window(states, valid, torch.tensor(now), HORIZON)
    for b in range(BATCH):
        state, present, memory = states[b, 0], valid[b, now[b]], {}
        embeddings: list[list[dict[loops.Pair, Tensor]]] = [[] for _ in forecaster.layers]
        graphs: list[dict[loops.Pair, float]] = []
        for t in range(now[b] + HORIZON):
            observed = t <= now[b]
            frame, here = (states[b, t], valid[b, t]) if observed else (state, present)
            inputs = forecaster.codec.inputs(frame, here)
            if observed or kind == "imma-dynamic":
                for layer, seen in zip(forecaster.layers, embeddings, strict=True):
                    seen.append(loops.embed(layer.frames, inputs, here))
                graphs = [attention(*both, here) for both in zip(forecaster.layers, embeddings, strict=True)]
            weights = {pair: [graph[pair] for graph in graphs] for pair in loops.pairs_of(here)}
            memory = loops.decode(forecaster.decoder, inputs, here, weights, memory)
            change = torch.zeros_like(frame)
            for i, hidden in memory.items():
                change[i] = forecaster.decoder.readout(hidden)
            state = forecaster.codec.advance(frame, change)
            if observed:
                torch.testing.assert_close(window.one_step[b, t][here], state[here], **METRES)
            if t >= now[b]:
                torch.testing.assert_close(window.rollout[b, present, t - now[b]], state[present], **METRES)


# --- Attention --------------------------------------------------------------------------------------------------------


def test_attention_hand_computed():
    scores = torch.tensor([[9.0, 0.0, 0.0], [1.0, 9.0, 1.0 + torch.log(torch.tensor(3.0)).item()], [5.0, 6.0, 7.0]])
    ours = masked_attention(scores, pair_mask(torch.ones(3).bool()))
    last_receiver = torch.tensor([5.0, 6.0]).softmax(0).tolist()
    expected = torch.tensor([[0.0, 0.5, 0.5], [0.25, 0.0, 0.75], [*last_receiver, 0.0]])
    torch.testing.assert_close(ours, expected)
    assert masked_attention(scores, pair_mask(torch.tensor([True, False, True]))).tolist() == [
        [0.0, 0.0, 1.0], [0.0, 0.0, 0.0], [1.0, 0.0, 0.0],
    ]  # fmt: skip


def test_attention_without_senders_is_zero_with_a_finite_gradient():
    scores = torch.randn(2, 3, 3, generator=torch.Generator().manual_seed(0), requires_grad=True)
    weights = masked_attention(scores, pair_mask(torch.tensor([[False] * 3, [True, False, False]])))
    assert not weights.any()
    weights.sum().backward()
    assert torch.isfinite(scores.grad).all()


def test_gradients_of_attention():
    pairs = pair_mask(torch.tensor([True, True, False, True]))
    scores = torch.randn(4, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda s: masked_attention(s, pairs), (scores,))


def test_edge_probabilities_are_shares_of_attention():
    forecaster = tiny("imma-dynamic")
    states, valid = random_states(0, BATCH, TIME, AGENTS, 4), random_presence(0, BATCH, TIME, AGENTS)
    belief = last(forecaster, states, valid)
    senders = pair_mask(valid[:, -1]).any(-1)
    layers = 3 * belief.edge_probs[..., 1:]
    torch.testing.assert_close(layers.sum(-2), senders[..., None].expand(-1, -1, 3).float())  # one per layer
    torch.testing.assert_close(belief.edge_probs[..., 0], 1 - layers.mean(-1))
    assert (layers[..., 0] - layers[..., 1]).abs().max() > 1e-2  # layers differ


def graph_while_forecasting(kind: str, monkeypatch: pytest.MonkeyPatch) -> list[Tensor]:
    forecaster, graphs = tiny(kind), []
    belief = last(forecaster, random_states(0, BATCH, TIME, AGENTS, 4), torch.ones(BATCH, TIME, AGENTS).bool())
    inner = IMMA.recur
    monkeypatch.setattr(
        IMMA, "recur", lambda self, x, v, graph, nodes: graphs.append(graph) or inner(self, x, v, graph, nodes)
    )
    forecaster.rollout(belief, 4)
    return [belief.internal.scores, *graphs]


def test_the_graph_stands_still_unless_asked(monkeypatch: pytest.MonkeyPatch):
    still = graph_while_forecasting("imma", monkeypatch)
    assert len(still) == 4 and all(torch.equal(graph, still[0]) for graph in still)
    moving = graph_while_forecasting("imma-dynamic", monkeypatch)
    assert all(not torch.allclose(a, b, atol=1e-4) for a, b in zip(moving, moving[1:], strict=False))


# --- Training layer by layer ------------------------------------------------------------------------------------------


def gradients(forecaster: IMMA) -> list[bool]:
    """Which layers' encoders get a gradient."""
    forecaster.zero_grad(set_to_none=True)
    states, valid = random_states(0, BATCH, TIME, AGENTS, 4), torch.ones(BATCH, TIME, AGENTS).bool()
    forecaster.window(states, valid, torch.tensor([1, 3]), HORIZON).rollout.square().mean().backward()
    return [any(p.grad is not None and bool(p.grad.any()) for p in layer.parameters()) for layer in forecaster.layers]


def test_every_layer_is_trained():
    assert gradients(fresh("imma-dynamic")) == [True, True, True]


@pytest.mark.slow
def test_overfits_one_batch():
    forecaster, states = fresh("imma"), random_states(0, 2, 5, 3, 4) / 4
    valid, now = torch.ones(2, 5, 3).bool(), torch.full((2,), 2)
    optimizer = torch.optim.Adam(forecaster.parameters(), lr=1e-2)
    losses = []
    for _ in range(120):
        output = forecaster.window(states, valid, now, 2)
        loss = output.one_step[:, :-1].sub(states[:, 1:]).square().mean()
        loss = loss + output.rollout.transpose(1, 2).sub(states[:, 3:]).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < losses[0] / 5
