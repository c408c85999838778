"""What every learned baseline must keep: streaming, no peeking, padding, symmetry, memory that moves with agents."""

from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from jaxtyping import TypeCheckError
from torch import Tensor
from torch.nn import functional

from predictor.forecaster import Memory, TrainableForecaster, WindowOutput
from predictor.graph import pair_mask
from predictor.scene import KINEMATIC_FEATURES_3D, SceneSpec
from predictor.support.errors import UserError
from predictor.training.objective import kl_categorical
from tests.predictor.baselines.helpers import (
    AGENTS,
    BATCH,
    HORIZON,
    KINDS,
    TIME,
    TOLERANCE,
    every_kind,
    fresh,
    last,
    no_noise,
    presence,
    seeds,
    stream,
    tiny,
)
from tests.predictor.helpers import ROAD, random_presence, random_states

PER_AGENT = [kind for kind in KINDS if kind != "lstm-joint"]
WITH_GRAPH = [kind for kind in KINDS if kind.startswith(("dnri", "imma"))]
DRAWN = [kind for kind in KINDS if kind.startswith("dnri")]
METRES = {"rtol": 1e-5, "atol": 1e-4}  # positions are tens of metres


def scenes(seed: int = 0, batch: int = BATCH, time: int = TIME, agents: int = AGENTS) -> Tensor:
    return random_states(seed, batch, time, agents, 4)


def quiet_window(forecaster: Any, states: Tensor, valid: Tensor, now: Tensor, steps: int = HORIZON) -> WindowOutput:
    with no_noise():
        return forecaster.window(states, valid, now, steps)


def everything(forecaster: Any, states: Tensor, valid: Tensor) -> dict[str, Tensor]:
    """All outputs as [batch time agents (agents) …]."""
    now = torch.full((len(states),), states.shape[1] - 2)
    window = quiet_window(forecaster, states, valid, now)
    belief = last(forecaster, states, valid)
    outputs = {
        "one_step": window.one_step,
        "rollout": window.rollout[:, None],
        "streamed": forecaster.rollout(belief, HORIZON).states,
        "pair edges": belief.edge_probs[:, None],
    }
    if window.prior_logits is not None:
        outputs |= {"pair prior": window.prior_logits, "pair posterior": window.posterior_logits}
    return outputs


def is_pairwise(name: str) -> bool:
    return name.startswith("pair")


# --- Interface --------------------------------------------------------------------------------------------------------


@every_kind
def test_is_a_trainable_forecaster(kind: str):
    forecaster = fresh(kind)
    assert isinstance(forecaster, TrainableForecaster)
    assert forecaster.horizon_steps == HORIZON
    belief = last(forecaster, scenes(), torch.ones(BATCH, TIME, AGENTS).bool())
    assert belief.edge_probs.shape == (BATCH, AGENTS, AGENTS, forecaster.num_edge_types)
    assert torch.equal(belief.edge_features, torch.zeros(BATCH, AGENTS, AGENTS, forecaster.edge_feature_dim))
    assert forecaster.edge_feature_dim >= 1 and forecaster.num_edge_types >= 2


@every_kind
def test_the_same_seed_builds_the_same_model_and_another_does_not(kind: str):
    one, same = fresh(kind).state_dict(), fresh(kind).state_dict()
    assert all(torch.equal(one[name], same[name]) for name in one)
    torch.manual_seed(8)
    other = type(fresh(kind))(fresh(kind).spec, fresh(kind).config).state_dict()
    assert not all(torch.equal(one[name], other[name]) for name in one)


@pytest.mark.shapes
@every_kind
def test_axes_in_the_wrong_order_raise(kind: str):
    forecaster, valid = tiny(kind), torch.ones(BATCH, AGENTS).bool()
    with pytest.raises(TypeCheckError):
        forecaster.observe(forecaster.empty_memory(BATCH, AGENTS), scenes()[:, 0], valid.T)


@every_kind
@pytest.mark.parametrize("has_ego", [True, False])
def test_three_dimensions(kind: str, has_ego: bool):
    layout = SceneSpec(
        1.0, ("world", "centroid", "world"), KINEMATIC_FEATURES_3D, (10.0,) * 3 + (5.0,) * 3, has_ego=has_ego
    )
    forecaster = fresh(kind, layout)
    states = torch.randn(BATCH, TIME, AGENTS, 6, generator=torch.Generator().manual_seed(0))
    valid = torch.ones(BATCH, TIME, AGENTS).bool()
    window = quiet_window(forecaster, states, valid, torch.tensor([2, 3]))
    assert window.one_step.shape == (BATCH, TIME, AGENTS, 6)
    streamed = forecaster.rollout(list(stream(forecaster, states, valid))[2][1], HORIZON).states
    torch.testing.assert_close(streamed[0, 0], window.rollout[0], **METRES)


@every_kind
def test_sizes_must_fit(kind: str):
    forecaster = fresh(kind)
    config = type(forecaster.config)
    with pytest.raises(UserError, match=r"delta_scales needs 4 positive numbers, got \(1.0, 2.0\)"):
        type(forecaster)(forecaster.spec, config(delta_scales=(1.0, 2.0)))
    width = {"mlp": "hidden_dim", "lstm": "embed_dim"}.get(kind.split("-")[0], "rnn_dim")
    with pytest.raises(UserError, match=f"{width} must be at least 1, got 0"):
        config(**{width: 0})
    config(**{width: 1})


@pytest.mark.parametrize(("residual", "x_m"), [("state", 3.0), ("constant_velocity", 7.0), ("trapezoid", 8.0)])
@every_kind
def test_a_silent_network_leaves_the_residual(kind: str, residual: Any, x_m: float):
    """With a readout that says +1 in every unit and delta scales that say how much that is: x 1 → 1 + 2, + drift."""
    template = fresh(kind)
    config = type(template.config)(residual=residual, delta_scales=(2.0, 1e-9, 1.0, 1e-9))
    forecaster = type(template)(SceneSpec(2.0, has_ego=False), config, HORIZON)
    readout = forecaster.decoder.readout[-1] if kind in WITH_GRAPH else forecaster.readout
    torch.nn.init.zeros_(readout.weight)
    torch.nn.init.ones_(readout.bias)
    states = torch.tensor([[[[1.0, 5.0, 2.0, 0.0]]]])
    window = forecaster.window(states, torch.ones(1, 1, 1).bool(), torch.zeros(1, dtype=torch.long), 1)
    expected = torch.tensor([[[x_m, 5.0, 3.0, 0.0]]])
    torch.testing.assert_close(window.one_step[0], expected)
    torch.testing.assert_close(window.rollout[0, :, 0], expected[0])


# --- Streaming ≡ window -----------------------------------------------------------------------------------------------


@every_kind
@settings(max_examples=10)
@given(valid=presence(ego=False), seed=seeds, last_observed=st.tuples(*[st.integers(0, TIME - 1)] * BATCH))
def test_streaming_forecasts_what_the_window_does(kind: str, valid: Tensor, seed: int, last_observed: tuple[int, ...]):
    forecaster, states = tiny(kind), scenes(seed)
    window = quiet_window(forecaster, states, valid, torch.tensor(last_observed))
    beliefs = [belief for _, belief in stream(forecaster, states, valid)]
    for index, t in enumerate(last_observed):
        streamed = forecaster.rollout(beliefs[t], HORIZON).states
        torch.testing.assert_close(streamed[index, 0], window.rollout[index], **METRES)
    for t, belief in enumerate(beliefs):
        if window.prior_logits is None:  # teacher forcing follows the same graph as streaming
            torch.testing.assert_close(
                forecaster.rollout(belief, 1).states[:, 0, :, 0], window.one_step[:, t], **METRES
            )
        else:
            torch.testing.assert_close(belief.edge_probs, window.prior_logits[:, t].softmax(-1), **TOLERANCE)


@every_kind
def test_history_matters_to_all_but_the_mlp(kind: str):
    """Without this, the equality above would hold for a model that remembers nothing."""
    forecaster, states, valid = tiny(kind), scenes(), torch.ones(BATCH, TIME, AGENTS).bool()
    long, short = last(forecaster, states, valid), last(forecaster, states[:, -1:], valid[:, -1:])
    difference = (forecaster.rollout(long, HORIZON).states - forecaster.rollout(short, HORIZON).states).abs().max()
    assert difference == 0 if kind == "mlp" else difference > 1e-2
    if kind in WITH_GRAPH:
        assert (long.edge_probs - short.edge_probs)[pair_mask(valid[:, -1])].abs().max() > 1e-3


@every_kind
def test_memory_does_not_grow(kind: str):
    forecaster, states = tiny(kind), scenes(time=9)
    memories = [memory for memory, _ in stream(forecaster, states, torch.ones(BATCH, 9, AGENTS).bool())]
    sizes = {tuple(t.shape for t in (*m.nodes, *m.pairs)) for m in [forecaster.empty_memory(BATCH, AGENTS), *memories]}
    assert len(sizes) == 1
    assert bool(sizes.pop()) == (kind != "mlp")


@every_kind
def test_no_rollout_is_no_work(kind: str, monkeypatch: pytest.MonkeyPatch):
    forecaster, calls = tiny(kind), []
    inner = type(forecaster).recur
    monkeypatch.setattr(type(forecaster), "recur", lambda self, *args: calls.append(1) or inner(self, *args))
    window = forecaster.window(scenes(), torch.ones(BATCH, TIME, AGENTS).bool(), torch.tensor([2, 4]), 0)
    assert window.rollout.shape == (BATCH, AGENTS, 0, 4)
    assert len(calls) == TIME


@every_kind
def test_longer_horizons_continue_shorter_ones(kind: str):
    forecaster = tiny(kind)
    belief = last(forecaster, scenes(), torch.ones(BATCH, TIME, AGENTS).bool())
    longest = forecaster.rollout(belief, 5).states
    for steps in (0, 1, 3):
        assert torch.equal(longest[..., :steps, :], forecaster.rollout(belief, steps).states)


# --- No peeking -------------------------------------------------------------------------------------------------------


@every_kind
@settings(max_examples=8)
@given(valid=presence(), seed=seeds, now=st.integers(0, TIME - 2))
def test_the_future_changes_nothing_but_the_posterior(kind: str, valid: Tensor, seed: int, now: int):
    forecaster, states = tiny(kind), scenes(seed)
    valid[0, : now + 1, 1] = valid[:, now + 1 :, :2] = True  # at least one pair lives on both sides of `now`
    other_states, other_valid = states.clone(), valid.clone()
    other_states[:, now + 1 :] = scenes(seed + 1, time=TIME - now - 1)
    other_valid[:, now + 1 :, 2:] = ~valid[:, now + 1 :, 2:]
    one, other = (
        forecaster.window(s, v, torch.full((BATCH,), now), HORIZON, torch.Generator().manual_seed(3))
        for s, v in ((states, valid), (other_states, other_valid))
    )
    past = slice(now + 1)
    assert torch.equal(one.rollout, other.rollout)
    assert not torch.allclose(one.one_step[:, now + 1], other.one_step[:, now + 1], atol=1e-3)
    if kind in DRAWN:
        assert torch.equal(one.prior_logits[:, past], other.prior_logits[:, past])
        assert (one.posterior_logits[0, now, 0, 1] - other.posterior_logits[0, now, 0, 1]).abs().max() > 1e-5
    else:
        assert torch.equal(one.one_step[:, past], other.one_step[:, past])


# --- Padding and symmetry ---------------------------------------------------------------------------------------------


@every_kind
@pytest.mark.parametrize("frame", [("world", "world"), ROAD], ids=["world", "road"])
@settings(max_examples=8)
@given(valid=presence(), seed=seeds, padding=st.integers(1, 3))
def test_padding_is_invisible(kind: str, frame: Any, valid: Tensor, seed: int, padding: int):
    forecaster, states = tiny(kind, frame=frame), scenes(seed)
    padded_valid = functional.pad(valid, (0, padding))
    padded_states = 100 * scenes(seed + 1, agents=AGENTS + padding)
    padded_states[:, :, :AGENTS][valid] = states[valid]
    plain, padded = everything(forecaster, states, valid), everything(forecaster, padded_states, padded_valid)
    present = {"one_step": valid, "rollout": valid[:, [-2]], "streamed": valid[:, [-1]]}
    for name, expected in plain.items():
        ours = padded[name][:, :, :AGENTS, :AGENTS] if is_pairwise(name) else padded[name][:, :, :AGENTS]
        if name in present:  # an absent agent has no state to speak of
            ours, expected = ours[present[name]], expected[present[name]]
        torch.testing.assert_close(ours, expected, **METRES, msg=lambda m, n=name: f"{n}: {m}")


@pytest.mark.parametrize("kind", PER_AGENT)
@settings(max_examples=8)
@given(valid=presence(ego=False), seed=seeds, order=st.permutations(range(AGENTS)))
def test_permuting_agents_permutes_outputs(kind: str, valid: Tensor, seed: int, order: list[int]):
    forecaster, states = tiny(kind, has_ego=False), scenes(seed)
    plain = everything(forecaster, states, valid)
    for name, permuted in everything(forecaster, states[:, :, order], valid[:, :, order]).items():
        expected = plain[name][:, :, order]
        expected = expected[:, :, :, order] if is_pairwise(name) else expected
        torch.testing.assert_close(permuted, expected, **METRES, msg=lambda m, n=name: f"{n}: {m}")


@every_kind
def test_scenes_of_a_batch_are_independent(kind: str):
    forecaster, states, valid = tiny(kind), scenes(), random_presence(0, BATCH, TIME, AGENTS)
    together = everything(forecaster, states, valid)
    for scene in range(BATCH):
        for name, alone in everything(forecaster, states[scene : scene + 1], valid[scene : scene + 1]).items():
            torch.testing.assert_close(alone[0], together[name][scene], **METRES, msg=lambda m, n=name: f"{n}: {m}")


@every_kind
def test_an_ego_alone_and_frames_without_agents_are_forecast(kind: str):
    forecaster, states = tiny(kind, has_ego=False), scenes()
    valid = random_presence(0, BATCH, TIME, AGENTS, ego=False)
    valid[0] = False  # never an agent
    valid[1, 2] = valid[1, 5] = False  # no agent for some steps
    valid[1, 4] = torch.tensor([False, True, False, False])  # one alone
    for values in everything(forecaster, states, valid).values():
        assert torch.isfinite(values).all()
    no_edge = torch.zeros(forecaster.num_edge_types)
    no_edge[0] = 1.0
    for _, belief in stream(forecaster, states, valid):
        absent = ~pair_mask(belief.valid)
        assert torch.equal(belief.edge_probs[absent], no_edge.expand(int(absent.sum()), -1))
        torch.testing.assert_close(belief.edge_probs.sum(-1), torch.ones(BATCH, AGENTS, AGENTS))
        assert (belief.edge_probs >= 0).all()


# --- Memory -----------------------------------------------------------------------------------------------------------


@every_kind
def test_absent_agents_have_no_memory(kind: str):
    forecaster, states, valid = tiny(kind), scenes(), random_presence(0, BATCH, TIME, AGENTS)
    for (memory, _), present in zip(stream(forecaster, states, valid), valid.unbind(1), strict=True):
        assert all(not m[~present].any() and m[present].any() for m in memory.nodes)
        assert all(not m[~pair_mask(present)].any() for m in memory.pairs)


@pytest.mark.parametrize("kind", PER_AGENT)
def test_agents_forget_what_was_before_they_left(kind: str):
    """An agent that is back after a step of absence stands where a newcomer would; so do its pairs."""
    forecaster, states, valid = tiny(kind), scenes(batch=1, time=4, agents=3), torch.ones(1, 4, 3).bool()
    valid[0, 1, 2] = False
    returned = list(stream(forecaster, states, valid))[-1][0]
    valid[0, 0, 2] = False
    newcomer = list(stream(forecaster, states, valid))[-1][0]
    for ours, expected in zip(returned.pairs, newcomer.pairs, strict=True):
        torch.testing.assert_close(ours[0, 2], expected[0, 2], **TOLERANCE)
    if kind == "lstm":
        torch.testing.assert_close(returned.nodes[0][0, 2], newcomer.nodes[0][0, 2], **TOLERANCE)


@pytest.mark.parametrize("kind", PER_AGENT)
def test_memory_moves_with_agents_that_change_places(kind: str):
    forecaster, states, valid = tiny(kind, has_ego=False), scenes(), torch.ones(BATCH, TIME, AGENTS).bool()
    order = torch.tensor([[2, 0, 3, 1], [1, 3, 2, 0]])
    envs = torch.arange(BATCH)[:, None]
    (memory, _), (_, expected) = list(stream(forecaster, states, valid))[-2:]
    moved = memory.reorder(order, torch.ones(BATCH, AGENTS).bool())
    belief = forecaster.observe(moved, states[envs, -1, order], valid[:, -1])[1]
    ours, plain = forecaster.rollout(belief, HORIZON).states, forecaster.rollout(expected, HORIZON).states
    torch.testing.assert_close(ours[:, 0], plain[envs, 0, order], **METRES)


@every_kind
def test_a_new_agent_has_no_memory_of_the_one_at_its_place_before(kind: str):
    """Three of four stay and a new agent takes the place of the one that left."""
    forecaster, states, valid = tiny(kind), scenes(), torch.ones(BATCH, TIME, AGENTS).bool()
    known = torch.tensor([[True, True, False, True]] * BATCH)
    memory = list(stream(forecaster, states, valid))[-2][0]
    kept = memory.reorder(torch.arange(AGENTS).expand(BATCH, -1), known)
    future = forecaster.rollout(forecaster.observe(kept, states[:, -1], valid[:, -1])[1], HORIZON).states
    assert torch.isfinite(future).all()
    original = forecaster.rollout(last(forecaster, states, valid), HORIZON).states
    if kind == "lstm":
        torch.testing.assert_close(future[:, 0, known[0]], original[:, 0, known[0]], **METRES)
    if kind not in ("mlp", "lstm-joint"):
        assert not torch.allclose(future[:, 0, 2], original[:, 0, 2], atol=1e-3)
    else:  # no memory of its own
        torch.testing.assert_close(future, original, **METRES)


@every_kind
def test_envs_of_memory_are_selected_replaced_and_joined(kind: str):
    forecaster, states, valid = tiny(kind), scenes(batch=3), torch.ones(3, TIME, AGENTS).bool()
    memory = list(stream(forecaster, states, valid))[-2][0]
    empty = forecaster.empty_memory(1, AGENTS)
    shuffled = memory.select(torch.tensor([2, 0]))
    joined = Memory.concatenate(shuffled, empty)  # environments: third, first, an empty one
    replaced = joined.replace_envs(torch.tensor([0]), empty)
    now = states[torch.tensor([2, 0, 1]), -1]

    def forecast(from_memory: Memory) -> Tensor:
        return forecaster.rollout(forecaster.observe(from_memory, now, valid[:, -1])[1], HORIZON).states[:, 0]

    continued = forecaster.rollout(last(forecaster, states, valid), HORIZON).states[:, 0]
    new = forecaster.rollout(last(forecaster, now[:, None], valid[:, -1:]), HORIZON).states[:, 0]
    torch.testing.assert_close(forecast(joined), torch.stack([continued[2], continued[0], new[2]]), **METRES)
    torch.testing.assert_close(forecast(replaced), torch.stack([new[0], continued[0], new[2]]), **METRES)


@every_kind
def test_padded_memory_has_room_for_newcomers(kind: str):
    forecaster, states, valid = tiny(kind), scenes(), torch.ones(BATCH, TIME, AGENTS).bool()
    valid[:, :-1, -1] = False
    *_, (memory, _), (_, expected) = stream(forecaster, states, valid)
    short = list(stream(forecaster, states[:, :-1, :-1], valid[:, :-1, :-1]))[-1][0].padded(AGENTS)
    for ours, theirs in zip((*short.nodes, *short.pairs), (*memory.nodes, *memory.pairs), strict=True):
        torch.testing.assert_close(ours, theirs, **TOLERANCE)
    ours = forecaster.rollout(forecaster.observe(short, states[:, -1], valid[:, -1])[1], HORIZON).states
    torch.testing.assert_close(ours, forecaster.rollout(expected, HORIZON).states, **METRES)


# --- Samples ----------------------------------------------------------------------------------------------------------


@every_kind
def test_sample_0_draws_nothing_and_does_not_depend_on_the_others(kind: str):
    forecaster, generator = tiny(kind), torch.Generator().manual_seed(0)
    belief = last(forecaster, scenes(), random_presence(0, BATCH, TIME, AGENTS))
    before = generator.get_state()
    first = forecaster.rollout(belief, HORIZON, 1, generator).states
    assert torch.equal(generator.get_state(), before)
    many = forecaster.rollout(belief, HORIZON, 5, generator).states
    assert many.shape == (BATCH, 5, AGENTS, HORIZON, 4)
    assert torch.equal(many[:, :1], first)
    if kind not in DRAWN:
        assert torch.equal(many, first.expand_as(many))


# --- Training ---------------------------------------------------------------------------------------------------------


def loss(output: WindowOutput, states: Tensor, valid: Tensor) -> Tensor:
    total = output.one_step[:, :-1].sub(states[:, 1:]).square().mean() + output.rollout.square().mean()
    if output.prior_logits is not None and output.posterior_logits is not None:
        total = total + kl_categorical(output.posterior_logits, output.prior_logits, pair_mask(valid))
    return total


@every_kind
def test_every_weight_gets_a_finite_gradient(kind: str):
    forecaster, states, valid = fresh(kind), scenes(), random_presence(0, BATCH, TIME, AGENTS, ego=False)
    valid[0, 3] = False  # a frame without agents must not poison the gradient
    output = forecaster.window(states, valid, torch.tensor([1, 4]), HORIZON, torch.Generator().manual_seed(0))
    loss(output, states, valid).backward()
    for name, parameter in forecaster.named_parameters():
        assert parameter.grad is not None and torch.isfinite(parameter.grad).all(), name
        assert parameter.grad.abs().max() > 0, name
