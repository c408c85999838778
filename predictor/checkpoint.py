"""Predictor checkpoints: a folder with `config.json` and `model.safetensors`; no pickle, so safe to load from others.

A checkpoint holds everything needed to run it (spec, sizes, horizon, residual spread) and how it was made.
"""

import dataclasses
import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import safetensors
import torch
from safetensors.torch import load_file, save
from torch import nn

from predictor.baselines.constant_velocity import ConstantVelocity
from predictor.forecaster import TrainableForecaster
from predictor.models import build, config_from_json, name_of
from predictor.scene import SceneSpec
from predictor.support.errors import UserError
from predictor.support.files import new_folder, write_json
from predictor.support.runtime import resolve_device

FORMAT = "dgvae-rl predictor"
VERSION = 1
CONSTANT_VELOCITY = "constant-velocity"
WEIGHTS = "model.safetensors"
BEST_OF_RUN = "checkpoint"
"""Folder of the best checkpoint, in the run folder that `python -m predictor.train` writes."""
PRETRAINED = Path(__file__).resolve().parent / "pretrained"


@dataclass(frozen=True)
class CheckpointInfo:
    """Content of `config.json`, beside the weights."""

    spec: SceneSpec
    """Layout of the scenes that it observes."""
    config: Any
    """Sizes of the network: the model's config dataclass."""
    horizon_steps: int
    """Number of steps that it was trained to forecast."""
    std_m: tuple[float, ...] = ()
    """Standard deviation per axis of the validation error at each horizon step [m]; the spread that NLL uses."""
    sources: tuple[str, ...] = ()
    """Training data (env ids or dataset names)."""
    provenance: dict[str, Any] = field(default_factory=dict)
    """Command, commit, versions, seeds, validation results."""
    model: str = "dgvae"
    """Name of the network in `predictor.models`."""


def save_checkpoint(path: Path, model: nn.Module, info: CheckpointInfo) -> None:
    """Writes a checkpoint folder; an existing one is replaced only when the new one is complete."""
    if name_of(model) != info.model:
        raise UserError(f"the checkpoint says model '{info.model}' but the network is '{name_of(model)}'")
    with new_folder(Path(path)) as partial:
        tensors = {k: v.detach().cpu().contiguous() for k, v in model.state_dict().items()}
        (partial / WEIGHTS).write_bytes(save(tensors))  # `save_file` would not follow the umask
        write_json(partial / "config.json", {"format": FORMAT, "version": VERSION, **asdict(info)})


def resolve(name: str | Path) -> Path:
    """Returns the folder of a checkpoint: a shipped one by its name, a folder itself, or the best one of a run folder.

    Raises:
        UserError: none of them exists.
    """
    path = Path(name)
    if path.is_dir():
        best = path / BEST_OF_RUN
        return best if (best / WEIGHTS).is_file() and not (path / WEIGHTS).is_file() else path
    if str(name) in shipped():
        return PRETRAINED / str(name)
    raise UserError(
        f"no checkpoint '{name}': neither a folder nor a shipped name ({', '.join([*shipped(), CONSTANT_VELOCITY])})"
    )


def name_of_folder(path: str | Path) -> str:
    """Returns the name of a checkpoint in tables: its folder's, or the run folder's for its best checkpoint."""
    path = Path(path)
    named = path.resolve() if path.name in ("", ".", "..") else path
    return named.resolve().parent.name if named.name == BEST_OF_RUN else named.name


def shipped() -> list[str]:
    """Returns the names of the checkpoints that ship with the package."""
    return sorted(p.parent.name for p in PRETRAINED.glob("[!.]*/config.json"))


def load_checkpoint(name: str | Path, device: str = "cpu") -> tuple[Any, CheckpointInfo]:
    """Loads a model for inference, by a shipped name or a folder.

    Raises:
        UserError: the name is "constant-velocity", which has no weights, or the folder is not there, is not a predictor
            checkpoint, has another version, is truncated, or does not fit its own config.
    """
    if str(name) == CONSTANT_VELOCITY:
        raise UserError(f"'{name}' has no weights; pass a checkpoint")
    path = resolve(name)
    info = read_info(path)
    model = build(info.model, info.spec, info.config, info.horizon_steps)
    try:
        tensors = load_file(path / WEIGHTS)
    except (safetensors.SafetensorError, OSError) as error:
        raise UserError(f"{path / WEIGHTS} cannot be read ({error}); copy or train it again") from error
    expected = {k: tuple(v.shape) for k, v in model.state_dict().items()}
    found = {k: tuple(v.shape) for k, v in tensors.items()}
    if expected != found:
        name_ = next(k for k in sorted(expected.keys() | found.keys()) if expected.get(k) != found.get(k))
        raise UserError(
            f"{path}: tensor '{name_}' should be {expected.get(name_, 'absent')} by config.json but is "
            f"{found.get(name_, 'absent')} in model.safetensors; the two files do not belong together"
        )
    if not all(bool(torch.isfinite(t).all()) for t in tensors.values()):
        raise UserError(f"{path}: the weights are not finite; train it again")
    model.load_state_dict(tensors)
    return model.to(resolve_device(device)).eval(), info


def read_info(path: Path) -> CheckpointInfo:
    """Reads and checks `config.json`."""
    file = Path(path) / "config.json"
    try:
        content = json.loads(file.read_text())
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise UserError(f"{file} cannot be read ({error}); is {path} a predictor checkpoint?") from error
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise UserError(f"{path} is not a predictor checkpoint (config.json has no format '{FORMAT}')")
    if content.get("version") != VERSION:
        raise UserError(f"{path} has checkpoint version {content.get('version')}, this release reads {VERSION}")
    try:
        if int(content["horizon_steps"]) < 1:
            raise ValueError(f"horizon_steps must be at least 1, got {content['horizon_steps']}")
        model = str(content.get("model", "dgvae"))  # before version 0.2 there was one model only
        return CheckpointInfo(
            spec=_build(SceneSpec, content["spec"]),
            config=config_from_json(model, content["config"]),
            horizon_steps=int(content["horizon_steps"]),
            std_m=tuple(content["std_m"]),
            sources=tuple(content["sources"]),
            provenance=dict(content["provenance"]),
            model=model,
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise UserError(f"{file} does not describe a predictor: {error}") from error


def load_forecaster(
    name: str | Path, scene_spec: SceneSpec, source: str, device: str = "cpu"
) -> TrainableForecaster | ConstantVelocity:
    """Loads a forecaster for scenes of `scene_spec`, by a shipped name, a folder, or "constant-velocity".

    Raises:
        UserError: when `load_checkpoint` raises, or the checkpoint has another spec (features, dt).
    """
    if str(name) == CONSTANT_VELOCITY:
        return ConstantVelocity(scene_spec)
    model: TrainableForecaster
    model, info = load_checkpoint(name, device)
    info.spec.check_compatible(scene_spec, f"checkpoint '{name}'", source)
    return model


def _build(cls: type, values: dict[str, Any]) -> Any:
    fields = {f.name for f in dataclasses.fields(cls)}
    unknown = set(values) - fields
    if unknown:
        raise ValueError(f"unknown field '{sorted(unknown)[0]}' of {cls.__name__}")
    return cls(**{k: tuple(v) if isinstance(v, list) else v for k, v in values.items()})
