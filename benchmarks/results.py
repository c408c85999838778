"""One measured number (`Line`), and the number of it that means the same in another run (`Compared`)."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal

Kind = Literal["ratio", "matmul", "interpreter"]
"""A ratio of two things in one run, or a time divided by that of a yardstick (`benchmarks.timing`) in the same run."""
Better = Literal["lower", "higher"]

TOLERANCE = 1.35
"""By which factor a line may get worse before it counts as slower, where the line says nothing else."""


@dataclass(frozen=True)
class Compared:
    """What a later run is compared with."""

    value: float
    """The ratio."""
    kind: Kind
    """What it is a ratio of."""
    better: Better = "lower"
    """Which direction is faster."""
    tolerance: float = TOLERANCE
    """Factor by which it may get worse."""

    def slowdown(self, now: float) -> float:
        """By which factor `now` is slower; below 1 it is faster."""
        worse, than = (now, self.value) if self.better == "lower" else (self.value, now)
        return worse / than if than else math.inf


@dataclass(frozen=True)
class Line:
    """One line of the table."""

    section: str
    """Which section measured it."""
    name: str
    """What was measured."""
    what: Mapping[str, Any] = field(default_factory=dict)
    """Shape and settings."""
    value: float | None = None
    """Median; None if it was not measured."""
    unit: str = ""
    """Of the value."""
    quartiles: tuple[float, float] | None = None
    """Of the value, over blocks."""
    ratio: float | None = None
    """Median over blocks of this time divided by another one's."""
    ratio_to: str = ""
    """Whose; for a line whose value is a ratio, what it is a ratio of."""
    flop: float | None = None
    """Products that one call mathematically needs (`benchmarks.flops`)."""
    flops_per_s: float | None = None
    """The same divided by the time."""
    matmul_share: float | None = None
    """The same divided by the rate of plain float32 matrix products, measured around this line."""
    compared: Compared | None = None
    """What a later run is compared with; None if nothing is."""
    note: str = ""
    """What a reader should know, or why there is no value."""

    @property
    def key(self) -> str:
        """Names the line across runs."""
        return " | ".join([self.section, self.name, self.shape])

    @property
    def shape(self) -> str:
        """Shape and settings as text."""
        return ", ".join(f"{name} {value}" for name, value in self.what.items())

    def noted(self, note: str) -> "Line":
        """The same with a note."""
        return replace(self, note=note)

    def json(self) -> dict[str, Any]:
        """As JSON values."""
        return {"key": self.key} | asdict(self)


def skipped(section: str, name: str, why: str, what: Mapping[str, Any] | None = None) -> Line:
    """A line that says why nothing was measured."""
    return Line(section, name, what or {}, note=f"skipped: {why}")
