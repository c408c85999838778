"""The dG-VAE (paper Sec. IV): an encoder that infers edges and edge features, a decoder that moves agents along them.

Encoder: linear embedding → EdgeConv → edge embedding → forward LSTM per pair → learned prior and edge features;
forward ‖ backward LSTM → posterior (training only). Decoder: messages along sampled edges, with edge features → GRU →
change of state. `observe` and `rollout` make it a `Forecaster`; `window` is what training runs; both use the same
layers and differ only in how many steps enter at once.

Two things the paper leaves open are settled here. An agent without edges would not see itself, so the decoder adds a
linear term of the agent's own state to its messages. And while true states are fed, the graph is the prior's
expectation, so that a history has one meaning; samples branch off at the first forecast step.
"""

from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from predictor.codec import StateCodec
from predictor.disentangle import running_mean, window_mean
from predictor.errors import UserError
from predictor.forecaster import Belief, Memory, WindowOutput
from predictor.graph import pair_mask
from predictor.networks import PRESETS, Decoder, DGVAEConfig, Edges, Encoder, concrete_sample
from predictor.scene import SceneSpec

__all__ = ["DGVAE", "PRESETS", "DGVAEConfig", "Decoder", "Edges", "Encoder", "WindowOutput", "concrete_sample"]


class _Past(NamedTuple):
    """What the encoder remembers; tensors with a time axis, or without one."""

    hidden: Tensor
    cell: Tensor
    static: Tensor  # pair matching: mean and count (no column if off)
    seen: Tensor  # the latest inputs and a 1 (no column if changes are not looked at)


class _Encoding(NamedTuple):
    edges: Edges
    features: Tensor  # with the static dimensions averaged over the past of each step
    past: _Past  # after each step


class _Internal(NamedTuple):
    past: _Past
    logits: Tensor
    node_before: Tensor  # GRU state before the latest observation was decoded
    node_after: Tensor  # … and after, under the prior's expectation
    next_states: Tensor


class DGVAE(nn.Module):
    """The model, as a `Forecaster` and as a training objective's forward pass.

    Args:
        spec: layout of the scenes.
        config: sizes and variants.
        horizon_steps: steps it is trained to forecast.
    """

    def __init__(self, spec: SceneSpec, config: DGVAEConfig = PRESETS["paper"], horizon_steps: int = 5) -> None:
        """Build the network; weights come from torch's generator, so seed it first."""
        super().__init__()
        self.spec = spec
        self.config = config
        self.horizon_steps = horizon_steps
        self.codec = StateCodec(spec, config.delta_scales, config.residual, config.input_scales)
        self.sees_changes = bool(config.change_scales)
        if self.sees_changes and len(config.change_scales) != spec.num_features:
            raise UserError(f"change_scales needs {spec.num_features} numbers, got {config.change_scales}")
        inputs = self.codec.num_inputs
        self.encoder = Encoder(config, inputs + spec.num_features * self.sees_changes)
        self.decoder = Decoder(config, inputs, spec.num_features)
        self._per_change: Tensor
        per_change = self.codec.scales / torch.tensor(config.change_scales) if self.sees_changes else torch.ones(0)
        self.register_buffer("_per_change", per_change, persistent=False)

    @property
    def num_edge_types(self) -> int:
        """Edge types, "no edge" included."""
        return self.config.num_edge_types

    @property
    def edge_feature_dim(self) -> int:
        """Size of an edge's features."""
        return self.config.edge_feature_dim

    # --- Forecaster ---------------------------------------------------------------------------------------------

    def empty_memory(self, batch: int, agents: int) -> Memory:
        """Zeros on the model's device."""
        zeros = self.codec.scales.new_zeros
        pair = zeros(batch, agents, agents, self.config.rnn_dim)
        static = zeros(batch, agents, agents, self.config.static_dim + 1 if self.config.static_dim else 0)
        seen = zeros(batch, agents, self.codec.num_inputs + 1 if self.sees_changes else 0)
        return Memory(nodes=(zeros(batch, agents, self.config.decoder_dim), seen), pairs=(pair, pair.clone(), static))

    def observe(
        self, memory: Memory, states: Float[Tensor, "batch agents state"], valid: Bool[Tensor, "batch agents"]
    ) -> tuple[Memory, Belief]:
        """One encoder step and one decoder step under the prior's expected graph."""
        node_before, _ = memory.nodes
        past, logits, features = self._encode_step(states, valid, self._past(memory))
        probs = torch.softmax(logits, dim=-1)
        node_after, next_states = self._move(states, valid, probs, features, node_before)
        internal = _Internal(past, logits, node_before, node_after, next_states)
        after = Memory((node_after, past.seen), (past.hidden, past.cell, past.static))
        return after, Belief(states, valid, probs, features, internal)

    def rollout(
        self, belief: Belief, horizon_steps: int, num_samples: int = 1, generator: torch.Generator | None = None
    ) -> Float[Tensor, "batch samples agents horizon state"]:
        """Feed predictions back through the encoder, so that the graph evolves; sample 0 takes expected graphs."""
        known: _Internal = belief.internal
        futures = [self._continue(known.next_states, belief.valid, known.past, known.node_after, horizon_steps, None)]
        if num_samples > 1:
            draws = num_samples - 1
            states, valid, features, node, logits, *past = (
                t.repeat_interleave(draws, dim=0)
                for t in (
                    belief.states, belief.valid, belief.edge_features, known.node_before, known.logits, *known.past
                )
            )  # fmt: skip
            sampler = self._sampler(generator)
            futures.append(self._free_run(states, valid, features, _Past(*past), node, logits, horizon_steps, sampler))
        batch = len(belief.states)
        stacked = [f.unflatten(0, (batch, -1)) for f in futures]
        return torch.cat(stacked, dim=1) if num_samples > 1 else stacked[0]

    # --- Training -----------------------------------------------------------------------------------------------

    def window(
        self,
        states: Float[Tensor, "batch time agents state"],
        valid: Bool[Tensor, "batch time agents"],
        last_observed: Int[Tensor, " batch"],
        rollout_steps: int,
        generator: torch.Generator | None = None,
    ) -> WindowOutput:
        """Teacher-forced pass under the posterior and free-running roll-out under the prior, from the same encoding."""
        inputs, pairs = self.codec.inputs(states, valid), pair_mask(valid)
        memory = self.empty_memory(states.shape[0], states.shape[2])
        node, _ = memory.nodes
        edges, features, past = self._encode(inputs, valid, self._past(memory))
        posterior = self.encoder.posterior_logits(edges, pairs)
        sampled = self._sampler(generator)(posterior)
        shown = self._match_window(edges.features, features, pairs)
        messages = self.decoder.messages(inputs, pairs, sampled, shown)
        nodes = self._remember(messages, valid, node)
        one_step = self._integrate(states, valid, pairs, sampled, shown, nodes, messages)
        if not rollout_steps:
            nothing = states.new_zeros(len(states), states.shape[2], 0, states.shape[3])
            return WindowOutput(one_step, nothing, edges.prior_logits, posterior, shown)

        steps = int(last_observed.max())
        expected = torch.softmax(edges.prior_logits[:, :steps], dim=-1)
        messages = self.decoder.messages(inputs[:, :steps], pairs[:, :steps], expected, features[:, :steps])
        burned_in = torch.cat([node[:, None], self._remember(messages, valid[:, :steps], node)], dim=1)
        now = (torch.arange(len(states), device=states.device), last_observed)
        future = self._free_run(
            states[now], valid[now], features[now], _Past(*(t[now] for t in past)), burned_in[now],
            edges.prior_logits[now], rollout_steps, self._sampler(generator),
        )  # fmt: skip
        return WindowOutput(one_step, future, edges.prior_logits, posterior, shown)

    # --- Shared -------------------------------------------------------------------------------------------------

    def _past(self, memory: Memory) -> _Past:
        hidden, cell, static = memory.pairs
        return _Past(hidden, cell, static, memory.nodes[1])

    def _sampler(self, generator: torch.Generator | None) -> "_Sampler":
        return _Sampler(self.config.temperature, self.config.hard_samples, generator)

    def _encode(self, inputs: Tensor, valid: Tensor, past: _Past) -> _Encoding:
        """Encode a stretch of steps after `past`."""
        pairs, seen = pair_mask(valid), inputs.new_zeros(*inputs.shape[:-1], 0)
        if self.sees_changes:
            seen = torch.cat([inputs, torch.ones_like(inputs[..., :1])], dim=-1) * valid[..., None]
            before = torch.cat([past.seen[:, None], seen[:, :-1]], dim=1)
            known = before[..., -1:] * valid[..., None]
            features = self.spec.num_features
            changes = (inputs[..., :features] - before[..., :features]) * self._per_change * known
            inputs = torch.cat([inputs, changes], dim=-1)
        edges = self.encoder(inputs, pairs, past.hidden, past.cell)
        matched, static = edges.features, inputs.new_zeros(*pairs.shape, 0)
        if self.config.static_dim:
            static = running_mean(edges.features[..., : self.config.static_dim], pairs, past.static)
            matched = torch.cat([static[..., :-1], edges.features[..., self.config.static_dim :]], dim=-1)
        return _Encoding(edges, matched, _Past(edges.hidden, edges.cell, static, seen))

    def _encode_step(self, states: Tensor, valid: Tensor, past: _Past) -> tuple[_Past, Tensor, Tensor]:
        """The same for one step: memory, prior logits and features after it."""
        inputs = self.codec.inputs(states, valid)[:, None]
        edges, features, after = self._encode(inputs, valid[:, None], past)
        return _Past(*(t[:, 0] for t in after)), edges.prior_logits[:, 0], features[:, 0]

    def _match_window(self, features: Tensor, causal: Tensor, pairs: Tensor) -> Tensor:
        """Features for the teacher-forced pass: the static ones from the whole window, if the config asks for that."""
        static = self.config.static_dim
        if not static or self.config.pair_matching == "causal":
            return causal
        return torch.cat([window_mean(features[..., :static], pairs), features[..., static:]], dim=-1)

    def _remember(self, messages: Tensor, valid: Tensor, hidden: Tensor) -> Float[Tensor, "batch time agents decoder"]:
        """GRU states of all agents after each step."""
        nodes = []
        for message, present in zip(messages.unbind(1), valid.unbind(1), strict=True):
            hidden = self.decoder.step(message, present, hidden)
            nodes.append(hidden)
        return torch.stack(nodes, dim=1) if nodes else messages.new_zeros(len(hidden), 0, *hidden.shape[1:])

    def _move(
        self, states: Tensor, valid: Tensor, graph: Tensor, features: Tensor, node: Tensor
    ) -> tuple[Tensor, Tensor]:
        """One decoder step: GRU states after it, and the next states."""
        pairs = pair_mask(valid)
        messages = self.decoder.messages(self.codec.inputs(states, valid), pairs, graph, features)
        node = self.decoder.step(messages, valid, node)
        return node, self._integrate(states, valid, pairs, graph, features, node, messages)

    def _integrate(
        self,
        states: Tensor,
        valid: Tensor,
        pairs: Tensor,
        graph: Tensor,
        features: Tensor,
        node: Tensor,
        messages: Tensor,
    ) -> Float[Tensor, "*batch agents state"]:
        """States one step later; with substeps, messages are evaluated anew as the agents move."""
        change = self.decoder.change(node)
        substeps = self.config.substeps
        if not substeps:
            return self.codec.advance(states, change)
        for substep in range(substeps):
            if substep:
                messages = self.decoder.messages(self.codec.inputs(states, valid), pairs, graph, features)
            states = self.codec.advance(states, change + self.decoder.direct(messages), 1 / substeps)
        return states

    def _free_run(
        self,
        states: Tensor,
        valid: Tensor,
        features: Tensor,
        past: _Past,
        node: Tensor,
        logits: Tensor,
        horizon_steps: int,
        sampler: "_Sampler",
    ) -> Float[Tensor, "batch agents horizon state"]:
        """Roll out from an observation whose decoder step is still to be taken."""
        node, states = self._move(states, valid, sampler(logits), features, node)
        return self._continue(states, valid, past, node, horizon_steps, sampler)

    def _continue(
        self,
        states: Tensor,
        valid: Tensor,
        past: _Past,
        node: Tensor,
        horizon_steps: int,
        sampler: "_Sampler | None",
    ) -> Float[Tensor, "batch agents horizon state"]:
        """Roll out from predicted states; without a sampler along expected graphs."""
        future = [states]
        for _ in range(horizon_steps - 1):
            past, logits, features = self._encode_step(states, valid, past)
            graph = torch.softmax(logits, dim=-1) if sampler is None else sampler(logits)
            node, states = self._move(states, valid, graph, features, node)
            future.append(states)
        return torch.stack(future, dim=2)[:, :, :horizon_steps]


@dataclass(frozen=True)
class _Sampler:
    temperature: float
    hard: bool = False
    generator: torch.Generator | None = field(default=None)

    def __call__(self, logits: Tensor) -> Tensor:
        return concrete_sample(logits, self.temperature, self.generator, self.hard)
