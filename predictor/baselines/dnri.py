"""dNRI (Graber & Schwing, "Dynamic Neural Relational Inference", CVPR 2020) for scenes whose agents come and go.

Encoder per frame: agent → pair → agent → pair; then a forward LSTM per pair for the learned prior, and a reverse one
for the posterior (training only). Decoder: messages from its own hidden states along sampled edges, none along type 0;
gated update; change of state. The loss is `predictor.training.objective`.

Unlike the public code for a varying number of agents: the forward memory of a pair is kept from step to step, in
training as in prediction, and the reverse LSTM is run; future presence is not used when forecasting; a frame without
agents counts as a frame. Batch normalisation is left out (see `predictor.baselines.nri_blocks`). During the observed
history the edge weights are the prior's probabilities and not a draw, as in `predictor.dgvae`; samples are drawn from
the first forecast step on.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from predictor.baselines.base import (
    Encoded,
    Internal,
    Tensors,
    UnrolledForecaster,
    WeightRule,
    check_sizes,
    mean_weight,
)
from predictor.baselines.nri_blocks import FrameEncoder, HiddenDecoder, PairLSTM, elu_head
from predictor.dgvae.networks import concrete_sample, no_edge_where_absent
from predictor.forecaster import Belief, Futures, WindowOutput
from predictor.graph import pair_mask
from predictor.layers.state_codec import Residual
from predictor.noise import Noise, NoiseOfPairs, RepeatedNoise, TrainingNoise, noise_of_pairs, repeat_scenes
from predictor.scene import SceneSpec
from predictor.support.config_checks import MOST_PARTS, check_at_most
from predictor.support.errors import UserError


@dataclass(frozen=True)
class DNRIConfig:
    """Sizes of the network; the defaults are those of the public run scripts."""

    hidden_dim: int = 256
    """Width of the encoder's frame embedding."""
    rnn_dim: int = 64
    """Width of the LSTMs of each pair."""
    head_dim: int = 128
    """Hidden width of the prior and posterior heads."""
    decoder_dim: int = 256
    """Width of the memory of each agent."""
    message_dim: int = 256
    """Width of the decoder's messages."""
    num_edge_types: int = 2
    """Number of edge types; the first one is "no edge" and sends no message."""
    temperature: float = 0.5
    """Temperature of the concrete distribution."""
    hard_samples: bool = False
    """Whether one type per pair is drawn instead of a mixture, with the gradient of the mixture (straight-through)."""
    residual: Residual = "state"
    """Position to which the predicted change is added; see `predictor.layers.state_codec`."""
    delta_scales: tuple[float, ...] = ()
    """Typical one-step change of each feature [SI]; empty takes the spec's feature scales."""

    def __post_init__(self) -> None:
        """Checks ranges."""
        check_sizes(self, "hidden_dim", "rnn_dim", "head_dim", "decoder_dim", "message_dim")
        check_at_most(self, MOST_PARTS, "num_edge_types")
        if self.num_edge_types < 2:
            raise UserError(f"num_edge_types must be at least 2 (the first is 'no edge'), got {self.num_edge_types}")
        if not 0 < self.temperature < math.inf:
            raise UserError(f"temperature must be positive, got {self.temperature}")


class Edges(NamedTuple):
    """Encoder outputs for several steps."""

    hidden: Float[Tensor, "batch time agents agents rnn"]
    cell: Float[Tensor, "batch time agents agents rnn"]
    prior_logits: Float[Tensor, "batch time agents agents types"]
    embedding: Float[Tensor, "batch time agents agents hidden"]


class DNRIEncoder(nn.Module):
    """Computes logits of edge types from states."""

    def __init__(self, config: DNRIConfig, inputs: int) -> None:
        """Creates the layers, in the order in which data passes them."""
        super().__init__()
        self.frames = FrameEncoder(inputs, config.hidden_dim)
        self.forward_rnn = PairLSTM(config.hidden_dim, config.rnn_dim)
        self.reverse_rnn = PairLSTM(config.hidden_dim, config.rnn_dim)
        self.prior_head = elu_head(config.rnn_dim, config.head_dim, config.num_edge_types)
        self.posterior_head = elu_head(2 * config.rnn_dim, config.head_dim, config.num_edge_types)

    def forward(
        self,
        inputs: Float[Tensor, "batch time agents inputs"],
        valid: Bool[Tensor, "batch time agents"],
        hidden: Float[Tensor, "batch agents agents rnn"],
        cell: Float[Tensor, "batch agents agents rnn"],
    ) -> Edges:
        """Runs the forward LSTM from a given memory."""
        embedding = self.frames(inputs, valid)
        hiddens, cells = self.forward_rnn(embedding, valid, hidden, cell)
        logits = no_edge_where_absent(self.prior_head(hiddens), pair_mask(valid)[..., None])
        return Edges(hiddens, cells, logits, embedding)

    def posterior_logits(
        self, edges: Edges, valid: Bool[Tensor, "batch time agents"]
    ) -> Float[Tensor, "batch time agents agents types"]:
        """Computes the posterior logits, from past and future; training only."""
        zeros = torch.zeros_like(edges.hidden[:, 0])
        reverse, _ = self.reverse_rnn(edges.embedding, valid, zeros, zeros, reverse=True)
        logits = self.posterior_head(torch.cat([edges.hidden, reverse], dim=-1))
        return no_edge_where_absent(logits, pair_mask(valid)[..., None])


class DNRI(UnrolledForecaster):
    """The dNRI model, as a `TrainableForecaster`.

    Args:
        spec: layout of the scenes.
        config: sizes of the network.
        horizon_steps: number of steps that it is trained to forecast.
    """

    def __init__(self, spec: SceneSpec, config: DNRIConfig | None = None, horizon_steps: int = 5) -> None:
        """Builds the network; weights are drawn from torch's generator, so seed it first."""
        config = config or DNRIConfig()
        super().__init__(spec, config.residual, config.delta_scales, horizon_steps)
        self.config = config
        self.num_edge_types = config.num_edge_types
        self.node_sizes = (config.decoder_dim,)
        self.pair_sizes = (config.rnn_dim, config.rnn_dim)
        inputs = self.codec.num_inputs
        self.encoder = DNRIEncoder(config, inputs)
        sending = config.num_edge_types - 1
        self.decoder = HiddenDecoder(inputs, config.decoder_dim, config.message_dim, sending, spec.num_features)

    # --- Functions of a model -----------------------------------------------------------------------------------

    def encode(
        self,
        inputs: Float[Tensor, "batch time agents inputs"],
        valid: Bool[Tensor, "batch time agents"],
        pairs: Tensors,
    ) -> Encoded:
        """Computes prior logits and the forward LSTM's memory."""
        edges = self.encoder(inputs, valid, *pairs)
        return Encoded((edges.hidden, edges.cell), edges.prior_logits)

    def expected(self, scores: Float[Tensor, "*batch types"]) -> Float[Tensor, "*batch types"]:
        """Computes the prior's probabilities."""
        return torch.softmax(scores, dim=-1)

    def drawn(self, generator: NoiseOfPairs | None) -> WeightRule:
        """Returns a rule that draws edge weights."""

        def draw(logits: Tensor) -> Tensor:
            return concrete_sample(logits, self.config.temperature, generator, self.config.hard_samples)

        return draw

    def edge_probs(
        self, weights: Float[Tensor, "batch agents agents types"], valid: Bool[Tensor, "batch agents"]
    ) -> Float[Tensor, "batch agents agents types"]:
        """Returns the weights, which are probabilities of edge types."""
        return weights

    def recur(
        self,
        inputs: Float[Tensor, "batch agents inputs"],
        valid: Bool[Tensor, "batch agents"],
        weights: Float[Tensor, "batch agents agents types"],
        nodes: Tensors,
    ) -> Tensors:
        """Updates agents by messages averaged over the other agents and over the types that send messages."""
        shares = weights[..., 1:] * mean_weight(valid, inputs.dtype)[..., None] / (self.num_edge_types - 1)
        return (self.decoder.step(inputs, valid, shares, nodes[0]),)

    def change(
        self, inputs: Float[Tensor, "*batch agents inputs"], valid: Bool[Tensor, "*batch agents"], nodes: Tensors
    ) -> Float[Tensor, "*batch agents state"]:
        """Computes the change of state from the decoder's memory."""
        change: Tensor = self.decoder.readout(nodes[0])
        return change

    # --- Forecaster ---------------------------------------------------------------------------------------------

    def rollout(
        self, belief: Belief, horizon_steps: int, num_samples: int = 1, generator: Noise | None = None
    ) -> Futures:
        """Rolls out, encoding the predictions; sample 0 uses edge probabilities, the others draw edge types."""
        expected = super().rollout(belief, horizon_steps)
        if num_samples == 1:
            return expected
        drawn = self._drawn_futures(belief, horizon_steps, num_samples - 1, generator)
        return Futures(torch.cat([expected.states, drawn], dim=1))

    def rollout_plans(
        self,
        belief: Belief,
        plans: Float[Tensor, "batch plans horizon state"],
        num_samples: int = 1,
        generator: Noise | None = None,
    ) -> Futures:
        """Rolls out while agent 0 follows each plan; samples as those of `rollout`, the same draws for each plan."""
        expected = super().rollout_plans(belief, plans)
        if num_samples == 1:
            return expected
        drawn = self._drawn_futures(belief, plans.shape[2], num_samples - 1, generator, plans)
        drawn = drawn.unflatten(1, (num_samples - 1, plans.shape[1])).transpose(1, 2)
        return Futures(torch.cat([expected.states, drawn], dim=2))

    def _drawn_futures(
        self,
        belief: Belief,
        horizon_steps: int,
        draws: int,
        generator: Noise | None,
        plans: Float[Tensor, "batch plans horizon state"] | None = None,
    ) -> Float[Tensor, "batch branches agents horizon state"]:
        """Rolls out with drawn edge types; branches are the draws, and within each of them the plans."""
        now: Internal = belief.internal
        noise = noise_of_pairs(generator, pair_mask(belief.valid), draws, horizon_steps, self.num_edge_types)
        later = None if plans is None else self.drawn(RepeatedNoise(noise, *repeat_scenes(plans.shape[1])))

        def repeat(*tensors: Tensor) -> Tensors:
            return tuple(t.repeat_interleave(draws, dim=0) for t in tensors)

        states, valid, scores = repeat(belief.states, belief.valid, now.scores)
        if plans is not None:
            (plans,) = repeat(plans)
        memory, before, rule = repeat(*now.pairs), repeat(*now.before), self.drawn(noise)
        futures = self._branch(states, valid, memory, scores, before, horizon_steps, rule, later, plans)
        return futures.unflatten(0, (len(belief.states), -1))

    # --- Training -----------------------------------------------------------------------------------------------

    def window(
        self,
        states: Float[Tensor, "batch time agents state"],
        valid: Bool[Tensor, "batch time agents"],
        last_observed: Int[Tensor, " batch"],
        rollout_steps: int,
        generator: TrainingNoise | None = None,
    ) -> WindowOutput:
        """Runs a teacher-forced pass along posterior draws and a roll-out along prior draws, from the same encoding."""
        inputs = self.codec.inputs(states, valid)
        empty = self.empty_memory(states.shape[0], states.shape[2])
        edges = self.encoder(inputs, valid, *empty.pairs)
        posterior = self.encoder.posterior_logits(edges, valid)
        draw = self.drawn(generator)
        (nodes,) = self.remember(inputs, valid, draw(posterior), empty.nodes)
        one_step = self.codec.advance(states, self.change(inputs, valid, (nodes[:, 1:],)))
        rollout = one_step.new_zeros(*states[:, 0].shape[:2], 0, states.shape[-1])
        if rollout_steps:
            # the longest history; reading it from a GPU would wait for the device
            past = slice(states.shape[1] if last_observed.is_cuda else int(last_observed.max()))
            expected = self.expected(edges.prior_logits[:, past])
            (before,) = self.remember(inputs[:, past], valid[:, past], expected, empty.nodes)
            now = (torch.arange(len(states), device=states.device), last_observed)
            memory = (edges.hidden[now], edges.cell[now])
            rollout = self._branch(
                states[now], valid[now], memory, edges.prior_logits[now], (before[now],), rollout_steps, draw
            )
        return WindowOutput(one_step, rollout, edges.prior_logits, posterior)

    def _branch(
        self,
        states: Tensor,
        valid: Tensor,
        pairs: Tensors,
        scores: Tensor,
        before: Tensors,
        horizon_steps: int,
        rule: WeightRule,
        later_rule: WeightRule | None = None,
        plans: Float[Tensor, "batch plans horizon state"] | None = None,
    ) -> Float[Tensor, "batch_and_plans agents horizon state"]:
        """Rolls out from an observation before its decoder step, with edge weights of a given rule.

        With plans, the weights of all steps but the first, which does not depend on plans, follow the later rule.
        """
        inputs = self.codec.inputs(states, valid)
        nodes = self.recur(inputs, valid, rule(scores), before)
        states = self.codec.advance(states, self.change(inputs, valid, nodes))
        return self.continue_from(states, valid, pairs, scores, nodes, horizon_steps, later_rule or rule, plans)
