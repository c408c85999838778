"""Conversion of states to network inputs and back: scaling, frames, and how a predicted change is added.

All trainable models share it, so that a comparison of models is not a comparison of normalisations.
"""

import math
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from predictor.scene import SceneSpec
from predictor.support.errors import UserError

Residual = Literal["state", "constant_velocity", "trapezoid"]


def drift(
    spec: SceneSpec,
    residual: Residual,
    states: Float[Tensor, "*#batch state"],
    after: Float[Tensor, "*batch state"],
    fraction: float = 1.0,
) -> Float[Tensor, "*#batch axes"]:
    """Computes the change of position in one step that follows from velocities alone [m].

    Args:
        spec: layout of the states.
        residual: "state" gives zero; "constant_velocity" gives v·dt; "trapezoid" gives (v + v')/2·dt.
        states: current states [SI].
        after: states one step later [SI]; only "trapezoid" uses their velocities.
        fraction: fraction of a step.
    """
    axes = spec.position_dim
    velocity = states[..., axes : 2 * axes]
    if residual == "state":
        return torch.zeros_like(velocity)
    if residual == "trapezoid":
        velocity = 0.5 * (velocity + after[..., axes : 2 * axes])
    return velocity * (spec.dt_s * fraction)


def check_scales(name: str, scales: tuple[float, ...], spec: SceneSpec) -> None:
    """Checks that there is a positive, finite number for each feature.

    Raises:
        UserError: there is not.
    """
    if len(scales) != spec.num_features or not all(0 < scale < math.inf for scale in scales):
        raise UserError(f"{name} needs {spec.num_features} positive numbers, got {scales}")


class StateCodec(nn.Module):
    """Computes scaled features in the spec's frame, and next states from a network's output.

    Args:
        spec: layout, frame and scales of the states.
        delta_scales: typical one-step change of each feature [SI]; empty takes the spec's feature scales.
        residual: position to which the predicted change is added; see `drift`.
        input_scales: divisors of the inputs [SI]; empty takes the spec's feature scales.
    """

    def __init__(
        self,
        spec: SceneSpec,
        delta_scales: tuple[float, ...] = (),
        residual: Residual = "state",
        input_scales: tuple[float, ...] = (),
    ) -> None:
        """Creates buffers only; nothing is learned and nothing is saved."""
        super().__init__()
        deltas, inputs = delta_scales or spec.feature_scales, input_scales or spec.feature_scales
        for name, scales in (("delta_scales", deltas), ("input_scales", inputs)):
            check_scales(name, scales, spec)
        if residual not in ("state", "constant_velocity", "trapezoid"):
            raise UserError(f"residual must be 'state', 'constant_velocity' or 'trapezoid', got '{residual}'")
        self.spec = spec
        self.residual: Residual = residual
        self.scales: Tensor
        self.deltas: Tensor
        self._ego_axes: Tensor
        self._centroid_axes: Tensor
        self._predicted: Tensor
        for name, values in (
            ("scales", inputs),
            ("deltas", deltas),
            ("_ego_axes", [float(f == "ego") for f in spec.frame]),
            ("_centroid_axes", [float(f == "centroid") for f in spec.frame]),
            ("_predicted", [float(f not in spec.constant_features) for f in spec.feature_names]),
        ):
            self.register_buffer(name, torch.tensor(values), persistent=False)

    @property
    def num_inputs(self) -> int:
        """Number of columns of `inputs`: the features, and the ego's mark where there is an ego."""
        return self.spec.num_features + int(self.spec.has_ego)

    def inputs(
        self, states: Float[Tensor, "*batch agents state"], valid: Bool[Tensor, "*#batch agents"]
    ) -> Float[Tensor, "*batch agents inputs"]:
        """Computes scaled features, re-centred at this step, plus the ego's mark; zeros where absent."""
        axes = self.spec.position_dim
        positions, present = states[..., :axes], valid[..., None]
        centre = positions[..., :1, :] * self._ego_axes
        if self.has_centroid:
            centre = centre + self.centroid(states, valid)
        inputs = torch.cat([positions - centre, states[..., axes:]], dim=-1) / self.scales
        if self.spec.has_ego:
            mark = torch.zeros_like(inputs[..., :1])
            mark[..., 0, 0] = 1.0
            inputs = torch.cat([inputs, mark], dim=-1)
        return inputs * present

    @property
    def has_centroid(self) -> bool:
        """Whether positions are relative to the mean of all agents, on some axis."""
        return "centroid" in self.spec.frame

    def centroid(
        self, states: Float[Tensor, "*batch agents state"], valid: Bool[Tensor, "*#batch agents"]
    ) -> Float[Tensor, "*batch 1 axes"]:
        """Computes the mean position of those that are there [m], 0 on axes that are not relative to it."""
        there = valid[..., None]
        total = torch.where(there, states[..., : self.spec.position_dim], 0.0).sum(-2, keepdim=True)
        return total / there.sum(-2, keepdim=True).clamp(min=1) * self._centroid_axes

    def advance(
        self, states: Float[Tensor, "*#batch state"], change: Float[Tensor, "*batch state"], fraction: float = 1.0
    ) -> Float[Tensor, "*batch state"]:
        """Computes the states [SI] a step, or a fraction of one, later.

        Args:
            states: current states [SI].
            change: predicted rate of change, in units of `delta_scales` per step.
            fraction: fraction of a step.
        """
        axes = self.spec.position_dim
        after = states + change * (self.deltas * self._predicted * fraction)
        moved = after[..., :axes] + drift(self.spec, self.residual, states, after, fraction)
        return torch.cat([moved, after[..., axes:]], dim=-1)
