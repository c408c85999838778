"""Single steps of the dG-VAE without gradients: what streaming and roll-outs run.

The same function as the modules of `predictor.networks`, with fewer operations: linear layers in a row are folded into
one, layers on the same input are one product, and everything edge-sized is done in place. The folded weights are a
snapshot; `is_current` tells whether the modules have changed since.
"""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn import functional

from predictor.graph import PairLinear, folded, sum_over_senders, to_pairs
from predictor.networks import Decoder, Encoder, no_edge_where_absent
from predictor.recurrent import elu_, gru_step_, lstm_step_

Layer = tuple[Tensor, Tensor]
"""Weight (out, in) and bias (out)."""

# torch's own compiler takes this path for float32 layers on x86, where it is about twice as fast as the default one.
_ONEDNN = torch.backends.mkldnn.is_available() and hasattr(torch.ops.mkldnn, "_linear_pointwise")
# A product of this many multiplications or more is left to oneDNN, which takes longer to start.
_LARGE = 2**20


class Stepper:
    """The encoder and decoder of one network, ready for single steps.

    Args:
        encoder: without innovation rounds; its dropout is off.
        decoder: likewise.
    """

    def __init__(self, encoder: Encoder, decoder: Decoder) -> None:
        """Fold the weights."""
        modules = [m for part in (encoder, decoder) for m in part.modules()]
        self._weights = [m._parameters for m in modules if m._parameters]
        self._snapshot = self._versions()
        self._decoder = decoder
        with torch.no_grad():
            self._take_encoder(encoder)
            self._take_decoder(decoder)

    def is_current(self) -> bool:
        """Whether the modules still have the weights that were folded."""
        return self._snapshot == self._versions()

    def encode(
        self,
        inputs: Float[Tensor, "batch agents inputs"],
        present: Bool[Tensor, "batch agents slots"],
        senders: Int[Tensor, "*some agents slots"] | None,
        hidden: Float[Tensor, "batch agents slots rnn"],
        cell: Float[Tensor, "batch agents slots rnn"],
    ) -> tuple[
        Float[Tensor, "batch agents slots rnn"],
        Float[Tensor, "batch agents slots rnn"],
        Float[Tensor, "batch agents slots types"],
        Float[Tensor, "batch agents slots feature"],
    ]:
        """Memory of each pair after a step (hidden, cell), prior logits and features."""
        weight = present.to(inputs.dtype)
        summed = sum_over_senders(elu_(_spread(inputs, self._conv, senders)), weight)
        nodes = _product(summed, (self._conv_out[0], None)).addcmul_(weight.sum(-1, keepdim=True), self._conv_out[1])
        edges = elu_(_spread(elu_(nodes), self._edge, senders))
        gates = _product(hidden.reshape(-1, hidden.shape[-1]), self._recurrent)
        gates = _product(edges.flatten(0, 2), self._gates, gates)
        after, cell_after = lstm_step_(gates, cell.reshape(-1, cell.shape[-1]), weight.view(-1, 1))
        logits, features = self._read(after, weight.view(-1, 1))
        shape = (*present.shape, -1)
        logits = no_edge_where_absent(logits.view(shape), present[..., None])
        return after.view(shape), cell_after.view(shape), logits, features.view(*present.shape, features.shape[-1])

    def _read(self, hidden: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
        """Prior logits and features from pair memory."""
        heads = elu_(_product(elu_(hidden.clone()), self._heads))
        if self._features is None:
            return _product(heads, self._logits), heads.new_zeros(len(heads), 0)
        width = heads.shape[1] // 2
        return _product(heads[:, :width], self._logits), _product(heads[:, width:], self._features).mul_(weight)

    def drive(
        self,
        inputs: Float[Tensor, "batch agents inputs"],
        present: Bool[Tensor, "batch agents slots"],
        senders: Int[Tensor, "*some agents slots"] | None,
        weights: Float[Tensor, "batch agents slots types"],
        features: Float[Tensor, "batch agents slots feature"],
        valid: Bool[Tensor, "batch agents"],
        node: Float[Tensor, "batch agents decoder"],
    ) -> tuple[Float[Tensor, "batch agents decoder"], Float[Tensor, "batch agents message"] | None]:
        """GRU states after a step along a graph; and the messages, if substeps need them."""
        if self._own is None:
            messages = self._decoder.messages(inputs, present, weights, features, senders)
            return self._decoder.step(messages, valid, node), messages
        layer = self._message_layer(inputs, features, senders)
        gates = _product(inputs, self._own)
        for k, (block, (matrix, bias)) in enumerate(zip(layer.chunk(len(self._out), -1), self._out, strict=True)):
            weight = weights[..., k + 1] * present
            gates = _product(sum_over_senders(block, weight), (matrix, None), gates)
            gates.addcmul_(weight.sum(-1, keepdim=True), bias)
        flat = node.reshape(-1, node.shape[-1])
        after = gru_step_(gates.flatten(0, 1), _product(flat, self._remembered), flat)
        return after.view(node.shape).mul_(valid[..., None]), None

    def _message_layer(self, inputs: Tensor, features: Tensor, senders: Tensor | None) -> Tensor:
        layer = _spread(inputs, self._message, senders)
        if self._feature is None:
            return elu_(layer)
        if self._decoder.gated:
            return elu_(layer).mul_(functional.linear(features, self._feature).add_(1))
        layer.flatten(0, 2).addmm_(features.flatten(0, 2), self._feature.t())
        return elu_(layer)

    def _take_encoder(self, encoder: Encoder) -> None:
        self._conv = _roles(encoder.conv_pair, encoder.embed)
        self._conv_out = _layer(encoder.conv_out)
        self._edge = _roles(encoder.edge_pair)
        self._gates = folded(encoder.forward_input, encoder.edge_out)
        self._recurrent = (encoder.forward_hidden.weight.detach(), None)
        heads = [encoder.prior_head, encoder.feature_head] if encoder.config.edge_feature_dim else [encoder.prior_head]
        layers = [[_layer(part) for part in head if isinstance(part, nn.Linear)] for head in heads]
        self._heads = _beside(*(hidden for hidden, _ in layers))
        self._logits = layers[0][1]
        self._features = layers[1][1] if len(layers) > 1 else None

    def _take_decoder(self, decoder: Decoder) -> None:
        self._message = _roles(decoder.message_pair)
        self._feature = decoder.message_feature.weight.detach() if decoder.has_features else None
        gru = decoder.gru
        self._remembered = (gru.weight_hh.detach(), gru.bias_hh.detach())
        self._own: Layer | None = None
        if hasattr(decoder, "direct"):
            return  # substeps need the messages themselves
        weight, bias = gru.weight_ih, gru.bias_ih
        self._own = (weight @ decoder.own.weight, weight @ decoder.own.bias + bias)
        matrices, biases = (t.chunk(decoder.types) for t in (decoder.message_out.weight, decoder.message_out.bias))
        self._out = [(weight @ m, weight @ b) for m, b in zip(matrices, biases, strict=True)]

    def _versions(self) -> list[tuple[int, int]]:
        return [(p.data_ptr(), p._version) for owner in self._weights for p in owner.values() if p is not None]


def _product(rows: Tensor, layer: tuple[Tensor, Tensor | None], plus: Tensor | None = None) -> Tensor:
    """A linear layer, plus what is there already (which may be overwritten)."""
    weight, bias = layer
    if _ONEDNN and rows.device.type == "cpu" and rows.dtype is torch.float32:
        if rows.shape[:-1].numel() * weight.numel() >= _LARGE:
            linear = torch.ops.mkldnn._linear_pointwise
            if plus is None:
                return linear(rows, weight, bias, "none", [], "")
            return linear.binary(rows, plus, weight, bias, "add")
    product = functional.linear(rows, weight, bias)
    return product if plus is None else product.add_(plus)


def _spread(nodes: Tensor, layer: Layer, senders: Tensor | None) -> Tensor:
    """A `PairLinear` whose two products are one."""
    received, sent = _product(nodes, layer).chunk(2, dim=-1)
    if senders is None:
        return received[..., :, None, :] + sent[..., None, :, :]
    return to_pairs(sent, senders).add_(received[..., :, None, :])


def _roles(pair: PairLinear, after: nn.Linear | None = None) -> Layer:
    """Receiver's and sender's share of a `PairLinear`, one above the other."""
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
    """Layers on the same input as one."""
    return torch.cat([weight for weight, _ in layers]), torch.cat([bias for _, bias in layers])
