"""Reads and writes the episode store: ragged episodes of scenes in one Zarr group, written once, atomically.

Within an episode an agent keeps its column from its first step to its last, so a window is a slice; absent agents have
`valid=False`. All agents of the simulator are stored; which of them the ego perceives is decided when windows are cut
(`predictor.data.windows`).
"""

import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from jaxtyping import Bool, Float, Int

from predictor.scene import PADDING_ID, Scene, SceneSpec
from predictor.support.errors import UserError
from predictor.support.files import new_folder

FORMAT = "dgvae-rl episodes"
VERSION = 1
EDGE_LABELS = ("edge_types", "edge_attributes")
_FILL = {"edge_types": -1.0, "edge_attributes": 0.0, "causal_shift_m": np.nan}
"""All labels of pairs in a store, with the value for what is not known or not there."""
PERTURBATIONS = ("none", "brake", "accelerate", "left", "right", "remove", "kick")
"""What was done to an agent; `Episode.perturbed` holds the index in this tuple."""


@dataclass(frozen=True)
class Episode:
    """One episode with every agent that ever appeared; column 0 is the ego where there is one."""

    states: Float[np.ndarray, "time agents state"]
    """States, world frame, SI units, float32; zeros where not valid."""
    valid: Bool[np.ndarray, "time agents"]
    """Whether the agent is present at the step."""
    ids: Int[np.ndarray, " agents"]
    """Identity of the agent in each column."""
    label: str = ""
    """Name of the ego's driver, or any other tag."""
    seed: int = 0
    """Seed that reproduces the episode."""
    edge_types: Int[np.ndarray, "label_time agents agents"] | None = None
    """True type of each edge, receiver first; -1 where unknown. One step if it never changes."""
    edge_attributes: Float[np.ndarray, "label_time agents agents attributes"] | None = None
    """Known properties of each edge (a spring's constant), named in `StoreInfo`; one step if they never change."""
    causal_shift_m: Float[np.ndarray, "label_time agents agents"] | None = None
    """Farthest that an intervention on the sender moves the receiver within the labels' horizon [m], receiver first;
    NaN where unknown: at all steps and for all senders that were not tried. `causal_types` makes edge types of it."""
    perturbed: Int[np.ndarray, "time agents"] | None = None
    """What is done to each agent from this step to the next, an index in `PERTURBATIONS`; None if nothing ever is."""

    @staticmethod
    def from_scenes(scenes: Sequence[Scene], label: str = "", seed: int = 0) -> "Episode":
        """Joins scenes by identity; each id gets one column, in order of appearance."""
        column: dict[int, int] = {}
        for scene in scenes:
            for agent in scene.ids[scene.valid]:
                column.setdefault(int(agent), len(column))
        states = np.zeros((len(scenes), len(column), scenes[0].states.shape[-1]), dtype=np.float32)
        valid = np.zeros((len(scenes), len(column)), dtype=np.bool_)
        for t, scene in enumerate(scenes):
            columns = [column[int(agent)] for agent in scene.ids[scene.valid]]
            states[t, columns] = scene.states[scene.valid]
            valid[t, columns] = True
        return Episode(states, valid, np.array(list(column), dtype=np.int64), label, seed)


@dataclass(frozen=True)
class StoreInfo:
    """Content and provenance of a store."""

    spec: SceneSpec
    """Layout of the states; its frame is the default of the reader that recorded them."""
    source: str
    """Env id or dataset name of the recording."""
    provenance: dict[str, Any] = field(default_factory=dict)
    """Command, versions, commit, seeds."""
    edge_attribute_names: tuple[str, ...] = ()
    """Names of the columns of the episodes' `edge_attributes`."""
    num_steps: int = 0
    """Number of scenes over all episodes; set when a store is read."""
    causal_threshold_m: float | None = None
    """Shift above which an edge counts as causal [m]; None without causal labels."""


@dataclass(frozen=True)
class EpisodeStore:
    """Store in memory."""

    info: StoreInfo
    """Content and provenance."""
    episodes: list[Episode]
    """Episodes in the order in which they were written."""

    @property
    def num_steps(self) -> int:
        """Number of scenes over all episodes."""
        return sum(len(e.states) for e in self.episodes)


def write_store(path: Path, info: StoreInfo, episodes: Iterable[Episode], overwrite: bool = False) -> None:
    """Writes a store; nothing appears under `path` until it is complete.

    Raises:
        UserError: no episodes, non-finite states, or `path` exists and `overwrite` is not set.
    """
    path = Path(path)
    if path.exists() and not overwrite:
        raise UserError(f"{path} exists; choose another path or pass --overwrite")
    if path.exists() and not (path / "zarr.json").exists():
        raise UserError(f"{path} is not an episode store and will not be replaced; choose another path")
    episodes = list(episodes)
    if not episodes:
        raise UserError("a store needs at least one episode, got none")
    marked = [e.perturbed is not None for e in episodes]
    if any(marked) and not all(marked):
        raise UserError(f"{path}: either all episodes have perturbed or none, got both")
    for episode in episodes:
        _check_finite(episode, str(path))
    columns = max(e.states.shape[1] for e in episodes)
    lengths = np.array([len(e.states) for e in episodes])
    starts = np.concatenate([[0], np.cumsum(lengths)])
    states = np.zeros((starts[-1], columns, info.spec.num_features), dtype=np.float32)
    valid = np.zeros((starts[-1], columns), dtype=np.bool_)
    perturbed = np.zeros(valid.shape, dtype=np.int8)
    ids = np.full((len(episodes), columns), PADDING_ID, dtype=np.int64)
    for i, episode in enumerate(episodes):
        steps = slice(starts[i], starts[i + 1])
        states[steps, : episode.states.shape[1]] = episode.states
        valid[steps, : episode.states.shape[1]] = episode.valid
        if episode.perturbed is not None:
            perturbed[steps, : episode.states.shape[1]] = episode.perturbed
        ids[i, : len(episode.ids)] = episode.ids
    with new_folder(path) as partial:
        group = zarr.open_group(partial, mode="w")
        chunk = max(1, min(len(states), 4096))
        every_chunk: Any = {"write_empty_chunks": True}  # so that a missing chunk is damage, not zeros
        group.create_array("states", data=states, chunks=(chunk, columns, states.shape[-1]), config=every_chunk)
        group.create_array("valid", data=valid, chunks=(chunk, columns), config=every_chunk)
        if any(marked):
            group.create_array("perturbed", data=perturbed, chunks=(chunk, columns), config=every_chunk)
        group.create_array("ids", data=ids)
        group.create_array("starts", data=starts)
        group.create_array("seeds", data=np.array([e.seed for e in episodes], dtype=np.int64))
        for name, labels in _padded_labels(episodes, columns, str(path)).items():
            group.create_array(name, data=labels, config=every_chunk)
        group.attrs.update(
            {
                "format": FORMAT,
                "version": VERSION,
                "spec": asdict(info.spec),
                "source": info.source,
                "provenance": json.loads(json.dumps(info.provenance, default=str)),
                "labels": [e.label for e in episodes],
                "edge_attribute_names": list(info.edge_attribute_names),
                "causal_threshold_m": info.causal_threshold_m,
            }
        )


def read_store(path: Path) -> EpisodeStore:
    """Reads a whole store into memory.

    Raises:
        UserError: the path holds no store, a store of another version, or non-finite states.
    """
    path = Path(path)
    if not path.exists():
        raise UserError(f"no episode store at {path}; make one with python -m envs.collect")
    try:
        group = zarr.open_group(path, mode="r")
        attrs: dict[str, Any] = dict(group.attrs)
        if attrs.get("format") != FORMAT:
            raise UserError(f"{path} is not an episode store; make one with python -m envs.collect")
        if attrs["version"] != VERSION:
            raise UserError(
                f"{path} has store version {attrs['version']}, this release reads {VERSION}; collect it anew"
            )
        arrays = {name: np.asarray(group[name]) for name in ("states", "valid", "ids", "starts", "seeds")}
        labelled = [name for name in _FILL if name in group]
        marks = ["perturbed"] if "perturbed" in group else []
        for name in ("states", "valid", *labelled, *marks):
            stored: Any = group[name]
            if stored.nchunks_initialized != stored.nchunks:  # Zarr reads what is missing as zeros
                raise UserError(f"{path}: chunks of '{name}' are missing; copy or collect it anew")
        info = _info(attrs, len(arrays["states"]))
        labels = list(attrs["labels"])
        perturbed = np.asarray(group["perturbed"]) if marks else None
        edge_labels = {name: np.asarray(group[name]) for name in labelled}
        label_starts = np.asarray(group["label_starts"]) if edge_labels else None
    except (KeyError, TypeError, OSError, RuntimeError, json.JSONDecodeError, zarr.errors.BaseZarrError) as error:
        raise UserError(f"{path} is not a readable episode store ({error}); collect it anew") from error
    episodes = []
    for i, (start, stop) in enumerate(zip(arrays["starts"][:-1], arrays["starts"][1:], strict=True)):
        present = arrays["ids"][i] != PADDING_ID
        episode = Episode(
            arrays["states"][start:stop][:, present],
            arrays["valid"][start:stop][:, present],
            arrays["ids"][i][present],
            str(labels[i]),
            int(arrays["seeds"][i]),
            perturbed=None if perturbed is None else perturbed[start:stop][:, present],
            **_labels_of(edge_labels, label_starts, i, present),
        )
        _check_finite(episode, str(path))
        episodes.append(episode)
    return EpisodeStore(info, episodes)


def read_info_of(path: Path) -> StoreInfo:
    """Reads content and provenance of a store, without its arrays.

    Raises:
        UserError: the path holds no store.
    """
    try:
        group = zarr.open_group(path, mode="r")
        states: Any = group["states"]
        return _info(dict(group.attrs), int(states.shape[0]))
    except (KeyError, TypeError, OSError, RuntimeError, json.JSONDecodeError, zarr.errors.BaseZarrError) as error:
        raise UserError(f"{path} is not a readable episode store ({error}); make it anew") from error


def _info(attrs: dict[str, Any], num_steps: int) -> StoreInfo:
    names = tuple(str(name) for name in attrs.get("edge_attribute_names", ()))
    spec = _spec_from_json(attrs["spec"])
    threshold_m = attrs.get("causal_threshold_m")
    return StoreInfo(spec, str(attrs["source"]), dict(attrs["provenance"]), names, num_steps, threshold_m)


def _padded_labels(episodes: Sequence[Episode], columns: int, where: str) -> dict[str, np.ndarray]:
    """Returns the edge labels of all episodes end to end, and where each episode begins; empty without labels."""
    given = {name: [getattr(e, name) for e in episodes] for name in _FILL}
    given = {name: labels for name, labels in given.items() if any(x is not None for x in labels)}
    if not given:
        return {}
    padded: dict[str, np.ndarray] = {}
    for name, labels in given.items():
        if any(x is None for x in labels):
            raise UserError(f"{where}: either all episodes have {name} or none, got both")
        lengths = np.array([len(x) for x in labels])
        bad = [i for i, (e, n) in enumerate(zip(episodes, lengths, strict=True)) if n not in (1, len(e.states))]
        if bad:
            raise UserError(f"{where}: {name} of episode {bad[0]} need one step or every step, got {lengths[bad[0]]}")
        starts = np.concatenate([[0], np.cumsum(lengths)])
        if not np.array_equal(padded.setdefault("label_starts", starts), starts):
            raise UserError(f"{where}: edge_types and edge_attributes need equal numbers of steps in each episode")
        joined = np.full((starts[-1], columns, columns, *labels[0].shape[3:]), _FILL[name], labels[0].dtype)
        for label, begin in zip(labels, starts[:-1], strict=True):
            joined[begin : begin + len(label), : label.shape[1], : label.shape[2]] = label
        padded[name] = joined
    return padded


def _labels_of(
    edge_labels: dict[str, np.ndarray], starts: np.ndarray | None, episode: int, present: np.ndarray
) -> dict[str, np.ndarray]:
    if starts is None:
        return {}
    steps = slice(starts[episode], starts[episode + 1])
    return {name: labels[steps][:, present][:, :, present] for name, labels in edge_labels.items()}


def causal_types(shift_m: Float[np.ndarray, "*pairs"], threshold_m: float) -> Int[np.ndarray, "*pairs"]:
    """Returns edge types of causal labels: 1 where the shift exceeds the threshold, else 0, -1 where it is unknown."""
    return np.where(np.isnan(shift_m), -1, shift_m > threshold_m).astype(np.int8)


def with_causal_edges(store: EpisodeStore, threshold_m: float | None = None) -> EpisodeStore:
    """Returns the store with causal edges in place of its edge labels, for training and scores on them.

    `edge_types` are those of `causal_types`; the one attribute of an edge is its strength, `causal_strength`. In a
    store without causal labels all edges are unknown.

    Args:
        store: a store.
        threshold_m: shift above which an edge counts [m]; None takes the store's.
    """
    given = store.info.causal_threshold_m if threshold_m is None else threshold_m
    episodes = []
    for episode in store.episodes:
        shift_m = episode.causal_shift_m
        if shift_m is None or given is None:
            shift_m = np.full((1, len(episode.ids), len(episode.ids)), np.nan, dtype=np.float32)
        types = causal_types(shift_m, given or np.inf)
        strength = causal_strength(shift_m, given or np.inf)[..., None]
        episodes.append(replace(episode, edge_types=types, edge_attributes=strength))
    info = replace(store.info, edge_attribute_names=("causal_strength",), causal_threshold_m=given)
    return EpisodeStore(info, episodes)


def causal_strength(shift_m: Float[np.ndarray, "*pairs"], threshold_m: float) -> Float[np.ndarray, "*pairs"]:
    """Returns the strength of causal edges, log(1 + shift / threshold); 0 where unknown."""
    return np.log1p(np.nan_to_num(shift_m) / threshold_m).astype(np.float32)


def _check_finite(episode: Episode, where: str) -> None:
    finite = np.isfinite(episode.states).all(axis=-1)
    if not finite.all():
        t, agent = np.argwhere(~finite)[0]
        raise UserError(
            f"{where}: states must be finite, got {episode.states[t, agent].tolist()} "
            f"(episode seed {episode.seed}, step {t}, agent {episode.ids[agent]}); remove the episode"
        )


def _spec_from_json(values: dict[str, Any]) -> SceneSpec:
    arguments: dict[str, Any] = {key: tuple(v) if isinstance(v, list) else v for key, v in values.items()}
    return SceneSpec(**arguments)
