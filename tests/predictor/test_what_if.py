"""What-if forecasts: the ego follows its plan, the others react, and without a plan nothing changes."""

from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from predictor.baselines.constant_velocity import ConstantVelocity, NoisyConstantVelocity
from predictor.baselines.gaussian_residual import GaussianResidual
from predictor.baselines.nearest_neighbour import NearestNeighbour
from predictor.dgvae import DGVAE
from predictor.forecaster import Belief, Futures
from predictor.online import OnlineForecaster
from predictor.scene import Scene
from predictor.support import memory
from predictor.support.errors import UserError
from predictor.what_if import rollout_plans, with_ego
from tests.predictor.helpers import (
    EVERY_MODEL,
    FAST_LIKE,
    PLURAL,
    ROAD,
    any_model,
    batch,
    circling_episode,
    random_presence,
    random_states,
    scene,
    spec,
)

BATCH, TIME, AGENTS, HORIZON, PLANS = 2, 4, 4, 3, 3
CLOSE: dict[str, Any] = {"rtol": 1e-4, "atol": 1e-4}


@cache
def _other(kind: str) -> Any:
    if kind == "constant-velocity":
        return ConstantVelocity(spec())
    if kind == "noisy":
        return NoisyConstantVelocity(spec(), 0.5, 1.0)
    if kind == "nearest-neighbour":
        return NearestNeighbour.fit([circling_episode(i) for i in range(3)], spec(), HORIZON)
    if kind == "residual":
        return GaussianResidual(any_model("dgvae"), np.eye(2 * HORIZON))
    name = {"dgvae-frozen": {"rollout_graph": "frozen"}, "dgvae-neighbours": {"num_neighbours": 2}}
    if kind in name:
        return any_model("dgvae").variant(**name[kind])
    torch.manual_seed(7)
    made = DGVAE(spec(), replace(PLURAL, num_neighbours=2, num_edge_types=3), HORIZON)
    with torch.no_grad():
        for parameter in made.parameters():
            parameter.mul_(1.7)
    return made.eval().requires_grad_(False)


WITHOUT_REACTION = ("constant-velocity", "noisy", "nearest-neighbour")
OTHERS = ("residual", "dgvae-frozen", "dgvae-neighbours", "dgvae-plural-neighbours")
EVERY = (*EVERY_MODEL, *WITHOUT_REACTION, *OTHERS)
REACTING = tuple(k for k in EVERY if k not in WITHOUT_REACTION and k not in ("lstm", "mlp"))
every_forecaster = pytest.mark.parametrize("kind", EVERY)


def made(kind: str) -> Any:
    return any_model(kind) if kind in EVERY_MODEL else _other(kind)


@cache
def precise(kind: str) -> Any:
    """In float64: large weights then do not amplify a sum in another order."""
    forecaster = deepcopy(made(kind))
    return forecaster.double() if isinstance(forecaster, torch.nn.Module) else forecaster


def observed(forecaster: Any, states: Tensor, valid: Tensor) -> Belief:
    memory = forecaster.empty_memory(states.shape[0], states.shape[2])
    with torch.no_grad():
        for now, present in zip(states.unbind(1), valid.unbind(1), strict=True):
            memory, belief = forecaster.observe(memory, now * present[..., None], present)
    return belief


def scenes(seed: int = 0, share: float = 1.0) -> tuple[Tensor, Tensor]:
    return 0.5 * random_states(seed, BATCH, TIME, AGENTS, 4), random_presence(seed, BATCH, TIME, AGENTS, share=share)


def plans_for(seed: int = 0, plans: int = PLANS) -> Tensor:
    return random_states(seed + 99, BATCH, plans, HORIZON, 4)


def noise() -> list[np.random.Generator]:
    return [np.random.default_rng(i) for i in range(BATCH)]


def map_futures(change: Callable[[Tensor], Tensor], futures: Futures) -> Futures:
    return Futures(*(None if t is None else change(t) for t in futures))


def assert_close(ours: Futures, expected: Futures, valid: Tensor) -> None:
    """Equal for the agents that are there; both with an axis of plans."""
    for name in Futures._fields:
        one, other = getattr(ours, name), getattr(expected, name)
        assert (one is None) == (other is None), name
        if one is not None:
            assert one.shape == other.shape
            there = valid[:, None, None].expand(one.shape[:4])
            torch.testing.assert_close(one[there], other[there], **CLOSE, msg=lambda m, n=name: f"{n}: {m}")


# --- The ego follows, the others react --------------------------------------------------------------------------------


@every_forecaster
@pytest.mark.parametrize("samples", [1, 3, 6])
def test_the_ego_follows_its_plan_whatever_the_forecaster(kind: str, samples: int):
    belief, plans = observed(made(kind), *scenes()), plans_for()
    futures = rollout_plans(made(kind), belief, plans, samples, noise())
    assert futures.states.shape == (BATCH, PLANS, samples, AGENTS, HORIZON, 4)
    assert torch.equal(futures.states[:, :, :, 0], plans[:, :, None].expand(-1, -1, samples, -1, -1))
    plain = made(kind).rollout(belief, HORIZON, samples, noise())
    for name in ("mode_probs", "scale"):
        one, other = getattr(futures, name), getattr(plain, name)
        assert (one is None) == (other is None)
        if one is not None:
            assert one.shape == (BATCH, PLANS, *other.shape[1:])
    if futures.scale is not None:
        assert not futures.scale[..., 0, :, :].any() and (futures.scale[..., 1:, :, :] > 0).all()
    if futures.mode_probs is not None and plain.mode_probs is not None:
        torch.testing.assert_close(futures.mode_probs, plain.mode_probs[:, None].expand_as(futures.mode_probs))


@every_forecaster
@pytest.mark.parametrize("gradients", [False, True])
def test_the_plan_that_the_model_itself_forecasts_changes_nothing(kind: str, gradients: bool):
    belief = observed(made(kind), *scenes())
    with torch.set_grad_enabled(gradients):
        single = made(kind).rollout(belief, HORIZON, 1)
        futures = rollout_plans(made(kind), belief, single.states[:, :, 0])
    assert_close(futures, map_futures(lambda t: t[:, None], single)._replace(scale=futures.scale), belief.valid)
    if futures.scale is not None and single.scale is not None:
        torch.testing.assert_close(futures.scale[:, 0, :, 1:], single.scale[:, :, 1:], **CLOSE)


@pytest.mark.parametrize("kind", REACTING)
def test_another_plan_changes_the_forecast_of_the_others(kind: str):
    states = rollout_plans(made(kind), observed(made(kind), *scenes()), plans_for()).states[:, :, 0, 1:]
    apart = (states[:, 0] - states[:, 1]).abs()
    assert apart[..., 1:, :].max() > 1e-2


@pytest.mark.parametrize("kind", [*WITHOUT_REACTION, "lstm", "mlp"])
def test_without_interactions_the_others_are_forecast_as_without_plans(kind: str):
    belief = observed(made(kind), *scenes())
    planned = rollout_plans(made(kind), belief, plans_for(), 3, noise()).states
    plain = made(kind).rollout(belief, HORIZON, 3, noise()).states[:, None].expand_as(planned)
    # products of other batch sizes are rounded differently on some processors
    torch.testing.assert_close(planned[..., 1:, :, :], plain[..., 1:, :, :], rtol=1e-5, atol=1e-5)


@every_forecaster
@pytest.mark.parametrize("samples", [1, 3])
def test_others_never_see_the_plan_before_it_happens(kind: str, samples: int):
    """The state of step h moves others at step h + 1, not earlier: no step of a plan is read ahead."""
    belief, plans = observed(made(kind), *scenes()), plans_for()
    before = rollout_plans(made(kind), belief, plans, samples, noise()).states
    for step in range(HORIZON):
        other = plans.clone()
        other[:, :, step:] += 3.0
        after = rollout_plans(made(kind), belief, other, samples, noise()).states
        assert torch.equal(after[..., 1:, : step + 1, :], before[..., 1:, : step + 1, :])
        if kind in REACTING and step == 0:  # messages may take a step through the sender's memory
            assert (after[..., 1:, step + 1 :, :] - before[..., 1:, step + 1 :, :]).abs().max() > 1e-3


# --- One semantics, however it is computed ----------------------------------------------------------------------------


@every_forecaster
@pytest.mark.parametrize("samples", [1, 3, 6])
def test_plans_of_one_batch_are_those_one_by_one(kind: str, samples: int):
    """Samples too: every plan is compared under the same noise."""
    belief, plans = observed(made(kind), *scenes(share=0.7)), plans_for()
    together = rollout_plans(made(kind), belief, plans, samples, noise())
    for plan in range(PLANS):
        alone = rollout_plans(made(kind), belief, plans[:, plan : plan + 1], samples, noise())
        picked = map_futures(lambda t, p=plan: t[:, p : p + 1], together)  # type: ignore[misc]
        assert_close(alone, picked, belief.valid)


@every_forecaster
def test_scenes_of_one_batch_are_those_one_by_one(kind: str):
    (states, valid), plans, forecaster = scenes(3, share=0.6), plans_for(), made(kind)
    together = rollout_plans(forecaster, observed(forecaster, states, valid), plans, 3, noise())
    for i in range(BATCH):
        belief = observed(forecaster, states[i : i + 1], valid[i : i + 1])
        alone = rollout_plans(forecaster, belief, plans[i : i + 1], 3, noise()[i : i + 1])
        assert_close(alone, map_futures(lambda t, i=i: t[i : i + 1], together), belief.valid)  # type: ignore[misc]


@pytest.mark.parametrize("kind", [k for k in EVERY if k.startswith("dgvae")])
@pytest.mark.parametrize("samples", [1, 3, 6])
@settings(max_examples=4)
@given(seed=st.integers(0, 2**16), share=st.sampled_from([0.6, 1.0]))
def test_single_steps_and_modules_agree(kind: str, samples: int, seed: int, share: float):
    """With gradients the modules compute, without them folded weights on lists."""
    belief, plans, found = observed(made(kind), *scenes(seed, share)), plans_for(seed), []
    for gradients in (False, True):
        with torch.set_grad_enabled(gradients):
            found.append(rollout_plans(made(kind), belief, plans, samples, noise()))
    assert_close(*found, belief.valid)


@pytest.mark.parametrize("kind", [k for k in EVERY if k not in ("lstm-joint", "residual")])  # fixed places; float32
@settings(max_examples=2)
@given(seed=st.integers(0, 2**16))
def test_padding_is_invisible_and_a_permutation_of_the_others_permutes(kind: str, seed: int):
    (states, valid), plans, forecaster = scenes(seed, 0.7), plans_for(seed), precise(kind)
    states, plans = states.double(), plans.double()
    plain = rollout_plans(forecaster, observed(forecaster, states, valid), plans)
    wide, there = states.new_full((BATCH, TIME, AGENTS + 2, 4), 7.0), torch.zeros(BATCH, TIME, AGENTS + 2).bool()
    order = torch.tensor([0, 4, 1, 5, 2])[:AGENTS]
    order[1:] = order[1:].flip(0)
    wide[:, :, order], there[:, :, order] = states, valid
    belief = observed(forecaster, wide, there)
    moved = rollout_plans(forecaster, belief, plans)
    probs = None if moved.mode_probs is None else moved.mode_probs[..., order]
    scale = None if moved.scale is None else moved.scale[..., order, :, :]
    assert_close(Futures(moved.states[..., order, :, :], probs, scale), plain, valid[:, -1])


@pytest.mark.parametrize("kind", ["dgvae", "dgvae-plural", "dgvae-frozen", "dnri"])
def test_forecasts_are_differentiable_by_the_plan(kind: str):
    belief, plans = observed(made(kind), *scenes()), plans_for().requires_grad_()
    with torch.enable_grad():
        states = rollout_plans(made(kind), belief, plans, 2, noise()).states
        states[..., 1:, :, :].square().sum().backward()
    assert plans.grad is not None and plans.grad[:, :, :-1].abs().amax((1, 2, 3)).min() > 0
    assert not plans.grad[:, :, -1].any()  # after the last step nothing follows


def test_draws_repeat_with_their_generator_and_differ():
    model, belief, plans = made("dgvae"), observed(made("dgvae"), *scenes()), plans_for()
    one, again, other = (
        rollout_plans(model, belief, plans, 4, torch.Generator().manual_seed(seed)).states for seed in (1, 1, 2)
    )
    assert torch.equal(one, again) and not torch.equal(one, other)
    assert (one[:, :, 1, 1:] - one[:, :, 2, 1:]).abs().max() > 1e-3


# --- Streams ----------------------------------------------------------------------------------------------------------


def world(x_m: float, agents: int = 3) -> Scene:
    return scene({i: (x_m + 5.0 * i, 4.0 * i, 20.0 + i, 0.5 * i) for i in range(agents)}, size=4)


def world_plans(x_m: float) -> np.ndarray:
    t = np.arange(1, HORIZON + 1)
    slow, fast = ([x_m + v * t, 0 * t, v + 0 * t, 0 * t] for v in (10.0, 30.0))
    return np.stack([np.stack(slow, -1), np.stack(fast, -1)])[None]


@cache
def road_model(plural: bool) -> DGVAE:
    torch.manual_seed(3)
    return DGVAE(spec(ROAD), PLURAL if plural else FAST_LIKE, HORIZON).eval().requires_grad_(False)


@pytest.mark.parametrize("plural", [False, True])
def test_plans_are_in_the_world_frame_and_a_shift_changes_nothing(plural: bool):
    found = []
    for x_m in (0.0, 10_000.0):
        online = OnlineForecaster(road_model(plural), 1, 4)
        for step in range(3):
            online.observe(batch(world(x_m + 20.0 * step)))
        found.append(online.forecast(None, 2, noise()[:1], world_plans(x_m + 40.0)))
    near, far = found
    assert near.num_plans == 2 and near.xy.shape == (1, 2, 2, 4, HORIZON, 2)
    torch.testing.assert_close(near.xy, far.xy, rtol=0, atol=1e-4)
    expected = world_plans(0.0)[..., :2]  # relative to the ego, which is at (0, 0) then
    np.testing.assert_allclose(near.xy[:, :, 0, 0].numpy(), expected, atol=1e-4)
    assert not near.xy[:, :, :, 3].any()  # padding
    assert (near.of_plan(0).xy - near.of_plan(1).xy)[:, :, 1:3].abs().max() > 1e-4
    assert near.of_plan(0).num_plans == 0 and near.without_first(1).xy.shape == (1, 2, 2, 3, HORIZON, 2)
    assert near.sample_probs().shape == (1, 2, 2, 4)


@pytest.mark.parametrize("kind", ["dgvae", "dgvae-plural", "dnri", "constant-velocity"])
def test_a_plan_leaves_history_and_later_forecasts_alone(kind: str):
    """Clamped, not leaked: asking what if is no observation."""
    asked, silent = (OnlineForecaster(made(kind), 1, 4) for _ in range(2))
    for step in range(3):
        for online in (asked, silent):
            online.observe(batch(world(5.0 * step)))
        asked.forecast(HORIZON, ego_plan=world_plans(0.0))
        ours, expected = (o.forecast(HORIZON, 3, noise()[:1]) for o in (asked, silent))
        assert torch.equal(ours.xy, expected.xy) and ours.num_plans == 0


def test_constant_features_of_a_plan_are_the_observed_ones():
    layout = replace(
        spec(),
        feature_names=(*spec().feature_names, "role"),
        feature_scales=(*spec().feature_scales, 1.0),
        constant_features=("role",),
    )
    torch.manual_seed(0)
    model = DGVAE(layout, FAST_LIKE, HORIZON).eval()
    states = torch.cat([random_states(0, 1, 1, 3, 4), torch.ones(1, 1, 3, 1)], -1)
    belief = observed(model, states, torch.ones(1, 1, 3).bool())
    plan = torch.cat([random_states(1, 1, 1, HORIZON, 4), torch.full((1, 1, HORIZON, 1), 5.0)], -1)
    before = deepcopy(plan)
    futures = rollout_plans(model, belief, plan)
    assert (futures.states[..., 4] == 1.0).all() and torch.equal(plan, before)


def test_agent_0_is_replaced():
    states, ego = torch.zeros(2, 3, 4, 5), torch.ones(2, 1, 5)
    found = with_ego(states, ego)
    assert found[..., 0, :].eq(1).all() and not found[..., 1:, :].any()


# --- Errors -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("plan", "message"),
    [
        (
            np.zeros((1, 2, HORIZON + 1, 4)),
            r"ego_plan needs the shape .* = \(1, at least 1, 3, 4\), got \(1, 2, 4, 4\)",
        ),
        (np.zeros((1, 0, HORIZON, 4)), "ego_plan needs the shape"),
        (np.zeros((2, 2, HORIZON, 4)), "ego_plan needs the shape"),
        (np.zeros((2, HORIZON, 4)), "ego_plan needs the shape"),
        (np.zeros((1, 2, HORIZON, 2)), "ego_plan needs the shape"),
        (np.full((1, 2, HORIZON, 4), np.nan), r"ego_plan must be finite and at most 1e\+30 in size, got NaN"),
        (np.full((1, 2, HORIZON, 4), 1e200), r"ego_plan must be finite and at most 1e\+30 in size, got NaN"),
    ],
)
@pytest.mark.parametrize("kind", ["dgvae", "constant-velocity"])
def test_plans_that_do_not_fit_are_refused(kind: str, plan: np.ndarray, message: str):
    online = OnlineForecaster(made(kind), 1, 4)
    online.observe(batch(world(0.0)))
    with pytest.raises(UserError, match=message):
        online.forecast(HORIZON, ego_plan=plan)


def test_what_a_forecaster_gives_for_plans_has_the_sizes_that_were_asked_for(monkeypatch: pytest.MonkeyPatch):
    online = OnlineForecaster(made("dgvae"), 1, 4)
    online.observe(batch(world(0.0)))
    given = DGVAE.rollout_plans

    def too_short(*arguments: Any, **named: Any) -> Futures:
        return Futures(given(*arguments, **named).states[..., :-1, :])

    monkeypatch.setattr(DGVAE, "rollout_plans", too_short)
    with pytest.raises(UserError, match="rollout_plans of a forecaster: states must have the shape"):
        online.forecast(HORIZON, ego_plan=np.zeros((1, 2, HORIZON, 4)))


def test_plans_count_where_a_forecast_would_not_fit_into_the_memory(monkeypatch: pytest.MonkeyPatch):
    online = OnlineForecaster(made("dgvae"), 1, 4)
    online.observe(batch(world(0.0)))
    monkeypatch.setattr(memory, "memory_bytes", lambda: 50_000)
    online.forecast(HORIZON, ego_plan=np.zeros((1, 2, HORIZON, 4)))
    with pytest.raises(UserError, match="a forecast with num_samples=1"):
        online.forecast(HORIZON, ego_plan=np.zeros((1, 2000, HORIZON, 4)))


def test_a_plan_needs_an_ego():
    absent = Scene(np.zeros((4, 4)), np.array([-1, 5, -1, -1]), np.array([False, True, False, False]))
    online = OnlineForecaster(made("dgvae"), 1, 4)
    online.observe(batch(absent))
    with pytest.raises(UserError, match="a plan needs the ego in the scene, but it is absent in scene 0"):
        online.forecast(ego_plan=world_plans(0.0))
    online = OnlineForecaster(ConstantVelocity(spec(has_ego=False)), 1, 4)
    online.observe(batch(world(0.0)))
    with pytest.raises(UserError, match="a plan needs an ego, but the scenes have none"):
        online.forecast(HORIZON, ego_plan=world_plans(0.0))


def test_a_plan_beyond_those_of_the_forecast_is_refused():
    online = OnlineForecaster(made("dgvae"), 1, 4)
    online.observe(batch(world(0.0)))
    with pytest.raises(UserError, match="plan must be from 0 to 1, the plans of this forecast, got 2"):
        online.forecast(ego_plan=world_plans(0.0)).of_plan(2)


def test_noise_that_was_fitted_to_fewer_steps_is_refused():
    belief = observed(made("residual"), *scenes())
    with pytest.raises(UserError, match="the noise was fitted to 3 steps, got horizon_steps=4"):
        rollout_plans(made("residual"), belief, torch.zeros(BATCH, 1, HORIZON + 1, 4))


@pytest.mark.parametrize("kind", ["dgvae", "dgvae-neighbours", "dgvae-frozen"])
def test_the_first_step_of_every_draw_is_that_without_plans(kind: str):
    """No plan can change it, so the memory that a roll-out begins with is the same."""
    belief, plans = observed(made(kind), *scenes()), plans_for()
    planned = rollout_plans(made(kind), belief, plans, 4, noise()).states[:, :, :, 1:, 0]
    plain = made(kind).rollout(belief, HORIZON, 4, noise()).states[:, None, :, 1:, 0].expand_as(planned)
    there = belief.valid[:, None, None, 1:].expand(planned.shape[:4])
    torch.testing.assert_close(planned[there], plain[there], **CLOSE)
