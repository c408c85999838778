"""Jacobians of forecasts by `torch.func` are those of autograd and of finite differences, for every kind of model."""

from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from predictor.dgvae import DGVAE
from predictor.forecaster import TrainableForecaster
from predictor.models import build
from tests.predictor.helpers import EVERY_MODEL, FAST_LIKE, RICH, random_states, spec

TIME, AGENTS, HORIZON = 3, 4, 2
LAST = torch.tensor([TIME - 1])
VALID = torch.tensor([[True, True, True, False], [True, True, True, True], [True, True, True, False]])[None]
STEP = 1e-5
KINDS: dict[str, tuple[str, Any]] = EVERY_MODEL | {
    "dgvae-window": ("dgvae", replace(RICH, pair_matching="window", num_edge_types=3)),  # hard samples are no function
    "dgvae-neighbours": ("dgvae", replace(FAST_LIKE, num_neighbours=2, num_edge_types=3, static_dim=3)),
    "dgvae-frozen": (
        "dgvae",
        replace(FAST_LIKE, rollout_graph="frozen", edge_feature_dim=0, change_scales=(3.0, 3.0, 2.0, 2.0), substeps=2),
    ),
}
every_model = pytest.mark.parametrize("kind", KINDS)
Forecast = Callable[[Tensor], Tensor]


def made(kind: str, dtype: torch.dtype = torch.float64) -> TrainableForecaster:
    """An untrained model with weights large enough for every path to leave a trace."""
    name, config = KINDS[kind]
    torch.manual_seed(7)
    model: Any = build(name, spec(), config, HORIZON)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.mul_(1.7)
    return model.to(dtype).eval()


def observed(dtype: torch.dtype = torch.float64) -> Tensor:
    return random_states(3, 1, TIME, AGENTS, 4).to(dtype)


def of_all() -> Any:
    return torch.Generator().manual_seed(0)


def of_each_scene() -> Any:
    return [np.random.default_rng(0)]


def streamed(model: TrainableForecaster, num_samples: int = 1, noise: Callable[[], Any] = of_all) -> Forecast:
    """Observe every step, then roll out."""

    def forecast(states: Tensor) -> Tensor:
        memory = model.empty_memory(1, AGENTS)
        for t in range(TIME):
            memory, belief = model.observe(memory, states[:, t], VALID[:, t])
        return model.rollout(belief, HORIZON, num_samples, noise()).states[0, -1]

    return forecast


def whole_window(model: TrainableForecaster) -> Forecast:
    """The roll-out of a training window, and its last one-step prediction beside it."""

    def forecast(states: Tensor) -> Tensor:
        output = model.window(states, VALID, LAST, HORIZON, torch.Generator().manual_seed(0))
        return torch.cat([output.rollout[0], output.one_step[0, -1:].transpose(0, 1)], dim=1)

    return forecast


def difference_quotients(forecast: Forecast, states: Tensor, jacobian: Tensor) -> tuple[Tensor, Tensor]:
    """The Jacobian's product with three random directions, and central differences along them."""
    products, quotients = [], []
    for seed in range(3):
        direction = torch.randn(states.shape, generator=torch.Generator().manual_seed(seed), dtype=states.dtype)
        products.append(jacobian.flatten(-states.ndim) @ direction.flatten())
        quotients.append((forecast(states + STEP * direction) - forecast(states - STEP * direction)) / (2 * STEP))
    return torch.stack(products), torch.stack(quotients)


@every_model
@pytest.mark.parametrize("of", [streamed, whole_window])
def test_jacrev_is_autograd_and_finite_differences(kind: str, of: Callable[[TrainableForecaster], Forecast]):
    forecast, states = of(made(kind)), observed()
    jacobian = torch.func.jacrev(forecast)(states)
    torch.testing.assert_close(jacobian, torch.autograd.functional.jacobian(forecast, states), rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(*difference_quotients(forecast, states, jacobian), rtol=1e-5, atol=1e-6)
    assert jacobian[0, 0, :, 0, -1, 0].abs().max() > 1e-3  # an agent's next state follows its latest one
    assert not jacobian[..., 0, 3, :].any()  # absent


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind.startswith("dgvae")])
@pytest.mark.parametrize("kind_of_derivative", [torch.func.jacrev, torch.func.jacfwd])
@pytest.mark.filterwarnings("ignore:.*torch.jit.script.*:DeprecationWarning")  # torch's own, in jacfwd
def test_jacobians_where_gradients_are_switched_off(kind: str, kind_of_derivative: Any):
    """Planners call from within `no_grad`; the folded single step must not be taken."""
    forecast, states = streamed(made(kind)), observed()
    expected = torch.autograd.functional.jacobian(forecast, states)
    with torch.no_grad():
        jacobian = kind_of_derivative(forecast)(states)
    torch.testing.assert_close(jacobian, expected, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("kind", ["dgvae", "dgvae-neighbours", "dnri"])
@pytest.mark.parametrize("noise", [of_all, of_each_scene])
def test_a_drawn_sample_has_a_jacobian(kind: str, noise: Callable[[], Any]):
    forecast, states = streamed(made(kind), 2, noise), observed()
    jacobian = torch.func.jacrev(forecast)(states)
    torch.testing.assert_close(*difference_quotients(forecast, states, jacobian), rtol=1e-5, atol=1e-6)
    assert (jacobian - torch.func.jacrev(streamed(made(kind)))(states)).abs().max() > 1e-3


@every_model
def test_only_the_latest_observation_may_be_differentiated(kind: str):
    """The history was streamed without gradients."""
    model, states = made(kind), observed()
    memory = model.empty_memory(1, AGENTS)
    with torch.no_grad():
        for t in range(TIME - 1):
            memory, _ = model.observe(memory, states[:, t], VALID[:, t])

    def forecast(latest: Tensor) -> Tensor:
        _, belief = model.observe(memory, latest, VALID[:, -1])
        return model.rollout(belief, HORIZON).states[0, 0]

    latest = torch.func.jacrev(forecast)(states[:, -1])
    whole = torch.func.jacrev(streamed(model))(states)[..., -1, :, :]
    torch.testing.assert_close(latest, whole, rtol=1e-10, atol=1e-10)


def test_jacobians_in_float32():
    """As shipped, where other kernels are chosen."""
    exact = torch.func.jacrev(streamed(made("dgvae")))(observed())
    single = torch.func.jacrev(streamed(made("dgvae", torch.float32)))(observed(torch.float32))
    torch.testing.assert_close(single.double(), exact, rtol=1e-3, atol=1e-4)


def test_a_forward_derivative_by_dual_numbers_is_not_lost():
    model, states = made("dgvae"), observed()
    forecast = streamed(model)
    direction = torch.ones_like(states)
    expected = torch.autograd.functional.jacobian(forecast, states).flatten(-states.ndim) @ direction.flatten()
    with torch.no_grad(), torch.autograd.forward_ad.dual_level():
        result = forecast(torch.autograd.forward_ad.make_dual(states, direction))
        tangent = torch.autograd.forward_ad.unpack_dual(result).tangent
    torch.testing.assert_close(tangent, expected, rtol=1e-10, atol=1e-10)


def test_second_derivatives_of_a_forecast():
    """Newton steps of a planner: the Hessian is symmetric and that of finite differences of the gradient."""
    forecast, states = streamed(made("dgvae")), observed()

    def cost(latest: Tensor) -> Tensor:
        return forecast(torch.cat([states[:, :-1], latest], dim=1))[..., :2].square().mean()

    latest = states[:, -1:]
    size = latest.numel()
    hessian = torch.func.jacrev(torch.func.jacrev(cost))(latest).view(size, size)
    torch.testing.assert_close(hessian, hessian.T, rtol=1e-9, atol=1e-9)
    direction = torch.randn(latest.shape, generator=torch.Generator().manual_seed(0), dtype=latest.dtype)
    gradient = torch.func.grad(cost)
    quotient = (gradient(latest + STEP * direction) - gradient(latest - STEP * direction)).flatten() / (2 * STEP)
    torch.testing.assert_close(hessian @ direction.flatten(), quotient, rtol=1e-5, atol=1e-6)
    assert hessian.abs().max() > 1e-3


def test_a_jacobian_leaves_streaming_as_it_was():
    model = made("dgvae")
    assert isinstance(model, DGVAE)
    other, states = deepcopy(model), observed()
    torch.func.jacrev(streamed(model))(states)
    with torch.inference_mode():
        assert torch.equal(streamed(model)(states), streamed(other)(states))
