"""Measures whether a step costs more after a long history: three forecasters with different histories take turns.

All of them see the same scenes. A forecaster whose history has grown by more than a fifth is reset and observes a new
history, which is not timed, so that the lengths hold. The table also shows the cost of encoding the whole history anew.
"""

import time
from functools import partial
from typing import Any

import numpy as np
import torch

from benchmarks.models import forecaster, inference, road, scenes, sized
from benchmarks.results import Line
from benchmarks.settings import Settings
from benchmarks.timing import Meter, ratio_line, timed_line
from predictor.dgvae import DGVAE
from predictor.online import OnlineForecaster
from predictor.scene import SceneBatch

HISTORIES = (10, 100, 1000)
"""Lengths of the histories [steps]."""
ANEW = (10, 100)
"""Lengths of the histories that are encoded anew [steps]."""
BATCH, AGENTS, HORIZON = 8, 12, 5
STEPS_PER_BLOCK = 3
MOST_GROWTH = 1.2
ROUNDS = {"quick": 31, "full": 101}
TOLERANCE = 1.2


class Streamed:
    """Keeps a forecaster near one length of history.

    Args:
        model: model that forecasts.
        history: length of the history [steps].
        stream: scenes to observe, repeated from the start when they end.
    """

    def __init__(self, model: DGVAE, history: int, stream: list[SceneBatch]) -> None:
        """Observes the history."""
        self.history, self.seen = history, 0
        self._online = OnlineForecaster(model, len(stream[0]), stream[0].valid.shape[1])
        self._stream = stream
        self._refill()

    def block(self) -> float:
        """Measures the seconds of one observation and forecast, after one that loads the model into the cache."""
        if self.seen > MOST_GROWTH * self.history:
            self._refill()
        self._step()
        began = time.perf_counter()
        for _ in range(STEPS_PER_BLOCK):
            self._step()
        return (time.perf_counter() - began) / STEPS_PER_BLOCK

    def _refill(self) -> None:
        self._online.reset()
        self.seen = 0
        for _ in range(self.history - 1):
            self._observe()

    def _observe(self) -> None:
        self._online.observe(self._stream[self.seen % len(self._stream)])
        self.seen += 1

    def _step(self) -> None:
        self._observe()
        self._online.forecast()


def run(settings: Settings) -> list[Line]:
    """Measures the cost of a step by history, its ratio, and the cost of encoding the history anew."""
    presets = ("fast",) if settings.quick else ("fast", "paper")
    return [line for preset in presets for line in _measure(preset, settings)]


def _measure(preset: str, settings: Settings) -> list[Line]:
    model = forecaster(sized(preset), road(AGENTS), HORIZON)
    stream = _stream()
    meter = Meter(ROUNDS[settings.mode], budget_s=60.0)
    streamed = {str(h): Streamed(model, h, stream) for h in HISTORIES}
    timings = meter.time_blocks({name: s.block for name, s in streamed.items()})
    what = {"preset": preset, "batch": BATCH, "agents": AGENTS, "horizon": HORIZON}
    lines = [
        timed_line("streaming", "observe + forecast", what | {"history": int(name)}, timing)
        for name, timing in timings.items()
    ]
    short, long = (str(h) for h in (min(HISTORIES), max(HISTORIES)))
    ratios = timings[long].seconds / timings[short].seconds
    base = f"history {short} in the same run"
    name = f"a step after {long} steps / after {short}"
    lines.append(ratio_line("streaming", name, what, ratios, base, tolerance=TOLERANCE))
    return lines + _encoding_anew(model, what, Meter.of(settings))


def _encoding_anew(model: DGVAE, what: dict[str, Any], meter: Meter) -> list[Line]:
    calls = {}
    for steps in ANEW:
        states, valid = scenes(BATCH, AGENTS)
        window = states[:, None].expand(-1, steps, -1, -1).contiguous()
        present = valid[:, None].expand(-1, steps, -1).contiguous()
        last = torch.full((BATCH,), steps - 1)
        calls[steps] = inference(partial(model.window, window, present, last, HORIZON))
    timings = meter.measure({str(steps): call for steps, call in calls.items()})
    note = "training's window path, posterior included"
    return [
        timed_line("streaming", "whole history anew + forecast", what | {"history": int(s)}, timing).noted(note)
        for s, timing in timings.items()
    ]


def _stream(length: int = 64) -> list[SceneBatch]:
    """Returns scenes of agents that all stay and move with constant velocity."""
    states, valid = (tensor.numpy() for tensor in scenes(BATCH, AGENTS))
    ids = np.tile(np.arange(AGENTS), (BATCH, 1))
    move = np.array([1.0, 0.0, 0.0, 0.0])
    heading = np.zeros(BATCH)
    return [SceneBatch(states.astype(np.float64) + t * move, ids, valid, heading) for t in range(length)]
