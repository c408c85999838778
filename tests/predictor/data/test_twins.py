"""Pairs of windows with and without an intervention: which episodes are twins, and whose shifts count."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from predictor.data.store import PERTURBATIONS, Episode
from predictor.data.twins import MOVED_WEIGHT, Twins
from tests.predictor.helpers import circling_episode, spec

HISTORY, HORIZON, NOW = 3, 4, 5
BRAKED = 1


def twins_of(seed: int, shift_m: float) -> tuple[Episode, Episode]:
    """Agent 1 is perturbed at step `NOW`; in each step after it agent 2 is `shift_m` farther off than in the twin."""
    twin = circling_episode(seed, steps=NOW + 1 + HORIZON, agents=4)
    twin = replace(twin, perturbed=np.zeros(twin.valid.shape, dtype=np.int8))
    states, marks = twin.states.copy(), np.zeros_like(twin.perturbed)
    marks[NOW - 1, BRAKED] = PERTURBATIONS.index("brake")
    states[NOW:, BRAKED, 2:] /= 2
    states[NOW + 1 :, [0, BRAKED], 0] += 7.0
    states[NOW + 1 :, 2, 0] += shift_m * np.arange(1, HORIZON + 1)
    return replace(twin, states=states, perturbed=marks), twin


def made(*shifts_m: float) -> Twins:
    episodes = [episode for seed, shift_m in enumerate(shifts_m) for episode in twins_of(seed, shift_m)]
    return Twins(episodes, spec(has_ego=True), HISTORY, HORIZON)


def test_the_shift_is_that_of_the_others():
    pairs = made(3.0).batch(np.array([0]))
    assert pairs.branches.last_observed.tolist() == pairs.twins.last_observed.tolist() == [HISTORY - 1]
    assert pairs.counted.shape == (1, 4, HORIZON)
    true_m = pairs.true_shift(2)
    whose = (true_m.norm(dim=-1) > 0).any(-1)[0]
    assert whose.sum() == 1, "neither the ego's nor the perturbed agent's"
    torch.testing.assert_close(true_m[0, whose][0, :, 0], 3.0 * torch.arange(1.0, HORIZON + 1), atol=1e-4, rtol=0)
    assert pairs.counted.any(-1).sum() == 2


def test_history_is_shared_and_the_moment_is_not():
    pairs = made(0.0).batch(np.array([0]))
    now = HISTORY - 1
    assert torch.equal(pairs.branches.states[:, :now], pairs.twins.states[:, :now])
    assert not torch.equal(pairs.branches.states[:, now], pairs.twins.states[:, now])


def test_an_agent_that_one_of_the_two_lacks_does_not_count():
    branch, twin = twins_of(0, 3.0)
    valid = twin.valid.copy()
    valid[-1, 2] = False
    pairs = Twins([branch, replace(twin, valid=valid)], spec(has_ego=True), HISTORY, HORIZON).batch(np.array([0]))
    assert pairs.counted.sum() == 2 * HORIZON - 1 and not pairs.true_shift(2)[..., -1, :].any()


@pytest.mark.parametrize("case", ["order", "seed", "agents", "marks"])
def test_other_neighbours_are_no_twins(case: str):
    branch, twin = twins_of(0, 3.0)
    episodes = {
        "order": [twin, branch],
        "seed": [branch, replace(twin, seed=1)],
        "agents": [branch, replace(twin, ids=twin.ids + 1)],
        "marks": [branch, branch],
    }[case]
    assert len(Twins(episodes, spec(has_ego=True), HISTORY, HORIZON)) == 0
    assert len(Twins([branch, twin, *episodes], spec(has_ego=True), HISTORY, HORIZON)) == 1


def test_a_branch_that_ends_at_the_moment_is_no_twin():
    """A mark of a file from elsewhere may stand anywhere."""
    branch, twin = twins_of(0, 3.0)
    marks = np.zeros_like(twin.perturbed)
    marks[-1, BRAKED] = PERTURBATIONS.index("brake")
    assert len(Twins([replace(branch, perturbed=marks), twin], spec(has_ego=True), HISTORY, HORIZON)) == 0


def test_pairs_that_move_somebody_are_drawn_more_often():
    drawn = made(5.0, 0.0).draw(20_000, np.random.default_rng(0))
    assert np.mean(drawn == 0) == pytest.approx(MOVED_WEIGHT / (1 + MOVED_WEIGHT), abs=0.02)
