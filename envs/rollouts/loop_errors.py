"""Error of the forecasts that a policy acts on, while it acts: measured as the truth arrives, without a recording."""

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray

from predictor.scene import Forecast, SceneBatch


@dataclass(frozen=True)
class _Pending:
    """Forecasts of all environments at one step, whose truth has not arrived yet."""

    forecast_xy: Float[np.ndarray, "envs others horizon 2"]
    constant_xy: Float[np.ndarray, "envs others horizon 2"]
    ids: Int[np.ndarray, "envs others"]
    running: Bool[np.ndarray, " envs"]


class LoopErrors:
    """Compares each forecast with what then happens, up to the end of its episode.

    The single forecast of every other agent counts, at each step of the horizon at which the agent is seen again.
    Beside it stands constant velocity from the same scenes.

    Args:
        horizon_steps: number of steps of a forecast.
        dt_s: time of one step [s].
    """

    def __init__(self, horizon_steps: int, dt_s: float) -> None:
        """Starts with no forecasts."""
        self._pending: deque[_Pending] = deque(maxlen=horizon_steps)
        self._times_s = dt_s * np.arange(1, horizon_steps + 1)
        self._sums_m = np.zeros((2, horizon_steps))
        self._counts: NDArray[np.int64] = np.zeros(horizon_steps, dtype=np.int64)

    def sums(self) -> dict[str, list[Any]]:
        """Returns what was compared since the last call of `errors_m`, as content of JSON."""
        return {"sums_m": self._sums_m.tolist(), "counts": self._counts.tolist()}

    def go_on(self, sums: Mapping[str, list[Any]]) -> None:
        """Takes in what `sums` returned; what it compared counts, too."""
        self._sums_m += np.asarray(sums["sums_m"])
        self._counts += np.asarray(sums["counts"])

    def drop_pending(self) -> None:
        """Forgets the forecasts whose truth has not arrived yet: all environments were reset."""
        self._pending.clear()

    def add(self, seen: SceneBatch, ended: Bool[np.ndarray, " envs"], scenes: SceneBatch, forecast: Forecast) -> None:
        """Takes in one step of all environments.

        Args:
            seen: scene of each environment after the step, of an ended episode its last.
            ended: whether the episode ended with the step.
            scenes: the same scenes, but of an ended episode its successor's first.
            forecast: forecast of `scenes`, positions relative to each scene's ego.
        """
        for back, pending in enumerate(reversed(self._pending)):
            self._compare(pending, seen, back)
            pending.running[ended] = False
        velocity = scenes.states[:, 1:, None, 2:4]
        constant = scenes.states[:, 1:, None, :2] + velocity * self._times_s[:, None]
        single = scenes.states[:, :1, None, :2] + forecast.xy[:, 0, 1:].cpu().numpy()
        ids = np.where(scenes.valid, scenes.ids, -1)[:, 1:]
        self._pending.append(_Pending(single, constant, ids, np.ones(len(seen), dtype=bool)))

    def errors_m(self) -> tuple[float, float] | None:
        """Returns the mean errors of forecast and constant velocity since the last call; None if nothing was compared.

        Each step of the horizon has the same weight, however many agents were seen at it.
        """
        counted = self._counts > 0
        if not counted.any():
            return None
        ours, constant = (self._sums_m[:, counted] / self._counts[counted]).mean(axis=1)
        self._sums_m[:], self._counts[:] = 0.0, 0
        return float(ours), float(constant)

    def _compare(self, pending: _Pending, seen: SceneBatch, step: int) -> None:
        """Adds the errors of one earlier step's forecasts at one step of their horizon."""
        ids = np.where(seen.valid, seen.ids, -1)
        same = (pending.ids[:, :, None] == ids[:, None, :]) & (pending.ids >= 0)[:, :, None]
        env, agent, place = (same & pending.running[:, None, None]).nonzero()
        truth = seen.states[env, place, :2]
        for row, xy in enumerate((pending.forecast_xy, pending.constant_xy)):
            self._sums_m[row, step] += np.linalg.norm(xy[env, agent, step] - truth, axis=-1).sum()
        self._counts[step] += len(env)
