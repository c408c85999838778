"""The pass of training over whole windows: a teacher-forced part under the posterior, and a roll-out.

Both start from one encoding of all steps. The roll-out of a model without modes draws its edges from the prior; that of
a model with modes follows the first of them, all along one draw of the edges, which is held.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from predictor.dgvae.free_run import free_run
from predictor.dgvae.motion import Context, Motion
from predictor.dgvae.networks import edge_probabilities, no_edge_where_absent
from predictor.dgvae.packing import Padded
from predictor.dgvae.reading import Reading
from predictor.dgvae.self_edges import HeldType
from predictor.dgvae.single_step import Modules, Past
from predictor.forecaster import Futures, WindowOutput
from predictor.graph import among_nearest, off_diagonal, others, pair_mask, with_diagonal
from predictor.layers.rnn import masked_gru


@dataclass(frozen=True)
class TrainingPass:
    """Runs windows through the modules."""

    reading: Reading
    motion: Motion
    layers: Modules
    sampler: Callable[[Tensor], Tensor]
    """Function that draws edge types from logits."""

    def slots(self, valid: Tensor) -> int:
        """Returns the number of slots of an agent's pairs."""
        agents: int = valid.shape[-1]
        return agents if self._dense(agents) else agents - 1

    def run(
        self,
        states: Tensor,
        valid: Tensor,
        last_observed: Tensor,
        rollout_steps: int,
        num_modes: int,
        nodes: tuple[Tensor, Tensor],
        pairs: tuple[Tensor, Tensor, Tensor],
    ) -> WindowOutput:
        """Returns predictions and graphs; `nodes` and `pairs` are the memory before the first step."""
        decoder, self_edges = self.layers.decoder, self.layers.self_edges
        inferred = self._inferred(states, valid)
        graph, (node, seen) = self._graph(valid, inferred), nodes
        inputs, (edges, features, past) = self.reading.steps(states, valid, graph, Past(*pairs, seen))
        posterior = self.layers.encoder.posterior_logits(edges, graph.present, graph.senders)
        sampled = self.sampler(posterior)
        shown = self.reading.match_window(edges.features, features, graph.present)
        own = None if self_edges is None else functional.elu(graph.own(past.hidden))
        held = None if self_edges is None or own is None else self_edges.hold(own)
        share = decoder.feature_share(shown)
        layer = decoder.pair_layer(inputs, share, graph.senders)
        to_itself = self._to_itself(inputs, held)
        messages = decoder.combine(inputs, layer, graph.present, sampled) + to_itself
        change = decoder.change(masked_gru(messages, decoder.gru, valid, node))
        one_step = self.motion.integrate(
            self.layers, states, valid, Context(graph, sampled, share, held), change, messages
        )
        prior_posterior_features = _dense_outputs(graph, edges.prior_logits, posterior, shown)
        if not rollout_steps:
            nothing = states.new_zeros(len(states), states.shape[2], 0, states.shape[3])
            return WindowOutput(one_step, nothing, *prior_posterior_features, pairs=inferred)

        # the longest history; reading it from a GPU would wait for the device
        steps = states.shape[1] if last_observed.is_cuda else int(last_observed.max())
        expected = edge_probabilities(edges.prior_logits[:, :steps])
        if shown is not features:
            layer = decoder.pair_layer(inputs, decoder.feature_share(features), graph.senders)
        messages = decoder.combine(inputs[:, :steps], layer[:, :steps], graph.present[:, :steps], expected)
        to_itself = to_itself if held is None else to_itself[:, :steps]
        remembered = masked_gru(messages + to_itself, decoder.gru, valid[:, :steps], node)
        burned_in = torch.cat([node[:, None], remembered], dim=1)
        now = (torch.arange(len(states), device=states.device), last_observed)
        begin, logits = Padded(graph.present[now], graph.senders), edges.prior_logits[now]
        if own is not None:
            modes = self._modes(
                states[now], valid[now], begin, logits, features[now], own[now], burned_in[now], rollout_steps,
                num_modes,
            )  # fmt: skip
            return WindowOutput(one_step, modes.states[:, 0], *prior_posterior_features, modes, inferred)
        future = free_run(
            self.reading, self.motion, self.layers, states[now], valid[now], begin, features[now],
            Past(*(t[now] for t in past)), burned_in[now], logits, rollout_steps, self.sampler,
        )  # fmt: skip
        return WindowOutput(one_step, future, *prior_posterior_features, pairs=inferred)

    def _to_itself(self, inputs: Tensor, held: HeldType | None) -> Tensor:
        """Computes each agent's message to itself along its held type; a zero for a model without self-edges."""
        self_edges = self.layers.self_edges
        if self_edges is None or held is None:
            return inputs.new_zeros(())
        message: Tensor = self_edges.out(self_edges.layer(inputs, held))
        return message

    def _modes(
        self,
        states: Tensor,
        valid: Tensor,
        graph: Padded,
        logits: Tensor,
        features: Tensor,
        own: Tensor,
        node: Tensor,
        horizon_steps: int,
        num_modes: int,
    ) -> Futures:
        """Rolls out the first `num_modes` types of all agents along one draw of the edges.

        Columns after the last agent that is present get zeros: batches have the agents that left at the end.
        """
        self_edges = self.layers.self_edges
        assert self_edges is not None and graph.senders is None
        agents = valid.shape[1]
        # reading it from a GPU would wait for the device
        used = agents if valid.is_cuda else _last(valid.any(0)) + 1
        weights, drawn = self.sampler(logits), slice(used)
        share = self.layers.feature_share(features[:, drawn, drawn])
        pairs = (graph.present[:, drawn, drawn], weights[:, drawn, drawn], share)
        nodes = (states[:, drawn], valid[:, drawn], own[:, drawn], node[:, drawn])
        present, weights, share, first, there, past, memory = (t[:, None] for t in (*pairs, *nodes))
        types = torch.arange(num_modes, device=states.device)[:, None]
        context = Context(Padded(present, None), weights, share, self_edges.hold(past, types))
        run = self.motion.held_run(self.layers, first, there, context, memory, horizon_steps)
        future, growth = (functional.pad(t, (0, 0, 0, 0, 0, agents - used)) for t in run)
        probs = torch.softmax(self_edges.prior_head(own)[..., :num_modes], dim=-1).transpose(1, 2)
        return Futures(future, probs, self.motion.spread(growth))

    def _dense(self, agents: int) -> bool:
        """Returns whether slot j is agent j, which self-edges and what is computed from reverse pairs need."""
        return self.layers.self_edges is not None or self.reading.config.needs_reverse_pairs or agents == 1

    def _inferred(self, states: Tensor, valid: Tensor) -> Tensor | None:
        """Returns the pairs of the nearest agents that have edges; None if all pairs have."""
        near = self.reading.config.num_neighbours
        if not near:
            return None
        axes = self.reading.codec.spec.position_dim
        return pair_mask(valid) & among_nearest(states[..., :axes].detach(), valid, near)

    def _graph(self, valid: Tensor, inferred: Tensor | None) -> Padded:
        """Returns the pairs of each step: each agent with all others, or with the nearest."""
        present = pair_mask(valid) if inferred is None else inferred
        if self.layers.self_edges is not None:
            present = present | torch.diag_embed(valid)
        if self._dense(valid.shape[-1]):
            return Padded(present, None)
        return Padded(off_diagonal(present), others(valid.shape[-1], valid.device))


def _last(present: Tensor) -> int:
    """Returns the index of the last agent that is present; 0 if there is none."""
    places = present.nonzero()
    return int(places[-1]) if len(places) else 0


def _dense_outputs(graph: Padded, prior: Tensor, posterior: Tensor, features: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Converts a window's pair outputs to dense ones; diagonal entries are "no edge" and zeros."""
    if graph.senders is None:
        return prior, posterior, features
    nothing = features.new_zeros(features.shape[-1])
    no_edge = no_edge_where_absent(prior.new_zeros(prior.shape[-1]), graph.present.new_zeros(1))
    return with_diagonal(prior, no_edge), with_diagonal(posterior, no_edge), with_diagonal(features, nothing)
