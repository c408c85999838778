"""Inputs in each frame, and next states from each residual, in closed form."""

import inspect
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from predictor.layers.state_codec import Residual, StateCodec, drift
from predictor.scene import KINEMATIC_FEATURES, KINEMATIC_FEATURES_3D, AxisFrame, SceneSpec
from predictor.support.errors import UserError
from tests.predictor.helpers import random_presence, random_states, spec

SCALES_3D = (10.0, 10.0, 2.0, 5.0, 5.0, 4.0)
# Two present agents and an absent one, whose values must not matter.
PLANE = [[30.0, 5.0, 10.0, 0.0], [40.0, -5.0, 5.0, -5.0], [900.0, 900.0, 9.0, 9.0]]
SPACE = [[30.0, 5.0, 1.0, 10.0, 0.0, 2.0], [40.0, -5.0, 3.0, 5.0, -5.0, -4.0], [900.0] * 6]
PRESENT = torch.tensor([True, True, False])


def codec(*frame: AxisFrame, has_ego: bool = False, residual: Residual = "state", dt_s: float = 0.5) -> StateCodec:
    """Scales 10 m and 5 m/s in the plane; in space the third axis has its own; deltas 1, 2, 3, …"""
    if len(frame) == 3:
        layout = SceneSpec(dt_s, frame, KINEMATIC_FEATURES_3D, SCALES_3D, has_ego)
    else:
        layout = spec(frame, has_ego, dt_s=dt_s)
    deltas = tuple(float(i + 1) for i in range(layout.num_features))
    return StateCodec(layout, deltas, residual).double()


# --- Inputs -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("frame", "expected"),
    [
        (("world", "world"), [[3.0, 0.5, 2.0, 0.0], [4.0, -0.5, 1.0, -1.0]]),
        (("ego", "world"), [[0.0, 0.5, 2.0, 0.0, 1.0], [1.0, -0.5, 1.0, -1.0, 0.0]]),
        (("ego", "ego"), [[0.0, 0.0, 2.0, 0.0, 1.0], [1.0, -1.0, 1.0, -1.0, 0.0]]),
        (("centroid", "centroid"), [[-0.5, 0.5, 2.0, 0.0], [0.5, -0.5, 1.0, -1.0]]),
        (("world", "centroid"), [[3.0, 0.5, 2.0, 0.0], [4.0, -0.5, 1.0, -1.0]]),
        (("ego", "centroid"), [[0.0, 0.5, 2.0, 0.0, 1.0], [1.0, -0.5, 1.0, -1.0, 0.0]]),
    ],
    ids=lambda value: "-".join(value) if isinstance(value, tuple) else "",
)
def test_inputs_in_the_plane(frame: tuple[AxisFrame, AxisFrame], expected: list[list[float]]):
    coded = codec(*frame, has_ego="ego" in frame)
    states = torch.tensor(PLANE).double()
    expected = [*expected, [0.0] * len(expected[0])]
    assert coded.num_inputs == len(expected[0])
    assert coded.inputs(states, PRESENT).tolist() == expected
    several = coded.inputs(states.expand(2, 3, 3, 4), PRESENT.expand(2, 3, 3))
    assert torch.equal(several, torch.tensor(expected).double().expand_as(several))


@pytest.mark.parametrize(
    ("frame", "expected"),
    [
        (("world", "world", "world"), [[3.0, 0.5, 0.5, 2.0, 0.0, 0.5], [4.0, -0.5, 1.5, 1.0, -1.0, -1.0]]),
        (("centroid", "centroid", "centroid"), [[-0.5, 0.5, -0.5, 2.0, 0.0, 0.5], [0.5, -0.5, 0.5, 1.0, -1.0, -1.0]]),
        (("ego", "world", "centroid"), [[0.0, 0.5, -0.5, 2.0, 0.0, 0.5, 1.0], [1.0, -0.5, 0.5, 1.0, -1.0, -1.0, 0.0]]),
    ],
    ids=["world", "centroid", "each_its_own"],
)
def test_inputs_in_space(frame: Any, expected: list[list[float]]):
    coded = codec(*frame, has_ego="ego" in frame)
    assert coded.num_inputs == len(expected[0])
    assert coded.inputs(torch.tensor(SPACE).double(), PRESENT).tolist() == [*expected, [0.0] * len(expected[0])]


def test_features_beyond_the_kinematic_ones_are_scaled_only():
    layout = SceneSpec(
        1.0, ("centroid", "world"), (*KINEMATIC_FEATURES, "heading_rad"), (10.0, 10.0, 5.0, 5.0, 2.0), False
    )
    states = torch.tensor([[30.0, 5.0, 10.0, 0.0, 1.0], [40.0, -5.0, 5.0, -5.0, -1.0]])
    assert StateCodec(layout).inputs(states, torch.ones(2).bool()).tolist() == [
        [-0.5, 0.5, 2.0, 0.0, 0.5],
        [0.5, -0.5, 1.0, -1.0, -0.5],
    ]


def test_without_agents_there_is_no_centroid_and_no_input():
    inputs = codec("centroid", "centroid").inputs(torch.tensor(PLANE).double(), torch.zeros(3).bool())
    assert torch.equal(inputs, torch.zeros(3, 4).double())


@settings(max_examples=10)
@given(seed=st.integers(0, 2**16), offset=st.tuples(st.floats(-100, 100), st.floats(-100, 100)))
def test_centroid_frame_knows_no_place_and_no_absentee(seed: int, offset: tuple[float, float]):
    """Every scene of a batch is centred on its own agents."""
    coded = codec("centroid", "centroid")
    states, valid = random_states(seed, 5, 4, 4).double(), random_presence(seed, 5, 4, ego=False)
    inputs = coded.inputs(states, valid)
    for scene, present, ours in zip(states, valid, inputs, strict=True):
        if present.any():
            centred = scene[present, :2] - scene[present, :2].mean(0)
            torch.testing.assert_close(ours[present, :2], centred / 10.0)
            torch.testing.assert_close(ours[present, :2].sum(0), torch.zeros(2).double())
    elsewhere = states.clone()
    elsewhere[..., :2] += torch.tensor(offset).double()
    elsewhere[~valid] = 1e6
    torch.testing.assert_close(coded.inputs(elsewhere, valid), inputs)


# --- Next states ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("residual", "x_m", "y_m"),
    # x: 1 + 0.5·1, y: 2 + 1·2; vx: 3 + 0·3, vy: 4 + 0.5·4; dt 0.5
    [("state", 1.5, 4.0), ("constant_velocity", 1.5 + 1.5, 4.0 + 2.0), ("trapezoid", 1.5 + 1.5, 4.0 + 2.5)],
)
def test_next_state_closed_form(residual: Residual, x_m: float, y_m: float):
    state, change = torch.tensor([1.0, 2.0, 3.0, 4.0]).double(), torch.tensor([0.5, 1.0, 0.0, 0.5]).double()
    assert codec("world", "world", residual=residual).advance(state, change).tolist() == [x_m, y_m, 3.0, 6.0]


@pytest.mark.parametrize(
    ("residual", "moved"),
    [("state", [0.0, 0.0, 0.0]), ("constant_velocity", [1.0, 2.0, 3.0]), ("trapezoid", [1.0, 2.0, 4.5])],
)
def test_next_state_in_space(residual: Residual, moved: list[float]):
    """At 2, 4 and 6 m/s for half a second; the third velocity grows by 6 m/s."""
    state = torch.tensor([10.0, 20.0, 30.0, 2.0, 4.0, 6.0]).double()
    change = torch.tensor([0.0, 0.0, 0.0, 0.0, 0.0, 1.0]).double()
    after = codec("world", "world", "world", residual=residual).advance(state, change)
    assert (after - state).tolist() == [*moved, 0.0, 0.0, 6.0]


@pytest.mark.parametrize("residual", ["state", "constant_velocity", "trapezoid"])
def test_nothing_but_the_change_moves_other_features(residual: Residual):
    layout = SceneSpec(0.5, feature_names=(*KINEMATIC_FEATURES, "heading_rad"), feature_scales=(1.0,) * 5)
    coded = StateCodec(layout, (1.0, 1.0, 1.0, 1.0, 0.25), residual)
    after = coded.advance(torch.tensor([0.0, 0.0, 3.0, 4.0, 1.0]), torch.tensor([0.0, 0.0, 0.0, 0.0, 2.0]))
    assert after[2:].tolist() == [3.0, 4.0, 1.5]


def in_steps(residual: Residual, velocity_change: float, position_change: float, steps: int) -> Tensor:
    """From x = 1 m at 2 m/s, one step of 0.5 s taken in equal parts with the same rate of change throughout."""
    coded = codec("world", "world", residual=residual)
    state = torch.tensor([1.0, 0.0, 2.0, 0.0]).double()
    change = torch.tensor([position_change, 0.0, velocity_change / 3.0, 0.0], dtype=torch.float64)  # in units of 3 m/s
    for _ in range(steps):
        state = coded.advance(state, change, 1 / steps)
    return state


@settings(max_examples=12)
@given(acceleration=st.floats(-20, 20), steps=st.integers(1, 5))
def test_parts_of_a_step_under_constant_acceleration_are_exact(acceleration: float, steps: int):
    """x = x₀ + v₀ t + a t²/2, however many parts; so the trapezoid is not Euler's rule."""
    after = in_steps("trapezoid", 0.5 * acceleration, 0.0, steps)
    expected = [1.0 + 2.0 * 0.5 + acceleration * 0.125, 0.0, 2.0 + 0.5 * acceleration, 0.0]
    assert after.tolist() == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize(
    ("residual", "x_m"),
    # two halves at 2 m/s and 4 m/s for 0.25 s each; the second one's velocity is what the first one led to
    [("state", 1.0), ("constant_velocity", 1.0 + 0.5 + 1.0), ("trapezoid", 1.0 + 0.75 + 1.25)],
)
def test_halves_of_a_step(residual: Residual, x_m: float):
    assert in_steps(residual, 4.0, 0.0, 2).tolist() == pytest.approx([x_m, 0.0, 6.0, 0.0])


def test_parts_of_a_position_change_add_up():
    assert in_steps("state", 0.0, 3.0, 4).tolist() == pytest.approx([4.0, 0.0, 2.0, 0.0])


def test_drift_looks_ahead_for_the_trapezoid_only():
    states, after = torch.tensor([[0.0, 0.0, 2.0, 4.0]]), torch.tensor([[9.0, 9.0, 4.0, 0.0]])
    assert drift(spec(dt_s=0.5), "state", states, after).tolist() == [[0.0, 0.0]]
    assert drift(spec(dt_s=0.5), "constant_velocity", states, after).tolist() == [[1.0, 2.0]]
    assert drift(spec(dt_s=0.5), "trapezoid", states, after, 0.5).tolist() == [[0.75, 0.5]]


def test_feature_scales_stand_in_for_delta_scales():
    after = StateCodec(spec()).advance(torch.zeros(4), torch.ones(4))
    assert after.tolist() == [10.0, 10.0, 5.0, 5.0]


def test_nothing_is_learned_or_saved():
    coded = StateCodec(spec())
    assert not list(coded.parameters()) and not coded.state_dict()


# --- Refusals ---------------------------------------------------------------------------------------------------------


def test_delta_scales_must_fit_the_features():
    with pytest.raises(UserError, match=r"delta_scales needs 4 positive numbers, got \(1.0, 2.0\)"):
        StateCodec(spec(), (1.0, 2.0))
    space = SceneSpec(1.0, ("world",) * 3, KINEMATIC_FEATURES_3D, (1.0,) * 6)
    with pytest.raises(UserError, match=r"delta_scales needs 6 positive numbers, got \(1.0, 2.0, 3.0, 4.0\)"):
        StateCodec(space, (1.0, 2.0, 3.0, 4.0))


@pytest.mark.parametrize("wrong", [0.0, -1.0, float("inf"), float("nan")])
@pytest.mark.parametrize("name", ["delta_scales", "input_scales"])
def test_scales_must_be_positive_and_finite(name: str, wrong: float):
    scales: dict[str, Any] = {name: (1.0, wrong, 1.0, 1.0)}
    with pytest.raises(UserError, match=rf"{name} needs 4 positive numbers, got \(1.0, {wrong}, 1.0, 1.0\)"):
        StateCodec(spec(), **scales)


def test_unknown_residuals_are_refused():
    unchecked: Any = inspect.unwrap(StateCodec.__init__)  # shape checks would refuse it first
    with pytest.raises(UserError, match="residual must be 'state', 'constant_velocity' or 'trapezoid', got 'midpoint'"):
        unchecked(StateCodec.__new__(StateCodec), spec(), (), "midpoint")


def test_constant_features_are_given_but_never_predicted():
    """A role stays what it is, whatever a network says of its change."""
    names = (*KINEMATIC_FEATURES, "role", "size_m")
    layout = SceneSpec(dt_s=1.0, feature_names=names, feature_scales=(1.0,) * 6, constant_features=("role",))
    codec = StateCodec(layout)
    states = torch.tensor([[1.0, 2.0, 3.0, 4.0, 1.0, 0.5]])
    after = codec.advance(states, torch.ones_like(states))
    assert after.tolist() == [[2.0, 3.0, 4.0, 5.0, 1.0, 1.5]]
    assert codec.inputs(states, torch.ones(1, dtype=torch.bool))[0, 4] == 1.0


def test_constant_features_lie_beyond_velocity():
    with pytest.raises(UserError, match="constant_features must be among the features beyond velocity, got"):
        SceneSpec(dt_s=1.0, constant_features=("vx_mps",))
