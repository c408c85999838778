"""Trains a forecaster: `python -m predictor.train --data data/roundabout --out runs/roundabout`.

The best checkpoint is chosen by the energy score of free-running samples on held-out episodes: it rewards accuracy and
a spread like the truth's, whereas one-step errors reward neither.

`torchrun --nproc-per-node 2 -m predictor.train …` trains with two processes (`predictor.training.processes`).
"""

import io
import math
import os
import shlex
import signal
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack, nullcontext, redirect_stderr
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.utils.tensorboard import SummaryWriter

from predictor.checkpoint import BEST_OF_RUN, CheckpointInfo, load_checkpoint, read_info, save_checkpoint
from predictor.data.store import content_id
from predictor.support.command_line import parse
from predictor.support.errors import UserError, run_entry_point, short
from predictor.support.files import check_out, delete_leftovers, write_json
from predictor.support.locks import locked
from predictor.support.progress import WorkShown
from predictor.support.provenance import provenance
from predictor.support.reading import as_object, read_object
from predictor.support.remote import address
from predictor.support.runtime import tune
from predictor.support.stopping import deferred_stops, resumable
from predictor.training.config import TrainConfig
from predictor.training.curve import CURVE_FILE, KEYS, add_point, read_curve
from predictor.training.processes import ALONE, Group, LostProcessError, joined
from predictor.training.trainer import LOG_EVERY, Trainer
from predictor.training.training_data import load_data

STATE_FILE = "train_state.pt"


def train(config: TrainConfig, group: Group = ALONE) -> Path:
    """Trains until all steps are done or validation stops improving; returns the folder of the best checkpoint.

    Ctrl-C and SIGTERM wait for the end of a step and save the state; a second one does not wait.

    Args:
        config: options of the run.
        group: processes that train together; the first of them alone touches the run folder.

    Raises:
        UserError: the folder holds another run, another process trains in it, data do not fit, the disk is full, or
            a process of the group is lost.
    """
    state_file, config_file = config.out / STATE_FILE, config.out / "config.json"
    with resumable(lambda: _kept(config, state_file)):
        return _train(config, group, state_file, config_file)


def _train(config: TrainConfig, group: Group, state_file: Path, config_file: Path) -> Path:
    trainer = group.together(lambda: _prepared(config, group, config_file))
    group.check_same((_comparable(config), [len(w) for w in trainer.data.train]), "options or data")
    group.align(trainer.model)
    if all(int(windows.flat.steps.max()) <= config.horizon_steps for windows in trainer.data.val):
        trainer.close()
        raise UserError(
            f"no validation episode has {config.horizon_steps} steps of future, so no checkpoint could be chosen; "
            "lower --horizon-steps or collect longer episodes"
        )
    if not math.isfinite(group.from_leader(lambda: trainer.baseline_m)):
        trainer.close()
        raise UserError(
            f"no agent of the validation windows is there for all {config.horizon_steps} steps of future, so no "
            "checkpoint could be chosen; lower --horizon-steps, draw more with --val-windows, use longer tracks, or "
            "raise perception_m if the ego sees nobody"
        )
    made = provenance(("torch", "numpy", "zarr", "safetensors"))
    with ExitStack() as stack:
        stack.callback(trainer.close)
        group.from_leader(lambda: _take_folder(stack, config, config_file))
        if config.resume and group.from_leader(state_file.exists):
            group.from_leader(lambda: _check_same_network(trainer))
            trainer.restore(state_file)
        if not group.leads:
            _follow(trainer)
            return config.out / BEST_OF_RUN
        if not trainer.finished or trainer.owes_validation:  # else the file tells how the run was made
            stores = {address(path): content_id(path) for path in (*config.data, *config.val_data)}
            write_json(config_file, {"config": _comparable(config), "stores": stores, "provenance": made})
        _run(trainer, state_file, made)
    if not (config.out / BEST_OF_RUN).exists():
        raise UserError(
            f"no checkpoint was chosen in {config.out}: no validation error was finite, or {BEST_OF_RUN} was deleted; "
            "train anew, with a lower --lr if it diverged"
        )
    return config.out / BEST_OF_RUN


def _prepared(config: TrainConfig, group: Group, config_file: Path) -> Trainer:
    if group.leads:
        _check_run_folder(config, config_file)
    tune(config.device)
    if config.threads:
        torch.set_num_threads(config.threads)
    return Trainer(config, load_data(config), group)


def _take_folder(stack: ExitStack, config: TrainConfig, config_file: Path) -> None:
    """Locks the run folder until the stack ends."""
    stack.enter_context(locked(config.out, "training"))
    _check_run_folder(config, config_file)  # another training may have come and gone
    delete_leftovers(config.out)  # of a run that was killed while it saved
    read_curve(config.out / CURVE_FILE)  # a damaged one, or a damaged result, is told now, not at the next validation
    if (config.out / BEST_OF_RUN).exists():
        load_checkpoint(config.out / BEST_OF_RUN)


def _follow(trainer: Trainer) -> None:
    """Takes part in a training that another process leads, to its end; errors that it shares are told by that one."""
    config, group = trainer.config, trainer.group
    with deferred_stops() as stops:
        try:
            if config.init and not trainer.step:
                trainer.share_progress()
            if trainer.owes_validation:
                trainer.share_progress()
            while not trainer.finished:
                terms = trainer.train_step()
                if group.any(stops.asked is not None):
                    sys.exit(128 + (stops.asked or signal.SIGTERM))
                if trainer.due or trainer.step % trainer.read_every == 0:
                    trainer.read(terms)
                if trainer.due:
                    trainer.share_progress()
        except LostProcessError:
            raise
        except UserError:
            sys.exit(2)


def _kept(config: TrainConfig, state_file: Path) -> str:
    """Returns what a run that is stopped keeps."""
    if not state_file.exists():
        return "nothing is saved yet; the same command with --resume begins anew"
    return f"its state is saved in {config.out}; the same command with --resume goes on"


def _run(trainer: Trainer, state_file: Path, made: dict[str, Any]) -> None:
    """Trains, logs, validates and saves until the run is finished, or a signal asks it to stop."""
    config, printed = trainer.config, 0
    with (
        SummaryWriter(str(config.out / "tb"), purge_step=_first_unknown(trainer)) as writer,
        WorkShown("train", config.steps, trainer.step) as progress,
        deferred_stops() as stops,
    ):
        if config.init and not trainer.step:
            note = _validate_and_save(trainer, writer, made)  # so that the result is no worse than where it began
            progress.say(note)
            trainer.share_progress()
        if trainer.owes_validation:
            progress.say(_validate_and_save(trainer, writer, made))
            trainer.save(state_file)
            trainer.share_progress()
        began, since = time.perf_counter(), trainer.step
        while not trainer.finished:
            terms = trainer.train_step()
            for line in trainer.notes[printed:]:
                progress.say(line)
            printed = len(trainer.notes)
            if trainer.group.any(stops.asked is not None):
                trainer.read(terms)  # a state that is not finite is never saved
                trainer.save(state_file)
                stops.asked = stops.asked or signal.SIGTERM  # another process was asked
                stops.stop()
            if not trainer.due and trainer.step % trainer.read_every:
                continue
            seen = trainer.read(terms)
            seen["steps_per_s"] = (trainer.step - since) / (time.perf_counter() - began)
            if trainer.due:
                trainer.save(state_file)  # a kill during the validation, for want of memory say, loses no step
                progress.say(_validate_and_save(trainer, writer, made))
                trainer.save(state_file)
                trainer.share_progress()
            if trainer.step % LOG_EVERY == 0:
                for name, value in seen.items():
                    writer.add_scalar(f"train/{name}", value, trainer.step)
            shown = next((f"{k} {seen[k]:.3g}" for k in ("nll_rollout", "nll_one_step") if k in seen), "")
            progress.to(trainer.step, shown)
            began, since = time.perf_counter(), trainer.step
        if trainer.step < config.steps:
            progress.say(
                f"stopped at step {trainer.step:,} of {config.steps:,}: {trainer.stale} validations without a better "
                "score; with --resume and a larger --patience it goes on"
            )


def _first_unknown(trainer: Trainer) -> int:
    """Returns the first step whose points of the curves are still to be logged; a killed run has logged more."""
    return trainer.step + (trainer.step > 0 and not trainer.owes_validation)


def _validate_and_save(trainer: Trainer, writer: SummaryWriter, made: dict[str, Any]) -> str:
    accuracy, std_m = trainer.validate()
    for name in KEYS[:-1]:
        writer.add_scalar(f"val/{name}", getattr(accuracy, name), trainer.step)
    writer.add_scalar("val/constant_velocity_ade_m", trainer.baseline_m, trainer.step)
    errors = {name: getattr(accuracy, name) for name in KEYS[:-1]} | {KEYS[-1]: trainer.baseline_m}
    add_point(trainer.config.out / CURVE_FILE, {"step": trainer.step} | errors)
    score = trainer.score(accuracy)
    better = score < trainer.best
    trainer.best, trainer.stale = (score, 0) if better else (trainer.best, trainer.stale + 1)
    if better or (trainer.config.keep == "last" and math.isfinite(score)):
        result = {
            "step": trainer.step,
            "val_energy_m": accuracy.energy_m,
            "val_ade_m": accuracy.ade_m,
            "val_fde_m": accuracy.fde_m,
            "val_samples": accuracy.num_samples,
            "val_min_ade_m": accuracy.min_ade_m,
            "val_min_fde_m": accuracy.min_fde_m,
            "val_constant_velocity_ade_m": trainer.baseline_m,
        }
        if accuracy.mixture_nll:
            result["val_mixture_nll"] = float(np.mean(accuracy.mixture_nll))
        stores = {address(path): content_id(path) for path in (*trainer.config.data, *trainer.config.val_data)}
        told = made | {"train_config": _comparable(trainer.config), "stores": stores, "result": result}
        if trainer.config.only_spread:
            _, before = load_checkpoint(trainer.config.init)
            info = replace(before, config=trainer.model.config, provenance=before.provenance | {"spread": told})
        else:
            info = CheckpointInfo(
                spec=trainer.model.spec,
                config=trainer.model.config,
                model=trainer.config.model,
                horizon_steps=trainer.config.horizon_steps,
                std_m=std_m,
                sources=trainer.data.sources,
                provenance=told,
            )
        save_checkpoint(trainer.config.out / BEST_OF_RUN, trainer.model, info)
    name, unit = ("negative log-likelihood", "nats") if trainer.config.only_spread else ("energy score", "m")
    return (
        f"step {trainer.step:,}: {name} {score:.3f} {unit} (best {trainer.best:.3f}), "
        f"ADE {accuracy.ade_m:.3f} m (constant velocity {trainer.baseline_m:.3f})"
    )


def _comparable(config: TrainConfig) -> dict[str, Any]:
    values = asdict(config)
    for name in ("resume", "threads", "device", "data_device", "capture"):
        del values[name]
    values["data"] = [address(p) for p in config.data]
    values["val_data"] = [address(p) for p in config.val_data]
    values["set"] = list(config.set)
    values["out"] = str(config.out)
    return values


def _check_run_folder(config: TrainConfig, config_file: Path) -> None:
    check_out(config.out)
    if not os.path.lexists(config_file):
        if config.out.exists() and any(not p.name.startswith(".") for p in config.out.iterdir()):
            raise UserError(f"{config.out} is not empty and not a training run; choose another --out")
        return
    curve = config.out / CURVE_FILE
    if not config.resume:
        if not any((config.out / name).exists() for name in (STATE_FILE, CURVE_FILE, BEST_OF_RUN)):
            read_object(config_file)
            return  # that run ended before its first validation, for example by a loss that is not finite
        raise UserError(f"{config.out} holds a run already; pass --resume to continue it or choose another --out")
    if not (config.out / STATE_FILE).exists() and any(p["step"] for p in read_curve(curve)):
        raise UserError(
            f"cannot resume: {config.out} has a curve but no {STATE_FILE}, so that the training would begin anew and "
            "replace what is there; choose another --out"
        )
    content = read_object(config_file)
    before = as_object(content.get("config"), f"{config_file}: config")
    now = _comparable(config)
    defaults = {f.name: f.default for f in fields(TrainConfig)}  # of fields that are newer than the run
    old = {name: before.get(name, defaults[name]) for name in now}
    for name, value in old.items():
        if not isinstance(value, float | int if isinstance(now[name], float) else type(now[name])):
            kind = type(now[name]).__name__
            raise UserError(f"{config_file}: config.{name} must be of type {kind}, got {short(repr(value), 80)}")
    known = as_object(content.get("stores"), f"{config_file}: stores")
    stores = {name: [known.get(str(path)) for path in old[name]] for name in ("data", "val_data")}
    moved = [name for name, contents in stores.items() if _are(getattr(config, name), contents)]
    free = ("steps", "patience", "out", *config.without_effect, *moved)
    changed = [name for name in now if old[name] != now[name] and name not in free]
    if changed:
        differences = ", ".join(f"{name} was {old[name]} and is now {now[name]}" for name in changed)
        options = " ".join(_option(name, old[name]) for name in changed)
        raise UserError(f"cannot resume: {differences}; use the same arguments, with {options}")
    for path in (*config.data, *config.val_data):
        if address(path) in known and known[address(path)] != content_id(path):
            raise UserError(
                f"cannot resume: {address(path)} is another store than the run began with; choose another --out"
            )


def _check_same_network(trainer: Trainer) -> None:
    """Raises if the checkpoint of `init` has other sizes or scales than when the run began."""
    kept, model = trainer.config.out / BEST_OF_RUN, trainer.model
    if not trainer.config.init or not kept.exists():
        return
    info = read_info(kept)
    if (info.config, info.spec.feature_scales) != (model.config, model.spec.feature_scales):
        raise UserError(
            f"cannot resume: '{trainer.config.init}' has another network than when the run began; choose another --out"
        )


def _are(stores: Sequence[Path], contents: Sequence[Any]) -> bool:
    """Returns whether stores, wherever they are now, have these contents."""
    return len(stores) == len(contents) and None not in contents and [content_id(p) for p in stores] == contents


def _option(name: str, value: Any) -> str:
    """Returns a field's value as words of a command line."""
    flag = name.replace("_", "-")
    if isinstance(value, bool):
        return f"--{flag}" if value else f"--no-{flag}"
    return shlex.join([f"--{flag}", *map(str, value if isinstance(value, list) else [value])])


def main() -> None:
    """Entry point."""
    with joined() as group:
        with nullcontext() if group.leads else redirect_stderr(io.StringIO()):  # usage is printed once
            config = group.together(lambda: parse(TrainConfig, __doc__))
        checkpoint = train(config, group)
        if group.leads:
            print(f"{config.keep} checkpoint: {checkpoint}")


if __name__ == "__main__":
    run_entry_point(main)
