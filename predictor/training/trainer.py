"""One training run of a forecaster: data, model, optimiser and progress.

Every random draw is a function of (seed, step), so a run that was killed and resumed ends with the same weights as one
that was not.
"""

import math
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from predictor.baselines.constant_velocity import ConstantVelocity
from predictor.data.windows import WindowBatch, Windows
from predictor.evaluation.accuracy import Accuracy, fitted_std_m, summarise
from predictor.evaluation.outcomes import run_windows, windows_per_forward
from predictor.noise import NoiseOfRows, TrainingNoise
from predictor.support.errors import UserError
from predictor.support.files import new_file
from predictor.support.runtime import float32_products, precision
from predictor.training.batches import Plan, open_batches, plan
from predictor.training.config import TrainConfig
from predictor.training.cuda_graph import (
    CapturedStep,
    CudaRecorder,
    NotCapturableError,
    Recorder,
    default_generator,
    signature,
)
from predictor.training.objective import window_loss
from predictor.training.processes import ALONE, Group, keep_rows_of_dropout
from predictor.training.saved_state import read_state
from predictor.training.shift_loss import TwinShifts
from predictor.training.start import initial_model
from predictor.training.training_data import TrainingData

VALIDATION_DRAWS = 5
"""Number of samples for model selection, of models without modes."""
LOG_EVERY = 25
"""Number of steps between two points of the training curves; on a CUDA device also between readings of results."""


class Trainer:
    """Runs the training: model, optimiser, data and progress.

    On a CUDA device a step is recorded and replayed (`predictor.training.cuda_graph`), the data is kept there if it
    fits, and nothing is read back between calls of `read`.
    """

    def __init__(self, config: TrainConfig, data: TrainingData, group: Group = ALONE) -> None:
        """Builds model, batches and optimiser from the config and the seed; a group's processes share each batch."""
        self.config = config
        self.data = data
        self.group = group
        self.device = torch.device(group.device(config.device))
        on_cuda = self.device.type == "cuda"
        if on_cuda and self.device.index is not None:
            torch.cuda.set_device(self.device)
        torch.manual_seed(config.seed)
        self.model: Any = initial_model(config, data.spec, data.train_episodes).to(self.device)
        self.step, self.validated, self.stale = 0, 0, 0
        self.best = math.inf
        self.baseline_m = self._baseline() if group.leads else math.nan
        self.noise = torch.Generator(device=self.device)
        self._drawn: TrainingNoise = self.noise
        rows = group.rows(config.batch_size)
        self._shifts = TwinShifts.of(config, data.train_episodes, data.spec, group.connected)
        if group.connected or self._shifts is not None:
            # a recorded step would hold the messages between processes, or the first pairs
            config = replace(config, capture="off")
        if group.connected:
            self._drawn = NoiseOfRows(self.noise, rows, config.batch_size)
            keep_rows_of_dropout(self.model, rows, config.batch_size)
        source = open_batches(config, data.train, self.device, self.model.config, rows)
        self.batches, self.notes, self._widths = source.batches, (*data.notes, *source.notes), source.widths
        self.read_every = LOG_EVERY if on_cuda else 1
        self._checks_each_loss = not on_cuda
        self._recorder: Recorder | None = CudaRecorder(self.device, self.noise) if source.capture else None
        self._recorded: dict[Any, CapturedStep] = {}
        self.optimizer = self._adam(capturable=source.capture)
        self._scales = torch.tensor(self.model.spec.feature_scales, device=self.device)
        self._kl_scale = torch.ones((), device=self.device)
        self._finite = torch.ones((), dtype=torch.bool, device=self.device)
        self._finite_until = 0

    @property
    def finished(self) -> bool:
        """Whether all steps are done, or `patience` validations brought no progress and the best weights are kept."""
        patient = self.config.keep == "last" or self.stale < self.config.patience
        return self.step >= self.config.steps or not patient

    @property
    def due(self) -> bool:
        """Whether validation follows the latest step."""
        return self.step % self.config.eval_every == 0 or self.step == self.config.steps

    @property
    def owes_validation(self) -> bool:
        """Whether the run was stopped between its latest step and the validation that follows it."""
        return self.step > 0 and self.due and self.validated < self.step

    def train_step(self) -> Mapping[str, Tensor]:
        """Computes one optimiser step; the batch and all noise depend on (seed, step) alone.

        Returns:
            Loss, gradient norm and the objective's terms, on the device; a later step may overwrite them.

        Raises:
            UserError: the loss or its gradient is not finite (on a CUDA device, `read` raises this).
        """
        now = self.plan(self.step)
        batch = self.batches.batch(now)
        torch.manual_seed(now.dropout_seed)
        self.noise.manual_seed(now.noise_seed)
        for group in self.optimizer.param_groups:
            if isinstance(group["lr"], Tensor):
                group["lr"].fill_(now.lr)
            else:
                group["lr"] = now.lr
        self._kl_scale.fill_(now.kl_scale)
        self.model.train()
        if self._recorder is not None:
            terms = self._replayed(self._recorder, batch, now.rollout_steps, now.num_modes)
        else:
            terms = self._optimise(batch, now.rollout_steps, now.num_modes, now.weight)
        self.step += 1
        return terms

    def plan(self, step: int) -> Plan:
        """Returns batch, seeds and schedules of a step."""
        return plan(self.config, [len(w) for w in self.data.train], step, self.num_modes, self._widths)

    @property
    def num_modes(self) -> int:
        """Number of modes of the model; 1 for a model without modes."""
        return getattr(self.model.config, "num_modes", 0) or 1

    def read(self, terms: Mapping[str, Tensor]) -> dict[str, float]:
        """Returns the terms of the latest step as numbers; waits for the device.

        Raises:
            UserError: the loss or its gradient was not finite in a step since the last reading.
        """
        first, self._finite_until = self._finite_until, self.step
        finite, *values = torch.stack([self._finite, *terms.values()]).tolist()
        if not finite:
            raise UserError(
                f"the loss or its gradient was not finite in some step from {first} to {self.step - 1}; lower --lr or "
                "check the data"
            )
        return dict(zip(terms, values, strict=True))

    def _optimise(
        self, batch: WindowBatch, rollout_steps: int, num_modes: int, weight: float = 1.0
    ) -> Mapping[str, Tensor]:
        """Computes forward, loss, backward, clipping and update; on a CUDA device the host reads no result."""
        kind = self.config.precision
        with float32_products("high") if kind == "tf32" else nullcontext():
            with precision("bfloat16" if kind == "bfloat16" else "float32", self.device.type):
                more = {"num_modes": num_modes} if num_modes > 1 else {}
                output = self.model.window(
                    batch.states, batch.valid, batch.last_observed, rollout_steps, self._drawn, **more
                )
            exact = output.float()
            sums = {"total": self.group.total} if self.group.connected else {}
            loss, terms = window_loss(self.model, batch, exact, self.config, self._kl_scale, self._scales, **sums)
            loss = weight * loss
            if self._shifts is not None and rollout_steps:
                shift = self._shifts.loss(self.model, self.step, rollout_steps, self._scales, **more)
                loss, terms = loss + self.config.shift_weight * shift, terms | {"shift": shift.detach()}
            self.optimizer.zero_grad(set_to_none=True)
            loss.backward()
        found = {"loss": loss.detach(), **terms}
        if self.group.connected:
            found = self.group.add_gradients(list(self.model.parameters()), found)
        if self._checks_each_loss and not torch.isfinite(found["loss"]):
            raise UserError(f"the loss is {float(found['loss'])} at step {self.step}; lower --lr or check the data")
        norm = torch.nn.utils.clip_grad_norm_(self.model.parameters(), self.config.clip_norm)
        if self._checks_each_loss and not torch.isfinite(norm):
            raise UserError(f"the gradient is {float(norm)} at step {self.step}; lower --lr or check the data")
        self.optimizer.step()
        self._finite.logical_and_(torch.isfinite(found["loss"]) & torch.isfinite(norm))
        return {"grad_norm": norm, **found}

    def _replayed(
        self, recorder: Recorder, batch: WindowBatch, rollout_steps: int, num_modes: int
    ) -> Mapping[str, Tensor]:
        """Replays a step; records it first if there is no recording for these shapes."""
        key = (rollout_steps, num_modes, signature(batch))
        if key not in self._recorded:
            if any(steps != rollout_steps for steps, *_ in self._recorded):  # the roll-out has grown, and never shrinks
                self._forget()
            try:
                self._recorded[key] = CapturedStep(
                    partial(self._optimise, rollout_steps=rollout_steps, num_modes=num_modes),
                    batch,
                    self._state,
                    (self.noise, default_generator(self.device)),
                    recorder,
                )
            except NotCapturableError as error:
                self._recorder = None
                self.notes = (*self.notes, f"steps are not captured: {error}")
                return self._optimise(batch, rollout_steps, num_modes)
        return self._recorded[key](batch)

    def _state(self) -> list[Tensor]:
        """Returns every tensor that a step changes."""
        moments = (v for values in self.optimizer.state.values() for v in values.values() if isinstance(v, Tensor))
        return [*self.model.parameters(), *self.model.buffers(), *moments, self._finite]

    def _forget(self) -> None:
        self._recorded.clear()
        if self._recorder is not None:
            self._recorder.forget()

    def _adam(self, capturable: bool) -> torch.optim.Adam:
        """Returns Adam; for capturing its rate is a tensor, and torch's warning about uncaptured steps is off."""
        rate: Any = torch.tensor(self.config.lr, device=self.device) if capturable else self.config.lr
        fused = True if self.device.type == "cuda" else None
        optimizer = torch.optim.Adam(self.model.parameters(), lr=rate, capturable=capturable, fused=fused)
        optimizer._warned_capturable_if_run_uncaptured = True
        return optimizer

    def score(self, accuracy: Accuracy) -> float:
        """Returns what selects the checkpoint, the lower the better: the energy score of the samples [m].

        They do not depend on the spread, so that this is selected by the mixture's negative log-likelihood [nats].
        """
        return float(np.mean(accuracy.mixture_nll)) if self.config.only_spread else accuracy.energy_m

    def validate(self) -> tuple[Accuracy, tuple[float, ...]]:
        """Returns accuracy on held-out episodes, and the single forecast's spread per step and axis [m], if known."""
        self.model.eval()
        self.validated = self.step
        samples = self.num_modes if self.num_modes > 1 else VALIDATION_DRAWS
        outcomes = [o for w, i in self._val_indices() for o in run_windows(
            self.model, w, i, self.config.horizon_steps, samples, batch_size=windows_per_forward(w, i, samples),
            device=str(self.device))]  # fmt: skip
        std_m = fitted_std_m(outcomes)
        return summarise(self.config.model, outcomes), std_m if np.isfinite(std_m).all() else ()

    def save(self, path: Path) -> None:
        """Writes the training state so that a kill leaves the old or the new one."""
        progress = {name: getattr(self, name) for name in ("step", "best", "stale", "validated")}
        state = {"model": self.model.state_dict(), "optimizer": self.optimizer.state_dict()} | progress
        with new_file(path) as partial:
            torch.save(state, partial)

    def restore(self, path: Path) -> None:
        """Continues from a saved training state, of this kind of device or another; process 0 reads it for all."""
        self._forget()  # recordings refer to tensors that are replaced here
        try:
            device = torch.device("cpu") if self.group.connected else self.device
            state = self.group.from_leader(lambda: read_state(path, self.model, device))
            self.model.load_state_dict(state["model"])
            # Adam's settings are this run's, its moments are the saved ones
            groups = zip(self.optimizer.state_dict()["param_groups"], state["optimizer"]["param_groups"], strict=True)
            state["optimizer"]["param_groups"] = [ours | {"params": theirs["params"]} for ours, theirs in groups]
            self.optimizer.load_state_dict(state["optimizer"])
            self.step, self.best, self.stale = state["step"], state["best"], state["stale"]
            self.validated = state["validated"]
            self._finite_until = self.step
        except UserError:
            raise
        except (RuntimeError, KeyError, TypeError, ValueError) as error:
            reason = " ".join(str(error).split())[:200]
            raise UserError(f"{path} cannot be read ({reason}); train anew into another --out") from error

    def share_progress(self) -> None:
        """Tells the processes that follow what the validation of process 0 brought."""
        self.best, self.stale = self.group.from_leader(lambda: (self.best, self.stale))
        self.validated = self.step

    def close(self) -> None:
        """Stops the preparation of batches."""
        self.batches.close()

    def _baseline(self) -> float:
        spec, steps = self.data.spec, self.config.horizon_steps
        outcomes = [o for w, i in self._val_indices() for o in run_windows(ConstantVelocity(spec, steps), w, i, steps)]
        return summarise("constant velocity", outcomes).min_ade_m

    def _val_indices(self) -> list[tuple[Windows, np.ndarray]]:
        share = max(1, self.config.val_windows // len(self.data.val))
        rng = np.random.default_rng([self.config.seed, 2])
        return [(w, rng.permutation(len(w))[:share]) for w in self.data.val]
