"""Constant velocity, without and with Gaussian noise: the baselines of every learned forecaster.

`ConstantVelocity` is the baseline of a single forecast, `NoisyConstantVelocity` that of best-of-K errors and coverage;
a stochastic model should be better than both.
"""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from predictor.forecaster import Belief, Futures, Memory, edgeless_belief
from predictor.noise import Noise, normal_of_agents
from predictor.scene import SceneSpec


class ConstantVelocity:
    """Forecaster without memory, edges and parameters."""

    def __init__(
        self, spec: SceneSpec, horizon_steps: int = 5, num_edge_types: int = 2, edge_feature_dim: int = 1
    ) -> None:
        """Stores the sizes; edge sizes only shape the (empty) edge outputs, to match a learned forecaster's."""
        self.spec = spec
        self.horizon_steps = horizon_steps
        self.num_edge_types = num_edge_types
        self.edge_feature_dim = edge_feature_dim

    def empty_memory(self, batch: int, agents: int) -> Memory:
        """Returns a memory without content."""
        return Memory()

    def observe(
        self, memory: Memory, states: Float[Tensor, "batch agents state"], valid: Bool[Tensor, "batch agents"]
    ) -> tuple[Memory, Belief]:
        """Returns the states as belief; every pair has "no edge"."""
        return memory, edgeless_belief(states, valid, self.num_edge_types, self.edge_feature_dim)

    def rollout(
        self, belief: Belief, horizon_steps: int, num_samples: int = 1, generator: Noise | None = None
    ) -> Futures:
        """Computes x + v·t; all samples are equal."""
        states = belief.states
        time_s = self.spec.dt_s * torch.arange(1, horizon_steps + 1, dtype=states.dtype, device=states.device)
        future = states[:, :, None].repeat(1, 1, horizon_steps, 1)
        axes = self.spec.position_dim
        future[..., :axes] += states[:, :, None, axes : 2 * axes] * time_s[:, None]
        return Futures(future[:, None].expand(-1, num_samples, -1, -1, -1))


class NoisyConstantVelocity(ConstantVelocity):
    """Forecaster whose samples scatter around constant velocity, by two parameters that `fit` estimates from data.

    Sample 0 is constant velocity. Each other sample draws one number per agent and axis, n ~ N(0, 1): its position
    t seconds ahead is x + v·t + n·`noise_m`·t^`growth`. With `growth` 1 the velocity is noisy.
    """

    def __init__(self, spec: SceneSpec, noise_m: float, growth: float, horizon_steps: int = 5) -> None:
        """Stores the two parameters.

        Args:
            spec: layout of the scenes.
            noise_m: standard deviation per axis one second ahead [m].
            growth: exponent of the standard deviation in time.
            horizon_steps: default number of steps to forecast.
        """
        super().__init__(spec, horizon_steps)
        self.noise_m = noise_m
        self.growth = growth

    @classmethod
    def fit(cls, spec: SceneSpec, std_m: Sequence[float]) -> "NoisyConstantVelocity":
        """Fits both parameters to the errors of constant velocity, by least squares on their logarithms.

        Args:
            spec: layout of the scenes.
            std_m: standard deviation per axis of the errors on training data, at each step of the horizon [m].
        """
        time_s = spec.dt_s * np.arange(1, len(std_m) + 1)
        found = np.asarray(std_m, dtype=np.float64)
        used = np.isfinite(found) & (found > 0)
        if used.sum() < 2:
            share = float(found[used][0] / time_s[used][0]) if used.any() else 0.0
            return cls(spec, share, 1.0, len(std_m))
        growth, offset = np.polyfit(np.log(time_s[used]), np.log(found[used]), 1)
        return cls(spec, float(np.exp(offset)), float(growth), len(std_m))

    def std_m(self, horizon_steps: int) -> Float[Tensor, "horizon axes"]:
        """Returns the standard deviation of the noise at each step [m]."""
        time_s = self.spec.dt_s * torch.arange(1, horizon_steps + 1, dtype=torch.float32)
        return (self.noise_m * time_s**self.growth)[:, None].expand(-1, self.spec.position_dim)

    def rollout(
        self,
        belief: Belief,
        horizon_steps: int,
        num_samples: int = 1,
        generator: Noise | None = None,
    ) -> Futures:
        """Returns constant velocity as sample 0, and samples with noise; each one's velocity follows its positions.

        With one generator per scene of the batch, a scene's samples depend on no other scene.

        Raises:
            UserError: the number of generators is not the number of scenes.
        """
        future = super().rollout(belief, horizon_steps, num_samples).states.clone()
        axes = self.spec.position_dim
        drawn = normal_of_agents(generator, belief.valid, num_samples - 1, axes).to(future)[..., None, :]
        time_s = self.spec.dt_s * torch.arange(1, horizon_steps + 1, dtype=future.dtype, device=future.device)
        spread_m = self.noise_m * time_s**self.growth
        added_m = spread_m.diff(prepend=spread_m.new_zeros(1))
        future[:, 1:, ..., :axes] += drawn * spread_m[:, None]
        future[:, 1:, ..., axes : 2 * axes] += drawn * added_m[:, None] / self.spec.dt_s
        return Futures(future)
