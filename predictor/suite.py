"""Rerun the paper's tables: `python -m predictor.suite --table springs --budget cpu --data data --out runs/suite`.

Trains every row (each in its own process, resumable, cached by a hash of its config and data), measures it in both
views of docs/protocol.md, and prints the table as Markdown, with JSON and LaTeX beside it.
"""

import hashlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import matplotlib
from matplotlib import pyplot as plt
from rich.progress import Progress

from predictor.data.store import read_info_of
from predictor.evaluation.disentanglement import sklearn
from predictor.evaluation.measure_row import measure_row
from predictor.evaluation.paper_tables import BURN_IN_STEPS, HORIZON_STEPS, NUM_SAMPLES, TABLES, Budget, Row, Sizes
from predictor.reports.plots import plot_rows_by_step
from predictor.reports.tables import latex_table, markdown_report
from predictor.support.command_line import Renamed, parse
from predictor.support.config_checks import check_at_least, check_choices
from predictor.support.errors import UserError, run_entry_point
from predictor.support.files import write_json, write_text
from predictor.support.provenance import provenance
from predictor.support.runtime import resolve_device, tune
from predictor.train import train
from predictor.training.config import TrainConfig, TrainPrecision, check_precision

TableName = Literal["springs", "recipe", "mocap", "nba", "sdd", "ind"]


@dataclass(frozen=True)
class SuiteConfig:
    """Trains and measure every row of one of the paper's tables."""

    table: TableName
    """Table of the paper to rerun."""
    data: Path = Path("data")
    """Folder of the episode stores; a missing one is named with the command that makes it."""
    out: Path = Path("runs/suite")
    """Folder for runs, results and tables, with a folder below it for each table and budget."""
    budget: Budget = "cpu"
    """Sizes of networks and training: "smoke" takes minutes, "cpu" hours on two cores with smaller networks,
    "paper" needs a GPU for the paper's sizes."""
    rows: tuple[str, ...] = ()
    """Keys of the rows to run; none runs all."""
    steps: int = 0
    """Number of optimiser steps of every row; 0 takes the budget's."""
    workers: Annotated[int, Renamed("jobs")] = 0
    """Number of parallel processes, a row in each; 0 is one per core (one in all on a GPU)."""
    seed: int = 0
    """Random seed for training and forecasts."""
    device: str = "cpu"
    """Device that trains and measures: cpu, cuda or auto (cuda where there is one)."""
    precision: TrainPrecision = "float32"
    """Precision of matrix products in training (see `python -m predictor.train --help`); measuring is in float32."""
    only_row: str = ""
    """Key of a row to run in this process; the suite starts its processes with it."""

    def __post_init__(self) -> None:
        """Checks choices and ranges; `device="auto"` becomes the device that is taken.

        Raises:
            UserError: an unknown table or row, a number that makes no sense, or a device that is not there.
        """
        check_choices(self)
        check_at_least(self, 0, "steps", "workers", "seed")
        keys = [row.key for row in TABLES[self.table].rows]
        for key in (*self.rows, *filter(None, [self.only_row])):
            if key not in keys:
                raise UserError(f"table '{self.table}' has no row '{key}'; there are {', '.join(keys)}")
        object.__setattr__(self, "device", resolve_device(self.device))
        check_precision(self.precision, self.device)

    def check_stores(self) -> None:
        """Checks that the stores of the table are there.

        Raises:
            UserError: one is missing; the message has the commands that make them.
        """
        table = TABLES[self.table]
        missing = [s for s in (table.train, table.val, *table.tests.values()) if s and not (self.data / s).exists()]
        if missing:
            commands = "; ".join(c.format(data=self.data) for c in table.commands)
            raise UserError(f"no store at {self.data / missing[0]}; make the stores of this table with: {commands}")

    @property
    def sizes(self) -> Sizes:
        """The budget, with `steps` in its place."""
        sizes = TABLES[self.table].budgets[self.budget]
        return replace(sizes, steps=self.steps, eval_every=min(sizes.eval_every, self.steps)) if self.steps else sizes

    @property
    def folder(self) -> Path:
        """Folder for this table at this budget."""
        return self.out / f"{self.table}-{self.budget}"

    @property
    def num_processes(self) -> int:
        """Number of parallel processes, a row in each."""
        return self.workers or (1 if self.device.startswith("cuda") else os.cpu_count() or 1)


def row_config(config: SuiteConfig, row: Row, out: Path) -> TrainConfig:
    """What the row is trained with."""
    table, sizes = TABLES[config.table], config.sizes
    sets = (*sizes.widths.get(row.model, ()), *row.set)
    base = TrainConfig(
        data=(config.data / table.train,),
        val_data=(config.data / table.val,) if table.val else (),
        out=out,
        model=row.model,  # type: ignore[arg-type]  # rows without training do not come here
        preset="paper",
        set=sets,
        max_episodes=sizes.max_episodes,
        steps=sizes.steps,
        batch_size=sizes.batch_size,
        history_steps=BURN_IN_STEPS,
        min_history_steps=8,
        val_history_steps=BURN_IN_STEPS,
        horizon_steps=HORIZON_STEPS,
        val_windows=sizes.val_windows,
        eval_every=sizes.eval_every,
        patience=1000,
        seed=config.seed,
        device=config.device,
        precision=config.precision,
        threads=0 if config.device != "cpu" else max(1, (os.cpu_count() or 1) // config.num_processes),
        resume=True,
    )
    return replace(base, **row.train)


def row_folder(config: SuiteConfig, row: Row) -> Path:
    """Where the row's run and result lie: a new folder whenever its config or data change."""
    table, sizes = TABLES[config.table], config.sizes
    content: dict[str, Any] = {
        "row": {"model": row.model},
        "protocol": [BURN_IN_STEPS, HORIZON_STEPS, NUM_SAMPLES, table.test_stride, sizes.test_windows, config.seed],
        "stores": [_fingerprint(config.data / s) for s in (table.train, table.val, *table.tests.values()) if s],
    }
    if row.is_trained:
        values = asdict(row_config(config, row, Path()))
        for name in ("data", "val_data", "out", "threads", "device", "data_device", "capture", "resume"):
            del values[name]
        if values["precision"] == "float32":
            del values["precision"]  # rows that were trained before there was a choice keep their folder
        content["train"] = values
    digest = hashlib.sha256(json.dumps(content, sort_keys=True, default=str).encode()).hexdigest()[:10]
    return config.folder / "rows" / f"{row.key}-{digest}"


def run_row(config: SuiteConfig, row: Row) -> dict[str, Any]:
    """Trains (or resume) and measure one row; writes and returns its result."""
    if read_info_of(config.data / TABLES[config.table].train).edge_attribute_names:
        sklearn("linear_model")  # known to be missing now, not after training
    folder = row_folder(config, row)
    folder.mkdir(parents=True, exist_ok=True)
    began = time.perf_counter()
    checkpoint = None
    if row.is_trained:
        checkpoint = train(row_config(config, row, folder / "run"))
    trained = time.perf_counter()
    result = {
        "key": row.key,
        "name": row.name,
        "train_seconds": trained - began,
        **measure_row(TABLES[config.table], row, config.data, config.sizes, checkpoint, config.seed, config.device),
        "measure_seconds": time.perf_counter() - trained,
        "provenance": provenance(("torch", "numpy", "zarr")),
    }
    write_json(folder / "result.json", result)
    return result


def run_suite(config: SuiteConfig) -> dict[str, Any]:
    """Runs every row that has no result yet, then write the table; returns its content.

    Raises:
        UserError: a missing store.
    """
    config.check_stores()
    table = TABLES[config.table]
    chosen = [r for r in table.rows if not config.rows or r.key in config.rows]
    pending = [r for r in chosen if not (row_folder(config, r) / "result.json").exists()]
    began = time.perf_counter()
    failed = _run_in_processes(config, pending)
    results = {
        r.key: json.loads((row_folder(config, r) / "result.json").read_text())
        for r in chosen
        if (row_folder(config, r) / "result.json").exists()
    }
    content = {
        "table": config.table,
        "title": table.title,
        "budget": config.budget,
        "sizes": asdict(config.sizes),
        "wall_seconds_this_call": time.perf_counter() - began,
        "train_seconds": sum(r["train_seconds"] for r in results.values()),
        "rows": [results[r.key] for r in chosen if r.key in results],
        "paper": {r.key: r.paper for r in chosen if r.paper},
        "failed": failed,
        "provenance": provenance(("torch", "numpy", "zarr")),
    }
    config.folder.mkdir(parents=True, exist_ok=True)
    write_json(config.folder / "table.json", content)
    for name, text in (("table.md", markdown_report(content)), ("table.tex", latex_table(content))):
        write_text(config.folder / name, text)
    if content["rows"]:
        _plot(config, content["rows"], content["title"])
    return content


def _plot(config: SuiteConfig, rows: Sequence[dict[str, Any]], title: str) -> None:
    matplotlib.use("Agg")
    kinds = list(rows[0]["tests"])
    dt_s = read_info_of(config.data / TABLES[config.table].tests[kinds[0]]).spec.dt_s
    figure, axes = plt.subplots(
        1, len(kinds), figsize=(1 + 5 * len(kinds), 5.2), sharey=True, squeeze=False, layout="constrained"
    )
    for ax, kind in zip(axes[0], kinds, strict=True):
        plot_rows_by_step(ax, rows, kind, dt_s).set_title(kind)
    axes[0, 0].set_ylabel("displacement of the best sample [m]")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2 * len(kinds), fontsize=7.5, frameon=False)
    figure.suptitle(
        f"{title}, budget {config.budget}, one seed per row; bars: standard error over 20 subsets", fontsize=9
    )
    figure.savefig(config.folder / "by_step.png", dpi=110)
    plt.close(figure)


def _run_in_processes(config: SuiteConfig, pending: Sequence[Row]) -> dict[str, str]:
    """Rows in parallel; the ones that fail, with their last line."""
    waiting, failed = list(pending), {}
    running: dict[str, tuple[subprocess.Popen[bytes], Path]] = {}
    with Progress() as progress:
        task = progress.add_task(f"{config.table}: {len(pending)} rows to run", total=len(pending))
        try:
            while waiting or running:
                while waiting and len(running) < config.num_processes:
                    row = waiting.pop(0)
                    running[row.key] = _start(config, row)
                time.sleep(0.5)
                for key, (process, log) in list(running.items()):
                    if process.poll() is None:
                        continue
                    del running[key]
                    if process.returncode:
                        failed[key] = (log.read_text(errors="replace").strip().splitlines() or ["no output"])[-1]
                    progress.advance(task)
                    progress.update(task, description=f"{config.table}: {', '.join(running) or 'done'}")
        finally:
            for process, _ in running.values():
                process.terminate()
    return failed


def _start(config: SuiteConfig, row: Row) -> "tuple[subprocess.Popen[bytes], Path]":
    folder = row_folder(config, row)
    folder.mkdir(parents=True, exist_ok=True)
    log = folder / "log.txt"
    command = [
        sys.executable, "-m", "predictor.suite", "--table", config.table, "--data", str(config.data),
        "--out", str(config.out), "--budget", config.budget, "--steps", str(config.steps), "--workers",
        str(config.num_processes), "--seed", str(config.seed), "--device", config.device,
        "--precision", config.precision, "--only-row", row.key,
    ]  # fmt: skip
    with log.open("wb") as stream:
        return subprocess.Popen(command, stdout=stream, stderr=subprocess.STDOUT), log


def _fingerprint(path: Path) -> str:
    """Of a store, without reading its arrays: what it was made from and how."""
    info = read_info_of(path)
    made = {k: v for k, v in info.provenance.items() if k not in ("time", "machine", "versions", "commit", "command")}
    content = json.dumps([asdict(info.spec), info.source, made, info.num_steps], sort_keys=True, default=str)
    return hashlib.sha256(content.encode()).hexdigest()


def main() -> None:
    """Entry point."""
    config = parse(SuiteConfig, __doc__)
    tune(config.device)
    if config.only_row:
        config.check_stores()
        run_row(config, next(r for r in TABLES[config.table].rows if r.key == config.only_row))
        return
    content = run_suite(config)
    print((config.folder / "table.md").read_text())
    print(f"written to {config.folder}: table.md, table.json, table.tex, by_step.png")
    if content["failed"]:
        raise UserError(
            "; ".join(f"row '{key}' failed: {reason}" for key, reason in content["failed"].items())
            + f"; its log is in {config.folder / 'rows'}, and running the same command again retries it"
        )


if __name__ == "__main__":
    run_entry_point(main)
