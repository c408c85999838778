"""What happens after the last observation changes no forecast, whatever the model: bit for bit."""

from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from predictor.data.store import Episode
from predictor.data.windows import WindowBatch, Windows
from tests.predictor.helpers import EVERY_MODEL, any_model, random_presence, random_states, spec

BATCH, TIME, AGENTS, HORIZON = 2, 6, 4, 3
every_model = pytest.mark.parametrize("kind", EVERY_MODEL)
every_future = given(
    seed=st.integers(0, 2**16),
    last_observed=st.tuples(*[st.integers(0, TIME - 2)] * BATCH),
    share=st.sampled_from([0.5, 0.8, 1.0]),
)


def observed(seed: int, share: float) -> tuple[Tensor, Tensor]:
    states, valid = random_states(seed, BATCH, TIME, AGENTS, 4), random_presence(seed, BATCH, TIME, AGENTS, share=share)
    return states * valid[..., None], valid


def with_another_future(states: Tensor, valid: Tensor, last_observed: Tensor, seed: int) -> tuple[Tensor, Tensor]:
    """Other states and other presence after each window's last observation; not one future number stays."""
    later = torch.arange(TIME) > last_observed[:, None]
    other_valid = torch.where(later[..., None], ~valid, valid)
    other_valid[..., 0] = True
    other_states = torch.where(later[..., None, None], 10 * random_states(seed + 1, *states.shape), states)
    assert not (states == other_states)[later].any(-1)[valid[later]].any()
    return other_states * other_valid[..., None], other_valid


def streamed(forecaster: Any, states: Tensor, valid: Tensor, last_observed: Tensor) -> list[Tensor]:
    """Belief and forecast of each window at its last observation, from one stream over the whole window."""
    memory, beliefs, last = forecaster.empty_memory(BATCH, AGENTS), {}, last_observed.tolist()
    for t, (now, present) in enumerate(zip(states.unbind(1), valid.unbind(1), strict=True)):
        memory, belief = forecaster.observe(memory, now, present)
        if t in last:
            forecast = forecaster.rollout(belief, HORIZON, 2, torch.Generator().manual_seed(3)).states
            beliefs[t] = (belief.edge_probs, belief.edge_features, forecast)
    return [torch.stack([beliefs[t][i][window] for window, t in enumerate(last)]) for i in range(3)]


def in_window(forecaster: Any, states: Tensor, valid: Tensor, last_observed: Tensor) -> Tensor:
    """The free run of the training pass, with graphs drawn where the model draws them."""
    generator = torch.Generator().manual_seed(3)
    rollout: Tensor = forecaster.window(states, valid, last_observed, HORIZON, generator).rollout
    return rollout


@every_model
@settings(max_examples=6)
@every_future
def test_another_future_changes_no_forecast(kind: str, seed: int, last_observed: tuple[int, ...], share: float):
    forecaster, now = any_model(kind), torch.tensor(last_observed)
    states, valid = observed(seed, share)
    other = with_another_future(states, valid, now, seed)
    for ours, expected in zip(streamed(forecaster, *other, now), streamed(forecaster, states, valid, now), strict=True):
        assert torch.equal(ours, expected)
    assert torch.equal(in_window(forecaster, *other, now), in_window(forecaster, states, valid, now))


@every_model
def test_the_present_does_change_it(kind: str):
    """Without this, the equalities above would hold for a model that is blind."""
    forecaster, now = any_model(kind), torch.tensor([2, 3])
    states, valid = observed(0, 1.0)
    other = states.clone()
    other[torch.arange(BATCH), now] += 1.0
    assert (in_window(forecaster, other, valid, now) - in_window(forecaster, states, valid, now)).abs().min() > 1e-4
    ours, expected = streamed(forecaster, other, valid, now), streamed(forecaster, states, valid, now)
    assert (ours[2] - expected[2]).abs().max() > 1e-2


# --- From episodes ----------------------------------------------------------------------------------------------------


def forecast_of(forecaster: Any, batch: WindowBatch) -> Tensor:
    """One draw for all, so that only what is observed can matter."""
    rollout: Tensor = forecaster.window(
        batch.states, batch.valid, batch.last_observed, HORIZON, torch.Generator().manual_seed(3)
    ).rollout
    return rollout


@pytest.mark.parametrize("kind", ["dgvae-rich", "dgvae-window", "dnri", "lstm-joint"])
@settings(max_examples=5)
@given(seed=st.integers(0, 2**16), now=st.integers(0, TIME - 2))
def test_windows_are_cut_without_looking_ahead(kind: str, seed: int, now: int):
    """Who is in a window, and in which column, is decided by what the ego saw: also when it is a different crowd that
    comes into view afterwards."""
    layout = spec(perception_m=25.0)
    states, valid = observed(seed, 0.7)
    other_states, other_valid = with_another_future(states, valid, torch.full((BATCH,), now), seed)
    batches = []
    for s, v in ((states, valid), (other_states, other_valid)):
        episode = Episode(s[0].numpy(), v[0].numpy(), np.arange(AGENTS))
        batches.append(Windows([episode], layout, history_steps=4, horizon_steps=HORIZON).batch(np.array([now])))
    one, two = batches
    seen = slice(int(one.last_observed) + 1)
    assert torch.equal(one.states[:, seen], two.states[:, seen]) and torch.equal(one.valid[:, seen], two.valid[:, seen])
    forecaster = any_model(kind)
    assert torch.equal(forecast_of(forecaster, one), forecast_of(forecaster, two))
