"""Kill storm: `python -m tests.storm.kills --kills 10`.

Each command runs once in peace and once under SIGKILLs at random moments. After each kill no process may live on; at
the end the command goes on to its end, its results equal those of the run in peace, and no log has a traceback.
"""

import random
import shutil
import subprocess
import time
from dataclasses import dataclass
from pathlib import Path

from predictor.support.command_line import parse
from predictor.support.config_checks import check_at_least
from predictor.support.errors import UserError, run_entry_point
from tests.storm.all_commands import LOG, NAMES, Counts, Name, try_all
from tests.storm.running import TRACEBACK, finish, orphans, start, tracebacks_below
from tests.storm.subjects import Subject, differs


@dataclass(frozen=True)
class KillsConfig:
    """Kills commands at random moments and lets them go on."""

    kills: int = 10
    """Number of kills, spread over the commands in turn."""
    only: tuple[Name, ...] = NAMES
    """Commands to kill."""
    seed: int = 0
    """Random seed of the moments."""

    def __post_init__(self) -> None:
        """Checks ranges."""
        check_at_least(self, 1, "kills")


def storm(name: str, subject: Subject, kills: int, folder: Path, rng: random.Random) -> Counts:
    """Runs one command in peace and under kills; returns what was counted."""
    counts, words = Counts(), subject.words(folder / "inputs", folder / "peace")
    began = time.monotonic()
    if finish(start(words, folder / "peace.log")):
        raise UserError(f"{name} fails in peace: {(folder / 'peace.log').read_text()[-2000:]}")
    whole_s = time.monotonic() - began
    expected = subject.results(folder / "peace")
    out, log = folder / "killed", folder / LOG
    words = subject.words(folder / "inputs", out)
    while counts.kills < kills:
        run, wait_s = start(words, log), rng.uniform(0.1, 1.0) * whole_s
        try:
            if run.process.wait(wait_s):
                counts.failures += 1
            counts.tracebacks += tracebacks_below(out)
            shutil.rmtree(out, ignore_errors=True)  # it came to its end: anew
        except subprocess.TimeoutExpired:
            counts.kills += 1
        finally:
            run.process.kill()
            run.process.wait()
        counts.orphans += len(orphans(run))
        if subject.is_over(out):  # killed after its last write
            counts.unequal += differs(name, subject.results(out), expected)
            counts.tracebacks += tracebacks_below(out)
            shutil.rmtree(out)
        print(f"{name}: kill {counts.kills} of {kills} after {wait_s:.1f} of {whole_s:.1f} s", flush=True)
    counts.failures += finish(start(words, log)) != 0
    counts.tracebacks += log.read_text(errors="replace").count(TRACEBACK) + tracebacks_below(out)
    counts.unequal += not counts.failures and differs(name, subject.results(out), expected)
    return counts


def main() -> None:
    """Entry point."""
    config = parse(KillsConfig, __doc__)
    try_all(storm, config.only, config.kills, config.seed)


if __name__ == "__main__":
    run_entry_point(main)
