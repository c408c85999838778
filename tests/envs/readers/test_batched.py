"""Batched readers: what they read, what they refuse, and that no step of the stream loops over rows."""

import sys
from collections.abc import Callable
from copy import deepcopy
from types import FrameType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from benchmarks.row_costs import make_run
from benchmarks.tensor_traffic import TensorTraffic, spec
from envs.readers.base import perceive
from envs.readers.batched import AgentTensors, BatchedReader, TensorReader
from envs.readers.envpool import PoolReader
from envs.readers.vmas import VmasReader
from envs.scene_stream import ForecastConfig, SceneStream
from predictor.layers import rnn
from predictor.scene import PADDING_ID, Scene, SceneSpec
from predictor.support.errors import UserError
from tests.envs.helpers import HIGHWAY_SPEC, tiny_model

ROAD = spec(agents=4)
FIELD = SceneSpec(dt_s=0.1, has_ego=False, max_agents=5)


def crowd(rows: int = 3, agents: int = 6) -> AgentTensors:
    rng = torch.Generator().manual_seed(0)
    states = 20 * torch.randn(rows, agents, 4, generator=rng, dtype=torch.float64)
    valid = torch.rand(rows, agents, generator=rng) < 0.7
    valid[:, 0] = True
    ids = torch.stack([torch.randperm(100, generator=rng)[:agents] for _ in range(rows)])
    return AgentTensors(states, valid, ids, torch.linspace(0, 1, rows))


@pytest.mark.parametrize("kind", ["torch", "numpy"])
def test_an_ego_perceives_what_the_reader_of_one_environment_says(kind: str):
    given = crowd()
    arrays = [field.numpy() for field in (given.states, given.valid, given.ids, given.heading_rad)]  # type: ignore[union-attr]
    read = TensorReader(ROAD).read(given if kind == "torch" else AgentTensors(*arrays), np.arange(3))
    for row in range(3):
        alone = perceive(Scene(arrays[0][row], arrays[2][row], arrays[1][row], float(arrays[3][row])), ROAD)
        np.testing.assert_array_equal(read.states[row], alone.states)
        np.testing.assert_array_equal(read.ids[row], alone.ids)
        np.testing.assert_array_equal(read.valid[row], alone.valid)
    np.testing.assert_allclose(read.heading_rad, arrays[3])


@pytest.mark.unchecked
def test_without_an_ego_all_agents_stay_in_their_places():
    read = TensorReader(FIELD).read(
        AgentTensors(torch.ones(2, 3, 4), torch.tensor([[1, 0, 1], [1, 1, 1]])), np.arange(2)
    )
    assert read.ids.tolist() == [[0, PADDING_ID, 2, PADDING_ID, PADDING_ID], [0, 1, 2, PADDING_ID, PADDING_ID]]
    assert read.valid.tolist() == [[True, False, True, False, False], [True, True, True, False, False]]
    assert (read.states[0, 1] == 0).all() and (read.states[:, 3:] == 0).all() and read.states.dtype == np.float64


def test_values_of_absent_agents_do_not_matter():
    given = crowd()
    assert given.valid is not None
    given.states[~given.valid] = torch.nan
    assert np.isfinite(TensorReader(ROAD).read(given, np.arange(3)).states).all()


def changed(**changes: Any) -> AgentTensors:
    given = crowd()
    fields = {name: getattr(given, name).clone() for name in ("states", "valid", "ids", "heading_rad")}
    for name, change in changes.items():
        fields[name] = change(fields[name])
    return AgentTensors(**fields)


def put(place: Any, value: Any) -> Callable[[torch.Tensor], torch.Tensor]:
    def change(field: torch.Tensor) -> torch.Tensor:
        field[place] = value
        return field

    return change


@pytest.mark.unchecked
@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (dict(states=lambda s: s[..., :3]), r"states need 4 features .*, got 3"),
        (dict(states=put((1, 0, 2), torch.inf)), r"must be finite, but it is not so in 1 of 3, entry 1 first"),
        (dict(states=put((1, 0, 2), -1e38)), r"states must be at most 1e\+30 in size, but it is not so in 1 of 3"),
        (dict(heading_rad=put(2, torch.nan)), r"heading_rad must be finite, but it is not so in 1 of 3, entry 2"),
        (dict(valid=put((2, 0), False)), r"agent 0 must be the ego.* in 1 of 3, entry 2 first"),
        (dict(ids=put((0, 0), -3)), r"ids of present agents must not be negative.*entry 0"),
        (dict(ids=lambda i: torch.ones_like(i)), r"ids must be unique within an environment.* 3 of 3"),
        (dict(ids=lambda i: i.double()), r"ids that are whole numbers, got float64"),
        (dict(valid=lambda v: v * 0.5), r"valid of True and False .or 1 and 0., got float32 with other values"),
        (dict(valid=lambda v: v[:, :2]), r"valid of the shape \(3, 6\).* got \(3, 2\)"),
        (dict(states=lambda s: s[:2]), r"states of 3 environments × agents × features, got \(2, 6, 4\)"),
    ],
)
def test_a_bad_array_is_refused_in_a_line(changes: dict[str, Any], words: str):
    given = changed(**changes)
    with pytest.raises(UserError, match=words) as refused:
        TensorReader(ROAD).read(given, np.arange(3))
    assert "\n" not in str(refused.value)


def test_ones_and_zeros_are_truth_values():
    given = changed(valid=lambda v: v.to(torch.int8))
    expected = TensorReader(ROAD).read(changed(), np.arange(3)).valid
    assert TensorReader(ROAD).read(given, np.arange(3)).valid.tolist() == expected.tolist()


def test_equal_ids_of_absent_agents_are_no_matter():
    given = changed(ids=put((slice(None), slice(1, None)), 7), valid=put((slice(None), slice(2, None)), False))
    assert TensorReader(ROAD).read(given, np.arange(3)).ids.tolist()[0][2:] == [PADDING_ID, PADDING_ID]


def test_too_many_agents_without_an_ego_are_refused():
    with pytest.raises(UserError, match=r"6 agents do not fit max_agents=5; raise max_agents"):
        TensorReader(FIELD).read(AgentTensors(torch.zeros(2, 6, 4)), np.arange(2))


def entity(radius: float, places: torch.Tensor, **more: Any) -> Any:
    state = SimpleNamespace(pos=places, vel=0 * places + radius)
    return SimpleNamespace(state=state, shape=SimpleNamespace(circumscribed_radius=lambda: radius), **more)


def vmas_like(rows: int) -> Any:
    places = torch.arange(2.0 * rows).reshape(rows, 2)
    agents, landmarks = [entity(0.1, places), entity(0.2, places + 1, adversary=True)], [entity(0.3, places + 2)]
    return SimpleNamespace(world=SimpleNamespace(agents=agents, landmarks=landmarks, dt=0.1, batch_dim=rows, dim_p=2))


def test_vmas_is_read_without_vmas():
    env = vmas_like(4)
    reader = VmasReader(env)
    assert reader.spec.max_agents == 3 and reader.spec.dt_s == pytest.approx(0.1) and not reader.spec.has_ego
    read = reader.read(env, np.array([3, 1]))
    np.testing.assert_allclose(read.states[0, 1], [7, 8, 0.2, 0.2, 1, 0, 0.2], rtol=1e-6)
    np.testing.assert_allclose(read.states[1, 2], [4, 5, 0.3, 0.3, 0, 1, 0.3], rtol=1e-6)
    assert read.ids.tolist() == [[0, 1, 2]] * 2
    assert VmasReader(env, landmarks=False).spec.max_agents == 2
    with pytest.raises(UserError, match=r"needs an environment of VMAS \(vmas.make_env\), got SimpleNamespace"):
        VmasReader(SimpleNamespace())


def test_vmas_itself():
    vmas = pytest.importorskip("vmas")
    env = vmas.make_env("simple_spread", num_envs=5, device="cpu", continuous_actions=True, seed=0)
    env.reset()
    read = VmasReader(env).read(env, np.arange(5))
    for agent in range(3):
        np.testing.assert_allclose(read.states[:, agent, :2], env.agents[agent].state.pos.numpy(), rtol=1e-6)


def test_numbers_of_every_width_are_read_and_words_refused():
    half = torch.arange(16.0).reshape(1, 4, 4).bfloat16()
    read = TensorReader(ROAD).read(AgentTensors(half), np.arange(1))
    np.testing.assert_array_equal(read.states[0, 0], [0.0, 1.0, 2.0, 3.0])
    words = np.full((1, 4, 4), "a")
    for given, name in (
        (AgentTensors(words), "states"),
        (AgentTensors(half, heading_rad=words[0, 0, :1]), "heading_rad"),
    ):
        with pytest.raises(UserError, match=f"TensorReader needs {name} that are numbers, got <U1"):
            TensorReader(ROAD).read(given, np.arange(1))


def test_all_batched_readers_keep_the_interface():
    for reader in (TensorReader(ROAD), PoolReader(HIGHWAY_SPEC, 2), VmasReader(vmas_like(2))):
        assert isinstance(reader, BatchedReader)


def test_memory_follows_the_ids_of_tensor_traffic():
    """A stream that sees the rows of traffic forecasts what one that sees a row alone forecasts."""
    together, alone = (SceneStream(tiny_model(ROAD), ROAD, rows, ForecastConfig()) for rows in (6, 1))
    traffic, reader = TensorTraffic(6, 9), TensorReader(ROAD)
    for _ in range(5):
        read = reader.read(traffic.agents, np.arange(6))
        begun = np.flatnonzero(traffic.begun.numpy())
        together.reset(begun)
        if 4 in begun:
            alone.reset()
        every, one = together.take(read), alone.take(read[np.array([4])])
        torch.testing.assert_close(every.xy[4], one.xy[0], rtol=1e-4, atol=1e-4)
        traffic.step()


class Opcodes:
    """Counts the instructions of Python that run within its block, in modules of this project."""

    def __enter__(self) -> "Opcodes":
        self.count = 0
        sys._getframe().f_trace_opcodes = True  # Python 3.12 looks at settrace whether a frame wants instructions
        sys.settrace(self._enter)
        return self

    def __exit__(self, *error: Any) -> None:
        sys.settrace(None)

    def _enter(self, frame: FrameType, event: str, argument: Any) -> Any:
        frame.f_trace_opcodes, frame.f_trace_lines = True, False
        return self._count

    def _count(self, frame: FrameType, event: str, argument: Any) -> Any:
        self.count += event == "opcode"
        return self._count


FEW, MANY = 100, 500


def instructions(rows: int, read: Callable[[Any], Any] | None = None) -> int:
    step, observe = make_run("traffic", rows, "highway", max_rows=1024, device="cpu")
    observe(), step()
    with Opcodes() as counted:
        observe()
        if read is not None:
            read(rows)
    return counted.count


@pytest.fixture
def whole_arrays(monkeypatch: pytest.MonkeyPatch) -> None:
    """Large arrays are not cut into blocks that fit into the cache."""
    monkeypatch.setattr(rnn, "_MANY", float("inf"))


@pytest.mark.slow
@pytest.mark.unchecked  # they would add some instructions for each environment
@pytest.mark.usefixtures("whole_arrays")
def test_no_step_loops_over_rows_in_python():
    few, many = instructions(FEW), instructions(MANY)
    assert abs(many - few) < MANY - FEW, f"{few} instructions for {FEW} rows, {many} for {MANY}"


@pytest.mark.usefixtures("whole_arrays")
def test_a_loop_over_rows_would_be_found():
    few, many = (instructions(rows, lambda rows: [row for row in range(rows)]) for rows in (FEW, MANY))
    assert many - few > 2 * (MANY - FEW)


def test_what_the_simulator_writes_later_changes_no_scene():
    given = AgentTensors(np.ones((2, 3, 4)), np.ones((2, 3), bool), np.tile(np.arange(3), (2, 1)), np.zeros(2))
    scenes = TensorReader(SceneSpec(dt_s=1.0, max_agents=3)).read(given, np.arange(2))
    before = deepcopy(scenes)
    for array in (given.states, given.valid, given.ids, given.heading_rad):
        array[:] = 0 if array.dtype == bool else array + 1
    for name in ("states", "valid", "ids", "heading_rad"):
        np.testing.assert_array_equal(getattr(scenes, name), getattr(before, name))
