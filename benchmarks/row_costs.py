"""Costs of a step of many environments at once: what `benchmarks.rows` measures, in a process of its own."""

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
import torch

from benchmarks.tensor_traffic import TensorTraffic, spec
from envs.observation import ForecastStream
from envs.readers.batched import TensorReader
from envs.readers.vmas import VmasReader
from envs.scene_stream import ForecastConfig, SceneStream
from predictor.checkpoint import load_forecaster
from predictor.support.errors import UserError

Simulator = Literal["traffic", "vmas"]
AGENTS = 12
"""Number of entries of a row of tensor traffic, the ego included."""
WARM_UP, LEAST_STEPS = 2, 3


@dataclass(frozen=True)
class Measured:
    """Cost of a step for a number of rows."""

    rows: int
    """Number of environments."""
    forecast_ms: float
    """Median time to read, forecast and make entries [ms]."""
    simulator_ms: float
    """Median time of the simulator [ms]."""
    peak_mib: float | None
    """Highest rise of memory, from before anything was made to the end [MiB]; None where it cannot be measured."""

    @property
    def steps_per_s(self) -> float:
        """Environment steps per second, simulator included."""
        return 1e3 * self.rows / (self.forecast_ms + self.simulator_ms)


def make_run(
    simulator: Simulator, rows: int, checkpoint: str, max_rows: int, device: str
) -> tuple[Callable[[], None], Callable[[], Any]]:
    """Makes environments and a stream; returns functions that step the one and forecast with the other.

    Raises:
        UserError: VMAS is not installed, or the checkpoint does not fit.
    """
    config = ForecastConfig(device=device, max_rows=max_rows)
    envs = np.arange(rows)
    if simulator == "traffic":
        traffic, road = TensorTraffic(rows, AGENTS), TensorReader(spec(AGENTS))
        stream = ForecastStream(
            load_forecaster(checkpoint, road.spec, "tensor traffic", device), road.spec, rows, config
        )

        def observe() -> Any:
            stream.reset(np.flatnonzero(traffic.begun.numpy()))
            return stream.observe(road.read(traffic.agents, envs))

        return traffic.step, observe
    try:
        import vmas
    except ImportError as error:
        raise UserError(f"--simulator vmas needs VMAS ({error}); pip install vmas") from error
    env = vmas.make_env("simple_spread", num_envs=rows, device="cpu", continuous_actions=True, seed=0)
    env.reset()
    reader = VmasReader(env)
    worlds = SceneStream(
        load_forecaster(checkpoint, reader.spec, "VMAS's simple_spread", device), reader.spec, rows, config
    )
    return lambda: env.step([env.get_random_action(agent) for agent in env.agents]), lambda: worlds.take(
        reader.read(env, envs)
    )


class RowCosts:
    """Steps one number of rows.

    Args:
        simulator: what steps.
        rows: number of rows.
        checkpoint: forecaster.
        max_rows: largest number of rows in one call of the forecaster.
        seconds: time of the measurement [s]; at least `LEAST_STEPS` steps are timed.
        device: device of the forecaster.
    """

    def __init__(
        self, simulator: Simulator, rows: int, checkpoint: str, max_rows: int, seconds: float, device: str
    ) -> None:
        """Loads kernels with a run of two rows."""
        self._simulator, self._rows, self._seconds = simulator, rows, seconds
        self._rest = checkpoint, max_rows, device
        self._on_gpu = device.startswith("cuda")
        self._times: list[tuple[float, float]] = []
        step, observe = make_run(simulator, 2, *self._rest)
        step(), observe()
        if self._on_gpu:
            torch.cuda.reset_peak_memory_stats()

    def run(self) -> None:
        """Makes environments and a stream, and times their steps."""
        cpu_clock = time.process_time if torch.get_num_threads() == 1 else time.perf_counter
        clock = self._gpu_clock if self._on_gpu else cpu_clock
        step, observe = make_run(self._simulator, self._rows, *self._rest)
        for _ in range(WARM_UP):
            step(), observe()
        until = time.perf_counter() + self._seconds
        while len(self._times) < LEAST_STEPS or time.perf_counter() < until:
            began = clock()
            step()
            between = clock()
            observe()
            self._times.append((between - began, clock() - between))

    @staticmethod
    def _gpu_clock() -> float:
        """Returns the time at which all that was queued on the GPU is done [s]."""
        torch.cuda.synchronize()
        return time.perf_counter()

    def found(self, rise: int | None) -> dict[str, Any]:
        """Returns `Measured` as JSON values, from the rise of this process's memory [bytes]; of a GPU from its own."""
        peak = torch.cuda.max_memory_allocated() if self._on_gpu else rise
        simulated, forecast = (1e3 * float(np.median(of)) for of in zip(*self._times, strict=True))
        return asdict(Measured(self._rows, forecast, simulated, None if peak is None else peak / 2**20))
