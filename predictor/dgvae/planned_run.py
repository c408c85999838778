"""Roll-outs in which agent 0 follows plans, several in one batch; see `predictor.what_if`.

The step after the observation depends on no plan and is computed once. Then a model without modes has a scene of its
own for each plan, since its edges evolve; a model with modes has P plans × K modes on its axis of modes, plan by plan.
"""

from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from predictor.dgvae.free_run import proceed
from predictor.dgvae.motion import Context, Motion
from predictor.dgvae.packing import Packed, Padded
from predictor.dgvae.reading import Reading
from predictor.dgvae.single_step import Internal, Past
from predictor.forecaster import Futures
from predictor.noise import NoiseOfPairs, PairNoise, RepeatedNoise, repeat_scenes
from predictor.what_if import with_ego


class PlannedRun(NamedTuple):
    """Rolls out the plans of one batch of scenes."""

    reading: Reading
    motion: Motion
    known: Internal
    """Data of the belief."""
    states: Float[Tensor, "batch agents state"]
    """Observed states."""
    valid: Tensor
    """Which agents are present."""
    plans: Float[Tensor, "batch plans horizon state"]
    """States of agent 0 at each step."""

    def free(
        self,
        num_samples: int,
        noise: torch.Generator | PairNoise | None,
        sampler: Callable[[NoiseOfPairs | None], Callable[[Tensor], Tensor]],
    ) -> Futures:
        """Rolls out a model without modes: sample 0 along edge probabilities, the others along drawn types.

        Args:
            num_samples: number of samples for each plan.
            noise: noise of the draws, the same for each plan.
            sampler: function that makes a rule from noise, which draws edge types from logits.
        """
        known, count = self.known, self.plans.shape[1]
        start = Start(self.valid, known.graph, known.past, known.node_after, known.probs, known.features)
        single = self._proceed(start, known.next_states, self.plans, None)[:, :, None]
        if num_samples == 1:
            return Futures(single)
        draws, layers = num_samples - 1, known.layers
        now = Start(self.valid, known.graph, known.past, known.node_before, known.logits, known.features)
        now = now.repeat(draws)
        drawn = now.graph.per_pair(sampler(noise), now.edges)
        context = Context(now.graph, drawn, layers.feature_share(now.features))
        states = self.states.repeat_interleave(draws, dim=0)
        node, states = self.motion.step(layers, states, now.valid, context, now.node)
        shared = RepeatedNoise(noise, *_plans_of(now.graph, count))
        plans = self.plans.repeat_interleave(draws, dim=0)
        future = self._proceed(now._replace(node=node, edges=drawn), states, plans, sampler(shared))
        sampled = future.unflatten(0, (len(self.states), draws)).transpose(1, 2)
        return Futures(torch.cat([single, sampled], dim=2))

    def _proceed(
        self, start: "Start", states: Tensor, plans: Tensor, rule: Callable[[Tensor], Tensor] | None
    ) -> Float[Tensor, "batch plans agents horizon state"]:
        """Rolls out from predicted states, a scene for each plan."""
        count, horizon_steps = plans.shape[1:3]
        each = start.repeat(count)
        future = proceed(
            self.reading, self.motion, self.known.layers, states.repeat_interleave(count, dim=0), each.valid,
            each.graph, each.past, each.node, (each.edges, each.features), horizon_steps, rule, plans.flatten(0, 1),
        )  # fmt: skip
        return future.unflatten(0, plans.shape[:2])

    def held(
        self, types: Int[Tensor, "batch samples agents"], mode_probs: Float[Tensor, "batch samples agents"] | None
    ) -> Futures:
        """Rolls out a model with modes, whose agents hold their types in every plan."""
        known, motion, self_edges = self.known, self.motion, self.motion.self_edges
        assert self_edges is not None and known.own is not None
        layers, graph, (count, horizon_steps) = known.layers, known.graph, self.plans.shape[1:3]
        shared = (self.states, self.valid, known.probs, layers.feature_share(known.features), known.own)
        first, there, weights, share, own = (t[:, None] for t in shared)
        samples = types.shape[1]

        def context(of_types: Tensor) -> Context:
            held = self_edges.hold(own, graph.pack_nodes(of_types[..., None])[..., 0])
            return Context(graph.for_modes(), weights, share, held)

        begin = context(types)
        assert begin.held is not None
        if samples == 1:  # the single forecast's first step was made when the scene was observed
            node, states = known.node_after[:, None], known.next_states[:, None]
        else:
            node, states = motion.step(layers, first, there, begin, known.node_before[:, None])
        growth = graph.unpack_nodes(self_edges.growth(node, begin.held))
        plans = self.plans.repeat_interleave(samples, dim=1)
        states, node, growth, types = (_of_plans(t, count) for t in (states, node, growth, types))
        states = with_ego(states, plans[:, :, 0])
        later, more = motion.held_run(layers, states, there, context(types), node, horizon_steps - 1, plans[:, :, 1:])
        states, growth = torch.cat([states[..., None, :], later], -2), torch.cat([growth[..., None, :], more], -2)
        by_plan = (count, samples)
        probs = None if mode_probs is None else mode_probs[:, None].expand(-1, count, -1, -1)
        return Futures(states.unflatten(1, by_plan), probs, motion.spread(growth).unflatten(1, by_plan))


class Start(NamedTuple):
    """Data from which a model without modes rolls out; `edges` are weights or logits."""

    valid: Tensor
    graph: Padded | Packed
    past: Past
    node: Tensor
    edges: Tensor
    features: Tensor

    def repeat(self, times: int) -> "Start":
        """Repeats each scene."""
        graph, past = self.graph, self.past
        pairs = (graph.repeat_pairs(t, times) for t in (past.hidden, past.cell, past.static, self.edges, self.features))
        hidden, cell, static, edges, features = pairs
        valid, seen = (t.repeat_interleave(times, dim=0) for t in (self.valid, past.seen))
        node = graph.repeat_nodes(self.node, times)
        return Start(valid, graph.repeat(times), Past(hidden, cell, static, seen), node, edges, features)


def _plans_of(graph: Padded | Packed, plans: int) -> tuple[Callable[[Tensor], Tensor], Callable[[Tensor], Tensor]]:
    """Returns functions that undo and do the repetition of pairs for each plan, for `RepeatedNoise`."""
    if isinstance(graph, Padded):
        return repeat_scenes(plans)
    listed = len(graph.slots)
    if not listed:  # an ego that is alone
        return lambda pairs: pairs[:0], lambda pairs: pairs
    return lambda pairs: pairs[:listed], lambda pairs: graph.repeat_pairs(pairs, plans)[: plans * listed]


def _of_plans(values: Tensor, plans: int) -> Tensor:
    """Repeats the axis of modes, which is the second one, for each plan."""
    return values.unsqueeze(1).expand(-1, plans, *values.shape[1:]).flatten(1, 2)
