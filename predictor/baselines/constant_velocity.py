"""Everyone keeps the velocity they have: the baseline that every learned forecaster stands beside."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from predictor.forecaster import Belief, Memory, edgeless_belief
from predictor.layers.pair_noise import Noise
from predictor.scene import SceneSpec


class ConstantVelocity:
    """A `Forecaster` without memory, without edges, without parameters."""

    def __init__(
        self, spec: SceneSpec, horizon_steps: int = 5, num_edge_types: int = 2, edge_feature_dim: int = 1
    ) -> None:
        """Edge sizes only shape the (empty) edge outputs, so that observations can match a learned forecaster's."""
        self.spec = spec
        self.horizon_steps = horizon_steps
        self.num_edge_types = num_edge_types
        self.edge_feature_dim = edge_feature_dim

    def empty_memory(self, batch: int, agents: int) -> Memory:
        """Nothing is remembered."""
        return Memory()

    def observe(
        self, memory: Memory, states: Float[Tensor, "batch agents state"], valid: Bool[Tensor, "batch agents"]
    ) -> tuple[Memory, Belief]:
        """Keep the states; every pair has "no edge"."""
        return memory, edgeless_belief(states, valid, self.num_edge_types, self.edge_feature_dim)

    def rollout(
        self, belief: Belief, horizon_steps: int, num_samples: int = 1, generator: Noise | None = None
    ) -> Float[Tensor, "batch samples agents horizon state"]:
        """X + v·t; all samples are the same."""
        states = belief.states
        time_s = self.spec.dt_s * torch.arange(1, horizon_steps + 1, dtype=states.dtype, device=states.device)
        future = states[:, :, None].repeat(1, 1, horizon_steps, 1)
        axes = self.spec.position_dim
        future[..., :axes] += states[:, :, None, axes : 2 * axes] * time_s[:, None]
        return future[:, None].expand(-1, num_samples, -1, -1, -1)
