"""What-if forecasts: the ego follows given plans during the roll-out, and the other agents react to them.

A plan is the ego's state at each step of the horizon. Several plans are rolled out in one batch, from the same history.
At each step a model predicts all agents, then the ego's prediction is replaced by the plan's state, so that whatever
reaches the others from the ego comes from the plan. Others at step h thus depend on the plan's states before h alone.
"""

from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from predictor.forecaster import Belief, Forecaster, Futures
from predictor.forecaster_checks import check_futures
from predictor.noise import Noise
from predictor.scene import LARGEST, SceneSpec
from predictor.support.errors import UserError


@runtime_checkable
class ReactiveForecaster(Forecaster, Protocol):
    """Interface of forecasters whose agents react to each other: what the ego does changes the others' forecast."""

    def rollout_plans(
        self,
        belief: Belief,
        plans: Float[Tensor, "batch plans horizon state"],
        num_samples: int = 1,
        generator: Noise | None = None,
    ) -> Futures:
        """Computes possible futures for each plan of agent 0; samples of all plans are drawn from the same noise.

        Args:
            belief: belief after the latest observation; agent 0 is present in every scene.
            plans: states of agent 0 [SI] at each step, in the axes of the belief's states.
            num_samples: number of samples for each plan.
            generator: source of the samples' noise.

        Returns:
            Futures with an axis of plans after the batch; the entries of agent 0 are not read.
        """


def rollout_plans(
    forecaster: Forecaster,
    belief: Belief,
    plans: Float[Tensor, "batch plans horizon state"],
    num_samples: int = 1,
    generator: Noise | None = None,
) -> Futures:
    """Computes possible futures of each scene for each plan of its ego, with any forecaster.

    The forecast of a forecaster without interactions is the same for all plans. The ego's entries are the plan, its
    spread is 0. Its constant features are those observed, whatever the plan has.

    Args:
        forecaster: source of the futures.
        belief: its belief after the latest observation.
        plans: states of the ego [SI] at each step, in the axes of the belief's states.
        num_samples: number of samples for each plan.
        generator: source of the samples' noise.

    Returns:
        Futures with an axis of plans after the batch.

    Raises:
        UserError: the spec has no ego, the ego is absent, or the plans are of another shape, not finite or too
            large; what the forecaster returns has other sizes.
    """
    within = bool((plans.abs() <= LARGEST).all())
    check_plans(forecaster.spec, belief.valid[:, 0], tuple(plans.shape), within, plans.shape[-2])
    kept = [forecaster.spec.feature_names.index(name) for name in forecaster.spec.constant_features]
    if kept:
        plans = plans.clone()
        plans[..., kept] = belief.states[:, None, :1, kept]
    horizon_steps = plans.shape[2]
    if isinstance(forecaster, ReactiveForecaster):
        futures = forecaster.rollout_plans(belief, plans, num_samples, generator)
        axes = forecaster.spec.position_dim
        check_futures(futures, horizon_steps, num_samples, belief.states, axes, plans.shape[1])
    else:
        futures = _for_all(forecaster.rollout(belief, horizon_steps, num_samples, generator), plans.shape[1])
    states = with_ego(futures.states.transpose(-3, -2), plans[:, :, None]).transpose(-3, -2)
    scale = None if futures.scale is None else futures.scale.clone()
    if scale is not None:
        scale[..., 0, :, :] = 0.0
    return Futures(states, futures.mode_probs, scale)


def with_ego(
    states: Float[Tensor, "*batch agents state"], ego: Float[Tensor, "*#batch state"]
) -> Float[Tensor, "*batch agents state"]:
    """Returns the states with agent 0's replaced."""
    first = ego.to(states)[..., None, :].expand(*states.shape[:-2], 1, states.shape[-1])
    return torch.cat([first, states[..., 1:, :]], dim=-2)


def check_plans(
    spec: SceneSpec,
    ego_valid: Bool[Tensor, " batch"] | Bool[np.ndarray, " batch"],
    shape: tuple[int, ...],
    within: bool,
    horizon_steps: int,
) -> None:
    """Raises unless plans fit the scenes.

    Args:
        spec: layout of the scenes.
        ego_valid: in which scenes the ego is present.
        shape: shape of the plans.
        within: whether all numbers of the plans are finite and at most `LARGEST` in size.
        horizon_steps: number of steps of the forecast.

    Raises:
        UserError: the spec has no ego, the ego is absent, or the plans are of another shape, not finite or too large.
    """
    if not spec.has_ego:
        raise UserError("a plan needs an ego, but the scenes have none (has_ego=False); forecast without ego_plan")
    wanted = (len(ego_valid), horizon_steps, spec.num_features)
    if len(shape) != 4 or (shape[0], *shape[2:]) != wanted or shape[1] < 1:
        raise UserError(
            f"ego_plan needs the shape (scenes, plans, steps, features) = ({wanted[0]}, at least 1, {wanted[1]}, "
            f"{wanted[2]}), got {shape}"
        )
    if not within:
        raise UserError(
            f"ego_plan must be finite and at most {LARGEST:g} in size, got NaN, infinity or a larger number"
        )
    if not bool(ego_valid.all()):
        absent = [scene for scene, there in enumerate(ego_valid.tolist()) if not there]
        raise UserError(f"a plan needs the ego in the scene, but it is absent in scene {absent[0]}")


def _for_all(futures: Futures, plans: int) -> Futures:
    """Returns the same futures for each plan."""

    def repeated(values: Tensor) -> Tensor:
        return values[:, None].expand(-1, plans, *values.shape[1:])

    probs, scale = (None if t is None else repeated(t) for t in (futures.mode_probs, futures.scale))
    return Futures(repeated(futures.states), probs, scale)
