"""The command `agents.watch`: a film beside the policy, or an episode in a window."""

import sys
from pathlib import Path

import pytest

from agents.task import Task
from agents.watch import WatchConfig, main, play_in_window
from predictor.support.errors import UserError, run_entry_point
from tests.agents.helpers import TOY, policy_for
from tests.agents.test_policy import FAST, FEW, saved


def test_a_film_is_written_beside_the_policy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    saved(tmp_path, Task(FAST, "constant-velocity", env_kwargs=FEW), run=True)
    monkeypatch.setattr(sys, "argv", ["watch", str(tmp_path), "--seed", "3"])
    run_entry_point(main)
    film = tmp_path / "watch-3.mp4"
    assert film.read_bytes()[4:8] == b"ftyp"
    assert "film: " in capsys.readouterr().out


def test_what_cannot_be_drawn_is_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    from agents.runs import save_model

    task = Task(TOY, "none")
    save_model(policy_for(task), tmp_path / "policy.zip", note=task.note)
    monkeypatch.setattr(sys, "argv", ["watch", str(tmp_path / "policy.zip")])
    with pytest.raises(SystemExit):
        run_entry_point(main)
    error = capsys.readouterr().err
    assert "Meadow cannot be drawn: films are of highway-env and PettingZoo; try --window" in error
    assert error.count("\n") == 1 and not list(tmp_path.glob("*.mp4"))
    with pytest.raises(UserError, match="cannot make multiagent env .* with {'render_mode': 'human'}"):
        play_in_window(WatchConfig(tmp_path / "policy.zip", window=True))


def test_a_window_plays_the_seed_at_the_policys_hands(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    monkeypatch.setattr("agents.watch.time.sleep", lambda seconds: None)
    path, model = saved(tmp_path, Task(FAST, "none", env_kwargs=FEW))
    env = Task(FAST, "none", env_kwargs=FEW).make()
    observation, _ = env.reset(seed=5)
    total, over = 0.0, False
    while not over:
        observation, reward, *ended, _ = env.step(model.predict(observation, deterministic=True)[0])
        total, over = total + float(reward), any(ended)
    assert play_in_window(WatchConfig(path, seed=5, window=True)) == pytest.approx(total)
