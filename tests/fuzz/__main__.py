"""Coverage-guided fuzzing of what is read from files: `python -m tests.fuzz json --seconds 60`.

Inputs grow from the corpus (`tests/fuzz/corpus/`) towards lines that were not reached yet. Only a `UserError` of one
printable line may come of an input, within a second, in bounded memory. What is found lies in the folder of the entry
under `--out`; copied into the corpus, the default tests replay it. It needs the extra `fuzz` (atheris, Linux).
"""

import importlib.util
import os
import re
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from predictor.support.command_line import parse
from predictor.support.config_checks import check_at_least
from predictor.support.errors import UserError, run_entry_point
from tests.fuzz.entries import ENTRY_NAMES, MOST_BYTES, EntryName, stored

MOST_MIB = 2048
"""Memory that the process may take [MiB]; torch and the libraries take 500 of it."""


@dataclass(frozen=True)
class FuzzConfig:
    """Fuzzes one kind of input."""

    entry: Positional[EntryName]
    """Kind of input."""
    seconds: int = 60
    """Time [s]."""
    seed: int = 1
    """Random seed."""
    out: Path = Path("runs/fuzz")
    """Folder of inputs that reached new lines and of findings."""

    def __post_init__(self) -> None:
        """Checks ranges."""
        check_at_least(self, 1, "seconds", "seed")


def run(config: FuzzConfig) -> tuple[int, list[Path]]:
    """Fuzzes in a process of its own; returns the number of inputs that were tried, and this run's findings.

    Raises:
        UserError: atheris is not installed, or the process said nothing.
    """
    if importlib.util.find_spec("atheris") is None:
        raise UserError(
            "fuzzing needs atheris; install it with pip install -c constraints.txt -e '.[all,fuzz]' (Linux)"
        )
    grown, found = config.out / config.entry / "corpus", config.out / config.entry / "findings"
    for folder in (grown, found):
        folder.mkdir(parents=True, exist_ok=True)
    for path in stored(config.entry):
        (grown / path.name).write_bytes(path.read_bytes())
    libfuzzer = [
        f"-max_total_time={config.seconds}", f"-seed={config.seed}", f"-max_len={MOST_BYTES}", "-timeout=10",
        f"-rss_limit_mb={MOST_MIB}", "-print_final_stats=1", "-close_fd_mask=1", f"-artifact_prefix={found}/",
        str(grown),
    ]  # fmt: skip
    words = [sys.executable, "-m", "tests.fuzz.child", config.entry, str(found), *libfuzzer]
    before = {path: path.stat().st_mtime_ns for path in found.iterdir()}
    said = subprocess.run(words, stderr=subprocess.PIPE, text=True, errors="replace", check=False).stderr
    tried = re.search(r"stat::number_of_executed_units:\s*(\d+)", said)
    changed = [path for path in found.iterdir() if path.stat().st_mtime_ns != before.get(path)]
    findings = sorted(path for path in changed if path.suffix != ".txt")  # of this run, not of earlier ones
    if tried is None and not findings:
        raise UserError(f"the fuzzer ended early: {said[-1500:]}")
    return int(tried[1]) if tried else 0, findings


def main() -> None:
    """Entry point."""
    config = parse(FuzzConfig, __doc__)
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    tried, findings = run(config)
    print(f"{config.entry}: {tried} inputs in {config.seconds} s, {len(findings)} findings")
    for path in findings:
        note = path.with_suffix(".txt")
        print(f"  {path}: {note.read_text().strip().splitlines()[-1] if note.is_file() else 'hang or memory'}")
    if findings:
        raise UserError(f"{len(findings)} inputs broke the boundary; mend it and copy them into tests/fuzz/corpus")


if __name__ == "__main__":
    assert ENTRY_NAMES
    run_entry_point(main)
