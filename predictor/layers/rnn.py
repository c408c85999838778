"""LSTM and GRU over masked sequences, differentiable in every way, and single steps of both without gradients.

Both are the textbook cells, written step by step for autograd, so that `torch.func` differentiates them too (planners
need Jacobians of forecasts). `nn.LSTM` returns the cell state of the last step only, roll-outs begin at any step, and
its oneDNN kernel has no forward-mode derivative. Time comes first in memory: a step is one contiguous block. Single
steps work in place; tanh is computed there as 2σ(2x) − 1, several times faster on a CPU and equal up to rounding.
"""

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

_MANY = 2**14
"""Number of elements from which six fast operations take less time than an exponential."""
_MANY_TANH = 2**12
"""Number of elements from which four fast operations take less time than a hyperbolic tangent."""
_BLOCK = 2**17
"""Number of elements that stay in a core's own cache between them."""

Correction = Callable[[int, Tensor], Tensor]
"""Function that computes an addend of the gates from the step's index and the hidden state before it."""


def masked_lstm(
    gates: Float[Tensor, "batch time agents slots gates"],
    recurrent: nn.Linear,
    pairs: Bool[Tensor, "batch time agents slots"],
    hidden: Float[Tensor, "batch agents slots rnn"],
    cell: Float[Tensor, "batch agents slots rnn"],
    reverse: bool = False,
    correct: Correction | None = None,
) -> tuple[Float[Tensor, "batch time agents slots rnn"], Float[Tensor, "batch time agents slots rnn"]]:
    """Runs an LSTM for each pair, from gate inputs of all steps; the memory of an absent pair is set to zero.

    Args:
        gates: input share of the gates (input, forget, candidate, output).
        recurrent: layer from the hidden state to the gates.
        pairs: which pairs are present.
        hidden: hidden state before the first step (after the last one, if reversed).
        cell: cell state at the same step.
        reverse: whether to run from the last step to the first.
        correct: function that computes an addend of the gates.

    Returns:
        Hidden and cell state after each step; views, whose memory has time first.
    """
    assert correct is None or not reverse  # corrections are computed for the steps in their order only
    with full_precision(gates.device):
        steps = list(zip(_steps(gates), _steps(pairs[..., None].to(gates.dtype)), strict=True))
        h, c = hidden.flatten(0, -2), cell.flatten(0, -2)
        hiddens, cells = [], []
        for t, (gate, present) in enumerate(reversed(steps) if reverse else steps):
            if correct is not None:
                gate = gate + correct(t, h.view_as(hidden)).flatten(0, -2)
            h, c = _lstm_step(gate, present, recurrent.weight, h, c)
            hiddens.append(h)
            cells.append(c)
    if reverse:
        hiddens.reverse()
        cells.reverse()
    return _sequence(hiddens, hidden), _sequence(cells, hidden)


def masked_gru(
    inputs: Float[Tensor, "batch time agents inputs"],
    cell: nn.GRUCell,
    valid: Bool[Tensor, "batch time agents"],
    hidden: Float[Tensor, "batch agents hidden"],
) -> Float[Tensor, "batch time agents hidden"]:
    """Runs a `GRUCell` for each agent and returns its state after each step; that of an absent agent is set to zero.

    Args:
        inputs: inputs of the cell.
        cell: cell with the weights.
        valid: which agents are present.
        hidden: state before the first step.
    """
    if not inputs.shape[1]:
        return hidden.new_zeros(len(hidden), 0, *hidden.shape[1:])
    states, state = [], hidden.flatten(0, -2)
    with full_precision(inputs.device):
        for step, present in zip(_steps(inputs), _steps(valid[..., None].to(hidden.dtype)), strict=True):
            state = cell(step.to(hidden.dtype), state) * present
            states.append(state)
    return _sequence(states, hidden)


def full_precision(device: torch.device) -> AbstractContextManager[object]:
    """Turns autocast off: rounding errors of recurrences add up over many steps, and CUDA's rounds their cells."""
    if not torch.amp.is_autocast_available(device.type) or not torch.is_autocast_enabled(device.type):
        return nullcontext()
    return torch.autocast(device.type, enabled=False)


def lstm_step_(
    gates: Float[Tensor, "pairs gates"], cell: Float[Tensor, "pairs rnn"]
) -> tuple[Float[Tensor, "pairs rnn"], Float[Tensor, "pairs rnn"]]:
    """Computes hidden and cell state after one step; `gates` (input and recurrent share) is overwritten."""
    _squash(gates)
    i, f, s, o = gates.chunk(4, dim=-1)
    cell = f.mul(cell).addcmul_(i, s, value=2).sub_(i)
    return _tanh(cell).mul_(o), cell


def gru_step_(
    gates: Float[Tensor, "*agents gates"],
    share: Float[Tensor, "*#agents gates"],
    hidden: Float[Tensor, "*#agents hidden"],
) -> Float[Tensor, "*agents hidden"]:
    """Computes a GRU's state after one step; `gates` (the input's share) is overwritten, `share` is the state's."""
    width = hidden.shape[-1]
    gates[..., : 2 * width].add_(share[..., : 2 * width]).sigmoid_()
    r, z, u = gates.chunk(3, dim=-1)
    n = u.addcmul_(r, share[..., 2 * width :]).mul_(2).sigmoid_().mul_(2).sub_(1)
    return torch.lerp(n, hidden, z)


def elu_(x: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Computes ELU in place; for many numbers on a CPU as x⁺ + 1/σ(−x⁻) − 2 (σ: logistic), which is a fifth faster."""
    if x.device.type != "cpu" or x.numel() < _MANY or not x.is_contiguous():
        return torch.nn.functional.elu_(x)
    for part in x.view(-1).split(_BLOCK):
        below = part.clamp(max=0).neg_().sigmoid_().reciprocal_()
        part.clamp_(min=0).add_(below).sub_(2)
    return x


def elu(x: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Computes ELU like `elu_`, not in place."""
    return torch.nn.functional.elu(x) if x.numel() < _MANY else elu_(x.clone())


def _tanh(x: Tensor) -> Tensor:
    """Computes tanh; of many numbers on a CPU with the logistic function."""
    if x.device.type != "cpu" or x.numel() < _MANY_TANH:
        return torch.tanh(x)
    return x.mul(2).sigmoid_().mul_(2).sub_(1)


def _squash(gates: Tensor) -> None:
    """Computes σ of input, forget and output gate, and σ(2·) of the candidate, in place."""
    rnn = gates.shape[-1] // 4
    gates[:, 2 * rnn : 3 * rnn].mul_(2)
    gates.sigmoid_()


def _lstm_step(gate: Tensor, present: Tensor, weight: Tensor, hidden: Tensor, cell: Tensor) -> tuple[Tensor, Tensor]:
    """Computes hidden and cell state after one step, zero where absent; `gate` is the input's share."""
    i, f, g, o = torch.addmm(gate.to(hidden.dtype), hidden, weight.t()).chunk(4, dim=-1)
    cell = torch.addcmul(torch.sigmoid(f) * cell, torch.sigmoid(i), torch.tanh(g)) * present
    return torch.sigmoid(o) * torch.tanh(cell), cell  # 0 where the cell is


def _steps(sequence: Tensor) -> tuple[Tensor, ...]:
    """Returns each time step, with agents or pairs in one list."""
    # unbind, not [t]: the gradient of an index is a full-size tensor of zeros for every step
    return sequence.transpose(0, 1).flatten(1, -2).unbind(0)


def _sequence(steps: list[Tensor], like: Tensor) -> Tensor:
    """Joins steps, batch first in shape and time first in memory."""
    return torch.stack(steps).unflatten(1, like.shape[:-1]).transpose(0, 1)
