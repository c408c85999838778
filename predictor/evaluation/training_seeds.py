"""Joins the results of one line under several training seeds: their mean, and the range of each number."""

from collections.abc import Sequence
from typing import Any


def joined(results: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Returns one result: the mean of every number, summed times, and the results themselves as `runs`.

    A number that a run does not have has no mean. Where all runs agree, and in texts, the first run's value stays.

        >>> row = joined([{"seed": 0, "train_seconds": 2.0, "a": [1.0]}, {"seed": 1, "train_seconds": 3.0, "a": [2.0]}])
        >>> row["a"], row["train_seconds"], row["seeds"]
        ([1.5], 5.0, [0, 1])
    """
    times = {key: sum(r[key] for r in results) for key in ("train_seconds", "measure_seconds") if key in results[0]}
    return _mean(results) | times | {"seeds": [r["seed"] for r in results], "runs": list(results)}


def limits(row: dict[str, Any], *path: str) -> tuple[float, float] | None:
    """Returns the smallest and the largest value of a number over the runs of a line; None for a single run.

    Args:
        row: line of a table, by `joined`.
        path: keys that lead to the number in each run.
    """
    if len(row["runs"]) < 2:
        return None
    found = [_at(run, path) for run in row["runs"]]
    known = [value for value in found if value is not None]
    return (min(known), max(known)) if len(known) == len(found) else None


def _at(run: Any, path: Sequence[str]) -> Any:
    for key in path:
        run = None if run is None else run.get(key)
    return run


def _mean(values: Sequence[Any]) -> Any:
    first = values[0]
    if any(v is None for v in values):
        return None
    if isinstance(first, dict):
        shared = {key: [v[key] for v in values] for key in first if all(key in v for v in values)}
        return {key: parts[0] if key == "permutation" else _mean(parts) for key, parts in shared.items()}
    if isinstance(first, list | tuple) and all(len(v) == len(first) for v in values):
        return [_mean(parts) for parts in zip(*values, strict=True)]
    if isinstance(first, int | float) and not isinstance(first, bool) and any(v != first for v in values):
        return sum(values) / len(values)
    return first
