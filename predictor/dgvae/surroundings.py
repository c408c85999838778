"""Surroundings of an agent: what is nearest ahead of it and behind it, in its own lane and in those beside it.

Whether a driver changes lane depends on the gaps around it, that is on the nearest agent of each side alone. A sum over
all neighbours hides it. So the maximum over neighbours is taken of how near each one is, and the graph layer adds a
linear function of it to each agent (not in the paper). It also tells whose edge a pair is: an agent behind which
another one is nearer seldom matters.
"""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from predictor.dgvae.geometry import across

_LANE = 0.2
"""Width of a lane as a share of the typical distance of neighbours: 4 m on roads, where that is about 20 m."""
_BESIDE = 0.1
"""Distance along the heading, as a share of the typical one, below which an agent is beside, neither ahead nor behind;
the agent itself, at 0, is nowhere."""
_LOUD = 4.0
"""Factor of all features: with it they vary as much as those of a pair's geometry, and are learned as fast."""
_NEAR = 0.3
"""Addend to speeds, as in `predictor.dgvae.geometry`: directions vanish smoothly with the speed."""


class Surroundings(nn.Module):
    """Computes the surroundings of agents from the inputs of their pairs; nothing is learned.

    Args:
        units: size of one unit of the first inputs, positions [m] and velocities [m/s].
        distance_m: typical distance of neighbours [m].
        speed_mps: typical relative speed of neighbours [m/s].
    """

    num_features = 18
    """Number of features of an agent: three for each of six places."""

    def __init__(self, units: Float[Tensor, " axes_twice"], distance_m: float, speed_mps: float) -> None:
        """Creates a buffer, which is not saved."""
        super().__init__()
        self.axes = len(units) // 2
        scales = torch.tensor([distance_m] * self.axes + [speed_mps] * self.axes)
        self._factor: Tensor
        self.register_buffer("_factor", units / scales, persistent=False)
        self._lanes: Tensor
        self.register_buffer("_lanes", torch.tensor([-_LANE, 0.0, _LANE]), persistent=False)

    def forward(self, graph: Any, inputs: Float[Tensor, "*agents inputs"]) -> Float[Tensor, "*agents surroundings"]:
        """Computes how near the nearest agent of each place is, and how fast it comes nearer or gets away.

        Places are the lane to the right, the own one and the one to the left, each ahead and behind. Lanes are strips
        along the agent's heading, with soft borders; in space there is no right and left. All is at least 0, and 0
        where nobody is.

        Args:
            graph: pairs of the agents, `Padded` or `Packed`.
            inputs: inputs of the agents, positions and velocities first.
        """
        axes, width = self.axes, 2 * self.axes
        own, other = graph.ends(inputs[..., :width] * self._factor)
        where, moving = (other - own).split(axes, dim=-1)
        heading = own[..., axes:]
        heading = heading / (heading.square().sum(-1, keepdim=True) + _NEAR**2).sqrt()
        ahead, faster = ((vector * heading).sum(-1, keepdim=True) for vector in (where, moving))
        beside = across(heading, where, ahead, where.square().sum(-1, keepdim=True), 0.1 * _LANE)
        in_lane = torch.exp(-((beside - self._lanes) / (0.5 * _LANE)).square())
        sides = torch.cat([ahead, -ahead], dim=-1).relu()
        near = _LOUD * sides / (_BESIDE + sides) / (1 + sides)
        leaving = functional.softsign(torch.cat([faster, -faster], dim=-1))
        kinds = torch.cat([near, near * (-leaving).relu(), near * leaving.relu()], dim=-1)
        found: Tensor = graph.most((in_lane[..., None] * kinds[..., None, :]).flatten(-2))
        return found
