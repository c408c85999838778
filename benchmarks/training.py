"""A training step: windows per second, share of the matmul rate, peak memory, and what the allocator's setting brings.

The step is window, loss, backward and Adam on full windows. glibc's handling of freed memory can only be set once per
process, so the default is timed in another process, which takes turns with this one.
"""

from dataclasses import replace
from typing import NamedTuple

from benchmarks.flops import STATE, Work
from benchmarks.models import TrainingStep, sized
from benchmarks.results import Row, skipped
from benchmarks.settings import Settings
from benchmarks.timing import Meter, rate_row, ratio_row
from benchmarks.worker_process import Child, exact_memory
from predictor.runtime import keep_freed_memory


class Case(NamedTuple):
    """One shape."""

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


def run(settings: Settings) -> list[Row]:
    """Every shape; then memory, then the allocator."""
    cases = CASES[settings.mode]
    rows = [row for case in cases for row in _speed(case, Meter.of(settings))]
    rows.append(_bfloat16(cases[-1], Meter.of(settings)))
    rows += _memory(cases if not settings.quick else cases[:1], settings.threads)
    return [*rows, _allocator(settings)]


def _step(case: Case) -> TrainingStep:
    return TrainingStep(sized(case.preset), case.agents, case.steps, case.batch, case.rollout)


def _name(case: Case) -> str:
    return "teacher-forced + roll-out" if case.rollout else "teacher-forced"


def _speed(case: Case, meter: Meter) -> list[Row]:
    step = _step(case)
    work = Work(step.model.config, case.agents, inputs=STATE)
    flop = work.training(case.batch, case.steps, case.rollout, step.last)
    timing = meter.measure({"step": step})["step"]
    what = case._asdict()
    steps = rate_row("training", _name(case), what, timing, 1, "steps/s", flop=flop)
    windows = rate_row("training", f"{_name(case)}, windows", what, timing, case.batch, "windows/s")
    return [steps, replace(windows, compared=None)]  # the same number twice


def _bfloat16(case: Case, meter: Meter) -> Row:
    shape = (case.agents, case.steps, case.batch, case.rollout)
    steps = {kind: TrainingStep(sized(case.preset), *shape, kind) for kind in ("float32", "bfloat16")}
    timings = meter.measure(steps)
    ratios = timings["float32"].seconds / timings["bfloat16"].seconds
    row = ratio_row("training", f"{_name(case)}, float32 / bfloat16", case._asdict(), ratios, "--precision bfloat16")
    return replace(row, compared=None)  # says something about the processor


def _memory(cases: tuple[Case, ...], threads: int) -> list[Row]:
    rows = []
    with Child(threads, exact_memory()) as child:
        for case in cases:
            name, what = f"peak memory, {_name(case)}", case._asdict()
            peak = child.ask("training", **what)["peak_bytes"]
            if peak is None:
                rows.append(skipped("training", name, "needs /proc/self/clear_refs (Linux)", what))
                continue
            note = "rise of the resident size in a process of its own"
            rows.append(Row("training", name, what, peak / 2**20, "MiB", note=note))
    return rows


def _allocator(settings: Settings) -> Row:
    name, case = "step, glibc's default / freed memory kept", ALLOCATOR_CASE
    if not keep_freed_memory():
        return skipped("training", name, "needs glibc", case._asdict())
    step = _step(case)
    step()
    with Child(settings.threads) as child:

        def default() -> float:
            return float(child.ask("training", **case._asdict())["seconds"])

        default()
        meter = Meter(ALLOCATOR_ROUNDS[settings.mode])
        timings = meter.time_blocks({"default": default, "kept": step.timed})
    ratios = timings["default"].seconds / timings["kept"].seconds
    row = ratio_row("training", name, case._asdict(), ratios, "predictor.runtime.keep_freed_memory()")
    return replace(row, compared=None)  # says something about glibc, not about us
