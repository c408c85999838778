"""Data of a training: windows of all stores, split by episode into training and validation."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Int

from predictor.data.causal_edges import with_causal_edges
from predictor.data.device_windows import with_agents
from predictor.data.store import Episode, EpisodeStore, content_id, read_store
from predictor.data.windows import Windows, siblings, split_episodes
from predictor.scene import SceneSpec
from predictor.support.errors import UserError
from predictor.support.remote import address
from predictor.training.config import TrainConfig


@dataclass(frozen=True)
class TrainingData:
    """Keeps windows of all stores, split by episode."""

    spec: SceneSpec
    """Layout of the first store's scenes; the others are compatible."""
    sources: tuple[str, ...]
    """Source of each store's recordings."""
    train: list[Windows]
    """Training windows of each store."""
    val: list[Windows]
    """Windows of each store for model selection."""
    train_episodes: list[Episode]
    """All training episodes."""
    notes: tuple[str, ...] = ()
    """What the user should know about the stores, a sentence each."""


def load_data(config: TrainConfig) -> TrainingData:
    """Reads and splits the stores.

    Raises:
        UserError: stores differ in features, dt_s or whether there is an ego, have too few episodes, or val_data plays
            episodes of data or holds scenes of its recordings.
    """
    stores: list[EpisodeStore] = [read_store(path) for path in (*config.data, *config.val_data)]
    if config.causal_edges:
        if all(store.info.causal_threshold_m is None for store in stores[: len(config.data)]):
            raise UserError("causal_edges needs a store with causal labels, got none; collect one with --branches 4")
        stores = [with_causal_edges(store) for store in stores]
    paths = [address(path) for path in (*config.data, *config.val_data)]
    _check_alike(paths, stores)
    most = max(store.info.spec.max_agents for store in stores[: len(config.data)])
    spec = replace(stores[0].info.spec, max_agents=most)
    _check_labels(config, stores)
    longest = max((len(e.states) for store in stores for e in store.episodes), default=0)
    if config.horizon_steps >= longest:  # such windows would fill the memory with steps that no episode has
        raise UserError(
            f"episodes have at most {longest} steps, a horizon of {config.horizon_steps:,} needs "
            f"{config.horizon_steps + 1:,}; lower --horizon-steps or collect longer episodes"
        )
    notes = _differences(paths[: len(config.data)], stores)
    sources = tuple(s.info.source for s in stores[: len(config.data)])
    if config.val_data:
        cut = len(config.data)
        training, held_back = ({content_id(path) for path in part} for part in (config.data, config.val_data))
        if training & held_back:
            raise UserError("val_data holds a store of data, so that nothing would be held out; leave val_data out")
        _check_held_out(paths, stores, cut)
        chosen = [s.episodes[: config.max_episodes or None] if i < cut else s.episodes for i, s in enumerate(stores)]
        train = [_windows(config, e, spec, validation=False) for e in chosen[:cut]]
        val = [_windows(config, e, spec, validation=True) for e in chosen[cut:]]
        return TrainingData(spec, sources, train, val, [e for part in chosen[:cut] for e in part], notes)
    train, val, episodes, splits = [], [], [], []
    for place, store in zip(paths, stores, strict=True):
        group, few = _kept_together(store, config.val_fraction)
        parts = split_episodes(int(group.max()) + 1, config.val_fraction, config.seed)
        splits.append([np.flatnonzero(np.isin(group, part)).tolist() for part in parts])
        if few:
            notes += (
                f"{place}: {few} are too few recordings to hold out {config.val_fraction:.0%} of them, so stretches "
                "are held out beside those that are trained on; pass a larger --val-fraction, or --val-data",
            )
    # stores may have seeds, or recordings, in common: what is held out in one is not trained on in another
    marks = _marks(stores)
    held = [set[Any]().union(*(own[i] for i in held_out)) for own, (_, held_out) in zip(marks, splits, strict=True)]
    for number, (path, store, (kept, held_out)) in enumerate(zip(config.data, stores, splits, strict=True)):
        elsewhere = set[Any]().union(*held[:number], *held[number + 1 :]) - held[number]
        kept = [i for i in kept if not marks[number][i] & elsewhere][: config.max_episodes or None]
        if not kept or not held_out:
            advice = "collect more, or change --val-fraction"
            if "recordings" in store.info.provenance:
                advice = "convert with a smaller --episode-steps, or pass --val-data"
            raise UserError(
                f"{address(path)}: {len(store.episodes)} episodes split into {len(kept)} for training and "
                f"{len(held_out)} for validation; both need at least one, so {advice}"
            )
        chosen_here = [store.episodes[i] for i in kept]
        train.append(_windows(config, chosen_here, spec, validation=False))
        val.append(_windows(config, [store.episodes[i] for i in held_out], spec, validation=True))
        episodes += chosen_here
    return TrainingData(spec, sources, train, val, episodes, notes)


def _kept_together(store: EpisodeStore, val_fraction: float) -> tuple[Int[np.ndarray, " episodes"], int]:
    """Returns a number for each episode that those share which stay on one side of the split.

    These are the branches of an episode and, of data read from files, the stretches of one recording: the same agents
    moments later. Where there are too few recordings to hold out a share of them, stretches count on their own.

    Returns:
        The numbers, and the number of recordings where they are too few; 0 otherwise.
    """
    recordings = store.info.provenance.get("recordings")
    few = 0
    if isinstance(recordings, list) and len(recordings) == len(store.episodes):
        names, recording = np.unique([str(name) for name in recordings], return_inverse=True)
        if split_episodes(len(names), val_fraction, 0)[1]:
            return recording, 0
        few = len(names)
    return siblings(store.episodes), few


def _marks(stores: Sequence[EpisodeStore]) -> list[list[set[Any]]]:
    """Returns, for each episode of each store, what other stores know it by: its seed, or the scenes of a recording."""
    many = sum("seed" not in store.info.provenance for store in stores) > 1  # else no recording can be in two
    found = []
    for store in stores:
        played = [_played(store, i) for i in range(len(store.episodes))]
        found.append(
            [
                {seed} if seed is not None else _scenes([episode]) if many else set()
                for seed, episode in zip(played, store.episodes, strict=True)
            ]
        )
    return found


def _played(store: EpisodeStore, number: int) -> tuple[str, int] | None:
    """Returns the environment and seed, which say how an episode begins; None where seeds only number episodes."""
    return (store.info.source, store.episodes[number].seed) if "seed" in store.info.provenance else None


def _check_alike(paths: Sequence[str], stores: Sequence[EpisodeStore]) -> None:
    """Checks that a network for scenes of the first store can read those of all."""
    first = stores[0].info.spec
    for path, store in zip(paths, stores, strict=True):
        spec = store.info.spec
        for name in ("feature_names", "constant_features", "has_ego", "dt_s"):
            ours, theirs = getattr(first, name), getattr(spec, name)
            if abs(ours - theirs) > 1e-6 if name == "dt_s" else ours != theirs:
                raise UserError(
                    f"all stores need the same {name}, but {paths[0]} has {ours} and {path} has {theirs}; train on "
                    "stores of one kind"
                )


def _differences(paths: Sequence[str], stores: Sequence[EpisodeStore]) -> tuple[str, ...]:
    """Returns a sentence for each setting in which a store differs from the first one, whose settings are kept."""
    first = stores[0].info.spec
    return tuple(
        f"{name} is {getattr(first, name)} in {paths[0]} and {getattr(store.info.spec, name)} in {path}; the "
        "checkpoint keeps that of the first"
        for name in ("frame", "perception_m", "feature_scales")
        for path, store in zip(paths, stores, strict=False)
        if getattr(store.info.spec, name) != getattr(first, name)
    )


def _check_held_out(paths: Sequence[str], stores: Sequence[EpisodeStore], cut: int) -> None:
    """Checks that no store from `cut` on plays a seed of those before, or has a scene of their recordings."""
    played = [{p for i in range(len(store.episodes)) if (p := _played(store, i)) is not None} for store in stores]
    for path, theirs in zip(paths[cut:], played[cut:], strict=True):
        for trained, ours in zip(paths[:cut], played[:cut], strict=True):
            if both := ours & theirs:
                raise UserError(
                    f"{path} (val_data) plays {len(both)} of the episodes of {trained}: the same environment and "
                    f"seeds, such as {min(seed for _, seed in both)}; collect it with another --seed, or leave "
                    "val_data out"
                )
    recorded = [set() if "seed" in store.info.provenance else _scenes(store.episodes) for store in stores]
    for path, held_out in zip(paths[cut:], recorded[cut:], strict=True):
        for trained, scenes in zip(paths[:cut], recorded[:cut], strict=True):
            if common := held_out & scenes:
                raise UserError(
                    f"{path} (val_data) has {len(common)} of its {len(held_out)} scenes in common with {trained}: the "
                    "same recording; make it from other files, or leave val_data out"
                )


def _scenes(episodes: Sequence[Episode]) -> set[int]:
    """Returns a hash of each scene with two agents or more, by which a recording is known again."""
    return {
        hash(states[there].tobytes())
        for episode in episodes
        for states, there in zip(episode.states, episode.valid, strict=True)
        if there.sum() > 1
    }


def _check_labels(config: TrainConfig, stores: Sequence[EpisodeStore]) -> None:
    """Checks that every training store has the labels for which the config has a weight."""
    for option, name in (("label_weight", "edge_attributes"), ("type_label_weight", "edge_types")):
        for path, store in zip(config.data, stores, strict=False):
            if getattr(config, option) and any(getattr(e, name) is None for e in store.episodes[:1]):
                raise UserError(
                    f"{option} needs {name}, and store {address(path)} has none; set it to 0 or use labelled data"
                )
    kinds = {store.info.edge_attribute_names: address(path) for path, store in zip(config.data, stores, strict=False)}
    if config.label_weight and len(kinds) > 1:
        listed = ", ".join(f"{path} has {', '.join(names) or 'ones without names'}" for names, path in kinds.items())
        raise UserError(f"label_weight needs the same edge attributes in every store, but {listed}; train on one kind")


def _windows(config: TrainConfig, episodes: Sequence[Episode], spec: SceneSpec, validation: bool) -> Windows:
    whole = validation and config.val_history_steps > 1  # as in the tables: whole burn-in, whole horizon
    future, history = (config.horizon_steps, config.val_history_steps) if whole else (1, 1)
    windows = Windows(episodes, spec, config.history_steps, config.horizon_steps, future, history)
    return windows if validation else with_agents(windows)
