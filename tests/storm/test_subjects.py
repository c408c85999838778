"""What storms compare: results, without what differs between equal runs."""

import json
from pathlib import Path

from tests.storm.subjects import SUBJECTS, differs


def table(seconds: float, error: float) -> str:
    test = {"by_step_m": [error], "seconds": seconds, "peak_memory_mb": 400.0 + seconds}
    run = {
        "train_seconds": seconds,
        "measure_seconds": seconds,
        "provenance": {"time": seconds},
        "tests": {"test": test},
    }
    return json.dumps({"failed": [], "rows": [{"key": "lstm", "tests": {"test": test}, "runs": [run]}]})


def found(folder: Path, seconds: float, error: float) -> dict:
    file = folder / "suite" / "springs-smoke" / "table.json"
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(table(seconds, error))
    return dict(SUBJECTS["suite"].results(folder))


def test_times_and_memory_make_no_difference_but_errors_do(tmp_path: Path):
    expected = found(tmp_path, 1.0, 0.5)
    assert not differs("suite", found(tmp_path, 2.0, 0.5), expected)
    assert differs("suite", found(tmp_path, 1.0, 0.5001), expected)
    assert differs("suite", {}, expected)
