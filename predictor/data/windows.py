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

    def to(self, device: torch.device) -> "WindowBatch":
        """The same windows on another device."""
        return WindowBatch(self.states.to(device), self.valid.to(device), self.last_observed.to(device))


def visible(episode: Episode, spec: SceneSpec) -> Bool[np.ndarray, "time agents"]:
    """Who the ego (column 0) perceives: the nearest `max_agents` within `perception_m`; everyone without an ego."""
    if not spec.has_ego:
        return episode.valid
    offsets = episode.states[..., :2] - episode.states[:, :1, :2]
    distance_m = np.where(episode.valid, np.hypot(offsets[..., 0], offsets[..., 1]), np.inf)
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
    """

    def __init__(
        self,
        episodes: Sequence[Episode],
        spec: SceneSpec,
        history_steps: int,
        horizon_steps: int,
        min_future_steps: int = 1,
    ) -> None:
        """Index the windows and precompute visibility."""
        self.spec = spec
        self.history_steps = history_steps
        self.horizon_steps = horizon_steps
        self._states = [e.states for e in episodes]
        self._present = [e.valid for e in episodes]
        self._visible = [visible(e, spec) for e in episodes]
        self.index = np.array(
            [(i, t) for i, e in enumerate(episodes) for t in range(len(e.states) - min_future_steps)], dtype=np.int64
        ).reshape(-1, 2)
        if not len(self.index):
            raise UserError(
                f"no window fits: episodes have at most {max((len(e.states) for e in episodes), default=0)} steps, "
                f"a window needs {min_future_steps + 1}"
            )

    def __len__(self) -> int:
        """Number of windows."""
        return len(self.index)

    def batch(self, indices: Int[np.ndarray, " batch"]) -> WindowBatch:
        """Cut and pad the given windows; agents beyond the widest window cost nothing."""
        cuts = [self._cut(episode, now) for episode, now in self.index[indices].tolist()]
        agents = max(states.shape[1] for states, _, _ in cuts)
        time = max(last for _, _, last in cuts) + 1 + self.horizon_steps
        states = np.zeros((len(cuts), time, agents, self.spec.num_features), dtype=np.float32)
        valid = np.zeros((len(cuts), time, agents), dtype=np.bool_)
        for row, (window, seen, _) in enumerate(cuts):
            states[row, : window.shape[0], : window.shape[1]] = window
            valid[row, : seen.shape[0], : seen.shape[1]] = seen
        last_observed = np.array([last for _, _, last in cuts], dtype=np.int64)
        return WindowBatch(torch.from_numpy(states), torch.from_numpy(valid), torch.from_numpy(last_observed))

    def _cut(self, episode: int, now: int) -> tuple[np.ndarray, np.ndarray, int]:
        begin = max(0, now - self.history_steps + 1)
        end = now + 1 + self.horizon_steps
        last = now - begin
        seen = self._visible[episode][begin:end].copy()
        seen[last + 1 :] = self._present[episode][begin:end][last + 1 :] & seen[last]
        # Columns: the ego, who is visible now, who was visible before (it sent messages then); nobody else matters.
        weight = seen[: last + 1].sum(axis=0) + 1000 * seen[last]
        weight[0] += 1_000_000 * self.spec.has_ego
        columns = np.argsort(-weight, kind="stable")
        columns = columns[weight[columns] > 0]
        seen = seen[:, columns]
        states = self._states[episode][begin:end][:, columns] * seen[..., None]
        if self.spec.has_ego and (states.shape[1] == 0 or not seen[: last + 1, 0].all()):
            raise UserError(f"episode {episode}: the ego (column 0) must be present at every step up to {now}")
        return states, seen, last


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
    )
