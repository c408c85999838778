"""Branches beside their twins: windows of one moment with and without an intervention, cut with equal columns.

A store of branches that was recorded with twins (`envs.collect --branches 4 --twins`) has after each branch, in which
one agent is marked as perturbed, an episode of the same agents without a mark.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from predictor.data.store import Episode
from predictor.data.window_tensors import WindowBatch, cut
from predictor.data.windows import Windows
from predictor.scene import SceneSpec

MOVED = 0.01
"""Shift from which on an agent counts as moved, in units of the position's scale."""
MOVED_WEIGHT = 4.0
"""How much likelier a pair is drawn in which somebody is moved."""
_AT_ONCE = 256


@dataclass(frozen=True)
class Pairs:
    """Windows of branches, those of their twins, and whose shifts are known; columns and steps of both are the same."""

    branches: WindowBatch
    """Windows whose last observed step is the moment, with the intervention."""
    twins: WindowBatch
    """Windows of the same moments without it."""
    counted: Bool[Tensor, "batch agents horizon"]
    """Whether both have the agent; never of the ego, nor of the agent that was perturbed."""

    def to(self, device: torch.device) -> "Pairs":
        """Returns the windows on another device."""
        return Pairs(self.branches.to(device), self.twins.to(device), self.counted.to(device))

    def true_shift(self, axes: int) -> Float[Tensor, "batch agents horizon {axes}"]:
        """Returns how far the intervention moves each agent [m], zeros where that is not counted."""
        steps = self.counted.shape[-1]
        after, before = (_future(batch, batch.states, steps)[..., :axes] for batch in (self.branches, self.twins))
        return torch.where(self.counted[..., None], after - before, 0.0)


class Twins:
    """Finds the branches that have twins, and cuts pairs of windows.

    Args:
        episodes: episodes in the order of their store.
        spec: range and number of visible agents.
        history_steps: longest history.
        horizon_steps: steps after the moment.
    """

    def __init__(self, episodes: Sequence[Episode], spec: SceneSpec, history_steps: int, horizon_steps: int) -> None:
        """Indexes the pairs."""
        self._spec, self._history, self._horizon = spec, history_steps, horizon_steps
        pairs = [pair for pair in pairwise(episodes) if _are_twins(*pair)]
        found = [np.argwhere(np.asarray(branch.perturbed))[0] for branch, _ in pairs]
        self._now = torch.tensor([int(step) + 1 for step, _ in found], dtype=torch.int64)
        self._senders = torch.tensor([int(sender) for _, sender in found], dtype=torch.int64)
        if pairs:
            self._branches, self._twins = (
                Windows(side, spec, history_steps, horizon_steps) for side in map(list, zip(*pairs, strict=True))
            )
        numbers = np.array_split(np.arange(len(pairs)), 1 + len(pairs) // _AT_ONCE)
        weight = np.where(np.concatenate([self._moves(part) for part in numbers]), MOVED_WEIGHT, 1.0)
        self._share = weight / weight.sum() if len(weight) else weight

    def __len__(self) -> int:
        """Returns the number of pairs."""
        return len(self._now)

    def draw(self, count: int, rng: np.random.Generator) -> Int[np.ndarray, " {count}"]:
        """Draws pairs, those in which somebody is moved `MOVED_WEIGHT` times as often."""
        return rng.choice(len(self), count, p=self._share)

    def batch(self, indices: Int[np.ndarray, " batch"]) -> Pairs:
        """Cuts the pairs of the given numbers."""
        history = self._history
        episode = torch.from_numpy(indices)
        now = self._now[episode]
        casts = self._branches.cast(episode, now, history)
        agents = int(casts.size.max())
        time = min(history, int(now.max()) + 1) + self._horizon
        branches, twins = (
            cut(windows.flat, episode, now, casts, history, self._horizon, time, agents)
            for windows in (self._branches, self._twins)
        )
        both = _future(branches, branches.valid, self._horizon) & _future(twins, twins.valid, self._horizon)
        known = casts.order[:, :agents] != self._senders[episode][:, None]
        if self._spec.has_ego:
            known = known & (torch.arange(agents) > 0)
        return Pairs(branches, twins, both & known[..., None])

    def _moves(self, indices: Int[np.ndarray, " batch"]) -> Bool[np.ndarray, " batch"]:
        """Returns in which pairs an agent is moved."""
        if not len(indices):
            return np.zeros(0, dtype=np.bool_)
        axes = self._spec.position_dim
        shift = self.batch(indices).true_shift(axes) / torch.tensor(self._spec.feature_scales[:axes])
        return (shift.norm(dim=-1) > MOVED).flatten(1).any(1).numpy()


def _are_twins(branch: Episode, other: Episode) -> bool:
    """Returns whether the second episode is the twin of the first one, and both go on after the moment."""
    if branch.perturbed is None or other.perturbed is None or (branch.seed, branch.label) != (other.seed, other.label):
        return False
    if not branch.perturbed.any() or other.perturbed.any() or not np.array_equal(branch.ids, other.ids):
        return False
    return int(np.argwhere(branch.perturbed)[0, 0]) + 1 < min(len(branch.states), len(other.states))


def _future(batch: WindowBatch, values: Tensor, steps: int) -> Tensor:
    """Returns the values of the steps after the last observed one, agents before steps."""
    windows = torch.arange(len(values), device=values.device)[:, None]
    later = batch.last_observed[:, None] + torch.arange(1, steps + 1, device=values.device)
    return values[windows, later].transpose(1, 2)
