"""Checks of what a forecaster is and returns: its parts, types and shapes."""

from typing import Any

import numpy as np
from jaxtyping import Float
from torch import Tensor

from predictor.forecaster import Belief, Forecaster, Futures, Memory, has_scale
from predictor.scene import SceneSpec
from predictor.support.errors import UserError, short
from predictor.support.signatures import takes

_ARGUMENTS = {
    "empty_memory": "batch, agents",
    "observe": "memory, states, valid",
    "rollout": "belief, horizon_steps, num_samples, generator",
}
"""Arguments with which the methods of a forecaster are called."""


def require_forecaster(given: Any) -> Forecaster:
    """Returns `given`, which must have what a `Forecaster` has.

    Raises:
        UserError: a part is missing, it is a class instead of an object, or its spec is no `SceneSpec`.
    """
    if isinstance(given, type):
        raise UserError(f"a forecaster is an object, got the class {given.__name__}; call it first")
    parts = ("spec", "horizon_steps", "num_edge_types", "edge_feature_dim", "empty_memory", "observe", "rollout")
    missing = [part for part in parts if not hasattr(given, part)]
    if missing:
        raise UserError(
            f"a forecaster needs {', '.join(parts)} (predictor.forecaster.Forecaster), but {type(given).__name__} has "
            f"no {', '.join(missing)}"
        )
    for part, arguments in _ARGUMENTS.items():
        if not takes(getattr(given, part), *arguments.split(", ")):
            name = type(given).__name__
            raise UserError(f"{part} of a forecaster must take ({arguments}), which that of {name} does not")
    if not isinstance(given.spec, SceneSpec):
        raise UserError(f"the spec of a forecaster must be a SceneSpec, got {type(given.spec).__name__}")
    for part, least in (("horizon_steps", 1), ("num_edge_types", 1), ("edge_feature_dim", 0)):
        number = getattr(given, part)
        if not isinstance(number, int | np.integer) or number < least:
            raise UserError(f"{part} of a forecaster must be a whole number from {least} on, got {short(repr(number))}")
    forecaster: Forecaster = given
    return forecaster


def check_empty(given: Any, envs: int, agents: int) -> None:
    """Checks what a forecaster's `empty_memory` returned; no value is read.

    Raises:
        UserError: it is no `Memory`, or has no place for each environment and agent.
    """
    if not isinstance(given, Memory):
        raise UserError(f"empty_memory of a forecaster must return a Memory, got {type(given).__name__}")
    for tensor in (*given.nodes, *given.pairs):
        if tuple(tensor.shape[:2]) != (envs, agents):
            raise UserError(
                f"empty_memory of a forecaster: the shape of each part must begin with {(envs, agents)}, got "
                f"{tuple(tensor.shape)}; check_forecaster (dgvae_rl.testing) finds the cause"
            )


def check_observed(given: Any, states: Float[Tensor, "batch agents state"], forecaster: Forecaster) -> None:
    """Checks types and shapes of what a forecaster's `observe` returned for these states; no value is read.

    Raises:
        UserError: they do not fit.
    """
    if not (isinstance(given, tuple) and len(given) == 2 and isinstance(given[1], Belief)):
        raise UserError(f"observe of a forecaster must return a Memory and a Belief, got {type(given).__name__}")
    if not isinstance(given[0], Memory):
        raise UserError(f"observe of a forecaster must return a Memory first, got {type(given[0]).__name__}")
    belief = given[1]
    batch, agents, _ = states.shape
    slots = agents if belief.senders is None else belief.senders.shape[-1]
    wanted = {
        "states": tuple(states.shape),
        "valid": (batch, agents),
        "edge_probs": (batch, agents, slots, forecaster.num_edge_types),
        "edge_features": (batch, agents, slots, forecaster.edge_feature_dim),
    }
    for name, shape in wanted.items():
        _check_shape(f"observe of a forecaster: {name} of the belief", getattr(belief, name), shape)


def check_futures(
    given: Any,
    steps: int,
    num_samples: int,
    observed: Float[Tensor, "batch agents state"],
    axes: int,
    plans: int | None = None,
) -> None:
    """Checks what a forecaster's `rollout` returned, or its `rollout_plans`.

    Args:
        given: what it returned.
        steps: number of steps that it was asked for.
        num_samples: number of samples that it was asked for.
        observed: states that it went on from.
        axes: number of axes of a position.
        plans: number of plans of each scene that it was asked for, an axis after the batch; None for `rollout`.

    Raises:
        UserError: it is no `Futures`, or has other sizes than it was asked for.
    """
    name = "rollout" if plans is None else "rollout_plans"
    if not isinstance(given, Futures):
        raise UserError(f"{name} of a forecaster must return Futures, got {type(given).__name__}")
    for part in (given.states, given.mode_probs, given.scale):
        if part is not None and not isinstance(part, Tensor):
            raise UserError(f"{name} of a forecaster: Futures must hold tensors, got {type(part).__name__}")
    sizes = tuple(given.states.shape)
    if plans is None and len(sizes) == 5 and (sizes[1], sizes[3]) != (num_samples, steps):
        raise UserError(
            f"the forecaster was asked for {num_samples} samples of {steps} steps and gave {sizes[1]} of {sizes[3]}"
        )
    batch, agents, features = observed.shape
    each = (batch, num_samples, agents) if plans is None else (batch, plans, num_samples, agents)
    _check_shape(f"{name} of a forecaster: states", given.states, (*each, steps, features))
    if given.mode_probs is not None:
        _check_shape(f"{name} of a forecaster: mode_probs", given.mode_probs, each)
    if given.scale is not None:
        _check_shape(f"{name} of a forecaster: scale", given.scale, (*each, steps, axes))


def _check_shape(what: str, given: Any, shape: tuple[int, ...]) -> None:
    found = tuple(getattr(given, "shape", ()))
    if found != shape:
        raise UserError(
            f"{what} must have the shape {shape}, got {found}; check_forecaster (dgvae_rl.testing) finds the cause"
        )


def check_scale(futures: "Futures", forecaster: "Forecaster") -> None:
    """Checks that futures come with a scale if, and only if, the forecaster says so.

    Raises:
        UserError: they do not.
    """
    if (futures.scale is not None) != has_scale(forecaster):
        found, wanted = ("no scale", "False") if futures.scale is None else ("a scale", "True")
        raise UserError(
            f"rollout of a forecaster gave {found}, and its has_scale is {has_scale(forecaster)}; set has_scale = "
            f"{wanted}, which sizes observations"
        )
