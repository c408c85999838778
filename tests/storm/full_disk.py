"""Disk-full storm: `python -m tests.storm.full_disk --points 10`.

Each command writes to a small disk (tmpfs, in a mount namespace of its own) that fills up at a random place. It must
end in one line without a traceback and leave no process; with more room the same command goes on, and its results
equal those of a run in peace.
"""

import os
import random
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from predictor.support.command_line import parse
from predictor.support.config_checks import check_at_least
from predictor.support.errors import UserError, run_entry_point
from tests.storm.all_commands import LOG, NAMES, Counts, Name, try_all
from tests.storm.running import TRACEBACK, finish, orphans, start, tracebacks_below
from tests.storm.subjects import Subject, differs

INSIDE = "STORM_INSIDE"
ROOM = "512m"
MOST_TRIES = 4
"""Number of runs without a full disk after which a point is given up, for each point."""
_BLOCK = 4096


@dataclass(frozen=True)
class FullDiskConfig:
    """Lets commands run out of disk at random places."""

    points: int = 10
    """Number of times that a disk is full, spread over the commands in turn."""
    only: tuple[Name, ...] = NAMES
    """Commands to try."""
    seed: int = 0
    """Random seed of the places."""

    def __post_init__(self) -> None:
        """Checks ranges."""
        check_at_least(self, 1, "points")


def storm(name: str, subject: Subject, points: int, folder: Path, rng: random.Random) -> Counts:
    """Fills the disk of one command several times; returns what was counted (kills are full disks)."""
    disk = folder / "disk"
    _mount(disk, ROOM)
    try:
        return _fill(name, subject, points, folder, rng)
    finally:
        subprocess.run(["umount", str(disk)], check=True)


def _fill(name: str, subject: Subject, points: int, folder: Path, rng: random.Random) -> Counts:
    counts, disk, log = Counts(), folder / "disk", folder / LOG
    words = subject.words(folder / "inputs", disk)
    if finish(start(words, folder / "peace.log")):
        raise UserError(f"{name} fails in peace: {(folder / 'peace.log').read_text()[-2000:]}")
    expected, used = subject.results(disk), _used(disk)
    for _ in range(points * MOST_TRIES):
        if counts.kills == points:
            break
        _mount(disk, str(max(2, int(rng.uniform(0.02, 1.0) * used / _BLOCK)) * _BLOCK))
        run = start(words, log)
        status = finish(run)
        counts.orphans += len(orphans(run))
        said = run.said()
        counts.tracebacks += said.count(TRACEBACK) + tracebacks_below(disk)
        last = (said.strip().splitlines() or [""])[-1]
        print(f"{name}: full disk {counts.kills + 1} of {points}: status {status}: {last}", flush=True)
        if not status:
            continue
        counts.kills += 1
        counts.failures += not ("No space left" in said or "disk is full" in said)
        subprocess.run(["mount", "-o", f"remount,size={ROOM}", str(disk)], check=True)
        failed = finish(start(words, log)) != 0
        counts.failures += failed
        counts.unequal += not failed and differs(name, subject.results(disk), expected)
    counts.failures += counts.kills < points
    return counts


def _mount(disk: Path, size: str) -> None:
    """Puts an empty disk of some size at a path."""
    if disk.is_mount():
        subprocess.run(["umount", str(disk)], check=True)
    shutil.rmtree(disk, ignore_errors=True)
    disk.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "storm", str(disk)], check=True)


def _used(disk: Path) -> int:
    return sum(_BLOCK * -(-path.lstat().st_size // _BLOCK) for path in disk.rglob("*"))


def main() -> None:
    """Entry point."""
    config = parse(FullDiskConfig, __doc__)
    if INSIDE not in os.environ:
        words = ["unshare", "--map-root-user", "--mount", sys.executable, "-m", "tests.storm.full_disk", *sys.argv[1:]]
        os.execvpe("unshare", words, os.environ | {INSIDE: "1"})
    try_all(storm, config.only, config.points, config.seed)


if __name__ == "__main__":
    run_entry_point(main)
