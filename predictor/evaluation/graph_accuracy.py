"""Computes the accuracy of an inferred interaction graph: accuracy, F1, connectivity, Brier score.

All measures are over ordered pairs (receiver, sender), so graphs may be symmetric or not, and over a whole evaluation
set: `GraphTally` adds up confusion counts batch by batch. Type 0 is "no edge". A model trained without a true graph may
number its types differently; `matched` then renames its types by the one permutation that is best on the *whole set*
(a permutation per scene would overestimate). Without it, type 0 must be "no edge" by construction (its messages are
skipped).

Edges are unbalanced (70 % in k-springs): predicting "edge" for all pairs has the accuracy `true_connectivity`, so F1 is
more informative.
"""

import itertools
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

PairTypes = Int[Tensor, " batch *pairs"]
"""Types of pairs: windows first, then receivers and senders, with or without a time axis between them."""

PairMask = Bool[Tensor, " batch *pairs"]
"""Whether a pair counts."""

Predicted = Float[Tensor, "batch *pairs types"] | PairTypes
"""Predicted probabilities of the types, or predicted types."""

UNKNOWN = -1
"""True type of a pair whose type is unknown, as in stores."""

MAX_MATCHED_TYPES = 7
"""Largest number of types that can be matched; all 7! = 5040 permutations are tried."""


@dataclass(frozen=True)
class GraphAccuracy:
    """Accuracy of inferred graphs; None if a measure is not defined (no valid pair, no truth, no edge)."""

    pairs: int
    """Number of valid ordered pairs."""
    connectivity: float | None
    """Share of pairs whose most likely type is an edge (the paper's NBA table)."""
    accuracy: float | None = None
    """Share of pairs whose most likely type is the true one."""
    f1: float | None = None
    """F1 of "is an edge": 2 TP / (2 TP + FP + FN)."""
    precision: float | None = None
    """Precision of "is an edge": TP / (TP + FP)."""
    recall: float | None = None
    """Recall of "is an edge": TP / (TP + FN)."""
    brier: float | None = None
    """Mean squared difference between the probability of an edge and its presence: 0 is perfect, 0.25 is a
    constant probability of 0.5. Types given without probabilities count as certain."""
    true_connectivity: float | None = None
    """Share of pairs with a true edge: the accuracy of predicting "edge" for all pairs (with two types)."""
    commonest: float | None = None
    """Share of pairs of the commonest true type: the accuracy of predicting it for all pairs."""
    confusion: list[list[int]] | None = None
    """Number of pairs by true type (outer list) and most likely type (inner list), after renaming."""
    permutation: tuple[int, ...] | None = None
    """True type of each of the model's types; the identity unless matched."""


class GraphTally:
    """Adds up confusion counts, batch by batch.

    Example:
        >>> tally = GraphTally(num_types=2)
        >>> types = torch.tensor([[[0, 1], [1, 0]]])
        >>> tally.add(types, types, torch.tensor([[[False, True], [True, False]]]))
        >>> tally.results().accuracy
        1.0

    Args:
        num_types: number of edge types of the model, "no edge" included; the truth may have fewer.
    """

    def __init__(self, num_types: int) -> None:
        """Begins without windows."""
        if num_types < 1:
            raise ValueError(f"num_types must be at least 1, got {num_types}")
        self.num_types = num_types
        self._predicted = np.zeros(num_types, dtype=np.int64)
        self._confusion = np.zeros((num_types, num_types), dtype=np.int64)  # true × predicted
        self._brier = np.zeros(num_types)  # by the type taken for "no edge"
        self._has_truth: bool | None = None

    def add(self, predicted: Predicted, true_types: PairTypes | None, valid: PairMask) -> None:
        """Adds a batch of windows.

        Args:
            predicted: probabilities of the types, or types.
            true_types: true types, used where `valid`; a pair with -1 (unknown) does not count. None without any
                truth: only connectivity is computed.
            valid: pairs that count; leave out the diagonal and absent agents (`predictor.graph.pair_mask`).

        Raises:
            ValueError: a type is not below `num_types`, or only some batches have true types.
        """
        if self._has_truth not in (None, true_types is not None):
            raise ValueError("either all batches of a tally have true types or none; use two tallies")
        self._has_truth = true_types is not None
        valid = valid.cpu()
        if true_types is not None:
            true_types = true_types.cpu().long()
            valid = valid & (true_types != UNKNOWN)
            self._check(true_types[valid], "true")
        probs, types = self._as_both(predicted.detach().cpu(), valid)
        self._predicted += _count(types, valid, self.num_types)
        if true_types is None:
            return
        pair = torch.where(valid, true_types, 0) * self.num_types + types
        self._confusion += _count(pair, valid, self.num_types**2).reshape(self._confusion.shape)
        no_edge = (true_types == 0)[..., None].double()
        squared = torch.where(valid[..., None], (probs.double() - no_edge).square(), 0.0)
        self._brier += squared.flatten(0, -2).sum(0).numpy()

    def results(self, matched: bool = False) -> GraphAccuracy:
        """Returns the accuracy over all batches that were added.

        Args:
            matched: whether to rename the model's types by the permutation of highest accuracy (ties: the identity).

        Raises:
            ValueError: `matched` without true types, or with more than `MAX_MATCHED_TYPES` types.
        """
        if matched and not self._has_truth:
            raise ValueError("types can only be matched to true types; add them or pass matched=False")
        if self._has_truth is None:
            return GraphAccuracy(0, None)
        if not self._has_truth:
            return GraphAccuracy(int(self._predicted.sum()), _ratio(self._predicted[1:].sum(), self._predicted.sum()))
        permutation = _best_permutation(self._confusion) if matched else tuple(range(self.num_types))
        confusion = self._confusion[:, np.argsort(permutation)]
        pairs, hits = confusion.sum(), confusion[1:, 1:].sum()
        inferred, true = confusion[:, 1:].sum(), confusion[1:].sum()
        return GraphAccuracy(
            int(pairs),
            connectivity=_ratio(inferred, pairs),
            accuracy=_ratio(np.trace(confusion), pairs),
            f1=_ratio(2 * hits, inferred + true),
            precision=_ratio(hits, inferred),
            recall=_ratio(hits, true),
            brier=_ratio(self._brier[permutation.index(0)], pairs),
            true_connectivity=_ratio(true, pairs),
            commonest=_ratio(confusion.sum(1).max(), pairs),
            confusion=confusion.tolist() if pairs else None,
            permutation=permutation,
        )

    def _as_both(self, predicted: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
        """Returns probabilities, and types with 0 where not valid."""
        if not predicted.is_floating_point():
            self._check(predicted[valid], "predicted")
            types = torch.where(valid, predicted, 0).long()
            return torch.nn.functional.one_hot(types, self.num_types).float(), types
        if predicted.shape[-1] != self.num_types:
            raise ValueError(f"probabilities need {self.num_types} types, got {predicted.shape[-1]}")
        return predicted, predicted.argmax(-1)

    def _check(self, types: Tensor, which: str) -> None:
        if types.numel() and not 0 <= int(types.min()) <= int(types.max()) < self.num_types:
            raise ValueError(
                f"{which} types must be 0 to {self.num_types - 1}, got {int(types.min())} to {int(types.max())}"
            )


def graph_accuracy(
    predicted: Predicted,
    true_types: PairTypes,
    valid: PairMask,
    matched: bool = False,
) -> float | None:
    """Computes the share of valid pairs whose most likely type is the true one; None without a valid pair.

    Arguments and errors are those of `GraphTally.add`.
    """
    if predicted.is_floating_point():
        num_types = predicted.shape[-1]
    else:
        known = [types[valid] for types in (predicted, true_types) if valid.any()]
        num_types = 1 + max((int(types.max()) for types in known), default=0)
    tally = GraphTally(num_types)
    tally.add(predicted, true_types, valid)
    return tally.results(matched).accuracy


def _count(types: Tensor, valid: Tensor, num_types: int) -> Int[np.ndarray, " types"]:
    """Counts the valid entries by type."""
    return torch.bincount(types[valid], minlength=num_types).numpy()


def _ratio(part: float, whole: float) -> float | None:
    """Returns the share; None of nothing."""
    return float(part / whole) if whole else None


def _best_permutation(confusion: Int[np.ndarray, "types types"]) -> tuple[int, ...]:
    """Returns the true type for each predicted type for which most pairs agree; the first permutation among equals."""
    types = len(confusion)
    if types > MAX_MATCHED_TYPES:
        raise ValueError(f"at most {MAX_MATCHED_TYPES} types can be matched, got {types}")
    return max(itertools.permutations(range(types)), key=lambda p: int(confusion[list(p), range(types)].sum()))


def edge_entropy(
    edge_probs: Float[Tensor, "*batch types"], valid: Bool[Tensor, "*batch"]
) -> tuple[Float[Tensor, "*batch"], Bool[Tensor, "*batch"]]:
    """Computes the entropy of the edge type [nats] per pair: 0 is certain, log(types) is uninformative."""
    return -(edge_probs * torch.log(edge_probs.clamp(min=1e-12))).sum(-1), valid
