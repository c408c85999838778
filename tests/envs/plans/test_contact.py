"""Contacts: gaps of rectangles in closed form, the first contact, and probabilities over modes and draws."""

from collections.abc import Sequence

import numpy as np
import pytest
import torch

from envs.plans.contact import FAR_M, contacts
from predictor.scene import Forecast, SceneBatch

HORIZON = 2


def meet(
    ego: Sequence[tuple[float, float]],
    other: Sequence[tuple[float, float]],
    now: tuple[float, float, float, float],
    probs: Sequence[float] | None = None,
    others: Sequence[Sequence[tuple[float, float]]] = (),
) -> tuple[Forecast, SceneBatch]:
    """One plan; the other agent's futures are `other`, or one sample for each of `others`; `now` is its state."""
    futures = others or [other]
    xy = np.zeros((1, 1, len(futures), 2, HORIZON, 2), dtype=np.float32)
    xy[:, :, :, 0], xy[0, 0, :, 1] = np.array(ego), np.array(futures)
    shares = None if probs is None else torch.tensor(probs).float()[None, None, :, None].expand(1, 1, -1, 2)
    none = torch.zeros(1, 2, 2, 2)
    forecast = Forecast(torch.from_numpy(xy), none, none, torch.ones(1, 2).bool(), mode_probs=shares)
    states = np.array([[(0.0, 0.0, 10.0, 0.0), now]])
    return forecast, SceneBatch(states, np.array([[0, 1]]), np.ones((1, 2), dtype=np.bool_), np.zeros(1))


STRAIGHT = [(10.0, 0.0), (20.0, 0.0)]


@pytest.mark.parametrize(
    ("other", "now", "gap_m", "share"),
    [
        ([(40.0, 0.0), (50.0, 0.0)], (30.0, 0.0, 10.0, 0.0), 25.0, 1.0),  # a leader at the same speed: 30 m − 5 m
        ([(10.0, 4.0), (20.0, 4.0)], (0.0, 4.0, 10.0, 0.0), 2.0, 1.0),  # beside, 4 m − 2 m
        ([(20.0, 0.0), (20.0, 0.0)], (20.0, 0.0, 0.0, 0.0), -2.0, 0.8),  # stands at 20 m: touched after 1.5 s
        ([(10.0, 0.0), (10.0, -10.0)], (10.0, 10.0, 0.0, -10.0), -3.5, 0.4),  # crosses: 3.5 m both ways
        ([(0.0, 30.0), (0.0, 30.0)], (0.0, 30.0, 0.0, 0.0), 28.0, 1.0),  # stands far away, heading along x
    ],
    ids=["leader", "beside", "standing", "crossing", "far"],
)
def test_gap_and_first_contact_in_closed_form(
    other: list[tuple[float, float]], now: tuple[float, float, float, float], gap_m: float, share: float
):
    found = contacts(*meet(STRAIGHT, other, now))
    assert found.gap_m.shape == (1, 1, 1, 1)
    assert found.gap_m[0, 0, 0, 0] == pytest.approx(gap_m, abs=1e-4)
    assert found.share[0, 0, 0, 0] == pytest.approx(share)
    assert found.by_step[0, 0, 0, 0, -1] == (share < 1)


def test_a_fast_crossing_between_two_steps_is_seen():
    """At the steps themselves both are far apart."""
    found = contacts(*meet([(10.0, 0.0), (20.0, 0.0)], [(6.0, -20.0), (6.0, -70.0)], (6.0, 30.0, 0.0, -50.0)))
    assert found.by_step.any()
    apart = np.hypot(6.0 - np.array([10.0, 20.0]), [-20.0, -70.0])
    assert apart.min() > 15


def test_a_contact_stays_one_for_later_steps():
    found = contacts(*meet(STRAIGHT, [(10.0, 0.0), (40.0, 0.0)], (12.0, 0.0, 0.0, 0.0)))
    assert found.by_step[0, 0, 0, 0].tolist() == [True, True]


def test_risk_weighs_modes_by_their_probability():
    away, ahead = [(40.0, 0.0), (50.0, 0.0)], [(20.0, 0.0), (20.0, 0.0)]
    forecast, scene = meet(STRAIGHT, away, (20.0, 0.0, 0.0, 0.0), [0.7, 0.3], [away, ahead])
    found = contacts(forecast, scene)
    np.testing.assert_allclose(found.risk(), [[[0.3]]], atol=1e-6)
    np.testing.assert_allclose(found.survival()[0, 0, -1], 0.7, atol=1e-6)


def three(probs: torch.Tensor | None) -> tuple[Forecast, SceneBatch]:
    """Two agents; sample 0 has the first one in the way, sample 1 the second one, at both steps."""
    xy = torch.zeros(1, 1, 2, 3, HORIZON, 2)
    xy[..., 0, :, 0] = torch.tensor([10.0, 20.0])
    xy[..., 1:, :, 1] = 50.0
    xy[0, 0, 0, 1], xy[0, 0, 1, 2] = xy[0, 0, 0, 0], xy[0, 0, 0, 0]
    none = torch.zeros(1, 3, 3, 2)
    states = np.array([[(0.0, 0.0, 10.0, 0.0), (0.0, 50.0, 0.0, 0.0), (0.0, 50.0, 0.0, 0.0)]])
    scene = SceneBatch(states, np.array([[0, 1, 2]]), np.ones((1, 3), dtype=np.bool_), np.zeros(1))
    return Forecast(xy, none, none, torch.ones(1, 3).bool(), mode_probs=probs), scene


def test_modes_of_agents_are_independent_and_draws_are_scenes():
    modes = contacts(*three(torch.full((1, 1, 2, 3), 0.5)))
    assert modes.survival()[0, 0, -1] == pytest.approx(0.25)
    draws = contacts(*three(None))
    assert draws.survival()[0, 0, -1] == 0.0  # one of them is in the way in every draw
    np.testing.assert_allclose(draws.risk(), [[[0.5, 0.5]]])


def test_absent_agents_are_far_away():
    forecast, scene = meet(STRAIGHT, STRAIGHT, (0.0, 0.0, 10.0, 0.0))
    scene.valid[0, 1] = False
    found = contacts(forecast, scene)
    assert found.gap_m.item() == FAR_M and found.share.item() == 1.0 and not found.by_step.any()


def test_a_forecast_that_is_no_number_is_no_free_way():
    found = contacts(*meet(STRAIGHT, [(np.nan, np.nan), (np.nan, np.nan)], (30.0, 0.0, 10.0, 0.0)))
    assert found.by_step.all() and found.share[0, 0, 0, 0] < 1


def test_an_ego_alone_meets_nobody():
    forecast, scene = meet(STRAIGHT, STRAIGHT, (30.0, 0.0, 10.0, 0.0))
    alone = Forecast(forecast.xy[:, :, :, :1], *(torch.zeros(1, 1, 1, 2),) * 2, torch.ones(1, 1).bool())
    found = contacts(alone, SceneBatch(scene.states[:, :1], scene.ids[:, :1], scene.valid[:, :1], scene.heading_rad))
    assert found.share.shape == (1, 1, 1, 0)
    np.testing.assert_array_equal(found.survival(), 1.0)
