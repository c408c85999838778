"""What can be set in a training run of the predictor."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import torch

from predictor.errors import UserError
from predictor.models import ModelName

Likelihood = Literal["gaussian", "laplace"]
TrainPrecision = Literal["float32", "tf32", "bfloat16"]
DataDevice = Literal["auto", "cpu", "device"]
Capture = Literal["auto", "off"]


@dataclass(frozen=True)
class TrainConfig:
    """Train a forecaster on one or more episode stores."""

    data: tuple[Path, ...]
    """Episode stores (python -m envs.collect makes them); several are mixed by their number of windows."""
    out: Path
    """Run folder: checkpoint/, config.json, TensorBoard, training state."""
    val_data: tuple[Path, ...] = ()
    """Stores for model selection; left out, episodes of `data` are held out."""
    model: ModelName = "dgvae"
    """Which network."""
    preset: Literal["fast", "paper"] = "fast"
    """Network size."""
    set: tuple[str, ...] = ()
    """Single fields of the network's config, as field=value: --set hidden_dim=64 static_dim=16."""
    input_changes: bool = False
    """The dG-VAE's encoder also sees what changed since the last step (`change_scales`, fitted to the data)."""
    fit_inputs: bool = False
    """The dG-VAE's inputs are divided by their spread in the data (`input_scales`) instead of the spec's scales."""
    steps: int = 4000
    """Optimiser steps."""
    batch_size: int = 64
    """Windows per step."""
    lr: float = 2e-3
    """Peak learning rate (Adam), after warm-up, then cosine to 2 %."""
    history_steps: int = 10
    """Longest history in a training window; at deployment the memory is unlimited."""
    min_history_steps: int = 0
    """Each batch draws its longest history between this and `history_steps`; 0 always takes `history_steps`."""
    val_history_steps: int = 1
    """Least history of a window for model selection; with `history_steps`, whole sequences are cut as in the tables."""
    horizon_steps: int = 5
    """Free-running steps in training, and the default horizon of the checkpoint."""
    curriculum_steps: int = 0
    """The free run grows from 1 step to `horizon_steps` over so many optimiser steps; 0 is all at once."""
    one_step_weight: float = 0.2
    """Weight of the teacher-forced one-step likelihood."""
    rollout_weight: float = 1.0
    """Weight of the free-running likelihood; 0 trains teacher-forced only, as the NRI family does."""
    kl_weight: float = 1.0
    """Weight of KL(posterior ‖ prior)."""
    kl_warmup_steps: int = 0
    """The KL weight grows linearly from 0 over so many optimiser steps."""
    edge_cost: float = 0.0
    """Price [nats] of a certain edge, so that edges which explain nothing are dropped; 0 is the paper's."""
    label_weight: float = 0.0
    """Restricted labelling: weight of the regression of the first feature dimensions on known edge attributes."""
    type_label_weight: float = 0.0
    """Restricted labelling of edge types: weight of the prior's and posterior's cross-entropy with known types."""
    variance: float = 5e-5
    """Fixed variance of the likelihood, in scaled units (paper: σ)."""
    likelihood: Likelihood = "laplace"
    """"gaussian" is the paper's; "laplace" weighs large errors less and gives lower displacement errors."""
    clip_norm: float = 100.0
    """Largest gradient norm."""
    max_episodes: int = 0
    """Use only so many episodes of each training store, the first ones; 0 is all."""
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
    precision: TrainPrecision = "float32"
    """Of matrix products in training: "tf32" (CUDA) rounds their inputs to 10 bits, which tensor cores multiply;
    "bfloat16" rounds inputs and results to 7 (autocast). Weights, memories and losses stay float32."""
    data_device: DataDevice = "auto"
    """Where windows are cut: by the CPU, or on the training device, which then holds all the data. "auto" takes the
    device if that is CUDA and the data fits into half of its free memory."""
    capture: Capture = "auto"
    """"auto" records training steps as CUDA graphs where that is possible; "off" launches kernels one by one."""
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
        if self.one_step_weight == self.rollout_weight == 0:
            raise UserError("one_step_weight and rollout_weight are both 0; nothing would be learned")
        if self.min_history_steps > self.history_steps:
            raise UserError(f"min_history_steps must be at most {self.history_steps}, got {self.min_history_steps}")
        if not 1 <= self.val_history_steps <= self.history_steps:
            raise UserError(
                f"val_history_steps must lie between 1 and {self.history_steps}, got {self.val_history_steps}"
            )
        if not 0 < self.val_fraction < 1:
            raise UserError(f"val_fraction must lie between 0 and 1, got {self.val_fraction}")
        if not self.data:
            raise UserError("data needs at least one episode store; make one with python -m envs.collect")
        for name in ("lr", "variance", "clip_norm"):
            if not 0 < getattr(self, name) < math.inf:
                raise UserError(f"{name} must be positive, got {getattr(self, name)}")
        for name in (
            "one_step_weight", "rollout_weight", "kl_weight", "seed", "threads", "curriculum_steps", "kl_warmup_steps",
            "edge_cost", "label_weight", "type_label_weight", "min_history_steps", "max_episodes",
        ):  # fmt: skip
            if not 0 <= getattr(self, name) < math.inf:
                raise UserError(f"{name} must not be negative, got {getattr(self, name)}")
        self._check_machine()

    def _check_machine(self) -> None:
        if self.device != "cpu" and not self.device.startswith("cuda"):
            raise UserError(f"device must be 'cpu' or 'cuda', got '{self.device}'")
        for name, kind in (("precision", TrainPrecision), ("data_device", DataDevice), ("capture", Capture)):
            if getattr(self, name) not in get_args(kind):
                raise UserError(f"{name} must be one of {', '.join(get_args(kind))}, got '{getattr(self, name)}'")
        if not self.device.startswith("cuda"):
            if self.precision == "tf32":
                raise UserError("precision 'tf32' needs a CUDA device; use --precision float32 or --device cuda")
            return
        if not torch.cuda.is_available():
            raise UserError(f"device '{self.device}' asked for but torch sees no CUDA device; use --device cpu")
        if self.precision == "bfloat16" and not torch.cuda.is_bf16_supported(including_emulation=False):
            raise UserError(f"device '{self.device}' has no bfloat16 arithmetic; use --precision float32")
