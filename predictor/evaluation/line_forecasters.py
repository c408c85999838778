"""Makes the forecaster of a line of a table: loaded or fitted to the training store, always with samples.

A model without samples of its own gets them from a Gaussian, fitted to the errors of its single forecast. All noise is
fitted to the same windows of the training store: as many observed and predicted steps as the table measures, as far as
training episodes are long enough. Which windows are drawn does not depend on the training seed.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from predictor.baselines.constant_velocity import ConstantVelocity
from predictor.baselines.least_squares import SpringLeastSquares
from predictor.baselines.majority import MajorityGraph
from predictor.baselines.nearest_neighbour import NearestNeighbour
from predictor.checkpoint import load_checkpoint
from predictor.data.store import Episode, read_store
from predictor.data.windows import Windows
from predictor.evaluation.controls import fit_noise, fit_residual
from predictor.evaluation.paper_tables import NUM_SAMPLES, Line, PaperTable, Protocol, Sizes
from predictor.scene import SceneSpec

PAIR_BUDGET = 60_000
"""Largest number of pairs × samples per batch; it limits memory for scenes of any size."""
MOST_WINDOWS_OF_A_BATCH = 256
"""Largest number of windows per batch."""


@dataclass(frozen=True)
class LineForecaster:
    """A forecaster and what a table says of it."""

    forecaster: Any
    """The forecaster; its `rollout` gives K samples."""
    device: str
    """Device that it runs on."""
    parameters: int = 0
    """Number of trained weights."""
    std_m: tuple[float, ...] = ()
    """Spread per axis at each step [m] around the samples, fitted on validation data; empty without one."""
    fitted: dict[str, Any] = field(default_factory=dict)
    """Numbers that were fitted to training windows."""


def line_forecaster(
    table: PaperTable, line: Line, data: Path, sizes: Sizes, checkpoint: Path | None, spec: SceneSpec, device: str
) -> LineForecaster:
    """Returns the forecaster of a line.

    Args:
        table: table of the line.
        line: line to measure.
        data: folder of the stores.
        sizes: number of training episodes and windows to fit to.
        checkpoint: trained weights; None for a line without training.
        spec: layout of the test scenes.
        device: device that runs models.

    Raises:
        UserError: a store or checkpoint is unreadable, or training episodes are too short to fit to.
    """
    horizon_steps = table.protocol.horizon_steps
    if line.is_trained:
        assert checkpoint is not None
        model, info = load_checkpoint(checkpoint, device)
        made = LineForecaster(model, device, sum(p.numel() for p in model.parameters()), info.std_m)
        return _with_residuals(made, table, data, sizes) if line.draws_residuals else made
    episodes = _episodes(table, data, sizes)
    if line.model == "constant-velocity-noise":
        windows = fit_windows(episodes, spec, table.protocol)
        noisy = fit_noise(windows, horizon_steps, most_windows=sizes.fit_windows)
        fitted = {"noise_m": noisy.noise_m, "growth": noisy.growth, "windows": min(len(windows), sizes.fit_windows)}
        return LineForecaster(noisy, device, fitted=fitted)
    if line.model == "nearest-neighbours":
        near = NearestNeighbour.fit(episodes, spec, horizon_steps, k=NUM_SAMPLES - 1).to(device)
        return LineForecaster(near, device, fitted={"neighbours": near.k, "examples": near.num_examples})
    forecaster: Any = ConstantVelocity(spec, horizon_steps)
    if line.model == "majority":
        forecaster = MajorityGraph.fit(spec, horizon_steps, episodes)
    if line.model == "least-squares":  # it works on the CPU only
        forecaster, device = SpringLeastSquares(spec, horizon_steps, smallest_constant=table.smallest_constant), "cpu"
    return _with_residuals(LineForecaster(forecaster, device), table, data, sizes)


def batch_size(agents: int, samples: int) -> int:
    """Returns the number of windows in one forward, for scenes of so many agents and samples."""
    return max(1, min(MOST_WINDOWS_OF_A_BATCH, PAIR_BUDGET // (max(1, agents) ** 2 * samples)))


def fit_windows(episodes: Sequence[Episode], spec: SceneSpec, protocol: Protocol) -> Windows:
    """Returns windows of the table's lengths; of shorter history where the longest episode does not hold them.

    Raises:
        UserError: no episode is longer than the horizon.
    """
    horizon = protocol.horizon_steps
    longest = max((len(e.states) for e in episodes), default=0)
    history = max(1, min(protocol.burn_in_steps, longest - horizon))
    return Windows(episodes, spec, history, horizon, min_future_steps=horizon, min_history_steps=history)


def _with_residuals(made: LineForecaster, table: PaperTable, data: Path, sizes: Sizes) -> LineForecaster:
    """Returns the forecaster with samples around its single forecast."""
    episodes = _episodes(table, data, sizes)
    windows = fit_windows(episodes, made.forecaster.spec, table.protocol)
    agents = max(int(e.valid.sum(1).max(initial=0)) for e in episodes)
    residual = fit_residual(
        made.forecaster, windows, table.protocol.horizon_steps, device=made.device,
        most_windows=sizes.fit_windows, batch_size=batch_size(agents, 1),
    )  # fmt: skip
    fitted = {
        "std_m": residual.std_m(residual.horizon_steps).tolist(),
        "covariance_m2": residual.covariance.tolist(),
        "windows": min(len(windows), sizes.fit_windows),
    }
    return LineForecaster(residual, made.device, made.parameters, (), fitted)


def _episodes(table: PaperTable, data: Path, sizes: Sizes) -> Sequence[Episode]:
    """Returns the training episodes of a budget."""
    return read_store(data / table.train).episodes[: sizes.max_episodes or None]
