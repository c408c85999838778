"""Contacts: gaps of rectangles in closed form, the first contact, and probabilities over modes and draws."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

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


SIZE_M = (5.0, 2.0)
found_contacts = partial(contacts, size_m=SIZE_M, dt_s=1.0)
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
    found = found_contacts(*meet(STRAIGHT, other, now))
    assert found.gap_m.shape == (1, 1, 1, 1)
    assert found.gap_m[0, 0, 0, 0] == pytest.approx(gap_m, abs=1e-4)
    assert found.share[0, 0, 0, 0] == pytest.approx(share)
    assert found.by_step[0, 0, 0, 0, -1] == (share < 1)


def test_a_fast_crossing_between_two_steps_is_seen():
    """At the steps themselves both are far apart."""
    found = found_contacts(*meet([(10.0, 0.0), (20.0, 0.0)], [(6.0, -20.0), (6.0, -70.0)], (6.0, 30.0, 0.0, -50.0)))
    assert found.by_step.any()
    apart = np.hypot(6.0 - np.array([10.0, 20.0]), [-20.0, -70.0])
    assert apart.min() > 15


def test_a_contact_stays_one_for_later_steps():
    found = found_contacts(*meet(STRAIGHT, [(10.0, 0.0), (40.0, 0.0)], (12.0, 0.0, 0.0, 0.0)))
    assert found.by_step[0, 0, 0, 0].tolist() == [True, True]


def test_risk_weighs_modes_by_their_probability():
    away, ahead = [(40.0, 0.0), (50.0, 0.0)], [(20.0, 0.0), (20.0, 0.0)]
    forecast, scene = meet(STRAIGHT, away, (20.0, 0.0, 0.0, 0.0), [0.7, 0.3], [away, ahead])
    found = found_contacts(forecast, scene)
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
    modes = found_contacts(*three(torch.full((1, 1, 2, 3), 0.5)))
    assert modes.survival()[0, 0, -1] == pytest.approx(0.25)
    draws = found_contacts(*three(None))
    assert draws.survival()[0, 0, -1] == 0.0  # one of them is in the way in every draw
    np.testing.assert_allclose(draws.risk(), [[[0.5, 0.5]]])


def test_absent_agents_are_far_away():
    forecast, scene = meet(STRAIGHT, STRAIGHT, (0.0, 0.0, 10.0, 0.0))
    scene.valid[0, 1] = False
    found = found_contacts(forecast, scene)
    assert found.gap_m.item() == FAR_M and found.share.item() == 1.0 and not found.by_step.any()


def test_a_forecast_that_is_no_number_is_no_free_way():
    found = found_contacts(*meet(STRAIGHT, [(np.nan, np.nan), (np.nan, np.nan)], (30.0, 0.0, 10.0, 0.0)))
    assert found.by_step.all() and found.share[0, 0, 0, 0] < 1


def test_an_ego_alone_meets_nobody():
    forecast, scene = meet(STRAIGHT, STRAIGHT, (30.0, 0.0, 10.0, 0.0))
    alone = Forecast(forecast.xy[:, :, :, :1], *(torch.zeros(1, 1, 1, 2),) * 2, torch.ones(1, 1).bool())
    of_ego = SceneBatch(scene.states[:, :1], scene.ids[:, :1], scene.valid[:, :1], scene.heading_rad)
    found = found_contacts(alone, of_ego)
    assert found.share.shape == (1, 1, 1, 0)
    np.testing.assert_array_equal(found.survival(), 1.0)


@pytest.mark.parametrize("ahead_m", [60.0, 72.0, 73.0, 74.0, 79.5, 99.0])
def test_no_head_on_crash_is_jumped_over(ahead_m: float):
    """33 m/s against 33 m/s: 13 m from one instant to the next, of 10 m in which they touch."""
    ego, other = [(33.0, 0.0), (66.0, 0.0)], [(ahead_m - 33.0, 0.0), (ahead_m - 66.0, 0.0)]
    found = found_contacts(*meet(ego, other, (ahead_m, 0.0, -33.0, 0.0)))
    assert found.risk()[0, 0, 0] == 1 and found.gap_m[0, 0, 0, 0] == pytest.approx(-2.0, abs=1e-4)
    assert found.share[0, 0, 0, 0] == pytest.approx((ahead_m - 5) / 132, abs=0.11), "at the nearest instant"


def test_the_least_gap_of_fast_agents_is_that_of_many_instants():
    """Only theirs is searched; of slower ones, the instants are near enough."""
    rng, searched = np.random.default_rng(0), 0
    for _ in range(40):
        start, end = rng.uniform(-40, 40, (2, 2))
        forecast, scenes = meet([(0.0, 0.0)] * 2, [tuple(end)] * 2, (*start, *(end - start)))
        x, y = (start + np.linspace(0, 1, 20_001)[:, None] * (end - start)).T
        cos, sin = (end - start) / np.hypot(*(end - start))
        along, across = 2.5 + 2.5 * abs(cos) + abs(sin), 1 + 2.5 * abs(sin) + abs(cos)
        own = np.maximum(abs(x) - along, abs(y) - across)
        turned = np.maximum(abs(x * cos + y * sin) - along, abs(y * cos - x * sin) - across)
        least, found = np.maximum(own, turned)[1:].min(), found_contacts(forecast, scenes).gap_m[0, 0, 0, 0]
        if np.hypot(*(end - start)) > 20:
            searched += 1
            assert found == pytest.approx(least, abs=4e-3)
        else:
            assert least - 1e-3 <= found <= least + 2
    assert 20 < searched < 40


@pytest.mark.parametrize("dt_s", [0.2, 0.1, 0.06, 0.05])
def test_a_slow_agent_turns_whatever_the_length_of_a_step(dt_s: float):
    """A car turns from east to north at 1.5 m/s, and passes another one, parked 1 m beside its way."""
    times = np.arange(1, round(6 / dt_s) + 1) * dt_s
    angle = np.minimum(times / 2, np.pi / 2)
    ego = np.stack([3 * np.sin(angle), 3 * (1 - np.cos(angle)) + np.maximum(0, times - np.pi) * 1.5], -1)
    xy = torch.tensor(np.stack([ego, np.tile([7.6, 7.0], (len(times), 1))])[None, None, None]).float()
    forecast = Forecast(xy, torch.zeros(1, 2, 2, 2), torch.zeros(1, 2, 2, 1), torch.ones(1, 2).bool())
    states = np.array([[(0.0, 0.0, 1.5, 0.0), (7.6, 7.0, 0.0, 0.0)]])
    scenes = SceneBatch(states, np.array([[0, 1]]), np.ones((1, 2), dtype=np.bool_), np.zeros(1))
    found = contacts(forecast, scenes, SIZE_M, dt_s)
    assert found.gap_m[0, 0, 0, 0] == pytest.approx(0.9, abs=0.05) and found.risk()[0, 0, 0] == 0


def test_an_ego_at_rest_faces_as_the_scene_says():
    """Along y it reaches 2.5 m to the side, along x 1 m; the other's half width is 1 m."""
    forecast, batch = meet([(0.0, 0.0), (0.0, 0.0)], [(10.0, 3.0), (20.0, 3.0)], (0.0, 3.0, 10.0, 0.0))
    batch.states[0, 0, 2:] = 0.0
    assert not found_contacts(forecast, batch).by_step.any()
    assert found_contacts(forecast, replace(batch, heading_rad=np.full(1, np.pi / 2))).by_step.any()
