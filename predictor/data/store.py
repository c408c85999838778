"""The episode store: ragged episodes of scenes in one Zarr group, written once, atomically.

Within an episode an agent keeps its column from its first step to its last, so a window is a plain slice; agents that
are absent have `valid=False`. All agents of the simulator are stored; what an ego could see of them is decided when
windows are cut (`predictor.data.windows`).
"""

import json
import shutil
import uuid
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from jaxtyping import Bool, Float, Int

from predictor.errors import UserError
from predictor.provenance import replace_folder
from predictor.scene import PADDING_ID, Scene, SceneSpec

FORMAT = "dgvae-rl episodes"
VERSION = 1


@dataclass(frozen=True)
class Episode:
    """One episode with every agent that ever appeared; column 0 is the ego where there is one."""

    states: Float[np.ndarray, "time agents state"]
    """World frame, SI units, float32; zeros where not valid."""
    valid: Bool[np.ndarray, "time agents"]
    """Who is present when."""
    ids: Int[np.ndarray, " agents"]
    """Identity of each column."""
    label: str = ""
    """How the ego was driven, or any other tag."""
    seed: int = 0
    """The seed that reproduces the episode."""

    @staticmethod
    def from_scenes(scenes: Sequence[Scene], label: str = "", seed: int = 0) -> "Episode":
        """Join scenes by identity; each id gets one column, in order of appearance."""
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
    """What a store holds and how it was made."""

    spec: SceneSpec
    """Layout of the states; the frame is the reader's suggestion."""
    source: str
    """What was recorded: an env id or a dataset's name."""
    provenance: dict[str, Any] = field(default_factory=dict)
    """Command, versions, commit, seeds."""


@dataclass(frozen=True)
class EpisodeStore:
    """A store in memory."""

    info: StoreInfo
    """What it holds."""
    episodes: list[Episode]
    """In the order of their seeds."""

    @property
    def num_steps(self) -> int:
        """Scenes over all episodes."""
        return sum(len(e.states) for e in self.episodes)


def write_store(path: Path, info: StoreInfo, episodes: Iterable[Episode], overwrite: bool = False) -> None:
    """Write a store; nothing appears under `path` until it is complete.

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
    for episode in episodes:
        _check_finite(episode, str(path))
    columns = max(e.states.shape[1] for e in episodes)
    lengths = np.array([len(e.states) for e in episodes])
    starts = np.concatenate([[0], np.cumsum(lengths)])
    states = np.zeros((starts[-1], columns, info.spec.num_features), dtype=np.float32)
    valid = np.zeros((starts[-1], columns), dtype=np.bool_)
    ids = np.full((len(episodes), columns), PADDING_ID, dtype=np.int64)
    for i, episode in enumerate(episodes):
        rows = slice(starts[i], starts[i + 1])
        states[rows, : episode.states.shape[1]] = episode.states
        valid[rows, : episode.states.shape[1]] = episode.valid
        ids[i, : len(episode.ids)] = episode.ids
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}.partial")
    try:
        group = zarr.open_group(partial, mode="w")
        chunk = max(1, min(len(states), 4096))
        every_chunk: Any = {"write_empty_chunks": True}  # so that a missing chunk is damage, not zeros
        group.create_array("states", data=states, chunks=(chunk, columns, states.shape[-1]), config=every_chunk)
        group.create_array("valid", data=valid, chunks=(chunk, columns), config=every_chunk)
        group.create_array("ids", data=ids)
        group.create_array("starts", data=starts)
        group.create_array("seeds", data=np.array([e.seed for e in episodes], dtype=np.int64))
        group.attrs.update(
            {
                "format": FORMAT,
                "version": VERSION,
                "spec": asdict(info.spec),
                "source": info.source,
                "provenance": json.loads(json.dumps(info.provenance, default=str)),
                "labels": [e.label for e in episodes],
            }
        )
        replace_folder(partial, path)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def read_store(path: Path) -> EpisodeStore:
    """Read a whole store into memory.

    Raises:
        UserError: the path holds no store, one of another version, or non-finite states.
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
        for name in ("states", "valid"):
            stored: Any = group[name]
            if stored.nchunks_initialized != stored.nchunks:  # Zarr reads what is missing as zeros
                raise UserError(f"{path}: chunks of '{name}' are missing; copy or collect it anew")
        info = StoreInfo(_spec_from_json(attrs["spec"]), str(attrs["source"]), dict(attrs["provenance"]))
        labels = list(attrs["labels"])
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
        )
        _check_finite(episode, str(path))
        episodes.append(episode)
    return EpisodeStore(info, episodes)


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
