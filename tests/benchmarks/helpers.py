"""Rows, baselines and settings that the benchmarks' tests share."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.compare import Baseline, write_baseline
from benchmarks.results import Better, Compared, Kind, Row
from benchmarks.settings import Settings

QUICK = Settings(quick=True, threads=1)
HERE = "a processor"


def row(
    value: float, name: str = "step", kind: Kind = "ratio", better: Better = "lower", tolerance: float = 1.5
) -> Row:
    """A row of section "data" whose compared number is `value`."""
    return Row("data", name, {"agents": 5}, value, "ms", compared=Compared(value, kind, better, tolerance))


def baseline(*rows: Row) -> Baseline:
    """Made of rows, here."""
    return Baseline("quick", 1, HERE, {r.key: r.compared for r in rows if r.compared is not None})


def write(path: Path, rows: Sequence[Row], settings: Settings = QUICK, machine: str = HERE) -> Path:
    """The same in a file."""
    made: dict[str, Any] = {}
    write_baseline(path, settings, rows, machine, made)
    return path
