"""Measures latency and throughput of observing and of rolling out, over batch × agents × horizon × samples."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from benchmarks.flops import Work
from benchmarks.models import SIZES, forecaster, inference, observed, road, scenes, sized
from benchmarks.results import Line
from benchmarks.settings import Settings
from benchmarks.timing import Meter, Timing, rate_line, timed_line
from predictor.dgvae import DGVAE


class Case(NamedTuple):
    """Shape of a forecast."""

    batch: int
    agents: int
    horizon: int
    samples: int


CASES: dict[str, tuple[Case, ...]] = {
    "quick": (Case(1, 6, 5, 1), Case(8, 12, 5, 1), Case(64, 12, 5, 1), Case(8, 12, 5, 6)),
    "full": (
        Case(1, 6, 5, 1),
        Case(1, 12, 15, 1),
        Case(8, 12, 5, 1),
        Case(8, 12, 15, 1),
        Case(64, 12, 5, 1),
        Case(64, 12, 15, 1),
        Case(8, 12, 5, 20),
        Case(8, 10, 20, 1),
        Case(8, 30, 20, 1),
    ),
}
EVOLVING = "evolving graph, float32"
ONE, SIX, PLANS = "one forecast, plural", "six futures, plural", "one forecast for each of five plans, plural"
"""Names of the lines of a model with modes, each a step of streaming: observe and roll out."""
WITHOUT_MODES = "one forecast without modes"
NUM_PLANS = 5
PROMISED = {ONE: 1.2, SIX: 2.0, PLANS: 2.5}
"""Largest ratio of each line to its base for a single scene; larger batches share the cost of calls."""


def run(settings: Settings) -> list[Line]:
    """Measures both presets at every shape, and what modes and plans cost."""
    meter, cases = Meter.of(settings), CASES[settings.mode]
    lines = [line for preset in SIZES for case in cases for line in _case(preset, case, meter)]
    shapes = dict.fromkeys(case._replace(samples=1) for case in cases)
    return lines + [line for case in shapes for line in _modes(case, meter)]


def _modes(case: Case, meter: Meter) -> list[Line]:
    """Measures a step of streaming with one forecast, with six, and with one for each of five plans of the ego.

    One forecast stands beside the step of a model without modes, the others beside one forecast.
    """
    states, valid = scenes(case.batch, case.agents)
    single, plural = (forecaster(sized(name), road(case.agents), case.horizon) for name in ("fast", "plural"))
    plans = states[:, None, None, 0].expand(-1, NUM_PLANS, case.horizon, -1).contiguous()
    steps = {
        WITHOUT_MODES: partial(_step, single, states, valid, 1),
        ONE: partial(_step, plural, states, valid, 1),
        SIX: partial(_step, plural, states, valid, 6),
        PLANS: partial(_planned_step, plural, states, valid, plans),
    }
    timings = meter.measure({name: inference(step) for name, step in steps.items()})
    return [
        timed_line("forecast", name, case._asdict() | {"samples": samples}, timings[name], base=timings[base],
                   ratio_to=base, at_most=PROMISED[name] if case.batch == 1 else None)
        for name, base, samples in ((ONE, WITHOUT_MODES, 1), (SIX, ONE, 6), (PLANS, ONE, 1))
    ]  # fmt: skip


def _step(model: DGVAE, states: Tensor, valid: Tensor, samples: int) -> Any:
    _, belief = model.observe(model.empty_memory(*valid.shape), states, valid)
    return model.rollout(belief, model.horizon_steps, samples).states


def _planned_step(model: DGVAE, states: Tensor, valid: Tensor, plans: Tensor) -> Any:
    _, belief = model.observe(model.empty_memory(*valid.shape), states, valid)
    return model.rollout_plans(belief, plans).states


def _case(preset: str, case: Case, meter: Meter) -> list[Line]:
    model = forecaster(sized(preset), road(case.agents), case.horizon)
    timings = meter.measure(_calls(model, case))
    work = Work(model.config, case.agents)
    what = {"preset": preset} | case._asdict()
    look, run_on = work.observe(case.batch), work.rollout(case.horizon, case.samples, case.batch)
    frozen = work.rollout(case.horizon, case.samples, case.batch, frozen=True)
    seen, rolled = timings["observe"], timings["roll-out"]

    def line(name: str, flop: float | None, base: Timing | None = None) -> Line:
        return timed_line(
            "forecast", name, what, timings[name], flop=flop, base=base, ratio_to=EVOLVING if base else ""
        )

    forecasts = case.batch * case.agents * case.samples
    return [
        line("observe", look),
        line("roll-out", run_on),
        line("roll-out, frozen graph", frozen, rolled),
        line("observe and roll-out, half of the agents there", None),
        rate_line(
            "forecast", "observe + roll-out", what, seen.plus(rolled), forecasts, "agent-forecasts/s",
            flop=look + run_on,
        ),
    ]  # fmt: skip


def _calls(model: DGVAE, case: Case) -> dict[str, Callable[[], Any]]:
    states, valid = scenes(case.batch, case.agents)
    frozen = model.variant(rollout_graph="frozen")
    memory, belief = observed(model, states, valid)
    frozen_belief = observed(frozen, states, valid)[1]
    generator = torch.Generator().manual_seed(0)
    observe = inference(partial(model.observe, memory, states, valid))
    rollout = inference(partial(model.rollout, belief, case.horizon, case.samples, generator))
    return {
        "observe": observe,
        "roll-out": rollout,
        "roll-out, frozen graph": inference(
            partial(frozen.rollout, frozen_belief, case.horizon, case.samples, generator)
        ),
        "observe and roll-out, half of the agents there": inference(partial(_half, model, case)),
    }


def _half(model: DGVAE, case: Case) -> Any:
    """Observes and rolls out scenes in which every second agent is absent, as in batches of unequal scenes."""
    states, valid = scenes(case.batch, case.agents)
    valid[:, 1::2] = False
    _, belief = model.observe(model.empty_memory(*valid.shape), states * valid[..., None], valid)
    return model.rollout(belief, case.horizon, case.samples, torch.Generator().manual_seed(0)).states
