"""Layers on ordered pairs of agents: linear maps of receiver and sender, and sums of messages over senders."""

from collections.abc import Callable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn import functional


class PairLinear(nn.Module):
    """Linear layer on x_i ‖ x_j, computed as one node-level product for each role and added on the pair.

    The weight on the concatenation splits into two blocks, so the cost is that of agents, not of pairs.

    Args:
        inputs: size of a node.
        outputs: size of the result.
        relative: make it a layer on x_i ‖ (x_j − x_i), as in EdgeConv.
    """

    def __init__(self, inputs: int, outputs: int, relative: bool = False) -> None:
        """Creates both blocks."""
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
        """Computes pair features, before any non-linearity.

        Args:
            nodes: features of each agent.
            senders: index of the agent in each slot; None is dense.
            after: linear layer that is applied to `nodes` first; both are folded into one.
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
        extra: Float[Tensor, "*#batch agents slots out"] | None = None,
    ) -> Float[Tensor, "*batch agents slots out"]:
        """Computes the ELU of `forward` plus `extra`; only the result is kept for the gradient."""
        pairs = self(nodes, senders, after)
        return functional.elu_(pairs if extra is None else pairs + extra)

    def _roles(self, nodes: Tensor, after: nn.Linear | None) -> tuple[Tensor, Tensor]:
        sent = self._product(self.sender, nodes, after)
        received = self._product(self.receiver, nodes, after)
        return received - sent if self.relative else received, sent

    def _product(self, layer: nn.Linear, nodes: Tensor, after: nn.Linear | None) -> Tensor:
        if after is None:
            return functional.linear(nodes, layer.weight, layer.bias)
        return functional.linear(nodes, *folded(layer, after))


def to_pairs(
    nodes: Float[Tensor, "*batch agents node"], senders: Int[Tensor, "*some agents slots"]
) -> Float[Tensor, "*batch agents slots node"]:
    """Returns the node of each pair's sender; `senders` is one list for all, or one for each of the last batch axes."""
    agents, slots = senders.shape[-2:]
    if senders.ndim == 2:
        return nodes.index_select(-2, senders.flatten()).unflatten(-2, (agents, slots))
    if senders.ndim > 3:
        places = senders.flatten(-2)[..., None].expand(*nodes.shape[:-2], -1, nodes.shape[-1])
        return nodes.gather(-2, places).unflatten(-2, (agents, slots))
    places = senders + agents * torch.arange(len(senders), device=senders.device)[:, None, None]
    return nodes.flatten(-3, -2).index_select(-2, places.flatten()).unflatten(-2, tuple(senders.shape))


def ends(
    nodes: Float[Tensor, "*batch agents node"], senders: Int[Tensor, "*some agents slots"] | None = None
) -> tuple[Float[Tensor, "*batch agents 1 node"], Float[Tensor, "*batch _ slots node"]]:
    """Returns the nodes of each pair's receiver and sender, for broadcasting over pairs; no `senders` is dense."""
    return nodes[..., :, None, :], nodes[..., None, :, :] if senders is None else to_pairs(nodes, senders)


def folded(outer: nn.Linear, inner: nn.Linear) -> tuple[Float[Tensor, "out in"], Float[Tensor, " out"]]:
    """Returns weight and bias of two consecutive linear layers: W (W' x + b') + b."""
    bias = outer.weight @ inner.bias
    return outer.weight @ inner.weight, bias if outer.bias is None else bias + outer.bias


def sum_over_senders(
    pairs: Float[Tensor, "*batch agents slots hidden"], weight: Float[Tensor, "*#batch agents slots"]
) -> Float[Tensor, "*batch agents hidden"]:
    """Computes Σ_j weight_ij · pair_ij."""
    return torch.matmul(weight[..., None, :], pairs)[..., 0, :]


Total = Callable[[Tensor], Tensor]
"""Function that sums a tensor over all processes of a training (`predictor.training.processes`)."""


def of_one_process(tensor: Tensor) -> Tensor:
    """Returns a tensor as it is: its sum over the one process that there is."""
    return tensor


def masked_mean(
    values: Float[Tensor, "*batch"], valid: Bool[Tensor, "*batch"], total: Total = of_one_process
) -> Float[Tensor, ""]:
    """Computes the mean over valid entries; 0 if there is none.

    Args:
        values: values to average.
        valid: which entries count.
        total: sums the counts over all processes; the result is then this process's share, and the shares add up to
            the mean over the entries of all.
    """
    # where, not a product: an invalid entry may be infinite, and inf · 0 is NaN.
    found = torch.where(valid, values, torch.zeros_like(values)).sum()
    return found / total(valid.sum()).clamp(min=1)
