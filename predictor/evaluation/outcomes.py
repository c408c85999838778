"""Runs a forecaster over windows and returns its forecasts with the truth and its mask.

The error of a sequence has two views (docs/protocol.md): *horizon-only* compares the free run after the last observed
step (`run_window_batch`); *whole-sequence* also compares the one-step predictions that are made from true states while
observing (`run_sequence_batch`).
"""

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from predictor.data.device_windows import window_sizes
from predictor.data.windows import WindowBatch, Windows
from predictor.forecaster import Belief, Forecaster
from predictor.noise import Noise

CARRIED = "is_ball"
"""Feature of an agent that others carry."""
LANDMARK = "landmark"
"""Feature of an agent that never moves."""
MOST_PAIRS = 1_000_000
"""Largest number of pairs of agents, over windows and samples, in one forward."""


@dataclass(frozen=True)
class Outcome:
    """Forecasts and truth of a batch of windows; inferred and true graph if requested."""

    forecast: Float[Tensor, "batch samples agents horizon axes"]
    """Predicted positions [m]."""
    future: Float[Tensor, "batch agents horizon axes"]
    """True positions [m], in the frame of `forecast`."""
    valid: Bool[Tensor, "batch agents horizon"]
    """Whether the truth exists and counts."""
    edge_probs: Float[Tensor, "batch agents agents types"] | None = None
    """Prior probabilities of the edge types at the last observed step, receiver first; agents as in the windows."""
    edge_features: Float[Tensor, "batch agents agents feature"] | None = None
    """Edge features at the last observed step."""
    present: Bool[Tensor, "batch agents"] | None = None
    """Whether the agent (or ego) is present at the last observed step; `pair_mask` of it gives the valid pairs."""
    edge_types: Int[Tensor, "batch agents agents"] | None = None
    """True type of each edge at the last observed step, -1 where unknown."""
    edge_attributes: Float[Tensor, "batch agents agents attributes"] | None = None
    """Known properties of each edge at that step, zeros where unknown or absent."""
    mode_probs: Float[Tensor, "batch samples agents"] | None = None
    """Probability of each sample; None if the samples are draws."""
    scale: Float[Tensor, "batch samples agents horizon axes"] | None = None
    """Standard deviation around each sample [m]; None if the forecaster has no such estimate."""
    carried: Bool[Tensor, "batch agents"] | None = None
    """Which agents others carry (`CARRIED`): who holds them does not overlap with them. None where nothing can be."""
    landmarks: Bool[Tensor, "batch agents"] | None = None
    """Which agents never move (`LANDMARK`). None where there can be none."""
    episode: Int[np.ndarray, " batch"] | None = None
    """Number of each window's episode; None where it is not known."""

    def single(self) -> "Outcome":
        """Returns the single forecast alone: sample 0."""
        return replace(
            self,
            forecast=self.forecast[:, :1],
            mode_probs=None,
            scale=None if self.scale is None else self.scale[:, :1],
        )

    def without_landmarks(self) -> "Outcome":
        """Returns the same with landmarks not counted."""
        return self if self.landmarks is None else replace(self, valid=self.valid & ~self.landmarks[..., None])

    def last_windows(self, count: int) -> "Outcome":
        """Returns the last windows of the batch; all, if there are fewer."""
        kept: dict[str, Any] = {}
        for field in fields(self):
            value = getattr(self, field.name)
            kept[field.name] = None if value is None else value[max(0, len(value) - count) :]
        return Outcome(**kept)

    def tail(self, steps: int) -> "Outcome":
        """Returns the last steps only: the horizon-only view of a whole sequence.

        Raises:
            ValueError: there are fewer steps.
        """
        if not 1 <= steps <= self.valid.shape[-1]:
            raise ValueError(f"steps must be between 1 and {self.valid.shape[-1]}, got {steps}")
        return replace(
            self,
            forecast=self.forecast[..., -steps:, :],
            future=self.future[..., -steps:, :],
            valid=self.valid[..., -steps:],
            scale=None if self.scale is None else self.scale[..., -steps:, :],
        )


@torch.inference_mode()
def run_window_batch(
    forecaster: Forecaster,
    batch: WindowBatch,
    horizon_steps: int,
    num_samples: int = 1,
    generator: Noise | None = None,
    keep_beliefs: bool = False,
) -> Outcome:
    """Streams the history of each window, forecasts, and returns forecast and truth; the ego is left out.

    Args:
        forecaster: model that gets the steps up to `last_observed`.
        batch: windows with at least `horizon_steps` steps (padding included) after `last_observed`.
        horizon_steps: number of steps of the free run.
        num_samples: number of samples K.
        generator: source of the noise of samples.
        keep_beliefs: whether to return the graph at the last observed step, and the true one if the data has it.
    """
    belief: Belief | None = None
    for _, latest in _observed(forecaster, batch):
        belief = latest
    assert belief is not None
    return _free_run(forecaster, batch, belief, horizon_steps, num_samples, generator, keep_beliefs)


@torch.inference_mode()
def run_sequence_batch(
    forecaster: Forecaster,
    batch: WindowBatch,
    horizon_steps: int,
    num_samples: int = 1,
    generator: Noise | None = None,
    keep_beliefs: bool = False,
) -> Outcome:
    """Predicts every step but the first: one step ahead from true states while observing, then the free run.

    The horizon axis has `last_observed` one-step predictions (made from steps 0 … last_observed − 1, of steps 1 …
    last_observed), then `horizon_steps` free ones; with a burn-in of n steps that is n − 1 + `horizon_steps`. The
    one-step part is the forecaster's most likely prediction (sample 0), shared by all samples. Windows with a shorter
    history have no truth at the beginning; an agent counts at a step if it is seen there and one step before. The
    last `horizon_steps` entries equal those of `run_window_batch`, which has equal arguments.
    """
    axes = forecaster.spec.position_dim
    window = torch.arange(len(batch.states), device=batch.states.device)
    predicted, truth, valid, scales = [], [], [], []
    belief: Belief | None = None
    for step, belief in _observed(forecaster, batch):
        one = forecaster.rollout(belief, 1, 1)
        predicted.append(one.states[:, 0, :, 0, :axes])
        if one.scale is not None:
            scales.append(one.scale[:, 0, :, 0])
        ahead = (step + 1).clamp(min=0)
        truth.append(batch.states[window, ahead][..., :axes])
        valid.append(_without_ego(forecaster, batch.valid[window, ahead] & belief.valid))
    assert belief is not None
    free = _free_run(forecaster, batch, belief, horizon_steps, num_samples, generator, keep_beliefs)
    if len(predicted) == 1:
        return free
    # The last entry is the free run's own first step.
    one_step = torch.stack(predicted[:-1], dim=2)[:, None].expand(-1, num_samples, -1, -1, -1)
    scale = free.scale
    if scale is not None:
        spread = torch.stack(scales[:-1], dim=2)[:, None].expand(-1, num_samples, -1, -1, -1)
        scale = torch.cat([spread, scale], dim=3)
    return replace(
        free,
        forecast=torch.cat([one_step, free.forecast], dim=3),
        future=torch.cat([torch.stack(truth[:-1], dim=2), free.future], dim=2),
        valid=torch.cat([torch.stack(valid[:-1], dim=2), free.valid], dim=2),
        scale=scale,
    )


def run_windows(
    forecaster: Forecaster,
    windows: Windows,
    indices: Int[np.ndarray, " some"],
    horizon_steps: int,
    num_samples: int = 1,
    seed: int = 0,
    batch_size: int = 256,
    device: str = "cpu",
    whole_sequence: bool = False,
    keep_beliefs: bool = False,
) -> Iterator[Outcome]:
    """Yields outcomes of the given windows in batches; `whole_sequence` runs `run_sequence_batch`.

    Nothing is kept between batches; `predictor.evaluation.accuracy.summarise` consumes the iterator. A forecaster with
    an ego gets an absent one before the agents of windows that have none, as in live scenes (`Scene.behind_absent`).
    """
    run = run_sequence_batch if whole_sequence else run_window_batch
    for begin in range(0, len(indices), batch_size):
        chosen = indices[begin : begin + batch_size]
        batch = windows.batch(chosen).to(torch.device(device))
        if forecaster.spec.has_ego and not windows.spec.has_ego:
            batch = batch.behind_absent()
        outcome = run(forecaster, batch, horizon_steps, num_samples, noise_of_windows(chosen, seed), keep_beliefs)
        yield replace(outcome, episode=windows.index[chosen, 0])


def windows_per_forward(windows: Windows, indices: Int[np.ndarray, " some"], samples: int) -> int:
    """Returns the number of windows in one forward, by the largest of them, so that memory is bounded."""
    agents = int(window_sizes(windows, indices).max())
    return max(1, min(256, MOST_PAIRS // max(1, agents**2 * samples)))


def noise_of_windows(indices: Int[np.ndarray, " some"], seed: int) -> list[np.random.Generator]:
    """Returns a generator for each window, so that its samples do not depend on what else is in its batch."""
    return [np.random.default_rng([seed, int(index)]) for index in indices]


def _observed(forecaster: Forecaster, batch: WindowBatch) -> Iterator[tuple[Int[Tensor, " batch"], Belief]]:
    """Yields the step of each window and the belief after it; all histories end together.

    Windows with a shorter history get an empty scene until it begins (step below 0). The memory of an agent that is
    absent is dropped, as in live scenes (`predictor.online`).
    """
    window = torch.arange(len(batch.states), device=batch.states.device)
    memory = forecaster.empty_memory(batch.states.shape[0], batch.states.shape[2])
    places = torch.arange(batch.states.shape[2], device=batch.states.device).expand(len(window), -1)
    for back in range(int(batch.last_observed.max()), -1, -1):
        step = batch.last_observed - back
        now = step.clamp(min=0)
        valid = batch.valid[window, now] & (step >= 0)[:, None]
        memory, belief = forecaster.observe(memory, batch.states[window, now] * valid[..., None], valid)
        yield step, belief
        memory = memory.reorder(places, valid)


def _free_run(
    forecaster: Forecaster,
    batch: WindowBatch,
    belief: Belief,
    horizon_steps: int,
    num_samples: int,
    generator: Noise | None,
    keep_beliefs: bool,
) -> Outcome:
    axes = forecaster.spec.position_dim
    window = torch.arange(len(batch.states), device=batch.states.device)
    futures = forecaster.rollout(belief, horizon_steps, num_samples, generator)
    steps = batch.last_observed[:, None] + torch.arange(1, horizon_steps + 1, device=window.device)
    truth = batch.states[window[:, None], steps].transpose(1, 2)[..., :axes]
    valid = batch.valid[window[:, None], steps].transpose(1, 2) & belief.valid[..., None]
    now = (window, batch.last_observed)

    def marked(feature: str) -> Tensor | None:
        names = forecaster.spec.feature_names
        return batch.states[now][..., names.index(feature)] > 0.5 if feature in names else None

    outcome = Outcome(
        futures.states[..., :axes],
        truth,
        _without_ego(forecaster, valid),
        mode_probs=futures.mode_probs,
        scale=futures.scale,
        carried=marked(CARRIED),
        landmarks=marked(LANDMARK),
    )
    if not keep_beliefs:
        return outcome
    belief = belief.dense()
    return replace(
        outcome,
        edge_probs=belief.edge_probs,
        edge_features=belief.edge_features,
        present=belief.valid,
        edge_types=None if batch.edge_types is None else batch.edge_types[now],
        edge_attributes=None if batch.edge_attributes is None else batch.edge_attributes[now],
    )


def _without_ego(
    forecaster: Forecaster, valid: Bool[Tensor, "batch agents *steps"]
) -> Bool[Tensor, "batch agents *steps"]:
    """Returns the mask without agent 0 if that is the ego, which is not forecast."""
    if forecaster.spec.has_ego:
        valid = valid.clone()
        valid[:, 0] = False
    return valid
