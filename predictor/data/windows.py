"""Cuts training windows from episodes: what the ego perceived up to a step, and what happened after it.

History is masked to perception (range and nearest N at each step). After the last observed step, the agents visible
then are followed while they exist, visible or not: that is the truth a forecast is compared with. No window has an
intervention that begins after its last observed step: nobody could foresee it.
"""

from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Int
from torch import Tensor
from torch.nn.functional import pad

from predictor.data.store import Episode
from predictor.data.window_tensors import UNKNOWN_TYPE, Casts, WindowBatch, cast, cut, flatten
from predictor.scene import SceneSpec, perceived_agents
from predictor.support.errors import UserError


def visible(episode: Episode, spec: SceneSpec) -> Bool[np.ndarray, "time agents"]:
    """Returns which agents the ego (column 0) perceives at each step; all that are present, without an ego."""
    if not spec.has_ego or not len(episode.ids):
        return episode.valid
    order, seen = perceived_agents(episode.states, episode.valid, 0, spec)
    perceived = np.zeros_like(episode.valid)
    np.put_along_axis(perceived, order, seen, axis=1)
    return perceived


class Windows:
    """Keeps all windows of some episodes, one for each step at which a forecast is made.

    Args:
        episodes: episodes of which at least one has two steps.
        spec: range and number of visible agents.
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
        """Indexes the windows and computes which agents are visible."""
        if min(history_steps, horizon_steps, min_history_steps) < 1:
            raise UserError(
                "windows need at least 1 step of history and 1 of horizon, got "
                f"{min(history_steps, min_history_steps)} and {horizon_steps}"
            )
        self.spec = spec
        self.history_steps = history_steps
        self.horizon_steps = horizon_steps
        lengths = np.array([len(e.states) for e in episodes], dtype=np.int64)
        index = _index(lengths, min_history_steps - 1, min_future_steps)
        first = np.concatenate([[0], np.cumsum([len(e.states) for e in episodes], dtype=np.int64)])
        kept = np.concatenate([np.zeros(0, np.bool_), *(foreseeable(e, horizon_steps) for e in episodes)])
        self.index = index[kept[first[index[:, 0]] + index[:, 1]]]
        if len(index) and not len(self.index):
            raise UserError(
                f"no window fits: in each of the {len(index)} that are long enough an intervention begins within the "
                "horizon, which nobody can foresee; lower the horizon, or record episodes with fewer interventions"
            )
        if not len(self.index):
            raise UserError(
                f"no window fits: episodes have at most {lengths.max(initial=0)} steps, "
                f"a window needs {min_history_steps + min_future_steps}"
            )
        self.flat = flatten(
            [e.states for e in episodes],
            [e.valid for e in episodes],
            [visible(e, spec) for e in episodes],
            [e.edge_types for e in episodes],
            [e.edge_attributes for e in episodes],
        )

    def __len__(self) -> int:
        """Returns the number of windows."""
        return len(self.index)

    def batch(self, indices: Int[np.ndarray, " batch"], history_steps: int | None = None) -> WindowBatch:
        """Cuts and pads the given windows; agents beyond the widest window cost nothing.

        Windows without an agent have an absent one, since networks compute nothing of none.

        Args:
            indices: numbers of the windows.
            history_steps: a shorter history than the longest one.

        Raises:
            UserError: the ego is missing at an observed step.
        """
        episode, now = (torch.from_numpy(column) for column in self.index[indices].T.copy())
        history = min(history_steps or self.history_steps, int(now.max()) + 1)
        casts = self.cast(episode, now, history)
        agents, time = max(1, int(casts.size.max())), history + self.horizon_steps
        return cut(self.flat, episode, now, casts, history, self.horizon_steps, time, agents)

    def cast(self, episode: Int[Tensor, " batch"], now: Int[Tensor, " batch"], history_steps: int) -> Casts:
        """Returns the agents that take part in windows, given by their episodes and last observed steps.

        Raises:
            UserError: the ego is missing at an observed step.
        """
        width = max(1, int(self.flat.columns[episode].max()))
        casts = cast(self.flat, episode, now, history_steps, width, self.spec.has_ego)
        if self.spec.has_ego and not casts.ego_stays.all():
            window = int((~casts.ego_stays).nonzero()[0])
            raise UserError(
                f"episode {int(episode[window])}: the ego (column 0) must be present at every step up to "
                f"{int(now[window])}"
            )
        return casts


def _index(lengths: Int[np.ndarray, " episodes"], first: int, future_steps: int) -> Int[np.ndarray, "windows 2"]:
    """Returns episode and last observed step of each window."""
    counts = np.maximum(lengths - future_steps - first, 0)
    episode = np.repeat(np.arange(len(lengths)), counts)
    begins = np.repeat(np.cumsum(counts) - counts, counts)
    return np.stack([episode, np.arange(len(episode)) - begins + first], axis=1)


def foreseeable(episode: Episode, horizon_steps: int) -> Bool[np.ndarray, " time"]:
    """Returns after which steps no intervention begins within the horizon."""
    if episode.perturbed is None:
        return np.ones(len(episode.states), dtype=np.bool_)
    before = np.pad(episode.perturbed, ((1, 0), (0, 0)))[:-1]
    begins = ((episode.perturbed != 0) & (episode.perturbed != before)).any(axis=1)
    until = np.concatenate([[0], np.cumsum(begins)])
    now = np.arange(len(begins))
    return np.asarray(until[np.minimum(now + horizon_steps, len(begins))] == until[now])


def siblings(episodes: Sequence[Episode]) -> Int[np.ndarray, " episodes"]:
    """Returns a number for each episode that branches of one episode share, for they have steps in common."""
    first = [
        i == 0 or e.perturbed is None or (e.seed, e.label) != (episodes[i - 1].seed, episodes[i - 1].label)
        for i, e in enumerate(episodes)
    ]
    return np.cumsum(first) - 1


def split_episodes(count: int, fraction: float, seed: int) -> tuple[list[int], list[int]]:
    """Returns indices of training and validation episodes; whole episodes, so that no window straddles."""
    order = np.random.default_rng(seed).permutation(count)
    held_out = int(round(count * fraction))
    return sorted(order[held_out:].tolist()), sorted(order[:held_out].tolist())


def padded(batch: WindowBatch, time: int, agents: int) -> WindowBatch:
    """Returns the windows with absent agents and steps appended, up to the given size."""
    if batch.valid.shape[1:] == (time, agents):
        return batch
    later, others = time - batch.valid.shape[1], agents - batch.valid.shape[2]
    types, attributes = batch.edge_types, batch.edge_attributes
    return WindowBatch(
        pad(batch.states, (0, 0, 0, others, 0, later)),
        pad(batch.valid, (0, others, 0, later)),
        batch.last_observed,
        None if types is None else pad(types, (0, others, 0, others, 0, later), value=UNKNOWN_TYPE),
        None if attributes is None else pad(attributes, (0, 0, 0, others, 0, others, 0, later)),
    )


def concatenate(batches: Sequence[WindowBatch]) -> WindowBatch:
    """Returns one batch of windows that were cut from different stores."""
    if len(batches) == 1:
        return batches[0]
    time = max(b.states.shape[1] for b in batches)
    agents = max(b.states.shape[2] for b in batches)
    parts = [padded(b, time, agents) for b in batches]
    joined: dict[str, Any] = {f.name: _joined([getattr(p, f.name) for p in parts]) for f in fields(WindowBatch)}
    return WindowBatch(**joined)


def _joined(tensors: Sequence[Tensor | None]) -> Tensor | None:
    known = [t for t in tensors if t is not None]
    # some stores have labels and others do not, or attributes of another number: none are used
    return torch.cat(known) if len(known) == len(tensors) and len({t.shape[1:] for t in known}) == 1 else None
