"""Graphs and the layers on them, against plain loops over agents and slots."""

from itertools import product

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor, nn

from predictor.graph import NO_AGENT, among_nearest, nearest, off_diagonal, others, pair_mask, to_dense, with_diagonal
from predictor.layers.pairs import PairLinear, folded, sum_over_senders, to_pairs
from tests.predictor.helpers import random_presence, random_states

EXACT = {"rtol": 0.0, "atol": 1e-12}
seeds = st.integers(0, 2**16)


def draw(seed: int, *shape: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def anyone(seed: int, batch: int, agents: int, slots: int) -> Tensor:
    """Senders in any slots, several times too, the receiver itself among them."""
    return torch.randint(agents, (batch, agents, slots), generator=torch.Generator().manual_seed(seed))


def test_pair_mask_closed_form():
    valid = torch.tensor([[True, True, False], [False, False, False]])
    expected = torch.zeros(2, 3, 3, dtype=torch.bool)
    expected[0, 0, 1] = expected[0, 1, 0] = True
    assert torch.equal(pair_mask(valid), expected)


def test_pair_mask_of_one_agent_is_empty():
    assert not pair_mask(torch.tensor([True])).any()


def test_pair_linear_is_a_linear_layer_on_the_concatenation():
    torch.manual_seed(0)
    layer, nodes = PairLinear(3, 5), torch.randn(2, 4, 3)
    whole = torch.nn.Linear(6, 5)
    whole.weight.data = torch.cat([layer.receiver.weight, layer.sender.weight], dim=1)
    whole.bias.data = layer.receiver.bias.data
    pairs = layer(nodes)
    for i in range(4):
        for j in range(4):
            expected = whole(torch.cat([nodes[:, i], nodes[:, j]], dim=-1))
            torch.testing.assert_close(pairs[:, i, j], expected)


def test_relative_pair_linear_is_the_edge_convolution():
    torch.manual_seed(0)
    layer, nodes = PairLinear(3, 5, relative=True), torch.randn(4, 3)
    whole = torch.nn.Linear(6, 5)
    whole.weight.data = torch.cat([layer.receiver.weight, layer.sender.weight], dim=1)
    whole.bias.data = layer.receiver.bias.data
    pairs = layer(nodes)
    for i in range(4):
        for j in range(4):
            expected = whole(torch.cat([nodes[i], nodes[j] - nodes[i]], dim=-1))
            torch.testing.assert_close(pairs[i, j], expected)


def test_sum_over_senders_against_a_loop():
    generator = torch.Generator().manual_seed(0)
    pairs, weight = torch.randn(2, 4, 4, 3, generator=generator), torch.rand(2, 4, 4, generator=generator)
    expected = torch.zeros(2, 4, 3)
    for b in range(2):
        for receiver in range(4):
            for sender in range(4):
                expected[b, receiver] += weight[b, receiver, sender] * pairs[b, receiver, sender]
    torch.testing.assert_close(sum_over_senders(pairs, weight), expected)


# --- Without the diagonal ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("agents", [1, 2, 3, 5])
def test_others_are_all_but_oneself_in_order(agents: int):
    assert others(agents).tolist() == [[j for j in range(agents) if j != i] for i in range(agents)]


@pytest.mark.parametrize("agents", [1, 2, 3, 5])
@pytest.mark.parametrize("batch", [(), (2,), (2, 3)], ids=["none", "one", "two"])
def test_off_diagonal_leaves_out_oneself(agents: int, batch: tuple[int, ...]):
    dense = draw(0, *batch, agents, agents)
    pairs = off_diagonal(dense)
    assert pairs.shape == (*batch, agents, agents - 1)
    for i, (slot, j) in product(range(agents), enumerate(range(agents - 1))):
        assert torch.equal(pairs[..., i, slot], dense[..., i, j + (j >= i)])


def test_off_diagonal_of_a_mask_and_of_a_view():
    mask = pair_mask(random_presence(0, 3, 4))
    assert torch.equal(off_diagonal(mask), torch.stack([mask[:, i, o] for i, o in enumerate(others(4))], dim=1))
    turned = draw(0, 4, 4, 3).permute(2, 1, 0)
    assert torch.equal(off_diagonal(turned), off_diagonal(turned.clone()))


@pytest.mark.parametrize("agents", [2, 3, 5])
@pytest.mark.parametrize("batch", [(), (2,), (2, 3)], ids=["none", "one", "two"])
def test_the_diagonal_comes_back(agents: int, batch: tuple[int, ...]):
    dense, diagonal = draw(0, *batch, agents, agents, 3), draw(1, 3)
    pairs = torch.stack([off_diagonal(feature) for feature in dense.unbind(-1)], dim=-1)
    back = with_diagonal(pairs, diagonal)
    for i, j in product(range(agents), range(agents)):
        expected = diagonal.expand(*batch, 3) if i == j else dense[..., i, j, :]
        assert torch.equal(back[..., i, j, :], expected)


# --- Senders ----------------------------------------------------------------------------------------------------------


def test_to_pairs_with_one_list_for_all():
    nodes, senders = draw(0, 2, 3, 4, 5), anyone(1, 1, 4, 2)[0]
    pairs = to_pairs(nodes, senders)
    assert pairs.shape == (2, 3, 4, 2, 5)
    for i, s in product(range(4), range(2)):
        assert torch.equal(pairs[:, :, i, s], nodes[:, :, senders[i, s]])


@pytest.mark.parametrize("time", [(), (2,), (2, 1)], ids=["none", "one", "two"])
def test_to_pairs_with_a_list_for_each_scene(time: tuple[int, ...]):
    nodes, senders = draw(0, *time, 3, 4, 5), anyone(1, 3, 4, 6)
    pairs = to_pairs(nodes, senders)
    assert pairs.shape == (*time, 3, 4, 6, 5)
    for b, i, s in product(range(3), range(4), range(6)):
        assert torch.equal(pairs[..., b, i, s, :], nodes[..., b, senders[b, i, s], :])


@settings(max_examples=5)
@given(seed=seeds)
def test_to_dense_against_a_loop(seed: int):
    batch, agents, slots = 2, 4, 3
    pairs, absent = draw(seed, batch, agents, slots, 2), draw(seed + 1, 2)
    senders = draw(seed + 2, batch, agents, agents).argsort(-1)[..., :slots]  # no agent twice
    senders[draw(seed + 3, batch, agents, slots) > 0.5] = NO_AGENT  # the content of such a slot must not matter
    dense = to_dense(pairs, senders, absent)
    for b, i, j in product(range(batch), range(agents), range(agents)):
        slot = senders[b, i].tolist().index(j) if j in senders[b, i] else None
        assert torch.equal(dense[b, i, j], absent if slot is None else pairs[b, i, slot])


# --- The nearest ------------------------------------------------------------------------------------------------------


def nearest_by_loops(positions: Tensor, valid: Tensor, count: int) -> list[list[int]]:
    """The nearest others of each agent of one scene, in order."""
    agents, found = range(len(valid)), []
    for i in agents:
        candidates = [j for j in agents if j != i and valid[i] and valid[j]]
        distance = {j: (positions[i] - positions[j]).double().norm().item() for j in candidates}
        found.append(sorted(candidates, key=distance.__getitem__)[:count])
    return found


@settings(max_examples=10)
@given(seed=seeds, count=st.integers(1, 7), axes=st.sampled_from([2, 3]))
def test_nearest_against_a_loop(seed: int, count: int, axes: int):
    positions, valid = draw(seed, 3, 5, axes) * 20, random_presence(seed, 3, 5, ego=False)
    senders, present = nearest(positions, valid, count)
    assert senders.shape == present.shape == (3, 5, count)
    assert ((senders >= 0) & (senders < 5)).all()  # an empty slot can be looked up, whatever stands there
    for b, i in product(range(3), range(5)):
        expected = nearest_by_loops(positions[b], valid[b], count)[i]
        assert senders[b, i][present[b, i]].tolist() == expected
        assert present[b, i].tolist() == [True] * len(expected) + [False] * (count - len(expected))


def test_nearest_of_two_in_one_place():
    positions = torch.tensor([[[1.0, 1.0], [1.0, 1.0], [9.0, 9.0]]])
    senders, present = nearest(positions, torch.ones(1, 3).bool(), 1)
    assert senders[0, :2, 0].tolist() == [1, 0] and present.all()


def test_absent_agents_are_no_neighbours_whatever_their_position():
    positions, valid = random_states(0, 1, 4, 4)[..., :2], torch.tensor([[True, True, False, True]])
    littered = positions.clone()
    littered[0, 2] = positions[0, 0]
    for one, other in zip(nearest(positions, valid, 2), nearest(littered, valid, 2), strict=True):
        assert torch.equal(one[:, valid[0]], other[:, valid[0]])


@pytest.mark.parametrize("count", [1, 2, 7])
def test_among_nearest_against_a_loop(count: int):
    positions, valid = random_states(0, 2, 3, 5, 4)[..., :2], random_presence(0, 2, 3, 5, ego=False)
    mask = among_nearest(positions, valid, count)
    assert mask.shape == (2, 3, 5, 5)
    for b, t, i in product(range(2), range(3), range(5)):
        found = nearest_by_loops(positions[b, t], valid[b, t], count)[i]
        assert mask[b, t, i].nonzero().flatten().tolist() == sorted(found)


@pytest.mark.parametrize("agents", [25, 26])
def test_nearest_far_from_the_origin(agents: int):
    """10 km down a road in float32; beyond 25 agents torch.cdist by itself would expand the square, and be 10 m off."""
    positions, valid = random_states(0, 1, agents, 4)[..., :2] + torch.tensor([1e4, 0.0]), torch.ones(1, agents).bool()
    senders, _ = nearest(positions, valid, 3)
    assert senders[0].tolist() == nearest_by_loops(positions[0], valid[0], 3)


def test_among_nearest_of_a_single_scene():
    positions, valid = random_states(0, 5, 4)[..., :2], torch.ones(5).bool()
    assert torch.equal(among_nearest(positions, valid, 2), among_nearest(positions[None], valid[None], 2)[0])


# --- Layers -----------------------------------------------------------------------------------------------------------


def linear(seed: int, inputs: int, outputs: int, bias: bool = True) -> nn.Linear:
    torch.manual_seed(seed)
    return nn.Linear(inputs, outputs, bias).double()


@pytest.mark.parametrize("bias", [True, False])
def test_folded_is_one_layer_after_the_other(bias: bool):
    outer, inner, inputs = linear(0, 4, 3, bias), linear(1, 5, 4), draw(0, 6, 5)
    torch.testing.assert_close(nn.functional.linear(inputs, *folded(outer, inner)), outer(inner(inputs)), **EXACT)


def pair_linear(relative: bool) -> PairLinear:
    torch.manual_seed(0)
    return PairLinear(4, 5, relative).double()


@pytest.mark.parametrize("relative", [False, True])
def test_a_layer_that_nodes_are_still_to_pass(relative: bool):
    layer, after, nodes = pair_linear(relative), linear(1, 3, 4), draw(0, 2, 6, 3)
    torch.testing.assert_close(layer(nodes, after=after), layer(after(nodes)), **EXACT)


@pytest.mark.parametrize("relative", [False, True])
@pytest.mark.parametrize("folding", [False, True], ids=["plain", "folded"])
@pytest.mark.parametrize("batched", [False, True], ids=["shared", "batched"])
def test_pairs_with_senders_are_some_of_the_dense_ones(relative: bool, folding: bool, batched: bool):
    layer, after, nodes = pair_linear(relative), linear(1, 4, 4) if folding else None, draw(0, 3, 2, 6, 4)
    senders = anyone(0, 2, 6, 4) if batched else anyone(0, 1, 6, 4)[0]
    pairs, dense = layer(nodes, senders, after), layer(nodes, None, after)
    assert pairs.shape == (3, 2, 6, 4, 5)
    for b, i, s in product(range(2), range(6), range(4)):
        sender = senders[b, i, s] if batched else senders[i, s]
        torch.testing.assert_close(pairs[:, b, i, s], dense[:, b, i, sender], **EXACT)


@pytest.mark.parametrize("relative", [False, True])
def test_gradients_through_senders_are_those_of_the_dense_pairs(relative: bool):
    layer, after, leaf, senders = pair_linear(relative), linear(1, 3, 4), draw(0, 2, 4, 3), anyone(0, 2, 4, 2)
    weight, gradients = draw(1, 2, 4, 2, 5), []
    scenes, receivers = torch.arange(2)[:, None, None], torch.arange(4)[:, None]
    for dense in (False, True):
        nodes = leaf.clone().requires_grad_()
        pairs = layer(nodes, None, after)[scenes, receivers, senders] if dense else layer(nodes, senders, after)
        wrt = [nodes, *layer.parameters(), *after.parameters()]
        gradients.append(torch.autograd.grad((pairs * weight).sum(), wrt))
    torch.testing.assert_close(*gradients, **EXACT)


@pytest.mark.parametrize("extra", [False, True], ids=["alone", "extra"])
@pytest.mark.parametrize("listed", ["dense", "shared", "batched"])
def test_elu_and_its_gradients_are_those_of_the_layer_before_it(extra: bool, listed: str):
    layer, after = pair_linear(relative=True), linear(1, 3, 4)
    senders = {"dense": None, "shared": anyone(0, 1, 4, 2)[0], "batched": anyone(0, 2, 4, 2)}[listed]
    slots = 4 if senders is None else 2
    nodes, more = draw(0, 3, 2, 4, 3).requires_grad_(), draw(1, 3, 2, 4, slots, 5).requires_grad_()
    ours = layer.elu(nodes, senders, after, more if extra else None)
    plain = layer(nodes, senders, after)
    plain = nn.functional.elu(plain + more if extra else plain)
    torch.testing.assert_close(ours, plain, **EXACT)
    wrt = [nodes, *layer.parameters(), *after.parameters(), *([more] if extra else [])]
    weight = draw(2, *plain.shape)
    gradients = [torch.autograd.grad((result * weight).sum(), wrt) for result in (ours, plain)]
    torch.testing.assert_close(*gradients, **EXACT)
