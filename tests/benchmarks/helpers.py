"""Lines, baselines and settings that the benchmarks' tests share."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.compare import Baseline, write_baseline
from benchmarks.results import Better, Compared, Kind, Line
from benchmarks.settings import Settings

QUICK = Settings(quick=True, threads=1)
HERE = "a processor"


def line(
    value: float,
    name: str = "step",
    kind: Kind = "ratio",
    better: Better = "lower",
    tolerance: float = 1.5,
    at_most: float | None = None,
) -> Line:
    """Returns a line of section "data" whose compared number is `value`."""
    compared = Compared(value, kind, better, tolerance, at_most)
    return Line("data", name, {"agents": 5}, value, "ms", ratio_to="one" if at_most else "", compared=compared)


def baseline(*lines: Line) -> Baseline:
    """Makes a baseline of lines, measured on this machine."""
    return Baseline("quick", 1, HERE, {r.key: r.compared for r in lines if r.compared is not None})


def write(path: Path, lines: Sequence[Line], settings: Settings = QUICK, machine: str = HERE) -> Path:
    """Writes a baseline of lines to a file."""
    made: dict[str, Any] = {}
    write_baseline(path, settings, lines, machine, made)
    return path
