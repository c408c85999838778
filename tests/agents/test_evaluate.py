import json
from pathlib import Path

import pytest
from rich.console import Console
from stable_baselines3 import PPO

from agents import evaluate
from agents.arena import MultiagentArena
from agents.evaluate import EvaluateConfig, checked_drivers, compared_drivers, evaluate_policy_on_seeds, main, show
from agents.results import Evaluation
from agents.runs import SHIPPED
from agents.task import EVALUATION_SEED, Task
from agents.vec_envs import EpisodeResult
from predictor.support.errors import UserError
from tests.agents.helpers import TOY, policy_for, refuse


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


def test_no_episodes_are_refused():
    with pytest.raises(UserError, match="num_episodes must be at least 1, got 0"):
        evaluate_policy_on_seeds(Task(TOY, "none"), "idle", "idle", 0)
    with pytest.raises(UserError, match="num_envs must be at least 1, got 0"):
        evaluate_policy_on_seeds(Task(TOY, "none"), "idle", "idle", 1, num_envs=0)


@pytest.mark.slow
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
    with pytest.raises(UserError, match=r"highway-fast.zip sees forecasts, .* measure it with --run-dir"):
        checked_drivers(Task("highway-fast-v0", "none"), (str(SHIPPED / "highway-fast.zip"),))
    assert checked_drivers(Task("simple_tag_v3", "none"), ()) == ()


@pytest.mark.parametrize(
    ("sizes_of", "named", "accepted"),
    [
        ("exit", "exit", False),  # it would be measured with `highway` all the same
        ("own:module:forecaster", "own:module:forecaster", True),
        ("s3://bucket/sizes", "s3://bucket/sizes", True),
        ("exit", "highway", True),
        (None, "exit", False),
    ],
)
def test_only_what_has_to_be_trusted_may_be_named_beside_the_policy_s_forecaster(
    sizes_of: str | None, named: str, accepted: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    task = Task("highway-fast-v0", "forecast", checkpoint="highway")
    object.__setattr__(task, "sizes_of", sizes_of)  # none of these is there
    for name, value in (("policy_zip", tmp_path / "policy.zip"), ("local_policy", tmp_path), ("algorithm_of", "ppo"),
                        ("task_of_policy", task), ("replace", task)):  # fmt: skip
        monkeypatch.setattr(evaluate, name, lambda *given, value=value, **more: value)
    config = EvaluateConfig(run_dir=tmp_path, checkpoint=named)
    if accepted:
        assert evaluate._trained(config, tmp_path).task is task
        return
    with pytest.raises(UserError, match=f"was trained on forecaster highway, got --checkpoint {named}; leave it out"):
        evaluate._trained(config, tmp_path)


def test_a_policy_knows_the_checkpoint_that_ships_for_its_environment(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    def trained(task: Task, named: str) -> Task:
        found = {"policy_zip": tmp_path / "policy.zip", "local_policy": tmp_path, "algorithm_of": "ppo"}
        for name, value in (found | {"task_of_policy": task}).items():
            monkeypatch.setattr(evaluate, name, lambda *given, value=value, **more: value)
        return evaluate._trained(EvaluateConfig(run_dir=tmp_path, checkpoint=named), tmp_path).task

    shipped, blind = Task("highway-fast-v0", "forecast"), Task("highway-fast-v0", "none")
    assert trained(shipped, "highway") == shipped
    with pytest.raises(UserError, match="was trained on forecaster highway, got --checkpoint merge; leave it out"):
        trained(shipped, "merge")
    with pytest.raises(UserError, match="sees no forecaster's forecasts, got --checkpoint highway; leave it out"):
        trained(blind, "highway")


def test_the_planner_takes_the_checkpoint_that_a_run_names():
    task = Task("highway-fast-v0", "forecast", checkpoint="highway")
    named = ("planner:highway", "planner@0.3:highway", "planner:merge", "slower")
    assert compared_drivers(task, ("planner", "planner@0.3", "planner:merge", "slower")) == named
    assert compared_drivers(Task("highway-fast-v0", "none"), ("planner",)) == ("planner",)


def test_constant_actions_stand_for_one_driver_each():
    names = checked_drivers(Task("merge-v1", "none"), ("slower", "constant-actions", "random"))
    assert names == ("slower", "lane-left", "idle", "lane-right", "faster", "random")
    assert checked_drivers(Task("CartPole-v1", "none"), ("constant-actions",)) == ("action-0", "action-1")


@pytest.mark.slow
def test_one_table_of_planner_and_constant_actions(tmp_path: Path, monkeypatch, capsys: pytest.CaptureFixture[str]):
    command = "--policy planner:constant-velocity --env-id intersection-v2 --episodes 1"
    monkeypatch.setattr("sys.argv", ["evaluate", *command.split(), "--num-envs", "1", "--out", str(tmp_path)])
    main()
    content = json.loads((tmp_path / "summary.json").read_text(), parse_constant=refuse)
    lines = {policy["policy"]: policy["action_shares"] for policy in content["policies"]}
    assert list(lines) == ["planner:constant-velocity", "slower", "idle", "faster", "random"]
    assert all(lines[name] == {name: 1.0} for name in ("slower", "idle", "faster"))
    assert content["differences"]["reference"] in ("slower", "idle", "faster")
    assert all(policy["success_rate"] in (0.0, 1.0) for policy in content["policies"])
    assert all(e["driving"]["time_s"] == e["length"] for episodes in content["episodes"].values() for e in episodes)
    assert {e["seed"] for episodes in content["episodes"].values() for e in episodes} == {EVALUATION_SEED}
    assert "5 of 5" in capsys.readouterr().out  # the bar knows that idle is one line, not two


def test_constant_actions_are_compared_unless_others_are_named(monkeypatch: pytest.MonkeyPatch):
    merge, racetrack = Task("merge-v1", "none"), Task("racetrack-v1", "none")
    constants = ("lane-left", "idle", "lane-right", "faster", "slower")
    assert compared_drivers(merge) == constants
    assert compared_drivers(merge, ("none",)) == compared_drivers(merge, ()) == ()
    assert compared_drivers(merge, ("varied",)) == ("varied",)
    assert compared_drivers(merge, ("varied", "constant-actions")) == ("varied", *constants)
    assert compared_drivers(racetrack) == ()  # steering is not discrete
    monkeypatch.setattr(evaluate, "MOST_CONSTANTS", 4)
    assert compared_drivers(merge) == ()  # as many lines would be no table
    assert compared_drivers(merge, ("constant-actions",)) == constants
    assert compared_drivers(Task("simple_tag_v3", "none")) == ()  # no ego
    with pytest.raises(UserError, match="--drivers none adds no line and stands alone, got varied none"):
        compared_drivers(merge, ("varied", "none"))


def test_no_further_drivers_on_demand(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    command = "--policy slower --env-id merge-v1 --drivers none --episodes 1 --num-envs 1"
    monkeypatch.setattr("sys.argv", ["evaluate", *command.split(), "--out", str(tmp_path)])
    main()
    content = json.loads((tmp_path / "summary.json").read_text(), parse_constant=refuse)
    assert [policy["policy"] for policy in content["policies"]] == ["slower", "random", "idle"]
    assert all(policy["success_rate"] is None for policy in content["policies"])


def test_the_policy_runs_on_the_device_that_is_asked_for(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """Its network as well as the forecaster; no such device is needed to ask for one."""
    asked: list[str] = []
    for module in ("agents.evaluate", "agents.task"):
        monkeypatch.setattr(f"{module}.resolve_device", lambda device: device)
    model = PPO.__new__(PPO)  # only handed through

    def load(*_: object, device: str) -> PPO:
        asked.append(device)
        return model

    monkeypatch.setattr("agents.evaluate.load_model", load)
    policy = Path("highway-fast")
    trained = evaluate._trained(EvaluateConfig(run_dir=policy, device="cuda", out=tmp_path), policy)
    assert trained.model() is model
    assert (trained.task.device, asked) == ("cuda", ["cuda"])


def test_no_more_episodes_are_played_than_can_be_read():
    with pytest.raises(UserError, match="episodes must be at most 10,000, got 20000"):
        EvaluateConfig(Path("run"), episodes=20_000)


@pytest.mark.parametrize("alike", [True, False])
def test_episodes_that_begin_alike_are_told(
    alike: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setattr("agents.evaluate.begins_alike", lambda task: alike and task == "Roundabout-v0")
    results = {"idle": [EpisodeResult(0, 1.0, 1, None, float("nan"))] * 2}
    show(Evaluation("envpool/Roundabout-v0", 0, results), Console(width=200))
    said = "EnvPool's Roundabout-v0 begins every episode in the same state, so the intervals say nothing"
    assert (said in capsys.readouterr().out) == alike
    show(Evaluation("roundabout-v1", 0, results), Console(width=200))
    assert said not in capsys.readouterr().out
