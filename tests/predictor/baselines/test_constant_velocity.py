import torch

from predictor.baselines.constant_velocity import ConstantVelocity
from predictor.forecaster import Belief, Memory
from predictor.scene import KINEMATIC_FEATURES_3D, SceneSpec
from tests.predictor.helpers import random_presence, random_states, spec


def observe(forecaster: ConstantVelocity, states: torch.Tensor) -> Belief:
    memory = forecaster.empty_memory(len(states), states.shape[1])
    return forecaster.observe(memory, states, torch.ones(states.shape[:2]).bool())[1]


def test_forecast_closed_form():
    states = torch.tensor([[[1.0, 2.0, 4.0, 0.0], [0.0, 0.0, -2.0, 6.0]]])
    forecaster = ConstantVelocity(spec(dt_s=0.5))
    future = forecaster.rollout(observe(forecaster, states), 3)
    assert future[0, 0, 0].tolist() == [[3.0, 2.0, 4.0, 0.0], [5.0, 2.0, 4.0, 0.0], [7.0, 2.0, 4.0, 0.0]]
    assert future[0, 0, 1, :, :2].tolist() == [[-1.0, 3.0], [-2.0, 6.0], [-3.0, 9.0]]


def test_other_features_stay_as_they_are():
    names, scales = (*spec().feature_names, "heading_rad"), (1.0,) * 5
    forecaster = ConstantVelocity(SceneSpec(1.0, feature_names=names, feature_scales=scales))
    future = forecaster.rollout(observe(forecaster, torch.tensor([[[0.0, 0.0, 1.0, 2.0, 0.7]]])), 2)
    torch.testing.assert_close(future[0, 0, 0], torch.tensor([[1.0, 2.0, 1.0, 2.0, 0.7], [2.0, 4.0, 1.0, 2.0, 0.7]]))


def test_three_dimensions():
    layout = SceneSpec(0.5, ("world",) * 3, KINEMATIC_FEATURES_3D, (1.0,) * 6)
    future = ConstantVelocity(layout).rollout(
        observe(ConstantVelocity(layout), torch.tensor([[[1.0, 2.0, 3.0, 4.0, 0.0, -2.0]]])), 2
    )
    assert future[0, 0, 0].tolist() == [[3.0, 2.0, 2.0, 4.0, 0.0, -2.0], [5.0, 2.0, 1.0, 4.0, 0.0, -2.0]]


def test_all_samples_are_the_same():
    forecaster = ConstantVelocity(spec())
    future = forecaster.rollout(observe(forecaster, random_states(0, 2, 3, 4)), 3, 5)
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
