"""What a step is given depends on seed and step alone, wherever it is cut and whoever cuts it."""

import re
import threading
import time
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from predictor.data.device_windows import ResidentWindows
from predictor.data.windows import WindowBatch, Windows
from predictor.dgvae.config import PRESETS
from predictor.support.errors import UserError
from predictor.training import batches as batches_module
from predictor.training.batches import (
    DeviceBatches,
    HostBatches,
    Plan,
    PrefetchedBatches,
    Shapes,
    open_batches,
    padding_factor,
    plan,
)
from predictor.training.config import TrainConfig
from predictor.training.trainer import Trainer
from predictor.training.training_data import load_data
from tests.predictor.helpers import FAST_LIKE, circling_episode, spec, write_circles

CPU = torch.device("cpu")
ON_HOST = "windows are cut on the host, one batch ahead"
CONFIG = TrainConfig((Path(),), Path(), steps=20, batch_size=6, history_steps=4, horizon_steps=3, min_history_steps=1)


@pytest.fixture(autouse=True)
def tiny(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(PRESETS, "fast", replace(FAST_LIKE, dropout=0.1))


def windows(config: TrainConfig = CONFIG, agents: tuple[int, ...] = (2, 3)) -> list[Windows]:
    """One store for each number of agents."""
    stores = [[circling_episode(10 * n + i, steps=9, agents=n) for i in range(4)] for n in agents]
    return [Windows(episodes, spec(), config.history_steps, config.horizon_steps) for episodes in stores]


def assert_same(ours: WindowBatch, expected: WindowBatch) -> None:
    for f in fields(WindowBatch):
        a, b = getattr(ours, f.name), getattr(expected, f.name)
        assert (a is None) == (b is None) and (a is None or torch.equal(a, b)), f.name


# --- Plans ------------------------------------------------------------------------------------------------------------


def test_plans_are_functions_of_seed_and_step():
    plans = [plan(CONFIG, [10, 20], step) for step in range(20)]
    for step in (19, 3, 0):
        again = plan(CONFIG, [10, 20], step)
        for f in fields(Plan):
            if f.name != "windows":
                assert getattr(again, f.name) == getattr(plans[step], f.name)
        assert all(np.array_equal(a, b) for a, b in zip(again.windows, plans[step].windows, strict=True))
    assert len({p.dropout_seed for p in plans} | {p.noise_seed for p in plans}) == 40
    assert {p.history_steps for p in plans} == {1, 2, 3, 4}
    other = plan(replace(CONFIG, seed=1), [10, 20], 0)
    assert (other.dropout_seed, other.noise_seed) != (plans[0].dropout_seed, plans[0].noise_seed)


@pytest.mark.parametrize(
    ("modes", "few"), [(1, 1), (2, 2), (3, 2), (6, 2), (8, 2), (9, 3), (20, 6)], ids=lambda n: str(n)
)
def test_every_other_step_rolls_out_a_third_of_the_modes(modes: int, few: int):
    """Never less than two, where there are two: a single one would have no score but its own likelihood."""
    assert [plan(CONFIG, [10, 20], step, modes).num_modes for step in range(4)] == [few, modes] * 2
    plain, others = plan(CONFIG, [10, 20], 0), plan(CONFIG, [10, 20], 0, modes)
    assert plain.num_modes == 1
    assert replace(plain, windows=(), num_modes=0) == replace(others, windows=(), num_modes=0)


def test_every_store_gives_its_share():
    drawn = [plan(CONFIG, [10, 1000], step).windows for step in range(50)]
    assert all(len(a) + len(b) == 6 for a, b in drawn)
    assert sum(len(a) for a, _ in drawn) < 20
    assert all((a < 10).all() and (b < 1000).all() for a, b in drawn)


def test_sorted_batches_hold_the_windows_of_their_steps_in_order_of_size():
    sizes, rng = [10, 300], np.random.default_rng(0)
    widths = [rng.integers(1, 13, n) for n in sizes]
    for first in (0, batches_module._POOL):
        steps = range(first, first + batches_module._POOL)
        plain, ordered = ([plan(CONFIG, sizes, s, widths=w) for s in steps] for w in (None, widths))
        for k in range(len(sizes)):
            pools = (np.sort(np.concatenate([p.windows[k] for p in plans])) for plans in (plain, ordered))
            np.testing.assert_array_equal(*pools)
        found = sorted(
            (np.concatenate([w[i] for w, i in zip(widths, p.windows, strict=True)]) for p in ordered),
            key=lambda w: (w.min(), w.max()),
        )
        assert all(len(w) == CONFIG.batch_size for w in found)
        assert all(a.max() <= b.min() for a, b in zip(found, found[1:], strict=False))
        mean = np.average([w.mean() for w in widths], weights=sizes)
        assert sorted(p.weight for p in ordered) == pytest.approx([w.mean() / mean for w in found])
        assert {p.weight for p in plain} == {1.0}


def test_sizes_come_in_no_fixed_order():
    """Every other step rolls out a third of the modes: large scenes must not always meet the same ones."""
    widths = [np.arange(100)]
    weights = np.array([plan(CONFIG, [100], s, widths=widths).weight for s in range(30 * batches_module._POOL)])
    of_step = weights.reshape(30, batches_module._POOL)
    largest, even = of_step.argmax(1), weights[::2].mean()
    assert len(set(largest.tolist())) > batches_module._POOL // 2 and even == pytest.approx(1, abs=0.1)


@pytest.mark.parametrize(("agents", "sorts"), [((3, 3), False), ((2, 3), True)])
def test_batches_are_sorted_where_scenes_differ_in_size(agents: tuple[int, ...], sorts: bool):
    widths = open_batches(CONFIG, windows(agents=agents), CPU).widths
    assert (widths is not None) == sorts
    if widths is not None:
        assert [w.tolist() for w in widths] == [
            [n] * len(s) for n, s in zip(agents, windows(agents=agents), strict=True)
        ]


def test_rate_warms_up_and_falls_to_2_percent():
    config = replace(CONFIG, steps=1000, lr=2.0)
    rates = [plan(config, [5], step).lr for step in range(1000)]
    assert rates[:2] == pytest.approx([0.02, 0.04]) and max(rates) == rates[99] == 2.0
    assert rates[-1] == pytest.approx(0.04, rel=1e-2) and rates[100:] == sorted(rates[100:], reverse=True)


# --- Shapes -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("history", "time"), [(1, 18), (8, 18), (9, 26), (33, 50), (39, 50), (40, 50)])
def test_histories_come_in_eights(history: int, time: int):
    assert Shapes(5, 40, 10).time(history) == time


def test_rounding_does_not_exceed_the_longest_history():
    assert [Shapes(5, 6, 2).time(h) for h in (1, 5, 6)] == [8, 8, 8]


@pytest.mark.parametrize("step", range(4))
def test_fixed_shapes_only_append_absence(step: int):
    stores, shapes = windows(), Shapes(5, 4, 3)
    now = plan(CONFIG, [len(w) for w in stores], step)
    loose, fixed = (HostBatches(stores, CPU, s).batch(now) for s in (None, shapes))
    time, agents = loose.valid.shape[1:]
    assert fixed.valid.shape == (6, 7, 5)
    assert torch.equal(fixed.states[:, :time, :agents], loose.states)
    assert torch.equal(fixed.valid[:, :time, :agents], loose.valid)
    assert fixed.valid.sum() == loose.valid.sum() and not fixed.states[~fixed.valid].any()


@pytest.mark.parametrize(
    ("agents", "batch_size", "expected"), [([5] * 9, 4, 1.0), ([2, 4], 64, 1.0), ([2] * 999 + [20], 1, 100.0)]
)
def test_padding_factor(agents: list[int], batch_size: int, expected: float):
    assert padding_factor(np.array(agents), batch_size) == pytest.approx(expected, rel=0.5)


# --- On the device ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shapes", [None, Shapes(3, 4, 3)], ids=["loose", "fixed"])
@pytest.mark.parametrize("step", range(4))
def test_device_batches_give_the_same_windows(step: int, shapes: Shapes | None):
    """From two stores, in the same order; without fixed shapes it pads to the widest window of all."""
    stores = windows()
    now = plan(CONFIG, [len(w) for w in stores], step)
    agents = shapes.agents if shapes else None
    ours = DeviceBatches(ResidentWindows(stores, CPU, agents), CPU, shapes).batch(now)
    expected = HostBatches(stores, CPU, shapes or Shapes(3, now.history_steps, 3)).batch(now)
    assert_same(ours, expected)


def test_no_history_is_longer_than_the_longest_episode():
    """It was padded with as many steps as the option says, which no memory holds."""
    config = replace(CONFIG, history_steps=2_000_000_000, min_history_steps=0)
    stores = windows(config)
    now = plan(config, [len(w) for w in stores], 0)
    ours = DeviceBatches(ResidentWindows(stores, CPU), CPU).batch(now)
    expected = HostBatches(stores, CPU).batch(now)
    time, agents = expected.valid.shape[1:]
    assert ours.valid.shape[1] <= 9 + config.horizon_steps
    assert torch.equal(ours.states[:, :time, :agents], expected.states) and ours.valid.sum() == expected.valid.sum()


@pytest.mark.parametrize("changes", [{}, {"min_history_steps": 1, "curriculum_steps": 4}], ids=["plain", "schedules"])
def test_training_on_resident_data_is_training(tmp_path: Path, changes: dict[str, Any]):
    data = write_circles(tmp_path / "circles")
    settings = TrainConfig(
        (data,), tmp_path / "run", preset="fast", batch_size=16, history_steps=4, horizon_steps=3, **changes
    )
    host, resident = (Trainer(s, load_data(s)) for s in (settings, replace(settings, data_device="device")))
    assert isinstance(host.batches, HostBatches) and isinstance(resident.batches, DeviceBatches)
    for _ in range(5):
        assert resident.read(resident.train_step()) == pytest.approx(host.read(host.train_step()), rel=1e-6)


def test_what_does_not_fit_is_refused_with_both_sizes():
    stores = windows()
    with pytest.raises(UserError) as error:
        ResidentWindows(stores, CPU, budget_bytes=2**10)
    assert str(error.value) == (
        f"the windows need {sum(w.flat.num_bytes + w.index.nbytes for w in stores) / 2**20:.1f} MiB on cpu and 0.0 MiB "
        "are set aside for them; pass --data-device cpu or use fewer episodes (--max-episodes)"
    )


# --- One ahead --------------------------------------------------------------------------------------------------------


class Watched(HostBatches):
    """Notes who cuts which batch, and hands it on without a device."""

    def __init__(self, stores: list[Windows]) -> None:
        super().__init__(stores, CPU)
        self.cut: list[tuple[int, str]] = []

    def on_host(self, plan: Plan) -> WindowBatch:
        self.cut.append((plan.step, threading.current_thread().name))
        return super().on_host(plan)


@pytest.fixture
def unpinned(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(WindowBatch, "pinned_to", WindowBatch.to)


def prefetched(stores: list[Windows], steps: int = 6) -> tuple[PrefetchedBatches, Watched]:
    watched = Watched(stores)
    return PrefetchedBatches(watched, lambda step: plan(CONFIG, [len(w) for w in stores], step), steps), watched


def test_batches_prepared_ahead_are_the_same(unpinned: None):
    stores = windows()
    batches, watched = prefetched(stores)
    for step in range(6):
        now = plan(CONFIG, [len(w) for w in stores], step)
        assert_same(batches.batch(now), HostBatches(stores, CPU).batch(now))
    assert batches._next is None  # there is no step after the last
    batches.close()
    assert [step for step, _ in watched.cut] == list(range(6))  # each once
    assert [name.startswith("batches") for _, name in watched.cut] == [False] + [True] * 5


def test_a_step_out_of_order_is_cut_at_once(unpinned: None):
    """After a restored state; what was prepared in vain does not matter."""
    stores = windows()
    batches, _ = prefetched(stores)
    for step in (0, 4, 2):
        now = plan(CONFIG, [len(w) for w in stores], step)
        assert_same(batches.batch(now), HostBatches(stores, CPU).batch(now))
    batches.close()


def test_errors_of_the_thread_arrive(unpinned: None):
    stores = windows()
    batches, watched = prefetched(stores)
    batches.batch(plan(CONFIG, [len(w) for w in stores], 0))
    assert batches._next is not None
    batches._next[1].result()
    watched.windows = [None]  # type: ignore[list-item]
    batches.batch(plan(CONFIG, [len(w) for w in stores], 1))
    with pytest.raises((TypeError, AttributeError, ValueError)):
        batches.batch(plan(CONFIG, [len(w) for w in stores], 2))
    batches.close()


def test_closing_waits_for_the_thread(unpinned: None, monkeypatch: pytest.MonkeyPatch):
    stores = windows()
    batches, watched = prefetched(stores)
    original = watched.on_host
    monkeypatch.setattr(watched, "on_host", lambda now: (time.sleep(0.05), original(now))[1])
    batches.batch(plan(CONFIG, [len(w) for w in stores], 0))
    batches.close()
    assert not [t for t in threading.enumerate() if t.name.startswith("batches")]


# --- Where the data lives ---------------------------------------------------------------------------------------------


CUDA = torch.device("cuda")


@pytest.fixture
def card(monkeypatch: pytest.MonkeyPatch) -> Callable[[int], None]:
    """A CUDA device with so many bytes free, as far as deciding goes; its memory is this machine's."""

    def with_free(free: int) -> None:
        monkeypatch.setattr(torch.cuda, "mem_get_info", lambda: (free, free))
        resident = batches_module.ResidentWindows
        monkeypatch.setattr(
            batches_module, "ResidentWindows", lambda stores, _, agents, budget: resident(stores, CPU, agents, budget)
        )

    return with_free


@pytest.mark.parametrize(
    ("asked", "free", "resident"),
    [("auto", 2**20, True), ("auto", 2**12, False), ("cpu", 2**20, False), ("device", 2**20, True)],
)
def test_data_goes_to_the_device_if_it_fits(card: Callable[[int], None], asked: Any, free: int, resident: bool):
    card(free)
    source = open_batches(replace(CONFIG, data_device=asked), windows(), CUDA)
    assert (
        source.capture and source.notes[0] == "steps are captured as CUDA graphs, with 3 agents and histories in eights"
    )
    if resident:
        assert isinstance(source.batches, DeviceBatches) and source.notes[1] == "windows are kept on the device (0 MiB)"
        assert source.batches.shapes == Shapes(3, 4, 3)
    else:
        assert isinstance(source.batches, PrefetchedBatches) and source.notes[1:] == (ON_HOST,)
        assert source.batches.batches.shapes == Shapes(3, 4, 3)
    source.batches.close()


def test_data_that_must_go_to_the_device_and_does_not_fit_is_refused(card: Callable[[int], None]):
    card(2**12)
    with pytest.raises(UserError, match=r"the windows need .* MiB on cpu and 0\.0 MiB are set aside for them"):
        open_batches(replace(CONFIG, data_device="device"), windows(), CUDA)


def test_shapes_of_histories_beyond_the_episodes_are_those_of_the_longest(card: Callable[[int], None]):
    card(2**20)
    config = replace(CONFIG, history_steps=1000)
    source = open_batches(config, windows(config), CUDA)
    assert isinstance(source.batches, DeviceBatches) and source.batches.shapes is not None
    assert source.batches.shapes.history_steps == max(int(w.flat.steps.max()) for w in windows(config)) < 12


def test_shapes_stay_fixed_without_capturing(card: Callable[[int], None]):
    """So that noise is drawn in the same shapes, and steps can be compared."""
    card(2**20)
    source = open_batches(replace(CONFIG, capture="off"), windows(), CUDA)
    assert isinstance(source.batches, DeviceBatches) and source.batches.shapes == Shapes(3, 4, 3)
    assert not source.capture and source.notes == ("windows are kept on the device (0 MiB)",)


def test_crowds_that_vary_are_not_padded_to_the_largest(card: Callable[[int], None]):
    card(2**30)
    stores = windows(replace(CONFIG, batch_size=1), agents=(2,) * 20 + (12,))
    source = open_batches(replace(CONFIG, batch_size=1), stores, CUDA)
    assert (
        not source.capture and isinstance(source.batches, PrefetchedBatches) and source.batches.batches.shapes is None
    )
    reason = r"steps are not captured: scenes hold 2 to 7 agents, and padding every batch to 7 would cost 9\.\d times"
    assert re.match(reason, source.notes[0]) and source.notes[1:] == (ON_HOST,)
    source.batches.close()


def test_on_a_cpu_batches_are_cut_by_it():
    for asked, kind in (("auto", HostBatches), ("cpu", HostBatches), ("device", DeviceBatches)):
        source = open_batches(replace(CONFIG, data_device=asked), windows(), CPU)  # type: ignore[arg-type]
        assert type(source.batches) is kind and source.batches.shapes is None  # type: ignore[attr-defined]
        assert (source.capture, source.notes) == (False, ())


def test_the_rate_falls_without_a_jump_to_the_last_step():
    rates = [plan(replace(CONFIG, steps=1000, lr=2.0), [5], step).lr for step in range(1000)]
    assert rates[100] == pytest.approx(2.0, rel=1e-3)  # the fall begins where the warm-up ends
    assert rates[550] == pytest.approx(2.0 * (0.02 + 0.98 / 2))  # half-way
    assert rates[-2] > rates[-1] > 0.04


def test_the_memory_that_a_process_needs_is_that_of_its_rows(monkeypatch: pytest.MonkeyPatch):
    given: list[int] = []
    monkeypatch.setattr(batches_module, "check_memory", lambda needed, *_: given.append(needed))
    open_batches(CONFIG, windows(), CPU)
    open_batches(CONFIG, windows(), CPU, rows=slice(0, CONFIG.batch_size // 3))
    assert given[1] == given[0] // 3
