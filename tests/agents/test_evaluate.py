import json
import math
from pathlib import Path

import pytest

from agents.arena import MultiagentArena
from agents.evaluate import (
    Evaluation,
    checked_drivers,
    evaluate_policy_on_seeds,
    main,
    mean_and_standard_error,
    summarize,
    wilson_interval,
)
from agents.task import EVALUATION_SEED, Task
from agents.vec_envs import EpisodeResult
from predictor.support.errors import UserError
from tests.agents.helpers import TOY, policy_for

EPISODES = [
    EpisodeResult(seed=10, episode_return=20.0, length=30, crashed=False, mean_speed_mps=22.0),
    EpisodeResult(seed=11, episode_return=10.0, length=12, crashed=True, mean_speed_mps=28.0),
    EpisodeResult(seed=12, episode_return=21.0, length=30, crashed=False, mean_speed_mps=25.0),
]


@pytest.mark.parametrize(
    ("successes", "trials", "low", "high"),
    [
        (0, 10, 0.0, 0.27753),  # z²/(n + z²)
        (10, 10, 0.72247, 1.0),
        (5, 10, 0.23659, 0.76341),
        (1, 50, 0.00354, 0.10496),
        (0, 1, 0.0, 0.79346),
    ],
    ids=["none", "all", "half", "rare", "single"],
)
def test_wilson_interval_closed_form(successes: int, trials: int, low: float, high: float):
    assert wilson_interval(successes, trials) == pytest.approx((low, high), abs=1e-5)


@pytest.mark.parametrize(("successes", "trials"), [(-1, 5), (6, 5), (0, 0)])
def test_wilson_interval_refuses_nonsense(successes: int, trials: int):
    with pytest.raises(UserError, match="successes"):
        wilson_interval(successes, trials)


def test_standard_error_closed_form():
    mean, error = mean_and_standard_error([1.0, 3.0])
    assert (mean, error) == pytest.approx((2.0, 1.0))  # sd √2, n 2


def test_standard_error_of_one_value_is_unknown():
    assert math.isnan(mean_and_standard_error([4.0])[1])


def test_summary_of_episodes():
    line = summarize("ppo", EPISODES)
    assert (line.policy, line.episodes) == ("ppo", 3)
    assert line.return_mean == pytest.approx(17.0)
    assert line.length_mean == pytest.approx(24.0)
    assert line.crash_rate == pytest.approx(1 / 3)
    assert line.mean_speed_mps == pytest.approx(25.0)
    assert line.crash_low < line.crash_rate < line.crash_high


def refuse(constant: str) -> None:
    raise AssertionError(f"{constant} is not JSON")


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
    assert sorted(p.name for p in tmp_path.iterdir()) == ["summary.json", "summary.md"]


def herd(seed: int, ants: float, bees: float) -> EpisodeResult:
    """Returns the result of an episode with several roles, without an ego."""
    return EpisodeResult(seed, (ants + bees) / 2, 5, None, math.nan, {"ant": ants, "bee": bees})


def test_without_an_ego_there_are_roles_but_no_crashes(tmp_path: Path):
    evaluation = Evaluation(
        "meadow", 1, {"ppo": [herd(1, 1.0, 4.0), herd(2, 3.0, 8.0)], "random": [herd(1, 0.0, 0.5)]}, False
    )
    evaluation.write(tmp_path)
    lines = (tmp_path / "summary.md").read_text().splitlines()
    assert lines[0] == "| policy | return | return of ant | return of bee | length |"
    assert lines[2] == "| ppo | 4.00 ± 1.50 | 2.00 ± 1.00 | 6.00 ± 2.00 | 5.0 ± 0.0 |"
    assert lines[3] == "| random | 0.25 | 0.00 | 0.50 | 5.0 |"
    assert lines[-1].endswith("return: mean over the learners.")
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
    assert lines[3] == "| silent | 2.00 | 5.0 | – | 20.0 |"
    alone = Evaluation("toy-v0", 10, {"silent": [silent]}).markdown()
    assert "0 %" not in alone
    assert "the environment reports no crashes" in alone


def test_the_caption_of_an_ego_explains_its_interval():
    assert "95 % Wilson interval" in Evaluation("toy-v0", 10, {"ppo": EPISODES}).markdown()


def test_one_role_needs_no_column():
    single = EpisodeResult(1, 2.0, 5, None, math.nan)
    assert (
        Evaluation("meadow", 1, {"ppo": [single]}, has_ego=False).markdown().startswith("| policy | return | length |")
    )


def test_all_policies_play_the_same_held_out_seeds():
    task = Task(TOY, "none")
    model, calls = policy_for(task), []
    evaluation = evaluate_policy_on_seeds(task, model, "ppo", 3, on_episode=lambda: calls.append(None))
    assert list(evaluation.results) == ["ppo", "random", "idle"]
    assert len(calls) == 3 * 3
    seeds = range(EVALUATION_SEED, EVALUATION_SEED + 3)
    for name, found in evaluation.results.items():
        expected = MultiagentArena(task).play(model if name == "ppo" else name, seeds)
        assert [(e.seed, e.episode_return) for e in found] == [(e.seed, e.episode_return) for e in expected]


def test_the_planner_is_a_policy_and_a_line_of_the_table():
    """A driver in the place of a trained policy, and another one beside the baselines; each name once."""
    task = Task("highway-fast-v0", "none")
    evaluation = evaluate_policy_on_seeds(
        task, "planner:constant-velocity", "planner", num_episodes=1, first_seed=7, drivers=("idle",)
    )
    assert list(evaluation.results) == ["planner", "idle", "random"]
    planned, idle = (evaluation.results[name][0] for name in ("planner", "idle"))
    assert (planned.seed, planned.length) == (7, 30) and planned.crashed is False
    assert planned.episode_return > idle.episode_return


def test_drivers_that_cannot_drive_are_refused_before_anything_runs():
    with pytest.raises(UserError, match="drivers of an ego need an environment with one ego, simple_tag_v3 has"):
        checked_drivers(Task("simple_tag_v3", "none"), ("planner",))
    with pytest.raises(UserError, match="no scene reader knows|no plan model knows"):
        checked_drivers(Task("CartPole-v1", "none"), ("planner",))
    with pytest.raises(UserError, match=r"constant-actions needs an environment with discrete actions, got Box\("):
        checked_drivers(Task("racetrack-v1", "none"), ("constant-actions",))
    assert checked_drivers(Task("simple_tag_v3", "none"), ()) == ()


def test_constant_actions_stand_for_one_driver_each():
    names = checked_drivers(Task("merge-v1", "none"), ("slower", "constant-actions", "random"))
    assert names == ("slower", "lane-left", "idle", "lane-right", "faster", "random")
    assert checked_drivers(Task("CartPole-v1", "none"), ("constant-actions",)) == ("action-0", "action-1")


def test_shares_are_of_all_steps_not_of_episodes():
    long = EpisodeResult(1, 0.0, 30, False, 20.0, {}, {"slower": 29, "idle": 1})
    short = EpisodeResult(2, 0.0, 2, True, 20.0, {}, {"faster": 2})
    assert summarize("ppo", [short, long]).action_shares == {"slower": 29 / 32, "faster": 2 / 32, "idle": 1 / 32}
    assert summarize("ppo", EPISODES).action_shares == {}


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
    assert "constant" not in varied and varied.endswith("Wilson interval.\n")


def test_one_table_of_planner_and_constant_actions(tmp_path: Path, monkeypatch, capsys: pytest.CaptureFixture[str]):
    command = "--policy planner:constant-velocity --env-id intersection-v2 --drivers constant-actions --episodes 1"
    monkeypatch.setattr("sys.argv", ["evaluate", *command.split(), "--num-envs", "1", "--out", str(tmp_path)])
    main()
    content = json.loads((tmp_path / "summary.json").read_text(), parse_constant=refuse)
    lines = {policy["policy"]: policy["action_shares"] for policy in content["policies"]}
    assert list(lines) == ["planner:constant-velocity", "slower", "idle", "faster", "random"]
    assert all(lines[name] == {name: 1.0} for name in ("slower", "idle", "faster"))
    assert {e["seed"] for episodes in content["episodes"].values() for e in episodes} == {EVALUATION_SEED}
    assert "5/5" in capsys.readouterr().out  # the bar knows that idle is one line, not two
