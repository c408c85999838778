"""IMMA (Sun et al., "Interaction Modeling with Multiplex Attention", NeurIPS 2022) in streaming form.

A multiplex graph: several layers of soft edges, each with its own encoder and attention that sums to one over an
agent's senders. The decoder sends one kind of message per layer, weighted by attention, and is otherwise NRI's.
Forecasts are deterministic.

The public code flattens 24 observed steps of a fixed number of agents into the encoder's input, decodes from an empty
memory, and the decoder's input is its own output layer. Here the encoder embeds each frame and an LSTM per pair keeps
its history, so that histories may have any length and agents may come and go; the decoder's inputs are states, observed
ones and then predicted ones. As there, edge weights are constant while forecasting (`dynamic_graph=True` infers them
anew). Messages are not divided by the width of the hidden state, as there and in NRI, where an average is meant.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from predictor.baselines.base import Encoded, Tensors, UnrolledForecaster, check_sizes
from predictor.baselines.nri_blocks import FrameEncoder, HiddenDecoder, PairLSTM
from predictor.graph import pair_mask
from predictor.layers.state_codec import Residual
from predictor.scene import SceneSpec
from predictor.support.config_checks import MOST_PARTS, check_at_most


@dataclass(frozen=True)
class IMMAConfig:
    """Sizes of the network; the widths are those of the public basketball run."""

    hidden_dim: int = 256
    """Width of each layer's frame embedding."""
    rnn_dim: int = 64
    """Width of each layer's LSTM of a pair; the public code has none."""
    decoder_dim: int = 256
    """Width of the memory of each agent."""
    message_dim: int = 256
    """Width of the decoder's messages."""
    num_layers: int = 2
    """Number of layers of the multiplex graph (public code: 2 by default, 5 for basketball)."""
    dynamic_graph: bool = False
    """Whether attention is inferred anew from predicted states, or kept from the last observed step (public code)."""
    residual: Residual = "state"
    """Position to which the predicted change is added; see `predictor.layers.state_codec`."""
    delta_scales: tuple[float, ...] = ()
    """Typical one-step change of each feature [SI]; empty takes the spec's feature scales."""

    def __post_init__(self) -> None:
        """Checks ranges."""
        check_sizes(self, "hidden_dim", "rnn_dim", "decoder_dim", "message_dim", "num_layers")
        check_at_most(self, MOST_PARTS, "num_layers")


class AttentionLayer(nn.Module):
    """Computes one layer of the multiplex graph: from states to attention over senders."""

    def __init__(self, config: IMMAConfig, inputs: int) -> None:
        """Creates the layers, in the order in which data passes them."""
        super().__init__()
        self.frames = FrameEncoder(inputs, config.hidden_dim)
        self.rnn = PairLSTM(config.hidden_dim, config.rnn_dim)
        self.score = nn.Linear(config.rnn_dim, 1, bias=False)  # a bias would cancel in the softmax

    def forward(
        self,
        inputs: Float[Tensor, "batch time agents inputs"],
        valid: Bool[Tensor, "batch time agents"],
        hidden: Float[Tensor, "batch agents agents rnn"],
        cell: Float[Tensor, "batch agents agents rnn"],
    ) -> tuple[Tensors, Float[Tensor, "batch time agents agents"]]:
        """Computes memory after each step and attention, receiver first."""
        hiddens, cells = self.rnn(self.frames(inputs, valid), valid, hidden, cell)
        return (hiddens, cells), masked_attention(self.score(hiddens)[..., 0], pair_mask(valid))


class IMMA(UnrolledForecaster):
    """The IMMA model, as a `TrainableForecaster`.

    Args:
        spec: layout of the scenes.
        config: sizes of the network.
        horizon_steps: number of steps that it is trained to forecast.
    """

    def __init__(self, spec: SceneSpec, config: IMMAConfig | None = None, horizon_steps: int = 5) -> None:
        """Builds the network; weights are drawn from torch's generator, so seed it first."""
        config = config or IMMAConfig()
        super().__init__(spec, config.residual, config.delta_scales, horizon_steps)
        self.config = config
        self.num_edge_types = config.num_layers + 1
        self.node_sizes = (config.decoder_dim,)
        self.pair_sizes = (config.rnn_dim, config.rnn_dim) * config.num_layers
        inputs, kinds = self.codec.num_inputs, config.num_layers
        self.layers = nn.ModuleList(AttentionLayer(config, inputs) for _ in range(kinds))
        self.decoder = HiddenDecoder(inputs, config.decoder_dim, config.message_dim, kinds, spec.num_features)

    # --- Functions of a model -----------------------------------------------------------------------------------

    def encode(
        self,
        inputs: Float[Tensor, "batch time agents inputs"],
        valid: Bool[Tensor, "batch time agents"],
        pairs: Tensors,
    ) -> Encoded:
        """Computes the attention of each layer, and the memory of its LSTM."""
        memory: Tensors = ()
        attention = []
        for index, layer in enumerate(self.layers):
            after, attended = layer(inputs, valid, *pairs[2 * index : 2 * index + 2])
            memory += after
            attention.append(attended)
        return Encoded(memory, torch.stack(attention, dim=-1))

    def edge_probs(
        self, weights: Float[Tensor, "batch agents agents layers"], valid: Bool[Tensor, "batch agents"]
    ) -> Float[Tensor, "batch agents agents types"]:
        """Converts attention to probabilities: type k is layer k's attention divided by the number of layers.

        Type 0 ("no edge") is one minus the attention averaged over layers, and 1 where there is no pair.
        """
        shares = weights / self.config.num_layers
        return torch.cat([(1 - shares.sum(-1, keepdim=True)).clamp(min=0), shares], dim=-1)

    def evolve(
        self,
        inputs: Float[Tensor, "batch agents inputs"],
        valid: Bool[Tensor, "batch agents"],
        pairs: Tensors,
        scores: Float[Tensor, "batch agents agents layers"],
    ) -> tuple[Tensors, Float[Tensor, "batch agents agents layers"]]:
        """Keeps memory and attention, unless `dynamic_graph` is set."""
        return super().evolve(inputs, valid, pairs, scores) if self.config.dynamic_graph else (pairs, scores)

    def recur(
        self,
        inputs: Float[Tensor, "batch agents inputs"],
        valid: Bool[Tensor, "batch agents"],
        weights: Float[Tensor, "batch agents agents layers"],
        nodes: Tensors,
    ) -> Tensors:
        """Updates agents by the sum of all layers' messages; within a layer attention sums to one."""
        return (self.decoder.step(inputs, valid, weights, nodes[0]),)

    def change(
        self, inputs: Float[Tensor, "*batch agents inputs"], valid: Bool[Tensor, "*batch agents"], nodes: Tensors
    ) -> Float[Tensor, "*batch agents state"]:
        """Computes the change of state from the decoder's memory."""
        change: Tensor = self.decoder.readout(nodes[0])
        return change


def masked_attention(
    scores: Float[Tensor, "*batch agents agents"], pairs: Bool[Tensor, "*batch agents agents"]
) -> Float[Tensor, "*batch agents agents"]:
    """Computes the softmax over the senders of each receiver; zeros if there are none."""
    # a finite stand-in for -inf, whose softmax over nothing would be NaN
    scores = scores.masked_fill(~pairs, torch.finfo(scores.dtype).min)
    return torch.softmax(scores, dim=-1) * pairs
