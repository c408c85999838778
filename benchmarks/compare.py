"""Baselines: what a run is compared with, what got slower, and by how much.

Only numbers that mean the same in another run are kept: ratios within the run, and times divided by a yardstick's in
the same run. Absolute times are neither stored nor compared.
"""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from benchmarks.results import Compared, Line
from benchmarks.settings import Settings
from predictor.support.errors import UserError
from predictor.support.files import write_json

FORMAT = "dgvae-rl benchmark baseline"
VERSION = 1
OTHER_PROCESSOR = 2.0
"""On another processor than the baseline's, multiples of a yardstick may be worse by this factor besides."""


@dataclass(frozen=True)
class Baseline:
    """What to compare with."""

    mode: str
    """"quick" or "full"."""
    threads: int
    """torch threads."""
    processor: str
    """Where it was measured."""
    lines: Mapping[str, Compared]
    """By key."""


@dataclass(frozen=True)
class Change:
    """One line, then and now."""

    key: str
    """Of the line."""
    before: Compared
    """In the baseline."""
    now: float
    """The same number in this run."""
    tolerance: float
    """Factor up to which it does not count."""

    @property
    def slowdown(self) -> float:
        """By which factor it got slower; below 1 it got faster."""
        return self.before.slowdown(self.now)

    @property
    def slower(self) -> bool:
        """Beyond the tolerance."""
        return self.slowdown > self.tolerance

    @property
    def faster(self) -> bool:
        """Beyond the tolerance."""
        return self.slowdown < 1 / self.tolerance

    def text(self) -> str:
        """For people."""
        factor = f"{self.slowdown:.2f}× slower" if self.slowdown >= 1 else f"{1 / self.slowdown:.2f}× faster"
        unit = {"ratio": "", "matmul": " matmul-equivalents", "interpreter": " interpreter-equivalents"}
        values = f"{self.before.value:.4g} → {self.now:.4g}{unit[self.before.kind]}"
        return f"{factor} ({values}, tolerance {self.tolerance:.2f}×): {self.key}"


@dataclass(frozen=True)
class Comparison:
    """A run against a baseline."""

    changes: tuple[Change, ...]
    """Lines that both have."""
    missing: tuple[str, ...]
    """Keys of the baseline that were not measured although their section ran."""
    new: tuple[str, ...]
    """Keys that the baseline does not have."""

    @property
    def slower(self) -> list[Change]:
        """Worst first."""
        return sorted((c for c in self.changes if c.slower), key=lambda change: -change.slowdown)

    @property
    def faster(self) -> list[Change]:
        """Best first."""
        return sorted((c for c in self.changes if c.faster), key=lambda change: change.slowdown)

    def report(self) -> list[str]:
        """For people."""
        parts = [f"SLOWER  {change.text()}" for change in self.slower]
        parts += [f"faster  {change.text()}" for change in self.faster]
        parts += [f"missing {key}" for key in self.missing] + [f"new     {key}" for key in self.new]
        counts = f"{len(self.changes)} lines compared: {len(self.slower)} slower, {len(self.faster)} faster"
        return [*parts, f"{counts}, {len(self.missing)} missing, {len(self.new)} new"]


def write_baseline(
    path: Path, settings: Settings, lines: Sequence[Line], machine: str, made: Mapping[str, Any]
) -> None:
    """Write the comparable numbers of a run; a reader finds the old file or the new one."""
    compared = {line.key: asdict(line.compared) for line in lines if line.compared is not None}
    path.parent.mkdir(parents=True, exist_ok=True)
    head = {"format": FORMAT, "version": VERSION, "mode": settings.mode, "threads": settings.threads}
    write_json(path, head | {"processor": machine, "provenance": made, "lines": compared})


def read_baseline(path: Path, settings: Settings) -> Baseline:
    """A baseline that fits the run to come.

    Raises:
        UserError: unreadable, or made with other settings.
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


def compare(baseline: Baseline, lines: Iterable[Line], sections: Sequence[str], machine: str) -> Comparison:
    """Hold a run's lines against the baseline's.

    Args:
        baseline: what to compare with.
        lines: what was measured.
        sections: which sections ran; lines of others are not missing.
        machine: the processor's name.
    """
    now = {line.key: line.compared for line in lines if line.compared is not None}
    widened = 1.0 if machine == baseline.processor else OTHER_PROCESSOR
    changes = []
    for key, before in baseline.lines.items():
        measured = now.get(key)
        if measured is not None:
            tolerance = before.tolerance * (1.0 if before.kind == "ratio" else widened)
            changes.append(Change(key, before, measured.value, tolerance))
    expected = [key for key in baseline.lines if key.split(" | ")[0] in sections]
    missing = tuple(key for key in expected if key not in now)
    return Comparison(tuple(changes), missing, tuple(key for key in now if key not in baseline.lines))


def better_of(lines: Sequence[Line], again: Iterable[Line], keys: Iterable[str]) -> list[Line]:
    """The lines, with those of these keys replaced where the second measurement was better."""
    wanted = set(keys)
    second = {line.key: line for line in again if line.key in wanted and line.compared is not None}

    def choose(line: Line) -> Line:
        other = second.get(line.key)
        if other is None or other.compared is None or line.compared is None:
            return line
        improved = line.compared.slowdown(other.compared.value) < 1
        return replace(other, note=", ".join(filter(None, [other.note, "measured twice"]))) if improved else line

    return [choose(line) for line in lines]
