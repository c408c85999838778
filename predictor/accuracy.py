"""From forecasts and truth to an accuracy table; used on windows of a dataset and on live environments alike."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from predictor import metrics
from predictor.data.windows import WindowBatch, Windows
from predictor.forecaster import Forecaster


@dataclass(frozen=True)
class Outcome:
    """Forecasts and what then happened."""

    forecast: Float[Tensor, "batch samples agents horizon 2"]
    """Predicted positions [m]."""
    future: Float[Tensor, "batch agents horizon 2"]
    """True positions [m], same frame."""
    valid: Bool[Tensor, "batch agents horizon"]
    """Which truths exist and count."""


@dataclass(frozen=True)
class Accuracy:
    """Errors of one forecaster at one number of samples."""

    name: str
    """The forecaster."""
    num_samples: int
    """K of the best-of-K metrics."""
    min_ade_m: float
    """Mean over agents whose truth is known over the whole horizon [m]."""
    min_fde_m: float
    """The same at the last step [m]."""
    by_step_m: list[float]
    """Displacement at each step of each agent's best sample [m], all agents whose truth is known there."""
    rmse_m: list[float]
    """Root mean squared displacement of the samples' mean at each step [m]."""
    nll: list[float]
    """Negative log-likelihood at each step [nats], with the spread fitted on validation data; empty without one."""
    agents: int
    """Forecasts (agent × instant) behind min_ade_m."""


@torch.inference_mode()
def run_window_batch(
    forecaster: Forecaster,
    batch: WindowBatch,
    horizon_steps: int,
    num_samples: int = 1,
    generator: torch.Generator | None = None,
) -> Outcome:
    """Stream the history of each window, forecast, and line up the truth; the ego is left out."""
    rows = torch.arange(len(batch.states), device=batch.states.device)
    longest = int(batch.last_observed.max())
    memory = forecaster.empty_memory(batch.states.shape[0], batch.states.shape[2])
    belief = None
    for back in range(longest, -1, -1):
        # Histories end together: rows that begin later see an empty scene until then.
        step = batch.last_observed - back
        started = step >= 0
        now = step.clamp(min=0)
        valid = batch.valid[rows, now] & started[:, None]
        memory, belief = forecaster.observe(memory, batch.states[rows, now] * valid[..., None], valid)
    assert belief is not None
    future_states = forecaster.rollout(belief, horizon_steps, num_samples, generator)
    steps = batch.last_observed[:, None] + torch.arange(1, horizon_steps + 1, device=rows.device)
    truth = batch.states[rows[:, None], steps].transpose(1, 2)
    valid = batch.valid[rows[:, None], steps].transpose(1, 2) & belief.valid[..., None]
    if forecaster.spec.has_ego:
        valid = valid.clone()
        valid[:, 0] = False
    return Outcome(future_states[..., :2], truth[..., :2], valid)


def run_windows(
    forecaster: Forecaster,
    windows: Windows,
    indices: Int[np.ndarray, " some"],
    horizon_steps: int,
    num_samples: int = 1,
    seed: int = 0,
    batch_size: int = 256,
    device: str = "cpu",
) -> Iterator[Outcome]:
    """Outcomes of the given windows, in batches."""
    generator = torch.Generator(device=device).manual_seed(seed)
    for begin in range(0, len(indices), batch_size):
        batch = windows.batch(indices[begin : begin + batch_size]).to(torch.device(device))
        yield run_window_batch(forecaster, batch, horizon_steps, num_samples, generator)


def summarise(name: str, outcomes: Sequence[Outcome], std_m: Sequence[float] = ()) -> Accuracy:
    """Average outcomes into one row.

    Args:
        name: the forecaster's name.
        outcomes: at least one, of equal samples and horizon.
        std_m: spread per axis at each step [m] for the likelihood; empty leaves it out.
    """
    samples, horizon = outcomes[0].forecast.shape[1], outcomes[0].forecast.shape[3]
    complete: list[Tensor] = []
    final: list[Tensor] = []
    sums = torch.zeros(3, horizon, dtype=torch.float64)
    counts = torch.zeros(horizon, dtype=torch.float64)
    spread = torch.tensor(list(std_m)[:horizon]) if len(std_m) >= horizon else None
    for outcome in outcomes:
        forecast, future, valid = outcome.forecast.cpu(), outcome.future.cpu(), outcome.valid.cpu()
        whole = valid.all(-1)
        complete.append(metrics.min_ade(forecast, future, valid)[0][whole])
        final.append(metrics.min_fde(forecast, future, valid)[0][whole])
        values = [
            metrics.min_displacement(forecast, future, valid)[0],
            metrics.squared_error(forecast, future, valid)[0],
        ]
        if spread is not None:
            values.append(metrics.gaussian_mixture_nll(forecast, future, valid, spread)[0])
        for i, value in enumerate(values):
            sums[i] += torch.where(valid, value, 0.0).sum((0, 1)).double()
        counts += valid.sum((0, 1))
    means = sums / counts.clamp(min=1)
    ade, fde = torch.cat(complete), torch.cat(final)
    return Accuracy(
        name=name,
        num_samples=samples,
        min_ade_m=float(ade.mean()) if len(ade) else float("nan"),
        min_fde_m=float(fde.mean()) if len(fde) else float("nan"),
        by_step_m=means[0].tolist(),
        rmse_m=means[1].sqrt().tolist(),
        nll=means[2].tolist() if spread is not None else [],
        agents=len(ade),
    )


def fitted_std_m(outcomes: Sequence[Outcome]) -> tuple[float, ...]:
    """Standard deviation per axis of the first sample's error at each step [m]: the maximum-likelihood round spread."""
    horizon = outcomes[0].forecast.shape[3]
    total, count = torch.zeros(horizon, dtype=torch.float64), torch.zeros(horizon, dtype=torch.float64)
    for outcome in outcomes:
        squared = (outcome.forecast[:, 0] - outcome.future).square().sum(-1)
        total += torch.where(outcome.valid, squared, 0.0).sum((0, 1)).double().cpu()
        count += outcome.valid.sum((0, 1)).cpu()
    variance = total / (2 * count.clamp(min=1))
    return tuple(variance.sqrt().clamp(min=1e-3).tolist())
