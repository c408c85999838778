"""dNRI against a scene-by-scene, pair-by-pair loop, and its draws."""

import copy
from dataclasses import replace
from functools import cache

import pytest
import torch
from hypothesis import given, settings
from torch import Tensor
from torch.nn import functional

from predictor.baselines import dnri
from predictor.baselines.dnri import DNRI, DNRIConfig
from predictor.graph import pair_mask
from predictor.scene import SceneSpec
from predictor.support.errors import UserError
from predictor.training.objective import kl_categorical
from tests.predictor.baselines import loops
from tests.predictor.baselines.helpers import (
    AGENTS,
    BATCH,
    DNRI_SIZES,
    HORIZON,
    TIME,
    TOLERANCE,
    fresh,
    last,
    no_noise,
    presence,
    seeds,
    tiny,
)
from tests.predictor.helpers import random_presence, random_states, spec

METRES = {"rtol": 1e-5, "atol": 1e-4}
EXACT = {"rtol": 1e-9, "atol": 1e-9}
"""In float64; in float32 the order of summation, which differs between machines, costs up to 1e-4."""
DNRI_KINDS = pytest.mark.parametrize("kind", ["dnri", "dnri-3types"])


class Loop:
    """One scene, from its first frame on, along expected graphs."""

    def __init__(self, forecaster: DNRI) -> None:
        self.forecaster = forecaster
        self.embeddings: list[dict[loops.Pair, Tensor]] = []
        self.memory: dict[int, Tensor] = {}

    def prior(self) -> dict[loops.Pair, Tensor]:
        """Logits of the latest frame, from all frames so far."""
        encoder = self.forecaster.encoder
        hidden = loops.lstm_of_pairs(encoder.forward_rnn, self.embeddings)[-1]
        return {pair: encoder.prior_head(h) for pair, h in hidden.items()}

    def posterior(self) -> list[dict[loops.Pair, Tensor]]:
        encoder = self.forecaster.encoder
        forward = loops.lstm_of_pairs(encoder.forward_rnn, self.embeddings)
        reverse = loops.lstm_of_pairs(encoder.reverse_rnn, self.embeddings, reverse=True)
        return [
            {pair: encoder.posterior_head(torch.cat([h, behind[pair]])) for pair, h in ahead.items()}
            for ahead, behind in zip(forward, reverse, strict=True)
        ]

    def see(self, state: Tensor, valid: Tensor) -> None:
        inputs = self.forecaster.codec.inputs(state, valid)
        self.embeddings.append(loops.embed(self.forecaster.encoder.frames, inputs, valid))

    def act(self, state: Tensor, valid: Tensor, logits: dict[loops.Pair, Tensor]) -> Tensor:
        """States that follow when messages take these logits' expectation."""
        types, others = self.forecaster.num_edge_types, max(int(valid.sum()) - 1, 1)
        weights = {pair: (z.softmax(-1)[1:] / (types - 1) / others).tolist() for pair, z in logits.items()}
        inputs = self.forecaster.codec.inputs(state, valid)
        self.memory = loops.decode(self.forecaster.decoder, inputs, valid, weights, self.memory)
        change = torch.zeros_like(state)
        for i, hidden in self.memory.items():
            change[i] = self.forecaster.decoder.readout(hidden)
        return self.forecaster.codec.advance(state, change)


@cache
def in_double(kind: str) -> DNRI:
    return copy.deepcopy(tiny(kind)).double()


@DNRI_KINDS
@settings(max_examples=6)
@given(valid=presence(ego=False), seed=seeds)
def test_prior_and_rollout_against_a_loop(kind: str, valid: Tensor, seed: int):
    forecaster, states, now = in_double(kind), random_states(seed, BATCH, TIME, AGENTS, 4).double(), (1, 3)
    with no_noise():
        window = forecaster.window(states, valid, torch.tensor(now), HORIZON)
    for b in range(BATCH):
        loop, state, present = Loop(forecaster), states[b, 0], valid[b, now[b]]
        for t in range(now[b] + HORIZON):
            observed = t <= now[b]
            frame = (states[b, t], valid[b, t]) if observed else (state, present)
            loop.see(*frame)
            logits = loop.prior()
            for pair, expected in logits.items() if observed else ():
                torch.testing.assert_close(window.prior_logits[b, t][pair], expected, **EXACT)
            state = loop.act(*frame, logits)
            if t >= now[b]:
                torch.testing.assert_close(window.rollout[b, present, t - now[b]], state[present], **EXACT)


@DNRI_KINDS
@settings(max_examples=6)
@given(valid=presence(ego=False), seed=seeds)
def test_posterior_and_teacher_forcing_against_a_loop(kind: str, valid: Tensor, seed: int):
    forecaster, states = in_double(kind), random_states(seed, BATCH, TIME, AGENTS, 4).double()
    with no_noise():
        window = forecaster.window(states, valid, torch.tensor([0, 1]), 0)
    for b in range(BATCH):
        loop = Loop(forecaster)
        for t in range(TIME):
            loop.see(states[b, t], valid[b, t])
        for t, logits in enumerate(loop.posterior()):
            for pair, expected in logits.items():
                torch.testing.assert_close(window.posterior_logits[b, t][pair], expected, **EXACT)
            here, after = valid[b, t], loop.act(states[b, t], valid[b, t], logits)
            torch.testing.assert_close(window.one_step[b, t][here], after[here], **EXACT)


def test_absent_pairs_have_no_edge_for_certain():
    states, valid = random_states(0, BATCH, TIME, AGENTS, 4), random_presence(0, BATCH, TIME, AGENTS)
    window = tiny("dnri-3types").window(states, valid, torch.tensor([1, 2]), 1)
    absent = ~pair_mask(valid)
    for logits in (window.prior_logits, window.posterior_logits):
        assert torch.equal(logits.softmax(-1)[absent], torch.tensor([1.0, 0.0, 0.0]).expand(int(absent.sum()), 3))
    assert kl_categorical(window.posterior_logits, window.prior_logits, absent) == 0


def test_the_first_type_is_silent():
    """Without edges there are no messages: moving the others leaves an agent's forecast as it is."""
    forecaster = fresh("dnri-3types").requires_grad_(False)
    head = forecaster.encoder.prior_head[-1]
    head.weight.zero_()
    head.bias.copy_(torch.tensor([1e4, 0.0, 0.0]))
    states, valid = random_states(0, 1, TIME, 3, 4), torch.ones(1, TIME, 3).bool()
    moved = states.clone()
    moved[..., 1:, :] += 3.0

    def first_agent() -> list[Tensor]:
        return [forecaster.rollout(last(forecaster, s, valid), 3).states[0, 0, 0] for s in (states, moved)]

    torch.testing.assert_close(*first_agent(), **TOLERANCE)
    head.bias.copy_(torch.tensor([0.0, 0.0, 1e4]))
    one, other = first_agent()
    assert not torch.allclose(one, other, atol=1e-3)


# --- Draws ------------------------------------------------------------------------------------------------------------


@pytest.fixture(params=[False, True], ids=["soft", "hard"])
def forecaster(request: pytest.FixtureRequest) -> DNRI:
    torch.manual_seed(7)
    made = DNRI(spec(), DNRIConfig(**DNRI_SIZES, num_edge_types=3, hard_samples=request.param), HORIZON)
    with torch.no_grad():
        for parameter in made.parameters():
            parameter.mul_(1.7)
    return made.requires_grad_(False)


def test_samples_depend_on_the_generator_alone(forecaster: DNRI):
    belief = last(forecaster, random_states(0, BATCH, TIME, AGENTS, 4), torch.ones(BATCH, TIME, AGENTS).bool())

    def draw(seed: int, everywhere: int) -> Tensor:
        torch.manual_seed(everywhere)
        return forecaster.rollout(belief, HORIZON, 4, torch.Generator().manual_seed(seed)).states

    assert torch.equal(draw(5, everywhere=1), draw(5, everywhere=2))
    one, other = draw(5, everywhere=1), draw(6, everywhere=1)
    assert torch.equal(one[:, 0], other[:, 0])
    assert (one[:, 1:] - other[:, 1:]).abs().amax((2, 3, 4)).min() > 1e-4
    distance = (one[:, :, None] - one[:, None]).abs().amax((-1, -2, -3)) + torch.eye(4)
    assert distance.min() > 1e-4


def test_samples_belong_to_their_scene():
    """Without noise every sample of a scene is its own expected forecast, so scenes and samples are not mixed up."""
    forecaster = tiny("dnri")
    belief = last(forecaster, random_states(0, BATCH, TIME, AGENTS, 4), torch.ones(BATCH, TIME, AGENTS).bool())
    with no_noise():
        drawn = forecaster.rollout(belief, HORIZON, 4).states
    torch.testing.assert_close(drawn, drawn[:, :1].expand_as(drawn), **METRES)
    assert not torch.allclose(drawn[0], drawn[1], atol=1.0)


def test_a_window_is_drawn_from_its_generator(forecaster: DNRI):
    states, valid = random_states(0, BATCH, TIME, AGENTS, 4), torch.ones(BATCH, TIME, AGENTS).bool()
    one, same, other = (
        forecaster.window(states, valid, torch.tensor([1, 3]), HORIZON, torch.Generator().manual_seed(s))
        for s in (0, 0, 1)
    )
    assert torch.equal(one.one_step, same.one_step) and torch.equal(one.rollout, same.rollout)
    assert not torch.allclose(one.one_step, other.one_step, atol=1e-4)
    assert not torch.allclose(one.rollout, other.rollout, atol=1e-4)
    assert torch.equal(one.prior_logits, other.prior_logits)


def test_training_and_forecasting_draw_from_the_right_logits(monkeypatch: pytest.MonkeyPatch):
    """Teacher forcing draws from the posterior, the roll-out's first step from the prior of the last observed one."""
    forecaster, seen = tiny("dnri"), []
    monkeypatch.setattr(dnri, "concrete_sample", lambda logits, *_: seen.append(logits) or logits.softmax(-1))
    states, valid = random_states(0, BATCH, TIME, AGENTS, 4), torch.ones(BATCH, TIME, AGENTS).bool()
    window = forecaster.window(states, valid, torch.tensor([1, 3]), HORIZON)
    assert len(seen) == 1 + HORIZON
    assert torch.equal(seen[0], window.posterior_logits)
    assert torch.equal(seen[1], window.prior_logits[torch.arange(2), torch.tensor([1, 3])])


def test_the_burn_in_ends_at_the_last_observation(monkeypatch: pytest.MonkeyPatch):
    forecaster, calls = tiny("dnri"), []
    inner = DNRI.recur
    monkeypatch.setattr(DNRI, "recur", lambda self, *args: calls.append(1) or inner(self, *args))
    states, valid = random_states(0, BATCH, TIME, AGENTS, 4), torch.ones(BATCH, TIME, AGENTS).bool()
    forecaster.window(states, valid, torch.tensor([1, 3]), HORIZON)
    assert len(calls) == TIME + 3 + HORIZON  # teacher forcing, steps 0 to 2, the rest is the free run's


def test_hard_draws_are_one_type_each_and_pass_the_soft_gradient():
    config = DNRIConfig(**DNRI_SIZES, num_edge_types=3)
    logits = torch.randn(50, 3, generator=torch.Generator().manual_seed(0), requires_grad=True)
    soft, hard = (
        DNRI(spec(), replace(config, hard_samples=hard)).drawn(torch.Generator().manual_seed(1))(logits)
        for hard in (False, True)
    )
    torch.testing.assert_close(hard, functional.one_hot(soft.argmax(-1), 3).float(), rtol=0, atol=1e-6)
    weights = torch.randn(50, 3, generator=torch.Generator().manual_seed(2))
    gradients = [torch.autograd.grad((graph * weights).sum(), logits)[0] for graph in (soft, hard)]
    assert torch.equal(*gradients)
    assert gradients[0].abs().max() > 0


# --- Sizes and learning -----------------------------------------------------------------------------------------------


def test_default_size_is_that_of_the_public_scripts():
    """1.61 M parameters there, less batch norm, one of two LSTM biases and the message MLP of the silent type."""
    parameters = sum(p.numel() for p in DNRI(SceneSpec(1.0, has_ego=False)).parameters())
    batch_norm, lstm_biases, silent = 4 * 2 * 256, 2 * 4 * 64, (512 + 1) * 256 + (256 + 1) * 256
    assert parameters + batch_norm + lstm_biases + silent == 1_611_016


def test_values_out_of_range():
    with pytest.raises(UserError, match="num_edge_types must be at least 2 .* got 1"):
        DNRIConfig(num_edge_types=1)
    with pytest.raises(UserError, match="temperature must be positive, got 0"):
        DNRIConfig(temperature=0.0)


@pytest.mark.slow
def test_overfits_one_batch():
    forecaster, states = fresh("dnri"), random_states(0, 2, 5, 3, 4) / 4
    valid, now = torch.ones(2, 5, 3).bool(), torch.full((2,), 2)
    optimizer = torch.optim.Adam(forecaster.parameters(), lr=1e-2)
    generator, losses = torch.Generator().manual_seed(0), []
    for _ in range(120):
        output = forecaster.window(states, valid, now, 2, generator)
        loss = output.one_step[:, :-1].sub(states[:, 1:]).square().mean()
        loss = loss + output.rollout.transpose(1, 2).sub(states[:, 3:]).square().mean()
        optimizer.zero_grad()
        (loss + 0.01 * kl_categorical(output.posterior_logits, output.prior_logits, pair_mask(valid))).backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < losses[0] / 5
