"""The dG-VAE (paper Sec. IV): an encoder infers edges and their features, a decoder predicts motion from them.

Encoder: linear embedding → EdgeConv → edge embedding → forward LSTM per pair → learned prior and edge features;
forward ‖ backward LSTM → posterior (training only). Decoder: messages along sampled edges, with edge features → GRU →
change of state. `observe` and `rollout` make it a `Forecaster`; `window` is the pass of training; all use the same
layers and differ only in the number of steps that they compute at once. Without gradients, single steps go through
`predictor.dgvae.single_step`, which needs fewer operations for the same result.

Two things that the paper leaves open are settled here. Without edges an agent's own state would be no input of its
decoder, so a linear term of that state is added to the messages. And during the observed history the edges' weights are
the prior's probabilities, so that one history gives one memory; samples are drawn from the first forecast step on.

With `num_modes`, each agent has an edge to itself whose types are its possible futures (`predictor.dgvae.self_edges`).
Scene k of a roll-out follows type k of every agent, so the scenes are enumerated and nothing is drawn.
"""

from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn import functional

from predictor.dgvae.config import PRESETS, DGVAEConfig
from predictor.dgvae.free_run import free_run, proceed
from predictor.dgvae.geometry import Geometry
from predictor.dgvae.motion import Context, Motion
from predictor.dgvae.networks import Decoder, Encoder, concrete_sample, edge_probabilities
from predictor.dgvae.packing import Packed, Padded
from predictor.dgvae.planned_run import PlannedRun, Start
from predictor.dgvae.reading import Reading
from predictor.dgvae.self_edges import SelfEdges
from predictor.dgvae.single_step import Internal, Layers, Modules, Past, Stepper, differentiable, unpacked
from predictor.dgvae.training_pass import TrainingPass
from predictor.forecaster import Belief, Futures, Memory, WindowOutput
from predictor.graph import NO_AGENT, nearest, pair_mask
from predictor.layers.state_codec import StateCodec, check_scales
from predictor.noise import Noise, NoiseOfPairs, TrainingNoise, noise_of_pairs, uniform_of_agents
from predictor.scene import SceneSpec
from predictor.support.errors import UserError


class DGVAE(nn.Module):
    """The dG-VAE, as a `Forecaster` and as the forward pass of training.

    Forecasts are differentiable, also by `torch.func`; float64 makes Jacobians exact:

        >>> model = DGVAE(SceneSpec(dt_s=1.0, max_agents=3), PRESETS["fast"]).double().eval()
        >>> observe = lambda states: model.observe(model.empty_memory(1, 3), states, torch.ones(1, 3).bool())[1]
        >>> forecast = lambda states: model.rollout(observe(states), horizon_steps=2).states[0, 0]
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
        geometry = None
        if config.geometry_scales:
            geometry = Geometry(self.codec.scales[: 2 * spec.position_dim], *config.geometry_scales)
        self.encoder = Encoder(config, inputs + spec.num_features * self.sees_changes, geometry)
        self.decoder = Decoder(config, inputs, spec.num_features, geometry)
        self.self_edges: SelfEdges | None = None
        if config.num_modes:
            sizes = (config.rnn_dim, config.head_dim, config.message_dim, config.decoder_dim)
            self.self_edges = SelfEdges(inputs, *sizes, config.num_modes, spec.position_dim, config.spread_by_type)
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

    @property
    def has_scale(self) -> bool:
        """Whether roll-outs come with a standard deviation around each sample."""
        return self.self_edges is not None

    @property
    def _slots(self) -> int:
        """Number of listed senders of an agent; 0 where slot j is agent j."""
        near = self.config.num_neighbours
        return near + (self.self_edges is not None) if near else 0

    def variant(self, **changes: Any) -> "DGVAE":
        """Returns a model with these weights and a changed config.

        The weights fit any value of `num_neighbours`, `rollout_graph`, `symmetric_types`, `temperature` and
        `hard_samples`.

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
        listed = self._slots
        nodes, pairs = self._zero_memory(batch, agents, listed or agents)
        senders = torch.full((batch, agents, listed), NO_AGENT, device=nodes[0].device) if listed else None
        return Memory(nodes, pairs, senders)

    def observe(
        self, memory: Memory, states: Float[Tensor, "batch agents state"], valid: Bool[Tensor, "batch agents"]
    ) -> tuple[Memory, Belief]:
        """Computes one encoder step and one decoder step along the prior's edge probabilities."""
        padded = self._graph_now(states, valid)
        if padded.senders is not None:
            memory = memory.to_slots(padded.senders, padded.present)
        # lists without entries cannot be lengthened, and there is nothing to compute quickly
        layers = self._layers() if len(states) else self._plain()
        graph: Padded | Packed = padded
        if isinstance(layers, Stepper):
            graph = Packed.of(padded, valid, self.self_edges is not None)
        (node, seen), pairs = memory.nodes, memory.pairs
        node_before, (hidden, cell, static) = graph.pack_nodes(node), map(graph.pack_pairs, pairs)
        past, logits, features = self._reading.step(layers, states, valid, graph, Past(hidden, cell, static, seen))
        probs = edge_probabilities(logits)
        own = None if self.self_edges is None else functional.elu(graph.own(past.hidden))
        held = None if self.self_edges is None or own is None else self.self_edges.hold(own)
        context = Context(graph, probs, layers.feature_share(features), held)
        node_after, next_states = self._motion.step(layers, states, valid, context, node_before)
        known = Internal(layers, graph, past, logits, probs, features, node_before, node_after, next_states, own)
        remembered = tuple(graph.unpack_pairs(t) for t in (past.hidden, past.cell, past.static))
        after = Memory((graph.unpack_nodes(node_after), past.seen), remembered, memory.senders)
        near = self.config.num_neighbours or None  # self-edges, in the slot after these, are not shown
        shown_probs, shown_features = graph.unpack_pairs(probs, no_edge=True), graph.unpack_pairs(features)
        senders = None if memory.senders is None else memory.senders[:, :, :near]
        return after, Belief(states, valid, shown_probs[:, :, :near], shown_features[:, :, :near], known, senders)

    def rollout(
        self, belief: Belief, horizon_steps: int, num_samples: int = 1, generator: Noise | None = None
    ) -> Futures:
        """Rolls out from a belief; sample 0 uses edge probabilities and type 0 of every self-edge.

        With at least `num_samples` modes, sample k follows type k of every agent and nothing is drawn; with fewer, the
        other samples draw each agent's type. Without modes, edge types are drawn, and predictions are encoded.
        """
        known: Internal = belief.internal
        if differentiable():  # the history may have been observed without gradients
            known = unpacked(known, self._plain())
        if self.self_edges is not None:
            return self._modes(belief, known, horizon_steps, num_samples, generator)
        layers, graph, motion, edges = known.layers, known.graph, self._motion, (known.probs, known.features)
        future = proceed(
            self._reading, motion, layers, known.next_states, belief.valid, graph, known.past, known.node_after, edges,
            horizon_steps, None,
        )  # fmt: skip
        if num_samples == 1:
            return Futures(future[:, None])
        draws = num_samples - 1
        steps = horizon_steps if self.config.rollout_graph == "evolving" else 1
        noise = noise_of_pairs(generator, graph.pairs_there, draws, steps, self.num_edge_types)
        start = Start(belief.valid, graph, known.past, known.node_before, known.logits, known.features).repeat(draws)
        drawn = free_run(
            self._reading, motion, layers, belief.states.repeat_interleave(draws, dim=0), start.valid, start.graph,
            start.features, start.past, start.node, start.edges, horizon_steps, self._sampler(noise),
        )  # fmt: skip
        return Futures(torch.cat([future[:, None], drawn.unflatten(0, (len(future), draws))], dim=1))

    def _modes(
        self, belief: Belief, known: Internal, horizon_steps: int, num_samples: int, generator: Noise | None
    ) -> Futures:
        """Rolls out scenes that hold their types: enumerated ones, or draws if there are fewer types than samples."""
        assert self.self_edges is not None and known.own is not None
        layers, graph, valid, motion = known.layers, known.graph, belief.valid, self._motion
        share = layers.feature_share(known.features)
        if num_samples == 1:
            held = self.self_edges.hold(known.own)
            context = Context(graph, known.probs, share, held)
            first = graph.unpack_nodes(self.self_edges.growth(known.node_after, held))
            states, growth = motion.held_run(
                layers, known.next_states, valid, context, known.node_after, horizon_steps - 1
            )
            states = torch.cat([known.next_states[:, :, None], states], dim=2)
            growth = torch.cat([first[:, :, None], growth], dim=2)
            return Futures(states[:, None], torch.ones_like(states[:, None, :, 0, 0]), motion.spread(growth)[:, None])
        types, mode_probs = self._types(known, valid, num_samples, generator)
        shared = (belief.states, valid, known.probs, share, known.own, known.node_before)
        first, there, weights, share, own, node = (t[:, None] for t in shared)
        held = self.self_edges.hold(own, graph.pack_nodes(types[..., None])[..., 0])
        context = Context(graph.for_modes(), weights, share, held)
        run = motion.held_run(layers, first, there, context, node, horizon_steps)
        states, growth = (t.expand(-1, num_samples, *t.shape[2:]) for t in run)  # a horizon of 0 has no modes yet
        return Futures(states, mode_probs, motion.spread(growth))

    def _types(
        self, known: Internal, valid: Tensor, num_samples: int, generator: Noise | None
    ) -> tuple[Int[Tensor, "batch samples agents"], Float[Tensor, "batch samples agents"] | None]:
        """Returns the type of each agent in each sample, and their probabilities unless they are drawn."""
        assert self.self_edges is not None and known.own is not None
        logits = known.graph.unpack_nodes(self.self_edges.prior_head(known.own))
        probs = torch.softmax(logits.masked_fill(~valid[..., None], 0.0), dim=-1)
        types = torch.arange(num_samples, device=valid.device)[None, :, None].expand(len(valid), -1, valid.shape[1])
        if num_samples <= self.config.num_modes:
            first = probs[..., :num_samples]
            return types, (first / first.sum(-1, keepdim=True)).transpose(1, 2)
        uniform = uniform_of_agents(generator, valid, num_samples).to(probs)
        types = (uniform[..., None] >= probs.cumsum(-1)[:, None, :, :-1]).sum(-1)
        types[:, 0] = 0
        return types, None

    def rollout_plans(
        self,
        belief: Belief,
        plans: Float[Tensor, "batch plans horizon state"],
        num_samples: int = 1,
        generator: Noise | None = None,
    ) -> Futures:
        """Rolls out from a belief while agent 0 follows each plan; samples as those of `rollout`."""
        known: Internal = belief.internal
        if differentiable():
            known = unpacked(known, self._plain())
        run = PlannedRun(self._reading, self._motion, known, belief.states, belief.valid, plans)
        if self.self_edges is not None:
            types, probs = self._types(known, belief.valid, num_samples, generator)
            return run.held(types, probs)
        noise = None
        if num_samples > 1:
            steps = plans.shape[2] if self.config.rollout_graph == "evolving" else 1
            draws = num_samples - 1
            noise = noise_of_pairs(generator, known.graph.pairs_there, draws, steps, self.num_edge_types)
        return run.free(num_samples, noise, self._sampler)

    # --- Training -----------------------------------------------------------------------------------------------

    def window(
        self,
        states: Float[Tensor, "batch time agents state"],
        valid: Bool[Tensor, "batch time agents"],
        last_observed: Int[Tensor, " batch"],
        rollout_steps: int,
        generator: TrainingNoise | None = None,
        num_modes: int = 1,
    ) -> WindowOutput:
        """Runs a teacher-forced pass under the posterior and a roll-out under the prior, from the same encoding.

        A model with modes rolls out the first `num_modes` of them.
        """
        training = TrainingPass(self._reading, self._motion, self._plain(), self._sampler(generator))
        memory = self._zero_memory(states.shape[0], states.shape[2], training.slots(valid))
        return training.run(states, valid, last_observed, rollout_steps, num_modes, *memory)

    # --- Shared -------------------------------------------------------------------------------------------------

    def _graph_now(self, states: Tensor, valid: Tensor) -> Padded:
        near, to_itself = self.config.num_neighbours, self.self_edges is not None
        agents = valid.shape[1]
        if not near:
            present = pair_mask(valid)
            return Padded(present | torch.diag_embed(valid) if to_itself else present, None)
        senders, present = nearest(states[..., : self.spec.position_dim].detach(), valid, near)
        if to_itself:  # in the last slot
            own = torch.arange(agents, device=valid.device).expand(len(valid), -1)[..., None]
            senders, present = torch.cat([senders, own], dim=-1), torch.cat([present, valid[..., None]], dim=-1)
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

    def _sampler(self, noise: NoiseOfPairs | None) -> Callable[[Tensor], Tensor]:
        return lambda logits: concrete_sample(logits, self.config.temperature, noise, self.config.hard_samples)

    def _plain(self) -> Modules:
        return Modules(self.encoder, self.decoder, self.self_edges)

    @property
    def _reading(self) -> Reading:
        return Reading(self.codec, self.encoder, self.config, self._per_change)

    @property
    def _motion(self) -> Motion:
        return Motion(self.codec, self.decoder, self.self_edges, self.config.substeps)

    def _layers(self) -> Layers:
        """Returns the layers for single steps: with gradients the modules themselves, else folded weights."""
        dropout = self.encoder.dropout.training and self.config.dropout > 0
        if differentiable() or dropout or self.config.needs_reverse_pairs:
            return self._plain()
        if self._stepper is None or not self._stepper.is_current(self.encoder, self.decoder, self.self_edges):
            self._stepper = Stepper(self.encoder, self.decoder, self.self_edges)
        return self._stepper
