"""Measures accuracy and time with cheaper graphs: `python -m benchmarks.graph_accuracy --checkpoint A B --data C D`.

Each checkpoint is measured on the same windows of each store with all pairs, with the nearest k, and with a graph that
is frozen when the roll-out begins, whatever it was trained with; plural checkpoints are always frozen. The table shows
minADE of the most likely forecast, also for constant velocity; the time includes streaming the history and forecasting,
one window at a time.
"""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from predictor.baselines.constant_velocity import ConstantVelocity
from predictor.checkpoint import load_checkpoint
from predictor.data.store import read_store
from predictor.data.windows import Windows
from predictor.dgvae import DGVAE
from predictor.dgvae.config import DGVAEConfig
from predictor.evaluation.accuracy import Tally
from predictor.evaluation.measure_line import protocol_indices
from predictor.evaluation.outcomes import run_windows
from predictor.forecaster import Forecaster
from predictor.support.command_line import parse
from predictor.support.config_checks import check_at_least
from predictor.support.errors import UserError, run_entry_point
from predictor.support.files import check_out_file, write_json
from predictor.support.provenance import provenance
from predictor.support.runtime import tune


@dataclass(frozen=True)
class GraphConfig:
    """Measures checkpoints with several graphs."""

    checkpoint: tuple[Path, ...]
    """Checkpoints of dG-VAEs to measure: shipped names, folders or run folders."""
    data: tuple[Path, ...]
    """Episode stores to measure on."""
    neighbours: tuple[int, ...] = (2, 4, 8, 16)
    """Numbers of neighbours to measure with; all pairs, evolving and frozen, are always measured."""
    burn_in_steps: int = 40
    """Number of steps observed in every window before the forecast begins."""
    horizon_steps: int = 10
    """Number of steps to forecast."""
    max_windows: int = 100
    """Number of windows measured at most in each store, drawn evenly."""
    stride: int = 5
    """Number of steps between two windows of an episode."""
    threads: int = 2
    """Number of CPU threads of torch."""
    out: Path | None = None
    """JSON file to write the result to."""

    def __post_init__(self) -> None:
        """Checks ranges.

        Raises:
            UserError: a value is out of range.
        """
        if not self.checkpoint or not self.data:
            raise UserError("give at least one of --checkpoint and one of --data")
        check_at_least(self, 1, "burn_in_steps", "horizon_steps", "max_windows", "stride", "threads", "neighbours")
        check_out_file(self.out)


def measure(forecaster: Forecaster, windows: Windows, config: GraphConfig) -> dict[str, float]:
    """Measures errors [m] over the windows, and the seconds for all of them."""
    chosen = protocol_indices(windows, config.stride, config.max_windows, 0, config.burn_in_steps)
    tally, began = Tally(), time.perf_counter()
    for outcome in run_windows(forecaster, windows, chosen, config.horizon_steps, batch_size=1):
        tally.add(outcome)
    accuracy = tally.accuracy("")
    return {
        "min_ade_m": accuracy.min_ade_m,
        "min_fde_m": accuracy.min_fde_m,
        "seconds": time.perf_counter() - began,
        "windows": len(chosen),
    }


def variants(checkpoint: Path, config: GraphConfig) -> list[DGVAE]:
    """Returns the checkpoint's network with each graph, all pairs first; one with modes is frozen in each.

    Raises:
        UserError: the checkpoint holds another model.
    """
    forecaster, _ = load_checkpoint(checkpoint)
    if not isinstance(forecaster, DGVAE):
        raise UserError(f"{checkpoint} is no dG-VAE; only its graph can be changed")
    counts = (0, *config.neighbours)
    if forecaster.config.num_modes:
        return [forecaster.variant(num_neighbours=count) for count in counts]
    graphs = [forecaster.variant(num_neighbours=count, rollout_graph="evolving") for count in counts]
    return [*graphs, forecaster.variant(num_neighbours=0, rollout_graph="frozen")]


def main() -> None:
    """Runs the command."""
    config = parse(GraphConfig, __doc__)
    tune()
    torch.set_num_threads(config.threads)
    table = Table("store", "agents", "trained on", "graph", "minADE [m]", "minFDE [m]", "s per window")
    lines: list[dict[str, Any]] = []
    for path in config.data:
        store = read_store(path)
        spec, history, horizon = store.info.spec, config.burn_in_steps, config.horizon_steps
        windows = Windows(store.episodes, spec, history, horizon, horizon, history)
        agents = float(np.mean([e.valid.sum(axis=1).mean() for e in store.episodes]))
        cases: list[tuple[str, str, Forecaster]] = [("", "constant velocity", ConstantVelocity(spec, horizon))]
        for checkpoint in config.checkpoint:
            info = load_checkpoint(checkpoint)[1]
            info.spec.check_recorded(spec, f"checkpoint '{checkpoint}'", f"store {path}")
            trained = info.config
            cases += [(_graph(trained), _graph(other.config), other) for other in variants(checkpoint, config)]
        for trained_on, graph, forecaster in cases:
            measured = measure(forecaster, windows, config)
            lines.append({"store": path.name, "agents": agents, "trained_on": trained_on, "graph": graph} | measured)
            errors = (f"{measured[key]:.3f}" for key in ("min_ade_m", "min_fde_m"))
            seconds = f"{measured['seconds'] / measured['windows']:.3f}"
            table.add_row(path.name, f"{agents:.0f}", trained_on, graph, *errors, seconds)
    Console(width=120).print(table)
    if config.out is not None:
        write_json(config.out, {"lines": lines, "provenance": provenance(("torch",))})


def _graph(config: DGVAEConfig) -> str:
    pairs = f"nearest {config.num_neighbours}" if config.num_neighbours else "all pairs"
    return pairs if config.rollout_graph == "evolving" else f"{pairs}, {config.rollout_graph}"


if __name__ == "__main__":
    run_entry_point(main)
