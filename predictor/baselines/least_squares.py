"""Upper bound for springs: given their law, infers the constants by least squares and integrates it. No competitor.

Springs are linear in their constants: over a step, Δv_i = Σ_j k_ij ∫(r_j − r_i) dt. The integral follows from positions
and velocities at both ends (Hermite, exact to fourth order in dt). Each receiver keeps its normal equations over
senders, so streaming is exact; the two estimates of a spring are averaged. Steps in which the receiver may have touched
a wall are left out; a sender that touches one bends the integral a little. Columns of the equations are the scene's
places, so agents must keep theirs.
"""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from predictor.data.springs import Physics, simulate
from predictor.forecaster import Belief, Futures, Memory
from predictor.graph import pair_mask
from predictor.noise import Noise
from predictor.scene import SceneSpec
from predictor.support.errors import UserError

SMALLEST_CONSTANT = 0.5
"""Smallest spring constant of the paper's data [N/m]."""
RIDGE = 1e-9


class _Internal(NamedTuple):
    constants: Tensor


class SpringLeastSquares:
    """Forecaster of springs with known law and unknown constants; its one edge feature is the spring constant.

    Args:
        spec: layout of the springs' store.
        horizon_steps: default number of steps to forecast.
        smallest_constant: smallest spring constant of the data [N/m]; pairs below half of it have no spring.
    """

    num_edge_types = 2
    edge_feature_dim = 1

    def __init__(
        self,
        spec: SceneSpec,
        horizon_steps: int = 10,
        smallest_constant: float = SMALLEST_CONSTANT,
    ) -> None:
        """Stores the arguments; nothing is learned."""
        if spec.position_dim != 2 or spec.has_ego:
            raise UserError("least squares needs springs in a plane without an ego; use another model")
        self.spec = spec
        self.horizon_steps = horizon_steps
        self.smallest_constant = smallest_constant

    def empty_memory(self, batch: int, agents: int) -> Memory:
        """Returns zeros for the latest state with a mark, and each receiver's normal matrix and right-hand side."""
        zeros = torch.zeros(batch, agents, agents, agents + 1, dtype=torch.float64)
        return Memory((torch.zeros(batch, agents, 5, dtype=torch.float64),), (zeros,))

    def observe(
        self, memory: Memory, states: Float[Tensor, "batch agents state"], valid: Bool[Tensor, "batch agents"]
    ) -> tuple[Memory, Belief]:
        """Adds the latest step's two equations per receiver, and solves for the constants."""
        (before,), (equations,) = memory.nodes, memory.pairs
        now = torch.cat([states.double(), torch.ones_like(states[..., :1], dtype=torch.float64)], dim=-1)
        now = now * valid[..., None]
        both = pair_mask(valid & (before[..., 4] > 0))
        seconds = self.spec.dt_s
        integral = seconds * (before[..., :2] + now[..., :2]) / 2 + seconds**2 * (before[..., 2:4] - now[..., 2:4]) / 12
        regressors = (integral[:, None] - integral[:, :, None]) * both[..., None]  # receiver, sender, axis
        kick = now[..., 2:4] - before[..., 2:4]
        usable = (both.any(-1) & ~self._near_wall(before) & ~self._near_wall(now))[..., None, None]
        normal = torch.einsum("bija,bila->bijl", regressors, regressors)
        right = torch.einsum("bija,bia->bij", regressors, kick)
        absent = equations.shape[-1] - 1 - states.shape[1]  # places behind the last agent, of which no state is given
        added = torch.cat([functional.pad(normal, (0, absent)), right[..., None]], dim=-1)
        equations = equations + added * usable
        constants = self._solve(equations, pair_mask(valid))
        has_edge = constants > self.smallest_constant / 2
        probs = torch.stack([~has_edge, has_edge], dim=-1).to(states.dtype)
        belief = Belief(states, valid, probs, constants[..., None].to(states.dtype), _Internal(constants * has_edge))
        return Memory((now,), (equations,)), belief

    def rollout(
        self, belief: Belief, horizon_steps: int, num_samples: int = 1, generator: Noise | None = None
    ) -> Futures:
        """Integrates the law; all samples are equal."""
        physics = Physics(
            num_agents=belief.states.shape[1],
            dt_s=self.spec.dt_s,
            frames=horizon_steps + 1,
        )
        states = belief.states.double()
        rolled = simulate(physics, belief.internal.constants, states[..., :2], states[..., 2:])
        future = rolled[:, 1:].transpose(1, 2).to(belief.states.dtype)
        return Futures(future[:, None].expand(-1, num_samples, -1, -1, -1))

    def _near_wall(self, states: Tensor) -> Tensor:
        reach = states[..., 2:4].abs() * self.spec.dt_s
        near: Tensor = (states[..., :2].abs() + reach > Physics.box_m).any(-1)
        return near

    def _solve(self, equations: Tensor, pairs: Tensor) -> Float[Tensor, "batch agents agents"]:
        agents = equations.shape[2]
        normal = equations[..., :agents] + RIDGE * torch.eye(agents, dtype=torch.float64)
        solved = torch.linalg.solve(normal, equations[..., -1])
        return (solved + solved.transpose(1, 2)) / 2 * pairs
