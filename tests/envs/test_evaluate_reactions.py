"""The commands `python -m envs.evaluate --reactions`, `--graph` and `--plans`."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from envs import evaluate
from envs.rollouts import graph_run, reactions
from envs.rollouts.causal_labels import IN_ARENAS
from envs.rollouts.graph_run import DISTANCE, MAJORITY, TREES
from envs.rollouts.reaction_cells import ELSEWHERE
from envs.rollouts.reactions import STRAIGHT
from predictor.support.errors import UserError
from tests.envs.evaluation import TAG, forget, no_processes, read_json, save_tag
from tests.envs.helpers import run_command

STILL = "constant-velocity"


@pytest.fixture(autouse=True)
def in_process(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    no_processes(monkeypatch)
    forget()
    yield
    forget()


@pytest.mark.slow
def test_the_command_writes_table_figure_and_numbers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
):
    monkeypatch.setattr(reactions, "SHARE", 1.0)
    out = tmp_path / "results"
    arguments = ["--reactions", "--env-ids", TAG, "--checkpoint", save_tag(tmp_path / "tag"), "--out", str(out)]
    arguments += ["--perturbations", "2", "--most-episodes", "2", "--max-steps", "6", "--workers", "1"]
    code, errors, output = run_command(evaluate.main, arguments, monkeypatch, capsys)
    assert (code, errors) == (0, [])
    assert f"{TAG}, driven heuristic: shift of receivers after 3 steps of 0.1 s" in output
    assert {path.name for path in out.iterdir()} == {"reactions.json", "reactions.md", f"{TAG}.reactions.png"}
    content = read_json(out / "reactions.json")
    assert content["config"]["perturbations"] == 2
    assert {"command", "commit", "versions"} <= set(content["provenance"])
    (result,) = content["results"]
    assert [cell["name"] for cell in result["cells"]] == [cell.name for cell in ELSEWHERE]
    straight = result["cells"][0]["reactions"][STRAIGHT]
    assert (straight["pairs"], straight["slope"]["value"], straight["length_m"]) == (2, 0.0, 0.0)
    learned = result["cells"][0]["reactions"]["tag"]
    assert learned["slope"]["value"] != 0.0 and learned["true_m"] == straight["true_m"] > 0.01
    assert len(result["perturbations"]) == sum(cell["pairs"] for cell in result["cells"])
    assert f"| {ELSEWHERE[0].name} | 2 (" in (out / "reactions.md").read_text()


@pytest.mark.slow
def test_the_graph_is_written_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture):
    """Both measurements in one run; labels are of one sender, as quick as they can be."""
    quick = replace(IN_ARENAS, horizon_s=0.2, senders=1)
    monkeypatch.setattr(graph_run, "settings_for", lambda world: quick)
    out = tmp_path / "results"
    arguments = ["--reactions", "--graph", "--env-ids", TAG, "--checkpoint", save_tag(tmp_path / "tag")]
    arguments += ["--perturbations", "1", "--most-episodes", "1", "--episodes", "2", "--max-steps", "8"]
    arguments += ["--workers", "1", "--out", str(out)]
    code, errors, output = run_command(evaluate.main, arguments, monkeypatch, capsys)
    assert (code, errors) == (0, [])
    assert "edges by" in output and "false reaction" in output
    assert {"graph.json", "graph.md", f"{TAG}.graph.png", "reactions.json"} <= {path.name for path in out.iterdir()}
    (result,) = read_json(out / "graph.json")["results"]
    assert list(result["scores"]) == ["tag", MAJORITY, DISTANCE, TREES]
    assert result["settings"]["senders"] == 1 and result["scores"]["tag"]["pairs"] > 0
    assert "| tag | " in (out / "graph.md").read_text()


@pytest.mark.slow
def test_plans_are_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture):
    out = tmp_path / "results"
    arguments = ["--plans", "--env-ids", "merge-v1", "--checkpoint", STILL, "--episodes", "2", "--max-steps", "9"]
    arguments += ["--horizon-steps", "2", "--workers", "1", "--out", str(out)]
    code, errors, output = run_command(evaluate.main, arguments, monkeypatch, capsys)
    assert (code, errors) == (0, [])
    assert "right choices" in output and "collisions by plan: IDLE" in output
    assert {path.name for path in out.iterdir()} == {"plans.json", "plans.md", "merge-v1.plans.png"}
    (result,) = read_json(out / "plans.json")["results"]
    assert list(result["scores"]) == [STRAIGHT] and result["moments"] >= 1 and result["horizon_steps"] == 2


def test_what_was_measured_is_written_before_another_environment_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
):
    measured = evaluate.measure_plans

    def failing(run: Any) -> Any:
        if run.env_id == "highway-fast-v0":
            raise UserError("the simulator died")
        return measured(run)

    monkeypatch.setattr(evaluate, "measure_plans", failing)
    out = tmp_path / "results"
    arguments = ["--plans", "--env-ids", "merge-v1", "highway-fast-v0", "--checkpoint", STILL, "--episodes", "1"]
    arguments += ["--max-steps", "9", "--horizon-steps", "1", "--workers", "1", "--out", str(out)]
    code, errors, _ = run_command(evaluate.main, arguments, monkeypatch, capsys)
    assert (code, errors) == (2, ["error: the simulator died"])
    assert [result["env_id"] for result in read_json(out / "plans.json")["results"]] == ["merge-v1"]
    assert "merge-v1" in (out / "plans.md").read_text()


def test_a_checkpoint_that_does_not_fit_is_refused_before_anything_is_measured(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
):
    monkeypatch.setattr(evaluate, "measure_plans", lambda run: pytest.fail("measured"))
    arguments = ["--plans", "--env-ids", "merge-v1", "racetrack-v1", "--checkpoint", "merge", "--workers", "1"]
    code, errors, _ = run_command(evaluate.main, arguments, monkeypatch, capsys)
    assert (
        code == 2 and "checkpoint 'merge' was trained at dt_s=1 but env 'racetrack-v1' steps at dt_s=0.2" in errors[0]
    )


@pytest.mark.parametrize(("options", "processes"), [({}, 50), ({"reactions": True}, 300)])
def test_as_many_processes_are_checked_as_may_start(
    options: dict[str, Any], processes: int, monkeypatch: pytest.MonkeyPatch
):
    asked: dict[str, int] = {}
    monkeypatch.setattr(evaluate, "check_count", lambda count, name, each_bytes=0: asked.update({name: count}))
    evaluate.EvaluateConfig(("highway-fast-v0",), episodes=50, workers=300, **options)
    assert asked["workers"] == processes


ERRORS = {
    "no-copies": (["--env-ids", TAG, "pursuit_v5"], "raw_env cannot be perturbed; use an environment of highway-env"),
    "zero": (["--perturbations", "0"], "perturbations must be at least 1, got 0"),
    "no-episodes": (["--most-episodes", "0"], "most_episodes must be at least 1, got 0"),
    "no-store": (["--data", "nowhere"], "no episode store at nowhere; make one"),
    "no-copies-for-a-graph": (["--graph", "--env-ids", "pursuit_v5"], "raw_env cannot be perturbed"),
    "no-plans": (["--plans", "--env-ids", TAG], "plans are those of one ego, and simple_tag_v3 has several"),
    "no-effect-of-memory": (["--memory-steps", "5"], "memory_steps has no effect on reactions; leave it out"),
    "no-effect-of-episodes": (["--episodes", "7"], "episodes has no effect on reactions; leave it out"),
    "no-checkpoint": (["--checkpoint", "nowhere"], "no checkpoint 'nowhere'"),
}


@pytest.mark.parametrize("case", ERRORS)
def test_bad_input_is_one_line_and_leaves_nothing(
    case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
):
    arguments, message = ERRORS[case]
    monkeypatch.chdir(tmp_path)
    base = {"--env-ids": TAG, "--checkpoint": STILL, "--workers": "1", "--out": "results"}
    words = [word for option in base.items() if option[0] not in arguments for word in option]
    code, errors, _ = run_command(evaluate.main, ["--reactions", *words, *arguments], monkeypatch, capsys)
    assert (code, len(errors)) == (2, 1)
    assert errors[0].startswith(f"error: {message}")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"perturbations": 3}, "perturbations has no effect on accuracy; leave it out"),
        ({"graph": True, "horizon_steps": 3}, "horizon_steps has no effect on graph; leave it out"),
        (
            {"graph": True, "plans": True, "data": (Path("nowhere"),)},
            "data has no effect on graph and plans; leave it out",
        ),
    ],
)
def test_an_option_that_nothing_uses_is_refused(options: dict[str, Any], message: str):
    with pytest.raises(UserError, match=f"^{message}$"):
        evaluate.EvaluateConfig((TAG,), **options)


def test_draws_reach_what_is_measured(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture):
    seen: list[int] = []

    def measure(run: Any) -> Any:
        seen.append(run.hidden_draws)
        raise UserError("enough")

    for name in ("measure_reactions", "measure_plans"):
        monkeypatch.setattr(evaluate, name, measure)
    for kind in ("--reactions", "--plans"):
        arguments = [kind, "--env-ids", "merge-v1", "--checkpoint", STILL, "--hidden-draws", "3", "--workers", "1"]
        code, errors, _ = run_command(evaluate.main, arguments, monkeypatch, capsys)
        assert code and "enough" in errors[0]
    assert seen == [3, 3]


@pytest.mark.parametrize(("draws", "sentence"), [("2", "needs an environment of highway-env"), (str(10**12), "GiB")])
def test_draws_that_are_not_possible_are_refused_in_a_line(
    draws: str, sentence: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
):
    arguments = ["--reactions", "--env-ids", TAG, "--checkpoint", STILL, "--hidden-draws", draws]
    code, errors, _ = run_command(evaluate.main, arguments, monkeypatch, capsys)
    assert code and len(errors) == 1 and "hidden_draws" in errors[0] and sentence in errors[0]
