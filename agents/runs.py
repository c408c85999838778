"""The folder of a training run: its config, and model files that a kill at any moment cannot corrupt.

Every file is written under a temporary name, flushed to disk and renamed. A DQN checkpoint carries its replay buffer in
the same zip, so the two can never disagree. SB3 zips hold pickled data: load only files you trust.
"""

import io
import json
import pickle
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from stable_baselines3 import DQN, PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from agents.presets import Algorithm
from predictor.errors import UserError
from predictor.files import delete_leftovers, new_file, write_json

CONFIG_FILE = "config.json"
CHECKPOINT_FILE = "checkpoint.zip"
BEST_FILE = "best_model.zip"
POLICY_FILE = "policy.zip"
_ALGORITHMS: dict[str, type[BaseAlgorithm]] = {"ppo": PPO, "dqn": DQN}
_BUFFER_ENTRY = "replay_buffer.pkl"
_NOTE_ENTRY = "note.json"


def open_run(
    run_dir: Path, config: dict[str, Any], provenance: dict[str, Any], resume: bool, free: Sequence[str] = ()
) -> None:
    """Create a run folder with its config, or check that an existing one may be continued.

    Args:
        run_dir: the folder.
        config: what makes the run; must be the same when it is resumed.
        provenance: of this start; each start is kept.
        resume: continue what is there (a folder without a run in it is started anew).
        free: fields of `config` that may differ on resume, as they do not change the training.

    Raises:
        UserError: the folder is in use, or holds a run with another config.
    """
    if run_dir.exists() and not run_dir.is_dir():
        raise UserError(f"{run_dir} is a file; choose another --out")
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


def read_config(run_dir: Path) -> dict[str, Any]:
    """The config of a run.

    Raises:
        UserError: the folder holds no run.
    """
    return _read(run_dir / CONFIG_FILE)["config"]


def save_model(model: BaseAlgorithm, path: Path, note: dict[str, Any] | None = None, buffer: bool = False) -> None:
    """Save a model so that `path` is always a whole file.

    Args:
        model: what to save.
        path: a ``.zip``; readable by SB3's own ``load``.
        note: small JSON content that travels inside.
        buffer: put the replay buffer inside as well, if the algorithm has one.
    """
    with new_file(path) as partial:
        with partial.open("wb") as file:
            model.save(file)
        with zipfile.ZipFile(partial, "a") as archive:
            archive.writestr(_NOTE_ENTRY, json.dumps(note or {}))
            if buffer and isinstance(model, OffPolicyAlgorithm):
                with archive.open(_BUFFER_ENTRY, "w", force_zip64=True) as entry:
                    pickle.dump(model.replay_buffer, entry, protocol=pickle.HIGHEST_PROTOCOL)


def load_model(path: Path, algorithm: Algorithm, venv: VecEnv | None = None, device: str = "cpu") -> BaseAlgorithm:
    """Load a model, with the replay buffer if it is inside.

    Raises:
        UserError: no such file, not a model of this algorithm, or not made for these spaces.
    """
    if not path.exists():
        raise UserError(f"no policy at {path}; train one with python train_policy.py")
    try:
        model = _ALGORITHMS[algorithm].load(path, env=venv, device=device)
    except (ValueError, KeyError, TypeError, AttributeError, AssertionError, EOFError, RuntimeError) as error:
        reason = " ".join(str(error).split())
        raise UserError(f"{path} is no {algorithm} policy that fits here: {reason}") from error
    with zipfile.ZipFile(path) as archive:
        if isinstance(model, OffPolicyAlgorithm) and _BUFFER_ENTRY in archive.namelist():
            model.load_replay_buffer(io.BytesIO(archive.read(_BUFFER_ENTRY)))
    return model


def read_note(path: Path) -> dict[str, Any]:
    """The note that travels inside a saved model; empty if there is no such file or note."""
    if not path.exists():
        return {}
    with zipfile.ZipFile(path) as archive:
        return json.loads(archive.read(_NOTE_ENTRY)) if _NOTE_ENTRY in archive.namelist() else {}


def _read(file: Path) -> dict[str, Any]:
    try:
        return json.loads(file.read_text())
    except FileNotFoundError as error:
        raise UserError(f"{file.parent} holds no training run ({file.name} is missing)") from error
    except (json.JSONDecodeError, UnicodeDecodeError, NotADirectoryError) as error:
        raise UserError(f"{file} is not a run's config: {error}") from error


def _check_same(file: Path, config: dict[str, Any], free: Sequence[str]) -> list[Any]:
    """Compare with the stored config; returns the provenance of earlier starts."""
    stored = _read(file)
    before = stored.get("config", {})
    for name in config:
        if name not in free and before.get(name) != config[name]:
            raise UserError(
                f"cannot resume {file.parent}: {name} was {before.get(name)!r}, now {config[name]!r}; "
                "pass the old value or choose another --out"
            )
    return list(stored.get("provenance", []))
