"""Tunes the hyperparameters of an algorithm: `python -m agents.tune --env-id highway-fast-v0 --algorithm ppo`.

Every trial trains policies that are shown zeros in place of forecasts, so that tuning never favours forecasts, and
measures them on seeds that nothing else uses. The first trial is the preset itself. The same command goes on with a
tuning that was stopped. The folder holds best.toml, for `train_policy.py --preset`, and Optuna's study (tuning.db).
"""

import json
import os
import shutil
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from agents.algorithms import DivergedError
from agents.arena import open_arena
from agents.preset_settings import changed, write_preset
from agents.presets import Algorithm, Preset
from agents.results import PACKAGES
from agents.runs import load_model
from agents.search_space import search_space
from agents.task import SELECTION_SEED, TUNING_SEED, Observe, Task
from agents.training import TrainingPlan, train
from envs.registry import entry_for
from predictor.checkpoint import CONSTANT_VELOCITY
from predictor.own_forecasters import is_own
from predictor.support.command_line import parse
from predictor.support.config_checks import check_at_least, check_choices
from predictor.support.errors import UserError, one_line, run_entry_point, short
from predictor.support.files import check_out, delete_leftovers, disk_errors_of, write_json
from predictor.support.locks import locked
from predictor.support.memory import ENV_BYTES, PROCESS_BYTES, check_count
from predictor.support.provenance import provenance
from predictor.support.reading import MIB, as_object, check_regular, damage_in, read_bytes, read_object
from predictor.support.runtime import keep_freed_memory
from predictor.support.stopping import resumable
from predictor.support.typed_values import converted

if TYPE_CHECKING:
    from optuna import Study

ARM: Observe = "zeros"
"""What the policies are shown: entries of the shape of forecasts that say nothing."""
TRAINING_SEED = 900_000_000
"""First seed of a training; those of studies and of `train_policy.py` are counted from 0."""
MAX_TRAININGS = 100
MAX_SEED = (SELECTION_SEED - TRAINING_SEED) // MAX_TRAININGS
DIVERGED = "Expected parameter"
"""Beginning of the error by which torch refuses the distribution of actions of a network that diverged."""
MOST_STUDY_BYTES = 1024 * MIB
"""Largest size of Optuna's study."""
CONFIG_FILE, STUDY_FILE, BEST_FILE, PRESET_FILE = "tuning.json", "tuning.db", "best.toml", "preset.toml"


@dataclass(frozen=True)
class TuneConfig:
    """Tunes the hyperparameters of an algorithm on policies that are shown no forecasts."""

    env_id: str = "highway-fast-v0"
    """Environment to train on: Gymnasium or PettingZoo parallel id."""
    algorithm: Algorithm = "ppo"
    """Learning algorithm."""
    trials: int = 30
    """Number of trials, those of earlier starts included; the first one is the preset."""
    steps: int = 20_000
    """Number of environment steps of each training."""
    num_envs: int = 6
    """Number of parallel environments of each training."""
    trainings: int = 1
    """Number of trainings per trial, under different seeds; their mean return counts."""
    episodes: int = 50
    """Number of episodes that measure each training."""
    selections: int = 8
    """Number of times in a training that the policy is measured for model selection."""
    selection_episodes: int = 20
    """Number of episodes per such measurement."""
    checkpoint: str | None = None
    """Forecaster whose shape the zeros have; None, or one of your own, takes the checkpoint that ships for the env id,
    if there is one."""
    checkpoint_every: int = 2_000
    """Number of environment steps between the checkpoints of a training. Episodes end there, so `checkpoint_every /
    num_envs` should be well above their length."""
    env_kwargs: str = ""
    """Arguments of the environment as a JSON object."""
    seed: int = 0
    """Random seed of the search and of the trainings."""
    out: Path | None = None
    """Folder of the tuning; None takes runs/tune-ENV_ID-ALGORITHM. The same command goes on with what is in it."""

    def __post_init__(self) -> None:
        """Checks choices and ranges; `plan` checks that the values fit together.

        Raises:
            UserError: a value is out of range or does not fit the others.
        """
        check_choices(self)
        names = ("trials", "steps", "num_envs", "trainings", "episodes", "selections", "selection_episodes")
        check_at_least(self, 1, *names, "checkpoint_every")
        if not 0 <= self.seed < MAX_SEED:
            raise UserError(f"seed must lie in [0, {MAX_SEED}), got {self.seed}")
        if self.trainings > MAX_TRAININGS:
            raise UserError(f"trainings must be at most {MAX_TRAININGS}, got {self.trainings}")
        for name in ("episodes", "selection_episodes"):
            check_count(getattr(self, name), name)
        check_count(self.num_envs, "num_envs", PROCESS_BYTES if self.num_envs > 1 else ENV_BYTES)
        self.plan({}, 0)

    @property
    def folder(self) -> Path:
        """Path of the folder."""
        return self.out or Path("runs") / f"tune-{self.env_id}-{self.algorithm}"

    def plan(self, settings: Mapping[str, Any], number: int) -> TrainingPlan:
        """Returns the plan of a trial's training.

        Args:
            settings: hyperparameters in place of the preset's.
            number: number of the training in its trial, from 0.
        """
        learners = entry_for(self.env_id).learners
        has_sizes = self.checkpoint is not None and self.checkpoint != CONSTANT_VELOCITY and not is_own(self.checkpoint)
        task = Task(
            self.env_id,
            ARM,
            self.checkpoint,
            learners=learners,
            env_kwargs=self.env_kwargs,
            sizes_of=self.checkpoint if has_sizes else None,
        )
        return TrainingPlan(
            task,
            self.algorithm,
            self.steps,
            self.num_envs,
            TRAINING_SEED + self.seed * MAX_TRAININGS + number,
            selections=self.selections,
            selection_episodes=self.selection_episodes,
            selection_envs=min(self.num_envs, os.cpu_count() or 1),
            checkpoint_every=self.checkpoint_every,
            repeatable=True,
            settings=settings,
        )


def tune(config: TuneConfig) -> Path:
    """Runs the trials that are missing; returns the path of the best hyperparameters.

    Raises:
        UserError: Optuna is not installed, the algorithm does not fit the environment, the folder holds something
            else, or every trial diverged.
    """
    try:
        import optuna
    except ModuleNotFoundError as error:
        raise UserError("agents.tune needs the optuna package; pip install 'dgvae-rl[tune]'") from error
    plan, folder = config.plan({}, 0), config.folder
    check_out(folder)
    plan.check_spaces(*plan.task.check())
    _check_folder(folder, config)
    with locked(folder, "tuning"), disk_errors_of(folder / STUDY_FILE):
        _note(folder, config)
        study = open_study(folder / STUDY_FILE)
        for trial in study.get_trials(deepcopy=False, states=(optuna.trial.TrialState.RUNNING,)):
            study.tell(trial.number, state=optuna.trial.TrialState.FAIL)  # of a start that was killed: drawn again
        _write_best(config, study, plan.preset)  # a kill may have come between a trial's end and this
        for index in range(len(_ended(study)), config.trials):
            _run_trial(config, study, index, plan.preset)
            _write_best(config, study, plan.preset)
    if not (folder / BEST_FILE).exists():
        raise UserError(f"the networks of all {config.trials} trials diverged; give more --trials")
    return folder / BEST_FILE


def open_study(file: Path) -> "Study":
    """Opens Optuna's study in a file, or begins one.

    Raises:
        UserError: the file is no regular one, or holds no study.
    """
    import optuna
    from sqlalchemy import URL
    from sqlalchemy.exc import DatabaseError
    from sqlalchemy.pool import NullPool

    if os.path.lexists(file):
        check_regular(file, MOST_STUDY_BYTES)
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    try:
        # Without a pool each connection is closed after its use; Python 3.13 warns of those that nobody closes.
        address = URL.create("sqlite", database=str(file)).render_as_string()
        storage = optuna.storages.RDBStorage(address, engine_kwargs={"poolclass": NullPool})
        return optuna.create_study(storage=storage, study_name="tuning", direction="maximize", load_if_exists=True)
    except (DatabaseError, optuna.exceptions.OptunaError, RuntimeError, ValueError) as error:
        if isinstance(error.__cause__, OSError) or "disk is full" in str(error) or "disk I/O" in str(error):
            raise  # a full disk, which is told elsewhere
        reason = short(one_line(error), 120)
        raise UserError(f"{file} holds no study of Optuna ({reason}); remove it to begin anew") from error


def _run_trial(config: TuneConfig, study: "Study", index: int, preset: Preset) -> None:
    """Draws hyperparameters, which depend on the seed, the index and the trials before alone, and measures them."""
    import optuna

    space, began = search_space(preset), time.perf_counter()
    seed = int(np.random.SeedSequence([config.seed, index]).generate_state(1)[0])
    study.sampler = optuna.samplers.TPESampler(seed=seed)
    trial = study.ask(fixed_distributions=space) if index else None
    settings = {name: getattr(preset, name) for name in space} if trial is None else dict(trial.params)
    try:
        value = _measure(config, settings, config.folder / "trials" / f"{index + 1:03d}")
    except ValueError as error:
        if not isinstance(error, DivergedError) and not str(error).startswith(DIVERGED):
            raise
        value = None
    state = optuna.trial.TrialState.PRUNED if value is None else optuna.trial.TrialState.COMPLETE
    if trial is None:
        study.add_trial(optuna.create_trial(state=state, params=settings, distributions=space, value=value))
    else:
        study.tell(trial, value, state)
    shown = ", ".join(f"{name}={number:.4g}" for name, number in settings.items())
    result = "diverged" if value is None else f"return {value:.3f}"
    seconds = time.perf_counter() - began
    print(f"trial {index + 1} of {config.trials}: {result}, {seconds:.0f} s: {shown}", flush=True)


def _measure(config: TuneConfig, settings: Mapping[str, Any], folder: Path) -> float:
    """Returns the mean return of a trial's trainings on the tuning seeds."""
    plans = [config.plan(settings, number) for number in range(config.trainings)]
    preset_file, begun = folder / PRESET_FILE, folder / f".{PRESET_FILE}"
    write_preset(begun, plans[0].preset)
    if os.path.lexists(preset_file) and read_bytes(preset_file, MIB) != begun.read_bytes():
        shutil.rmtree(folder)  # another version of Optuna draws other values
        write_preset(begun, plans[0].preset)
    begun.rename(preset_file)
    seeds = range(TUNING_SEED, TUNING_SEED + config.episodes)
    means = []
    for number, plan in enumerate(plans):
        run = folder / str(number)
        run.mkdir(exist_ok=True)
        delete_leftovers(run)
        policy = load_model(train(plan, run, progress_bar=False), plan.algorithm)
        arena = open_arena(plan.task, min(plan.selection_envs, config.episodes))
        try:
            means.append(float(np.mean([result.episode_return for result in arena.play(policy, seeds)])))
        finally:
            arena.close()
    return float(np.mean(means))


def _ended(study: "Study") -> list[Any]:
    """Returns the trials that ended, diverged ones included, in their order."""
    return [trial for trial in study.get_trials(deepcopy=False) if trial.state.name in ("COMPLETE", "PRUNED")]


def _write_best(config: TuneConfig, study: "Study", preset: Preset) -> None:
    """Writes the hyperparameters of the best trial so far; of the first one of equals."""
    ended = _ended(study)
    measured = [(trial.value, -index, index) for index, trial in enumerate(ended) if trial.value is not None]
    if not measured:
        return  # they all diverged
    value, _, index = max(measured)
    measured_in = f"{config.trainings} x {config.episodes} episodes, seeds from {TUNING_SEED}"
    comments = (
        f"python -m agents.tune: {config.algorithm} on {config.env_id}, arm {ARM}, {config.steps} steps",
        f"trial {index + 1}, the best of {len(ended)}: mean return {value:.3f} in {measured_in}",
    )
    best = changed(preset, ended[index].params, config.algorithm)
    write_preset(config.folder / BEST_FILE, best, comments)


def _settings_of_tuning(config: TuneConfig) -> dict[str, Any]:
    """Returns what must be equal in all starts of a tuning, as JSON content."""
    values = {name: value for name, value in asdict(config).items() if name not in ("trials", "out")}
    plan = config.plan({}, 0)
    pin = plan.task.note.forecaster
    shape = None if pin is None else {**asdict(pin), "checkpoint": None}
    content: dict[str, Any] = json.loads(json.dumps({**values, "preset": asdict(plan.preset), "zeros_of": shape}))
    return content


def _check_folder(folder: Path, config: TuneConfig) -> None:
    """Checks that a folder holds nothing, or this tuning.

    Raises:
        UserError: it holds something else, or a tuning with other settings.
    """
    file = folder / CONFIG_FILE
    if not file.exists():
        found = [path.name for path in folder.iterdir() if not path.name.startswith(".")] if folder.exists() else []
        if found:
            raise UserError(f"{folder} holds {found[0]} but no tuning ({CONFIG_FILE}); choose another --out")
        return
    try:
        content = read_object(file)
        before = as_object(content["config"], f"{file}: config")
        converted(content.get("provenance", []), tuple[dict[str, Any], ...], f"{file}: provenance")
    except (UserError, KeyError) as error:
        why = damage_in(file, error)
        raise UserError(f"{file} is damaged ({why}); remove {folder} or choose another --out") from error
    defaults = {field.name: field.default for field in fields(TuneConfig)}  # of fields that are newer than the tuning
    for name, now in _settings_of_tuning(config).items():
        then = before.get(name, defaults.get(name))
        if then != now:
            raise UserError(
                f"cannot go on in {folder}: {name} was {then!r}, now {now!r}; "
                "pass the old value or choose another --out"
            )


def _note(folder: Path, config: TuneConfig) -> None:
    """Writes the settings of the tuning, and a line on each of its starts."""
    file = folder / CONFIG_FILE
    starts = read_object(file).get("provenance", []) if file.exists() else []
    made = provenance((*PACKAGES, "optuna"))
    write_json(file, {"config": _settings_of_tuning(config), "provenance": [*starts, made]})


def main() -> None:
    """Runs the command."""
    keep_freed_memory()
    torch.set_num_threads(1)  # small networks; the environments' processes fill the cores
    config = parse(TuneConfig, __doc__)
    with resumable("the same command goes on: ended trials are kept, the one that ran continues"):
        best = tune(config)
    print(f"written to {best}")


if __name__ == "__main__":
    run_entry_point(main)
