"""Measures the shares of time of a step by kind of operation: `python -m benchmarks.time_shares`.

torch's profiler runs over three calls: a prediction at the shape that is compared with the published dNRI, a batch of
forecasts and a training step of the paper's size. Shares are of the processor time that torch's operations report
themselves, without the time of the interpreter between them.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from rich.console import Console
from rich.table import Table
from torch.profiler import ProfilerActivity, profile

from benchmarks.models import TrainingStep, box, forecaster, inference, observed, road, scenes, sized
from benchmarks.reference import EQUAL, PREDICTION
from predictor.support.command_line import parse
from predictor.support.config_checks import check_at_least
from predictor.support.errors import run_entry_point
from predictor.support.runtime import processor, tune

KINDS: dict[str, tuple[str, ...]] = {
    "products": ("linear_pointwise", "addmm", "aten::mm", "bmm"),
    "ELU, gates": ("elu", "sigmoid", "tanh", "reciprocal", "clamp", "neg", "lerp"),
    "lookups, sums over senders": ("index", "embedding_bag", "aten::sum", "gather", "scatter"),
}
"""Parts of operations' names, by kind; operations that match none are "rest"."""


@dataclass(frozen=True)
class ProfileConfig:
    """Measures the shares of time by kind of operation."""

    threads: int = 2
    """Number of CPU threads of torch."""
    calls: int = 10
    """Number of profiled calls, after three that do not count; of the training step a fifth as many."""

    def __post_init__(self) -> None:
        """Checks ranges.

        Raises:
            UserError: a value is out of range.
        """
        check_at_least(self, 1, "threads", "calls")


def kind_of(operation: str) -> str:
    """Returns the kind of an operation, by its name."""
    return next((kind for kind, parts in KINDS.items() if any(part in operation for part in parts)), "rest")


def shares(call: Callable[[], Any], calls: int) -> tuple[dict[str, float], float]:
    """Measures the share of each kind, and the number of operations per call."""
    for _ in range(3):
        call()
    with profile(activities=[ProfilerActivity.CPU]) as seen:
        for _ in range(calls):
            call()
    spent = dict.fromkeys([*KINDS, "rest"], 0.0)
    events = [e for e in seen.key_averages() if e.self_cpu_time_total > 0]
    for event in events:
        spent[kind_of(event.key)] += event.self_cpu_time_total
    total = sum(spent.values())
    return {kind: value / total for kind, value in spent.items()}, sum(e.count for e in events) / calls


def subjects() -> dict[str, tuple[Callable[[], Any], int]]:
    """Returns the calls to profile by name, each with the divisor of its number of calls."""
    shape = PREDICTION
    equal = forecaster(EQUAL, box(shape.agents), shape.future)
    _, belief = observed(equal, *scenes(shape.batch, shape.agents))
    paper = forecaster(sized("paper"), road(12), 5)
    _, many = observed(paper, *scenes(64, 12))
    return {
        f"roll-out of {shape.future} steps, {shape.batch} × {shape.agents} agents, widths of dNRI": (
            inference(lambda: equal.rollout(belief, shape.future).states),
            1,
        ),
        "roll-out of 5 steps, 64 × 12 agents, paper": (inference(lambda: paper.rollout(many, 5).states), 1),
        "training step, 128 × 5 agents × 50 steps, paper": (TrainingStep(sized("paper"), 5, 50, 128), 5),
    }


def main() -> None:
    """Runs the command."""
    config = parse(ProfileConfig, __doc__)
    tune()
    torch.set_num_threads(config.threads)
    table = Table("call", *KINDS, "rest", "operations", title=f"{processor()}, {config.threads} threads")
    for name, (call, less) in subjects().items():
        spent, operations = shares(call, max(1, config.calls // less))
        table.add_row(name, *(f"{100 * share:.0f} %" for share in spent.values()), f"{operations:,.0f}")
    Console(width=150).print(table)


if __name__ == "__main__":
    run_entry_point(main)
