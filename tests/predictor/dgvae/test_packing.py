"""Lists of who is there: there and back, lengths, sums, and nothing read or drawn for entries that only fill up."""

import pytest
import torch
from torch import Tensor

from predictor.dgvae.packing import Packed, Padded
from predictor.graph import pair_mask
from tests.predictor.helpers import random_presence

BATCH, AGENTS = 3, 5


def lists(valid: Tensor) -> Packed:
    return Packed.of(Padded(pair_mask(valid), None), valid)


@pytest.fixture
def valid() -> Tensor:
    return random_presence(0, BATCH, AGENTS, ego=False)


def test_there_and_back(valid: Tensor):
    packed, pairs = lists(valid), pair_mask(valid)
    nodes, edges = torch.rand(BATCH, AGENTS, 2) + 1, torch.rand(BATCH, AGENTS, AGENTS, 3) + 1
    assert torch.equal(packed.unpack_nodes(packed.pack_nodes(nodes)), nodes * valid[..., None])
    assert torch.equal(packed.unpack_pairs(packed.pack_pairs(edges)), edges * pairs[..., None])
    shown = packed.unpack_pairs(packed.pack_pairs(edges), no_edge=True)
    assert (shown[~pairs] == torch.tensor([1.0, 0.0, 0.0])).all() and torch.equal(shown[pairs], edges[pairs])


def test_lengths_are_few_and_little_is_added():
    lengths = {}
    for agents in range(2, 60):
        packed = lists(torch.ones(1, agents, dtype=torch.bool))
        there = agents * (agents - 1)
        lengths[there] = len(packed.pack_pairs(torch.zeros(1, agents, agents, 1)))
        assert there <= lengths[there] <= max(there + 7, 1.07 * there)
        assert lengths[there] % 8 == 0
    large = [length for there, length in lengths.items() if there >= 512]
    assert all(length % 32 == 0 for length in large)


def test_a_change_is_made_to_pairs_that_are_there_alone(valid: Tensor):
    packed, seen = lists(valid), []
    listed = packed.pack_pairs(torch.rand(BATCH, AGENTS, AGENTS, 2))
    there = int(pair_mask(valid).sum())
    assert len(listed) > there  # else this shows nothing

    def double(pairs: Tensor) -> Tensor:
        seen.append(len(pairs))
        return 2 * pairs

    changed = packed.per_pair(double, listed)
    assert seen == [there] and len(changed) == len(listed)
    assert torch.equal(changed[:there], 2 * listed[:there])


def test_sums_over_senders_leave_the_filling_out(valid: Tensor):
    packed, pairs = lists(valid), pair_mask(valid)
    edges, weights = torch.rand(BATCH, AGENTS, AGENTS, 2), torch.rand(BATCH, AGENTS, AGENTS, 1)
    listed, weight = packed.pack_pairs(edges), packed.pack_pairs(weights)[:, 0]
    for ours, expected in (
        (packed.gather(listed), (edges * pairs[..., None]).sum(2)),
        (packed.gather(listed, weight), (edges * weights * pairs[..., None]).sum(2)),
        (packed.total(weight), (weights * pairs[..., None]).sum(2)),
        (packed.counts.float(), pairs.sum(2, keepdim=True).float()),
    ):
        torch.testing.assert_close(packed.unpack_nodes(ours), expected)


def test_repeated_scenes_are_those_of_a_repeated_batch(valid: Tensor):
    packed = lists(valid)
    edges, nodes = torch.rand(BATCH, AGENTS, AGENTS, 2), torch.rand(BATCH, AGENTS, 3)
    again = packed.repeat(3)
    ours = again.unpack_pairs(packed.repeat_pairs(packed.pack_pairs(edges), 3))
    assert torch.equal(ours, packed.unpack_pairs(packed.pack_pairs(edges)).repeat_interleave(3, dim=0))
    ours = again.unpack_nodes(packed.repeat_nodes(packed.pack_nodes(nodes), 3))
    assert torch.equal(ours, packed.unpack_nodes(packed.pack_nodes(nodes)).repeat_interleave(3, dim=0))


def test_no_agents_at_all():
    packed = lists(torch.zeros(2, 3, dtype=torch.bool))
    listed = packed.pack_pairs(torch.ones(2, 3, 3, 4))
    assert not packed.unpack_nodes(packed.gather(listed)).any()
    assert not packed.unpack_pairs(listed).any()
