"""What streaming does to memory, against plain loops."""

from itertools import product

import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from predictor.forecaster import Belief, Memory, edgeless_belief
from predictor.graph import NO_AGENT

BATCH, AGENTS, SLOTS = 3, 4, 2
seeds = st.integers(0, 2**16)


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
    all_agents = torch.ones(1, AGENTS).bool()
    there_and_back = before.reorder(order, all_agents).reorder(back, all_agents)
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


def test_select_and_replace_envs():
    before, other = memory(0), memory(1, batch=2)
    envs = torch.tensor([2, 0])
    after = before.replace_envs(envs, other)
    assert torch.equal(after.select(envs).nodes[0], other.nodes[0])
    for kind in (0, 1):
        assert torch.equal(after.pairs[kind][2], other.pairs[kind][0])
        assert torch.equal(after.pairs[kind][0], other.pairs[kind][1])
        assert torch.equal(after.pairs[kind][1], before.pairs[kind][1])
    assert torch.equal(before.nodes[0], memory(0).nodes[0])  # a copy: nothing was changed in place


def test_concatenate_keeps_the_order_of_envs():
    joined = Memory.concatenate(memory(0), memory(1, batch=2))
    assert torch.equal(joined.nodes[0], torch.cat([memory(0).nodes[0], memory(1, batch=2).nodes[0]]))
    assert torch.equal(joined.select(torch.tensor([3, 4])).pairs[1], memory(1, batch=2).pairs[1])


def test_forecasters_without_memory_have_an_empty_one():
    empty, envs = Memory(), torch.tensor([0])
    assert empty.reorder(torch.zeros(1, 2).long(), torch.ones(1, 2).bool()) == empty
    assert empty.select(envs) == empty.replace_envs(envs, empty) == Memory.concatenate(empty, empty) == empty


# --- With a list of senders -------------------------------------------------------------------------------------------


def listed(seed: int, batch: int = BATCH, slots: int = SLOTS) -> Memory:
    """No agent receives from another one twice, nor from itself; empty slots hold nothing."""
    generator = torch.Generator().manual_seed(seed)
    score = torch.rand(batch, AGENTS, AGENTS, generator=generator) + 9 * torch.eye(AGENTS)
    senders = score.argsort(-1)[..., :slots]
    senders[torch.rand(senders.shape, generator=generator) > 0.6] = NO_AGENT
    held = (senders != NO_AGENT)[..., None]
    pairs = tuple(torch.randn(batch, AGENTS, slots, width, generator=generator) * held for width in (2, 3))
    return Memory((torch.randn(batch, AGENTS, 5, generator=generator),), pairs, senders)


def received(memory: Memory, kind: int, env: int) -> dict[tuple[int, int], list[float]]:
    """Memory of each receiver and sender of an environment."""
    assert memory.senders is not None
    found: dict[tuple[int, int], list[float]] = {}
    for i, senders in enumerate(memory.senders[env].tolist()):
        for slot, j in enumerate(senders):
            if j != NO_AGENT:
                assert (i, j) not in found
                found[i, j] = memory.pairs[kind][env, i, slot].tolist()
    return found


@st.composite
def moves(draw: st.DrawFn) -> tuple[Tensor, Tensor]:
    """Previous places of agents at new places: fewer or more than before, with any old place for new agents."""
    agents = draw(st.integers(1, AGENTS + 2))
    source, known = torch.zeros(BATCH, agents, dtype=torch.long), torch.zeros(BATCH, agents, dtype=torch.bool)
    for b in range(BATCH):
        old = draw(st.permutations([*range(AGENTS), *[None] * agents]))[:agents]
        known[b] = torch.tensor([o is not None for o in old])
        source[b] = torch.tensor([draw(st.integers(0, AGENTS - 1)) if o is None else o for o in old])
    return source, known


@settings(max_examples=10)
@given(seed=seeds, move=moves())
def test_reorder_with_senders_against_a_loop(seed: int, move: tuple[Tensor, Tensor]):
    before, (source, known) = listed(seed), move
    after = before.reorder(source, known)
    assert after.senders is not None and after.senders.shape == (*source.shape, SLOTS)
    for b in range(BATCH):
        new = {int(source[b, i]): i for i in range(source.shape[1]) if known[b, i]}
        for i in range(source.shape[1]):
            expected = before.nodes[0][b, source[b, i]] if known[b, i] else torch.zeros(5)
            assert torch.equal(after.nodes[0][b, i], expected)
        for kind in (0, 1):
            old = received(before, kind, b)
            assert received(after, kind, b) == {
                (new[i], new[j]): m for (i, j), m in old.items() if {i, j} <= new.keys()
            }


@settings(max_examples=10)
@given(seed=seeds, slots=st.integers(1, 3))
def test_to_slots_against_a_loop(seed: int, slots: int):
    before, now = listed(seed), listed(seed + 1, slots=slots).senders
    assert now is not None
    present = now != NO_AGENT
    place = now.clamp(min=0)  # as `nearest` gives it: an empty slot has some agent's index
    after = before.to_slots(place, present)
    assert after.nodes is before.nodes and torch.equal(after.senders, now)
    for b, (kind, width) in product(range(BATCH), enumerate((2, 3))):
        old = received(before, kind, b)
        for i, slot in product(range(AGENTS), range(slots)):
            expected = old.get((i, int(now[b, i, slot])), [0.0] * width)
            assert after.pairs[kind][b, i, slot].tolist() == expected


def test_who_lost_its_slot_starts_from_zero_when_it_is_back():
    before = listed(0, batch=1)
    senders = torch.tensor([[[1, 2], [0, 2], [0, 1], [0, 1]]])
    all_agents = torch.ones(1, AGENTS, SLOTS).bool()
    first = Memory(before.nodes, tuple(torch.ones_like(m) for m in before.pairs), senders)
    away = first.to_slots(torch.tensor([[[2, 3], [0, 2], [0, 1], [0, 1]]]), all_agents)
    back = away.to_slots(senders, all_agents)
    for memory in back.pairs:
        assert not memory[0, 0, 0].any() and memory[0, 0, 1].all() and memory[0, 1:].all()


def test_padding_adds_agents_without_senders():
    before = listed(0)
    after = before.padded(AGENTS + 2)
    assert after.senders is not None and before.senders is not None
    assert torch.equal(after.senders[:, :AGENTS], before.senders) and (after.senders[:, AGENTS:] == NO_AGENT).all()
    for ours, expected in zip((*after.nodes, *after.pairs), (*before.nodes, *before.pairs), strict=True):
        assert ours.shape == (BATCH, AGENTS + 2, *expected.shape[2:])
        assert torch.equal(ours[:, :AGENTS], expected) and not ours[:, AGENTS:].any()


def tensors(memory: Memory) -> list[Tensor]:
    assert memory.senders is not None
    return [*memory.nodes, *memory.pairs, memory.senders]


def test_envs_keep_their_senders():
    before, other, envs = listed(0), listed(1, batch=2), torch.tensor([2, 0])
    for ours, old, new in zip(tensors(before.replace_envs(envs, other)), tensors(before), tensors(other), strict=True):
        assert [torch.equal(ours[b], e) for b, e in enumerate((new[1], old[1], new[0]))] == [True] * 3
    for ours, old in zip(tensors(before.select(envs)), tensors(before), strict=True):
        assert torch.equal(ours, torch.stack([old[2], old[0]]))
    joined = tensors(Memory.concatenate(before, other))
    for ours, old, new in zip(joined, tensors(before), tensors(other), strict=True):
        assert torch.equal(ours, torch.cat([old, new]))
    assert all(torch.equal(a, b) for a, b in zip(tensors(before), tensors(listed(0)), strict=True))  # not in place


def belief(senders: Tensor | None, slots: int) -> Belief:
    generator = torch.Generator().manual_seed(0)
    probs = torch.rand(BATCH, AGENTS, slots, 3, generator=generator).softmax(-1)
    features = torch.randn(BATCH, AGENTS, slots, 2, generator=generator)
    valid = torch.ones(BATCH, AGENTS).bool()
    return Belief(torch.zeros(BATCH, AGENTS, 4), valid, probs, features, senders=senders)


def test_dense_belief_against_a_loop():
    senders = listed(0).senders
    assert senders is not None
    sparse = belief(senders, SLOTS)
    dense = sparse.dense()
    assert dense.senders is None
    assert dense.states is sparse.states and dense.valid is sparse.valid
    for b, i, j in product(range(BATCH), range(AGENTS), range(AGENTS)):
        slot = senders[b, i].tolist().index(j) if j in senders[b, i] else None
        probs = torch.tensor([1.0, 0.0, 0.0]) if slot is None else sparse.edge_probs[b, i, slot]
        features = torch.zeros(2) if slot is None else sparse.edge_features[b, i, slot]
        assert torch.equal(dense.edge_probs[b, i, j], probs)
        assert torch.equal(dense.edge_features[b, i, j], features)


def test_dense_belief_of_a_dense_one_is_itself():
    for already in (belief(None, AGENTS), edgeless_belief(torch.zeros(1, 2, 4), torch.ones(1, 2).bool(), 2, 3)):
        assert already.dense() is already
