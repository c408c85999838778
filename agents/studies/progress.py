"""Progress of a study: one line per cell that ended, on the terminal and in the study's log."""

import datetime
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from agents.studies.cells import Cell
from agents.studies.findings import column
from agents.studies.results import Result

STUDY_LOG = "study.log"


class Progress:
    """Writes a line when a cell ends, with an estimate of the time that is left.

    Args:
        folder: folder of the study.
        total: number of all cells.
        done: number of cells with a result.
        missing: cells that are going to run.
        workers: number of cells that run side by side.
    """

    def __init__(self, folder: Path, total: int, done: int, missing: Sequence[Cell], workers: int) -> None:
        """Writes the first line."""
        self._log, self._total, self._missing, self._workers = folder / STUDY_LOG, total, list(missing), workers
        self._done, self._began = done, time.monotonic()
        self._work_done = 0.0
        at_once = min(workers, len(missing))
        self._say(f"{total} cells, {done} of them finished before, {len(missing)} to run; {at_once} at a time")

    def finished(self, cell: Cell, result: Result) -> None:
        """Writes the line of a cell that has a result."""
        value = np.mean(column(result, "episode_return"))
        self._end(cell, f"return {value:.2f}")

    def failed(self, cell: Cell) -> None:
        """Writes the line of a cell that has no result."""
        self._end(cell, "failed")

    def _end(self, cell: Cell, outcome: str) -> None:
        self._done += 1
        self._missing.remove(cell)
        self._work_done += _work(cell)
        left_s = (time.monotonic() - self._began) / self._work_done * sum(map(_work, self._missing))
        self._say(f"[{self._done}/{self._total}] {cell.title}: {outcome}; about {left_s / 60:.0f} min left")

    def _say(self, text: str) -> None:
        line = f"{datetime.datetime.now():%H:%M:%S} {text}"
        print(line, flush=True)
        with self._log.open("a", encoding="utf-8") as log:
            log.write(line + "\n")


def _work(cell: Cell) -> float:
    """Returns how much there is to do for a cell, in test episodes: a training counts 25 steps as one."""
    if cell.plan is None:
        return float(cell.episodes)
    return cell.episodes + cell.plan.steps / 25 + cell.plan.selections * cell.plan.selection_episodes
