import json
import math
from dataclasses import replace
from pathlib import Path

import pytest

from agents.episode_file import EPISODE_FILE, episode_columns, has_pyarrow, write_episodes
from agents.evaluate import show
from agents.results import Evaluation
from agents.vec_envs import EpisodeResult
from envs.rollouts.driving_measures import DrivingMeasures
from tests.agents.helpers import EPISODES

DRIVEN = [
    replace(
        EPISODES[0],
        success=True,
        driving=DrivingMeasures(30.0, 0.1, 4, 1.25, 2.5, 0.5, None),
        action_counts={"slower": 29, "idle": 1},
    ),
    replace(EPISODES[1], success=False, action_counts={"faster": 12}),
]
HERD = EpisodeResult(7, 2.5, 5, None, math.nan, {"ant": 1.0, "bee": 4.0})


def test_a_line_for_each_policy_and_seed(tmp_path: Path):
    parquet = pytest.importorskip("pyarrow.parquet")
    write_episodes(tmp_path, {"ppo": DRIVEN, "herd": [HERD]})
    table = parquet.read_table(tmp_path / EPISODE_FILE)
    assert table.column_names == [
        "policy", "seed", "episode_return", "length", "crashed", "mean_speed_mps", "success", "time_s",
        "off_road_share", "lane_changes", "min_time_to_contact_s", "low_time_to_contact_s", "hard_brake_share",
        "jerk_rms_mps3", "returns.ant", "returns.bee", "actions.faster", "actions.idle", "actions.slower",
    ]  # fmt: skip
    first, second, third = table.to_pylist()
    assert (first["policy"], first["seed"], first["episode_return"], first["lane_changes"]) == ("ppo", 10, 20.0, 4)
    assert [first[f"actions.{name}"] for name in ("slower", "idle", "faster")] == [29, 1, 0]
    assert (first["crashed"], first["success"], first["jerk_rms_mps3"]) == (False, True, None)
    assert (second["seed"], second["crashed"], second["time_s"], second["actions.faster"]) == (11, True, None, 12)
    assert (third["policy"], third["returns.bee"], third["mean_speed_mps"]) == ("herd", 4.0, None)
    assert (third["crashed"], third["actions.slower"]) == (None, None)
    assert {str(table.schema.field(name).type) for name in ("seed", "length", "lane_changes", "actions.idle")} == {
        "int64"
    }
    assert {str(table.schema.field(name).type) for name in ("crashed", "success")} == {"bool"}


def test_columns_keep_their_types_where_nothing_is_reported(tmp_path: Path):
    parquet = pytest.importorskip("pyarrow.parquet")
    write_episodes(tmp_path, {"herd": [HERD]})
    schema = parquet.read_table(tmp_path / EPISODE_FILE).schema
    assert (str(schema.field("crashed").type), str(schema.field("time_s").type)) == ("bool", "double")


def test_every_field_of_a_result_is_a_column():
    columns = episode_columns({"ppo": DRIVEN})
    assert all(len(values) == 2 for values in columns.values())
    flat = {"returns_by_role", "action_counts", "driving"}
    assert {*EpisodeResult.__dataclass_fields__} - flat | {*DrivingMeasures.__dataclass_fields__} < {*columns}


def test_without_pyarrow_one_line_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    """The summary is written as ever; the file of an earlier evaluation does not stay beside it."""
    from rich.console import Console

    (tmp_path / EPISODE_FILE).write_text("an earlier one")
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert not has_pyarrow()
    evaluation = Evaluation("toy-v0", 10, {"ppo": EPISODES})
    evaluation.write(tmp_path)
    show(evaluation, Console(width=200))
    assert "no episodes.parquet: it needs pyarrow; pip install 'dgvae-rl[study]'" in capsys.readouterr().out
    assert len(json.loads((tmp_path / "summary.json").read_text())["episodes"]["ppo"]) == 3
    assert sorted(p.name for p in tmp_path.iterdir()) == ["summary.json", "summary.md"]
