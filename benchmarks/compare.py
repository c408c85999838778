"""Compares a run with a baseline, an earlier run, and reports what got slower and by how much.

A baseline holds only numbers that are comparable between runs: ratios within the run, and times divided by a
yardstick's (`benchmarks.timing`) in the same run. Absolute times are neither stored nor compared.
"""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from benchmarks.results import Compared, Kind, Line
from benchmarks.settings import Settings
from predictor.support.errors import UserError
from predictor.support.files import write_json

FORMAT = "dgvae-rl benchmark baseline"
VERSION = 1
OTHER_PROCESSOR: Mapping[Kind, float] = {"ratio": 1.3, "matmul": 2.0, "interpreter": 2.0}
"""Extra factor on the tolerance, on another processor than the baseline's; processors differ least within a run."""


@dataclass(frozen=True)
class Baseline:
    """Comparable numbers of an earlier run."""

    mode: str
    """Mode of that run: "quick" or "full"."""
    threads: int
    """Number of torch threads."""
    processor: str
    """Name of the processor."""
    lines: Mapping[str, Compared]
    """Compared numbers, by the key of their line."""


@dataclass(frozen=True)
class Change:
    """Change of one line against the baseline."""

    key: str
    """Key of the line."""
    before: Compared
    """Number in the baseline."""
    now: float
    """Number in this run."""
    tolerance: float
    """Factor up to which a difference does not count."""

    @property
    def slowdown(self) -> float:
        """Factor by which the line got slower; below 1 it got faster."""
        return self.before.slowdown(self.now)

    @property
    def slower(self) -> bool:
        """Whether the line got slower by more than the tolerance."""
        return self.slowdown > self.tolerance

    @property
    def faster(self) -> bool:
        """Whether the line got faster by more than the tolerance."""
        return self.slowdown < 1 / self.tolerance

    def text(self) -> str:
        """Returns the change as one line of text."""
        factor = f"{self.slowdown:.2f}× slower" if self.slowdown >= 1 else f"{1 / self.slowdown:.2f}× faster"
        unit = {"ratio": "", "matmul": " matmul-equivalents", "interpreter": " interpreter-equivalents"}
        values = f"{self.before.value:.4g} → {self.now:.4g}{unit[self.before.kind]}"
        return f"{factor} ({values}, tolerance {self.tolerance:.2f}×): {self.key}"


@dataclass(frozen=True)
class Comparison:
    """Result of comparing a run with a baseline."""

    changes: tuple[Change, ...]
    """Changes of the lines that both have."""
    missing: tuple[str, ...]
    """Keys of the baseline that were not measured although their section ran."""
    new: tuple[str, ...]
    """Keys that the baseline does not have."""
    broken: tuple[Line, ...] = ()
    """Lines above what is promised of them (`Compared.at_most`), in the baseline or not."""

    @property
    def slower(self) -> list[Change]:
        """Lines that got slower, the worst first."""
        return sorted((c for c in self.changes if c.slower), key=lambda change: -change.slowdown)

    @property
    def faster(self) -> list[Change]:
        """Lines that got faster, the best first."""
        return sorted((c for c in self.changes if c.faster), key=lambda change: change.slowdown)

    @property
    def failing(self) -> list[str]:
        """Keys of the lines that got slower or are above what is promised."""
        return list(dict.fromkeys([change.key for change in self.slower] + [line.key for line in self.broken]))

    def report(self) -> list[str]:
        """Returns the comparison as lines of text."""
        parts = [
            f"BROKEN  {line.compared.value:.2f} of {line.ratio_to}, promised {line.compared.at_most:.2f}: {line.key}"
            for line in self.broken
            if line.compared is not None
        ]
        parts += [f"SLOWER  {change.text()}" for change in self.slower]
        parts += [f"faster  {change.text()}" for change in self.faster]
        parts += [f"missing {key}" for key in self.missing] + [f"new     {key}" for key in self.new]
        counts = f"{len(self.changes)} lines compared: {len(self.slower)} slower, {len(self.faster)} faster"
        promises = f", {len(self.broken)} above a promise" if self.broken else ""
        return [*parts, f"{counts}, {len(self.missing)} missing, {len(self.new)} new{promises}"]


def write_baseline(
    path: Path, settings: Settings, lines: Sequence[Line], machine: str, made: Mapping[str, Any]
) -> None:
    """Writes the comparable numbers of a run, without what is promised of them; the file is replaced atomically."""
    compared = {line.key: asdict(line.compared) for line in lines if line.compared is not None}
    for values in compared.values():
        del values["at_most"]
    path.parent.mkdir(parents=True, exist_ok=True)
    head = {"format": FORMAT, "version": VERSION, "mode": settings.mode, "threads": settings.threads}
    write_json(path, head | {"processor": machine, "provenance": made, "lines": compared})


def read_baseline(path: Path, settings: Settings) -> Baseline:
    """Reads a baseline and checks that it fits these settings.

    Raises:
        UserError: the file is missing, unreadable, or was made with other settings.
    """
    again = f"make one with python -m benchmarks{' --quick' if settings.quick else ''} --write-baseline {path}"
    if not path.is_file():
        raise UserError(f"no baseline at {path}; {again}")
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if (content["format"], content["version"]) != (FORMAT, VERSION):
            raise KeyError(f"format {content['format']!r}, version {content['version']}")
        lines = {key: Compared(**values) for key, values in content["lines"].items()}
        baseline = Baseline(content["mode"], int(content["threads"]), str(content["processor"]), lines)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise UserError(f"{path} is not a readable baseline ({error}); {again}") from error
    if baseline.mode != settings.mode:
        raise UserError(f"{path} was made by a {baseline.mode} run and this one is {settings.mode}; {again}")
    if baseline.threads != settings.threads:
        raise UserError(f"{path} was made with --threads {baseline.threads}, this run has {settings.threads}; {again}")
    return baseline


def compare(baseline: Baseline, lines: Sequence[Line], sections: Sequence[str], machine: str) -> Comparison:
    """Compares a run's lines with the baseline's.

    Args:
        baseline: numbers of the earlier run.
        lines: lines of this run.
        sections: names of the sections that ran; lines of other sections do not count as missing.
        machine: name of this machine's processor.
    """
    now = {line.key: line.compared for line in lines if line.compared is not None}
    elsewhere = machine != baseline.processor
    changes = []
    for key, before in baseline.lines.items():
        measured = now.get(key)
        if measured is not None and measured.kind == before.kind:
            tolerance = before.tolerance * (OTHER_PROCESSOR[before.kind] if elsewhere else 1.0)
            changes.append(Change(key, before, measured.value, tolerance))
    expected = [key for key in baseline.lines if key.split(" | ")[0] in sections]
    compared = {change.key for change in changes}
    missing = tuple(key for key in expected if key not in compared)
    broken = tuple(line for line in lines if line.compared is not None and line.compared.broken)
    return Comparison(tuple(changes), missing, tuple(key for key in now if key not in compared), broken)


def better_of(lines: Sequence[Line], again: Iterable[Line], keys: Iterable[str]) -> list[Line]:
    """Returns the lines; those with one of the keys are replaced where the second measurement was better."""
    wanted = set(keys)
    second = {line.key: line for line in again if line.key in wanted and line.compared is not None}

    def choose(line: Line) -> Line:
        other = second.get(line.key)
        if other is None or other.compared is None or line.compared is None:
            return line
        improved = line.compared.slowdown(other.compared.value) < 1
        return replace(other, note=", ".join(filter(None, [other.note, "measured twice"]))) if improved else line

    return [choose(line) for line in lines]
