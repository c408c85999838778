"""The dG-VAE against plain loops, and what it must keep: streaming, no peeking, padding, symmetry, sampling."""

import re
from collections.abc import Iterator
from copy import deepcopy
from dataclasses import replace
from itertools import product
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.nn import functional

from predictor.dgvae import DGVAE
from predictor.dgvae import model as dgvae
from predictor.dgvae.config import DGVAEConfig
from predictor.forecaster import Belief, Memory, WindowOutput
from predictor.graph import pair_mask
from predictor.support.errors import UserError
from tests.predictor.helpers import FAST_LIKE, RICH, ROAD, model, precise, random_presence, random_states, spec

BATCH, TIME, AGENTS = 2, 6, 4
TOLERANCE = {"rtol": 0.0, "atol": 1e-5}
EXACT = {"rtol": 0.0, "atol": 1e-9}  # in float64
EVERY_KIND = [
    pytest.param(size, residual, types, id=f"{size}-{residual}-{types}types")
    for size, residual, types in (
        *product(("fast", "paper"), ("state", "constant_velocity"), (2, 3)),
        *product(("rich",), ("trapezoid",), (2, 3)),
    )
]
every_kind = pytest.mark.parametrize(("size", "residual", "types"), EVERY_KIND)


@st.composite
def presence(draw: st.DrawFn, ego: bool = True) -> Tensor:
    """Who is present at each step; every pattern of entering and leaving can occur."""
    cells = BATCH * TIME * AGENTS
    bits = draw(st.integers(0, 2**cells - 1))
    valid = torch.tensor([bool(bits >> i & 1) for i in range(cells)]).view(BATCH, TIME, AGENTS)
    if ego:
        valid[..., 0] = True
    return valid


seeds = st.integers(0, 2**16)


def stream(forecaster: DGVAE, states: Tensor, valid: Tensor) -> Iterator[tuple[Memory, Belief]]:
    """Memory and belief after each step."""
    memory = forecaster.empty_memory(states.shape[0], states.shape[2])
    for now, present in zip(states.unbind(1), valid.unbind(1), strict=True):
        memory, belief = forecaster.observe(memory, now, present)
        yield memory, belief


def last(forecaster: DGVAE, states: Tensor, valid: Tensor) -> Belief:
    """Belief after the whole history."""
    return list(stream(forecaster, states, valid))[-1][1]


def window_without_noise(forecaster: DGVAE, states: Tensor, valid: Tensor, last_observed: Tensor) -> WindowOutput:
    """The training pass with every sampled graph replaced by the expected one."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(dgvae, "concrete_sample", lambda logits, *_: torch.softmax(logits, dim=-1))
        return forecaster.window(states, valid, last_observed, forecaster.horizon_steps)


# --- Streaming ≡ full window ------------------------------------------------------------------------------------------


@every_kind
@settings(max_examples=10)
@given(valid=presence(), seed=seeds)
def test_streaming_encodes_what_the_whole_history_at_once_does(
    size: Any, residual: Any, types: int, valid: Tensor, seed: int
):
    forecaster = model(size, types, residual)
    states = random_states(seed, BATCH, TIME, AGENTS, 4)
    whole = window_without_noise(forecaster, states, valid, torch.zeros(BATCH, dtype=torch.long))
    for t, (_, belief) in enumerate(stream(forecaster, states, valid)):
        torch.testing.assert_close(belief.internal.logits, whole.prior_logits[:, t], **TOLERANCE)
        torch.testing.assert_close(belief.edge_probs, whole.prior_logits[:, t].softmax(-1), **TOLERANCE)
        torch.testing.assert_close(belief.edge_features, whole.features[:, t], **TOLERANCE)


@every_kind
@settings(max_examples=10)
@given(valid=presence(), seed=seeds, last_observed=st.tuples(*[st.integers(0, TIME - 1)] * BATCH))
def test_streaming_forecasts_what_the_window_does(
    size: Any, residual: Any, types: int, valid: Tensor, seed: int, last_observed: tuple[int, ...]
):
    # exactly: where two agents meet, roll-outs along their geometry multiply rounding errors
    forecaster = deepcopy(model(size, types, residual)).double()
    states = random_states(seed, BATCH, TIME, AGENTS, 4).double()
    window = window_without_noise(forecaster, states, valid, torch.tensor(last_observed))
    beliefs = [belief for _, belief in stream(forecaster, states, valid)]
    for index, t in enumerate(last_observed):
        streamed = forecaster.rollout(beliefs[t], forecaster.horizon_steps).states
        torch.testing.assert_close(
            streamed[index, 0], window.rollout[index], rtol=1e-4, atol=1e-4
        )  # positions: tens of m


def test_streaming_in_two_stretches_equals_one():
    """The encoder takes a memory in: the second half of a history continues where the first one ended."""
    forecaster = model()
    states, valid = random_states(0, BATCH, TIME, AGENTS, 4), random_presence(0, BATCH, TIME, AGENTS)
    inputs, pairs = forecaster.codec.inputs(states, valid), pair_mask(valid)
    empty = forecaster.empty_memory(BATCH, AGENTS).pairs[:2]
    whole = forecaster.encoder(inputs, pairs, *empty)
    first = forecaster.encoder(inputs[:, :2], pairs[:, :2], *empty)
    second = forecaster.encoder(inputs[:, 2:], pairs[:, 2:], first.hidden[:, -1], first.cell[:, -1])
    torch.testing.assert_close(second.prior_logits, whole.prior_logits[:, 2:], **TOLERANCE)
    assert not torch.allclose(first.hidden[:, -1], torch.zeros(()))


def test_history_matters():
    """Without this, the equalities above would hold for a model that remembers nothing."""
    forecaster = model()
    states, valid = random_states(0, BATCH, TIME, AGENTS, 4), torch.ones(BATCH, TIME, AGENTS).bool()
    long, short = last(forecaster, states, valid), last(forecaster, states[:, -1:], valid[:, -1:])
    pairs = pair_mask(valid[:, -1])
    assert (long.edge_probs - short.edge_probs)[pairs].abs().max() > 1e-2
    assert (long.edge_features - short.edge_features)[pairs].abs().max() > 1e-2
    assert (forecaster.rollout(long, 3).states - forecaster.rollout(short, 3).states).abs().max() > 1e-2


def test_memory_does_not_grow():
    forecaster = model()
    states, valid = random_states(0, 1, 9, 3, 4), torch.ones(1, 9, 3).bool()
    shapes = {tuple(t.shape for t in (*memory.nodes, *memory.pairs)) for memory, _ in stream(forecaster, states, valid)}
    assert len(shapes) == 1


# --- No peeking -------------------------------------------------------------------------------------------------------


@every_kind
@settings(max_examples=10)
@given(valid=presence(), seed=seeds, now=st.integers(0, TIME - 2))
def test_the_future_changes_the_posterior_and_nothing_else(
    size: Any, residual: Any, types: int, valid: Tensor, seed: int, now: int
):
    forecaster = model(size, types, residual)
    states = random_states(seed, BATCH, TIME, AGENTS, 4)
    valid[0, : now + 1, 1] = valid[:, now + 1 :, :2] = True  # at least one pair lives on both sides of `now`
    other_states, other_valid = states.clone(), valid.clone()
    other_states[:, now + 1 :] = random_states(seed + 1, BATCH, TIME - now - 1, AGENTS, 4)
    other_valid[:, now + 1 :, 2:] = ~valid[:, now + 1 :, 2:]
    last_observed = torch.full((BATCH,), now)
    one, other = (
        forecaster.window(s, v, last_observed, 3, torch.Generator().manual_seed(3))
        for s, v in ((states, valid), (other_states, other_valid))
    )
    past = slice(None, now + 1)
    assert torch.equal(one.prior_logits[:, past], other.prior_logits[:, past])
    assert torch.equal(one.features[:, past], other.features[:, past])
    torch.testing.assert_close(one.rollout, other.rollout, rtol=0, atol=1e-5)
    assert (one.posterior_logits[0, now, 0, 1] - other.posterior_logits[0, now, 0, 1]).abs().max() > 1e-4
    # … while the present does change all of them
    assert not torch.allclose(one.prior_logits[:, now + 1], other.prior_logits[:, now + 1], atol=1e-4)


# --- Padding and symmetry ---------------------------------------------------------------------------------------------


def everything(forecaster: DGVAE, states: Tensor, valid: Tensor) -> dict[str, Tensor]:
    """All outputs, time axis second; agents (and pairs of them) follow it."""
    now = torch.full((len(states),), states.shape[1] - 2)
    window = window_without_noise(forecaster, states, valid, now)
    belief = last(forecaster, states, valid)
    samples = max(1, forecaster.config.num_modes)
    futures = forecaster.rollout(belief, 3, samples)
    modes = {"mode_probs": futures.mode_probs, "mode_scale": futures.scale} if samples > 1 else {}
    return modes | {
        "prior": window.prior_logits,
        "posterior": window.posterior_logits,
        "features": window.features,
        "one_step": window.one_step,
        "rollout": window.rollout[:, None],
        "streamed_probs": belief.edge_probs[:, None],
        "streamed_features": belief.edge_features[:, None],
        "streamed": futures.states,
    }


def presence_of(forecaster: DGVAE, valid: Tensor) -> dict[str, Tensor]:
    """Whether an agent is there, for each output that says nothing of one that is not."""
    modes = valid[:, [-1]].expand(-1, max(1, forecaster.config.num_modes), -1)
    streamed = {name: modes for name in ("streamed", "mode_probs", "mode_scale")}
    return {"one_step": valid, "rollout": valid[:, [-2]], **streamed}


PAIRWISE = {"prior", "posterior", "features", "streamed_probs", "streamed_features"}


@pytest.mark.slow
@pytest.mark.parametrize("size", ["fast", "rich", "plural"])
@pytest.mark.parametrize(
    "frame", [("world", "world"), ROAD, ("centroid", "centroid")], ids=["world", "road", "centroid"]
)
@settings(max_examples=12)
@given(valid=presence(), seed=seeds, padding=st.integers(1, 3))
def test_padding_is_invisible(size: Any, frame: Any, valid: Tensor, seed: int, padding: int):
    forecaster = precise(size, num_edge_types=3, frame=frame)
    states = random_states(seed, BATCH, TIME, AGENTS, 4).double()
    garbage = 100 * random_states(seed + 1, BATCH, TIME, AGENTS + padding, 4).double()
    padded_valid = torch.cat([valid, torch.zeros(BATCH, TIME, padding).bool()], dim=2)
    padded_states = torch.where(padded_valid[..., None], garbage.clone(), garbage)
    padded_states[:, :, :AGENTS][valid] = states[valid]
    plain, padded = everything(forecaster, states, valid), everything(forecaster, padded_states, padded_valid)
    present = presence_of(forecaster, valid)
    for name, expected in plain.items():
        ours = padded[name][:, :, :AGENTS, :AGENTS] if name in PAIRWISE else padded[name][:, :, :AGENTS]
        if name in present:
            ours, expected = ours[present[name]], expected[present[name]]
        torch.testing.assert_close(ours, expected, **EXACT, msg=lambda m, n=name: f"{n}: {m}")


@pytest.mark.slow
@pytest.mark.parametrize("size", ["fast", "rich", "plural"])
@settings(max_examples=12)
@given(valid=presence(ego=False), seed=seeds, order=st.permutations(range(AGENTS)))
def test_permuting_agents_permutes_outputs(size: Any, valid: Tensor, seed: int, order: list[int]):
    check_permutation(precise(size, num_edge_types=3, has_ego=False), valid, seed, order)


@settings(max_examples=12)
@given(valid=presence(), seed=seeds, others=st.permutations(range(1, AGENTS)))
def test_permuting_others_around_the_ego_permutes_outputs(valid: Tensor, seed: int, others: list[int]):
    check_permutation(precise(num_edge_types=3, frame=ROAD), valid, seed, [0, *others])


def check_permutation(forecaster: DGVAE, valid: Tensor, seed: int, order: list[int]) -> None:
    states = random_states(seed, BATCH, TIME, AGENTS, 4).double()
    plain = everything(forecaster, states, valid)
    permuted = everything(forecaster, states[:, :, order], valid[:, :, order])
    present = presence_of(forecaster, valid[:, :, order])
    for name, values in plain.items():
        ours, expected = (
            permuted[name],
            values[:, :, order][:, :, :, order] if name in PAIRWISE else values[:, :, order],
        )
        if name in present:
            ours, expected = ours[present[name]], expected[present[name]]
        torch.testing.assert_close(ours, expected, **EXACT, msg=lambda m, n=name: f"{n}: {m}")


def test_the_ego_is_not_like_the_others():
    forecaster = model()
    states, valid = random_states(0, 1, TIME, 3, 4), torch.ones(1, TIME, 3).bool()
    one, other = (last(forecaster, states[:, :, order], valid) for order in ([0, 1, 2], [1, 0, 2]))
    assert not torch.allclose(one.edge_probs[:, 2, 0], other.edge_probs[:, 2, 1], atol=1e-3)


@pytest.mark.parametrize("padding", [0, 3])
def test_ego_alone_is_forecast(padding: int):
    forecaster = precise(frame=ROAD)
    states, valid = random_states(0, BATCH, TIME, 1, 4).double(), torch.ones(BATCH, TIME, 1).bool()
    alone = everything(forecaster, states, valid)
    wide = functional.pad(states, (0, 0, 0, padding)), functional.pad(valid, (0, padding))
    for name, values in everything(forecaster, *wide).items():
        assert torch.isfinite(values).all()
        ours = values[:, :, :1, :1] if name in PAIRWISE else values[:, :, :1]
        torch.testing.assert_close(ours, alone[name], **EXACT)
    belief = last(forecaster, *wide)
    assert torch.equal(belief.edge_probs[..., 0], torch.ones(BATCH, 1 + padding, 1 + padding).double())
    assert not belief.edge_features.any()


def test_absent_pairs_have_no_edge_and_no_features():
    states, valid = random_states(0, BATCH, TIME, AGENTS, 4), random_presence(0, BATCH, TIME, AGENTS)
    belief = last(model(num_edge_types=3), states, valid)
    absent = ~pair_mask(valid[:, -1])
    assert torch.equal(belief.edge_probs[absent], torch.tensor([1.0, 0.0, 0.0]).expand(int(absent.sum()), 3))
    assert not belief.edge_features[absent].any()
    assert belief.edge_features[~absent].all()


def test_agents_forget_what_was_before_they_left():
    """An agent that is back after a step of absence stands where a newcomer would; so do its pairs."""
    forecaster = model()
    states, valid = random_states(0, 1, 4, 3, 4), torch.ones(1, 4, 3).bool()
    valid[0, 1, 2] = False
    returned = list(stream(forecaster, states, valid))[-1][0]
    valid[0, 0, 2] = False
    newcomer = list(stream(forecaster, states, valid))[-1][0]
    for ours, expected in zip((*returned.pairs, *returned.nodes), (*newcomer.pairs, *newcomer.nodes), strict=True):
        torch.testing.assert_close(ours[0, 2], expected[0, 2], **TOLERANCE)
    assert not torch.allclose(returned.nodes[0][0, 0], newcomer.nodes[0][0, 0], atol=1e-3)  # the ego did meet it


# --- Residual and inputs ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("residual", "expected"),
    [("state", [1.5, 4.0, 3.0, 4.5]), ("constant_velocity", [3.0, 6.0, 3.0, 4.5])],
)
def test_change_is_added_to_the_residual(residual: Any, expected: list[float]):
    config = DGVAEConfig(8, 5, 6, 7, 9, residual=residual, delta_scales=(1.0, 2.0, 3.0, 4.0))
    forecaster = DGVAE(spec(dt_s=0.5), config)
    after = forecaster.codec.advance(torch.tensor([1.0, 2.0, 3.0, 4.0]), torch.tensor([0.5, 1.0, 0.0, 0.125]))
    assert after.tolist() == expected


def test_network_inputs_closed_form():
    states = torch.tensor([[[30.0, 5.0, 10.0, 0.0], [40.0, -5.0, 5.0, -5.0], [9.0, 9.0, 9.0, 9.0]]])
    valid = torch.tensor([[True, True, False]])
    assert model(frame=ROAD).codec.inputs(states, valid).tolist() == [
        [[0.0, 0.5, 2.0, 0.0, 1.0], [1.0, -0.5, 1.0, -1.0, 0.0], [0.0] * 5]
    ]
    assert model(has_ego=False).codec.inputs(states, valid).tolist() == [
        [[3.0, 0.5, 2.0, 0.0], [4.0, -0.5, 1.0, -1.0], [0.0] * 4]
    ]


def test_encoder_sees_what_changed_since_the_last_step():
    """In units of `change_scales`, in the frame of each step; nothing for who was not there a step ago."""
    torch.manual_seed(0)
    forecaster = DGVAE(spec(ROAD), replace(FAST_LIKE, change_scales=(2.0, 4.0, 1.0, 5.0)), 3)
    shown = []
    forecaster.encoder.register_forward_pre_hook(lambda _, arguments: shown.append(arguments[0]))
    states, valid = torch.zeros(1, 4, 3, 4), torch.ones(1, 4, 3).bool()
    states[0, :, 0, 0] = torch.tensor([0.0, 10.0, 20.0, 30.0])  # the ego drives on; agent 1 keeps its distance …
    states[0, :, 1, 0] = torch.tensor([5.0, 15.0, 25.0, 39.0])  # … until it is 4 m further
    states[0, :, 1, 3] = torch.tensor([0.0, 5.0, 5.0, 0.0])
    states[0, :, 2, 1] = torch.tensor([0.0, 8.0, 8.0, 16.0])
    valid[0, 1, 2] = False
    forecaster.window(states, valid, torch.tensor([3]), 0)
    inputs = torch.cat([forecaster.codec.inputs(states, valid), torch.zeros(1, 4, 3, 4)], dim=-1)
    inputs[0, 1, 1, 8] = 1.0
    inputs[0, 3, 1, 5:] = torch.tensor([2.0, 0.0, 0.0, -1.0])
    inputs[0, 3, 2, 5:] = torch.tensor([-5.0, 2.0, 0.0, 0.0])  # the ego moved away by 10 m
    torch.testing.assert_close(shown.pop(), inputs)
    memory = forecaster.empty_memory(1, 3)
    for t in range(4):
        memory, _ = forecaster.observe(memory, states[:, t], valid[:, t])
        torch.testing.assert_close(shown.pop(), inputs[:, [t]])


@pytest.mark.parametrize(("of_place", "change"), [(True, [1.0, 2.0]), (False, [-19.0, 2.0])])
def test_an_agent_that_comes_does_not_move_the_others(of_place: bool, change: list[float]):
    """The mean of all agents, to which x is relative, jumps by 20 m; agent 0 moves by 1 m along x and 2 along y."""
    torch.manual_seed(0)
    config = replace(FAST_LIKE, change_scales=(1.0, 1.0, 1.0, 1.0), changes_of_place=of_place)
    forecaster = DGVAE(spec(("centroid", "world"), has_ego=False), config, 3)
    shown = []
    forecaster.encoder.register_forward_pre_hook(lambda _, arguments: shown.append(arguments[0]))
    states, valid = torch.zeros(1, 2, 2, 4), torch.tensor([[[True, False], [True, True]]])
    states[0, 1, :, :2] = torch.tensor([[1.0, 2.0], [39.0, 0.0]])
    forecaster.window(states, valid, torch.tensor([1]), 0)
    window = shown.pop()
    torch.testing.assert_close(window[0, 1, :, 4:6], torch.tensor([change, [0.0, 0.0]]))
    torch.testing.assert_close(window[..., :4], forecaster.codec.inputs(states, valid))
    memory = forecaster.empty_memory(1, 2)
    for step in range(2):
        memory, _ = forecaster.observe(memory, states[:, step], valid[:, step])
        torch.testing.assert_close(shown.pop(), window[:, [step]])


@pytest.mark.parametrize(
    ("scales", "must"),
    [((1.0, 2.0), "needs 4 positive numbers"), ((1.0, 0.0, 1.0, 1.0), "must be positive, finite numbers")],
    ids=["too_few", "zero"],
)
def test_change_scales_must_fit_the_features(scales: tuple[float, ...], must: str):
    with pytest.raises(UserError, match=rf"change_scales {must}, got {re.escape(str(scales))}"):
        DGVAE(spec(), replace(FAST_LIKE, change_scales=scales))


def test_substeps_against_a_loop():
    """Messages act on the motion directly, and anew as the agents move; the memory of each agent stands still."""
    forecaster = precise("rich", num_edge_types=3)
    states, valid = random_states(0, BATCH, TIME, AGENTS, 4).double(), random_presence(0, BATCH, TIME, AGENTS)
    belief = last(forecaster, states, valid)
    moved, pairs = belief.states, pair_mask(belief.valid)
    change = forecaster.decoder.change(belief.internal.node_after)
    for _ in range(2):
        inputs = forecaster.codec.inputs(moved, belief.valid)
        messages = forecaster.decoder.messages(inputs, pairs, belief.edge_probs, belief.edge_features)
        pushed = forecaster.decoder.direct(messages)
        assert pushed.abs().max() > 1e-2
        moved = forecaster.codec.advance(moved, change + pushed, 0.5)
    torch.testing.assert_close(forecaster.rollout(belief, 1).states[:, 0, :, 0], moved, **EXACT)
    window = forecaster.window(states, valid, torch.full((BATCH,), TIME - 1), 1)
    assert window.one_step.shape == states.shape and window.rollout.shape == (BATCH, AGENTS, 1, 4)


@pytest.mark.parametrize("substeps", [0, 2])
def test_zero_start_begins_at_the_residual_and_learns(substeps: int):
    """Fresh weights forecast constant velocity; the readout, which is zero, has a gradient that is not."""
    torch.manual_seed(0)
    forecaster = DGVAE(spec(), replace(FAST_LIKE, zero_start=True, substeps=substeps), 3)
    states, valid = random_states(0, BATCH, TIME, AGENTS, 4), torch.ones(BATCH, TIME, AGENTS).bool()
    output = forecaster.window(states, valid, torch.tensor([1, 3]), 3, torch.Generator().manual_seed(0))
    now = states[torch.arange(BATCH), torch.tensor([1, 3])]
    steps = torch.arange(1.0, 4.0)[:, None]
    expected = now[:, :, None, :2] + steps * now[:, :, None, 2:]
    torch.testing.assert_close(output.rollout[..., :2], expected)
    torch.testing.assert_close(output.rollout[..., 2:], now[:, :, None, 2:].expand(-1, -1, 3, -1))
    output.rollout.sum().backward()
    assert forecaster.decoder.readout.weight.grad is not None
    assert forecaster.decoder.readout.weight.grad.abs().max() > 0


@pytest.mark.parametrize("hard", [False, True])
def test_graphs_are_drawn_as_the_config_says(hard: bool, monkeypatch: pytest.MonkeyPatch):
    """Once for the whole teacher-forced pass, then once for each step of the free run; for pairs of two agents."""
    drawn = []

    def sample(logits: Tensor, temperature: float, generator: Any, hard: bool) -> Tensor:
        drawn.append((tuple(logits.shape), temperature, hard))
        return torch.softmax(logits, dim=-1)

    monkeypatch.setattr(dgvae, "concrete_sample", sample)
    forecaster = DGVAE(spec(), replace(FAST_LIKE, temperature=0.75, hard_samples=hard), 3)
    states, valid = random_states(0, BATCH, TIME, AGENTS, 4), random_presence(0, BATCH, TIME, AGENTS)
    forecaster.window(states, valid, torch.tensor([1, 3]), 2)
    pair = (AGENTS, AGENTS - 1, 2)
    assert drawn == [((BATCH, TIME, *pair), 0.75, hard)] + 2 * [((BATCH, *pair), 0.75, hard)]
    forecaster.window(states, valid, torch.tensor([1, 3]), 0)
    assert len(drawn) == 4


@settings(max_examples=8)
@given(valid=presence(), seed=seeds, offsets=st.tuples(*[st.integers(-400, 400)] * TIME))
def test_each_step_is_seen_from_where_the_ego_is(valid: Tensor, seed: int, offsets: tuple[int, ...]):
    """Moving the scenes of a window along the road, each by its own distance, moves predictions and nothing else."""
    forecaster = model(frame=ROAD)
    states = random_states(seed, BATCH, TIME, AGENTS, 4)
    moved = states.clone()
    moved[..., 0] += torch.tensor(offsets)[:, None]
    now = TIME - 2
    here, there = (window_without_noise(forecaster, s, valid, torch.full((BATCH,), now)) for s in (states, moved))
    torch.testing.assert_close(there.prior_logits, here.prior_logits, rtol=0, atol=1e-3)  # float32 at 400 m: 3e-5 m
    torch.testing.assert_close(there.posterior_logits, here.posterior_logits, rtol=0, atol=1e-3)
    torch.testing.assert_close(there.features, here.features, rtol=0, atol=1e-3)
    there.rollout[..., 0] -= offsets[now]
    there.one_step[..., 0] -= torch.tensor(offsets)[:, None]
    torch.testing.assert_close(there.rollout, here.rollout, rtol=0, atol=1e-2)
    torch.testing.assert_close(there.one_step, here.one_step, rtol=0, atol=1e-2)


# --- Samples ----------------------------------------------------------------------------------------------------------


@pytest.fixture
def belief() -> Belief:
    return last(
        model(num_edge_types=3), random_states(0, BATCH, TIME, AGENTS, 4), torch.ones(BATCH, TIME, AGENTS).bool()
    )


def test_sample_0_draws_nothing(belief: Belief):
    forecaster = model(num_edge_types=3)
    generator = torch.Generator().manual_seed(0)
    before = generator.get_state()
    first = forecaster.rollout(belief, 3, 1, generator).states
    assert torch.equal(generator.get_state(), before)
    many = forecaster.rollout(belief, 3, 4, generator).states
    assert torch.equal(many[:, :1], first)
    assert many.shape == (BATCH, 4, AGENTS, 3, 4)


def test_samples_depend_on_the_generator_alone(belief: Belief):
    forecaster = model(num_edge_types=3)

    def draw(seed: int, everywhere: int) -> Tensor:
        torch.manual_seed(everywhere)
        return forecaster.rollout(belief, 3, 4, torch.Generator().manual_seed(seed)).states

    assert torch.equal(draw(5, everywhere=1), draw(5, everywhere=2))
    one, other = draw(5, everywhere=1), draw(6, everywhere=1)
    assert torch.equal(one[:, 0], other[:, 0])
    assert (one[:, 1:] - other[:, 1:]).abs().amax((2, 3, 4)).min() > 1e-4


def test_samples_differ_from_each_other_and_between_scenes(belief: Belief):
    drawn = model(num_edge_types=3).rollout(belief, 3, 5, torch.Generator().manual_seed(0)).states
    distance = (drawn[:, :, None] - drawn[:, None]).abs().amax((-1, -2, -3)) + torch.eye(5)
    assert distance.min() > 1e-4


def test_samples_belong_to_their_scene(belief: Belief):
    """Without noise every sample of a scene is its own expected forecast, so scenes and samples are not mixed up."""
    forecaster = model(num_edge_types=3)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(dgvae, "concrete_sample", lambda logits, *_: torch.softmax(logits, dim=-1))
        drawn = forecaster.rollout(belief, 3, 4).states
    torch.testing.assert_close(drawn, drawn[:, :1].expand_as(drawn), rtol=1e-5, atol=1e-5)
    assert not torch.allclose(drawn[0], drawn[1], atol=1.0)


def test_longer_horizons_continue_shorter_ones(belief: Belief):
    forecaster = model(num_edge_types=3)
    torch.testing.assert_close(
        forecaster.rollout(belief, 5).states[..., :3, :], forecaster.rollout(belief, 3).states, **TOLERANCE
    )


# --- Training pass and config -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("sizes", [FAST_LIKE, RICH], ids=["fast", "rich"])
def test_every_weight_gets_a_finite_gradient(sizes: DGVAEConfig):
    torch.manual_seed(0)
    forecaster = DGVAE(spec(), sizes, horizon_steps=3)
    states, valid = random_states(0, BATCH, TIME, AGENTS, 4), random_presence(0, BATCH, TIME, AGENTS)
    output = forecaster.window(states, valid, torch.tensor([1, 3]), 3, torch.Generator().manual_seed(0))
    divergence = (output.posterior_logits.softmax(-1) * output.prior_logits.log_softmax(-1))[pair_mask(valid)].sum()
    (output.one_step.square().mean() + output.rollout.square().mean() - divergence).backward()
    for name, parameter in forecaster.named_parameters():
        assert parameter.grad is not None and torch.isfinite(parameter.grad).all(), name
        assert parameter.grad.abs().max() > 0, name


def test_one_step_prediction_ignores_what_it_predicts():
    """Teacher forcing shows the decoder the posterior's graph (which saw the future) but not the next state itself."""
    forecaster = model()
    states, valid = random_states(0, 1, TIME, 1, 4), torch.ones(1, TIME, 1).bool()  # no pairs: no graph to leak through
    other = states.clone()
    other[:, 3:] += 5.0
    now = torch.tensor([1])
    one, two = (window_without_noise(forecaster, s, valid, now).one_step for s in (states, other))
    assert torch.equal(one[:, :3], two[:, :3])
    assert not torch.equal(one[:, 3], two[:, 3])


def test_dropout_acts_in_training_only():
    torch.manual_seed(0)
    forecaster = DGVAE(spec(), DGVAEConfig(8, 5, 6, 7, 9, dropout=0.5), 3)
    states, valid = random_states(0, 1, 1, 3, 4), torch.ones(1, 1, 3).bool()
    assert not torch.equal(last(forecaster, states, valid).edge_probs, last(forecaster, states, valid).edge_probs)
    forecaster.eval()
    assert torch.equal(last(forecaster, states, valid).edge_probs, last(forecaster, states, valid).edge_probs)


def test_delta_scales_must_fit_the_features():
    with pytest.raises(UserError, match=r"delta_scales needs 4 positive numbers, got \(1.0, 2.0\)"):
        DGVAE(spec(), DGVAEConfig(delta_scales=(1.0, 2.0)))
