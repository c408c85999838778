import io
import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from agents.results import Evaluation, read_evaluation
from agents.vec_envs import EpisodeResult
from envs.rollouts.driving_measures import DrivingMeasures
from tests.agents.helpers import EPISODES, refuse


def test_written_summary_is_valid_json_and_a_table(tmp_path: Path):
    silent = [EpisodeResult(seed=10, episode_return=1.0, length=2, crashed=False, mean_speed_mps=math.nan)]
    evaluation = Evaluation("toy-v0", 10, {"ppo": EPISODES, "silent": silent})
    evaluation.write(tmp_path, algorithm="ppo")
    content = json.loads((tmp_path / "summary.json").read_text(), parse_constant=refuse)
    assert content["algorithm"] == "ppo"
    assert [line["policy"] for line in content["policies"]] == ["ppo", "silent"]
    assert content["policies"][1]["mean_speed_mps"] is None
    assert [e["seed"] for e in content["episodes"]["ppo"]] == [10, 11, 12]
    lines = (tmp_path / "summary.md").read_text().splitlines()
    assert lines[2].startswith("| ppo | 17.00 ± 3.51 | 24.0 ± 6.0 | 33 % (")
    assert lines[3].endswith("| – |")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["episodes.parquet", "summary.json", "summary.md"]


def test_what_is_written_is_read_again(tmp_path: Path):
    evaluation = Evaluation("toy-v0", 10, {"ppo": EPISODES}, env_kwargs='{"lanes": 3}')
    evaluation.write(tmp_path)
    assert read_evaluation(tmp_path / "summary.json") == evaluation


def herd(seed: int, ants: float, bees: float) -> EpisodeResult:
    """Returns the result of an episode with several roles, without an ego."""
    return EpisodeResult(seed, (ants + bees) / 2, 5, None, math.nan, {"ant": ants, "bee": bees})


def test_one_crash_in_200_episodes_does_not_read_0_percent(tmp_path: Path):
    episodes = [replace(EPISODES[0], crashed=number == 0) for number in range(200)]
    Evaluation("toy-v0", 10, {"ppo": episodes}).write(tmp_path)
    assert " 0.5 % (0.1–2.8 %) " in (tmp_path / "summary.md").read_text()


def test_without_an_ego_there_are_roles_but_no_crashes(tmp_path: Path):
    evaluation = Evaluation(
        "meadow", 1, {"ppo": [herd(1, 1.0, 4.0), herd(2, 3.0, 8.0)], "random": [herd(1, 0.0, 0.5)]}, False
    )
    evaluation.write(tmp_path)
    lines = (tmp_path / "summary.md").read_text().splitlines()
    assert lines[0] == "| policy | return | return of ant | return of bee | length |"
    assert lines[2] == "| ppo | 4.00 ± 1.50 | 2.00 ± 1.00 | 6.00 ± 2.00 | 5.0 ± 0.0 |"
    assert lines[3] == "| random | 0.25 | 0.00 | 0.50 | 5.0 |"
    assert lines[5].endswith("return: mean over the learners.")
    assert [column.header for column in evaluation.table().columns] == lines[0].strip("| ").split(" | ")
    content = json.loads((tmp_path / "summary.json").read_text(), parse_constant=refuse)
    line = content["policies"][0]
    assert (line["crash_rate"], line["crash_low"], line["mean_speed_mps"]) == (None, None, None)
    assert line["role_returns"] == {"ant": [2.0, 1.0], "bee": [6.0, 2.0]}
    assert content["policies"][1]["role_returns"] == {"ant": [0.0, None], "bee": [0.5, None]}  # a single episode
    assert content["episodes"]["ppo"][1]["returns_by_role"] == {"ant": 3.0, "bee": 8.0}


def test_crashes_that_are_never_reported_are_unknown_not_zero():
    silent = EpisodeResult(1, 2.0, 5, None, 20.0)
    mixed = Evaluation("toy-v0", 10, {"ppo": EPISODES, "silent": [silent]})
    lines = mixed.markdown().splitlines()
    assert lines[2].endswith("% (6–79 %) | 25.0 |")
    assert lines[3] == "| silent | 2.00 | 5.0 | not reported | 20.0 |"
    alone = Evaluation("toy-v0", 10, {"silent": [silent]}).markdown()
    assert "0 %" not in alone
    assert "crashes are not reported: no info has their key; name it, spelt as there, with" in alone


def test_the_caption_of_an_ego_explains_its_interval():
    assert "95 % Wilson interval" in Evaluation("toy-v0", 10, {"ppo": EPISODES}).markdown()


def test_one_role_needs_no_column():
    single = EpisodeResult(1, 2.0, 5, None, math.nan)
    assert (
        Evaluation("meadow", 1, {"ppo": [single]}, has_ego=False).markdown().startswith("| policy | return | length |")
    )


def driven(**steps: int) -> list[EpisodeResult]:
    """Returns an episode with so many steps of each action."""
    return [EpisodeResult(1, 0.0, sum(steps.values()), False, 20.0, {}, steps)]


def test_a_nearly_constant_policy_is_named_under_the_table(tmp_path: Path):
    found = {"ppo": driven(slower=95, idle=5), "planner": driven(slower=94, idle=6), "dqn": driven(idle=7)}
    known = {"slower": driven(slower=9), "idle": driven(**{"action-0": 9}), "random": driven(idle=4, slower=5)}
    evaluation = Evaluation("toy-v0", 1, found | known)
    evaluation.write(tmp_path)
    line = "(Nearly) constant: ppo takes slower in 95.0 % of its steps; dqn takes idle in 100.0 % of its steps."
    assert (tmp_path / "summary.md").read_text().splitlines()[-1] == line
    content = json.loads((tmp_path / "summary.json").read_text(), parse_constant=refuse)
    assert [list(policy["action_shares"].items()) for policy in content["policies"][:2]] == [
        [("slower", 0.95), ("idle", 0.05)],
        [("slower", 0.94), ("idle", 0.06)],
    ]
    varied = Evaluation("toy-v0", 1, known).markdown()
    assert "constant" not in varied


MEASURED = DrivingMeasures(30.0, 0.1, 4, 1.25, 2.5, 0.5, None)
"""Measures of an episode that is too short for a jerk."""


def with_driving(success: bool | None) -> list[EpisodeResult]:
    """Returns two episodes with measures."""
    later = DrivingMeasures(20.0, 0.0, 2, 0.75, 1.5, 0.0, 2.0)
    return [replace(EPISODES[0], driving=MEASURED, success=success), replace(EPISODES[2], driving=later)]


def test_driving_has_a_table_of_its_own(tmp_path: Path):
    evaluation = Evaluation("road-v0", 10, {"ppo": with_driving(None), "unmeasured": EPISODES})
    evaluation.write(tmp_path)
    lines = (tmp_path / "summary.md").read_text().splitlines()
    assert lines[0] == "| policy | return | length | crash rate (95 %) | speed [m/s] |"
    header = lines.index(
        "| policy | time [s] | off-road | lane changes | least time to contact [s] | its 5 % quantile [s] "
        "| hard braking | jerk [m/s³] |"
    )
    assert lines[header + 2] == (
        "| ppo | 25.0 ± 5.0 | 5.0 ± 5.0 % | 3.0 ± 1.0 | 1.00 ± 0.25 | 2.00 ± 0.50 | 25.0 ± 25.0 % | 2.00 |"
    )
    assert lines[header + 3] == "| unmeasured | – | – | – | – | – | – | – |"
    policies = json.loads((tmp_path / "summary.json").read_text(), parse_constant=refuse)["policies"]
    assert policies[0]["driving"]["lane_changes"] == [3.0, 1.0]
    assert policies[0]["driving"]["jerk_rms_mps3"] == [2.0, None]
    assert (policies[1]["driving"], policies[0]["success_rate"]) == ({}, None)


def test_driving_that_is_not_measured_is_said_so_once():
    assert "\n\nDriving measures: not reported.\n" in Evaluation("toy-v0", 10, {"ppo": EPISODES}).markdown()
    herds = Evaluation("meadow", 1, {"ppo": [herd(1, 1.0, 4.0)]}, has_ego=False).markdown()
    assert "Driving" not in herds


def test_success_is_a_column_where_it_is_reported():
    reported = [replace(e, success=e.seed == 10) for e in EPISODES]
    evaluation = Evaluation("goal-v0", 10, {"ppo": reported, "silent": EPISODES})
    lines = evaluation.markdown().splitlines()
    assert lines[0] == "| policy | return | length | crash rate (95 %) | success rate (95 %) | speed [m/s] |"
    assert lines[2].endswith("| 33 % (6–79 %) | 33 % (6–79 %) | 25.0 |")
    assert lines[3].endswith("| 33 % (6–79 %) | not reported | 25.0 |")


@pytest.mark.parametrize("crashed_success", [False, None])
def test_a_success_with_a_crash_does_not_show_that_failures_are_reported(crashed_success: bool | None):
    """Of four episodes one succeeded, two said nothing, and one crashed, with a success or without a word."""
    found = [
        replace(EPISODES[0], success=True, crashed=None),
        replace(EPISODES[0], success=None, crashed=None),
        replace(EPISODES[0], success=None, crashed=None),
        replace(EPISODES[0], success=crashed_success, crashed=True),
    ]
    assert Evaluation("toy-v0", 10, {"ppo": found}).summaries[0].success_rate == 0.25


@pytest.mark.parametrize("success", [None, True])
def test_the_table_fits_into_eighty_columns(success: bool | None):
    long = [replace(e, success=success, episode_return=10 * e.episode_return) for e in EPISODES]
    printed = io.StringIO()
    console = Console(width=80, file=printed)
    console.print(Evaluation("intersection-v2", 2_000_000_000, {"ppo (constant-velocity)": long}).table())
    text = printed.getvalue()
    assert max(map(len, text.splitlines())) <= 80
    assert "(constant-velocity)" in text and "170.00 ± 35.12" in text and "24.0 ± 6.0" in text
    assert ("33 % (6–79 %)" in text) == (success is None)
    assert ("100 %" in text) == bool(success)


def test_differences_stand_in_both_files(tmp_path: Path):
    slower = [replace(e, episode_return=e.episode_return - 2.0, action_counts={"slower": e.length}) for e in EPISODES]
    Evaluation("toy-v0", 10, {"ppo": EPISODES, "slower": slower}).write(tmp_path)
    text = (tmp_path / "summary.md").read_text()
    assert "| policy | return − return of slower (95 %) |\n|---|---|\n| ppo | +2.00 (+2.00 to +2.00) |\n\n" in text
    content = json.loads((tmp_path / "summary.json").read_text(), parse_constant=refuse)
    assert content["differences"] == {
        "reference": "slower",
        "policies": {"ppo": {"value": 2.0, "interval": [2.0, 2.0]}},
    }
    assert text.rstrip().endswith("(10,000 draws). Intervals of fewer than 20 episodes are too narrow.")
    many = [replace(EPISODES[0], seed=10 + i, episode_return=float(i)) for i in range(20)]
    assert "too narrow" not in Evaluation("toy-v0", 10, {"ppo": many, "slower": many}).markdown()
    single = Evaluation("toy-v0", 10, {"ppo": EPISODES[:1], "slower": slower[:1]}).markdown()
    assert "| ppo | +2.00 |" in single
    assert "return − return" not in Evaluation("toy-v0", 10, {"ppo": EPISODES}).markdown()
