"""Scenes of different sizes without padding: agents and pairs of a whole batch in two flat lists.

A batch of scenes is padded to its largest, and pairs to its square; in traffic most of that is empty. Single steps
without gradients work on lists of those who are there. `Padded` has the same methods and leaves everything in place.

The lists' lengths are rounded up by a few per cent, with entries that nobody reads: oneDNN compiles its products for
each length it meets, which takes longer than the product, and so it meets few.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional

_LEAST_STEP = 8
"""Lengths are multiples of it."""


class Padded(NamedTuple):
    """Pairs as an array of agents × slots; axes as in `predictor.graph`."""

    present: Bool[Tensor, "*batch agents slots"]
    """Who may interact."""
    senders: Int[Tensor, "*some agents slots"] | None
    """Whose each slot is; None if slot j is agent j's."""

    @property
    def pairs_there(self) -> Bool[Tensor, "*batch agents slots"]:
        """Which slots hold a pair."""
        return self.present

    def pack_nodes(self, nodes: Tensor) -> Tensor:
        """The same."""
        return nodes

    def pack_pairs(self, pairs: Tensor) -> Tensor:
        """The same."""
        return pairs

    def among_pairs(self, pairs: Tensor) -> Tensor:
        """Which entries are of pairs that are there."""
        return self.present

    def forget_absent(self, nodes: Tensor, valid: Tensor) -> Tensor:
        """Zeros for who is not there."""
        return nodes * valid[..., None]

    def unpack_nodes(self, nodes: Tensor) -> Tensor:
        """The same."""
        return nodes

    def unpack_pairs(self, pairs: Tensor, no_edge: bool = False) -> Tensor:
        """The same."""
        return pairs

    def per_pair(self, change: Callable[[Tensor], Tensor], pairs: Tensor) -> Tensor:
        """A change to each pair by itself."""
        return change(pairs)

    def repeat_nodes(self, nodes: Tensor, times: int) -> Tensor:
        """Each scene so many times in a row."""
        return nodes.repeat_interleave(times, dim=0)

    def repeat_pairs(self, pairs: Tensor, times: int) -> Tensor:
        """Each scene so many times in a row."""
        return pairs.repeat_interleave(times, dim=0)

    def repeat(self, times: int) -> "Padded":
        """The pairs of a batch with each scene so many times in a row."""
        senders = None if self.senders is None else self.senders.repeat_interleave(times, dim=0)
        return Padded(self.present.repeat_interleave(times, dim=0), senders)


@dataclass(frozen=True)
class Packed:
    """Lists of the agents and pairs that are there, scene by scene, pairs by receiver."""

    padded: Padded
    """Where they come from."""
    valid: Bool[Tensor, "batch agents"]
    """Likewise."""
    agents: Int[Tensor, " agents_there"]
    """Places of the listed agents in the flattened batch."""
    slots: Int[Tensor, " pairs_there"]
    """Places of the listed pairs in the flattened array of pairs."""
    receivers: Int[Tensor, " pairs_there"]
    """Which listed agent."""
    roles: Int[Tensor, "pairs 2"]
    """Rows of receiver and sender where each listed agent has two in a row, as a receiver and as a sender."""
    offsets: Int[Tensor, " listed_and_end"]
    """Where each listed agent's pairs begin, and where the last one's end."""
    each: Int[Tensor, " pairs_there"]
    """0, 1, 2, …"""
    counts: Int[Tensor, "listed 1"]
    """Number of each agent's senders."""

    @staticmethod
    def of(padded: Padded, valid: Bool[Tensor, "batch agents"]) -> "Packed":
        """List what is there."""
        present = padded.present
        width, slots_each = valid.shape[1], present.shape[2]
        place = valid.flatten().cumsum(0) - 1  # in the list of agents
        agents = valid.flatten().nonzero()[:, 0]
        slots = present.flatten().nonzero()[:, 0]
        receiver = slots // slots_each
        if padded.senders is None:
            sender = slots % slots_each
        else:
            sender = padded.senders.flatten()[slots]
        count = present.sum(-1).flatten()[agents]
        scene = receiver // width * width
        receivers, senders = place[receiver], place[scene + sender]
        roles = torch.stack([2 * receivers, 2 * senders + 1], dim=1)
        beyond = _rounded(len(agents)) - len(agents)
        offsets = functional.pad(count.cumsum(0), (1, 0))
        return Packed(
            padded=padded,
            valid=valid,
            agents=agents,
            slots=slots,
            receivers=receivers,
            roles=functional.pad(roles, (0, 0, 0, _rounded(len(slots)) - len(slots))),
            offsets=torch.cat([offsets, offsets[-1:].expand(beyond)]),
            each=torch.arange(len(slots), device=slots.device),
            counts=functional.pad(count[:, None], (0, 0, 0, beyond)),
        )

    @property
    def pairs_there(self) -> Bool[Tensor, "batch agents slots"]:
        """Which slots of the padded array hold a pair."""
        return self.padded.present

    def pack_nodes(self, nodes: Float[Tensor, "batch agents node"]) -> Float[Tensor, "listed node"]:
        """Rows of the listed agents."""
        return nodes.flatten(0, 1).index_select(0, _lengthened(self.agents))

    def pack_pairs(self, pairs: Float[Tensor, "batch agents slots pair"]) -> Float[Tensor, "pairs pair"]:
        """Rows of the listed pairs."""
        return pairs.flatten(0, 2).index_select(0, _lengthened(self.slots))

    def among_pairs(self, pairs: Float[Tensor, "pairs pair"]) -> Bool[Tensor, " pairs"]:
        """All of them."""
        return torch.ones(len(pairs), dtype=torch.bool, device=pairs.device)

    def forget_absent(
        self, nodes: Float[Tensor, "listed node"], valid: Bool[Tensor, "batch agents"]
    ) -> Float[Tensor, "listed node"]:
        """The same: who is not there is not listed."""
        return nodes

    def per_pair(
        self, change: Callable[[Tensor], Tensor], pairs: Float[Tensor, "pairs before"]
    ) -> Float[Tensor, "pairs after"]:
        """A change to each pair by itself; what draws noise draws none for nobody."""
        changed = change(pairs[: len(self.slots)])
        return functional.pad(changed, (0, 0, 0, len(pairs) - len(changed)))

    def unpack_nodes(self, nodes: Float[Tensor, "listed node"]) -> Float[Tensor, "batch agents node"]:
        """Zeros for who is not listed."""
        padded = nodes.new_zeros(self.valid.numel(), nodes.shape[-1])
        return padded.index_copy_(0, self.agents, nodes[: len(self.agents)]).unflatten(0, self.valid.shape)

    def unpack_pairs(
        self, pairs: Float[Tensor, "pairs pair"], no_edge: bool = False
    ) -> Float[Tensor, "batch agents slots pair"]:
        """Zeros for pairs that are not listed; with `no_edge`, certainty of the first type."""
        shape = self.padded.present.shape
        padded = pairs.new_zeros(shape.numel(), pairs.shape[-1])
        if no_edge:
            padded[:, 0] = 1.0
        return padded.index_copy_(0, self.slots, pairs[: len(self.slots)]).unflatten(0, shape)

    def repeat_nodes(self, nodes: Float[Tensor, "listed node"], times: int) -> Float[Tensor, "more node"]:
        """Each scene so many times in a row."""
        scene = self.agents // self.valid.shape[1]
        return nodes.index_select(0, _lengthened(_repeated(scene, len(self.valid), times)))

    def repeat_pairs(self, pairs: Float[Tensor, "pairs pair"], times: int) -> Float[Tensor, "more pair"]:
        """Each scene so many times in a row."""
        scene = self.slots // self.padded.present[0].numel()
        return pairs.index_select(0, _lengthened(_repeated(scene, len(self.valid), times)))

    def repeat(self, times: int) -> "Packed":
        """The lists of a batch with each scene so many times in a row."""
        return Packed.of(self.padded.repeat(times), self.valid.repeat_interleave(times, dim=0))

    def spread(self, shares: Float[Tensor, "listed two_out"]) -> Float[Tensor, "pairs out"]:
        """Receiver's plus sender's share of each pair; an agent's two shares stand beside each other."""
        of_roles = shares.view(-1, shares.shape[1] // 2)
        return functional.embedding_bag(self.roles, of_roles, mode="sum")

    def gather(
        self, pairs: Float[Tensor, "pairs out"], weight: Float[Tensor, " pairs"] | None = None
    ) -> Float[Tensor, "listed out"]:
        """Sum over senders, weighted."""
        if weight is not None:
            weight = weight[: len(self.slots)]
        return functional.embedding_bag(
            self.each, pairs, self.offsets, mode="sum", per_sample_weights=weight, include_last_offset=True
        )

    def total(self, weight: Float[Tensor, " pairs"]) -> Float[Tensor, "listed 1"]:
        """Total weight of each agent's senders."""
        total = weight.new_zeros(len(self.counts))
        return total.index_add_(0, self.receivers, weight[: len(self.slots)])[:, None]


def _rounded(length: int) -> int:
    """At least so much, one of sixteen lengths between a number and its double."""
    step = max(_LEAST_STEP, 1 << max(0, length.bit_length() - 5))
    return -(-max(length, 1) // step) * step


def _lengthened(places: Int[Tensor, " there"]) -> Int[Tensor, " rounded"]:
    """The list, rounded up with the first place."""
    return functional.pad(places, (0, _rounded(len(places)) - len(places)))


def _repeated(scene: Tensor, scenes: int, times: int) -> Tensor:
    """Places of a list's entries, sorted by scene, when each scene is repeated."""
    sizes = torch.bincount(scene, minlength=scenes)
    starts = (sizes.cumsum(0) - sizes).repeat_interleave(times)
    sizes = sizes.repeat_interleave(times)
    total = sizes.cumsum(0)
    within = torch.arange(int(sizes.sum()), device=scene.device) - (total - sizes).repeat_interleave(sizes)
    return starts.repeat_interleave(sizes) + within
