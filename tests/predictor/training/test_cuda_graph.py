"""Recorded steps: what is copied in, what is taken back after the warm-up, and that the run is that of plain steps."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from predictor.data.windows import WindowBatch
from predictor.support.errors import UserError
from predictor.train import train
from predictor.training import trainer as trainer_module
from predictor.training.batches import HostBatches, PrefetchedBatches, Shapes
from predictor.training.config import TrainConfig
from predictor.training.cuda_graph import CapturedStep, NotCapturableError, default_generator, signature
from predictor.training.objective import window_loss
from predictor.training.trainer import Trainer
from predictor.training.training_data import load_data

SCHEDULES: dict[str, Any] = {
    "min_history_steps": 1,
    "history_steps": 4,
    "horizon_steps": 3,
    "curriculum_steps": 4,
    "kl_warmup_steps": 4,
    "set": ("dropout=0.1",),
}


class FakeRecorder:
    """Like CUDA: warming up executes the work, recording does not, replaying does."""

    def __init__(self, warm_up_steps: int = 3) -> None:
        self.warm_up_steps = warm_up_steps
        self.recorded = self.replayed = self.forgotten = 0

    def warm_up(self, work: Callable[[], None]) -> None:
        for _ in range(self.warm_up_steps):
            work()

    def record(self, work: Callable[[], None]) -> Callable[[], None]:
        self.recorded += 1

        def replay() -> None:
            self.replayed += 1
            work()

        return replay

    def forget(self) -> None:
        self.forgotten += 1


class Refusing(FakeRecorder):
    """A device on which the step turns out to look at a result, after it was run once."""

    def warm_up(self, work: Callable[[], None]) -> None:
        work()
        raise NotCapturableError("this model's results are read by the host during a step")


pytestmark = pytest.mark.usefixtures("tiny")


def config(data: Path, out: Path, **changes: Any) -> TrainConfig:
    small = {"steps": 7, "batch_size": 5, "history_steps": 3, "horizon_steps": 2, "val_fraction": 0.34, "eval_every": 2}
    return TrainConfig(data=(data,), out=out, **({"preset": "fast"} | small | changes))


def made(settings: TrainConfig, recorder: FakeRecorder | None = None, padded: bool = False) -> Trainer:
    """A trainer as it is on a CUDA device: with `padded` fixed shapes, with a recorder replayed steps."""
    trainer = Trainer(settings, load_data(settings))
    trainer._recorder = recorder
    if padded:
        assert isinstance(trainer.batches, HostBatches)
        trainer.batches.shapes = Shapes(3, settings.history_steps, settings.horizon_steps)
    return trainer


def batch(scale: float = 1.0, windows: int = 2) -> WindowBatch:
    states = scale * torch.arange(windows * 3 * 2 * 4, dtype=torch.float32).view(windows, 3, 2, 4)
    return WindowBatch(states, torch.ones(windows, 3, 2).bool(), torch.zeros(windows, dtype=torch.int64))


# --- The books --------------------------------------------------------------------------------------------------------


class Toy:
    """A parameter, an Adam with a rate that is a tensor, and noise."""

    def __init__(self) -> None:
        self.weight = torch.nn.Parameter(torch.tensor([1.0, 2.0, 3.0, 4.0]))
        self.rate = torch.tensor(0.1)
        self.adam = torch.optim.Adam([self.weight], lr=self.rate)
        self.noise = torch.Generator().manual_seed(5)

    def step(self, given: WindowBatch) -> Mapping[str, Tensor]:
        drawn = torch.rand(4, generator=self.noise) + torch.rand(4)
        loss = ((given.states.mean((0, 1, 2)) + drawn) * self.weight).square().sum()
        self.adam.zero_grad(set_to_none=True)
        loss.backward()
        self.adam.step()
        return {"loss": loss.detach()}

    def state(self) -> list[Tensor]:
        return [self.weight, *(v for kept in self.adam.state.values() for v in kept.values())]

    def recorded(self, recorder: FakeRecorder) -> CapturedStep:
        generators = (self.noise, default_generator(torch.device("cpu")))
        return CapturedStep(self.step, batch(), self.state, generators, recorder)


def seeded(toy: Toy, rate: float, seed: int) -> None:
    toy.rate.fill_(rate)
    toy.noise.manual_seed(seed)
    torch.manual_seed(seed)


def test_replaying_is_stepping():
    """Contents are copied in, the rate is read anew at each step, and no trace of the warm-up is left."""
    plain, toy, recorder = Toy(), Toy(), FakeRecorder()
    seeded(toy, 0.3, 1)
    captured = toy.recorded(recorder)
    assert torch.equal(toy.weight, plain.weight) and not any(t.any() for t in toy.state()[1:])
    for step, (scale, rate) in enumerate([(1.0, 0.1), (0.5, 0.2), (-2.0, 0.05)]):
        for each in (plain, toy):
            seeded(each, rate, step)
        expected = plain.step(batch(scale))["loss"]
        seeded(toy, rate, step)
        assert torch.equal(captured(batch(scale))["loss"], expected)
        for ours, theirs in zip(toy.state(), plain.state(), strict=True):
            assert torch.equal(ours, theirs)
    assert (captured.replays, recorder.replayed, recorder.recorded) == (3, 3, 1)


def test_state_that_was_there_is_put_back_in_place():
    toy = Toy()
    toy.step(batch())
    before = [t.clone() for t in toy.state()]
    places = [t.data_ptr() for t in toy.state()]
    drawn = toy.noise.get_state()
    toy.recorded(FakeRecorder())
    assert all(torch.equal(a, b) for a, b in zip(toy.state(), before, strict=True))
    assert [t.data_ptr() for t in toy.state()] == places
    assert torch.equal(toy.noise.get_state(), drawn)


def test_a_refused_recording_leaves_everything_as_it_was():
    toy, plain = Toy(), Toy()
    default = torch.get_rng_state()
    with pytest.raises(NotCapturableError):
        toy.recorded(Refusing())
    assert torch.equal(toy.weight, plain.weight)
    assert torch.equal(toy.noise.get_state(), plain.noise.get_state())
    assert torch.equal(torch.get_rng_state(), default)


def test_another_shape_is_refused():
    captured = Toy().recorded(FakeRecorder())
    with pytest.raises(
        ValueError, match=r"the step was recorded for .*\(2, 3, 2, 4\).*, got .*\(5, 3, 2, 4\).*another"
    ):
        captured(batch(windows=5))
    labelled = replace(batch(), edge_types=torch.zeros(2, 3, 2, 2, dtype=torch.int8))
    with pytest.raises(ValueError, match="edge_types"):
        captured(labelled)
    assert captured.replays == 0


def test_signatures_tell_what_a_recording_is_good_for():
    assert signature(batch()) == signature(batch(3.0))
    assert signature(batch()) != signature(batch(windows=3))


# --- In training ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("changes", [{}, SCHEDULES], ids=["plain", "schedules"])
def test_recorded_training_is_plain_training(circles: Path, tmp_path: Path, changes: dict[str, Any]):
    settings = config(circles, tmp_path, **changes)
    recorder = FakeRecorder()
    plain, recorded = made(settings, padded=True), made(settings, recorder, padded=True)
    for _ in range(6):
        expected, ours = plain.train_step(), recorded.train_step()
        assert recorded.read(ours) == plain.read(expected)
    assert all(torch.equal(a, b) for a, b in zip(plain.model.parameters(), recorded.model.parameters(), strict=True))
    assert recorder.replayed == 6
    # one recording for each length of the free run (1, 1, 2, 2, 3, 3); none is kept that will not come again
    assert recorder.recorded == (3 if changes else 1)
    assert (recorder.forgotten, len(recorded._recorded)) == ((2, 1) if changes else (0, 1))


@pytest.mark.slow
def test_restored_run_records_anew(circles: Path, tmp_path: Path):
    """Recordings know tensors by address, and restoring replaces the optimiser's."""
    settings = config(circles, tmp_path, **SCHEDULES)
    whole = made(settings, FakeRecorder(), padded=True)
    resumed = made(settings, FakeRecorder(), padded=True)
    for _ in range(2):
        whole.train_step()
        resumed.train_step()
    whole.save(tmp_path / "state")
    for _ in range(3):
        whole.train_step()
    resumed.restore(tmp_path / "state")
    assert not resumed._recorded
    for _ in range(3):
        resumed.train_step()
    assert all(torch.equal(a, b) for a, b in zip(whole.model.parameters(), resumed.model.parameters(), strict=True))


def test_a_model_that_cannot_be_recorded_is_trained_all_the_same(circles: Path, tmp_path: Path):
    settings = config(circles, tmp_path)
    plain, trainer = made(settings), made(settings, Refusing())
    for _ in range(3):
        assert trainer.read(trainer.train_step()) == plain.read(plain.train_step())
    reason = "this model's results are read by the host during a step"
    assert trainer.notes == (f"steps are not captured: {reason}",)
    assert trainer._recorder is None


def test_the_user_is_told_once(
    circles: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    original = Trainer.__init__

    def refusing(trainer: Trainer, *args: Any) -> None:
        original(trainer, *args)
        trainer._recorder, trainer.notes = Refusing(), ("first line",)

    monkeypatch.setattr(Trainer, "__init__", refusing)
    train(config(circles, tmp_path / "run"))
    said = capsys.readouterr().out
    assert said.count("first line") == said.count("steps are not captured: this model's results are read") == 1


# --- Not looking ------------------------------------------------------------------------------------------------------


def test_losses_that_are_not_finite_are_found_when_the_numbers_are_read(
    circles: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """As on a CUDA device: the host does not look at every step, and then names the steps that it did not look at."""
    trainer = made(config(circles, tmp_path, steps=100), FakeRecorder())
    trainer._checks_each_loss = False
    trainer.read(trainer.train_step())
    trainer.train_step()

    def diverged(*args: Any) -> Any:
        loss, terms = window_loss(*args)
        return loss * float("nan"), terms

    with monkeypatch.context() as patch:
        patch.setattr(trainer_module, "window_loss", diverged)
        trainer.train_step()
    terms = dict.fromkeys(trainer.train_step(), torch.zeros(()))  # later losses may look as they like
    with pytest.raises(UserError) as error:
        trainer.read(terms)
    message = "the loss or its gradient was not finite in some step from 1 to 3; lower --lr or check the data"
    assert str(error.value) == message


@pytest.mark.slow
def test_numbers_are_read_now_and_then(circles: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """And always before a checkpoint is written, so that none is of a run that has diverged."""
    settings = config(circles, tmp_path / "run", steps=13, eval_every=5)
    original, read, looked = Trainer.__init__, Trainer.read, []

    def rarely(trainer: Trainer, *args: Any) -> None:
        original(trainer, *args)
        trainer.read_every = 4

    def noting(trainer: Trainer, terms: Mapping[str, Tensor]) -> dict[str, float]:
        looked.append(trainer.step)
        return read(trainer, terms)

    monkeypatch.setattr(Trainer, "__init__", rarely)
    monkeypatch.setattr(Trainer, "read", noting)
    train(settings)
    assert looked == [4, 5, 8, 10, 12, 13]


@pytest.mark.slow
def test_run_that_is_read_rarely_ends_like_any_other(circles: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    train(config(circles, tmp_path / "often", **SCHEDULES))
    original = Trainer.__init__

    def rarely(trainer: Trainer, *args: Any) -> None:
        original(trainer, *args)
        trainer.read_every = 4

    monkeypatch.setattr(Trainer, "__init__", rarely)
    train(config(circles, tmp_path / "rarely", **SCHEDULES))
    often, rare = (torch.load(tmp_path / n / "train_state.pt", weights_only=True) for n in ("often", "rarely"))
    assert all(torch.equal(rare["model"][name], value) for name, value in often["model"].items())


# --- On a GPU ---------------------------------------------------------------------------------------------------------

NEEDS_CUDA = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")


@NEEDS_CUDA
@pytest.mark.parametrize("precision", ["float32", "tf32", "bfloat16"])
@pytest.mark.parametrize("data_device", ["cpu", "device"])
@pytest.mark.parametrize("changes", [{}, SCHEDULES], ids=["plain", "schedules"])
def test_captured_steps_are_eager_steps(
    circles: Path, tmp_path: Path, changes: dict[str, Any], data_device: Any, precision: Any
):
    """Same batches, same draws, same weights up to the order of sums."""
    settings = config(
        circles, tmp_path, device="cuda", data_device=data_device, precision=precision, steps=100, **changes
    )
    eager = made_on_cuda(replace(settings, capture="off"))
    captured = made_on_cuda(settings)
    assert eager._recorder is None and captured._recorder is not None
    for _ in range(5):
        expected, ours = eager.read(eager.train_step()), captured.read(captured.train_step())
        assert ours == pytest.approx(expected, rel=1e-4 if precision == "float32" else 5e-2)
    assert captured._recorder is not None and captured._recorded
    for a, b in zip(eager.model.parameters(), captured.model.parameters(), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-3, atol=1e-4 if precision == "float32" else 2e-2)
    captured.close()
    eager.close()


@NEEDS_CUDA
def test_what_is_resident_and_what_is_not_is_the_same_training(circles: Path, tmp_path: Path):
    settings = config(circles, tmp_path, device="cuda", steps=100, **SCHEDULES)
    here, there = (made_on_cuda(replace(settings, data_device=where)) for where in ("cpu", "device"))
    assert isinstance(here.batches, PrefetchedBatches) and not isinstance(there.batches, PrefetchedBatches)
    for _ in range(5):
        assert here.read(here.train_step()) == pytest.approx(there.read(there.train_step()), rel=1e-5)
    here.close()


@NEEDS_CUDA
def test_a_model_whose_results_are_read_is_not_captured_on_cuda(circles: Path, tmp_path: Path):
    trainer = made_on_cuda(config(circles, tmp_path, device="cuda", model="dnri"))
    trainer.read(trainer.train_step())
    assert trainer._recorder is None
    assert "steps are not captured: this model's results are read" in trainer.notes[-1]


@NEEDS_CUDA
def test_run_on_cuda_is_resumed_to_the_same_weights(circles: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    settings = config(circles, tmp_path / "run", device="cuda", **SCHEDULES)
    train(replace(settings, out=tmp_path / "whole"))
    original = Trainer.train_step

    def stopping(trainer: Trainer) -> Mapping[str, Tensor]:
        if trainer.step == 5:
            raise KeyboardInterrupt
        return original(trainer)

    with monkeypatch.context() as patch:
        patch.setattr(Trainer, "train_step", stopping)
        with pytest.raises(KeyboardInterrupt):
            train(settings)
    train(replace(settings, resume=True))
    whole, run = (torch.load(tmp_path / n / "train_state.pt", weights_only=True) for n in ("whole", "run"))
    for name, value in whole["model"].items():
        torch.testing.assert_close(run["model"][name], value, rtol=1e-4, atol=1e-5)


def made_on_cuda(settings: TrainConfig) -> Trainer:
    return Trainer(settings, load_data(settings))
