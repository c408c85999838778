"""What streaming does to memory, against plain loops."""

from itertools import product

import torch

from predictor.forecaster import Memory

BATCH, AGENTS = 3, 4


def memory(seed: int, batch: int = BATCH) -> Memory:
    generator = torch.Generator().manual_seed(seed)
    pairs = tuple(torch.randn(batch, AGENTS, AGENTS, width, generator=generator) for width in (2, 3))
    return Memory((torch.randn(batch, AGENTS, 5, generator=generator),), pairs)


def test_reorder_against_a_loop():
    before = memory(0)
    source = torch.tensor([[0, 2, 1, 3], [3, 0, 0, 1], [2, 1, 3, 0]])
    known = torch.tensor([[True, True, True, True], [True, False, True, False], [True, False, True, True]])
    after = before.reorder(source, known)
    for b, i in product(range(BATCH), range(AGENTS)):
        expected = before.nodes[0][b, source[b, i]] if known[b, i] else torch.zeros(5)
        assert torch.equal(after.nodes[0][b, i], expected)
    for kind, (b, i, j) in product((0, 1), product(range(BATCH), range(AGENTS), range(AGENTS))):
        moved = before.pairs[kind][b, source[b, i], source[b, j]]
        both = known[b, i] and known[b, j]
        assert torch.equal(after.pairs[kind][b, i, j], moved if both else torch.zeros_like(moved))


def test_reordering_twice_is_reordering_once():
    before = memory(0, batch=1)
    order, back = torch.tensor([[2, 0, 3, 1]]), torch.tensor([[1, 3, 0, 2]])
    everyone = torch.ones(1, AGENTS).bool()
    there_and_back = before.reorder(order, everyone).reorder(back, everyone)
    assert torch.equal(there_and_back.nodes[0], before.nodes[0])
    assert all(torch.equal(a, b) for a, b in zip(there_and_back.pairs, before.pairs, strict=True))


def test_padding_adds_agents_without_memory():
    before = memory(0)
    after = before.padded(AGENTS + 2)
    assert torch.equal(after.nodes[0][:, :AGENTS], before.nodes[0]) and not after.nodes[0][:, AGENTS:].any()
    for ours, expected in zip(after.pairs, before.pairs, strict=True):
        assert ours.shape == (BATCH, AGENTS + 2, AGENTS + 2, expected.shape[-1])
        assert torch.equal(ours[:, :AGENTS, :AGENTS], expected)
        assert not ours[:, AGENTS:].any() and not ours[:, :, AGENTS:].any()
    assert all(torch.equal(a, b) for a, b in zip(before.padded(AGENTS).pairs, before.pairs, strict=True))


def test_select_and_replace_rows():
    before, other = memory(0), memory(1, batch=2)
    rows = torch.tensor([2, 0])
    after = before.replace_rows(rows, other)
    assert torch.equal(after.select(rows).nodes[0], other.nodes[0])
    for kind in (0, 1):
        assert torch.equal(after.pairs[kind][2], other.pairs[kind][0])
        assert torch.equal(after.pairs[kind][0], other.pairs[kind][1])
        assert torch.equal(after.pairs[kind][1], before.pairs[kind][1])
    assert torch.equal(before.nodes[0], memory(0).nodes[0])  # a copy: nothing was changed in place


def test_concatenate_keeps_the_order_of_rows():
    joined = Memory.concatenate(memory(0), memory(1, batch=2))
    assert torch.equal(joined.nodes[0], torch.cat([memory(0).nodes[0], memory(1, batch=2).nodes[0]]))
    assert torch.equal(joined.select(torch.tensor([3, 4])).pairs[1], memory(1, batch=2).pairs[1])


def test_forecasters_without_memory_have_an_empty_one():
    empty, rows = Memory(), torch.tensor([0])
    assert empty.reorder(torch.zeros(1, 2).long(), torch.ones(1, 2).bool()) == empty
    assert empty.select(rows) == empty.replace_rows(rows, empty) == Memory.concatenate(empty, empty) == empty
