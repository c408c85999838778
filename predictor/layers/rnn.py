"""LSTM and GRU over masked sequences, with gradients written by hand.

Both are the textbook cells. Autograd would keep and clear a dozen temporaries per step; here each step is one matrix
product and a few in-place operations, all weight gradients are one product at the end, and what the backward pass needs
is kept in one array per kind. tanh is taken from the logistic function, 2σ(2x) − 1, which is several times faster on a
CPU and the same up to rounding. Time comes first in memory: a step is one contiguous block.
"""

from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

_MANY = 2**15
"""Numbers from which six fast operations beat a slow one."""

Correction = Callable[[int, Tensor], Tensor]
"""What else to add to the gates, given the step and the hidden state before it."""


def masked_lstm(
    gates: Float[Tensor, "batch time agents slots gates"],
    recurrent: nn.Linear,
    pairs: Bool[Tensor, "batch time agents slots"],
    hidden: Float[Tensor, "batch agents slots rnn"],
    cell: Float[Tensor, "batch agents slots rnn"],
    reverse: bool = False,
    correct: Correction | None = None,
) -> tuple[Float[Tensor, "batch time agents slots rnn"], Float[Tensor, "batch time agents slots rnn"]]:
    """An LSTM for each pair, from gate inputs of all steps; a pair that is not there has its memory set to zero.

    Args:
        gates: input share of the gates (input, forget, candidate, output).
        recurrent: hidden state to gates.
        pairs: which pairs are there.
        hidden: before the first step (after the last one, if reversed).
        cell: likewise.
        reverse: run from the last step to the first.
        correct: what else to add to the gates, given the step and the hidden state before it.

    Returns:
        Hidden and cell state after each step; views, whose memory has time first.
    """
    assert correct is None or not reverse  # corrections know the steps in their order only
    time_first, width = gates.transpose(0, 1), gates.shape[-1]
    steps = time_first.reshape(len(time_first), -1, width)
    present = pairs.transpose(0, 1).reshape(len(steps), -1, 1).to(gates.dtype)
    before = (hidden.reshape(-1, width // 4), cell.reshape(-1, width // 4))
    if correct is None:
        hiddens, cells = _LSTM.apply(steps, recurrent.weight, present, *before, reverse)
    else:
        hiddens, cells = _corrected_lstm(steps, recurrent, present, *before, correct, hidden.shape)
    shape = (*time_first.shape[:-1], width // 4)
    return hiddens.view(shape).transpose(0, 1), cells.view(shape).transpose(0, 1)


def masked_gru(
    inputs: Float[Tensor, "batch time agents inputs"],
    cell: nn.GRUCell,
    valid: Bool[Tensor, "batch time agents"],
    hidden: Float[Tensor, "batch agents hidden"],
) -> Float[Tensor, "batch time agents hidden"]:
    """States of a `GRUCell` for each agent after each step; an absent agent has its memory set to zero.

    Args:
        inputs: of the cell.
        cell: its weights.
        valid: who is there.
        hidden: before the first step.
    """
    time_first = inputs.transpose(0, 1)
    if not len(time_first):
        return hidden.new_zeros(len(hidden), 0, *hidden.shape[1:])
    gates = nn.functional.linear(time_first, cell.weight_ih, cell.bias_ih)
    steps = gates.reshape(len(gates), -1, gates.shape[-1])
    present = valid.transpose(0, 1).reshape(len(gates), -1, 1).to(gates.dtype)
    before = hidden.reshape(-1, hidden.shape[-1])
    states: Tensor = _GRU.apply(steps, cell.weight_hh, cell.bias_hh, present, before)
    return states.view(*time_first.shape[:-1], -1).transpose(0, 1)


def lstm_step_(
    gates: Float[Tensor, "pairs gates"], cell: Float[Tensor, "pairs rnn"]
) -> tuple[Float[Tensor, "pairs rnn"], Float[Tensor, "pairs rnn"]]:
    """Hidden and cell state after one step; `gates` (input and recurrent share) is overwritten."""
    _squash(gates)
    i, f, s, o = gates.chunk(4, dim=-1)
    cell = f.mul(cell).addcmul_(i, s, value=2).sub_(i)
    return _tanh(cell).mul_(o), cell


def gru_step_(
    gates: Float[Tensor, "agents gates"], share: Float[Tensor, "agents gates"], hidden: Float[Tensor, "agents hidden"]
) -> Float[Tensor, "agents hidden"]:
    """State of a GRU after one step; `gates` (the input's share) is overwritten, `share` is the hidden state's."""
    width = hidden.shape[-1]
    gates[:, : 2 * width].add_(share[:, : 2 * width]).sigmoid_()
    r, z, u = gates.chunk(3, dim=-1)
    n = u.addcmul_(r, share[:, 2 * width :]).mul_(2).sigmoid_().mul_(2).sub_(1)
    return torch.lerp(n, hidden, z)


def elu_(x: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """ELU in place; of many numbers on a CPU from the logistic function, x⁺ + 1/σ(−x⁻) − 2: a third faster there."""
    if x.device.type != "cpu" or x.numel() < _MANY:
        return torch.nn.functional.elu_(x)
    below = x.clamp(max=0).neg_().sigmoid_().reciprocal_()
    return x.clamp_(min=0).add_(below).sub_(2)


def elu(x: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """The same, not in place."""
    if x.device.type != "cpu" or x.numel() < _MANY:
        return torch.nn.functional.elu(x)
    return x.clamp(min=0).add_(x.clamp(max=0).neg_().sigmoid_().reciprocal_()).sub_(2)


def _tanh(x: Tensor) -> Tensor:
    """tanh; of many numbers on a CPU from the logistic function."""
    if x.device.type != "cpu" or x.numel() < _MANY:
        return torch.tanh(x)
    return x.mul(2).sigmoid_().mul_(2).sub_(1)


def _squash(gates: Tensor) -> None:
    """σ of input, forget and output, and σ(2·) of the candidate, in place."""
    rnn = gates.shape[-1] // 4
    gates[:, 2 * rnn : 3 * rnn].mul_(2)
    gates.sigmoid_()


def _corrected_lstm(
    steps: Tensor,
    recurrent: nn.Linear,
    present: Tensor,
    hidden: Tensor,
    cell: Tensor,
    correct: Correction,
    shape: torch.Size,
) -> tuple[Tensor, Tensor]:
    """The LSTM of `_LSTM` by autograd, since a correction may be anything."""
    hiddens, cells = [], []
    # unbind, not [t]: the gradient of an index is a full-size tensor of zeros for every step
    for t, (gate, there) in enumerate(zip(steps.unbind(0), present.unbind(0), strict=True)):
        gate = gate + recurrent(hidden) + correct(t, hidden.view(shape)).reshape(gate.shape)
        i, f, g, o = gate.chunk(4, dim=-1)
        cell = (torch.sigmoid(f) * cell + torch.sigmoid(i) * torch.tanh(g)) * there
        hidden = torch.sigmoid(o) * torch.tanh(cell)  # 0 where the cell is
        hiddens.append(hidden)
        cells.append(cell)
    return torch.stack(hiddens), torch.stack(cells)


def _full_precision_forward(function: Callable[..., Any]) -> Callable[..., Any]:
    """Recurrences add up over many steps, so that autocast leaves them alone."""
    for device in ("cpu", "cuda"):
        function = torch.amp.custom_fwd(function, device_type=device, cast_inputs=torch.float32)
    return function


def _full_precision_backward(function: Callable[..., Any]) -> Callable[..., Any]:
    for device in ("cpu", "cuda"):
        function = torch.amp.custom_bwd(function, device_type=device)
    return function


class _LSTM(torch.autograd.Function):
    """gates (T, P, 4R), weight (4R, R), present (T, P, 1), hidden and cell (P, R) → hiddens and cells (T, P, R)."""

    @staticmethod
    @_full_precision_forward
    def forward(
        ctx: Any, gates: Tensor, weight: Tensor, present: Tensor, hidden: Tensor, cell: Tensor, reverse: bool
    ) -> tuple[Tensor, Tensor]:
        acts = torch.empty_like(gates)
        hiddens, cells, squashed = (gates.new_empty(*gates.shape[:2], weight.shape[1]) for _ in range(3))
        h, c, matrix = hidden, cell, weight.t()
        for t in _order(len(gates), reverse):
            _squash(torch.addmm(gates[t], h, matrix, out=acts[t]))
            i, f, s, o = acts[t].chunk(4, dim=-1)
            c = torch.mul(f, c, out=cells[t]).addcmul_(i, s, value=2).sub_(i).mul_(present[t])
            q = torch.mul(c, 2, out=squashed[t]).sigmoid_()
            h = torch.mul(o, q, out=hiddens[t]).mul_(2).sub_(o)
        ctx.save_for_backward(acts, hiddens, cells, squashed, weight, present, hidden, cell)
        ctx.reverse = reverse
        return hiddens, cells

    @staticmethod
    @once_differentiable
    @_full_precision_backward
    def backward(ctx: Any, grad_hiddens: Tensor, grad_cells: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        acts, hiddens, cells, squashed, weight, present, hidden, cell = ctx.saved_tensors
        order = list(_order(len(acts), ctx.reverse))
        grads = torch.empty_like(acts)
        dh, dc = torch.zeros_like(hidden), torch.zeros_like(cell)
        for k in reversed(range(len(order))):
            t = order[k]
            before = cells[order[k - 1]] if k else cell
            dh.add_(grad_hiddens[t])
            dc.add_(grad_cells[t])
            dc = _lstm_backward_(grads[t], acts[t], squashed[t], before, present[t], dh, dc)
            torch.mm(grads[t], weight, out=dh)
        later, earlier = (slice(None, -1), slice(1, None)) if ctx.reverse else (slice(1, None), slice(None, -1))
        dw = grads[order[0]].t() @ hidden
        dw.addmm_(grads[later].flatten(0, 1).t(), hiddens[earlier].flatten(0, 1))
        return grads, dw, None, dh, dc, None


def _lstm_backward_(
    grad: Tensor, act: Tensor, squashed: Tensor, before: Tensor, present: Tensor, dh: Tensor, dc: Tensor
) -> Tensor:
    """Fill the gradient of one step's gates; the gradient of the cell before it. `dc` is used up."""
    i, f, s, o = act.chunk(4, dim=-1)
    di, df, ds, do = grad.chunk(4, dim=-1)
    tanh = squashed.mul(2).sub_(1)
    torch.mul(dh, tanh, out=do)
    slope = tanh.square_().neg_().add_(1).mul_(o)  # ∂h/∂c
    dc.addcmul_(dh, slope).mul_(present)
    torch.mul(dc, s, out=di).mul_(2).sub_(dc)
    torch.mul(dc, before, out=df)
    torch.mul(dc, i, out=ds).mul_(4)  # the candidate is 2σ(2·) − 1
    dc.mul_(f)
    grad.mul_(torch.addcmul(act, act, act, value=-1))
    return dc


class _GRU(torch.autograd.Function):
    """gates (T, P, 3D), weight (3D, D), bias (3D), present (T, P, 1), hidden (P, D) → states (T, P, D)."""

    @staticmethod
    @_full_precision_forward
    def forward(ctx: Any, gates: Tensor, weight: Tensor, bias: Tensor, present: Tensor, hidden: Tensor) -> Tensor:
        width = weight.shape[1]
        own = torch.empty_like(gates)  # the hidden state's share
        acts = torch.empty_like(gates)  # σ of reset and update, σ(2·) of the candidate
        states = gates.new_empty(*gates.shape[:2], width)
        h = hidden
        for t in range(len(gates)):
            share, act = torch.addmm(bias, h, weight.t(), out=own[t]), acts[t]
            torch.add(gates[t, :, : 2 * width], share[:, : 2 * width], out=act[:, : 2 * width]).sigmoid_()
            r, z, s = act.chunk(3, dim=-1)
            torch.addcmul(gates[t, :, 2 * width :], r, share[:, 2 * width :], out=s).mul_(2).sigmoid_()
            n = s.mul(2).sub_(1)
            h = torch.lerp(n, h, z, out=states[t]).mul_(present[t])
        ctx.save_for_backward(own, acts, states, weight, present, hidden)
        return states

    @staticmethod
    @once_differentiable
    @_full_precision_backward
    def backward(ctx: Any, grad_states: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        own, acts, states, weight, present, hidden = ctx.saved_tensors
        width = weight.shape[1]
        grads, shares = torch.empty_like(acts), torch.empty_like(acts)
        dh = torch.zeros_like(hidden)
        for t in reversed(range(len(acts))):
            before = states[t - 1] if t else hidden
            dh = dh.add_(grad_states[t]).mul_(present[t])
            r, z, s = acts[t].chunk(3, dim=-1)
            dr, dz, dn = grads[t].chunk(3, dim=-1)
            n = s.mul(2).sub_(1)
            torch.sub(before, n, out=dz).mul_(dh)
            torch.addcmul(dh, dh, z, value=-1, out=dn).mul_(n.square_().neg_().add_(1))
            torch.mul(dn, own[t, :, 2 * width :], out=dr)
            squashed = acts[t, :, : 2 * width]
            grads[t, :, : 2 * width].mul_(torch.addcmul(squashed, squashed, squashed, value=-1))
            shares[t, :, : 2 * width] = grads[t, :, : 2 * width]
            torch.mul(dn, r, out=shares[t, :, 2 * width :])
            dh.mul_(z).addmm_(shares[t], weight)
        dw = shares[0].t() @ hidden
        dw.addmm_(shares[1:].flatten(0, 1).t(), states[:-1].flatten(0, 1))
        return grads, dw, shares.sum((0, 1)), None, dh


def _order(steps: int, reverse: bool) -> range:
    return range(steps - 1, -1, -1) if reverse else range(steps)
