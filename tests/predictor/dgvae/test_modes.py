"""Modes of a plural dG-VAE: enumerated futures with probabilities, the same streamed, trained, copied and stored."""

from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from predictor.checkpoint import CheckpointInfo, load_checkpoint, save_checkpoint
from predictor.dgvae import DGVAE
from predictor.dgvae import model as dgvae
from predictor.dgvae.config import DGVAEConfig
from predictor.dgvae.networks import edge_probabilities
from predictor.forecaster import Belief, Futures, has_scale
from predictor.support.errors import UserError
from tests.predictor.helpers import FAST_LIKE, PLURAL, RICH, enlarge, random_presence, random_states, spec

BATCH, TIME, AGENTS, HORIZON = 2, 5, 4, 3
CLOSE = {"rtol": 1e-4, "atol": 1e-4}
VARIANTS: dict[str, DGVAEConfig] = {
    "plural": PLURAL,
    "rich": replace(RICH, num_modes=3, rollout_graph="frozen"),
    "neighbours": replace(PLURAL, num_neighbours=2, num_edge_types=3),
}
every_variant = pytest.mark.parametrize("variant", VARIANTS)


@cache
def made(variant: str = "plural") -> DGVAE:
    """An untrained model with weights large enough for every path to leave a trace."""
    torch.manual_seed(7)
    model = DGVAE(spec(), VARIANTS[variant], HORIZON)
    enlarge(model)
    return model.eval().requires_grad_(False)


def observed(model: DGVAE, states: Tensor, valid: Tensor) -> list[Belief]:
    """Belief after each step, streamed without gradients as when deployed."""
    memory, beliefs = model.empty_memory(states.shape[0], states.shape[2]), []
    with torch.no_grad():
        for now, present in zip(states.unbind(1), valid.unbind(1), strict=True):
            memory, belief = model.observe(memory, now, present)
            beliefs.append(belief)
    return beliefs


def scenes(agents: int = AGENTS, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Scenes of which all agents but those of the last column stay."""
    states, valid = random_states(seed, BATCH, TIME, agents, 4) * 0.5, torch.ones(BATCH, TIME, agents).bool()
    if agents > 1:
        valid[1, :, -1] = False
    return states, valid


def belief(variant: str = "plural", agents: int = AGENTS) -> Belief:
    return observed(made(variant), *scenes(agents))[-1]


def assert_close(ours: Futures, expected: Futures, valid: Tensor | None = None) -> None:
    """Equal futures; of the present agents, if said."""
    for name in Futures._fields:
        one, other = getattr(ours, name), getattr(expected, name)
        assert (one is None) == (other is None), name
        if one is not None:
            there = slice(None) if valid is None else valid[:, None].expand(-1, one.shape[1], -1)
            torch.testing.assert_close(one[there], other[there], **CLOSE, msg=lambda m, n=name: f"{n}: {m}")


# --- Enumerated futures -----------------------------------------------------------------------------------------------


@every_variant
@pytest.mark.parametrize("per_scene", [False, True], ids=["one generator", "one per scene"])
def test_nothing_is_drawn_while_there_are_modes_enough(variant: str, per_scene: bool):
    now, modes = belief(variant), VARIANTS[variant].num_modes
    noise: Any = [np.random.default_rng(i) for i in range(BATCH)] if per_scene else torch.Generator().manual_seed(0)

    def state() -> Any:
        return [n.bit_generator.state for n in noise] if per_scene else noise.get_state().tolist()

    before, everywhere = state(), torch.get_rng_state()
    found = [made(variant).rollout(now, HORIZON, k, noise) for k in (1, 2, modes)]
    assert state() == before and torch.equal(torch.get_rng_state(), everywhere)
    assert_close(made(variant).rollout(now, HORIZON, modes, None), found[-1])
    made(variant).rollout(now, HORIZON, modes + 1, noise)
    assert state() != before


@every_variant
def test_a_rollout_holds_a_share_and_a_spread_for_each_sample(variant: str):
    model, modes = made(variant), VARIANTS[variant].num_modes
    assert has_scale(model) and not has_scale(DGVAE(spec(), FAST_LIKE))
    for samples in (1, 2, modes, modes + 2):
        futures = model.rollout(belief(variant), HORIZON, samples)
        assert futures.states.shape == (BATCH, samples, AGENTS, HORIZON, 4)
        assert futures.scale is not None and futures.scale.shape == (BATCH, samples, AGENTS, HORIZON, 2)
        assert (futures.mode_probs is None) == (samples > modes)  # then they are draws
        if futures.mode_probs is not None:
            assert futures.mode_probs.shape == (BATCH, samples, AGENTS)
            torch.testing.assert_close(futures.mode_probs.sum(1), torch.ones(BATCH, AGENTS))
            assert (futures.mode_probs > 0).all()
    probs = model.rollout(belief(variant), HORIZON, modes).mode_probs
    assert probs is not None and (probs - 1 / modes)[:, :, :-1].abs().max() > 1e-2


@every_variant
@pytest.mark.parametrize("more", [2, "modes", "draws"])
def test_sample_0_is_the_single_forecast(variant: str, more: Any):
    modes = VARIANTS[variant].num_modes
    samples = {"modes": modes, "draws": modes + 3}.get(more, more)
    model, now = made(variant), belief(variant)
    alone, many = model.rollout(now, HORIZON, 1), model.rollout(now, HORIZON, samples, torch.Generator().manual_seed(0))
    assert alone.scale is not None and many.scale is not None
    there = now.valid
    torch.testing.assert_close(many.states[:, 0][there], alone.states[:, 0][there], **CLOSE)
    torch.testing.assert_close(many.scale[:, 0][there], alone.scale[:, 0][there], **CLOSE)


@every_variant
def test_fewer_samples_are_the_first_of_more_with_their_share(variant: str):
    model, now, modes = made(variant), belief(variant), VARIANTS[variant].num_modes
    whole = model.rollout(now, HORIZON, modes)
    assert whole.mode_probs is not None and whole.scale is not None
    for few in range(2, modes):
        share = whole.mode_probs[:, :few] / whole.mode_probs[:, :few].sum(1, keepdim=True)
        expected = Futures(whole.states[:, :few], share, whole.scale[:, :few])
        assert_close(model.rollout(now, HORIZON, few), expected, now.valid)


@every_variant
def test_longer_horizons_continue_shorter_ones(variant: str):
    model, now = made(variant), belief(variant)
    for samples in (1, 3):
        longest = model.rollout(now, 5, samples)
        assert longest.scale is not None
        for steps in (0, 1, 3):
            expected = Futures(longest.states[..., :steps, :], longest.mode_probs, longest.scale[..., :steps, :])
            if steps or samples > 1:
                assert_close(model.rollout(now, steps, samples), expected, now.valid)


@every_variant
def test_an_agent_alone_has_different_futures(variant: str):
    """Types of edges between agents cannot tell them apart: there are none."""
    futures = made(variant).rollout(belief(variant, agents=1), HORIZON, VARIANTS[variant].num_modes)
    ends = futures.states[:, :, 0, -1, :2]
    apart = torch.cdist(ends, ends) + 10 * torch.eye(ends.shape[1])
    assert apart.min() > 1e-2


@every_variant
def test_an_agent_keeps_its_type_and_the_others_follow_theirs(variant: str):
    """A mode is a scene: with another type of the sender, the receiver's future is another one."""
    model, now, modes = made(variant), belief(variant), VARIANTS[variant].num_modes
    with pytest.MonkeyPatch.context() as patch:
        hold = type(model.self_edges).hold

        def first_agent_stays(self_edges: Any, past: Tensor, types: Tensor | None = None) -> Any:
            if types is not None and types.ndim == 3:
                types = types.clone()
                types[..., 0] = 0
            return hold(self_edges, past, types)

        with torch.enable_grad():  # padded arrays: places are those of the agents
            plain = model.rollout(now, HORIZON, modes).states
            patch.setattr(type(model.self_edges), "hold", first_agent_stays)
            held = model.rollout(now, HORIZON, modes).states
    assert (plain[:, 1:, 0] - held[:, 1:, 0]).abs().max() > 1e-2
    assert (held[:, 1:, 0] - held[:, :1, 0]).abs().max() > 1e-4  # pushed by the others alone
    assert torch.equal(plain[:, 0], held[:, 0])


@every_variant
def test_the_spread_is_positive_and_grows_with_time(variant: str):
    now = belief(variant)
    for samples in (1, VARIANTS[variant].num_modes, 9):
        scale = made(variant).rollout(now, 6, samples).scale
        assert scale is not None
        growth = torch.cat([scale[..., :1, :], scale.diff(dim=-2)], dim=-2).transpose(1, 2)[now.valid]
        assert growth.min() > 0


@every_variant
def test_samples_with_gradients_are_those_without(variant: str):
    """Lists of the agents that are there, and padded arrays."""
    model, now, modes = made(variant), belief(variant), VARIANTS[variant].num_modes
    for samples in (1, modes, modes + 3):
        found = []
        for gradients in (False, True):
            with torch.set_grad_enabled(gradients):
                found.append(model.rollout(now, HORIZON, samples, [np.random.default_rng(i) for i in (4, 5)]))
        assert_close(*found, now.valid)


# --- Drawn types ------------------------------------------------------------------------------------------------------


def test_more_samples_than_modes_draw_types_as_often_as_their_probability_says():
    """Each agent for itself. Without messages between agents, a sample's type shows in its states."""
    model, samples = deepcopy(made()), 4001
    with torch.no_grad():
        for parameter in model.decoder.message_out.parameters():
            parameter.zero_()
    model.eval()  # the folded weights are made anew
    now = observed(model, *scenes())[-1]
    modes, drawn = model.rollout(now, 1, 4), model.rollout(now, 1, samples, torch.Generator().manual_seed(0))
    assert modes.mode_probs is not None
    ends = (t[:, :, :, 0].permute(0, 2, 1, 3) for t in (drawn.states, modes.states))
    apart = torch.cdist(*ends, compute_mode="donot_use_mm_for_euclid_dist")  # scenes, agents, samples, modes
    assert apart.min(-1).values[now.valid].max() < 1e-4
    types = torch.nn.functional.one_hot(apart.argmin(-1), 4).float()[:, :, 1:]
    assert (apart[:, :, 0].argmin(-1) == 0)[now.valid].all()
    share = modes.mode_probs.transpose(1, 2)
    torch.testing.assert_close(types.mean(2)[now.valid], share[now.valid], rtol=0, atol=0.03)
    both = torch.einsum("bsk,bsl->bkl", types[:, 0], types[:, 1]) / (samples - 1)
    torch.testing.assert_close(both, share[:, 0, :, None] * share[:, 1, None, :], rtol=0, atol=0.03)


def test_drawn_types_follow_the_generator_of_their_own_scene():
    model, states, valid = made(), *scenes()
    same = states[:1].expand(3, -1, -1, -1), valid[:1].expand(3, -1, -1)
    now = observed(model, *same)[-1]
    one, other, again = model.rollout(now, HORIZON, 12, [np.random.default_rng(i) for i in (1, 2, 1)]).states
    torch.testing.assert_close(one, again, **CLOSE)
    assert (one - other).abs().amax((1, 2, 3)).max() > 1e-2
    torch.testing.assert_close(one[0], other[0], **CLOSE)
    with pytest.raises(UserError, match="samples need one generator per scene, got 2 generators for 3 scenes"):
        model.rollout(now, HORIZON, 12, [np.random.default_rng(i) for i in (1, 2)])


def test_drawn_types_repeat_with_their_generator_whatever_torch_has_drawn():
    model, now = made(), belief()

    def draw(seed: int, everywhere: int) -> Tensor:
        torch.manual_seed(everywhere)
        return model.rollout(now, HORIZON, 12, torch.Generator().manual_seed(seed)).states

    assert torch.equal(draw(5, everywhere=1), draw(5, everywhere=2))
    assert not torch.equal(draw(5, everywhere=1), draw(6, everywhere=1))


# --- Training pass ----------------------------------------------------------------------------------------------------


@every_variant
@settings(max_examples=6)
@given(
    seed=st.integers(0, 2**16),
    last_observed=st.tuples(*[st.integers(0, TIME - 1)] * BATCH),
    share=st.sampled_from([0.6, 1.0]),
)
def test_the_window_rolls_out_the_modes_that_streaming_does(
    variant: str, seed: int, last_observed: tuple[int, ...], share: float
):
    model, modes = made(variant), VARIANTS[variant].num_modes
    states, valid = random_states(seed, BATCH, TIME, AGENTS, 4), random_presence(seed, BATCH, TIME, AGENTS, share=share)
    beliefs = observed(model, states, valid)
    for count in (2, modes):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(dgvae, "concrete_sample", lambda logits, *_: edge_probabilities(logits))
            output = model.window(states, valid, torch.tensor(last_observed), HORIZON, num_modes=count)
        assert output.modes is not None and torch.equal(output.modes.states[:, 0], output.rollout)
        for index, t in enumerate(last_observed):
            streamed = model.rollout(beliefs[t], HORIZON, count)
            window, found = (Futures(*(part[[index]] for part in futures)) for futures in (output.modes, streamed))
            assert_close(window, found, valid[[index], t])


@every_variant
def test_agents_that_are_gone_cost_a_window_nothing(variant: str):
    """Their columns come last; they are not rolled out, and change no other agent's modes."""
    model, (states, valid) = made(variant), scenes()
    last_observed, count = torch.tensor([1, 3]), VARIANTS[variant].num_modes
    valid[:, 2:, -1] = False
    valid[0, 1, -1] = False  # the last observed step of the first window
    steps: list[int] = []
    advance = type(model.codec).advance

    def counted(codec: Any, before: Tensor, *rest: Any) -> Tensor:
        steps.append(before.shape[-2])
        return advance(codec, before, *rest)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(type(model.codec), "advance", counted)
        drawn = torch.Generator().manual_seed(0)
        modes = model.window(states, valid, last_observed, HORIZON, drawn, num_modes=count).modes
    assert modes is not None and modes.states.shape[2] == AGENTS and not modes.states[:, :, -1].any()
    assert set(steps[-HORIZON:]) == {AGENTS - 1}


def test_modes_of_a_window_share_one_draw_of_the_edges():
    drawn: list[tuple[int, ...]] = []

    def sample(logits: Tensor, *_: Any) -> Tensor:
        drawn.append(tuple(logits.shape))
        return edge_probabilities(logits)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(dgvae, "concrete_sample", sample)
        made().window(*scenes(), torch.tensor([1, 3]), HORIZON, num_modes=4)
    assert drawn == [(BATCH, TIME, AGENTS, AGENTS, 2), (BATCH, AGENTS, AGENTS, 2)]


def test_every_weight_of_the_self_edges_gets_a_finite_gradient():
    torch.manual_seed(0)
    model = DGVAE(spec(), PLURAL, HORIZON)
    output = model.window(*scenes(), torch.tensor([1, 3]), HORIZON, torch.Generator().manual_seed(0), 4)
    assert output.modes is not None and model.self_edges is not None
    sum((t.square() * torch.linspace(1, 2, t.numel()).view(t.shape)).sum() for t in output.modes).backward()
    for name, parameter in model.self_edges.named_parameters():
        assert parameter.grad is not None and torch.isfinite(parameter.grad).all(), name
        assert parameter.grad.abs().amax(tuple(range(1, parameter.ndim))).min() > 0, name  # of every type


def test_the_spread_teaches_nothing_but_its_own_layer():
    torch.manual_seed(0)
    model = DGVAE(spec(), PLURAL, HORIZON)
    output = model.window(*scenes(), torch.tensor([1, 3]), HORIZON, torch.Generator().manual_seed(0), 4)
    assert output.modes is not None and output.modes.scale is not None
    output.modes.scale.sum().backward()
    moved = {name for name, p in model.named_parameters() if p.grad is not None and p.grad.any()}
    assert moved == {"self_edges.spread.weight", "self_edges.spread.bias", "self_edges.spread_shift"}


def test_the_spread_of_a_type_is_its_own():
    """An addend of type 2 moves the spread of scene 2 alone, from the first step on; no position, no probability."""
    now, before = belief(), made()
    after = made().variant()
    assert after.self_edges is not None and after.self_edges.spread_shift is not None
    with torch.no_grad():
        after.self_edges.spread_shift[2] -= 1.0
    beliefs = observed(after, *scenes())
    one, other = before.rollout(now, HORIZON, 4), after.rollout(beliefs[-1], HORIZON, 4)
    assert one.scale is not None and other.scale is not None and one.mode_probs is not None
    assert torch.equal(one.states, other.states) and torch.equal(one.mode_probs, other.mode_probs)
    assert torch.equal(one.scale[:, [0, 1, 3]], other.scale[:, [0, 1, 3]])
    assert (other.scale[:, 2] < one.scale[:, 2]).transpose(0, 1)[..., 0, :].all()


# --- Config -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [1, -1])
def test_one_mode_is_no_choice(count: int):
    with pytest.raises(UserError) as error:
        replace(PLURAL, num_modes=count)
    assert str(error.value) == f"num_modes must be 0 or at least 2, got {count}"
    assert replace(PLURAL, num_modes=0).num_modes == 0 and replace(PLURAL, num_modes=2).num_modes == 2


def test_modes_need_a_frozen_graph():
    with pytest.raises(UserError) as error:
        replace(PLURAL, rollout_graph="evolving")
    message = "num_modes needs rollout_graph=frozen: what is drawn is held for the whole roll-out; or set num_modes=0"
    assert str(error.value) == message
    assert replace(PLURAL, rollout_graph="evolving", num_modes=0).rollout_graph == "evolving"


def test_modes_belong_to_the_weights():
    with pytest.raises(UserError, match="a network with {'num_modes': 5} has other weights; train one instead"):
        made().variant(num_modes=5)


# --- Derivatives ------------------------------------------------------------------------------------------------------


@every_variant
@pytest.mark.parametrize("part", ["states", "mode_probs"])
def test_modes_have_jacobians(variant: str, part: str):
    """By `torch.func`, autograd and finite differences."""
    model = deepcopy(made(variant)).double()
    states, valid = (t[1:, :3] for t in scenes())
    states = states.double()

    def modes(history: Tensor) -> Tensor:
        memory = model.empty_memory(1, AGENTS)
        for t in range(3):
            memory, now = model.observe(memory, history[:, t], valid[:, t])
        found: Tensor = getattr(model.rollout(now, 2, 3), part)
        return found[0, :, :3]  # the last agent is absent

    jacobian = torch.func.jacrev(modes)(states)
    torch.testing.assert_close(jacobian, torch.autograd.functional.jacobian(modes, states), rtol=1e-9, atol=1e-9)
    direction = torch.randn(states.shape, generator=torch.Generator().manual_seed(0), dtype=states.dtype)
    quotient = (modes(states + 1e-5 * direction) - modes(states - 1e-5 * direction)) / 2e-5
    torch.testing.assert_close(jacobian.flatten(-4) @ direction.flatten(), quotient, rtol=1e-5, atol=1e-6)
    assert not jacobian[..., 3, :].any()
    by_mode = jacobian.flatten(1).abs().amax(1)
    assert by_mode.min() > 1e-4 and (jacobian[0] - jacobian[1]).abs().max() > 1e-4


# --- Copies, devices, files -------------------------------------------------------------------------------------------


def through_a_file(model: DGVAE, folder: Path) -> DGVAE:
    info = CheckpointInfo(model.spec, model.config, model.horizon_steps)
    save_checkpoint(folder / "toy", model, info)
    assert sorted(path.name for path in (folder / "toy").iterdir()) == ["config.json", "model.safetensors"]
    loaded, found = load_checkpoint(folder / "toy")
    assert found.config == model.config and isinstance(loaded, DGVAE)
    return loaded


@every_variant
@pytest.mark.parametrize(
    "journey",
    [
        lambda model, _: deepcopy(model),
        lambda model, _: deepcopy(model).to(torch.float64).to(torch.float32),
        lambda model, _: model.variant(temperature=0.7),
        through_a_file,
    ],
    ids=["copy", "there and back", "variant", "file"],
)
def test_forecasts_survive(variant: str, journey: Callable[[DGVAE, Path], DGVAE], tmp_path: Path):
    model = made(variant)
    other = journey(model, tmp_path)
    assert other is not model
    for samples in (1, VARIANTS[variant].num_modes, 9):
        ours, expected = (
            m.rollout(observed(m, *scenes())[-1], HORIZON, samples, torch.Generator().manual_seed(0))
            for m in (other, model)
        )
        for one, two in zip(ours, expected, strict=True):
            assert (one is None and two is None) or torch.equal(one, two)


@every_variant
@pytest.mark.parametrize("samples", [1, 3, 9])
def test_all_that_a_rollout_needs_is_on_the_device_of_the_model(variant: str, samples: int):
    """The meta device computes shapes alone, and refuses tensors of any other."""
    model, meta = deepcopy(made(variant)).to("meta"), torch.device("meta")
    memory = model.empty_memory(BATCH, AGENTS)
    states, valid = torch.zeros(BATCH, AGENTS, 4, device=meta), torch.ones(BATCH, AGENTS, device=meta).bool()
    with torch.enable_grad():  # padded arrays: how many are there has no answer here
        _, now = model.observe(memory, states, valid)
        futures = model.rollout(now, HORIZON, samples)
    assert {t.device for t in futures if t is not None} == {meta}
    assert futures.states.shape == (BATCH, samples, AGENTS, HORIZON, 4)


def test_messages_of_agents_to_themselves_act_in_every_substep():
    """As those of the others: `test_substeps_against_a_loop` of a model with modes."""
    model, now = made("rich"), belief("rich")
    moved, known, self_edges = now.states, now.internal, model.self_edges
    held, change = self_edges.hold(known.own), model.decoder.change(known.node_after)
    for _ in range(2):
        inputs = model.codec.inputs(moved, now.valid)
        others = model.decoder.messages(inputs, known.graph.present, known.probs, known.features)
        pushed = model.decoder.direct(others + self_edges.out(self_edges.layer(inputs, held)))
        moved = model.codec.advance(moved, change + pushed, 0.5)
    torch.testing.assert_close(model.rollout(now, 1).states[:, 0, :, 0][now.valid], moved[now.valid], **CLOSE)
