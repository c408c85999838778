"""Policies on a hub: pushed with their warning, and loaded only by those who say that they trust them."""

import json
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from agents import evaluate
from agents import hub as policies
from agents.hub import card_of, policy_from_hub, push_policy_to_hub
from agents.policy import load_policy
from agents.push import main
from agents.runs import save_model
from agents.task import Observe, Task
from agents.watch import WatchConfig, write_film
from predictor.support.errors import UserError, run_entry_point
from tests.agents.test_policy import FAST, FEW, saved
from tests.hub_stand_in import Hub, hub_for_test

pytest.importorskip("huggingface_hub")


@pytest.fixture
def hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Hub]:
    with hub_for_test(tmp_path / "cache", monkeypatch, policies._fetched) as served:
        yield served


@pytest.mark.parametrize(
    ("arm", "seen"), [("forecast", "forecasts"), ("zeros", "the arm `zeros` in the shape of forecasts")]
)
def test_a_card_says_what_a_policy_sees(arm: Observe, seen: str):
    assert f". Sees {seen} of `highway` (5 steps).\n" in card_of(Task(FAST, arm, env_kwargs=FEW).note, "ppo", "me/fast")
    assert ". Sees no forecasts.\n" in card_of(Task(FAST, "none", env_kwargs=FEW).note, "ppo", "me/fast")


@pytest.mark.slow
def test_a_policy_is_loaded_from_a_hub_by_those_who_trust_it(hub: Hub, tmp_path: Path):
    saved(tmp_path, Task(FAST, "constant-velocity", env_kwargs=FEW), run=True)
    push_policy_to_hub(tmp_path, "me/fast")
    files = hub.files("me/fast")
    assert sorted(files) == ["README.md", "config.json", "policy.zip"]
    card = files["README.md"].decode()
    assert "holds pickled Python objects: loading it runs code" in card and "trust_pickle=True" in card
    asked = len(hub.asked)
    for load in (load_policy, policy_from_hub, lambda name: write_film(WatchConfig(Path(name)))):
        with pytest.raises(UserError, match="loading it runs code of whoever wrote it; if you trust them, say so with"):
            load("hub:me/fast")
    assert len(hub.asked) == asked, "nothing is downloaded before"
    policy, env = load_policy("hub:me/fast", trust_pickle=True)
    observation, _ = env.reset(seed=3)
    known, twin = load_policy(tmp_path)
    assert policy(observation) == known(twin.reset(seed=3)[0])
    film = write_film(WatchConfig(Path("hub:me/fast"), out=tmp_path / "film.mp4", trust_pickle=True))
    assert film.read_bytes()[4:8] == b"ftyp"


@pytest.mark.slow
def test_a_policy_of_a_hub_is_measured_by_those_who_trust_it(
    hub: Hub, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    """The table is that of the same policy on this machine."""
    path, _ = saved(tmp_path / "run", Task(FAST, "constant-velocity", env_kwargs=FEW))
    push_policy_to_hub(path, "me/fast")
    few = ["--episodes", "1", "--num-envs", "1", "--drivers", "none"]

    def evaluated(*words: str) -> None:
        monkeypatch.setattr(sys, "argv", ["evaluate", *words, *few])
        run_entry_point(evaluate.main)

    asked = len(hub.asked)
    for words, line in (
        (("--run-dir", "hub:me/fast", "--out", str(tmp_path / "a")), "loading it runs code of whoever wrote it"),
        (("--run-dir", "hub:me/fast", "--trust-pickle"), "hub:me/fast is no run folder; say with --out where the"),
        (("--run-dir", str(path)), "policy.zip is no run folder; say with --out where the results go"),
    ):
        with pytest.raises(SystemExit):
            evaluated(*words)
        assert line in " ".join(capsys.readouterr().err.split())
    assert len(hub.asked) == asked, "nothing is downloaded before"
    evaluated("--run-dir", "hub:me/fast", "--trust-pickle", "--out", str(tmp_path / "a"))
    evaluated("--run-dir", str(path), "--out", str(tmp_path / "b"))
    summaries = [json.loads((tmp_path / name / "summary.json").read_text()) for name in "ab"]
    assert [summary["observe"] for summary in summaries] == ["constant-velocity"] * 2
    assert summaries[0]["policies"] == summaries[1]["policies"]
    assert json.loads(summaries[0]["env_kwargs"]) == json.loads(FEW)
    alone = '{"config": {"vehicles_count": 0, "duration": 3}}'
    words = ["--env-kwargs", alone, "--crash-key", "nothing", "--seed", "77"]
    evaluated("--run-dir", str(path), "--out", str(tmp_path / "c"), *words)
    changed = json.loads((tmp_path / "c" / "summary.json").read_text())
    assert changed["first_seed"] == 77 != summaries[0]["first_seed"]
    assert json.loads(changed["env_kwargs"]) == json.loads(alone)
    assert changed["policies"][0]["length_mean"] == 3 and changed["policies"][0]["crash_rate"] is None


@pytest.mark.parametrize("what", ["merge", "policy"])
def test_what_is_pushed_as_private_stays_private(what: str, hub: Hub, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = what if what == "merge" else str(saved(tmp_path, Task(FAST, "none", env_kwargs=FEW))[0])
    for name, words in (("me/secret", ["--private"]), ("me/open", [])):
        monkeypatch.setattr(sys, "argv", ["push", path, name, *words])
        run_entry_point(main)
    assert hub.private == {"me/secret"}


def test_a_policy_does_not_keep_the_config_of_another_one(hub: Hub, tmp_path: Path):
    saved(tmp_path / "run", Task(FAST, "none", env_kwargs=FEW), run=True)
    (tmp_path / "run" / "summary.json").write_text("{}")
    push_policy_to_hub(tmp_path / "run", "me/fast")
    hub.commit("me/fast", notes__txt=b"mine")
    assert sorted(hub.files("me/fast")) == ["README.md", "config.json", "notes.txt", "policy.zip", "summary.json"]
    alone, _ = saved(tmp_path / "alone", Task(FAST, "none"))
    push_policy_to_hub(alone, "me/fast")
    assert sorted(hub.files("me/fast")) == ["README.md", "notes.txt", "policy.zip"]
    assert hub.files("me/fast")["policy.zip"] == alone.read_bytes()
    assert load_policy("hub:me/fast", trust_pickle=True)[1].unwrapped.config["vehicles_count"] > 0


def test_a_predictor_is_no_policy(hub: Hub):
    hub.commit("me/merge", config__json=b"{}")
    with pytest.raises(UserError, match="hub:me/merge has no policy.zip and is not what is asked for"):
        load_policy("hub:me/merge", trust_pickle=True)


def test_a_forecaster_that_others_lack_is_named(hub: Hub, tmp_path: Path):
    task = Task(FAST, "constant-velocity", env_kwargs=FEW)
    note = task.note
    assert note.forecaster is not None
    note = replace(note, forecaster=replace(note.forecaster, checkpoint="runs/merge"))
    path, model = saved(tmp_path, task)
    save_model(model, path, note=note)
    with pytest.raises(UserError, match="was trained on the forecaster 'runs/merge', a folder that others do not have"):
        push_policy_to_hub(path, "me/fast")
    assert hub.repositories == {}


def test_sizes_of_a_checkpoint_that_others_lack_are_named(hub: Hub, tmp_path: Path):
    path, _ = saved(tmp_path, Task(FAST, "constant-velocity", env_kwargs=FEW), run=True)
    content = json.loads((path.parent / "config.json").read_text())
    content["config"]["sizes_of"] = "runs/mine"
    (path.parent / "config.json").write_text(json.dumps(content))
    with pytest.raises(UserError, match="the sizes of the checkpoint 'runs/mine', a folder .*--sizes-of hub:"):
        push_policy_to_hub(path.parent, "me/fast")
    assert hub.repositories == {}


def test_the_command_knows_policies_from_predictors(
    hub: Hub, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    path, _ = saved(tmp_path, Task(FAST, "none", env_kwargs=FEW))
    for what, name, files in (
        ("merge", "me/merge", ["README.md", "config.json", "model.safetensors"]),
        (str(path), "me/fast", ["README.md", "policy.zip"]),
    ):
        monkeypatch.setattr(sys, "argv", ["push", what, name])
        run_entry_point(main)
        assert capsys.readouterr().out == f"pushed to {hub.address}/{name}\n"
        assert sorted(hub.files(name)) == files
