"""Many scenes are observed and forecast in parts: these are what the whole batch gives at once."""

from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
import torch

from predictor.dgvae import DGVAE
from predictor.online import MAX_ROWS, OnlineForecaster
from predictor.scene import PADDING_ID, Forecast, SceneBatch
from predictor.support.errors import UserError
from tests.predictor.helpers import EVERY_MODEL, ROAD, any_model, model, spec

ENVS, AGENTS, HORIZON = 5, 4, 3


def made(kind: str) -> Any:
    if kind != "dgvae-neighbours":
        return any_model(kind)
    torch.manual_seed(7)
    return DGVAE(spec(ROAD), replace(EVERY_MODEL["dgvae"][1], num_neighbours=2), HORIZON).eval().requires_grad_(False)


def drawn_scenes(rng: np.random.Generator, envs: int) -> SceneBatch:
    """An ego, and others at changing places, some of whom were there before."""
    ids = np.stack([np.concatenate([[0], 1 + rng.permutation(6)[: AGENTS - 1]]) for _ in range(envs)])
    valid = rng.random((envs, AGENTS)) < 0.7
    valid[:, 0] = True
    states = rng.normal(size=(envs, AGENTS, 4)) * (30.0, 4.0, 5.0, 1.0)
    states[..., 0] += 1000 * np.arange(envs)[:, None]
    return SceneBatch(states * valid[..., None], np.where(valid, ids, PADDING_ID), valid, np.zeros(envs))


def assert_equal(found: Forecast, expected: Forecast) -> None:
    for field in fields(Forecast):
        wanted, got = getattr(expected, field.name), getattr(found, field.name)
        assert (wanted is None) == (got is None), field.name
        if wanted is not None:
            torch.testing.assert_close(got, wanted, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("rows", [1, 2, 3])
@pytest.mark.parametrize("kind", ["dgvae", "dgvae-plural-rich", "dgvae-neighbours", "lstm-joint"])
def test_parts_of_a_batch_are_forecast_like_the_whole(kind: str, rows: int):
    forecaster = made(kind)
    streams = [OnlineForecaster(forecaster, ENVS, AGENTS, max_rows=most) for most in (rows, MAX_ROWS)]
    rng = np.random.default_rng(0)
    for step in range(5):
        now, count = drawn_scenes(rng, ENVS), ENVS
        for one in streams:
            if step == 2:
                one.observe(now[np.array([3, 1, 4])], np.array([3, 1, 4]))
            elif step == 3:
                one.observe_boundary(now, np.array([0, 4]), now[np.array([2, 1])])
            else:
                one.observe(now)
        count = {2: 3, 3: ENVS + 2}.get(step, ENVS)
        for samples, plans in ((1, None), (2, None), (2, rng.normal(size=(count, 2, HORIZON, 4)))):
            found, expected = (
                one.forecast(HORIZON, samples, [np.random.default_rng(i) for i in range(count)], plans)
                for one in streams
            )
            assert_equal(found, expected)


@pytest.mark.parametrize("kind", ["dgvae", "dgvae-plural-rich", "dgvae-neighbours", "lstm-joint"])
def test_no_scene_at_all_is_a_batch_too(kind: str):
    """All environments of some kind may be over at once."""
    online = OnlineForecaster(made(kind), ENVS, AGENTS)
    scenes = drawn_scenes(np.random.default_rng(0), ENVS)
    online.observe(scenes[np.array([], dtype=int)], np.array([], dtype=int))
    assert online.forecast(HORIZON, 2, []).xy.shape == (0, 2, AGENTS, HORIZON, 2)
    online.observe(scenes)
    assert online.forecast(HORIZON).xy.isfinite().all()


def test_no_call_gets_more_scenes_than_it_may(monkeypatch: pytest.MonkeyPatch):
    forecaster, sizes = model(frame=ROAD), []
    observe = forecaster.observe
    monkeypatch.setattr(forecaster, "observe", lambda m, s, v: sizes.append(len(s)) or observe(m, s, v))
    online = OnlineForecaster(forecaster, ENVS, AGENTS, max_rows=2)
    online.observe(drawn_scenes(np.random.default_rng(0), ENVS))
    assert sizes == [2, 2, 1]
    assert online.forecast(HORIZON).xy.shape == (ENVS, 1, AGENTS, HORIZON, 2)


def test_generators_and_plans_must_fit_all_scenes():
    online = OnlineForecaster(model(frame=ROAD), ENVS, AGENTS, max_rows=2)
    online.observe(drawn_scenes(np.random.default_rng(0), ENVS))
    with pytest.raises(UserError, match="one generator per scene, got 6 generators for 5 scenes"):
        online.forecast(HORIZON, 2, [np.random.default_rng(0)] * 6)
    with pytest.raises(UserError, match=r"ego_plan needs the shape .* = \(5, at least 1, 3, 4\), got \(6, 1, 3, 4\)"):
        online.forecast(HORIZON, 1, None, np.zeros((6, 1, HORIZON, 4)))
