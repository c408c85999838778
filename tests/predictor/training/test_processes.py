"""Training by several processes: equal to one process with the same batch, and one line when a process is lost.

Most tests run the processes as threads, which add their numbers up at a barrier; one starts torchrun.
"""

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, distributed, nn

from predictor.data.store import StoreInfo, write_store
from predictor.dgvae.config import PRESETS
from predictor.noise import NoiseOfRows
from predictor.support.errors import UserError
from predictor.train import train
from predictor.training import processes
from predictor.training.config import TrainConfig
from predictor.training.processes import ALONE, Group, LostProcessError, RowsDropout, joined, keep_rows_of_dropout
from predictor.training.trainer import Trainer
from predictor.training.training_data import load_data
from tests.predictor.helpers import FAST_LIKE, PLURAL, circling_episode, spec

ROOT = Path(__file__).parents[3]
STEPS = 10
CLOSE = 1e-6
"""Largest difference of a weight, and largest relative one of a loss, after as many steps."""
# What the parts of the objective and the kinds of noise are: options of a run.
RUNS: dict[str, dict[str, Any]] = {
    "dgvae": {"min_history_steps": 2},
    "dgvae-rich": {"set": ("static_dim=2", "innovation_rounds=1", "substeps=2", "pair_matching=window")},
    "dgvae-labels": {"label_weight": 1.0, "type_label_weight": 1.0, "edge_cost": 0.5, "kl_warmup_steps": 4},
    "dgvae-reactions": {"causal_edges": True, "reaction_weight": 2.0, "label_weight": 1.0, "type_label_weight": 1.0},
    "plural": {"preset": "plural", "curriculum_steps": 6},
    "dnri": {"model": "dnri", "set": ("hidden_dim=5", "rnn_dim=4", "decoder_dim=6", "message_dim=7")},
    "imma": {"model": "imma", "set": ("hidden_dim=5", "rnn_dim=4", "decoder_dim=6", "message_dim=7")},
    "lstm": {"model": "lstm", "set": ("embed_dim=5", "rnn_dim=4")},
    "mlp": {"model": "mlp", "set": ("hidden_dim=5",)},
}


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(PRESETS, "fast", FAST_LIKE)
    monkeypatch.setitem(PRESETS, "plural", PLURAL)


@pytest.fixture(scope="module")
def crowds(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Episodes of different lengths and numbers of agents, with every kind of label."""
    episodes = []
    for i in range(10):
        episode = circling_episode(i, steps=8 + i, agents=2 + i % 4)
        rng, pairs = np.random.default_rng(i), (1, len(episode.ids), len(episode.ids))
        episodes.append(
            replace(
                episode,
                edge_types=rng.integers(0, 2, size=pairs).astype(np.int8),
                edge_attributes=rng.random((*pairs, 1)).astype(np.float32),
                causal_shift_m=rng.choice([0.0, 3.0, np.nan], size=pairs).astype(np.float32),
            )
        )
    path = tmp_path_factory.mktemp("data") / "crowds"
    write_store(path, StoreInfo(spec(max_agents=6), "crowds", {}, ("k",), causal_threshold_m=1.0), episodes)
    return path


def config(data: Path, out: Path, **changes: Any) -> TrainConfig:
    options: dict[str, Any] = {
        "preset": "fast", "steps": STEPS, "batch_size": 7, "history_steps": 5, "horizon_steps": 3, "val_windows": 8,
    }  # fmt: skip
    return TrainConfig(data=(data,), out=out, **(options | changes))


class Meeting:
    """Where threads add up what each of them brings."""

    def __init__(self, count: int) -> None:
        self.barrier = threading.Barrier(count, timeout=60)
        self.brought: list[Tensor] = [torch.zeros(())] * count

    def total(self, index: int, tensor: Tensor) -> Tensor:
        self.brought[index] = tensor.detach().clone()
        self.barrier.wait()
        added = torch.stack(self.brought).sum(0)
        self.barrier.wait()
        return added


@dataclass(frozen=True)
class InThread(Group):
    """A process that is a thread."""

    meeting: Meeting | None = None

    def total(self, tensor: Tensor) -> Tensor:
        assert self.meeting is not None
        return self.meeting.total(self.index, tensor)


class CountsItself(InThread):
    """Divides by the mean of all counts, as an average of the processes' means does."""

    def total(self, tensor: Tensor) -> Tensor:
        return tensor * self.count if tensor.dtype == torch.int64 else super().total(tensor)


class Averages(InThread):
    def add_gradients(self, parameters: Sequence[nn.Parameter], terms: Mapping[str, Tensor]) -> dict[str, Tensor]:
        found = super().add_gradients(parameters, terms)
        for parameter in parameters:
            if parameter.grad is not None:
                parameter.grad /= self.count
        return found


class KeepsItsGradients(InThread):
    def add_gradients(self, parameters: Sequence[nn.Parameter], terms: Mapping[str, Tensor]) -> dict[str, Tensor]:
        own = [None if p.grad is None else p.grad.clone() for p in parameters]
        found = super().add_gradients(parameters, terms)
        for parameter, grad in zip(parameters, own, strict=True):
            parameter.grad = grad
        return found


Run = tuple[list[float], list[Tensor]]


def steps_of(trainer: Trainer) -> Run:
    losses = [trainer.read(trainer.train_step())["loss"] for _ in range(STEPS)]
    return losses, [p.detach().clone() for p in trainer.model.parameters()]


def together(settings: TrainConfig, count: int, kind: type[InThread] = InThread) -> list[Run]:
    meeting, data = Meeting(count), load_data(settings)
    groups = [kind(i, count, i, connected=True, meeting=meeting) for i in range(count)]
    trainers = [Trainer(settings, data, group) for group in groups]
    with ThreadPoolExecutor(count) as pool:
        return list(pool.map(steps_of, trainers))


def apart(ours: Run, expected: Run) -> float:
    """The larger of the largest difference of a weight and the largest relative one of a loss."""
    losses = max(abs(a - b) / max(1.0, abs(b)) for a, b in zip(ours[0], expected[0], strict=True))
    return max(losses, *(float((a - b).abs().max()) for a, b in zip(ours[1], expected[1], strict=True)))


@pytest.mark.slow
@pytest.mark.parametrize("kind", RUNS)
def test_several_processes_take_the_steps_of_one(crowds: Path, tmp_path: Path, kind: str):
    settings = config(crowds, tmp_path / "run", **RUNS[kind])
    one = steps_of(Trainer(settings, load_data(settings)))
    for count in (2, 3):  # 7 windows: shares of different sizes
        for ours in together(settings, count):
            assert apart(ours, one) < CLOSE, count


@pytest.mark.slow
def test_windows_on_the_device_are_shared_too(crowds: Path, tmp_path: Path):
    settings = config(crowds, tmp_path / "run", data_device="device")
    one = steps_of(Trainer(settings, load_data(settings)))
    assert all(apart(ours, one) < CLOSE for ours in together(settings, 2))


@pytest.mark.slow
@pytest.mark.parametrize("mistake", [CountsItself, Averages, KeepsItsGradients])
def test_a_wrong_sum_is_seen(crowds: Path, tmp_path: Path, mistake: type[InThread]):
    settings = config(crowds, tmp_path / "run")
    one = steps_of(Trainer(settings, load_data(settings)))
    assert apart(together(settings, 2, mistake)[0], one) > 10 * CLOSE


@pytest.mark.slow
def test_noise_of_its_own_is_seen(crowds: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    settings = config(crowds, tmp_path / "run")
    one = steps_of(Trainer(settings, load_data(settings)))
    monkeypatch.setattr(NoiseOfRows, "like", lambda self, logits: torch.rand(logits.shape, generator=self._generator))
    assert apart(together(settings, 2)[0], one) > 10 * CLOSE


# --- Rows -------------------------------------------------------------------------------------------------------------


def test_rows_share_a_batch():
    for count in (1, 2, 3, 7):
        parts = [list(range(7))[Group(i, count).rows(7)] for i in range(count)]
        assert sum(parts, []) == list(range(7)) and max(map(len, parts)) - min(map(len, parts)) <= 1
    with pytest.raises(UserError, match=r"batch_size must be at least the number of processes \(3\), got 2"):
        Group(0, 3).rows(2)


@pytest.mark.parametrize("order", [(0, 1, 2), (1, 0, 2), (2, 1, 0)])
def test_dropout_of_rows_is_that_of_the_batch(order: tuple[int, ...]):
    """Also of a permuted tensor, which torch draws for in the order of its memory."""
    whole = torch.randn(*(torch.Size([6, 4, 5])[axis] for axis in order)).permute([order.index(a) for a in range(3)])
    assert whole.shape == (6, 4, 5)
    torch.manual_seed(3)
    expected = nn.Dropout(0.4)(whole)
    for rows in (slice(0, 2), slice(2, 6)):
        torch.manual_seed(3)
        part = whole[rows].contiguous() if order == (0, 1, 2) else whole[rows]
        assert torch.equal(RowsDropout(0.4, rows, 6)(part), expected[rows])
    assert torch.equal(RowsDropout(0.4, slice(0, 2), 6).eval()(whole[:2]), whole[:2])


def test_dropout_of_one_row_is_that_of_the_batch():
    """Steps are stacked with time first in memory, where the strides of a single row and of time are equal."""
    steps = list(torch.randn(4, 3, 5))

    def sequence(rows: slice) -> Tensor:
        return torch.stack([step[rows] for step in steps]).transpose(0, 1)

    torch.manual_seed(3)
    expected = nn.Dropout(0.4)(sequence(slice(0, 3)))
    for row in range(3):
        torch.manual_seed(3)
        rows = slice(row, row + 1)
        assert torch.equal(RowsDropout(0.4, rows, 3)(sequence(rows)), expected[rows])


def test_every_dropout_of_a_network_keeps_its_rows():
    network = nn.Sequential(nn.Linear(2, 2), nn.Sequential(nn.Dropout(0.3)), nn.Dropout(0.1))
    keep_rows_of_dropout(network, slice(0, 1), 2)
    kinds = [(type(m), m.p) for m in network.modules() if isinstance(m, nn.Dropout)]
    assert kinds == [(RowsDropout, 0.3), (RowsDropout, 0.1)]


# --- Groups -----------------------------------------------------------------------------------------------------------


def test_one_process_needs_no_connection(monkeypatch: pytest.MonkeyPatch):
    assert ALONE.leads and ALONE.from_leader(lambda: 3) == 3 and ALONE.any(True) and ALONE.device("cuda:1") == "cuda:1"
    monkeypatch.setattr(distributed, "is_torchelastic_launched", lambda: False)
    with joined() as group:
        assert group is ALONE and not distributed.is_initialized()


def test_each_process_has_a_card_of_its_own(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    assert Group(5, 8, 1, connected=True).device("cuda") == "cuda:1"
    assert Group(1, 2, 1, connected=True).device("cpu") == "cpu"
    with pytest.raises(UserError, match="needs a card of its own, and there are 2; pass --nproc-per-node 2"):
        Group(2, 3, 2, connected=True).device("cuda")
    with pytest.raises(UserError, match="device 'cuda:0' is one card for 2 processes; pass --device cuda"):
        Group(0, 2, 0, connected=True).device("cuda:0")
    assert Group(0, 1, 0, connected=True).device("cuda:1") == "cuda:1"


@dataclass(frozen=True)
class Answers(Group):
    """A process whose others say what the test says."""

    connected: bool = True
    others: tuple[Any, ...] = ()

    def _gathered(self, value: Any) -> list[Any]:
        given = list(self.others)
        given.insert(self.index, value)
        return given


def raising(error: Exception) -> Callable[[], None]:
    def call() -> None:
        raise error

    return call


def test_the_first_process_that_fails_says_why_and_the_others_leave():
    with pytest.raises(UserError, match="mine"):
        Answers(1, 2, others=(False,)).together(raising(UserError("mine")))
    with pytest.raises(UserError, match="mine"):
        Answers(0, 2, others=(True,)).together(raising(UserError("mine")))
    for call in (raising(UserError("mine")), lambda: None):
        with pytest.raises(SystemExit, match="2"):
            Answers(1, 2, others=(True,)).together(call)
    assert Answers(1, 2, others=(False,)).together(lambda: 3) == 3


def test_processes_with_other_data_are_refused():
    Answers(0, 2, others=("[1]",)).check_same([1], "data")
    with pytest.raises(UserError, match="data of process 1 are not those of process 0; give all the same"):
        Answers(0, 2, others=("[2]",)).check_same([1], "data")
    with pytest.raises(SystemExit):
        Answers(1, 2, others=("[2]",)).check_same([1], "data")


def test_a_lost_process_is_one_sentence(monkeypatch: pytest.MonkeyPatch):
    def broken(tensor: Tensor) -> None:
        raise RuntimeError("[/src/gloo/pair.cc:537] Read error [127.0.0.1]:5: reset by peer. This is likely because.")

    monkeypatch.setattr(processes.distributed, "all_reduce", broken)
    with pytest.raises(LostProcessError) as caught:
        Group(0, 2, connected=True).total(torch.ones(1))
    assert str(caught.value) == (
        "another process of this training has ended or does not answer (Read error [127.0.0.1]:5: reset by peer); "
        "the same command with --resume goes on from the last saved state"
    )


# --- torchrun ---------------------------------------------------------------------------------------------------------


OPTIONS = ("--preset", "fast", "--set", "hidden_dim=9", "rnn_dim=5", "head_dim=8", "dropout=0.2")


def options_of(settings: TrainConfig) -> list[str]:
    names = ("steps", "batch_size", "history_steps", "horizon_steps", "val_windows", "eval_every", "min_history_steps")
    given = [word for name in names for word in (f"--{name.replace('_', '-')}", str(getattr(settings, name)))]
    return [*OPTIONS, *given, "--data", str(settings.data[0]), "--out", str(settings.out)]


def torchrun(*words: str) -> "subprocess.Popen[str]":
    command = [sys.executable, "-m", "torch.distributed.run", "--nproc-per-node", "2", "-m", "predictor.train", *words]
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    return subprocess.Popen(
        command, cwd=ROOT, env=environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    )


def ended(process: "subprocess.Popen[str]", limit_s: float) -> str:
    """Returns what a process printed until its end, within some time; it is always ended."""
    try:
        return process.communicate(timeout=limit_s)[0]
    finally:
        process.kill()


def large(settings: TrainConfig, **changes: Any) -> TrainConfig:
    """The same network as that of `OPTIONS`, which another process builds from the real preset."""
    return replace(settings, set=OPTIONS[3:], **changes)


@pytest.mark.slow
def test_torchrun_takes_up_a_run_and_ends_where_one_process_does(
    crowds: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.undo()
    settings = large(config(crowds, tmp_path / "one", steps=STEPS + 3, eval_every=STEPS + 3, min_history_steps=2))
    begun = Trainer(settings, load_data(settings))
    for _ in range(3):
        begun.train_step()
    (tmp_path / "two").mkdir()
    begun.save(tmp_path / "two" / "train_state.pt")
    train(settings)
    (tmp_path / "two" / "config.json").write_text(
        (tmp_path / "one" / "config.json").read_text().replace(str(tmp_path / "one"), str(tmp_path / "two"))
    )
    running = torchrun(*options_of(replace(settings, out=tmp_path / "two")), "--resume")
    printed = ended(running, 120)
    assert running.returncode == 0, printed
    assert printed.count("best checkpoint:") == 1
    one, two = (torch.load(tmp_path / name / "train_state.pt", weights_only=True) for name in ("one", "two"))
    assert two["step"] == STEPS + 3 and abs(one["best"] - two["best"]) < CLOSE * max(1.0, one["best"])
    for name, value in one["model"].items():
        assert float((two["model"][name] - value).abs().max()) < CLOSE, name
    assert sorted(p.name for p in (tmp_path / "two").iterdir()) == [
        "checkpoint",
        "config.json",
        "curve.json",
        "tb",
        "train_state.pt",
    ]


@pytest.fixture
def endless(crowds: Path, tmp_path: Path) -> Iterator["subprocess.Popen[str]"]:
    """A training of two processes that has saved a state and goes on."""
    settings = config(crowds, tmp_path / "run", steps=1_000_000, eval_every=5)
    running = torchrun(*options_of(settings))
    until = time.monotonic() + 100
    while not (tmp_path / "run" / "train_state.pt").exists() and time.monotonic() < until and running.poll() is None:
        time.sleep(0.2)
    yield running
    running.kill()
    running.wait()


def children(process: "subprocess.Popen[str]") -> list[int]:
    found = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    return [int(pid) for pid in found]


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="needs Linux's list of processes")
def test_a_process_that_is_killed_ends_the_training_in_one_line(endless: "subprocess.Popen[str]", tmp_path: Path):
    workers = children(endless)
    os.kill(workers[-1], signal.SIGKILL)
    printed = ended(endless, 90)
    lines = [line for line in printed.splitlines() if line.startswith("error:")]
    assert len(lines) == 1 and "another process of this training has ended" in lines[0], printed
    assert "the same command with --resume goes on" in lines[0]
    assert torch.load(tmp_path / "run" / "train_state.pt", weights_only=True)["step"] >= 5
    assert not any(Path(f"/proc/{pid}").exists() for pid in workers)


@pytest.mark.slow
def test_a_signal_saves_the_state_and_ends_all(endless: "subprocess.Popen[str]", tmp_path: Path):
    endless.send_signal(signal.SIGTERM)
    printed = ended(endless, 90)
    stopped = [line for line in printed.splitlines() if line.startswith("stopped:")]
    assert stopped == [f"stopped: its state is saved in {tmp_path / 'run'}; the same command with --resume goes on"], (
        printed
    )
