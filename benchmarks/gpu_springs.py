"""Trains the paper-size dG-VAE on 5-Spring on one GPU with one command: `python -m benchmarks.gpu_springs --data data`.

Makes the data if it is missing, trains the dG-VAE for 150 epochs of 50,000 sequences at batch 128, measures it as the
table does (the line of `python -m predictor.suite --table springs --budget paper --lines dgvae`) and writes
summary.json: steps/s, minutes, accuracy. A run that was killed continues from its last checkpoint.

Without a GPU, `--project` times a step of the same shapes on this machine, counts its products, bytes and kernels, and
computes the time on a card from them. That is arithmetic on assumptions, not a measurement.
"""

import pickle
import statistics
import tempfile
import time
from collections import Counter as Counts
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.utils import _pytree as pytree
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.flop_counter import flop_registry

from predictor.data.springs import SpringsConfig, make
from predictor.evaluation.paper_tables import SPRINGS, Budget
from predictor.suite import SuiteConfig, line_config, line_folder, run_line
from predictor.support.command_line import parse
from predictor.support.config_checks import check_at_least, check_choices, check_positive
from predictor.support.errors import UserError, run_entry_point
from predictor.support.files import check_out, write_json
from predictor.support.provenance import provenance
from predictor.support.reading import read_object
from predictor.support.runtime import processor, resolve_device, tune
from predictor.training.batches import Shapes
from predictor.training.config import TrainConfig, TrainPrecision
from predictor.training.objective import window_loss
from predictor.training.trainer import Trainer
from predictor.training.training_data import load_data

SPLITS = ("train", "val", "test", "ood")
LINE = next(line for line in SPRINGS.lines if line.key == "dgvae")
ATEN = torch.ops.aten
NO_KERNEL = {
    ATEN.empty, ATEN.empty_like, ATEN.empty_strided, ATEN.new_empty, ATEN.new_empty_strided, ATEN.detach,
    ATEN._unsafe_view, ATEN.lift_fresh, ATEN.is_same_size, ATEN._local_scalar_dense, ATEN.resize_,
}  # fmt: skip
"""Operations that move no data; views are not counted either."""
FLOP = {packet: flop_registry[packet] for packet in (ATEN.mm, ATEN.addmm, ATEN.bmm, ATEN.baddbmm)} | {
    ATEN.addmm_: flop_registry[ATEN.addmm], ATEN.baddbmm_: flop_registry[ATEN.baddbmm],
}  # fmt: skip
"""Functions that count the FLOP of matrix products, by operation; other operations count 0."""
H200_TFLOPS = {"float32": 67.0, "tf32": 494.0, "bfloat16": 989.0}
"""Peak rate of an H200 for dense products [TFLOP/s], by precision, from the vendor's data sheet."""
OTHER_KERNEL_US = (1.5, 2.0, 2.5, 3.0)
"""Least times of a kernel [µs] for which the projection is repeated."""
UPDATE_KERNELS = 10
"""Number of kernels of clipping and fused Adam on a GPU; the hundreds that a CPU needs for them are not counted."""


@dataclass(frozen=True)
class GpuSpringsConfig:
    """Trains the paper-size dG-VAE on 5-Spring, measures it, and writes how long it took."""

    data: Path = Path("data")
    """Folder of the episode stores; springs/ below it is made if it is missing (a few minutes)."""
    out: Path = Path("runs/gpu_springs")
    """Folder to write: the suite's line of the table, and summary.json (or projection.json)."""
    device: str = "cuda"
    """Device that trains and measures: cpu, cuda or auto; `--project` takes the CPU."""
    precision: TrainPrecision = "float32"
    """Precision of matrix products in training, see `python -m predictor.train --help`."""
    budget: Budget = "paper"
    """Sizes of network and training: "paper" is 150 epochs at batch 128, "smoke" takes a minute on a CPU."""
    steps: int = 0
    """Number of optimiser steps; 0 takes the budget's."""
    seed: int = 0
    """Random seed for data, training and forecasts."""
    sequences: int = 50_000
    """Number of training sequences to make if there are none (paper: 50,000)."""
    held_out: int = 10_000
    """Number of sequences of each of the other splits (paper: 10,000)."""
    project: bool = False
    """Time and count a step on this machine, and project it onto a card."""
    timed_steps: int = 3
    """Number of steps to time for the projection, after one to warm up."""
    batch_size: int = 0
    """Number of windows in a step of the projection; 0 takes the budget's."""
    peak_tflops: float = 0.0
    """Peak rate of the card's products at this precision; 0 takes an H200's (67 in float32, 494 in TF32, 989 in
    bfloat16)."""
    bandwidth_gbs: float = 4800.0
    """Bandwidth of the card's memory (H200: 4,800)."""
    share: float = 0.0
    """Share of the peak that products of these shapes reach; 0 takes the share of this machine's own rate."""
    kernel_us: float = 2.0
    """Least time of a kernel in a replayed graph, start included [µs]: the assumption that matters most."""
    target_minutes: float = 30.0
    """Time that the training should stay below [minutes]."""

    def __post_init__(self) -> None:
        """Checks choices and ranges; replaces `device="auto"` by the device that is taken.

        Raises:
            UserError: a value is out of range, or, without `project`, the device is not available.
        """
        check_choices(self)
        check_at_least(self, 1, "sequences", "held_out", "timed_steps")
        check_at_least(self, 0, "steps", "seed", "batch_size", "peak_tflops")
        check_positive(self, "bandwidth_gbs", "kernel_us", "target_minutes")
        if not 0 <= self.share <= 1:
            raise UserError(f"share must lie between 0 and 1, got {self.share}")
        if self.project:
            return
        projected = ("timed_steps", "batch_size", "peak_tflops", "bandwidth_gbs", "share", "kernel_us")
        if idle := [name for name in projected if getattr(self, name) != getattr(type(self), name)]:
            raise UserError(f"{idle[0]} is of a projection and has no effect without --project; leave it out")
        try:
            object.__setattr__(self, "device", resolve_device(self.device))
        except UserError as error:
            raise UserError(f"{error}, or pass --project for an estimate") from None

    @property
    def suite(self) -> SuiteConfig:
        """Config of the suite for this line of the table; a projection computes on the CPU, which has no TF32."""
        device = "cpu" if self.project else self.device
        precision: TrainPrecision = "float32" if self.project and self.precision == "tf32" else self.precision
        return SuiteConfig(
            "springs", self.data, self.out, self.budget, (LINE.key,), self.steps, 1, self.seed, device, precision
        )


# --- The run ----------------------------------------------------------------------------------------------------------


def make_missing(config: GpuSpringsConfig) -> dict[str, float]:
    """Simulates the missing splits and returns the seconds that each took."""
    folder = config.data / "springs"
    sizes = {name: config.sequences if name == "train" else config.held_out for name in SPLITS}
    train, val, test, ood = (0 if (folder / name).exists() else size for name, size in sizes.items())
    return make(SpringsConfig(folder, train, val, test, ood, seed=config.seed)) if train + val + test + ood else {}


def run(config: GpuSpringsConfig) -> dict[str, Any]:
    """Makes data, trains, measures and writes the summary; finished parts are not repeated."""
    made = make_missing(config)
    config.suite.check_stores()
    folder, file = line_folder(config.suite, LINE), config.out / "summary.json"
    before, result = _steps_done(folder / "run"), folder / "result.json"
    finished = result.exists()
    if (known := read_object(file) if finished and file.exists() else {}).get("config") == _plain(config):
        return known
    measured = read_object(result) if finished else run_line(config.suite, LINE)
    if finished and not {"train_seconds", "measure_seconds", "tests"} <= set(measured):
        raise UserError(f"{result} is not the result of this line; delete it, and the line is measured again")
    steps = config.suite.sizes.steps
    minutes = measured["train_seconds"] / 60
    here = torch.cuda.get_device_name() if config.device.startswith("cuda") else processor()
    # device and steps of a finished training's last call are known to that call alone
    device, last = (known.get("device"), known.get("steps_of_the_last_call")) if finished else (here, steps - before)
    test = measured["tests"]["test"]
    summary = {
        "device": device,
        "steps": steps,
        "steps_of_the_last_call": last,
        "train_minutes_of_the_last_call": minutes,
        "steps_per_s_with_validation": None if last is None else last / measured["train_seconds"],
        "measure_minutes": measured["measure_seconds"] / 60,
        "data_seconds": made,
        "below_target": minutes <= config.target_minutes if last == steps else None,
        "min_ade_m": test["horizon_only"]["min_ade_m"],
        "graph_accuracy": test["graph"]["accuracy"],
        "tests": measured["tests"],
        "config": _plain(config),
        "provenance": provenance(("torch", "numpy", "zarr")),
    }
    write_json(file, summary)
    return summary


def _steps_done(folder: Path) -> int:
    state = folder / "train_state.pt"
    try:
        return int(torch.load(state, weights_only=True, map_location="cpu")["step"]) if state.exists() else 0
    except (OSError, RuntimeError, ValueError, LookupError, TypeError, EOFError, pickle.UnpicklingError) as error:
        raise UserError(f"{state} is damaged; delete {folder} to train anew") from error


# --- The projection ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Kernel:
    """Operation that moves data."""

    name: str
    """Name of the operation."""
    flop: float
    """FLOP of a matrix product; 0 for other operations."""
    moved_bytes: float
    """Number of bytes of inputs and outputs."""


class Counter(TorchDispatchMode):
    """Records every operation, those of the backward pass included."""

    def __init__(self) -> None:
        """Starts with no kernels."""
        super().__init__()
        self.kernels: list[Kernel] = []

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Runs the operation and records it unless it is a view."""
        kwargs = kwargs or {}
        out = func(*args, **kwargs)
        packet = func._overloadpacket
        if not func.is_view and packet not in NO_KERNEL:
            tensors = [t for t in pytree.tree_leaves((args, kwargs, out)) if isinstance(t, Tensor)]
            moved = sum(t.numel() * t.element_size() for t in tensors)
            flop = FLOP[packet](*args, **kwargs, out_val=out) if packet in FLOP else 0
            self.kernels.append(Kernel(packet.__name__, float(flop), float(moved)))
        return out


def projected_config(config: GpuSpringsConfig, data: Path) -> TrainConfig:
    """Returns the config of the line's training at its mean history length, which gives the mean cost of a step."""
    settings = line_config(replace(config.suite, data=data), LINE, config.out / "unused")
    shapes = Shapes(1, settings.history_steps, settings.horizon_steps)
    lengths = range(settings.min_history_steps, settings.history_steps + 1)
    mean = statistics.mean(shapes.time(n) for n in lengths) - settings.horizon_steps
    batch = config.batch_size or settings.batch_size
    return replace(
        settings,
        batch_size=batch,
        history_steps=round(mean),
        min_history_steps=0,
        val_history_steps=1,
    )


def count(trainer: Trainer) -> list[Kernel]:
    """Returns the kernels of forward, loss and backward of one step."""
    now = trainer.plan(0)
    batch = trainer.batches.batch(now)
    with Counter() as counter:
        output = trainer.model.window(
            batch.states, batch.valid, batch.last_observed, now.rollout_steps, trainer.noise.manual_seed(0)
        )
        loss, _ = window_loss(trainer.model, batch, output, trainer.config)
        loss.backward()
    trainer.optimizer.zero_grad(set_to_none=True)
    return counter.kernels


def time_steps(trainer: Trainer, steps: int) -> list[float]:
    """Measures the seconds of each step, after one to warm up."""
    trainer.read(trainer.train_step())
    seconds = []
    for _ in range(steps):
        began = time.perf_counter()
        trainer.read(trainer.train_step())
        seconds.append(time.perf_counter() - began)
    return seconds


def matmul_rate(size: int = 1024, repeats: int = 5) -> float:
    """Measures FLOP/s of a plain float32 product on this machine, the best of a few."""
    left, right, out = torch.randn(size, size), torch.randn(size, size), torch.empty(size, size)
    seconds = []
    for _ in range(repeats + 1):
        began = time.perf_counter()
        torch.mm(left, right, out=out)
        seconds.append(time.perf_counter() - began)
    return float(2 * size**3 / min(seconds[1:]))


def project(config: GpuSpringsConfig) -> dict[str, Any]:
    """Times and counts a step on this machine, and projects its time on the card."""
    tune()
    with tempfile.TemporaryDirectory() as folder:
        data, batch = Path(folder), config.batch_size or config.suite.sizes.batch_size
        make(SpringsConfig(data / "springs", train=2 * batch, val=8, test=0, ood=0, seed=config.seed))
        settings = projected_config(config, data)
        trainer = Trainer(settings, load_data(settings))
    kernels, seconds, rate = count(trainer), time_steps(trainer, config.timed_steps), matmul_rate()
    here, steps = measured_here(kernels, seconds, rate), config.suite.sizes.steps
    cards = {us: on_card(replace(config, kernel_us=us), kernels, here, steps) for us in OTHER_KERNEL_US}
    content = {
        "what": "a projection from counts and assumptions, not a measurement on the card",
        "batch_size": settings.batch_size,
        "history_steps": settings.history_steps,
        "horizon_steps": settings.horizon_steps,
        "here": here,
        "card": on_card(config, kernels, here, steps),
        "minutes_by_kernel_us": {us: card["minutes"] for us, card in cards.items()},
        "config": _plain(config),
        "provenance": provenance(("torch", "numpy")),
    }
    config.out.mkdir(parents=True, exist_ok=True)
    write_json(config.out / "projection.json", content)
    return content


def measured_here(kernels: list[Kernel], seconds: list[float], matmul_flop_per_s: float) -> dict[str, Any]:
    """Returns the counts of a step and its speed on this machine."""
    flop, step_s = sum(k.flop for k in kernels), statistics.median(seconds)
    return {
        "machine": processor(),
        "threads": torch.get_num_threads(),
        "step_s": seconds,
        "median_step_s": step_s,
        "flop_per_step": flop,
        "bytes_per_step": sum(k.moved_bytes for k in kernels),
        "kernels_per_step": len(kernels) + UPDATE_KERNELS,
        "kernels_by_operation": dict(Counts(k.name for k in kernels).most_common()),
        "flop_per_s": flop / step_s,
        "matmul_flop_per_s": matmul_flop_per_s,
        "share_of_matmul_rate": flop / step_s / matmul_flop_per_s,
    }


def on_card(config: GpuSpringsConfig, kernels: list[Kernel], here: Mapping[str, Any], steps: int) -> dict[str, float]:
    """Computes the seconds of a step on the card, by each limit alone and with every kernel at its own limit.

    Args:
        config: rates of the card.
        kernels: kernels of a step.
        here: result of `measured_here`; its share of the matmul rate is taken if the config has none.
        steps: number of steps of the run.

    Returns:
        The seconds by name, the assumptions behind them, and the minutes of the whole run.
    """
    share = config.share or min(1.0, here["share_of_matmul_rate"])
    peak = config.peak_tflops or H200_TFLOPS[config.precision]
    rate, bandwidth, least = peak * 1e12 * share, config.bandwidth_gbs * 1e9, config.kernel_us * 1e-6
    step_s = sum(max(least, k.flop / rate, k.moved_bytes / bandwidth) for k in kernels) + UPDATE_KERNELS * least
    return {
        "peak_tflops": peak,
        "share_of_peak": share,
        "products_s": sum(k.flop for k in kernels) / rate,
        "memory_s": sum(k.moved_bytes for k in kernels) / bandwidth,
        "kernels_s": (len(kernels) + UPDATE_KERNELS) * least,
        "step_s": step_s,
        "steps": steps,
        "minutes": steps * step_s / 60,
        "target_minutes": config.target_minutes,
    }


def _plain(config: GpuSpringsConfig) -> dict[str, Any]:
    return {name: str(value) if isinstance(value, Path) else value for name, value in asdict(config).items()}


def describe(content: dict[str, Any]) -> str:
    """Returns the projection as text."""
    here, card = content["here"], content["card"]
    verdict = "below" if card["minutes"] <= card["target_minutes"] else "ABOVE"
    other = ", ".join(f"{us} µs: {minutes:.1f} minutes" for us, minutes in content["minutes_by_kernel_us"].items())
    most = ", ".join(f"{name} {number:,}" for name, number in list(here["kernels_by_operation"].items())[:5])
    return "\n".join(
        [
            f"a step: {content['batch_size']} windows of {content['history_steps']} + {content['horizon_steps']} steps",
            f"  here ({here['machine']}, {here['threads']} threads): {here['median_step_s']:.3f} s",
            f"  {here['flop_per_step'] / 1e9:,.1f} GFLOP in products, {here['bytes_per_step'] / 1e9:,.2f} GB moved, "
            f"{here['kernels_per_step']:,} kernels (most of them {most})",
            f"  {here['flop_per_s'] / 1e9:,.1f} GFLOP/s, {here['share_of_matmul_rate']:.0%} of the rate of plain "
            f"products here ({here['matmul_flop_per_s'] / 1e9:,.1f} GFLOP/s)",
            "PROJECTION, not a measurement: on the card a step takes",
            f"  {1e3 * card['products_s']:.1f} ms by products ({card['share_of_peak']:.0%} of {card['peak_tflops']:g} "
            f"TFLOP/s), {1e3 * card['memory_s']:.1f} ms by memory, {1e3 * card['kernels_s']:.1f} ms by its kernels",
            f"  {1e3 * card['step_s']:.1f} ms with every kernel at its own limit; {card['steps']:,} steps: "
            f"{card['minutes']:.1f} minutes, {verdict} the target of {card['target_minutes']:g}",
            f"  if the least a kernel takes is {other}",
        ]
    )


def main() -> None:
    """Runs the command."""
    config = parse(GpuSpringsConfig, __doc__)
    check_out(config.out)
    if config.project:
        print(describe(project(config)), f"written to {config.out / 'projection.json'}", sep="\n")
        return
    summary = run(config)
    last, speed = summary["steps_of_the_last_call"], summary["steps_per_s_with_validation"]
    of_call = "an unknown number of" if last is None else f"{last:,}"
    rate = "" if last is None else f" ({speed:.1f} steps/s, validation included) on {summary['device']}"
    print(
        f"{of_call} steps in {summary['train_minutes_of_the_last_call']:.1f} minutes{rate}; "
        f"minADE {summary['min_ade_m']:.4f} m, graph accuracy {summary['graph_accuracy']:.3f}\n"
        f"written to {config.out / 'summary.json'}"
    )


if __name__ == "__main__":
    run_entry_point(main)
