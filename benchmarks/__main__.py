"""Measures the speed of forecasts, training, wrappers and readers, and prints one table.

`python -m benchmarks` runs every section, `--only forecast streaming` some, `--quick` a short version. With
`--baseline benchmarks/baseline.json` the run is compared with an earlier one by ratios alone, and the exit status is 1
if anything got slower or costs more than is promised. docs/speed.md explains the table.
"""

import sys
import time

import torch
from rich.console import Console

from benchmarks.compare import Comparison, read_baseline, write_baseline
from benchmarks.settings import Settings
from benchmarks.suite import measure, report, settle
from benchmarks.table import plain, rich_table
from predictor.support.command_line import parse
from predictor.support.errors import run_entry_point
from predictor.support.files import write_json
from predictor.support.runtime import keep_freed_memory, processor, tune


def main() -> None:
    """Runs the command."""
    settings = parse(Settings, __doc__)
    settings.check_files()
    settings.check_env()
    if settings.reference is not None:
        from benchmarks.reference import load

        load(settings.reference)  # a wrong path is reported now, not after half an hour
    baseline = None if settings.baseline is None else read_baseline(settings.baseline, settings)
    began = time.perf_counter()
    tune()
    keeps_memory = keep_freed_memory()
    torch.set_num_threads(settings.threads)
    console, progress = Console(), Console(stderr=True)

    def say(section: str) -> None:
        progress.print(f"[{time.perf_counter() - began:5.0f} s] {section} …", markup=False, highlight=False)

    lines = measure(settings, settings.sections, say)
    comparison: Comparison | None = None
    if baseline is not None:
        lines, comparison = settle(settings, baseline, lines, say)
    result = report(settings, lines, keeps_memory, began)
    settings.out.parent.mkdir(parents=True, exist_ok=True)
    write_json(settings.out, result)
    if settings.write_baseline is not None:
        write_baseline(settings.write_baseline, settings, lines, processor(), result["provenance"])
    kept = "kept" if keeps_memory else "returned to the system"
    versions = ", ".join(f"{name} {version}" for name, version in result["provenance"]["versions"].items())
    print(f"{result['machine']}; {settings.threads} torch threads; freed memory is {kept}; {settings.mode} run")
    print(f"commit {result['provenance']['commit']}; {versions}")
    console.print(rich_table(lines)) if console.is_terminal else print(plain(lines))
    if comparison is not None and baseline is not None:
        if baseline.processor != processor():
            print(f"the baseline is of another processor ({baseline.processor}): wider tolerances")
        print("\n".join(comparison.report()))
        if comparison.failing:
            sys.exit(1)


if __name__ == "__main__":
    run_entry_point(main)
