"""The dG-VAE without part of its graph, to measure what the graph is worth; weights and memory stay as they are.

"averaged" gives each receiver the mean of probabilities and features over its senders, so that it makes no difference
whose edge it is; "cut" gives every pair "no edge". Both hold from the first observed step on, for edges between agents;
an agent's edge to itself stays, and its memory, which has seen the others.
"""

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from predictor.dgvae.model import DGVAE
from predictor.dgvae.networks import edge_probabilities
from predictor.dgvae.packing import Packed, Padded
from predictor.dgvae.reading import Reading
from predictor.dgvae.single_step import Layers, Past

Ablation = Literal["averaged", "cut"]
_LEAST = 1e-12  # probability of which a logarithm is taken


class EdgeAblation(DGVAE):
    """A dG-VAE with the weights of another one, whose edges are changed in each step; for forecasts only.

    Args:
        model: the dG-VAE.
        kind: what happens to its edges.
    """

    def __init__(self, model: DGVAE, kind: Ablation) -> None:
        """Copies the weights."""
        with torch.random.fork_rng(devices=[]):  # the initial weights are not kept
            super().__init__(model.spec, model.config, model.horizon_steps)
        self.to(model.codec.scales).load_state_dict(model.state_dict())
        self.kind: Ablation = kind
        self.eval().requires_grad_(False)

    @property
    def _reading(self) -> Reading:
        return _Ablated(self.codec, self.encoder, self.config, self._per_change, self.kind)


@dataclass(frozen=True)
class _Ablated(Reading):
    """Reading whose single steps have changed edges."""

    kind: Ablation

    def step(
        self, layers: Layers, states: Tensor, valid: Tensor, graph: Padded | Packed, past: Past
    ) -> tuple[Past, Tensor, Tensor]:
        """Encodes one step; memory is that of the whole model."""
        after, logits, features = super().step(layers, states, valid, graph, past)
        types = logits.shape[-1]
        edges = graph.unpack_pairs(torch.cat([edge_probabilities(logits), features], dim=-1))
        changed = graph.pack_pairs(self._changed(edges, self._between_agents(graph)))
        return after, changed[..., :types].clamp(min=_LEAST).log(), changed[..., types:]

    def _between_agents(self, graph: Padded | Packed) -> Tensor:
        """Returns the mask of the slots that hold another agent."""
        there = graph.pairs_there.clone()
        if self.config.num_modes and self.config.num_neighbours:
            there[..., -1] = False
        elif self.config.num_modes:
            torch.diagonal(there, dim1=-2, dim2=-1).fill_(False)
        return there

    def _changed(self, edges: Tensor, there: Tensor) -> Tensor:
        if self.kind == "cut":
            new = torch.zeros_like(edges)
            new[..., 0] = 1.0
        else:
            count = there.sum(dim=-1, keepdim=True).clamp(min=1)[..., None]
            new = (edges * there[..., None]).sum(dim=-2, keepdim=True) / count
        return torch.where(there[..., None], new, edges)
