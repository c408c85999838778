"""Tuning in-process and tiny: once on zeros, for the rest on a toy, which has nothing to forecast."""

import json
import math
import os
import sys
import tomllib
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import optuna
import pytest
import torch
from stable_baselines3 import PPO

from agents import tune as command
from agents.preset_settings import settings_from_file
from agents.presets import PPOPreset
from agents.task import EVALUATION_SEED, SELECTION_SEED, TUNING_SEED
from agents.training import SaveCheckpoint, TrainingPlan
from agents.tune import TuneConfig, open_study, tune
from agents.vec_envs import SeededEpisodes
from predictor.support.errors import UserError, run_entry_point
from tests.agents.studies.helpers import TOY

HIGHWAY: dict[str, Any] = {"env_id": "highway-fast-v0", "env_kwargs": '{"config": {"duration": 3}}'}
TINY: dict[str, Any] = {"steps": 12, "num_envs": 1, "episodes": 2, "selections": 1, "selection_episodes": 1}


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Makes updates after a few steps."""
    monkeypatch.setattr("agents.training.preset_for", lambda *_: PPOPreset(n_steps=8, batch_size=8, n_epochs=2))
    monkeypatch.setattr("agents.search_space.CHOICES", {"n_steps": (8, 16), "batch_size": (8, 16)})


@pytest.fixture
def toy(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shows policies the toy's own observation, as it has no scenes."""
    monkeypatch.setattr(command, "ARM", "none")


def config(out: Path, **changes: Any) -> TuneConfig:
    return TuneConfig(**{"env_id": TOY, "out": out, "trials": 2, **TINY, **changes})


def study_of(folder: Path) -> optuna.Study:
    return open_study(folder / "tuning.db")


def ended(folder: Path) -> list[tuple[Any, Any]]:
    """Returns parameters and value of the trials that ended."""
    trials = [trial for trial in study_of(folder).get_trials() if trial.state == optuna.trial.TrialState.COMPLETE]
    return [(trial.params, trial.value) for trial in trials]


def test_optuna_says_nothing_of_its_own(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    optuna.logging.set_verbosity(optuna.logging.INFO)
    optuna.logging.enable_propagation()
    try:
        command.open_study(tmp_path / "tuning.db")
    finally:
        optuna.logging.disable_propagation()
    assert not caplog.records


@pytest.mark.slow
def test_the_best_trial_is_written_for_train_policy(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    best = tune(config(tmp_path / "tuned", **HIGHWAY, steps=8))
    lines = capsys.readouterr().out.splitlines()
    assert [line.partition(":")[0] for line in lines] == ["trial 1 of 2", "trial 2 of 2"]
    assert "learning_rate=0.0005" in lines[0] and "gamma=0.8" in lines[0]
    (first, one), (second, other) = ended(tmp_path / "tuned")
    assert (first["learning_rate"], first["gamma"], first["n_steps"]) == (5e-4, 0.8, 8), "the preset itself"
    assert second["learning_rate"] != 5e-4
    found = settings_from_file("ppo", best)
    assert found["net_arch"] == (256, 256) and set(found) == {*PPOPreset.__dataclass_fields__} - {"target_kl"}, (
        "all that is set"
    )
    expected = second if other > one else first
    assert found["learning_rate"] == expected["learning_rate"] and found["gamma"] == expected["gamma"]
    assert f"mean return {max(one, other):.3f} in 1 x 2 episodes" in best.read_text()
    assert f"return {other:.3f}" in lines[1]


@pytest.mark.usefixtures("toy")
def test_a_kill_before_the_best_is_written_loses_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    with monkeypatch.context() as patch:
        values = iter([1.0, 5.0])
        patch.setattr(command, "_measure", lambda *_: next(values))
        write = command._write_best
        patch.setattr(
            command, "_write_best", lambda c, study, preset: len(command._ended(study)) < 2 and write(c, study, preset)
        )
        best = tune(config(tmp_path / "tuned"))
    assert "mean return 1.000" in best.read_text()
    assert "trial 2, the best of 2: mean return 5.000" in tune(config(tmp_path / "tuned")).read_text()


def test_zeros_have_the_sizes_of_the_checkpoint_that_is_named():
    task = TuneConfig(**HIGHWAY, checkpoint="exit").plan({}, 0).task
    assert (task.observe, task.sizes_of) == ("zeros", "exit")
    assert TuneConfig(**HIGHWAY).plan({}, 0).task.sizes_of is None


def test_policies_are_shown_zeros():
    assert TuneConfig(**HIGHWAY).plan({}, 0).task.observe == "zeros"
    assert TuneConfig("simple_tag_v3").plan({}, 0).task.learners == ("adversary",)


@pytest.mark.usefixtures("toy")
def test_seeds_are_used_by_nothing_else(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    queued: list[int] = []
    queue = SeededEpisodes.queue

    def note(self: SeededEpisodes, seeds: Any, driver: Any = None) -> None:
        queued.extend(seeds)
        queue(self, seeds, driver)

    monkeypatch.setattr(SeededEpisodes, "queue", note)
    plans: list[TrainingPlan] = []
    train = command.train

    def trained(plan: TrainingPlan, *arguments: Any, **options: Any) -> Path:
        plans.append(plan)
        return train(replace(plan, in_process=True), *arguments, **options)  # where its seeds are seen

    monkeypatch.setattr(command, "train", trained)
    tune(config(tmp_path / "tuned", trials=1, trainings=2, seed=3))
    seeds = [plan.seed for plan in plans]
    assert seeds == [900_000_300, 900_000_301] and max(seeds) < SELECTION_SEED
    measured = [seed for seed in queued if seed >= TUNING_SEED]
    assert sorted(set(measured)) == [TUNING_SEED, TUNING_SEED + 1] and max(measured) < EVALUATION_SEED
    assert set(queued) - set(measured) == {SELECTION_SEED}
    assert command.TRAINING_SEED + command.MAX_SEED * command.MAX_TRAININGS <= SELECTION_SEED


class Killed(BaseException):
    """Stands for a kill."""


@pytest.mark.slow
@pytest.mark.usefixtures("toy")
def test_a_killed_tuning_ends_as_one_that_was_not(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Killed in the second trial, after a checkpoint; started anew twice, the second time for more trials."""
    plan = TuneConfig.plan
    monkeypatch.setattr(TuneConfig, "plan", lambda *arguments: replace(plan(*arguments), checkpoint_every=8))
    tune(config(tmp_path / "whole", trials=3, steps=32))
    save, started = SaveCheckpoint._on_rollout_start, list[int]()

    def die(self: SaveCheckpoint) -> None:
        save(self)
        started.append(self.model.num_timesteps)
        if started.count(0) == 2 and self.model.num_timesteps > 8:
            raise Killed

    with monkeypatch.context() as patch:
        patch.setattr(SaveCheckpoint, "_on_rollout_start", die)
        with pytest.raises(Killed):
            tune(config(tmp_path / "killed", trials=2, steps=32))
    states = [trial.state.name for trial in study_of(tmp_path / "killed").get_trials()]
    assert states == ["COMPLETE", "RUNNING"]
    tune(config(tmp_path / "killed", trials=2, steps=32))
    before = (tmp_path / "killed" / "trials" / "001" / "0" / "policy.zip").stat().st_mtime_ns
    tune(config(tmp_path / "killed", trials=3, steps=32))
    assert (tmp_path / "killed" / "trials" / "001" / "0" / "policy.zip").stat().st_mtime_ns == before
    found = ended(tmp_path / "whole")
    assert ended(tmp_path / "killed") == found
    assert len({params["learning_rate"] for params, *_ in found}) == 3, "every trial draws for itself"
    states = [trial.state.name for trial in study_of(tmp_path / "killed").get_trials()]
    assert states == ["COMPLETE", "FAIL", "COMPLETE", "COMPLETE"]
    assert (tmp_path / "killed" / "best.toml").read_bytes() == (tmp_path / "whole" / "best.toml").read_bytes()
    assert len(json.loads((tmp_path / "killed" / "tuning.json").read_text())["provenance"]) == 3


@pytest.mark.slow
@pytest.mark.usefixtures("toy")
def test_a_training_with_other_hyperparameters_is_not_continued(tmp_path: Path):
    """As after an update of Optuna that draws other values."""
    folder = tmp_path / "tuned" / "trials" / "001"

    def trained_at() -> int:
        (tmp_path / "tuned" / "tuning.db").unlink(missing_ok=True)
        tune(config(tmp_path / "tuned", trials=1))
        return (folder / "0" / "checkpoint.zip").stat().st_mtime_ns

    first = trained_at()
    assert trained_at() == first
    (folder / "preset.toml").write_text("gamma = 0.5\n")
    assert trained_at() > first
    assert "gamma = 0.8\n" in (folder / "preset.toml").read_text()


@pytest.mark.slow
@pytest.mark.usefixtures("toy")
def test_trials_whose_networks_diverge_count_as_worst(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    measure = command._measure
    message = "Expected parameter logits (Tensor of shape (8, 5)) of distribution Categorical to satisfy ..."

    def diverge(config: TuneConfig, settings: Any, folder: Path) -> float:
        if folder.name == "002":
            raise ValueError(message)
        return measure(config, settings, folder)

    monkeypatch.setattr(command, "_measure", diverge)
    best = tune(config(tmp_path / "tuned"))
    assert "trial 2 of 2: diverged, " in capsys.readouterr().out
    assert tomllib.loads(best.read_text())["learning_rate"] == 5e-4
    message = "another error"
    with pytest.raises(ValueError, match="another error"):
        tune(config(tmp_path / "other"))


@pytest.mark.slow
@pytest.mark.usefixtures("toy")
def test_a_training_that_ends_with_weights_that_are_no_numbers_is_a_trial_that_diverged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    def diverge(model: PPO, *_: Any, **__: Any) -> None:
        with torch.no_grad():
            next(iter(model.policy.parameters())).fill_(math.nan)
        raise ValueError("Expected parameter logits ...")

    monkeypatch.setattr(PPO, "learn", diverge)
    with pytest.raises(UserError, match="the networks of all 2 trials diverged"):
        tune(config(tmp_path / "tuned"))
    assert "trial 1 of 2: diverged, " in (told := capsys.readouterr().out) and "trial 2 of 2: diverged, " in told


@pytest.mark.usefixtures("toy")
def test_a_folder_of_something_else_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(command, "_run_trial", lambda *_: (tmp_path / "tuned" / "best.toml").write_text(""))
    tune(config(tmp_path / "tuned", trials=1))
    tune(config(tmp_path / "tuned", trials=2))
    with pytest.raises(UserError, match="cannot go on in .*: steps was 12, now 13; pass the old value or choose"):
        tune(config(tmp_path / "tuned", steps=13))
    with pytest.raises(UserError, match="checkpoint_every was 2000, now 77; pass the old value"):
        tune(config(tmp_path / "tuned", checkpoint_every=77))
    file = tmp_path / "tuned" / "tuning.json"
    earlier = json.loads(file.read_text())
    del earlier["config"]["checkpoint_every"]  # of a version without
    file.write_text(json.dumps(earlier))
    tune(config(tmp_path / "tuned", trials=2))
    assert config(tmp_path, checkpoint_every=77).plan({}, 0).checkpoint_every == 77
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("")
    with pytest.raises(UserError, match=r"holds notes.txt but no tuning \(tuning.json\); choose another --out"):
        tune(config(tmp_path / "mine"))
    (tmp_path / "tuned" / "tuning.json").write_text("{")
    with pytest.raises(UserError, match="tuning.json is damaged .*; remove"):
        tune(config(tmp_path / "tuned"))


def test_a_missing_optuna_is_one_clear_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setitem(sys.modules, "optuna", None)
    monkeypatch.setattr("torch.set_num_threads", lambda _: None)
    monkeypatch.setattr(sys, "argv", ["tune", "--out", str(tmp_path / "tuned")])
    with pytest.raises(SystemExit):
        run_entry_point(command.main)
    error = capsys.readouterr().err
    assert error == "error: agents.tune needs the optuna package; pip install 'dgvae-rl[tune]'\n"
    assert not (tmp_path / "tuned").exists()


def test_a_study_leaves_no_connection_open(tmp_path: Path):
    """Python 3.13 warns of connections that nobody closes."""
    study = open_study(tmp_path / "tuning.db")
    study.add_trial(optuna.create_trial(value=1.0))
    descriptors = Path("/proc/self/fd")
    if not descriptors.exists():
        pytest.skip("no /proc/self/fd here")
    opened = [os.readlink(link) for link in descriptors.iterdir() if os.path.lexists(link)]
    assert len(study.get_trials()) == 1 and not [path for path in opened if path.startswith(str(tmp_path))]


def test_the_first_trial_is_the_preset_also_where_rollouts_have_odd_sizes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """simple_tag's rollouts of 25 steps share few divisors with its batch of 480."""
    odd = PPOPreset(n_steps=25, batch_size=480, n_epochs=5)
    monkeypatch.setattr("agents.training.preset_for", lambda *_: odd)
    drawn: list[Any] = []
    monkeypatch.setattr(command, "_measure", lambda config, settings, folder: drawn.append(settings) or 0.0)
    config = TuneConfig("simple_tag_v3", out=tmp_path, trials=1, num_envs=6)
    tune(config)
    assert drawn[0]["batch_size"] == 480
    assert drawn[0] == {name: asdict(odd)[name] for name in drawn[0]}


def test_any_folder_may_hold_a_tuning(tmp_path: Path):
    """A question mark begins the options of an address, and %20 is a blank there."""
    folder = tmp_path / "really? 100%20sure"
    folder.mkdir()
    open_study(folder / "tuning.db")
    assert [path.name for path in folder.iterdir()] == ["tuning.db"]


def test_of_equal_trials_the_first_one_is_the_best(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    settings = [{"learning_rate": rate} for rate in (1e-4, 2e-4, 3e-4)]
    values = (1.0, 2.0, 2.0)
    trials = [SimpleNamespace(value=v, params=s) for v, s in zip(values, settings, strict=True)]
    monkeypatch.setattr(command, "_ended", lambda study: trials)
    (tmp_path / "tuned").mkdir()
    command._write_best(config(tmp_path / "tuned"), None, PPOPreset())  # type: ignore[arg-type]
    text = (tmp_path / "tuned" / command.BEST_FILE).read_text()
    assert "trial 2, the best of 3" in text and "0.0002" in text
