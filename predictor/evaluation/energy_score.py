"""The energy score: a proper score of sampled futures, which rewards samples that spread as the truth does.

It is the expected distance of a sample to the truth, minus half the expected distance between two samples. Its mean is
lowest if the samples have the distribution of the truth (Gneiting & Raftery 2007), whereas best-of-K errors are lowest
for samples that spread more, and single errors for samples that do not spread. For a single sample it is the distance.
Modes with probabilities are a distribution; K draws are taken for one, whose best spread is a little below the truth's.
"""

from collections.abc import Callable

import torch
from jaxtyping import Bool, Float
from torch import Tensor


def energy_score(
    forecast: Float[Tensor, "batch samples agents horizon axes"],
    future: Float[Tensor, "batch agents horizon axes"],
    valid: Bool[Tensor, "batch agents horizon"],
    mode_probs: Float[Tensor, "batch samples agents"] | None = None,
) -> tuple[Float[Tensor, "batch agents"], Bool[Tensor, "batch agents"]]:
    """Computes the energy score of each agent's samples [m]; the distance of two futures is their mean displacement.

    Args:
        forecast: sampled positions [m].
        future: true positions [m].
        valid: which entries count.
        mode_probs: probability of each sample; None if all are equally likely.
    """
    count = valid.sum(-1).clamp(min=1)

    def distance(first: Tensor, second: Tensor) -> Tensor:
        step = torch.linalg.vector_norm(first - second, dim=-1)
        return torch.where(valid[:, None], step, 0.0).sum(-1) / count[:, None]

    return weighted_score(forecast, future, mode_probs, distance), valid.any(-1)


def weighted_score(
    samples: Float[Tensor, "batch samples ..."],
    truth: Float[Tensor, "batch ..."],
    probs: Float[Tensor, "batch samples ..."] | None,
    distance: Callable[[Tensor, Tensor], Tensor],
) -> Float[Tensor, "batch ..."]:
    """Computes Σ_k p_k d(s_k, x) − Σ_{k<l} p_k p_l d(s_k, s_l).

    Args:
        samples: sampled events.
        truth: true event.
        probs: probability of each sample; None if all are equally likely.
        distance: function of two events [batch some *event] that returns distances [batch some *units].
    """
    count = samples.shape[1]
    to_truth = distance(samples, truth[:, None])
    if probs is None:
        probs = torch.full_like(to_truth, 1 / count)
    score = (probs * to_truth).sum(1)
    # one row of pairs at a time: all at once would need memory for the square of the samples
    for k in range(count - 1):
        between = distance(samples[:, k : k + 1], samples[:, k + 1 :])
        score = score - (probs[:, k : k + 1] * probs[:, k + 1 :] * between).sum(1)
    return score
