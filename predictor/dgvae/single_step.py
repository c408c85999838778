"""Single steps of the dG-VAE without gradients, used by streaming and roll-outs.

The stepper computes the function of the modules of `predictor.dgvae.networks` with fewer operations: only present
agents and pairs are computed (`predictor.dgvae.packing`), consecutive linear layers are folded into one, layers on one
input are one product, and everything edge-sized is done in place. The folded weights are a snapshot; `is_current`
returns whether the modules still have them.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.autograd import forward_ad
from torch.nn import functional

from predictor.dgvae.networks import NO_EDGE_LOGIT, Decoder, Edges, Encoder, no_edge_where_absent
from predictor.dgvae.packing import Packed, Padded
from predictor.dgvae.self_edges import SelfEdges
from predictor.layers.pairs import PairLinear, folded
from predictor.layers.rnn import elu, elu_, gru_step_, lstm_step_


class Past(NamedTuple):
    """Memory of the encoder; tensors with a time axis, or without one."""

    hidden: Tensor
    cell: Tensor
    static: Tensor  # pair matching: mean and count (no column if off)
    seen: Tensor  # the latest inputs and a 1 (no column if changes are no input)


class Encoding(NamedTuple):
    """Encoder outputs for several steps."""

    edges: Edges
    features: Tensor  # with the static dimensions averaged over the past of each step
    past: Past  # after each step


@runtime_checkable
class Layers(Protocol):
    """Interface of the networks in single steps; `graph` is `Padded` for the modules, `Packed` for the stepper."""

    def encode(self, inputs: Tensor, graph: Any, hidden: Tensor, cell: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Computes the memory of each pair after a step (hidden, cell), prior logits and features."""

    def feature_share(self, features: Tensor) -> Tensor:
        """Computes the share of each pair's features in its message."""

    def decode(
        self, inputs: Tensor, graph: Any, weights: Tensor, share: Tensor, node: Tensor, own: Tensor | None
    ) -> tuple[Tensor, Tensor | None]:
        """Computes GRU states after a step along weighted edges; and the messages, unless only the GRU needs them."""

    def messages(self, inputs: Tensor, graph: Any, weights: Tensor, share: Tensor, own: Tensor | None) -> Tensor:
        """Computes the sum of messages to each agent; `own` is the hidden layer of its message to itself."""


class Internal(NamedTuple):
    """Data of a belief from which it is rolled out."""

    layers: Layers
    graph: Padded | Packed  # of all that follows but states
    past: Past
    logits: Tensor
    probs: Tensor
    features: Tensor
    node_before: Tensor  # GRU state before the latest observation was decoded
    node_after: Tensor  # … and after, under the prior's expectation
    next_states: Tensor
    own: Tensor | None = None  # activated memory of each self-edge


@dataclass(frozen=True)
class Modules:
    """Computes single steps by the modules themselves."""

    encoder: Encoder
    decoder: Decoder
    self_edges: SelfEdges | None = None

    def encode(self, inputs: Tensor, graph: Any, hidden: Tensor, cell: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Computes the memory of each pair after a step (hidden, cell), prior logits and features."""
        edges: Edges = self.encoder(inputs[:, None], graph.present[:, None], hidden, cell, graph.senders)
        return edges.hidden[:, 0], edges.cell[:, 0], edges.prior_logits[:, 0], edges.features[:, 0]

    def feature_share(self, features: Tensor) -> Tensor:
        """Computes the share of each pair's features in its message."""
        return self.decoder.feature_share(features)

    def decode(
        self, inputs: Tensor, graph: Any, weights: Tensor, share: Tensor, node: Tensor, own: Tensor | None
    ) -> tuple[Tensor, Tensor | None]:
        """Computes GRU states after a step along weighted edges, and the messages."""
        messages = self.messages(inputs, graph, weights, share, own)
        return self.decoder.step(messages, node), messages

    def messages(self, inputs: Tensor, graph: Any, weights: Tensor, share: Tensor, own: Tensor | None) -> Tensor:
        """Computes the sum of messages to each agent along weighted edges, with its message to itself."""
        layer = self.decoder.pair_layer(inputs, share, graph.senders)
        summed = self.decoder.combine(inputs, layer, graph.present, weights)
        if self.self_edges is None or own is None:
            return summed
        total: Tensor = summed + self.self_edges.out(own)
        return total


def differentiable() -> bool:
    """Returns whether derivatives may be taken: autograd, forward mode or a transform of `torch.func` is on."""
    functional_transform: bool = torch._C._are_functorch_transforms_active()
    return torch.is_grad_enabled() or functional_transform or forward_ad._current_level >= 0


def unpacked(known: Internal, layers: Layers) -> Internal:
    """Returns the data of a belief for other layers, which take padded arrays."""
    graph = known.graph
    if isinstance(graph, Padded):
        return known
    hidden, cell, static, seen = known.past
    past = Past(graph.unpack_pairs(hidden), graph.unpack_pairs(cell), graph.unpack_pairs(static), seen)
    logits = no_edge_where_absent(graph.unpack_pairs(known.logits), graph.padded.present[..., None])
    probs, features = graph.unpack_pairs(known.probs, no_edge=True), graph.unpack_pairs(known.features)
    nodes = graph.unpack_nodes(known.node_before), graph.unpack_nodes(known.node_after)
    own = None if known.own is None else graph.unpack_nodes(known.own)
    return Internal(layers, graph.padded, past, logits, probs, features, *nodes, known.next_states, own)


Layer = tuple[Tensor, Tensor]
"""Weight (out, in) and bias (out)."""


# torch's own compiler takes this path for float32 layers on x86, where it is about twice as fast as the default one.
_ONEDNN = torch.backends.mkldnn.is_available() and hasattr(torch.ops.mkldnn, "_linear_pointwise")


# Products of this many multiplications or more are computed by oneDNN, which takes longer to start (10 to 70 µs).
_LARGE = 2**22


class Stepper:
    """Computes single steps of one network with folded weights.

    Args:
        encoder: encoder without innovation rounds and with dropout off.
        decoder: decoder of the network.
        self_edges: self-edges of the network, if it has any.
    """

    def __init__(self, encoder: Encoder, decoder: Decoder, self_edges: SelfEdges | None = None) -> None:
        """Folds the weights."""
        self._snapshot = _versions(encoder, decoder, self_edges)
        with torch.no_grad():
            self._take_encoder(encoder)
            self._take_decoder(decoder, None if self_edges is None else _layer(self_edges.out))

    def is_current(self, encoder: Encoder, decoder: Decoder, self_edges: SelfEdges | None = None) -> bool:
        """Returns whether these modules still have the weights that were folded.

        Changes that autograd does not count are not noticed: through `.data`, or by the replay of a CUDA graph.
        """
        return self._snapshot == _versions(encoder, decoder, self_edges)

    def encode(
        self,
        inputs: Float[Tensor, "listed inputs"],
        graph: Packed,
        hidden: Float[Tensor, "pairs rnn"],
        cell: Float[Tensor, "pairs rnn"],
    ) -> tuple[
        Float[Tensor, "pairs rnn"],
        Float[Tensor, "pairs rnn"],
        Float[Tensor, "pairs types"],
        Float[Tensor, "pairs feature"],
    ]:
        """Computes the memory of each pair after a step (hidden, cell), prior logits and features."""
        geometry = None if self._geometry is None else self._geometry(*graph.ends(inputs))
        summed = graph.gather(elu_(_spread(inputs, self._conv, graph, geometry, self._conv_geometry)))
        nodes = _product(summed, (self._conv_out[0], None))
        nodes = elu_(nodes.addcmul_(graph.counts, self._conv_out[1]))
        edges = elu_(_spread(nodes, self._edge, graph, geometry, self._edge_geometry))
        gates = _product(edges, self._gates, _product(hidden, self._recurrent))
        hidden, cell = lstm_step_(gates, cell)
        heads = elu_(_product(elu(hidden), self._heads))
        width = heads.shape[1] // (1 if self._features is None else 2)
        logits = _product(heads[:, :width], self._logits)
        if self._features is None:
            features = heads.new_zeros(len(heads), 0)
        else:
            features = _product(heads[:, width:], self._features)
        if graph.selves is not None:  # an agent's pair with itself is no edge between two
            logits.index_fill_(0, graph.selves, NO_EDGE_LOGIT)[:, 0].index_fill_(0, graph.selves, 0.0)
            features.index_fill_(0, graph.selves, 0.0)
        return hidden, cell, logits, features

    def feature_share(self, features: Float[Tensor, "pairs feature"]) -> Float[Tensor, "pairs _"]:
        """Computes the share of each pair's features in its message."""
        return features if self._feature is None else _product(features, self._feature)

    def decode(
        self,
        inputs: Float[Tensor, "listed *modes inputs"],
        graph: Packed,
        weights: Float[Tensor, "pairs ... types"],
        share: Float[Tensor, "pairs ... _"],
        node: Float[Tensor, "listed ... decoder"],
        own: Float[Tensor, "listed *more_modes message"] | None,
    ) -> tuple[Float[Tensor, "listed *more_modes decoder"], Float[Tensor, "listed *more_modes message"] | None]:
        """Computes GRU states after a step along weighted edges; and the messages, if substeps need them."""
        if self._to_gates is None:
            messages = self.messages(inputs, graph, weights, share, own)
            gates = _product(messages, self._gru)
        else:
            messages = None
            gates = self._along(inputs, graph, weights, share, own, *self._to_gates)
        return gru_step_(gates, _product(node, self._remembered), node), messages

    def messages(
        self,
        inputs: Float[Tensor, "listed *modes inputs"],
        graph: Packed,
        weights: Float[Tensor, "pairs ... types"],
        share: Float[Tensor, "pairs ... _"],
        own: Float[Tensor, "listed *more_modes message"] | None,
    ) -> Float[Tensor, "listed *more_modes message"]:
        """Computes the sum of messages to each agent along weighted edges, its own terms included."""
        return self._along(inputs, graph, weights, share, own, self._own, self._out, self._self_out)

    def _along(
        self,
        inputs: Tensor,
        graph: Packed,
        weights: Tensor,
        share: Tensor,
        own: Tensor | None,
        own_term: Layer,
        out: list[Layer],
        self_out: Layer | None,
    ) -> Tensor:
        geometry = None if self._geometry is None else self._geometry(*graph.ends(inputs))
        layer = _spread(inputs, self._message, graph, geometry, self._message_geometry)
        if self._feature is None:
            elu_(layer)
        elif self._gated:
            elu_(layer).mul_(share + 1)
        else:
            elu_(layer.add_(share))
        total = None if own is None or self_out is None else _product(own, self_out)
        total = _product(inputs, own_term, total)
        for k, (block, (matrix, bias)) in enumerate(zip(layer.chunk(len(out), -1), out, strict=True)):
            weight = weights[..., k + 1].flatten()  # the modes share it
            total = _product(graph.gather(block.contiguous(), weight), (matrix, None), total)
            total.addcmul_(graph.total(weight).view(-1, *[1] * (total.ndim - 1)), bias)
        return total

    def _take_encoder(self, encoder: Encoder) -> None:
        self._conv = _roles(encoder.conv_pair, encoder.embed)
        self._conv_out = _layer(encoder.conv_out)
        self._edge = _roles(encoder.edge_pair)
        self._geometry = encoder.geometry
        self._conv_geometry: Layer | None = None
        self._edge_geometry: Layer | None = None
        if encoder.geometry is not None:
            self._conv_geometry, self._edge_geometry = _layer(encoder.conv_geometry), _layer(encoder.edge_geometry)
        self._gates = folded(encoder.forward_input, encoder.edge_out)
        self._recurrent = (encoder.forward_hidden.weight.detach(), None)
        heads = [encoder.prior_head, encoder.feature_head] if encoder.config.edge_feature_dim else [encoder.prior_head]
        layers = [[_layer(part) for part in head if isinstance(part, nn.Linear)] for head in heads]
        self._heads = _beside(*(hidden for hidden, _ in layers))
        self._logits = layers[0][1]
        self._features = layers[1][1] if len(layers) > 1 else None

    def _take_decoder(self, decoder: Decoder, self_out: Layer | None) -> None:
        gru, types = decoder.gru, decoder.types
        self._message, self._gated = _roles(decoder.message_pair), decoder.gated
        self._message_geometry = None if decoder.geometry is None else _layer(decoder.message_geometry)
        self._feature = (decoder.message_feature.weight.detach(), None) if decoder.has_features else None
        self._own = _layer(decoder.own)
        parts = (t.detach().chunk(types) for t in (decoder.message_out.weight, decoder.message_out.bias))
        self._out: list[Layer] = list(zip(*parts, strict=True))
        self._gru = (gru.weight_ih.detach(), gru.bias_ih.detach())
        self._remembered = (gru.weight_hh.detach(), gru.bias_hh.detach())
        self._self_out = self_out
        self._to_gates: tuple[Layer, list[Layer], Layer | None] | None = None
        if not hasattr(decoder, "direct"):  # nothing but the GRU needs the messages
            weight, bias = self._gru
            own = (weight @ self._own[0], weight @ self._own[1] + bias)
            to_itself = None if self_out is None else (weight @ self_out[0], weight @ self_out[1])
            self._to_gates = (own, [(weight @ matrix, weight @ share) for matrix, share in self._out], to_itself)


def _versions(*modules: nn.Module | None) -> list[tuple[int, int]]:
    there = [part for part in modules if part is not None]
    parameters = (p for part in there for m in part.modules() for p in m._parameters.values() if p is not None)
    return [(p.data_ptr(), 0 if p.is_inference() else p._version) for p in parameters]


def _product(inputs: Tensor, layer: tuple[Tensor, Tensor | None], plus: Tensor | None = None) -> Tensor:
    """Computes a linear layer, plus `plus` (which may be overwritten, and may have more modes)."""
    weight, bias = layer
    if _ONEDNN and inputs.device.type == "cpu" and inputs.dtype is torch.float32:
        if inputs.shape[:-1].numel() * weight.numel() >= _LARGE:
            linear = torch.ops.mkldnn._linear_pointwise
            if plus is None:
                return linear(inputs, weight, bias, "none", [], "")
            if plus.shape[:-1] == inputs.shape[:-1]:
                return linear.binary(inputs, plus, weight, bias, "add")
    if plus is not None and bias is None and inputs.ndim == 2 and plus.shape[:-1] == inputs.shape[:-1]:
        return plus.addmm_(inputs, weight.t())
    product = functional.linear(inputs, weight, bias)
    return product if plus is None else plus.add_(product)


def _spread(
    nodes: Tensor, layer: Layer, graph: Packed, geometry: Tensor | None = None, geometry_layer: Layer | None = None
) -> Tensor:
    """Computes a `PairLinear` with one product instead of two, plus a layer on the pairs' geometry."""
    pairs = graph.spread(_product(nodes, layer))
    return pairs if geometry is None or geometry_layer is None else _product(geometry, geometry_layer, pairs)


def _roles(pair: PairLinear, after: nn.Linear | None = None) -> Layer:
    """Returns receiver's and sender's share of a `PairLinear` as one layer."""
    received, sent = (
        folded(role, after) if after is not None else _layer(role) for role in (pair.receiver, pair.sender)
    )
    if pair.relative:
        received = (received[0] - sent[0], received[1] - sent[1])
    return _beside(received, sent)


def _layer(linear: nn.Linear) -> Layer:
    bias = linear.bias if linear.bias is not None else linear.weight.new_zeros(linear.out_features)
    return linear.weight.detach(), bias.detach()


def _beside(*layers: Layer) -> Layer:
    """Joins layers on the same input into one."""
    return torch.cat([weight for weight, _ in layers]), torch.cat([bias for _, bias in layers])
