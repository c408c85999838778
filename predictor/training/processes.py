"""Training by several processes: each computes its rows of every batch, and all of them take the same step.

`torchrun --nproc-per-node N -m predictor.train …` starts the processes; torch.distributed connects them, by gloo
between CPUs and by NCCL between CUDA devices. All draw the windows and the noise of the whole batch and keep their
own rows.
The objective is made of means over what is present, so each process divides its sums by the counts of all: losses and
gradients are then shares, which are added, in one message for each step. That is why DistributedDataParallel is not
used: it averages the gradients of processes whose rows hold different numbers of agents.
"""

import os
import re
import signal
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from typing import Any, TypeVar

import torch
from torch import Tensor, distributed, nn
from torch.nn import functional

from predictor.support.errors import Terminated, UserError, short
from predictor.support.processes import stop_with_parent

WAIT = timedelta(minutes=30)
"""Longest time that a process waits for another one; process 0 validates and saves meanwhile."""
Result = TypeVar("Result")


class LostProcessError(UserError):
    """Raised where another process of the training has ended or does not answer."""


@dataclass(frozen=True)
class Group:
    """The processes of one training; process 0 leads: it alone validates, logs and writes."""

    index: int = 0
    """Number of this process."""
    count: int = 1
    """Number of processes."""
    local: int = 0
    """Number of this process on its machine, which is that of its CUDA device."""
    connected: bool = False
    """Whether torch.distributed runs; a training without it needs none."""

    @property
    def leads(self) -> bool:
        """Whether this is process 0."""
        return self.index == 0

    def device(self, name: str) -> str:
        """Returns this process's device.

        Raises:
            UserError: the name is of one card, or there are fewer cards than processes.
        """
        if not self.connected or not name.startswith("cuda"):
            return name
        if ":" in name:
            if self.count == 1:
                return name
            raise UserError(f"device '{name}' is one card for {self.count} processes; pass --device cuda")
        found = torch.cuda.device_count()
        if self.local >= found:
            raise UserError(
                f"each process needs a card of its own, and there are {found}; pass --nproc-per-node {found}"
            )
        return f"cuda:{self.local}"

    def rows(self, batch_size: int) -> slice:
        """Returns this process's rows of a batch.

        Raises:
            UserError: there are fewer rows than processes.
        """
        if batch_size < self.count:
            raise UserError(f"batch_size must be at least the number of processes ({self.count}), got {batch_size}")
        return slice(batch_size * self.index // self.count, batch_size * (self.index + 1) // self.count)

    def total(self, tensor: Tensor) -> Tensor:
        """Returns the sum of a tensor over all processes, without gradient."""
        if not self.connected:
            return tensor
        added = tensor.detach().clone()
        with _answered():
            distributed.all_reduce(added)
        return added

    def add_gradients(self, parameters: Sequence[nn.Parameter], terms: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Adds up the gradients of all processes, in place, and returns the sums of some numbers.

        Which parameters have a gradient depends on the step alone, so it is the same in all processes.
        """
        flat = [(torch.zeros_like(p) if p.grad is None else p.grad).flatten() for p in parameters]
        added = self.total(torch.cat([*flat, *(term[None].to(flat[0]) for term in terms.values())]))
        parts = added.split([len(part) for part in flat] + [1] * len(terms))
        for parameter, part in zip(parameters, parts, strict=False):
            if parameter.grad is not None:
                parameter.grad.copy_(part.view_as(parameter))
        return {name: part[0] for name, part in zip(terms, parts[len(flat) :], strict=True)}

    def any(self, here: bool) -> bool:
        """Returns whether something is so in any process."""
        return here if not self.connected else bool(self.total(torch.tensor(int(here))))

    def from_leader(self, make: Callable[[], Result]) -> Result:
        """Returns what a function returns in process 0; the others get a copy.

        Raises:
            UserError: it raises one; the others leave without a word.
        """
        made = self.together(lambda: make() if self.leads else None)
        box: list[Any] = [made]
        if self.connected:
            with _answered():
                distributed.broadcast_object_list(box)
        shared: Result = box[0]
        return shared

    def together(self, call: Callable[[], Result]) -> Result:
        """Calls a function in every process; where it fails in one, all end, and one of them says why.

        Raises:
            UserError: the first process that fails raises its own error.
            SystemExit: another process has raised one (status 2).
        """
        if not self.connected:
            return call()
        result, problem = None, None
        try:
            result = call()
        except (UserError, OSError) as error:
            problem = error
        failed = self._gathered(problem is not None)
        if problem is not None and not any(failed[: self.index]):
            raise problem
        if any(failed):
            sys.exit(2)
        return result  # type: ignore[return-value]

    def check_same(self, value: object, what: str) -> None:
        """Checks that a value is the same in all processes.

        Raises:
            UserError: it is not.
        """
        if not self.connected:
            return
        found = self._gathered(repr(value))
        others = [i for i, theirs in enumerate(found) if theirs != found[0]]
        if others and not self.leads:
            sys.exit(2)
        if others:
            raise UserError(f"{what} of process {others[0]} are not those of process 0; give all the same")

    def align(self, module: nn.Module) -> None:
        """Gives all processes the weights of process 0."""
        if self.connected:
            with _answered():
                for tensor in module.state_dict().values():
                    distributed.broadcast(tensor, 0)

    def _gathered(self, value: Any) -> list[Any]:
        found: list[Any] = [None] * self.count
        with _answered():
            distributed.all_gather_object(found, value)
        return found


ALONE = Group()


@contextmanager
def joined() -> Iterator[Group]:
    """Connects the processes that torchrun started; without torchrun there is one, and nothing is connected.

    Processes other than the first print errors of their own alone.

    Raises:
        UserError: they cannot be connected.
    """
    if not distributed.is_available() or not distributed.is_torchelastic_launched():
        yield ALONE
        return
    stop_with_parent()  # torchrun
    index, count, local = (int(os.environ[name]) for name in ("RANK", "WORLD_SIZE", "LOCAL_RANK"))
    if torch.cuda.is_available() and local < torch.cuda.device_count():
        torch.cuda.set_device(local)
    try:
        with _answered():
            backend = "cpu:gloo,cuda:nccl" if torch.cuda.is_available() else "gloo"
            distributed.init_process_group(backend, timeout=WAIT)
        yield Group(index, count, local, connected=True)
    except KeyboardInterrupt:
        if index == 0:
            raise
        sys.exit(128 + signal.SIGINT)
    except Terminated:
        if index == 0:
            raise
        sys.exit(128 + signal.SIGTERM)
    finally:
        if distributed.is_initialized() and sys.exc_info()[0] is None:
            distributed.destroy_process_group()


@contextmanager
def _answered() -> Iterator[None]:
    """Turns the errors of a connection into one sentence."""
    try:
        yield
    except RuntimeError as error:
        said = re.sub(r"^\[[^]]*\] *", "", " ".join(str(error).split()))  # without the line of gloo's code
        reason = short(said.partition(". ")[0], 120)
        raise LostProcessError(
            f"another process of this training has ended or does not answer ({reason}); "
            "the same command with --resume goes on from the last saved state"
        ) from error


class RowsDropout(nn.Dropout):
    """Dropout of some rows of a batch, with the noise that they get where the whole batch is one.

    Args:
        p: probability of a zero.
        rows: rows of the batch.
        total: number of rows of the whole batch.
    """

    def __init__(self, p: float, rows: slice, total: int) -> None:
        """Stores the arguments."""
        super().__init__(p)
        self._rows, self._total = rows, total

    def forward(self, input: Tensor) -> Tensor:
        """Returns the input, with zeros in training."""
        if not self.training or not self.p:
            return input
        # torch draws in the order of the memory, which is not that of the axes in a permuted tensor
        strides = input.stride()
        # of one row, the stride says nothing of where rows lie; beside a later axis, that one was first
        order = sorted(range(input.ndim), key=lambda axis: (-strides[axis], axis == 0))
        shape = (self._total, *input.shape[1:])
        whole = input.new_ones([shape[axis] for axis in order]).permute(
            [order.index(axis) for axis in range(input.ndim)]
        )
        return input * functional.dropout(whole, self.p)[self._rows]


def keep_rows_of_dropout(model: nn.Module, rows: slice, total: int) -> None:
    """Replaces the dropout of a network by that of some rows of a batch."""
    for parent in list(model.modules()):
        for name, child in parent.named_children():
            if type(child) is nn.Dropout:
                setattr(parent, name, RowsDropout(child.p, rows, total))
