"""Attention over senders: what share of its receiver's attention each sender has, as an input of the edge.

Whether a sender matters depends on the others: the one in front of it hides it. A network of pairs cannot tell, and a
sum over senders hardly shows who is the nearest. A few heads compare a receiver's senders with each other and give
each pair its shares (not in the paper).
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

SHARPEST = 8.0
"""Largest absolute score: a sender gets at most e¹⁶ times the share of another."""


class Attention(nn.Module):
    """Computes the shares of pairs, and what they add to the hidden layer of the edge.

    Args:
        width: width of the pairs' hidden layers.
        heads: number of comparisons.
    """

    def __init__(self, width: int, heads: int) -> None:
        """Creates the layers."""
        super().__init__()
        self.score = nn.Linear(width, heads, bias=False)
        self.out = nn.Linear(heads, width, bias=False)

    def forward(
        self, hidden: Float[Tensor, "*batch agents slots width"], pairs: Bool[Tensor, "*batch agents slots"]
    ) -> Float[Tensor, "*batch agents slots width"]:
        """Computes what the shares of a receiver's senders add to each pair."""
        weight = weights(self.score(hidden)) * pairs[..., None]
        added: Tensor = self.out(shares(weight, weight.sum(-2, keepdim=True)))
        return added


def weights(scores: Float[Tensor, "*pairs heads"]) -> Float[Tensor, "*pairs heads"]:
    """Returns the weight of each pair before it is divided by the receiver's total; bounded, so nothing overflows."""
    return torch.exp(SHARPEST * torch.tanh(scores / SHARPEST))


def shares(
    weight: Float[Tensor, "*pairs heads"], total: Float[Tensor, "*#pairs heads"]
) -> Float[Tensor, "*pairs heads"]:
    """Returns each pair's share; 1 in the total stands for nobody, so that shares may add up to less than 1."""
    return weight / (1 + total)
