"""Where and how a run is computed: what may change on resuming, what may not, and precision on a CPU."""

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode

from predictor import train as training
from predictor.evaluation.paper_tables import TABLES
from predictor.suite import SuiteConfig, line_config, line_folder
from predictor.support.errors import UserError
from predictor.train import train
from predictor.training import trainer as trainer_module
from predictor.training.config import TrainConfig
from predictor.training.objective import window_loss
from predictor.training.trainer import Trainer
from predictor.training.training_data import load_data

pytestmark = pytest.mark.usefixtures("tiny")


def config(data: Path, out: Path, **changes: Any) -> TrainConfig:
    small = {
        "preset": "fast",
        "steps": 4,
        "batch_size": 16,
        "history_steps": 3,
        "horizon_steps": 2,
        "val_fraction": 0.34,
        "eval_every": 2,
    }
    return TrainConfig(data=(data,), out=out, **(small | changes))


# --- Resuming ---------------------------------------------------------------------------------------------------------


def interrupted(settings: TrainConfig, step: int) -> None:
    original = Trainer.train_step

    def stopping(trainer: Trainer) -> Mapping[str, Tensor]:
        if trainer.step == step:
            raise KeyboardInterrupt
        return original(trainer)

    with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(Trainer, "train_step", stopping)
        train(settings)


@pytest.mark.slow
@pytest.mark.parametrize("change", [{"data_device": "device"}, {"capture": "off"}, {"threads": 1}])
def test_a_run_may_go_on_elsewhere(circles: Path, tmp_path: Path, change: dict[str, Any]):
    """And ends with the same weights, where shapes are the same."""
    train(config(circles, tmp_path / "whole"))
    settings = config(circles, tmp_path / "run")
    interrupted(settings, 3)
    train(replace(settings, resume=True, **change))
    whole, run = (torch.load(tmp_path / n / "train_state.pt", weights_only=True) for n in ("whole", "run"))
    for name, value in whole["model"].items():
        torch.testing.assert_close(run["model"][name], value, rtol=1e-6, atol=1e-7)


def test_precision_stays_what_it_was(circles: Path, tmp_path: Path):
    settings = config(circles, tmp_path / "run")
    train(settings)
    with pytest.raises(UserError, match="precision was float32 and is now bfloat16; use the same arguments"):
        train(replace(settings, resume=True, precision="bfloat16"))


def test_a_run_begun_before_there_was_a_choice_of_precision_goes_on(circles: Path, tmp_path: Path):
    settings = config(circles, tmp_path / "run")
    interrupted(settings, 3)
    file = tmp_path / "run" / "config.json"
    recorded = json.loads(file.read_text())
    assert recorded["config"].pop("precision") == "float32"
    assert not {"capture", "data_device", "threads", "device"} & recorded["config"].keys()
    file.write_text(json.dumps(recorded))
    with pytest.raises(UserError, match="precision was float32 and is now bfloat16"):
        train(replace(settings, resume=True, precision="bfloat16"))
    train(replace(settings, resume=True))
    assert torch.load(tmp_path / "run" / "train_state.pt", weights_only=True)["step"] == 4


def test_how_adam_runs_is_not_restored(circles: Path, tmp_path: Path):
    """A state saved on a GPU says that Adam is fused and captured; here it goes on as it runs here."""
    settings = config(circles, tmp_path)
    plain, resumed = (Trainer(settings, load_data(settings)) for _ in range(2))
    for _ in range(2):
        plain.train_step()
    plain.save(tmp_path / "state")
    state = torch.load(tmp_path / "state", weights_only=True)
    state["optimizer"]["param_groups"][0] |= {"fused": True, "capturable": True, "lr": torch.tensor(7.0)}
    torch.save(state, tmp_path / "state")
    resumed.restore(tmp_path / "state")
    group = resumed.optimizer.param_groups[0]
    assert (group["fused"], group["capturable"]) == (None, False) and not isinstance(group["lr"], Tensor)
    for trainer in (plain, resumed):
        trainer.train_step()
    assert all(torch.equal(a, b) for a, b in zip(plain.model.parameters(), resumed.model.parameters(), strict=True))


def test_a_state_of_another_model_is_refused(circles: Path, tmp_path: Path):
    settings = config(circles, tmp_path)
    trainer = Trainer(settings, load_data(settings))
    trainer.save(tmp_path / "state")
    state = torch.load(tmp_path / "state", weights_only=True)
    state["optimizer"]["param_groups"] *= 2
    torch.save(state, tmp_path / "state")
    with pytest.raises(UserError, match=r"state cannot be read \('optimizer' must have one group"):
        trainer.restore(tmp_path / "state")


# --- Precision --------------------------------------------------------------------------------------------------------


def test_bfloat16_rounds_products_and_nothing_else(circles: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Products in the network do; the loss is taken in float32, and so are weights, their gradients and moments."""
    products, outputs = [], []

    class Watching(TorchDispatchMode):
        def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
            out = func(*args, **(kwargs or {}))
            if func._overloadpacket in (torch.ops.aten.mm, torch.ops.aten.addmm):
                products.append(out.dtype)
            return out

    def watching(model: Any, batch: Any, output: Any, *others: Any) -> Any:
        outputs.append({t.dtype for t in output if t is not None})
        assert not torch.is_autocast_enabled("cpu")
        return window_loss(model, batch, output, *others)

    monkeypatch.setattr(trainer_module, "window_loss", watching)
    losses, kinds = [], []
    for precision in ("float32", "bfloat16"):
        settings = config(circles, tmp_path, precision=precision)
        trainer = Trainer(settings, load_data(settings))
        with Watching():
            losses.append(trainer.read(trainer.train_step())["loss"])
        kinds.append(set(products))
        products.clear()
        assert {t.dtype for t in trainer._state()} == {torch.float32, torch.bool}
        assert {p.grad.dtype for p in trainer.model.parameters() if p.grad is not None} == {torch.float32}
    assert kinds[0] == {torch.float32} and torch.bfloat16 in kinds[1]
    assert outputs == [{torch.float32}] * 2
    assert losses[0] != losses[1] == pytest.approx(losses[0], rel=0.05)


@pytest.mark.parametrize("model", [{"preset": "fast"}, {"preset": "plural"}, {"model": "lstm"}])
def test_memories_stay_float32_in_bfloat16(circles: Path, tmp_path: Path, model: dict[str, Any]):
    """On CUDA autocast rounds the cells of GRU and LSTM; on a CPU it does not, so what counts is that it is off."""
    settings = config(circles, tmp_path, precision="bfloat16", **model)
    trainer = Trainer(settings, load_data(settings))
    seen = []
    for cell in trainer.model.modules():
        if isinstance(cell, nn.GRUCell | nn.LSTMCell):
            cell.register_forward_hook(
                lambda _, inputs, __: seen.append((torch.is_autocast_enabled("cpu"), inputs[0].dtype))
            )
    trainer.train_step()
    assert set(seen) == {(False, torch.float32)}


def test_tensor_cores_are_allowed_for_the_step_alone(circles: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Forward and backward; a CPU that is told so computes as it did."""
    seen = []
    backward = Tensor.backward

    def watching(loss: Tensor, *args: Any, **kwargs: Any) -> None:
        seen.append(torch.get_float32_matmul_precision())
        backward(loss, *args, **kwargs)

    monkeypatch.setattr(Tensor, "backward", watching)
    before = torch.get_float32_matmul_precision()
    for precision in ("tf32", "float32"):
        settings = config(circles, tmp_path)
        object.__setattr__(settings, "precision", precision)  # a config refuses it on a CPU
        Trainer(settings, load_data(settings)).train_step()
    assert seen == ["high", before] and torch.get_float32_matmul_precision() == before


# --- Bad input --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"precision": "float16"}, "precision must be one of float32, tf32, bfloat16, got 'float16'"),
        ({"precision": "tf32"}, "precision 'tf32' needs a CUDA device; use --precision float32 or --device cuda"),
        ({"data_device": "gpu"}, "data_device must be one of auto, cpu, device, got 'gpu'"),
        ({"capture": "on"}, "capture must be one of auto, off, got 'on'"),
        ({"device": "tpu"}, "device must be cpu, cuda or auto, got 'tpu'"),
        ({"device": "cuda"}, "device 'cuda' was asked for but torch finds no CUDA device; use --device cpu"),
    ],
)
def test_wrong_choices_are_named(
    circles: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, changes: dict[str, Any], message: str
):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    settings = config(circles, tmp_path)
    for name, value in changes.items():  # in tests, the checks of types would refuse a wrong choice first
        object.__setattr__(settings, name, value)
    with pytest.raises(UserError) as error:
        settings.__post_init__()
    assert str(error.value) == message


def test_a_card_without_bfloat16_is_refused(circles: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda including_emulation: False)
    config(circles, tmp_path, device="cuda")
    with pytest.raises(UserError, match="device 'cuda' has no bfloat16 arithmetic; use --precision float32"):
        config(circles, tmp_path, device="cuda", precision="bfloat16")


# --- The process ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("device", ["cpu", "cuda"])
def test_the_process_is_tuned_for_its_device(
    circles: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, device: str
):
    called: list[str] = []
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    monkeypatch.setattr(training, "tune", called.append)
    monkeypatch.setattr(training, "load_data", lambda _: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        train(config(circles, tmp_path / "run", device=device))
    assert called == [device]


def test_background_work_ends_with_the_run(circles: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    closed = []
    monkeypatch.setattr(Trainer, "close", lambda trainer: closed.append(trainer.step))
    train(config(circles, tmp_path / "whole"))
    interrupted(config(circles, tmp_path / "run"), 3)
    assert closed == [4, 3]


# --- The suite --------------------------------------------------------------------------------------------------------


def test_precision_is_part_of_a_line_and_the_machine_is_not(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("predictor.suite.content_id", str)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda including_emulation: True)
    line = next(r for r in TABLES["springs"].lines if r.key == "dgvae")
    suite = SuiteConfig("springs", tmp_path, tmp_path)
    assert line_config(replace(suite, precision="bfloat16"), line, tmp_path).precision == "bfloat16"
    folders = [
        line_folder(s, line)
        for s in (suite, replace(suite, precision="bfloat16"), replace(suite, device="cuda"), replace(suite, workers=1))
    ]
    assert folders[0] != folders[1] and folders[0] == folders[2] == folders[3]


# --- Files that are damaged ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("curve.json", "{", "curve.json is damaged; remove it to go on without it"),
        ("checkpoint/model.safetensors", "", r"model\.safetensors"),
        ("checkpoint/config.json", "[]", r"config\.json"),
    ],
)
def test_what_a_run_would_go_on_with_is_looked_at_first(
    circles: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, content: str, message: str
):
    """A finished run gave a broken checkpoint for its result; a damaged curve ended a run at its next validation."""
    settings = config(circles, tmp_path / "run")
    train(settings)
    (tmp_path / "run" / name).write_text(content)
    monkeypatch.setattr(Trainer, "train_step", lambda _: pytest.fail("trained"))
    for steps in (settings.steps, settings.steps + 4):
        with pytest.raises(UserError, match=message):
            train(replace(settings, resume=True, steps=steps))
