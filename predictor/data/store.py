"""Reads and writes the episode store: ragged episodes of scenes in one Zarr group, written once, atomically.

Within an episode an agent keeps its column from its first step to its last, so a window is a slice; absent agents have
`valid=False`. All agents of the simulator are stored; which of them the ego perceives is decided when windows are cut
(`predictor.data.windows`).
"""

import hashlib
import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from predictor.data.episode_checks import check_episode, check_finite, check_label_values, check_widths
from predictor.data.store_files import (
    CONTENT,
    DIGEST,
    FORMAT,
    METADATA,
    ArrayWriter,
    StoreHeader,
    check_digest,
    check_exists,
    check_new_store,
    digest_of,
    most_bytes_of,
    open_group,
    read_arrays,
    read_header,
)
from predictor.scene import PADDING_ID, Scene, SceneSpec
from predictor.scene_checks import check_resolution
from predictor.support.config_checks import check_positive
from predictor.support.errors import UserError
from predictor.support.files import check_place, new_folder, plain, told_of
from predictor.support.locks import locked_path
from predictor.support.reading import version_of
from predictor.support.remote import address, is_remote, local_copy
from predictor.support.typed_values import converted, from_table

VERSION = 1
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
    NaN where unknown: at all steps and for all senders that were not tried. `predictor.data.causal_edges` makes edges
    of it."""
    perturbed: Int[np.ndarray, "time agents"] | None = None
    """What is done to each agent from this step to the next, an index in `PERTURBATIONS`; None if nothing ever is. Of a
    branch, what begins at its moment, in the step before it alone, also if it lasts."""

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

    def __post_init__(self) -> None:
        """Checks ranges.

        Raises:
            UserError: a value is out of range.
        """
        check_positive(self, "causal_threshold_m")


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
        UserError: no episodes, arrays that do not fit, states that are not finite or too far from zero for float32,
            `path` exists and `overwrite` is not set, or another process writes it.
    """
    path = Path(path)
    check_new_store(path, overwrite)
    with locked_path(path):
        _write(path, info, list(episodes))


def _write(path: Path, info: StoreInfo, episodes: Sequence[Episode]) -> None:
    """Writes a store in place of what is there."""
    if not episodes:
        raise UserError("a store needs at least one episode, got none")
    for episode in episodes:
        check_episode(episode, info.spec, str(path))
        check_finite(episode, str(path))
        check_resolution(episode.states, info.spec, f"{address(path)}, episode seed {episode.seed}")
        if episode.perturbed is not None and not np.isin(episode.perturbed, range(len(PERTURBATIONS))).all():
            raise UserError(f"{address(path)}: perturbed must lie between 0 and {len(PERTURBATIONS) - 1}")
    marked = [e.perturbed is not None for e in episodes]
    if any(marked) and not all(marked):
        raise UserError(f"{address(path)}: either all episodes have perturbed or none, got both")
    columns = max(e.states.shape[1] for e in episodes)
    if not columns:
        raise UserError(f"{address(path)}: a store needs at least one agent, got none")
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
    labels = _padded_labels(episodes, columns, info.edge_attribute_names, str(path))
    with new_folder(path) as partial:
        group = open_group(partial, mode="w")
        chunk = max(1, min(len(states), 4096))
        arrays = ArrayWriter(group)
        arrays.write("states", states, chunks=(chunk, columns, states.shape[-1]))
        arrays.write("valid", valid, chunks=(chunk, columns))
        if any(marked):
            arrays.write("perturbed", perturbed, chunks=(chunk, columns))
        small = {"ids": ids, "starts": starts, "seeds": np.array([e.seed for e in episodes], dtype=np.int64)}
        for name, data in (small | labels).items():
            arrays.write(name, data)
        attributes = {
            "format": FORMAT,
            "version": VERSION,
            "spec": asdict(info.spec),
            "source": info.source,
            "provenance": info.provenance,
            "labels": [e.label for e in episodes],
            "edge_attribute_names": list(info.edge_attribute_names),
            "causal_threshold_m": info.causal_threshold_m,
            CONTENT: arrays.content.hexdigest(),
        }
        text = json.dumps(attributes, default=plain, ensure_ascii=False)
        written = json.loads(text.encode("utf-8", "replace").decode())  # a label may be the name of a file, no UTF-8
        group.attrs.update(written | {DIGEST: digest_of(written)})
        with told_of(path, partial):
            header = read_header(partial, FORMAT)
            _checked_labels(partial, header, _info(partial, header))


def read_store(path: Path) -> EpisodeStore:
    """Reads a whole store into memory.

    Raises:
        UserError: the path holds no store, a store of another version, or non-finite states.
    """
    path = Path(path)
    check_place(path)
    check_exists(path)
    if is_remote(path):
        with local_copy(path, most_bytes_of) as copy:
            return read_store(copy)
    header = read_header(path, FORMAT)
    info = _info(path, header)
    labels = _checked_labels(path, header, info)
    check_digest(path, header.attributes)
    arrays = read_arrays(path, header)
    _check_arrays(path, arrays)
    edge_labels = {name: arrays[name] for name in _FILL if name in arrays}
    episodes = []
    for i, (start, stop) in enumerate(zip(arrays["starts"][:-1], arrays["starts"][1:], strict=True)):
        present = arrays["ids"][i] != PADDING_ID
        episode = Episode(
            arrays["states"][start:stop][:, present],
            arrays["valid"][start:stop][:, present],
            arrays["ids"][i][present],
            labels[i],
            int(arrays["seeds"][i]),
            perturbed=arrays["perturbed"][start:stop][:, present] if "perturbed" in arrays else None,
            **_labels_of(edge_labels, arrays.get("label_starts"), i, present),
        )
        check_finite(episode, str(path))
        episodes.append(episode)
    return EpisodeStore(info, episodes)


def read_info_of(path: Path) -> StoreInfo:
    """Reads content and provenance of a store, without its arrays.

    Raises:
        UserError: the path holds no store.
    """
    return _info_and_hash(Path(path))[0]


def content_id(path: Path) -> str:
    """Returns a hash of layout, source, provenance, length and arrays (of older stores without arrays); reads none.

    Raises:
        UserError: as `read_info_of`.
    """
    info, arrays = _info_and_hash(Path(path))
    made = {k: v for k, v in info.provenance.items() if k not in ("time", "machine", "versions", "commit", "command")}
    content = json.dumps([asdict(info.spec), info.source, made, info.num_steps, *arrays], sort_keys=True, default=str)
    return hashlib.sha256(content.encode()).hexdigest()


def _info_and_hash(path: Path) -> tuple[StoreInfo, list[Any]]:
    if is_remote(path):
        with local_copy(path, lambda name: most_bytes_of(name) if name == METADATA else None) as copy:
            return _info_and_hash(copy)
    header = read_header(path, FORMAT)
    check_digest(path, header.attributes)
    return _info(path, header), [header.attributes[key] for key in (CONTENT,) if key in header.attributes]


def _info(path: Path, header: StoreHeader) -> StoreInfo:
    """Returns what the attributes say, after a check of their types and ranges."""
    attributes, where = header.attributes, f"{path}: attributes"
    version_of(attributes, VERSION, f"store {path}")
    for key in ("spec", "source", "provenance"):
        if key not in attributes:
            raise UserError(f"{where}: key '{key}' is missing; collect the store anew")
    known = ("spec", "source", "provenance", "edge_attribute_names", "causal_threshold_m")
    given = {key: attributes[key] for key in known if key in attributes}
    return from_table(StoreInfo, given, where, {"num_steps": header.shapes["states"][0]})


def _checked_labels(path: Path, header: StoreHeader, info: StoreInfo) -> tuple[str, ...]:
    """Returns the tags of the episodes, after a check that the shapes of all arrays fit together."""
    shapes = header.shapes
    steps, agents, _ = shapes["states"]
    episodes = shapes["seeds"][0]
    edges = ("edge_types", "edge_attributes", "causal_shift_m")
    wanted: dict[str, tuple[int, ...]] = {
        "states": (steps, agents, info.spec.num_features),
        "valid": (steps, agents),
        "perturbed": (steps, agents),
        "ids": (episodes, agents),
        "starts": (episodes + 1,),
        "label_starts": (episodes + 1,),
    }
    label_steps = next((shapes[name][0] for name in edges if name in shapes), 0)
    wanted |= dict.fromkeys(edges, (label_steps, agents, agents))
    if "edge_attributes" in shapes:
        wanted["edge_attributes"] += (len(info.edge_attribute_names) or shapes["edge_attributes"][-1],)
    for name, shape in shapes.items():
        if shape != wanted.get(name, shape):
            hint = " (edge_attribute_names)" if name == "edge_attributes" else ""
            raise UserError(f"{path}: '{name}' must have the shape {wanted[name]}{hint}, got {shape}; collect it anew")
    if any(name in shapes for name in edges) != ("label_starts" in shapes):
        raise UserError(f"{path}: labels of edges and label_starts belong together; collect it anew")
    labels: tuple[str, ...] = converted(header.attributes.get("labels"), tuple[str, ...], f"{path}: labels")
    if len(labels) != episodes:
        raise UserError(f"{path}: labels must be as many as episodes ({episodes}), got {len(labels)}")
    return labels


def _check_arrays(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Checks the values of the arrays that say where episodes begin and who is in them, and of labels."""
    last = {"starts": len(arrays["states"]), "label_starts": 0}
    last["label_starts"] = next((len(arrays[name]) for name in _FILL if name in arrays), 0)
    for name in ("starts", "label_starts"):
        places = arrays.get(name)
        # not by differences, which wrap around
        if places is not None and (places[0] != 0 or places[-1] != last[name] or (places[1:] <= places[:-1]).any()):
            raise UserError(f"{path}: '{name}' must rise from 0 to {last[name]}; copy or collect it anew")
    if "label_starts" in arrays:
        labelled, steps = (np.diff(arrays[name].astype(np.int64)) for name in ("label_starts", "starts"))
        if ((labelled != 1) & (labelled != steps)).any():
            raise UserError(f"{path}: an episode's edges need one step or every step; collect it anew")
    for name in _FILL.keys() & arrays.keys():
        check_label_values(name, arrays[name], str(path))
    for i, ids in enumerate(arrays["ids"]):
        live = ids[ids != PADDING_ID]
        if (live < 0).any() or len(np.unique(live)) < len(live):
            raise UserError(f"{path}: ids of episode {i} must differ and not be negative; copy or collect it anew")
    marks = arrays.get("perturbed")
    if marks is not None and ((marks < 0) | (marks >= len(PERTURBATIONS))).any():
        raise UserError(f"{path}: 'perturbed' must lie between 0 and {len(PERTURBATIONS) - 1}; collect it anew")


def _padded_labels(
    episodes: Sequence[Episode], columns: int, names: Sequence[str], where: str
) -> dict[str, np.ndarray]:
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
        if name == "edge_attributes":
            check_widths(labels, names, where)
        kind = np.result_type(*labels)
        if name != "edge_types":
            kind = np.result_type(kind, np.float32)  # what is read: not half of it
        elif kind.kind == "u":
            kind = np.dtype(np.int16)
        joined = np.full((starts[-1], columns, columns, *labels[0].shape[3:]), _FILL[name], kind)
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
