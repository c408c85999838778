import math
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sklearn.metrics import r2_score

from predictor.evaluation.disentanglement import _first_half, dci, direct_r2, linear_r2, mig, mutual_information
from predictor.support.errors import UserError

POINTS = 4000


def factors(seed: int = 0, count: int = 3, points: int = POINTS) -> np.ndarray:
    """Independent, uniform attributes."""
    return np.random.default_rng(seed).uniform(0.5, 2.0, size=(points, count))


def every(target: np.ndarray) -> np.ndarray:
    return np.ones(target.shape, dtype=np.bool_)


ROTATION, _ = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))


# --- R² ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("prediction", "r2"),
    [
        ([1.0, 2.0, 3.0], 1.0),
        ([2.0, 2.0, 2.0], 0.0),  # the mean
        ([3.0, 2.0, 1.0], 1 - 8 / 2),
        ([2.0, 3.0, 4.0], 1 - 3 / 2),  # right but for an offset: not refitted
    ],
    ids=["exact", "mean", "reversed", "offset"],
)
def test_direct_r2_closed_form(prediction: list[float], r2: float):
    target = np.array([1.0, 2.0, 3.0])
    assert direct_r2(np.array(prediction), target, every(target)) == pytest.approx(r2)


def test_direct_r2_sees_only_what_counts():
    prediction, target = np.array([[1.0, 9.0], [2.0, np.nan]]), np.array([[1.0, 0.0], [2.0, 0.0]])
    assert direct_r2(prediction, target, np.array([[True, False], [True, False]])) == 1.0


@given(st.integers(0, 10**6))
def test_direct_r2_against_scikit_learn(seed: int):
    prediction, target = np.random.default_rng(seed).normal(size=(2, 30))
    assert direct_r2(prediction, target, every(target)) == pytest.approx(r2_score(target, prediction))


@pytest.mark.parametrize(
    ("target", "valid"),
    [([1.0, 2.0], [False, False]), ([1.0, 2.0], [True, False]), ([3.0, 3.0], [True, True])],
    ids=["nothing", "one", "constant"],
)
def test_no_r2_without_a_spread_to_explain(target: list[float], valid: list[bool]):
    assert direct_r2(np.zeros(2), np.array(target), np.array(valid)) is None


def test_linear_r2_reads_out_any_affine_code():
    target = factors()
    features = target @ ROTATION * [1e-3, 1.0, 1e3] + [5.0, -100.0, 0.0]
    for column in range(3):
        assert linear_r2(features, target[:, column], every(target[:, column])) == pytest.approx(1.0, abs=1e-4)


def test_linear_r2_of_features_that_know_nothing_is_about_zero():
    target = factors(count=1)[:, 0]
    noise = np.random.default_rng(1).normal(size=(POINTS, 16))
    assert linear_r2(noise, target, every(target)) == pytest.approx(0.0, abs=0.02)
    # … on the half that it was not fitted on: with few points it is worse than the mean, not better
    few = linear_r2(noise[:40], target[:40], every(target[:40]))
    assert few is not None and few < 0


def test_linear_r2_is_that_of_the_signal():
    """Feature = target + noise of equal variance: R² of the best read-out is 1/2."""
    target, noise = np.random.default_rng(0).normal(size=(2, POINTS))
    assert linear_r2((target + noise)[:, None], target, every(target)) == pytest.approx(0.5, abs=0.03)


@given(st.integers(0, 10**6))
def test_linear_r2_is_that_of_the_normal_equations(seed: int):
    rng = np.random.default_rng(seed)
    features, order = rng.normal(size=(60, 3)) * [1.0, 50.0, 0.01], np.random.default_rng(0).permutation(60)
    target = features @ rng.normal(size=3) + rng.normal(size=60)
    fit, score = order[:30], order[30:]
    mean, std = features[fit].mean(0), features[fit].std(0)
    known, asked = (features[fit] - mean) / std, (features[score] - mean) / std
    offset = target[fit].mean()
    weights = np.linalg.solve(known.T @ known + 0.1 * 30 * np.eye(3), known.T @ (target[fit] - offset))
    expected = direct_r2(asked @ weights + offset, target[score], every(target[score]))
    assert linear_r2(features, target, every(target), ridge=0.1) == pytest.approx(expected, abs=1e-9)


def test_linear_r2_does_not_mind_copies_and_constants():
    target = factors(count=1)[:, 0]
    features = np.stack([target, target, np.full(POINTS, 7.0), np.zeros(POINTS)], axis=1)
    assert linear_r2(features, target, every(target)) == pytest.approx(1.0, abs=1e-4)


def test_linear_r2_takes_pairs_of_windows_and_keeps_a_window_together():
    """A window's own mark tells its target; it is of no use for windows that were not fitted."""
    windows = 40
    target = np.random.default_rng(0).normal(size=windows)[:, None, None] * np.ones((windows, 3, 3))
    marks = np.eye(windows)[:, None, None] * np.ones((windows, 3, 3, 1))
    unseen = linear_r2(marks, target, every(target))
    assert unseen is not None and unseen < 0.1
    apart = linear_r2(marks.reshape(-1, windows), target.reshape(-1), every(target.reshape(-1)))
    assert apart is not None and apart > 0.9


def test_linear_r2_keeps_the_windows_of_an_episode_together():
    """An episode's own mark tells its target; windows of one episode in both halves would make it of use."""
    episodes = np.repeat(np.arange(40), 5)
    target = np.random.default_rng(0).normal(size=40)[episodes]
    marks = np.eye(40)[episodes]
    apart, together = linear_r2(marks, target, every(target)), linear_r2(marks, target, every(target), groups=episodes)
    assert apart is not None and apart > 0.9
    assert together is not None and together < 0.1


def test_linear_r2_sees_only_what_counts():
    target = factors(count=1, points=100)[:, 0]
    valid = np.random.default_rng(0).random(100) < 0.5
    features = np.where(valid, target, np.nan)[:, None]
    assert linear_r2(features, np.where(valid, target, np.inf), valid) == pytest.approx(1.0, abs=1e-4)


@pytest.mark.parametrize("points", [0, 1, 2, 3])
def test_linear_r2_of_too_little_is_none(points: int):
    target = np.arange(float(points))
    assert linear_r2(target[:, None], target, every(target)) is None


@pytest.mark.parametrize("half", [0, 1], ids=["fitted", "scored"])
def test_linear_r2_of_a_half_without_a_valid_entry_is_none(half: int):
    target, valid = np.arange(8.0), np.ones(8, dtype=np.bool_)
    valid[np.array_split(np.random.default_rng(0).permutation(8), 2)[half]] = False
    assert linear_r2(target[:, None], target, valid) is None


# --- DCI --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "features",
    [factors(), factors()[:, [2, 0, 1]] * [-3.0, 100.0, 1e-3] + 7],
    ids=["identity", "permuted_and_scaled"],
)
def test_dci_of_one_dimension_per_factor(features: np.ndarray):
    found = dci(features, factors())
    assert found.disentanglement == pytest.approx(1.0, abs=1e-3)
    assert found.completeness == pytest.approx(1.0, abs=1e-3)
    assert found.informativeness == pytest.approx(1.0, abs=5e-3)


def test_dci_of_features_that_know_nothing():
    found = dci(np.random.default_rng(1).normal(size=(POINTS, 3)), factors())
    assert found.disentanglement == pytest.approx(0.0, abs=0.01)
    assert found.completeness == pytest.approx(0.0, abs=0.01)
    assert found.informativeness is not None and found.informativeness < 0.01


def test_rotated_features_know_as_much_but_are_entangled():
    found = dci(factors() @ ROTATION, factors())
    assert found.informativeness is not None and found.informativeness > 0.98
    assert found.disentanglement is not None and found.disentanglement < 0.95
    even = np.array([[1.0, 1.0], [1.0, -1.0]])  # 45 degrees: each dimension serves both factors alike
    found = dci(factors(count=2) @ even, factors(count=2))
    assert found.disentanglement == pytest.approx(0.0, abs=0.05)
    assert found.completeness == pytest.approx(0.0, abs=0.05)


def test_halves_of_dci_are_of_whole_episodes():
    """Features without any relation to the factors; both are the same throughout an episode."""
    rng = np.random.default_rng(2)
    features, known = (np.repeat(rng.normal(size=(20, size)), 50, axis=0) for size in (16, 2))
    within, across = dci(features, known), dci(features, known, groups=np.repeat(np.arange(20), 50))
    assert within.informativeness is not None and within.informativeness > 0.5, "the points were seen already"
    assert across.informativeness is not None and across.informativeness < 0.0
    assert not np.any(across.importance)


def test_importance_says_which_dimension_holds_what():
    found = dci(factors()[:, [2, 0, 1]], factors())
    assert np.argmax(found.importance, axis=0).tolist() == [1, 2, 0]


def test_what_is_true_by_definition_is_not_a_score():
    assert dci(factors(), factors(count=1)).disentanglement is None
    assert dci(factors(count=1), factors()).completeness is None
    constant = dci(factors(), np.ones((POINTS, 2)))
    assert constant.informativeness is None and constant.disentanglement == 0.0


def test_dci_depends_on_the_seed_alone():
    noisy = factors() + 0.3 * np.random.default_rng(1).normal(size=(POINTS, 3))
    assert dci(noisy, factors(), seed=1) == dci(noisy, factors(), seed=1)
    assert dci(noisy, factors(), seed=1) != dci(noisy, factors(), seed=2)


def test_dci_needs_points():
    with pytest.raises(ValueError, match="dci needs at least 2 points in each half, got 1 and 2"):
        dci(np.zeros((3, 2)), np.zeros((3, 2)))


@pytest.mark.parametrize(
    "score",
    [
        lambda: dci(factors(), factors()),
        lambda: mig(factors(), factors()),
        lambda: linear_r2(factors(), factors()[:, 0], every(factors()[:, 0])),
    ],
    ids=["dci", "mig", "linear_r2"],
)
def test_without_scikit_learn_scores_say_how_to_get_it(score: Callable[[], Any], monkeypatch: pytest.MonkeyPatch):
    for name in [name for name in sys.modules if name.split(".")[0] == "sklearn"]:
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(UserError, match=r"need scikit-learn: pip install 'dgvae-rl\[scores\]'"):
        score()


# --- MIG --------------------------------------------------------------------------------------------------------------


def test_mig_of_one_dimension_per_factor():
    assert mig(factors(), factors()) == pytest.approx(1.0, abs=0.01)
    monotone = np.stack([np.exp(3 * factors()[:, 1]), -(factors()[:, 0] ** 3), factors()[:, 2]], axis=1)
    assert mig(monotone, factors()) == pytest.approx(mig(factors(), factors()), abs=1e-3)


def test_mig_of_features_that_know_nothing():
    assert mig(np.random.default_rng(1).normal(size=(POINTS, 3)), factors()) == pytest.approx(0.0, abs=0.01)


def test_mig_of_a_copy_is_zero():
    assert mig(np.tile(factors(count=1), 2), factors(count=1)) == 0.0


def test_mig_of_rotated_features_is_lower():
    rotated = mig(factors() @ ROTATION, factors())
    assert rotated is not None and rotated < 0.7


def test_mig_of_one_dimension_is_its_share_of_the_entropy():
    assert mig(factors(count=1), factors(count=1)) == pytest.approx(1.0)


def test_factors_that_never_vary_are_left_out():
    both = np.concatenate([factors(), np.ones((POINTS, 1))], axis=1)
    assert mig(factors(), both) == mig(factors(), factors())
    assert mig(factors(), np.ones((POINTS, 2))) is None


@pytest.mark.parametrize("sides", [2, 5])
def test_mutual_information_of_a_label_with_itself_is_its_entropy(sides: int):
    label = np.arange(1000.0)[:, None] % sides
    found = mutual_information(label, label)
    assert found.item() == pytest.approx(math.log(sides), abs=0.005)


@given(st.integers(0, 10**6))
def test_mutual_information_of_few_kinds_is_that_of_a_plain_histogram(seed: int):
    rng = np.random.default_rng(seed)
    first = rng.integers(4, size=3000)
    second = np.where(rng.random(3000) < 0.5, first, rng.integers(4, size=3000))
    found = mutual_information(first[:, None].astype(float), second[:, None].astype(float)).item()
    joint = np.histogram2d(first, second, bins=4)[0] / 3000
    expected = np.outer(joint.sum(1), joint.sum(0))
    plain = (joint[joint > 0] * np.log(joint[joint > 0] / expected[joint > 0])).sum()
    assert found == pytest.approx(plain - ((joint > 0).sum() - 4 - 4 + 1) / 6000, abs=1e-12)


def test_mutual_information_of_independent_columns_is_not_biased():
    rng = np.random.default_rng(0)
    found = mutual_information(rng.normal(size=(2000, 8)), rng.normal(size=(2000, 8)))
    assert found.min() >= 0 and found.mean() < 0.01  # uncorrected 20 × 20 cells would give 361 / 4000 = 0.09


def test_bins_must_divide():
    with pytest.raises(ValueError, match="bins must be at least 2, got 1"):
        mig(factors(), factors(), bins=1)


def test_dci_fits_nothing_to_the_half_that_is_scored():
    """Neither the regressor nor the scales of its inputs."""
    known, kept = factors(points=400), _first_half(400, None, 0)
    features = known + 0.3 * np.random.default_rng(1).normal(size=known.shape)
    wider = [np.where(kept[:, None], v, 3 * v - 2 * v[kept].mean(0)) for v in (features, known)]
    assert dci(*wider).importance == dci(features, known).importance
