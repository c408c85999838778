from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from predictor.evaluation.causal_graph import (
    BINS,
    RANKING_DRAWS,
    CausalPairs,
    average_precision,
    best_bound,
    halves,
    roc_auc,
    score_rule,
    spearman,
)
from predictor.evaluation.standard_errors import Estimate, bootstrap_draws, central_interval

metrics = pytest.importorskip("sklearn.metrics")


def value(estimate: Estimate | None) -> float:
    assert estimate is not None
    return estimate.value


def pairs(exists: object, episode: object, shift_m: object = None, receiver: object = None) -> CausalPairs:
    edges = np.asarray(exists, dtype=np.bool_)
    shifts = edges.astype(np.float64) if shift_m is None else np.asarray(shift_m, dtype=np.float64)
    receivers = np.zeros(len(edges), dtype=np.int64) if receiver is None else np.asarray(receiver)
    return CausalPairs(shifts, edges, np.asarray(episode), receivers)


def drawn(seed: int, count: int = 60) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Scores with many ties, edges, shifts, and how often each is drawn; always both classes."""
    rng = np.random.default_rng(seed)
    exists = rng.random(count) < 0.3
    exists[:2] = [True, False]
    score = np.round(rng.random(count) + 0.4 * exists, 1)
    weights = rng.integers(0, 4, count).astype(np.float64)
    weights[:2] = 1
    return score, exists, rng.random(count) + exists, weights


@settings(max_examples=25)
@given(st.integers(0, 10_000))
def test_ranking_is_scikit_learns_also_of_drawn_pairs(seed: int):
    score, exists, shift_m, weights = drawn(seed)
    rows = np.repeat(np.arange(len(score)), weights.astype(int))
    for weighted, own in ((np.ones_like(weights), np.arange(len(score))), (weights, rows)):
        s, e = score[own], exists[own]
        assert roc_auc(score, exists, weighted[None])[0] == pytest.approx(metrics.roc_auc_score(e, s))
        assert average_precision(score, exists, weighted[None])[0] == pytest.approx(
            metrics.average_precision_score(e, s)
        )
        ranks = [np.unique(v, return_inverse=True, return_counts=True)[1:] for v in (s, shift_m[own])]
        middles = [(counts.cumsum() - counts / 2)[inverse] for inverse, counts in ranks]
        assert spearman(score, shift_m, weighted[None])[0] == pytest.approx(np.corrcoef(*middles)[0, 1])


def test_rows_of_weights_are_apart():
    score, exists, shift_m, weights = drawn(3)
    both = np.stack([weights, np.ones_like(weights)])
    for measure, truth in ((roc_auc, exists), (average_precision, exists), (spearman, shift_m)):
        alone = [measure(score, truth, row[None])[0] for row in both]
        np.testing.assert_allclose(measure(score, truth, both), alone)


def test_what_is_not_defined_is_not_a_number():
    ones = np.ones((1, 3))
    nothing, everything = np.zeros(3, dtype=np.bool_), np.ones(3, dtype=np.bool_)
    score = np.array([0.1, 0.2, 0.3])
    assert np.isnan(roc_auc(score, nothing, ones)) and np.isnan(roc_auc(score, everything, ones))
    assert np.isnan(average_precision(score, nothing, ones))
    assert np.isnan(spearman(score, np.ones(3), ones))


@pytest.mark.slow
@settings(max_examples=25)
@given(st.integers(0, 10_000))
def test_the_best_bound_has_the_highest_f1_of_all(seed: int):
    score, exists, *_ = drawn(seed)
    bound = best_bound(score, exists)
    assert bound is not None
    possible = [metrics.f1_score(exists, score > b) for b in np.unique(score) - 1e-6]
    assert metrics.f1_score(exists, score > bound) == pytest.approx(max(possible))
    assert best_bound(score, np.zeros_like(exists)) is None


def test_a_bound_lies_between_neighbouring_scores_of_half_the_precision():
    """In float32 their middle is the greater one, above which there is no score."""
    score = np.array([1.0, np.nextafter(np.float32(1), np.float32(0)), 0.1, 0.2] * 2, dtype=np.float32)
    found = score_rule(score, pairs([True, False, False, False] * 2, [0] * 4 + [1] * 4), None)
    assert value(found.f1) == value(found.auc) == 1.0


def test_all_is_measured_on_the_second_half_and_the_bound_fitted_on_the_first():
    """In the first half edges score above 2, in the second above 5; both rules would be perfect on their own half."""
    exists = [True, True, False, False] * 2
    score = np.array([3.0, 4.0, 1.0, 1.5, 9.0, 8.0, 3.0, 1.0])
    found = score_rule(score, pairs(exists, [0] * 4 + [1] * 4), None)
    assert found.bound == found.fitted_bound == pytest.approx((3.0 + 1.5) / 2)
    assert (found.pairs, found.episodes, found.share) == (4, 1, 0.5)
    assert (value(found.precision), value(found.recall)) == (pytest.approx(2 / 3), 1.0)
    assert value(found.f1) == value(found.fitted) == pytest.approx(0.8)
    assert value(found.accuracy) == 0.75
    assert value(found.auc) == value(found.average_precision) == 1.0
    own = score_rule(score, pairs(exists, [0] * 4 + [1] * 4), 5.0)
    assert (own.bound, value(own.f1), value(own.fitted)) == (5.0, 1.0, pytest.approx(0.8))


def test_a_rule_without_a_bound_decides_nothing():
    """No edge in the first half, so none could be fitted; its order of the pairs is scored all the same."""
    exists = [False] * 4 + [True, True, False, False]
    found = score_rule(np.arange(8.0)[::-1].copy(), pairs(exists, [0] * 4 + [1] * 4), None)
    assert found.bound is None and value(found.auc) == 1.0
    assert found.f1 is None and found.accuracy is None and found.recall is None and found.precision is None


def test_halves_are_whole_episodes():
    first, second = halves(pairs([True] * 6, [4, 4, 7, 7, 7, 9]))
    assert first.tolist() == [True, True, False, False, False, False]
    assert (first != second).all()


def test_decisions_are_scikit_learns():
    score, exists, shift_m, _ = drawn(8)
    found = score_rule(score, pairs(exists, np.repeat([0, 1], 30), shift_m), 0.5)
    late, taken = exists[30:], score[30:] > 0.5
    assert value(found.precision) == pytest.approx(metrics.precision_score(late, taken))
    assert value(found.recall) == pytest.approx(metrics.recall_score(late, taken))
    assert value(found.f1) == pytest.approx(metrics.f1_score(late, taken))
    assert value(found.accuracy) == pytest.approx(metrics.accuracy_score(late, taken))
    assert value(found.auc) == pytest.approx(metrics.roc_auc_score(late, score[30:]))
    assert value(found.strength) == pytest.approx(spearman(score[30:], shift_m[30:], np.ones((1, 30)))[0])
    assert found.calibration_error is None and found.bins == ()


def test_calibration_closed_form():
    """Of ten pairs at 0.85 four are edges, and of ten at 0.15 one: the errors are 0.45 and 0.05."""
    exists = [True] * 4 + [False] * 6 + [True] + [False] * 9
    score = np.repeat([0.85, 0.15], 10)
    found = score_rule(np.tile(score, 2), pairs(exists * 2, np.repeat([0, 1], 20)), 0.5, probability=True)
    assert value(found.calibration_error) == pytest.approx((0.45 + 0.05) / 2)
    assert len(found.bins) == BINS and [one.pairs for one in found.bins if one.pairs] == [10, 10]
    low, high = found.bins[1], found.bins[8]
    assert (low.lower, low.upper, low.share) == pytest.approx((0.1, 0.2, 0.1)) and low.mean_prob == pytest.approx(0.15)
    assert (high.share, high.mean_prob) == pytest.approx((0.4, 0.85))
    certain = score_rule(np.ones(40), pairs([True] * 40, np.repeat([0, 1], 20)), 0.5, probability=True)
    assert value(certain.calibration_error) == 0.0 and certain.bins[9].pairs == 20


def test_spread_is_over_the_senders_of_one_receiver():
    """Receivers that differ among themselves have no spread; a lone sender does not count."""
    episode = [0] * 5 + [1] * 5
    receiver = [1, 1, 2, 2, 3] * 2
    apart = score_rule(np.tile([0.9, 0.9, 0.1, 0.1, 0.5], 2), pairs([True] * 10, episode, receiver=receiver), 0.5)
    assert apart.spread_between_senders == pytest.approx(0.0, abs=1e-9)
    within = score_rule(np.tile([0.9, 0.1, 0.9, 0.1, 0.5], 2), pairs([True] * 10, episode, receiver=receiver), 0.5)
    assert within.spread_between_senders == pytest.approx(0.4)


def test_intervals_are_over_episodes():
    """Of two tested episodes one is right and one wrong: a quarter of the draws is either twice."""
    exists = [True, False] * 4
    score = np.array([1.0, 0.0, 1.0, 0.0, 1.0, 0.0, 0.0, 1.0])
    found = score_rule(score, pairs(exists, np.repeat([0, 1, 2, 3], 2)), 0.5)
    assert found.accuracy == Estimate(0.5, (0.0, 1.0))
    assert found.auc is not None and found.auc.interval == (0.0, 1.0)
    alike = score_rule(np.tile([1.0, 0.0], 4), pairs(exists, np.repeat([0, 1, 2, 3], 2)), 0.5)
    assert alike.auc == Estimate(1.0, (1.0, 1.0))


def test_the_interval_of_a_ranking_is_of_the_draws_alone():
    rng = np.random.default_rng(5)
    episode, exists = np.repeat(range(6), 8), rng.random(48) < 0.4
    score = rng.random(48) + 0.5 * exists
    found = score_rule(score, pairs(exists, episode), 0.5).auc
    half = episode >= 3  # what is measured on
    draws = bootstrap_draws(3, draws=RANKING_DRAWS).astype(np.float64)[:, episode[half] - 3]
    assert found is not None and found.interval == central_interval(roc_auc(score[half], exists[half], draws))


def test_what_rests_on_one_episode_has_no_interval():
    """All edges of the tested half are in one of its three episodes; accuracy is of all three."""
    exists = [True, False] * 3 + [True, False] + [False] * 4
    score = np.tile([1.0, 0.0, 0.0], 4)
    found = score_rule(score, pairs(exists, np.repeat(range(6), 2)), 0.5)
    for estimate in (found.auc, found.average_precision, found.recall):
        assert estimate is not None and estimate.interval is None
    assert found.accuracy is not None and found.accuracy.interval is not None


def test_without_labels_there_are_no_numbers():
    found = score_rule(np.zeros(0), pairs([], np.zeros(0, dtype=int)), 0.5)
    assert (found.pairs, found.f1, found.auc) == (0, None, None)


def test_the_curve_ends_where_all_are_edges():
    score, exists, *_ = drawn(5, 400)
    found = score_rule(score, pairs(exists, np.repeat([0, 1], 200)), 0.5)
    assert 1 < len(found.curve) <= 60
    assert found.curve[-1] == pytest.approx((1.0, exists[200:].mean()))
    recalls = [recall for recall, _ in found.curve]
    assert recalls == sorted(recalls)


def test_edges_from_leaders_and_others_are_counted_apart():
    """Of 4 edges from leaders 3 are found, of 2 others none; a leader without an edge counts in neither."""
    exists = np.array([True] * 6 + [False] * 2)
    leads = np.array([True] * 4 + [False] * 2 + [True, False])
    score = np.array([0.9, 0.8, 0.7, 0.2, 0.3, 0.1, 0.9, 0.6])
    later = replace(pairs(np.tile(exists, 2), np.repeat([0, 1], 8)), leads=np.tile(leads, 2))
    found = score_rule(np.tile(score, 2), later, 0.5)
    assert (value(found.recall_of_leaders), value(found.recall_of_others)) == (0.75, 0.0)
    assert value(found.recall) == 0.5
    unknown = score_rule(np.tile(score, 2), replace(later, leads=None), 0.5)
    assert unknown.recall_of_leaders is None and unknown.recall_of_others is None
    assert unknown.recall == found.recall
    nobody_leads = score_rule(np.tile(score, 2), replace(later, leads=np.zeros(16, dtype=np.bool_)), 0.5)
    assert nobody_leads.recall_of_leaders is None and value(nobody_leads.recall_of_others) == 0.5


def test_leaders_of_joined_pairs_are_known_if_all_parts_know_them():
    one = replace(pairs([True, False], [0, 0]), leads=np.array([False, True]))
    other = pairs([False, True], [1, 1])
    assert CausalPairs.concatenate([one, other]).leads is None
    both = CausalPairs.concatenate([one, replace(other, leads=np.array([True, True]))])
    assert both.leads is not None and both.leads.tolist() == [False, True, True, True]
    chosen = both.where(np.array([True, True, False, False])).leads
    assert chosen is not None and chosen.tolist() == [False, True]
