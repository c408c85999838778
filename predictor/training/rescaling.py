"""Gives a network the scales of other data: its forecasts stay, its weights get the size that they train well at.

A network that is trained on from another road's checkpoint sees positions divided by that road's length and width, so
that its inputs may be dozens of units large, or a hundredth of one. Every scale but those of the edges' geometry
divides the inputs of a linear layer or multiplies its outputs, so the layer's weights can take the change.
"""

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn

from predictor.models import build
from predictor.support.errors import UserError

SCALES = ("delta_scales", "input_scales", "change_scales", "geometry_scales")
"""Fields of the config that are scales of the data."""
_OF_PARTS = ("change_scales", "geometry_scales")
"""Those without which the network lacks the inputs that they divide; the others are the spec's where none are given."""
_OF_INPUTS = (
    "encoder.embed", "decoder.message_pair.receiver", "decoder.message_pair.sender", "decoder.own", "self_edges.input",
)  # fmt: skip
"""Layers whose first inputs are an agent's state; those of the first one may be followed by its changes."""
_SAME = 1e-3
"""Difference of forecasts, as a share of the position's scale, above which the network is not the same."""


def rescaled(model: nn.Module, name: str, scales: dict[str, tuple[float, ...]], horizon_steps: int) -> Any:
    """Builds a copy of a dG-VAE with other scales; only geometry of edges and spread of modes change its forecasts.

    Args:
        model: network whose scales are replaced.
        name: name of the model.
        scales: new scales, by field of the config; where they are empty, since the data show none, the old ones stay.
        horizon_steps: number of steps that the copy forecasts.

    Raises:
        UserError: the network has parts whose weights cannot take the change.
    """
    source: Any = model
    before, spec = source.config, source.spec
    after = replace(before, **{k: v for k, v in scales.items() if v and (k not in _OF_PARTS or getattr(before, k))})
    weights = {key: value.clone() for key, value in source.state_dict().items()}
    features = spec.num_features

    def ratio(field: str, inverse: bool = False) -> Tensor:
        old, new = (torch.tensor(getattr(c, field) or spec.feature_scales) for c in (before, after))
        return old / new if inverse else new / old

    for layer in _OF_INPUTS:
        if (weight := weights.get(f"{layer}.weight")) is not None:
            weight[:, :features] *= ratio("input_scales")
    if after.change_scales:
        weights["encoder.embed.weight"][:, -features:] *= ratio("change_scales")
    for kind in ("weight", "bias"):
        rows = ratio("delta_scales", inverse=True)
        weights[f"decoder.readout.{kind}"] *= rows[:, None] if kind == "weight" else rows
    plain, copy = (
        build(name, spec, replace(after, geometry_scales=geometry), horizon_steps).eval()
        for geometry in (before.geometry_scales, after.geometry_scales)
    )
    plain.load_state_dict(weights)
    copy.load_state_dict(weights)
    was_training = source.training
    moved = (_forecast(plain, horizon_steps) - _forecast(source.eval(), horizon_steps)).abs().max()
    source.train(was_training)
    if not moved <= _SAME * max(spec.feature_scales):
        raise UserError(
            f"refit_scales cannot keep what this network forecasts, it moves by {float(moved):.3g}; leave it out"
        )
    return copy.train(was_training)


@torch.no_grad()
def _forecast(model: Any, horizon_steps: int) -> Tensor:
    """Returns the forecast of a scene in motion, with all its modes."""
    spec, samples = model.spec, max(1, model.config.num_modes)
    noise = torch.Generator().manual_seed(0)
    states = 0.3 * torch.randn(4, 5, spec.num_features, generator=noise) * torch.tensor(spec.feature_scales)
    valid = torch.ones(4, 5, dtype=torch.bool)
    memory, belief = model.empty_memory(4, 5), None
    for step in range(3):
        memory, belief = model.observe(memory, states + 0.02 * step * states.roll(1, 0), valid)
    found: Tensor = model.rollout(belief, horizon_steps, samples, generator=noise).states
    return found
