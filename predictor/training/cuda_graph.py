"""Training steps that are recorded once as a CUDA graph and then replayed.

A paper-size step is tens of thousands of small kernels; launching them one by one from Python takes several times as
long as computing them. A graph holds them all, with the memory they work on, and is launched as one. It requires
constant shapes, inputs that are copied into fixed tensors, and that the host reads no result during the step.

`CapturedStep` handles inputs, warm-up and outputs and does not depend on CUDA; a `Recorder` does the recording.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor

from predictor.data.windows import WindowBatch
from predictor.support.errors import UserError

Terms = Mapping[str, Tensor]
"""Named results of a step: scalars on its device."""
Step = Callable[[WindowBatch], Terms]
"""One whole training step: forward, loss, backward, clipping, update; it changes its state in place."""

WARM_UP_STEPS = 3
_SYNCHRONISED = "synchronizing CUDA operation"


class NotCapturableError(RuntimeError):
    """Raised when the host reads a result during a step, which therefore cannot be recorded."""


@runtime_checkable
class Recorder(Protocol):
    """Interface of what records work and replays it."""

    def warm_up(self, work: Callable[[], None]) -> None:
        """Runs the work a few times, so that everything that is set up lazily exists.

        Raises:
            NotCapturableError: the work cannot be recorded.
        """

    def record(self, work: Callable[[], None]) -> Callable[[], None]:
        """Returns a function that replays the work; the recording itself need not execute it."""

    def forget(self) -> None:
        """Declares that all recordings so far are no longer replayed."""


class CudaRecorder:
    """Records CUDA graphs that share one memory pool, since no two of them run at the same time.

    Args:
        device: current CUDA device.
        noise: generator that the work uses, besides the device's default one. A replay starts from the seed and
            offset that the generators have at that time.
    """

    def __init__(self, device: torch.device, noise: torch.Generator) -> None:
        """Stores the arguments; nothing is allocated yet."""
        self.device = device
        self.noise = noise
        self._pool: Any = None  # torch's handle has a type that not every release names

    def warm_up(self, work: Callable[[], None]) -> None:
        """Runs the work on a side stream, as capturing requires, with every synchronisation an error."""
        stream = torch.cuda.Stream(self.device)
        stream.wait_stream(torch.cuda.current_stream(self.device))
        mode = torch.cuda.get_sync_debug_mode()
        torch.cuda.set_sync_debug_mode("error")
        try:
            with torch.cuda.stream(stream):
                for _ in range(WARM_UP_STEPS):
                    work()
        except RuntimeError as error:
            if _SYNCHRONISED not in str(error):
                raise
            raise NotCapturableError("this model's results are read by the host during a step") from error
        finally:
            torch.cuda.set_sync_debug_mode(mode)
            torch.cuda.current_stream(self.device).wait_stream(stream)

    def record(self, work: Callable[[], None]) -> Callable[[], None]:
        """Captures the work; only kernels of this thread count, so that other threads may continue to prepare data.

        Raises:
            UserError: CUDA does not capture the work; the device cannot be used after a failed capture.
        """
        if self._pool is None:
            self._pool = torch.cuda.graph_pool_handle()
        graph = torch.cuda.CUDAGraph()
        graph.register_generator_state(self.noise)
        try:
            with torch.cuda.graph(graph, pool=self._pool, capture_error_mode="thread_local"):
                work()
        except RuntimeError as error:
            reason = " ".join(str(error.__context__ or error).split())[:200]
            raise UserError(f"the training step could not be captured ({reason}); pass --capture off") from error
        return graph.replay

    def forget(self) -> None:
        """Drops the memory pool: once its graphs are deleted it cannot be used; the next recording creates one."""
        self._pool = None


class CapturedStep:
    """Runs a recorded step on tensors of fixed size.

    Args:
        step: function that computes the step.
        example: batch of the size of all later ones.
        state: function that returns every tensor that the step changes; tensors that do not exist before the first
            step start at zero.
        generators: generators that the step uses.
        recorder: records the step.

    Raises:
        NotCapturableError: the step cannot be recorded; state and generators are as before.
    """

    def __init__(
        self,
        step: Step,
        example: WindowBatch,
        state: Callable[[], Sequence[Tensor]],
        generators: Sequence[torch.Generator],
        recorder: Recorder,
    ) -> None:
        """Warms up, restores state and generators, and records."""
        self.replays = 0
        self._inputs = {name: tensor.clone() for name, tensor in _tensors(example).items()}
        self._outputs: Terms = {}
        static = WindowBatch(**self._inputs)

        def work() -> None:
            self._outputs = step(static)

        kept = [(tensor, tensor.clone()) for tensor in state()]
        drawn = [generator.get_state() for generator in generators]
        try:
            recorder.warm_up(work)
        finally:
            _put_back(state(), kept)
            for generator, before in zip(generators, drawn, strict=True):
                generator.set_state(before)
        self._replay = recorder.record(work)

    def __call__(self, batch: WindowBatch) -> Terms:
        """Runs the step on a batch; the results are overwritten by the next call.

        Raises:
            ValueError: the batch differs from the example in shape or kind.
        """
        given = _tensors(batch)
        wanted, got = signature(self._inputs), signature(given)
        if wanted != got:
            raise ValueError(f"the step was recorded for {wanted}, got {got}; record another one for this batch")
        for name, tensor in given.items():
            self._inputs[name].copy_(tensor, non_blocking=True)
        self._replay()
        self.replays += 1
        return self._outputs


def signature(tensors: Mapping[str, Tensor] | WindowBatch) -> tuple[tuple[str, tuple[int, ...], torch.dtype], ...]:
    """Returns names, shapes and types; a recording is valid for one such signature."""
    named = _tensors(tensors) if isinstance(tensors, WindowBatch) else tensors
    return tuple((name, tuple(tensor.shape), tensor.dtype) for name, tensor in named.items())


def default_generator(device: torch.device) -> torch.Generator:
    """Returns the generator that dropout uses."""
    if device.type != "cuda":
        return torch.default_generator
    return torch.cuda.default_generators[torch.cuda.current_device() if device.index is None else device.index]


def _tensors(batch: WindowBatch) -> dict[str, Tensor]:
    named = {f.name: getattr(batch, f.name) for f in fields(batch)}
    return {name: tensor for name, tensor in named.items() if tensor is not None}


@torch.no_grad()
def _put_back(state: Sequence[Tensor], kept: Sequence[tuple[Tensor, Tensor]]) -> None:
    """Restores tensors in place, since recordings refer to tensors by their memory addresses."""
    before = {id(tensor): copy for tensor, copy in kept}
    for tensor in state:
        if id(tensor) in before:
            tensor.copy_(before[id(tensor)])
        else:
            tensor.zero_()
