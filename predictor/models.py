"""Every trainable forecaster by name: its config class, its network, and how a config is put together.

Checkpoints, training and the suite of tables build models here; a new model is added to `ModelName` and `KINDS`.
"""

import dataclasses
import types
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args, get_origin, get_type_hints

import torch
from torch import nn
from torch.overrides import TorchFunctionMode

from predictor.baselines.dnri import DNRI, DNRIConfig
from predictor.baselines.imma import IMMA, IMMAConfig
from predictor.baselines.lstm import LSTM, LSTMConfig
from predictor.baselines.mlp import MLP, MLPConfig
from predictor.dgvae import DGVAE
from predictor.dgvae.config import PRESETS, DGVAEConfig
from predictor.scene import SceneSpec
from predictor.support.errors import UserError, short
from predictor.support.typed_values import from_table

_ENTRYWISE = ("add", "sub", "mul", "div")


class _Unfilled(TorchFunctionMode):
    """Leaves out draws, products and what works in place: on the meta device, where nothing has a value.

    torch would load its compiler for them, which takes seconds. The shapes stay as they are.
    """

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Runs a function of torch, or returns its first argument where it would only change entries."""
        name = getattr(func, "__name__", "")
        if func is torch.randn:
            func = torch.empty
        in_place = name.endswith("_") and not name.endswith("__") and name != "requires_grad_"
        return args[0] if args and (in_place or name in _ENTRYWISE) else func(*args, **(kwargs or {}))


ModelName = Literal["dgvae", "dnri", "imma", "lstm", "mlp"]


@dataclass(frozen=True)
class _Kind:
    config: type
    network: type


KINDS: dict[str, _Kind] = {
    "dgvae": _Kind(DGVAEConfig, DGVAE),
    "dnri": _Kind(DNRIConfig, DNRI),
    "imma": _Kind(IMMAConfig, IMMA),
    "lstm": _Kind(LSTMConfig, LSTM),
    "mlp": _Kind(MLPConfig, MLP),
}


def name_of(model: nn.Module) -> str:
    """Returns the name under which a model can be built again.

    Raises:
        UserError: not a model that can be trained.
    """
    for name, kind in KINDS.items():
        if type(model) is kind.network:
            return name
    raise UserError(f"{type(model).__name__} is not a trainable model; there are {', '.join(KINDS)}")


def build(name: str, spec: SceneSpec, config: Any, horizon_steps: int) -> nn.Module:
    """Builds a network with fresh weights from torch's generator.

    Raises:
        UserError: no model of this name.
    """
    network: nn.Module = _kind(name).network(spec, config, horizon_steps)
    return network


def config_from_json(name: str, values: Any, where: str = "config") -> Any:
    """Returns the config of a checkpoint.

    Args:
        name: name of the model.
        values: content of JSON.
        where: file and key, for messages.

    Raises:
        UserError: no model of this name, an unknown field, or a value of another type or out of range.
    """
    return from_table(_kind(name).config, values, where)


def shapes_of(name: str, spec: SceneSpec, config: Any, horizon_steps: int) -> dict[str, tuple[int, ...]]:
    """Returns the shapes of a network's weights by name, without memory for any of them."""
    with torch.device("meta"), _Unfilled():
        network = build(name, spec, config, horizon_steps)
    return {key: tuple(tensor.shape) for key, tensor in network.state_dict().items()}


def configure(name: str, preset: str, overrides: Sequence[str] = (), **fitted: Any) -> Any:
    """Builds a config from a preset, `field=value` overrides, and values fitted to the data.

    Args:
        name: name of the model.
        preset: "paper", "fast" or "plural"; models other than the dG-VAE have their published sizes, halved unless
            "paper".
        overrides: texts such as "hidden_dim=64".
        fitted: values of fields such as `delta_scales`; an override wins.

    Raises:
        UserError: an unknown field, or a value that does not fit it.
    """
    cls = _kind(name).config
    base = PRESETS[preset] if name == "dgvae" else cls()
    if name != "dgvae" and preset != "paper":
        widths = {f.name: getattr(base, f.name) for f in dataclasses.fields(cls) if f.name.endswith("_dim")}
        base = dataclasses.replace(base, **{k: max(1, v // 2) for k, v in widths.items()})
    return changed(dataclasses.replace(base, **fitted), overrides)


def changed(config: Any, overrides: Sequence[str]) -> Any:
    """Returns a config with fields changed by texts such as "static_dim=1".

    Raises:
        UserError: an unknown field, or a value that does not fit it.
    """
    return dataclasses.replace(config, **dict(_parse(type(config), text) for text in overrides))


def _parse(cls: type, text: str) -> tuple[str, Any]:
    name, _, value = text.partition("=")
    hints = get_type_hints(cls)
    if name not in hints or not value:
        raise UserError(f"--set takes field=value with a field of {cls.__name__} ({', '.join(hints)}), got '{text}'")
    kind = hints[name]
    try:
        return name, _convert(kind, value)
    except ValueError as error:
        raise UserError(f"{name} of {cls.__name__} must be {_described(kind)}, got '{value}'") from error


def _convert(kind: Any, value: str) -> Any:
    if kind is bool:
        if value.lower() not in ("true", "false"):
            raise ValueError(value)
        return value.lower() == "true"
    if get_origin(kind) is Literal:
        if value not in get_args(kind):
            raise ValueError(value)
        return value
    if get_origin(kind) is tuple:
        return tuple(get_args(kind)[0](v) for v in value.split(","))
    return kind(value)


def _described(kind: Any) -> str:
    if get_origin(kind) is Literal:
        return "one of " + ", ".join(get_args(kind))
    if kind is bool:
        return "true or false"
    return "comma-separated numbers" if isinstance(kind, types.GenericAlias) else f"of type {kind.__name__}"


def _kind(name: str) -> _Kind:
    if name not in KINDS:
        raise UserError(f"no model '{short(name, 80)}'; there are {', '.join(KINDS)}")
    return KINDS[name]
