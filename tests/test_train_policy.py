"""The entry point, in-process and tiny; constant-velocity forecasts need no checkpoint."""

import contextlib
import io
import json
import os
import shutil
import signal
import subprocess
import sys
import time
import zipfile
from collections.abc import Callable
from dataclasses import asdict, astuple, replace
from pathlib import Path
from typing import Any, Literal

import imageio_ffmpeg
import pytest

import train_policy
from agents import evaluate, results
from agents.presets import Algorithm, PPOPreset, Preset, preset_for
from agents.results import Evaluation
from agents.runs import load_model
from agents.task import Backend
from agents.training import SaveCheckpoint, TrainingPlan
from envs.sb3.policy_file import NOTE_ENTRY, read_note, read_policy_note
from envs.video.highway import record_episode
from predictor.support.errors import UserError, run_entry_point
from tests.agents.helpers import TOY

# SB3 silences this warning at import, pytest makes it an error again.
pytestmark = pytest.mark.filterwarnings("ignore:rich is experimental")

TINY = (
    "--observe", "constant-velocity", "--num-envs", "1", "--selections", "1", "--selection-episodes", "1",
    "--eval-episodes", "1", "--checkpoint-every", "1",
)  # fmt: skip
CONSTANT = ("lane-left", "idle", "lane-right", "faster", "slower")
"""Constant actions of the highway."""
ROLLOUT = 20
PPO = (*TINY, "--steps", str(2 * ROLLOUT))
DQN = (*TINY, "--algorithm", "dqn", "--steps", str(2 * ROLLOUT))  # learns from step 10 on
TAG = (*TINY[2:], "--env-id", "simple_tag_v3", "--checkpoint", "constant-velocity", "--steps", str(2 * ROLLOUT))
"""Arguments of a run with two rollouts of three pursuers."""


def short_preset(env_id: str, algorithm: Algorithm, backend: Backend = "gymnasium") -> Preset:
    """Returns the preset with short rollouts and few gradient steps: the command is tested, not the learning."""
    preset = preset_for(env_id, algorithm, backend)
    if isinstance(preset, PPOPreset):
        return replace(preset, n_steps=ROLLOUT, batch_size=ROLLOUT, n_epochs=1)
    return replace(preset, learning_starts=10)


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    """Trains with short rollouts and makes short films."""
    shorten(monkeypatch)


def shorten(patch: pytest.MonkeyPatch) -> None:
    patch.setattr("agents.training.preset_for", short_preset)
    patch.setattr("agents.video.MAX_VIDEO_STEPS", 12)


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    def run(*arguments: str) -> None:
        monkeypatch.setattr(sys, "argv", ["train_policy.py", *arguments])
        run_entry_point(train_policy.main)

    return run


def trained(run: Path, *arguments: str, short: bool = True) -> tuple[Path, str]:
    """Returns a run and its output."""
    printed = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(printed):
        if short:
            shorten(patch)
        patch.setattr(sys, "argv", ["train_policy.py", *arguments, "--out", str(run)])
        run_entry_point(train_policy.main)
    return run, printed.getvalue()


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """Returns a finished run on the highway; every policy counts as constant in its table."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(results, "NEARLY_CONSTANT", 0.0)
        return trained(tmp_path_factory.mktemp("finished") / "run", *PPO)


@pytest.fixture(scope="module")
def chased(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """Returns a finished run of pursuers."""
    return trained(tmp_path_factory.mktemp("chased") / "run", *TAG[:-1], str(ROLLOUT))


def assert_video(path: Path, least_s: float) -> None:
    """Checks that the file is a video that decodes."""
    assert path.read_bytes()[4:8] == b"ftyp"
    frames, seconds = imageio_ffmpeg.count_frames_and_secs(path)
    assert frames > 10
    assert seconds >= least_s


def error_line(capsys: pytest.CaptureFixture[str]) -> str:
    captured = capsys.readouterr()
    lines = [line for line in captured.err.splitlines() if line.strip()]
    assert len(lines) == 1, captured.err
    assert lines[0].startswith("error: ")
    return lines[0]


def test_one_command_trains_evaluates_and_films(finished: tuple[Path, str]):
    run, printed = finished
    names = {p.name for p in run.iterdir()}
    assert names == {
        "config.json", "tb", "checkpoint.zip", "best_model.zip", "policy.zip",
        "curve.json", "summary.json", "summary.md", "episodes.parquet", "video.mp4",
    }  # fmt: skip
    summary = json.loads((run / "summary.json").read_text())
    assert [line["policy"] for line in summary["policies"]] == ["ppo (constant-velocity)", *CONSTANT, "random"]
    assert summary["differences"]["reference"] in CONSTANT
    assert {e["seed"] for found in summary["episodes"].values() for e in found} == {evaluate.EVALUATION_SEED}
    assert "(Nearly) constant: ppo (constant-velocity) takes" in printed
    config = json.loads((run / "config.json").read_text())
    assert config["config"]["steps"] == 2 * ROLLOUT
    assert config["provenance"][0]["versions"]["stable-baselines3"]
    assert list((run / "tb").rglob("events.out.tfevents.*"))
    for text in ("ppo", "random", "idle", "crash rate"):
        assert text in printed
    assert_video(run / "video.mp4", least_s=1)
    assert "video.mp4" in printed.replace("\n", "")


def test_best_model_carries_its_result(finished: tuple[Path, str]):
    run, _ = finished
    note = read_note(run / "policy.zip")
    assert note["steps"] == 2 * ROLLOUT
    assert 0 <= note["selection_return"] <= 30  # highway-env's rewards lie in [0, 1], 30 steps
    assert (run / "policy.zip").read_bytes() == (run / "best_model.zip").read_bytes()


@pytest.mark.slow
def test_a_finished_policy_is_evaluated_again(finished: tuple[Path, str], monkeypatch: pytest.MonkeyPatch):
    run, _ = finished
    arguments = ["evaluate.py", "--run-dir", str(run), "--episodes", "1", "--num-envs", "1"]
    monkeypatch.setattr(sys, "argv", arguments)
    run_entry_point(evaluate.main)
    again = json.loads((run / "evaluation" / "summary.json").read_text())
    assert again["episodes"] == json.loads((run / "summary.json").read_text())["episodes"]


@pytest.mark.slow
def test_a_policy_that_ships_is_measured_by_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    words = "--run-dir highway-fast --episodes 1 --num-envs 1 --drivers none"
    monkeypatch.setattr(sys, "argv", ["evaluate.py", *words.split()])
    with pytest.raises(SystemExit):
        run_entry_point(evaluate.main)
    assert "highway-fast is no run folder; say with --out where the results go" in error_line(capsys)
    monkeypatch.setattr(sys, "argv", ["evaluate.py", *words.split(), "--out", str(tmp_path)])
    run_entry_point(evaluate.main)
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert (summary["algorithm"], summary["observe"], summary["env_id"]) == ("ppo", "forecast", "highway-fast-v0")
    assert [line["policy"] for line in summary["policies"]] == ["ppo (forecast)", "random", "idle"]


@pytest.mark.slow
def test_best_median_and_worst_episodes_are_filmed(
    finished: tuple[Path, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    """Each film shows the episode that was measured."""
    recorded: list[tuple[int, float]] = []

    def record(*arguments: Any, **options: Any) -> Any:
        recording = record_episode(*arguments, **options | {"max_steps": None})
        recorded.append((options["seed"], recording.total_reward))
        return recording

    monkeypatch.setattr("agents.video.record_episode", record)
    words = f"--run-dir {finished[0]} --episodes 3 --num-envs 1 --drivers none --films --out {tmp_path}"
    monkeypatch.setattr(sys, "argv", ["evaluate.py", *words.split()])
    run_entry_point(evaluate.main)
    summary = json.loads((tmp_path / "summary.json").read_text())
    returns = {e["seed"]: e["episode_return"] for e in summary["episodes"]["ppo (constant-velocity)"]}
    films = summary["films"]
    assert [film["file"] for film in films.values()] == ["best.mp4", "median.mp4", "worst.mp4"]
    assert [film["return"] for film in films.values()] == sorted(returns.values(), reverse=True)
    assert recorded == [(film["seed"], pytest.approx(returns[film["seed"]])) for film in films.values()]
    for film in films.values():
        assert_video(tmp_path / film["file"], least_s=0.5)
    assert "films: best.mp4, median.mp4, worst.mp4" in capsys.readouterr().out


def with_note(run: Path, target: Path, change: Callable[[dict[str, Any]], None]) -> Path:
    """Copies a run and gives its policy another note."""
    shutil.copytree(run, target, ignore=shutil.ignore_patterns("evaluation"))
    with zipfile.ZipFile(run / "policy.zip") as whole, zipfile.ZipFile(target / "policy.zip", "w") as copy:
        for name in whole.namelist():
            content = whole.read(name)
            if name == NOTE_ENTRY:
                note = json.loads(content)
                change(note)
                content = json.dumps(note).encode()
            copy.writestr(name, content)
    return target


OTHER = {"checkpoint": "mine", "sha256": "ab" * 32}


def test_a_policy_and_its_run_pin_their_forecaster(finished: tuple[Path, str]):
    run, _ = finished
    note = read_policy_note(run / "policy.zip")
    assert note is not None and note.forecaster is not None
    assert (note.forecaster.checkpoint, note.forecaster.sha256) == ("constant-velocity", None)
    assert (note.forecaster.horizon_steps, note.forecaster.num_samples) == (5, 1)
    assert json.loads((run / "config.json").read_text())["config"]["forecaster"] == asdict(note.forecaster)
    assert read_policy_note(run / "checkpoint.zip") == note


def test_a_policy_is_not_evaluated_on_another_forecaster(
    finished: tuple[Path, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    run = with_note(finished[0], tmp_path / "run", lambda note: note["policy"]["forecaster"].update(OTHER))
    monkeypatch.setattr(sys, "argv", ["evaluate.py", "--run-dir", str(run), "--episodes", "1", "--num-envs", "1"])
    with pytest.raises(SystemExit) as exit_:
        run_entry_point(evaluate.main)
    assert exit_.value.code == 2
    line = error_line(capsys)
    assert "was trained on forecaster 'mine' (SHA-256 abababababab…), but gets 'constant-velocity'" in line
    assert not (run / "evaluation").exists()


@pytest.mark.slow
def test_a_policy_without_a_pin_is_evaluated_with_a_notice(
    finished: tuple[Path, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    run = with_note(finished[0], tmp_path / "run", lambda note: note.pop("policy"))
    monkeypatch.setattr(sys, "argv", ["evaluate.py", "--run-dir", str(run), "--episodes", "1", "--num-envs", "1"])
    run_entry_point(evaluate.main)
    assert "does not say which forecaster it was trained on" in " ".join(capsys.readouterr().err.split())
    assert (run / "evaluation" / "summary.json").exists()


def test_a_policy_without_forecasts_needs_no_pin(
    finished: tuple[Path, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    """One that was saved before notes existed has none, and is not told that it lacks a forecaster."""
    run = with_note(finished[0], tmp_path / "run", lambda note: note.pop("policy"))
    config = json.loads((run / "config.json").read_text())
    config["config"]["observe"] = "none"
    (run / "config.json").write_text(json.dumps(config))
    played: list[Any] = []
    monkeypatch.setattr(evaluate, "evaluate_with_progress", lambda *task: played.append(task) or Evaluation("", 0, {}))
    monkeypatch.setattr(Evaluation, "write", lambda *folder, **extra: None)
    monkeypatch.setattr(Evaluation, "table", lambda evaluation: "")
    monkeypatch.setattr(sys, "argv", ["evaluate.py", "--run-dir", str(run)])
    run_entry_point(evaluate.main)
    assert played and capsys.readouterr().err == ""


@pytest.mark.usefixtures("short")
@pytest.mark.parametrize("pinned", [True, False])
def test_a_run_goes_on_with_its_own_forecaster_only(
    command: Callable[..., None],
    pinned: bool,
    finished: tuple[Path, str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    run = tmp_path / "run"
    run.mkdir()
    content = json.loads((finished[0] / "config.json").read_text())
    if pinned:
        content["config"]["forecaster"].update(OTHER)
    else:
        del content["config"]["forecaster"]
    (run / "config.json").write_text(json.dumps(content))
    monkeypatch.setattr(train_policy, "train", lambda *arguments: sys.exit(0))
    capsys.readouterr()
    with pytest.raises(SystemExit) as exit_:
        command(*PPO, "--out", str(run), "--resume")
    if pinned:
        assert exit_.value.code == 2
        assert "was trained on forecaster 'mine' (SHA-256 abababababab…)" in error_line(capsys)
    else:
        assert exit_.value.code == 0
        assert "does not say which forecaster it was trained on" in " ".join(capsys.readouterr().out.split())


def test_pursuers_are_trained_measured_and_filmed_against_a_prey_that_is_driven(chased: tuple[Path, str]):
    run, printed = chased
    names = {p.name for p in run.iterdir()}
    assert {"config.json", "policy.zip", "summary.json", "summary.md", "video.mp4"} <= names
    config = json.loads((run / "config.json").read_text())["config"]
    assert (config["env_id"], config["learners"], config["partner"]) == ("simple_tag_v3", ["adversary"], "heuristic")
    assert config["envs"] == 1
    assert load_model(run / "policy.zip", "ppo").num_timesteps == ROLLOUT  # three pursuers learn in each
    summary = json.loads((run / "summary.json").read_text())
    assert [line["policy"] for line in summary["policies"]] == ["ppo (forecast)", "random", "heuristic"]
    assert all(line["crash_rate"] is None and line["length_mean"] == 25 for line in summary["policies"])
    assert (run / "summary.md").read_text().startswith("| policy | return | length |")
    assert "crash" not in printed
    assert_video(run / "video.mp4", least_s=1)


def test_pursuers_are_evaluated_again(chased: tuple[Path, str], monkeypatch: pytest.MonkeyPatch):
    run, _ = chased
    monkeypatch.setattr(sys, "argv", ["evaluate.py", "--run-dir", str(run), "--episodes", "1"])
    run_entry_point(evaluate.main)
    again = json.loads((run / "evaluation" / "summary.json").read_text())
    assert again["episodes"] == json.loads((run / "summary.json").read_text())["episodes"]


@pytest.mark.slow
def test_agents_without_forecasts_are_trained_and_filmed(tmp_path: Path):
    arguments = [*TINY[2:], "--env-id", "simple_spread_v3", "--observe", "none", "--steps", str(3 * ROLLOUT)]
    run, printed = trained(tmp_path / "run", *arguments)
    assert json.loads((run / "config.json").read_text())["config"]["learners"] == []
    assert load_model(run / "policy.zip", "ppo").observation_space.shape == (18,)
    lines = (run / "summary.md").read_text().splitlines()
    assert [line.split(" | ")[0] for line in lines[2:5]] == ["| ppo (none)", "| random", "| heuristic"]
    assert "video.mp4" in printed.replace("\n", "")
    assert_video(run / "video.mp4", least_s=1)


@pytest.mark.slow
def test_policies_trained_on_envpool_are_measured_on_the_original(tmp_path: Path):
    pytest.importorskip("envpool")
    arguments = ["--num-envs", "16", *TINY[4:], "--backend", "envpool", "--checkpoint", "constant-velocity"]
    run, _ = trained(tmp_path / "run", *arguments, "--steps", "512", "--no-video", short=False)
    config = json.loads((run / "config.json").read_text())["config"]
    assert (config["backend"], config["preset"]["n_steps"]) == ("envpool", 32)
    assert load_model(run / "policy.zip", "ppo").num_timesteps == 512
    summary = json.loads((run / "summary.json").read_text())
    assert summary["env_id"] == "highway-fast-v0"
    assert [line["policy"] for line in summary["policies"]] == ["ppo (forecast)", *CONSTANT, "random"]
    assert all(0 < line["return_mean"] <= 30 for line in summary["policies"])
    assert not (run / "video.mp4").exists()


@pytest.mark.parametrize(
    ("env_id", "backend", "sizes"),
    [
        ("highway-fast-v0", "gymnasium", train_policy.Sizes(6, 20_000, 20, 50)),
        ("highway-fast-v0", "envpool", train_policy.Sizes(64, 20_000, 20, 50)),
        ("intersection-multi-agent-v2", "gymnasium", train_policy.Sizes(6, 20_000, 20, 50)),
        ("simple_tag_v3", "gymnasium", train_policy.Sizes(64, 60_000, 100, 200)),
    ],
)
def test_sizes_by_default(env_id: str, backend: Literal["gymnasium", "envpool"], sizes: train_policy.Sizes):
    config = train_policy.TrainPolicyConfig(env_id, backend=backend)
    assert config.sizes == sizes
    plan = config.plan
    assert (plan.num_envs, plan.steps, plan.selection_episodes) == astuple(sizes)[:3]
    given = train_policy.Sizes(3, 100, 1, 7)
    assert train_policy.TrainPolicyConfig(env_id, backend=backend, **asdict(given)).sizes == given


def test_options_reach_the_task():
    given = {
        "timeout_s": 7.0,
        "crash_key": "outcome.hit",
        "success_key": "outcome.goal",
        "env_kwargs": '{"config": {}}',
    }
    task = train_policy.TrainPolicyConfig("highway-fast-v0", **given).plan.task
    assert {name: getattr(task, name) for name in given} == given


@pytest.mark.parametrize(
    ("env_id", "asked", "learners"),
    [
        ("simple_tag_v3", None, ("adversary",)),
        ("simple_tag_v3", (), ()),
        ("simple_tag_v3", ("agent_0",), ("agent_0",)),
        ("simple_spread_v3", None, ()),
        ("highway-fast-v0", None, ()),
    ],
)
def test_who_learns(env_id: str, asked: tuple[str, ...] | None, learners: tuple[str, ...]):
    task = train_policy.TrainPolicyConfig(env_id, learners=asked).plan.task
    assert task.learners == learners


@pytest.mark.slow
@pytest.mark.usefixtures("short")
@pytest.mark.parametrize(
    ("arguments", "interrupted_at"),
    [(PPO, ROLLOUT), (DQN, ROLLOUT), (TAG, ROLLOUT)],
    ids=["ppo", "dqn", "pursuers"],
)
def test_interrupted_run_goes_on_where_it_was(
    command: Callable[..., None],
    arguments: tuple[str, ...],
    interrupted_at: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
):
    run = tmp_path / "run"
    algorithm = "dqn" if "dqn" in arguments else "ppo"
    save = SaveCheckpoint._on_rollout_start

    def save_then_die(self: SaveCheckpoint) -> None:
        save(self)
        if self._saved_at >= interrupted_at:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(SaveCheckpoint, "_on_rollout_start", save_then_die)
        with pytest.raises(SystemExit) as exit_:
            command(*arguments, "--out", str(run))
    assert exit_.value.code == 130
    interrupted = load_model(run / "checkpoint.zip", algorithm)
    assert interrupted.num_timesteps == interrupted_at
    assert not (run / "policy.zip").exists()

    started_at: list[int] = []
    start = SaveCheckpoint._on_training_start

    def note_start(self: SaveCheckpoint) -> None:
        started_at.append(self.model.num_timesteps)
        start(self)

    monkeypatch.setattr(SaveCheckpoint, "_on_training_start", note_start)
    command(*arguments, "--out", str(run), "--no-video", "--resume")
    assert started_at == [interrupted_at]
    finished = load_model(run / "checkpoint.zip", algorithm)
    assert finished.num_timesteps == int(arguments[-1])
    if algorithm == "dqn":
        assert finished.replay_buffer.size() == 2 * ROLLOUT  # type: ignore[attr-defined]
    assert (run / "policy.zip").exists()
    assert (run / "summary.md").exists()


@pytest.mark.slow
def test_kill_nine_then_resume(command: Callable[..., None], tmp_path: Path):
    run = tmp_path / "run"
    arguments = [*DQN[:-1], "80", "--set", "learning_starts=10", "--out", str(run), "--no-video"]
    root = Path(train_policy.__file__).parent
    process = subprocess.Popen([sys.executable, "train_policy.py", *arguments], cwd=root)
    while not (run / "checkpoint.zip").exists():
        assert process.poll() is None, "it ended before its first checkpoint; what it said is above"
        time.sleep(0.05)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    reached = load_model(run / "checkpoint.zip", "dqn").num_timesteps
    assert 0 < reached < 80
    command(*arguments, "--resume")
    assert load_model(run / "checkpoint.zip", "dqn").num_timesteps == 80


def test_resume_with_another_config_names_the_field(
    short: None,
    command: Callable[..., None],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
):
    run = tmp_path / "run"
    monkeypatch.setattr(train_policy, "train", lambda *arguments: sys.exit(0))
    with pytest.raises(SystemExit):
        command(*PPO, "--out", str(run))
    before = (run / "config.json").read_bytes()
    capsys.readouterr()
    with pytest.raises(SystemExit) as exit_:
        command(*PPO, "--out", str(run), "--resume", "--seed", "3")
    assert exit_.value.code == 2
    assert "seed was 0, now 3" in error_line(capsys)
    with pytest.raises(SystemExit) as exit_:
        command(*PPO, "--out", str(run))
    assert exit_.value.code == 2
    assert "exists; choose another --out" in error_line(capsys)
    assert (run / "config.json").read_bytes() == before


def test_hyperparameters_are_recorded_and_compared_on_resume(
    command: Callable[..., None], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    """From a file and from the command line, which counts more; in whatever form they are given again."""
    run, file = tmp_path / "run", tmp_path / "mine.toml"
    file.write_text("learning_rate = 1e-3\ngamma = 0.95\n")
    plans: list[TrainingPlan] = []

    def note(plan: TrainingPlan, folder: Path) -> None:
        plans.append(plan)
        sys.exit(0)

    monkeypatch.setattr(train_policy, "train", note)
    with pytest.raises(SystemExit):
        command(*PPO, "--out", str(run), "--preset", str(file), "--set", "gamma=0.9", "net_arch=8,8")
    expected = PPOPreset(learning_rate=1e-3, gamma=0.9, net_arch=(8, 8))
    assert plans[0].preset == expected
    config = json.loads((run / "config.json").read_text())["config"]
    assert config["preset"] == {**asdict(expected), "net_arch": [8, 8]}
    assert (config["preset_file"], config["set"]) == (str(file), ["gamma=0.9", "net_arch=8,8"])
    words = ("--set", "net_arch=[8,8]", "learning_rate=0.001", "gamma=0.9")
    with pytest.raises(SystemExit) as exit_:
        command(*PPO, "--out", str(run), "--resume", *words)
    assert exit_.value.code == 0 and plans[1].preset == expected
    capsys.readouterr()
    for changed, message in (
        ((), "preset.learning_rate was 0.001, now 0.0005; pass the old value"),
        ((*words[:-1], "gamma=0.8"), "preset.gamma was 0.9, now 0.8; pass the old value"),
    ):
        with pytest.raises(SystemExit) as exit_:
            command(*PPO, "--out", str(run), "--resume", *changed)
        assert exit_.value.code == 2 and message in error_line(capsys)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--env-id", "highway-fats-v0"), "cannot make env 'highway-fats-v0'"),
        (("--checkpoint", "nowhere"), "no checkpoint 'nowhere'"),
        (("--checkpoint", "highway", "--observe", "none"), "has no effect with observe=none"),
        (("--steps", "-5"), "steps must be at least 1, got -5"),
        (("--steps", "0"), "steps must be at least 1, got 0"),
        (("--num-envs", "0"), "num_envs must be at least 1, got 0"),
        (("--eval-episodes", "0"), "eval_episodes must be at least 1, got 0"),
        (("--seed", "-1"), "seed must lie in"),
        (("--device", "tpu9"), "device must be cpu, cuda or auto, got 'tpu9'"),
        (("--env-id", "nonsense"), "cannot make env 'nonsense'"),
        (
            ("--env-id", "simple_tag_v3", "--observe", "none", "--learners", "nonsense"),
            "learners: 'nonsense' is neither an agent nor a role of simple_tag_v3",
        ),
        (("--learners", "adversary"), "learners are for PettingZoo environments, highway-fast-v0 has one ego"),
        (("--env-id", "simple_tag_v3", "--driver", "nonsense"), "driver must be one of random, idle, varied"),
        (("--env-id", TOY, "--observe", "none", "--learners", "ant"), "no heuristic drives meadow_v0"),
        (("--env-id", TOY, "--observe", "constant-velocity"), "no scene reader knows meadow_v0"),
        (("--backend", "envpool", "--env-id", "merge-mixed-v0"), "EnvPool has no copy of 'merge-mixed-v0'"),
        (("--backend", "envpool", "--env-id", "simple_tag_v3"), "backend envpool has no simple_tag_v3"),
        (
            ("--env-id", "racetrack-v1", "--algorithm", "dqn", "--observe", "none"),
            "dqn needs a discrete action space",
        ),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, tuple) else "",
)
def test_bad_input_is_one_clear_line_and_leaves_nothing(
    command: Callable[..., None],
    arguments: tuple[str, ...],
    message: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
):
    run = tmp_path / "run"
    with pytest.raises(SystemExit) as exit_:
        command(*arguments, "--out", str(run))
    assert exit_.value.code == 2
    assert message in error_line(capsys)
    assert not run.exists()


def test_help_explains_every_field(command: Callable[..., None], capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as exit_:
        command("--help-all")
    assert exit_.value.code == 0
    text = " ".join(capsys.readouterr().out.split())
    for option in (
        "--env-id", "--observe", "--checkpoint", "--resume", "--eval-episodes", "--no-video",
        "--backend", "--learners", "--driver",
    ):  # fmt: skip
        assert option in text


def test_evaluating_no_run_is_one_clear_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(sys, "argv", ["evaluate.py", "--run-dir", str(tmp_path)])
    with pytest.raises(SystemExit) as exit_:
        run_entry_point(evaluate.main)
    assert exit_.value.code == 2
    assert "holds no training run" in error_line(capsys)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"observe": "none", "num_samples": 6}, "num_samples has no effect with observe=none; leave one out"),
        ({"observe": "none", "horizon_steps": 3}, "horizon_steps has no effect with observe=none; leave one out"),
        ({"driver": "mixed"}, "driver drives the other agents of PettingZoo, merge-v1 has one ego; leave driver out"),
        (
            {"shaping": False},
            "no-shaping changes the rewards of simple_tag alone, merge-v1 has one ego; leave no-shaping out",
        ),
        (
            {"env_id": "simple_spread_v3", "shaping": False},
            "no-shaping changes the rewards of simple_tag alone, got simple_spread_v3; leave it out",
        ),
        (
            {"env_id": "simple_spread_v3", "driver": "mixed"},
            r"driver drives the agents that do not learn, and all of simple_spread_v3 do; name those that learn "
            r"\(learners\), or leave driver out",
        ),
        ({"eval_episodes": 20_000}, "eval_episodes must be at most 10,000, got 20000"),
    ],
)
def test_an_option_without_effect_is_refused(options: dict[str, Any], message: str):
    with pytest.raises(UserError, match=f"^{message}$"):
        train_policy.TrainPolicyConfig(**{"env_id": "merge-v1"} | options)
