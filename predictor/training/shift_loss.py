"""Loss on shifts: how far an intervention moves agents, beside how far it moves their forecasts.

The same moment is forecast with and without the intervention, with equal noise. What is unforeseeable in both (a
route, a wished speed) is in both errors and leaves the difference, so that a reaction is learned from far fewer
interventions than by the error of either forecast (not in the paper).
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from predictor.data.store import Episode
from predictor.data.twins import MOVED, Pairs, Twins
from predictor.forecaster import WindowOutput
from predictor.scene import SceneSpec
from predictor.support.errors import UserError
from predictor.support.runtime import precision
from predictor.training.config import TrainConfig
from predictor.training.mode_loss import unit

MOVED_AT_STEP = MOVED / 2
"""Shift from which on an agent counts as moved at a step; less than of a pair, since shifts grow over the horizon."""
LARGE = 0.03
"""Error, in units of the position's scale, from which on the loss grows linearly: the mean is learned, few large shifts
(a lane change) do not decide alone."""


class TwinShifts:
    """Draws pairs of branches and twins, and computes the loss on their shifts; all is a function of (seed, step).

    Args:
        config: options of the run.
        twins: the pairs, at least one.
    """

    def __init__(self, config: TrainConfig, twins: Twins) -> None:
        """Keeps both."""
        self._config, self._twins = config, twins

    @staticmethod
    def of(
        config: TrainConfig, episodes: Sequence[Episode], spec: SceneSpec, several_processes: bool
    ) -> "TwinShifts | None":
        """Finds the pairs among training episodes; None if shifts have no weight.

        Raises:
            UserError: shifts have a weight, and there are no pairs, or several processes share the batches.
        """
        if not config.shift_weight:
            return None
        if several_processes:
            raise UserError("shift_weight needs one process; train on one device, or set it to 0")
        twins = Twins(episodes, spec, config.history_steps, config.horizon_steps)
        if not len(twins):
            raise UserError(
                "shift_weight needs branches with twins, got none; collect a store with --branches 4 --twins"
            )
        return TwinShifts(config, twins)

    def loss(
        self,
        model: Any,
        step: int,
        rollout_steps: int,
        scales: Float[Tensor, " state"],
        num_modes: int = 1,
    ) -> Float[Tensor, ""]:
        """Computes the loss of half as many pairs as a batch has windows; both windows of a pair have equal noise."""
        config = self._config
        rng = np.random.default_rng([config.seed, 5, step])
        drawn, seed = self._twins.draw(max(1, config.batch_size // 2), rng), int(rng.integers(2**62))
        pairs, outputs = self._twins.batch(drawn).to(scales.device), []
        noise, more = torch.Generator(device=scales.device), {"num_modes": num_modes} if num_modes > 1 else {}
        for side in (pairs.branches, pairs.twins):
            torch.manual_seed(seed)
            noise.manual_seed(seed)
            with precision("bfloat16" if config.precision == "bfloat16" else "float32", scales.device.type):
                output = model.window(side.states, side.valid, side.last_observed, rollout_steps, noise, **more)
            outputs.append(output.float())
        return shift_loss(outputs[0], outputs[1], pairs, scales, model.spec.position_dim, config.variance)


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
    moved = (true.norm(dim=-1) > MOVED_AT_STEP).sum().clamp(min=1)
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
