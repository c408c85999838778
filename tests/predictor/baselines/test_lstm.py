"""The recurrent baselines against plain loops, and what the one memory of a whole scene must do."""

from itertools import product

import pytest
import torch
from hypothesis import given, settings
from torch import Tensor

from predictor.baselines.lstm import LSTM, LSTMConfig
from predictor.forecaster import Memory
from predictor.scene import SceneSpec
from predictor.support.errors import UserError
from tests.predictor.baselines.helpers import (
    AGENTS,
    BATCH,
    COLUMNS,
    HORIZON,
    TIME,
    TOLERANCE,
    fresh,
    last,
    presence,
    seeds,
    stream,
    tiny,
)
from tests.predictor.helpers import random_presence, random_states, spec

SCALES = torch.tensor([10.0, 10.0, 5.0, 5.0])
METRES = {"rtol": 1e-5, "atol": 1e-4}


def network_step(forecaster: LSTM, x: Tensor, memory: tuple[Tensor, Tensor]) -> tuple[Tensor, tuple[Tensor, Tensor]]:
    """Output and memory of the written-out network for one input vector."""
    cell = forecaster.cell
    embedded = (forecaster.embed.weight @ x + forecaster.embed.bias).clamp(min=0)
    gates = cell.weight_ih @ embedded + cell.bias_ih + cell.weight_hh @ memory[0] + cell.bias_hh
    width = forecaster.config.rnn_dim
    i, f, g, o = (gates[k * width : (k + 1) * width] for k in range(4))
    c = f.sigmoid() * memory[1] + i.sigmoid() * g.tanh()
    h = o.sigmoid() * c.tanh()
    hidden = (forecaster.hidden.weight @ h + forecaster.hidden.bias).clamp(min=0)
    return forecaster.readout.weight @ hidden + forecaster.readout.bias, (h, c)


def scaled(state: Tensor, agent: int) -> Tensor:
    return torch.cat([state / SCALES, torch.tensor([float(agent == 0)])])


@settings(max_examples=5)
@given(valid=presence(ego=False), seed=seeds)
def test_per_agent_against_a_loop(valid: Tensor, seed: int):
    forecaster, states = tiny("lstm"), random_states(seed, BATCH, TIME, AGENTS, 4)
    empty = (torch.zeros(5), torch.zeros(5))
    now = (1, 4)
    window = forecaster.window(states, valid, torch.tensor(now), HORIZON)

    def step(state: Tensor, i: int, memory: tuple[Tensor, Tensor]) -> tuple[Tensor, tuple[Tensor, Tensor]]:
        change, memory = network_step(forecaster, scaled(state, i), memory)
        after = state + change * SCALES
        after[:2] += state[2:]  # the residual is constant velocity at 1 s
        return after, memory

    for b, i in product(range(BATCH), range(AGENTS)):
        memory = empty
        for t in range(TIME):
            if not valid[b, t, i]:
                memory = empty
                continue
            after, memory = step(states[b, t, i], i, memory)
            torch.testing.assert_close(window.one_step[b, t, i], after, **METRES)
            if t == now[b]:
                future, free = [after], memory
                while len(future) < HORIZON:
                    after, free = step(future[-1], i, free)
                    future.append(after)
                torch.testing.assert_close(window.rollout[b, i], torch.stack(future), **METRES)


def joint_loop(forecaster: LSTM, states: Tensor, valid: Tensor) -> Tensor:
    """Predictions of the next states [time agents state] of one scene."""
    memory = (torch.zeros(5), torch.zeros(5))
    predictions, before = [], torch.zeros(AGENTS).bool()
    for state, present in zip(states, valid, strict=True):
        if not (present & before).any():
            memory = (torch.zeros(5), torch.zeros(5))
        columns = torch.zeros(COLUMNS, 5)
        for i in range(AGENTS):
            if present[i]:
                columns[i] = scaled(state[i], i)
        change, memory = network_step(forecaster, columns.flatten(), memory)
        predictions.append(state + change.view(COLUMNS, 4)[:AGENTS] * SCALES)
        before = present
    return torch.stack(predictions)


@settings(max_examples=8)
@given(valid=presence(ego=False), seed=seeds)
def test_joint_against_a_loop(valid: Tensor, seed: int):
    forecaster, states = tiny("lstm-joint"), random_states(seed, BATCH, TIME, AGENTS, 4)
    window = forecaster.window(states, valid, torch.tensor([1, 4]), HORIZON)
    for b, t in ((0, 1), (1, 4)):
        expected = joint_loop(forecaster, states[b], valid[b])
        torch.testing.assert_close(window.one_step[b][valid[b]], expected[valid[b]], **METRES)
        history, future = states[b, : t + 1], []
        for _ in range(HORIZON):
            present = torch.cat([valid[b, : t + 1], valid[b, t].expand(len(future), -1)])
            future.append(joint_loop(forecaster, torch.cat([history, *(f[None] for f in future)]), present)[-1])
        ours = window.rollout[b].transpose(0, 1)[:, valid[b, t]]
        torch.testing.assert_close(ours, torch.stack(future)[:, valid[b, t]], **METRES)


def test_joint_sees_the_others_and_knows_columns_apart():
    forecaster = tiny("lstm-joint", has_ego=False)
    states, valid = random_states(0, 1, TIME, 3, 4), torch.ones(1, TIME, 3).bool()
    moved = states.clone()
    moved[..., 1:, :] += 3.0
    plain, others = (forecaster.rollout(last(forecaster, s, valid), 2).states[0, 0] for s in (states, moved))
    assert not torch.allclose(plain[0], others[0], atol=1e-2)
    order = [0, 2, 1]
    permuted = forecaster.rollout(last(forecaster, states[:, :, order], valid), 2).states[0, 0]
    assert not torch.allclose(permuted[order], plain, atol=1e-2)


def one_step(forecaster: LSTM, memory: Memory, states: Tensor, valid: Tensor) -> Tensor:
    return forecaster.rollout(forecaster.observe(memory, states, valid)[1], 1).states


def test_the_scene_is_remembered_while_anybody_stays():
    forecaster = tiny("lstm-joint", has_ego=False)
    states, all_agents = random_states(0, 1, TIME, AGENTS, 4), torch.ones(1, AGENTS).bool()
    memory = list(stream(forecaster, states[:, :-1], all_agents[:, None].expand(-1, TIME - 1, -1)))[-1][0]
    now, source = states[:, -1], torch.arange(AGENTS)[None]
    expected = one_step(forecaster, memory, now, all_agents)
    for stays in range(AGENTS):  # whichever agent, at any place: memories of new agents are zero and do not count
        kept = memory.reorder(source, torch.arange(AGENTS)[None] == stays)
        torch.testing.assert_close(one_step(forecaster, kept, now, all_agents), expected, **TOLERANCE)
    new = one_step(forecaster, forecaster.empty_memory(1, AGENTS), now, all_agents)
    replaced = memory.reorder(source, torch.zeros(1, AGENTS).bool())
    torch.testing.assert_close(one_step(forecaster, replaced, now, all_agents), new, **TOLERANCE)
    assert not torch.allclose(new, expected, atol=1e-2)
    # by id or by place: an agent that left does not keep the scene's memory, also if no agent was re-sorted
    alone = torch.tensor([[False, False, True, True]])
    first = list(stream(forecaster, states[:, :-1], ~alone[:, None].expand(-1, TIME - 1, -1)))[-1][0]
    ours = one_step(forecaster, first, now, alone)
    torch.testing.assert_close(ours, one_step(forecaster, forecaster.empty_memory(1, AGENTS), now, alone), **TOLERANCE)


def test_joint_takes_no_more_agents_than_it_has_columns():
    forecaster = LSTM(spec(max_agents=3), LSTMConfig(joint=True), HORIZON)
    assert forecaster.columns == 3
    memory, states = forecaster.empty_memory(1, 5), random_states(0, 1, 5, 4)
    three, four = torch.tensor([[True, True, True, False, False]]), torch.tensor([[True, False, False, True, False]])
    assert forecaster.rollout(forecaster.observe(memory, states, three)[1], 2).states.shape == (1, 1, 5, 2, 4)
    with pytest.raises(UserError, match="agents at fixed places, but place 3 holds one too; .* num_agents=4 or"):
        forecaster.observe(memory, states, four)
    with pytest.raises(UserError, match="takes 3 agents"):
        forecaster.window(states[:, None], four[:, None], torch.tensor([0]), 1)


@pytest.mark.parametrize("kind", ["lstm", "lstm-joint"])
def test_memory_is_kept_with_present_agents(kind: str):
    forecaster = tiny(kind)
    states, valid = random_states(0, BATCH, TIME, AGENTS, 4), random_presence(0, BATCH, TIME, AGENTS)
    memory = list(stream(forecaster, states, valid))[-1][0]
    assert [m.shape[-1] for m in memory.nodes] == [5, 5] + ([1] if kind == "lstm-joint" else [])
    if kind == "lstm-joint":
        for env in range(BATCH):
            present = memory.nodes[0][env, valid[env, -1]]
            assert torch.equal(present, present[:1].expand_as(present))


@pytest.mark.parametrize(("joint", "columns"), [(False, 1), (True, 5)])
def test_default_sizes_are_the_papers(joint: bool, columns: int):
    forecaster = LSTM(SceneSpec(1.0, has_ego=False), LSTMConfig(joint, 5))
    layers = [(4 * columns, 64), (64 + 128 + 1, 4 * 128), (128, 64), (64, 4 * columns)]
    # torch's LSTM has two biases per gate
    assert sum(p.numel() for p in forecaster.parameters()) == sum((n + 1) * m for n, m in layers)


def test_number_of_agents_is_not_negative():
    with pytest.raises(UserError, match="num_agents must be positive, or 0 .* got -1"):
        LSTMConfig(joint=True, num_agents=-1)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["lstm", "lstm-joint"])
def test_overfits_one_batch(kind: str):
    forecaster, states = fresh(kind), random_states(0, 2, 5, 2, 4) / 4
    valid, now = torch.ones(2, 5, 2).bool(), torch.full((2,), 2)
    optimizer = torch.optim.Adam(forecaster.parameters(), lr=2e-2)
    losses = []
    for _ in range(150):
        output = forecaster.window(states, valid, now, 2)
        loss = output.one_step[:, :-1].sub(states[:, 1:]).square().mean()
        loss = loss + output.rollout.transpose(1, 2).sub(states[:, 3:]).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < losses[0] / 10
