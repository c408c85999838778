from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from predictor.baselines.constant_velocity import ConstantVelocity
from predictor.data.store import Episode
from predictor.data.windows import WindowBatch, Windows
from predictor.evaluation.accuracy import summarise
from predictor.evaluation.graph_accuracy import graph_accuracy
from predictor.evaluation.outcomes import (
    CARRIED,
    Outcome,
    run_sequence_batch,
    run_window_batch,
    run_windows,
    windows_per_forward,
)
from predictor.forecaster import Belief, Futures, Memory
from predictor.graph import pair_mask
from predictor.online import OnlineForecaster
from predictor.scene import KINEMATIC_FEATURES, KINEMATIC_FEATURES_3D, SceneBatch, SceneSpec
from tests.predictor.helpers import ROAD, any_model, model, random_presence, random_states, spec

SOLID = SceneSpec(
    0.5, ("world",) * 3, feature_names=KINEMATIC_FEATURES_3D, feature_scales=(1.0,) * 6, has_ego=False, max_agents=9
)


@dataclass
class Marking:
    """Forecasts, at every step ahead, the position plus 100 per step seen, 10 per step ahead and 1 per sample."""

    spec: SceneSpec
    horizon_steps: int = 3
    num_edge_types: int = 2
    edge_feature_dim: int = 1

    def empty_memory(self, batch: int, agents: int) -> Memory:
        return Memory(nodes=(torch.zeros(batch, agents, 1),))

    def observe(self, memory: Memory, states: Tensor, valid: Tensor) -> tuple[Memory, Belief]:
        seen = memory.nodes[0] + valid[..., None]
        shape = (*valid.shape, valid.shape[1])
        probs = torch.stack([torch.zeros(shape), torch.ones(shape)], dim=-1)
        return Memory((seen,)), Belief(states, valid, probs, seen[:, :, None].expand(*shape, 1), seen)

    def rollout(
        self, belief: Belief, horizon_steps: int, num_samples: int = 1, generator: torch.Generator | None = None
    ) -> Futures:
        mark = 100 * belief.internal[:, None, :, None]
        ahead = 10 * torch.arange(1, horizon_steps + 1)[:, None] + torch.arange(num_samples)[:, None, None, None]
        return Futures(belief.states[:, None, :, None] + mark + ahead)


def moving(spec_: SceneSpec, windows: int = 2, steps: int = 6, agents: int = 3) -> Tensor:
    """Everyone is at (step / 10, …) at each step, plus the agent's number / 100."""
    states = torch.zeros(windows, steps, agents, spec_.num_features)
    return states + torch.arange(steps)[:, None, None] / 10 + torch.arange(agents)[:, None] / 100


@pytest.mark.parametrize("layout", [spec(has_ego=False), SOLID], ids=["2d", "3d"])
def test_sequence_closed_form(layout: SceneSpec):
    states = moving(layout)
    batch = WindowBatch(states, torch.ones(2, 6, 3).bool(), torch.tensor([3, 3]))
    given = run_sequence_batch(Marking(layout), batch, horizon_steps=2, num_samples=2)
    assert given.forecast.shape == (2, 2, 3, 3 + 2, layout.position_dim)
    assert given.valid.all()
    # truths are steps 1 to 5; steps 1 to 3 are forecast from 1, 2 and 3 steps seen, 4 and 5 from 4
    truth, agent = [0.1, 0.2, 0.3, 0.4, 0.5], 2
    assert given.future[1, agent, :, -1].tolist() == pytest.approx([t + 0.02 for t in truth])
    expected = [100 + 10 + 0.0, 200 + 10 + 0.1, 300 + 10 + 0.2, 400 + 10 + 0.3, 400 + 20 + 0.3]
    assert given.forecast[1, 0, agent, :, -1].tolist() == pytest.approx([e + 0.02 for e in expected])
    # the second sample shares what is one step ahead
    expected = [*expected[:3], expected[3] + 1, expected[4] + 1]
    assert given.forecast[1, 1, agent, :, -1].tolist() == pytest.approx([e + 0.02 for e in expected])


def test_histories_of_different_length_end_together():
    layout = spec(has_ego=False)
    batch = WindowBatch(moving(layout, windows=3), torch.ones(3, 6, 3).bool(), torch.tensor([3, 1, 0]))
    given = run_sequence_batch(Marking(layout), batch, horizon_steps=2)
    assert given.valid[:, 0].tolist() == [
        [True, True, True, True, True],
        [False, False, True, True, True],
        [False, False, False, True, True],
    ]
    for window, last in enumerate([3, 1, 0]):
        alone = WindowBatch(batch.states[window : window + 1], batch.valid[window : window + 1], torch.tensor([last]))
        expected = run_sequence_batch(Marking(layout), alone, horizon_steps=2)
        steps = last + 2
        torch.testing.assert_close(given.forecast[window, ..., -steps:, :], expected.forecast[0])
        torch.testing.assert_close(given.future[window, ..., -steps:, :], expected.future[0])


def test_one_step_counts_only_from_seen_to_seen():
    layout = spec(has_ego=False)
    valid = torch.ones(1, 5, 2).bool()
    valid[0, 1, 1] = False  # agent 1 is away at step 1: no truth of step 1, nothing to forecast step 2 from
    batch = WindowBatch(moving(layout, 1, 5, 2) * valid[..., None], valid, torch.tensor([3]))
    given = run_sequence_batch(Marking(layout), batch, horizon_steps=1)
    assert given.valid[0].tolist() == [[True, True, True, True], [False, False, True, True]]


def test_without_a_history_there_is_only_the_free_run():
    layout = spec(has_ego=False)
    batch = WindowBatch(moving(layout), torch.ones(2, 6, 3).bool(), torch.tensor([0, 0]))
    whole, free = (run(Marking(layout), batch, 3) for run in (run_sequence_batch, run_window_batch))
    assert torch.equal(whole.forecast, free.forecast) and torch.equal(whole.valid, free.valid)


def windows(history_steps: int = 4, horizon_steps: int = 3, **kwargs: int) -> Windows:
    present = random_presence(0, 9, 4, share=0.8).numpy()
    states = random_states(0, 9, 4, 4).numpy() * present[..., None]
    episode = Episode(states, present, np.arange(4))
    short = Episode(states[:5], present[:5], np.arange(4))
    return Windows([episode, short], spec(ROAD), history_steps, horizon_steps, **kwargs)


class Counting(ConstantVelocity):
    """Forecasts as many metres per step as it has seen steps of an agent, and forgets nothing by itself."""

    def empty_memory(self, batch: int, agents: int) -> Memory:
        return Memory((torch.zeros(batch, agents, 1),))

    def observe(self, memory: Memory, states: Tensor, valid: Tensor) -> tuple[Memory, Belief]:
        seen = memory.nodes[0] + valid[..., None]
        return Memory((seen,)), replace(super().observe(memory, states, valid)[1], internal=seen)

    def rollout(self, belief: Belief, horizon_steps: int, num_samples: int = 1, generator: Any = None) -> Futures:
        states = belief.states[:, None, :, None].repeat(1, num_samples, 1, horizon_steps, 1)
        states[..., :1] += belief.internal[:, None, :, None] * torch.arange(1, horizon_steps + 1)[:, None]
        return Futures(states)


def test_memory_of_an_agent_that_was_away_begins_anew_as_in_live_scenes():
    states, valid = np.zeros((6, 2, 4), np.float32), np.ones((6, 2), np.bool_)
    valid[2, 1] = False
    episode = Episode(states, valid, np.array([5, 7]))
    forecaster = Counting(spec(("world", "world"), has_ego=False))
    made = Windows([episode], forecaster.spec, 10, 1)
    live = OnlineForecaster(forecaster, 1, 2)
    for now in range(5):
        live.observe(SceneBatch(states[now][None].astype(float), episode.ids[None], valid[now][None], np.zeros(1)))
        (row,) = np.flatnonzero(made.index[:, 1] == now)
        outcome = run_window_batch(forecaster, made.batch(np.array([row])), 1)
        there = valid[now]
        assert torch.equal(outcome.forecast[0, 0, there], live.forecast(1).xy[0, 0, there])
    assert outcome.forecast[0, 0, :, 0, 0].tolist() == [5.0, 2.0]


def test_the_last_windows_may_be_all_or_none():
    outcome = run_window_batch(ConstantVelocity(spec(ROAD)), windows().batch(np.arange(4)), 3)
    for count, left in ((0, 0), (3, 3), (4, 4), (9, 4)):
        last = outcome.last_windows(count)
        assert len(last.forecast) == len(last.valid) == left
        assert torch.equal(last.future, outcome.future[len(outcome.future) - left :])


def test_tail_of_the_sequence_is_the_window():
    """The horizon-only view comes out of the same run: same samples, same truths, ego left out."""
    forecaster, cut = model(frame=ROAD), windows()
    indices = np.arange(len(cut))
    (whole,) = run_windows(forecaster, cut, indices, 3, num_samples=4, seed=5, whole_sequence=True)
    (free,) = run_windows(forecaster, cut, indices, 3, num_samples=4, seed=5)
    tail = whole.tail(3)
    assert torch.equal(tail.forecast, free.forecast)
    assert torch.equal(tail.future, free.future) and torch.equal(tail.valid, free.valid)
    assert not whole.valid[:, 0].any()
    assert whole.valid[:, 1:, :3].any()


def test_samples_of_a_window_do_not_depend_on_its_batch():
    forecaster, cut = model(frame=ROAD), windows()
    indices = np.arange(len(cut))
    (together,) = run_windows(forecaster, cut, indices, 3, num_samples=4, seed=5)
    assert together.episode is not None and together.episode.tolist() == cut.index[indices, 0].tolist()
    alone = [out for i in indices for out in run_windows(forecaster, cut, indices[i : i + 1], 3, num_samples=4, seed=5)]
    for number, one in enumerate(alone):
        agents = one.forecast.shape[2]
        torch.testing.assert_close(one.forecast[0], together.forecast[number, :, :agents], rtol=1e-5, atol=1e-5)
    assert float((together.forecast[0, 1] - together.forecast[0, 2]).abs().max()) > 1e-3


def test_the_spread_of_a_model_with_modes_is_that_of_each_step_of_the_sequence():
    forecaster, cut = any_model("dgvae-plural"), windows()
    indices = np.arange(len(cut))
    (whole,) = run_windows(forecaster, cut, indices, 3, num_samples=4, whole_sequence=True)
    (free,) = run_windows(forecaster, cut, indices, 3, num_samples=4)
    assert whole.scale is not None and free.scale is not None and whole.scale.shape == whole.forecast.shape
    assert torch.equal(whole.tail(3).scale, free.scale)
    batch = cut.batch(np.array([5]))
    one = run_sequence_batch(forecaster, batch, 3, num_samples=4)
    memory = forecaster.empty_memory(1, batch.states.shape[2])
    _, belief = forecaster.observe(memory, batch.states[:, 0], batch.valid[:, 0])
    expected = forecaster.rollout(belief, 1).scale[0, 0, :, 0]
    for sample in range(4):
        torch.testing.assert_close(one.scale[0, sample, :, 0], expected)


def test_one_step_part_of_a_model_against_a_loop():
    forecaster, cut = model(frame=ROAD), windows()
    batch = cut.batch(np.array([5]))
    last = int(batch.last_observed)
    given = run_sequence_batch(forecaster, batch, 3, num_samples=2, generator=torch.Generator().manual_seed(0))
    memory = forecaster.empty_memory(1, batch.states.shape[2])
    for t in range(last):
        memory, belief = forecaster.observe(memory, batch.states[:, t], batch.valid[:, t])
        expected = forecaster.rollout(belief, 3).states[0, 0, :, 0, :2]
        for sample in range(2):
            now = batch.valid[0, t]
            torch.testing.assert_close(given.forecast[0, sample, now, t], expected[now])
        assert torch.equal(given.future[0, :, t], batch.states[0, t + 1, :, :2])


def test_sequence_does_not_peek():
    forecaster, cut = model(frame=ROAD), windows()
    batch = cut.batch(np.array([3, 4]))
    later = batch.states.clone()
    later[:, int(batch.last_observed.max()) + 1 :] += 50.0
    changed = WindowBatch(later, batch.valid, batch.last_observed)
    first, second = (run_sequence_batch(forecaster, b, 3).forecast for b in (batch, changed))
    assert torch.equal(first, second)


@pytest.mark.parametrize("steps", [0, 6])
def test_tail_longer_than_the_outcome_is_refused(steps: int):
    outcome = Outcome(torch.zeros(1, 1, 1, 5, 2), torch.zeros(1, 1, 5, 2), torch.ones(1, 1, 5).bool())
    with pytest.raises(ValueError, match=f"steps must be between 1 and 5, got {steps}"):
        outcome.tail(steps)


@pytest.mark.parametrize("whole_sequence", [False, True])
def test_beliefs_are_those_of_the_last_observed_step(whole_sequence: bool):
    forecaster, cut = model(num_edge_types=3, frame=ROAD), windows()
    indices = np.arange(len(cut))
    arguments = {"whole_sequence": whole_sequence}
    (without,) = run_windows(forecaster, cut, indices, 3, **arguments)
    assert without.edge_probs is without.edge_features is without.present is None
    (given,) = run_windows(forecaster, cut, indices, 3, keep_beliefs=True, **arguments)
    batch = cut.batch(indices)
    assert given.present is not None and given.edge_probs is not None and given.edge_features is not None
    assert torch.equal(given.present, batch.valid[torch.arange(len(cut)), batch.last_observed])
    window = 6
    memory = forecaster.empty_memory(1, batch.states.shape[2])
    for t in range(int(batch.last_observed[window]) + 1):
        memory, belief = forecaster.observe(memory, batch.states[window, t][None], batch.valid[window, t][None])
    torch.testing.assert_close(given.edge_probs[window], belief.edge_probs[0])
    torch.testing.assert_close(given.edge_features[window], belief.edge_features[0])
    assert torch.equal(given.forecast, without.forecast)
    if whole_sequence:
        assert given.tail(3).edge_probs is given.edge_probs


def test_true_edges_are_those_of_the_last_observed_step_and_stand_beside_the_believed_ones():
    layout = spec(has_ego=False)
    types = torch.randint(2, (2, 6, 3, 3), generator=torch.Generator().manual_seed(0))
    attributes = torch.randn(2, 6, 3, 3, 2)
    last = torch.tensor([3, 1])
    batch = WindowBatch(moving(layout), torch.ones(2, 6, 3).bool(), last, types, attributes)
    given = run_window_batch(Marking(layout), batch, 2, keep_beliefs=True)
    assert given.edge_types is not None and given.edge_attributes is not None
    assert torch.equal(given.edge_types, types[[0, 1], last])
    assert torch.equal(given.edge_attributes, attributes[[0, 1], last])
    assert given.edge_features is not None and given.present is not None and given.edge_probs is not None
    assert given.edge_features[:, 0, 1, 0].tolist() == [4.0, 2.0]  # steps seen
    found = graph_accuracy(given.edge_probs, given.edge_types, pair_mask(given.present))
    off_diagonal = types[[0, 1], last][:, ~torch.eye(3).bool()]
    assert found == pytest.approx(off_diagonal.float().mean().item())  # Marking says "edge" everywhere


def test_a_forecaster_with_an_ego_forecasts_every_agent_of_windows_without_one():
    """An absent agent stands before them: the first one is not taken for the ego, and edges stay where they are."""
    rng = np.random.default_rng(0)
    types, strengths = rng.integers(0, 2, (7, 3, 3)).astype(np.int8), rng.random((7, 3, 3, 1), dtype=np.float32)
    valid = np.ones((7, 3), dtype=np.bool_)
    valid[:2, 0] = False  # not there from the beginning, as no ego may be
    states = rng.normal(size=(7, 3, 4)).astype(np.float32)
    episode = Episode(states, valid, np.arange(3), edge_types=types, edge_attributes=strengths)
    windows = Windows([episode], spec(has_ego=False), history_steps=3, horizon_steps=2)
    chosen = np.arange(len(windows))
    (plain,) = run_windows(Marking(spec(has_ego=False)), windows, chosen, 2, keep_beliefs=True)
    (behind,) = run_windows(Marking(spec()), windows, chosen, 2, keep_beliefs=True)
    assert behind.valid[:, 1:].equal(plain.valid) and not behind.valid[:, 0].any()
    assert behind.forecast[:, :, 1:].equal(plain.forecast) and behind.future[:, 1:].equal(plain.future)
    assert behind.edge_types is not None and behind.edge_attributes is not None
    assert plain.edge_types is not None and behind.edge_types[:, 1:, 1:].equal(plain.edge_types)
    assert (behind.edge_types[:, 0] == -1).all() and (behind.edge_types[:, :, 0] == -1).all()
    assert plain.edge_attributes is not None and behind.edge_attributes[:, 1:, 1:].equal(plain.edge_attributes)


def test_windows_of_nobody_fit_into_one_forward():
    seen = np.zeros((6, 2), dtype=np.bool_)
    seen[5] = True  # after all forecasts
    nobody = Episode(np.zeros((6, 2, 4), np.float32), seen, np.arange(2))
    windows = Windows([nobody], spec(has_ego=False), 2, 2)
    chosen = np.flatnonzero(windows.index[:, 1] < 5)
    assert windows_per_forward(windows, chosen, 3) == 256


def test_a_ball_does_not_overlap_with_who_holds_it():
    """Ten players five metres apart, the ball in the hand of one: nobody is nearer than half a metre to another one."""
    court = SceneSpec(
        0.12,
        ("centroid", "centroid"),
        feature_names=(*KINEMATIC_FEATURES, CARRIED),
        feature_scales=(1.0,) * 5,
        has_ego=False,
        max_agents=11,
    )
    states = torch.zeros(1, 6, 11, 5)
    states[..., 1:, 0] = 5.0 * torch.arange(10)
    states[..., 0, :2], states[..., 0, 4] = torch.tensor([0.2, 0.2]), 1.0
    batch = WindowBatch(states, torch.ones(1, 6, 11, dtype=torch.bool), torch.tensor([2]))

    def overlaps(batch: WindowBatch) -> tuple[float, float]:
        found = summarise("still", [run_window_batch(ConstantVelocity(court), batch, 3)], miss_threshold_m=0.5)
        return found.overlap, found.true_overlap

    assert overlaps(batch) == (0.0, 0.0)
    states[..., 2, 0] = 0.3  # two players
    assert overlaps(batch) == pytest.approx((0.2, 0.2))
    plain = spec(has_ego=False)
    others = WindowBatch(states[..., : plain.num_features], batch.valid, batch.last_observed)
    assert run_window_batch(ConstantVelocity(plain), others, 3).carried is None
