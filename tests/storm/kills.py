"""Kill storm: `python -m tests.storm.kills --kills 10`.

Each command runs once in peace and once under SIGKILLs at random moments. After each kill no process may live on; at
the end the command goes on to its end, its results equal those of the run in peace, and no log has a traceback.
"""

import random
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from predictor.support.command_line import parse
from predictor.support.config_checks import check_at_least
from predictor.support.errors import UserError, run_entry_point
from tests.storm.running import finish, orphans, start
from tests.storm.subjects import SUBJECTS, Subject, make_inputs

Name = Literal["train", "policy", "collect", "suite", "study"]


@dataclass(frozen=True)
class KillsConfig:
    """Kills commands at random moments and lets them go on."""

    kills: int = 10
    """Number of kills, spread over the commands in turn."""
    only: tuple[Name, ...] = ("train", "policy", "collect", "suite", "study")
    """Commands to kill."""
    seed: int = 0
    """Random seed of the moments."""

    def __post_init__(self) -> None:
        """Checks ranges."""
        check_at_least(self, 1, "kills")


@dataclass
class Counts:
    """What a storm counted."""

    kills: int = 0
    orphans: int = 0
    tracebacks: int = 0
    unequal: int = 0
    failures: int = 0

    @property
    def is_good(self) -> bool:
        """Whether nothing was lost."""
        return not (self.orphans or self.tracebacks or self.unequal or self.failures)


def storm(name: str, subject: Subject, kills: int, folder: Path, rng: random.Random) -> Counts:
    """Runs one command in peace and under kills; returns what was counted."""
    counts, words = Counts(), subject.words(folder / "inputs", folder / "peace")
    began = time.monotonic()
    if finish(start(words, folder / "peace.log")):
        raise UserError(f"{name} fails in peace: {(folder / 'peace.log').read_text()[-2000:]}")
    whole_s = time.monotonic() - began
    expected = subject.results(folder / "peace")
    out, log = folder / "killed", folder / "killed.log"
    words = subject.words(folder / "inputs", out)
    while counts.kills < kills:
        run, wait_s = start(words, log), rng.uniform(0.1, 1.0) * whole_s
        try:
            if run.process.wait(wait_s):
                counts.failures += 1
            shutil.rmtree(out, ignore_errors=True)  # it came to its end: anew
        except subprocess.TimeoutExpired:
            counts.kills += 1
        finally:
            run.process.kill()
            run.process.wait()
        counts.orphans += len(orphans(run))
        if subject.is_over(out):  # killed after its last write
            counts.unequal += subject.results(out) != expected
            shutil.rmtree(out)
        print(f"{name}: kill {counts.kills} of {kills} after {wait_s:.1f} of {whole_s:.1f} s", flush=True)
    counts.failures += finish(start(words, log)) != 0
    counts.tracebacks += log.read_text(errors="replace").count("Traceback (most recent call last)")
    counts.unequal += not counts.failures and subject.results(out) != expected
    return counts


def main() -> None:
    """Entry point."""
    config = parse(KillsConfig, __doc__)
    rng, all_good = random.Random(config.seed), True
    for place, name in enumerate(config.only):
        kills = config.kills // len(config.only) + (place < config.kills % len(config.only))
        if not kills:
            continue
        with tempfile.TemporaryDirectory(prefix="storm-", ignore_cleanup_errors=True) as folder:
            make_inputs(Path(folder) / "inputs")
            counts = storm(name, SUBJECTS[name], kills, Path(folder), rng)
            log = (Path(folder) / "killed.log").read_text(errors="replace")
        print(f"{name}: {counts}", flush=True)
        if not counts.is_good:
            print(log[-4000:], file=sys.stderr)
        all_good = all_good and counts.is_good
    if not all_good:
        raise UserError("the storm found damage; see above")


if __name__ == "__main__":
    run_entry_point(main)
