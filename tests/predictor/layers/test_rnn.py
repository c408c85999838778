"""Masked LSTM and GRU: values against torch's own cells, gradients against autograd and finite differences."""

from collections.abc import Callable
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor, nn

from predictor.graph import pair_mask
from predictor.layers.rnn import lstm_step_, masked_gru, masked_lstm
from tests.predictor.helpers import random_presence

BATCH, TIME, AGENTS, RNN, WIDTH = 2, 5, 3, 4, 6
EXACT = {"rtol": 0.0, "atol": 1e-12}


def draw(seed: int, *shape: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(*shape, generator=generator, dtype=torch.float64).requires_grad_()


def plain_lstm(
    gates: Tensor, weight: Tensor, pairs: Tensor, hidden: Tensor, cell: Tensor, reverse: bool
) -> tuple[Tensor, Tensor]:
    hiddens, cells = {}, {}
    for t in reversed(range(TIME)) if reverse else range(TIME):
        i, f, g, o = (gates[:, t] + hidden @ weight.T).chunk(4, dim=-1)
        cell = (f.sigmoid() * cell + i.sigmoid() * g.tanh()) * pairs[:, t, ..., None]
        hidden = o.sigmoid() * cell.tanh() * pairs[:, t, ..., None]
        hiddens[t], cells[t] = hidden, cell
    return tuple(torch.stack([values[t] for t in range(TIME)], dim=1) for values in (hiddens, cells))  # type: ignore[return-value]


def plain_gru(inputs: Tensor, cell: nn.GRUCell, valid: Tensor, hidden: Tensor) -> Tensor:
    states = []
    for t in range(inputs.shape[1]):
        after = cell(inputs[:, t].flatten(0, 1), hidden.flatten(0, 1)).view_as(hidden)
        hidden = after * valid[:, t, :, None]
        states.append(hidden)
    return torch.stack(states, dim=1)


def lstm_case(seed: int, share: float) -> tuple[list[Tensor], nn.Linear, Tensor]:
    recurrent = nn.Linear(RNN, 4 * RNN, bias=False).double()
    recurrent.weight.data = draw(seed, 4 * RNN, RNN).data
    gates = draw(seed + 1, BATCH, TIME, AGENTS, AGENTS, 4 * RNN)
    before = [draw(seed + 2 + k, BATCH, AGENTS, AGENTS, RNN) for k in range(2)]
    return [gates, *before], recurrent, pair_mask(random_presence(seed, BATCH, TIME, AGENTS, ego=False, share=share))


def gradients(outputs: Any, inputs: list[Tensor]) -> list[Tensor]:
    """Of a weighted sum of all outputs, each entry with a weight of its own."""
    total = sum((out * torch.arange(out.numel(), dtype=out.dtype).view(out.shape).cos()).sum() for out in outputs)
    return list(torch.autograd.grad(total, inputs))


@pytest.mark.parametrize("reverse", [False, True], ids=["forward", "reverse"])
@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 2**16), share=st.sampled_from([0.5, 0.9, 1.0]))
def test_lstm_and_its_gradients_are_those_of_autograd(reverse: bool, seed: int, share: float):
    inputs, recurrent, pairs = lstm_case(seed, share)
    gates, hidden, cell = inputs
    ours = masked_lstm(gates, recurrent, pairs, hidden, cell, reverse)
    plain = plain_lstm(gates, recurrent.weight, pairs, hidden, cell, reverse)
    torch.testing.assert_close(ours, plain, **EXACT)
    wrt = [*inputs, recurrent.weight]
    torch.testing.assert_close(gradients(ours, wrt), gradients(plain, wrt), **EXACT)


def test_a_correction_of_zero_changes_neither_values_nor_gradients():
    inputs, recurrent, pairs = lstm_case(0, 0.8)
    gates, hidden, cell = inputs
    ours = masked_lstm(gates, recurrent, pairs, hidden, cell)
    corrected = masked_lstm(
        gates, recurrent, pairs, hidden, cell, correct=lambda _, h: torch.zeros_like(h).repeat(1, 1, 1, 4)
    )
    torch.testing.assert_close(ours, corrected, **EXACT)
    wrt = [*inputs, recurrent.weight]
    torch.testing.assert_close(gradients(ours, wrt), gradients(corrected, wrt), **EXACT)


def test_corrections_see_the_step_and_the_memory_before_it():
    inputs, recurrent, pairs = lstm_case(0, 1.0)
    gates, hidden, cell = inputs
    seen: list[tuple[int, Tensor]] = []

    def correct(t: int, before: Tensor) -> Tensor:
        seen.append((t, before))
        return torch.zeros(*before.shape[:-1], 4 * RNN, dtype=before.dtype)

    hiddens, _ = masked_lstm(gates, recurrent, pairs, hidden, cell, correct=correct)
    assert [t for t, _ in seen] == list(range(TIME))
    torch.testing.assert_close(seen[0][1], hidden, **EXACT)
    torch.testing.assert_close(seen[3][1], hiddens[:, 2], **EXACT)


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 2**16), share=st.sampled_from([0.5, 0.9, 1.0]))
def test_gru_and_its_gradients_are_those_of_the_cell(seed: int, share: float):
    torch.manual_seed(seed)
    cell = nn.GRUCell(WIDTH, RNN).double()
    inputs, hidden = draw(seed, BATCH, TIME, AGENTS, WIDTH), draw(seed + 1, BATCH, AGENTS, RNN)
    valid = random_presence(seed, BATCH, TIME, AGENTS, ego=False, share=share)
    ours, plain = masked_gru(inputs, cell, valid, hidden), plain_gru(inputs, cell, valid, hidden)
    torch.testing.assert_close(ours, plain, **EXACT)
    wrt = [inputs, hidden, *cell.parameters()]
    torch.testing.assert_close(gradients([ours], wrt), gradients([plain], wrt), **EXACT)


def test_gru_over_no_steps():
    states = masked_gru(
        torch.zeros(BATCH, 0, AGENTS, WIDTH),
        nn.GRUCell(WIDTH, RNN),
        torch.zeros(BATCH, 0, AGENTS, dtype=torch.bool),
        torch.zeros(BATCH, AGENTS, RNN),
    )
    assert states.shape == (BATCH, 0, AGENTS, RNN)


def test_one_step_in_place_is_the_first_of_many():
    inputs, recurrent, pairs = lstm_case(3, 1.0)
    gates, hidden, cell = (x.detach() for x in inputs)
    hiddens, cells = masked_lstm(gates[:, :1], recurrent, torch.ones_like(pairs[:, :1]), hidden, cell)
    step = gates[:, 0].flatten(0, 2) + hidden.flatten(0, 2) @ recurrent.weight.T
    h, c = lstm_step_(step.detach(), cell.flatten(0, 2))
    torch.testing.assert_close((h.view_as(hidden), c.view_as(cell)), (hiddens[:, 0], cells[:, 0]), **EXACT)


@pytest.mark.parametrize("layout", [lambda t: t, lambda t: t.transpose(0, 1).contiguous().transpose(0, 1)])
def test_memory_layout_changes_nothing(layout: Callable[[Tensor], Tensor]):
    inputs, recurrent, pairs = lstm_case(1, 0.8)
    gates, hidden, cell = inputs
    ours = masked_lstm(layout(gates), recurrent, layout(pairs), hidden, cell)
    torch.testing.assert_close(ours, masked_lstm(gates, recurrent, pairs, hidden, cell), **EXACT)


@pytest.mark.parametrize(
    "correct", [None, lambda _, h: torch.zeros(*h.shape[:-1], 4 * RNN)], ids=["plain", "corrected"]
)
def test_recurrences_are_not_rounded_under_autocast(correct: Any):
    inputs, recurrent, pairs = lstm_case(0, 0.8)
    gates, hidden, cell = (x.detach().float() for x in inputs)
    recurrent, rnn = recurrent.float(), nn.GRUCell(WIDTH, RNN)
    sequence, valid, state = draw(3, BATCH, TIME, AGENTS, WIDTH).detach().float(), pairs.any(-1), hidden[:, :, 0]
    expected = *masked_lstm(gates, recurrent, pairs, hidden, cell), masked_gru(sequence, rnn, valid, state)
    with torch.autocast("cpu", torch.bfloat16):
        found = (
            *masked_lstm(gates, recurrent, pairs, hidden, cell, correct=correct),
            masked_gru(sequence, rnn, valid, state),
        )
        rounded = masked_lstm(gates.bfloat16(), recurrent, pairs, hidden, cell)[0]
    for ours, exact in zip(found, expected, strict=True):
        assert torch.equal(ours, exact)
    assert rounded.dtype is torch.float32 and not torch.equal(rounded, expected[0])  # inputs may be rounded before
