"""Studies what a policy gains from forecasts: `python -m agents.study --study quick`.

A study is a TOML file: scenarios × arms × algorithms × seeds, and drivers beside them (docs/study.md). Every cell is
one training with its test episodes, in a process of its own. The same command continues a study that was stopped, and
never runs a finished cell again. The folder then holds report.html, report.md, episodes.parquet and curves.parquet.
"""

import itertools
import json
import os
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, cast

from agents.episode_file import has_pyarrow
from agents.presets import preset_for
from agents.results import PACKAGES
from agents.studies.cells import Cell, cells_of
from agents.studies.findings import Findings
from agents.studies.plan import Study, read_study, shipped_studies, study_file
from agents.studies.pool import run_cells
from agents.studies.progress import Progress
from agents.studies.report import HEADROOM, PAGE, REPORT, write_headroom, write_report
from agents.studies.results import RESULT_FILE, Result, read_result, write_tables
from agents.task import Task
from envs.registry import envpool_task_of
from envs.sb3.algorithms import Algorithm
from envs.simulators.envpool import begins_alike
from predictor.support.cluster import check_address, connected
from predictor.support.command_line import parse
from predictor.support.config_checks import check_at_least
from predictor.support.errors import UserError, run_entry_point
from predictor.support.files import check_out, delete_leftovers, new_file, write_text
from predictor.support.jobs import LOG_FILE
from predictor.support.locks import locked
from predictor.support.memory import PROCESS_BYTES, check_count
from predictor.support.provenance import commit_at_start, provenance
from predictor.support.stopping import resumable

CELLS = "cells"
STUDY_FILE, EARLIER_FILE = "study.toml", "study.before.toml"
FAILED = 1
"""Exit status if a cell failed."""


@dataclass(frozen=True)
class StudyConfig:
    """Runs all cells of a study side by side, and writes its tables and its report."""

    study: str = "quick"
    """Study: the name of one that ships (see --list), or the path of a TOML file."""
    out: Path | None = None
    """Folder of the study; None takes runs/study-NAME. The same command continues what is in it."""
    workers: int = 0
    """Number of cells that run side by side, each in a process with one thread; 0 is one per core."""
    scenarios: tuple[str, ...] = ()
    """Scenarios to run, by their names in the study; none given runs all. The report has all that were run so far."""
    seeds: int | None = None
    """Number of training seeds to run, the first ones of the study; None runs all."""
    cluster: str | None = None
    """Ray cluster that runs the cells, in place of --workers: auto (the one that runs on this machine) or HOST:PORT of
    its head; --out has to be on a file system that all machines share (docs/scale.md). None runs them here."""
    headroom: bool = False
    """Run the arms of no and of perfect foresight alone, beside constant actions and planner: is there anything to
    gain? Writes headroom.md."""
    report: bool = False
    """Write tables and report of all results that the folder has, those of earlier versions too, and run nothing."""
    list: bool = False
    """Print the studies that ship, and run nothing."""

    def __post_init__(self) -> None:
        """Checks ranges."""
        check_at_least(self, 0, "workers")
        check_at_least(self, 1, "seeds")
        check_count(self.workers, "workers", PROCESS_BYTES)
        check_address(self.cluster)
        if self.report and (self.scenarios or self.seeds is not None or self.cluster is not None):
            raise UserError("--report takes all results in the folder; leave out --scenarios, --seeds and --cluster")

    @property
    def num_processes(self) -> int:
        """Number of cells that run side by side."""
        return self.workers or os.cpu_count() or 1


def run_study(config: StudyConfig) -> int:
    """Runs the cells without a result, writes tables and report; returns the exit status.

    Raises:
        UserError: the study file, the folder or a result in it is not as it must be; nothing has been run then.
    """
    if not has_pyarrow():
        raise UserError("a study writes Parquet tables, which need pyarrow; pip install 'dgvae-rl[study]'")
    file = study_file(config.study)
    study, text = read_study(file), file.read_text(encoding="utf-8")
    if config.headroom:
        study = _with_file(study, file)
    folder = config.out or Path("runs") / f"study-{study.name}"
    check_out(folder)
    _check_folder(folder)
    if config.report:
        return _report_only(config, folder, study, text)
    cells = cells_of(study, file.name)
    chosen = _chosen(config, study, cells)
    with locked(folder, "study"):
        delete_leftovers(folder)
        results = _results_of(folder, cells)
        _keep_file(folder, text)
        copies = {envpool_task_of(cell.task.env_id) for cell in chosen if cell.task.backend == "envpool"}
        for task_id in filter(begins_alike, sorted(copies)):
            print(f"note: EnvPool's {task_id} begins every training episode in the same state; the original does not")
        failed = _run_missing(config, folder, chosen, results, len(cells))
        done = _in_order(study, [results[cell.name] for cell in cells if cell.name in results])
        not_run = _counted(len(cells) - len(done) - len(failed), "cell")
        _write(config, folder, study, done, text, [cell for cell, _ in failed], not_run)
    for cell, reason in failed:
        log = folder / CELLS / cell.name / LOG_FILE
        print(f"failed: {cell.title}: {reason}; its log is {log}", file=sys.stderr)
    return FAILED if failed else 0


def _with_file(study: Study, file: Path) -> Study:
    try:
        return study.headroom_only()
    except UserError as error:
        raise UserError(f"{file.name}: {error}") from error


def _chosen(config: StudyConfig, study: Study, cells: Sequence[Cell]) -> list[Cell]:
    """Returns the cells that the command asks for.

    Raises:
        UserError: an unknown scenario, or more training seeds than the study has.
    """
    known = [scenario.name for scenario in study.scenarios]
    for name in config.scenarios:
        if name not in known:
            raise UserError(f"study {study.name} has no scenario '{name}'; it has {', '.join(known)}")
    most = len(study.training_seeds)
    if config.seeds is not None and config.seeds > most:
        raise UserError(
            f"study {study.name} has {most} training seeds, got --seeds {config.seeds}; change seeds in a copy of its "
            "file"
        )
    seeds = {None, *study.training_seeds[: config.seeds]}
    return [cell for cell in cells if cell.scenario in (config.scenarios or known) and cell.seed in seeds]


def _check_folder(folder: Path) -> None:
    """Checks that a folder holds a study, or nothing.

    Raises:
        UserError: it holds something else.
    """
    if folder.exists() and not (folder / STUDY_FILE).exists():
        found = [path.name for path in folder.iterdir() if not path.name.startswith(".")]
        if found:
            raise UserError(f"{folder} holds {found[0]} but no study ({STUDY_FILE}); choose another --out")


def _keep_file(folder: Path, text: str) -> None:
    """Writes the study's file into the folder; the file of an earlier run is kept if it was another one."""
    earlier = folder / STUDY_FILE
    if earlier.exists() and (before := earlier.read_bytes()) != text.encode():
        with new_file(folder / EARLIER_FILE) as partial:
            partial.write_bytes(before)
        print(f"{earlier} was of another study or an earlier version; kept as {EARLIER_FILE}", file=sys.stderr)
    write_text(earlier, text)


def _results_of(folder: Path, cells: Sequence[Cell]) -> dict[str, Result]:
    """Reads the results that are there, by the names of their cells.

    Raises:
        UserError: one of them is damaged.
    """
    files = {cell.name: folder / CELLS / cell.name / RESULT_FILE for cell in cells}
    return {name: read_result(file) for name, file in files.items() if file.exists()}


def _report_only(config: StudyConfig, folder: Path, study: Study, text: str) -> int:
    """Writes tables and report of all results in the folder; returns the exit status.

    Raises:
        UserError: there is none, or one is damaged.
    """
    results = _all_results(folder, study)
    if not results:
        raise UserError(f"{folder} holds no result of this study ({CELLS}/NAME/{RESULT_FILE}); run it without --report")
    with locked(folder, "study"):
        _keep_file(folder, text)
        trained = sum(result.algorithm is not None for result in results)
        to_train = len(study.scenarios) * len(study.arms) * len(study.algorithms) * len(study.training_seeds)
        _write(config, folder, study, results, text, (), _counted(to_train - trained, "training"))
    return 0


def _all_results(folder: Path, study: Study) -> list[Result]:
    """Reads the results of a study's scenarios and arms, whatever version they are of; of two of one cell the later.

    Those of other settings than the file's are left out, which a line says.

    Raises:
        UserError: one of them is damaged.
    """
    ids = {scenario.name: scenario.env_id for scenario in study.scenarios}  # a scenario's may have changed
    advice = "move it away for a report of the others; the command without --report measures its cell anew"
    every = [read_result(file, advice) for file in sorted((folder / CELLS).glob(f"*/{RESULT_FILE}"))]
    found = [each for each in every if each.env_id == ids.get(each.scenario)]
    fitting = [each for each in found if _has_settings_of(each, study)]
    if len(fitting) < len(found):
        others = len(found) - len(fitting)
        print(f"left out: {others} results of other settings than {study.name}'s file has now", file=sys.stderr)
        found = fitting
    return _in_order(study, sorted(found, key=lambda each: str(each.provenance.get("time"))))


def _in_order(study: Study, results: Iterable[Result]) -> list[Result]:
    """Returns the results of the study's drivers and arms in the order of its file; of two of one cell the later."""
    latest = {(each.scenario, each.arm, each.algorithm, each.seed): each for each in results}
    drivers = {arm for _, arm, algorithm, _ in latest if algorithm is None}
    arms = list(itertools.product([arm.name for arm in study.arms], study.algorithms, study.training_seeds))
    cells = [
        (scenario.name, *line)
        for scenario in study.scenarios
        for line in (*((name, None, None) for name in scenario.references_among(drivers)), *arms)
    ]
    return [latest[cell] for cell in cells if cell in latest]


def _counted(number: int, what: str) -> str:
    """Returns a number of things as text; empty for none."""
    return f"{number} {what}{'s' * (number > 1)}" if number else ""


def _has_settings_of(result: Result, study: Study) -> bool:
    """Returns whether a result is of the settings that the study's file has now, as far as the result says."""
    scenario = next(scenario for scenario in study.scenarios if scenario.name == result.scenario)
    arm = next((arm for arm in study.arms if arm.name == result.arm), None)
    if result.settings is None or (arm is None and result.algorithm is not None):  # an arm that is gone
        return True
    wanted = study.settings_of(scenario, None if result.algorithm is None else arm, result.algorithm)
    return _meaning(result.settings, scenario.env_id, result.algorithm) == _meaning(
        wanted, scenario.env_id, result.algorithm
    )


def _meaning(said: Mapping[str, Any], env_id: str, algorithm: str | None) -> dict[str, Any]:
    """Returns what a file says of a result without what changes none: the device, and values that are the defaults."""
    options = {**said.get("scenario", {}), **said.get("arm", {})}
    usual = {field.name: field.default for field in fields(Task)}
    backend = options.get("backend", "gymnasium")
    preset = {} if algorithm is None else asdict(preset_for(env_id, cast(Algorithm, algorithm), backend))
    usual, preset = json.loads(json.dumps([usual, preset], default=str))
    named = {k: v for k, v in options.items() if k != "device" and (k not in usual or v != usual[k])}
    changes = {key: value for key, value in said.get("settings", {}).items() if value != preset.get(key)}
    return {**said, "scenario": named, "arm": {}, "settings": changes}


def _run_missing(
    config: StudyConfig, folder: Path, cells: Sequence[Cell], results: dict[str, Result], total: int
) -> list[tuple[Cell, str]]:
    """Runs the chosen cells without a result and adds theirs; returns those that failed, and why."""
    missing, failed = [cell for cell in cells if cell.name not in results], list[tuple[Cell, str]]()
    with connected(config.cluster if missing else None, PACKAGES) as cluster:
        side_by_side = config.num_processes if cluster is None else cluster.size
        note = _notes(folder, results, failed, Progress(folder, total, len(results), missing, side_by_side))
        run_cells(missing, folder / CELLS, commit_at_start(), note, config.num_processes, cluster)
    return failed


def _notes(
    folder: Path, results: dict[str, Result], failed: list[tuple[Cell, str]], progress: Progress
) -> Callable[[Cell, str | None], None]:
    """Returns what notes a cell that ended, among the results or those that failed."""

    def note(cell: Cell, reason: str | None) -> None:
        if reason is None:
            results[cell.name] = read_result(folder / CELLS / cell.name / RESULT_FILE)
            progress.finished(cell, results[cell.name])
        else:
            failed.append((cell, reason))
            progress.failed(cell)

    return note


def _write(
    config: StudyConfig, folder: Path, study: Study, results: Sequence[Result], text: str, failed: Sequence[Cell],
    not_run: str,
) -> None:  # fmt: skip
    """Writes what the study found, and says where; `not_run` says how many cells are not run yet, empty for none."""
    if not results:
        return
    findings, made = Findings.of(study, results), provenance(PACKAGES)
    titles = [cell.title for cell in failed]
    if config.headroom:
        print(write_headroom(folder, findings, made, titles, not_run))
        print(f"written to {folder / HEADROOM}")
        return
    write_tables(folder, results)
    write_report(folder, findings, text, made, titles, not_run)
    print(f"written to {folder}: {REPORT}, {PAGE}, episodes.parquet, curves.parquet")


def main() -> None:
    """Runs the command."""
    config = parse(StudyConfig, __doc__)
    if config.list:
        print("\n".join(f"{name}: {read_study(study_file(name)).title}" for name in shipped_studies()))
        return
    for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ[name] = "1"  # of the cells' processes: each fills one core
    with resumable("the same command goes on: finished cells are kept, others continue"):
        status = run_study(config)
    if status:
        sys.exit(status)


if __name__ == "__main__":
    run_entry_point(main)
