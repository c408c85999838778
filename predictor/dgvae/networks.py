"""The dG-VAE's two networks (paper Sec. IV): the encoder of edges and the decoder of motion.

Both take one step or many at once; `predictor.dgvae.model` combines them. Linear layers on a concatenation of two
agents are computed per agent and added on the pair, and the last layer of an edge MLP is moved behind the sum over
senders; both are identities.
"""

from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn import functional

from predictor.dgvae.config import DGVAEConfig
from predictor.dgvae.geometry import Geometry
from predictor.dgvae.innovation import Innovation
from predictor.graph import self_pairs
from predictor.layers.pairs import PairLinear, ends, folded, sum_over_senders
from predictor.layers.rnn import Correction, full_precision, masked_lstm
from predictor.noise import NoiseOfPairs, uniform_like

NO_EDGE_LOGIT = -1e4
"""Logit of every type but "no edge" where there is no edge."""


class Edges(NamedTuple):
    """Encoder outputs for several steps; pairs as in the encoder's input."""

    hidden: Float[Tensor, "batch time agents slots rnn"]
    cell: Float[Tensor, "batch time agents slots rnn"]
    prior_logits: Float[Tensor, "batch time agents slots types"]
    features: Float[Tensor, "batch time agents slots feature"]
    hidden_layer: Float[Tensor, "batch time agents slots hidden"]
    """Hidden layer of the edge MLP; its second layer is folded into the gates."""


def concrete_sample(
    logits: Float[Tensor, "*batch types"],
    temperature: float,
    generator: NoiseOfPairs | None = None,
    hard: bool = False,
) -> Float[Tensor, "*batch types"]:
    """Draws a reparameterised sample of the concrete distribution (paper Sec. IV, Sampling).

    Args:
        logits: unnormalised log-probabilities.
        temperature: temperature; samples become one-hot as it approaches 0.
        generator: source of the Gumbel noise: a `PairNoise` with one generator per scene, or one generator for all.
        hard: whether samples are one-hot, with the gradient of the soft ones (straight-through).
    """
    if logits.dtype in (torch.bfloat16, torch.float16):
        logits = logits.float()  # rare types are drawn by the tails of the noise
    uniform = uniform_like(logits, generator)
    tiny = torch.finfo(logits.dtype).tiny
    gumbel = -torch.log(-torch.log(uniform.clamp(tiny, 1 - torch.finfo(logits.dtype).eps)))
    soft = edge_probabilities((logits + gumbel) / temperature)
    if not hard:
        return soft
    one_hot = torch.zeros_like(soft).scatter_(-1, soft.argmax(-1, keepdim=True), 1.0)
    return one_hot + (soft - soft.detach())


def _head(inputs: int, hidden: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(inputs, hidden), nn.ELU(), nn.Linear(hidden, outputs))


class Encoder(nn.Module):
    """Computes edge logits and features from states, step by step or for many steps at once."""

    def __init__(self, config: DGVAEConfig, inputs: int, geometry: Geometry | None = None) -> None:
        """Creates the layers, in the order in which data passes them."""
        super().__init__()
        self.config = config
        self.geometry = geometry
        width, rnn = config.hidden_dim, config.rnn_dim
        self.embed = nn.Linear(inputs, width)
        self.conv_pair = PairLinear(width, width, relative=True)
        self.conv_out = nn.Linear(width, width)
        self.edge_pair = PairLinear(width, width)
        self.edge_out = nn.Linear(width, width)
        if geometry is not None:
            self.conv_geometry = nn.Linear(geometry.num_features, width, bias=False)
            self.edge_geometry = nn.Linear(geometry.num_features, width, bias=False)
        self.forward_input = nn.Linear(width, 4 * rnn)
        self.forward_hidden = nn.Linear(rnn, 4 * rnn, bias=False)
        self.backward_input = nn.Linear(width, 4 * rnn)
        self.backward_hidden = nn.Linear(rnn, 4 * rnn, bias=False)
        for gates in (self.forward_input, self.backward_input):
            gates.bias.data[rnn : 2 * rnn] += config.forget_bias
        if config.innovation_rounds:
            self.innovation = Innovation(inputs, rnn, config.innovation_dim, config.innovation_rounds)
            self.innovation_gates = nn.Linear(rnn, 4 * rnn, bias=False)
        self.dropout = nn.Dropout(config.dropout)
        self.prior_head = _head(rnn, config.head_dim, config.num_edge_types)
        if config.edge_feature_dim:
            self.feature_head = _head(rnn, config.head_dim, config.edge_feature_dim)
        self.posterior_head = _head(2 * rnn, config.head_dim, config.num_edge_types)

    def embed_edges(
        self,
        inputs: Float[Tensor, "*batch agents inputs"],
        pairs: Bool[Tensor, "*batch agents slots"],
        senders: Int[Tensor, "*some agents slots"] | None = None,
    ) -> Float[Tensor, "*batch agents slots hidden"]:
        """Computes the graph block up to the hidden layer of the edge MLP, for all steps at once."""
        weight = pairs.to(inputs.dtype)
        to_conv = to_edge = None
        if self.geometry is not None:
            geometry = self.geometry(*ends(inputs, senders))
            to_conv, to_edge = self.conv_geometry(geometry), self.edge_geometry(geometry)
        summed = sum_over_senders(self.conv_pair.elu(inputs, senders, self.embed, to_conv), weight)
        # Σ_j (W h_ij + b) = W Σ_j h_ij + n b: the second layer of EdgeConv costs agents, not pairs.
        count = weight.sum(-1, keepdim=True)
        nodes = functional.elu(functional.linear(summed, self.conv_out.weight) + count * self.conv_out.bias)
        return self.edge_pair.elu(nodes, senders, extra=to_edge)

    def _gates(self, layer: nn.Linear, hidden: Tensor) -> Tensor:
        """Computes the input share of an LSTM's gates."""
        weight, bias = folded(layer, self.edge_out)
        return _time_first(lambda x: functional.linear(x, weight, bias), hidden)

    def forward(
        self,
        inputs: Float[Tensor, "batch time agents inputs"],
        pairs: Bool[Tensor, "batch time agents slots"],
        hidden: Float[Tensor, "batch agents slots rnn"],
        cell: Float[Tensor, "batch agents slots rnn"],
        senders: Int[Tensor, "*some agents slots"] | None = None,
    ) -> Edges:
        """Runs the forward LSTM from a given memory; the memory of an absent pair is set to zero."""
        hidden_layer = _time_first(lambda x, mask: self.embed_edges(x, mask, senders), inputs, pairs)
        between = self._between(pairs, senders)
        correct = self._correction(inputs, between) if self.config.innovation_rounds else None
        gates = self._gates(self.forward_input, hidden_layer)
        hiddens, cells = masked_lstm(gates, self.forward_hidden, pairs, hidden, cell, correct=correct)
        past = self.dropout(functional.elu(hiddens))
        present = between[..., None]
        if self.config.edge_feature_dim:
            features = _time_first(self.feature_head, past) * present
        else:
            features = past.new_zeros(*pairs.shape, 0)
        logits = no_edge_where_absent(self._types(self.prior_head, past), present)
        return Edges(hiddens, cells, logits, features, hidden_layer)

    def _between(self, pairs: Tensor, senders: Tensor | None) -> Tensor:
        """Returns the pairs of two agents: all but self-edges."""
        if not self.config.num_modes:
            return pairs
        own = self_pairs(pairs.shape[-2], senders, pairs.device)
        return pairs & ~(own if own.ndim == 2 else own[:, None])

    def _correction(self, inputs: Tensor, pairs: Tensor) -> Correction:
        regressors, targets = self.innovation.prepare(inputs, pairs)
        steps = list(zip(regressors.unbind(1), targets.unbind(1), strict=True))

        def gates(t: int, hidden: Tensor) -> Tensor:
            added: Tensor = self.innovation_gates(self.innovation(hidden, *steps[t]))
            return added

        return gates

    def posterior_logits(
        self,
        edges: Edges,
        pairs: Bool[Tensor, "batch time agents slots"],
        senders: Int[Tensor, "*some agents slots"] | None = None,
    ) -> Float[Tensor, "batch time agents slots types"]:
        """Computes the posterior logits, from past and future; training only."""
        zeros = torch.zeros_like(edges.hidden[:, 0])
        gates = self._gates(self.backward_input, edges.hidden_layer)
        backward, _ = masked_lstm(gates, self.backward_hidden, pairs, zeros, zeros, reverse=True)
        both = self.dropout(functional.elu(torch.cat([edges.hidden, backward], dim=-1)))
        between = self._between(pairs, senders)[..., None]
        return no_edge_where_absent(self._types(self.posterior_head, both), between)

    def _types(self, head: nn.Module, memory: Tensor) -> Tensor:
        """Computes the logits of a head."""
        logits = _time_first(head, memory)
        return (logits + logits.transpose(-2, -3)) / 2 if self.config.symmetric_types else logits


def _time_first(layer: Callable[..., Tensor], *tensors: Tensor) -> Tensor:
    """Applies a layer with time before batch, which is the LSTMs' layout in memory, so that nothing is copied."""
    return layer(*(t.transpose(0, 1) for t in tensors)).transpose(0, 1)


def edge_probabilities(logits: Float[Tensor, "*batch types"]) -> Float[Tensor, "*batch types"]:
    """Computes the softmax over edge types; for two types as a logistic function, several times faster on a CPU."""
    if logits.shape[-1] != 2:
        return torch.softmax(logits, dim=-1)
    edge = torch.sigmoid(logits[..., 1] - logits[..., 0])
    return torch.stack([1 - edge, edge], dim=-1)


def no_edge_where_absent(
    logits: Float[Tensor, "*batch types"], present: Bool[Tensor, "*batch 1"]
) -> Float[Tensor, "*batch types"]:
    """Returns the logits with certainty of "no edge" for absent pairs."""
    absent = torch.full_like(logits, NO_EDGE_LOGIT)
    absent[..., 0] = 0.0
    return torch.where(present, logits, absent)


class Decoder(nn.Module):
    """Computes changes of state from messages along edges."""

    def __init__(self, config: DGVAEConfig, inputs: int, outputs: int, geometry: Geometry | None = None) -> None:
        """Creates the layers, in the order in which data passes them."""
        super().__init__()
        self.geometry = geometry
        self.types = config.num_edge_types - 1  # type 0 sends no message
        self.gated = config.gated_messages
        width = config.message_dim
        self.message_pair = PairLinear(inputs, self.types * width)
        if geometry is not None:
            self.message_geometry = nn.Linear(geometry.num_features, self.types * width, bias=False)
        if config.edge_feature_dim:
            self.message_feature = nn.Linear(config.edge_feature_dim, self.types * width, bias=False)
        self.message_out = nn.Linear(width, self.types * width)  # one block for each type that sends messages
        self.own = nn.Linear(inputs, width)
        self.gru = nn.GRUCell(width, config.decoder_dim)
        self.readout = nn.Linear(config.decoder_dim, outputs)
        if config.substeps:
            self.direct = nn.Linear(width, outputs, bias=False)
        self.has_features = config.edge_feature_dim > 0
        if config.zero_start:
            for parameter in (*self.readout.parameters(), *(self.direct.parameters() if config.substeps else ())):
                nn.init.zeros_(parameter)

    def messages(
        self,
        inputs: Float[Tensor, "*batch agents inputs"],
        pairs: Bool[Tensor, "*batch agents slots"],
        weights: Float[Tensor, "*batch agents slots types"],
        features: Float[Tensor, "*batch agents slots feature"],
        senders: Int[Tensor, "*some agents slots"] | None = None,
    ) -> Float[Tensor, "*batch agents message"]:
        """Computes Σ_j z_ij · h(x_i ‖ x_j ‖ e_ij) plus the agent's own term, for all steps at once."""
        return self.combine(inputs, self.pair_layer(inputs, self.feature_share(features), senders), pairs, weights)

    def feature_share(
        self, features: Float[Tensor, "*batch agents slots feature"]
    ) -> Float[Tensor, "*batch agents slots hidden"]:
        """Computes the share of edge features in `pair_layer`; computed once where features are held."""
        share: Tensor = self.message_feature(features) if self.has_features else features
        return share

    def pair_layer(
        self,
        inputs: Float[Tensor, "*batch agents inputs"],
        share: Float[Tensor, "*#batch agents slots _"],
        senders: Int[Tensor, "*some agents slots"] | None = None,
    ) -> Float[Tensor, "*batch agents slots hidden"]:
        """Computes the hidden layer of h, one block for each type that sends messages; independent of edge weights.

        Args:
            inputs: inputs of each agent.
            share: result of `feature_share`.
            senders: index of the agent in each slot; None is dense.
        """
        extra = None
        if self.geometry is not None:
            extra = self.message_geometry(self.geometry(*ends(inputs, senders)))
        if self.has_features and not self.gated:
            extra = share if extra is None else extra + share
        layer = self.message_pair.elu(inputs, senders, extra=extra)
        return layer * (1 + share) if self.has_features and self.gated else layer

    def combine(
        self,
        inputs: Float[Tensor, "*batch agents inputs"],
        layer: Float[Tensor, "*batch agents slots hidden"],
        pairs: Bool[Tensor, "*#batch agents slots"],
        weights: Float[Tensor, "*#batch agents slots types"],
    ) -> Float[Tensor, "*batch agents message"]:
        """Computes messages from the result of `pair_layer`, weighted by the edges' types."""
        total: Tensor = self.own(inputs)
        blocks = zip(
            layer.chunk(self.types, dim=-1),
            self.message_out.weight.chunk(self.types),
            self.message_out.bias.chunk(self.types),
            strict=True,
        )
        for k, (layer_k, matrix, bias) in enumerate(blocks):
            weight = weights[..., k + 1] * pairs
            # Σ_j z_ij (W h_ij + b) = W Σ_j z_ij h_ij + b Σ_j z_ij: the second layer costs agents, not pairs.
            summed = functional.linear(sum_over_senders(layer_k, weight), matrix)
            total = total + summed + weight.sum(-1, keepdim=True) * bias
        return total

    def step(
        self,
        messages: Float[Tensor, "*batch agents message"],
        hidden: Float[Tensor, "*#batch agents decoder"],
    ) -> Float[Tensor, "*batch agents decoder"]:
        """Computes one GRU step for every agent."""
        width, axes = hidden.shape[-1], messages.shape[:-1]
        inputs = messages.flatten(0, -2).to(hidden.dtype)
        with full_precision(inputs.device):
            after: Tensor = self.gru(inputs, hidden.expand(*axes, width).flatten(0, -2))
        return after.unflatten(0, axes)

    def change(self, hidden: Float[Tensor, "*batch decoder"]) -> Float[Tensor, "*batch state"]:
        """Computes the change of state, in units of `delta_scales`."""
        change: Tensor = self.readout(functional.elu(hidden))
        return change
