"""Single steps without gradients are those of the modules: same values, current weights, inputs left alone."""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from copy import deepcopy
from dataclasses import replace
from functools import cache
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor, nn
from torch.nn.utils import parameters_to_vector, vector_to_parameters

from predictor.dgvae import DGVAE
from predictor.dgvae import model as dgvae
from predictor.dgvae import single_step as stepper
from predictor.dgvae.config import DGVAEConfig
from predictor.dgvae.packing import Packed
from predictor.dgvae.single_step import Stepper
from predictor.forecaster import Belief, Memory
from tests.predictor.helpers import FAST_LIKE, PLURAL, RICH, random_presence, random_states, spec

BATCH, TIME, AGENTS, HORIZON, SAMPLES = 2, 4, 4, 3, 3
CHANGES = (3.0, 3.0, 2.0, 2.0)
CONFIGS = {
    "fast": FAST_LIKE,
    "three types": replace(FAST_LIKE, num_edge_types=3),
    "no features": replace(FAST_LIKE, edge_feature_dim=0, num_edge_types=3),
    "static": replace(FAST_LIKE, static_dim=3),
    "gated": replace(FAST_LIKE, gated_messages=True, num_edge_types=3),
    "gated without features": replace(FAST_LIKE, gated_messages=True, edge_feature_dim=0),
    "changes": replace(FAST_LIKE, change_scales=CHANGES),
    "substeps": replace(FAST_LIKE, substeps=2, residual="trapezoid"),
    "neighbours": replace(FAST_LIKE, num_neighbours=2, num_edge_types=3),
    "frozen": replace(FAST_LIKE, rollout_graph="frozen"),
    "modes": PLURAL,
    "modes with substeps": replace(FAST_LIKE, num_modes=5, rollout_graph="frozen", substeps=2),
    "modes of neighbours": replace(PLURAL, num_neighbours=2, num_edge_types=3),
    "everything": replace(RICH, innovation_rounds=0, num_edge_types=3, num_neighbours=2, rollout_graph="frozen"),
}
every_config = pytest.mark.parametrize("name", CONFIGS)
TOLERANCE = {torch.float64: {"rtol": 1e-10, "atol": 1e-10}, torch.float32: {"rtol": 1e-4, "atol": 1e-3}}
EXACT = TOLERANCE[torch.float64]
WITHOUT_GRADIENTS = {"no_grad": torch.no_grad, "inference_mode": torch.inference_mode}


def made(config: DGVAEConfig, dtype: torch.dtype = torch.float64) -> DGVAE:
    """A fresh network, with weights large enough for every path to leave a trace."""
    torch.manual_seed(7)
    forecaster = DGVAE(spec(), config, HORIZON)
    with torch.no_grad():
        for parameter in forecaster.parameters():
            parameter.mul_(1.7)
    return forecaster.to(dtype).eval()


kept = cache(made)


def scenes(seed: int = 0, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
    return random_states(seed, BATCH, TIME, AGENTS, 4).to(dtype), random_presence(seed, BATCH, TIME, AGENTS)


def stream(forecaster: DGVAE, states: Tensor, valid: Tensor) -> Iterator[tuple[Memory, Belief]]:
    memory = forecaster.empty_memory(states.shape[0], states.shape[2])
    for now, present in zip(states.unbind(1), valid.unbind(1), strict=True):
        memory, belief = forecaster.observe(memory, now, present)
        yield memory, belief


def tensors(value: Any) -> list[Tensor]:
    """Every tensor inside memories, beliefs and tuples of them, in order."""
    if isinstance(value, Tensor):
        return [value]
    if isinstance(value, Memory | Belief | Packed):
        value = tuple(vars(value).values())
    return [t for part in value for t in tensors(part)] if isinstance(value, tuple | list) else []


def run(
    forecaster: DGVAE,
    context: Callable[[], AbstractContextManager[Any]] = torch.no_grad,
    shown: tuple[Tensor, Tensor] | None = None,
) -> list[Tensor]:
    """All that observing and rolling out give to the outside: memory and edges after each step, forecasts at the end.

    Samples go along graphs that are sharper than the expected ones, and the same each time: who is drawn for in which
    order is not the same with the modules. States of absent agents are not compared.
    """
    states, valid = shown or scenes(dtype=next(forecaster.parameters()).dtype)
    with context(), pytest.MonkeyPatch.context() as patch:
        patch.setattr(dgvae, "concrete_sample", lambda logits, *_: torch.softmax(3 * logits, dim=-1))
        steps = list(stream(forecaster, states, valid))
        forecast = forecaster.rollout(steps[-1][1], HORIZON, SAMPLES).states
    public = [(memory, belief.edge_probs, belief.edge_features, belief.senders) for memory, belief in steps]
    return [t.detach() for t in [*tensors(public), forecast * valid[:, -1, None, :, None, None]]]


def same(ours: list[Tensor], expected: list[Tensor], dtype: torch.dtype = torch.float64) -> None:
    torch.testing.assert_close(ours, expected, **TOLERANCE[dtype])


def forbid(monkeypatch: pytest.MonkeyPatch) -> None:
    class Forbidden(Stepper):
        def __init__(self, *_: Any) -> None:
            raise AssertionError("the stepper is not for this network")

    monkeypatch.setattr(dgvae, "Stepper", Forbidden)


# --- The same values --------------------------------------------------------------------------------------------------


@st.composite
def presence(draw: st.DrawFn) -> Tensor:
    cells = BATCH * TIME * AGENTS
    bits = draw(st.integers(0, 2**cells - 1))
    return torch.tensor([bool(bits >> i & 1) for i in range(cells)]).view(BATCH, TIME, AGENTS)


@every_config
@settings(max_examples=5)
@given(valid=presence(), seed=st.integers(0, 2**16))
def test_values_are_those_of_the_modules(name: str, valid: Tensor, seed: int):
    forecaster = kept(CONFIGS[name])
    shown = (scenes(seed)[0], valid)
    same(run(forecaster, torch.no_grad, shown), run(forecaster, torch.enable_grad, shown))


@pytest.mark.parametrize("large", [False, True])
@every_config
def test_values_in_float32(name: str, large: bool, monkeypatch: pytest.MonkeyPatch):
    """Large products take another library, where there is one; here all of them do, or none."""
    monkeypatch.setattr(stepper, "_LARGE", 0 if large else torch.inf)
    forecaster = kept(CONFIGS[name], torch.float32)
    same(run(forecaster), run(forecaster, torch.enable_grad), torch.float32)


@pytest.mark.parametrize("agents", [1, 2])
@pytest.mark.parametrize("name", ["fast", "everything"])
def test_smallest_scenes(name: str, agents: int):
    states, valid = scenes()
    shown = states[:, :, :agents], valid[:, :, :agents]
    same(run(kept(CONFIGS[name]), shown=shown), run(kept(CONFIGS[name]), torch.enable_grad, shown))


@every_config
def test_both_ways_of_doing_without_gradients(name: str):
    forecaster = kept(CONFIGS[name])
    for one, other in zip(run(forecaster, torch.no_grad), run(forecaster, torch.inference_mode), strict=True):
        assert torch.equal(one, other)


@pytest.mark.parametrize("context", WITHOUT_GRADIENTS.values(), ids=WITHOUT_GRADIENTS)
def test_it_is_used_where_there_are_no_gradients(context: Any, monkeypatch: pytest.MonkeyPatch):
    """Folded once, then one encoder step for each observation and each fed-back prediction."""
    counts = {"folded": 0, "encode": 0, "decode": 0}

    class Counting(Stepper):
        def __init__(self, *parts: Any) -> None:
            counts["folded"] += 1
            super().__init__(*parts)

        def encode(self, *args: Any) -> Any:
            counts["encode"] += 1
            return super().encode(*args)

        def decode(self, *args: Any) -> Any:
            counts["decode"] += 1
            return super().decode(*args)

    monkeypatch.setattr(dgvae, "Stepper", Counting)
    forecaster = made(FAST_LIKE)
    run(forecaster, torch.enable_grad)
    assert counts == {"folded": 0, "encode": 0, "decode": 0}
    run(forecaster, context)
    fed_back = 2 * (HORIZON - 1)  # along the expected graph, and along drawn ones
    assert counts == {"folded": 1, "encode": TIME + fed_back, "decode": TIME + fed_back + 1}


def test_where_every_slot_is_taken_the_same_graphs_are_drawn():
    """Otherwise nothing is drawn for empty slots, and the noise is another one."""
    forecaster, (states, _) = kept(CONFIGS["neighbours"]), scenes()
    forecasts = []
    for context in (torch.no_grad, torch.enable_grad):
        with context():
            *_, (_, belief) = stream(forecaster, states, torch.ones(BATCH, TIME, AGENTS).bool())
            forecasts.append(forecaster.rollout(belief, HORIZON, SAMPLES, torch.Generator().manual_seed(0)).states)
    torch.testing.assert_close(*forecasts, **EXACT)
    assert (forecasts[0][:, 1:] - forecasts[0][:, :1]).abs().amax((0, 2, 3, 4)).min() > 1e-3


@every_config
@torch.no_grad()
def test_samples_do_not_depend_on_padding(name: str):
    """Nothing is drawn for who is not there."""
    forecaster, (states, valid) = kept(CONFIGS[name]), scenes()
    wide = nn.functional.pad(states, (0, 0, 0, 2)), nn.functional.pad(valid, (0, 2))
    forecasts = []
    for shown in ((states, valid), wide):
        *_, (_, belief) = stream(forecaster, *shown)
        drawn = forecaster.rollout(belief, HORIZON, SAMPLES, torch.Generator().manual_seed(0)).states
        forecasts.append(drawn[:, :, :AGENTS] * valid[:, -1, None, :, None, None])
    torch.testing.assert_close(*forecasts, **EXACT)


def test_a_belief_from_without_gradients_is_rolled_out_with_them():
    """Burn in without gradients, free-run with them."""
    forecaster, (states, valid) = made(FAST_LIKE), scenes()
    with torch.no_grad():
        *_, (_, belief) = stream(forecaster, states, valid)
    forecaster.rollout(belief, HORIZON).states.square().mean().backward()
    for name in ("encoder.embed", "encoder.prior_head.0", "decoder.message_out", "decoder.readout"):
        gradient = forecaster.get_submodule(name).weight.grad
        assert gradient is not None and gradient.abs().max() > 0, name


def test_gradients_are_not_lost_by_an_earlier_run_without_them():
    forecaster = made(FAST_LIKE)
    expected = gradients(made(FAST_LIKE))
    run(forecaster, torch.inference_mode)
    run(forecaster, torch.no_grad)
    torch.testing.assert_close(gradients(forecaster), expected, **EXACT)
    assert max(g.abs().max() for g in expected) > 1e-3


def gradients(forecaster: DGVAE) -> list[Tensor]:
    states, valid = scenes()
    *_, (_, belief) = stream(forecaster, states, valid)
    forecaster.rollout(belief, HORIZON).states.square().mean().backward()
    return [p.grad for p in forecaster.parameters() if p.grad is not None]


# --- Not for every network --------------------------------------------------------------------------------------------


def test_corrected_memories_go_through_the_modules(monkeypatch: pytest.MonkeyPatch):
    forbid(monkeypatch)
    forecaster = made(replace(RICH, num_edge_types=3))
    for ours, expected in zip(run(forecaster), run(forecaster, torch.enable_grad), strict=True):
        assert torch.equal(ours, expected)


def test_dropout_in_training_is_not_bypassed(monkeypatch: pytest.MonkeyPatch):
    forbid(monkeypatch)
    forecaster = made(replace(FAST_LIKE, dropout=0.5)).train()
    torch.manual_seed(0)
    one, other = run(forecaster), run(forecaster)
    assert (one[-1] - other[-1]).abs().max() > 1e-3
    torch.manual_seed(0)
    same(run(forecaster, torch.enable_grad), one)  # the same layers, asked in the same order


def test_dropout_is_off_in_evaluation():
    forecaster = made(replace(FAST_LIKE, dropout=0.5))
    same(run(forecaster), run(made(FAST_LIKE)))


def test_dropout_that_alone_is_in_training_is_not_bypassed():
    """Monte-Carlo dropout: everything in evaluation mode but the dropout layer."""
    forecaster = made(replace(FAST_LIKE, dropout=0.5))
    forecaster.encoder.dropout.train()
    assert (run(forecaster)[-1] - run(forecaster)[-1]).abs().max() > 1e-3


# --- Weights that change ----------------------------------------------------------------------------------------------


def optimiser_step(forecaster: DGVAE) -> DGVAE:
    states, valid = scenes()
    output = forecaster.window(states, valid, torch.full((BATCH,), 1), 2, torch.Generator().manual_seed(0))
    (output.one_step.square().mean() + output.rollout.square().mean()).backward()
    torch.optim.Adam(forecaster.parameters(), lr=0.05).step()
    return forecaster


def other_weights(forecaster: DGVAE, assign: bool = False) -> DGVAE:
    forecaster.load_state_dict({k: 0.8 * v for k, v in forecaster.state_dict().items()}, assign=assign)
    return forecaster


def edited(forecaster: DGVAE, context: Any = torch.no_grad) -> DGVAE:
    with context():
        for parameter in forecaster.parameters():
            parameter.mul_(0.8)
    return forecaster


def edited_behind_autograd(forecaster: DGVAE) -> DGVAE:
    """As the replay of a CUDA graph does; not seen by itself, but training ends with a change of mode."""
    for parameter in forecaster.parameters():
        parameter.data.mul_(0.8)
    return forecaster.eval()


def vector(forecaster: DGVAE) -> DGVAE:
    vector_to_parameters(0.8 * parameters_to_vector(forecaster.parameters()), forecaster.parameters())
    return forecaster


def new_parameter(forecaster: DGVAE) -> DGVAE:
    layer = forecaster.encoder.conv_out
    layer.weight = nn.Parameter(0.5 * layer.weight.detach())
    return forecaster


def new_encoder(forecaster: DGVAE) -> DGVAE:
    forecaster.encoder = edited(deepcopy(forecaster)).encoder
    return forecaster


def new_head(forecaster: DGVAE) -> DGVAE:
    forecaster.encoder.prior_head = edited(deepcopy(forecaster)).encoder.prior_head
    return forecaster


@pytest.mark.parametrize(
    "change",
    [
        optimiser_step,
        other_weights,
        pytest.param(lambda m: other_weights(m, assign=True), id="other_weights_assigned"),
        edited,
        pytest.param(lambda m: edited(m, torch.inference_mode), id="edited_in_inference_mode"),
        vector,
        new_parameter,
        pytest.param(lambda m: edited(deepcopy(m)), id="copy_edited"),
        edited_behind_autograd,
        new_encoder,
        new_head,
    ],
)
def test_results_follow_the_weights(change: Callable[[DGVAE], DGVAE]):
    forecaster = made(CONFIGS["three types"])
    before = run(forecaster)
    forecaster = change(forecaster)
    after = run(forecaster)
    assert (after[-1] - before[-1]).abs().max() > 1e-3
    same(after, run(forecaster, torch.enable_grad))


@pytest.mark.slow
def test_results_follow_every_single_weight():
    forecaster, (states, valid) = made(CONFIGS["everything"]), scenes()
    shown = states[:, -2:], valid[:, -2:]
    before = run(forecaster, shown=shown)
    for name, parameter in forecaster.named_parameters():
        weight = parameter.detach().clone()
        with torch.no_grad():
            parameter.mul_(1.5).add_(0.1)
        after = run(forecaster, shown=shown)
        same(after, run(forecaster, torch.enable_grad, shown))
        moved = max((a.double() - b.double()).abs().max() for a, b in zip(after, before, strict=True))
        assert moved > 1e-6 or name.startswith(("encoder.posterior", "encoder.backward")), name
        with torch.no_grad():
            parameter.copy_(weight)


def test_a_snapshot_knows_whether_it_is_current():
    forecaster, other = made(FAST_LIKE), made(FAST_LIKE)
    taken = Stepper(forecaster.encoder, forecaster.decoder)
    run(forecaster)
    assert taken.is_current(forecaster.encoder, forecaster.decoder)
    assert not taken.is_current(forecaster.encoder, other.decoder)
    assert not taken.is_current(other.encoder, forecaster.decoder)
    with torch.no_grad():
        forecaster.decoder.gru.bias_hh[0] += 1.0
    assert not taken.is_current(forecaster.encoder, forecaster.decoder)


def test_results_follow_the_precision():
    forecaster = made(FAST_LIKE, torch.float32)
    single = run(forecaster)
    double = run(forecaster.double())
    assert single[-1].dtype == torch.float32 and double[-1].dtype == torch.float64
    same(double, run(made(FAST_LIKE, torch.float32).double(), torch.enable_grad))


def test_a_copy_has_weights_of_its_own():
    forecaster = made(FAST_LIKE)
    before = run(forecaster)
    copy = edited(deepcopy(forecaster))
    run(copy)
    for ours, expected in zip(run(forecaster), before, strict=True):
        assert torch.equal(ours, expected)


def test_networks_made_in_inference_mode_forecast():
    with torch.inference_mode():
        forecaster = made(FAST_LIKE)
    same(run(forecaster), run(made(FAST_LIKE)))


# --- What goes in stays as it is --------------------------------------------------------------------------------------


@every_config
def test_nothing_that_goes_in_is_changed(name: str):
    forecaster, (states, valid) = kept(CONFIGS[name]), scenes()
    with torch.no_grad():
        memory, _ = list(stream(forecaster, states[:, :-1], valid[:, :-1]))[-1]
        given_ = [*tensors(memory), states, valid]
        copies = [t.clone() for t in given_]
        after, belief = forecaster.observe(memory, states[:, -1], valid[:, -1])
        assert all(torch.equal(t, copy) for t, copy in zip(given_, copies, strict=True))
        held = tensors([after, belief])
        assert len(held) > 10  # the belief's insides too
        copies = [t.clone() for t in held]
        forecaster.rollout(belief, HORIZON, SAMPLES, torch.Generator().manual_seed(0))
        forecaster.observe(after, states[:, 0], valid[:, 0])
        assert all(torch.equal(t, copy) for t, copy in zip(held, copies, strict=True))


def agents_first(t: Tensor) -> Tensor:
    """The same values, with the batch innermost in memory but for the third axis."""
    return t.transpose(0, 2).contiguous().transpose(0, 2)


@pytest.mark.parametrize(
    ("name", "of_states", "of_valid"),
    [
        ("fast", True, False),
        ("neighbours", True, True),
        ("fast", False, True),
    ],
)
def test_layout_in_memory_changes_nothing(name: str, of_states: bool, of_valid: bool):
    states, valid = scenes()
    shown = agents_first(states) if of_states else states, agents_first(valid) if of_valid else valid
    same(run(kept(CONFIGS[name]), shown=shown), run(kept(CONFIGS[name])))


@every_config
def test_layout_of_memory_changes_nothing(name: str):
    forecaster, (states, valid) = kept(CONFIGS[name]), scenes()
    with torch.no_grad():
        memory = list(stream(forecaster, states[:, :-1], valid[:, :-1]))[-1][0]
        turned = Memory(tuple(map(agents_first, memory.nodes)), tuple(map(agents_first, memory.pairs)), memory.senders)
        ours, expected = (forecaster.observe(m, states[:, -1], valid[:, -1]) for m in (turned, memory))
    same(tensors(ours), tensors(expected))


def test_expanded_presence():
    states, all_agents = scenes()[0], torch.ones(1, 1, AGENTS, dtype=torch.bool).expand(BATCH, TIME, AGENTS)
    same(run(kept(FAST_LIKE), shown=(states, all_agents)), run(kept(FAST_LIKE), shown=(states, all_agents.clone())))
