"""The file ``episodes.parquet``: one line for each policy and seed, for notebooks and statistics.

Columns are the fields of `EpisodeResult`, those of its driving measures, ``returns.ROLE`` and ``actions.NAME``. What an
environment does not report is null. Parquet needs pyarrow, which is optional.
"""

import importlib.util
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

from agents.vec_envs import EpisodeResult
from envs.rollouts.driving_measures import DrivingMeasures
from predictor.support.files import new_file

EPISODE_FILE = "episodes.parquet"
NO_PYARROW = f"no {EPISODE_FILE}: it needs pyarrow; pip install 'dgvae-rl[study]'"
_TYPES: dict[str, str] = {
    "policy": "string",
    "seed": "int64",
    "length": "int64",
    "crashed": "bool_",
    "success": "bool_",
    "lane_changes": "int64",
}
"""Name of pyarrow's function for the type of each column that is not a number with a fraction."""
_NESTED = ("returns_by_role", "action_counts", "driving")


def has_pyarrow() -> bool:
    """Returns whether pyarrow is installed."""
    return importlib.util.find_spec("pyarrow") is not None


def write_episodes(folder: Path, results: Mapping[str, Sequence[EpisodeResult]]) -> None:
    """Writes the episodes of all policies; without pyarrow, deletes the file of an earlier evaluation instead.

    Args:
        folder: folder of ``episodes.parquet``.
        results: results of the episodes, by policy.
    """
    path = folder / EPISODE_FILE
    if not has_pyarrow():
        path.unlink(missing_ok=True)
        return
    import pyarrow
    import pyarrow.parquet

    columns = {
        name: pyarrow.array(values, getattr(pyarrow, _type_of(name))(), from_pandas=True)  # NaN becomes null
        for name, values in episode_columns(results).items()
    }
    with new_file(path) as partial:
        pyarrow.parquet.write_table(pyarrow.table(columns), partial)


def episode_columns(results: Mapping[str, Sequence[EpisodeResult]]) -> dict[str, list[Any]]:
    """Returns the values of each column, one for each policy and episode."""
    lines = [(policy, episode) for policy, episodes in results.items() for episode in episodes]
    columns: dict[str, list[Any]] = {"policy": [policy for policy, _ in lines]}
    for field in fields(EpisodeResult):
        if field.name not in _NESTED:
            columns[field.name] = [getattr(episode, field.name) for _, episode in lines]
    for field in fields(DrivingMeasures):
        columns[field.name] = [None if e.driving is None else getattr(e.driving, field.name) for _, e in lines]
    for role in sorted({role for _, episode in lines for role in episode.returns_by_role}):
        columns[f"returns.{role}"] = [episode.returns_by_role.get(role) for _, episode in lines]
    for action in sorted({action for _, episode in lines for action in episode.action_counts}):
        counts = [episode.action_counts for _, episode in lines]
        columns[f"actions.{action}"] = [taken.get(action, 0) if taken else None for taken in counts]
    return columns


def _type_of(column: str) -> str:
    """Returns the name of the pyarrow function that makes a column's type."""
    return "int64" if column.startswith("actions.") else _TYPES.get(column, "float64")
