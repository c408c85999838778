"""The command `agents.watch`: a film beside the policy, or an episode in a window."""

import sys
from pathlib import Path
from typing import Any

import imageio_ffmpeg
import numpy as np
import pytest

from agents.policy import load_policy
from agents.task import Task
from agents.video import recorded
from agents.watch import WatchConfig, main, play_in_window, write_film
from envs.video.window import play
from predictor.baselines.constant_velocity import ConstantVelocity
from predictor.scene import SceneSpec
from predictor.support.errors import UserError, run_entry_point
from tests.agents.helpers import TOY, policy_for
from tests.agents.test_policy import FAST, FEW, saved


@pytest.mark.slow
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
    assert "Meadow cannot be drawn: films are of highway-env, of PettingZoo environments with a reader" in error
    assert error.count("\n") == 1 and not list(tmp_path.glob("*.mp4"))
    with pytest.raises(UserError, match="cannot make multiagent env .* with {'render_mode': 'human'}"):
        play_in_window(WatchConfig(tmp_path / "policy.zip", window=True))


@pytest.mark.slow
def test_a_film_is_as_long_as_asked(tmp_path: Path):
    path, _ = saved(tmp_path, Task(FAST, "none", env_kwargs=FEW))
    lengths = []
    for steps in (1, 2):
        film = write_film(WatchConfig(path, seed=5, out=tmp_path / f"{steps}.mp4", max_steps=steps))
        lengths.append(imageio_ffmpeg.count_frames_and_secs(film)[0])
    assert 0 < lengths[0] < lengths[1]


@pytest.mark.slow
@pytest.mark.parametrize("observe", ["none", "constant-velocity"])
def test_a_window_shows_the_pictures_of_the_film(observe: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    monkeypatch.setattr("envs.video.window.time.sleep", lambda seconds: None)
    path, model = saved(tmp_path, Task(FAST, observe, env_kwargs=FEW))
    recording = recorded(Task(FAST, observe, env_kwargs=FEW), model, 5)
    assert recording is not None
    assert play_in_window(WatchConfig(path, seed=5, window=True)) == len(recording) > 4
    assert play_in_window(WatchConfig(path, seed=5, window=True, max_steps=1)) < len(recording)


def test_an_environment_that_is_not_drawn_has_its_own_window(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    monkeypatch.setattr("agents.watch.time.sleep", lambda seconds: None)
    path, _ = saved(tmp_path, Task("CartPole-v1", "none"))
    assert 1 < play_in_window(WatchConfig(path, seed=5, window=True, max_steps=30)) <= 30


def made_by_hand(spec: SceneSpec) -> ConstantVelocity:
    """A forecaster of a user's own."""
    return ConstantVelocity(spec)


@pytest.mark.slow
def test_a_policy_of_ones_own_forecaster_is_filmed_and_loaded(tmp_path: Path):
    """Its zip, which runs code anyway, names the forecaster; the run's config alone does not import it."""
    own = f"own:{__name__}:made_by_hand"
    saved(tmp_path, Task(FAST, "forecast", own, env_kwargs=FEW), run=True)
    film = write_film(WatchConfig(tmp_path, out=tmp_path / "film.mp4", max_steps=2))
    assert film.read_bytes()[4:8] == b"ftyp"
    policy, env = load_policy(tmp_path)
    assert env.action_space.contains(policy(env.reset(seed=0)[0]))
    saved(tmp_path, Task(FAST, "constant-velocity", env_kwargs=FEW))
    with pytest.raises(UserError, match="imports code; if you trust it, name it yourself with --checkpoint own:"):
        write_film(WatchConfig(tmp_path))


@pytest.mark.slow
def test_ids_of_envpool_are_drawn_by_highway_env(tmp_path: Path):
    pytest.importorskip("envpool")
    path, _ = saved(tmp_path, Task("envpool/HighwayFast-v0", "none"))
    film = write_film(WatchConfig(path, out=tmp_path / "film.mp4", max_steps=2))
    assert film.read_bytes()[4:8] == b"ftyp"


def test_without_a_screen_there_is_no_window(monkeypatch: pytest.MonkeyPatch):
    """SDL draws into memory where it finds none, without a word."""
    for name in ("SDL_VIDEODRIVER", "DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("pygame.display.get_driver", lambda: "offscreen")
    with pytest.raises(UserError, match="cannot open a window: there is no screen; leave out --window"):
        play([np.zeros((8, 8, 3), np.uint8)], 10.0, "film")


def test_a_policy_is_not_filmed_on_another_forecaster(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path, _ = saved(tmp_path, Task(FAST, "constant-velocity", env_kwargs=FEW))
    other = Task(FAST, "constant-velocity", env_kwargs=FEW, horizon_steps=3)
    monkeypatch.setattr("agents.watch.task_of_policy", lambda *given: other)
    for shown in (write_film, play_in_window):
        with pytest.raises(UserError, match="was trained on forecasts with horizon_steps=5, but gets horizon_steps=3"):
            shown(WatchConfig(path, out=tmp_path / "film.mp4"))
    monkeypatch.setattr("agents.watch.task_of_policy", lambda *given: Task(FAST, "none", env_kwargs=FEW))
    with pytest.raises(UserError, match="sees forecasts, but its run's config says observe=none; copy both together"):
        write_film(WatchConfig(path, out=tmp_path / "film.mp4"))
    assert not (tmp_path / "film.mp4").exists()


def test_a_policy_is_a_zip(tmp_path: Path):
    """Drivers tell policies from other names by it."""
    path, _ = saved(tmp_path, Task(FAST, "none", env_kwargs=FEW))
    path.rename(tmp_path / "mine.policy")
    with pytest.raises(UserError, match="a policy is a .zip file, got .*mine.policy; give it that ending"):
        load_policy(tmp_path / "mine.policy")
