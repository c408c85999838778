"""Runs sections, and what a run leaves behind: rows, machine, versions."""

import importlib
import time
from collections.abc import Callable, Sequence
from typing import Any

import torch

from benchmarks.compare import Baseline, Comparison, better_of, compare
from benchmarks.optional_packages import missing
from benchmarks.results import Row, skipped
from benchmarks.settings import SECTIONS, Settings
from predictor.provenance import provenance
from predictor.runtime import processor

NEEDED: dict[str, tuple[str, ...]] = {
    "wrappers": ("gymnasium", "highway_env", "stable_baselines3"),
    "ppo": ("gymnasium", "highway_env", "stable_baselines3"),
}
"""Optional packages without which a section is skipped as a whole."""
PACKAGES = ("torch", "numpy", "zarr", "gymnasium", "highway-env", "envpool", "stable-baselines3")


def measure(settings: Settings, sections: Sequence[str], began: Callable[[str], None]) -> list[Row]:
    """Run sections one after the other.

    Args:
        settings: what to run.
        sections: which.
        began: is told the name of each section as it begins.
    """
    rows: list[Row] = []
    for section in sections:
        began(section)
        absent = missing(*NEEDED.get(section, ()))
        rows += [skipped(section, section, absent)] if absent else _run(section, settings)
    return rows


WITH_POLICIES = {"wrappers", "ppo"}
"""Sections that leave products to torch's own library, as `train_policy.py` does."""


def _run(section: str, settings: Settings) -> list[Row]:
    module: Any = importlib.import_module(SECTIONS[section])
    if section not in WITH_POLICIES:
        rows: list[Row] = module.run(settings)
        return rows
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("highest")
    try:
        rows = module.run(settings)
    finally:
        torch.set_float32_matmul_precision(before)
    return rows


def settle(
    settings: Settings, baseline: Baseline, rows: list[Row], began: Callable[[str], None]
) -> tuple[list[Row], Comparison]:
    """Compare with a baseline; what looks slower is measured once more and the better of both counts."""
    comparison = compare(baseline, rows, settings.sections, processor())
    failing = [change.key for change in comparison.slower]
    if failing:
        sections = [s for s in settings.sections if any(key.startswith(f"{s} | ") for key in failing)]
        again = measure(settings, sections, lambda name: began(f"{name}, once more"))
        rows = better_of(rows, again, failing)
        comparison = compare(baseline, rows, settings.sections, processor())
    return rows, comparison


def report(settings: Settings, rows: Sequence[Row], keeps_memory: bool, began: float) -> dict[str, Any]:
    """Everything about a run, as JSON values.

    Args:
        settings: of the run.
        rows: what was measured.
        keeps_memory: whether glibc keeps freed memory.
        began: when, by `time.perf_counter`.
    """
    return {
        "machine": processor(),
        "threads": settings.threads,
        "mode": settings.mode,
        "keeps_freed_memory": keeps_memory,
        "seconds": round(time.perf_counter() - began, 1),
        "provenance": provenance(PACKAGES),
        "rows": [row.json() for row in rows],
    }
