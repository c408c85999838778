"""Reading of a training state from disk: types, ranges and shapes are checked before anything of it is taken."""

import math
import pickle
import warnings
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from predictor.support.errors import UserError, short
from predictor.support.reading import MIB, check_regular

MOST_BYTES = 65_536 * MIB
_MOMENTS = ("step", "exp_avg", "exp_avg_sq")


def read_state(path: Path, model: nn.Module, device: torch.device) -> dict[str, Any]:
    """Reads the state that `Trainer.save` wrote for this model; unpickles tensors, numbers and texts alone.

    Args:
        path: path of the file.
        model: network whose weights it must hold.
        device: device of the tensors.

    Raises:
        UserError: the file cannot be read, or a part is missing, of another type, out of range or not finite.
    """
    check_regular(path, MOST_BYTES)
    try:
        with warnings.catch_warnings(action="ignore"):  # of a pickle that is refused anyway
            state = torch.load(path, weights_only=True, map_location=device)
    except (RuntimeError, ValueError, KeyError, TypeError, EOFError, OSError, MemoryError, AttributeError,
            IndexError, pickle.UnpicklingError) as error:  # fmt: skip
        raise _damaged(path, " ".join(str(error).split())) from error
    if not isinstance(state, dict):
        raise _damaged(path, f"it must hold a dict, got {type(state).__name__}")
    kinds = {"model": dict, "optimizer": dict, "step": int, "best": float, "stale": int, "validated": int}
    for name, kind in kinds.items():
        value = state.get(name)
        if not isinstance(value, kind) or isinstance(value, bool):
            raise _damaged(path, f"'{name}' must be of type {kind.__name__}, got {type(value).__name__}")
    if state["step"] < 0 or state["stale"] < 0 or math.isnan(state["best"]):
        raise _damaged(path, "step and stale must not be negative, and best a number, got "
                       f"{state['step']}, {state['stale']} and {state['best']}")  # fmt: skip
    _check_weights(path, state["model"], model)
    _check_moments(path, state["optimizer"], model, trained=state["step"] > 0)
    return state


def _check_weights(path: Path, weights: dict[Any, Any], model: nn.Module) -> None:
    for name, ours in model.state_dict().items():
        found = weights.get(name)
        if not isinstance(found, Tensor) or found.shape != ours.shape or found.dtype != ours.dtype:
            raise _damaged(path, f"weight '{name}' must be a tensor of shape {tuple(ours.shape)} and {ours.dtype}")
        if not bool(torch.isfinite(found).all()):
            raise _damaged(path, f"weight '{name}' is not finite")


def _check_moments(path: Path, optimizer: dict[Any, Any], model: nn.Module, trained: bool) -> None:
    moments, parameters = optimizer.get("state"), list(model.parameters())
    groups = optimizer.get("param_groups")
    if not isinstance(moments, dict) or not isinstance(groups, list) or not all(isinstance(g, dict) for g in groups):
        raise _damaged(path, "'optimizer' must have a dict 'state' and a list 'param_groups'")
    if [group.get("params") for group in groups] != [list(range(len(parameters)))]:
        raise _damaged(path, "'optimizer' must have one group, of all weights in their order")
    if trained and not moments:
        raise _damaged(path, "'optimizer' has no moments, which each step leaves")
    for place, entry in moments.items():
        if not isinstance(entry, dict) or not set(_MOMENTS) <= entry.keys() or not _is_place(place, parameters):
            raise _damaged(path, f"'optimizer' must hold {', '.join(_MOMENTS)} of each weight")
        if not _is_count(entry["step"]):
            raise _damaged(path, "'optimizer' must hold step as a number of at least 0")
        for name in _MOMENTS[1:]:
            if not isinstance(entry[name], Tensor) or entry[name].shape != parameters[place].shape:
                raise _damaged(path, f"'optimizer' has a moment {name} of another shape than its weight")
            if not entry[name].is_floating_point() or not bool(torch.isfinite(entry[name]).all()):
                raise _damaged(path, f"'optimizer' has a moment {name} that is not finite")
        if bool((entry["exp_avg_sq"] < 0).any()):
            raise _damaged(path, "'optimizer' has a mean square exp_avg_sq below 0")


def _is_count(step: Any) -> bool:
    """Returns whether it is a finite number of at least 0, or a tensor of one."""
    if isinstance(step, Tensor) and step.numel() == 1 and not step.is_complex():
        step = step.item()
    return type(step) in (int, float) and math.isfinite(step) and step >= 0


def _is_place(place: Any, parameters: list[nn.Parameter]) -> bool:
    return isinstance(place, int) and 0 <= place < len(parameters)


def _damaged(path: Path, reason: str) -> UserError:
    return UserError(f"{path} cannot be read ({short(reason, 200)}); train anew into another --out")
