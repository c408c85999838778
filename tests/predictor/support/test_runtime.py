"""What the process is told of memory and precision; and that checkpoints keep how a network is to be run."""

import ctypes
import json
import os
import platform
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from predictor.checkpoint import CheckpointInfo, load_checkpoint, save_checkpoint
from predictor.dgvae import DGVAE
from predictor.support import runtime
from predictor.support.errors import UserError
from predictor.support.runtime import keep_freed_memory, precision, prefer_onednn, processor, resolve_device, tune
from tests.predictor.helpers import FAST_LIKE, model, random_states, spec

# --- Precision of products --------------------------------------------------------------------------------------------


def product() -> torch.dtype:
    return (torch.ones(2, 2) @ torch.ones(2, 2)).dtype


def test_products_are_rounded_within_the_block():
    with precision("bfloat16", "cpu"):
        assert product() == torch.bfloat16
        with precision("float32", "cpu"):
            assert product() == torch.float32
        assert product() == torch.bfloat16
    assert product() == torch.float32


def test_precision_is_restored_after_an_exception():
    with pytest.raises(KeyError), precision("bfloat16", "cpu"):
        raise KeyError
    assert product() == torch.float32


# --- Devices ----------------------------------------------------------------------------------------------------------


def pretend_devices(monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: number > 0)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: number)


@pytest.mark.parametrize(
    ("name", "there", "taken"),
    [
        ("cpu", False, "cpu"),
        ("auto", False, "cpu"),
        ("auto", True, "cuda"),
        ("cuda", True, "cuda"),
        ("cuda:1", True, "cuda:1"),
    ],
)
def test_names_of_devices(name: str, there: bool, taken: str, monkeypatch: pytest.MonkeyPatch):
    pretend_devices(monkeypatch, 2 if there else 0)
    assert resolve_device(name) == taken


@pytest.mark.parametrize("name", ["tpu9", "", "gpu", "meta", "mps"])
def test_other_devices_are_refused(name: str):
    with pytest.raises(UserError, match=f"device must be cpu, cuda or auto, got '{name}'"):
        resolve_device(name)


@pytest.mark.parametrize(
    ("name", "there", "found"),
    [("cuda", 0, "no CUDA device"), ("cuda:1", 1, "1 CUDA device"), ("cuda:9", 2, "2 CUDA devices")],
)
def test_an_absent_device_is_refused(name: str, there: int, found: str, monkeypatch: pytest.MonkeyPatch):
    pretend_devices(monkeypatch, there)
    with pytest.raises(UserError, match=f"device '{name}' was asked for but torch finds {found}; use --device cpu"):
        resolve_device(name)


# --- Memory and machine -----------------------------------------------------------------------------------------------


class Libc:
    """Notes what it is asked for, and grants it or not."""

    def __init__(self, grants: bool) -> None:
        self.asked: dict[int, int] = {}
        self.grants = grants

    def mallopt(self, option: int, value: int) -> int:
        self.asked[option] = value
        return int(self.grants)


def afresh(setting: Any) -> bool:
    """A setting that is made once for each process, as if it had not been made yet."""
    return getattr(setting, "__wrapped__", setting)()


def pretend(monkeypatch: pytest.MonkeyPatch, system: str, libc: str, grants: bool = True) -> Libc:
    made = Libc(grants)
    monkeypatch.setattr(sys, "platform", system)
    monkeypatch.setattr(platform, "libc_ver", lambda: (libc, "2.39"))
    monkeypatch.setattr(ctypes, "CDLL", lambda _: made)
    return made


def test_freed_memory_is_kept_by_what_malloc_h_says(monkeypatch: pytest.MonkeyPatch):
    libc = pretend(monkeypatch, "linux", "glibc")
    assert afresh(keep_freed_memory) is True
    assert libc.asked == {-4: 0, -1: 2**31 - 1, -2: 2**26}  # M_MMAP_MAX, M_TRIM_THRESHOLD, M_TOP_PAD


def test_where_glibc_refuses_it_says_so(monkeypatch: pytest.MonkeyPatch):
    pretend(monkeypatch, "linux", "glibc", grants=False)
    assert afresh(keep_freed_memory) is False


@pytest.mark.parametrize(("system", "libc"), [("darwin", ""), ("win32", ""), ("linux", ""), ("linux", "musl")])
def test_other_systems_are_left_alone(monkeypatch: pytest.MonkeyPatch, system: str, libc: str):
    made = pretend(monkeypatch, system, libc)
    assert afresh(keep_freed_memory) is False
    assert made.asked == {}


def test_kept_memory_changes_no_result():
    def trained() -> list[torch.Tensor]:
        torch.manual_seed(0)
        forecaster = DGVAE(spec(), FAST_LIKE, 2)
        states, valid = random_states(0, 2, 4, 3, 4), torch.ones(2, 4, 3).bool()
        output = forecaster.window(states, valid, torch.tensor([1, 1]), 2, torch.Generator().manual_seed(0))
        output.rollout.square().mean().backward()
        return [output.one_step.detach(), *(p.grad for p in forecaster.parameters() if p.grad is not None)]

    expected = trained()
    assert isinstance(afresh(keep_freed_memory), bool)
    for _ in range(2):  # the second time in memory that was used
        assert all(torch.equal(a, b) for a, b in zip(trained(), expected, strict=True))


@pytest.fixture(params=["highest", "high", "medium"])
def before(request: pytest.FixtureRequest) -> Iterator[str]:
    """torch's own setting for matrix products; put back after the test."""
    found = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision(request.param)
    yield request.param
    torch.set_float32_matmul_precision(found)


@pytest.mark.parametrize(
    ("vendor", "capability", "exact", "done"),
    [
        ("AuthenticAMD", "AVX512", True, True),
        ("AuthenticAMD", "AVX512", False, False),
        ("AuthenticAMD", "AVX2", True, False),
        ("GenuineIntel", "AVX512", True, False),
        (None, "DEFAULT", True, False),
    ],
)
def test_onednn_is_preferred_only_where_it_is_exact(
    before: str, monkeypatch: pytest.MonkeyPatch, vendor: str | None, capability: str, exact: bool, done: bool
):
    asked = []
    runtime._onednn_is_better.cache_clear()

    def products_are_exact() -> bool:
        asked.append(torch.get_float32_matmul_precision())
        return exact

    monkeypatch.setattr(runtime, "_cpu_info", lambda _: [vendor] if vendor else [])
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: capability)
    monkeypatch.setattr(runtime, "_products_are_exact", products_are_exact)
    assert prefer_onednn() is prefer_onednn() is done
    assert torch.get_float32_matmul_precision() == ("medium" if done else before)
    assert set(asked) <= {"medium"} and len(asked) < 2  # what is judged is what would be set
    tune("cuda")
    assert torch.get_float32_matmul_precision() == before, "products on CUDA are not to round to TF32"
    runtime._onednn_is_better.cache_clear()


def test_rounded_products_are_not_exact(monkeypatch: pytest.MonkeyPatch):
    assert runtime._products_are_exact()
    with precision("bfloat16", "cpu"):
        assert not runtime._products_are_exact()


@pytest.mark.parametrize(("device", "expected"), [("cpu", ["memory", "products"]), ("cuda", ["memory"])])
def test_products_on_cuda_are_left_alone(monkeypatch: pytest.MonkeyPatch, device: str, expected: list[str]):
    """The setting that sends products to oneDNN would let those on CUDA round to TF32."""
    done: list[str] = []
    monkeypatch.setattr(runtime, "keep_freed_memory", lambda: done.append("memory"))
    monkeypatch.setattr(runtime, "prefer_onednn", lambda: done.append("products"))
    tune(device)
    assert done == expected


def test_processor_has_a_name_and_a_number_of_cores():
    name, cores = processor().rsplit(", ", 1)
    assert name.strip() and cores == f"{os.cpu_count()} logical cores"


@pytest.mark.parametrize("content", [None, "processor : 0\n"], ids=["no file", "no name"])
def test_processor_of_a_system_that_tells_less(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, content: str | None):
    if content is not None:
        (tmp_path / "cpuinfo").write_text(content)
    monkeypatch.setattr(runtime, "open", lambda _: (tmp_path / "cpuinfo").open(), raising=False)
    monkeypatch.setattr(runtime, "platform", SimpleNamespace(processor=lambda: "", machine=lambda: "riscv64"))
    assert processor() == f"riscv64, {os.cpu_count()} logical cores"


def test_processor_is_the_first_model_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "cpuinfo").write_text("processor\t: 0\nmodel name\t: Some CPU: 3 GHz\nmodel name\t: Another\n")
    monkeypatch.setattr(runtime, "open", lambda _: (tmp_path / "cpuinfo").open(), raising=False)
    assert processor() == f"Some CPU: 3 GHz, {os.cpu_count()} logical cores"


# --- Checkpoints ------------------------------------------------------------------------------------------------------


def saved(path: Path, forecaster: DGVAE) -> CheckpointInfo:
    info = CheckpointInfo(forecaster.spec, forecaster.config, forecaster.horizon_steps)
    save_checkpoint(path, forecaster, info)
    return info


def edit(path: Path, **fields: Any) -> None:
    """Fields of the network's config; None takes one out."""
    content = json.loads((path / "config.json").read_text())
    config = content["config"] | fields
    content["config"] = {name: value for name, value in config.items() if value is not None}
    (path / "config.json").write_text(json.dumps(content))


def forecast(forecaster: DGVAE) -> torch.Tensor:
    states = random_states(0, 2, 4, 4)
    belief = forecaster.observe(forecaster.empty_memory(2, 4), states, torch.ones(2, 4).bool())[1]
    return forecaster.rollout(belief, 3, 2, torch.Generator().manual_seed(0)).states


def test_checkpoints_keep_neighbours_and_graph(tmp_path: Path):
    forecaster = model().variant(num_neighbours=2, rollout_graph="frozen")
    info = saved(tmp_path / "toy", forecaster)
    loaded, read = load_checkpoint(tmp_path / "toy")
    assert read == info and loaded.config == forecaster.config
    assert (loaded.config.num_neighbours, loaded.config.rollout_graph) == (2, "frozen")
    assert torch.equal(forecast(loaded), forecast(forecaster))
    assert not torch.allclose(forecast(loaded), forecast(model()), atol=1e-3)


def test_checkpoints_from_before_there_were_neighbours_load(tmp_path: Path):
    saved(tmp_path / "toy", model())
    edit(tmp_path / "toy", num_neighbours=None, rollout_graph=None)
    loaded, read = load_checkpoint(tmp_path / "toy")
    assert read.config == loaded.config == model().config == replace(FAST_LIKE, num_neighbours=0)
    assert torch.equal(forecast(loaded), forecast(model()))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"num_neighbours": -2}, "config: num_neighbours must not be negative, got -2"),
        ({"rollout_graph": "forzen"}, "(?s)config: .*rollout_graph.*'forzen'"),
    ],
)
def test_impossible_values_are_refused(tmp_path: Path, fields: dict[str, Any], message: str):
    saved(tmp_path / "toy", model())
    edit(tmp_path / "toy", **fields)
    with pytest.raises(UserError, match=message):
        load_checkpoint(tmp_path / "toy")
