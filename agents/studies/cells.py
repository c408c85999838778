"""Cells of a study: one training under one seed, or one driver, measured on the test seeds.

A cell is named by a hash of everything that determines its result, so that a change of the study runs what it changed
and keeps the rest. A cell that was killed goes on from its checkpoint and ends as if it had not been (`repeatable` in
`agents.training`).
"""

import functools
import hashlib
import json
import shlex
import sys
import time
from collections.abc import Mapping
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm

from agents.arena import open_arena
from agents.evaluate import checked_drivers
from agents.presets import Algorithm, Preset
from agents.results import PACKAGES
from agents.runs import CURVE_FILE, FORECASTER, load_model, open_run, read_curve
from agents.studies.plan import Scenario, Study, StudyArm, task_for
from agents.studies.results import RESULT_FILE, Result, write_result
from agents.task import EVALUATION_SEED, Task
from agents.training import TrainingPlan, train
from envs.drivers.all_agents import make_driver
from envs.drivers.content import content_of, content_of_module
from envs.drivers.planner import ORACLE, is_planner, planner_checkpoint, planner_config
from envs.registry import checkpoint_for, entry_for
from envs.sb3.algorithms import CONTRIB
from predictor.checkpoint import read_info, resolve
from predictor.own_forecasters import is_own
from predictor.support.errors import UserError
from predictor.support.files import delete_leftovers
from predictor.support.provenance import installed_version, provenance

RULES = ("stable-baselines3", "gymnasium", "pettingzoo", "highway-env", "mpe2")
"""Packages whose versions are part of a cell's name: the simulators and the learning algorithms."""
MEASURING = 4
"""Number of the way of running and measuring, networks included; a cell of another one is another cell."""
NETWORK = 2
"""Number of the network that reads forecasts (`agents.features`); a cell of a policy with another one is another
cell."""
YOUNGER = {"perception_m": None, "vf_coef": 0.5, "target_kl": None, "crash_key": None, "success_key": None}
"""Fields of `Task` and of presets that came after the first cells, with the value that those had: it does not change
their names."""
PATHS = ("checkpoint", "sizes_of")
"""Fields of `Task` with paths of checkpoints, of which the cells' names have hash and sizes instead."""
LONGEST = 200
"""Largest size of the readable part of a cell's name [bytes]; a file system has 255 for the whole."""
RUN_FOLDER = "run"


@dataclass(frozen=True)
class Cell:
    """Training under one seed, or a driver, in one scenario."""

    scenario: str
    """Name of the scenario."""
    line: str
    """Name of the arm, or of the driver."""
    task: Task
    """Environment, and what the policy is shown; drivers are shown nothing."""
    plan: TrainingPlan | None
    """Plan of the training; None for a driver."""
    episodes: int
    """Number of test episodes."""
    forecaster: Mapping[str, Any] | None
    """Pin of the forecaster whose forecasts are shown, or by which the planner drives, or of the policy that drives;
    None if there is none."""
    settings: Mapping[str, Any] | None = None
    """What the study's file says of the cell, for its result; no part of its name."""

    @property
    def algorithm(self) -> Algorithm | None:
        """Learning algorithm; None for a driver."""
        return None if self.plan is None else self.plan.algorithm

    @property
    def seed(self) -> int | None:
        """Training seed; None for a driver."""
        return None if self.plan is None else self.plan.seed

    @property
    def title(self) -> str:
        """Name in messages."""
        trained = "" if self.plan is None else f", {self.plan.algorithm}, seed {self.plan.seed}"
        return f"{self.scenario}, {self.line}{trained}"

    @functools.cached_property
    def name(self) -> str:
        """Name of the cell's folder; it ends with a hash of everything that determines the result."""
        parts = [self.scenario, self.line, *([] if self.plan is None else [self.plan.algorithm, str(self.plan.seed)])]
        written = json.dumps(self.content, sort_keys=True, default=str)
        digest = hashlib.sha256(written.encode()).hexdigest()[:10]
        read = "".join(sign if sign.isalnum() or sign in ".-_" else "-" for sign in ".".join(parts))
        return f"{read.encode()[:LONGEST].decode(errors='ignore')}-{digest}"

    @property
    def content(self) -> dict[str, Any]:
        """Everything that determines the result, as JSON content."""
        task = {key: value for key, value in _named(self.task).items() if key not in (*PATHS, "device", "timeout_s")}
        content: dict[str, Any] = {
            "measuring": MEASURING,
            "task": task,
            "forecaster": _content_of(self.forecaster),
            "test": [EVALUATION_SEED, self.episodes],
            "versions": {name: installed_version(name) for name in RULES},
        }
        if (module := content_of_module(self.task.env_id)) is not None:
            content["module"] = module
        if self.plan is None:
            return content | {"driver": self.line}
        if self.plan.algorithm in CONTRIB:
            content["versions"]["sb3-contrib"] = installed_version("sb3-contrib")
        if self.task.backend == "envpool":
            content["versions"]["envpool"] = installed_version("envpool")
        if self.task.observe != "none":
            content["network"] = NETWORK
        unrelated = {"task", "device", "in_process", "selection_envs", "settings"}
        if not self.task.is_multiagent:
            unrelated.add("shaping")
        if self.plan.steps % self.plan.selections:  # where they do not divide, measurements once lay elsewhere
            content["selections"] = "in equal parts"
        if self.plan.selections > 1:  # the latest one that was not significantly worse was once kept
            content["kept"] = "highest mean"
        values = {key: value for key, value in asdict(self.plan).items() if key not in unrelated}
        return content | {"plan": values, "preset": _named(self.plan.preset)}


def _content_of(forecaster: Mapping[str, Any] | None) -> dict[str, Any] | None:
    """Returns what names a forecaster: the hash of its weights, or name and hash of the module whose code makes it."""
    if forecaster is None:
        return None
    name = forecaster.get("checkpoint")
    if name is None or not is_own(name):
        return {**forecaster, "checkpoint": None}
    return {**forecaster, "module": content_of(name)}


def _named(settings: Task | Preset) -> dict[str, Any]:
    """Returns the fields that are part of a cell's name."""
    return {key: value for key, value in asdict(settings).items() if key not in YOUNGER or value != YOUNGER[key]}


def cells_of(study: Study, where: str) -> list[Cell]:
    """Returns all cells of a study: in each scenario the drivers first, then each arm under each algorithm and seed.

    Raises:
        UserError: an environment, a checkpoint, a driver or an algorithm does not fit; the message begins with `where`.
    """
    cells: list[Cell] = []
    for scenario in study.scenarios:
        cells += _drivers(study, scenario, where)
        for arm in study.arms:
            cells += _trainings(study, scenario, arm, where)
    return cells


def run_cell(cell: Cell, folder: Path, commit: str) -> Result:
    """Trains from where an earlier start was stopped, plays the test seeds, writes the result into the folder.

    Args:
        cell: cell to run.
        folder: folder of the cell.
        commit: commit that was checked out when the study began, whose code runs.
    """
    torch.set_num_threads(1)
    delete_leftovers(folder)
    made = provenance(PACKAGES, _command()) | {"commit": commit}
    policy: BaseAlgorithm | None = None
    trained_s, curve = 0.0, list[dict[str, Any]]()
    if cell.plan is not None:
        run = folder / RUN_FOLDER
        # the folder's name has the forecaster's hash and sizes, and the preset with its settings
        free = (FORECASTER, "device", "settings", *PATHS)
        open_run(run, _run_config(cell), made, resume=True, free=free)
        policy = load_model(train(cell.plan, run), cell.plan.algorithm, device=cell.plan.device)
        curve = read_curve(run / CURVE_FILE)
        trained_s = curve[-1].get("seconds") or 0.0 if curve else 0.0  # somebody removed a damaged one
    began = time.perf_counter()
    num_envs = 1 if cell.plan is None else min(cell.plan.num_envs, cell.episodes)
    arena = open_arena(cell.task, num_envs, in_process=True)
    try:
        seeds = range(EVALUATION_SEED, EVALUATION_SEED + cell.episodes)
        episodes = arena.play(cell.line if policy is None else policy, seeds)
    finally:
        arena.close()
    result = Result(
        cell.scenario,
        cell.task.env_id,
        cell.line,
        cell.algorithm,
        cell.seed,
        tuple(asdict(episode) for episode in episodes),
        tuple(curve),
        trained_s,
        time.perf_counter() - began,
        made,
        None if cell.settings is None else dict(cell.settings),
    )
    write_result(folder / RESULT_FILE, result)
    return result


def _drivers(study: Study, scenario: Scenario, where: str) -> list[Cell]:
    """Returns the cells of a scenario's references, each checked by making its driver once."""
    task = task_for(scenario, StudyArm("none", "none", {}), where)
    names, place = tuple(dict.fromkeys(scenario.references)), f"{where}: scenario {scenario.name}"
    try:
        task.check()
    except UserError as error:
        raise UserError(f"{place}: {error}") from error
    try:
        if task.is_multiagent:
            with closing(task.make()) as many:
                many.reset(seed=0)
                for name in names:
                    make_driver(name, many, np.random.default_rng(0))
        else:
            names = checked_drivers(task, names)
        said = study.settings_of(scenario)
        return [Cell(scenario.name, name, task, None, study.episodes, _driver_pin(name, task), said) for name in names]
    except UserError as error:
        raise UserError(f"{place}: {error}; references = [] in the study file leaves {', '.join(names)} out") from error


def _trainings(study: Study, scenario: Scenario, arm: StudyArm, where: str) -> list[Cell]:
    """Returns the cells of an arm in a scenario."""
    task = task_for(scenario, arm, where)
    cells = []
    try:
        found, pin = task.check(), task.note.forecaster
        for algorithm in study.algorithms:
            for seed in study.training_seeds:
                plan = TrainingPlan(
                    task,
                    algorithm,
                    scenario.steps,
                    scenario.num_envs,
                    seed,
                    task.device,
                    study.selections,
                    study.selection_episodes,
                    min(scenario.num_envs, study.selection_episodes),
                    study.checkpoint_every,
                    in_process=True,
                    repeatable=True,
                    settings=study.settings.get(algorithm, {}),
                )
                plan.check_spaces(*found)
                shown = None if pin is None else asdict(pin)
                said = study.settings_of(scenario, arm, algorithm)
                cells.append(Cell(scenario.name, arm.name, task, plan, study.episodes, shown, said))
    except UserError as error:
        raise UserError(f"{where}: scenario {scenario.name}, arm {arm.name}: {error}") from error
    return cells


def _driver_pin(name: str, task: Task) -> dict[str, Any] | None:
    """Returns what determines a driver beside its name; None for one that its name determines.

    That is the hash of a policy's zip or of the module of a driver of one's own, or what the planner's forecasts come
    from and its settings.
    """
    if name.endswith(".zip") or is_own(name):
        return {"sha256": content_of(name)}
    if not is_planner(name):
        return None
    settings = asdict(planner_config(name))
    checkpoint = planner_checkpoint(name) or checkpoint_for(task.env_id)
    if checkpoint == ORACLE and (shipped := entry_for(task.env_id).checkpoint) is not None:
        info = read_info(resolve(shipped))  # true futures are as long and as wide as its forecasts
        settings["bounds"] = [info.horizon_steps, info.spec.max_agents, info.spec.perception_m]
    return {"sha256": content_of(f"planner:{checkpoint}") or checkpoint, **settings}


def _run_config(cell: Cell) -> dict[str, Any]:
    """Returns the config of the training's folder, as `agents.evaluate` and others read it."""
    assert cell.plan is not None
    plan = {key: value for key, value in asdict(cell.plan).items() if key not in ("task", "in_process")}
    pin = None if cell.forecaster is None else dict(cell.forecaster)
    task = {key: value for key, value in asdict(cell.task).items() if key != "timeout_s"}
    return {**task, **plan, "partner": cell.task.driver, FORECASTER: pin}


def _command() -> str:
    return shlex.join(["python", "-m", "agents.study", *sys.argv[1:]])  # a cell's process has the study's arguments
