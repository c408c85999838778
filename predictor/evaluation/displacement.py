"""Computes forecast metrics as pure functions; each returns values and a mask of the valid ones.

Positions have two axes or three [m]. An agent without a valid step has no error: it is invalid, not a perfect 0, and so
is a scene without a valid agent. Invalid values are meaningless.
"""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

MISS_THRESHOLD_M = 2.0
"""Final displacement above which a forecast misses [m]: the usual choice in driving (Argoverse 1 and 2)."""

COVERAGE_SHARE = 0.9
"""Nominal share of truths within the interval of `coverage` and of `mixture_coverage`."""


def displacement(
    forecast: Float[Tensor, "batch samples agents horizon axes"], future: Float[Tensor, "batch agents horizon axes"]
) -> Float[Tensor, "batch samples agents horizon"]:
    """Computes the distance of each predicted position to the truth [m]."""
    return torch.linalg.vector_norm(forecast - future[:, None], dim=-1)


def min_ade(
    forecast: Float[Tensor, "batch samples agents horizon axes"],
    future: Float[Tensor, "batch agents horizon axes"],
    valid: Bool[Tensor, "batch agents horizon"],
) -> tuple[Float[Tensor, "batch agents"], Bool[Tensor, "batch agents"]]:
    """Computes the mean displacement over valid steps [m] of the best sample per agent."""
    return _mean_displacement(forecast, future, valid).min(dim=1).values, valid.any(-1)


def min_fde(
    forecast: Float[Tensor, "batch samples agents horizon axes"],
    future: Float[Tensor, "batch agents horizon axes"],
    valid: Bool[Tensor, "batch agents horizon"],
) -> tuple[Float[Tensor, "batch agents"], Bool[Tensor, "batch agents"]]:
    """Computes the displacement at the last step [m] of the best sample per agent; valid if that step is."""
    return displacement(forecast[..., -1:, :], future[..., -1:, :])[..., 0].min(dim=1).values, valid[..., -1]


def min_joint_ade(
    forecast: Float[Tensor, "batch samples agents horizon axes"],
    future: Float[Tensor, "batch agents horizon axes"],
    valid: Bool[Tensor, "batch agents horizon"],
) -> tuple[Float[Tensor, " batch"], Bool[Tensor, " batch"]]:
    """Computes the mean displacement [m] of the best sample per scene: one sample is chosen for all its agents.

    A sample's error is the mean over the scene's valid agents of their mean displacement over valid steps, so it is
    never below the mean of `min_ade` over the same agents. (minJointADE, e.g. Weng et al., "Joint Metrics Matter",
    ICCV 2023; also called "minSADE".)
    """
    agents = valid.any(-1).sum(-1)
    joint = _mean_displacement(forecast, future, valid).sum(-1) / agents.clamp(min=1)[:, None]
    return joint.min(dim=1).values, agents > 0


def min_joint_fde(
    forecast: Float[Tensor, "batch samples agents horizon axes"],
    future: Float[Tensor, "batch agents horizon axes"],
    valid: Bool[Tensor, "batch agents horizon"],
) -> tuple[Float[Tensor, " batch"], Bool[Tensor, " batch"]]:
    """Computes the mean displacement at the last step [m] of the best sample per scene, over agents valid there."""
    return min_joint_ade(forecast[..., -1:, :], future[..., -1:, :], valid[..., -1:])


def miss_rate(
    forecast: Float[Tensor, "batch samples agents horizon axes"],
    future: Float[Tensor, "batch agents horizon axes"],
    valid: Bool[Tensor, "batch agents horizon"],
    threshold_m: float = MISS_THRESHOLD_M,
) -> tuple[Float[Tensor, "batch agents"], Bool[Tensor, "batch agents"]]:
    """Returns 1 for each agent whose `min_fde` is above the threshold, else 0; the mean is the miss rate.

    Args:
        forecast: sampled positions [m].
        future: true positions [m].
        valid: which entries count; an agent without its last step is invalid.
        threshold_m: largest final displacement that is not a miss [m]. The default suits driving; scenes of another
            size need another value.
    """
    final, known = min_fde(forecast, future, valid)
    return (final > threshold_m).to(final.dtype), known


def min_displacement(
    forecast: Float[Tensor, "batch samples agents horizon axes"],
    future: Float[Tensor, "batch agents horizon axes"],
    valid: Bool[Tensor, "batch agents horizon"],
) -> tuple[Float[Tensor, "batch agents horizon"], Bool[Tensor, "batch agents horizon"]]:
    """Computes the displacement at each step [m] of each agent's best sample (by its mean over valid steps)."""
    distance = torch.where(valid[:, None], displacement(forecast, future), 0.0)
    best = distance.sum(-1).argmin(dim=1)
    index = best[:, None, :, None].expand(-1, 1, -1, distance.shape[-1])
    return distance.gather(1, index)[:, 0], valid


def squared_error(
    forecast: Float[Tensor, "batch samples agents horizon axes"],
    future: Float[Tensor, "batch agents horizon axes"],
    valid: Bool[Tensor, "batch agents horizon"],
    mode_probs: Float[Tensor, "batch samples agents"] | None = None,
) -> tuple[Float[Tensor, "batch agents horizon"], Bool[Tensor, "batch agents horizon"]]:
    """Computes the squared displacement of the samples' mean [m²], summed over axes (its root mean is the RMSE)."""
    mean = forecast.mean(dim=1) if mode_probs is None else (mode_probs[..., None, None] * forecast).sum(1)
    return (mean - future).square().sum(-1), valid


def miss_distance_m(scale_m: float) -> float:
    """Returns the final displacement above which a forecast misses [m]: 2 m, a tenth of the scale of a small arena."""
    return MISS_THRESHOLD_M if scale_m >= 50 else 0.1 * scale_m


LEAST_STD_M = 1e-3
"""Smallest standard deviation of a mode that counts [m]: a likelihood has no upper bound as it goes to zero."""


def mixture_nll(
    forecast: Float[Tensor, "batch samples agents horizon axes"],
    future: Float[Tensor, "batch agents horizon axes"],
    valid: Bool[Tensor, "batch agents horizon"],
    mode_probs: Float[Tensor, "batch samples agents"],
    scale: Float[Tensor, "batch samples agents horizon axes"],
) -> tuple[Float[Tensor, "batch agents horizon"], Bool[Tensor, "batch agents horizon"]]:
    """Computes the negative log-likelihood [nats] of the truth under the predicted mixture of Gaussians at each step.

    Args:
        forecast: mean of each mode [m].
        future: true positions [m].
        valid: which entries count.
        mode_probs: probability of each mode.
        scale: standard deviation of each mode [m].
    """
    std_m = scale.clamp(min=LEAST_STD_M)
    error = torch.where(valid[:, None, ..., None], forecast - future[:, None], 0.0) / std_m
    log_density = -0.5 * error.square().sum(-1) - torch.log(std_m).sum(-1)
    log_density = log_density - 0.5 * forecast.shape[-1] * math.log(2 * math.pi)
    log_probs = torch.log(mode_probs.clamp(min=torch.finfo(mode_probs.dtype).tiny))
    return -torch.logsumexp(log_density + log_probs[..., None], dim=1), valid


def coverage(
    forecast: Float[Tensor, "batch samples agents horizon axes"],
    future: Float[Tensor, "batch agents horizon axes"],
    valid: Bool[Tensor, "batch agents horizon"],
    share: float = COVERAGE_SHARE,
    mode_probs: Float[Tensor, "batch samples agents"] | None = None,
) -> tuple[Float[Tensor, "batch agents horizon"], Bool[Tensor, "batch agents horizon"]]:
    """Returns 1 where the truth is as near to the samples' mean as the central `share` of the samples, else 0.

    Of draws, the mean is `share` if they are spread like the truth, less if they are nearer together, more if they are
    further apart. The distance of the truth to the samples' mean is compared with the `share`-quantile of the samples'
    distances. For few draws, a draw's distance is to the mean of the *other* draws, since the mean does not include
    the truth either (K/(K−1) times the distance to the mean of all), and the quantile is the value of rank share·(K+1),
    linear between ranks (Hyndman & Fan 1996, type 6: unbiased coverage). Forecasters deliver the single forecast as
    sample 0, which is nearer to the mean than a draw: with it the mean is 0.886 for 9 samples of the truth's spread,
    0.895 for 20. Modes with probabilities are no draws but the distribution itself: the mean is weighted, and the truth
    is inside if less than `share` of the probability is nearer to the mean. Their mean is not `share` where they are
    right: it depends on how unequal they are and on the spread around each, which counts in `mixture_coverage` alone.

    Args:
        forecast: sampled positions [m].
        future: true positions [m].
        valid: which entries count.
        share: share between 0 and 1. K draws give quantiles of rank 1 to K: if share·(K+1) is outside (one sample;
            fewer than 9 for 0.9), all entries are invalid.
        mode_probs: probability of each sample; None for draws.

    Raises:
        ValueError: `share` is not between 0 and 1.
    """
    if not 0 < share < 1:
        raise ValueError(f"share must be between 0 and 1, got {share}")
    samples = forecast.shape[1]
    if mode_probs is not None and samples > 1:
        centre = (mode_probs[..., None, None] * forecast).sum(1)
        apart = torch.linalg.vector_norm(future - centre, dim=-1)
        nearer = displacement(forecast, centre) < apart[:, None]
        return ((nearer * mode_probs[..., None]).sum(1) < share).to(future.dtype), valid
    rank = round(share * (samples + 1), 9)  # 0.7 · 10 is to be 7
    if samples < 2 or not 1 <= rank <= samples:
        return torch.zeros_like(future[..., 0]), torch.zeros_like(valid)
    centre = forecast.mean(dim=1)
    spread = displacement(forecast, centre).sort(dim=1).values * (samples / (samples - 1))
    below = min(int(rank), samples - 1)
    limit = torch.lerp(spread[:, below - 1], spread[:, below], rank - below)
    return (torch.linalg.vector_norm(future - centre, dim=-1) <= limit).to(future.dtype), valid


def mixture_coverage(
    forecast: Float[Tensor, "batch samples agents horizon axes"],
    future: Float[Tensor, "batch agents horizon axes"],
    valid: Bool[Tensor, "batch agents horizon"],
    mode_probs: Float[Tensor, "batch samples agents"],
    scale: Float[Tensor, "batch samples agents horizon axes"],
) -> tuple[Float[Tensor, "batch agents horizon"], Bool[Tensor, "batch agents horizon"]]:
    """Computes the share of the truth's coordinates in the central 90 % of the predicted mixture of Gaussians.

    A coordinate is inside if its predicted distribution has between 5 and 95 % of its probability below it. So a mode
    counts with its spread, which `coverage` leaves out.

    Args:
        forecast: mean of each mode [m].
        future: true positions [m].
        valid: which entries count.
        mode_probs: probability of each mode.
        scale: standard deviation of each mode [m].
    """
    error = (future[:, None] - forecast) / scale.clamp(min=LEAST_STD_M)
    below = (mode_probs[..., None, None] * torch.special.ndtr(error)).sum(1)
    inside = (below - 0.5).abs() <= COVERAGE_SHARE / 2
    return inside.to(future.dtype).mean(-1), valid


def overlap(
    positions: Float[Tensor, "batch samples agents horizon axes"],
    valid: Bool[Tensor, "batch agents horizon"],
    distance_m: float,
    mode_probs: Float[Tensor, "batch samples agents"] | None = None,
) -> tuple[Float[Tensor, "batch agents"], Bool[Tensor, "batch agents"]]:
    """Computes the share of an agent's steps at which another valid agent of its sample is nearer than `distance_m`.

    Args:
        positions: sampled positions [m].
        valid: which entries count.
        distance_m: distance of two centres below which agents overlap [m].
        mode_probs: probability of each sample; None for draws.
    """
    at_step = positions.transpose(2, 3)
    apart = torch.cdist(at_step, at_step, compute_mode="donot_use_mm_for_euclid_dist")
    there = valid.transpose(1, 2)[:, None]
    itself = torch.eye(positions.shape[2], dtype=torch.bool, device=positions.device)
    apart = apart.masked_fill(~(there[..., None] & there[..., None, :]) | itself, torch.inf)
    hit = (apart.min(-1).values < distance_m).transpose(2, 3).to(positions.dtype)
    share = hit.sum(-1) / valid.sum(-1).clamp(min=1)[:, None]
    return share.mean(1) if mode_probs is None else (share * mode_probs).sum(1), valid.any(-1)


def _mean_displacement(
    forecast: Float[Tensor, "batch samples agents horizon axes"],
    future: Float[Tensor, "batch agents horizon axes"],
    valid: Bool[Tensor, "batch agents horizon"],
) -> Float[Tensor, "batch samples agents"]:
    """Computes the mean displacement over valid steps [m]; 0 for an agent without one."""
    distance = torch.where(valid[:, None], displacement(forecast, future), 0.0)
    return distance.sum(-1) / valid.sum(-1).clamp(min=1)[:, None]
