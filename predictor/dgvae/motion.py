"""One step of motion: messages to each agent, its memory after them, and its next state."""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from predictor.dgvae.networks import Decoder
from predictor.dgvae.packing import Packed, Padded
from predictor.dgvae.self_edges import HeldType, SelfEdges
from predictor.dgvae.single_step import Layers
from predictor.layers.state_codec import StateCodec
from predictor.what_if import with_ego


class Context(NamedTuple):
    """What a step of motion needs besides states and memory; a roll-out may hold it."""

    graph: Padded | Packed
    weights: Tensor
    """Weight of each edge type, for each pair."""
    share: Tensor
    """Share of the edge features in messages, for each pair (`Layers.feature_share`)."""
    held: HeldType | None = None
    """Types of the self-edges; None for a model without any."""


@dataclass(frozen=True)
class Motion:
    """Moves agents along weighted edges.

    Roll-outs of modes have an axis for them, as in `predictor.dgvae.packing`; the first step may come with length 1
    there, and is then computed once as far as the modes agree.
    """

    codec: StateCodec
    decoder: Decoder
    self_edges: SelfEdges | None
    substeps: int

    def step(
        self, layers: Layers, states: Tensor, valid: Tensor, context: Context, node: Tensor
    ) -> tuple[Tensor, Float[Tensor, "batch *modes agents state"]]:
        """Computes one decoder step: GRU states after it, and the next states."""
        graph = context.graph
        inputs = graph.pack_nodes(self.codec.inputs(states, valid))
        own = self.own_layer(inputs, context)
        node, messages = layers.decode(inputs, graph, context.weights, context.share, node, own)
        node = graph.forget_absent(node, valid)
        change = graph.unpack_nodes(self.decoder.change(node))
        return node, self.integrate(layers, states, valid, context, change, messages)

    def own_layer(self, inputs: Tensor, context: Context) -> Tensor | None:
        """Computes the hidden layer of each agent's message to itself; None for a model without self-edges."""
        if self.self_edges is None or context.held is None:
            return None
        return self.self_edges.layer(inputs, context.held)

    def integrate(
        self,
        layers: Layers,
        states: Tensor,
        valid: Tensor,
        context: Context,
        change: Tensor,
        messages: Tensor | None,
    ) -> Float[Tensor, "*batch agents state"]:
        """Computes the states one step later; with substeps, messages are evaluated again as the agents move."""
        if not self.substeps:
            return self.codec.advance(states, change)
        assert messages is not None
        graph = context.graph
        for substep in range(self.substeps):
            if substep:
                inputs = graph.pack_nodes(self.codec.inputs(states, valid))
                own = self.own_layer(inputs, context)
                messages = layers.messages(inputs, graph, context.weights, context.share, own)
            pushed = graph.unpack_nodes(self.decoder.direct(messages))
            states = self.codec.advance(states, change + pushed, 1 / self.substeps)
        return states

    def held_run(
        self,
        layers: Layers,
        states: Tensor,
        valid: Tensor,
        context: Context,
        node: Tensor,
        horizon_steps: int,
        plan: Float[Tensor, "batch modes horizon state"] | None = None,
    ) -> tuple[Float[Tensor, "batch *modes agents horizon state"], Float[Tensor, "batch *modes agents horizon axes"]]:
        """Rolls out along held types while the context stays as it is; returns states and growth of their spread.

        With plans, one for each mode, agent 0 follows them.
        """
        assert self.self_edges is not None and context.held is not None
        future, growth = [], []
        for step in range(horizon_steps):
            node, states = self.step(layers, states, valid, context, node)
            states = states if plan is None else with_ego(states, plan[..., step, :])
            future.append(states)
            growth.append(context.graph.unpack_nodes(self.self_edges.growth(node, context.held)))
        if not future:
            nothing = states[..., None, :][..., :0, :]
            return nothing, nothing[..., : self.codec.spec.position_dim]
        return torch.stack(future, dim=-2), torch.stack(growth, dim=-2)

    def spread(self, growth: Float[Tensor, "*batch horizon axes"]) -> Float[Tensor, "*batch horizon axes"]:
        """Computes the standard deviation of the position at each step [m] from its growth in each."""
        return growth.cumsum(-2) * self.codec.deltas[: self.codec.spec.position_dim]
