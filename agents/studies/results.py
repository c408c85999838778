"""Results of cells on disk: one JSON file per cell, whole or absent, and the tidy Parquet tables of all of them."""

import hashlib
import importlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from predictor.support.errors import UserError
from predictor.support.files import finite, new_file, write_json
from predictor.support.reading import MIB, damage_in, read_object
from predictor.support.typed_values import from_table

RESULT_FILE = "result.json"
EPISODES_FILE, CURVES_FILE = "episodes.parquet", "curves.parquet"
MOST_BYTES = 1024 * MIB
"""Largest size of a result."""
_DIGEST = "sha256"
MEASURED_ANEW = (
    "delete this file and run the same command again: all other cells are kept, and this one is measured anew"
)
"""What to do with a damaged result while a study runs."""
_RENAMED = {"seed": "episode_seed", "episode_return": "return"}
"""Field of an episode → its column, where the name alone would be misread."""


@dataclass(frozen=True)
class Result:
    """What a cell found."""

    scenario: str
    """Name of the scenario."""
    env_id: str
    """Gymnasium or PettingZoo id."""
    arm: str
    """Name of the arm, or of the driver."""
    algorithm: str | None
    """Learning algorithm; None for a driver."""
    seed: int | None
    """Training seed; None for a driver."""
    episodes: tuple[dict[str, Any], ...]
    """Fields of `EpisodeResult` of every test episode."""
    curve: tuple[dict[str, Any], ...]
    """Measurements in training; none for a driver."""
    train_seconds: float
    """Time that was learned, without measurements [s]."""
    measure_seconds: float
    """Time of the test episodes [s]."""
    provenance: dict[str, Any]
    """Command, commit, versions, time."""
    settings: dict[str, Any] | None = None
    """What the study's file said of the cell (`Study.settings_of`); None in results of earlier versions."""


def write_result(path: Path, result: Result) -> None:
    """Writes a result with a hash of its content; NaN becomes None."""
    content = json.loads(json.dumps(finite(asdict(result)), default=str))
    write_json(path, content | {_DIGEST: _digest(content)})


def read_result(path: Path, advice: str = MEASURED_ANEW) -> Result:
    """Reads a result.

    Args:
        path: path of the file.
        advice: what to do if it is damaged, for the message.

    Raises:
        UserError: the file is damaged; the message says what to do.
    """
    try:
        content = read_object(path, MOST_BYTES)
        if content.pop(_DIGEST, None) != _digest(content):
            raise UserError(f"its content does not have the hash ({_DIGEST}) that it was written with")
        return from_table(Result, content, "its content")
    except UserError as error:
        raise UserError(f"{path} is damaged ({damage_in(path, error)}); {advice}") from error


def write_tables(folder: Path, results: Sequence[Result]) -> None:
    """Writes a line per test episode and a line per measurement in training, of all results, as Parquet."""
    _write_parquet(folder / EPISODES_FILE, [_labels(r) | _columns(e) for r in results for e in r.episodes])
    curves = [_labels(r) | point for r in results for point in r.curve]
    _write_parquet(folder / CURVES_FILE, curves)


def _labels(result: Result) -> dict[str, Any]:
    return {
        "scenario": result.scenario,
        "env_id": result.env_id,
        "arm": result.arm,
        "algorithm": result.algorithm,
        "seed": result.seed,
    }


def _columns(episode: dict[str, Any]) -> dict[str, Any]:
    """Returns the columns of an episode; what has several values is written as JSON."""
    return {
        _RENAMED.get(key, key): json.dumps(value, sort_keys=True) if isinstance(value, dict | list) else value
        for key, value in episode.items()
    }


def _write_parquet(path: Path, lines: Sequence[dict[str, Any]]) -> None:
    arrow: Any = importlib.import_module("pyarrow")
    parquet: Any = importlib.import_module("pyarrow.parquet")
    names = list(dict.fromkeys(name for line in lines for name in line))
    columns = {name: [line.get(name) for line in lines] for name in names}
    with new_file(path) as partial:
        parquet.write_table(arrow.table(columns), partial)


def _digest(content: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
