"""Runs cells side by side, each in a process of its own, in a folder that one study uses at a time."""

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from agents.studies.cells import Cell, run_cell
from agents.studies.results import RESULT_FILE
from predictor.support.cluster import Cluster
from predictor.support.jobs import run_tasks
from predictor.support.runtime import keep_freed_memory


def run_cells(
    cells: Sequence[Cell],
    folder: Path,
    commit: str,
    on_end: Callable[[Cell, str | None], None],
    workers: int,
    cluster: Cluster | None = None,
) -> None:
    """Runs cells; returns when all have ended.

    Args:
        cells: cells without a result.
        folder: folder of the cells' folders, inside that of the study, which is locked.
        commit: commit whose code runs them.
        on_end: called with each cell that ended, and why it has no result; with None if it has one.
        workers: largest number of processes of this machine.
        cluster: machines that run the cells instead, and share the folder.

    Raises:
        UserError: a machine of the cluster does not see the folder, or has other versions.
    """
    tasks = [_Task(cell, folder.absolute(), commit) for cell in cells]
    with contextlib.closing(run_tasks(tasks, workers=workers, cluster=cluster, imports=[__name__])) as ended:
        for number, reason in ended:
            on_end(cells[number], reason)


@dataclass(frozen=True)
class _Task:
    """Cell that is run in a process of its own."""

    cell: Cell
    cells: Path
    commit: str

    @property
    def folder(self) -> Path:
        """Folder of the cell."""
        return self.cells / self.cell.name

    @property
    def result(self) -> Path:
        """File of its result."""
        return self.folder / RESULT_FILE

    @property
    def locked_folder(self) -> Path:
        """Folder of the study."""
        return self.cells.parent

    def run(self) -> None:
        """Runs the cell."""
        keep_freed_memory()
        run_cell(self.cell, self.folder, self.commit)

    def waits_for(self, other: Any) -> bool:
        """Returns False: cells stand alone."""
        return False
