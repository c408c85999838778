"""Training windows cut from episodes: what the ego could see up to a step, and what then happened.

History is masked to perception (range and nearest N at each step). After the last observed step, the agents visible
then are followed for as long as they exist, seen or not: that is the truth a forecast is judged by.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from predictor.data.store import Episode
from predictor.errors import UserError
from predictor.scene import SceneSpec


@dataclass(frozen=True)
class WindowBatch:
    """Windows of equal length, padded at the end; columns are agents."""

    states: Float[Tensor, "batch time agents state"]
    """World frame [SI]."""
    valid: Bool[Tensor, "batch time agents"]
    """Visible up to `last_observed`; afterwards present and visible at `last_observed`."""
    last_observed: Int[Tensor, " batch"]
    """Index of the last step that a forecaster may see."""
    edge_types: Int[Tensor, "batch time agents agents"] | None = None
    """True type of each edge, receiver first; -1 where unknown or absent."""
    edge_attributes: Float[Tensor, "batch time agents agents attributes"] | None = None
    """Known properties of each edge; zeros where unknown or absent."""

    def to(self, device: torch.device) -> "WindowBatch":
        """The same windows on another device."""
        tensors = (self.states, self.valid, self.last_observed, self.edge_types, self.edge_attributes)
        return WindowBatch(*(None if t is None else t.to(device) for t in tensors))  # type: ignore[arg-type]


def visible(episode: Episode, spec: SceneSpec) -> Bool[np.ndarray, "time agents"]:
    """Who the ego (column 0) perceives: the nearest `max_agents` within `perception_m`; everyone without an ego."""
    if not spec.has_ego:
        return episode.valid
    axes = spec.position_dim
    offsets = episode.states[..., :axes] - episode.states[:, :1, :axes]
    distance_m = np.where(episode.valid, np.linalg.norm(offsets, axis=-1), np.inf)
    distance_m[:, 0] = -1.0
    rank = np.argsort(np.argsort(distance_m, axis=1, kind="stable"), axis=1, kind="stable")
    seen: np.ndarray = episode.valid & (distance_m <= spec.perception_m) & (rank < spec.max_agents)
    return seen


class Windows:
    """All windows of some episodes, addressed by the step at which the forecast is made.

    Args:
        episodes: at least one must have two steps.
        spec: decides what is visible.
        history_steps: longest history; shorter where the episode has just begun.
        horizon_steps: steps after the last observed one; shorter where the episode ends (masked).
        min_future_steps: keep only windows with at least this much future.
        min_history_steps: keep only windows with at least this much history.
    """

    def __init__(
        self,
        episodes: Sequence[Episode],
        spec: SceneSpec,
        history_steps: int,
        horizon_steps: int,
        min_future_steps: int = 1,
        min_history_steps: int = 1,
    ) -> None:
        """Index the windows and precompute visibility."""
        self.spec = spec
        self.history_steps = history_steps
        self.horizon_steps = horizon_steps
        self._states = [e.states for e in episodes]
        self._present = [e.valid for e in episodes]
        self._visible = [visible(e, spec) for e in episodes]
        self._labels = [(e.edge_types, e.edge_attributes) for e in episodes]
        self.index = np.array(
            [
                (i, t)
                for i, e in enumerate(episodes)
                for t in range(min_history_steps - 1, len(e.states) - min_future_steps)
            ],
            dtype=np.int64,
        ).reshape(-1, 2)
        if not len(self.index):
            raise UserError(
                f"no window fits: episodes have at most {max((len(e.states) for e in episodes), default=0)} steps, "
                f"a window needs {min_history_steps + min_future_steps}"
            )

    def __len__(self) -> int:
        """Number of windows."""
        return len(self.index)

    def batch(self, indices: Int[np.ndarray, " batch"], history_steps: int | None = None) -> WindowBatch:
        """Cut and pad the given windows; agents beyond the widest window cost nothing.

        Args:
            indices: which windows.
            history_steps: a shorter history than the longest one.
        """
        cuts = [
            self._cut(episode, now, history_steps or self.history_steps)
            for episode, now in self.index[indices].tolist()
        ]
        agents = max(len(cut.columns) for cut in cuts)
        time = max(cut.last for cut in cuts) + 1 + self.horizon_steps
        states = np.zeros((len(cuts), time, agents, self.spec.num_features), dtype=np.float32)
        valid = np.zeros((len(cuts), time, agents), dtype=np.bool_)
        for row, cut in enumerate(cuts):
            steps, seen = cut.seen.shape
            states[row, :steps, :seen] = cut.states
            valid[row, :steps, :seen] = cut.seen
        types, attributes = (self._edge_labels(cuts, which, valid) for which in (0, 1))
        last_observed = np.array([cut.last for cut in cuts], dtype=np.int64)
        return WindowBatch(
            torch.from_numpy(states), torch.from_numpy(valid), torch.from_numpy(last_observed), types, attributes
        )

    def _edge_labels(self, cuts: "Sequence[_Cut]", which: int, valid: np.ndarray) -> Tensor | None:
        first = self._labels[cuts[0].episode][which]
        if first is None:
            return None
        batch, time, agents = valid.shape
        padded = np.full((batch, time, agents, agents, *first.shape[3:]), -1 if which == 0 else 0, dtype=first.dtype)
        for row, cut in enumerate(cuts):
            labels = self._labels[cut.episode][which]
            assert labels is not None
            steps, seen = cut.seen.shape
            stretch = labels if len(labels) == 1 else labels[cut.begin : cut.begin + steps]
            padded[row, :steps, :seen, :seen] = stretch[:, cut.columns][:, :, cut.columns]
        pairs = valid[..., :, None] & valid[..., None, :] & ~np.eye(agents, dtype=np.bool_)
        padded[~pairs] = -1 if which == 0 else 0
        return torch.from_numpy(padded)

    def _cut(self, episode: int, now: int, history_steps: int) -> "_Cut":
        begin = max(0, now - history_steps + 1)
        end = now + 1 + self.horizon_steps
        last = now - begin
        seen = self._visible[episode][begin:end].copy()
        seen[last + 1 :] = self._present[episode][begin:end][last + 1 :] & seen[last]
        # Columns: the ego, who is visible now, who was visible before (it sent messages then); nobody else matters.
        # Without an ego the order is the episode's, so that a fixed cast keeps its columns.
        weight = seen[: last + 1].sum(axis=0) + 1000 * seen[last]
        weight[0] += 1_000_000 * self.spec.has_ego
        columns = np.argsort(-weight, kind="stable") if self.spec.has_ego else np.arange(len(weight))
        columns = columns[weight[columns] > 0]
        seen = seen[:, columns]
        states = self._states[episode][begin:end][:, columns] * seen[..., None]
        if self.spec.has_ego and (states.shape[1] == 0 or not seen[: last + 1, 0].all()):
            raise UserError(f"episode {episode}: the ego (column 0) must be present at every step up to {now}")
        return _Cut(int(episode), int(begin), int(last), columns, states, seen)


@dataclass(frozen=True)
class _Cut:
    episode: int
    begin: int
    last: int
    columns: np.ndarray
    states: np.ndarray
    seen: np.ndarray


def split_episodes(count: int, fraction: float, seed: int) -> tuple[list[int], list[int]]:
    """Indices of training and validation episodes; whole episodes, so that no window straddles."""
    order = np.random.default_rng(seed).permutation(count)
    held_out = int(round(count * fraction))
    return sorted(order[held_out:].tolist()), sorted(order[:held_out].tolist())


def concatenate(batches: Sequence[WindowBatch]) -> WindowBatch:
    """One batch of windows that were cut from different stores."""
    time = max(b.states.shape[1] for b in batches)
    agents = max(b.states.shape[2] for b in batches)

    def pad(tensor: Tensor) -> Tensor:
        widened = tensor.new_zeros(len(tensor), time, agents, *tensor.shape[3:])
        widened[:, : tensor.shape[1], : tensor.shape[2]] = tensor
        return widened

    return WindowBatch(
        torch.cat([pad(b.states) for b in batches]),
        torch.cat([pad(b.valid) for b in batches]),
        torch.cat([b.last_observed for b in batches]),
        *(_joined_labels(batches, name, time, agents) for name in ("edge_types", "edge_attributes")),
    )


def _joined_labels(batches: Sequence[WindowBatch], name: str, time: int, agents: int) -> Tensor | None:
    labels = [getattr(b, name) for b in batches]
    if any(label is None for label in labels):
        return None  # some stores have labels and others do not: none are used
    padded = []
    for label in labels:
        fill = -1 if name == "edge_types" else 0
        widened = label.new_full((len(label), time, agents, agents, *label.shape[4:]), fill)
        widened[:, : label.shape[1], : label.shape[2], : label.shape[3]] = label
        padded.append(widened)
    return torch.cat(padded)
