"""Windows by index arithmetic are the windows that a plain loop cuts, bit for bit, on the host and on a device."""

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from predictor.data.device_windows import ResidentWindows, bytes_needed, window_sizes
from predictor.data.store import Episode
from predictor.data.window_tensors import flatten, join
from predictor.data.windows import WindowBatch, Windows, concatenate, padded, visible
from predictor.scene import SceneSpec
from predictor.support.errors import UserError
from tests.predictor.helpers import random_presence, random_states, spec

CPU = torch.device("cpu")
NAMES = tuple(f.name for f in fields(WindowBatch))


# --- A plain loop -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Cut:
    begin: int
    last: int
    columns: np.ndarray
    states: np.ndarray
    seen: np.ndarray


def cut_one(episode: Episode, layout: SceneSpec, now: int, history: int, horizon: int) -> Cut:
    begin, end = max(0, now - history + 1), now + 1 + horizon
    last = now - begin
    seen = visible(episode, layout)[begin:end].copy()
    seen[last + 1 :] = episode.valid[begin:end][last + 1 :] & seen[last]
    weight = seen[: last + 1].sum(axis=0) + 1000 * seen[last]
    weight[0] += 1_000_000 * layout.has_ego
    columns = np.argsort(-weight, kind="stable") if layout.has_ego else np.arange(len(weight))
    columns = columns[weight[columns] > 0]
    seen = seen[:, columns]
    return Cut(begin, last, columns, episode.states[begin:end][:, columns] * seen[..., None], seen)


def loop(windows: Windows, episodes: list[Episode], places: np.ndarray, history: int) -> WindowBatch:
    """Window by window; the layout of `WindowBatch` in words."""
    chosen = [(episodes[e], now) for e, now in windows.index[places].tolist()]
    cuts = [cut_one(e, windows.spec, now, history, windows.horizon_steps) for e, now in chosen]
    time, agents = max(c.last for c in cuts) + 1 + windows.horizon_steps, max(1, *(len(c.columns) for c in cuts))
    states = np.zeros((len(cuts), time, agents, windows.spec.num_features), dtype=np.float32)
    valid = np.zeros((len(cuts), time, agents), dtype=np.bool_)
    for window, cut in enumerate(cuts):
        steps, seen = cut.seen.shape
        states[window, :steps, :seen], valid[window, :steps, :seen] = cut.states, cut.seen
    labels = [loop_labels([e for e, _ in chosen], cuts, name, valid) for name in ("edge_types", "edge_attributes")]
    last = torch.tensor([cut.last for cut in cuts])
    return WindowBatch(torch.from_numpy(states), torch.from_numpy(valid), last, *labels)


def loop_labels(episodes: list[Episode], cuts: list[Cut], name: str, valid: np.ndarray) -> Tensor | None:
    first = getattr(episodes[0], name)
    if first is None:
        return None
    fill = -1 if name == "edge_types" else 0
    batch, time, agents = valid.shape
    made = np.full((batch, time, agents, agents, *first.shape[3:]), fill, dtype=first.dtype)
    for window, (episode, cut) in enumerate(zip(episodes, cuts, strict=True)):
        labels, (steps, seen) = getattr(episode, name), cut.seen.shape
        stretch = labels if len(labels) == 1 else labels[cut.begin : cut.begin + steps]
        made[window, :steps, :seen, :seen] = stretch[:, cut.columns][:, :, cut.columns]
    made[~(valid[..., :, None] & valid[..., None, :] & ~np.eye(agents, dtype=np.bool_))] = fill
    return torch.from_numpy(made)


# --- Casts of every kind ----------------------------------------------------------------------------------------------


def random_episode(seed: int, steps: int, agents: int, ego: bool, label_steps: int | None) -> Episode:
    present = random_presence(seed, steps, agents, ego=ego).numpy()
    states = random_states(seed, steps, agents, 4).numpy() * present[..., None]
    episode = Episode(states, present, np.arange(agents))
    if label_steps is None:
        return episode
    rng, size = np.random.default_rng(seed), (label_steps, agents, agents)
    attributes = rng.normal(size=(*size, 2)).astype(np.float32)
    return replace(episode, edge_types=rng.integers(3, size=size).astype(np.int8), edge_attributes=attributes)


Store = tuple[Windows, list[Episode], int]
STORES = st.fixed_dictionaries(
    {
        "seed": st.integers(0, 2**16),
        "ego": st.booleans(),
        "labels": st.sampled_from(["none", "static", "per_step", "both"]),
        "sizes": st.lists(st.tuples(st.integers(2, 8), st.integers(1, 6)), min_size=1, max_size=4),
        "perception_m": st.sampled_from([8.0, 15.0, 1e6]),
        "max_agents": st.integers(2, 6),
        "longest": st.integers(1, 6),
        "horizon": st.integers(1, 4),
        "shorter_by": st.integers(0, 5),
    }
)


def store(drawn: dict[str, Any]) -> Store:
    """Windows of a few episodes, those episodes, and a history."""
    episodes = []
    for i, (steps, agents) in enumerate(drawn["sizes"]):
        count = {"none": None, "static": 1, "per_step": steps, "both": steps if i % 2 else 1}[drawn["labels"]]
        episodes.append(random_episode(drawn["seed"] + i, steps, agents, drawn["ego"], count))
    layout = spec(has_ego=drawn["ego"], perception_m=drawn["perception_m"], max_agents=drawn["max_agents"])
    history = max(1, drawn["longest"] - drawn["shorter_by"])
    return Windows(episodes, layout, drawn["longest"], drawn["horizon"]), episodes, history


def assert_same(ours: WindowBatch, expected: WindowBatch) -> None:
    for name in NAMES:
        a, b = getattr(ours, name), getattr(expected, name)
        assert (a is None) == (b is None), name
        assert a is None or (a.dtype == b.dtype and torch.equal(a, b)), name


@settings(max_examples=60)
@given(drawn=STORES, seed=st.integers(0, 100))
def test_index_arithmetic_is_the_loop(drawn: dict[str, Any], seed: int):
    windows, episodes, history = store(drawn)
    places = np.random.default_rng(seed).integers(len(windows), size=5)
    assert_same(windows.batch(places, history), loop(windows, episodes, places, history))
    assert_same(windows.batch(places), loop(windows, episodes, places, windows.history_steps))


@settings(max_examples=40)
@given(drawn=STORES, seed=st.integers(0, 100), longer=st.integers(0, 3))
def test_resident_windows_are_windows(drawn: dict[str, Any], seed: int, longer: int):
    """Padded to a shape that depends on nothing that was drawn."""
    windows, _, history = store(drawn)
    resident = ResidentWindows([windows], CPU)
    places = np.random.default_rng(seed).integers(len(windows), size=5)
    time = history + windows.horizon_steps + longer
    batch = resident.batch(torch.from_numpy(places), history, time)
    assert batch.valid.shape == (5, time, resident.agents)
    assert_same(batch, padded(windows.batch(places, history), time, resident.agents))
    longest = min(history, int(windows.flat.steps.max()))
    assert resident.batch(torch.from_numpy(places), history).valid.shape[1] == longest + windows.horizon_steps
    assert len(resident) == len(windows)


@settings(max_examples=20)
@given(drawn=STORES)
def test_sizes_are_those_of_the_windows(drawn: dict[str, Any]):
    windows, episodes, _ = store(drawn)
    sizes = window_sizes(windows)
    assert sizes.shape == (len(windows),)
    every_other = np.arange(0, len(windows), 2)
    np.testing.assert_array_equal(window_sizes(windows, every_other), sizes[every_other])
    for window, (episode, now) in enumerate(windows.index.tolist()):
        cut = cut_one(episodes[episode], windows.spec, now, windows.history_steps, windows.horizon_steps)
        assert sizes[window] == len(cut.columns)


@pytest.mark.parametrize("labelled", [(True, True), (True, False)], ids=["all_labelled", "some_labelled"])
def test_resident_windows_of_two_stores_are_numbered_store_by_store(labelled: tuple[bool, bool]):
    stores = []
    for i, known in enumerate(labelled):
        episodes = [random_episode(10 * i + j, 5 + i, 2 + i + j, True, 1 if known else None) for j in range(3)]
        stores.append(Windows(episodes, spec(), 3, 2))
    resident = ResidentWindows(stores, CPU)
    places = [np.array([0, 3, 7]), np.array([1, 2])]
    expected = concatenate([w.batch(r) for w, r in zip(stores, places, strict=True)])
    batch = resident.batch(
        torch.from_numpy(np.concatenate([r + o for r, o in zip(places, resident.offsets, strict=True)]))
    )
    assert_same(batch, padded(expected, 5, resident.agents))
    assert (batch.edge_types is not None) == all(labelled)


def test_joining_one_store_copies_nothing():
    flat = Windows([random_episode(0, 4, 2, True, 1)], spec(), 2, 1).flat
    assert join([flat]) is flat


def test_an_ego_that_leaves_is_found_when_windows_move_to_the_device():
    episode = random_episode(0, 6, 3, True, None)
    episode.valid[4, 0] = False
    with pytest.raises(UserError, match=r"episode 0: the ego \(column 0\) must be present at every step up to 4"):
        ResidentWindows([Windows([episode], spec(), 3, 1)], CPU)


def test_bytes_are_those_of_the_tensors():
    """64 entries and the one of padding, of 4 floats and 2 marks; one label for each of 16 pairs, and unknown."""
    windows = Windows([random_episode(0, 16, 4, True, 1)], spec(), 3, 1)
    sizes, labels = 65 * (4 * 4 + 2) + 3 * 8, 17 * (1 + 2 * 4) + 2 * (8 + 1)
    assert windows.flat.num_bytes == sizes + labels
    assert bytes_needed([windows, windows]) == 2 * (sizes + labels + 15 * 2 * 8)
    assert windows.flat.to(CPU).num_bytes == sizes + labels


def test_a_window_without_anybody():
    """Without a visible agent and without an ego, a batch has an absent one: networks compute nothing of none."""
    unseen = Episode(np.zeros((3, 2, 4), np.float32), np.zeros((3, 2), np.bool_), np.arange(2))
    windows = Windows([unseen], spec(has_ego=False), 2, 1)
    assert windows.batch(np.array([0, 1])).states.shape == (2, 3, 1, 4)
    empty = replace(unseen, states=unseen.states[:, :0], valid=unseen.valid[:, :0], ids=unseen.ids[:0])
    assert Windows([empty], spec(has_ego=False), 2, 1).batch(np.array([1])).valid.tolist() == [[[False]] * 3]


def test_absent_agents_hide_what_their_states_hold():
    """A store may have any value where no agent is."""
    episode = random_episode(0, 4, 3, True, None)
    episode.valid[:, 1] = False
    episode.states[:, 1] = np.nan
    batch = Windows([episode], spec(), 3, 1).batch(np.array([2]))
    assert batch.states.isfinite().all()


def test_flat_labels_need_every_episode():
    known, unknown = random_episode(0, 4, 2, True, 1), random_episode(1, 4, 2, True, None)
    for episodes in ([known, unknown], [unknown, known]):
        flat = flatten(
            [e.states for e in episodes], [e.valid for e in episodes], [e.valid for e in episodes],
            [e.edge_types for e in episodes], [e.edge_attributes for e in episodes],
        )  # fmt: skip
        assert flat.edge_types is None and flat.edge_attributes is None


def test_padding_to_the_same_size_copies_nothing():
    batch = Windows([random_episode(0, 4, 2, True, 1)], spec(), 2, 1).batch(np.array([0, 1]))
    assert padded(batch, *batch.valid.shape[1:]) is batch
    assert concatenate([batch]) is batch
