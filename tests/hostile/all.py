"""Tries all bad inputs, each in a process of its own: `python -m tests.hostile.all`.

Prints what does not end in one clear line and is not argued to be fine (`tests.hostile.argued`), and how many ended in
what way; ends with status 2 if there is any such input.
"""

import contextlib
import importlib
import io
import shutil
import tempfile
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import torch

from predictor.support.command_line import parse
from predictor.support.errors import UserError, run_entry_point
from tests.hostile import attempts, calls
from tests.hostile.argued import reason_of
from tests.hostile.inputs import write_inputs
from tests.hostile.samples import KINDS
from tests.hostile.trying import Trial, try_apart
from tests.hostile.zoo import CASES, Case
from tests.test_entry_points import REFUSED

Part = Literal["numbers", "paths", "names", "contradictions", "environment", "files", "calls"]
PARTS: tuple[Part, ...] = get_args(Part)


@dataclass(frozen=True)
class AllConfig:
    """Tries all bad inputs."""

    only: tuple[Part, ...] = PARTS
    """Parts of the zoo."""
    of: str = ""
    """Beginning of the titles that are tried, for example predictor.train."""


@dataclass(frozen=True)
class FileTrial:
    """A damaged file that is loaded."""

    case: Case
    """Damage."""

    @property
    def title(self) -> str:
        """Name of the trial."""
        return self.case.title

    @property
    def expected(self) -> tuple[str, ...]:
        """Parts of the line."""
        return tuple(self.case.expected.split("|"))

    def run(self) -> None:
        """Makes a sample, damages it and loads it."""
        with tempfile.TemporaryDirectory() as name:
            sample = Path(name) / "sample"
            sample.mkdir()
            with contextlib.redirect_stdout(io.StringIO()):
                KINDS[self.case.kind].make(sample)
            self.case.spoil(sample)
            KINDS[self.case.kind].load(sample)


def files() -> Iterator[FileTrial]:
    """Yields all damaged files."""
    yield from map(FileTrial, CASES)


SOURCES: dict[Part, Callable[[], Iterable[Trial]]] = {
    "numbers": attempts.numbers,
    "paths": attempts.paths,
    "names": attempts.names,
    "contradictions": attempts.contradictions,
    "environment": attempts.environment,
    "files": files,
    "calls": calls.calls,
}
"""Trials by part."""


def try_all(config: AllConfig) -> Counter[str]:
    """Tries everything; prints what is neither clear nor argued, and returns how many ended in what way."""
    torch.set_num_threads(1)
    counts: Counter[str] = Counter()
    for command in REFUSED:
        importlib.import_module(command)
    with tempfile.TemporaryDirectory(prefix="hostile-") as name:
        inputs = Path(name) / "inputs"
        inputs.mkdir()
        with contextlib.redirect_stdout(io.StringIO()):
            write_inputs(inputs)
        for part in config.only:
            for trial in SOURCES[part]():
                if not trial.title.startswith(config.of):
                    continue
                outcome = try_apart(trial, inputs)
                verdict = outcome.verdict
                if verdict != "one clear line" and reason_of(trial.title, verdict):
                    verdict = "argued fine"
                counts[verdict] += 1
                if verdict not in ("one clear line", "argued fine"):
                    last = outcome.said.strip().splitlines()[-2:]
                    print(
                        f"{verdict}: {trial.title!r} ({outcome.seconds:.1f} s): {' | '.join(last)[-400:]!r}", flush=True
                    )
    shutil.rmtree(name, ignore_errors=True)
    if not counts:
        raise UserError(f"of must begin the title of a trial, got '{config.of}'; leave it out to try all")
    return counts


def main() -> None:
    """Entry point."""
    counts = try_all(parse(AllConfig, __doc__))
    print(f"tried {sum(counts.values())}: " + ", ".join(f"{number} {name}" for name, number in counts.most_common()))
    if wrong := sum(number for name, number in counts.items() if name not in ("one clear line", "argued fine")):
        raise UserError(f"{wrong} bad inputs ended otherwise; see above")


if __name__ == "__main__":
    run_entry_point(main)
