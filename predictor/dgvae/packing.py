"""Scenes of different sizes without padding: agents and pairs of a whole batch in two flat lists.

A batch of scenes is padded to its largest, and pairs to the square of that; in traffic most of it is empty. Single
steps without gradients compute on lists of the present agents and pairs (`Packed`). `Padded` has the same methods and
leaves everything in place.

The lengths of the lists are rounded up by a few per cent, with unused entries: oneDNN compiles its products for each
length, which takes longer than the product, so there should be few lengths.

Roll-outs of modes have one more axis, before that of padded agents and after that of lists. What all modes share has
length 1 there.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor
from torch.nn import functional

from predictor.layers.pairs import ends

_LEAST_STEP = 8
"""Smallest unit of which lengths are multiples."""


class Padded(NamedTuple):
    """Keeps pairs as an array of agents × slots; axes as in `predictor.graph`."""

    present: Bool[Tensor, "*batch agents slots"]
    """Which pairs may interact."""
    senders: Int[Tensor, "*some agents slots"] | None
    """Index of the sender in each slot; None if slot j is agent j's."""

    def for_modes(self) -> "Padded":
        """Returns the pairs with an axis of modes."""
        return Padded(self.present[:, None], None if self.senders is None else self.senders[:, None])

    @property
    def pairs_there(self) -> Bool[Tensor, "*batch agents slots"]:
        """Mask of the slots that hold a pair."""
        return self.present

    def pack_nodes(self, nodes: Tensor) -> Tensor:
        """Returns `nodes` unchanged."""
        return nodes

    def ends(self, nodes: Tensor) -> tuple[Tensor, Tensor]:
        """Returns the entries of each pair's receiver and sender, left to broadcasting."""
        return ends(nodes, self.senders)

    def own(self, pairs: Tensor) -> Tensor:
        """Returns the entry of each agent's pair with itself, which is the last slot where senders are listed."""
        if self.senders is None:
            return torch.diagonal(pairs, dim1=-3, dim2=-2).movedim(-1, -2)
        return pairs[..., -1, :]

    def pack_pairs(self, pairs: Tensor) -> Tensor:
        """Returns `pairs` unchanged."""
        return pairs

    def among_pairs(self, pairs: Tensor) -> Tensor:
        """Returns the mask of the entries of present pairs."""
        return self.present

    def forget_absent(self, nodes: Tensor, valid: Tensor) -> Tensor:
        """Sets the entries of absent agents to zero."""
        return nodes * valid[..., None]

    def unpack_nodes(self, nodes: Tensor) -> Tensor:
        """Returns `nodes` unchanged."""
        return nodes

    def unpack_pairs(self, pairs: Tensor, no_edge: bool = False) -> Tensor:
        """Returns `pairs` unchanged."""
        return pairs

    def per_pair(self, change: Callable[[Tensor], Tensor], pairs: Tensor) -> Tensor:
        """Applies a function of single pairs to all of them."""
        return change(pairs)

    def repeat_nodes(self, nodes: Tensor, times: int) -> Tensor:
        """Repeats the agents of each scene `times` times."""
        return nodes.repeat_interleave(times, dim=0)

    def repeat_pairs(self, pairs: Tensor, times: int) -> Tensor:
        """Repeats the pairs of each scene `times` times."""
        return pairs.repeat_interleave(times, dim=0)

    def repeat(self, times: int) -> "Padded":
        """Returns the pairs of a batch in which each scene is repeated `times` times."""
        senders = None if self.senders is None else self.senders.repeat_interleave(times, dim=0)
        return Padded(self.present.repeat_interleave(times, dim=0), senders)


@dataclass(frozen=True)
class Packed:
    """Lists the present agents and pairs, scene by scene, pairs by receiver."""

    padded: Padded
    """Padded pairs from which the lists are made."""
    valid: Bool[Tensor, "batch agents"]
    """Which agents of the padded batch are present."""
    agents: Int[Tensor, " agents_there"]
    """Index of each listed agent in the flattened batch."""
    slots: Int[Tensor, " pairs_there"]
    """Index of each listed pair in the flattened array of pairs."""
    receivers: Int[Tensor, " pairs_there"]
    """Index of each pair's receiver among the listed agents."""
    roles: Int[Tensor, "pairs 2"]
    """Indices of receiver and sender in a list that holds each agent twice, first as receiver, then as sender."""
    offsets: Int[Tensor, " listed_and_end"]
    """Index of the first pair of each listed agent, and the number of pairs at the end."""
    each: Int[Tensor, " pairs_there"]
    """Index of each pair: 0, 1, 2, …"""
    counts: Int[Tensor, "listed 1"]
    """Number of each agent's senders."""
    selves: Int[Tensor, " agents_there"] | None = None
    """Index of each listed agent's pair with itself; None if no agent has one."""

    @staticmethod
    def of(padded: Padded, valid: Bool[Tensor, "batch agents"], self_edges: bool = False) -> "Packed":
        """Lists the present agents and pairs; with `self_edges`, every agent must have a pair with itself."""
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
            selves=(receivers == senders).nonzero()[:, 0] if self_edges else None,
        )

    def for_modes(self) -> "Packed":
        """Returns the lists unchanged: all modes share them."""
        return self

    @property
    def pairs_there(self) -> Bool[Tensor, "batch agents slots"]:
        """Mask of the slots of the padded array that hold a pair."""
        return self.padded.present

    def pack_nodes(self, nodes: Shaped[Tensor, "batch *modes agents node"]) -> Shaped[Tensor, "listed *modes node"]:
        """Returns the entries of the listed agents."""
        return nodes.movedim(-2, 1).flatten(0, 1).index_select(0, _lengthened(self.agents))

    def pack_pairs(self, pairs: Float[Tensor, "batch agents slots pair"]) -> Float[Tensor, "pairs pair"]:
        """Returns the entries of the listed pairs."""
        return pairs.flatten(0, 2).index_select(0, _lengthened(self.slots))

    def ends(
        self, nodes: Float[Tensor, "listed *modes node"]
    ) -> tuple[Float[Tensor, "pairs *modes node"], Float[Tensor, "pairs *modes node"]]:
        """Returns the entries of each pair's receiver and sender."""
        receivers, senders = (self.roles // 2).unbind(1)
        return nodes.index_select(0, receivers), nodes.index_select(0, senders)

    def own(self, pairs: Float[Tensor, "pairs pair"]) -> Float[Tensor, "listed pair"]:
        """Returns the entry of each listed agent's pair with itself."""
        assert self.selves is not None
        return pairs.index_select(0, _lengthened(self.selves))

    def among_pairs(self, pairs: Float[Tensor, "pairs pair"]) -> Bool[Tensor, " pairs"]:
        """Returns a mask that is True everywhere: only present pairs are listed."""
        return torch.ones(len(pairs), dtype=torch.bool, device=pairs.device)

    def forget_absent(
        self, nodes: Float[Tensor, "listed *modes node"], valid: Bool[Tensor, "batch ... agents"]
    ) -> Float[Tensor, "listed *modes node"]:
        """Returns `nodes` unchanged: absent agents are not listed."""
        return nodes

    def per_pair(
        self, change: Callable[[Tensor], Tensor], pairs: Float[Tensor, "pairs before"]
    ) -> Float[Tensor, "pairs after"]:
        """Applies a function of single pairs to all listed ones; no noise is drawn for absent pairs."""
        changed = change(pairs[: len(self.slots)])
        return functional.pad(changed, (0, 0, 0, len(pairs) - len(changed)))

    def unpack_nodes(self, nodes: Float[Tensor, "listed *modes node"]) -> Float[Tensor, "batch *modes agents node"]:
        """Returns the padded array of agents, with zeros for absent ones."""
        padded = nodes.new_zeros(self.valid.numel(), *nodes.shape[1:])
        padded.index_copy_(0, self.agents, nodes[: len(self.agents)])
        return padded.unflatten(0, self.valid.shape).movedim(1, -2)

    def unpack_pairs(
        self, pairs: Float[Tensor, "pairs pair"], no_edge: bool = False
    ) -> Float[Tensor, "batch agents slots pair"]:
        """Returns the padded array of pairs, with zeros for absent ones, or with certainty of type 0 if `no_edge`."""
        shape = self.padded.present.shape
        padded = pairs.new_zeros(shape.numel(), pairs.shape[-1])
        if no_edge:
            padded[:, 0] = 1.0
        return padded.index_copy_(0, self.slots, pairs[: len(self.slots)]).unflatten(0, shape)

    def repeat_nodes(self, nodes: Float[Tensor, "listed node"], times: int) -> Float[Tensor, "more node"]:
        """Repeats the agents of each scene `times` times."""
        scene = self.agents // self.valid.shape[1]
        return nodes.index_select(0, _lengthened(_repeated(scene, len(self.valid), times)))

    def repeat_pairs(self, pairs: Float[Tensor, "pairs pair"], times: int) -> Float[Tensor, "more pair"]:
        """Repeats the pairs of each scene `times` times."""
        scene = self.slots // self.padded.present[0].numel()
        return pairs.index_select(0, _lengthened(_repeated(scene, len(self.valid), times)))

    def repeat(self, times: int) -> "Packed":
        """Returns the lists of a batch in which each scene is repeated `times` times."""
        valid = self.valid.repeat_interleave(times, dim=0)
        return Packed.of(self.padded.repeat(times), valid, self.selves is not None)

    def spread(self, shares: Float[Tensor, "listed *modes two_out"]) -> Float[Tensor, "pairs *modes out"]:
        """Computes receiver's plus sender's share of each pair; an agent's two shares are side by side."""
        of_roles = shares.unflatten(-1, (2, -1)).movedim(-2, 1).flatten(0, 1)
        summed = functional.embedding_bag(self.roles, of_roles.flatten(1), mode="sum")
        return summed.unflatten(1, of_roles.shape[1:])

    def gather(
        self, pairs: Float[Tensor, "pairs *modes out"], weight: Float[Tensor, " pairs"] | None = None
    ) -> Float[Tensor, "listed *modes out"]:
        """Computes the weighted sum over senders."""
        if weight is not None:
            weight = weight[: len(self.slots)]
        summed = functional.embedding_bag(
            self.each, pairs.flatten(1), self.offsets, mode="sum", per_sample_weights=weight, include_last_offset=True
        )
        return summed.unflatten(1, pairs.shape[1:])

    def total(self, weight: Float[Tensor, " pairs"]) -> Float[Tensor, "listed 1"]:
        """Computes the total weight of each agent's senders."""
        total = weight.new_zeros(len(self.counts))
        return total.index_add_(0, self.receivers, weight[: len(self.slots)])[:, None]


def _rounded(length: int) -> int:
    """Rounds a length up to one of sixteen lengths between a number and its double."""
    step = max(_LEAST_STEP, 1 << max(0, length.bit_length() - 5))
    return -(-max(length, 1) // step) * step


def _lengthened(places: Int[Tensor, " there"]) -> Int[Tensor, " rounded"]:
    """Returns the list lengthened to a rounded length by zeros."""
    return functional.pad(places, (0, _rounded(len(places)) - len(places)))


def _repeated(scene: Tensor, scenes: int, times: int) -> Tensor:
    """Returns the indices of a list's entries, sorted by scene, when each scene is repeated."""
    sizes = torch.bincount(scene, minlength=scenes)
    starts = (sizes.cumsum(0) - sizes).repeat_interleave(times)
    sizes = sizes.repeat_interleave(times)
    total = sizes.cumsum(0)
    within = torch.arange(int(sizes.sum()), device=scene.device) - (total - sizes).repeat_interleave(sizes)
    return starts.repeat_interleave(sizes) + within
