"""Folder of a training run: its config, and model files that stay whole when the process is killed at any moment.

Every file is written under a temporary name, flushed to disk and renamed. The checkpoint of an off-policy algorithm
holds its replay buffer in the same zip, so that model and buffer always belong together. SB3 zips hold pickled data:
load only files you trust.
"""

import io
import json
import os
import pickle
import zipfile
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.save_util import recursive_getattr
from stable_baselines3.common.vec_env import VecEnv

from agents.presets import Algorithm
from envs.registry import check_arguments
from envs.sb3.algorithms import algorithm_of_model
from envs.sb3.policy_file import FORECASTER, ForecasterPin, PolicyNote, algorithm_of, load_policy, write_note
from predictor.support.errors import UserError
from predictor.support.files import check_out, check_place, delete_leftovers, new_file, write_json
from predictor.support.reading import NoSuchFile, damage_in, read_json
from predictor.support.typed_values import converted

CONFIG_FILE = "config.json"
CHECKPOINT_FILE = "checkpoint.zip"
BEST_FILE = "best_model.zip"
POLICY_FILE = "policy.zip"
CURVE_FILE = "curve.json"
SUMMARY_FILE = "summary.json"
SHIPPED = Path(__file__).resolve().parent / "pretrained"
"""Folder of the policies that ship, NAME.zip each."""
LARGEST = 1e30
"""Largest size of a number in a learning curve; larger ones cannot be drawn."""

OPTIONS_OF = {"envs": "num_envs", "partner": "driver"}
"""Options of train_policy.py by the older names that the config keeps for them."""
_BUFFER_ENTRY = "replay_buffer.pkl"
_WITHOUT_CONFIG = "move it away to use the run's policy.zip alone, or train anew in another folder"


def open_run(
    run_dir: Path, config: dict[str, Any], provenance: dict[str, Any], resume: bool, free: Sequence[str] = ()
) -> None:
    """Creates a run folder with its config, or checks that an existing run may be continued.

    Args:
        run_dir: path of the folder.
        config: settings of the run; must be equal when the run is resumed.
        provenance: provenance of this start; the file keeps one entry per start.
        resume: whether to continue the run in the folder (a folder without a run gets a new one).
        free: fields of `config` that may differ on resume, as they do not change the training.

    Raises:
        UserError: the folder is in use, or holds a run with another config.
    """
    check_out(run_dir)
    config = json.loads(json.dumps(config, default=str))
    file = run_dir / CONFIG_FILE
    started = run_dir.exists() and any(not entry.name.startswith(".") for entry in run_dir.iterdir())
    starts: list[Any] = []
    if started:
        if not resume:
            raise UserError(f"{run_dir} exists; choose another --out, or continue it with --resume")
        starts = _check_same(file, config, free)
    run_dir.mkdir(parents=True, exist_ok=True)
    delete_leftovers(run_dir)
    write_json(file, {"config": config, "provenance": [*starts, provenance]})


def read_config(run_dir: Path, *required: str) -> dict[str, Any]:
    """Reads the config of a run.

    Args:
        run_dir: path of the folder.
        required: keys that the config must have.

    Raises:
        UserError: the folder holds no run of a policy, or one without a required key.
    """
    config: dict[str, Any] = _read(run_dir / CONFIG_FILE)["config"]
    for name in required:
        if name not in config:
            raise UserError(f"{run_dir / CONFIG_FILE}: key '{name}' is missing")
    return config


def shipped_policies() -> list[str]:
    """Returns the names of the policies that ship with the package."""
    return sorted(file.stem for file in SHIPPED.glob("*.zip"))


def policy_zip(path: str | Path) -> Path:
    """Returns the zip of a policy: the file itself, the final policy of a run folder, or a shipped one by its name.

    Raises:
        UserError: there is none; the message says what is there instead.
    """
    path = Path(path)
    check_place(path)
    if path.is_file():
        if path.suffix != ".zip":
            raise UserError(f"a policy is a .zip file, got {path}; give it that ending")
        return path
    if not path.is_dir():
        if str(path) in shipped_policies():
            return SHIPPED / f"{path}.zip"
        names = ", ".join(shipped_policies())
        raise UserError(
            f"no policy at {path}: neither a run folder nor a .zip nor one that ships ({names}); "
            "train one with train_policy.py"
        )
    if (path / POLICY_FILE).is_file():
        return path / POLICY_FILE
    read_config(path)
    raise UserError(
        f"{path} holds no {POLICY_FILE}: its training has not ended; continue it with --resume, or name one of its "
        ".zip files"
    )


def is_policy(path: Path) -> bool:
    """Returns whether a path is a policy's zip or a run folder of train_policy.py."""
    if path.is_dir():
        return any((path / name).is_file() for name in (POLICY_FILE, CHECKPOINT_FILE))
    return path.suffix == ".zip"


def read_curve(path: Path) -> list[dict[str, Any]]:
    """Reads the measurements of a training, in the order of their steps; none if there is no such file.

    Raises:
        UserError: the file is damaged.
    """
    if not os.path.lexists(path):
        return []
    advice = f"{path} is damaged; remove it to go on without it"
    try:
        points = converted(read_json(path), tuple[dict[str, Any], ...], str(path))
        for place, point in enumerate(points):
            check_point(point, f"{path}: {place}")
            if place and point["steps"] <= points[place - 1]["steps"]:
                raise UserError(f"{path}: {place}: steps must rise, got {point['steps']}")
    except UserError as error:
        raise UserError(f"{advice} ({damage_in(path, error)})") from error
    return list(points)


def check_point(point: Mapping[str, Any], where: str) -> None:
    """Checks a measurement of a training's curve.

    Raises:
        UserError: it has no steps or no return, or one out of range.
    """
    for name, kind in (("steps", int), ("return", float)):
        if name not in point:
            raise UserError(f"{where}: key '{name}' is missing")
        converted(point[name], kind, f"{where}: {name}")
    for name, value in point.items():
        converted(value, float | None, f"{where}: {name}")
        if value is not None and abs(value) > LARGEST:
            raise UserError(f"{where}: {name} must be at most {LARGEST:g} in size, got {value:g}")
    if point["steps"] < 0:
        raise UserError(f"{where}: steps must not be negative, got {point['steps']}")


def save_model(
    model: BaseAlgorithm,
    path: Path,
    extra: dict[str, Any] | None = None,
    note: PolicyNote | None = None,
    to_continue: bool = False,
) -> None:
    """Saves a model so that `path` is always a whole file.

    Args:
        model: model to save.
        path: path of the ``.zip``, which SB3's own ``load`` also reads.
        extra: small JSON content stored inside; `envs.sb3.policy_file.read_note` returns it.
        note: what the policy needs beside its weights.
        to_continue: whether training can go on from the file: it then holds the optimiser's moments, which are twice as
            large as the weights, and the replay buffer, if the algorithm has one.
    """
    with new_file(path) as partial:
        with partial.open("wb") as file, nullcontext() if to_continue else _without_moments(model):
            model.save(file)
        write_note(partial, note, extra or {}, algorithm_of_model(model))
        if to_continue and isinstance(model, OffPolicyAlgorithm):
            with zipfile.ZipFile(partial, "a") as archive, archive.open(_BUFFER_ENTRY, "w", force_zip64=True) as entry:
                pickle.dump(model.replay_buffer, entry, protocol=pickle.HIGHEST_PROTOCOL)


@contextmanager
def _without_moments(model: BaseAlgorithm) -> Iterator[None]:
    """Lets a model's optimisers forget what they have averaged inside the block."""
    parts = (recursive_getattr(model, name) for name in model._get_torch_save_params()[0])
    kept = [(part, part.state) for part in parts if isinstance(part, torch.optim.Optimizer)]
    try:
        for optimizer, _ in kept:
            optimizer.state = defaultdict(dict)
        yield
    finally:
        for optimizer, state in kept:
            optimizer.state = state


def load_model(path: Path, algorithm: Algorithm, venv: VecEnv | None = None, device: str = "cpu") -> BaseAlgorithm:
    """Loads a model, with the replay buffer if the file holds one.

    Raises:
        UserError: the file is missing, holds a model of another algorithm, or a model for other spaces.
    """
    found = algorithm_of(path)
    if found != algorithm:
        raise UserError(
            f"{path} holds a policy of {found}, where one of {algorithm} is expected; take the file of its own run"
        )
    model = load_policy(path, venv, device)
    with zipfile.ZipFile(path) as archive:
        if isinstance(model, OffPolicyAlgorithm) and _BUFFER_ENTRY in archive.namelist():
            model.load_replay_buffer(io.BytesIO(archive.read(_BUFFER_ENTRY)))
    return model


def check_forecaster(run_dir: Path, found: ForecasterPin | None) -> bool:
    """Compares the forecaster of a run that is continued with the one it would get now.

    Returns:
        False if the run does not record its forecaster (started before forecasters were pinned).

    Raises:
        UserError: the run was trained on another forecaster.
    """
    if not os.path.lexists(run_dir / CONFIG_FILE):
        return True
    stored = _read(run_dir / CONFIG_FILE)["config"]
    if FORECASTER not in stored:
        return found is None
    pinned = stored[FORECASTER]
    if found is not None and pinned is not None:
        ForecasterPin.from_json(pinned).check(found, f"run {run_dir}")
    return True


def _read(file: Path) -> dict[str, Any]:
    try:
        content = read_json(file)
    except NoSuchFile as error:
        raise UserError(
            f"{file.parent} holds no training run ({file.name} is missing); name the folder of one, or a .zip"
        ) from error
    except UserError as error:
        raise UserError(f"{file} is damaged ({damage_in(file, error)}); {_WITHOUT_CONFIG}") from error
    config = content.get("config") if isinstance(content, dict) else None
    if not isinstance(config, dict) or "env_id" not in config:  # a predictor's run has none
        raise UserError(f"{file} is not the config of a policy's run; {_WITHOUT_CONFIG}")
    for name, kind in (("env_id", str), ("observe", str), ("algorithm", Algorithm)):
        if name in config:
            converted(config[name], kind, f"{file}: {name}")
    check_arguments(config.get("env_kwargs", ""), f"{file}: env_kwargs")
    converted(content.get("provenance", []), tuple[Any, ...], f"{file}: provenance")
    return content


def _check_same(file: Path, config: dict[str, Any], free: Sequence[str]) -> list[Any]:
    """Compares with the stored config; returns the provenance of earlier starts."""
    stored = _read(file)
    before = stored["config"]
    for name, now in config.items():
        was = before.get(name, now)  # runs of older versions lack some values, also among hyperparameters
        if isinstance(was, dict) and isinstance(now, dict):
            was = now | was
        if name in free or was == now:
            continue
        if isinstance(was, dict) and isinstance(now, dict):  # name the part that differs
            part = next(key for key in was if key not in now or was[key] != now[key])
            name, was, now = f"{name}.{part}", was[part], now.get(part, "not there")
        name = OPTIONS_OF.get(name, name)
        raise UserError(
            f"cannot resume {file.parent}: {name} was {was!r}, now {now!r}; pass the old value or choose another --out"
        )
    return list(stored.get("provenance", []))
