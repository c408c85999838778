"""The geometry of a pair in closed form, its symmetries, and that forecasts depend on it."""

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from predictor.dgvae import DGVAE
from predictor.dgvae.geometry import _NEAR, Geometry
from predictor.support.errors import UserError
from tests.predictor.helpers import FAST_LIKE, PLURAL, spec

DISTANCE_M, SPEED_MPS = 10.0, 2.0
NAMES = ("x", "y", "vx", "vy", "ahead", "beside", "faster", "distance", "closing", "contact")


def features(receiver: list[float], sender: list[float], units: tuple[float, ...] = (1.0,) * 4) -> dict[str, float]:
    """Geometry before it is squashed, in units of the scales."""
    geometry = Geometry(torch.tensor(units), DISTANCE_M, SPEED_MPS).double()
    found = geometry(*(torch.tensor(agent).double() for agent in (receiver, sender)))
    values = found / (1 - found.abs())  # softsign undone
    return dict(zip(NAMES, values.tolist(), strict=True))


def test_a_follower_that_closes_in():
    """20 m behind its leader, 4 m/s faster, driving along x."""
    found = features([0.0, 0.0, 24.0, 0.0], [20.0, 3.0, 20.0, 0.0])
    distance = math.sqrt(2.0**2 + 0.3**2 + _NEAR**2)
    forward = 12 / math.sqrt(12**2 + _NEAR**2)
    expected = {
        "x": 2.0, "y": 0.3, "vx": -2.0, "vy": 0.0,
        "ahead": 2 * forward, "beside": 0.3 * forward, "faster": -2 * forward,
        "distance": distance, "closing": 2 * 2 / distance, "contact": 2 * 2 / distance**2,
    }  # fmt: skip
    assert found == pytest.approx(expected, rel=1e-5)


def test_units_of_the_inputs_cancel():
    plain = features([0.0, 1.0, 4.0, 1.0], [7.0, -2.0, 3.0, 0.5])
    scaled = features([0.0, 0.1, 2.0, 0.5], [0.07, -0.2, 1.5, 0.25], (100.0, 10.0, 2.0, 2.0))
    assert scaled == pytest.approx(plain, rel=1e-5)


@settings(max_examples=30)
@given(angle=st.floats(-3.0, 3.0), shift=st.floats(-50.0, 50.0), seed=st.integers(0, 2**16))
def test_what_the_receiver_sees_turns_and_moves_with_it(angle: float, shift: float, seed: int):
    """All but the first four, which are along the axes of the map."""
    agents = torch.randn(2, 4, generator=torch.Generator().manual_seed(seed)).double() * 5
    turn = torch.tensor([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]).double()
    turned = torch.cat([agents[:, :2] @ turn.T + shift, agents[:, 2:] @ turn.T], dim=-1)
    before, after = (features(*(a.tolist() for a in pair)) for pair in (agents, turned))
    for name in NAMES[4:]:
        assert after[name] == pytest.approx(before[name], rel=1e-4, abs=1e-6)


def test_an_agent_and_itself_is_at_no_distance_and_has_a_gradient():
    agents = torch.zeros(2, 1, 4, dtype=torch.float64, requires_grad=True)
    found = Geometry(torch.ones(4), DISTANCE_M, SPEED_MPS).double()(*agents)
    assert found[0, :7].abs().max() == 0 and found[0, 8:].abs().max() == 0
    found.sum().backward()
    assert torch.isfinite(agents.grad).all()


def test_in_space_the_side_is_a_distance():
    geometry = Geometry(torch.ones(6), DISTANCE_M, SPEED_MPS)
    found = geometry(torch.tensor([0.0, 0, 0, 100, 0, 0]), torch.tensor([20.0, 30, 40, 100, 0, 0]))
    assert geometry.num_features == len(found) == 12
    beside = found[7] / (1 - found[7])
    assert beside == pytest.approx(math.sqrt(3.0**2 + 4.0**2 + _NEAR**2), rel=1e-3)


@pytest.mark.parametrize("part", ["conv_geometry", "edge_geometry", "message_geometry"])
def test_every_layer_of_the_geometry_matters(part: str):
    torch.manual_seed(3)
    model = DGVAE(spec(), replace(PLURAL, num_neighbours=0), 3).eval()
    states = torch.tensor([[[0.0, 0, 1, 0], [2, 0, 0.5, 0], [1, 1, 1, 0]]])

    def run() -> Tensor:
        model._stepper = None
        with torch.no_grad():
            belief = model.observe(model.empty_memory(1, 3), states, torch.ones(1, 3).bool())[1]
            return model.rollout(belief, 3).states

    before = run()
    with torch.no_grad():
        dict(model.named_parameters())[f"{'decoder' if part[0] == 'm' else 'encoder'}.{part}.weight"].mul_(3.0)
    assert (run() - before).abs().max() > 1e-6


def test_without_scales_there_is_no_geometry():
    names = dict(DGVAE(spec(), FAST_LIKE).named_parameters())
    assert not any("geometry" in name for name in names)
    more = dict(DGVAE(spec(), replace(FAST_LIKE, geometry_scales=(10.0, 2.0))).named_parameters())
    assert sum("geometry" in name for name in more) == 3 and len(more) == len(names) + 3


@pytest.mark.parametrize("scales", [(1.0,), (1.0, 0.0), (-1.0, 2.0), (1.0, math.inf), (1.0, 2.0, 3.0)])
def test_scales_are_a_distance_and_a_speed(scales: tuple[float, ...]):
    with pytest.raises(UserError, match="geometry_scales needs a distance"):
        replace(FAST_LIKE, geometry_scales=scales)
