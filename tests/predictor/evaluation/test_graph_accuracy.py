import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from sklearn.metrics import accuracy_score, brier_score_loss, f1_score, precision_score, recall_score
from torch import Tensor

from predictor.evaluation.graph_accuracy import GraphAccuracy, GraphTally, graph_accuracy
from predictor.graph import pair_mask

PAIRS = pair_mask(torch.ones(1, 3).bool())
ASYMMETRIC = torch.tensor([[[0, 1, 1], [0, 0, 1], [0, 0, 0]]])
"""Three edges of six, each one way."""
FULL = torch.ones(1, 3, 3, dtype=torch.int64)


def drawn(seed: int, types: int, windows: int = 6, agents: int = 4) -> tuple[Tensor, Tensor, Tensor]:
    """Probabilities, true types and pair masks."""
    generator = torch.Generator().manual_seed(seed)
    probs = torch.softmax(2 * torch.randn(windows, agents, agents, types, generator=generator), dim=-1)
    truth = torch.randint(types, (windows, agents, agents), generator=generator)
    present = torch.rand(windows, agents, generator=generator) < 0.8
    return probs, truth, pair_mask(present)


def tallied(*batches: tuple[Tensor, Tensor | None, Tensor], types: int) -> GraphTally:
    tally = GraphTally(types)
    for batch in batches:
        tally.add(*batch)
    return tally


sets = st.builds(drawn, st.integers(0, 10**6), types=st.just(3))


@pytest.mark.parametrize(
    ("predicted", "accuracy", "f1", "connected"),
    [
        (ASYMMETRIC, 1.0, 1.0, 0.5),
        (ASYMMETRIC.mT.contiguous(), 0.0, 0.0, 0.5),  # right but for the direction
        (FULL, 0.5, 2 * 3 / (6 + 3), 1.0),
        (torch.zeros_like(FULL), 0.5, 0.0, 0.0),
        (1 - ASYMMETRIC, 0.0, 0.0, 0.5),
    ],
    ids=["exact", "reversed", "always_edge", "never_edge", "opposite"],
)
def test_closed_form(predicted: Tensor, accuracy: float, f1: float, connected: float):
    assert graph_accuracy(predicted, ASYMMETRIC, PAIRS) == pytest.approx(accuracy)
    found = tallied((predicted, ASYMMETRIC, PAIRS), types=2).results()
    assert (found.f1, found.connectivity) == pytest.approx((f1, connected))


def test_symmetric_graphs_are_counted_in_both_directions():
    truth = ASYMMETRIC + ASYMMETRIC.mT
    predicted = truth.clone()
    predicted[0, 0, 1] = 0  # one direction of one spring is missed
    assert graph_accuracy(predicted, truth, PAIRS) == pytest.approx(5 / 6)


@pytest.mark.parametrize(
    ("probability", "brier"), [(1.0, 0.0), (0.5, 0.25), (0.0, 1.0), (0.8, 0.04)], ids=["sure", "none", "wrong", "leans"]
)
def test_brier_closed_form(probability: float, brier: float):
    probs = torch.tensor([1 - probability, probability]).expand(1, 3, 3, 2)
    assert tallied((probs, FULL, PAIRS), types=2).results().brier == pytest.approx(brier, abs=1e-6)


def test_probabilities_and_their_types_agree():
    probs, truth, valid = drawn(0, types=3)
    first, second = (tallied((p, truth, valid), types=3).results() for p in (probs, probs.argmax(-1)))
    assert (first.accuracy, first.f1, first.confusion) == (second.accuracy, second.f1, second.confusion)
    assert second.brier == pytest.approx(np.mean(((probs.argmax(-1) > 0) != (truth > 0))[valid].numpy()))


def test_the_commonest_type_is_one_of_all_types_not_edge_or_none():
    truth = torch.tensor([[0, 1, 1], [2, 0, 2], [2, 1, 0]])[None]
    truth[0, 0, 1] = 2
    found = tallied((torch.ones_like(truth), truth, PAIRS), types=3).results()
    assert (found.true_connectivity, found.commonest, found.accuracy) == pytest.approx((1.0, 4 / 6, 2 / 6))


@pytest.mark.slow
@given(sets)
def test_against_scikit_learn(batch: tuple[Tensor, Tensor, Tensor]):
    probs, truth, valid = batch
    if not valid.any():
        return
    found = tallied(batch, types=3).results()
    given_, true = probs.argmax(-1)[valid].numpy(), truth[valid].numpy()
    assert found.pairs == len(true) == int(valid.sum())
    assert found.accuracy == pytest.approx(accuracy_score(true, given_))
    expected = [f(true > 0, given_ > 0, zero_division=0) for f in (f1_score, precision_score, recall_score)]
    assert [x or 0 for x in (found.f1, found.precision, found.recall)] == pytest.approx(expected)
    edge = 1 - probs[..., 0][valid].double().clamp(0, 1).numpy()
    assert found.brier == pytest.approx(brier_score_loss(true > 0, edge, labels=[False, True]), abs=1e-6)
    assert found.connectivity == pytest.approx(np.mean(given_ > 0))
    assert found.true_connectivity == pytest.approx(np.mean(true > 0))


# --- Names of types ---------------------------------------------------------------------------------------------------


def test_swapped_types_are_matched():
    opposite = 1 - ASYMMETRIC
    assert graph_accuracy(opposite, ASYMMETRIC, PAIRS, matched=True) == 1.0
    found = tallied((opposite, ASYMMETRIC, PAIRS), types=2).results(matched=True)
    assert found.f1 == 1.0
    assert found.permutation == (1, 0)
    assert found.confusion == [[3, 0], [0, 3]]
    assert found.brier == 0.0


@given(sets, st.permutations(range(3)))
def test_names_do_not_matter_when_matched(batch: tuple[Tensor, Tensor, Tensor], names: list[int]):
    probs, truth, valid = batch
    first = tallied((probs, truth, valid), types=3).results(matched=True)
    second = tallied((probs[..., names], truth, valid), types=3).results(matched=True)
    assert first.accuracy == pytest.approx(second.accuracy)
    assert first.accuracy is None or first.accuracy >= (graph_accuracy(probs, truth, valid) or 0)


@given(sets, st.permutations(range(3)))
def test_a_renamed_truth_is_found_again(batch: tuple[Tensor, Tensor, Tensor], names: list[int]):
    _, truth, valid = batch
    renamed = torch.tensor(names)[truth]
    found = tallied((renamed, truth, valid), types=3).results(matched=True)
    assert found.accuracy in (None, 1.0)
    assert found.brier in (None, 0.0)
    assert found.permutation is not None
    if len(truth[valid].unique()) == 3:
        assert [found.permutation[name] for name in names] == [0, 1, 2]


def test_one_permutation_for_the_whole_set():
    """Scene by scene each of the two would be perfect; as a set they contradict each other."""
    truth, predicted = ASYMMETRIC.repeat(2, 1, 1), torch.cat([ASYMMETRIC, 1 - ASYMMETRIC])
    valid = PAIRS.repeat(2, 1, 1)
    assert graph_accuracy(predicted, truth, valid, matched=True) == 0.5
    valid[1, 0] = False  # the first scene weighs more: its names are taken
    found = tallied((predicted, truth, valid), types=2).results(matched=True)
    assert found.permutation == (0, 1) and found.accuracy == pytest.approx(6 / 10)


def test_equally_good_names_stay_as_they_are():
    assert tallied((FULL, ASYMMETRIC, PAIRS), types=3).results(matched=True).permutation == (0, 1, 2)


def test_truth_may_have_fewer_types_than_the_model():
    predicted = torch.where(ASYMMETRIC == 1, 2, 1)
    found = tallied((predicted, ASYMMETRIC, PAIRS), types=3).results(matched=True)
    assert found.accuracy == 1.0
    assert found.permutation == (2, 0, 1)


def test_too_many_types_to_match_is_said():
    tally = tallied((FULL, FULL, PAIRS), types=8)
    assert tally.results().accuracy == 1.0
    with pytest.raises(ValueError, match="at most 7 types can be matched, got 8"):
        tally.results(matched=True)


# --- Sets -------------------------------------------------------------------------------------------------------------


@given(sets, st.integers(1, 5), st.booleans())
def test_batches_do_not_matter(batch: tuple[Tensor, Tensor, Tensor], cut: int, matched: bool):
    at_once = tallied(batch, types=3).results(matched)
    pieces = [tuple(t[:cut] for t in batch), tuple(t[cut:] for t in batch)]
    found = tallied(*pieces, types=3).results(matched)  # type: ignore[arg-type]
    assert replace(found, brier=None) == replace(at_once, brier=None)
    assert found.brier == (None if at_once.brier is None else pytest.approx(at_once.brier))


@given(sets, st.permutations(range(4)))
def test_order_of_agents_does_not_matter(batch: tuple[Tensor, Tensor, Tensor], order: list[int]):
    moved = tuple(t[:, order][:, :, order] for t in batch)
    first, second = (tallied(b, types=3).results() for b in (batch, moved))
    assert first.confusion == second.confusion
    assert first.brier == pytest.approx(second.brier)


@given(sets)
def test_pairs_that_do_not_count_leave_no_trace(batch: tuple[Tensor, Tensor, Tensor]):
    probs, truth, valid = batch
    noise = torch.where(valid[..., None], probs, math.nan), torch.where(valid, truth, 99), valid
    assert tallied(noise, types=3).results() == tallied(batch, types=3).results()
    unknown = probs, torch.where(valid, truth, -1), torch.ones_like(valid)
    assert tallied(unknown, types=3).results() == tallied(batch, types=3).results()


def test_every_step_of_a_graph_that_changes_counts():
    probs, truth, valid = (t.unflatten(0, (2, 3)) for t in drawn(0, types=3))
    assert graph_accuracy(probs, truth, valid) == graph_accuracy(*drawn(0, types=3))


@pytest.mark.parametrize("windows", [0, 1])
def test_no_valid_pair_is_none_and_not_nan(windows: int):
    nothing = torch.zeros(windows, 3, 3).bool()
    types = torch.zeros(windows, 3, 3, dtype=torch.int64)
    assert graph_accuracy(types, types, nothing) is None
    for matched in (False, True):
        found = tallied((types, types, nothing), types=2).results(matched)
        assert found == GraphAccuracy(0, None, permutation=(0, 1))
    assert GraphTally(2).results() == GraphAccuracy(0, None)


def test_without_an_edge_anywhere_there_is_no_f1():
    none = torch.zeros_like(FULL)
    found = tallied((none, none, PAIRS), types=2).results()
    assert (found.accuracy, found.f1, found.precision, found.recall) == (1.0, None, None, None)


def test_without_a_truth_only_connectivity_is_known():
    probs, _, valid = drawn(0, types=3)
    found = tallied((probs[:3], None, valid[:3]), (probs[3:], None, valid[3:]), types=3).results()
    assert found.connectivity == pytest.approx(np.mean(probs.argmax(-1)[valid].numpy() > 0))
    assert found.accuracy is found.f1 is found.brier is found.confusion is found.permutation is None
    with pytest.raises(ValueError, match="types can only be matched to true types"):
        tallied((probs, None, valid), types=3).results(matched=True)


# --- Bad input --------------------------------------------------------------------------------------------------------


def test_bad_types_are_said():
    with pytest.raises(ValueError, match="num_types must be at least 1, got 0"):
        GraphTally(0)
    with pytest.raises(ValueError, match="true types must be 0 to 1, got 2 to 2"):
        GraphTally(2).add(FULL, 2 * FULL, PAIRS)
    with pytest.raises(ValueError, match="predicted types must be 0 to 1, got -1 to -1"):
        GraphTally(2).add(-FULL, FULL, PAIRS)
    with pytest.raises(ValueError, match="probabilities need 3 types, got 2"):
        GraphTally(3).add(torch.rand(1, 3, 3, 2), FULL, PAIRS)


def test_truth_in_some_batches_only_is_refused():
    tally = tallied((FULL, FULL, PAIRS), types=2)
    with pytest.raises(ValueError, match="either all batches of a tally have true types or none"):
        tally.add(FULL, None, PAIRS)
