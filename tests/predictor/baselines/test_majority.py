import numpy as np
import pytest
import torch

from predictor.baselines.majority import MajorityGraph
from predictor.data.store import Episode
from predictor.graph import pair_mask
from predictor.support.errors import UserError
from tests.predictor.helpers import random_states, spec


def labelled(types: list[list[int]] | None) -> Episode:
    return Episode(
        np.zeros((3, 3, 4), np.float32),
        np.ones((3, 3), np.bool_),
        np.arange(3),
        edge_types=None if types is None else np.array([types], np.int8),
    )


MOSTLY_2 = labelled([[0, 2, 1], [2, 0, 2], [1, 2, 0]])
HALF_UNKNOWN = labelled([[0, -1, 0], [-1, 0, -1], [0, -1, 0]])


def test_every_pair_has_the_most_frequent_type_of_two_agents():
    """The diagonal, all 0, and unknown pairs do not count: 4 of 8 pairs are of type 2."""
    forecaster = MajorityGraph.fit(spec(), 5, [MOSTLY_2, HALF_UNKNOWN])
    assert (forecaster.edge_type, forecaster.num_edge_types) == (2, 3)
    states = random_states(0, 2, 4, 4)
    valid = torch.tensor([[True] * 4, [True, True, False, True]])
    _, belief = forecaster.observe(forecaster.empty_memory(2, 4), states, valid)
    pairs = pair_mask(valid)
    assert torch.equal(belief.edge_probs[pairs], torch.tensor([0.0, 0.0, 1.0]).expand(18, 3))
    assert torch.equal(belief.edge_probs[~pairs], torch.tensor([1.0, 0.0, 0.0]).expand(14, 3)), "no pair, no edge"


@pytest.mark.parametrize(
    ("episodes", "message"),
    [
        ([labelled(None)], "needs true edge types, and the training store has none"),
        ([labelled([[0] * 3] * 3)], "needs at least two edge types, the training store has 1"),
    ],
)
def test_it_needs_labels(episodes: list[Episode], message: str):
    with pytest.raises(UserError, match=message):
        MajorityGraph.fit(spec(), 5, episodes)
