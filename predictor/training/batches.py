"""Inputs of each training step: its batch, seeds and schedules, all functions of (seed, step).

Batches are cut from windows on the host, or on the device if the data is kept there (`predictor.data.device_windows`).
For an accelerator their shapes are fixed, and batches from the host are prepared one step ahead by a thread.
"""

import math
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Int

from predictor.data.device_windows import ResidentWindows, bytes_needed, window_sizes
from predictor.data.windows import WindowBatch, Windows, concatenate, padded
from predictor.support.memory import check_memory
from predictor.training.config import SMALLER, TrainConfig

MOST_PADDING = 3.0
"""Largest factor by which padding to a fixed size may increase the pairs of a batch; more costs more than it saves."""
EVERY_ROW = slice(None)
"""Rows of a batch that one process cuts alone."""
_HISTORY_BUCKET = 8
_POOL = 8
"""Number of steps whose windows are sorted by their number of agents, so that a batch has little padding."""


@dataclass(frozen=True)
class Plan:
    """Random and scheduled quantities of one training step."""

    step: int
    """Index of the step."""
    dropout_seed: int
    """Seed of torch's default generators."""
    noise_seed: int
    """Seed of the generator that samples graphs."""
    history_steps: int
    """Number of observed steps of the batch, at most."""
    rollout_steps: int
    """Number of roll-out steps; 0 skips the roll-out."""
    num_modes: int
    """Number of modes that are rolled out, by models that have any."""
    kl_scale: float
    """Share of the KL's full weight."""
    lr: float
    """Learning rate."""
    windows: tuple[np.ndarray, ...]
    """Indices of the drawn windows of each store."""
    weight: float = 1.0
    """Factor of the loss: number of agents per window, relative to that of all windows."""


def plan(
    config: TrainConfig,
    sizes: Sequence[int],
    step: int,
    num_modes: int = 1,
    widths: Sequence[Int[np.ndarray, " _"]] | None = None,
) -> Plan:
    """Draws the random quantities of a step and computes the scheduled ones.

    Args:
        config: options of the run.
        sizes: number of windows of each store; batches are mixed in this proportion.
        step: index of the step.
        num_modes: number of modes of the model. Every other step rolls out the first third of them, so that a few
            modes are a forecast as well.
        widths: number of agents of each window. If given, the windows of several steps are sorted by it, so that each
            of these steps gets scenes of similar size; the loss is weighted so that agents count the same in all.
    """
    dropout, noise, history, drawn = _draw(config, sizes, step)
    weight = 1.0
    if widths is not None:
        drawn = _of_similar_width(config, sizes, step, widths)
        mean = np.average([w.mean() for w in widths], weights=sizes)
        weight = float(np.concatenate([w[d] for w, d in zip(widths, drawn, strict=True)]).mean() / mean)
    warm = min(1.0, (step + 1) / config.kl_warmup_steps) if config.kl_warmup_steps else 1.0
    lr = config.lr * _schedule(step, config.steps)
    modes = num_modes if step % 2 else max(min(2, num_modes), num_modes // 3)
    return Plan(step, dropout, noise, history, _rollout_steps(config, step), modes, warm, lr, tuple(drawn), weight)


def _draw(config: TrainConfig, sizes: Sequence[int], step: int) -> tuple[int, int, int, list[np.ndarray]]:
    """Draws both seeds, the longest history and the windows of each store."""
    rng = np.random.default_rng([config.seed, 1, step])
    dropout, noise = int(rng.integers(2**62)), int(rng.integers(2**62))
    history = config.history_steps
    if config.min_history_steps:
        history = int(rng.integers(config.min_history_steps, config.history_steps + 1))
    shares = np.array(sizes)
    counts = rng.multinomial(config.batch_size, shares / shares.sum())
    drawn = [rng.integers(n, size=c) if c else np.zeros(0, dtype=np.int64) for n, c in zip(sizes, counts, strict=True)]
    return dropout, noise, history, drawn


def _of_similar_width(
    config: TrainConfig, sizes: Sequence[int], step: int, widths: Sequence[np.ndarray]
) -> list[np.ndarray]:
    """Returns a step's part of the windows of `_POOL` steps, sorted by width; which part is drawn."""
    first = step - step % _POOL
    draws = [_draw(config, sizes, s)[3] for s in range(first, first + _POOL)]
    pool = [np.concatenate(of_store) for of_store in zip(*draws, strict=True)]
    store = np.repeat(np.arange(len(pool)), [len(p) for p in pool])
    window = np.concatenate(pool)
    order = np.argsort(np.concatenate([w[p] for w, p in zip(widths, pool, strict=True)]), kind="stable")
    part = int(np.random.default_rng([config.seed, 4, first]).permutation(_POOL)[step - first])
    chosen = order[part * config.batch_size : (part + 1) * config.batch_size]
    return [window[chosen[store[chosen] == k]] for k in range(len(pool))]


def _rollout_steps(config: TrainConfig, step: int) -> int:
    if not config.rollout_weight:
        return 0
    if step >= config.curriculum_steps:
        return config.horizon_steps
    return 1 + (config.horizon_steps - 1) * step // config.curriculum_steps


def _schedule(step: int, steps: int, warmup: int = 100) -> float:
    if step < warmup:
        return (step + 1) / warmup
    progress = (step - warmup) / max(1, steps - warmup)
    return 0.02 + 0.98 * 0.5 * (1 + math.cos(math.pi * min(1.0, progress)))


@dataclass(frozen=True)
class Shapes:
    """Fixed shapes of batches, so few that a step can be recorded once for each."""

    agents: int
    """Number of agents of every batch, padding included."""
    history_steps: int
    """Number of observed steps of the longest history."""
    horizon_steps: int
    """Number of steps after it."""

    def time(self, history_steps: int) -> int:
        """Returns the number of steps of a batch; histories are rounded up to a multiple of eight, or the longest."""
        rounded = _HISTORY_BUCKET * math.ceil(history_steps / _HISTORY_BUCKET)
        return min(rounded, self.history_steps) + self.horizon_steps


@runtime_checkable
class Batches(Protocol):
    """Interface of what cuts batches from windows."""

    def batch(self, plan: Plan) -> WindowBatch:
        """Returns the batch of a step, on the device of training."""

    def close(self) -> None:
        """Stops work in the background."""


class HostBatches:
    """Cuts batches on the host; with `shapes`, pads them.

    Args:
        windows: windows of each store.
        device: device of the batches.
        shapes: fixed shapes; None pads to the widest window of each batch.
        rows: rows of each batch that are kept, those of this process; their padding is that of the whole batch.
    """

    def __init__(
        self,
        windows: Sequence[Windows],
        device: torch.device,
        shapes: Shapes | None = None,
        rows: slice = EVERY_ROW,
    ) -> None:
        """Stores the arguments; nothing is copied yet."""
        self.windows = windows
        self.device = device
        self.shapes = shapes
        self.rows = rows

    def on_host(self, plan: Plan) -> WindowBatch:
        """Returns the batch of a step, on the host."""
        drawn = zip(self.windows, plan.windows, strict=True)
        batch = concatenate([w.batch(chosen, plan.history_steps) for w, chosen in drawn if len(chosen)])
        if self.shapes:
            batch = padded(batch, self.shapes.time(plan.history_steps), self.shapes.agents)
        return batch if self.rows == EVERY_ROW else batch.rows(self.rows)

    def batch(self, plan: Plan) -> WindowBatch:
        """Returns the batch of a step."""
        return self.on_host(plan).to(self.device)

    def close(self) -> None:
        """Does nothing: no work is in the background."""


class PrefetchedBatches:
    """Cuts batches on the host for an accelerator: a thread prepares the next one during the current step.

    Args:
        batches: cuts the batches.
        plans: function that returns the plan of a step.
        steps: number of steps; none is prepared beyond.
    """

    def __init__(self, batches: HostBatches, plans: Callable[[int], Plan], steps: int) -> None:
        """Creates the thread, which starts with the first batch."""
        self.batches = batches
        self._plans = plans
        self._steps = steps
        self._next: tuple[int, Future[WindowBatch]] | None = None
        self._worker = ThreadPoolExecutor(max_workers=1, thread_name_prefix="batches")

    def batch(self, plan: Plan) -> WindowBatch:
        """Returns the batch of a step; the copy to the device does not wait for the device's current work."""
        if self._next is not None and self._next[0] == plan.step:
            batch = self._next[1].result()
        else:
            batch = self.batches.on_host(plan)
        after = plan.step + 1
        self._next = (after, self._worker.submit(self._prepare, after)) if after < self._steps else None
        return batch.pinned_to(self.batches.device)

    def _prepare(self, step: int) -> WindowBatch:
        return self.batches.on_host(self._plans(step))

    def close(self) -> None:
        """Waits for the thread to end."""
        self._worker.shutdown(cancel_futures=True)


class DeviceBatches:
    """Cuts batches on the device, where the data is.

    Args:
        windows: windows on the device.
        device: device of windows and batches.
        shapes: fixed shapes; None takes each plan's own history.
        rows: rows of each batch that are cut, those of this process.
    """

    def __init__(
        self,
        windows: ResidentWindows,
        device: torch.device,
        shapes: Shapes | None = None,
        rows: slice = EVERY_ROW,
    ) -> None:
        """Stores the arguments; nothing is copied."""
        self.windows = windows
        self.device = device
        self.shapes = shapes
        self.rows = rows

    def batch(self, plan: Plan) -> WindowBatch:
        """Returns the batch of a step; only the indices of its windows are copied to the device."""
        drawn = [chosen + offset for chosen, offset in zip(plan.windows, self.windows.offsets, strict=True)]
        indices = torch.from_numpy(np.concatenate(drawn)[self.rows])
        if self.device.type == "cuda":
            indices = indices.pin_memory().to(self.device, non_blocking=True)
        time = self.shapes.time(plan.history_steps) if self.shapes else None
        return self.windows.batch(indices, plan.history_steps, time)

    def close(self) -> None:
        """Does nothing: no work is in the background."""


@dataclass(frozen=True)
class Source:
    """Batches of a run, and how steps are run on them."""

    batches: Batches
    """Cuts the batches."""
    capture: bool = False
    """Whether steps are captured as CUDA graphs: on a CUDA device, with fixed shapes."""
    notes: tuple[str, ...] = ()
    """Messages for the user, one line each."""
    widths: tuple[Int[np.ndarray, " _"], ...] | None = None
    """Number of agents of each window, by which batches are put together; None if shapes are fixed or all are equal."""


def check_batch(config: TrainConfig, agents: Int[np.ndarray, " windows"], network: Any, device: torch.device) -> None:
    """Checks, before any batch is made, that the least that a training step keeps fits into the memory.

    These are the states at each forecast step, and one memory of each pair where the network has a memory of pairs.

    Args:
        config: options of the training.
        agents: number of agents of each window.
        network: config of the network.
        device: device that trains.

    Raises:
        UserError: it does not fit.
    """
    width = getattr(network, "rnn_dim", 0) if config.model in ("dgvae", "dnri", "imma") else 0
    senders = np.minimum(agents, getattr(network, "num_neighbours", 0) or agents)
    each = float(np.mean(16 * (1 + config.horizon_steps) * agents + 4 * width * agents * senders))
    available = torch.cuda.mem_get_info()[1] if device.type == "cuda" else None
    check_memory(int(config.batch_size * each), f"a step with batch_size={config.batch_size:,}", SMALLER, available)


def open_batches(
    config: TrainConfig,
    windows: Sequence[Windows],
    device: torch.device,
    network: Any = None,
    rows: slice = EVERY_ROW,
) -> Source:
    """Decides where the data is kept and whether its shapes are fixed.

    Args:
        config: options of the training.
        windows: windows of each store.
        device: device that trains.
        network: config of the network; None checks the memory for states alone.
        rows: rows of each batch that this process takes.

    Raises:
        UserError: the data is to be kept on the device and does not fit, a batch cannot fit, or an ego is missing.
    """
    widths = tuple(window_sizes(w) for w in windows)
    agents = np.concatenate(widths)
    taken = len(range(config.batch_size)[rows])
    check_batch(config if taken == config.batch_size else replace(config, batch_size=taken), agents, network, device)
    if device.type != "cuda":
        resident = config.data_device == "device"
        batches: Batches = (
            DeviceBatches(ResidentWindows(windows, device), device, rows=rows)
            if resident
            else HostBatches(windows, device, rows=rows)
        )
        return Source(batches, widths=widths if len(np.unique(agents)) > 1 else None)
    history = min(config.history_steps, max(int(w.flat.steps.max()) for w in windows))
    shapes: Shapes | None = Shapes(int(agents.max()), history, config.horizon_steps)
    waste = padding_factor(agents, config.batch_size)
    notes = []
    if waste > MOST_PADDING:
        notes.append(
            f"steps are not captured: scenes hold {agents.min()} to {agents.max()} agents, and padding every batch to "
            f"{agents.max()} would cost {waste:.1f} times the pairs"
        )
        shapes = None
    capture = config.capture == "auto" and shapes is not None
    if capture:
        notes.append(f"steps are captured as CUDA graphs, with {agents.max()} agents and histories in eights")
    budget = torch.cuda.mem_get_info()[0] // 2
    needed = bytes_needed(windows)
    if config.data_device == "device" or (config.data_device == "auto" and shapes and needed <= budget):
        batches = DeviceBatches(ResidentWindows(windows, device, int(agents.max()), budget), device, shapes, rows)
        notes.append(f"windows are kept on the device ({needed / 2**20:,.0f} MiB)")
    else:
        plans = partial(plan, config, [len(w) for w in windows])
        batches = PrefetchedBatches(HostBatches(windows, device, shapes, rows), plans, config.steps)
        notes.append("windows are cut on the host, one batch ahead")
    return Source(batches, capture, tuple(notes))


def padding_factor(agents: Int[np.ndarray, " windows"], batch_size: int) -> float:
    """Computes the factor by which the pairs of a batch grow if it is padded to the widest window of all."""
    drawn = np.random.default_rng(0).choice(agents, size=(256, batch_size)).max(axis=1).astype(np.float64)
    return float(np.square(agents.max()) / max(np.square(drawn).mean(), 1.0))
