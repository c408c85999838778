import pickle
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import envs.readers
from envs.readers import reader_for, register_reader
from envs.readers.base import Reader, build_reader
from envs.readers.function import FunctionReader
from envs.wrappers import ForecastObservation, SceneObservation
from predictor.scene import PADDING_ID, Scene, SceneSpec
from predictor.support.errors import ProtocolError, UserError
from tests.envs.helpers import NamedReader, play

SPEC = SceneSpec(dt_s=0.5, perception_m=10.0, max_agents=3)


class Parade(gym.Env):
    """Each agent walks straight on; the ego stands, turned by a quarter."""

    observation_space = gym.spaces.Box(-1, 1, (1,), np.float64)
    action_space = gym.spaces.Discrete(1)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict]:
        self.states = np.array([[0, 0, 0, 0], [4, 0, 0, 2], [-3, 0, 1, 0], [0, 6, 0, 0], [99, 0, 0, 0]], np.float64)
        return np.zeros(1), {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict]:
        self.states[:, :2] += self.states[:, 2:] * SPEC.dt_s
        return np.zeros(1), 0.0, False, False, {}


class GrandParade(Parade):
    pass


def read_parade(env: gym.Env) -> Scene:
    states = env.unwrapped.states
    return Scene(states.copy(), np.array([7, 3, 9, 4, 5]), np.ones(5, dtype=np.bool_), np.pi / 2)


def bare_read(env):
    return read_parade(env)


PARADE = FunctionReader(read_parade, SPEC)


@pytest.fixture
def unregistered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(envs.readers, "_REGISTERED", {})


def test_the_ego_perceives_the_nearest_agents():
    env = SceneObservation(Parade(), reader=PARADE)
    obs, _ = env.reset()
    assert obs["scene_ids"].tolist() == [7, 9, 3]
    assert obs["scene_states"][:, 0].tolist() == [0, -3, 4]
    assert env.reader.read_all(env).ids.tolist() == [7, 3, 9, 4, 5]
    assert env.scene_spec is SPEC
    assert env.scene.heading_rad == np.pi / 2


def test_perception_ends_where_the_spec_says():
    obs, _ = SceneObservation(
        Parade(), reader=FunctionReader(read_parade, SceneSpec(dt_s=0.5, perception_m=4.0))
    ).reset()
    assert obs["scene_ids"].tolist() == [7, 9, 3] + [PADDING_ID] * 9


def test_forecasts_are_in_the_egos_axes():
    env = ForecastObservation(Parade(), "constant-velocity", reader=PARADE)
    steps = play(env, [0, 0], seed=0)
    np.testing.assert_allclose(steps[0][0]["forecast"][1, :2], [[1, -4], [2, -4]], atol=1e-5)  # agent 3: world (4, 1)
    first, second = steps[0][0]["forecast"][1, 1], steps[2][0]["agents"]
    assert any(np.allclose(first, agent[:2], atol=1e-5) for agent in second)


def test_each_env_has_a_reader_of_its_own():
    first, second = PARADE(Parade()), PARADE(Parade())
    assert isinstance(first, Reader)
    assert first is not second


def test_registered_it_needs_no_option(unregistered: None):
    with pytest.raises(UserError, match="no scene reader knows Parade"):
        reader_for(Parade())
    register_reader(Parade, PARADE)
    for env in (Parade(), GrandParade(), gym.wrappers.TimeLimit(Parade(), 3)):
        obs, _ = ForecastObservation(env, "constant-velocity").reset()
        assert obs["valid"].tolist() == [1, 1]


def test_it_can_be_pickled():
    again = pickle.loads(pickle.dumps(PARADE))
    assert again == PARADE
    assert SceneObservation(Parade(), reader=again).reset()[0]["scene_ids"].tolist() == [7, 9, 3]


@pytest.mark.parametrize(("read", "spec"), [(SPEC, read_parade), ("read", SPEC), (read_parade, 0.5)])
def test_what_is_no_function_or_no_spec_is_named(read: Any, spec: Any):
    got = f"got {type(read).__name__} and {type(spec).__name__}"
    maker = object.__new__(FunctionReader)  # the shape checks of these tests would be faster than the constructor
    vars(maker).update(read=read, spec=spec)
    with pytest.raises(UserError, match=r"needs a function read\(env\) -> Scene and a SceneSpec, " + got):
        maker.__post_init__()


def test_the_function_is_named_in_errors():
    def read_nothing(env: gym.Env) -> Any:
        return None

    def read_twins(env: gym.Env) -> Scene:
        return Scene(np.zeros((2, 4)), np.array([1, 1]), np.ones(2, dtype=np.bool_))

    with pytest.raises(UserError, match=r"read_nothing: reading must give a Scene \(predictor.scene\), got NoneType"):
        SceneObservation(Parade(), reader=FunctionReader(read_nothing, SPEC)).reset()
    with pytest.raises(UserError, match=r"read_twins: ids must be unique within a scene, got \[1, 1\]"):
        SceneObservation(Parade(), reader=FunctionReader(read_twins, SPEC)).reset()


# --- What else may be passed as reader= -------------------------------------------------------------------------------

ADVICE = r"for a function that reads a scene, give FunctionReader\({}, SceneSpec\(dt_s=...\)\)"


def without_spec(env: Any) -> Any:
    return NamedReader(env)


def broken_maker(env: Any) -> Reader:
    raise UserError("my own words")


def early(env: Any) -> Reader:
    raise ProtocolError("call reset() first")


@pytest.mark.parametrize("wrapper", [SceneObservation, ForecastObservation])
@pytest.mark.parametrize(
    ("reader", "message"),
    [
        (read_parade, "but read_parade gives a Scene; " + ADVICE.format("read_parade")),
        (bare_read, "but bare_read failed with AttributeError: .*'states'; " + ADVICE.format("bare_read")),
        (
            lambda env: Scene(np.zeros((1, 4)), np.zeros(1, int), np.ones(1, bool)),
            "gives Scene without spec, reset, read",
        ),
        (lambda env: None, "gives NoneType without spec, reset, read"),
        (without_spec, "without_spec: the spec of a reader must be a SceneSpec, got Parade; a class of one's own"),
        (early, "early failed with ProtocolError: call reset.. first"),
        (broken_maker, "^my own words$"),
    ],
    ids=["annotated", "bare", "scene", "nothing", "no_spec", "too_early", "own_words"],
)
def test_what_makes_no_reader_is_named(wrapper: type[gym.Wrapper], reader: Any, message: str):
    arguments = {} if wrapper is SceneObservation else {"checkpoint": "constant-velocity"}
    with pytest.raises(UserError, match=message):
        wrapper(Parade(), reader=reader, **arguments)


class Headless(Reader):
    def read_all(self, env: Any) -> Scene:
        return read_parade(env)


def test_a_class_that_makes_no_reader_is_told_what_it_needs():
    with pytest.raises(UserError, match="Headless gives .*Headless needs read_all"):
        build_reader(type("Headless", (Headless,), {"__init__": lambda self, env: None}), Parade())


def test_a_function_that_takes_no_environment_is_named():
    with pytest.raises(UserError, match="read_nowhere must take the environment and nothing else"):

        def read_nowhere() -> Scene:
            raise AssertionError

        FunctionReader(read_nowhere, SPEC)  # type: ignore[arg-type]


def test_a_module_is_no_reader():
    with pytest.raises(UserError, match="'tests.envs.own_code' must name a function or class as module:name"):
        build_reader("tests.envs.own_code", Parade())


def test_a_reader_in_place_of_its_class_is_named():
    with pytest.raises(UserError, match="reader= takes what makes a reader, .*got an object of NamedReader"):
        build_reader(NamedReader(SPEC), Parade())
