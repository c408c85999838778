"""IMMA (Sun et al., "Interaction Modeling with Multiplex Attention", NeurIPS 2022) in streaming form.

A multiplex graph: several layers of soft edges, each layer with an encoder of its own and attention that sums to one
over an agent's senders. The decoder sends one kind of message per layer, weighted by attention, and is otherwise NRI's.
Forecasts are deterministic.

The public code flattens 24 observed steps of a fixed number of agents into the encoder's input, decodes from an empty
memory and feeds the decoder its own output layer. Here the encoder embeds each frame and remembers pairs in an LSTM, so
that histories of any length and agents that come and go have a meaning; the decoder takes in states, observed ones and
then its own predictions. As there, the graph stands still while forecasting (`dynamic_graph=True` infers it anew).
Messages are not divided by the width of the hidden state, as they are there and in NRI where an average is meant.
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
from predictor.support.errors import UserError


@dataclass(frozen=True)
class IMMAConfig:
    """Sizes; the widths are those of the public basketball run."""

    hidden_dim: int = 256
    """Width of each layer's frame embedding."""
    rnn_dim: int = 64
    """Width of each layer's LSTM of a pair; the public code has none."""
    decoder_dim: int = 256
    """Width of the memory of each agent."""
    message_dim: int = 256
    """Width of the decoder's messages."""
    num_layers: int = 2
    """Layers of the multiplex graph (public code: 2 by default, 5 for basketball)."""
    dynamic_graph: bool = False
    """Infer attention anew from predicted states, rather than keep the last observed graph (public code)."""
    residual: Residual = "state"
    """What the predicted change of position is added to; see `predictor.layers.state_codec`."""
    delta_scales: tuple[float, ...] = ()
    """Typical one-step change of each feature [SI]; empty takes the spec's feature scales."""

    def __post_init__(self) -> None:
        """Check ranges."""
        check_sizes(self, "hidden_dim", "rnn_dim", "decoder_dim", "message_dim", "num_layers")


class AttentionLayer(nn.Module):
    """One layer of the multiplex graph: from states to attention over senders."""

    def __init__(self, config: IMMAConfig, inputs: int) -> None:
        """Layers in the order in which data passes."""
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
        """Memory after each step and attention, receiver first."""
        hiddens, cells = self.rnn(self.frames(inputs, valid), valid, hidden, cell)
        return (hiddens, cells), masked_attention(self.score(hiddens)[..., 0], pair_mask(valid))


class IMMA(UnrolledForecaster):
    """The model, as a `TrainableForecaster`.

    Args:
        spec: layout of the scenes.
        config: sizes.
        horizon_steps: steps it is trained to forecast.
    """

    def __init__(self, spec: SceneSpec, config: IMMAConfig | None = None, horizon_steps: int = 5) -> None:
        """Build the network; weights come from torch's generator, so seed it first."""
        config = config or IMMAConfig()
        super().__init__(spec, config.residual, config.delta_scales, horizon_steps)
        self.config = config
        self.num_edge_types = config.num_layers + 1
        self.node_sizes = (config.decoder_dim,)
        self.pair_sizes = (config.rnn_dim, config.rnn_dim) * config.num_layers
        inputs, kinds = self.codec.num_inputs, config.num_layers
        self.layers = nn.ModuleList(AttentionLayer(config, inputs) for _ in range(kinds))
        self.decoder = HiddenDecoder(inputs, config.decoder_dim, config.message_dim, kinds, spec.num_features)
        self.volume: Tensor
        self.register_buffer("volume", torch.ones(kinds), persistent=False)

    def train_layer(self, layer: int | None, volume: float = 1.0) -> None:
        """A stage of the paper's Progressive Layer Training, which adds layers one by one, the last one first.

        Args:
            layer: the one that is added: those before it are silent, the encoders of those after it no longer learn.
                None ends the progress: every layer speaks and learns.
            volume: factor on the added layer's attention, raised from 0 to 1 during its stage.
        """
        if layer is not None and not 0 <= layer < self.config.num_layers:
            raise UserError(f"layer must be from 0 to {self.config.num_layers - 1}, or None; got {layer}")
        self.volume.fill_(1.0)
        if layer is not None:
            self.volume[:layer], self.volume[layer] = 0.0, volume
        for index, encoder in enumerate(self.layers):
            encoder.requires_grad_(layer is None or index <= layer)

    # --- Pieces -------------------------------------------------------------------------------------------------

    def encode(
        self,
        inputs: Float[Tensor, "batch time agents inputs"],
        valid: Bool[Tensor, "batch time agents"],
        pairs: Tensors,
    ) -> Encoded:
        """Attention of each layer, and the memory of its LSTM."""
        memory: Tensors = ()
        attention = []
        for index, layer in enumerate(self.layers):
            after, weights = layer(inputs, valid, *pairs[2 * index : 2 * index + 2])
            memory += after
            attention.append(weights)
        return Encoded(memory, torch.stack(attention, dim=-1))

    def edge_probs(
        self, graph: Float[Tensor, "batch agents agents layers"], valid: Bool[Tensor, "batch agents"]
    ) -> Float[Tensor, "batch agents agents types"]:
        """Type k is layer k's attention divided by the number of layers; type 0 is what is left of 1.

        A pair's share of "no edge" is thus one minus its attention averaged over layers, and 1 where there is no pair.
        """
        shares = graph / self.config.num_layers
        return torch.cat([(1 - shares.sum(-1, keepdim=True)).clamp(min=0), shares], dim=-1)

    def evolve(
        self,
        inputs: Float[Tensor, "batch agents inputs"],
        valid: Bool[Tensor, "batch agents"],
        pairs: Tensors,
        scores: Float[Tensor, "batch agents agents layers"],
    ) -> tuple[Tensors, Float[Tensor, "batch agents agents layers"]]:
        """The graph stands still, unless the config says otherwise."""
        return super().evolve(inputs, valid, pairs, scores) if self.config.dynamic_graph else (pairs, scores)

    def recur(
        self,
        inputs: Float[Tensor, "batch agents inputs"],
        valid: Bool[Tensor, "batch agents"],
        graph: Float[Tensor, "batch agents agents layers"],
        nodes: Tensors,
    ) -> Tensors:
        """Messages of all layers are added; within a layer attention sums to one."""
        return (self.decoder.step(inputs, valid, graph * self.volume, nodes[0]),)

    def change(
        self, inputs: Float[Tensor, "*batch agents inputs"], valid: Bool[Tensor, "*batch agents"], nodes: Tensors
    ) -> Float[Tensor, "*batch agents state"]:
        """Read off the decoder's memory."""
        change: Tensor = self.decoder.readout(nodes[0])
        return change


def masked_attention(
    scores: Float[Tensor, "*batch agents agents"], pairs: Bool[Tensor, "*batch agents agents"]
) -> Float[Tensor, "*batch agents agents"]:
    """Softmax over the senders of each receiver; all zero for who has none."""
    # a finite stand-in for -inf, whose softmax over nothing would be NaN
    scores = scores.masked_fill(~pairs, torch.finfo(scores.dtype).min)
    return torch.softmax(scores, dim=-1) * pairs
