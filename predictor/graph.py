"""Dense graphs of small scenes: who is paired with whom, and layers on pairs that work on nodes first.

A pair is always (receiver, sender), in this axis order.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn


def pair_mask(valid: Bool[Tensor, "*batch agents"]) -> Bool[Tensor, "*batch agents agents"]:
    """Pairs of two different, present agents."""
    agents = valid.shape[-1]
    distinct = ~torch.eye(agents, dtype=torch.bool, device=valid.device)
    return valid[..., :, None] & valid[..., None, :] & distinct


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

    def forward(self, nodes: Float[Tensor, "*batch agents node"]) -> Float[Tensor, "*batch agents agents out"]:
        """Pair features, before any non-linearity."""
        sent = self.sender(nodes)
        received = self.receiver(nodes)
        if self.relative:
            received = received - sent
        return received[..., :, None, :] + sent[..., None, :, :]


def sum_over_senders(
    pairs: Float[Tensor, "*batch agents agents hidden"], weight: Float[Tensor, "*batch agents agents"]
) -> Float[Tensor, "*batch agents hidden"]:
    """Σ_j weight_ij · pair_ij."""
    return torch.matmul(weight[..., None, :], pairs)[..., 0, :]
