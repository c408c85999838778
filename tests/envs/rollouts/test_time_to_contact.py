"""Closed forms, and the simulator's own check of overlap as the reference."""

import math
from typing import Any

import numpy as np
import pytest
from highway_env.utils import are_polygons_intersecting
from highway_env.vehicle.objects import Obstacle

from envs.rollouts.time_to_contact import times_to_contact

CAR = (5.0, 2.0)


def contact_s(
    offset_m: tuple[float, float],
    velocity_mps: tuple[float, float],
    headings_rad: tuple[float, float] = (0.0, 0.0),
    sizes_m: tuple[tuple[float, float], tuple[float, float]] = (CAR, CAR),
) -> float:
    """Returns the time to contact of an ego and one other body."""
    found = times_to_contact(
        np.array([offset_m]),
        np.array([velocity_mps]),
        headings_rad[0],
        np.array([headings_rad[1]]),
        np.array(sizes_m[0]),
        np.array([sizes_m[1]]),
    )
    return float(found[0])


@pytest.mark.parametrize(
    ("offset_m", "velocity_mps", "headings_rad", "expected_s"),
    [
        ((65.0, 0.0), (-30.0, 0.0), (0.0, math.pi), 2.0),  # 60 m between the bumpers
        ((25.0, 0.0), (-10.0, 0.0), (0.0, 0.0), 2.0),  # 20 m to a slower leader
        ((-25.0, 0.0), (4.0, 0.0), (0.0, 0.0), 5.0),  # a faster follower
        ((25.0, 0.0), (10.0, 0.0), (0.0, 0.0), math.inf),  # it drives away
        ((25.0, 0.0), (0.0, 0.0), (0.0, 0.0), math.inf),  # it keeps its distance
        ((25.0, 4.0), (-10.0, 0.0), (0.0, 0.0), math.inf),  # in the next lane, 2 m beside
        ((25.0, 1.9), (-10.0, 0.0), (0.0, 0.0), 2.0),  # overlap of 0.1 m in width
        ((0.0, 4.0), (0.0, -1.0), (0.0, 0.0), 2.0),  # from the side, 2 m between the doors
        ((18.0, -23.5), (-10.0, 10.0), (0.0, math.pi / 2), 2.0),  # crossing: 20 m along y; along x from 1.45 to 2.15 s
        ((13.5, -23.5), (-10.0, 10.0), (0.0, math.pi / 2), math.inf),  # it has passed when the ego comes
        ((3.0, 1.0), (5.0, 0.0), (0.0, 0.0), 0.0),  # overlap already
        ((-2.0, 0.0), (0.0, 0.0), (0.0, 0.0), 0.0),
    ],
    ids=[
        "head-on", "leader", "follower", "away", "constant", "next-lane", "grazing", "sideways", "crossing",
        "passed", "overlapping", "overlapping-at-rest",
    ],
)  # fmt: skip
def test_closed_form(
    offset_m: tuple[float, float],
    velocity_mps: tuple[float, float],
    headings_rad: tuple[float, float],
    expected_s: float,
):
    assert contact_s(offset_m, velocity_mps, headings_rad) == pytest.approx(expected_s)


def test_bodies_have_their_own_sizes():
    truck = (12.0, 2.5)
    assert contact_s((28.5, 0.0), (-10.0, 0.0), sizes_m=(CAR, truck)) == pytest.approx(2.0)
    assert contact_s((28.5, 0.0), (-10.0, 0.0), sizes_m=(truck, CAR)) == pytest.approx(2.0)


def test_without_others_there_is_no_time():
    nobody = np.zeros((0, 2))
    assert times_to_contact(nobody, nobody, 0.0, np.zeros(0), np.array(CAR), nobody).shape == (0,)


def test_against_the_simulator():
    """highway-env's own check of overlap: none before the time that is found, every 20 ms, and one right after it."""
    rng, met = np.random.default_rng(3), 0
    for _ in range(24):
        headings, offset = rng.uniform(-np.pi, np.pi, 2), rng.uniform(-15, 15, 2)
        velocity = rng.uniform(-6, 6, 2) - offset / 2
        found = contact_s(tuple(offset), tuple(velocity), tuple(headings))
        ego, other = (Obstacle(None, (0.0, 0.0), heading) for heading in headings)
        ego.LENGTH, ego.WIDTH, other.LENGTH, other.WIDTH = *CAR, *CAR

        def overlap(
            time_s: float, ego: Obstacle = ego, other: Obstacle = other, at: Any = offset, by: Any = velocity
        ) -> bool:
            other.position = at + by * time_s
            return are_polygons_intersecting(ego.polygon(), other.polygon(), np.zeros(2), np.zeros(2))[0]

        assert not any(overlap(time_s) for time_s in np.arange(0.0, min(found - 1e-6, 2.0), 0.02))
        if found < math.inf:
            met += 1
            assert overlap(found + 1e-4)
    assert 5 < met < 20
