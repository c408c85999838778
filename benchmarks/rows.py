"""Measures forecasts for many environments at once against their number: steps/s, time per row, peak memory.

`python -m benchmarks.rows` steps tensor traffic of 1 to 16,384 rows (`--simulator vmas`: VMAS), each number in a
process of its own. A step reads all rows (`envs.readers.batched`), moves memories along with ids, forecasts, and makes
entries of observations; the simulator's own time stands beside it. With one thread on a CPU, times are processor times,
which other processes change little. Exponents are slopes of log cost over log rows.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from benchmarks.many_agents import exponent
from benchmarks.row_costs import Measured, Simulator, make_run
from benchmarks.worker_process import WorkerProcess
from predictor.online import MAX_ROWS
from predictor.support import markdown
from predictor.support.command_line import parse
from predictor.support.config_checks import check_at_least, check_choices
from predictor.support.errors import UserError, run_entry_point
from predictor.support.files import check_out_file, write_json
from predictor.support.provenance import provenance
from predictor.support.runtime import processor, resolve_device

CHECKPOINTS: dict[Simulator, str] = {"traffic": "highway", "vmas": "simple-spread"}
TIME_FROM, MEMORY_FROM = 256, 1024
"""Number of rows from which exponents are fitted; below, the fixed cost of calls dominates."""


@dataclass(frozen=True)
class RowsConfig:
    """Measures forecasts against the number of rows."""

    num_envs: tuple[int, ...] = (1, 16, 256, 1024, 4096, 16384)
    """Numbers of environments that step at once."""
    simulator: Simulator = "traffic"
    """What is forecast: tensor traffic of 12 entries per row, half of them empty, or VMAS's simple_spread (needs
    VMAS)."""
    checkpoint: str | None = None
    """Forecaster: shipped name, folder or run folder; None takes highway for traffic, simple-spread for VMAS."""
    max_rows: int = MAX_ROWS
    """Largest number of rows in one call of the forecaster."""
    seconds: float = 5.0
    """Time of a measurement [s]; at least 3 steps are timed."""
    threads: int = 1
    """Number of torch threads."""
    device: str = "cpu"
    """Device of the forecaster: cpu, cuda or auto."""
    out: Path | None = None
    """JSON file to write the result to."""

    def __post_init__(self) -> None:
        """Checks ranges.

        Raises:
            UserError: a value is out of range.
        """
        check_choices(self)
        check_at_least(self, 1, "max_rows", "threads")
        if not self.num_envs or min(self.num_envs) < 1:
            raise UserError(f"num_envs needs numbers of at least 1, got {self.num_envs}")
        if not 0 < self.seconds < float("inf"):
            raise UserError(f"seconds must be positive, got {self.seconds}")
        object.__setattr__(self, "device", resolve_device(self.device))
        check_out_file(self.out)


def exponents(measured: Sequence[Measured]) -> dict[str, float]:
    """Returns the powers of the number of rows with which time and memory grow, where there are two numbers or more."""
    found = {}
    times = {one.rows: one.forecast_ms for one in measured if one.rows >= TIME_FROM}
    peaks = {one.rows: one.peak_mib for one in measured if one.rows >= MEMORY_FROM and one.peak_mib is not None}
    for name, costs in (("time", times), ("memory", peaks)):
        if len(costs) > 1:
            found[name] = exponent({count: max(cost, 1e-3) for count, cost in costs.items()})
    return found


def table(measured: Sequence[Measured]) -> str:
    """Returns the measurements as a Markdown table."""
    headings = ("rows", "steps/s", "forecasts [ms]", "ms per row", "simulator [ms]", "peak memory [MiB]")
    lines = [
        (
            f"{one.rows:,}",
            f"{one.steps_per_s:,.0f}",
            f"{one.forecast_ms:,.1f}",
            f"{one.forecast_ms / one.rows:.3f}",
            f"{one.simulator_ms:,.1f}",
            "–" if one.peak_mib is None else f"{one.peak_mib:,.0f}",
        )
        for one in measured
    ]
    return markdown.table(headings, lines, "r")


def main() -> None:
    """Runs the command."""
    config = parse(RowsConfig, __doc__)
    checkpoint = config.checkpoint or CHECKPOINTS[config.simulator]
    make_run(config.simulator, 1, checkpoint, config.max_rows, config.device)  # what is wrong is said now
    measured = []
    for rows in config.num_envs:
        with WorkerProcess(config.threads) as worker:
            answer = worker.ask(
                "rows",
                simulator=config.simulator,
                rows=rows,
                checkpoint=checkpoint,
                max_rows=config.max_rows,
                seconds=config.seconds,
                device=config.device,
            )
        measured.append(Measured(**answer))
    grows = exponents(measured)
    print(
        f"{config.simulator}, checkpoint {checkpoint}, {config.device}, {processor()}, {config.threads} torch threads"
    )
    print(table(measured))
    for name, power in grows.items():
        print(f"{name} grows with rows to the power {power:.2f}")
    if config.out is not None:
        lines = [asdict(one) for one in measured]
        versions = provenance(("torch", "numpy", "vmas"))
        write_json(config.out, {"rows": lines, "exponents": grows, "provenance": versions})


if __name__ == "__main__":
    run_entry_point(main)
