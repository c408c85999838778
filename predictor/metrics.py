"""Forecast metrics as pure functions; each returns its value and which entries mean something.

An agent with no valid step has no error: it is reported as invalid, not as a perfect 0.
"""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor


def displacement(
    forecast: Float[Tensor, "batch samples agents horizon 2"], future: Float[Tensor, "batch agents horizon 2"]
) -> Float[Tensor, "batch samples agents horizon"]:
    """Distance of each predicted position to the truth [m]."""
    return torch.linalg.vector_norm(forecast - future[:, None], dim=-1)


def min_ade(
    forecast: Float[Tensor, "batch samples agents horizon 2"],
    future: Float[Tensor, "batch agents horizon 2"],
    valid: Bool[Tensor, "batch agents horizon"],
) -> tuple[Float[Tensor, "batch agents"], Bool[Tensor, "batch agents"]]:
    """Best-of-samples mean displacement over valid steps [m] per agent."""
    distance = torch.where(valid[:, None], displacement(forecast, future), 0.0)
    mean = distance.sum(-1) / valid.sum(-1).clamp(min=1)[:, None]
    return mean.min(dim=1).values, valid.any(-1)


def min_fde(
    forecast: Float[Tensor, "batch samples agents horizon 2"],
    future: Float[Tensor, "batch agents horizon 2"],
    valid: Bool[Tensor, "batch agents horizon"],
) -> tuple[Float[Tensor, "batch agents"], Bool[Tensor, "batch agents"]]:
    """Best-of-samples displacement at the last step of the horizon [m] per agent; valid if that step is."""
    return displacement(forecast, future)[..., -1].min(dim=1).values, valid[..., -1]


def min_displacement(
    forecast: Float[Tensor, "batch samples agents horizon 2"],
    future: Float[Tensor, "batch agents horizon 2"],
    valid: Bool[Tensor, "batch agents horizon"],
) -> tuple[Float[Tensor, "batch agents horizon"], Bool[Tensor, "batch agents horizon"]]:
    """Displacement at each step [m] of each agent's best sample (best by its mean over valid steps)."""
    distance = torch.where(valid[:, None], displacement(forecast, future), 0.0)
    best = distance.sum(-1).argmin(dim=1)
    index = best[:, None, :, None].expand(-1, 1, -1, distance.shape[-1])
    return distance.gather(1, index)[:, 0], valid


def squared_error(
    forecast: Float[Tensor, "batch samples agents horizon 2"],
    future: Float[Tensor, "batch agents horizon 2"],
    valid: Bool[Tensor, "batch agents horizon"],
) -> tuple[Float[Tensor, "batch agents horizon"], Bool[Tensor, "batch agents horizon"]]:
    """Squared displacement of the mean of the samples [m²]; the root of its mean is the RMSE."""
    return (forecast.mean(dim=1) - future).square().sum(-1), valid


def gaussian_mixture_nll(
    forecast: Float[Tensor, "batch samples agents horizon 2"],
    future: Float[Tensor, "batch agents horizon 2"],
    valid: Bool[Tensor, "batch agents horizon"],
    std_m: Float[Tensor, " horizon"],
) -> tuple[Float[Tensor, "batch agents horizon"], Bool[Tensor, "batch agents horizon"]]:
    """Negative log-likelihood [nats] of the true position under equal round Gaussians around the samples.

    Args:
        forecast: sampled positions [m].
        future: true positions [m].
        valid: which entries count.
        std_m: standard deviation per axis at each step [m], fitted on other data.
    """
    distance_sq = displacement(forecast, future).square()
    log_density = -distance_sq / (2 * std_m**2) - 2 * torch.log(std_m) - math.log(2 * math.pi)
    return math.log(forecast.shape[1]) - torch.logsumexp(log_density, dim=1), valid


def edge_entropy(
    edge_probs: Float[Tensor, "*batch types"], valid: Bool[Tensor, "*batch"]
) -> tuple[Float[Tensor, "*batch"], Bool[Tensor, "*batch"]]:
    """Entropy of the edge type [nats] per pair: 0 is a decided graph, log(types) an uninformative one."""
    return -(edge_probs * torch.log(edge_probs.clamp(min=1e-12))).sum(-1), valid
