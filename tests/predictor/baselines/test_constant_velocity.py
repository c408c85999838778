import numpy as np
import pytest
import torch

from predictor.baselines.constant_velocity import ConstantVelocity, NoisyConstantVelocity
from predictor.forecaster import Belief, Memory
from predictor.scene import KINEMATIC_FEATURES_3D, SceneSpec
from predictor.support.errors import UserError
from tests.predictor.helpers import random_presence, random_states, spec


def observe(forecaster: ConstantVelocity, states: torch.Tensor) -> Belief:
    memory = forecaster.empty_memory(len(states), states.shape[1])
    return forecaster.observe(memory, states, torch.ones(states.shape[:2]).bool())[1]


def test_forecast_closed_form():
    states = torch.tensor([[[1.0, 2.0, 4.0, 0.0], [0.0, 0.0, -2.0, 6.0]]])
    forecaster = ConstantVelocity(spec(dt_s=0.5))
    future = forecaster.rollout(observe(forecaster, states), 3).states
    assert future[0, 0, 0].tolist() == [[3.0, 2.0, 4.0, 0.0], [5.0, 2.0, 4.0, 0.0], [7.0, 2.0, 4.0, 0.0]]
    assert future[0, 0, 1, :, :2].tolist() == [[-1.0, 3.0], [-2.0, 6.0], [-3.0, 9.0]]


def test_other_features_stay_as_they_are():
    names, scales = (*spec().feature_names, "heading_rad"), (1.0,) * 5
    forecaster = ConstantVelocity(SceneSpec(1.0, feature_names=names, feature_scales=scales))
    future = forecaster.rollout(observe(forecaster, torch.tensor([[[0.0, 0.0, 1.0, 2.0, 0.7]]])), 2).states
    torch.testing.assert_close(future[0, 0, 0], torch.tensor([[1.0, 2.0, 1.0, 2.0, 0.7], [2.0, 4.0, 1.0, 2.0, 0.7]]))


def test_three_dimensions():
    layout = SceneSpec(0.5, ("world",) * 3, KINEMATIC_FEATURES_3D, (1.0,) * 6)
    future = (
        ConstantVelocity(layout)
        .rollout(observe(ConstantVelocity(layout), torch.tensor([[[1.0, 2.0, 3.0, 4.0, 0.0, -2.0]]])), 2)
        .states
    )
    assert future[0, 0, 0].tolist() == [[3.0, 2.0, 2.0, 4.0, 0.0, -2.0], [5.0, 2.0, 1.0, 4.0, 0.0, -2.0]]


def test_all_samples_are_the_same():
    forecaster = ConstantVelocity(spec())
    future = forecaster.rollout(observe(forecaster, random_states(0, 2, 3, 4)), 3, 5).states
    assert future.shape == (2, 5, 3, 3, 4)
    assert torch.equal(future, future[:, :1].expand_as(future))


def test_forecasting_leaves_the_belief_alone():
    forecaster, states = ConstantVelocity(spec()), random_states(0, 2, 3, 4)
    belief = observe(forecaster, states)
    forecaster.rollout(belief, 3)
    assert torch.equal(belief.states, random_states(0, 2, 3, 4))


def test_edges_are_decided_and_take_the_sizes_asked_for():
    forecaster = ConstantVelocity(spec(), num_edge_types=3, edge_feature_dim=4)
    belief = observe(forecaster, random_states(0, 2, 3, 4))
    assert torch.equal(belief.edge_probs, torch.tensor([1.0, 0.0, 0.0]).expand(2, 3, 3, 3))
    assert torch.equal(belief.edge_features, torch.zeros(2, 3, 3, 4))


def test_history_leaves_no_trace():
    forecaster = ConstantVelocity(spec())
    states, valid = random_states(0, 4, 1, 3, 4), random_presence(0, 4, 1, 3)
    memory = forecaster.empty_memory(1, 3)
    for now, present in zip(states, valid, strict=True):
        memory, belief = forecaster.observe(memory, now, present)
    assert memory == Memory()
    assert torch.equal(belief.states, states[-1]) and torch.equal(belief.valid, valid[-1])


# --- With noise -----------------------------------------------------------------------------------------------------


def test_both_parameters_of_the_noise_are_recovered_from_the_errors_they_cause():
    layout = spec(dt_s=0.5)
    fitted = NoisyConstantVelocity.fit(layout, [0.3 * (0.5 * step) ** 1.7 for step in range(1, 11)])
    assert (fitted.noise_m, fitted.growth) == (pytest.approx(0.3), pytest.approx(1.7))
    assert fitted.horizon_steps == 10


@pytest.mark.parametrize(("std_m", "noise_m"), [([2.0], 4.0), ([0.0, 0.0], 0.0), ([0.0, 3.0], 3.0)])
def test_fewer_than_two_errors_give_noise_on_the_velocity(std_m: list[float], noise_m: float):
    fitted = NoisyConstantVelocity.fit(spec(dt_s=0.5), std_m)
    assert (fitted.noise_m, fitted.growth) == (pytest.approx(noise_m), 1.0)


def test_samples_scatter_around_constant_velocity_as_fitted():
    layout, states = spec(dt_s=0.5), random_states(0, 3, 4, 4)
    noisy, straight = NoisyConstantVelocity(layout, 0.3, 1.5), ConstantVelocity(layout)
    belief = observe(noisy, states)
    samples = noisy.rollout(belief, 4, 4001, torch.Generator().manual_seed(0)).states
    exact = straight.rollout(belief, 4).states
    assert torch.equal(samples[:, :1], exact)  # sample 0 is the single forecast
    offsets = (samples - exact)[:, 1:]
    spread_m = 0.3 * torch.tensor([0.5, 1.0, 1.5, 2.0]) ** 1.5
    torch.testing.assert_close(offsets[..., :2].std((0, 1, 2)), spread_m[:, None].expand(4, 2), rtol=0.02, atol=0)
    torch.testing.assert_close(noisy.std_m(4), spread_m[:, None].expand(4, 2))
    assert float(offsets[..., :2].mean().abs()) < 0.01
    correlation = torch.corrcoef(
        torch.stack([offsets[..., 0].flatten(0, 2)[:, 3], offsets[..., 1].flatten(0, 2)[:, 3]])
    )
    assert abs(float(correlation[0, 1])) < 0.02  # axes are drawn apart


def test_a_sample_with_noise_moves_with_the_velocity_it_states():
    noisy, states = NoisyConstantVelocity(spec(dt_s=0.5), 0.3, 1.5), random_states(0, 1, 2, 4)
    samples = noisy.rollout(observe(noisy, states), 4, 3, torch.Generator().manual_seed(0)).states
    positions = torch.cat([states[:, None, :, None, :2].expand(1, 3, 2, 1, 2), samples[..., :2]], dim=3)
    torch.testing.assert_close(positions.diff(dim=3) / 0.5, samples[..., 2:4], rtol=1e-4, atol=1e-4)


def test_equal_generators_give_equal_noise_and_the_batch_is_left_alone():
    noisy, states = NoisyConstantVelocity(spec(), 0.3, 1.0), random_states(0, 2, 3, 4)
    belief = observe(noisy, states)
    first, second = (noisy.rollout(belief, 3, 5, torch.Generator().manual_seed(7)).states for _ in range(2))
    assert torch.equal(first, second) and not torch.equal(first[:, 1], first[:, 2])
    assert torch.equal(belief.states, states)


def test_a_scene_with_its_own_generator_draws_the_same_in_any_batch_and_with_any_padding():
    noisy, states = NoisyConstantVelocity(spec(), 0.3, 1.0), random_states(0, 2, 3, 4)
    both = noisy.rollout(observe(noisy, states), 3, 5, [np.random.default_rng(7), np.random.default_rng(8)]).states
    padded = torch.cat([states[1:], torch.zeros(1, 2, 4)], dim=1)
    belief = noisy.observe(noisy.empty_memory(1, 5), padded, torch.tensor([[True] * 3 + [False] * 2]))[1]
    alone = noisy.rollout(belief, 3, 5, [np.random.default_rng(8)]).states
    assert torch.equal(alone[0, :, :3], both[1]) and not torch.equal(both[0, 1], both[1, 1])


def test_generators_must_be_as_many_as_scenes():
    noisy, states = NoisyConstantVelocity(spec(), 0.3, 1.0), random_states(0, 2, 3, 4)
    with pytest.raises(UserError, match="samples need one generator per scene, got 1 generators for 2 scenes"):
        noisy.rollout(observe(noisy, states), 3, 5, [np.random.default_rng(7)])
