from dataclasses import replace

import numpy as np
import pytest

from envs.rollouts.causal_labels import IN_ARENAS
from envs.rollouts.recording import Recording, record
from envs.rollouts.world import open_world
from predictor.data.store import PERTURBATIONS

TAG = "simple_tag_v3"
QUICK = replace(IN_ARENAS, horizon_s=0.3, senders=2)


def test_a_record_says_what_was_done_to_whom():
    world = open_world("highway-fast-v0", "idle")
    plain = record(world, 1, "idle", Recording(max_steps=5))
    assert (plain.perturbed, plain.causal_shift_m, plain.label, plain.seed) == (None, None, "idle", 1)
    done = record(world, 1, "idle", Recording(max_steps=5, perturb=1.0, perturb_kinds=("brake",)))
    assert done.perturbed is not None and done.perturbed.dtype == np.int8
    assert (done.perturbed[:-1] == PERTURBATIONS.index("brake")).sum(axis=1).tolist() == [1] * (len(done.states) - 1)
    assert not done.perturbed[-1].any()
    first = int(done.perturbed[0].argmax())
    speed = np.linalg.norm(done.states[..., 2:], axis=-1)
    assert speed[1, first] < speed[0, first] - 1.0
    np.testing.assert_array_equal(done.states[0], plain.states[0])
    assert done.edge_types is not None and plain.edge_types is not None


def test_an_agent_that_is_taken_out_is_absent_where_the_mark_says_so():
    done = record(open_world(TAG, "idle"), 1, "idle", Recording(25, perturb=0.6, perturb_kinds=("remove",)))
    assert done.perturbed is not None and done.perturbed.any()
    taken = done.perturbed[:-1] == PERTURBATIONS.index("remove")
    ending = taken & ~np.concatenate([taken[1:], np.zeros_like(taken[:1])])
    assert not (done.valid[1:] & taken & ~ending).any()
    assert done.valid[1:][~taken].all()


@pytest.mark.slow
def test_labels_come_every_so_many_steps_from_a_random_one_on():
    world = open_world(TAG, "idle")
    firsts = set()
    for seed in range(4):
        found = record(world, seed, "idle", Recording(12, causal_every=5, causal=QUICK)).causal_shift_m
        assert found is not None
        steps = np.flatnonzero(~np.isnan(found).all(axis=(1, 2)))
        assert (np.diff(steps) == 5).all() and 2 <= len(steps) <= 3
        firsts.add(int(steps[0]))
    assert len(firsts) > 1 and firsts <= set(range(5))


def test_labels_change_nothing_in_the_record():
    world = open_world(TAG, "heuristic")
    plain = record(world, 3, "heuristic", Recording(8, perturb=0.5))
    labelled = record(world, 3, "heuristic", Recording(8, perturb=0.5, causal_every=3, causal=QUICK))
    for name in ("states", "valid", "ids", "perturbed"):
        np.testing.assert_array_equal(getattr(plain, name), getattr(labelled, name))
