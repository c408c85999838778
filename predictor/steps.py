"""What single steps of the dG-VAE carry along, and what they need of the networks.

`predictor.dgvae` runs them; `Modules` takes the networks as they are, with gradients, `predictor.stepper` the same
without.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, runtime_checkable

from torch import Tensor

from predictor.networks import Decoder, Edges, Encoder, no_edge_where_absent
from predictor.packing import Packed, Padded


class Past(NamedTuple):
    """What the encoder remembers; tensors with a time axis, or without one."""

    hidden: Tensor
    cell: Tensor
    static: Tensor  # pair matching: mean and count (no column if off)
    seen: Tensor  # the latest inputs and a 1 (no column if changes are not looked at)


class Encoding(NamedTuple):
    """What the encoder makes of a stretch of steps."""

    edges: Edges
    features: Tensor  # with the static dimensions averaged over the past of each step
    past: Past  # after each step


@runtime_checkable
class Layers(Protocol):
    """What single steps need of the networks; `graph` is `Padded` for the modules, `Packed` for the stepper."""

    def encode(self, inputs: Tensor, graph: Any, hidden: Tensor, cell: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Memory of each pair after a step (hidden, cell), prior logits and features."""

    def drive(
        self, inputs: Tensor, graph: Any, weights: Tensor, features: Tensor, node: Tensor
    ) -> tuple[Tensor, Tensor | None]:
        """GRU states after a step along a graph; and the messages, unless nobody else needs them."""

    def messages(self, inputs: Tensor, graph: Any, weights: Tensor, features: Tensor) -> Tensor:
        """What reaches each agent along a graph."""


class Internal(NamedTuple):
    """What a belief keeps to roll out from."""

    layers: Layers
    graph: Padded | Packed  # of all that follows but states
    past: Past
    logits: Tensor
    probs: Tensor
    features: Tensor
    node_before: Tensor  # GRU state before the latest observation was decoded
    node_after: Tensor  # … and after, under the prior's expectation
    next_states: Tensor


@dataclass(frozen=True)
class Modules:
    """Single steps through the modules themselves."""

    encoder: Encoder
    decoder: Decoder

    def encode(self, inputs: Tensor, graph: Any, hidden: Tensor, cell: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """As `Layers.encode`."""
        edges: Edges = self.encoder(inputs[:, None], graph.present[:, None], hidden, cell, graph.senders)
        return edges.hidden[:, 0], edges.cell[:, 0], edges.prior_logits[:, 0], edges.features[:, 0]

    def drive(
        self, inputs: Tensor, graph: Any, weights: Tensor, features: Tensor, node: Tensor
    ) -> tuple[Tensor, Tensor | None]:
        """As `Layers.drive`."""
        messages = self.messages(inputs, graph, weights, features)
        return self.decoder.step(messages, node), messages

    def messages(self, inputs: Tensor, graph: Any, weights: Tensor, features: Tensor) -> Tensor:
        """As `Layers.messages`."""
        return self.decoder.messages(inputs, graph.present, weights, features, graph.senders)


def unpacked(known: Internal, layers: Layers) -> Internal:
    """The same for other layers, which take padded arrays."""
    graph = known.graph
    if isinstance(graph, Padded):
        return known
    hidden, cell, static, seen = known.past
    past = Past(graph.unpack_pairs(hidden), graph.unpack_pairs(cell), graph.unpack_pairs(static), seen)
    logits = no_edge_where_absent(graph.unpack_pairs(known.logits), graph.padded.present[..., None])
    probs, features = graph.unpack_pairs(known.probs, no_edge=True), graph.unpack_pairs(known.features)
    nodes = graph.unpack_nodes(known.node_before), graph.unpack_nodes(known.node_after)
    return Internal(layers, graph.padded, past, logits, probs, features, *nodes, known.next_states)
