"""The surroundings of an agent: places in closed form, symmetries, who counts, and that forecasts depend on them."""

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from predictor.dgvae import DGVAE
from predictor.dgvae.packing import Packed, Padded
from predictor.dgvae.surroundings import _LOUD, _NEAR, Surroundings
from predictor.graph import pair_mask
from predictor.support.errors import UserError
from tests.predictor.helpers import FAST_LIKE, PLURAL, spec

DISTANCE_M, SPEED_MPS = 20.0, 2.0
OWN = [0.0, 0.0, 200.0, 0.0]
LANE_M = 4.0
PLACES = {"right": 0, "own": 1, "left": 2}
KINDS = ("near ahead", "near behind", "comes, ahead", "comes, behind", "leaves, ahead", "leaves, behind")


def around(*others: list[float], units: tuple[float, ...] = (1.0,) * 4) -> dict[tuple[str, str], float]:
    """Surroundings of an agent at the origin that drives fast along x, by lane and kind."""
    states = torch.tensor([OWN, *others]).double()[None]
    graph = Padded(pair_mask(torch.ones(1, states.shape[1]).bool()), None)
    found = Surroundings(torch.tensor(units), DISTANCE_M, SPEED_MPS).double()(graph, states / torch.tensor(units))
    rows = found[0, 0].reshape(3, 6)
    return {(lane, kind): float(rows[i, j]) for lane, i in PLACES.items() for j, kind in enumerate(KINDS)}


def near(distance_m: float) -> float:
    forward = 100 / math.sqrt(100**2 + _NEAR**2)
    share = distance_m / DISTANCE_M * forward
    return _LOUD * share / (0.1 + share) / (1 + share)


def test_a_leader_that_comes_nearer_is_ahead_on_the_own_lane():
    found = around([30.0, 0.0, 196.0, 0.0])
    assert found["own", "near ahead"] == pytest.approx(near(30.0), rel=1e-6)
    assert found["own", "comes, ahead"] == pytest.approx(near(30.0) * 2 / 3, rel=1e-4)
    assert found["own", "leaves, ahead"] == 0
    assert found["own", "near behind"] == found["own", "comes, behind"] == found["own", "leaves, behind"] == 0
    assert found["left", "near ahead"] == pytest.approx(near(30.0) * math.exp(-4), rel=1e-4)


def test_one_that_is_faster_behind_comes_nearer_and_one_that_is_slower_leaves():
    assert around([-30.0, LANE_M, 204.0, 0.0])["left", "comes, behind"] == pytest.approx(near(30.0) * 2 / 3, rel=1e-3)
    assert around([-30.0, -LANE_M, 196.0, 0.0])["right", "leaves, behind"] == pytest.approx(
        near(30.0) * 2 / 3, rel=1e-3
    )


def test_the_nearest_counts_and_who_is_behind_it_changes_nothing():
    one = around([30.0, 0.0, 196.0, 0.0])
    assert around([30.0, 0.0, 196.0, 0.0], [60.0, 0.0, 200.0, 0.0]) == pytest.approx(one, abs=1e-12)
    assert around([30.0, 0.0, 196.0, 0.0], [15.0, 0.0, 200.0, 0.0])["own", "near ahead"] > one["own", "near ahead"]


def test_alone_or_level_with_itself_nothing_is_around():
    assert set(around().values()) == {0.0}
    states = torch.tensor([[OWN]])
    itself = Padded(torch.ones(1, 1, 1).bool(), None)
    assert Surroundings(torch.ones(4), DISTANCE_M, SPEED_MPS)(itself, states).abs().max() == 0


def test_units_of_the_inputs_cancel():
    others = [30.0, 3.0, 196.0, 1.0], [-12.0, -4.0, 203.0, 0.0]
    assert around(*others, units=(100.0, 10.0, 20.0, 2.0)) == pytest.approx(around(*others), rel=1e-6)


@settings(max_examples=30)
@given(angle=st.floats(-3.0, 3.0), shift=st.floats(-50.0, 50.0), seed=st.integers(0, 2**16))
def test_they_turn_and_move_with_the_agent_and_do_not_know_the_order(angle: float, shift: float, seed: int):
    noise = torch.Generator().manual_seed(seed)
    agents = torch.randn(6, 4, generator=noise).double() * torch.tensor([20.0, 6.0, 5.0, 5.0])
    turn = torch.tensor([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]).double()
    turned = torch.cat([agents[:, :2] @ turn.T + shift, agents[:, 2:] @ turn.T], dim=-1)
    order = torch.cat([torch.zeros(1, dtype=torch.long), 1 + torch.randperm(5, generator=noise)])
    surroundings = Surroundings(torch.ones(4), DISTANCE_M, SPEED_MPS).double()
    graph = Padded(pair_mask(torch.ones(1, 6).bool()), None)
    before, after = (surroundings(graph, a[None])[0] for a in (agents, turned[order]))
    torch.testing.assert_close(after, before[order], rtol=1e-5, atol=1e-7)


@settings(max_examples=20)
@given(seed=st.integers(0, 2**16), listed=st.booleans())
def test_packed_and_padded_pairs_agree_and_absent_agents_are_not_seen(seed: int, listed: bool):
    noise = torch.Generator().manual_seed(seed)
    valid = torch.rand(3, 7, generator=noise) < 0.6
    valid[0, 0] = True
    states = torch.randn(3, 7, 4, generator=noise) * torch.tensor([30.0, 6.0, 20.0, 2.0])
    present, senders = pair_mask(valid), None
    if listed:
        senders = torch.stack([torch.randperm(7, generator=noise) for _ in range(21)]).reshape(3, 7, 7)
        present = present.gather(2, senders)
    padded = Padded(present, senders)
    packed = Packed.of(padded, valid)
    surroundings = Surroundings(torch.ones(4), DISTANCE_M, SPEED_MPS)
    quick = packed.unpack_nodes(surroundings(packed, packed.pack_nodes(states)))
    torch.testing.assert_close(quick, surroundings(padded, states) * valid[..., None])
    elsewhere = torch.where(valid[..., None], states, states + 5.0)
    torch.testing.assert_close(surroundings(padded, elsewhere)[valid], surroundings(padded, states)[valid])


def test_in_space_there_is_ahead_and_behind():
    states = torch.tensor([[[0.0, 0, 0, 100, 0, 0], [20.0, 0.0, 0.0, 100, 0, 0]]])
    found = Surroundings(torch.ones(6), DISTANCE_M, SPEED_MPS)(Padded(pair_mask(torch.ones(1, 2).bool()), None), states)
    assert found[0, 0, 6] > 0.1 and found[0, 1, 7] > 0.1 and found[0, 0, 7] == found[0, 1, 6] == 0


def test_forecasts_edges_and_modes_depend_on_them():
    torch.manual_seed(3)
    model = DGVAE(spec(), replace(PLURAL, num_neighbours=0), 3).eval()
    states = torch.tensor([[[0.0, 0, 1, 0], [2, 0, 0.5, 0], [1, 1, 1, 0]]])

    def run() -> tuple[Tensor, ...]:
        model._stepper = None
        with torch.no_grad():
            belief = model.observe(model.empty_memory(1, 3), states, torch.ones(1, 3).bool())[1]
            found = model.rollout(belief, 3, 4)
            return belief.edge_probs, found.states, found.mode_probs

    before = run()
    with torch.no_grad():
        model.encoder.conv_surroundings.weight.mul_(3.0)
    assert all((new - old).abs().max() > 1e-6 for new, old in zip(run(), before, strict=True))


def test_they_are_one_more_layer_and_need_scales():
    plain = dict(DGVAE(spec(), replace(FAST_LIKE, geometry_scales=(10.0, 2.0))).named_parameters())
    more = dict(DGVAE(spec(), replace(FAST_LIKE, geometry_scales=(10.0, 2.0), surroundings=True)).named_parameters())
    assert set(more) - set(plain) == {"encoder.conv_surroundings.weight"}
    with pytest.raises(UserError, match="surroundings needs geometry_scales, got none"):
        replace(FAST_LIKE, surroundings=True)
