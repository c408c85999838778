"""Measures a training step: windows per second, share of the matmul rate, peak memory, gain from allocator settings.

The step is window, loss, backward and Adam on full windows. glibc's handling of freed memory can only be set once per
process, so the default is timed in another process, which takes turns with this one.
"""

from dataclasses import replace
from typing import NamedTuple

from benchmarks.flops import STATE, Work
from benchmarks.models import TrainingStep, sized
from benchmarks.results import Line, skipped
from benchmarks.settings import Settings
from benchmarks.timing import Meter, rate_line, ratio_line
from benchmarks.worker_process import WorkerProcess, exact_memory
from predictor.support.runtime import keep_freed_memory


class Case(NamedTuple):
    """Shape of a training step."""

    preset: str
    agents: int
    steps: int
    batch: int
    rollout: int


_SPRINGS = {"agents": 5, "steps": 50, "batch": 128}
_ROAD = {"agents": 12, "steps": 15, "batch": 64}
CASES: dict[str, tuple[Case, ...]] = {
    "quick": (
        Case("fast", **_SPRINGS, rollout=0),
        Case("fast", **_SPRINGS, rollout=10),
        Case("fast", **_ROAD, rollout=5),
        Case("paper", **_SPRINGS, rollout=0),
    ),
    "full": tuple(
        Case(preset, **shape, rollout=rollout)
        for preset in ("fast", "paper")
        for shape, longest in ((_SPRINGS, 10), (_ROAD, 5))
        for rollout in (0, longest)
    ),
}
ALLOCATOR_CASE = Case("fast", **_SPRINGS, rollout=0)
ALLOCATOR_ROUNDS = {"quick": 5, "full": 15}


def run(settings: Settings) -> list[Line]:
    """Measures every shape, then memory, then the allocator."""
    cases = CASES[settings.mode]
    lines = [line for case in cases for line in _speed(case, Meter.of(settings))]
    lines.append(_bfloat16(cases[-1], Meter.of(settings)))
    lines += _memory(cases if not settings.quick else cases[:1], settings.threads)
    return [*lines, _allocator(settings)]


def _step(case: Case) -> TrainingStep:
    return TrainingStep(sized(case.preset), case.agents, case.steps, case.batch, case.rollout)


def _name(case: Case) -> str:
    return "teacher-forced + roll-out" if case.rollout else "teacher-forced"


def _speed(case: Case, meter: Meter) -> list[Line]:
    step = _step(case)
    work = Work(step.model.config, case.agents, inputs=STATE)
    flop = work.training(case.batch, case.steps, case.rollout, step.last)
    timing = meter.measure({"step": step})["step"]
    what = case._asdict()
    steps = rate_line("training", _name(case), what, timing, 1, "steps/s", flop=flop)
    windows = rate_line("training", f"{_name(case)}, windows", what, timing, case.batch, "windows/s")
    return [steps, replace(windows, compared=None)]  # compared once, as steps/s


def _bfloat16(case: Case, meter: Meter) -> Line:
    shape = (case.agents, case.steps, case.batch, case.rollout)
    steps = {kind: TrainingStep(sized(case.preset), *shape, kind) for kind in ("float32", "bfloat16")}
    timings = meter.measure(steps)
    ratios = timings["float32"].seconds / timings["bfloat16"].seconds
    line = ratio_line("training", f"{_name(case)}, float32 / bfloat16", case._asdict(), ratios, "--precision bfloat16")
    return replace(line, compared=None)  # depends on the processor


def _memory(cases: tuple[Case, ...], threads: int) -> list[Line]:
    lines = []
    with WorkerProcess(threads, exact_memory()) as worker:
        for case in cases:
            name, what = f"peak memory, {_name(case)}", case._asdict()
            peak = worker.ask("training", **what)["peak_bytes"]
            if peak is None:
                lines.append(skipped("training", name, "needs /proc/self/clear_refs (Linux)", what))
                continue
            note = "rise of the resident size in a process of its own"
            lines.append(Line("training", name, what, peak / 2**20, "MiB", note=note))
    return lines


def _allocator(settings: Settings) -> Line:
    name, case = "step, glibc's default / freed memory kept", ALLOCATOR_CASE
    if not keep_freed_memory():
        return skipped("training", name, "needs glibc", case._asdict())
    step = _step(case)
    step()
    with WorkerProcess(settings.threads) as worker:

        def default() -> float:
            return float(worker.ask("training", **case._asdict())["seconds"])

        default()
        meter = Meter(ALLOCATOR_ROUNDS[settings.mode])
        timings = meter.time_blocks({"default": default, "kept": step.timed})
    ratios = timings["default"].seconds / timings["kept"].seconds
    line = ratio_line("training", name, case._asdict(), ratios, "predictor.support.runtime.keep_freed_memory()")
    return replace(line, compared=None)  # depends on glibc, not on this project
