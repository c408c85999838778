"""Measured line of the table (`Line`), and its number that is comparable with another run (`Compared`)."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal

Kind = Literal["ratio", "matmul", "interpreter"]
"""Kind of a number: ratio of two things in one run, or time divided by a yardstick's (`benchmarks.timing`)."""
Better = Literal["lower", "higher"]

TOLERANCE = 1.35
"""Default factor by which a line may get worse before it counts as slower."""


@dataclass(frozen=True)
class Compared:
    """Number that a later run is compared with."""

    value: float
    """Value of the ratio."""
    kind: Kind
    """Kind of the ratio."""
    better: Better = "lower"
    """Direction that is faster."""
    tolerance: float = TOLERANCE
    """Factor by which the number may get worse."""
    at_most: float | None = None
    """Largest value that the project promises, whatever the baseline has; None if it promises none."""

    @property
    def broken(self) -> bool:
        """Whether the number is above what is promised."""
        return self.at_most is not None and self.value > self.at_most

    def slowdown(self, now: float) -> float:
        """Returns the factor by which `now` is slower; below 1 it is faster."""
        worse, than = (now, self.value) if self.better == "lower" else (self.value, now)
        return worse / than if than else math.inf


@dataclass(frozen=True)
class Line:
    """Line of the table."""

    section: str
    """Name of the section that measured it."""
    name: str
    """Name of what was measured."""
    what: Mapping[str, Any] = field(default_factory=dict)
    """Shape and settings."""
    value: float | None = None
    """Median of the value; None if it was not measured."""
    unit: str = ""
    """Unit of the value."""
    quartiles: tuple[float, float] | None = None
    """First and third quartile of the value, over blocks."""
    ratio: float | None = None
    """Median over blocks of this time divided by another line's."""
    ratio_to: str = ""
    """Name of that other line; if the value itself is a ratio, what it is a ratio of."""
    flop: float | None = None
    """FLOP of the products that one call mathematically needs (`benchmarks.flops`)."""
    flops_per_s: float | None = None
    """Value of `flop` divided by the time of a call [1/s]."""
    matmul_share: float | None = None
    """Value of `flops_per_s` divided by the rate of plain float32 matrix products, measured around this line."""
    compared: Compared | None = None
    """Number that a later run is compared with; None if the line is not compared."""
    note: str = ""
    """Remark for the reader, or the reason why there is no value."""

    @property
    def key(self) -> str:
        """Identifier of the line across runs."""
        return " | ".join([self.section, self.name, self.shape])

    @property
    def shape(self) -> str:
        """Shape and settings as text."""
        return ", ".join(f"{name} {value}" for name, value in self.what.items())

    def noted(self, note: str) -> "Line":
        """Returns this line with a note."""
        return replace(self, note=note)

    def json(self) -> dict[str, Any]:
        """Returns the line as JSON values."""
        return {"key": self.key} | asdict(self)


def skipped(section: str, name: str, why: str, what: Mapping[str, Any] | None = None) -> Line:
    """Returns a line with the reason why nothing was measured."""
    return Line(section, name, what or {}, note=f"skipped: {why}")
