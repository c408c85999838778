"""The forecaster of docs/own_forecaster.md: goes on with the mean velocity that it has seen."""

import torch

from dgvae_rl import Belief, Futures, Memory, SceneSpec, edgeless_belief


class MeanVelocity:
    """A `Forecaster` without edges, whose memory is the sum of all velocities so far."""

    horizon_steps = 5  # default number of steps
    num_edge_types, edge_feature_dim = 2, 1  # it infers no edges

    def __init__(self, spec: SceneSpec):
        """Keep the layout of the scenes."""
        self.spec = spec

    def empty_memory(self, batch, agents):
        """Return the memory of agents that were never seen."""
        return Memory(nodes=(torch.zeros(batch, agents, 3),))  # sum of velocities, number of steps

    def observe(self, memory, states, valid):
        """Take in one instant."""
        seen = torch.cat([states[..., 2:4], torch.ones_like(states[..., :1])], dim=-1)
        total = memory.nodes[0] + seen * valid[..., None]
        belief = edgeless_belief(states, valid, self.num_edge_types, self.edge_feature_dim)
        mean = total[..., :2] / total[..., 2:].clamp(min=1)
        return Memory(nodes=(total,)), Belief(states, valid, belief.edge_probs, belief.edge_features, mean)

    def rollout(self, belief, horizon_steps, num_samples=1, generator=None):
        """Go on with the mean velocity."""
        time_s = self.spec.dt_s * torch.arange(1, horizon_steps + 1)
        states = belief.states[:, None, :, None].repeat(1, num_samples, 1, horizon_steps, 1)
        states[..., :2] += belief.internal[:, None, :, None] * time_s[:, None]
        return Futures(states)
