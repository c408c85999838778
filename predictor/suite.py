"""Reruns the paper's tables: `python -m predictor.suite --table springs --budget cpu --data data --out runs/suite`.

Trains each line under each seed (in its own process, resumable, cached by a hash of its config and data), measures it
in both views of docs/protocol.md, and prints the table as Markdown, with JSON and LaTeX beside it.
"""

import contextlib
import hashlib
import json
import os
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import matplotlib
import torch

from predictor.data.store import content_id, read_info_of
from predictor.evaluation.ablations import ABLATIONS
from predictor.evaluation.disentanglement import sklearn
from predictor.evaluation.measure_line import FEATURED, measure_line
from predictor.evaluation.nri_tables import NRI_TABLES
from predictor.evaluation.paper_tables import NUM_SAMPLES, Budget, Line, Sizes
from predictor.evaluation.paper_tables import TABLES as PAPER_TABLES
from predictor.evaluation.training_seeds import joined
from predictor.reports.plots import figure_by_step, save_figure
from predictor.reports.suite_tables import latex_table, markdown_report
from predictor.support.cluster import check_address, connected
from predictor.support.command_line import parse
from predictor.support.config_checks import check_at_least, check_choices
from predictor.support.errors import UserError, run_entry_point
from predictor.support.files import finite, write_json, write_text
from predictor.support.jobs import run_tasks
from predictor.support.locks import locked
from predictor.support.memory import PROCESS_BYTES, check_count
from predictor.support.progress import WorkShown
from predictor.support.provenance import provenance
from predictor.support.reading import read_object
from predictor.support.remote import exists
from predictor.support.runtime import resolve_device, tune
from predictor.support.stopping import resumable
from predictor.train import train
from predictor.training.config import TrainConfig, TrainPrecision, check_precision

TableName = Literal[
    "springs", "mocap", "nba", "sdd", "ind", "recipe", "recipe-driving", "modes", "modes-driving", "nri-springs",
    "nri-charged",
]  # fmt: skip

TABLES = PAPER_TABLES | ABLATIONS | NRI_TABLES
MIN_HISTORY_STEPS = 8
"""Smallest number of observed steps of a training window, where the table's burn-in is not shorter."""
ADDED = {
    "precision": "float32", "causal_edges": False, "reaction_weight": 0.0, "init": "", "only_spread": False,
    "shift_weight": 0.0, "keep": "best", "refit_scales": False,
}  # fmt: skip
"""Options that came after the first lines were trained, with the values that change nothing."""
PACKAGES = ("torch", "numpy", "zarr")
MEASURING = 2
"""Number of the way of measuring: results of another one are not taken for finished."""


@dataclass(frozen=True)
class SuiteConfig:
    """Trains and measures all lines of one of the paper's tables, of an ablation, or of a table beside NRI's."""

    table: TableName
    """Table to run: one of the paper's; what each part of the dG-VAE+ (recipe) or of its modes is worth, on springs or
    in driving; or graph accuracy on NRI's simulators."""
    data: Path = Path("data")
    """Folder of the episode stores; a missing one is named with the command that makes it."""
    out: Path = Path("runs/suite")
    """Folder for runs, results and tables, with a folder below it for each table and budget."""
    budget: Budget = "cpu"
    """Sizes of networks and training: "smoke" takes minutes, "cpu" about an hour on two cores with smaller networks,
    "paper" needs a GPU for the paper's sizes."""
    lines: tuple[str, ...] = ()
    """Keys of the lines to run; none runs all."""
    steps: int = 0
    """Number of optimiser steps of every line; 0 takes that of the budget."""
    workers: int = 0
    """Number of parallel processes, a line in each, which share all cores (or OMP_NUM_THREADS threads, where that is
    set); 0 is one per core (one in all on a GPU)."""
    seed: int = 0
    """Random seed for training and forecasts; the first one, if there are several."""
    device: str = "cpu"
    """Device that trains and measures: cpu, cuda or auto (cuda where there is one)."""
    precision: TrainPrecision = "float32"
    """Precision of matrix products in training (see `python -m predictor.train --help`); measuring is in float32."""
    seeds: int = 1
    """Number of training seeds of each line, from `seed` on; cells then show mean and range."""
    cluster: str | None = None
    """Ray cluster that runs the lines, each on one CPU (and one GPU with --device cuda): auto (the one that runs on
    this machine) or HOST:PORT of its head; --data and --out have to be on a file system that all machines share
    (docs/scale.md). None runs them here."""

    def __post_init__(self) -> None:
        """Checks choices and ranges; `device="auto"` becomes the device that is taken.

        Raises:
            UserError: an unknown table or line, a number out of range, or a device that is not there.
        """
        check_choices(self)
        check_at_least(self, 0, "steps", "workers", "seed")
        check_at_least(self, 1, "seeds")
        check_count(self.seeds, "seeds")
        check_count(self.workers, "workers", PROCESS_BYTES)
        check_address(self.cluster)
        keys = [line.key for line in TABLES[self.table].lines]
        for key in self.lines:
            if key not in keys:
                raise UserError(f"table '{self.table}' has no line '{key}'; there are {', '.join(keys)}")
        object.__setattr__(self, "device", resolve_device(self.device))
        check_precision(self.precision, self.device)

    def check_stores(self) -> None:
        """Checks that the stores of the table are there.

        Raises:
            UserError: a store is missing; the message has the commands that make it.
        """
        table = TABLES[self.table]
        missing = [s for s in (table.train, table.val, *table.tests.values()) if s and not exists(self.data / s)]
        if missing:
            commands = "; ".join(c.format(data=self.data) for c in table.commands)
            raise UserError(f"no store at {self.data / missing[0]}; make the stores of this table with: {commands}")

    @property
    def sizes(self) -> Sizes:
        """Sizes of the budget, with `steps` if it is given."""
        sizes = TABLES[self.table].budgets[self.budget]
        return replace(sizes, steps=self.steps, eval_every=min(sizes.eval_every, self.steps)) if self.steps else sizes

    @property
    def folder(self) -> Path:
        """Folder for this table at this budget."""
        return self.out / f"{self.table}-{self.budget}"

    @property
    def num_processes(self) -> int:
        """Number of parallel processes, a line in each, between which the cores are divided."""
        if self.cluster is not None and self.device == "cpu":
            return os.cpu_count() or 1  # a line has one CPU
        return self.workers or (1 if self.device.startswith("cuda") else os.cpu_count() or 1)


def line_config(config: SuiteConfig, line: Line, out: Path) -> TrainConfig:
    """Returns the training config of a line."""
    table, sizes = TABLES[config.table], config.sizes
    sets = (*sizes.widths.get(line.model, ()), *line.set)
    val_history_steps = min(table.protocol.burn_in_steps, table.protocol.train_history_steps)
    base = TrainConfig(
        data=(config.data / table.train,),
        val_data=(config.data / table.val,) if table.val else (),
        out=out,
        model=line.model,  # type: ignore[arg-type]  # lines without training do not come here
        preset="paper",
        set=sets,
        input_changes=False,  # a line that has more than the paper's inputs says so
        fit_inputs=False,
        edge_geometry=False,
        max_episodes=sizes.max_episodes,
        steps=sizes.steps,
        batch_size=sizes.batch_size,
        history_steps=table.protocol.train_history_steps,
        min_history_steps=min(MIN_HISTORY_STEPS, val_history_steps),
        val_history_steps=val_history_steps,
        horizon_steps=table.protocol.train_horizon_steps,
        val_windows=sizes.val_windows,
        eval_every=sizes.eval_every,
        patience=1000,
        seed=config.seed,
        device=config.device,
        precision=config.precision,
        threads=0 if config.device != "cpu" else max(1, torch.get_num_threads() // config.num_processes),
        resume=True,
    )
    return replace(base, **line.train)


def line_folder(config: SuiteConfig, line: Line) -> Path:
    """Returns the folder of a line's run and result; another config or other data give another folder."""
    table, sizes = TABLES[config.table], config.sizes
    steps = [table.protocol.burn_in_steps, table.protocol.horizon_steps]
    row: dict[str, Any] = {"model": line.model, "residual_of": line.residual_of, "overlap_m": table.overlap_m}
    if table.overlap_of != "agents":  # results in which the ball was a player are measured anew
        row["overlap_of"] = table.overlap_of
    content: dict[str, Any] = {
        "row": row,
        "measuring": MEASURING,
        "protocol": [*steps, NUM_SAMPLES, table.test_stride, sizes.test_windows, config.seed],
        "stores": [content_id(config.data / s) for s in (table.train, table.val, *table.tests.values()) if s],
    }
    if line.is_trained:
        values = asdict(line_config(config, line, Path()))
        for name in ("data", "val_data", "out", "threads", "device", "data_device", "capture", "resume"):
            del values[name]
        for name, before in ADDED.items():
            if values[name] == before:
                del values[name]  # lines trained before the option existed keep their folder
        content["train"] = values
    digest = hashlib.sha256(json.dumps(content, sort_keys=True, default=str).encode()).hexdigest()[:10]
    return config.folder / "rows" / f"{line.key}-{digest}"


def line_of(table: TableName, key: str) -> Line:
    """Returns the line with this key."""
    return next(line for line in TABLES[table].lines if line.key == key)


def run_line(config: SuiteConfig, line: Line) -> dict[str, Any]:
    """Trains (or resumes) and measures one line under the first seed; writes and returns its result."""
    if (
        line.model in FEATURED
        and not line.residual_of
        and read_info_of(config.data / TABLES[config.table].train).edge_attribute_names
    ):
        sklearn("linear_model")  # raises before training, not after it
    folder = line_folder(config, line)
    folder.mkdir(parents=True, exist_ok=True)
    began = time.perf_counter()
    checkpoint = None
    if line.is_trained:
        source = line_of(config.table, line.residual_of) if line.residual_of else line
        checkpoint = train(line_config(config, source, line_folder(config, source) / "run"))
    trained = time.perf_counter()
    result = {
        "key": line.key,
        "name": line.name,
        "seed": config.seed,
        "train_seconds": trained - began,
        **measure_line(TABLES[config.table], line, config.data, config.sizes, checkpoint, config.seed, config.device),
        "measure_seconds": time.perf_counter() - trained,
        "provenance": provenance(PACKAGES),
    }
    write_json(folder / "result.json", result)
    return result


class Job(NamedTuple):
    """A line under one seed."""

    config: SuiteConfig
    """Config of the suite with this seed alone."""
    line: Line
    """Line to train and measure."""

    @property
    def name(self) -> str:
        """Name in messages."""
        return f"{self.line.key}, seed {self.config.seed}"

    @property
    def folder(self) -> Path:
        """Folder of the result."""
        return line_folder(self.config, self.line)

    @property
    def result(self) -> Path:
        """File of the result."""
        return self.folder / "result.json"

    @property
    def locked_folder(self) -> Path:
        """Folder of the table."""
        return self.config.folder

    def run(self) -> None:
        """Trains and measures in this process, which is its own."""
        tune(self.config.device)
        print(f"measured {run_line(self.config, self.line)['name']}")

    def waits_for(self, other: "Job") -> bool:
        """Returns whether the other job trains the model that this one measures."""
        return self.line.residual_of == other.line.key and self.config.seed == other.config.seed


def jobs_of(config: SuiteConfig) -> list[Job]:
    """Returns the chosen lines under each of their seeds; a line without training has the first one alone."""
    chosen = [line for line in TABLES[config.table].lines if not config.lines or line.key in config.lines]
    return [
        Job(replace(config, seed=config.seed + i, seeds=1), line)
        for line in chosen
        for i in range(config.seeds if line.is_trained else 1)
    ]


def run_suite(config: SuiteConfig) -> dict[str, Any]:
    """Runs all lines without a result, then writes the table; returns its content.

    Raises:
        UserError: a store is missing.
    """
    config.check_stores()
    table, jobs = TABLES[config.table], jobs_of(config)
    began = time.perf_counter()
    with (
        locked(config.folder, "suite"),
        resumable("the same command goes on: finished lines are kept, others continue"),
    ):
        failed = _run_missing(config, [job for job in jobs if not job.result.exists()])
    results: dict[str, list[dict[str, Any]]] = {}
    for job in jobs:
        if job.result.exists():
            results.setdefault(job.line.key, []).append(read_object(job.result))
    lines = [joined(found) for found in results.values()]
    content = {
        "table": config.table,
        "title": table.title,
        "budget": config.budget,
        "sizes": asdict(config.sizes),
        "num_samples": NUM_SAMPLES,
        "seeds": config.seeds,
        "overlap_m": table.overlap_m,
        "overlap_of": table.overlap_of,
        "wall_seconds_this_call": time.perf_counter() - began,
        "train_seconds": sum(line["train_seconds"] for line in lines),
        "rows": lines,
        "paper": {line.key: line.paper for line in table.lines if line.paper and line.key in results},
        "published": table.published,
        "protocol": asdict(table.protocol),
        "failed": failed,
        "provenance": provenance(PACKAGES),
    }
    config.folder.mkdir(parents=True, exist_ok=True)
    write_json(config.folder / "table.json", finite(content))
    for name, text in (("table.md", markdown_report(content)), ("table.tex", latex_table(content))):
        write_text(config.folder / name, text)
    if lines:
        _plot(config, lines, content["title"])
    return content


def _run_missing(config: SuiteConfig, pending: Sequence[Job]) -> dict[str, str]:
    """Runs jobs here or on a cluster; returns why those without a result have none, by name."""
    failed = dict[str, str]()
    with connected(config.cluster if pending else None, PACKAGES) as cluster:
        gpus = int(config.device.startswith("cuda"))
        running, done = list[str](), 0
        with WorkShown(config.table, len(pending)) as shown:

            def begun(number: int) -> None:
                running.append(pending[number].name)
                shown.to(done, ", ".join(running))

            jobs = run_tasks(pending, workers=config.num_processes, cluster=cluster, gpus=gpus, on_start=begun)
            with contextlib.closing(jobs) as ended:
                for number, reason in ended:
                    name, done = pending[number].name, done + 1
                    if reason is not None:
                        failed[name] = reason
                    running = [one for one in running if one != name]
                    shown.to(done, ", ".join(running))
    return failed


def _plot(config: SuiteConfig, results: Sequence[dict[str, Any]], title: str) -> None:
    matplotlib.use("Agg")
    kinds = list(results[0]["tests"])
    dt_s = read_info_of(config.data / TABLES[config.table].tests[kinds[0]]).spec.dt_s
    seeds = "one seed" if config.seeds == 1 else f"mean over {config.seeds} seeds"
    headline = f"{title}, budget {config.budget}, {seeds}"
    figure = figure_by_step(results, kinds, dt_s, f"{headline}; bars: standard error over test episodes")
    save_figure(figure, config.folder / "by_step.png", 110)


def main() -> None:
    """Entry point."""
    config = parse(SuiteConfig, __doc__)
    tune(config.device)
    content = run_suite(config)
    print((config.folder / "table.md").read_text(encoding="utf-8"))
    print(f"written to {config.folder}: table.md, table.json, table.tex, by_step.png")
    if content["failed"]:
        raise UserError(
            "; ".join(f"line '{key}' failed: {reason}" for key, reason in content["failed"].items())
            + f"; its log is in {config.folder / 'rows'}, and running the same command again retries it"
        )


if __name__ == "__main__":
    run_entry_point(main)
