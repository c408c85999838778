"""Writes the store and the data card of a dataset together; the card holds what was measured on the episodes."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from predictor.data.loading import LoaderConfig, Split, checksum
from predictor.data.store import Episode, StoreInfo, write_store
from predictor.scene import SceneSpec
from predictor.support.errors import UserError
from predictor.support.files import new_file
from predictor.support.markdown import table
from predictor.support.provenance import provenance
from predictor.support.remote import address


@dataclass(frozen=True)
class DatasetNotes:
    """Facts about a dataset that cannot be measured on its episodes; its loader gives them."""

    title: str
    """Name of the dataset."""
    about: str
    """Description of the dataset, one paragraph."""
    rights: str
    """Licence and terms of use."""
    choices: tuple[str, ...]
    """Decisions of the loader: units, axes, what is dropped."""
    counts: Mapping[str, int] = field(default_factory=dict)
    """Number of things read, skipped or dropped, by name."""
    advice: str = ""
    """What to look at where no episode is left."""


def save_dataset(
    config: LoaderConfig,
    spec: SceneSpec,
    episodes: Sequence[Episode],
    notes: DatasetNotes,
    files: Iterable[Path],
    extra: Mapping[str, object] | None = None,
    recording: Callable[[str], str] = str,
) -> None:
    """Writes the store and, beside it, its data card; either both are complete or nothing is left.

    Args:
        config: paths of the source and the output.
        spec: layout of the states.
        episodes: at least one.
        notes: facts for the card.
        files: files that were read, for the checksum.
        extra: additional provenance.
        recording: gives the name of the recording from an episode's label; training keeps its episodes on one side of a
            split, since they hold the same agents, moments later.

    Raises:
        UserError: no episodes, or the output exists and may not be replaced.
    """
    check_not_empty(config, episodes, notes)
    read = list(files)
    names = [recording(episode.label) for episode in episodes]
    number = {name: i for i, name in enumerate(dict.fromkeys(names))}
    facts = provenance(("numpy", "zarr")) | {
        "source_sha256": checksum(config.source, read),
        "source_files": len(read),
        "split": config.split,
        "counts": dict(notes.counts),
        "recordings": [number[name] for name in names],
        "rights": notes.rights,
        **(extra or {}),
    }
    info = StoreInfo(spec, notes.title, facts)
    with new_file(config.card_path) as partial:
        text = card_text(config.split, info, episodes, notes)
        partial.write_text(text, encoding="utf-8", errors="backslashreplace")
        write_store(config.out, info, episodes, config.overwrite)


def check_not_empty(config: LoaderConfig, episodes: Sequence[Episode], notes: DatasetNotes) -> None:
    """Checks that there is an episode; the error says what was counted.

    Raises:
        UserError: there is none.
    """
    if not episodes:
        told = "; ".join(part for part in (_counted(notes) or "no data", notes.advice) if part)
        raise UserError(f"{config.source} gives no episode for split '{config.split}'; {told}")


def summary(config: LoaderConfig, episodes: Sequence[Episode]) -> str:
    """Returns one line for the terminal."""
    steps = sum(len(e.states) for e in episodes)
    where, card = address(config.out), address(config.card_path)
    return f"{where}: {len(episodes)} episodes, {steps} steps, split '{config.split}'; card {card}"


def most_present(episodes: Iterable[Episode]) -> int:
    """Returns the largest number of agents present at one step."""
    return max((int(e.valid.sum(axis=1).max(initial=0)) for e in episodes), default=0)


def card_text(split: Split, info: StoreInfo, episodes: Sequence[Episode], notes: DatasetNotes) -> str:
    """Returns the data card as Markdown."""
    facts = info.provenance
    parts = [
        f"# {notes.title}",
        notes.about,
        "## Facts",
        table(("fact", "value"), _facts(split, info, episodes)),
        "## Columns of a state",
        f"Frame of the positions for a network: {' × '.join(info.spec.frame)}. The standard deviation is over this "
        "store, with positions in that frame; the scale is what the network divides by, the same for all splits.",
        table(("column", "scale", "standard deviation"), _columns(info.spec, episodes)),
        "## What the loader did",
        "\n".join(f"* {choice}" for choice in notes.choices),
        "## Counts",
        table(("what", "count"), [(name, f"{count:,}") for name, count in notes.counts.items()]),
        "## Rights",
        notes.rights,
        "## Made by",
        f"```\n{facts['command']}\n```",
        f"Commit {facts['commit']}, {facts['time']}. Source: {facts['source_files']} files, "
        f"SHA-256 `{facts['source_sha256']}`.",
    ]
    return "\n\n".join(parts) + "\n"


def _facts(split: Split, info: StoreInfo, episodes: Sequence[Episode]) -> list[tuple[str, str]]:
    lengths = np.array([len(e.states) for e in episodes])
    present = np.concatenate([e.valid.sum(axis=1) for e in episodes])
    labels = sorted({e.label for e in episodes})
    shown = ", ".join(labels) if len(labels) <= 30 else f"{len(labels)} different"
    return [
        ("split", split),
        ("episodes", f"{len(episodes):,}"),
        ("labels", shown),
        ("steps", f"{lengths.sum():,} ({lengths.sum() * info.spec.dt_s / 60:.1f} min)"),
        ("steps per episode (min / median / max)", _spread(lengths)),
        ("agents per step (min / median / max)", _spread(present)),
        ("steps without an agent", f"{int((present == 0).sum()):,}"),
        ("time step", f"{info.spec.dt_s:.6g} s"),
        ("units", "metres, metres per second"),
    ]


def _columns(spec: SceneSpec, episodes: Sequence[Episode]) -> list[tuple[str, str, str]]:
    deviations = _deviations(spec, episodes)
    return [
        (f"`{name}`", f"{scale:g}", f"{deviation:.3g}")
        for name, scale, deviation in zip(spec.feature_names, spec.feature_scales, deviations, strict=True)
    ]


def _deviations(spec: SceneSpec, episodes: Sequence[Episode]) -> list[float]:
    """Returns the standard deviation of each column over all present agents, positions in the spec's frame."""
    count, total, squares = 0, np.zeros(spec.num_features), np.zeros(spec.num_features)
    centred = np.array([frame == "centroid" for frame in spec.frame])
    for episode in episodes:
        states = episode.states.astype(np.float64)
        axes = spec.position_dim
        present = episode.valid[..., None]
        centre = (states[..., :axes] * present).sum(axis=1, keepdims=True) / np.maximum(
            present.sum(axis=1, keepdims=True), 1
        )
        states[..., :axes] -= centre * centred
        points = states[episode.valid]
        count, total, squares = count + len(points), total + points.sum(axis=0), squares + (points**2).sum(axis=0)
    mean = total / max(count, 1)
    return [float(v) for v in np.sqrt(np.maximum(squares / max(count, 1) - mean**2, 0.0))]


def _spread(values: np.ndarray) -> str:
    return f"{values.min():g} / {np.median(values):g} / {values.max():g}"


def _counted(notes: DatasetNotes) -> str:
    return ", ".join(f"{name}: {count}" for name, count in notes.counts.items())
