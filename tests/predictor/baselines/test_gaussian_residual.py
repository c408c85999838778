"""Gaussian noise around another forecaster's single forecast: of the fitted covariance, and nothing else changed."""

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from predictor.baselines.constant_velocity import ConstantVelocity
from predictor.baselines.gaussian_residual import GaussianResidual
from predictor.forecaster import Belief, Forecaster, Futures, has_scale
from predictor.online import OnlineForecaster
from predictor.scene import SceneSpec
from predictor.support.errors import UserError
from tests.predictor.helpers import any_model, batch, random_states, scene, spec

HORIZON, AXES, SAMPLES = 3, 2, 20_001
LAYOUT = SceneSpec(
    0.5, feature_names=("x_m", "y_m", "vx_mps", "vy_mps", "heading_rad"), feature_scales=(1.0,) * 5, has_ego=False
)


def root() -> np.ndarray:
    """A root of a covariance that mixes steps and axes, growing with time."""
    drawn = np.random.default_rng(0).normal(size=(HORIZON * AXES,) * 2)
    return np.tril(drawn) + np.diag([1.0, 1.0, 2.0, 2.0, 3.0, 3.0])


def fitted(errors: int = 50_000, layout: SceneSpec = LAYOUT) -> GaussianResidual:
    drawn = np.random.default_rng(1).normal(size=(errors, HORIZON * AXES)) @ root().T
    return GaussianResidual.fit(ConstantVelocity(layout, 7), drawn.reshape(errors, HORIZON, AXES))


def belief(forecaster: Forecaster, agents: int = 2, scenes: int = 1) -> Belief:
    states = torch.cat([random_states(0, scenes, agents, 4), torch.full((scenes, agents, 1), 0.7)], dim=-1)
    valid = torch.ones(scenes, agents).bool()
    return forecaster.observe(forecaster.empty_memory(scenes, agents), states, valid)[1]


def noise_of(control: GaussianResidual, now: Belief, samples: int = SAMPLES, steps: int = HORIZON) -> Tensor:
    """What is added to the single forecast: (samples, agents, steps, state), of the first scene."""
    futures = control.rollout(now, steps, samples, torch.Generator().manual_seed(0)).states[0]
    return futures[1:] - futures[:1]


# --- Covariance -------------------------------------------------------------------------------------------------------


def test_noise_has_the_covariance_of_the_errors_it_was_fitted_to():
    """Over all steps and axes together: what is correlated in time stays so; agents draw for themselves."""
    control = fitted()
    noise = noise_of(control, belief(control))[..., :AXES].flatten(2)
    expected = torch.from_numpy(root() @ root().T).float()
    of_agents = noise.flatten(1).T.cov()
    size = HORIZON * AXES
    assert expected.abs().max() > 10 and expected[0, 2].abs() > 0.3
    for agent in range(2):
        found = of_agents[agent * size : (agent + 1) * size, agent * size : (agent + 1) * size]
        torch.testing.assert_close(found, expected, rtol=0.03, atol=0.3)
    torch.testing.assert_close(of_agents[:size, size:], torch.zeros(size, size), rtol=0, atol=0.3)
    torch.testing.assert_close(noise.mean(0), torch.zeros(2, size), rtol=0, atol=0.1)


def test_a_constant_error_is_noise_too_since_the_single_forecast_stays():
    """The second moment, not the variance: samples stand around the forecast, not around the mean error."""
    errors = np.ones((10, HORIZON, AXES)) * np.array([3.0, 0.0])
    control = GaussianResidual.fit(ConstantVelocity(LAYOUT), errors)
    noise = noise_of(control, belief(control))
    assert noise[..., 0].std(0).flatten().tolist() == pytest.approx([3.0] * 2 * HORIZON, rel=0.03)
    torch.testing.assert_close(noise[..., 0, 0], noise[..., 2, 0], rtol=1e-4, atol=1e-4)  # wholly correlated in time
    assert noise[..., 1].abs().max() < 1e-3


def test_in_three_dimensions():
    names = ("x_m", "y_m", "z_m", "vx_mps", "vy_mps", "vz_mps")
    layout = SceneSpec(1.0, ("world",) * 3, names, (1.0,) * 6, has_ego=False)
    errors = np.random.default_rng(0).normal(size=(4000, 2, 3)) * np.array([1.0, 2.0, 3.0])
    control = GaussianResidual.fit(ConstantVelocity(layout), errors)
    assert control.horizon_steps == 2
    now = control.observe(control.empty_memory(1, 1), torch.zeros(1, 1, 6), torch.ones(1, 1).bool())[1]
    noise = noise_of(control, now, 4001, 2)
    assert noise[:, 0, :, :3].std(0).flatten().tolist() == pytest.approx([1, 2, 3] * 2, rel=0.06)


# --- Samples ----------------------------------------------------------------------------------------------------------


def test_sample_0_is_the_single_forecast_and_draws_nothing():
    control, generator = fitted(100), torch.Generator().manual_seed(0)
    now, before = belief(control, scenes=2), generator.get_state()
    expected = control.forecaster.rollout(now, HORIZON).states
    assert torch.equal(control.rollout(now, HORIZON, 1, generator).states, expected)
    assert torch.equal(generator.get_state(), before)
    many = control.rollout(now, HORIZON, 4, generator)
    assert torch.equal(many.states[:, :1], expected) and many.states.shape[1] == 4
    assert many.mode_probs is None and many.scale is None and not has_scale(control)


def test_a_sample_moves_with_the_velocity_it_states_and_keeps_the_rest():
    control = fitted(100)
    now = belief(control)
    samples = control.rollout(now, HORIZON, 3, torch.Generator().manual_seed(0)).states
    start = now.states[:, None, :, None, :2].expand(1, 3, 2, 1, 2)
    positions = torch.cat([start, samples[..., :2]], dim=3)
    torch.testing.assert_close(positions.diff(dim=3) / 0.5, samples[..., 2:4], rtol=1e-4, atol=1e-3)
    assert (samples[..., 4] == 0.7).all()


def test_a_shorter_forecast_has_the_first_steps_of_the_noise():
    control = fitted(100)
    now = belief(control)
    for steps in (0, 1, 2):
        torch.testing.assert_close(noise_of(control, now, 5, steps), noise_of(control, now, 5)[:, :, :steps])


def test_a_scene_with_its_own_generator_draws_the_same_in_any_batch_and_with_any_padding():
    control = GaussianResidual(ConstantVelocity(spec()), np.eye(HORIZON * AXES))
    agents = [{i: random_states(n, 4)[None].squeeze().tolist() for i in range(2 + n)} for n in range(2)]

    def forecast(*histories: Any, size: int = 4, seeds: tuple[int, ...] = (0, 1)) -> Tensor:
        online = OnlineForecaster(control, len(histories), size)
        online.observe(batch(*(scene(history, size) for history in histories)))
        return online.forecast(num_samples=5, generator=[np.random.default_rng(seed) for seed in seeds]).xy

    both = forecast(*agents)
    torch.testing.assert_close(forecast(agents[1], size=6, seeds=(1,))[0, :, :4], both[1])
    assert (both[0, :, 2:] == 0).all() and (both[0, 1:, :2] - both[1, 1:, :2]).abs().min() > 1e-4
    with pytest.raises(UserError, match="samples need one generator per scene, got 2 generators for 1 scenes"):
        forecast(agents[0], seeds=(0, 1))


@pytest.mark.parametrize("kind", ["dgvae-plural", "dgvae"])
def test_memory_beliefs_and_the_single_forecast_are_those_of_the_model(kind: str):
    """The control has what the model has, its history included; of its modes only the first."""
    model: Any = any_model(kind)
    control = GaussianResidual(model, 1e-12 * np.eye(HORIZON * AXES))
    assert isinstance(control, Forecaster)
    assert (control.spec, control.num_edge_types, control.edge_feature_dim, control.horizon_steps) == (
        model.spec, model.num_edge_types, model.edge_feature_dim, HORIZON,
    )  # fmt: skip
    futures: list[Futures] = []
    for forecaster in (control, model):
        memory = forecaster.empty_memory(1, 3)
        for t in range(3):
            memory, now = forecaster.observe(memory, random_states(t, 1, 3, 4), torch.ones(1, 3).bool())
        futures.append(forecaster.rollout(now, HORIZON, 1))
    assert torch.equal(futures[0].states, futures[1].states)


# --- Limits -----------------------------------------------------------------------------------------------------------


def test_a_covariance_needs_more_examples_than_coordinates():
    straight = ConstantVelocity(LAYOUT)
    with pytest.raises(UserError) as error:
        GaussianResidual.fit(straight, np.zeros((6, HORIZON, AXES)))
    assert str(error.value) == "a covariance of 6 coordinates needs more examples, got 6"
    assert GaussianResidual.fit(straight, np.zeros((7, HORIZON, AXES))).horizon_steps == HORIZON


@pytest.mark.parametrize("wrong", [np.nan, np.inf])
def test_an_error_that_is_not_finite_is_refused(wrong: float):
    errors = np.random.default_rng(0).normal(size=(50, HORIZON, AXES))
    errors[7, 0, 1] = wrong
    with pytest.raises(UserError, match="the single forecast has errors that are not finite"):
        GaussianResidual.fit(ConstantVelocity(LAYOUT), errors)


def test_errors_of_zero_are_no_reason_to_fail():
    """Agents that stand, all of them: the root of a covariance of zeros."""
    control = GaussianResidual.fit(ConstantVelocity(LAYOUT), np.zeros((7, HORIZON, AXES)))
    assert noise_of(control, belief(control), 9)[..., :AXES].abs().max() < 1e-4


def test_errors_in_large_units_that_grow_evenly_are_no_reason_to_fail():
    """Their covariance has rank one, and pixels are large numbers."""
    rate = 1000.0 * np.random.default_rng(0).normal(size=(500, 1, AXES))
    control = GaussianResidual.fit(ConstantVelocity(LAYOUT), rate * np.arange(1.0, HORIZON + 1)[:, None])
    drawn = noise_of(control, belief(control), 4000)[..., :AXES]
    assert drawn.isfinite().all() and drawn[..., -1, :].std() == pytest.approx(1000.0 * HORIZON, rel=0.1)


def test_a_forecast_beyond_the_fitted_steps_is_refused():
    control = fitted(100)
    now = belief(control)
    for samples in (1, 4):
        with pytest.raises(UserError) as error:
            control.rollout(now, HORIZON + 1, samples)
        assert str(error.value) == "the noise was fitted to 3 steps, got horizon_steps=4"


def test_the_standard_deviation_is_that_of_the_samples():
    control = fitted()
    drawn = noise_of(control, belief(control))[:, 0, :, :AXES].std(0)
    torch.testing.assert_close(control.std_m(HORIZON), drawn, rtol=0.03, atol=0)
    assert torch.equal(control.std_m(1), control.std_m(HORIZON)[:1])
