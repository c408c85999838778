"""Infers edges from the geometry of a pair, by gradient-boosted trees: the strongest rule that needs no network.

Trees are fitted to labels, so they say how much of the labels can be seen in the present scene by someone who has some
of them. Needs scikit-learn (the `scores` extra).
"""

import numpy as np
from jaxtyping import Bool, Float, Int

from predictor.evaluation.disentanglement import sklearn

_SETTINGS = {"max_iter": 150, "learning_rate": 0.06, "max_leaf_nodes": 15, "l2_regularization": 1.0}
"""Settings of the trees; the same everywhere, and not tuned."""
_BESIDE_M = 2.5
"""Distance from the straight line between two agents within which a third one is between them [m]: over half a lane;
in a small arena, all of it."""
_SLOW_MPS = 0.5
"""Speed below which a heading fades [m/s]."""


def pair_features(
    states: Float[np.ndarray, "agents features"],
    valid: Bool[np.ndarray, " agents"],
    receiver: Int[np.ndarray, " pairs"],
    sender: Int[np.ndarray, " pairs"],
    axes: int,
) -> Float[np.ndarray, "pairs geometry"]:
    """Describes pairs of one scene: both motions as the receiver sees them, its own, and who else is there.

    Args:
        states: states, position and velocity first [m, m/s].
        valid: which agents are there.
        receiver: row of each pair's receiver.
        sender: row of each pair's sender.
        axes: number of coordinates of a position.
    """
    where, moving = states[:, :axes], states[:, axes : 2 * axes]
    speed = np.linalg.norm(moving, axis=-1)
    heading = moving / np.sqrt(speed**2 + _SLOW_MPS**2)[:, None]
    apart, faster, ahead = where[sender] - where[receiver], moving[sender] - moving[receiver], heading[receiver]
    distance = np.linalg.norm(apart, axis=-1)
    closing = -(apart * faster).sum(axis=-1) / np.maximum(distance, 1.0)
    others = where[None] - where[receiver][:, None]  # pairs, agents, axes
    nearer = (np.linalg.norm(others, axis=-1) < distance[:, None]) & valid
    nearer[np.arange(len(receiver)), receiver] = False
    share = (others * apart[:, None]).sum(axis=-1) / np.maximum(distance, 1e-6)[:, None] ** 2
    off = np.linalg.norm(others - share[..., None] * apart[:, None], axis=-1)
    between = nearer & (share > 0) & (share < 1) & (off < _BESIDE_M)
    columns = [
        *apart.T, *faster.T, *where[receiver].T, *ahead.T, *heading[sender].T,
        *_along_and_across(apart, ahead), *_along_and_across(faster, ahead), *_along_and_across(heading[sender], ahead),
        distance, closing, closing / np.maximum(distance, 1.0), speed[receiver], speed[sender],
        nearer.sum(axis=-1), between.sum(axis=-1),
    ]  # fmt: skip
    return np.stack(columns, axis=-1).astype(np.float64)


def _along_and_across(
    vectors: Float[np.ndarray, "pairs axes"], ahead: Float[np.ndarray, "pairs axes"]
) -> tuple[Float[np.ndarray, " pairs"], Float[np.ndarray, " pairs"]]:
    """Returns the parts of vectors along a heading and across it, to the left in the plane, without a side in space."""
    along = (vectors * ahead).sum(axis=-1)
    if vectors.shape[-1] == 2:
        return along, ahead[:, 0] * vectors[:, 1] - ahead[:, 1] * vectors[:, 0]
    return along, np.linalg.norm(vectors - along[:, None] * ahead, axis=-1)


def tree_scores(
    features: Float[np.ndarray, "pairs geometry"],
    exists: Bool[np.ndarray, " pairs"],
    fit: Bool[np.ndarray, " pairs"],
) -> Float[np.ndarray, " pairs"] | None:
    """Returns the probability of an edge of each pair; None where the pairs to fit are all alike.

    Args:
        features: description of each pair.
        exists: whether each pair is an edge.
        fit: which pairs the trees are fitted to.

    Raises:
        UserError: scikit-learn is not installed.
    """
    trees = sklearn("ensemble").HistGradientBoostingClassifier(**_SETTINGS, random_state=0)
    if len(np.unique(exists[fit])) < 2:
        return None
    found: Float[np.ndarray, "pairs classes"] = trees.fit(features[fit], exists[fit]).predict_proba(features)
    return found[:, 1]
