import json
from pathlib import Path

import pyarrow.parquet as parquet
import pytest

from agents.studies.results import read_result, write_result, write_tables
from predictor.support.errors import UserError
from tests.agents.studies.helpers import result


def test_a_result_is_read_as_it_was_written(tmp_path: Path):
    written = result("none", [1.5, 2.5], seed=3)
    write_result(tmp_path / "result.json", written)
    assert read_result(tmp_path / "result.json") == written


def test_what_is_not_reported_is_none(tmp_path: Path):
    episodes = ({"seed": 0, "episode_return": 1.0, "mean_speed_mps": float("nan")},)
    write_result(tmp_path / "result.json", result("none", [1.0], episodes=episodes))
    assert read_result(tmp_path / "result.json").episodes[0]["mean_speed_mps"] is None


@pytest.mark.parametrize("damage", ["half", "empty", "edited", "field", "list"])
def test_a_damaged_result_is_named_with_what_to_do(damage: str, tmp_path: Path):
    path = tmp_path / "result.json"
    write_result(path, result("none", [1.5, 2.5], seed=3))
    text = path.read_text()
    content = json.loads(text)
    damaged = {
        "half": text[: len(text) // 2],
        "empty": "",
        "edited": text.replace("2.5", "9.5"),
        "field": json.dumps({key: value for key, value in content.items() if key != "episodes"}),
        "list": "[1]",
    }
    path.write_text(damaged[damage])
    message = r"^\S+result.json is damaged \(.*\); delete this file and run the same command again: all other cells are"
    with pytest.raises(UserError, match=message) as error:
        read_result(path)
    assert "\n" not in str(error.value)


def test_tables_have_a_line_per_episode_and_per_measurement(tmp_path: Path):
    results = [result("none", [1.0, 2.0, 3.0], seed=s) for s in (0, 1)] + [result("idle", [5.0])]
    write_tables(tmp_path, results)
    episodes = parquet.read_table(tmp_path / "episodes.parquet").to_pylist()
    assert len(episodes) == 7
    assert episodes[4] == {
        "scenario": "one", "env_id": "toy-v0", "arm": "none", "algorithm": "ppo", "seed": 1, "episode_seed": 1,
        "return": 2.0, "length": 10, "crashed": False, "mean_speed_mps": 20.0,
        "action_counts": '{"faster": 1, "slower": 1}',
    }  # fmt: skip
    assert (episodes[-1]["arm"], episodes[-1]["algorithm"], episodes[-1]["seed"]) == ("idle", None, None)
    curves = parquet.read_table(tmp_path / "curves.parquet").to_pylist()
    assert [(c["seed"], c["steps"], c["return"]) for c in curves] == [
        (s, t, r) for s in (0, 1) for t, r in ((100, 1.0), (200, 3.0))
    ]
