"""Graphs: who is paired with whom, and layers on pairs that work on nodes first.

A pair is always (receiver, sender), in this axis order. Pairs of a scene lie in an array of agents × slots. Without a
list of senders, slot j is agent j ("dense"). With one, slot s of receiver i is agent `senders[i, s]`: all others, which
leaves the diagonal out, or the nearest few, so that the cost grows with the number of agents and not with its square.
"""

from typing import Any

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn import functional

NOBODY = -1
"""Sender of an empty slot."""


def pair_mask(valid: Bool[Tensor, "*batch agents"]) -> Bool[Tensor, "*batch agents agents"]:
    """Pairs of two different, present agents."""
    agents = valid.shape[-1]
    distinct = ~torch.eye(agents, dtype=torch.bool, device=valid.device)
    return valid[..., :, None] & valid[..., None, :] & distinct


def others(agents: int, device: torch.device | None = None) -> Int[Tensor, "agents slots"]:
    """Senders of a graph in which everyone hears everyone else, in order."""
    every = torch.arange(agents, device=device)
    return off_diagonal(every.expand(agents, agents))


def off_diagonal(dense: Shaped[Tensor, "*batch agents agents"]) -> Shaped[Tensor, "*batch agents slots"]:
    """From dense pairs to those with `others`."""
    agents = dense.shape[-1]
    # row by row, the entries between two diagonal ones are as many as there are agents
    between = dense.flatten(-2)[..., 1:].unflatten(-1, (agents - 1, agents + 1))[..., :-1]
    return between.reshape(*dense.shape[:-2], agents, agents - 1)


def with_diagonal(
    pairs: Shaped[Tensor, "*batch agents slots feature"], diagonal: Shaped[Tensor, " feature"]
) -> Shaped[Tensor, "*batch agents agents feature"]:
    """From pairs with `others` to dense ones, every diagonal entry as given."""
    agents = pairs.shape[-3]
    between = pairs.reshape(*pairs.shape[:-3], agents - 1, agents, pairs.shape[-1])
    first = diagonal.expand(*between.shape[:-2], 1, -1)
    last = diagonal.expand(*between.shape[:-3], 1, -1)
    flat = torch.cat([torch.cat([first, between], dim=-2).flatten(-3, -2), last], dim=-2)
    return flat.unflatten(-2, (agents, agents))


def nearest(
    positions: Float[Tensor, "batch agents axes"], valid: Bool[Tensor, "batch agents"], count: int
) -> tuple[Int[Tensor, "batch agents slots"], Bool[Tensor, "batch agents slots"]]:
    """The nearest others of each agent in `count` slots, and which of the slots hold one.

    Everyone is compared with everyone, by distance alone; that square is small beside what pairs cost.
    """
    agents = positions.shape[1]
    # exact: the fast way squares coordinates, and 10 km down a road nothing is left of a metre
    distance = torch.cdist(positions, positions, compute_mode="donot_use_mm_for_euclid_dist")
    distance = distance.masked_fill(~pair_mask(valid), torch.inf)
    found = distance.topk(min(count, agents), dim=-1, largest=False)
    missing = (0, count - found.indices.shape[-1])
    return functional.pad(found.indices, missing), functional.pad(found.values < torch.inf, missing)


def among_nearest(
    positions: Float[Tensor, "*batch agents axes"], valid: Bool[Tensor, "*batch agents"], count: int
) -> Bool[Tensor, "*batch agents agents"]:
    """The dense mask of the pairs that `nearest` finds."""
    agents, axes = positions.shape[-2:]
    senders, present = nearest(positions.reshape(-1, agents, axes), valid.reshape(-1, agents), min(count, agents))
    mask = torch.zeros(*senders.shape[:2], senders.shape[1], dtype=torch.bool, device=valid.device)
    return mask.scatter_(-1, senders, present).view(*valid.shape, valid.shape[-1])


def to_dense(
    pairs: Float[Tensor, "batch agents slots feature"],
    senders: Int[Tensor, "batch agents slots"],
    absent: Float[Tensor, " feature"],
) -> Float[Tensor, "batch agents agents feature"]:
    """Slots put where their senders stand, `absent` everywhere else."""
    batch, agents, _, width = pairs.shape
    # one more column takes what the empty slots hold
    dense = absent.expand(batch, agents, agents + 1, width).clone()
    place = torch.where(senders == NOBODY, agents, senders)
    return dense.scatter_(2, place[..., None].expand_as(pairs), pairs)[:, :, :agents]


def to_pairs(
    nodes: Float[Tensor, "*batch agents node"], senders: Int[Tensor, "*some agents slots"]
) -> Float[Tensor, "*batch agents slots node"]:
    """The node of each pair's sender; `senders` is one list for all, or one for each of the last batch axis."""
    agents, slots = senders.shape[-2:]
    if senders.ndim == 2:
        return nodes.index_select(-2, senders.flatten()).unflatten(-2, (agents, slots))
    rows = senders + agents * torch.arange(len(senders), device=senders.device)[:, None, None]
    return nodes.flatten(-3, -2).index_select(-2, rows.flatten()).unflatten(-2, tuple(senders.shape))


class PairLinear(nn.Module):
    """A linear layer on x_i ‖ x_j, computed as one node-level product for each role and added on the pair.

    The weight on the concatenation splits into two blocks, so the cost is that of agents, not of pairs.

    Args:
        inputs: size of a node.
        outputs: size of the result.
        relative: make it a layer on x_i ‖ (x_j − x_i), as in EdgeConv.
    """

    def __init__(self, inputs: int, outputs: int, relative: bool = False) -> None:
        """Create both blocks."""
        super().__init__()
        self.receiver = nn.Linear(inputs, outputs)
        self.sender = nn.Linear(inputs, outputs, bias=False)
        self.relative = relative

    def forward(
        self,
        nodes: Float[Tensor, "*batch agents node"],
        senders: Int[Tensor, "*some agents slots"] | None = None,
        after: nn.Linear | None = None,
    ) -> Float[Tensor, "*batch agents slots out"]:
        """Pair features, before any non-linearity.

        Args:
            nodes: one per agent.
            senders: who is in which slot; None is dense.
            after: a linear layer that `nodes` are still to pass; two in a row are folded into one.
        """
        received, sent = self._roles(nodes, after)
        if senders is None:
            return received[..., :, None, :] + sent[..., None, :, :]
        return received[..., :, None, :] + to_pairs(sent, senders)

    def elu(
        self,
        nodes: Float[Tensor, "*batch agents node"],
        senders: Int[Tensor, "*some agents slots"] | None = None,
        after: nn.Linear | None = None,
        extra: Float[Tensor, "*batch agents slots out"] | None = None,
    ) -> Float[Tensor, "*batch agents slots out"]:
        """ELU of `forward`, and of what else is to be added to it; only the result is kept for the gradient."""
        result: Tensor = _PairELU.apply(*self._roles(nodes, after), extra, senders)
        return result

    def _roles(self, nodes: Tensor, after: nn.Linear | None) -> tuple[Tensor, Tensor]:
        sent = self._product(self.sender, nodes, after)
        received = self._product(self.receiver, nodes, after)
        return received - sent if self.relative else received, sent

    def _product(self, layer: nn.Linear, nodes: Tensor, after: nn.Linear | None) -> Tensor:
        if after is None:
            return functional.linear(nodes, layer.weight, layer.bias)
        return functional.linear(nodes, *folded(layer, after))


class _PairELU(torch.autograd.Function):
    """received and sent (…, A, W), extra (…, A, S, W) or None → elu(received_i + sent_j + extra_ij) (…, A, S, W)."""

    @staticmethod
    def forward(ctx: Any, received: Tensor, sent: Tensor, extra: Tensor | None, senders: Tensor | None) -> Tensor:
        if senders is None:
            pairs = received[..., :, None, :] + sent[..., None, :, :]
        else:
            pairs = to_pairs(sent, senders).add_(received[..., :, None, :])
        if extra is not None:
            pairs.add_(extra)
        functional.elu_(pairs)
        ctx.save_for_backward(pairs)
        ctx.senders, ctx.has_extra = senders, extra is not None
        return pairs

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        (pairs,) = ctx.saved_tensors
        grad = torch.ops.aten.elu_backward(grad, 1.0, 1.0, 1.0, True, pairs)
        received = grad.sum(-2)
        sent = grad.sum(-3) if ctx.senders is None else _from_pairs(grad, ctx.senders)
        return received, sent, grad if ctx.has_extra else None, None


def _from_pairs(pairs: Tensor, senders: Tensor) -> Tensor:
    """What `to_pairs` gave, summed back to its senders."""
    agents, slots = senders.shape[-2:]
    if senders.ndim == 2:
        total = pairs.new_zeros(*pairs.shape[:-3], agents, pairs.shape[-1])
        return total.index_add_(-2, senders.flatten(), pairs.flatten(-3, -2))
    rows = senders + agents * torch.arange(len(senders), device=senders.device)[:, None, None]
    total = pairs.new_zeros(*pairs.shape[:-4], len(senders) * agents, pairs.shape[-1])
    return total.index_add_(-2, rows.flatten(), pairs.flatten(-4, -2)).unflatten(-2, (len(senders), agents))


def folded(outer: nn.Linear, inner: nn.Linear) -> tuple[Float[Tensor, "out in"], Float[Tensor, " out"]]:
    """Weight and bias of two linear layers in a row: W (W' x + b') + b."""
    bias = outer.weight @ inner.bias
    return outer.weight @ inner.weight, bias if outer.bias is None else bias + outer.bias


def sum_over_senders(
    pairs: Float[Tensor, "*batch agents slots hidden"], weight: Float[Tensor, "*batch agents slots"]
) -> Float[Tensor, "*batch agents hidden"]:
    """Σ_j weight_ij · pair_ij."""
    return torch.matmul(weight[..., None, :], pairs)[..., 0, :]
