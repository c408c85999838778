"""What is minimised for a model with modes: energy scores of agents and of scenes, and the likelihood of the spread.

The modes are all enumerated, so the energy score is exact and differentiable in their positions and probabilities: it
draws modes to the truth and apart from each other, as much as the truth varies. Mode 0 has a likelihood of its own
(`predictor.training.objective`); here its position is a constant, so it does not pay for the spread.
"""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from predictor.evaluation.displacement import mixture_nll
from predictor.evaluation.energy_score import weighted_score
from predictor.forecaster import Futures
from predictor.layers.pairs import Total, masked_mean, of_one_process

REST_SHARE = 0.5
"""Weight of the features beyond position in a distance, relative to the position's."""
_TINY = 1e-10  # under a square root: its derivative at 0 is infinite


def energy_terms(
    modes: Futures,
    truth: Float[Tensor, "batch agents horizon state"],
    valid: Bool[Tensor, "batch agents horizon"],
    scales: Float[Tensor, " state"],
    axes: int,
    weights: Float[Tensor, "batch agents"] | float = 1.0,
    total: Total = of_one_process,
) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
    """Computes the energy score of agents (mean over agents) and of scenes (mean over scenes and steps).

    The distance of two futures of an agent is the mean over valid steps of the distance of their positions plus half
    that of their other features. The distance of two scenes at a step is the root of the sum over agents of squared
    distances of positions of the agents that are there, divided by the root of the number of agents that are there at
    any step; a scene's probability is the mean of its agents'.

    Args:
        modes: enumerated futures.
        truth: true states [SI].
        valid: which entries count.
        scales: divisors that make features comparable.
        axes: number of axes of a position.
        weights: factors of the agents' scores.
        total: sums counts over all processes.
    """
    assert modes.mode_probs is not None
    samples = torch.cat([modes.states[:, :1].detach(), modes.states[:, 1:]], dim=1) / scales
    samples = torch.where(valid[:, None, :, :, None], samples, 0.0)
    target = torch.where(valid[..., None], truth / scales, 0.0)
    steps, there = valid.sum(-1).clamp(min=1), valid.any(-1)

    def apart(first: Tensor, second: Tensor) -> Tensor:
        squared = (first - second).square()
        position, rest = ((part.sum(-1) + _TINY).sqrt() for part in (squared[..., :axes], squared[..., axes:]))
        moved = position + REST_SHARE * rest
        return torch.where(valid[:, None], moved, 0.0).sum(-1) / steps[:, None]

    agents = masked_mean(weighted_score(samples, target, modes.mode_probs, apart) * weights, there, total)

    present = there[:, None].to(samples.dtype)
    count = present.sum(-1).clamp(min=1)

    def scenes_apart(first: Tensor, second: Tensor) -> Tensor:
        squared = (first - second)[..., :axes].square().sum((2, 4))
        return (squared + _TINY).sqrt() / count[..., None].sqrt()

    of_scenes = (modes.mode_probs * present).sum(-1) / count
    score = weighted_score(samples, target, of_scenes[..., None].expand(-1, -1, valid.shape[-1]), scenes_apart)
    return agents, masked_mean(score, valid.any(1), total)


def spread_nll(
    modes: Futures,
    truth: Float[Tensor, "batch agents horizon state"],
    valid: Bool[Tensor, "batch agents horizon"],
    axes: int,
    total: Total = of_one_process,
) -> Float[Tensor, ""]:
    """Computes the negative log-likelihood [nats] under the mixture of modes at each step; it trains the spread alone.

    The single forecast has a term of its own, since it is also shown alone.
    """
    assert modes.scale is not None and modes.mode_probs is not None
    positions, target = modes.states[..., :axes].detach(), truth[..., :axes]
    mixture, _ = mixture_nll(positions, target, valid, modes.mode_probs.detach(), modes.scale)
    alone, _ = mixture_nll(
        positions[:, :1], target, valid, torch.ones_like(modes.mode_probs[:, :1]), modes.scale[:, :1]
    )
    return masked_mean(mixture + alone, valid, total)


def unit(variance: float) -> float:
    """Returns the factor that brings scaled distances to the unit of the Laplace likelihood with this variance."""
    return 1 / math.sqrt(variance / 2)
