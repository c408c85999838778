"""Reads and writes the accuracy of a checkpoint in live environments, `in_env.json` beside its weights.

`python -m envs.evaluate` writes accuracy.json; `python -m predictor.card` copies the values of the tables from it into
the record. The cards and the tables of README.md and docs/in_env.md are written from the records alone.
"""

import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from predictor.support.errors import UserError
from predictor.support.files import write_json
from predictor.support.reading import read_object
from predictor.support.typed_values import from_table

FILE_NAME = "in_env.json"

Interval = tuple[float, float]


@dataclass(frozen=True)
class Control:
    """What a control reached with as many samples."""

    best_of_k_m: float
    """Best of K [m]."""
    joint_best_of_k_m: float
    """Best of K scenes, all agents together [m]."""
    energy_m: float
    """Energy score [m]."""
    coverage: float | None
    """Share of truths within the central 90 % of the samples, all steps together."""


@dataclass(frozen=True)
class Measurement:
    """Accuracy in one environment, with one driver and one number of samples; None where it was not measured."""

    env_id: str
    """Id of the environment, with its arguments where it had some."""
    driver: str
    """Name of the driver."""
    episodes: int
    """Number of episodes."""
    samples: int
    """K of `best_of_k_m`."""
    command: str
    """Command that measured it."""
    commit: str
    """Commit at which it was measured, or the first and the last that it may have been; empty if not recorded."""
    constant_velocity_ade_m: float | None = None
    """ADE of constant velocity on the same scenes [m]."""
    constant_velocity_fde_m: float | None = None
    """FDE of constant velocity [m]."""
    min_ade_m: float | None = None
    """ADE of the single forecast (K = 1) [m]."""
    min_ade_interval_m: Interval | None = None
    """95 % bootstrap interval of `min_ade_m` over episodes [m]."""
    min_fde_m: float | None = None
    """FDE of the single forecast [m]."""
    best_of_k_m: float | None = None
    """minADE of the best of K samples [m]."""
    best_of_k_interval_m: Interval | None = None
    """95 % bootstrap interval of `best_of_k_m` over episodes [m]."""
    joint_best_of_k_m: float | None = None
    """Joint minADE: of the best of K scenes [m]."""
    joint_best_of_k_interval_m: Interval | None = None
    """95 % bootstrap interval of `joint_best_of_k_m` over episodes [m]."""
    energy_m: float | None = None
    """Energy score of K samples [m]."""
    energy_interval_m: Interval | None = None
    """95 % bootstrap interval of `energy_m` over episodes [m]."""
    coverage: Interval | None = None
    """Smallest and largest share of truths within the central 90 % of the samples, over the steps."""
    mixture_coverage: Interval | None = None
    """Smallest and largest share of true coordinates within the central 90 % of the predicted mixture, over the
    steps; None for a checkpoint without scales."""
    spread_commit: str | None = None
    """Commit at which `mixture_coverage` was measured, if it was later, after the spread alone was trained."""
    overlap: tuple[float, float] | None = None
    """Share of agents' steps nearer to another agent than the miss threshold, in samples and in truth."""
    controls: dict[str, Control] | None = None
    """Figures of each control at the same K, by its name."""
    one_step_m: float | None = None
    """ADE (K = 1) with a memory of one step [m]."""
    one_step_interval_m: Interval | None = None
    """95 % bootstrap interval of `one_step_m` over episodes [m]."""
    neighbours_m: float | None = None
    """ADE of nearest neighbours, fitted to the checkpoint's training data [m]."""
    below_cv: float | None = None
    """1 − `min_ade_m` / `constant_velocity_ade_m`."""
    below_cv_interval: Interval | None = None
    """95 % bootstrap interval of `below_cv` over episodes."""
    latency_ms: Interval | None = None
    """Median and 95th percentile of the time of one forecast [ms]."""
    forecasts: int | None = None
    """Number of forecasts behind `min_ade_m`."""
    horizon_steps: int | None = None
    """Number of forecast steps."""
    dt_s: float | None = None
    """Length of a step [s]."""
    note: str = ""
    """Remark that the number needs; printed under the tables."""

    @property
    def key(self) -> tuple[str, str, int]:
        """Environment, driver and number of samples; a later measurement with this key replaces this one."""
        return self.env_id, self.driver, self.samples


@dataclass(frozen=True)
class _Record:
    """Content of the file."""

    measurements: tuple[Measurement, ...]
    """Measurements, in the order of the tables."""


def measurements_of(accuracy: dict[str, Any], checkpoint: str) -> list[Measurement]:
    """Returns the measurements of a checkpoint in the content of an accuracy.json of `envs.evaluate`.

    Raises:
        KeyError, TypeError, AttributeError, UserError: the content is not of such a file.
    """
    results = [result for result in accuracy["results"] if result["checkpoint"] == checkpoint]
    found = [_measurement(result, accuracy["config"], accuracy["provenance"]) for result in results]
    return [from_table(Measurement, asdict(measurement), checkpoint) for measurement in found]


def read_record(folder: Path) -> list[Measurement]:
    """Reads `in_env.json` of a checkpoint's folder; empty if there is no such file.

    Raises:
        UserError: the file is not a record.
    """
    path = folder / FILE_NAME
    if not os.path.lexists(path):
        return []
    try:
        content = from_table(_Record, read_object(path), str(path))
    except UserError as error:
        raise UserError(
            f"{path} is not a record of measurements ({error}); write it with python -m predictor.card"
        ) from error
    return list(content.measurements)


def updated(recorded: Sequence[Measurement], found: Sequence[Measurement]) -> list[Measurement]:
    """Returns a record with measurements in place of those with the same key, whose remarks they get."""
    new = {measurement.key: measurement for measurement in found}
    kept = [replace(new.pop(old.key), note=old.note) if old.key in new else old for old in recorded]
    return [*kept, *new.values()]


def write_record(folder: Path, measurements: Sequence[Measurement]) -> None:
    """Writes `in_env.json` of a checkpoint's folder."""
    entries = [{k: v for k, v in asdict(m).items() if v is not None and (k, v) != ("note", "")} for m in measurements]
    write_json(folder / FILE_NAME, {"measurements": entries})


def _measurement(result: dict[str, Any], config: dict[str, Any], made: dict[str, Any]) -> Measurement:
    one, straight = result["model"], result["constant_velocity"]
    short = (result.get("histories") or {}).get("1") or {}
    controls = result.get("controls") or {}
    near = controls.get("nearest neighbours") or {}
    median_ms, p95_ms = result.get("latency_median_ms"), result.get("latency_p95_ms")
    return Measurement(
        env_id=" ".join(filter(None, (result["env_id"], result.get("env_kwargs")))),
        driver=result["driver"],
        episodes=config["episodes"],
        samples=config["num_samples"],
        command=made["command"],
        commit=made.get("commit") or "",
        constant_velocity_ade_m=straight["min_ade_m"],
        constant_velocity_fde_m=straight["min_fde_m"],
        min_ade_m=one["min_ade_m"],
        min_ade_interval_m=_frozen((one.get("intervals") or {}).get("min_ade_m")),
        min_fde_m=one["min_fde_m"],
        **_of_samples(result),
        one_step_m=short.get("min_ade_m"),
        one_step_interval_m=_frozen((short.get("intervals") or {}).get("min_ade_m")),
        neighbours_m=near.get("ade_m", near.get("min_ade_m")),
        below_cv=result["reduction"],
        below_cv_interval=_frozen(result["reduction_interval"]),
        latency_ms=None if median_ms is None or p95_ms is None else (median_ms, p95_ms),
        forecasts=one.get("agents"),
        horizon_steps=len(one["by_step_m"]) if one.get("by_step_m") else None,
        dt_s=result.get("dt_s"),
    )


def _of_samples(result: dict[str, Any]) -> dict[str, Any]:
    """Returns the figures of K samples, and those of the controls."""
    many = result["model_samples"]
    intervals = many.get("intervals") or {}
    found: dict[str, Any] = {"best_of_k_m": many["min_ade_m"]}
    for name, key in (("best_of_k", "min_ade_m"), ("joint_best_of_k", "min_joint_ade_m"), ("energy", "energy_m")):
        found[f"{name}_m"] = many[key]
        found[f"{name}_interval_m"] = _frozen(intervals.get(key))
    for figure in ("coverage", "mixture_coverage"):
        covered = [c for c in many.get(figure) or [] if c is not None]
        found[figure] = (min(covered), max(covered)) if covered else None
    overlap = many["overlap"], many["true_overlap"]
    found["overlap"] = None if None in overlap else overlap
    found["controls"] = {
        key: Control(
            one["min_ade_m"],
            one["min_joint_ade_m"],
            one["energy_m"],
            (one["statistics"].get("coverage") or {}).get("mean"),
        )
        for key, one in (result.get("controls") or {}).items()
    } or None
    return found


def _frozen(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value
