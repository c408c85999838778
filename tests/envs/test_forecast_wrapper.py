"""The family of wrappers: one signature, the same attributes, flat observations, copies and pickles that continue."""

import pickle
from collections.abc import Callable
from copy import deepcopy
from functools import cache, partial
from inspect import signature
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from pettingzoo import ParallelEnv
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecMonitor

from envs.forecast_wrapper import ForecastWrapper
from envs.parallel import ForecastParallelEnv
from envs.readers import FunctionReader
from envs.sb3.forecast import VecForecast
from envs.vector import VectorForecast
from envs.wrappers import ForecastObservation, SceneObservation
from predictor.scene import Scene, SceneSpec
from predictor.support.errors import ProtocolError, UserError
from tests.envs.helpers import assert_same, tiny_model
from tests.envs.test_parallel import WORLD, Toy, ToyReader

COMMON = ("checkpoint", "horizon_steps", "num_samples", "flatten", "device", "forecaster", "seed", "reader")
FAMILY = (ForecastObservation, ForecastParallelEnv, VecForecast, VectorForecast)
SPEC = SceneSpec(dt_s=1.0, perception_m=60.0, max_agents=5)
BODIES, EPISODE, ENVS = 4, 4, 3


class Walkers(gym.Env[np.ndarray, int]):
    """Bodies on random walks; the first one is the ego."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (2, 2), np.float64)
    action_space = gym.spaces.Discrete(3)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.states, self.t = self.np_random.normal(size=(BODIES, 4)) * 5, 0
        return self.states[:2, :2].copy(), {}

    def step(self, action: int) -> tuple[np.ndarray, float, bool, bool, dict]:
        self.t += 1
        self.states = self.states + self.np_random.normal(size=(BODIES, 4)) + action
        return self.states[:2, :2].copy(), float(self.t), self.t >= EPISODE, False, {}


def read_walkers(env: gym.Env) -> Scene:
    return Scene(env.unwrapped.states, 7 + np.arange(BODIES), np.ones(BODIES, dtype=np.bool_), 0.3)  # type: ignore[attr-defined]


READER = FunctionReader(read_walkers, SPEC)


def walkers() -> SceneObservation:
    return SceneObservation(Walkers(), reader=READER)


@cache
def network(has_ego: bool = True) -> Any:
    return tiny_model(SPEC if has_ego else WORLD)


def single(**options: Any) -> ForecastObservation:
    return ForecastObservation(Walkers(), **{"reader": READER, "forecaster": network(), **options})


def several(**options: Any) -> ForecastParallelEnv:
    return ForecastParallelEnv(Toy(), **{"reader": ToyReader, "forecaster": network(False), **options})


def sb3(**options: Any) -> VecForecast:
    return VecForecast(DummyVecEnv([walkers] * ENVS), **{"forecaster": network(), **options})


def vector(mode: AutoresetMode = AutoresetMode.SAME_STEP, **options: Any) -> VectorForecast:
    env = SyncVectorEnv([walkers] * ENVS, autoreset_mode=mode)
    return VectorForecast(env, **{"forecaster": network(), **options})


MAKERS: dict[str, Callable[..., Any]] = {"single": single, "parallel": several, "sb3": sb3, "vector": vector}
every_wrapper = pytest.mark.parametrize("make", MAKERS.values(), ids=MAKERS)


def begin(env: Any) -> Any:
    if isinstance(env, VecForecast):
        env.seed(3)
        return env.reset()
    return env.reset(seed=3)[0]


def step(env: Any, action: int) -> Any:
    """The next observation; what closes an episode comes with it."""
    if isinstance(env, VecForecast):
        obs, _, _, infos = env.step(np.full(ENVS, action))
        return [obs, *(info["terminal_observation"] for info in infos if "terminal_observation" in info)]
    if isinstance(env, VectorForecast):
        obs, _, _, _, infos = env.step(np.full(ENVS, action))
        return [obs, *(one for one in infos.get("final_obs", ()) if one is not None)]
    if isinstance(env, ParallelEnv):
        return env.step(dict.fromkeys(env.agents, 1))[0] if env.agents else env.reset()[0]
    obs, _, terminated, _, _ = env.step(action)
    return env.reset()[0] if terminated else obs


def play(env: Any, steps: int) -> list[Any]:
    return [step(env, action % 3) for action in range(steps)]


def assert_equal(actual: Any, expected: Any) -> None:
    if isinstance(expected, list):
        assert len(actual) == len(expected)
        for one, other in zip(actual, expected, strict=True):
            assert_equal(one, other)
    elif isinstance(expected, dict) and expected and all(isinstance(value, dict) for value in expected.values()):
        assert list(actual) == list(expected)
        for key in expected:
            assert_equal(actual[key], expected[key])
    else:
        assert_same(actual, expected, tolerance=0.0)


# --- One signature ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("wrapper", FAMILY, ids=lambda wrapper: wrapper.__name__)
def test_all_take_the_same_arguments_with_the_same_defaults(wrapper: type):
    parameters = signature(wrapper).parameters
    first = signature(ForecastObservation).parameters
    assert [name for name in parameters if name in COMMON] == list(COMMON)
    for name in COMMON:
        assert parameters[name].default == first[name].default
        assert parameters[name].kind == first[name].kind
    assert issubclass(wrapper, ForecastWrapper)


@every_wrapper
def test_scene_and_forecast_are_there_after_a_reset(make: Callable[..., Any]):
    env = make(num_samples=2, horizon_steps=4)
    for name in ("scene", "forecast"):
        with pytest.raises(ProtocolError, match=f"there is no {name} yet; call reset"):
            getattr(env, name)
    begin(env)
    entries = 1 if isinstance(env, ForecastObservation | ForecastParallelEnv) else ENVS
    assert env.forecast.xy.shape[:2] == (entries, 2)
    assert env.forecast.xy.shape[3:] == (4, 2)
    assert env.scene is not None
    assert env.forecaster is (network(False) if isinstance(env, ForecastParallelEnv) else network())


@every_wrapper
def test_a_seed_of_the_samples_can_be_given(make: Callable[..., Any]):
    def samples(**options: Any) -> np.ndarray:
        env = make(num_samples=3, **options)
        if isinstance(env, VecForecast):
            env.venv.seed(0)
            env.reset()
        elif isinstance(env, VectorForecast | ForecastObservation):
            env.env.reset(seed=0)
            env.reset()
        else:
            env.env._rng = np.random.default_rng(0)
            env.reset()
        return env.forecast.xy.numpy()

    first, again, other = samples(seed=1), samples(seed=1), samples(seed=2)
    np.testing.assert_array_equal(first, again)
    np.testing.assert_array_equal(first[:, 0], other[:, 0])
    assert (first != other).any()
    np.testing.assert_array_equal(samples(), samples(seed=0))


@every_wrapper
def test_a_checkpoint_and_a_forecaster_are_one_too_many(make: Callable[..., Any]):
    with pytest.raises(UserError, match="a checkpoint or a forecaster, not both .checkpoint 'highway'"):
        make(checkpoint="highway")


@every_wrapper
def test_a_forecaster_that_does_not_fit_is_named(make: Callable[..., Any]):
    misfit = tiny_model(SceneSpec(dt_s=0.2))
    with pytest.raises(UserError, match="the forecaster was trained at dt_s=0.2 but env '.*' steps at dt_s=1"):
        make(forecaster=misfit)


@pytest.mark.parametrize("make", [sb3, vector], ids=["sb3", "vector"])
def test_a_reader_for_environments_that_report_scenes_is_refused(make: Callable[..., Any]):
    with pytest.raises(UserError, match="takes no reader: its environments report their scenes.* to SceneObservation"):
        make(reader=READER)


# --- What the attributes hold at an episode's end ---------------------------------------------------------------------


@pytest.mark.parametrize("make", [sb3, vector], ids=["sb3", "vector"])
def test_scene_and_forecast_are_those_of_the_observation_shown(make: Callable[..., Any]):
    """Every environment ends at the same step, where the stream forecasts two scenes of each."""
    env, alone = make(num_samples=2), [single(num_samples=2) for _ in range(ENVS)]
    begin(env)
    for i, one in enumerate(alone):
        one.reset(seed=3 + i)
    ended = 0
    for t in range(2 * EPISODE + 1):
        shown = step(env, t % 3)
        ended += len(shown) > 1
        for i, one in enumerate(alone):
            obs = step(one, t % 3)
            assert_same({key: value[i] for key, value in shown[0].items()}, obs)
            assert_same(env.forecast.xy[i].numpy(), one.forecast.xy[0].numpy())
            np.testing.assert_array_equal(env.scene.states[i], one.scene.states)
        assert len(env.forecast.xy) == len(env.scene) == ENVS
    assert ended == 2


# --- One Box ----------------------------------------------------------------------------------------------------------


@every_wrapper
def test_a_flat_observation_is_the_dict_in_one_box(make: Callable[..., Any]):
    nested, flat = make(num_samples=2), make(num_samples=2, flatten=True)
    pairs = [(begin(nested), begin(flat)), *zip(play(nested, EPISODE + 1), play(flat, EPISODE + 1), strict=True)]
    for full, box in pairs:
        if isinstance(nested, ForecastParallelEnv):
            for agent, observation in full.items():
                space = flat.observation_space(agent)
                assert isinstance(space, gym.spaces.Box) and box[agent] in space
                assert_same(box[agent], gym.spaces.flatten(nested.observation_space(agent), observation), 0.0)
            continue
        if isinstance(nested, ForecastObservation):
            assert isinstance(flat.observation_space, gym.spaces.Box) and box in flat.observation_space
            assert_same(box, gym.spaces.flatten(nested.observation_space, full), 0.0)
            continue
        one = getattr(nested, "single_observation_space", nested.observation_space)
        full, box = (full, box) if isinstance(full, list) else ([full], [box])
        stacked, *closing = full
        expected = [gym.spaces.flatten(one, {k: v[i] for k, v in stacked.items()}) for i in range(ENVS)]
        np.testing.assert_array_equal(box[0], np.stack(expected))
        assert box[0].dtype == getattr(flat, "single_observation_space", flat.observation_space).dtype
        for actual, last in zip(box[1:], closing, strict=True):
            np.testing.assert_array_equal(actual, gym.spaces.flatten(one, last))


def test_an_own_observation_that_counts_is_flattened_as_gymnasium_does():
    class Counting(Walkers):
        observation_space = gym.spaces.Discrete(9)

        def reset(self, **options: Any) -> tuple[Any, dict]:
            super().reset(**options)
            return 2, {}

    env = SyncVectorEnv([partial(SceneObservation, Counting(), reader=READER)] * 1)
    flat = VectorForecast(env, forecaster=network(), flatten=True)
    obs, _ = flat.reset(seed=0)
    assert obs in flat.observation_space
    assert obs.shape[1] == flat.single_observation_space.shape[0]  # type: ignore[index]


# --- Copies and pickles -----------------------------------------------------------------------------------------------


def pickled(env: Any) -> Any:
    return pickle.loads(pickle.dumps(env))


@every_wrapper
@pytest.mark.parametrize("samples", [1, 5])
@pytest.mark.parametrize("again", [deepcopy, pickled])
def test_a_copy_continues_exactly(make: Callable[..., Any], samples: int, again: Callable[[Any], Any]):
    env = make(num_samples=samples)
    begin(env)
    play(env, 2)
    copy = again(env)
    expected = play(env, 2 * EPISODE)  # over an episode's end
    assert_equal(play(copy, 2 * EPISODE), expected)


@every_wrapper
def test_a_copy_that_goes_another_way_leaves_the_original_alone(make: Callable[..., Any]):
    env, undisturbed = make(num_samples=5), make(num_samples=5)
    for each in (env, undisturbed):
        begin(each)
        play(each, 2)
    copy = deepcopy(env)
    begin(copy)
    play(copy, 3)
    assert_equal(play(env, 3), play(undisturbed, 3))


@every_wrapper
def test_a_copy_shares_the_network_and_a_pickle_carries_it(make: Callable[..., Any]):
    env = make()
    begin(env)
    assert deepcopy(env).forecaster is env.forecaster
    carried = pickled(env).forecaster
    assert carried is not env.forecaster
    for name, tensor in env.forecaster.state_dict().items():
        assert (carried.state_dict()[name] == tensor).all()


@every_wrapper
def test_a_pickle_that_was_not_reset_yet_works(make: Callable[..., Any]):
    env = make(num_samples=5)
    copy = pickled(env)
    assert_equal(begin(copy), begin(env))


def test_the_forecaster_a_copy_was_given_is_not_doubled():
    env = single()
    copy = deepcopy(env)
    assert copy._saved_kwargs["forecaster"] is env._saved_kwargs["forecaster"] is env.forecaster


@pytest.mark.parametrize("again", [deepcopy, pickled])
def test_a_copy_around_a_monitor_continues_and_counts(again: Callable[[Any], Any]):
    def episodes(venv: VecEnv, steps: int) -> list[Any]:
        infos = [info for _ in range(steps) for info in venv.step(np.ones(ENVS, dtype=int))[3]]
        return [(info["episode"]["r"], info["episode"]["l"]) for info in infos if "episode" in info]

    env = VecForecast(VecMonitor(VecMonitor(DummyVecEnv([walkers] * ENVS))), forecaster=network())
    env.seed(0)
    env.reset()
    assert not episodes(env, 2)
    copy = again(env)
    assert (
        isinstance(copy.venv.venv, VecMonitor) and copy.venv is not env.venv and copy.get_attr("t") == env.get_attr("t")
    )
    assert episodes(copy, EPISODE) == episodes(env, EPISODE) != []


@pytest.mark.parametrize("mode", list(AutoresetMode), ids=lambda mode: mode.name)
def test_a_copy_of_a_vector_environment_continues_in_every_mode(mode: AutoresetMode):
    env = vector(mode, num_samples=5)
    begin(env)
    play(env, EPISODE - 1 if mode is AutoresetMode.DISABLED else EPISODE)
    copy = deepcopy(env)
    assert_equal(play(copy, 1), play(env, 1))
    if mode is AutoresetMode.DISABLED:
        masks = [{"reset_mask": np.array([True, False, True])} for _ in range(2)]
        obs, again = (each.reset(options=mask)[0] for each, mask in zip((env, copy), masks, strict=True))
        assert_equal(again, obs)
