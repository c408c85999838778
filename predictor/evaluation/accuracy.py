"""Computes accuracy from forecasts and truth, for windows of a dataset and for live environments.

Each batch of outcomes is reduced to a few sums per window, so a test set of any size needs little memory; the
forecasts are not kept.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from predictor.evaluation import displacement as metrics
from predictor.evaluation.energy_score import energy_score
from predictor.evaluation.outcomes import Outcome
from predictor.evaluation.standard_errors import NUM_SUBSETS, Statistic, batch_interval, ratio_statistics
from predictor.support.errors import UserError

OPTIONAL = ("coverage", "mixture_nll", "mixture_coverage")
"""Names of quantities that are left out, not NaN, if they could not be measured."""
MOST_OFF = 1e-3
"""Largest difference from 1 of the sum of an agent's probabilities."""
SCALAR_NAMES = {"rmse_m": "overall_rmse_m"} | {name: name for name in OPTIONAL}
"""Names of the numbers over all steps, by name of the quantity at each step."""


@dataclass(frozen=True)
class Accuracy:
    """Errors of one forecaster at one number of samples; NaN without a truth to compare with."""

    name: str
    """Name of the forecaster."""
    num_samples: int
    """Number of samples, K of the best-of-K metrics."""
    min_ade_m: float
    """Mean displacement [m], best sample per agent; mean over agents whose truth is known over the whole horizon."""
    min_fde_m: float
    """Displacement at the last step [m], best sample per agent; mean over these agents."""
    by_step_m: list[float]
    """Displacement of each agent's best sample at each step [m]; mean over agents whose truth is known at the step."""
    rmse_m: list[float]
    """Root mean squared displacement of the samples' mean at each step [m]."""
    nll: list[float]
    """Negative log-likelihood at each step [nats], with the spread fitted on validation data; empty without one."""
    agents: int
    """Number of forecasts (agent × step) behind `min_ade_m`."""
    min_joint_ade_m: float = math.nan
    """Mean displacement [m], best sample per scene; mean over scenes, with the agents of `min_ade_m`."""
    min_joint_fde_m: float = math.nan
    """Displacement at the last step [m], best sample per scene; mean over scenes."""
    miss_rate: float = math.nan
    """Share of the agents of `min_fde_m` whose best final displacement is above the threshold."""
    overall_rmse_m: float = math.nan
    """Root mean squared displacement of the samples' mean [m] over all steps and agents whose truth is known. The
    squares of all axes are added, so it is never below the mean displacement."""
    coverage: list[float] = field(default_factory=list)
    """Share of truths within the central 90 % of the samples at each step; empty with too few samples."""
    miss_by_step: list[float] = field(default_factory=list)
    """Share of agents whose best sample has a displacement above the threshold at each step."""
    miss_threshold_m: float = metrics.MISS_THRESHOLD_M
    """Threshold of `miss_rate` and `miss_by_step` [m]."""
    ade_m: float = math.nan
    """Mean displacement of the single forecast, sample 0 [m]; mean over the agents of `min_ade_m`."""
    fde_m: float = math.nan
    """Displacement of the single forecast at the last step [m]."""
    energy_m: float = math.nan
    """Energy score of the samples [m], a proper score; mean over the agents of `min_ade_m`."""
    overlap: float = math.nan
    """Share of an agent's steps at which it is nearer than `miss_threshold_m` to another agent of the same sample."""
    true_overlap: float = math.nan
    """Share of the truth that `overlap` should have."""
    mixture_nll: list[float] = field(default_factory=list)
    """Negative log-likelihood [nats] under the predicted mixture at each step; empty without predicted scales. With
    more samples than modes it is the mixture of the samples drawn, of equal weights."""
    mixture_coverage: list[float] = field(default_factory=list)
    """Share of true coordinates within the central 90 % of the predicted mixture at each step; empty without predicted
    scales."""
    scenes: int = 0
    """Number of scenes behind `min_joint_ade_m`."""
    axes: int = 2
    """Number of axes of a position."""
    statistics: dict[str, Statistic] = field(default_factory=dict)
    """Mean ± standard error over subsets of the windows' episodes, by name of the scalar fields above, and those of
    `OPTIONAL` over all steps; without those that could not be measured."""
    step_errors: dict[str, list[float | None]] = field(default_factory=dict)
    """Standard error over these subsets at each step, by name of the list fields above."""
    intervals: dict[str, tuple[float, float]] = field(default_factory=dict)
    """95 % bootstrap interval over batches (episodes, in a live environment), by name of the scalar fields; empty
    if not requested."""
    step_intervals: dict[str, list[tuple[float, float] | None]] = field(default_factory=dict)
    """95 % bootstrap interval over batches at each step, by name of the list fields."""


class Tally:
    """Collects outcomes batch by batch and keeps a few numbers per window.

    Args:
        std_m: spread per axis at each step [m] for the likelihood; empty, shorter than the horizon, or not finite at a
            step, leaves it out.
        miss_threshold_m: threshold of the miss rate [m].
        partial_agents: whether agents with a partly known truth count: their displacement is the mean over the known
            steps, and their final one counts if the last step is known. By default they do not, so that every mean
            is over forecasts of equal length.
    """

    def __init__(
        self,
        std_m: Sequence[float] = (),
        miss_threshold_m: float = metrics.MISS_THRESHOLD_M,
        partial_agents: bool = False,
    ) -> None:
        """Begins without outcomes."""
        self._std_m = tuple(std_m) if np.isfinite(std_m).all() else ()
        self._threshold_m = miss_threshold_m
        self._partial = partial_agents
        self._shape: tuple[int, int, int] | None = None
        self._sums: dict[str, list[np.ndarray]] = {}
        self._counts: dict[str, list[np.ndarray]] = {}
        self._episodes: list[np.ndarray | None] = []

    def add(self, outcome: Outcome) -> None:
        """Adds a batch of windows.

        Raises:
            ValueError: the number of samples, steps or axes differs from that of earlier batches.
            UserError: a forecast that counts is not finite, or its probabilities or its scale are impossible.
        """
        _, samples, _, horizon, axes = outcome.forecast.shape
        counted = outcome.valid.any(dim=-1)[:, None, :, None, None]
        if not bool((outcome.forecast.isfinite() | ~counted).all()):
            raise UserError("the forecaster forecasts numbers that are not finite; its weights are damaged or diverged")
        _check_modes(outcome, counted[..., 0, 0])
        shape = (samples, horizon, axes)
        if self._shape not in (None, shape):
            raise ValueError(
                f"outcomes of one tally need the same samples, horizon and axes {self._shape}, got {shape}"
            )
        self._shape = shape
        self._episodes.append(outcome.episode)
        for name, (value, valid) in self._measure(outcome).items():
            known, count = torch.where(valid, value, 0.0).double(), valid.double()
            if valid.ndim > 1:
                known, count = known.sum(1), count.sum(1)  # over agents
            self._sums.setdefault(name, []).append(known.cpu().numpy())
            self._counts.setdefault(name, []).append(count.cpu().numpy())

    def accuracy(
        self, name: str, num_subsets: int = NUM_SUBSETS, seed: int = 0, batch_intervals: bool = False
    ) -> Accuracy:
        """Returns the accuracy over all batches that were added.

        Args:
            name: the forecaster's name.
            num_subsets: number of subsets for the standard errors: of the windows' episodes where these are known, as
                windows of one episode overlap or are alike, else of windows.
            seed: random seed of the subsets and of the bootstrap.
            batch_intervals: whether to bootstrap over the batches, each of which must be an independent episode.

        Raises:
            ValueError: nothing was collected.
        """
        if self._shape is None:
            raise ValueError("an accuracy needs at least one outcome, got none")
        samples, _, axes = self._shape
        counts = {key: np.concatenate(parts) for key, parts in self._counts.items()}
        counts = {key: count for key, count in counts.items() if count.any() or key not in OPTIONAL}
        sums = {key: np.concatenate(self._sums[key]) for key in counts}
        whole = {key: ratio(sums[key].sum(), counts[key].sum()) for key in counts}
        steps = {
            key: [ratio(s, c) for s, c in zip(sums[key].sum(0), counts[key].sum(0), strict=True)]
            for key in counts
            if counts[key].ndim == 2
        }
        added = self._by_episode()
        sums = {key: added(value) for key, value in sums.items()}
        counts = {key: added(value) for key, value in counts.items()}
        statistics, step_errors = _spread(sums, counts, num_subsets, seed, self._knows_episodes)
        intervals, step_intervals = self._bootstrap(seed) if batch_intervals else ({}, {})
        return Accuracy(
            name=name,
            num_samples=samples,
            agents=int(counts["min_ade_m"].sum()),
            scenes=int(counts["min_joint_ade_m"].sum()),
            axes=axes,
            **{
                key: whole[key]
                for key in (
                    "min_ade_m",
                    "min_fde_m",
                    "min_joint_ade_m",
                    "min_joint_fde_m",
                    "miss_rate",
                    "ade_m",
                    "fde_m",
                    "energy_m",
                )
            },
            overall_rmse_m=math.sqrt(whole["rmse_m"]),
            overlap=whole["overlap"],
            true_overlap=whole["true_overlap"],
            by_step_m=steps["by_step_m"],
            miss_by_step=steps["miss_by_step"],
            miss_threshold_m=self._threshold_m,
            rmse_m=[math.sqrt(value) for value in steps["rmse_m"]],
            nll=steps.get("nll", []),
            coverage=steps.get("coverage", []),
            mixture_nll=steps.get("mixture_nll", []),
            mixture_coverage=steps.get("mixture_coverage", []),
            statistics=statistics,
            step_errors=step_errors,
            intervals=intervals,
            step_intervals=step_intervals,
        )

    @property
    def _knows_episodes(self) -> bool:
        return all(part is not None for part in self._episodes)

    def _by_episode(self) -> Callable[[np.ndarray], np.ndarray]:
        """Returns a function that adds up the windows of each episode, in the order of their first windows."""
        if not self._knows_episodes:
            return lambda values: values
        numbers = np.concatenate([part for part in self._episodes if part is not None])
        _, first, places = np.unique(numbers, return_index=True, return_inverse=True)
        order = np.argsort(places, kind="stable")  # windows of an episode side by side
        starts = np.searchsorted(places[order], np.arange(len(first)))
        by_first = np.argsort(first)
        return lambda values: np.add.reduceat(values[order], starts, axis=0)[by_first]

    def _bootstrap(
        self, seed: int
    ) -> tuple[dict[str, tuple[float, float]], dict[str, list[tuple[float, float] | None]]]:
        """Computes `Accuracy.intervals` and `Accuracy.step_intervals`."""
        scalars: dict[str, tuple[float, float]] = {}
        by_step: dict[str, list[tuple[float, float] | None]] = {}
        for key, parts in self._sums.items():
            sums = np.stack([part.sum(0) for part in parts])
            counts = np.stack([part.sum(0) for part in self._counts[key]])
            root = key == "rmse_m"
            if sums.ndim == 1:
                found = batch_interval(sums, counts, seed, root)
                scalars |= {} if found is None else {key: found}
                continue
            if key in SCALAR_NAMES and (found := batch_interval(sums.sum(1), counts.sum(1), seed, root)) is not None:
                scalars[SCALAR_NAMES[key]] = found
            by_step[key] = [batch_interval(s, c, seed, root) for s, c in zip(sums.T, counts.T, strict=True)]
        return scalars, by_step

    def _measure(self, outcome: Outcome) -> dict[str, tuple[Tensor, Tensor]]:
        """Computes values and mask of every metric: per agent, per scene, and per agent and step."""
        forecast, future, valid = outcome.forecast, outcome.future, outcome.valid
        horizon = forecast.shape[3]
        counted = valid if self._partial else valid & valid.all(-1, keepdim=True)
        values = {
            "min_ade_m": metrics.min_ade(forecast, future, counted),
            "min_fde_m": metrics.min_fde(forecast, future, counted),
            "miss_rate": metrics.miss_rate(forecast, future, counted, self._threshold_m),
            "min_joint_ade_m": metrics.min_joint_ade(forecast, future, counted),
            "min_joint_fde_m": metrics.min_joint_fde(forecast, future, counted),
            "by_step_m": metrics.min_displacement(forecast, future, valid),
            "miss_by_step": self._missed(forecast, future, valid),
            "rmse_m": metrics.squared_error(forecast, future, valid, outcome.mode_probs),
            "coverage": metrics.coverage(forecast, future, valid, mode_probs=outcome.mode_probs),
            "ade_m": metrics.min_ade(forecast[:, :1], future, counted),
            "fde_m": metrics.min_fde(forecast[:, :1], future, counted),
            "energy_m": energy_score(forecast, future, counted, outcome.mode_probs),
        }
        solid = valid if outcome.carried is None else valid & ~outcome.carried[..., None]
        values["overlap"] = metrics.overlap(forecast, solid, self._threshold_m, outcome.mode_probs)
        values["true_overlap"] = metrics.overlap(future[:, None], solid, self._threshold_m)
        equal_probs = forecast.new_full(forecast.shape[:3], 1 / forecast.shape[1])
        if outcome.scale is not None:
            probs = equal_probs if outcome.mode_probs is None else outcome.mode_probs
            values["mixture_nll"] = metrics.mixture_nll(forecast, future, valid, probs, outcome.scale)
            values["mixture_coverage"] = metrics.mixture_coverage(forecast, future, valid, probs, outcome.scale)
        if len(self._std_m) >= max(1, horizon):
            std_m = torch.tensor(self._std_m[:horizon], device=forecast.device)[:, None].expand_as(forecast)
            values["nll"] = metrics.mixture_nll(forecast, future, valid, equal_probs, std_m)
        return values

    def _missed(self, forecast: Tensor, future: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
        distance, known = metrics.min_displacement(forecast, future, valid)
        return (distance > self._threshold_m).to(distance.dtype), known


def _check_modes(outcome: Outcome, counted: Tensor) -> None:
    """Checks probabilities and scales of the agents that count (batch, 1, agents): scores of others mean nothing."""
    probs, scale = outcome.mode_probs, outcome.scale
    if probs is not None:
        right = (probs >= 0).all(1, keepdim=True) & ((probs.sum(1, keepdim=True) - 1).abs() < MOST_OFF)
        if not bool((right | ~counted).all()):
            raise UserError("the forecaster's mode_probs must be at least 0 and sum to 1 over the modes of an agent")
    if scale is not None and not bool((((scale >= 0) & scale.isfinite()) | ~counted[..., None, None]).all()):
        raise UserError("the forecaster's xy_scale must be finite and at least 0")


def summarise(
    name: str,
    outcomes: Iterable[Outcome],
    std_m: Sequence[float] = (),
    miss_threshold_m: float = metrics.MISS_THRESHOLD_M,
) -> Accuracy:
    """Computes the accuracy of outcomes.

    Args:
        name: the forecaster's name.
        outcomes: at least one, of equal samples and horizon; an iterator is consumed batch by batch.
        std_m: spread per axis at each step [m] for the likelihood; empty leaves it out.
        miss_threshold_m: threshold of the miss rate [m].
    """
    tally = Tally(std_m, miss_threshold_m)
    for outcome in outcomes:
        tally.add(outcome)
    return tally.accuracy(name)


def fitted_std_m(outcomes: Iterable[Outcome]) -> tuple[float, ...]:
    """Computes the standard deviation per axis of the first sample's error at each step [m] (maximum likelihood).

    NaN at a step that no agent reaches.
    """
    totals, counts = [], []
    for outcome in outcomes:
        squared = (outcome.forecast[:, 0] - outcome.future).square().sum(-1)
        totals.append(torch.where(outcome.valid, squared, 0.0).sum((0, 1)).double().cpu())
        counts.append(outcome.future.shape[-1] * outcome.valid.sum((0, 1)).cpu())
    if not totals:
        raise ValueError("a spread needs at least one outcome, got none")
    variance = torch.stack(totals).sum(0) / torch.stack(counts).sum(0)
    return tuple(variance.sqrt().clamp(min=1e-3).tolist())


def ratio(total: float, count: float) -> float:
    """Returns total / count; NaN where nothing was counted."""
    return float(total / count) if count else math.nan


def _spread(
    sums: dict[str, np.ndarray], counts: dict[str, np.ndarray], num_subsets: int, seed: int, pooled: bool
) -> tuple[dict[str, Statistic], dict[str, list[float | None]]]:
    """Computes `Accuracy.statistics` and `Accuracy.step_errors` from sums and counts per window (and step)."""
    scalars: dict[str, Statistic | None] = {}
    step_errors: dict[str, list[float | None]] = {}
    for key in sums:
        root = key == "rmse_m"
        if sums[key].ndim == 1:
            scalars[key] = ratio_statistics(sums[key], counts[key], num_subsets, seed, pooled=pooled)
            continue
        if key in SCALAR_NAMES:
            total, count = sums[key].sum(1), counts[key].sum(1)
            scalars[SCALAR_NAMES[key]] = ratio_statistics(total, count, num_subsets, seed, root, pooled)
        found = [
            ratio_statistics(s, c, num_subsets, seed, root, pooled)
            for s, c in zip(sums[key].T, counts[key].T, strict=True)
        ]
        step_errors[key] = [None if f is None else f.standard_error for f in found]
    return {key: value for key, value in scalars.items() if value is not None}, step_errors
