"""Lets each command through a storm, with its share of the blows, and sums up what was damaged."""

import random
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from predictor.support.errors import UserError
from tests.storm.subjects import SUBJECTS, Subject, make_inputs

Name = Literal["train", "policy", "collect", "suite", "study"]
NAMES: tuple[Name, ...] = get_args(Name)
"""Commands that storms know."""
LOG = "storm.log"
"""File of a storm's folder with what the command said."""


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


Storm = Callable[[str, Subject, int, Path, random.Random], Counts]


def try_all(storm: Storm, only: Sequence[Name], blows: int, seed: int) -> None:
    """Lets commands through a storm.

    Args:
        storm: function of a command's name, the command, its blows, a folder and a source of randomness.
        only: names of the commands.
        blows: number of kills or full disks, spread over the commands in turn.
        seed: random seed.

    Raises:
        UserError: something was damaged.
    """
    rng, all_good = random.Random(seed), True
    for place, name in enumerate(only):
        share = blows // len(only) + (place < blows % len(only))
        if not share:
            continue
        with tempfile.TemporaryDirectory(prefix="storm-", ignore_cleanup_errors=True) as folder:
            make_inputs(Path(folder) / "inputs")
            counts = storm(name, SUBJECTS[name], share, Path(folder), rng)
            log = (Path(folder) / LOG).read_text(errors="replace")
        print(f"{name}: {counts}", flush=True)
        if not counts.is_good:
            print(log[-6000:], file=sys.stderr)
        all_good = all_good and counts.is_good
    if not all_good:
        raise UserError("the storm found damage; see above")
