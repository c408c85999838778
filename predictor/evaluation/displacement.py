"""Forecasts metrics as pure functions; each returns its value and which entries mean something.

Positions have two axes or three [m]. An agent with no valid step has no error: it is reported as invalid, not as a
perfect 0, and so is a scene with no valid agent. Values where `valid` is not are meaningless.
"""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

MISS_THRESHOLD_M = 2.0
"""Final displacement above which a forecast misses [m]: the usual choice in driving (Argoverse 1 and 2)."""

COVERAGE_SHARE = 0.9
"""Share of the truth that the interval of `coverage` should hold."""


def displacement(
    forecast: Float[Tensor, "batch samples agents horizon axes"], future: Float[Tensor, "batch agents horizon axes"]
) -> Float[Tensor, "batch samples agents horizon"]:
    """Distance of each predicted position to the truth [m]."""
    return torch.linalg.vector_norm(forecast - future[:, None], dim=-1)


def min_ade(
    forecast: Float[Tensor, "batch samples agents horizon axes"],
    future: Float[Tensor, "batch agents horizon axes"],
    valid: Bool[Tensor, "batch agents horizon"],
) -> tuple[Float[Tensor, "batch agents"], Bool[Tensor, "batch agents"]]:
    """Best-of-samples mean displacement over valid steps [m] per agent."""
    return _mean_displacement(forecast, future, valid).min(dim=1).values, valid.any(-1)


def min_fde(
    forecast: Float[Tensor, "batch samples agents horizon axes"],
    future: Float[Tensor, "batch agents horizon axes"],
    valid: Bool[Tensor, "batch agents horizon"],
) -> tuple[Float[Tensor, "batch agents"], Bool[Tensor, "batch agents"]]:
    """Best-of-samples displacement at the last step of the horizon [m] per agent; valid if that step is."""
    return displacement(forecast[..., -1:, :], future[..., -1:, :])[..., 0].min(dim=1).values, valid[..., -1]


def min_joint_ade(
    forecast: Float[Tensor, "batch samples agents horizon axes"],
    future: Float[Tensor, "batch agents horizon axes"],
    valid: Bool[Tensor, "batch agents horizon"],
) -> tuple[Float[Tensor, " batch"], Bool[Tensor, " batch"]]:
    """Best-of-samples mean displacement [m] per scene: one sample is chosen for all agents together.

    A sample's error is the mean over the scene's valid agents of their mean displacement over valid steps, so it is
    never below the mean of `min_ade` over the same agents. (minJointADE, e.g. Weng et al., "Joint Metrics Matter",
    ICCV 2023; "minSADE" in other places.)
    """
    agents = valid.any(-1).sum(-1)
    joint = _mean_displacement(forecast, future, valid).sum(-1) / agents.clamp(min=1)[:, None]
    return joint.min(dim=1).values, agents > 0


def min_joint_fde(
    forecast: Float[Tensor, "batch samples agents horizon axes"],
    future: Float[Tensor, "batch agents horizon axes"],
    valid: Bool[Tensor, "batch agents horizon"],
) -> tuple[Float[Tensor, " batch"], Bool[Tensor, " batch"]]:
    """The same at the last step of the horizon [m], over the agents that are there; the best sample is its own best."""
    return min_joint_ade(forecast[..., -1:, :], future[..., -1:, :], valid[..., -1:])


def miss_rate(
    forecast: Float[Tensor, "batch samples agents horizon axes"],
    future: Float[Tensor, "batch agents horizon axes"],
    valid: Bool[Tensor, "batch agents horizon"],
    threshold_m: float = MISS_THRESHOLD_M,
) -> tuple[Float[Tensor, "batch agents"], Bool[Tensor, "batch agents"]]:
    """1 for each agent whose `min_fde` is above the threshold, else 0; its mean is the miss rate.

    Args:
        forecast: sampled positions [m].
        future: true positions [m].
        valid: which entries count; an agent without its last step is invalid.
        threshold_m: a final displacement of exactly this is no miss [m]. The default suits driving; scenes of other
            size need their own.
    """
    final, known = min_fde(forecast, future, valid)
    return (final > threshold_m).to(final.dtype), known


def min_displacement(
    forecast: Float[Tensor, "batch samples agents horizon axes"],
    future: Float[Tensor, "batch agents horizon axes"],
    valid: Bool[Tensor, "batch agents horizon"],
) -> tuple[Float[Tensor, "batch agents horizon"], Bool[Tensor, "batch agents horizon"]]:
    """Displacement at each step [m] of each agent's best sample (best by its mean over valid steps)."""
    distance = torch.where(valid[:, None], displacement(forecast, future), 0.0)
    best = distance.sum(-1).argmin(dim=1)
    index = best[:, None, :, None].expand(-1, 1, -1, distance.shape[-1])
    return distance.gather(1, index)[:, 0], valid


def squared_error(
    forecast: Float[Tensor, "batch samples agents horizon axes"],
    future: Float[Tensor, "batch agents horizon axes"],
    valid: Bool[Tensor, "batch agents horizon"],
) -> tuple[Float[Tensor, "batch agents horizon"], Bool[Tensor, "batch agents horizon"]]:
    """Squared displacement of the mean of the samples [m²], axes added up; the root of its mean is the RMSE."""
    return (forecast.mean(dim=1) - future).square().sum(-1), valid


def gaussian_mixture_nll(
    forecast: Float[Tensor, "batch samples agents horizon axes"],
    future: Float[Tensor, "batch agents horizon axes"],
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
    axes = forecast.shape[-1]
    distance_sq = displacement(forecast, future).square()
    log_density = -distance_sq / (2 * std_m**2) - axes * (torch.log(std_m) + 0.5 * math.log(2 * math.pi))
    return math.log(forecast.shape[1]) - torch.logsumexp(log_density, dim=1), valid


def coverage(
    forecast: Float[Tensor, "batch samples agents horizon axes"],
    future: Float[Tensor, "batch agents horizon axes"],
    valid: Bool[Tensor, "batch agents horizon"],
    share: float = COVERAGE_SHARE,
) -> tuple[Float[Tensor, "batch agents horizon"], Bool[Tensor, "batch agents horizon"]]:
    """1 where the truth is as near the samples' mean as the central `share` of the samples, else 0.

    Its mean is `share` if the samples are spread like the truth, less if they are too sure, more if too timid. The
    truth's distance to the samples' mean is compared with the `share`-quantile of the samples' own distances. Two
    details keep a few samples honest: a sample's distance is to the mean of the *others*, because the truth has no part
    in the mean either (that is K/(K−1) times its distance to the mean of all), and the quantile is the value of rank
    share·(K+1), between ranks by a line (Hyndman & Fan 1996, type 6: unbiased coverage).

    Args:
        forecast: sampled positions [m].
        future: true positions [m].
        valid: which entries count.
        share: between 0 and 1. K samples know only quantiles of rank 1 to K: where share·(K+1) is beyond (one sample;
            fewer than 9 for 0.9), every entry is invalid.

    Raises:
        ValueError: `share` is not between 0 and 1.
    """
    if not 0 < share < 1:
        raise ValueError(f"share must be between 0 and 1, got {share}")
    samples = forecast.shape[1]
    rank = round(share * (samples + 1), 9)  # 0.7 · 10 is to be 7
    if samples < 2 or not 1 <= rank <= samples:
        return torch.zeros_like(future[..., 0]), torch.zeros_like(valid)
    centre = forecast.mean(dim=1)
    spread = displacement(forecast, centre).sort(dim=1).values * (samples / (samples - 1))
    below = min(int(rank), samples - 1)
    limit = torch.lerp(spread[:, below - 1], spread[:, below], rank - below)
    return (torch.linalg.vector_norm(future - centre, dim=-1) <= limit).to(future.dtype), valid


def _mean_displacement(
    forecast: Float[Tensor, "batch samples agents horizon axes"],
    future: Float[Tensor, "batch agents horizon axes"],
    valid: Bool[Tensor, "batch agents horizon"],
) -> Float[Tensor, "batch samples agents"]:
    """Mean over valid steps [m]; 0 for an agent without one."""
    distance = torch.where(valid[:, None], displacement(forecast, future), 0.0)
    return distance.sum(-1) / valid.sum(-1).clamp(min=1)[:, None]
