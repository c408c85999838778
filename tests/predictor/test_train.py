"""Training: it learns what can be learned, is a function of its seed, and nothing it writes can be lost by a kill."""

import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import zarr
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from predictor import train as training
from predictor.checkpoint import load_checkpoint
from predictor.data.store import Episode, StoreInfo, content_id, read_store, write_store
from predictor.data.windows import WindowBatch
from predictor.dgvae.config import PRESETS
from predictor.evaluation.accuracy import summarise
from predictor.evaluation.outcomes import run_windows
from predictor.forecaster import WindowOutput
from predictor.support.errors import UserError, run_entry_point
from predictor.train import train
from predictor.training.config import TrainConfig
from predictor.training.fitted_scales import typical_change
from predictor.training.objective import window_loss
from predictor.training.trainer import VALIDATION_DRAWS, Trainer
from predictor.training.training_data import load_data
from tests.predictor.data.test_twins import twins_of
from tests.predictor.helpers import FAST_LIKE, PLURAL, circling_episode, following_episode, model, spec, write_circles

ROOT = Path(__file__).parents[2]
State = dict[str, Any]
WITH_DROPOUT = replace(FAST_LIKE, dropout=0.1)


@pytest.fixture(scope="module")
def circles(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_circles(tmp_path_factory.mktemp("data") / "circles")


@pytest.fixture
def tiny(monkeypatch: pytest.MonkeyPatch) -> None:
    """The "fast" preset at a size that trains in milliseconds; dropout, so that its noise is part of what is tested."""
    monkeypatch.setitem(PRESETS, "fast", WITH_DROPOUT)


def config(data: Path, out: Path, **changes: Any) -> TrainConfig:
    small = {"steps": 7, "batch_size": 5, "history_steps": 3, "horizon_steps": 2, "val_fraction": 0.34, "eval_every": 2}
    return TrainConfig(data=(data,), out=out, **({"preset": "fast"} | small | changes))


def weights(trainer: Trainer) -> list[torch.Tensor]:
    return [p.detach().clone() for p in trainer.model.parameters()]


def run(trainer: Trainer, steps: int) -> Trainer:
    for _ in range(steps):
        trainer.train_step()
    return trainer


def assert_same_state(ours: State, expected: State) -> None:
    """Bit for bit, optimiser included."""
    for name in ("step", "best", "stale"):
        assert ours[name] == expected[name], name
    for name, value in expected["model"].items():
        assert torch.equal(ours["model"][name], value), name
    for index, moments in expected["optimizer"]["state"].items():
        for name, value in moments.items():
            assert torch.equal(ours["optimizer"]["state"][index][name], value), (index, name)


def state(out: Path) -> State:
    loaded: State = torch.load(out / "train_state.pt", weights_only=True)
    return loaded


# --- Learning ---------------------------------------------------------------------------------------------------------


def learned(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, episodes: list[Episode], **changes: Any) -> Trainer:
    monkeypatch.setitem(PRESETS, "fast", FAST_LIKE)
    write_store(tmp_path / "store", StoreInfo(spec(), "toy"), episodes)
    settings = config(tmp_path / "store", tmp_path / "run", lr=1e-2, **changes)
    trainer = Trainer(settings, load_data(settings))
    return run(trainer, settings.steps)


@pytest.mark.slow
def test_circles_are_learned(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """Agents that turn at a constant rate: the optimum is exact, and constant velocity is off by metres."""
    episodes = [circling_episode(seed) for seed in range(4)]
    trainer = learned(monkeypatch, tmp_path, episodes, steps=150, batch_size=16, horizon_steps=3, val_fraction=0.25)
    trainer.model.eval()
    seen = trainer.data.train[0]
    found = summarise("model", list(run_windows(trainer.model, seen, np.arange(len(seen)), 3)))
    assert trainer.baseline_m > 2.0
    assert found.min_ade_m < trainer.baseline_m / 5
    assert trainer.validate()[0].min_ade_m < trainer.baseline_m / 2


@pytest.mark.slow
def test_following_is_learned_through_the_edge(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """On held-out episodes; the follower's future is in the ego's velocity, so only messages bring the error down."""
    episodes = [following_episode(seed) for seed in range(60)]
    trainer = learned(monkeypatch, tmp_path, episodes, steps=300, batch_size=32, history_steps=2, val_fraction=0.2)
    assert trainer.baseline_m > 4.0
    assert trainer.validate()[0].min_ade_m < trainer.baseline_m / 4
    first = torch.from_numpy(np.stack([e.states[0] for e in episodes]))
    memory = trainer.model.empty_memory(len(first), 2)
    belief = trainer.model.observe(memory, first, torch.ones(len(first), 2).bool())[1]
    assert belief.edge_probs[:, 1, 0, 1].mean() > 0.9  # the follower listens to the ego


# --- A function of its seed -------------------------------------------------------------------------------------------


def test_equal_seeds_give_equal_weights(tiny: None, circles: Path, tmp_path: Path):
    settings = config(circles, tmp_path)
    one = run(Trainer(settings, load_data(settings)), 5)
    torch.manual_seed(123)
    other = Trainer(settings, load_data(settings))
    for _ in range(5):
        torch.rand(3), np.random.default_rng().random()  # what happens elsewhere does not matter
        other.train_step()
    assert all(torch.equal(a, b) for a, b in zip(weights(one), weights(other), strict=True))


def test_other_seeds_give_other_weights(tiny: None, circles: Path, tmp_path: Path):
    one, other = (
        run(Trainer(settings, load_data(settings)), 2)
        for settings in (config(circles, tmp_path, seed=s) for s in (0, 1))
    )
    assert not any(torch.equal(a, b) for a, b in zip(weights(one), weights(other), strict=True))


def test_steps_differ_in_batch_and_noise(tiny: None, circles: Path, tmp_path: Path):
    settings = config(circles, tmp_path, lr=1e-12)
    trainer = Trainer(settings, load_data(settings))
    losses = [float(trainer.train_step()["loss"]) for _ in range(4)]
    assert len(set(losses)) == 4


def test_validation_does_not_disturb_training(tiny: None, circles: Path, tmp_path: Path):
    settings = config(circles, tmp_path)
    one, other = (Trainer(settings, load_data(settings)) for _ in range(2))
    run(one, 4)
    for _ in range(4):
        other.validate()
        other.train_step()
    assert all(torch.equal(a, b) for a, b in zip(weights(one), weights(other), strict=True))


# --- Stopped and resumed ----------------------------------------------------------------------------------------------


# Everything that changes from step to step.
SCHEDULES = {
    "model": "dgvae",
    "min_history_steps": 1,
    "history_steps": 4,
    "horizon_steps": 3,
    "curriculum_steps": 4,
    "kl_warmup_steps": 4,
    "input_changes": True,
    "set": ("static_dim=2", "innovation_rounds=1", "substeps=2", "pair_matching=window", "hard_samples=true"),
}


@pytest.mark.slow
@pytest.mark.parametrize("stop", [1, 3])
@pytest.mark.parametrize("changes", [{}, SCHEDULES, {"model": "dnri"}], ids=["plain", "schedules", "dnri"])
def test_restored_trainer_continues_exactly(
    tiny: None, circles: Path, tmp_path: Path, stop: int, changes: dict[str, Any]
):
    settings = config(circles, tmp_path, **changes)
    whole = run(Trainer(settings, load_data(settings)), 5)
    run(Trainer(settings, load_data(settings)), stop).save(tmp_path / "state")
    torch.manual_seed(99)
    resumed = Trainer(settings, load_data(settings))
    resumed.restore(tmp_path / "state")
    assert resumed.step == stop
    run(resumed, 5 - stop)
    for name, trainer in (("whole", whole), ("resumed", resumed)):
        trainer.save(tmp_path / name)
    states = [torch.load(tmp_path / name, weights_only=True) for name in ("resumed", "whole")]
    assert_same_state(*states)


def stop_at(step: int) -> Callable[[pytest.MonkeyPatch], None]:
    def patch(monkeypatch: pytest.MonkeyPatch) -> None:
        original = Trainer.train_step

        def train_step(trainer: Trainer) -> Mapping[str, torch.Tensor]:
            if trainer.step == step:
                raise KeyboardInterrupt
            return original(trainer)

        monkeypatch.setattr(Trainer, "train_step", train_step)

    return patch


def stop_before_the_checkpoint(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(training, "save_checkpoint", interrupt)


def stop_between_checkpoint_and_state(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Trainer, "save", interrupt)


def interrupt(*_: object) -> None:
    raise KeyboardInterrupt


@pytest.fixture(scope="module")
def uninterrupted(circles: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with every schedule that nothing stopped."""
    out = tmp_path_factory.mktemp("uninterrupted") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(PRESETS, "fast", WITH_DROPOUT)
        train(config(circles, out, **SCHEDULES))
    return out


@pytest.mark.parametrize(
    "stop",
    [stop_at(0), stop_at(1), stop_at(5), stop_before_the_checkpoint, stop_between_checkpoint_and_state],
    ids=["at_once", "before_the_first_save", "between_saves", "before_the_checkpoint", "before_the_state"],
)
def test_interrupted_run_ends_like_one_that_was_not(
    tiny: None, circles: Path, uninterrupted: Path, tmp_path: Path, stop: Callable[[pytest.MonkeyPatch], None]
):
    settings = config(circles, tmp_path / "run", **SCHEDULES)
    with pytest.MonkeyPatch.context() as patch:
        stop(patch)
        with pytest.raises(KeyboardInterrupt):
            train(settings)
    train(replace(settings, resume=True))
    assert_same_state(state(tmp_path / "run"), state(uninterrupted))
    folders = (tmp_path / "run", uninterrupted)
    for ours, expected in zip(*(sorted(checkpoint_of(folder).items()) for folder in folders), strict=True):
        assert ours[0] == expected[0] and torch.equal(ours[1], expected[1])


@pytest.mark.slow
@pytest.mark.parametrize("step", [3, 4, 7], ids=["between_validations", "before_a_validation", "before_the_last"])
def test_a_run_that_a_signal_stops_ends_like_one_that_was_not(
    tiny: None, circles: Path, uninterrupted: Path, tmp_path: Path, step: int
):
    """The signal comes during a step, after which a validation may be due."""
    settings, train_step = config(circles, tmp_path / "run", **SCHEDULES), Trainer.train_step

    def signalled(trainer: Trainer) -> Mapping[str, torch.Tensor]:
        terms = train_step(trainer)
        if trainer.step == step:
            signal.raise_signal(signal.SIGINT)
        return terms

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Trainer, "train_step", signalled)
        with pytest.raises(KeyboardInterrupt):
            train(settings)
    assert state(tmp_path / "run")["step"] == step
    train(replace(settings, resume=True))
    assert_same_state(state(tmp_path / "run"), state(uninterrupted))
    curves = [json.loads((folder / "curve.json").read_text()) for folder in (tmp_path / "run", uninterrupted)]
    assert curves[0] == curves[1]


def checkpoint_of(out: Path) -> dict[str, torch.Tensor]:
    return load_checkpoint(out / "checkpoint")[0].state_dict()


def test_a_run_that_ended_before_its_first_validation_leaves_its_folder_free(tiny: None, circles: Path, tmp_path: Path):
    out = tmp_path / "run"
    with pytest.raises(UserError, match="the loss is nan at step"):
        train(config(circles, out, lr=1e30, clip_norm=1e30))
    assert (out / "config.json").exists() and not (out / "curve.json").exists()
    assert train(config(circles, out)) == out / "checkpoint"
    with pytest.raises(UserError, match="holds a run already"):
        train(config(circles, out))


def test_paths_may_be_texts(tiny: None, circles: Path, tmp_path: Path):
    given: Any = {"data": str(circles), "out": str(tmp_path / "run")}
    assert config(circles, tmp_path / "run") == replace(config(circles, tmp_path), **given)
    assert replace(config(circles, tmp_path), data=[circles, str(circles)]).data == (circles, circles)
    with pytest.raises(UserError, match="steps must be a whole number, got '1'"):
        replace(config(circles, tmp_path), steps="1")


def test_run_folder_says_how_it_was_made(tiny: None, circles: Path, tmp_path: Path):
    out = tmp_path / "run"
    assert train(config(circles, out)) == out / "checkpoint"
    _, info = load_checkpoint(out / "checkpoint")
    assert (info.spec, info.sources, info.horizon_steps, len(info.std_m)) == (spec(), ("circles",), 2, 2)
    assert info.provenance["result"]["val_constant_velocity_ade_m"] > 1.0
    assert info.provenance["train_config"]["steps"] == 7
    assert info.provenance["stores"] == {str(circles): content_id(circles)}
    recorded = json.loads((out / "config.json").read_text())
    assert recorded["config"]["data"] == [str(circles)]
    assert recorded["provenance"]["versions"]["torch"] == version("torch")
    assert list((out / "tb").glob("events*"))
    assert state(out)["step"] == 7  # the last step is saved although eval_every does not divide it
    assert sorted(p.name for p in out.iterdir()) == ["checkpoint", "config.json", "curve.json", "tb", "train_state.pt"]


def test_what_a_killed_save_left_is_deleted(tiny: None, circles: Path, tmp_path: Path):
    out = tmp_path / "run"
    (out / ".checkpoint.0a1b2c3d.partial").mkdir(parents=True)
    (out / ".train_state.pt.0a1b2c3d.partial.pt").write_text("half")
    train(config(circles, out, steps=2))
    assert not list(out.glob(".*"))


@pytest.mark.slow
def test_finished_run_is_left_as_it_is(tiny: None, circles: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    settings = config(circles, tmp_path / "run")
    train(settings)
    files = [p for p in (tmp_path / "run").rglob("*") if p.is_file() and p.parent.name != "tb"]
    assert tmp_path / "run" / "config.json" in files
    before = {p: (p.read_bytes(), p.stat().st_mtime_ns) for p in files}
    monkeypatch.setattr(Trainer, "train_step", interrupt)
    train(replace(settings, resume=True))
    assert {p: (p.read_bytes(), p.stat().st_mtime_ns) for p in files} == before


def test_more_steps_may_be_asked_for_on_resuming(tiny: None, circles: Path, tmp_path: Path):
    train(config(circles, tmp_path / "run", steps=2))
    more = config(circles, tmp_path / "run", steps=5, resume=True)
    train(more)
    assert state(tmp_path / "run")["step"] == 5
    train(more)  # a run that is finished
    curves = EventAccumulator(str(tmp_path / "run" / "tb")).Reload()
    steps = [point["step"] for point in json.loads((tmp_path / "run" / "curve.json").read_text())]
    assert [point.step for point in curves.Scalars("val/energy_m")] == steps and {2, 5} <= set(steps)


def test_best_checkpoint_is_kept_and_a_stale_run_stops(
    tiny: None, circles: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    validate, errors, kept = Trainer.validate, iter([3.0, 1.0, 1.0, 2.0, 0.5]), []

    def scripted(trainer: Trainer) -> Any:
        kept.append(weights(trainer))
        accuracy, std_m = validate(trainer)
        return replace(accuracy, energy_m=next(errors)), std_m

    monkeypatch.setattr(Trainer, "validate", scripted)
    out = train(config(circles, tmp_path / "run", steps=100, eval_every=1, patience=2))
    assert state(tmp_path / "run")["step"] == 4  # two validations without a better one: as good is not better
    best = load_checkpoint(out)[0]
    assert all(torch.equal(a, b) for a, b in zip(best.parameters(), kept[1], strict=True))
    assert load_checkpoint(out)[1].provenance["result"]["val_energy_m"] == 1.0


@pytest.mark.parametrize("preset", ["fast", "plural"])
def test_the_checkpoint_of_the_lowest_energy_is_kept_whatever_the_errors_say(
    tiny: None, circles: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, preset: Any
):
    """The best of K and the single forecast get worse while the score of the whole distribution gets better."""
    monkeypatch.setitem(PRESETS, "plural", PLURAL)
    validate, scores, kept = Trainer.validate, iter([(2.0, 1.0), (1.0, 5.0), (1.5, 0.5)]), []

    def scripted(trainer: Trainer) -> Any:
        kept.append(weights(trainer))
        accuracy, std_m = validate(trainer)
        energy_m, error_m = next(scores)
        return replace(accuracy, energy_m=energy_m, ade_m=error_m, min_ade_m=error_m, min_joint_ade_m=error_m), std_m

    monkeypatch.setattr(Trainer, "validate", scripted)
    out = train(config(circles, tmp_path / "run", preset=preset, steps=3, eval_every=1))
    best, info = load_checkpoint(out)
    assert all(torch.equal(a, b) for a, b in zip(best.parameters(), kept[1], strict=True))
    result = info.provenance["result"]
    assert (result["step"], result["val_energy_m"], result["val_ade_m"]) == (2, 1.0, 5.0)
    assert result["val_samples"] == (PLURAL.num_modes if preset == "plural" else VALIDATION_DRAWS)
    assert (state(tmp_path / "run")["best"], state(tmp_path / "run")["stale"]) == (1.0, 1)


def test_resumed_run_remembers_its_best(tiny: None, circles: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    validate, errors = Trainer.validate, iter([1.0, 3.0, 2.0, 2.5])

    def scripted(trainer: Trainer) -> Any:
        accuracy, std_m = validate(trainer)
        return replace(accuracy, energy_m=next(errors)), std_m

    monkeypatch.setattr(Trainer, "validate", scripted)
    settings = config(circles, tmp_path / "run", steps=100, eval_every=1, patience=3)
    with pytest.MonkeyPatch.context() as patch:
        stop_at(2)(patch)
        with pytest.raises(KeyboardInterrupt):
            train(settings)
    out = train(replace(settings, resume=True))
    assert (state(tmp_path / "run")["step"], state(tmp_path / "run")["best"]) == (4, 1.0)
    assert load_checkpoint(out)[1].provenance["result"]["step"] == 1


@pytest.mark.slow
def test_a_run_that_stopped_early_says_so_and_goes_on_with_more_patience(
    tiny: None, circles: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    validate = Trainer.validate

    def never_better(trainer: Trainer) -> Any:
        accuracy, std_m = validate(trainer)
        return replace(accuracy, energy_m=1.0), std_m

    monkeypatch.setattr(Trainer, "validate", never_better)
    settings = config(circles, tmp_path / "run", steps=20, eval_every=1, patience=2)
    train(settings)
    why = "stopped at step 3 of 20: 2 validations without a better score; with --resume and a larger --patience it goes"
    assert why in " ".join(capsys.readouterr().out.split())
    train(replace(settings, resume=True, steps=30))
    assert state(tmp_path / "run")["step"] == 3 and "stopped at step 3 of 30" in capsys.readouterr().out
    train(replace(settings, resume=True, steps=30, patience=4))
    assert state(tmp_path / "run")["step"] == 5


@pytest.mark.slow
def test_a_kill_during_a_validation_loses_no_step(tiny: None, circles: Path, tmp_path: Path):
    """It takes the most memory, and begins after many steps."""

    def killed(trainer: Trainer) -> Any:
        raise MemoryError

    settings = config(circles, tmp_path / "run", steps=4, eval_every=2)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Trainer, "validate", killed)
        with pytest.raises(MemoryError):
            train(settings)
    assert state(tmp_path / "run")["step"] == 2 and state(tmp_path / "run")["validated"] == 0
    whole = load_checkpoint(train(replace(settings, out=tmp_path / "whole")))[0]
    resumed = load_checkpoint(train(replace(settings, resume=True)))[0]
    assert all(torch.equal(a, b) for a, b in zip(whole.parameters(), resumed.parameters(), strict=True))


def test_a_horizon_beyond_all_episodes_is_refused_before_windows_are_made(circles: Path, tmp_path: Path):
    longest = max(len(episode.states) for episode in read_store(circles).episodes)
    with pytest.raises(UserError, match=f"episodes have at most {longest} steps, a horizon of {longest} needs"):
        train(config(circles, tmp_path / "run", horizon_steps=longest))
    with pytest.raises(UserError, match="a horizon of 20,000 needs 20,001; lower --horizon-steps"):
        train(config(circles, tmp_path / "run", horizon_steps=20_000))
    assert not (tmp_path / "run" / "train_state.pt").exists()


def test_tracks_shorter_than_the_horizon_are_refused_before_a_step(tiny: None, tmp_path: Path):
    """The episodes are long enough, but nobody stays for the whole horizon."""
    episodes = []
    for seed in range(6):
        whole = circling_episode(seed, steps=9)
        there = np.arange(9)[:, None] // 3 == np.arange(3)
        episodes.append(replace(whole, states=np.repeat(whole.states[:, :1], 3, axis=1) * there[..., None],
                                valid=there, ids=np.arange(3)))  # fmt: skip
    write_store(tmp_path / "data", StoreInfo(spec(has_ego=False), "short tracks"), episodes)
    with pytest.raises(UserError, match="no agent of the validation windows is there for all 4 steps of future"):
        train(config(tmp_path / "data", tmp_path / "run", horizon_steps=4))
    assert not (tmp_path / "run" / "train_state.pt").exists()


# --- kill -9 ----------------------------------------------------------------------------------------------------------

KILLED = """
import os, signal, sys
from predictor import train
from predictor.support import files
replace, exchange, step = os.replace, files._exchange, train.Trainer.train_step
seen = {}

def kill():
    os.kill(os.getpid(), signal.SIGKILL)

def killing_step(trainer):
    kill() if WHERE == "step" and trainer.step == WHEN else None
    return step(trainer)

def killing_replace(source, target):
    name = os.path.basename(target)
    seen[name] = seen.get(name, 0) + 1
    kill() if (name, seen[name]) == (WHERE, WHEN) else None
    return replace(source, target)

def killing_exchange(source, target):
    if WHERE == "exchange":
        kill()
    return WHERE != "checkpoint" and exchange(source, target)  # as where folders cannot be exchanged

os.replace, files._exchange, train.Trainer.train_step = killing_replace, killing_exchange, killing_step
sys.argv = ["train", *sys.argv[1:]]
train.main()
"""


@pytest.fixture(scope="module")
def never_killed(circles: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run that killed ones must end like."""
    out = tmp_path_factory.mktemp("never_killed") / "run"
    train(config(circles, out, threads=1))
    return out


@pytest.mark.slow
@pytest.mark.parametrize(
    ("where", "when"),
    # checkpoint: the old one is already moved away, the new one not yet in its place
    [("step", 1), ("step", 5), ("train_state.pt", 1), ("exchange", 1), ("checkpoint", 1)],
    ids=["before_the_first_save", "between_saves", "in_the_first_save", "exchanging", "replacing_the_checkpoint"],
)
def test_killed_process_is_resumed_to_the_same_weights(
    circles: Path, never_killed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, where: str, when: int
):
    settings = config(circles, tmp_path / "run", threads=1)
    code = KILLED.replace("WHERE", repr(where)).replace("WHEN", repr(when))
    command = [sys.executable, "-c", code, *arguments(settings)]
    killed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert killed.returncode == -signal.SIGKILL, killed.stderr
    monkeypatch.setattr(sys, "argv", ["train", *arguments(settings), "--resume"])
    training.main()
    assert_same_state(state(tmp_path / "run"), state(never_killed))
    ours, expected = checkpoint_of(tmp_path / "run"), checkpoint_of(never_killed)
    assert ours.keys() == expected.keys()
    assert all(torch.equal(value, expected[name]) for name, value in ours.items())


def arguments(settings: TrainConfig) -> list[str]:
    """The command line of a config."""
    names = (
        "out", "model", "preset", "steps", "batch_size", "history_steps", "horizon_steps", "val_fraction", "eval_every",
        "threads",
    )  # fmt: skip
    pairs = [(f"--{name.replace('_', '-')}", str(getattr(settings, name))) for name in names]
    overrides = ["--set", *settings.set] if settings.set else []
    return ["--data", *map(str, settings.data), *(word for pair in pairs for word in pair), *overrides]


# --- Bad input --------------------------------------------------------------------------------------------------------


def refused(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *words: str) -> str:
    """The one line that the entry point prints; its exit status is checked here."""
    monkeypatch.setattr(sys, "argv", ["train", *words])
    with pytest.raises(SystemExit) as stop:
        run_entry_point(training.main)
    assert stop.value.code == 2
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.startswith("error: ") and captured.err.count("\n") == 1
    return captured.err


def contents(folder: Path) -> dict[Path, bytes]:
    return {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()}


@pytest.mark.slow
def test_bad_input_ends_a_real_process_with_one_line(tmp_path: Path):
    words = ["--data", str(tmp_path / "nowhere"), "--out", str(tmp_path / "run")]
    command = [sys.executable, "-m", "predictor.train", *words]
    ended = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert ended.returncode == 2
    assert ended.stdout == ""
    assert ended.stderr == f"error: no episode store at {tmp_path}/nowhere; make one with python -m envs.collect\n"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--steps", "-3"], "steps must be at least 1, got -3"),
        (["--steps", "0"], "steps must be at least 1, got 0"),
        (["--batch-size", "0"], "batch_size must be at least 1, got 0"),
        (["--history-steps", "0"], "history_steps must be at least 1, got 0"),
        (["--horizon-steps", "-1"], "horizon_steps must be at least 1, got -1"),
        (["--val-fraction", "1.0"], "val_fraction must lie between 0 and 1, got 1.0"),
        (
            ["--val-fraction", "0.01"],
            "6 episodes split into 6 for training and 0 for validation; both need at least one",
        ),
        (["--lr", "0"], "lr must be positive, got 0.0"),
        (["--min-history-steps", "11"], "min_history_steps must be at most 10, got 11"),
        (["--min-history-steps", "-1"], "min_history_steps must not be negative, got -1"),
        (["--val-history-steps", "0"], "val_history_steps must lie between 1 and 10, got 0"),
        (["--val-history-steps", "11"], "val_history_steps must lie between 1 and 10, got 11"),
        (["--one-step-weight", "0", "--rollout-weight", "0"], "both 0; nothing would be learned"),
        (["--edge-cost", "-0.1"], "edge_cost must not be negative, got -0.1"),
        (["--label-weight", "nan"], "label_weight must be finite and not negative, got nan"),
        (["--curriculum-steps", "-1"], "curriculum_steps must not be negative, got -1"),
        (["--set", "width=3"], "--set takes field=value with a field of DGVAEConfig (hidden_dim, "),
        (["--set", "rnn_dim=wide"], "rnn_dim of DGVAEConfig must be of type int, got 'wide'"),
        (["--set", "rnn_dim=0"], "rnn_dim must be at least 1, got 0"),
        (["--set", "delta_scales=1,2"], "delta_scales needs 4 positive numbers, got (1.0, 2.0)"),
        (["--set", "rollout_graph=evolving"], "num_modes needs rollout_graph=frozen"),
        (["--device", "cuda"], "device 'cuda' was asked for but torch finds no CUDA device; use --device cpu"),
    ],
)
def test_bad_arguments_are_named(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    circles: Path,
    tmp_path: Path,
    words: list[str],
    message: str,
):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    given = refused(monkeypatch, capsys, "--data", str(circles), "--out", str(tmp_path / "run"), *words)
    assert message in given
    assert list(tmp_path.iterdir()) == []


def test_a_log_file_has_a_line_for_each_validation(
    tiny: None, capsys: pytest.CaptureFixture[str], circles: Path, tmp_path: Path
):
    """Where there is no terminal, the progress bar shows nothing until the end."""
    train(config(circles, tmp_path / "run"))
    lines = re.findall(r"^step (\d+): energy score \d.*constant velocity .*$", capsys.readouterr().out, re.MULTILINE)
    assert lines == ["2", "4", "6", "7"]


@pytest.mark.slow
def test_existing_run_is_not_overwritten(
    tiny: None, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], circles: Path, tmp_path: Path
):
    train(config(circles, tmp_path / "run"))
    capsys.readouterr()
    before = contents(tmp_path)
    given = refused(monkeypatch, capsys, *arguments(config(circles, tmp_path / "run")))
    assert given == f"error: {tmp_path}/run holds a run already; pass --resume to continue it or choose another --out\n"
    assert contents(tmp_path) == before


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"batch_size": 6}, "cannot resume: batch_size was 5 and is now 6; use the same arguments"),
        ({"horizon_steps": 3}, "cannot resume: horizon_steps was 2 and is now 3; use the same arguments"),
        ({"model": "mlp"}, "cannot resume: model was dgvae and is now mlp; use the same arguments"),
        ({"set": ("rnn_dim=4",)}, "cannot resume: set was [] and is now ['rnn_dim=4']; use the same arguments"),
    ],
)
def test_resuming_with_other_arguments_names_them(
    tiny: None,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    circles: Path,
    tmp_path: Path,
    change: Mapping[str, Any],
    message: str,
):
    train(config(circles, tmp_path / "run"))
    capsys.readouterr()
    before = contents(tmp_path)
    changed = arguments(config(circles, tmp_path / "run", **change))
    assert message in refused(monkeypatch, capsys, *changed, "--resume")
    assert contents(tmp_path) == before


def test_resuming_with_another_store_at_the_same_place_is_refused(circles: Path, tmp_path: Path):
    """Its errors would be compared with the best one of the other data."""
    train(config(circles, tmp_path / "run"))
    write_store(circles, StoreInfo(spec(), "circles", {"seeds": [7]}), [circling_episode(7)] * 6, overwrite=True)
    with pytest.raises(UserError, match="cannot resume: .*circles is another store than the run began with; choose"):
        train(config(circles, tmp_path / "run", resume=True))


def test_a_run_without_its_state_is_not_begun_anew(tiny: None, circles: Path, tmp_path: Path):
    train(config(circles, tmp_path / "run", steps=2))
    (tmp_path / "run" / "train_state.pt").unlink()
    curve = (tmp_path / "run" / "curve.json").read_text()
    with pytest.raises(UserError, match="has a curve but no train_state.pt, so that the training would begin anew"):
        train(config(circles, tmp_path / "run", steps=4, resume=True))
    assert (tmp_path / "run" / "curve.json").read_text() == curve


def test_a_run_goes_on_wherever_it_and_its_data_are(tiny: None, circles: Path, tmp_path: Path):
    shutil.copytree(circles, tmp_path / "before")
    train(config(tmp_path / "before", tmp_path / "run", steps=2))
    (tmp_path / "run").rename(tmp_path / "elsewhere")
    (tmp_path / "before").rename(tmp_path / "after")
    train(config(tmp_path / "after", tmp_path / "elsewhere", steps=4, resume=True))
    assert state(tmp_path / "elsewhere")["step"] == 4
    write_store(tmp_path / "other", StoreInfo(spec(), "circles"), [circling_episode(3)] * 6)
    with pytest.raises(UserError, match="cannot resume: data was .*after.* and is now .*other"):
        train(config(tmp_path / "other", tmp_path / "elsewhere", steps=4, resume=True))


def test_the_options_that_a_message_names_continue_a_run_whose_defaults_have_changed(
    tiny: None, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], circles: Path, tmp_path: Path
):
    """Without them, the same command is another one than when the run began."""
    held = tmp_path / "held"
    write_store(held, StoreInfo(spec(), "circles"), [circling_episode(seed, steps=10) for seed in range(9, 12)])
    began = config(circles, tmp_path / "run", input_changes=False, set=("rnn_dim=4", "head_dim=3"), val_data=(held,))
    train(replace(began, steps=2))
    capsys.readouterr()
    command = ["--data", str(circles), "--out", str(tmp_path / "run"), "--steps", "3", "--resume"]
    given = refused(monkeypatch, capsys, *command)
    assert "preset was fast and is now plural, " in given and "input_changes was False and is now True, " in given
    options = shlex.split(given.partition("use the same arguments, with ")[2])
    assert {"--preset", "fast", "--no-input-changes", "--val-data", "rnn_dim=4"} <= set(options)
    assert not {"--edge-geometry", "--fit-inputs"} & set(options)
    monkeypatch.setattr(sys, "argv", ["train", *command, *options])
    training.main()
    assert state(tmp_path / "run")["step"] == 3


def forget(out: Path, option: str) -> None:
    """Removes an option from what a run folder says, as if it had not existed when the run began."""
    recorded = json.loads((out / "config.json").read_text())
    del recorded["config"][option]
    (out / "config.json").write_text(json.dumps(recorded))


@pytest.fixture
def reactions(tmp_path: Path) -> Path:
    """A store of branches with twins: agent 2 goes faster where agent 1 was perturbed."""
    episodes = [episode for seed in range(6) for episode in twins_of(seed, 3.0)]
    write_store(tmp_path / "reactions", StoreInfo(spec(has_ego=True), "circles"), episodes)
    return tmp_path / "reactions"


@pytest.mark.slow
def test_shifts_are_learned_from_branches_and_their_twins(tiny: None, reactions: Path, tmp_path: Path):
    """With a shift of 3 m a step and no other error, the loss on shifts falls; killed and resumed, it is the same."""
    settings = config(reactions, tmp_path / "run", shift_weight=3.0, steps=150, lr=1e-2)
    trainer = Trainer(settings, load_data(settings))
    shifts = [float(trainer.train_step()["shift"]) for _ in range(150)]
    assert min(shifts[-5:]) < 0.8 * min(shifts[:5])
    other = Trainer(replace(settings, out=tmp_path / "other"), load_data(settings))
    run(other, 3).save(tmp_path / "state.pt")
    run(again := Trainer(settings, load_data(settings)), 1).restore(tmp_path / "state.pt")
    assert [float(again.train_step()["shift"]) for _ in range(3)] == shifts[3:6]


@pytest.mark.parametrize("keep", ["best", "last"])
def test_the_best_or_the_last_weights_are_kept(
    tiny: None, circles: Path, tmp_path: Path, keep: str, monkeypatch: pytest.MonkeyPatch
):
    """Each validation is worse than the one before: the first one's weights, or all steps and the last one's."""
    monkeypatch.setattr(Trainer, "score", lambda trainer, accuracy: float(trainer.step))
    train(config(circles, tmp_path / "run", keep=keep, patience=2))
    _, info = load_checkpoint(tmp_path / "run")
    assert info.provenance["result"]["step"] == {"best": 2, "last": 7}[keep]
    assert state(tmp_path / "run")["step"] == {"best": 6, "last": 7}[keep]


def test_shifts_need_twins(tiny: None, circles: Path, tmp_path: Path):
    with pytest.raises(UserError, match="shift_weight needs branches with twins, got none; collect a store with --br"):
        train(config(circles, tmp_path / "run", shift_weight=3.0))
    with pytest.raises(UserError, match="modes learn from roll-outs, and rollout_weight is 0; pass --preset"):
        train(config(circles, tmp_path / "run", rollout_weight=0.0, preset="plural"))
    for name in ("shift_weight", "reaction_weight", "curriculum_steps"):
        with pytest.raises(UserError, match=f"{name} is of roll-outs, and rollout_weight is 0; leave one of them out"):
            config(circles, tmp_path / "run", rollout_weight=0.0, causal_edges=True, **{name: 3})


@pytest.mark.slow
def test_options_without_effect_do_not_stop_a_run(tiny: None, circles: Path, tmp_path: Path):
    other = config(circles, tmp_path / "mlp", model="mlp", input_changes=False, edge_geometry=False)
    train(replace(other, steps=2))
    train(replace(other, input_changes=True, edge_geometry=True, resume=True))
    assert state(tmp_path / "mlp")["step"] == 7
    first = train(config(circles, tmp_path / "first", steps=2))
    settings = config(circles, tmp_path / "run", init=str(first), preset="plural")
    train(replace(settings, steps=2))
    forget(tmp_path / "run", "edge_geometry")
    train(replace(settings, resume=True))
    assert state(tmp_path / "run")["step"] == 7


def test_the_horizon_is_that_of_the_checkpoint_unless_given(tiny: None, circles: Path, tmp_path: Path):
    assert TrainConfig((circles,), tmp_path).horizon_steps == 5
    first = str(train(config(circles, tmp_path / "first", steps=2, horizon_steps=3)))
    assert TrainConfig((circles,), tmp_path, init=first).horizon_steps == 3
    assert TrainConfig((circles,), tmp_path, init=first, horizon_steps=2).horizon_steps == 2
    with pytest.raises(UserError, match="nowhere"):
        TrainConfig((circles,), tmp_path, init="nowhere")


def test_foreign_folder_is_not_written_into(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], circles: Path, tmp_path: Path
):
    (tmp_path / "notes.txt").write_text("mine")
    for resume in ([], ["--resume"]):
        given = refused(monkeypatch, capsys, *arguments(config(circles, tmp_path)), *resume)
        assert given == f"error: {tmp_path} is not empty and not a training run; choose another --out\n"
    assert [p.name for p in tmp_path.iterdir()] == ["notes.txt"]


def test_non_finite_states_in_the_store(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
):
    write_circles(tmp_path / "data")
    states: Any = zarr.open_group(tmp_path / "data", mode="r+")["states"]
    states[13, 1, 2] = np.inf
    given = refused(monkeypatch, capsys, *arguments(config(tmp_path / "data", tmp_path / "run")))
    assert "data: states must be finite, got [" in given and "(episode seed 1, step 3, agent 1)" in given
    assert not (tmp_path / "run").exists()


def test_stores_of_different_time_steps_do_not_mix(circles: Path, tmp_path: Path):
    write_store(tmp_path / "quick", StoreInfo(spec(dt_s=0.2), "quick"), read_store(circles).episodes)
    settings = replace(config(circles, tmp_path / "run"), data=(circles, tmp_path / "quick"))
    with pytest.raises(UserError, match=r"the same dt_s, but .*circles has 1\.0 and .*quick has 0\.2; train on"):
        load_data(settings)


# --- Parts ------------------------------------------------------------------------------------------------------------


def test_stores_are_mixed_by_their_windows(tiny: None, circles: Path, tmp_path: Path):
    write_store(tmp_path / "short", StoreInfo(spec(), "short"), [circling_episode(s, steps=2) for s in range(6)])
    settings = replace(config(circles, tmp_path / "run", batch_size=400), data=(circles, tmp_path / "short"))
    data = load_data(settings)
    assert data.sources == ("circles", "short")
    assert [len(w) for w in data.train] == [4 * 9, 4 * 1]
    trainer = Trainer(settings, data)
    batch = trainer.batches.batch(trainer.plan(0))
    longest = batch.valid[..., 0].sum(dim=1)
    assert len(batch.states) == 400
    assert 20 < int((longest == 2).sum()) < 130  # 1 in 10 from the short store, and the last windows of the other


@pytest.mark.parametrize(
    ("residual", "expected"),
    [("state", [np.sqrt((9 + 16) / 2), 1e-3, 1.0, 1e-3]), ("constant_velocity", [1.0, 1e-3, 1.0, 1e-3])],
)
def test_typical_change_closed_form(residual: str, expected: list[float]):
    states = np.zeros((3, 2, 4), dtype=np.float32)
    states[:, 0, 0], states[:, 0, 2] = (0.0, 3.0, 7.0), (2.0, 3.0, 4.0)  # moves by 3 and 4 m at 2 and 3 m/s
    states[:, 1, 0] = (0.0, 100.0, 0.0)
    valid = np.array([[True, True], [True, False], [True, True]])  # the jumps of the second agent are not seen
    assert typical_change([Episode(states, valid, np.arange(2))], spec(), residual) == pytest.approx(expected)


def test_loss_closed_form(tmp_path: Path):
    """One window, two agents; the last one is absent at the last step. Scales 10, 10, 5, 5."""
    states = torch.zeros(1, 3, 2, 4)
    valid = torch.tensor([[[True, True], [True, True], [True, False]]])
    even = torch.zeros(1, 3, 2, 2, 2)
    one_step, rollout = torch.zeros(1, 3, 2, 4), torch.zeros(1, 2, 2, 4)
    one_step[0, 0, 0, 0] = 10.0  # wrong about step 1
    one_step[0, 1, 1, 0] = one_step[0, 2] = 1e6  # of what does not exist
    rollout[0, 1, 0, 2] = 10.0
    rollout[0, 1, 1, 0] = 1e6
    posterior = even.clone()
    posterior[0, 0, 0, 1] = torch.tensor([0.8, 0.2]).log()
    posterior[0, :, 0, 0] = posterior[0, 2] = 100.0 * torch.tensor([1.0, -1.0])  # no pairs there
    output = WindowOutput(one_step, rollout, even, posterior, torch.zeros(1, 3, 2, 2, 1))
    settings = TrainConfig(
        (tmp_path,), tmp_path, variance=0.5, likelihood="gaussian", one_step_weight=10.0, kl_weight=100.0
    )
    forecaster = model(horizon_steps=2)
    loss, terms = window_loss(forecaster, WindowBatch(states, valid, torch.tensor([0])), output, settings)
    divergence = 0.8 * np.log(1.6) + 0.2 * np.log(0.4)
    assert terms["nll_one_step"].item() == pytest.approx(1 / 3)  # of 3 transitions
    assert terms["nll_rollout"].item() == pytest.approx(4 / 3)  # of 3 future states
    assert terms["kl"].item() == pytest.approx(divergence / 4, rel=1e-5)  # of 4 pairs
    assert terms["prior_entropy"].item() == pytest.approx(np.log(2))
    assert terms["prior_edge_share"].item() == pytest.approx(0.5)
    assert loss.item() == pytest.approx(10 / 3 + 4 / 3 + 100 * divergence / 4, rel=1e-5)


def test_diverged_training_says_so(tiny: None, circles: Path, tmp_path: Path):
    settings = config(circles, tmp_path)
    trainer = Trainer(settings, load_data(settings))
    with torch.no_grad():
        trainer.model.decoder.readout.bias.fill_(float("nan"))
    with pytest.raises(UserError, match="the loss is nan at step 0; lower --lr or check the data"):
        trainer.train_step()


def test_state_is_written_at_once(tiny: None, circles: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    settings = config(circles, tmp_path)
    trainer = Trainer(settings, load_data(settings))
    trainer.save(tmp_path / "state")
    before = (tmp_path / "state").read_bytes()
    trainer.train_step()
    monkeypatch.setattr(os, "replace", interrupt)
    with pytest.raises(KeyboardInterrupt):
        trainer.save(tmp_path / "state")
    assert (tmp_path / "state").read_bytes() == before
