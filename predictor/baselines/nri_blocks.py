"""Blocks that the NRI family shares (NRI, dNRI, IMMA): embedding of a frame's pairs, LSTM per pair, recurrent decoder.

Everything is masked, so agents may come and go. Means are over the other present agents. The batch normalisation of
the originals is left out: its statistics would depend on padding, and differ between a window and a stream.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn import functional

from predictor.baselines.base import mean_weight
from predictor.graph import pair_mask
from predictor.layers.pairs import PairLinear, sum_over_senders
from predictor.layers.rnn import masked_lstm


class FrameEncoder(nn.Module):
    """Embedding agent → pair → agent → pair, each arrow a two-layer ELU MLP, with a skip from the first pair MLP.

    Args:
        inputs: number of an agent's inputs.
        hidden_dim: width of all layers.
    """

    def __init__(self, inputs: int, hidden_dim: int) -> None:
        """Creates the layers, in the order in which data passes them; initial weights are those of the originals."""
        super().__init__()
        self.node = _elu_mlp(inputs, hidden_dim)
        self.pair = PairLinear(hidden_dim, hidden_dim)
        self.pair_out = nn.Linear(hidden_dim, hidden_dim)
        self.again_node = _elu_mlp(hidden_dim, hidden_dim)
        self.again_pair = PairLinear(hidden_dim, hidden_dim)
        self.again_skip = nn.Linear(hidden_dim, hidden_dim, bias=False)
        self.again_out = nn.Linear(hidden_dim, hidden_dim)
        initialise(self.pair.receiver, self.pair.sender)
        initialise(self.again_pair.receiver, self.again_pair.sender, self.again_skip)
        for layer in (self.pair_out, self.again_out):
            initialise(layer)

    def forward(
        self, inputs: Float[Tensor, "*batch agents inputs"], valid: Bool[Tensor, "*batch agents"]
    ) -> Float[Tensor, "*batch agents agents hidden"]:
        """Embeds all pairs of any number of frames at once."""
        first = functional.elu(self.pair_out(functional.elu(self.pair(self.node(inputs)))))
        mean = sum_over_senders(first, mean_weight(valid, inputs.dtype))
        second = self.again_pair(self.again_node(mean)) + self.again_skip(first)
        return functional.elu(self.again_out(functional.elu(second)))


class PairLSTM(nn.Module):
    """LSTM with the same weights for every pair; the memory of an absent pair is set to zero."""

    def __init__(self, inputs: int, hidden_dim: int) -> None:
        """Creates the layers, with initial weights as in `nn.LSTM`."""
        super().__init__()
        self.inputs = nn.Linear(inputs, 4 * hidden_dim)
        self.hidden = nn.Linear(hidden_dim, 4 * hidden_dim, bias=False)
        for parameter in self.parameters():
            nn.init.uniform_(parameter, -(hidden_dim**-0.5), hidden_dim**-0.5)

    def forward(
        self,
        embedding: Float[Tensor, "batch time agents agents inputs"],
        valid: Bool[Tensor, "batch time agents"],
        hidden: Float[Tensor, "batch agents agents rnn"],
        cell: Float[Tensor, "batch agents agents rnn"],
        reverse: bool = False,
    ) -> tuple[Float[Tensor, "batch time agents agents rnn"], Float[Tensor, "batch time agents agents rnn"]]:
        """Computes hidden and cell state after each step, from the memory before the first (last, if reversed)."""
        return masked_lstm(self.inputs(embedding), self.hidden, pair_mask(valid), hidden, cell, reverse)


class HiddenDecoder(nn.Module):
    """Decoder with messages from its own hidden states, a gated update from messages and input, and a readout.

    Each kind of message has its own two-layer tanh MLP on h_i ‖ h_j. Inputs of the gates are the messages, not the
    agent's own hidden state, which is kept by the update gate only: this is NRI's form of a GRU.

    Args:
        inputs: number of an agent's inputs.
        hidden_dim: width of the memory.
        message_dim: width of the messages.
        kinds: number of kinds of messages.
        outputs: number of outputs of the readout.
    """

    def __init__(self, inputs: int, hidden_dim: int, message_dim: int, kinds: int, outputs: int) -> None:
        """Creates the layers, in the order in which data passes them."""
        super().__init__()
        self.message_pair = PairLinear(hidden_dim, kinds * message_dim)
        self.message_out = nn.ModuleList(nn.Linear(message_dim, message_dim) for _ in range(kinds))
        self.input_gates = nn.Linear(inputs, 3 * hidden_dim)
        self.message_gates = nn.Linear(message_dim, 3 * hidden_dim, bias=False)
        self.readout = nn.Sequential(
            nn.Linear(hidden_dim, hidden_dim),
            nn.ReLU(),
            nn.Linear(hidden_dim, hidden_dim),
            nn.ReLU(),
            nn.Linear(hidden_dim, outputs),
        )

    def messages(
        self, hidden: Float[Tensor, "*batch agents hidden"], weights: Float[Tensor, "*batch agents agents kinds"]
    ) -> Float[Tensor, "*batch agents message"]:
        """Computes Σ_k Σ_j w_ijk · tanh(W_k tanh(V_k (h_i ‖ h_j)))."""
        first = torch.tanh(self.message_pair(hidden)).chunk(len(self.message_out), dim=-1)
        kinds = zip(first, self.message_out, weights.unbind(-1), strict=True)
        return torch.stack([sum_over_senders(torch.tanh(out(part)), w) for part, out, w in kinds]).sum(0)

    def step(
        self,
        inputs: Float[Tensor, "*batch agents inputs"],
        valid: Bool[Tensor, "*batch agents"],
        weights: Float[Tensor, "*batch agents agents kinds"],
        hidden: Float[Tensor, "*batch agents hidden"],
    ) -> Float[Tensor, "*batch agents hidden"]:
        """Computes the memory one step later; that of absent agents is zero."""
        reset_x, keep_x, new_x = self.input_gates(inputs).chunk(3, dim=-1)
        reset_m, keep_m, new_m = self.message_gates(self.messages(hidden, weights)).chunk(3, dim=-1)
        keep = torch.sigmoid(keep_x + keep_m)
        new = torch.tanh(new_x + torch.sigmoid(reset_x + reset_m) * new_m)
        after: Tensor = ((1 - keep) * new + keep * hidden) * valid[..., None]
        return after


def initialise(*parts: nn.Linear) -> None:
    """Sets Xavier weights and biases of 0.1 for one linear layer whose input is split over `parts`."""
    widths = [part.in_features for part in parts]
    joined = torch.empty(parts[0].out_features, sum(widths))
    nn.init.xavier_normal_(joined)
    with torch.no_grad():
        for part, block in zip(parts, joined.split(widths, dim=1), strict=True):
            part.weight.copy_(block)
            if part.bias is not None:
                part.bias.fill_(0.1)


def elu_head(inputs: int, hidden_dim: int, outputs: int) -> nn.Sequential:
    """Creates three linear layers with ELU between them, initialised as the originals."""
    layers = [nn.Linear(inputs, hidden_dim), nn.Linear(hidden_dim, hidden_dim), nn.Linear(hidden_dim, outputs)]
    for layer in layers:
        initialise(layer)
    return nn.Sequential(layers[0], nn.ELU(), layers[1], nn.ELU(), layers[2])


def _elu_mlp(inputs: int, hidden_dim: int) -> nn.Sequential:
    layers = [nn.Linear(inputs, hidden_dim), nn.Linear(hidden_dim, hidden_dim)]
    for layer in layers:
        initialise(layer)
    return nn.Sequential(layers[0], nn.ELU(), layers[1], nn.ELU())
