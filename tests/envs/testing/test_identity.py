"""Checks of identity on recorded scenes."""

import numpy as np
import pytest

from envs.testing.identity import identity_problems
from envs.testing.playing import Episode, Moment
from tests.envs.helpers import HIGHWAY_SPEC

RAMMED = (
    ((-18.3, -2.0, 14.6, 0.0), (-13.5, -2.0, 5.2, 0.0)),
    ((-13.2, -2.2, 0.2, 0.0), (-8.4, -2.3, 0.1, 0.0)),
)
"""States of two vehicles of intersection-mixed-v0 before and after a second in which the first ran into the second."""
RAMMED_AND_SLOWER = (
    ((204.51, 4.0, 29.34, 0.0), (226.68, 2.91, 11.43, 0.0)),
    ((212.24, 4.28, 14.59, -0.73), (224.23, 4.99, 6.18, -0.19)),
)
"""Seed 330,072 of highway-fast-v0: the first is then about as fast as the second was, and where it should be."""
RAMMED_AND_BOTH_SLOWER = (
    ((635.98, 7.70, 29.98, 1.05), (658.64, 9.21, 11.60, 0.19)),
    ((641.84, 7.58, 17.02, 1.14), (655.37, 7.09, 6.98, 0.28)),
)
"""Seed 100,001 of highway-mixed-v0: the second is then half as far off its course as the first."""
Pair = tuple[tuple[tuple[float, ...], ...], ...]
SPEC = HIGHWAY_SPEC


def episode(rammed: Pair = RAMMED) -> Episode:
    """Six vehicles with speeds of their own for 12 s, and two, one of which rams the other in the last step."""
    rng = np.random.default_rng(0)
    speeds = rng.uniform(5, 15, size=(6, 1)) * np.array([[1.0, 0.0]])
    places = np.arange(6)[:, None] * np.array([[0.0, 20.0]])
    moments = []
    for t in range(12):
        slips = rng.normal(scale=0.05, size=(6, 2))
        others = np.concatenate([places + t * speeds + slips, speeds], axis=1)
        pair = np.array([states[t == 11] for states in rammed])
        if t < 10:
            pair[:, :2] -= (10 - t) * pair[:, 2:]
        moments.append(Moment(np.concatenate([others, pair]), np.arange(8), 0.0))
    return Episode(moments)


@pytest.mark.parametrize("rammed", [RAMMED, RAMMED_AND_SLOWER, RAMMED_AND_BOTH_SLOWER])
def test_a_vehicle_that_runs_into_another_keeps_its_id(rammed: Pair):
    assert identity_problems([episode(rammed)], SPEC) == []


def test_two_that_change_ids_are_found():
    with_swap = episode()
    with_swap.moments[5:] = [Moment(m.states, m.ids[[1, 0, *range(2, 8)]], 0.0) for m in with_swap.moments[5:]]
    (found,) = [line for line in identity_problems([with_swap], SPEC) if "change hands" in line]
    assert "in step 5 id " in found


def waiting(times: int) -> list[Episode]:
    """Episodes of six vehicles at speeds of their own and two more: one stops just where the other one drives off."""
    speeds = np.arange(10.0, 16.0)
    episodes = []
    for number in range(6):
        moments = []
        for t in range(12):
            others = np.stack([t * speeds, 20.0 * np.arange(6), speeds, 0 * speeds], axis=1)
            stopped, gone = number < times and t >= 6, max(0, t - 5)
            arriving = [98.0 if stopped else 100.0 - 10 * (6 - t), -20.0, 0.0 if stopped else 10.0, 0.0]
            waited = [98.0 + 5 * gone, -20.0, 5.0 * (gone > 0), 0.0]
            moments.append(Moment(np.vstack([others, arriving, waited]), np.arange(8), 0.0))
        episodes.append(Episode(moments))
    return episodes


def test_one_that_stops_just_where_another_one_starts_has_not_taken_its_id():
    assert identity_problems(waiting(2), SPEC) == []
    (found,) = identity_problems(waiting(6), SPEC)
    assert "in step 6 id 6 is 2 m off its course, there where id 7 should be" in found
