"""Graphs: which agents are paired, as dense arrays, as lists of senders, and conversions between the two.

A pair is always (receiver, sender), in this axis order. Pairs of a scene lie in an array of agents × slots. Without a
list of senders, slot j is agent j ("dense"). With one, slot s of receiver i is agent `senders[i, s]`: all others, which
leaves the diagonal out, or the nearest few, so that the cost grows with the number of agents and not with its square.
"""

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor
from torch.nn import functional

NO_AGENT = -1
"""Sender of an empty slot."""


def pair_mask(valid: Bool[Tensor, "*batch agents"]) -> Bool[Tensor, "*batch agents agents"]:
    """Returns the pairs of two different, present agents."""
    agents = valid.shape[-1]
    distinct = ~torch.eye(agents, dtype=torch.bool, device=valid.device)
    return valid[..., :, None] & valid[..., None, :] & distinct


def self_pairs(
    agents: int, senders: Int[Tensor, "*some agents slots"] | None, device: torch.device | None = None
) -> Bool[Tensor, "*some agents slots"]:
    """Returns which slots hold an agent's pair with itself."""
    if senders is None:
        return torch.eye(agents, dtype=torch.bool, device=device)
    return senders == torch.arange(agents, device=device)[:, None]


def others(agents: int, device: torch.device | None = None) -> Int[Tensor, "agents slots"]:
    """Returns the senders of a graph in which each agent receives from all others, in order."""
    indices = torch.arange(agents, device=device)
    return off_diagonal(indices.expand(agents, agents))


def off_diagonal(dense: Shaped[Tensor, "*batch agents agents"]) -> Shaped[Tensor, "*batch agents slots"]:
    """Converts dense pairs to pairs with the senders of `others`, which leaves the diagonal out."""
    agents = dense.shape[-1]
    # in the flattened array, the entries between two diagonal ones are as many as there are agents
    between = dense.flatten(-2)[..., 1:].unflatten(-1, (agents - 1, agents + 1))[..., :-1]
    return between.reshape(*dense.shape[:-2], agents, agents - 1)


def with_diagonal(
    pairs: Shaped[Tensor, "*batch agents slots feature"], diagonal: Shaped[Tensor, " feature"]
) -> Shaped[Tensor, "*batch agents agents feature"]:
    """Converts pairs with the senders of `others` to dense ones, with `diagonal` in every diagonal entry."""
    agents = pairs.shape[-3]
    between = pairs.reshape(*pairs.shape[:-3], agents - 1, agents, pairs.shape[-1])
    first = diagonal.expand(*between.shape[:-2], 1, -1)
    last = diagonal.expand(*between.shape[:-3], 1, -1)
    flat = torch.cat([torch.cat([first, between], dim=-2).flatten(-3, -2), last], dim=-2)
    return flat.unflatten(-2, (agents, agents))


def nearest(
    positions: Float[Tensor, "batch agents axes"], valid: Bool[Tensor, "batch agents"], count: int
) -> tuple[Int[Tensor, "batch agents slots"], Bool[Tensor, "batch agents slots"]]:
    """Finds the nearest others of each agent, in `count` slots, and which of the slots hold one.

    All agents are compared with all, by distance alone; these squared costs are small beside those of layers on pairs.
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
    """Returns the dense mask of the pairs that `nearest` finds."""
    agents, axes = positions.shape[-2:]
    senders, present = nearest(positions.reshape(-1, agents, axes), valid.reshape(-1, agents), min(count, agents))
    mask = torch.zeros(*senders.shape[:2], senders.shape[1], dtype=torch.bool, device=valid.device)
    return mask.scatter_(-1, senders, present).view(*valid.shape, valid.shape[-1])


def to_dense(
    pairs: Float[Tensor, "batch agents slots feature"],
    senders: Int[Tensor, "batch agents slots"],
    absent: Float[Tensor, " feature"],
) -> Float[Tensor, "batch agents agents feature"]:
    """Converts pairs in slots to dense ones, with `absent` where no slot holds the pair."""
    batch, agents, _, width = pairs.shape
    # one more column takes what the empty slots hold
    dense = absent.expand(batch, agents, agents + 1, width).clone()
    place = torch.where(senders == NO_AGENT, agents, senders)
    return dense.scatter_(2, place[..., None].expand_as(pairs), pairs)[:, :, :agents]
