"""Another forecaster's single forecast plus Gaussian noise: the control of every model that claims to be stochastic.

A model's samples are worth something only if they are better than its own best guess with noise of the right size.
"""

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from predictor.forecaster import Belief, Forecaster, Futures, Memory
from predictor.noise import Noise, normal_of_agents
from predictor.scene import SceneSpec
from predictor.support.errors import UserError
from predictor.what_if import rollout_plans

LEAST_STD_M = 1e-6
"""Standard deviation that is added to every coordinate, so that the covariance has a root [m]."""


class GaussianResidual:
    """Forecaster whose samples are another one's single forecast plus noise of one fitted covariance.

    The covariance is that of the errors over all steps and axes, so noise is correlated in time as errors are. Agents
    draw independently. Velocities follow the positions' noise; other features are those of the single forecast.

    Args:
        forecaster: source of the single forecast, memory and beliefs.
        covariance: covariance of an agent's error [m²], steps × axes in this order.
    """

    def __init__(self, forecaster: Forecaster, covariance: Float[np.ndarray, "steps_and_axes steps_and_axes"]) -> None:
        """Computes the root of the covariance."""
        self.forecaster = forecaster
        axes = forecaster.spec.position_dim
        self.horizon_steps = len(covariance) // axes
        self.covariance = covariance
        least = max(LEAST_STD_M**2, 1e-12 * float(np.trace(covariance)))  # above the rounding of large units, as pixels
        root = np.linalg.cholesky(covariance + least * np.eye(len(covariance)))
        self._root = torch.from_numpy(root).float()

    @classmethod
    def fit(
        cls,
        forecaster: Forecaster,
        errors_m: Float[np.ndarray, "examples horizon axes"],
    ) -> "GaussianResidual":
        """Fits the covariance to errors of the single forecast on training data.

        Raises:
            UserError: there are fewer errors than coordinates, or some are not finite.
        """
        flat = errors_m.reshape(len(errors_m), -1).astype(np.float64)
        if not np.isfinite(flat).all():
            raise UserError("the single forecast has errors that are not finite; its weights are damaged or diverged")
        if len(flat) <= flat.shape[1]:
            raise UserError(f"a covariance of {flat.shape[1]} coordinates needs more examples, got {len(flat)}")
        return cls(forecaster, flat.T @ flat / len(flat))

    @property
    def spec(self) -> SceneSpec:
        """Layout of the scenes."""
        return self.forecaster.spec

    @property
    def num_edge_types(self) -> int:
        """Number of edge types."""
        return self.forecaster.num_edge_types

    @property
    def edge_feature_dim(self) -> int:
        """Number of features of an edge."""
        return self.forecaster.edge_feature_dim

    def std_m(self, horizon_steps: int) -> Float[Tensor, "horizon axes"]:
        """Returns the standard deviation of the noise at each step [m]."""
        std_m = torch.from_numpy(np.sqrt(np.diag(self.covariance))).float()
        return std_m.unflatten(0, (self.horizon_steps, self.spec.position_dim))[:horizon_steps]

    def empty_memory(self, batch: int, agents: int) -> Memory:
        """Returns the forecaster's memory before any observation."""
        return self.forecaster.empty_memory(batch, agents)

    def observe(
        self, memory: Memory, states: Float[Tensor, "batch agents state"], valid: Bool[Tensor, "batch agents"]
    ) -> tuple[Memory, Belief]:
        """Lets the forecaster observe."""
        return self.forecaster.observe(memory, states, valid)

    def rollout(
        self, belief: Belief, horizon_steps: int, num_samples: int = 1, generator: Noise | None = None
    ) -> Futures:
        """Returns the single forecast as sample 0, and draws around it.

        Raises:
            UserError: `horizon_steps` is larger than the fitted one.
        """
        self._check(horizon_steps)
        single = self.forecaster.rollout(belief, horizon_steps, 1).states
        return self._around(single, belief, num_samples, generator)

    def rollout_plans(
        self,
        belief: Belief,
        plans: Float[Tensor, "batch plans horizon state"],
        num_samples: int = 1,
        generator: Noise | None = None,
    ) -> Futures:
        """Returns, for each plan of agent 0, the single forecast as sample 0, and draws around it; all share the noise.

        Raises:
            UserError: the plans have more steps than the fitted ones, or do not fit the scenes.
        """
        self._check(plans.shape[2])
        single = rollout_plans(self.forecaster, belief, plans).states
        return self._around(single, belief, num_samples, generator)

    def _check(self, horizon_steps: int) -> None:
        if horizon_steps > self.horizon_steps:
            raise UserError(f"the noise was fitted to {self.horizon_steps} steps, got horizon_steps={horizon_steps}")

    def _around(self, single: Tensor, belief: Belief, num_samples: int, generator: Noise | None) -> Futures:
        """Draws around single forecasts, [batch *plans 1 agents horizon state]."""
        axes, horizon_steps = self.spec.position_dim, single.shape[-2]
        future = single.repeat_interleave(num_samples, dim=-4)
        drawn = normal_of_agents(generator, belief.valid, num_samples - 1, len(self._root)).to(future)
        noise = (drawn @ self._root.to(future).T).unflatten(-1, (self.horizon_steps, axes))[..., :horizon_steps, :]
        if future.ndim == 6:  # with plans
            noise = noise[:, None]
        future[..., 1:, :, :, :axes] += noise
        change = noise.diff(dim=-2, prepend=torch.zeros_like(noise[..., :1, :]))
        future[..., 1:, :, :, axes : 2 * axes] += change / self.spec.dt_s
        return Futures(future)
