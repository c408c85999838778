"""Pair matching (paper Sec. IV): the first edge-feature dimensions are averaged over time, to hold what is constant.

Restricted labelling, the supervised alternative, is in `predictor.training.objective`.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor


def running_mean(
    values: Float[Tensor, "batch time agents slots static"],
    pairs: Bool[Tensor, "batch time agents slots"],
    memory: Float[Tensor, "batch agents slots static_and_count"],
) -> Float[Tensor, "batch time agents slots static_and_count"]:
    """Computes the mean over the steps at which a pair was present without a break, and their number; causal.

    Args:
        values: feature dimensions to average.
        pairs: which pairs are present.
        memory: mean and count before the first step; zeros for "nothing yet".
    """
    after = []
    for value, present in zip(values.unbind(1), pairs[..., None].unbind(1), strict=True):
        memory = running_mean_step(value, present[..., 0], memory)
        after.append(memory)
    return torch.stack(after, dim=1)


def running_mean_step(
    value: Float[Tensor, "*pairs static"], present: Bool[Tensor, "*pairs"], memory: Float[Tensor, "*pairs _"]
) -> Float[Tensor, "*pairs _"]:
    """Computes `running_mean` for one step, in any layout of pairs."""
    mean, count = memory[..., :-1], memory[..., -1:] + 1
    return torch.cat([mean + (value - mean) / count, count], dim=-1) * present[..., None]


def window_mean(
    values: Float[Tensor, "batch time agents slots static"], pairs: Bool[Tensor, "batch time agents slots"]
) -> Float[Tensor, "batch time agents slots static"]:
    """Computes the mean over all steps of a window with the pair present (the paper's pair matching); training only."""
    present = pairs[..., None]
    mean = (values * present).sum(1, keepdim=True) / present.sum(1, keepdim=True).clamp(min=1)
    return mean * present
