"""One training run of a forecaster: data, model, optimiser, and where it stands.

Every random draw is a function of (seed, step), so a run that was killed and resumed ends with the same weights as one
that was not.
"""

import math
import os
import pickle
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from predictor.accuracy import Accuracy, fitted_std_m, run_windows, summarise
from predictor.baselines.constant_velocity import ConstantVelocity
from predictor.codec import Residual, StateCodec, drift
from predictor.data.store import Episode, EpisodeStore, read_store
from predictor.data.windows import WindowBatch, Windows, concatenate, split_episodes
from predictor.errors import UserError
from predictor.models import build, configure
from predictor.objective import window_loss
from predictor.scene import SceneSpec
from predictor.train_config import TrainConfig


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
    stores: list[EpisodeStore] = [read_store(path) for path in (*config.data, *config.val_data)]
    spec = stores[0].info.spec
    for path, store in zip((*config.data, *config.val_data), stores, strict=True):
        spec.check_compatible(store.info.spec, f"store {config.data[0]}", f"store {path}")
    _check_labels(config, stores)
    sources = tuple(s.info.source for s in stores[: len(config.data)])
    if config.val_data:
        cut = len(config.data)
        chosen = [s.episodes[: config.max_episodes or None] if i < cut else s.episodes for i, s in enumerate(stores)]
        train = [_windows(config, e, spec, validation=False) for e in chosen[:cut]]
        val = [_windows(config, e, spec, validation=True) for e in chosen[cut:]]
        return TrainingData(spec, sources, train, val, [e for part in chosen[:cut] for e in part])
    train, val, episodes = [], [], []
    for path, store in zip(config.data, stores, strict=True):
        kept, held_out = split_episodes(len(store.episodes), config.val_fraction, config.seed)
        kept = kept[: config.max_episodes or None]
        if not kept or not held_out:
            raise UserError(
                f"{path}: {len(store.episodes)} episodes split into {len(kept)} for training and {len(held_out)} "
                "for validation; both need at least one, so collect more"
            )
        mine = [store.episodes[i] for i in kept]
        train.append(_windows(config, mine, spec, validation=False))
        val.append(_windows(config, [store.episodes[i] for i in held_out], spec, validation=True))
        episodes += mine
    return TrainingData(spec, sources, train, val, episodes)


def _check_labels(config: TrainConfig, stores: Sequence[EpisodeStore]) -> None:
    """Weights of labels need labels in every training store; without this they would silently do nothing."""
    for option, name in (("label_weight", "edge_attributes"), ("type_label_weight", "edge_types")):
        for path, store in zip(config.data, stores, strict=False):
            if getattr(config, option) and any(getattr(e, name) is None for e in store.episodes[:1]):
                raise UserError(f"{option} needs {name}, and store {path} has none; set it to 0 or use labelled data")


def _windows(config: TrainConfig, episodes: Sequence[Episode], spec: SceneSpec, validation: bool) -> Windows:
    if not validation or config.val_history_steps == 1:
        return Windows(episodes, spec, config.history_steps, config.horizon_steps)
    # as in the tables: whole burn-in, whole horizon
    return Windows(
        episodes,
        spec,
        config.history_steps,
        config.horizon_steps,
        min_future_steps=config.horizon_steps,
        min_history_steps=config.val_history_steps,
    )


def typical_change(episodes: Sequence[Episode], spec: SceneSpec, residual: Residual) -> tuple[float, ...]:
    """Root mean square of what the decoder has to predict in one step, per feature [SI]."""
    total, count = np.zeros(spec.num_features), 0
    for episode in episodes:
        both = episode.valid[1:] & episode.valid[:-1]
        before, after = (torch.from_numpy(s) for s in (episode.states[:-1], episode.states[1:]))
        change = (after - before).numpy()
        change[..., : spec.position_dim] -= drift(spec, residual, before, after).numpy()
        total += np.square(change[both].astype(np.float64)).sum(axis=0)
        count += int(both.sum())
    scale = np.sqrt(total / max(count, 1))
    return tuple(float(s) for s in np.maximum(scale, 1e-3))


def typical_spread(episodes: Sequence[Episode], spec: SceneSpec) -> tuple[float, ...]:
    """Standard deviation of each input feature over the data [SI], positions as the spec's frame gives them."""
    states = [_in_frame(episode, spec)[episode.valid] for episode in episodes]
    spread = np.concatenate(states).astype(np.float64).std(axis=0)
    least = 1e-2 * np.array(spec.feature_scales)
    return tuple(float(s) for s in np.maximum(spread, least))


def _in_frame(episode: Episode, spec: SceneSpec) -> np.ndarray:
    codec = StateCodec(spec)
    inputs = codec.inputs(torch.from_numpy(episode.states), torch.from_numpy(episode.valid))[..., : spec.num_features]
    framed: np.ndarray = (inputs * codec.scales).numpy()
    return framed


def model_config(config: TrainConfig, data: TrainingData) -> Any:
    """The network's config, with scales fitted to the training data.

    Raises:
        UserError: a field of --set that the model does not have, or --input-changes or --fit-inputs for another model.
    """
    plain = configure(config.model, config.preset, config.set)
    fitted = {"delta_scales": typical_change(data.train_episodes, data.spec, plain.residual)}
    if config.input_changes:
        if config.model != "dgvae":
            raise UserError(f"--input-changes belongs to the dG-VAE; leave it out for --model {config.model}")
        fitted["change_scales"] = typical_change(data.train_episodes, data.spec, "state")
    if config.fit_inputs:
        if config.model != "dgvae":
            raise UserError(f"--fit-inputs belongs to the dG-VAE; leave it out for --model {config.model}")
        fitted["input_scales"] = typical_spread(data.train_episodes, data.spec)
    return configure(config.model, config.preset, config.set, **fitted)


class Trainer:
    """One training run: model, optimiser, data, and where it stands."""

    def __init__(self, config: TrainConfig, data: TrainingData) -> None:
        """Build everything from the config and the seed."""
        self.config = config
        self.data = data
        self.device = torch.device(config.device)
        torch.manual_seed(config.seed)
        self.model: Any = build(config.model, data.spec, model_config(config, data), config.horizon_steps)
        self.model.to(self.device)
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
        history = config.history_steps
        if config.min_history_steps:
            history = int(rng.integers(config.min_history_steps, config.history_steps + 1))
        batch = self._draw(self.data.train, rng, config.batch_size, history).to(self.device)
        for group in self.optimizer.param_groups:
            group["lr"] = config.lr * _schedule(self.step, config.steps)
        self.model.train()
        output = self.model.window(batch.states, batch.valid, batch.last_observed, self._rollout_steps(), generator)
        warm = min(1.0, (self.step + 1) / config.kl_warmup_steps) if config.kl_warmup_steps else 1.0
        loss, terms = window_loss(self.model, batch, output, config, warm)
        if not torch.isfinite(loss):
            raise UserError(f"the loss is {float(loss.detach())} at step {self.step}; lower --lr or check the data")
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(self.model.parameters(), config.clip_norm)
        self.optimizer.step()
        self.step += 1
        return {"loss": float(loss.detach()), "grad_norm": float(norm), **{k: float(v) for k, v in terms.items()}}

    def _rollout_steps(self) -> int:
        config = self.config
        if not config.rollout_weight:
            return 0
        if self.step >= config.curriculum_steps:
            return config.horizon_steps
        return 1 + (config.horizon_steps - 1) * self.step // config.curriculum_steps

    def validate(self) -> tuple[Accuracy, tuple[float, ...]]:
        """Free-running accuracy of the most likely forecast on held-out episodes, and its spread."""
        self.model.eval()
        outcomes = [o for w, i in self._val_indices() for o in run_windows(
            self.model, w, i, self.config.horizon_steps, device=self.config.device)]  # fmt: skip
        return summarise(self.config.model, outcomes), fitted_std_m(outcomes)

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

    def _draw(self, windows: Sequence[Windows], rng: np.random.Generator, size: int, history: int) -> WindowBatch:
        sizes = np.array([len(w) for w in windows])
        counts = rng.multinomial(size, sizes / sizes.sum())
        drawn = zip(windows, counts, strict=True)
        return concatenate([w.batch(rng.integers(len(w), size=c), history) for w, c in drawn if c])


def _schedule(step: int, steps: int, warmup: int = 100) -> float:
    if step < warmup:
        return (step + 1) / warmup
    progress = (step - warmup) / max(1, steps - warmup)
    return 0.02 + 0.98 * 0.5 * (1 + math.cos(math.pi * min(1.0, progress)))
