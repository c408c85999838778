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

from predictor.errors import UserError
from predictor.forecaster import Belief, Memory
from predictor.graph import pair_mask
from predictor.networks import PRESETS, Decoder, DGVAEConfig, Edges, Encoder, concrete_sample
from predictor.scene import SceneSpec

__all__ = ["DGVAE", "PRESETS", "DGVAEConfig", "Decoder", "Edges", "Encoder", "WindowOutput", "concrete_sample"]


class WindowOutput(NamedTuple):
    """What the losses need from one training window."""

    one_step: Float[Tensor, "batch time agents state"]
    """Teacher-forced prediction of the next state under the posterior graph, for each step [SI]."""
    rollout: Float[Tensor, "batch agents horizon state"]
    """Free-running states after `last_observed`, under the prior graph [SI]."""
    prior_logits: Float[Tensor, "batch time agents agents types"]
    posterior_logits: Float[Tensor, "batch time agents agents types"]
    features: Float[Tensor, "batch time agents agents feature"]


class _Internal(NamedTuple):
    pair_hidden: Tensor
    pair_cell: Tensor
    node_before: Tensor  # GRU state before the latest observation was decoded
    logits: Tensor
    node_after: Tensor  # … and after, under the prior's expectation
    next_states: Tensor


class DGVAE(nn.Module):
    """The model, as a `Forecaster` and as a training objective's forward pass.

    Args:
        spec: layout of the scenes.
        config: sizes.
        horizon_steps: steps it is trained to forecast.
    """

    def __init__(self, spec: SceneSpec, config: DGVAEConfig = PRESETS["paper"], horizon_steps: int = 5) -> None:
        """Build the network; weights come from torch's generator, so seed it first."""
        super().__init__()
        self.spec = spec
        self.config = config
        self.horizon_steps = horizon_steps
        inputs = spec.num_features + int(spec.has_ego)
        self.encoder = Encoder(config, inputs)
        self.decoder = Decoder(config, inputs, spec.num_features)
        deltas = config.delta_scales or spec.feature_scales
        if len(deltas) != spec.num_features:
            raise UserError(f"delta_scales needs {spec.num_features} numbers, got {deltas}")
        self._scales: Tensor
        self._deltas: Tensor
        self._ego_axes: Tensor
        self.register_buffer("_scales", torch.tensor(spec.feature_scales), persistent=False)
        self.register_buffer("_deltas", torch.tensor(deltas), persistent=False)
        self.register_buffer("_ego_axes", torch.tensor([float(f == "ego") for f in spec.frame]), persistent=False)

    @property
    def num_edge_types(self) -> int:
        """Edge types, "no edge" included."""
        return self.config.num_edge_types

    @property
    def edge_feature_dim(self) -> int:
        """Size of an edge's features."""
        return self.config.edge_feature_dim

    def network_inputs(
        self, states: Float[Tensor, "*batch agents state"], valid: Bool[Tensor, "*batch agents"]
    ) -> Float[Tensor, "*batch agents inputs"]:
        """Scaled features in the spec's frame (re-centred on the ego at this very step), plus the ego's mark."""
        centre = states[..., :1, :2] * self._ego_axes
        inputs = torch.cat([states[..., :2] - centre, states[..., 2:]], dim=-1) / self._scales
        if self.spec.has_ego:
            mark = torch.zeros_like(inputs[..., :1])
            mark[..., 0, 0] = 1.0
            inputs = torch.cat([inputs, mark], dim=-1)
        return inputs * valid[..., None]

    def advance(
        self, states: Float[Tensor, "*batch state"], change: Float[Tensor, "*batch state"]
    ) -> Float[Tensor, "*batch state"]:
        """Next states [SI] from states and the decoder's change."""
        after = states + change * self._deltas
        if self.config.residual == "constant_velocity":
            drift = torch.cat([states[..., 2:4] * self.spec.dt_s, torch.zeros_like(states[..., 2:])], dim=-1)
            after = after + drift
        return after

    # --- Forecaster ---------------------------------------------------------------------------------------------

    def empty_memory(self, batch: int, agents: int) -> Memory:
        """Zeros on the model's device."""
        zeros = self._scales.new_zeros
        pair = zeros(batch, agents, agents, self.config.rnn_dim)
        return Memory(nodes=(zeros(batch, agents, self.config.decoder_dim),), pairs=(pair, pair.clone()))

    def observe(
        self, memory: Memory, states: Float[Tensor, "batch agents state"], valid: Bool[Tensor, "batch agents"]
    ) -> tuple[Memory, Belief]:
        """One encoder step and one decoder step under the prior's expected graph."""
        inputs, pairs = self.network_inputs(states, valid), pair_mask(valid)
        edges = self.encoder(inputs[:, None], pairs[:, None], *memory.pairs)
        hidden, cell, logits, features = (
            edges.hidden[:, 0],
            edges.cell[:, 0],
            edges.prior_logits[:, 0],
            edges.features[:, 0],
        )
        probs = torch.softmax(logits, dim=-1)
        (node_before,) = memory.nodes
        node_after = self.decoder.step(self.decoder.messages(inputs, pairs, probs, features), valid, node_before)
        next_states = self.advance(states, self.decoder.change(node_after))
        internal = _Internal(hidden, cell, node_before, logits, node_after, next_states)
        return Memory((node_after,), (hidden, cell)), Belief(states, valid, probs, features, internal)

    def rollout(
        self, belief: Belief, horizon_steps: int, num_samples: int = 1, generator: torch.Generator | None = None
    ) -> Float[Tensor, "batch samples agents horizon state"]:
        """Feed predictions back through the encoder, so that the graph evolves; sample 0 takes expected graphs."""
        internal: _Internal = belief.internal
        memory = (internal.pair_hidden, internal.pair_cell, internal.node_after)
        futures = [self._continue(internal.next_states, belief.valid, memory, horizon_steps, None)]
        if num_samples > 1:
            draws = num_samples - 1
            states, valid, features, hidden, cell, node, logits = (
                t.repeat_interleave(draws, dim=0)
                for t in (
                    belief.states, belief.valid, belief.edge_features,
                    internal.pair_hidden, internal.pair_cell, internal.node_before, internal.logits,
                )
            )  # fmt: skip
            sampler = _Sampler(self.config.temperature, generator)
            futures.append(
                self._free_run(states, valid, features, (hidden, cell, node), logits, horizon_steps, sampler)
            )
        batch = len(belief.states)
        stacked = [f.unflatten(0, (batch, -1)) for f in futures]
        return torch.cat(stacked, dim=1) if num_samples > 1 else stacked[0]

    # --- Training -----------------------------------------------------------------------------------------------

    def window(
        self,
        states: Float[Tensor, "batch time agents state"],
        valid: Bool[Tensor, "batch time agents"],
        last_observed: Int[Tensor, " batch"],
        generator: torch.Generator | None = None,
    ) -> WindowOutput:
        """Teacher-forced pass under the posterior and free-running roll-out under the prior, from the same encoding.

        Args:
            states: true states [SI]; the horizon's steps included.
            valid: who is present.
            last_observed: index of the last step that the roll-out has seen; needs history before and
                `horizon_steps` after it.
            generator: source of the concrete noise.
        """
        inputs, pairs = self.network_inputs(states, valid), pair_mask(valid)
        memory = self.empty_memory(states.shape[0], states.shape[2])
        edges = self.encoder(inputs, pairs, *memory.pairs)
        posterior = self.encoder.posterior_logits(edges, pairs)
        sampled = concrete_sample(posterior, self.config.temperature, generator)
        nodes = self._decode(inputs, valid, pairs, sampled, edges.features, memory.nodes[0])
        one_step = self.advance(states, self.decoder.change(nodes))

        steps = int(last_observed.max())
        expected = torch.softmax(edges.prior_logits[:, :steps], dim=-1)
        past = (inputs[:, :steps], valid[:, :steps], pairs[:, :steps], expected, edges.features[:, :steps])
        burned_in = torch.cat([memory.nodes[0][:, None], self._decode(*past, memory.nodes[0])], dim=1)
        rows = torch.arange(len(states), device=states.device)
        now = (rows, last_observed)
        start = (edges.hidden[now], edges.cell[now], burned_in[now])
        future = self._free_run(
            states[now], valid[now], edges.features[now], start, edges.prior_logits[now], self.horizon_steps,
            _Sampler(self.config.temperature, generator),
        )  # fmt: skip
        return WindowOutput(one_step, future, edges.prior_logits, posterior, edges.features)

    # --- Shared -------------------------------------------------------------------------------------------------

    def _decode(
        self, inputs: Tensor, valid: Tensor, pairs: Tensor, graph: Tensor, features: Tensor, hidden: Tensor
    ) -> Float[Tensor, "batch time agents decoder"]:
        messages = self.decoder.messages(inputs, pairs, graph, features)
        nodes = []
        for message, present in zip(messages.unbind(1), valid.unbind(1), strict=True):
            hidden = self.decoder.step(message, present, hidden)
            nodes.append(hidden)
        return torch.stack(nodes, dim=1) if nodes else messages.new_zeros(len(hidden), 0, *hidden.shape[1:])

    def _free_run(
        self,
        states: Tensor,
        valid: Tensor,
        features: Tensor,
        memory: tuple[Tensor, Tensor, Tensor],
        logits: Tensor,
        horizon_steps: int,
        sampler: "_Sampler",
    ) -> Float[Tensor, "batch agents horizon state"]:
        """Roll out from an observation whose decoder step is still to be taken."""
        hidden, cell, node = memory
        inputs, pairs = self.network_inputs(states, valid), pair_mask(valid)
        node = self.decoder.step(self.decoder.messages(inputs, pairs, sampler(logits), features), valid, node)
        states = self.advance(states, self.decoder.change(node))
        return self._continue(states, valid, (hidden, cell, node), horizon_steps, sampler)

    def _continue(
        self,
        states: Tensor,
        valid: Tensor,
        memory: tuple[Tensor, Tensor, Tensor],
        horizon_steps: int,
        sampler: "_Sampler | None",
    ) -> Float[Tensor, "batch agents horizon state"]:
        """Roll out from predicted states; without a sampler along expected graphs."""
        hidden, cell, node = memory
        pairs = pair_mask(valid)
        future = [states]
        for _ in range(horizon_steps - 1):
            inputs = self.network_inputs(states, valid)
            edges = self.encoder(inputs[:, None], pairs[:, None], hidden, cell)
            hidden, cell, logits = edges.hidden[:, 0], edges.cell[:, 0], edges.prior_logits[:, 0]
            graph = torch.softmax(logits, dim=-1) if sampler is None else sampler(logits)
            messages = self.decoder.messages(inputs, pairs, graph, edges.features[:, 0])
            node = self.decoder.step(messages, valid, node)
            states = self.advance(states, self.decoder.change(node))
            future.append(states)
        return torch.stack(future, dim=2)


@dataclass(frozen=True)
class _Sampler:
    temperature: float
    generator: torch.Generator | None = field(default=None)

    def __call__(self, logits: Tensor) -> Tensor:
        return concrete_sample(logits, self.temperature, self.generator)
