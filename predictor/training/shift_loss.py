"""Loss on shifts: how far an intervention moves agents, beside how far it moves their forecasts.

The same moment is forecast with and without the intervention, with equal noise. What is unforeseeable in both (a
route, a wished speed) is in both errors and leaves the difference, so that a reaction is learned from far fewer
interventions than by the error of either forecast (not in the paper).
"""

import torch
from jaxtyping import Float
from torch import Tensor

from predictor.data.twins import MOVED, Pairs
from predictor.forecaster import WindowOutput
from predictor.training.mode_loss import unit

LARGE = 0.03
"""Error, in units of the position's scale, from which on the loss grows linearly: the mean is learned, few large shifts
(a lane change) do not decide alone."""


def shift_loss(
    branches: WindowOutput,
    twins: WindowOutput,
    pairs: Pairs,
    scales: Float[Tensor, " state"],
    axes: int,
    variance: float,
) -> Float[Tensor, ""]:
    """Computes the error of the predicted shifts: pseudo-Huber, sum over agents and steps, per moved agent and step.

    Predicted shifts are those of the single forecast, and those of the modes' means, where there are modes.

    Args:
        branches: output for the windows with the intervention.
        twins: output for those without.
        pairs: the windows; roll-outs may be shorter than their horizon.
        scales: divisors that make features comparable.
        axes: number of axes of a position.
        variance: variance of the likelihood, whose unit this loss has.
    """
    steps = branches.rollout.shape[2]
    counted = pairs.counted[..., :steps, None]
    true = pairs.true_shift(axes)[..., :steps, :] / scales[:axes]
    moved = (true.norm(dim=-1) > MOVED / 2).sum().clamp(min=1)
    forecasts = [(branches.rollout, twins.rollout)]
    if branches.modes is not None and twins.modes is not None and branches.modes.states.shape[1] > 1:
        forecasts.append((_mean(branches), _mean(twins)))
    total = true.new_zeros(())
    for after, before in forecasts:
        predicted = (after - before)[..., :axes] / scales[:axes]
        squared = torch.where(counted, predicted - true, 0.0).square().sum(-1)
        total = total + LARGE * ((1 + squared / LARGE**2).sqrt() - 1).sum()
    return unit(variance) * total / moved


def _mean(output: WindowOutput) -> Float[Tensor, "batch agents horizon state"]:
    """Computes the mean of the modes, weighted by their probabilities."""
    assert output.modes is not None and output.modes.mode_probs is not None
    return (output.modes.states * output.modes.mode_probs[..., None, None]).sum(1)
