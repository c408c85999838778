"""Fits the stochastic controls to training data: constant velocity with noise, and a forecast with Gaussian noise.

Landmarks are left out: they never move, and their errors of 0 would make the noise of all others too small.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from predictor.baselines.constant_velocity import ConstantVelocity, NoisyConstantVelocity
from predictor.baselines.gaussian_residual import GaussianResidual
from predictor.data.store import Episode, read_store
from predictor.data.windows import Windows
from predictor.evaluation.accuracy import fitted_std_m
from predictor.evaluation.outcomes import run_windows
from predictor.forecaster import Forecaster
from predictor.scene import SceneSpec

MOST_WINDOWS = 2000
"""Largest number of windows to which a control is fitted; of more, this many are drawn."""
HISTORY_STEPS = 100
"""Largest number of observed steps of these windows, about as many as a forecaster remembers: with a shorter history it
errs more, and the noise would be wider than that of its forecasts in an episode."""


def training_windows(
    stores: Sequence[Path], spec: SceneSpec, horizon_steps: int, history_steps: int = HISTORY_STEPS
) -> Windows:
    """Returns windows of recorded episodes whose future is known over the whole horizon."""
    episodes: list[Episode] = [episode for store in stores for episode in read_store(store).episodes]
    return Windows(episodes, spec, history_steps, horizon_steps, min_future_steps=horizon_steps)


def fit_noise(
    windows: Windows, horizon_steps: int, seed: int = 0, most_windows: int | None = None
) -> NoisyConstantVelocity:
    """Fits the two parameters of constant velocity with noise; see `fit_residual`."""
    straight = ConstantVelocity(windows.spec, horizon_steps)
    outcomes = run_windows(straight, windows, _drawn(windows, seed, most_windows), horizon_steps)
    return NoisyConstantVelocity.fit(windows.spec, fitted_std_m(o.without_landmarks() for o in outcomes))


def fit_residual(
    forecaster: Forecaster,
    windows: Windows,
    horizon_steps: int,
    seed: int = 0,
    device: str = "cpu",
    most_windows: int | None = None,
    batch_size: int = 256,
) -> GaussianResidual:
    """Fits the covariance of a forecaster's errors.

    Args:
        forecaster: model whose single forecast errs.
        windows: windows of training data.
        horizon_steps: number of steps of the forecast.
        seed: random seed of the windows that are drawn.
        device: device that runs the model.
        most_windows: largest number of windows; None takes `MOST_WINDOWS`.
        batch_size: number of windows in one forward; limits the memory.
    """
    errors, drawn = [], _drawn(windows, seed, most_windows)
    for outcome in run_windows(forecaster, windows, drawn, horizon_steps, batch_size=batch_size, device=device):
        whole = outcome.without_landmarks().valid.all(-1)
        errors.append((outcome.future - outcome.forecast[:, 0])[whole].cpu().numpy())
    return GaussianResidual.fit(forecaster, np.concatenate(errors))


def _drawn(windows: Windows, seed: int, most_windows: int | None = None) -> np.ndarray:
    return np.random.default_rng([seed, 3]).permutation(len(windows))[: most_windows or MOST_WINDOWS]
