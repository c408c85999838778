"""The dG-VAE's objective (paper Sec. IV, Loss): negative log-likelihood plus KL to the learned prior, with masks."""

import math
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

Likelihood = Literal["gaussian", "laplace"]


def nll(
    predicted: Float[Tensor, "*batch state"],
    target: Float[Tensor, "*batch state"],
    valid: Bool[Tensor, "*batch"],
    scales: Float[Tensor, " state"],
    variance: float,
    likelihood: Likelihood = "gaussian",
) -> Float[Tensor, ""]:
    """Negative log-likelihood at fixed variance, up to a constant: summed over features, mean over valid entries.

    Args:
        predicted: states [SI].
        target: true states [SI].
        valid: which entries count.
        scales: divisors that make features comparable; the variance is in these units.
        variance: σ of the paper (which uses it as a variance), 5e-5 there.
        likelihood: "gaussian" (paper) or "laplace" with the same variance, whose gradient does not grow with the error.
    """
    # masked before it is squared: the gradient of an infinite error is NaN, also times zero
    error = torch.where(valid[..., None], (predicted - target) / scales, 0.0)
    if likelihood == "gaussian":
        per_entry = error.square().sum(-1) / (2 * variance)
    else:
        per_entry = error.abs().sum(-1) / math.sqrt(variance / 2)
    return masked_mean(per_entry, valid)


def kl_categorical(
    posterior_logits: Float[Tensor, "*batch types"],
    prior_logits: Float[Tensor, "*batch types"],
    valid: Bool[Tensor, "*batch"],
) -> Float[Tensor, ""]:
    """KL(posterior ‖ prior) over edge types [nats], mean over valid pairs."""
    log_q = torch.log_softmax(posterior_logits, dim=-1)
    log_p = torch.log_softmax(prior_logits, dim=-1)
    return masked_mean((log_q.exp() * (log_q - log_p)).sum(-1), valid)


def masked_mean(values: Float[Tensor, "*batch"], valid: Bool[Tensor, "*batch"]) -> Float[Tensor, ""]:
    """Mean over valid entries; 0 if there is none."""
    # where, not a product: an invalid entry may be infinite, and inf · 0 is NaN.
    total = torch.where(valid, values, torch.zeros_like(values)).sum()
    return total / valid.sum().clamp(min=1)
