"""Options of a training run of the predictor."""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

import torch

from predictor.checkpoint import read_info, resolve
from predictor.models import ModelName
from predictor.support.config_checks import (
    MOST_THREADS,
    check_at_least,
    check_at_most,
    check_choices,
    check_positive,
    check_types,
)
from predictor.support.errors import UserError
from predictor.support.memory import check_memory
from predictor.support.runtime import resolve_device

Likelihood = Literal["gaussian", "laplace"]
TrainPrecision = Literal["float32", "tf32", "bfloat16"]
DataDevice = Literal["auto", "cpu", "device"]
Capture = Literal["auto", "off"]
Keep = Literal["best", "last"]
OF_THE_DGVAE = ("input_changes", "fit_inputs", "edge_geometry")
"""Options of the dG-VAE's inputs, without effect on other models."""
OF_THE_NETWORK = ("preset", *OF_THE_DGVAE)
"""Options that make the network; a checkpoint to start from has them already."""
HORIZON_STEPS = 5
"""Number of steps forecast where neither the command nor a checkpoint says it."""
SMALLER = "pass a smaller --batch-size, or a shorter --horizon-steps"


@dataclass(frozen=True)
class TrainConfig:
    """Options of training a forecaster on one or more episode stores."""

    EVERYDAY: ClassVar = (
        "data", "out", "val_data", "model", "preset", "set", "init", "steps", "batch_size", "lr", "history_steps",
        "horizon_steps", "val_windows", "eval_every", "seed", "device", "resume",
    )  # fmt: skip
    """Fields that --help explains."""

    data: tuple[Path, ...]
    """Episode stores (python -m envs.collect makes them); several are mixed by their number of windows, and one
    that is listed twice counts twice."""
    out: Path
    """Run folder, with checkpoint/, config.json, TensorBoard and training state."""
    val_data: tuple[Path, ...] = ()
    """Episode stores for model selection; none given, episodes of `data` are held out."""
    model: ModelName = "dgvae"
    """Network to train."""
    preset: Literal["plural", "fast", "paper"] = "plural"
    """Sizes and parts of the network: "plural" has modes, so that its samples are enumerated futures with
    probabilities; "fast" has the same sizes without modes; "paper" has those of the paper, whose inputs take
    `--no-input-changes --no-fit-inputs --no-edge-geometry` as well. Other models have their published sizes with
    "paper", and half of them otherwise."""
    set: tuple[str, ...] = ()
    """Fields of the network's config to change, as field=value: --set hidden_dim=64 static_dim=16. With `init`, those
    that leave the weights' shapes as they are (static_dim, dropout)."""
    init: str = ""
    """Checkpoint to start from: a shipped name, a folder or a run folder. Network and scales are the checkpoint's, so
    leave out the options of the network, but for `set`; frame and range of perception are the data's. Empty starts from
    random weights."""
    refit_scales: bool = False
    """Whether the scales of `init` are fitted to the data anew, for data that spread otherwise than those it was
    trained on; the weights change along, so that forecasts stay the same but for the geometry of edges and the spread
    of modes (`Forecast.xy_scale`)."""
    only_spread: bool = False
    """Whether to train the spread of the modes alone (`Forecast.xy_scale`): the forecasts of `init` and their
    probabilities stay as they are, and the likelihood of the mixture selects the checkpoint."""
    input_changes: bool = True
    """Whether changes since the last step are inputs of the dG-VAE's encoder (`change_scales`, fitted to the data). No
    effect on other models."""
    fit_inputs: bool = True
    """Whether the dG-VAE's inputs are divided by their spread in the data (`input_scales`), not the spec's scales. No
    effect on other models."""
    edge_geometry: bool = True
    """Whether relative position, relative speed and time to contact are inputs of the dG-VAE's edges
    (`geometry_scales`, fitted to the data, if any step has two agents). No effect on other models."""
    causal_edges: bool = False
    """Whether the causal labels of the stores are the known edges (`--label-weight`, `--type-label-weight`), in place
    of leaders and followers; where a store has none, edges are unknown."""
    steps: int = 4000
    """Number of optimiser steps."""
    batch_size: int = 64
    """Number of windows in an optimiser step."""
    lr: float = 2e-3
    """Peak learning rate (Adam), after warm-up, then cosine to 2 %."""
    history_steps: int = 10
    """Largest number of observed steps of a training window; at deployment the history is unlimited."""
    min_history_steps: int = 0
    """Smallest `history_steps` that is drawn for a batch; 0 takes `history_steps` itself for every batch."""
    val_history_steps: int = 1
    """Smallest number of observed steps of a window for model selection; if equal to `history_steps`, whole sequences
    are cut as in the tables."""
    horizon_steps: int = 0
    """Number of steps forecast in training, and the default horizon of the checkpoint; 0 takes 5, or with `init` as
    many as that checkpoint forecasts."""
    curriculum_steps: int = 0
    """Number of optimiser steps over which the forecast grows from 1 step to `horizon_steps`; 0: at once."""
    one_step_weight: float = 0.2
    """Weight of the teacher-forced one-step likelihood."""
    rollout_weight: float = 1.0
    """Weight of the likelihood of the roll-out; 0 trains teacher-forced only, as the NRI family does."""
    energy_weight: float = 2.0
    """Weight of the energy score of each agent's modes; only models with modes have it."""
    joint_energy_weight: float = 2.0
    """Weight of the energy score of whole scenes, whose modes are those of all agents together."""
    kl_weight: float = 1.0
    """Weight of KL(posterior ‖ prior)."""
    kl_warmup_steps: int = 0
    """Number of optimiser steps over which the KL weight grows linearly from 0."""
    edge_cost: float = 0.0
    """Cost [nats] of a certain edge, in the prior and again in the posterior, which removes edges that explain nothing;
    0 is the paper's."""
    label_weight: float = 0.0
    """Weight of restricted labelling: regression of the first feature dimensions on known edge attributes (dG-VAE)."""
    type_label_weight: float = 0.0
    """Weight of restricted labelling of edge types: the prior's and posterior's cross-entropy with known types (dG-VAE
    and dNRI)."""
    reaction_weight: float = 0.0
    """Additional weight of agents that are about to react to an intervention, or would where causal labels say so: the
    roll-out's errors of an agent count 1 + this times the strength of its causal edge; needs `causal_edges`."""
    shift_weight: float = 0.0
    """Weight of the error of shifts: how far an intervention moves agents, beside how far it moves their forecasts;
    needs a store of branches with twins (`envs.collect --branches 4 --twins`) and one process."""
    variance: float = 5e-5
    """Fixed variance of the likelihood, in scaled units (σ in the paper)."""
    likelihood: Likelihood = "laplace"
    """Likelihood of the loss: "gaussian" is the paper's; "laplace" weighs large errors less and gives lower
    displacement errors."""
    clip_norm: float = 100.0
    """Largest gradient norm."""
    max_episodes: int = 0
    """Number of episodes taken from each training store, the first ones; 0 takes all."""
    val_fraction: float = 0.1
    """Share of episodes held out for model selection; of recordings, where the store is stretches of these."""
    val_windows: int = 1500
    """Number of held-out windows measured for model selection at most: an equal share from each store of `data`,
    however large it is."""
    eval_every: int = 250
    """Number of optimiser steps between validations, at which the training state is saved too."""
    patience: int = 8
    """Number of validations without a better energy score after which training stops."""
    keep: Keep = "best"
    """Weights of the checkpoint: those with the lowest energy score on held-out episodes, or, with "last", the latest
    that were validated, for what that score does not see (`shift_weight`, `type_label_weight`); all steps are done
    then."""
    seed: int = 0
    """Random seed for initial weights, split, order and noise."""
    device: str = "cpu"
    """Device that trains: cpu, cuda or auto (cuda where there is one)."""
    precision: TrainPrecision = "float32"
    """Precision of matrix products in training: "tf32" (CUDA) rounds inputs to 10 bits, which tensor cores
    multiply; "bfloat16" rounds inputs and results to 7 (autocast). Weights, memories and losses stay float32."""
    data_device: DataDevice = "auto"
    """Processor that cuts windows: the CPU, or the training device, which then holds all the data. "auto" takes the
    device if that is CUDA and the data fits into half of its free memory. "device" pads windows to one width, so
    that equal seeds draw other noise than with "cpu"."""
    capture: Capture = "auto"
    """Launch of steps: "auto" records them as CUDA graphs where that is possible, "off" launches each kernel."""
    threads: int = 0
    """Number of CPU threads of torch; 0 leaves torch's choice."""
    resume: bool = False
    """Whether to continue a run that was stopped; finished runs stay as they are."""

    def __post_init__(self) -> None:
        """Checks choices and ranges; replaces `device="auto"` by the chosen device, and a horizon of 0 by its value.

        Raises:
            UserError: a value is out of range, the device does not exist, or the checkpoint of `init` cannot be read.
        """
        check_types(self)
        check_choices(self)
        for name in ("data", "val_data"):
            given = getattr(self, name)
            paths = (given,) if isinstance(given, str | Path) else tuple(given)
            object.__setattr__(self, name, tuple(Path(path) for path in paths))
        object.__setattr__(self, "out", Path(self.out))
        if self.horizon_steps == 0:
            steps = read_info(resolve(self.init)).horizon_steps if self.init else HORIZON_STEPS
            object.__setattr__(self, "horizon_steps", steps)
        check_at_least(
            self, 1, "steps", "batch_size", "history_steps", "horizon_steps", "eval_every", "patience", "val_windows"
        )
        # each step of each window has a state; what the network needs is estimated when the data is there
        check_memory(16 * self.batch_size * (1 + self.horizon_steps), f"batch_size={self.batch_size:,}", SMALLER)
        check_positive(self, "lr", "variance", "clip_norm")
        check_at_least(
            self, 0, "one_step_weight", "rollout_weight", "kl_weight", "seed", "threads", "curriculum_steps",
            "kl_warmup_steps", "energy_weight", "joint_energy_weight", "edge_cost", "label_weight", "type_label_weight",
            "min_history_steps", "max_episodes", "reaction_weight", "shift_weight",
        )  # fmt: skip
        check_at_most(self, MOST_THREADS, "threads")
        of_rollouts = ("shift_weight", "reaction_weight", "curriculum_steps", "only_spread")
        without = [name for name in of_rollouts if getattr(self, name) and not self.rollout_weight]
        if without:
            raise UserError(f"{without[0]} is of roll-outs, and rollout_weight is 0; leave one of them out")
        if self.one_step_weight == self.rollout_weight == 0:
            raise UserError("one_step_weight and rollout_weight are both 0; nothing would be learned")
        given = [name for name in OF_THE_NETWORK if getattr(self, name) != getattr(type(self), name)]
        if self.init and given:
            raise UserError(f"init takes the network of '{self.init}'; leave out {', '.join(given)}")
        if self.refit_scales and (not self.init or self.only_spread or self.model != "dgvae"):
            raise UserError(
                "refit_scales needs a dG-VAE to start from, and not only_spread; pass --init, or leave it out"
            )
        if self.only_spread and self.set:
            raise UserError("only_spread keeps the network of its checkpoint; leave --set out")
        if self.shift_weight and self.history_steps == 1:
            raise UserError(
                "shift_weight needs history_steps of at least 2: with 1, one that was taken out is in neither window"
            )
        if self.only_spread and not self.init:
            raise UserError("only_spread needs the checkpoint whose spread it trains; pass --init, or leave it out")
        unknown = [name for name in self._of_graphs if getattr(self, name)]
        if unknown:
            lacking = "edge features" if self.model == "dnri" else "edges"
            raise UserError(f"model {self.model} has no {lacking}: set {' and '.join(unknown)} to 0")
        if self.reaction_weight and not self.causal_edges:
            raise UserError("reaction_weight needs the causal labels of branches; pass --causal-edges, or set it to 0")
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
        object.__setattr__(self, "device", resolve_device(self.device))
        check_precision(self.precision, self.device)

    @property
    def _of_graphs(self) -> tuple[str, ...]:
        """Weights that the model has no term for."""
        if self.model == "dgvae":
            return ()
        return ("label_weight",) if self.model == "dnri" else ("edge_cost", "label_weight", "type_label_weight")

    @property
    def without_effect(self) -> tuple[str, ...]:
        """Options that change nothing in this run."""
        if self.init:
            return OF_THE_NETWORK
        return () if self.model == "dgvae" else OF_THE_DGVAE


def check_precision(precision: TrainPrecision, device: str) -> None:
    """Checks that a device supports a precision.

    Raises:
        UserError: it does not.
    """
    if precision == "tf32" and not device.startswith("cuda"):
        raise UserError("precision 'tf32' needs a CUDA device; use --precision float32 or --device cuda")
    if precision == "bfloat16" and device.startswith("cuda"):
        if not torch.cuda.is_bf16_supported(including_emulation=False):
            raise UserError(f"device '{device}' has no bfloat16 arithmetic; use --precision float32")
