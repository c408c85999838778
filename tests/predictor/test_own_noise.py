"""Samples of one scene of a batch: they follow its own generator, whatever else is in the batch; for every model."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from predictor.baselines.constant_velocity import ConstantVelocity
from predictor.dgvae import DGVAE
from predictor.online import OnlineForecaster
from predictor.scene import Forecast, Scene, SceneBatch
from tests.predictor.helpers import EVERY_MODEL, FAST_LIKE, any_model, batch, random_states, scene, spec

AGENTS, SCENES, STEPS, SAMPLES = 6, 8, 3, 5
VARIANTS = {
    "dgvae-neighbours": replace(FAST_LIKE, num_neighbours=2),
    "dgvae-frozen": replace(FAST_LIKE, rollout_graph="frozen"),
    "dgvae-hard": replace(FAST_LIKE, hard_samples=True, num_edge_types=3),
}
KINDS = (*EVERY_MODEL, *VARIANTS, "constant-velocity")
DRAWING = tuple(kind for kind in KINDS if kind.startswith(("dgvae", "dnri")))
CLOSE = {"rtol": 1e-3, "atol": 1e-3}
"""Products of other sizes round differently; a free run of the richest variant amplifies that."""
every_kind = pytest.mark.parametrize("kind", KINDS)
every_drawing_kind = pytest.mark.parametrize("kind", DRAWING)


@cache
def forecaster(kind: str) -> Any:
    """One with room for `AGENTS` agents."""
    if kind == "constant-velocity":
        return ConstantVelocity(spec())
    if kind in EVERY_MODEL:
        return any_model(kind)
    torch.manual_seed(7)
    made = DGVAE(spec(), VARIANTS[kind], 3)
    with torch.no_grad():
        for parameter in made.parameters():
            parameter.mul_(1.7)
    return made.eval().requires_grad_(False)


def drive(kind: str, index: int, agents: int = AGENTS) -> list[Scene]:
    """The scenes of one environment, with 2 to 4 agents among them."""
    count = 2 + index % 3
    states = random_states(index, STEPS, count, 4).double().numpy() * 0.3
    return [scene(dict(enumerate(now.tolist())), agents) for now in states]


def forecast(kind: str, histories: Sequence[list[Scene]], seeds: Sequence[int], samples: int = SAMPLES) -> Forecast:
    online = OnlineForecaster(forecaster(kind), len(histories), len(histories[0][0].ids))
    for now in zip(*histories, strict=True):
        online.observe(batch(*now))
    return online.forecast(num_samples=samples, generator=[np.random.default_rng(seed) for seed in seeds])


def spread(samples: Tensor) -> float:
    return float((samples[:, 1:] - samples[:, :1]).abs().max())


@every_kind
def test_samples_alone_are_those_in_a_batch_of_eight(kind: str):
    histories = [drive(kind, i) for i in range(SCENES)]
    together = forecast(kind, histories, range(SCENES)).xy
    for i, history in enumerate(histories):
        torch.testing.assert_close(together[[i]], forecast(kind, [history], [i]).xy, **CLOSE)


@every_drawing_kind
def test_order_of_the_batch_has_no_say(kind: str):
    histories, order = [drive(kind, i) for i in range(SCENES)], [3, 0, 7, 5, 1, 2, 6, 4]
    expected = forecast(kind, histories, range(SCENES)).xy[order]
    torch.testing.assert_close(forecast(kind, [histories[i] for i in order], order).xy, expected, **CLOSE)


@every_drawing_kind
def test_padding_draws_nothing(kind: str):
    narrow, wide = forecast(kind, [drive(kind, 1)], [0]).xy, forecast(kind, [drive(kind, 1, AGENTS + 3)], [0]).xy
    torch.testing.assert_close(wide[:, :, :AGENTS], narrow, **CLOSE)


@every_drawing_kind
def test_equal_scenes_with_other_generators_differ_and_the_first_sample_draws_nothing(kind: str):
    history = drive(kind, 2)
    samples = forecast(kind, [history, history], [0, 1]).xy
    assert spread(samples[:1]) > 1e-2
    torch.testing.assert_close(samples[0, 0], samples[1, 0], **CLOSE)
    assert (samples[0, 1:] - samples[1, 1:]).abs().max() > 1e-2
    again = forecast(kind, [history, history], [1, 1]).xy
    torch.testing.assert_close(again[0], samples[1], **CLOSE)


@pytest.mark.parametrize("kind", ["dgvae", "dgvae-neighbours", "dnri"])
def test_samples_with_gradients_are_those_without(kind: str):
    """Lists of the agents that are there, and padded arrays: the same pairs draw the same numbers."""
    model, states = forecaster(kind), random_states(3, 2, AGENTS, 4) * 0.3
    valid = torch.tensor([[True, True, False, True, True, False], [True, True, True, False, False, False]])
    found = []
    for gradients in (False, True):
        with torch.set_grad_enabled(gradients):
            _, belief = model.observe(model.empty_memory(2, AGENTS), states, valid)
            rolled = model.rollout(belief, 3, SAMPLES, [np.random.default_rng(i) for i in (4, 5)]).states
            found.append(rolled * valid[:, None, :, None, None])
    torch.testing.assert_close(found[1].detach(), found[0], **CLOSE)


@every_kind
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_what_stands_in_padding_reaches_no_forecast(kind: str, value: float):
    histories = [drive(kind, i) for i in range(3)]
    clean = forecast(kind, histories, range(3))
    for history in histories:
        for now in history:
            now.states[~now.valid] = value
    found = forecast(kind, histories, range(3))
    assert bool((~found.valid).any())
    for name in ("xy", "edge_probs", "edge_features"):
        assert torch.equal(getattr(found, name), getattr(clean, name)), name


@pytest.mark.parametrize("kind", ["dgvae", "dgvae-rich"])
def test_an_absent_agent_in_front_may_hold_anything(kind: str):
    """Positions are taken relative to agent 0, which may be absent."""
    histories = [drive(kind, 2)]
    for now in histories[0]:
        now.valid[0], now.ids[0] = False, -1
    clean = forecast(kind, histories, [0])
    for now in histories[0]:
        now.states[0] = np.nan
    assert torch.equal(forecast(kind, histories, [0]).xy, clean.xy)


def test_some_scenes_of_a_batch_take_their_own_generators():
    histories = [drive("dgvae", i) for i in range(4)]
    online = OnlineForecaster(forecaster("dgvae"), 4, AGENTS)
    for now in zip(*histories, strict=True):
        online.observe(batch(*now))
    last = SceneBatch.stack([histories[i][-1] for i in (1, 3)])
    online.observe(last, np.array([1, 3]))
    some = online.forecast(num_samples=SAMPLES, generator=[np.random.default_rng(i) for i in (1, 3)]).xy
    for place, i in enumerate((1, 3)):
        expected = forecast("dgvae", [[*histories[i], histories[i][-1]]], [i]).xy
        torch.testing.assert_close(some[[place]], expected, **CLOSE)
