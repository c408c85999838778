"""Base of the learned baselines: streaming, teacher forcing and roll-out, made of a few functions.

A model defines the sizes of its memory (`node_sizes`, `pair_sizes`), how edge weights follow from the past (`encode`,
`expected`), how an agent's memory is updated (`recur`) and which change of state follows (`change`). A window
runs `encode` and `change` on all steps at once and `recur` step by step; streaming runs all three on one step.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from predictor.forecaster import Belief, Futures, Memory, WindowOutput
from predictor.graph import pair_mask
from predictor.layers.state_codec import Residual, StateCodec
from predictor.noise import Noise, TrainingNoise
from predictor.scene import SceneSpec
from predictor.support.config_checks import MOST_WIDTH, check_at_least, check_at_most, check_choices, check_scale_values
from predictor.what_if import with_ego

Tensors = tuple[Tensor, ...]
WeightRule = Callable[[Tensor], Tensor]
"""Function from scores to the edge weights of messages: probabilities or a draw."""


class Encoded(NamedTuple):
    """Encoder outputs for several steps, from the past alone."""

    memory: Tensors
    """Pair memory after each step, [batch time agents agents _]."""
    scores: Float[Tensor, "batch time agents agents scores"]
    """Scores from which edge weights are computed; no columns without edges."""


class Internal(NamedTuple):
    """Data of a belief from which it is rolled out."""

    pairs: Tensors
    scores: Tensor
    before: Tensors  # node memory without the latest observation
    nodes: Tensors  # … and with it, along expected edge weights
    next_states: Tensor


class UnrolledForecaster(nn.Module, ABC):
    """Base class of a `TrainableForecaster` made of steps; without the optional functions it has no memory, no edges.

    Args:
        spec: layout of the scenes.
        residual: position to which the predicted change is added; see `predictor.layers.state_codec`.
        delta_scales: typical one-step change of each feature [SI]; empty takes the spec's feature scales.
        horizon_steps: number of steps that it is trained to forecast.
    """

    node_sizes: tuple[int, ...] = ()
    """Width of each kind of agent memory."""
    pair_sizes: tuple[int, ...] = ()
    """Width of each kind of pair memory."""
    num_edge_types: int = 2
    """Number of edge types, "no edge" included."""
    edge_feature_dim: int = 1
    """Number of features of an edge; all are zero here, but observations have a place for them."""

    def __init__(
        self, spec: SceneSpec, residual: Residual, delta_scales: tuple[float, ...], horizon_steps: int
    ) -> None:
        """Stores the layout; weights are the subclass's."""
        super().__init__()
        self.spec = spec
        self.horizon_steps = horizon_steps
        self.codec = StateCodec(spec, delta_scales, residual)

    # --- Functions of a model -----------------------------------------------------------------------------------

    def encode(
        self,
        inputs: Float[Tensor, "batch time agents inputs"],
        valid: Bool[Tensor, "batch time agents"],
        pairs: Tensors,
    ) -> Encoded:
        """Computes pair memory and scores for all steps, given the pair memory before them."""
        return Encoded((), inputs.new_zeros(*valid.shape, valid.shape[-1], 0))

    def expected(self, scores: Float[Tensor, "*batch scores"]) -> Float[Tensor, "*batch weights"]:
        """Computes the edge weights that are used when nothing is drawn."""
        return scores

    def edge_probs(
        self, weights: Float[Tensor, "batch agents agents weights"], valid: Bool[Tensor, "batch agents"]
    ) -> Float[Tensor, "batch agents agents types"]:
        """Returns edge weights as probabilities of edge types; certainty of "no edge" for models without edges."""
        probs = weights.new_zeros(*weights.shape[:-1], self.num_edge_types)
        probs[..., 0] = 1.0
        return probs

    def evolve(
        self,
        inputs: Float[Tensor, "batch agents inputs"],
        valid: Bool[Tensor, "batch agents"],
        pairs: Tensors,
        scores: Float[Tensor, "batch agents agents scores"],
    ) -> tuple[Tensors, Float[Tensor, "batch agents agents scores"]]:
        """Computes pair memory and scores at a predicted step: predictions are encoded like observations."""
        encoded = self.encode(inputs[:, None], valid[:, None], pairs)
        return tuple(m[:, 0] for m in encoded.memory), encoded.scores[:, 0]

    def recur(
        self,
        inputs: Float[Tensor, "batch agents inputs"],
        valid: Bool[Tensor, "batch agents"],
        weights: Float[Tensor, "batch agents agents weights"],
        nodes: Tensors,
    ) -> Tensors:
        """Computes node memory one step later; that of absent agents is zero."""
        return ()

    @abstractmethod
    def change(
        self,
        inputs: Float[Tensor, "*batch agents inputs"],
        valid: Bool[Tensor, "*batch agents"],
        nodes: Tensors,
    ) -> Float[Tensor, "*batch agents state"]:
        """Computes the change of state, in units of `delta_scales`, from the node memory after the step."""

    # --- Forecaster ---------------------------------------------------------------------------------------------

    def empty_memory(self, batch: int, agents: int) -> Memory:
        """Returns zeros on the model's device."""
        zeros = self.codec.scales.new_zeros
        return Memory(
            tuple(zeros(batch, agents, size) for size in self.node_sizes),
            tuple(zeros(batch, agents, agents, size) for size in self.pair_sizes),
        )

    def observe(
        self, memory: Memory, states: Float[Tensor, "batch agents state"], valid: Bool[Tensor, "batch agents"]
    ) -> tuple[Memory, Belief]:
        """Computes one step of encoder and decoder, along expected edge weights."""
        inputs = self.codec.inputs(states, valid)
        encoded = self.encode(inputs[:, None], valid[:, None], memory.pairs)
        pairs, scores = tuple(m[:, 0] for m in encoded.memory), encoded.scores[:, 0]
        weights = self.expected(scores)
        nodes = self.recur(inputs, valid, weights, memory.nodes)
        next_states = self.codec.advance(states, self.change(inputs, valid, nodes))
        features = states.new_zeros(*weights.shape[:-1], self.edge_feature_dim)
        internal = Internal(pairs, scores, memory.nodes, nodes, next_states)
        return Memory(nodes, pairs), Belief(states, valid, self.edge_probs(weights, valid), features, internal)

    def rollout(
        self, belief: Belief, horizon_steps: int, num_samples: int = 1, generator: Noise | None = None
    ) -> Futures:
        """Rolls out from the belief; all samples are equal."""
        now: Internal = belief.internal
        future = self.continue_from(
            now.next_states, belief.valid, now.pairs, now.scores, now.nodes, horizon_steps, self.expected
        )
        return Futures(future[:, None].expand(-1, num_samples, -1, -1, -1))

    def rollout_plans(
        self,
        belief: Belief,
        plans: Float[Tensor, "batch plans horizon state"],
        num_samples: int = 1,
        generator: Noise | None = None,
    ) -> Futures:
        """Rolls out from the belief while agent 0 follows each plan; all samples are equal."""
        now: Internal = belief.internal
        future = self.continue_from(
            now.next_states, belief.valid, now.pairs, now.scores, now.nodes, plans.shape[2], self.expected, plans
        )
        each = future.unflatten(0, plans.shape[:2])[:, :, None]
        return Futures(each.expand(-1, -1, num_samples, -1, -1, -1))

    # --- Training -----------------------------------------------------------------------------------------------

    def window(
        self,
        states: Float[Tensor, "batch time agents state"],
        valid: Bool[Tensor, "batch time agents"],
        last_observed: Int[Tensor, " batch"],
        rollout_steps: int,
        generator: TrainingNoise | None = None,
    ) -> WindowOutput:
        """Runs the teacher-forced pass and the roll-out from its memory; see `TrainableForecaster.window`."""
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
        weights: Float[Tensor, "batch time agents agents weights"],
        nodes: Tensors,
    ) -> Tensors:
        """Computes node memory before the first step and after each one, [batch time+1 agents _]."""
        kept = [nodes]
        # unbind, not [:, t]: the gradient of an index is a full-size tensor of zeros for every step
        for now, present, edges in zip(inputs.unbind(1), valid.unbind(1), weights.unbind(1), strict=True):
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
        rule: WeightRule,
        plans: Float[Tensor, "batch plans horizon state"] | None = None,
    ) -> Float[Tensor, "batch_and_plans agents horizon state"]:
        """Rolls out from the states predicted for the first step; all present agents stay.

        With plans, agent 0 follows them, and each scene is rolled out once for each of its plans.
        """
        if plans is not None:
            count, plan = plans.shape[1], plans.flatten(0, 1)
            states, valid, scores = (t.repeat_interleave(count, dim=0) for t in (states, valid, scores))
            pairs, nodes = (tuple(t.repeat_interleave(count, dim=0) for t in ts) for ts in (pairs, nodes))
            states = with_ego(states, plan[:, 0])
        future = [states]
        for step in range(1, horizon_steps):
            inputs = self.codec.inputs(states, valid)
            pairs, scores = self.evolve(inputs, valid, pairs, scores)
            nodes = self.recur(inputs, valid, rule(scores), nodes)
            states = self.codec.advance(states, self.change(inputs, valid, nodes))
            states = states if plans is None else with_ego(states, plan[:, step])
            future.append(states)
        return torch.stack(future, dim=2)[:, :, :horizon_steps]


def mean_weight(valid: Bool[Tensor, "*batch agents"], dtype: torch.dtype) -> Float[Tensor, "*batch agents agents"]:
    """Returns 1 / (number of other present agents) per present pair: Σ_j w_ij x_ij is a mean, 0 if there are none."""
    pairs = pair_mask(valid).to(dtype)
    return pairs / pairs.sum(-1, keepdim=True).clamp(min=1)


def check_sizes(config: object, *names: str) -> None:
    """Checks that fields with closed choices have one of them and that the named fields are at least 1.

    Raises:
        UserError: a field is out of range.
    """
    check_choices(config)
    check_at_least(config, 1, *names)
    check_at_most(config, MOST_WIDTH, *names)
    check_scale_values(config, "delta_scales")
