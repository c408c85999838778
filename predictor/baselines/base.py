"""What the learned baselines share: streaming, teacher forcing and free roll-out, all from the same few pieces.

A model says what it carries from step to step (`node_sizes`, `pair_sizes`), how its graph comes from the past
(`encode`, `expected`), how an agent's memory moves on (`recur`) and which change of state follows (`change`). A window
runs `encode` and `change` on all steps at once and `recur` step by step; streaming runs all three on one step.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from predictor.forecaster import Belief, Memory, WindowOutput
from predictor.graph import pair_mask
from predictor.layers.state_codec import Residual, StateCodec
from predictor.noise import Noise
from predictor.scene import SceneSpec
from predictor.support.config_checks import check_at_least, check_choices

Tensors = tuple[Tensor, ...]
GraphRule = Callable[[Tensor], Tensor]
"""From scores to the graph that messages follow: an expectation or a draw."""


class Encoded(NamedTuple):
    """What the past says about pairs, for a stretch of time."""

    memory: Tensors
    """Pair memory after each step, [batch time agents agents _]."""
    scores: Float[Tensor, "batch time agents agents scores"]
    """What the graph is made from; no columns without a graph."""


class Internal(NamedTuple):
    """What a belief keeps to roll out from."""

    pairs: Tensors
    scores: Tensor
    before: Tensors  # node memory without the latest observation
    nodes: Tensors  # … and with it, under the expected graph
    next_states: Tensor


class UnrolledForecaster(nn.Module, ABC):
    """A `TrainableForecaster` made of steps; without the optional pieces it has neither memory nor graph.

    Args:
        spec: layout of the scenes.
        residual: what the predicted change of position is added to.
        delta_scales: typical one-step change of each feature [SI]; empty takes the spec's feature scales.
        horizon_steps: steps it is trained to forecast.
    """

    node_sizes: tuple[int, ...] = ()
    """Width of each kind of agent memory."""
    pair_sizes: tuple[int, ...] = ()
    """Width of each kind of pair memory."""
    num_edge_types: int = 2
    """Edge types, "no edge" included."""
    edge_feature_dim: int = 1
    """Size of an edge's features, which are all zero here; observations have a place for them."""

    def __init__(
        self, spec: SceneSpec, residual: Residual, delta_scales: tuple[float, ...], horizon_steps: int
    ) -> None:
        """Keep the layout; weights are the subclass's."""
        super().__init__()
        self.spec = spec
        self.horizon_steps = horizon_steps
        self.codec = StateCodec(spec, delta_scales, residual)

    # --- Pieces -------------------------------------------------------------------------------------------------

    def encode(
        self,
        inputs: Float[Tensor, "batch time agents inputs"],
        valid: Bool[Tensor, "batch time agents"],
        pairs: Tensors,
    ) -> Encoded:
        """Pair memory and graph scores for all steps, given the pair memory before them."""
        return Encoded((), inputs.new_zeros(*valid.shape, valid.shape[-1], 0))

    def expected(self, scores: Float[Tensor, "*batch scores"]) -> Float[Tensor, "*batch graph"]:
        """The graph that is followed when nothing is drawn."""
        return scores

    def edge_probs(
        self, graph: Float[Tensor, "batch agents agents graph"], valid: Bool[Tensor, "batch agents"]
    ) -> Float[Tensor, "batch agents agents types"]:
        """The graph as a distribution over edge types; "no edge" everywhere without a graph."""
        probs = graph.new_zeros(*graph.shape[:-1], self.num_edge_types)
        probs[..., 0] = 1.0
        return probs

    def evolve(
        self,
        inputs: Float[Tensor, "batch agents inputs"],
        valid: Bool[Tensor, "batch agents"],
        pairs: Tensors,
        scores: Float[Tensor, "batch agents agents scores"],
    ) -> tuple[Tensors, Float[Tensor, "batch agents agents scores"]]:
        """Pair memory and scores at a predicted step: predictions pass through the encoder like observations."""
        encoded = self.encode(inputs[:, None], valid[:, None], pairs)
        return tuple(m[:, 0] for m in encoded.memory), encoded.scores[:, 0]

    def recur(
        self,
        inputs: Float[Tensor, "batch agents inputs"],
        valid: Bool[Tensor, "batch agents"],
        graph: Float[Tensor, "batch agents agents graph"],
        nodes: Tensors,
    ) -> Tensors:
        """Node memory one step on; absent agents keep none."""
        return ()

    @abstractmethod
    def change(
        self,
        inputs: Float[Tensor, "*batch agents inputs"],
        valid: Bool[Tensor, "*batch agents"],
        nodes: Tensors,
    ) -> Float[Tensor, "*batch agents state"]:
        """Change of state, in units of `delta_scales`, given the node memory after the step."""

    # --- Forecaster ---------------------------------------------------------------------------------------------

    def empty_memory(self, batch: int, agents: int) -> Memory:
        """Zeros on the model's device."""
        zeros = self.codec.scales.new_zeros
        return Memory(
            tuple(zeros(batch, agents, size) for size in self.node_sizes),
            tuple(zeros(batch, agents, agents, size) for size in self.pair_sizes),
        )

    def observe(
        self, memory: Memory, states: Float[Tensor, "batch agents state"], valid: Bool[Tensor, "batch agents"]
    ) -> tuple[Memory, Belief]:
        """One step of everything, under the expected graph."""
        inputs = self.codec.inputs(states, valid)
        encoded = self.encode(inputs[:, None], valid[:, None], memory.pairs)
        pairs, scores = tuple(m[:, 0] for m in encoded.memory), encoded.scores[:, 0]
        graph = self.expected(scores)
        nodes = self.recur(inputs, valid, graph, memory.nodes)
        next_states = self.codec.advance(states, self.change(inputs, valid, nodes))
        features = states.new_zeros(*graph.shape[:-1], self.edge_feature_dim)
        internal = Internal(pairs, scores, memory.nodes, nodes, next_states)
        return Memory(nodes, pairs), Belief(states, valid, self.edge_probs(graph, valid), features, internal)

    def rollout(
        self, belief: Belief, horizon_steps: int, num_samples: int = 1, generator: Noise | None = None
    ) -> Float[Tensor, "batch samples agents horizon state"]:
        """Feed predictions back; all samples are the same."""
        now: Internal = belief.internal
        future = self.continue_from(
            now.next_states, belief.valid, now.pairs, now.scores, now.nodes, horizon_steps, self.expected
        )
        return future[:, None].expand(-1, num_samples, -1, -1, -1)

    # --- Training -----------------------------------------------------------------------------------------------

    def window(
        self,
        states: Float[Tensor, "batch time agents state"],
        valid: Bool[Tensor, "batch time agents"],
        last_observed: Int[Tensor, " batch"],
        rollout_steps: int,
        generator: torch.Generator | None = None,
    ) -> WindowOutput:
        """Teacher-forced pass and free roll-out of the same memory; see `TrainableForecaster.window`."""
        inputs = self.codec.inputs(states, valid)
        empty = self.empty_memory(states.shape[0], states.shape[2])
        encoded = self.encode(inputs, valid, empty.pairs)
        nodes = self.remember(inputs, valid, self.expected(encoded.scores), empty.nodes)
        after = tuple(m[:, 1:] for m in nodes)
        one_step = self.codec.advance(states, self.change(inputs, valid, after))
        now = (torch.arange(len(states), device=states.device), last_observed)
        rollout = self.continue_from(
            one_step[now],
            valid[now],
            tuple(m[now] for m in encoded.memory),
            encoded.scores[now],
            tuple(m[now] for m in after),
            rollout_steps,
            self.expected,
        )
        return WindowOutput(one_step, rollout)

    # --- Shared -------------------------------------------------------------------------------------------------

    def remember(
        self,
        inputs: Float[Tensor, "batch time agents inputs"],
        valid: Bool[Tensor, "batch time agents"],
        graph: Float[Tensor, "batch time agents agents graph"],
        nodes: Tensors,
    ) -> Tensors:
        """Node memory before the first step and after each one, [batch time+1 agents _]."""
        kept = [nodes]
        # unbind, not [:, t]: the gradient of an index is a full-size tensor of zeros for every step
        for now, present, edges in zip(inputs.unbind(1), valid.unbind(1), graph.unbind(1), strict=True):
            nodes = self.recur(now, present, edges, nodes)
            kept.append(nodes)
        return tuple(torch.stack(memory, dim=1) for memory in zip(*kept, strict=True))

    def continue_from(
        self,
        states: Float[Tensor, "batch agents state"],
        valid: Bool[Tensor, "batch agents"],
        pairs: Tensors,
        scores: Float[Tensor, "batch agents agents scores"],
        nodes: Tensors,
        horizon_steps: int,
        graph: GraphRule,
    ) -> Float[Tensor, "batch agents horizon state"]:
        """Roll out from the states predicted for the first step; whoever is present stays."""
        future = [states]
        for _ in range(horizon_steps - 1):
            inputs = self.codec.inputs(states, valid)
            pairs, scores = self.evolve(inputs, valid, pairs, scores)
            nodes = self.recur(inputs, valid, graph(scores), nodes)
            states = self.codec.advance(states, self.change(inputs, valid, nodes))
            future.append(states)
        return torch.stack(future, dim=2)[:, :, :horizon_steps]


def mean_weight(valid: Bool[Tensor, "*batch agents"], dtype: torch.dtype) -> Float[Tensor, "*batch agents agents"]:
    """1 / (number of others present) for each pair of present agents: Σ_j w_ij x_ij is a mean, 0 for who is alone."""
    pairs = pair_mask(valid).to(dtype)
    return pairs / pairs.sum(-1, keepdim=True).clamp(min=1)


def check_sizes(config: object, *names: str) -> None:
    """Raise a `UserError` unless closed choices are among their values, and these fields at least 1."""
    check_choices(config)
    check_at_least(config, 1, *names)
