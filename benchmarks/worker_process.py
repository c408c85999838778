"""Worker process for measurements that need a process of their own: allocator settings and peak memory.

`WorkerProcess(...).ask("training", preset="fast", …)` sends one line of JSON and receives one line back.
"""

import contextlib
import gc
import json
import os
import subprocess
import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import TracebackType
from typing import Any

from predictor.support.runtime import prefer_onednn

_MALLOC = "MALLOC_"


def exact_memory() -> dict[str, str]:
    """Returns environment variables that make glibc release larger blocks at once: resident memory is memory in use."""
    return {"MALLOC_MMAP_THRESHOLD_": "65536", "MALLOC_TRIM_THRESHOLD_": "65536", "MALLOC_TOP_PAD_": "0"}


class WorkerProcess:
    """Process that answers requests until its `with` block ends; glibc's allocator has its default settings.

    Args:
        threads: number of torch threads.
        environment: environment variables to add.
    """

    def __init__(self, threads: int, environment: Mapping[str, str] | None = None) -> None:
        """Starts the process."""
        root = str(Path(__file__).resolve().parents[1])
        clean = {name: value for name, value in os.environ.items() if not name.startswith(_MALLOC)}
        path = os.pathsep.join([root, *filter(None, [clean.get("PYTHONPATH")])])
        self._process = subprocess.Popen(
            [sys.executable, "-m", "benchmarks.worker_process", str(threads)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=clean | {"PYTHONPATH": path} | dict(environment or {}),
            cwd=root,
            text=True,
        )

    def ask(self, task: str, **arguments: Any) -> dict[str, Any]:
        """Runs a task of `TASKS` in the process and returns its answer.

        Raises:
            RuntimeError: the process died or the task failed.
        """
        streams = self._process
        assert streams.stdin is not None and streams.stdout is not None
        with contextlib.suppress(BrokenPipeError):  # then there is no answer either
            streams.stdin.write(json.dumps({"task": task, "arguments": arguments}) + "\n")
            streams.stdin.flush()
        line = streams.stdout.readline()
        answer: dict[str, Any] = json.loads(line) if line else {"error": f"it died with {streams.wait()}"}
        if "error" in answer:
            raise RuntimeError(f"{task} {arguments} in a process of its own: {answer['error']}")
        return answer

    def __enter__(self) -> "WorkerProcess":
        """Returns itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Ends the process."""
        if self._process.stdin is not None:
            with contextlib.suppress(BrokenPipeError):
                self._process.stdin.close()
        if error is not None:
            self._process.terminate()
        self._process.wait()
        if self._process.stdout is not None:
            self._process.stdout.close()


def peak_rise(call: Callable[[], Any]) -> int | None:
    """Measures the highest rise of this process's resident memory during a call [bytes]; None where /proc lacks it."""
    gc.collect()
    try:
        Path("/proc/self/clear_refs").write_text("5")  # resets the peak
        before = _status_bytes("VmRSS")
        kept = call()  # the result is kept until the peak is read
        peak = _status_bytes("VmHWM")
    except OSError:
        return None
    del kept
    return peak - before


def _status_bytes(name: str) -> int:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(f"{name}:"):
            return int(line.split()[1]) * 1024
    raise OSError(f"no {name} here")


@cache
def _training_step(preset: str, agents: int, steps: int, batch: int, rollout: int) -> Any:
    from benchmarks.models import TrainingStep, sized

    step = TrainingStep(sized(preset), agents, steps, batch, rollout)
    step()
    return step


def training(preset: str, agents: int, steps: int, batch: int, rollout: int) -> dict[str, Any]:
    """Measures seconds and peak memory of one training step."""
    step = _training_step(preset, agents, steps, batch, rollout)
    seconds: list[float] = []
    peak = peak_rise(lambda: seconds.append(step.timed()))
    return {"seconds": seconds[-1] if seconds else step.timed(), "peak_bytes": peak}


def forecast(preset: str, agents: int, neighbours: int, horizon: int) -> dict[str, Any]:
    """Measures the peak memory of observing a scene and forecasting it, memory and belief included."""
    import torch

    from benchmarks.models import forecaster, road, scenes, sized

    config = replace(sized(preset), num_neighbours=neighbours)

    def look(count: int) -> Any:
        model = forecaster(config, road(count), horizon)
        states, valid = scenes(1, count)
        with torch.inference_mode():
            memory, belief = model.observe(model.empty_memory(1, count), states, valid)
            return memory, belief, model.rollout(belief, horizon).states

    look(4)  # loads kernels and starts threads
    return {"peak_bytes": peak_rise(lambda: look(agents))}


def rows(**arguments: Any) -> dict[str, Any]:
    """Measures forecasts for many environments at once (`benchmarks.rows`)."""
    from benchmarks.row_costs import RowCosts

    costs = RowCosts(**arguments)
    return costs.found(peak_rise(costs.run))


TASKS: dict[str, Callable[..., dict[str, Any]]] = {"training": training, "forecast": forecast, "rows": rows}
"""Tasks of a worker, by name."""


def main() -> None:
    """Answers requests until the input ends; products are computed by the library that the parent takes."""
    import torch

    torch.set_num_threads(int(sys.argv[1]))
    prefer_onednn()
    for line in sys.stdin:
        request = json.loads(line)
        try:
            answer = TASKS[request["task"]](**request["arguments"])
        except Exception as error:  # the parent process reports it, whatever it is
            answer = {"error": f"{type(error).__name__}: {error}"}
        print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    main()
