"""Geometry of a pair: where the sender is and how it moves, as the receiver sees it, at the scale at which agents act.

An agent's own inputs are divided by their spread over the map. On a road that is tens of metres, so that a gap which is
closing hardly differs from one that is not; and a network of two layers cannot turn two velocities into the rate at
which a distance shrinks. These are given to the edges instead (not in the paper).
"""

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

_NEAR = 0.3
"""Addend to distances and speeds, as a share of their scales: directions vanish smoothly where these do."""


class Geometry(nn.Module):
    """Computes the geometry of pairs from the inputs of their agents; nothing is learned.

    Args:
        units: size of one unit of the first inputs, positions [m] and velocities [m/s].
        distance_m: scale of distances [m].
        speed_mps: scale of speeds [m/s].
    """

    def __init__(self, units: Float[Tensor, " axes_twice"], distance_m: float, speed_mps: float) -> None:
        """Creates a buffer, which is not saved."""
        super().__init__()
        self.axes = len(units) // 2
        scales = torch.tensor([distance_m] * self.axes + [speed_mps] * self.axes)
        self._factor: Tensor
        self.register_buffer("_factor", units / scales, persistent=False)

    @property
    def num_features(self) -> int:
        """Number of features of a pair."""
        return 2 * self.axes + 6

    def forward(
        self, own: Float[Tensor, "*#pairs inputs"], other: Float[Tensor, "*#pairs inputs"]
    ) -> Float[Tensor, "*both geometry"]:
        """Computes the features of pairs of a receiver and a sender, between −1 and 1.

        Relative position and velocity; both along and across the receiver's motion; distance, and the rate at
        which it shrinks, by itself and as a share of the distance (the inverse of the time to contact).
        """
        axes, width = self.axes, 2 * self.axes
        mine = own[..., :width] * self._factor
        apart = other[..., :width] * self._factor - mine
        where, moving, heading = apart[..., :axes], apart[..., axes:], mine[..., axes:]
        heading = heading / (heading.square().sum(-1, keepdim=True) + _NEAR**2).sqrt()
        squared = where.square().sum(-1, keepdim=True)
        distance = (squared + _NEAR**2).sqrt()
        closing = -(where * moving).sum(-1, keepdim=True) / distance
        ahead, faster = ((vector * heading).sum(-1, keepdim=True) for vector in (where, moving))
        beside = _across(heading, where, ahead, squared)
        features = torch.cat([apart, ahead, beside, faster, distance, closing, closing / distance], dim=-1)
        return functional.softsign(features)


def _across(heading: Tensor, where: Tensor, ahead: Tensor, squared: Tensor) -> Tensor:
    """Computes the distance across the heading: to the left in the plane, without a side in space."""
    if where.shape[-1] == 2:
        return heading[..., :1] * where[..., 1:] - heading[..., 1:] * where[..., :1]
    return ((squared - ahead.square()).clamp(min=0) + _NEAR**2).sqrt()
