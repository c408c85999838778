"""What each training step is given: its batch, seeds and schedules, all functions of (seed, step).

Batches come from windows on the host, or are cut on the device where the data lives there
(`predictor.data.device_windows`). For an accelerator their shapes are fixed, and batches from the host are prepared one
step ahead by a thread.
"""

import math
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Int

from predictor.data.device_windows import ResidentWindows, bytes_needed, window_sizes
from predictor.data.windows import WindowBatch, Windows, concatenate, padded
from predictor.training.config import TrainConfig

MOST_PADDING = 3.0
"""How many times the pairs of a batch may grow by padding it to a fixed size; launching a step eagerly costs more."""
_HISTORY_BUCKET = 8


@dataclass(frozen=True)
class Plan:
    """All that is random or scheduled about one step."""

    step: int
    """Its number."""
    dropout_seed: int
    """Of torch's default generators."""
    noise_seed: int
    """Of the generator that samples graphs."""
    history_steps: int
    """Longest history of the batch."""
    rollout_steps: int
    """Free-running steps; 0 skips the free run."""
    kl_scale: float
    """Share of the KL's full weight."""
    lr: float
    """Learning rate."""
    rows: tuple[np.ndarray, ...]
    """Windows of each store."""


def plan(config: TrainConfig, sizes: Sequence[int], step: int) -> Plan:
    """What the step is made of.

    Args:
        config: of the run.
        sizes: windows of each store; batches are mixed by them.
        step: its number.
    """
    rng = np.random.default_rng([config.seed, 1, step])
    dropout, noise = int(rng.integers(2**62)), int(rng.integers(2**62))
    history = config.history_steps
    if config.min_history_steps:
        history = int(rng.integers(config.min_history_steps, config.history_steps + 1))
    shares = np.array(sizes)
    counts = rng.multinomial(config.batch_size, shares / shares.sum())
    rows = [rng.integers(n, size=c) if c else np.zeros(0, dtype=np.int64) for n, c in zip(sizes, counts, strict=True)]
    warm = min(1.0, (step + 1) / config.kl_warmup_steps) if config.kl_warmup_steps else 1.0
    lr = config.lr * _schedule(step, config.steps)
    return Plan(step, dropout, noise, history, _rollout_steps(config, step), warm, lr, tuple(rows))


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
    """Fixed shapes: few enough that a step is recorded once for each."""

    agents: int
    """Columns of every batch."""
    history_steps: int
    """Longest history of all."""
    horizon_steps: int
    """Steps after it."""

    def time(self, history_steps: int) -> int:
        """Steps of a batch: histories are rounded up to a multiple of eight, or to the longest."""
        rounded = _HISTORY_BUCKET * math.ceil(history_steps / _HISTORY_BUCKET)
        return min(rounded, self.history_steps) + self.horizon_steps


@runtime_checkable
class Feed(Protocol):
    """Where batches come from."""

    def batch(self, plan: Plan) -> WindowBatch:
        """The batch of a step, on the device of training."""

    def close(self) -> None:
        """Stop what runs in the background."""


class HostFeed:
    """Batches cut on the host; with `shapes`, padded to them.

    Args:
        windows: one per store.
        device: where batches go.
        shapes: fixed ones; None pads to the widest window of each batch.
    """

    def __init__(self, windows: Sequence[Windows], device: torch.device, shapes: Shapes | None = None) -> None:
        """Nothing is copied yet."""
        self.windows = windows
        self.device = device
        self.shapes = shapes

    def on_host(self, plan: Plan) -> WindowBatch:
        """The batch, before it is moved."""
        drawn = zip(self.windows, plan.rows, strict=True)
        batch = concatenate([w.batch(rows, plan.history_steps) for w, rows in drawn if len(rows)])
        if self.shapes:
            batch = padded(batch, self.shapes.time(plan.history_steps), self.shapes.agents)
        return batch

    def batch(self, plan: Plan) -> WindowBatch:
        """The batch of a step."""
        return self.on_host(plan).to(self.device)

    def close(self) -> None:
        """Nothing runs in the background."""


class PrefetchedFeed:
    """A `HostFeed` for an accelerator: the next batch is cut by a thread while this one is computed on.

    Args:
        feed: what cuts batches.
        plans: the plan of a step.
        steps: no step from here on is prepared.
    """

    def __init__(self, feed: HostFeed, plans: Callable[[int], Plan], steps: int) -> None:
        """The thread starts with the first batch."""
        self.feed = feed
        self._plans = plans
        self._steps = steps
        self._next: tuple[int, Future[WindowBatch]] | None = None
        self._worker = ThreadPoolExecutor(max_workers=1, thread_name_prefix="batches")

    def batch(self, plan: Plan) -> WindowBatch:
        """The batch of a step; the copy to the device does not wait for what the device is doing."""
        if self._next is not None and self._next[0] == plan.step:
            batch = self._next[1].result()
        else:
            batch = self.feed.on_host(plan)
        after = plan.step + 1
        self._next = (after, self._worker.submit(self._prepare, after)) if after < self._steps else None
        return batch.pinned_to(self.feed.device)

    def _prepare(self, step: int) -> WindowBatch:
        return self.feed.on_host(self._plans(step))

    def close(self) -> None:
        """Wait for the thread."""
        self._worker.shutdown(cancel_futures=True)


class ResidentFeed:
    """Batches cut on the device, where the data is.

    Args:
        windows: on the device.
        device: the same.
        shapes: fixed ones; None takes each plan's own history.
    """

    def __init__(self, windows: ResidentWindows, device: torch.device, shapes: Shapes | None = None) -> None:
        """Nothing is copied."""
        self.windows = windows
        self.device = device
        self.shapes = shapes

    def batch(self, plan: Plan) -> WindowBatch:
        """The batch of a step; only the numbers of its windows travel."""
        rows = [rows + offset for rows, offset in zip(plan.rows, self.windows.offsets, strict=True)]
        indices = torch.from_numpy(np.concatenate(rows))
        if self.device.type == "cuda":
            indices = indices.pin_memory().to(self.device, non_blocking=True)
        time = self.shapes.time(plan.history_steps) if self.shapes else None
        return self.windows.batch(indices, plan.history_steps, time)

    def close(self) -> None:
        """Nothing runs in the background."""


@dataclass(frozen=True)
class Source:
    """Where batches come from, and what that allows."""

    feed: Feed
    """Batches."""
    capture: bool = False
    """Whether steps are to be captured: on a CUDA device, with fixed shapes."""
    notes: tuple[str, ...] = ()
    """What a user should know, one line each."""


def open_feed(config: TrainConfig, windows: Sequence[Windows], device: torch.device) -> Source:
    """Decide where the data lives and whether its shapes are fixed.

    Raises:
        UserError: the data is to live on the device and does not fit, or an ego is missing.
    """
    if device.type != "cuda":
        resident = config.data_device == "device"
        return Source(ResidentFeed(ResidentWindows(windows, device), device) if resident else HostFeed(windows, device))
    agents = np.concatenate([window_sizes(w) for w in windows])
    shapes: Shapes | None = Shapes(int(agents.max()), config.history_steps, config.horizon_steps)
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
        feed: Feed = ResidentFeed(ResidentWindows(windows, device, int(agents.max()), budget), device, shapes)
        notes.append(f"windows live on the device ({needed / 2**20:,.0f} MiB)")
    else:
        plans = partial(plan, config, [len(w) for w in windows])
        feed = PrefetchedFeed(HostFeed(windows, device, shapes), plans, config.steps)
        notes.append("windows are cut on the host, one batch ahead")
    return Source(feed, capture, tuple(notes))


def padding_factor(agents: Int[np.ndarray, " windows"], batch_size: int) -> float:
    """By how much the pairs of a batch grow if it is padded to the widest window of all."""
    drawn = np.random.default_rng(0).choice(agents, size=(256, batch_size)).max(axis=1).astype(np.float64)
    return float(np.square(agents.max()) / max(np.square(drawn).mean(), 1.0))
