"""Checks of an episode before it is written: types, shapes and values of its arrays, and its ids."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from predictor.scene import LARGEST, SceneSpec
from predictor.support.config_checks import MOST_PARTS
from predictor.support.errors import UserError, short

MOST_ID = int(np.iinfo(np.int64).max)
"""Largest id and seed of a store, whose numbers have 64 bits."""


def check_episode(episode: Any, spec: SceneSpec, where: str) -> None:
    """Checks types and shapes of an episode's states, presence, ids, labels and marks of interventions.

    Args:
        episode: what was given as an `Episode`.
        spec: layout of the states.
        where: path of the store, for messages.

    Raises:
        UserError: they do not fit, an id is negative, or two agents have the same.
    """
    arrays = {name: getattr(episode, name, None) for name in ("states", "valid", "ids")}
    for name, kinds, wanted, axes in (
        ("states", "f", "floating point", 3),
        ("valid", "b", "bool", 2),
        ("ids", "iu", "integers", 1),
    ):
        array = arrays[name]
        if not isinstance(array, np.ndarray) or array.dtype.kind not in kinds or array.ndim != axes:
            wanted = f"an array of {wanted} with {axes} axes"
            raise UserError(f"{where}: {name} of an episode must be {wanted}, got {_kind(array)}")
    states, valid, ids = arrays["states"], arrays["valid"], arrays["ids"]
    assert states is not None and valid is not None and ids is not None
    if not len(states) or states.shape[:2] != valid.shape or states.shape[1] != len(ids):
        raise UserError(
            f"{where}: an episode needs one step or more, and states, valid and ids of the same agents, got "
            f"{states.shape}, {valid.shape} and {ids.shape}"
        )
    if states.shape[2] != spec.num_features:
        wanted = f"{spec.num_features} features {spec.feature_names}"
        raise UserError(f"{where}: states need {wanted}, got {states.shape[2]}")
    if (ids < 0).any() or (ids > MOST_ID).any() or len(np.unique(ids)) != len(ids):
        wanted = f"different, not negative, and at most {MOST_ID}"
        raise UserError(f"{where}: ids of an episode must be {wanted}, got {short(ids.tolist())}")
    seed, label = getattr(episode, "seed", 0), getattr(episode, "label", "")
    if not isinstance(seed, int | np.integer) or not -MOST_ID <= seed <= MOST_ID:
        raise UserError(f"{where}: the seed of an episode must be a whole number of 64 bits, got {short(seed, 60)}")
    if not isinstance(label, str):
        raise UserError(f"{where}: the label of an episode must be a text, got {short(repr(label), 60)}")
    for name, kinds, axes in (("edge_types", "iu", 3), ("edge_attributes", "f", 4), ("causal_shift_m", "f", 3)):
        labels = getattr(episode, name, None)
        if labels is None:
            continue
        fits = isinstance(labels, np.ndarray) and labels.dtype.kind in kinds and labels.ndim == axes
        if not fits or labels.shape[1:3] != (len(ids), len(ids)):
            wanted = f"{'integers' if 'i' in kinds else 'floating point'} for each pair of the {len(ids)} agents"
            raise UserError(f"{where}: {name} of an episode must be an array of {wanted}, got {_kind(labels)}")
        check_label_values(name, labels, where)
    marks = getattr(episode, "perturbed", None)
    fits = isinstance(marks, np.ndarray) and marks.dtype.kind in "iu" and marks.shape == valid.shape
    if marks is not None and not fits:
        wanted = f"an array of integers of shape {valid.shape}"
        raise UserError(f"{where}: perturbed of an episode must be {wanted}, got {_kind(marks)}")


def _kind(given: Any) -> str:
    return f"{given.dtype} {given.shape}" if isinstance(given, np.ndarray) else short(repr(given), 60)


def check_label_values(name: str, labels: np.ndarray, where: str) -> None:
    """Raises a `UserError` if a label of pairs is out of range: types, attributes, or causal shifts [m]."""
    if name == "edge_types":
        fine, wanted = (labels >= -1) & (labels < MOST_PARTS), f"lie between -1 and {MOST_PARTS - 1}"
    elif name == "edge_attributes":
        fine, wanted = np.isfinite(labels), "be finite"
    else:
        fine, wanted = (
            np.isnan(labels) | (labels >= 0) & (labels <= np.float64(LARGEST)),
            f"lie between 0 and {LARGEST:g}, or be NaN",
        )
    if not fine.all():
        raise UserError(f"{where}: '{name}' must {wanted}, got {labels[~fine][0]}; collect it anew")


def check_widths(attributes: Sequence[np.ndarray], names: Sequence[str], where: str) -> None:
    """Raises a `UserError` if episodes have other numbers of edge attributes than names, or than each other."""
    widths = sorted({labels.shape[3] for labels in attributes})
    if widths != [len(names)] if names else (len(widths) > 1 or not widths[0]):
        wanted = (
            f"the {len(names)} of edge_attribute_names" if names else "one number of them, at least 1, in all episodes"
        )
        raise UserError(f"{where}: edge_attributes need {wanted}, got {', '.join(map(str, widths))}")


def check_finite(episode: Any, where: str) -> None:
    """Raises a `UserError` if a state of an episode is not finite, or too large; names the place of the first."""
    fine = (np.abs(episode.states) <= LARGEST).all(axis=-1)
    if not fine.all():
        t, agent = np.argwhere(~fine)[0]
        wanted = f"at most {LARGEST:g} in size" if np.isfinite(episode.states[t, agent]).all() else "finite"
        raise UserError(
            f"{where}: states must be {wanted}, got {episode.states[t, agent].tolist()} "
            f"(episode seed {episode.seed}, step {t}, agent {episode.ids[agent]}); remove the episode"
        )
