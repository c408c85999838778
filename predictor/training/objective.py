"""Training objective: likelihoods of one step and of a roll-out, KL to the prior, labels, cost of edges."""

import math
from typing import Any, get_args

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from predictor.data.causal_edges import STRENGTH
from predictor.data.windows import WindowBatch
from predictor.evaluation.graph_accuracy import edge_entropy
from predictor.forecaster import Futures, TrainableForecaster, WindowOutput
from predictor.graph import pair_mask
from predictor.layers.pairs import Total, masked_mean, of_one_process
from predictor.support.config_checks import check_choice
from predictor.training.config import Likelihood, TrainConfig
from predictor.training.mode_loss import energy_terms, spread_nll, unit


def nll(
    predicted: Float[Tensor, "*batch state"],
    target: Float[Tensor, "*batch state"],
    valid: Bool[Tensor, "*batch"],
    scales: Float[Tensor, " state"],
    variance: float,
    likelihood: Likelihood = "gaussian",
    weights: Float[Tensor, "*#batch"] | float = 1.0,
    total: Total = of_one_process,
) -> Float[Tensor, ""]:
    """Computes the negative log-likelihood at fixed variance, up to a constant: sum of features, mean of valid entries.

    Args:
        predicted: predicted states [SI].
        target: true states [SI].
        valid: which entries count.
        scales: divisors that make features comparable; the variance is in these units.
        variance: variance of the likelihood; σ in the paper (which uses it as a variance), 5e-5 there.
        likelihood: "gaussian" (paper) or "laplace" with the same variance, whose gradient does not grow with the error.
        weights: factors of the entries.
        total: sums counts over all processes (`predictor.layers.pairs.masked_mean`).

    Raises:
        UserError: the likelihood has another name.
    """
    check_choice("likelihood", likelihood, get_args(Likelihood))
    # masked before it is squared: the gradient of an infinite error is NaN, also times zero
    error = torch.where(valid[..., None], (predicted - target) / scales, 0.0)
    if likelihood == "gaussian":
        per_entry = error.square().sum(-1) / (2 * variance)
    else:
        per_entry = error.abs().sum(-1) / math.sqrt(variance / 2)
    return masked_mean(per_entry * weights, valid, total)


def kl_categorical(
    posterior_logits: Float[Tensor, "*batch types"],
    prior_logits: Float[Tensor, "*batch types"],
    valid: Bool[Tensor, "*batch"],
    total: Total = of_one_process,
) -> Float[Tensor, ""]:
    """Computes KL(posterior ‖ prior) over edge types [nats], mean over valid pairs."""
    log_q = torch.log_softmax(posterior_logits, dim=-1)
    log_p = torch.log_softmax(prior_logits, dim=-1)
    return masked_mean((log_q.exp() * (log_q - log_p)).sum(-1), valid, total)


Terms = dict[str, Tensor]


def window_loss(
    model: TrainableForecaster,
    batch: WindowBatch,
    output: WindowOutput,
    config: TrainConfig,
    kl_scale: float | Float[Tensor, ""] = 1.0,
    scales: Float[Tensor, " state"] | None = None,
    total: Total = of_one_process,
) -> tuple[Float[Tensor, ""], Terms]:
    """Computes the objective and its terms for one batch of windows.

    Args:
        model: source of the spec.
        batch: windows.
        output: the model's output for them.
        config: weights of the terms.
        kl_scale: share of the KL's full weight (warm-up).
        scales: the spec's feature scales on the batch's device; None copies them there, which a captured step cannot.
        total: sums counts over all processes; loss and terms are then this process's shares.
    """
    if scales is None:
        scales = torch.tensor(model.spec.feature_scales, device=batch.states.device)
    windows = torch.arange(len(batch.states), device=batch.states.device)[:, None]
    both = batch.valid[:, 1:] & batch.valid[:, :-1]
    terms: Terms = {}
    one_step = nll(
        output.one_step[:, :-1], batch.states[:, 1:], both, scales, config.variance, config.likelihood, total=total
    )
    loss = config.one_step_weight * one_step
    terms["nll_one_step"] = one_step
    horizon = output.rollout.shape[2]
    if horizon:
        steps = batch.last_observed[:, None] + torch.arange(1, horizon + 1, device=windows.device)
        truth = batch.states[windows, steps].transpose(1, 2)
        valid = batch.valid[windows, steps].transpose(1, 2)
        weights = reaction_weights(batch, config.reaction_weight, model.spec.has_ego, total)
        rollout = nll(
            output.rollout, truth, valid, scales, config.variance, config.likelihood, weights[..., None], total
        )
        loss = loss + config.rollout_weight * rollout
        terms["nll_rollout"] = rollout
        if output.modes is not None:
            extra, mode_terms = _mode_loss(
                model.spec.position_dim, output.modes, truth, valid, scales, weights, config, total
            )
            loss = loss + extra
            terms |= mode_terms
    if output.prior_logits is not None:
        extra, graph_terms = _graph_loss(model, batch, output, config, kl_scale, total)
        loss = loss + extra
        terms |= graph_terms
    return loss, {k: v.detach() for k, v in terms.items()}


def reaction_weights(
    batch: WindowBatch, weight: float, has_ego: bool, total: Total = of_one_process
) -> Float[Tensor, "batch agents"]:
    """Computes a factor for each agent: 1 plus `weight` times the strength of the causal edges to it, over its mean.

    Edges count whose causal label is that of the last observed step: in branches, those from an agent whose
    intervention is the last thing that was observed, so that its receivers react; in undisturbed episodes with labels,
    those to agents that would react. Of an agent that has just left, taken out or not, the edges are those of the step
    before. The edges to an ego do not count: they are those of a driver in its place, not of the policy whose motion
    was recorded.

    Args:
        batch: windows; their edges are causal ones, if they have any attributes.
        weight: weight of a strength of 1; 0 gives 1 for all.
        has_ego: whether the first agent is an ego.
        total: sums over all processes.
    """
    rows = torch.arange(len(batch.valid), device=batch.valid.device)
    visible = batch.valid[rows, batch.last_observed]
    factors = torch.ones_like(visible, dtype=batch.states.dtype)
    if not weight or batch.edge_attributes is None or batch.edge_types is None:
        return factors
    before = (batch.last_observed - 1).clamp(min=0)
    gone = batch.valid[rows, before] & ~visible
    strength = torch.zeros_like(factors)
    for step, senders in ((batch.last_observed, visible), (before, gone)):
        is_edge = (batch.edge_types[rows, step] > 0) & senders[:, None]
        found = torch.where(is_edge, batch.edge_attributes[rows, step][..., STRENGTH], 0.0)
        strength = torch.maximum(strength, found.amax(-1))
    if has_ego:
        strength[:, 0] = 0.0
    factors = factors + weight * strength
    return factors / total(masked_mean(factors, visible, total))


def _mode_loss(
    axes: int,
    modes: Futures,
    truth: Tensor,
    valid: Tensor,
    scales: Tensor,
    weights: Tensor,
    config: TrainConfig,
    total: Total,
) -> tuple[Tensor, Terms]:
    scale = unit(config.variance)
    agents, scenes = (scale * term for term in energy_terms(modes, truth, valid, scales, axes, weights, total))
    spread = spread_nll(modes, truth, valid, axes, total)
    loss = config.energy_weight * agents + config.joint_energy_weight * scenes + spread
    return loss, {"energy": agents, "joint_energy": scenes, "nll_spread": spread}


def _graph_loss(
    model: Any,
    batch: WindowBatch,
    output: WindowOutput,
    config: TrainConfig,
    kl_scale: float | Tensor,
    total: Total,
) -> tuple[Tensor, Terms]:
    assert output.prior_logits is not None and output.posterior_logits is not None
    prior, posterior = output.prior_logits, output.posterior_logits
    pairs = pair_mask(batch.valid) if output.pairs is None else output.pairs
    kl = kl_categorical(posterior, prior, pairs, total)
    probs = torch.softmax(prior, dim=-1)
    terms: Terms = {
        "kl": kl,
        "prior_entropy": masked_mean(*edge_entropy(probs.detach(), pairs), total),
        "prior_edge_share": masked_mean(1 - probs.detach()[..., 0], pairs, total),
    }
    loss = config.kl_weight * kl_scale * kl
    if config.edge_cost:
        both = ((1 - probs[..., 0]), 1 - torch.softmax(posterior, -1)[..., 0])
        edges = masked_mean(both[0], pairs, total) + masked_mean(both[1], pairs, total)
        loss = loss + config.edge_cost * edges
    if batch.edge_types is not None:
        known = pairs & (batch.edge_types >= 0)
        # 0 is "no edge"; all other types count as an edge where the model has fewer types than the labels
        truth = batch.edge_types.long().clamp(0, prior.shape[-1] - 1)
        terms["graph_accuracy"] = masked_mean((prior.detach().argmax(-1) == truth).float(), known, total)
        if config.type_label_weight:
            labelled = _cross_entropy(prior, truth, known, total) + _cross_entropy(posterior, truth, known, total)
            loss = loss + config.type_label_weight * labelled
            terms["type_label"] = labelled
    if config.label_weight and batch.edge_attributes is not None and output.features is not None:
        # causal attributes say themselves where they are known, others are known on edges
        labelled = pairs
        if batch.edge_types is not None and not config.causal_edges:
            labelled = pairs & (batch.edge_types > 0)
        label = restricted_labelling(output.features, model.config.in_units(batch.edge_attributes), labelled, total)
        loss = loss + config.label_weight * label
        terms["label"] = label
    return loss, terms


def _cross_entropy(logits: Tensor, truth: Tensor, known: Tensor, total: Total) -> Tensor:
    log_probs = functional.log_softmax(logits, dim=-1)
    return masked_mean(-log_probs.gather(-1, truth[..., None])[..., 0], known, total)


def restricted_labelling(
    features: Float[Tensor, "batch time agents agents feature"],
    attributes: Float[Tensor, "batch time agents agents attributes"],
    labelled: Bool[Tensor, "batch time agents agents"],
    total: Total = of_one_process,
) -> Float[Tensor, ""]:
    """Computes the mean squared error of the first feature dimensions against known edge attributes.

    Each attribute has a mean of its own, so that those that few pairs have count as much.

    Args:
        features: edge features from the past; as many of the first dimensions are used as there are attributes.
        attributes: true values; NaN where one is unknown, arbitrary where a pair has no label.
        labelled: mask of pairs whose attributes are known.
        total: sums counts over all processes.
    """
    known = labelled[..., None] & ~attributes.isnan()
    # masked before it is squared: the gradient of an infinite error is NaN, also times zero
    error = torch.where(known, features[..., : attributes.shape[-1]] - attributes, 0.0).square()
    means = [masked_mean(error[..., i], known[..., i], total) for i in range(attributes.shape[-1])]
    return torch.stack(means).mean()
