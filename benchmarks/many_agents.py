"""Measures time and memory of a forecast against the number of agents, for all pairs and for the nearest neighbours.

Exponents are the slopes of straight lines through log time and log memory over log agents. Memory is the rise of the
resident size of another process whose allocator returns every larger block to the system at once.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import torch

from benchmarks.flops import Work
from benchmarks.models import SIZES, forecaster, inference, road, scenes, sized
from benchmarks.results import Compared, Line, skipped
from benchmarks.settings import Settings
from benchmarks.timing import Meter, timed_line
from benchmarks.worker_process import WorkerProcess, exact_memory
from predictor.dgvae import DGVAE
from predictor.dgvae.config import DGVAEConfig

NEIGHBOURS = 8
HORIZON = 20
COUNTS: dict[str, tuple[int, ...]] = {"quick": (20, 50, 100, 200), "full": (10, 20, 50, 100, 200, 500)}
MOST_DENSE = {"quick": 100, "full": 500}
"""Largest number of agents for which all pairs are measured, if they fit into memory."""
MEMORY_COUNTS: dict[str, tuple[int, ...]] = {"quick": (50, 200), "full": (50, 100, 200, 500)}
FIT_FROM = 50
"""Smallest number of agents that exponents are fitted to; below it the fixed cost of calls dominates."""
MOST_BYTES = 4 * 2**30
EXPONENT_TOLERANCE = {"time": 1.6, "memory": 1.25}
"""Tolerance of exponents: one commit measured twice on one machine gave exponents of time up to 1.4 times apart."""
Costs = dict[int, float]


def exponent(costs: Costs) -> float:
    """Computes the slope of log cost over log count by least squares."""
    counts, values = np.array(list(costs), dtype=np.float64), np.array(list(costs.values()))
    return float(np.polyfit(np.log(counts), np.log(values), 1)[0])


def dense_bytes(config: DGVAEConfig, agents: int) -> float:
    """Estimates the bytes that all pairs take: embedding, gates, memory before and after, heads, messages."""
    width = 2 * config.hidden_dim + 8 * config.rnn_dim + 2 * config.head_dim + 2 * config.message_dim
    return 4.0 * agents**2 * width


def run(settings: Settings) -> list[Line]:
    """Measures both presets with both graphs."""
    lines = []
    with WorkerProcess(settings.threads, exact_memory()) as worker:
        for preset in SIZES:
            for neighbours in (0, NEIGHBOURS):
                times, timed = _times(preset, neighbours, settings)
                peaks, measured = _memory(preset, neighbours, settings, worker)
                lines += timed + measured
                lines += _exponents(preset, neighbours, times, peaks)
    return lines


def _what(preset: str, neighbours: int) -> dict[str, Any]:
    graph = f"{neighbours} nearest" if neighbours else "all pairs"
    return {"preset": preset, "graph": graph, "horizon": HORIZON}


def _counts(counts: Sequence[int], preset: str, neighbours: int, settings: Settings) -> tuple[list[int], list[Line]]:
    """Returns the numbers of agents to measure, and lines for those that do not fit into memory."""
    if neighbours:
        return list(counts), []
    chosen = [count for count in counts if count <= MOST_DENSE[settings.mode]]
    small = [count for count in chosen if dense_bytes(sized(preset), count) <= MOST_BYTES]
    why = f"all pairs need more than {MOST_BYTES / 2**30:.0f} GiB"
    what = _what(preset, neighbours)
    return small, [skipped("agents", "forecast", why, what | {"agents": c}) for c in chosen if c not in small]


def _times(preset: str, neighbours: int, settings: Settings) -> tuple[Costs, list[Line]]:
    meter = Meter.of(settings)
    counts, absent = _counts(COUNTS[settings.mode], preset, neighbours, settings)
    times: Costs = {}
    lines = []
    for agents in counts:
        config = replace(sized(preset), num_neighbours=neighbours)
        model = forecaster(config, road(agents), HORIZON)
        timing = meter.measure({"forecast": inference(partial(_forecast, model, *scenes(1, agents)))})["forecast"]
        work = Work(config, agents, neighbours=neighbours)
        flop = work.observe() + work.rollout(HORIZON)
        lines.append(
            timed_line("agents", "forecast", _what(preset, neighbours) | {"agents": agents}, timing, flop=flop)
        )
        times[agents] = timing.equivalents  # the machine's speed may change between two counts
    return times, lines + absent


def _forecast(model: DGVAE, states: torch.Tensor, valid: torch.Tensor) -> None:
    _, belief = model.observe(model.empty_memory(*valid.shape), states, valid)
    model.rollout(belief, HORIZON)


def _memory(preset: str, neighbours: int, settings: Settings, worker: WorkerProcess) -> tuple[Costs, list[Line]]:
    counts, _ = _counts(MEMORY_COUNTS[settings.mode], preset, neighbours, settings)
    peaks: Costs = {}
    lines = []
    for agents in counts:
        what = _what(preset, neighbours) | {"agents": agents}
        arguments = {"preset": preset, "agents": agents, "neighbours": neighbours, "horizon": HORIZON}
        peak = worker.ask("forecast", **arguments)["peak_bytes"]
        if peak is None:
            return {}, [skipped("agents", "peak memory", "needs /proc/self/clear_refs (Linux)", what)]
        lines.append(Line("agents", "peak memory", what, peak / 2**20, "MiB"))
        peaks[agents] = max(1.0, peak)
    return peaks, lines


def _exponents(preset: str, neighbours: int, times: Costs, peaks: Costs) -> list[Line]:
    lines = []
    for name, costs in (("time", times), ("memory", peaks)):
        fitted = {agents: cost for agents, cost in costs.items() if agents >= FIT_FROM}
        if len(fitted) < 2:
            continue
        slope = exponent(fitted)
        what = _what(preset, neighbours) | {"agents": f"{min(fitted)} to {max(fitted)}"}
        compared = Compared(slope, "ratio", "lower", EXPONENT_TOLERANCE[name])
        note = f"{name} grows with agents to this power"
        lines.append(Line("agents", f"exponent of {name}", what, slope, "", compared=compared, note=note))
    return lines
