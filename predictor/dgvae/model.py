"""The dG-VAE (paper Sec. IV): an encoder infers edges and their features, a decoder predicts motion from them.

Encoder: linear embedding → EdgeConv → edge embedding → forward LSTM per pair → learned prior and edge features;
forward ‖ backward LSTM → posterior (training only). Decoder: messages along sampled edges, with edge features → GRU →
change of state. `observe` and `rollout` make it a `Forecaster`; `window` is the pass of training; all use the same
layers and differ only in the number of steps that they compute at once. Without gradients, single steps go through
`predictor.dgvae.single_step`, which needs fewer operations for the same result.

Two things that the paper leaves open are settled here. Without edges an agent's own state would be no input of its
decoder, so a linear term of that state is added to the messages. And during the observed history the edges' weights are
the prior's probabilities, so that one history gives one memory; samples are drawn from the first forecast step on.
"""

from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from predictor.dgvae.networks import (
    PRESETS,
    Decoder,
    DGVAEConfig,
    Encoder,
    concrete_sample,
    edge_probabilities,
    no_edge_where_absent,
)
from predictor.dgvae.packing import Packed, Padded
from predictor.dgvae.pair_matching import running_mean, running_mean_step, window_mean
from predictor.dgvae.single_step import Encoding, Internal, Layers, Modules, Past, Stepper, differentiable, unpacked
from predictor.forecaster import Belief, Memory, WindowOutput
from predictor.graph import NO_AGENT, among_nearest, nearest, off_diagonal, others, pair_mask, with_diagonal
from predictor.layers.rnn import masked_gru
from predictor.layers.state_codec import StateCodec, check_scales
from predictor.noise import Noise, PairNoise, noise_of_pairs
from predictor.scene import SceneSpec
from predictor.support.errors import UserError


class DGVAE(nn.Module):
    """The dG-VAE, as a `Forecaster` and as the forward pass of training.

    Forecasts are differentiable, also by `torch.func`; float64 makes Jacobians exact:

        >>> model = DGVAE(SceneSpec(dt_s=1.0, max_agents=3), PRESETS["fast"]).double().eval()
        >>> observe = lambda states: model.observe(model.empty_memory(1, 3), states, torch.ones(1, 3).bool())[1]
        >>> forecast = lambda states: model.rollout(observe(states), horizon_steps=2)[0, 0]
        >>> torch.func.jacrev(forecast)(torch.ones(1, 3, 4).double()).shape  # (agent, step, state) by observed state
        torch.Size([3, 2, 4, 1, 3, 4])

    Args:
        spec: layout of the scenes.
        config: sizes and variants of the network.
        horizon_steps: number of steps that it is trained to forecast.
    """

    def __init__(self, spec: SceneSpec, config: DGVAEConfig = PRESETS["paper"], horizon_steps: int = 5) -> None:
        """Builds the network; weights are drawn from torch's generator, so seed it first."""
        super().__init__()
        self.spec = spec
        self.config = config
        self.horizon_steps = horizon_steps
        self.codec = StateCodec(spec, config.delta_scales, config.residual, config.input_scales)
        self.sees_changes = bool(config.change_scales)
        if self.sees_changes:
            check_scales("change_scales", config.change_scales, spec)
        inputs = self.codec.num_inputs
        self.encoder = Encoder(config, inputs + spec.num_features * self.sees_changes)
        self.decoder = Decoder(config, inputs, spec.num_features)
        self._per_change: Tensor
        per_change = self.codec.scales / torch.tensor(config.change_scales) if self.sees_changes else torch.ones(0)
        self.register_buffer("_per_change", per_change, persistent=False)
        self._stepper: Stepper | None = None

    @property
    def num_edge_types(self) -> int:
        """Number of edge types, "no edge" included."""
        return self.config.num_edge_types

    @property
    def edge_feature_dim(self) -> int:
        """Number of features of an edge."""
        return self.config.edge_feature_dim

    def variant(self, **changes: Any) -> "DGVAE":
        """Returns a model with these weights and a changed config.

        The weights fit any value of `num_neighbours`, `rollout_graph`, `temperature` and `hard_samples`.

        Raises:
            UserError: an unknown field, or the weights do not fit the changed config.
        """
        unknown = sorted(set(changes) - {f.name for f in fields(self.config)})
        if unknown:
            raise UserError(f"DGVAEConfig has no field '{unknown[0]}'")
        with torch.random.fork_rng(devices=[]):  # the initial weights are not kept
            other = DGVAE(self.spec, replace(self.config, **changes), self.horizon_steps).to(self.codec.scales)
        try:
            other.load_state_dict(self.state_dict())
        except RuntimeError as error:
            raise UserError(f"a network with {changes} has other weights; train one instead") from error
        return other.train(self.training).requires_grad_(next(self.parameters()).requires_grad)

    def train(self, mode: bool = True) -> "DGVAE":
        """Sets training mode as in any module, and deletes the folded weights."""
        self._stepper = None
        return super().train(mode)

    # --- Forecaster ---------------------------------------------------------------------------------------------

    def empty_memory(self, batch: int, agents: int) -> Memory:
        """Returns zeros on the model's device."""
        near = self.config.num_neighbours
        nodes, pairs = self._zero_memory(batch, agents, near or agents)
        senders = torch.full((batch, agents, near), NO_AGENT, device=nodes[0].device) if near else None
        return Memory(nodes, pairs, senders)

    def observe(
        self, memory: Memory, states: Float[Tensor, "batch agents state"], valid: Bool[Tensor, "batch agents"]
    ) -> tuple[Memory, Belief]:
        """Computes one encoder step and one decoder step along the prior's edge probabilities."""
        padded = self._graph_now(states, valid)
        if padded.senders is not None:
            memory = memory.to_slots(padded.senders, padded.present)
        layers = self._layers()
        graph: Padded | Packed = Packed.of(padded, valid) if isinstance(layers, Stepper) else padded
        (node, seen), pairs = memory.nodes, memory.pairs
        node_before, (hidden, cell, static) = graph.pack_nodes(node), map(graph.pack_pairs, pairs)
        past, logits, features = self._encode_step(layers, states, valid, graph, Past(hidden, cell, static, seen))
        probs = edge_probabilities(logits)
        node_after, next_states = self._move(layers, states, valid, graph, probs, features, node_before)
        known = Internal(layers, graph, past, logits, probs, features, node_before, node_after, next_states)
        remembered = tuple(graph.unpack_pairs(t) for t in (past.hidden, past.cell, past.static))
        after = Memory((graph.unpack_nodes(node_after), past.seen), remembered, memory.senders)
        shown = graph.unpack_pairs(probs, no_edge=True), graph.unpack_pairs(features)
        return after, Belief(states, valid, *shown, known, memory.senders)

    def rollout(
        self, belief: Belief, horizon_steps: int, num_samples: int = 1, generator: Noise | None = None
    ) -> Float[Tensor, "batch samples agents horizon state"]:
        """Rolls out, encoding predictions so that edges evolve; sample 0 uses edge probabilities, others draw types."""
        known: Internal = belief.internal
        if differentiable():  # the history may have been observed without gradients
            known = unpacked(known, self._plain())
        layers, graph, edges = known.layers, known.graph, (known.probs, known.features)
        future = self._continue(
            layers, known.next_states, belief.valid, graph, known.past, known.node_after, edges, horizon_steps, None
        )
        if num_samples == 1:
            return future[:, None]
        draws = num_samples - 1
        steps = horizon_steps if self.config.rollout_graph == "evolving" else 1
        noise = noise_of_pairs(generator, graph.pairs_there, draws, steps, self.num_edge_types)
        states, valid, seen = (
            t.repeat_interleave(draws, dim=0) for t in (belief.states, belief.valid, known.past.seen)
        )
        hidden, cell, static, features, logits = (
            graph.repeat_pairs(t, draws)
            for t in (known.past.hidden, known.past.cell, known.past.static, known.features, known.logits)
        )
        node = graph.repeat_nodes(known.node_before, draws)
        drawn = self._free_run(
            layers, states, valid, graph.repeat(draws), features, Past(hidden, cell, static, seen), node, logits,
            horizon_steps, self._sampler(noise),
        )  # fmt: skip
        return torch.cat([future[:, None], drawn.unflatten(0, (len(future), draws))], dim=1)

    # --- Training -----------------------------------------------------------------------------------------------

    def window(
        self,
        states: Float[Tensor, "batch time agents state"],
        valid: Bool[Tensor, "batch time agents"],
        last_observed: Int[Tensor, " batch"],
        rollout_steps: int,
        generator: torch.Generator | None = None,
    ) -> WindowOutput:
        """Runs a teacher-forced pass under the posterior and a roll-out under the prior, from the same encoding."""
        inputs, graph = self.codec.inputs(states, valid), self._graph_of_window(states, valid)
        (node, seen), pairs = self._zero_memory(states.shape[0], states.shape[2], graph.present.shape[-1])
        edges, features, past = self._encode(inputs, valid, graph, Past(*pairs, seen))
        posterior = self.encoder.posterior_logits(edges, graph.present)
        sampled = self._sampler(generator)(posterior)
        shown = self._match_window(edges.features, features, graph.present)
        layer = self.decoder.pair_layer(inputs, shown, graph.senders)
        messages = self.decoder.combine(inputs, layer, graph.present, sampled)
        nodes = masked_gru(messages, self.decoder.gru, valid, node)
        change = self.decoder.change(nodes)
        one_step = self._integrate(self._plain(), states, valid, graph, sampled, shown, change, messages)
        outputs = self._dense(graph, edges.prior_logits, posterior, shown)
        if not rollout_steps:
            return WindowOutput(one_step, states.new_zeros(len(states), states.shape[2], 0, states.shape[3]), *outputs)

        # the longest history; reading it from a GPU would wait for the device
        steps = states.shape[1] if last_observed.is_cuda else int(last_observed.max())
        expected = edge_probabilities(edges.prior_logits[:, :steps])
        if shown is not features:
            layer = self.decoder.pair_layer(inputs, features, graph.senders)
        messages = self.decoder.combine(inputs[:, :steps], layer[:, :steps], graph.present[:, :steps], expected)
        remembered = masked_gru(messages, self.decoder.gru, valid[:, :steps], node)
        burned_in = torch.cat([node[:, None], remembered], dim=1)
        now = (torch.arange(len(states), device=states.device), last_observed)
        future = self._free_run(
            self._plain(), states[now], valid[now], Padded(graph.present[now], graph.senders), features[now],
            Past(*(t[now] for t in past)), burned_in[now], edges.prior_logits[now], rollout_steps,
            self._sampler(generator),
        )  # fmt: skip
        return WindowOutput(one_step, future, *outputs)

    def _graph_of_window(self, states: Tensor, valid: Tensor) -> Padded:
        """Returns the pairs of each step: each agent with all others, or dense where the encoder needs that."""
        present, near = pair_mask(valid), self.config.num_neighbours
        if near:
            present = present & among_nearest(states[..., : self.spec.position_dim].detach(), valid, near)
        if self.config.innovation_rounds or valid.shape[-1] == 1:
            return Padded(present, None)
        return Padded(off_diagonal(present), others(valid.shape[-1], valid.device))

    def _dense(self, graph: Padded, prior: Tensor, posterior: Tensor, features: Tensor) -> tuple[Tensor, ...]:
        """Converts a window's pair outputs to dense ones; diagonal entries are "no edge" and zeros."""
        if graph.senders is None:
            return prior, posterior, features
        nothing = features.new_zeros(features.shape[-1])
        no_edge = no_edge_where_absent(prior.new_zeros(prior.shape[-1]), graph.present.new_zeros(1))
        return with_diagonal(prior, no_edge), with_diagonal(posterior, no_edge), with_diagonal(features, nothing)

    # --- Shared -------------------------------------------------------------------------------------------------

    def _graph_now(self, states: Tensor, valid: Tensor) -> Padded:
        near = self.config.num_neighbours
        if not near:
            return Padded(pair_mask(valid), None)
        senders, present = nearest(states[..., : self.spec.position_dim].detach(), valid, near)
        return Padded(present, senders)

    def _zero_memory(
        self, batch: int, agents: int, slots: int
    ) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor, Tensor]]:
        """Returns node and pair memory before any observation."""
        zeros, config = self.codec.scales.new_zeros, self.config
        pair = zeros(batch, agents, slots, config.rnn_dim)
        static = zeros(batch, agents, slots, config.static_dim + 1 if config.static_dim else 0)
        seen = zeros(batch, agents, self.codec.num_inputs + 1 if self.sees_changes else 0)
        return (zeros(batch, agents, config.decoder_dim), seen), (pair, pair.clone(), static)

    def _sampler(self, noise: torch.Generator | PairNoise | None) -> Callable[[Tensor], Tensor]:
        return lambda logits: concrete_sample(logits, self.config.temperature, noise, self.config.hard_samples)

    def _plain(self) -> Layers:
        return Modules(self.encoder, self.decoder)

    def _layers(self) -> Layers:
        """Returns the layers for single steps: with gradients the modules themselves, else folded weights."""
        dropout = self.encoder.dropout.training and self.config.dropout > 0
        if differentiable() or dropout or self.config.innovation_rounds:
            return self._plain()
        if self._stepper is None or not self._stepper.is_current(self.encoder, self.decoder):
            self._stepper = Stepper(self.encoder, self.decoder)
        return self._stepper

    def _encode(self, inputs: Tensor, valid: Tensor, graph: Padded, past: Past) -> Encoding:
        """Encodes several steps after `past`."""
        inputs, seen = self._with_changes(inputs, valid, past.seen)
        edges = self.encoder(inputs, graph.present, past.hidden, past.cell, graph.senders)
        features, static = self._match(edges.features, graph.present, past.static)
        return Encoding(edges, features, Past(edges.hidden, edges.cell, static, seen))

    def _encode_step(
        self, layers: Layers, states: Tensor, valid: Tensor, graph: Padded | Packed, past: Past
    ) -> tuple[Past, Tensor, Tensor]:
        """Encodes one step: returns memory, prior logits and features after it."""
        inputs, seen = self.codec.inputs(states, valid), past.seen
        if self.sees_changes:
            steps, after = self._with_changes(inputs[:, None], valid[:, None], seen)
            inputs, seen = steps[:, 0], after[:, 0]
        inputs = graph.pack_nodes(inputs)
        hidden, cell, logits, features = layers.encode(inputs, graph, past.hidden, past.cell)
        static = past.static
        if self.config.static_dim:
            first = features[..., : self.config.static_dim]
            static = running_mean_step(first, graph.among_pairs(static), static)
            features = torch.cat([static[..., :-1], features[..., self.config.static_dim :]], dim=-1)
        return Past(hidden, cell, static, seen), logits, features

    def _with_changes(self, inputs: Tensor, valid: Tensor, before: Tensor) -> tuple[Tensor, Tensor]:
        """Returns the encoder's inputs at several steps, and its memory of each one for the next."""
        if not self.sees_changes:
            return inputs, inputs.new_zeros(*inputs.shape[:-1], 0)
        seen = torch.cat([inputs, torch.ones_like(inputs[..., :1])], dim=-1) * valid[..., None]
        earlier = torch.cat([before[:, None], seen[:, :-1]], dim=1)
        known = earlier[..., -1:] * valid[..., None]
        features = self.spec.num_features
        changes = (inputs[..., :features] - earlier[..., :features]) * self._per_change * known
        return torch.cat([inputs, changes], dim=-1), seen

    def _match(self, features: Tensor, present: Tensor, before: Tensor) -> tuple[Tensor, Tensor]:
        """Computes causal pair matching: features with running means as static dimensions, and these means."""
        static = self.config.static_dim
        if not static:
            return features, features.new_zeros(*present.shape, 0)
        mean = running_mean(features[..., :static], present, before)
        return torch.cat([mean[..., :-1], features[..., static:]], dim=-1), mean

    def _match_window(self, features: Tensor, causal: Tensor, present: Tensor) -> Tensor:
        """Returns features for the teacher-forced pass, with static ones from the whole window if so configured."""
        static = self.config.static_dim
        if not static or self.config.pair_matching == "causal":
            return causal
        return torch.cat([window_mean(features[..., :static], present), features[..., static:]], dim=-1)

    def _move(
        self,
        layers: Layers,
        states: Tensor,
        valid: Tensor,
        graph: Padded | Packed,
        weights: Tensor,
        features: Tensor,
        node: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """Computes one decoder step: GRU states after it, and the next states."""
        inputs = graph.pack_nodes(self.codec.inputs(states, valid))
        node, messages = layers.decode(inputs, graph, weights, features, node)
        node = graph.forget_absent(node, valid)
        change = graph.unpack_nodes(self.decoder.change(node))
        return node, self._integrate(layers, states, valid, graph, weights, features, change, messages)

    def _integrate(
        self,
        layers: Layers,
        states: Tensor,
        valid: Tensor,
        graph: Padded | Packed,
        weights: Tensor,
        features: Tensor,
        change: Tensor,
        messages: Tensor | None,
    ) -> Float[Tensor, "*batch agents state"]:
        """Computes the states one step later; with substeps, messages are evaluated again as the agents move."""
        substeps = self.config.substeps
        if not substeps:
            return self.codec.advance(states, change)
        assert messages is not None
        for substep in range(substeps):
            if substep:
                inputs = graph.pack_nodes(self.codec.inputs(states, valid))
                messages = layers.messages(inputs, graph, weights, features)
            pushed = graph.unpack_nodes(self.decoder.direct(messages))
            states = self.codec.advance(states, change + pushed, 1 / substeps)
        return states

    def _free_run(
        self,
        layers: Layers,
        states: Tensor,
        valid: Tensor,
        graph: Padded | Packed,
        features: Tensor,
        past: Past,
        node: Tensor,
        logits: Tensor,
        horizon_steps: int,
        sampler: Callable[[Tensor], Tensor],
    ) -> Float[Tensor, "batch agents horizon state"]:
        """Rolls out from an observation before its decoder step."""
        drawn = graph.per_pair(sampler, logits)
        node, states = self._move(layers, states, valid, graph, drawn, features, node)
        return self._continue(layers, states, valid, graph, past, node, (drawn, features), horizon_steps, sampler)

    def _continue(
        self,
        layers: Layers,
        states: Tensor,
        valid: Tensor,
        graph: Padded | Packed,
        past: Past,
        node: Tensor,
        edges: tuple[Tensor, Tensor],
        horizon_steps: int,
        sampler: Callable[[Tensor], Tensor] | None,
    ) -> Float[Tensor, "batch agents horizon state"]:
        """Rolls out from predicted states; without a sampler along edge probabilities.

        The observed pairs stay; `edges` are weights and features, kept if frozen.
        """
        future, (weights, features) = [states], edges
        for _ in range(horizon_steps - 1):
            if self.config.rollout_graph == "evolving":
                past, logits, features = self._encode_step(layers, states, valid, graph, past)
                weights = edge_probabilities(logits) if sampler is None else graph.per_pair(sampler, logits)
            node, states = self._move(layers, states, valid, graph, weights, features, node)
            future.append(states)
        return torch.stack(future, dim=2)[:, :, :horizon_steps]
