"""Episodes end to end in flat tensors, and windows cut from them by index arithmetic alone.

No loop runs over windows, and nothing is read back: where the caller gives the sizes, every shape is known beforehand,
so the same code cuts windows on a CPU and on an accelerator. `predictor.data.windows` says what a window is;
`predictor.data.device_windows` keeps windows on a device.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from predictor.graph import pair_mask

UNKNOWN_TYPE = -1
"""Edge type where none is known."""
_VISIBLE_NOW, _EGO = 1000, 1_000_000
"""Weights that put who is visible now in front of who was visible before, and the ego in front of everyone."""


@dataclass(frozen=True)
class FlatLabels:
    """Edge labels of all episodes, end to end.

    Entry (step, receiver, sender) of an episode with `a` columns lies at first + (step · a + receiver) · a + sender.
    The last entry says that nothing is known.
    """

    values: Tensor
    """One entry per pair and labelled step, [entries] or [entries, attributes]."""
    first: Int[Tensor, " episodes"]
    """Where each episode begins."""
    fixed: Bool[Tensor, " episodes"]
    """Which episodes have one label for all their steps."""

    def to(self, device: torch.device) -> "FlatLabels":
        """The same on another device."""
        return FlatLabels(self.values.to(device), self.first.to(device), self.fixed.to(device))


@dataclass(frozen=True)
class FlatEpisodes:
    """Episodes without padding: entry (step, column) of an episode lies at first + step · columns + column.

    The last entry is nobody: it stands for all padding.
    """

    states: Float[Tensor, "entries state"]
    """World frame [SI]."""
    present: Bool[Tensor, " entries"]
    """Who is there."""
    visible: Bool[Tensor, " entries"]
    """Whom the ego perceives."""
    first: Int[Tensor, " episodes"]
    """Where each episode begins."""
    steps: Int[Tensor, " episodes"]
    """Scenes of each episode."""
    columns: Int[Tensor, " episodes"]
    """Agents that ever appear in each episode."""
    edge_types: FlatLabels | None = None
    """Where every episode has them."""
    edge_attributes: FlatLabels | None = None
    """Where every episode has them."""

    @property
    def num_bytes(self) -> int:
        """Memory of all tensors."""
        tensors = [self.states, self.present, self.visible, self.first, self.steps, self.columns]
        for labels in (self.edge_types, self.edge_attributes):
            tensors += [] if labels is None else [labels.values, labels.first, labels.fixed]
        return sum(t.numel() * t.element_size() for t in tensors)

    def to(self, device: torch.device) -> "FlatEpisodes":
        """The same on another device."""
        parts = {f.name: getattr(self, f.name) for f in fields(self)}
        moved: dict[str, Any] = {name: None if part is None else part.to(device) for name, part in parts.items()}
        return FlatEpisodes(**moved)


@dataclass(frozen=True)
class Cut:
    """Tensors of a window batch, see `predictor.data.windows.WindowBatch`."""

    states: Float[Tensor, "batch time agents state"]
    valid: Bool[Tensor, "batch time agents"]
    last_observed: Int[Tensor, " batch"]
    edge_types: Int[Tensor, "batch time agents agents"] | None
    edge_attributes: Float[Tensor, "batch time agents agents attributes"] | None


def flatten(
    states: Sequence[Float[np.ndarray, "_ _ state"]],
    present: Sequence[Bool[np.ndarray, "_ _"]],
    visible: Sequence[Bool[np.ndarray, "_ _"]],
    edge_types: Sequence[np.ndarray | None],
    edge_attributes: Sequence[np.ndarray | None],
) -> FlatEpisodes:
    """Join at least one episode; labels are kept where every episode has them."""
    sizes = np.array([s.shape[:2] for s in states], dtype=np.int64)
    return FlatEpisodes(
        _end_to_end([s.reshape(-1, s.shape[2]) for s in states], 0).float(),
        _end_to_end([p.reshape(-1) for p in present], 0),
        _end_to_end([v.reshape(-1) for v in visible], 0),
        torch.from_numpy(_starts(sizes.prod(axis=1))),
        torch.from_numpy(sizes[:, 0].copy()),
        torch.from_numpy(sizes[:, 1].copy()),
        _flat_labels(edge_types, UNKNOWN_TYPE),
        _flat_labels(edge_attributes, 0),
    )


def join(parts: Sequence[FlatEpisodes]) -> FlatEpisodes:
    """Episodes of several stores; labels are kept where every store has them."""
    if len(parts) == 1:
        return parts[0]
    entries = {n: _without_padding([getattr(p, n) for p in parts]) for n in ("states", "present", "visible")}
    sizes = {n: torch.cat([getattr(p, n) for p in parts]) for n in ("steps", "columns")}
    first = _shifted([p.first for p in parts], [p.present for p in parts])
    types, attributes = (_joined_labels([getattr(p, n) for p in parts]) for n in ("edge_types", "edge_attributes"))
    return FlatEpisodes(first=first, edge_types=types, edge_attributes=attributes, **entries, **sizes)


@dataclass(frozen=True)
class Casts:
    """Who takes part in each window, and in which column."""

    order: Int[Tensor, "batch width"]
    """The episode's column that stands in each column of the window; meaningless from `size` on."""
    size: Int[Tensor, " batch"]
    """Agents of each window."""
    ego_stays: Bool[Tensor, " batch"]
    """Whether the episode's first column is there at every observed step."""


def cast(
    flat: FlatEpisodes,
    episode: Int[Tensor, " batch"],
    now: Int[Tensor, " batch"],
    history_steps: int,
    width: int,
    has_ego: bool,
) -> Casts:
    """Order agents: the ego, who is visible now, who was visible before (it sent messages then); nobody else matters.

    Without an ego the order is the episode's, so that a fixed cast keeps its columns.

    Args:
        flat: all episodes.
        episode: of each window.
        now: last observed step of each window.
        history_steps: longest history.
        width: at least the largest number of columns among these episodes.
        has_ego: whether column 0 is the learner.
    """
    device = flat.states.device
    step = now[:, None] - torch.arange(history_steps - 1, -1, -1, device=device)
    column = torch.arange(width, device=device)
    columns = flat.columns[episode][:, None]
    row = torch.where(step >= 0, flat.first[episode][:, None] + step * columns, len(flat.present) - 1)
    there = (step >= 0)[:, :, None] & (column < columns)[:, None]
    seen = _pick(flat.visible, torch.where(there, row[:, :, None] + column, len(flat.present) - 1))
    weight = seen.sum(1) + _VISIBLE_NOW * seen[:, -1]
    key = (weight > 0).to(weight.dtype)
    if has_ego:
        key = weight + _EGO * (column == 0)
    order = torch.sort(key, dim=1, descending=True, stable=True).indices
    return Casts(order, (key > 0).sum(1), seen[:, :, :1].sum((1, 2)) == (step >= 0).sum(1))


def cut(
    flat: FlatEpisodes,
    episode: Int[Tensor, " batch"],
    now: Int[Tensor, " batch"],
    casts: Casts,
    history_steps: int,
    horizon_steps: int,
    time: int,
    agents: int,
) -> Cut:
    """Windows of the given size, padded at the end.

    Args:
        flat: all episodes.
        episode: of each window.
        now: last observed step of each window.
        casts: of these windows.
        history_steps: longest history.
        horizon_steps: steps after the last observed one; what the episode does not have is not valid.
        time: steps of the result, at least as many as any window has.
        agents: columns of the result, at least as many as any window has and at most as many as `casts`.
    """
    device, nobody = flat.states.device, len(flat.present) - 1
    last = now - (now - history_steps + 1).clamp(min=0)
    tick = torch.arange(time, device=device)
    step = (now - last)[:, None] + tick
    end = torch.minimum(now + 1 + horizon_steps, flat.steps[episode])
    column = torch.arange(agents, device=device)
    known = column < casts.size[:, None]
    who = torch.where(known, casts.order[:, :agents], 0)
    columns, first = flat.columns[episode][:, None], flat.first[episode][:, None]
    seen_now = _pick(flat.visible, torch.where(known, first + now[:, None] * columns + who, nobody))
    there = (step < end[:, None])[:, :, None] & known[:, None]
    entry = torch.where(there, (first + step * columns)[:, :, None] + who[:, None], nobody)
    observed = (tick <= last[:, None])[:, :, None]
    later = _pick(flat.present, entry) & seen_now[:, None]
    valid = torch.where(observed, _pick(flat.visible, entry), later)
    states = _pick(flat.states, torch.where(valid, entry, nobody))
    labels = [_cut_labels(f, episode, step, who, columns, valid) for f in (flat.edge_types, flat.edge_attributes)]
    return Cut(states, valid, last, *labels)


def _cut_labels(
    labels: FlatLabels | None, episode: Tensor, step: Tensor, who: Tensor, columns: Tensor, valid: Tensor
) -> Tensor | None:
    if labels is None:
        return None
    step = torch.where(labels.fixed[episode][:, None], 0, step)
    row = (step * columns)[:, :, None] + who[:, None]
    row = labels.first[episode][:, None, None] + row * columns[:, None]
    entry = torch.where(pair_mask(valid), row[..., None] + who[:, None, None], len(labels.values) - 1)
    return _pick(labels.values, entry)


def _pick(values: Tensor, entry: Tensor) -> Tensor:
    """`values[entry]`, several times faster on a CPU."""
    rows = values.flatten() if values[0].numel() == 1 else values
    return rows.index_select(0, entry.flatten()).view(*entry.shape, *values.shape[1:])


def _flat_labels(labels: Sequence[np.ndarray | None], unknown: int) -> FlatLabels | None:
    given = [label for label in labels if label is not None]
    if len(given) < len(labels):
        return None
    first = _starts(np.array([np.prod(label.shape[:3]) for label in given], dtype=np.int64))
    fixed = np.array([len(label) == 1 for label in given])
    values = _end_to_end([label.reshape(-1, *label.shape[3:]) for label in given], unknown)
    return FlatLabels(values, torch.from_numpy(first), torch.from_numpy(fixed))


def _joined_labels(parts: Sequence[FlatLabels | None]) -> FlatLabels | None:
    given = [part for part in parts if part is not None]
    if len(given) < len(parts):
        return None
    values = [p.values for p in given]
    first = _shifted([p.first for p in given], values)
    return FlatLabels(_without_padding(values), first, torch.cat([p.fixed for p in given]))


def _end_to_end(arrays: Sequence[np.ndarray], padding: int) -> Tensor:
    """Rows of all arrays, and one more."""
    return torch.from_numpy(
        np.concatenate([*arrays, np.full_like(arrays[0], padding, shape=(1, *arrays[0].shape[1:]))])
    )


def _without_padding(parts: Sequence[Tensor]) -> Tensor:
    """Rows of all tensors, with the last row of the last one only."""
    return torch.cat([*(p[:-1] for p in parts), parts[-1][-1:]])


def _shifted(first: Sequence[Tensor], entries: Sequence[Tensor]) -> Tensor:
    """Where episodes begin when the entries of several stores lie end to end."""
    offsets = _starts(np.array([len(e) - 1 for e in entries], dtype=np.int64)).tolist()
    return torch.cat([f + offset for f, offset in zip(first, offsets, strict=True)])


def _starts(sizes: np.ndarray) -> np.ndarray:
    starts = np.zeros(len(sizes), dtype=np.int64)
    np.cumsum(sizes[:-1], out=starts[1:])
    return starts
