"""Predictor checkpoints: a folder with `config.json` and `model.safetensors`; no pickle, so safe to load from others.

A checkpoint holds everything needed to run it (spec, sizes, horizon, residual spread) and how it was made. The name
"hub:owner/name" stands for one on a hub (`predictor.support.hub`), wherever a checkpoint's name is taken.
"""

import functools
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import safetensors
import torch
from safetensors.torch import save
from torch import nn

from predictor.baselines.constant_velocity import ConstantVelocity
from predictor.forecaster import Forecaster, TrainableForecaster
from predictor.models import KINDS, build, config_from_json, name_of, shapes_of
from predictor.own_forecasters import PREFIX, find_own, is_own, make_own
from predictor.scene import SceneSpec
from predictor.scene_checks import MOST_STEPS
from predictor.support.config_checks import check_at_least, check_at_most, check_scale_values
from predictor.support.errors import UserError, short
from predictor.support.files import Stamp, check_place, new_folder, stamp, told_of, write_bytes, write_json
from predictor.support.hub import fetch, hub_name, is_hub
from predictor.support.reading import MIB, NoSuchFile, check_regular, read_json, version_of
from predictor.support.remote import address, is_remote, kept_copy, named
from predictor.support.runtime import resolve_device
from predictor.support.typed_values import converted, from_table

FORMAT = "dgvae-rl predictor"
VERSION = 1
CONSTANT_VELOCITY = "constant-velocity"
CONFIG, WEIGHTS, CARD = "config.json", "model.safetensors", "README.md"
BEST_OF_RUN = "checkpoint"
"""Folder of the best checkpoint, in the run folder that `python -m predictor.train` writes."""
MOST_CONFIG_BYTES, MOST_WEIGHT_BYTES, MOST_CARD_BYTES = 4 * MIB, 4096 * MIB, MIB
"""Largest sizes of the two files, and of the card beside them."""
MOST_BYTES = {CONFIG: MOST_CONFIG_BYTES, WEIGHTS: MOST_WEIGHT_BYTES}
_BESIDE = (CONFIG, WEIGHTS, CARD, "in_env.json", ".gitattributes")
"""Files that a checkpoint's folder may hold where it is replaced as a whole."""
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

    def __post_init__(self) -> None:
        """Checks ranges.

        Raises:
            UserError: a value is out of range.
        """
        check_at_least(self, 1, "horizon_steps")
        check_at_most(self, MOST_STEPS, "horizon_steps")
        check_scale_values(self, "std_m")
        if self.std_m and len(self.std_m) != self.horizon_steps:
            raise UserError(f"std_m needs a number for each of {self.horizon_steps} steps, got {len(self.std_m)}")


def save_checkpoint(path: Path, model: nn.Module, info: CheckpointInfo) -> None:
    """Writes a checkpoint folder; an existing one is replaced only when the new one is complete and can be read.

    Raises:
        UserError: the network is of another kind than `info` says, a checkpoint may not hold its weights or `info`, or
            the folder holds something else than a checkpoint.
    """
    if name_of(model) != info.model:
        raise UserError(f"the checkpoint says model '{info.model}' but the network is '{name_of(model)}'")
    _check_replaceable(Path(path))
    with new_folder(Path(path)) as partial:
        tensors = {k: v.detach().cpu().contiguous() for k, v in model.state_dict().items()}
        write_bytes(partial / WEIGHTS, save(tensors))  # `save_file` would not follow the umask, nor flush
        write_json(partial / CONFIG, {"format": FORMAT, "version": VERSION, **asdict(info)})
        with told_of(path, partial):
            read_info(partial)
            read_weights(partial / WEIGHTS, {key: tuple(tensor.shape) for key, tensor in tensors.items()})


def _check_replaceable(path: Path) -> None:
    """Raises a `UserError` where writing a checkpoint would delete something else: a run folder, say."""
    if is_remote(path) or not path.is_dir():
        return  # on other file systems, files that are not of a checkpoint stay
    found = sorted(entry.name for entry in path.iterdir())
    others = [name for name in found if name not in _BESIDE]
    if others or (found and not {WEIGHTS, CONFIG} <= set(found)):
        raise UserError(
            f"{short(path)} holds {short((others or found)[0], 60)} and is no checkpoint, which alone is replaced; "
            "choose another folder"
        )


def resolve(name: str | Path) -> Path:
    """Returns the folder of a checkpoint: a shipped one by its name, a folder itself, or the best one of a run folder.

    A folder of a shipped name comes first if it holds a checkpoint.

    Of a folder on another file system (`s3://…`) it returns a copy, which is kept until the process ends. One on a hub
    is downloaded, once in a process.

    Raises:
        UserError: none of them exists, it is "constant-velocity", which has no weights, or the hub does not give it.
    """
    if not isinstance(name, str | Path) or not str(name).strip() or "\0" in str(name):
        raise UserError(f"a checkpoint is a folder or a shipped name, got {short(repr(name), 60)}")
    if is_hub(name):
        return _fetched(str(name))
    path = Path(name)
    if is_remote(path):
        found = kept_copy(path, MOST_BYTES) or kept_copy(path / BEST_OF_RUN, MOST_BYTES)
        if found is None:
            raise UserError(f"{address(path)} is not a predictor checkpoint (it has no {' and '.join(MOST_BYTES)})")
        return found
    check_place(path)
    best = path / BEST_OF_RUN
    holds, holds_best = (path / WEIGHTS).is_file(), (best / WEIGHTS).is_file()
    if str(name) in shipped() and not (holds or holds_best):  # a folder may be called "highway"
        return PRETRAINED / str(name)
    if path.is_dir():
        return best if holds_best and not holds else path
    if str(name) == CONSTANT_VELOCITY:
        raise UserError(f"'{name}' has no weights; pass a checkpoint")
    if is_own(name):
        raise UserError(f"'{name}' is a forecaster of your own and no checkpoint; pass one with weights")
    raise UserError(
        f"no checkpoint '{name}': neither a folder nor a shipped name ({', '.join([*shipped(), CONSTANT_VELOCITY])})"
    )


def weights_stamp(name: str | Path) -> Stamp:
    """Returns the stamp of a checkpoint's file of weights; zeros of a name that has none."""
    try:
        return stamp(resolve(name) / WEIGHTS)
    except UserError:
        return 0, 0


@functools.lru_cache(maxsize=64)
def _fetched(name: str) -> Path:
    return fetch(name, {CONFIG: MOST_CONFIG_BYTES, WEIGHTS: MOST_WEIGHT_BYTES}, {CARD: MOST_CARD_BYTES})


def name_of_folder(path: str | Path) -> str:
    """Returns the name of a checkpoint in tables: its folder's, or the run folder's for its best checkpoint."""
    if is_own(path):
        return str(path).removeprefix(PREFIX)
    if is_hub(path):
        return hub_name(path).repository.rpartition("/")[2]
    path = Path(path)
    above = path.parent.parent.name  # of a download in the cache: models--OWNER--NAME/snapshots/COMMIT
    if path.parent.name == "snapshots" and above.startswith("models--"):
        return above.rpartition("--")[2]
    # not resolve(), which raises where links lead in a circle
    named = Path(os.path.realpath(path)) if path.name in ("", ".", "..", BEST_OF_RUN) else path
    return named.parent.name if named.name == BEST_OF_RUN else named.name


def names_of(checkpoints: Sequence[str]) -> dict[str, str]:
    """Returns a name in tables for each checkpoint: its folder's, and folders above it where two are called alike.

    >>> names_of(["new/crossing/checkpoint", "old/crossing", "highway"])
    {'new/crossing/checkpoint': 'new/crossing', 'old/crossing': 'old/crossing', 'highway': 'highway'}

    Raises:
        UserError: one of them is given twice.
    """
    names = {checkpoint: name_of_folder(checkpoint) for checkpoint in checkpoints}
    parts = {checkpoint: _folders_of(checkpoint) for checkpoint in checkpoints}
    if len(set(parts.values())) < len(checkpoints):
        raise UserError(f"each checkpoint is given once, got {', '.join(checkpoints)}; leave one out")
    for length in range(2, max(map(len, parts.values()), default=0) + 1):
        found = list(names.values())
        alike = [checkpoint for checkpoint, name in names.items() if found.count(name) > 1]
        names |= {checkpoint: "/".join(parts[checkpoint][-length:]) for checkpoint in alike}
    return names


def _folders_of(checkpoint: str) -> tuple[str, ...]:
    """Returns the folders on the way to a checkpoint, without that of the best one in a run's."""
    known = not Path(checkpoint).is_dir() and checkpoint in (*shipped(), CONSTANT_VELOCITY)
    if is_own(checkpoint) or known:
        return (checkpoint,)
    path = Path(os.path.realpath(checkpoint))
    return (path.parent if path.name == BEST_OF_RUN else path).parts


def shipped() -> list[str]:
    """Returns the names of the checkpoints that ship with the package."""
    return sorted(p.parent.name for p in PRETRAINED.glob("[!.]*/config.json"))


def load_checkpoint(name: str | Path, device: str = "cpu") -> tuple[Any, CheckpointInfo]:
    """Loads a model for inference, by a shipped name or a folder.

    Raises:
        UserError: the name is "constant-velocity", which has no weights, or the folder is not there, is not a predictor
            checkpoint, has another version, is truncated, or does not fit its own config.
    """
    path = resolve(name)
    with named(path, name):
        info = read_info(path)
        tensors = read_weights(path / WEIGHTS, shapes_of(info.model, info.spec, info.config, info.horizon_steps))
    with torch.random.fork_rng(devices=[]):  # the initial weights are not kept
        model = build(info.model, info.spec, info.config, info.horizon_steps)
    model.load_state_dict(tensors)
    return model.to(resolve_device(device)).eval(), info


def read_weights(file: Path, shapes: Mapping[str, tuple[int, ...]]) -> dict[str, torch.Tensor]:
    """Reads the weights of a network, after names, types and shapes of all of them have been compared with its own.

    Raises:
        UserError: the file cannot be read, holds other weights, or some that are not finite.
    """
    check_regular(file, MOST_WEIGHT_BYTES)
    try:
        with safetensors.safe_open(file, "pt") as stored:
            slices = {key: stored.get_slice(key) for key in stored.keys()}  # noqa: SIM118 (no mapping)
            found = {key: tuple(part.get_shape()) for key, part in slices.items()}
            if found != shapes:
                key = next(k for k in sorted(shapes.keys() | found.keys()) if shapes.get(k) != found.get(k))
                raise UserError(
                    f"{file}: tensor '{short(key)}' should be {shapes.get(key, 'absent')} by config.json but is "
                    f"{found.get(key, 'absent')} in {file.name}; the two files do not belong together"
                )
            for key, part in slices.items():
                if part.get_dtype() != "F32":
                    raise UserError(f"{file}: tensor '{key}' must be float32 (F32), got {part.get_dtype()}")
            tensors = {key: stored.get_tensor(key) for key in found}
    except (safetensors.SafetensorError, OSError) as error:
        raise UserError(f"{file} is no safetensors file ({error}); copy or train it again") from error
    for key, tensor in tensors.items():
        if not bool(torch.isfinite(tensor).all()):
            raise UserError(f"{file}: tensor '{key}' is not finite; train it again")
    return tensors


def read_info(path: Path) -> CheckpointInfo:
    """Reads and checks `config.json`.

    Raises:
        UserError: it cannot be read, or does not describe a predictor; the message names the key.
    """
    file = Path(path) / CONFIG
    try:
        content = read_json(file, MOST_CONFIG_BYTES)
    except NoSuchFile as error:
        raise UserError(f"{path} is not a predictor checkpoint (it has no {file.name})") from error
    run = content.get("config") if isinstance(content, dict) else None
    if isinstance(run, dict) and "eval_every" in run:
        raise UserError(f"{path} is a training run without a checkpoint yet; train on, with --resume, to the first one")
    if not isinstance(content, dict) or content.pop("format", None) != FORMAT:
        raise UserError(f"{path} is not a predictor checkpoint (config.json has no format '{FORMAT}')")
    version_of(content, VERSION, f"checkpoint {path}")
    content.pop("version")
    for key in ("model", "std_m", "sources", "provenance"):
        if key not in content:
            raise UserError(f"{file}: key '{key}' is missing")
    model = converted(content["model"], str, f"{file}: model")
    if model not in KINDS:
        raise UserError(f"{file}: model: no model '{short(model, 80)}'; there are {', '.join(KINDS)}")
    config = config_from_json(model, content.pop("config", None), f"{file}: config")
    return from_table(CheckpointInfo, content, str(file), {"config": config})


def require_known(name: str | Path) -> None:
    """Checks that there is a forecaster of this name; imports one of a user's own, and loads no weights.

    Raises:
        UserError: there is none.
    """
    if is_own(name):
        find_own(str(name))
    elif str(name) != CONSTANT_VELOCITY:
        resolve(name)


def load_forecaster(name: str | Path, scene_spec: SceneSpec, source: str, device: str = "cpu") -> Forecaster:
    """Loads a forecaster for scenes of `scene_spec`.

    Args:
        name: shipped name, folder, "hub:owner/name", "constant-velocity", or the name of a user's own
            (`predictor.own_forecasters`), which imports code.
        scene_spec: layout of the scenes.
        source: origin of the scenes, for messages.
        device: device of a checkpoint.

    Raises:
        UserError: when `load_checkpoint` or `make_own` raises, or the checkpoint has another spec (features, dt).
    """
    if is_own(name):
        return make_own(str(name), scene_spec, source)
    if str(name) == CONSTANT_VELOCITY:
        return ConstantVelocity(scene_spec)
    model: TrainableForecaster
    model, info = load_checkpoint(name, device)
    info.spec.check_compatible(scene_spec, f"checkpoint '{name}'", source)
    return model
