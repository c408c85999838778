"""What a user's reader is asked for and refused: bounds of perception, names as ids, positions in space."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from envs.readers import FunctionReader, reader_for, register_reader
from envs.readers.base import bounded, build_reader
from envs.readers.identity import agent_ids
from envs.wrappers import ForecastObservation, SceneObservation
from predictor.baselines.constant_velocity import ConstantVelocity
from predictor.scene import KINEMATIC_FEATURES_3D, Scene, SceneSpec
from predictor.support.errors import UserError
from tests.envs.semantics import Crowd, read_crowd
from tests.envs.testing.test_check_reader import SPEC

READER = FunctionReader(read_crowd, SPEC)


class Near(Crowd):
    """Crowd with a registered reader."""


class Fixed:
    """Reader that derives from nothing."""

    spec = SPEC

    def __init__(self, env: Any) -> None:
        """Nothing to keep."""

    def reset(self) -> None:
        """Nothing to forget."""

    def read(self, env: Any) -> Scene:
        return READER(env).read(env)

    def read_all(self, env: Any) -> Scene:
        return read_crowd(env)


def seen(env: Any) -> np.ndarray:
    env.reset(seed=0)
    scene = env.scene
    return np.linalg.norm(scene.states[scene.valid, :2] - scene.states[0, :2], axis=1)


def test_bounds_hold_for_function_readers():
    everyone = seen(SceneObservation(Crowd(), reader=READER))
    assert len(everyone) == 5 and everyone.max() > 10
    near = SceneObservation(Crowd(), perception_m=10.0, max_agents=3, reader=READER)
    assert near.scene_spec.max_agents == 3 and near.observation_space["scene_ids"].shape == (3,)  # type: ignore[index]
    assert len(seen(near)) <= 3 and seen(near).max() <= 10
    forecasts = ForecastObservation(Crowd(), "constant-velocity", reader=READER, max_agents=4)
    assert forecasts.observation_space["agents"].shape[0] == 3  # type: ignore[index]


def test_bounds_hold_for_registered_readers():
    register_reader(Near, READER)
    assert reader_for(Near(), 7.0).spec == replace(SPEC, perception_m=7.0)
    assert reader_for(Near()).spec == SPEC  # the next one is not bounded
    assert seen(SceneObservation(Near(), max_agents=2)).shape == (2,)


def test_what_the_forecaster_was_trained_with_bounds_them_too():
    forecaster = ConstantVelocity(replace(SPEC, max_agents=3, perception_m=9.0))
    env = ForecastObservation(Crowd(), forecaster, reader=READER)
    assert env.get_wrapper_attr("scene_spec").max_agents == 3
    assert seen(env).max() <= 9


def test_a_reader_that_cannot_be_bounded_is_named():
    with pytest.raises(UserError, match=r"Fixed sets what the ego perceives itself, so max_agents=3 has no effect"):
        SceneObservation(Crowd(), max_agents=3, reader=Fixed)
    assert seen(SceneObservation(Crowd(), max_agents=SPEC.max_agents, reader=Fixed)).shape == (5,)
    small = ConstantVelocity(replace(SPEC, max_agents=3))
    assert seen(ForecastObservation(Crowd(), small, reader=Fixed)).shape == (5,)  # nobody asked for 3


def test_a_bound_out_of_range_is_named():
    with pytest.raises(UserError, match="max_agents must be a whole number from 1 to 65,536"):
        bounded(READER(None), None, 0)


def test_positions_in_space_are_refused_at_once():
    spec = SceneSpec(0.5, ("world",) * 3, KINEMATIC_FEATURES_3D, (1.0,) * 6)
    with pytest.raises(UserError, match="FunctionReader: environments need positions in a plane, got 3 axes; give x_m"):
        build_reader(FunctionReader(read_crowd, spec), Crowd())


def test_names_have_numbers():
    numbers = agent_ids(["car_1", "car_2", "car_1"])
    assert numbers.dtype == np.int64 and numbers[0] == numbers[2] != numbers[1]
    assert (agent_ids([str(i) for i in range(2000)]) >= 0).all()
    assert len(set(agent_ids([str(i) for i in range(2000)]).tolist())) == 2000
    assert agent_ids([]).shape == (0,)
    assert agent_ids(["car_1"])[0] == numbers[0]


def test_names_as_ids_are_told_what_to_do():
    names: Any = ["a", "b"]
    scene = replace(Scene(np.zeros((2, 4)), agent_ids(names), np.ones(2, dtype=bool)))
    object.__setattr__(scene, "ids", np.array(names))
    with pytest.raises(UserError, match=r"ids must be a NumPy array of integers .* got <U1 \(2,\); agent_ids\(names\)"):
        scene.check("mine", SPEC)
