"""The majority class: every pair has the type that is most frequent in the training data. What any graph must beat."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from predictor.baselines.constant_velocity import ConstantVelocity
from predictor.data.store import Episode
from predictor.forecaster import Belief, Memory
from predictor.graph import pair_mask
from predictor.scene import SceneSpec
from predictor.support.errors import UserError


class MajorityGraph(ConstantVelocity):
    """Forecaster by constant velocity whose pairs all have one type."""

    def __init__(self, spec: SceneSpec, horizon_steps: int, edge_type: int, num_edge_types: int) -> None:
        """Stores the type and the number of types."""
        super().__init__(spec, horizon_steps, num_edge_types)
        self.edge_type = edge_type

    @classmethod
    def fit(cls, spec: SceneSpec, horizon_steps: int, episodes: Sequence[Episode]) -> "MajorityGraph":
        """Counts the types of all pairs of two agents.

        Raises:
            UserError: an episode has no labels, or there is only one type.
        """
        counts = np.zeros(0, dtype=np.int64)
        for episode in episodes:
            if episode.edge_types is None:
                raise UserError("the majority class needs true edge types, and the training store has none")
            between = episode.edge_types[:, ~np.eye(episode.edge_types.shape[-1], dtype=np.bool_)]
            found = np.bincount(between[between >= 0])
            total = np.zeros(max(len(counts), len(found)), dtype=np.int64)
            total[: len(counts)] += counts
            total[: len(found)] += found
            counts = total
        if len(counts) < 2:
            raise UserError(f"the majority class needs at least two edge types, the training store has {len(counts)}")
        return cls(spec, horizon_steps, int(counts.argmax()), len(counts))

    def observe(
        self, memory: Memory, states: Float[Tensor, "batch agents state"], valid: Bool[Tensor, "batch agents"]
    ) -> tuple[Memory, Belief]:
        """Returns the states as belief; every pair of two present agents has the one type."""
        memory, belief = super().observe(memory, states, valid)
        one_type = torch.zeros_like(belief.edge_probs)
        one_type[..., self.edge_type] = 1.0
        probs = torch.where(pair_mask(valid)[..., None], one_type, belief.edge_probs)
        return memory, replace(belief, edge_probs=probs)
