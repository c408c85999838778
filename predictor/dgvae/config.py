"""Sizes and variants of the dG-VAE, and named sets of them."""

import math
from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from predictor.layers.state_codec import Residual
from predictor.support.config_checks import (
    MOST_PARTS,
    MOST_WIDTH,
    check_at_least,
    check_at_most,
    check_choices,
    check_scale_values,
)
from predictor.support.errors import UserError


@dataclass(frozen=True)
class DGVAEConfig:
    """Sizes and variants of the network; the defaults are the paper's (Sec. V, Implementation)."""

    hidden_dim: int = 128
    """Width of the encoder's graph layers."""
    rnn_dim: int = 64
    """Width of the LSTM of each pair."""
    head_dim: int = 256
    """Hidden width of the prior, posterior and feature heads."""
    message_dim: int = 128
    """Width of the decoder's messages."""
    decoder_dim: int = 256
    """Width of the GRU of each agent."""
    num_edge_types: int = 2
    """Number of edge types; the first one is "no edge" and sends no message."""
    edge_feature_dim: int = 32
    """Number of an edge's continuous features (paper: 16 to 64, by dataset); 0 is the ablation without them (dVAE)."""
    symmetric_types: bool = False
    """Whether both directions of a pair have one distribution over types, from the mean of their logits: where forces
    are mutual, each direction is evidence for the other. Drawn types and features still differ by direction."""
    temperature: float = 0.5
    """Temperature of the concrete distribution."""
    dropout: float = 0.0
    """Dropout probability after the LSTM of pairs; what an agent's own memory gives its modes has none."""
    residual: Residual = "state"
    """Position to which the predicted change is added: the current one (paper), or the current one moved on at the
    current velocity, or at the mean of current and predicted velocity (velocity-consistent)."""
    delta_scales: tuple[float, ...] = ()
    """Typical one-step change of each feature [SI] beyond the residual; empty takes the spec's feature scales."""
    input_scales: tuple[float, ...] = ()
    """Spread of each feature over the map [SI], which divides the network's inputs; empty takes the spec's feature
    scales. A road of 500 m by 12 m needs it: at 100 m for both axes its lanes lie 0.04 apart."""
    change_scales: tuple[float, ...] = ()
    """Typical one-step change of each feature [SI], of the ego's axes in the world; if given, the change of each input
    since the last step is an encoder input too."""
    changes_of_place: bool = False
    """Whether a position's change is that of the agent's place on "centroid" axes as well, whose origin jumps when an
    agent comes or goes. New networks have it there; checkpoints of before take the change in the frame."""
    geometry_scales: tuple[float, ...] = ()
    """Typical distance [m] and relative speed [m/s] of neighbours; if given, the geometry of each pair at these scales
    is an input of its edge and of its messages (`predictor.dgvae.geometry`)."""
    forget_bias: float = 0.0
    """Addend of the initial bias of the LSTMs' forget gates; 2 starts them with a memory of about eight steps."""
    innovation_rounds: int = 0
    """Number of corrections of pair memories at each encoder step (`predictor.dgvae.innovation`); paper: 0."""
    innovation_dim: int = 32
    """Width of these corrections."""
    feature_labels: tuple[str, ...] = ()
    """Edge attributes that restricted labelling taught to the first feature dimensions, in their order; "" for a
    dimension whose attribute no pair of the data had."""
    label_means: tuple[float, ...] = ()
    """Mean of each of these attributes over the data, in its unit; a dimension is the attribute less this mean ..."""
    label_scales: tuple[float, ...] = ()
    """... over this standard deviation. Both are empty where a dimension is the attribute itself."""
    static_dim: int = 0
    """Number of first feature dimensions that pair matching averages over time (paper: 16); 0 is off."""
    pair_matching: Literal["window", "causal"] = "causal"
    """Span of this average in training: the whole window (paper), or the past of each step, as when deployed."""
    substeps: int = 0
    """Number of evaluations of the messages within a step, each followed by a motion of the agents; 0 is the paper's
    decoder, in which messages act through the GRU alone."""
    gated_messages: bool = False
    """Whether edge features scale the messages instead of being one more input of theirs."""
    zero_start: bool = False
    """Whether fresh weights predict no change beyond the residual: with many senders, sums are large, and a roll-out
    through random weights diverges."""
    hard_samples: bool = False
    """Whether sampled edge types are one-hot, with the gradient of the soft ones (straight-through)."""
    num_neighbours: int = 0
    """Largest number of senders of an agent, the nearest ones; 0 takes all. With a limit, the cost grows with the
    number of agents, not with its square. A roll-out keeps the neighbours that it starts with."""
    rollout_graph: Literal["evolving", "frozen"] = "evolving"
    """Whether a roll-out encodes its predictions ("evolving"), or keeps the edges and features that it starts with
    ("frozen"): faster, and less accurate unless trained so."""

    num_modes: int = 0
    """Number of types of an agent's edge to itself, each of which is a possible future (`predictor.dgvae.self_edges`);
    0 is the paper's model, which has none. Needs rollout_graph="frozen": what is drawn is held for the roll-out."""
    spread_by_type: bool = False
    """Whether each of these types has a spread of its own. Type 0 stands for all futures when it is shown alone, the
    others for one each, so that their spread is several times smaller."""

    def __post_init__(self) -> None:
        """Checks choices and ranges."""
        check_choices(self)
        if self.num_modes < 0 or self.num_modes == 1:
            raise UserError(f"num_modes must be 0 or at least 2, got {self.num_modes}")
        if self.num_modes and self.rollout_graph != "frozen":
            raise UserError(
                "num_modes needs rollout_graph=frozen: what is drawn is held for the whole roll-out; or set num_modes=0"
            )
        check_at_least(self, 1, "hidden_dim", "rnn_dim", "head_dim", "message_dim", "decoder_dim", "innovation_dim")
        check_at_least(self, 0, "edge_feature_dim", "innovation_rounds", "static_dim", "substeps", "num_neighbours")
        check_at_most(
            self, MOST_WIDTH, "hidden_dim", "rnn_dim", "head_dim", "message_dim", "decoder_dim", "innovation_dim",
            "edge_feature_dim", "num_neighbours",
        )  # fmt: skip
        check_at_most(self, MOST_PARTS, "num_modes", "num_edge_types", "innovation_rounds", "substeps")
        check_scale_values(self, "delta_scales", "input_scales", "change_scales", "label_scales")
        if not math.isfinite(self.forget_bias):
            raise UserError(f"forget_bias must be finite, got {self.forget_bias}")
        if self.num_neighbours and self.needs_reverse_pairs:
            needy = "innovation_rounds" if self.innovation_rounds else "symmetric_types"
            raise UserError(f"{needy} needs every pair and its reverse; set num_neighbours to 0")
        if self.static_dim > self.edge_feature_dim:
            raise UserError(
                f"static_dim must be at most edge_feature_dim ({self.edge_feature_dim}), got {self.static_dim}"
            )
        if len(self.feature_labels) > self.edge_feature_dim:
            raise UserError(
                f"feature_labels needs an edge feature for each of {', '.join(self.feature_labels)}, got "
                f"edge_feature_dim={self.edge_feature_dim}"
            )
        if not {len(self.label_means), len(self.label_scales)} <= {0, len(self.feature_labels)}:
            raise UserError(
                f"label_means and label_scales need one number for each of {len(self.feature_labels)} feature_labels, "
                f"or none, got {len(self.label_means)} and {len(self.label_scales)}"
            )
        if len(self.label_means) != len(self.label_scales) or not all(map(math.isfinite, self.label_means)):
            raise UserError(f"label_means needs as many finite numbers as label_scales, got {self.label_means}")
        if self.num_edge_types < 2:
            raise UserError(f"num_edge_types must be at least 2 (the first is 'no edge'), got {self.num_edge_types}")
        scales = self.geometry_scales
        if scales and (len(scales) != 2 or not all(0 < scale < float("inf") for scale in scales)):
            raise UserError(f"geometry_scales needs a distance [m] and a speed [m/s], both positive, got {scales}")
        if not 0 < self.temperature < float("inf") or not 0 <= self.dropout < 1:
            raise UserError(f"need 0 < temperature < inf and 0 <= dropout < 1, got {self.temperature}, {self.dropout}")

    def in_units(self, attributes: Float[Tensor, "*pairs attributes"]) -> Float[Tensor, "*pairs attributes"]:
        """Returns edge attributes in the units of the feature dimensions that learn them; NaN where none learns one."""
        if not self.label_scales:
            return attributes
        of_each = enumerate(zip(self.feature_labels, self.label_means, self.label_scales, strict=True))
        units = [(attributes[..., i] - mean) / (scale if name else math.nan) for i, (name, mean, scale) in of_each]
        return torch.stack(units, dim=-1)

    def with_units(self, features: Float[Tensor, "*pairs dims"]) -> Float[Tensor, "*pairs dims"]:
        """Returns edge features whose first dimensions are their attributes, in the attributes' units."""
        if not self.label_scales:
            return features
        first = len(self.label_scales)
        means, scales = (features.new_tensor(of_each) for of_each in (self.label_means, self.label_scales))
        return torch.cat([features[..., :first] * scales + means, features[..., first:]], dim=-1)

    @property
    def needs_reverse_pairs(self) -> bool:
        """Whether the encoder computes a pair from its reverse, so that slot j must be agent j."""
        return bool(self.innovation_rounds) or self.symmetric_types


_FAST = DGVAEConfig(
    hidden_dim=48,
    rnn_dim=24,
    head_dim=48,
    message_dim=64,
    decoder_dim=96,
    edge_feature_dim=8,
    residual="constant_velocity",
)

PRESETS: dict[str, DGVAEConfig] = {
    "paper": DGVAEConfig(),
    "fast": _FAST,
    "plural": replace(_FAST, num_modes=20, spread_by_type=True, rollout_graph="frozen"),
}
"""Named sizes: "paper" is the paper's model, "fast" a small one for policies on a CPU, "plural" the small one with
modes: its samples are enumerated futures with probabilities."""
