"""Times calls: warm-up, blocks of calls that take turns, medians and quartiles, and two yardsticks.

The speed of a shared machine varies by tens of per cent within a minute, so calls that are compared are measured in
turns, in alternating order, and divided block by block. In the same turns runs a yardstick, a fixed computation: plain
float32 matrix products for code that consists of products, or a fixed loop of Python for code in which the interpreter
takes most of the time. A time divided by the yardstick's is about equal on another day.
"""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import numpy as np
import torch

from benchmarks.results import TOLERANCE, Compared, Kind, Line
from benchmarks.settings import Settings

Product = tuple[int, int, int]
REFERENCE_PRODUCTS: tuple[Product, ...] = ((9216, 48, 96), (12800, 64, 256), (4096, 128, 256), (1024, 256, 768))
"""Shapes (m, k, n) of reference products: recurrent and input products of pairs and of agents, for both presets."""
_LEAST_ROUNDS = 3
_MOST_REPEATS = 1000
_SLOW_S = 0.5
_PYTHON_TURNS = 2000


@dataclass(frozen=True)
class Yardstick:
    """Fixed computation whose time other times are divided by."""

    kind: Kind
    """Kind of the numbers that it gives."""
    call: Callable[[], Any]
    """Function that runs it once, some milliseconds."""
    flop: float = 0.0
    """FLOP of one call; 0 if they are not counted."""


@cache
def products(shapes: Sequence[Product] = REFERENCE_PRODUCTS) -> Yardstick:
    """Returns the yardstick of float32 matrix products of these shapes into existing memory."""
    generator = torch.Generator().manual_seed(0)
    operands = [
        (torch.randn(m, k, generator=generator), torch.randn(k, n, generator=generator), torch.empty(m, n))
        for m, k, n in shapes
    ]

    def multiply() -> None:
        for left, right, out in operands:
            torch.mm(left, right, out=out)

    return Yardstick("matmul", multiply, sum(2.0 * m * k * n for m, k, n in shapes))


@cache
def interpreter() -> Yardstick:
    """Returns the yardstick of a Python loop over small arrays, which resembles simulators and loaders."""

    def loop() -> float:
        states, total = np.zeros((16, 4)), 0.0
        for turn in range(_PYTHON_TURNS):
            states = states * 0.99 + turn
            total += float(states[0, 0])
        return total

    return Yardstick("interpreter", loop)


@dataclass(frozen=True)
class Timing:
    """Times of one call in each block, and of the yardstick in the same turns."""

    seconds: np.ndarray
    """Seconds of the call, by block."""
    yard: np.ndarray
    """Seconds of the yardstick, by block."""
    yardstick: Yardstick
    """Yardstick that was timed."""

    @property
    def median(self) -> float:
        """Median of the seconds of the call."""
        return float(np.median(self.seconds))

    @property
    def equivalents(self) -> float:
        """Number of runs of the yardstick that take as long as one call."""
        return float(np.median(self.seconds / self.yard))

    def plus(self, other: "Timing") -> "Timing":
        """Returns the timing of both calls, one after the other."""
        return Timing(self.seconds + other.seconds, self.yard, self.yardstick)

    def matmul_share(self, flop: float) -> float | None:
        """Returns the rate of a call with this many FLOP, divided by the rate of plain products."""
        if not self.yardstick.flop:
            return None
        return float(np.median(flop / self.seconds * self.yard / self.yardstick.flop))


def alternate(
    blocks: Mapping[str, Callable[[], float]], rounds: int, budget_s: float = math.inf
) -> dict[str, np.ndarray]:
    """Runs all blocks in turns, every second round in reverse order.

    Args:
        blocks: functions by name; each times itself and returns seconds.
        rounds: largest number of rounds.
        budget_s: time after which no further round begins, once there are three [s].

    Returns:
        The seconds of each block by name, round by round.
    """
    names, began = list(blocks), time.perf_counter()
    taken: dict[str, list[float]] = {name: [] for name in names}
    for turn in range(rounds):
        if turn >= _LEAST_ROUNDS and time.perf_counter() - began > budget_s:
            break
        for name in names if turn % 2 == 0 else reversed(names):
            taken[name].append(blocks[name]())
    return {name: np.array(values) for name, values in taken.items()}


@dataclass(frozen=True)
class Meter:
    """Measures times with a given number and length of blocks."""

    rounds: int = 15
    """Number of blocks of each call."""
    block_s: float = 0.03
    """Least time for which a block repeats its call [s]."""
    budget_s: float = 20.0
    """Time for all blocks of one comparison; at least three rounds are made [s]."""

    @staticmethod
    def of(settings: Settings) -> "Meter":
        """Returns the meter of a quick or a full run."""
        return Meter(7, 0.01, 2.0) if settings.quick else Meter()

    def measure(self, calls: Mapping[str, Callable[[], Any]], yardstick: Yardstick | None = None) -> dict[str, Timing]:
        """Times calls and the yardstick in turns, after a warm-up."""
        return self.time_blocks({name: self._block(call) for name, call in calls.items()}, yardstick)

    def time_blocks(
        self, blocks: Mapping[str, Callable[[], float]], yardstick: Yardstick | None = None
    ) -> dict[str, Timing]:
        """Times blocks that measure their own seconds, and the yardstick, in turns."""
        yardstick = yardstick or products()
        yardstick.call()
        seconds = alternate({"": partial(_repeat, yardstick.call, 1), **blocks}, self.rounds, self.budget_s)
        yard = seconds.pop("")
        return {name: Timing(values, yard, yardstick) for name, values in seconds.items()}

    def _block(self, call: Callable[[], Any]) -> Callable[[], float]:
        took = _repeat(call, 1)
        if took < _SLOW_S:
            took = _repeat(call, 1)  # the first one also loads kernels
        repeats = min(_MOST_REPEATS, max(1, math.ceil(self.block_s / max(took, 1e-9))))
        return partial(_repeat, call, repeats)


def _repeat(call: Callable[[], Any], repeats: int) -> float:
    began = time.perf_counter()
    for _ in range(repeats):
        call()
    return (time.perf_counter() - began) / repeats


def quartiles(values: np.ndarray) -> tuple[float, float]:
    """Returns the first and third quartile."""
    low, high = np.quantile(values, (0.25, 0.75))
    return float(low), float(high)


def timed_line(
    section: str,
    name: str,
    what: Mapping[str, Any],
    timing: Timing,
    *,
    flop: float | None = None,
    base: Timing | None = None,
    ratio_to: str = "",
    tolerance: float = TOLERANCE,
    at_most: float | None = None,
) -> Line:
    """Returns a line with the milliseconds of a call.

    With `at_most`, the largest promised ratio to `base`, that ratio is what a later run is compared with.
    """
    ms = 1e3 * timing.seconds
    ratio = None if base is None else float(np.median(timing.seconds / base.seconds))
    compared = Compared(timing.equivalents, timing.yardstick.kind, "lower", tolerance)
    if at_most is not None:
        assert ratio is not None, "a promised ratio needs its base"
        compared = Compared(ratio, "ratio", "lower", tolerance, at_most)
    return Line(
        section,
        name,
        what,
        float(np.median(ms)),
        "ms",
        quartiles(ms),
        ratio=ratio,
        ratio_to=ratio_to,
        flop=flop,
        flops_per_s=None if flop is None else flop / timing.median,
        matmul_share=None if flop is None else timing.matmul_share(flop),
        compared=compared,
    )


def rate_line(
    section: str,
    name: str,
    what: Mapping[str, Any],
    timing: Timing,
    count: float,
    unit: str,
    *,
    flop: float | None = None,
    tolerance: float = TOLERANCE,
) -> Line:
    """Returns a line with a rate per second, of `count` things in one call."""
    rates = count / timing.seconds
    line = timed_line(section, name, what, timing, flop=flop, tolerance=tolerance)
    return Line(
        section, name, what, float(np.median(rates)), unit, quartiles(rates), flop=flop, flops_per_s=line.flops_per_s,
        matmul_share=line.matmul_share, compared=line.compared,
    )  # fmt: skip


def ratio_line(
    section: str,
    name: str,
    what: Mapping[str, Any],
    ratios: np.ndarray,
    ratio_to: str,
    *,
    better: str = "lower",
    tolerance: float = TOLERANCE,
) -> Line:
    """Returns a line with the ratio of two things of the same run, block by block."""
    median = float(np.median(ratios))
    direction: Any = better
    compared = Compared(median, "ratio", direction, tolerance)
    return Line(section, name, what, median, "×", quartiles(ratios), ratio_to=ratio_to, compared=compared)
