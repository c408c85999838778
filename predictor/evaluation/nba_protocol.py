"""The protocol "NBA Score" of SocialVAE (Xu et al., ECCV 2022), on stores of whole possessions.

8 observed frames of 0.12 s, 12 predicted ones, best of K = 20, errors in feet. Every stretch of 20 frames of a
possession is a window (stride 1), and every player who is present throughout counts, which here are all ten; the ball
is a neighbour only. That gives 10 · Σ max(frames − 19, 0) forecasts, 592,640 on the published test folder, the number
that SocialVAE's README names. minADE and minFDE are the best of a player's K samples, each by itself; the mean is over
players and windows.

Eight positions make seven velocities, so a model observes seven steps: those of the frames 2 to 8. The first frame is
in them, as the position of the second less its velocity; no frame before the window is used, and none after it.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor

from predictor.baselines.constant_velocity import ConstantVelocity, NoisyConstantVelocity
from predictor.baselines.gaussian_residual import GaussianResidual
from predictor.data.nba import DT_S, FEATURES, METRES_PER_FOOT
from predictor.data.store import EpisodeStore
from predictor.data.windows import Windows
from predictor.evaluation import displacement as metrics
from predictor.evaluation.accuracy import fitted_std_m, ratio
from predictor.evaluation.energy_score import energy_score
from predictor.evaluation.outcomes import Outcome, noise_of_windows, run_window_batch
from predictor.evaluation.standard_errors import batch_interval
from predictor.forecaster import Forecaster
from predictor.support.errors import UserError
from predictor.support.progress import track

OBSERVED_FRAMES = 8
HISTORY_STEPS = OBSERVED_FRAMES - 1
"""Number of observed steps: a frame without one before it has no velocity and is no step."""
HORIZON_STEPS = 12
"""Number of predicted frames."""
NUM_SAMPLES = 20
"""Number of samples K."""
TEST_FORECASTS = 592_640
"""Number of forecasts on the published test folder, from SocialVAE's README."""


class Published(NamedTuple):
    """A published result on the test folder."""

    name: str
    """Name in the table."""
    min_ade_ft: float
    """Best of 20 mean displacements [ft]."""
    min_fde_ft: float
    """Best of 20 final displacements [ft]."""


PUBLISHED = (
    Published("SocialVAE, published", 0.64, 1.17),
    Published("SocialVAE + FPC, published", 0.58, 0.95),
)
"""SocialVAE's figures, quoted from memory. FPC draws 15 to 19 times as many samples and keeps 20 that are far apart."""


RESIDUAL_WINDOWS = 2_000
"""Largest number of training windows, of ten players each, to which a model's covariance is fitted."""


@dataclass(frozen=True)
class PlayerErrors:
    """Errors of one forecaster."""

    name: str
    """Name of the forecaster."""
    num_samples: int
    """Number of samples K."""
    forecasts: int
    """Number of forecasts, players times windows."""
    min_ade_ft: float
    """Mean displacement of each player's best sample [ft]."""
    min_fde_ft: float
    """Final displacement of each player's best sample [ft]."""
    min_joint_ade_ft: float
    """Mean displacement of the best sample of all ten players together [ft]."""
    min_joint_fde_ft: float
    """Final displacement of the best sample of all ten players together [ft]."""
    ade_ft: float
    """Mean displacement of the single forecast, sample 0 [ft]."""
    fde_ft: float
    """Final displacement of the single forecast [ft]."""
    energy_ft: float
    """Energy score of the samples [ft], a proper score."""
    coverage: float | None
    """Share of truths within the central 90 % of the samples; None with too few samples."""
    seconds: float = 0.0
    """Time that it took [s]."""
    intervals: dict[str, tuple[float, float]] = field(default_factory=dict)
    """95 % bootstrap interval over possessions, by name of the fields above; windows of a possession overlap."""


def protocol_windows(store: EpisodeStore, path: Path) -> Windows:
    """Returns all windows of the protocol.

    Raises:
        UserError: the store is not of `predictor.data.nba`, or no possession has 20 frames.
    """
    spec = store.info.spec
    if spec.feature_names != FEATURES or abs(spec.dt_s - DT_S) > 1e-6:
        raise UserError(f"{path} holds no basketball; make a store with python -m predictor.data.nba --episode-steps 0")
    try:
        return Windows(store.episodes, spec, HISTORY_STEPS, HORIZON_STEPS, HORIZON_STEPS, HISTORY_STEPS)
    except UserError as error:
        raise UserError(f"{path}: {error}; make it with --episode-steps 0, which keeps possessions whole") from error


def drawn(windows: Windows, max_windows: int, seed: int) -> Int[np.ndarray, " some"]:
    """Returns the numbers of at most `max_windows` windows, drawn evenly; 0 takes all."""
    if not 0 < max_windows < len(windows):
        return np.arange(len(windows))
    return np.sort(np.random.default_rng(seed).permutation(len(windows))[:max_windows])


def player_outcomes(
    forecaster: Forecaster,
    windows: Windows,
    indices: Int[np.ndarray, " some"],
    num_samples: int,
    seed: int = 0,
    batch_size: int = 64,
    device: str = "cpu",
    label: str = "",
) -> Iterator[tuple[Int[np.ndarray, " batch"], Outcome]]:
    """Yields the episode of each window, and forecasts and truth in which players alone are valid; keeps nothing."""
    ball = FEATURES.index("is_ball")
    begins = range(0, len(indices), batch_size)
    for begin in track(begins, label) if label else begins:
        chosen = indices[begin : begin + batch_size]
        batch = windows.batch(chosen).to(torch.device(device))
        outcome = run_window_batch(forecaster, batch, HORIZON_STEPS, num_samples, noise_of_windows(chosen, seed))
        is_player = batch.states[:, HISTORY_STEPS - 1, :, ball] < 0.5
        yield windows.index[chosen, 0], replace(outcome, valid=outcome.valid & is_player[..., None])


def fitted_noise(windows: Windows, indices: Int[np.ndarray, " some"]) -> NoisyConstantVelocity:
    """Returns constant velocity with noise, whose two parameters are fitted to the players of the given windows."""
    straight = ConstantVelocity(windows.spec, HORIZON_STEPS)
    outcomes = player_outcomes(straight, windows, indices, 1, batch_size=1024, label="fit noise")
    return NoisyConstantVelocity.fit(windows.spec, fitted_std_m(outcome for _, outcome in outcomes))


def fitted_residual(forecaster: Forecaster, windows: Windows, seed: int = 0, device: str = "cpu") -> GaussianResidual:
    """Returns a forecaster's single forecast with noise, whose covariance is fitted to errors on players.

    Args:
        forecaster: model whose single forecast errs.
        windows: training data, of which at most `RESIDUAL_WINDOWS` are drawn evenly.
        seed: random seed of the drawn windows.
        device: device that runs the model.
    """
    indices = drawn(windows, RESIDUAL_WINDOWS, seed)
    outcomes = player_outcomes(forecaster, windows, indices, 1, seed, device=device, label="fit covariance")
    errors = [(o.future - o.forecast[:, 0])[o.valid.all(-1)].cpu().numpy() for _, o in outcomes]
    return GaussianResidual.fit(forecaster, np.concatenate(errors))


class PlayerTally:
    """Adds up errors by possession, batch by batch."""

    def __init__(self, possessions: int) -> None:
        """Begins with zeros for each possession."""
        self._possessions = possessions
        self._sums: dict[str, np.ndarray] = {}
        self._counts: dict[str, np.ndarray] = {}
        self._samples = 0

    def add(self, possession: Int[np.ndarray, " batch"], outcome: Outcome) -> None:
        """Adds a batch of windows [m]."""
        self._samples = outcome.forecast.shape[1]
        for name, (values, valid) in _errors(outcome).items():
            known, count = torch.where(valid, values, 0.0).double(), valid.double()
            for kept, added in ((self._sums, known), (self._counts, count)):
                total = kept.setdefault(name, np.zeros(self._possessions))
                np.add.at(total, possession, added.flatten(1).sum(1).cpu().numpy())

    def errors(self, name: str, seconds: float = 0.0) -> PlayerErrors:
        """Returns the means over everything that was added, in feet."""
        means = {key: ratio(self._sums[key].sum(), self._counts[key].sum()) for key in self._sums}
        limits = {key: batch_interval(self._sums[key], self._counts[key]) for key in self._sums}
        measured = bool(self._counts["coverage"].any())
        return PlayerErrors(
            name,
            self._samples,
            int(self._counts["min_ade_ft"].sum()),
            coverage=means.pop("coverage") if measured else None,
            seconds=seconds,
            intervals={key: found for key, found in limits.items() if found is not None},
            **{key: mean for key, mean in means.items() if key != "coverage"},
        )


def _errors(outcome: Outcome) -> dict[str, tuple[Tensor, Tensor]]:
    """Returns values and mask of each error [ft], per player or per scene."""
    forecast, future = outcome.forecast / METRES_PER_FOOT, outcome.future / METRES_PER_FOOT
    valid = outcome.valid & outcome.valid.all(-1, keepdim=True)
    joint = (metrics.min_joint_ade(forecast, future, valid), metrics.min_joint_fde(forecast, future, valid))
    return {
        "min_ade_ft": metrics.min_ade(forecast, future, valid),
        "min_fde_ft": metrics.min_fde(forecast, future, valid),
        "min_joint_ade_ft": (joint[0][0][:, None], joint[0][1][:, None]),
        "min_joint_fde_ft": (joint[1][0][:, None], joint[1][1][:, None]),
        "ade_ft": metrics.min_ade(forecast[:, :1], future, valid),
        "fde_ft": metrics.min_fde(forecast[:, :1], future, valid),
        "energy_ft": energy_score(forecast, future, valid, outcome.mode_probs),
        "coverage": metrics.coverage(forecast, future, valid, mode_probs=outcome.mode_probs),
    }
