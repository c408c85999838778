"""Self-edges: the pair of an agent with itself, whose type decides which of its possible futures an agent takes.

The pair (i, i) passes through the same embedding and the same LSTM as every other pair (paper Sec. IV), so its memory
knows the agent's own past and what surrounds it. From this memory follow the probabilities of the types and, once a
type is held, one more message of the agent to itself at every step of a roll-out. A type is held for a whole roll-out.
Type 0 is the single forecast; all observed steps are decoded along it.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional

SHIFT_STD, GAIN_STD = 0.7, 0.3
"""Spread of fresh shifts and gains: types must differ at the start, or they never learn to."""


class HeldType(NamedTuple):
    """What the held types add to each agent's message to itself."""

    past: Float[Tensor, "*agents message"]
    """Share of the agent's past."""
    shift: Float[Tensor, "*types message"]
    """Addend of the held type."""
    gain: Float[Tensor, "*types message"]
    """Factor of the held type."""
    spread: Float[Tensor, "*types axes"] | None
    """Addend of the held type in the growth of its spread; None where all types grow alike."""


class SelfEdges(nn.Module):
    """Computes probabilities of the self-edge's types, messages along them, and the spread around a roll-out.

    Args:
        inputs: number of an agent's inputs of the decoder.
        memory: size of a pair's memory.
        head: hidden width of the prior's head.
        message: width of a message.
        decoder: size of the decoder's memory.
        types: number of types.
        axes: number of axes of a position.
        spread_by_type: whether each type has an addend of its own in the growth of its spread.
    """

    def __init__(
        self,
        inputs: int,
        memory: int,
        head: int,
        message: int,
        decoder: int,
        types: int,
        axes: int,
        spread_by_type: bool,
    ) -> None:
        """Creates the layers, in the order in which data passes them."""
        super().__init__()
        self.prior_head = nn.Sequential(nn.Linear(memory, head), nn.ELU(), nn.Linear(head, types))
        self.input = nn.Linear(inputs, message)
        self.past = nn.Linear(memory, message, bias=False)
        self.shift = nn.Parameter(SHIFT_STD * torch.randn(types, message))
        self.gain = nn.Parameter(1 + GAIN_STD * torch.randn(types, message))
        self.out = nn.Linear(message, message)
        self.spread = nn.Linear(decoder, axes)
        self.spread_shift = nn.Parameter(torch.zeros(types, axes)) if spread_by_type else None

    def hold(self, past: Float[Tensor, "*agents memory"], types: Int[Tensor, "*types"] | None = None) -> HeldType:
        """Returns what the given types (None: type 0 for all) add, from the activated memory of each self-edge.

        Types and agents are broadcast together.
        """
        chosen: Tensor | int = 0 if types is None else types
        spread = None if self.spread_shift is None else self.spread_shift[chosen]
        return HeldType(self.past(past), self.shift[chosen], self.gain[chosen], spread)

    def layer(self, inputs: Float[Tensor, "*agents inputs"], held: HeldType) -> Float[Tensor, "*held message"]:
        """Computes the hidden layer of each agent's message to itself; `out` makes it the message."""
        return functional.elu((self.input(inputs) + held.past) * held.gain + held.shift)

    def growth(self, node: Float[Tensor, "*held decoder"], held: HeldType) -> Float[Tensor, "*held axes"]:
        """Computes by how much the spread grows in a step, in units of `delta_scales`; of no effect on the memory."""
        grown = self.spread(functional.elu(node.detach()))
        return functional.softplus(grown if held.spread is None else grown + held.spread)
