"""Keeps episodes end to end in flat tensors and cuts windows from them by index arithmetic alone.

No loop runs over windows, and nothing is read back: where the caller gives the sizes, every shape is known beforehand,
so the same code cuts windows on a CPU and on an accelerator. `predictor.data.windows` defines a window;
`predictor.data.device_windows` keeps windows on a device.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import pad

from predictor.graph import pair_mask

UNKNOWN_TYPE = -1
"""Edge type where none is known."""
_VISIBLE_NOW, _EGO = 1000, 1_000_000
"""Weights that sort agents visible now before those visible earlier, and the ego before all agents."""


@dataclass(frozen=True)
class FlatLabels:
    """Edge labels of all episodes, end to end.

    Entry (step, receiver, sender) of an episode with `a` columns lies at first + (step · a + receiver) · a + sender.
    The last entry means unknown.
    """

    values: Tensor
    """Labels, one entry per pair and labelled step, [entries] or [entries, attributes]."""
    first: Int[Tensor, " episodes"]
    """Index of the first entry of each episode."""
    fixed: Bool[Tensor, " episodes"]
    """Whether an episode has one label for all its steps."""

    def to(self, device: torch.device) -> "FlatLabels":
        """Returns the labels on another device."""
        return FlatLabels(self.values.to(device), self.first.to(device), self.fixed.to(device))


@dataclass(frozen=True)
class FlatEpisodes:
    """Episodes without padding: entry (step, column) of an episode lies at first + step · columns + column.

    The last entry is no agent: it stands for all padding.
    """

    states: Float[Tensor, "entries state"]
    """States, world frame [SI]."""
    present: Bool[Tensor, " entries"]
    """Whether the agent is present."""
    visible: Bool[Tensor, " entries"]
    """Whether the ego perceives the agent."""
    first: Int[Tensor, " episodes"]
    """Index of the first entry of each episode."""
    steps: Int[Tensor, " episodes"]
    """Number of steps of each episode."""
    columns: Int[Tensor, " episodes"]
    """Number of agents that ever appear in each episode."""
    edge_types: FlatLabels | None = None
    """True types of the edges, if every episode has them."""
    edge_attributes: FlatLabels | None = None
    """Known properties of the edges, if every episode has them."""

    @property
    def num_bytes(self) -> int:
        """Memory of all tensors [bytes]."""
        tensors = [self.states, self.present, self.visible, self.first, self.steps, self.columns]
        for labels in (self.edge_types, self.edge_attributes):
            tensors += [] if labels is None else [labels.values, labels.first, labels.fixed]
        return sum(t.numel() * t.element_size() for t in tensors)

    def to(self, device: torch.device) -> "FlatEpisodes":
        """Returns the episodes on another device."""
        parts = {f.name: getattr(self, f.name) for f in fields(self)}
        moved: dict[str, Any] = {name: None if part is None else part.to(device) for name, part in parts.items()}
        return FlatEpisodes(**moved)


@dataclass(frozen=True)
class WindowBatch:
    """Windows of equal length, padded at the end; columns are agents."""

    states: Float[Tensor, "batch time agents state"]
    """States, world frame [SI]."""
    valid: Bool[Tensor, "batch time agents"]
    """Whether the agent is visible, up to `last_observed`; afterwards, whether it is present and was visible then."""
    last_observed: Int[Tensor, " batch"]
    """Index of the last step that a forecaster may see."""
    edge_types: Int[Tensor, "batch time agents agents"] | None = None
    """True type of each edge, receiver first; -1 where unknown or absent."""
    edge_attributes: Float[Tensor, "batch time agents agents attributes"] | None = None
    """Known properties of each edge; zeros where unknown or absent."""

    def to(self, device: torch.device) -> "WindowBatch":
        """Returns the windows on another device."""
        return self._each(lambda tensor: tensor.to(device))

    def pinned_to(self, device: torch.device) -> "WindowBatch":
        """Returns the windows on an accelerator, by a copy that neither side waits for."""
        return self._each(lambda tensor: tensor.pin_memory().to(device, non_blocking=True))

    def rows(self, rows: slice) -> "WindowBatch":
        """Returns some of the windows, with the padding of all."""
        return self._each(lambda tensor: tensor[rows])

    def behind_absent(self) -> "WindowBatch":
        """Returns the windows behind an absent agent, for a forecaster with an ego where no agent is the ego."""
        types, attributes = self.edge_types, self.edge_attributes
        return WindowBatch(
            pad(self.states, (0, 0, 1, 0)),
            pad(self.valid, (1, 0)),
            self.last_observed,
            None if types is None else pad(types, (1, 0, 1, 0), value=UNKNOWN_TYPE),
            None if attributes is None else pad(attributes, (0, 0, 1, 0, 1, 0)),
        )

    def _each(self, change: Callable[[Tensor], Tensor]) -> "WindowBatch":
        given = {f.name: getattr(self, f.name) for f in fields(self)}
        changed: dict[str, Any] = {name: None if tensor is None else change(tensor) for name, tensor in given.items()}
        return WindowBatch(**changed)


def flatten(
    states: Sequence[Float[np.ndarray, "_ _ state"]],
    present: Sequence[Bool[np.ndarray, "_ _"]],
    visible: Sequence[Bool[np.ndarray, "_ _"]],
    edge_types: Sequence[np.ndarray | None],
    edge_attributes: Sequence[np.ndarray | None],
) -> FlatEpisodes:
    """Joins at least one episode; labels are kept if every episode has them."""
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
    """Joins the episodes of several stores; labels are kept if every store has them."""
    if len(parts) == 1:
        return parts[0]
    entries = {n: _without_padding([getattr(p, n) for p in parts]) for n in ("states", "present", "visible")}
    sizes = {n: torch.cat([getattr(p, n) for p in parts]) for n in ("steps", "columns")}
    first = _shifted([p.first for p in parts], [p.present for p in parts])
    types, attributes = (_joined_labels([getattr(p, n) for p in parts]) for n in ("edge_types", "edge_attributes"))
    return FlatEpisodes(first=first, edge_types=types, edge_attributes=attributes, **entries, **sizes)


@dataclass(frozen=True)
class Casts:
    """Agents of each window and their columns."""

    order: Int[Tensor, "batch width"]
    """Column of the episode for each column of the window; meaningless from `size` on."""
    size: Int[Tensor, " batch"]
    """Number of agents of each window."""
    ego_stays: Bool[Tensor, " batch"]
    """Whether the agent of the episode's first column is present at every observed step."""


def cast(
    flat: FlatEpisodes,
    episode: Int[Tensor, " batch"],
    now: Int[Tensor, " batch"],
    history_steps: int,
    width: int,
    has_ego: bool,
) -> Casts:
    """Orders the agents of each window: the ego, those visible now, those visible earlier (they sent messages then).

    Other agents are left out. Without an ego the order is that of the episode, so a fixed set of agents keeps its
    columns.

    Args:
        flat: all episodes.
        episode: index of the episode of each window.
        now: last observed step of each window.
        history_steps: longest history.
        width: number of columns, at least the largest among these episodes.
        has_ego: whether column 0 is the ego.
    """
    device = flat.states.device
    step = now[:, None] - torch.arange(history_steps - 1, -1, -1, device=device)
    column = torch.arange(width, device=device)
    columns = flat.columns[episode][:, None]
    begin = torch.where(step >= 0, flat.first[episode][:, None] + step * columns, len(flat.present) - 1)
    there = (step >= 0)[:, :, None] & (column < columns)[:, None]
    seen = _pick(flat.visible, torch.where(there, begin[:, :, None] + column, len(flat.present) - 1))
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
) -> WindowBatch:
    """Cuts windows of the given size, padded at the end.

    Args:
        flat: all episodes.
        episode: index of the episode of each window.
        now: last observed step of each window.
        casts: agents of these windows.
        history_steps: longest history.
        horizon_steps: steps after the last observed one; steps after the end of the episode are not valid.
        time: number of steps of the result, at least that of the longest window.
        agents: number of columns of the result, at least that of the widest window and at most that of `casts`.
    """
    device, padding = flat.states.device, len(flat.present) - 1
    last = now - (now - history_steps + 1).clamp(min=0)
    tick = torch.arange(time, device=device)
    step = (now - last)[:, None] + tick
    end = torch.minimum(now + 1 + horizon_steps, flat.steps[episode])
    column = torch.arange(agents, device=device)
    known = column < casts.size[:, None]
    agent = torch.where(known, casts.order[:, :agents], 0)
    columns, first = flat.columns[episode][:, None], flat.first[episode][:, None]
    seen_now = _pick(flat.visible, torch.where(known, first + now[:, None] * columns + agent, padding))
    there = (step < end[:, None])[:, :, None] & known[:, None]
    entry = torch.where(there, (first + step * columns)[:, :, None] + agent[:, None], padding)
    observed = (tick <= last[:, None])[:, :, None]
    later = _pick(flat.present, entry) & seen_now[:, None]
    valid = torch.where(observed, _pick(flat.visible, entry), later)
    states = _pick(flat.states, torch.where(valid, entry, padding))
    labels = [_cut_labels(f, episode, step, agent, columns, valid) for f in (flat.edge_types, flat.edge_attributes)]
    return WindowBatch(states, valid, last, *labels)


def _cut_labels(
    labels: FlatLabels | None, episode: Tensor, step: Tensor, agent: Tensor, columns: Tensor, valid: Tensor
) -> Tensor | None:
    if labels is None:
        return None
    step = torch.where(labels.fixed[episode][:, None], 0, step)
    receiver = (step * columns)[:, :, None] + agent[:, None]
    begin = labels.first[episode][:, None, None] + receiver * columns[:, None]
    entry = torch.where(pair_mask(valid), begin[..., None] + agent[:, None, None], len(labels.values) - 1)
    return _pick(labels.values, entry)


def _pick(values: Tensor, entry: Tensor) -> Tensor:
    """Returns `values[entry]`, several times faster on a CPU."""
    entries = values.flatten() if values[0].numel() == 1 else values
    return entries.index_select(0, entry.flatten()).view(*entry.shape, *values.shape[1:])


def _flat_labels(labels: Sequence[np.ndarray | None], unknown: int) -> FlatLabels | None:
    given = [label for label in labels if label is not None]
    if len(given) < len(labels) or len({label.shape[3:] for label in given}) > 1:
        return None  # stores whose attributes mean something else
    first = _starts(np.array([np.prod(label.shape[:3]) for label in given], dtype=np.int64))
    fixed = np.array([len(label) == 1 for label in given])
    values = _end_to_end([label.reshape(-1, *label.shape[3:]) for label in given], unknown)
    return FlatLabels(values, torch.from_numpy(first), torch.from_numpy(fixed))


def _joined_labels(parts: Sequence[FlatLabels | None]) -> FlatLabels | None:
    given = [part for part in parts if part is not None]
    if len(given) < len(parts) or len({part.values.shape[1:] for part in given}) > 1:
        return None
    values = [p.values for p in given]
    first = _shifted([p.first for p in given], values)
    return FlatLabels(_without_padding(values), first, torch.cat([p.fixed for p in given]))


def _end_to_end(arrays: Sequence[np.ndarray], padding: int) -> Tensor:
    """Returns the entries of all arrays, and one entry of padding."""
    return torch.from_numpy(
        np.concatenate([*arrays, np.full_like(arrays[0], padding, shape=(1, *arrays[0].shape[1:]))])
    )


def _without_padding(parts: Sequence[Tensor]) -> Tensor:
    """Returns the entries of all tensors, with the padding of the last one only."""
    return torch.cat([*(p[:-1] for p in parts), parts[-1][-1:]])


def _shifted(first: Sequence[Tensor], entries: Sequence[Tensor]) -> Tensor:
    """Returns where episodes begin when the entries of several stores lie end to end."""
    offsets = _starts(np.array([len(e) - 1 for e in entries], dtype=np.int64)).tolist()
    return torch.cat([f + offset for f, offset in zip(first, offsets, strict=True)])


def _starts(sizes: np.ndarray) -> np.ndarray:
    starts = np.zeros(len(sizes), dtype=np.int64)
    np.cumsum(sizes[:-1], out=starts[1:])
    return starts
