"""Checks of identity on recorded scenes."""

import numpy as np

from envs.testing.identity import identity_problems
from envs.testing.playing import Episode, Moment
from tests.envs.helpers import HIGHWAY_SPEC

RAMMED = (
    ((-18.3, -2.0, 14.6, 0.0), (-13.5, -2.0, 5.2, 0.0)),
    ((-13.2, -2.2, 0.2, 0.0), (-8.4, -2.3, 0.1, 0.0)),
)
"""States of two vehicles of intersection-mixed-v0 before and after a second in which the first ran into the second."""
SPEC = HIGHWAY_SPEC


def episode(last: tuple[int, int]) -> Episode:
    """Six vehicles with speeds of their own for 12 s, and the two of `RAMMED` in the last step with these ids."""
    rng = np.random.default_rng(0)
    speeds = rng.uniform(5, 15, size=(6, 1)) * np.array([[1.0, 0.0]])
    places = np.arange(6)[:, None] * np.array([[0.0, 20.0]])
    moments = []
    for t in range(12):
        slips = rng.normal(scale=0.1, size=(6, 2))
        others = np.concatenate([places + t * speeds + slips, speeds], axis=1)
        pair = np.array([states[t == 11] for states in RAMMED])
        if t < 10:
            pair[:, :2] -= (10 - t) * pair[:, 2:]
        ids = np.array([0, 1, 2, 3, 4, 5, *(last if t == 11 else (6, 7))])
        moments.append(Moment(np.concatenate([others, pair]), ids, 0.0))
    return Episode(moments)


def test_a_vehicle_that_runs_into_another_keeps_its_id():
    assert identity_problems([episode((6, 7))], SPEC) == []


def test_two_that_change_ids_are_found():
    with_swap = episode((6, 7))
    with_swap.moments[5:] = [Moment(m.states, m.ids[[1, 0, *range(2, 8)]], 0.0) for m in with_swap.moments[5:]]
    (found,) = [line for line in identity_problems([with_swap], SPEC) if "change hands" in line]
    assert "in step 5 id " in found
