"""Train a dG-VAE: `python -m predictor.train --data data/roundabout --out runs/roundabout`.

Every random draw is a function of (seed, step), so a run that was killed and resumed ends with the same weights as one
that was not. The best checkpoint is chosen by free-running minADE on held-out episodes, not by one-step error.
"""

import json
import math
import os
import pickle
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import tyro
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from torch.utils.tensorboard import SummaryWriter

from predictor.accuracy import Accuracy, fitted_std_m, run_windows, summarise
from predictor.baselines.constant_velocity import ConstantVelocity
from predictor.checkpoint import CheckpointInfo, save_checkpoint
from predictor.data.store import Episode, EpisodeStore, read_store
from predictor.data.windows import WindowBatch, Windows, concatenate, split_episodes
from predictor.dgvae import DGVAE, PRESETS, DGVAEConfig, WindowOutput
from predictor.errors import UserError, run_entry_point
from predictor.graph import pair_mask
from predictor.losses import Likelihood, kl_categorical, masked_mean, nll
from predictor.metrics import edge_entropy
from predictor.provenance import provenance, write_json
from predictor.scene import SceneSpec


@dataclass(frozen=True)
class TrainConfig:
    """Train a dG-VAE on one or more episode stores."""

    data: tuple[Path, ...]
    """Episode stores (python -m envs.collect makes them); several are mixed by their number of windows."""
    out: Path
    """Run folder: checkpoint/, config.json, TensorBoard, training state."""
    preset: Literal["fast", "paper"] = "fast"
    """Network size."""
    steps: int = 4000
    """Optimiser steps."""
    batch_size: int = 64
    """Windows per step."""
    lr: float = 2e-3
    """Peak learning rate (Adam), after warm-up, then cosine to 2 %."""
    history_steps: int = 10
    """Longest history in a training window; at deployment the memory is unlimited."""
    horizon_steps: int = 5
    """Free-running steps in training, and the default horizon of the checkpoint."""
    one_step_weight: float = 0.2
    """Weight of the teacher-forced one-step likelihood beside the free-running one."""
    kl_weight: float = 1.0
    """Weight of KL(posterior ‖ prior)."""
    variance: float = 5e-5
    """Fixed variance of the likelihood, in scaled units (paper: σ)."""
    likelihood: Likelihood = "laplace"
    """"gaussian" is the paper's; "laplace" weighs large errors less and gives lower displacement errors."""
    clip_norm: float = 100.0
    """Largest gradient norm."""
    val_fraction: float = 0.1
    """Share of episodes held out for model selection."""
    val_windows: int = 1500
    """Held-out windows to measure on."""
    eval_every: int = 250
    """Steps between validations; the training state is saved then too."""
    patience: int = 8
    """Stop after so many validations without a better minADE."""
    seed: int = 0
    """Drives initial weights, split, order and noise."""
    device: str = "cpu"
    """"cpu" or "cuda"."""
    threads: int = 0
    """CPU threads for torch; 0 leaves torch's choice."""
    resume: bool = False
    """Continue a run that was stopped; finished runs stay as they are."""

    def check(self) -> None:
        """Check ranges.

        Raises:
            UserError: a value that makes no sense. (In `__post_init__`, tyro would turn it into a box of lines.)
        """
        for name in ("steps", "batch_size", "history_steps", "horizon_steps", "eval_every", "patience", "val_windows"):
            if getattr(self, name) < 1:
                raise UserError(f"{name} must be at least 1, got {getattr(self, name)}")
        if not 0 < self.val_fraction < 1:
            raise UserError(f"val_fraction must lie between 0 and 1, got {self.val_fraction}")
        if not self.data:
            raise UserError("data needs at least one episode store; make one with python -m envs.collect")
        for name in ("lr", "variance", "clip_norm"):
            if not 0 < getattr(self, name) < math.inf:
                raise UserError(f"{name} must be positive, got {getattr(self, name)}")
        for name in ("one_step_weight", "kl_weight", "seed", "threads"):
            if not 0 <= getattr(self, name) < math.inf:
                raise UserError(f"{name} must not be negative, got {getattr(self, name)}")
        if self.device != "cpu" and not self.device.startswith("cuda"):
            raise UserError(f"device must be 'cpu' or 'cuda', got '{self.device}'")
        if self.device.startswith("cuda") and not torch.cuda.is_available():
            raise UserError(f"device '{self.device}' asked for but torch sees no CUDA device; use --device cpu")


@dataclass(frozen=True)
class TrainingData:
    """Windows of all stores, split by episode."""

    spec: SceneSpec
    """Of the first store; the others are compatible."""
    sources: tuple[str, ...]
    """What each store was recorded from."""
    train: list[Windows]
    """One per store."""
    val: list[Windows]
    """One per store."""
    train_episodes: list[Episode]
    """All training episodes."""


def load_data(config: TrainConfig) -> TrainingData:
    """Read and split the stores.

    Raises:
        UserError: stores of different features or dt, or too few episodes.
    """
    stores: list[EpisodeStore] = [read_store(path) for path in config.data]
    spec = stores[0].info.spec
    train, val, episodes = [], [], []
    for path, store in zip(config.data, stores, strict=True):
        spec.check_compatible(store.info.spec, f"store {config.data[0]}", f"store {path}")
        kept, held_out = split_episodes(len(store.episodes), config.val_fraction, config.seed)
        if not kept or not held_out:
            raise UserError(
                f"{path}: {len(store.episodes)} episodes split into {len(kept)} for training and {len(held_out)} "
                "for validation; both need at least one, so collect more"
            )
        chosen = [store.episodes[i] for i in kept]
        train.append(Windows(chosen, spec, config.history_steps, config.horizon_steps))
        val.append(Windows([store.episodes[i] for i in held_out], spec, config.history_steps, config.horizon_steps))
        episodes += chosen
    return TrainingData(spec, tuple(s.info.source for s in stores), train, val, episodes)


def typical_change(episodes: Sequence[Episode], spec: SceneSpec, residual: str) -> tuple[float, ...]:
    """Root mean square of what the decoder has to predict in one step, per feature [SI]."""
    total, count = np.zeros(spec.num_features), 0
    for episode in episodes:
        both = episode.valid[1:] & episode.valid[:-1]
        change = episode.states[1:] - episode.states[:-1]
        if residual == "constant_velocity":
            change[..., :2] -= episode.states[:-1, :, 2:4] * spec.dt_s
        total += np.square(change[both].astype(np.float64)).sum(axis=0)
        count += int(both.sum())
    scale = np.sqrt(total / max(count, 1))
    return tuple(float(s) for s in np.maximum(scale, 1e-3))


def window_loss(
    model: DGVAE, batch: WindowBatch, output: WindowOutput, config: TrainConfig
) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
    """The objective and its terms for one batch of windows."""
    scales = torch.tensor(model.spec.feature_scales, device=batch.states.device)
    rows = torch.arange(len(batch.states), device=batch.states.device)
    both = batch.valid[:, 1:] & batch.valid[:, :-1]
    one_step = nll(output.one_step[:, :-1], batch.states[:, 1:], both, scales, config.variance, config.likelihood)
    steps = batch.last_observed[:, None] + torch.arange(1, model.horizon_steps + 1, device=rows.device)
    truth = batch.states[rows[:, None], steps].transpose(1, 2)
    valid = batch.valid[rows[:, None], steps].transpose(1, 2)
    rollout = nll(output.rollout, truth, valid, scales, config.variance, config.likelihood)
    pairs = pair_mask(batch.valid)
    kl = kl_categorical(output.posterior_logits, output.prior_logits, pairs)
    total = config.one_step_weight * one_step + rollout + config.kl_weight * kl
    probs = torch.softmax(output.prior_logits.detach(), dim=-1)
    terms = {
        "nll_rollout": rollout,
        "nll_one_step": one_step,
        "kl": kl,
        "prior_entropy": masked_mean(*edge_entropy(probs, pairs)),
        "prior_edge_share": masked_mean(1 - probs[..., 0], pairs),
    }
    return total, {k: v.detach() for k, v in terms.items()}


class Trainer:
    """One training run: model, optimiser, data, and where it stands."""

    def __init__(self, config: TrainConfig, data: TrainingData) -> None:
        """Build everything from the config and the seed."""
        self.config = config
        self.data = data
        self.device = torch.device(config.device)
        sizes: DGVAEConfig = PRESETS[config.preset]
        sizes = replace(sizes, delta_scales=typical_change(data.train_episodes, data.spec, sizes.residual))
        torch.manual_seed(config.seed)
        self.model = DGVAE(data.spec, sizes, config.horizon_steps).to(self.device)
        self.optimizer = torch.optim.Adam(self.model.parameters(), lr=config.lr)
        self.step = 0
        self.best = math.inf
        self.stale = 0
        self.baseline_m = self._baseline()

    @property
    def finished(self) -> bool:
        """All steps done, or no progress for `patience` validations."""
        return self.step >= self.config.steps or self.stale >= self.config.patience

    def train_step(self) -> dict[str, float]:
        """One optimiser step; the batch and all noise depend on (seed, step) alone."""
        config = self.config
        rng = np.random.default_rng([config.seed, 1, self.step])
        torch.manual_seed(int(rng.integers(2**62)))  # dropout
        generator = torch.Generator(device=self.device).manual_seed(int(rng.integers(2**62)))
        batch = self._draw(self.data.train, rng, config.batch_size).to(self.device)
        for group in self.optimizer.param_groups:
            group["lr"] = config.lr * _schedule(self.step, config.steps)
        self.model.train()
        output = self.model.window(batch.states, batch.valid, batch.last_observed, generator)
        loss, terms = window_loss(self.model, batch, output, config)
        if not torch.isfinite(loss):
            raise UserError(f"the loss is {float(loss.detach())} at step {self.step}; lower --lr or check the data")
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(self.model.parameters(), config.clip_norm)
        self.optimizer.step()
        self.step += 1
        return {"loss": float(loss.detach()), "grad_norm": float(norm), **{k: float(v) for k, v in terms.items()}}

    def validate(self) -> tuple[Accuracy, tuple[float, ...]]:
        """Free-running accuracy of the most likely forecast on held-out episodes, and its spread."""
        self.model.eval()
        outcomes = [o for w, i in self._val_indices() for o in run_windows(
            self.model, w, i, self.config.horizon_steps, device=self.config.device)]  # fmt: skip
        return summarise("dG-VAE", outcomes), fitted_std_m(outcomes)

    def save(self, path: Path) -> None:
        """Write the training state so that a kill leaves the old or the new one."""
        partial = path.with_name(f".{path.name}.partial")
        torch.save(
            {
                "model": self.model.state_dict(),
                "optimizer": self.optimizer.state_dict(),
                "step": self.step,
                "best": self.best,
                "stale": self.stale,
            },
            partial,
        )
        os.replace(partial, path)

    def restore(self, path: Path) -> None:
        """Continue from a saved training state."""
        try:
            state = torch.load(path, weights_only=True, map_location=self.device)
            self.model.load_state_dict(state["model"])
            self.optimizer.load_state_dict(state["optimizer"])
            self.step, self.best, self.stale = int(state["step"]), float(state["best"]), int(state["stale"])
        except (RuntimeError, KeyError, TypeError, EOFError, pickle.UnpicklingError) as error:
            reason = " ".join(str(error).split())[:200]
            raise UserError(f"{path} cannot be read ({reason}); train anew into another --out") from error

    def _baseline(self) -> float:
        spec, steps = self.data.spec, self.config.horizon_steps
        outcomes = [o for w, i in self._val_indices() for o in run_windows(ConstantVelocity(spec, steps), w, i, steps)]
        return summarise("constant velocity", outcomes).min_ade_m

    def _val_indices(self) -> list[tuple[Windows, np.ndarray]]:
        share = max(1, self.config.val_windows // len(self.data.val))
        rng = np.random.default_rng([self.config.seed, 2])
        return [(w, rng.permutation(len(w))[:share]) for w in self.data.val]

    def _draw(self, windows: Sequence[Windows], rng: np.random.Generator, size: int) -> WindowBatch:
        sizes = np.array([len(w) for w in windows])
        counts = rng.multinomial(size, sizes / sizes.sum())
        return concatenate([w.batch(rng.integers(len(w), size=c)) for w, c in zip(windows, counts, strict=True) if c])


def _schedule(step: int, steps: int, warmup: int = 100) -> float:
    if step < warmup:
        return (step + 1) / warmup
    progress = (step - warmup) / max(1, steps - warmup)
    return 0.02 + 0.98 * 0.5 * (1 + math.cos(math.pi * min(1.0, progress)))


def train(config: TrainConfig) -> Path:
    """Train until done or stale; returns the folder of the best checkpoint."""
    state_file, config_file = config.out / "train_state.pt", config.out / "config.json"
    _check_run_folder(config, config_file)
    if config.threads:
        torch.set_num_threads(config.threads)
    data = load_data(config)
    trainer = Trainer(config, data)
    config.out.mkdir(parents=True, exist_ok=True)
    if config.resume and state_file.exists():
        trainer.restore(state_file)
    made = provenance(("torch", "numpy", "zarr", "safetensors"))
    write_json(config_file, {"config": _comparable(config), "provenance": made})
    columns = (
        TextColumn("train"),
        BarColumn(20),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}"),
    )
    note = ""
    with SummaryWriter(str(config.out / "tb"), purge_step=trainer.step) as writer, Progress(*columns) as progress:
        task = progress.add_task("", total=config.steps, completed=trainer.step, note="")
        while not trainer.finished:
            began = time.perf_counter()
            terms = trainer.train_step()
            terms["steps_per_s"] = 1 / (time.perf_counter() - began)
            if trainer.step % config.eval_every == 0 or trainer.step == config.steps:
                note = _validate_and_save(trainer, writer, made)
                trainer.save(state_file)
            if trainer.step % 25 == 0:
                for name, value in terms.items():
                    writer.add_scalar(f"train/{name}", value, trainer.step)
            shown = " ".join(f"{k} {terms[k]:.3g}" for k in ("nll_rollout", "nll_one_step", "kl"))
            progress.update(task, completed=trainer.step, note=f"{shown} {note}")
    if not (config.out / "checkpoint").exists():
        raise UserError(
            f"no validation episode has {config.horizon_steps} steps of future, so no checkpoint was chosen; "
            "lower --horizon-steps or collect longer episodes"
        )
    return config.out / "checkpoint"


def _validate_and_save(trainer: Trainer, writer: SummaryWriter, made: dict[str, Any]) -> str:
    accuracy, std_m = trainer.validate()
    writer.add_scalar("val/min_ade_m", accuracy.min_ade_m, trainer.step)
    writer.add_scalar("val/min_fde_m", accuracy.min_fde_m, trainer.step)
    writer.add_scalar("val/constant_velocity_ade_m", trainer.baseline_m, trainer.step)
    if accuracy.min_ade_m < trainer.best:
        trainer.best, trainer.stale = accuracy.min_ade_m, 0
        result = {
            "step": trainer.step,
            "val_min_ade_m": accuracy.min_ade_m,
            "val_min_fde_m": accuracy.min_fde_m,
            "val_constant_velocity_ade_m": trainer.baseline_m,
        }
        info = CheckpointInfo(
            spec=trainer.data.spec,
            config=trainer.model.config,
            horizon_steps=trainer.config.horizon_steps,
            std_m=std_m,
            sources=trainer.data.sources,
            provenance=made | {"train_config": _comparable(trainer.config), "result": result},
        )
        save_checkpoint(trainer.config.out / "checkpoint", trainer.model, info)
    else:
        trainer.stale += 1
    return (
        f"| val minADE {accuracy.min_ade_m:.3f} m (best {trainer.best:.3f}, constant velocity {trainer.baseline_m:.3f})"
    )


def _comparable(config: TrainConfig) -> dict[str, Any]:
    values = asdict(config)
    for name in ("resume", "threads", "device"):
        del values[name]
    values["data"] = [str(p) for p in config.data]
    values["out"] = str(config.out)
    return values


def _check_run_folder(config: TrainConfig, config_file: Path) -> None:
    if not config_file.exists():
        if config.out.exists() and any(not p.name.startswith(".") for p in config.out.iterdir()):
            raise UserError(f"{config.out} is not empty and not a training run; choose another --out")
        return
    if not config.resume:
        raise UserError(f"{config.out} holds a run already; pass --resume to continue it or choose another --out")
    try:
        before, now = json.loads(config_file.read_text())["config"], _comparable(config)
    except (ValueError, KeyError, TypeError) as error:
        raise UserError(f"{config_file} cannot be read ({error}); train anew into another --out") from error
    for name, value in now.items():
        if name != "steps" and before.get(name) != value:
            raise UserError(f"cannot resume: {name} was {before.get(name)} and is now {value}; use the same arguments")


def main() -> None:
    """Entry point."""
    config = tyro.cli(TrainConfig, description=__doc__)
    config.check()
    checkpoint = train(config)
    print(f"best checkpoint: {checkpoint}")


if __name__ == "__main__":
    run_entry_point(main)
