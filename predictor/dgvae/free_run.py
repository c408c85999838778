"""Roll-outs of a model without modes: predictions are encoded, so that edges evolve, or edges are kept ("frozen")."""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from predictor.dgvae.motion import Context, Motion
from predictor.dgvae.networks import edge_probabilities
from predictor.dgvae.packing import Packed, Padded
from predictor.dgvae.reading import Reading
from predictor.dgvae.single_step import Layers, Past
from predictor.what_if import with_ego


def free_run(
    reading: Reading,
    motion: Motion,
    layers: Layers,
    states: Tensor,
    valid: Tensor,
    graph: Padded | Packed,
    features: Tensor,
    past: Past,
    node: Tensor,
    logits: Tensor,
    horizon_steps: int,
    sampler: Callable[[Tensor], Tensor],
) -> Float[Tensor, "batch agents horizon state"]:
    """Rolls out from an observation before its decoder step, along edge types that `sampler` draws from logits."""
    drawn = graph.per_pair(sampler, logits)
    context = Context(graph, drawn, layers.feature_share(features))
    node, states = motion.step(layers, states, valid, context, node)
    return proceed(reading, motion, layers, states, valid, graph, past, node, (drawn, features), horizon_steps, sampler)


def proceed(
    reading: Reading,
    motion: Motion,
    layers: Layers,
    states: Tensor,
    valid: Tensor,
    graph: Padded | Packed,
    past: Past,
    node: Tensor,
    edges: tuple[Tensor, Tensor],
    horizon_steps: int,
    sampler: Callable[[Tensor], Tensor] | None,
    plan: Float[Tensor, "batch horizon state"] | None = None,
) -> Float[Tensor, "batch agents horizon state"]:
    """Rolls out from predicted states; without a sampler along edge probabilities.

    The observed pairs stay; `edges` are weights and features, kept if frozen. With a plan, agent 0 follows it.
    """
    states = states if plan is None else with_ego(states, plan[:, 0])
    future, (weights, features) = [states], edges
    context = Context(graph, weights, layers.feature_share(features))
    for step in range(1, horizon_steps):
        if reading.config.rollout_graph == "evolving":
            past, logits, features = reading.step(layers, states, valid, graph, past)
            weights = edge_probabilities(logits) if sampler is None else graph.per_pair(sampler, logits)
            context = Context(graph, weights, layers.feature_share(features))
        node, states = motion.step(layers, states, valid, context, node)
        states = states if plan is None else with_ego(states, plan[:, step])
        future.append(states)
    return torch.stack(future, dim=2)[:, :, :horizon_steps]
