"""Runs sections and reports a run: lines, machine, versions."""

import contextlib
import importlib
import time
from collections.abc import Callable, Sequence
from typing import Any

from benchmarks.compare import Baseline, Comparison, better_of, compare
from benchmarks.optional_packages import missing
from benchmarks.results import Line, skipped
from benchmarks.settings import SECTIONS, Settings
from predictor.support.provenance import provenance
from predictor.support.runtime import float32_products, processor

NEEDED: dict[str, tuple[str, ...]] = {
    "wrappers": ("gymnasium", "highway_env", "stable_baselines3"),
    "ppo": ("gymnasium", "highway_env", "stable_baselines3"),
}
"""Optional packages without which a section is skipped as a whole."""
PACKAGES = ("torch", "numpy", "zarr", "gymnasium", "highway-env", "envpool", "stable-baselines3")


def measure(settings: Settings, sections: Sequence[str], began: Callable[[str], None]) -> list[Line]:
    """Runs sections one after the other.

    Args:
        settings: settings of the run.
        sections: names of the sections.
        began: receives the name of each section when it begins.
    """
    lines: list[Line] = []
    for section in sections:
        began(section)
        absent = missing(*NEEDED.get(section, ()))
        lines += [skipped(section, section, absent)] if absent else _run(section, settings)
    return lines


WITH_POLICIES = {"wrappers", "ppo"}
"""Sections that keep torch's default library for matrix products, as `train_policy.py` does."""


def _run(section: str, settings: Settings) -> list[Line]:
    module: Any = importlib.import_module(SECTIONS[section])
    with float32_products("highest") if section in WITH_POLICIES else contextlib.nullcontext():
        lines: list[Line] = module.run(settings)
    return lines


def settle(
    settings: Settings, baseline: Baseline, lines: list[Line], began: Callable[[str], None]
) -> tuple[list[Line], Comparison]:
    """Compares with a baseline; lines that fail are measured once more, and the better result counts."""
    comparison = compare(baseline, lines, settings.sections, processor())
    failing = comparison.failing
    if failing:
        sections = [s for s in settings.sections if any(key.startswith(f"{s} | ") for key in failing)]
        again = measure(settings, sections, lambda name: began(f"{name}, once more"))
        lines = better_of(lines, again, failing)
        comparison = compare(baseline, lines, settings.sections, processor())
    return lines, comparison


def report(settings: Settings, lines: Sequence[Line], keeps_memory: bool, began: float) -> dict[str, Any]:
    """Returns all results of a run as JSON values.

    Args:
        settings: settings of the run.
        lines: measured lines.
        keeps_memory: whether glibc keeps freed memory.
        began: start of the run, by `time.perf_counter` [s].
    """
    return {
        "machine": processor(),
        "threads": settings.threads,
        "mode": settings.mode,
        "keeps_freed_memory": keeps_memory,
        "seconds": round(time.perf_counter() - began, 1),
        "provenance": provenance(PACKAGES),
        "lines": [line.json() for line in lines],
    }
