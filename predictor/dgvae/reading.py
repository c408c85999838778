"""Reading of observed steps: from states to the memory of each pair, its prior over edge types and its features."""

from dataclasses import dataclass

import torch
from torch import Tensor

from predictor.dgvae.config import DGVAEConfig
from predictor.dgvae.networks import Encoder
from predictor.dgvae.packing import Packed, Padded
from predictor.dgvae.pair_matching import running_mean, running_mean_step, window_mean
from predictor.dgvae.single_step import Encoding, Layers, Past
from predictor.layers.state_codec import StateCodec


@dataclass(frozen=True)
class Reading:
    """Encodes states, one step or several."""

    codec: StateCodec
    encoder: Encoder
    config: DGVAEConfig
    per_change: Tensor
    """Factor from scaled inputs to their typical change; of no use if changes are no input."""

    def steps(self, states: Tensor, valid: Tensor, graph: Padded, past: Past) -> tuple[Tensor, Encoding]:
        """Encodes several steps after `past`; returns the codec's inputs, too."""
        own = self.codec.inputs(states, valid)
        inputs, seen = self._with_changes(own, states, valid, past.seen)
        edges = self.encoder(inputs, graph.present, past.hidden, past.cell, graph.senders)
        features, static = self._match(edges.features, graph.present, past.static)
        return own, Encoding(edges, features, Past(edges.hidden, edges.cell, static, seen))

    def step(
        self, layers: Layers, states: Tensor, valid: Tensor, graph: Padded | Packed, past: Past
    ) -> tuple[Past, Tensor, Tensor]:
        """Encodes one step: returns memory, prior logits and features after it."""
        inputs, seen = self.codec.inputs(states, valid), past.seen
        if self.config.change_scales:
            steps, after = self._with_changes(inputs[:, None], states[:, None], valid[:, None], seen)
            inputs, seen = steps[:, 0], after[:, 0]
        inputs = graph.pack_nodes(inputs)
        hidden, cell, logits, features = layers.encode(inputs, graph, past.hidden, past.cell)
        static = past.static
        if self.config.static_dim:
            first = features[..., : self.config.static_dim]
            static = running_mean_step(first, graph.among_pairs(static), static)
            features = torch.cat([static[..., :-1], features[..., self.config.static_dim :]], dim=-1)
        return Past(hidden, cell, static, seen), logits, features

    def _with_changes(self, inputs: Tensor, states: Tensor, valid: Tensor, before: Tensor) -> tuple[Tensor, Tensor]:
        """Returns the encoder's inputs at several steps, and its memory of each one for the next."""
        if not self.config.change_scales:
            return inputs, inputs.new_zeros(*inputs.shape[:-1], 0)
        placed, axes = inputs, self.codec.spec.position_dim
        if self.config.changes_of_place and self.codec.has_centroid:
            origin = self.codec.centroid(states, valid) / self.codec.scales[:axes]
            placed = torch.cat([inputs[..., :axes] + origin, inputs[..., axes:]], dim=-1)
        seen = torch.cat([placed, torch.ones_like(inputs[..., :1])], dim=-1) * valid[..., None]
        earlier = torch.cat([before[:, None], seen[:, :-1]], dim=1)
        known = earlier[..., -1:] * valid[..., None]
        features = self.codec.spec.num_features
        changes = (placed[..., :features] - earlier[..., :features]) * self.per_change * known
        return torch.cat([inputs, changes], dim=-1), seen

    def _match(self, features: Tensor, present: Tensor, before: Tensor) -> tuple[Tensor, Tensor]:
        """Computes causal pair matching: features with running means as static dimensions, and these means."""
        static = self.config.static_dim
        if not static:
            return features, features.new_zeros(*present.shape, 0)
        mean = running_mean(features[..., :static], present, before)
        return torch.cat([mean[..., :-1], features[..., static:]], dim=-1), mean

    def match_window(self, features: Tensor, causal: Tensor, present: Tensor) -> Tensor:
        """Returns features for the teacher-forced pass, with static ones from the whole window if so configured."""
        static = self.config.static_dim
        if not static or self.config.pair_matching == "causal":
            return causal
        return torch.cat([window_mean(features[..., :static], present), features[..., static:]], dim=-1)
