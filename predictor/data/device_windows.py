"""Windows whose episodes are kept on a device: batches are cut there in fixed shapes, without reading anything back.

A batch holds what `Windows.batch` gives, padded to the longest history and the widest window of all, so that a training
step on it can be captured once and replayed (`predictor.training.cuda_graph`).
"""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor

from predictor.data.window_tensors import WindowBatch, cast, cut, join
from predictor.data.windows import Windows
from predictor.support.errors import UserError

_CHUNK = 1 << 22
"""Number of entries examined at once when the widest window is searched."""


class ResidentWindows:
    """Keeps all windows of some stores on one device, numbered store by store.

    Args:
        windows: one `Windows` per store, with equal spec, history and horizon.
        device: device that keeps them.
        agents: number of agent columns of every batch; None takes that of the widest window.
        budget_bytes: largest size on the device; None sets no limit.

    Raises:
        UserError: they do not fit, or an ego is missing at an observed step.
    """

    def __init__(
        self,
        windows: Sequence[Windows],
        device: torch.device,
        agents: int | None = None,
        budget_bytes: int | None = None,
    ) -> None:
        """Copies everything to the device."""
        needed = bytes_needed(windows)
        if budget_bytes is not None and needed > budget_bytes:
            raise UserError(
                f"the windows need {needed / 2**20:,.1f} MiB on {device} and {budget_bytes / 2**20:,.1f} MiB are set "
                "aside for them; pass --data-device cpu or use fewer episodes (--max-episodes)"
            )
        first = windows[0]
        self.has_ego = first.spec.has_ego
        self.history_steps = first.history_steps
        self.horizon_steps = first.horizon_steps
        self.agents = max(int(window_sizes(w).max()) for w in windows) if agents is None else agents
        sizes = np.cumsum([0, *(len(w) for w in windows)])
        self.offsets: tuple[int, ...] = tuple(int(s) for s in sizes[:-1])
        flat = join([w.flat for w in windows])
        self._width, self._longest = int(flat.columns.max()), int(flat.steps.max())
        episodes = np.cumsum([0, *(len(w.flat.steps) for w in windows)])
        index = np.concatenate([w.index + [shift, 0] for w, shift in zip(windows, episodes[:-1], strict=True)])
        self._episode, self._now = (torch.from_numpy(column).to(device) for column in index.T.copy())
        self._flat = flat.to(device)

    def __len__(self) -> int:
        """Returns the number of windows."""
        return len(self._episode)

    def batch(
        self, indices: Int[Tensor, " batch"], history_steps: int | None = None, time: int | None = None
    ) -> WindowBatch:
        """Cuts the given windows on the device like `Windows.batch`, padded to a shape that is known beforehand.

        Args:
            indices: numbers of the windows, on the device.
            history_steps: a shorter history than the longest one; none is longer than the longest episode.
            time: number of steps of the result; None takes history plus horizon.
        """
        history = min(history_steps or self.history_steps, self._longest)
        episode, now = self._episode.index_select(0, indices), self._now.index_select(0, indices)
        casts = cast(self._flat, episode, now, history, self._width, self.has_ego)
        steps = time or history + self.horizon_steps
        return cut(self._flat, episode, now, casts, history, self.horizon_steps, steps, self.agents)


def bytes_needed(windows: Sequence[Windows]) -> int:
    """Returns the memory of `ResidentWindows` on its device, without batches [bytes]."""
    return sum(w.flat.num_bytes + w.index.nbytes for w in windows)


def window_sizes(windows: Windows, chosen: Int[np.ndarray, " windows"] | None = None) -> Int[np.ndarray, " windows"]:
    """Returns the number of agents of the chosen windows (None: of all), with the longest history.

    Raises:
        UserError: an ego is missing at an observed step.
    """
    flat, index = windows.flat, windows.index if chosen is None else windows.index[chosen]
    if not windows.spec.has_ego and flat.visible[:-1].all():  # a fixed cast
        return flat.columns.numpy()[index[:, 0]]
    history = min(windows.history_steps, int(flat.steps.max()))
    step = max(1, _CHUNK // (history * max(1, int(flat.columns.max()))))
    sizes = []
    for begin, end in pairwise([*range(0, len(index), step), len(index)]):
        episode, now = (torch.from_numpy(column) for column in index[begin:end].T.copy())
        sizes.append(windows.cast(episode, now, history).size.numpy())
    return np.concatenate(sizes)


def with_agents(windows: Windows) -> Windows:
    """Leaves out, in place, the windows in which no agent is seen: they teach nothing.

    Raises:
        UserError: none is left, or an ego is missing at an observed step.
    """
    windows.index = windows.index[window_sizes(windows) > 0]
    if not len(windows):
        raise UserError("no agent is there in any window of the episodes for training; check the recording")
    return windows
