"""What each wrapper says to an environment of another wrapper's kind, and to one that begins episodes by itself."""

from collections.abc import Callable
from copy import deepcopy
from typing import Any

import gymnasium as gym
import pytest
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv
from gymnasium.wrappers import Autoreset, TimeLimit
from stable_baselines3.common.vec_env import DummyVecEnv

from envs.parallel import ForecastParallelEnv
from envs.readers import FunctionReader
from envs.sb3.forecast import VecForecast
from envs.vector import VectorForecast
from envs.wrappers import ForecastObservation, SceneObservation
from predictor.support.errors import UserError
from tests.envs.dict_crowd import DictCrowd
from tests.envs.semantics import Crowd, Swarm, read_crowd
from tests.envs.testing.test_check_reader import SPEC

READER = FunctionReader(read_crowd, SPEC)


def scenes() -> SceneObservation:
    return SceneObservation(DictCrowd())


class Pool(gym.Env, gym.vector.VectorEnv):
    """An environment of both classes, as EnvPool's are."""

    num_envs = 1


def with_forecasts() -> ForecastObservation:
    return ForecastObservation(Crowd(), "constant-velocity", reader=READER, flatten=True)


WRONG: dict[str, tuple[Any, Callable[[], Any], str]] = {
    "class": (ForecastObservation, lambda: Crowd, r"one gymnasium env.*got the class Crowd; make .*: Crowd\(...\)"),
    "id": (SceneObservation, lambda: "Crossing-v0", r"got the text 'Crossing-v0'; make .* with gym.make\(...\)"),
    "PettingZoo": (ForecastObservation, Swarm, r"the PettingZoo environment Swarm; use ForecastParallelEnv"),
    "scenes of PettingZoo": (SceneObservation, Swarm, r"the PettingZoo environment Swarm; use ForecastParallelEnv"),
    "vector": (
        ForecastObservation, lambda: SyncVectorEnv([scenes]), "gymnasium vector environment Sync.*use VectorForecast",
    ),
    "SB3": (
        ForecastObservation, lambda: DummyVecEnv([scenes]), "the Stable-Baselines3 environment Dummy.*use VecForecast",
    ),
    "nothing": (ForecastObservation, lambda: 3, "got int; derive the environment from that class, or convert it"),
    "single in vector": (VectorForecast, scenes, r"VectorEnv, .*the single environment .*; use ForecastObservation"),
    "SB3 in vector": (VectorForecast, lambda: DummyVecEnv([scenes]), "Stable-Baselines3 .*; use VecForecast"),
    "vector in SB3": (VecForecast, lambda: SyncVectorEnv([scenes]), r"VecEnv \(make_vec_env\), .*; use VectorForecast"),
    "single in SB3": (VecForecast, scenes, "the single environment SceneObservation; use ForecastObservation"),
    "single in PettingZoo": (ForecastParallelEnv, Crowd, "a PettingZoo parallel env, .*Crowd; use ForecastObservation"),
    "EnvPool": (ForecastObservation, lambda: Pool(), r"got Pool, a pool of EnvPool's; make it with gym.make"),
    "EnvPool in vector": (VectorForecast, lambda: Pool(), "got Pool, a pool of EnvPool's; make it with gym.make"),
    "PettingZoo's class": (ForecastParallelEnv, lambda: Swarm, r"got the class Swarm; make an environment of it"),
}  # fmt: skip


@pytest.mark.unchecked
@pytest.mark.parametrize("case", WRONG)
def test_the_right_wrapper_is_named(case: str):
    wrapper, make, message = WRONG[case]
    more = {} if wrapper is SceneObservation else {"checkpoint": "constant-velocity"}
    with pytest.raises(UserError, match=f"^{wrapper.__name__} wraps .*{message}"):
        wrapper(make(), **more)


def test_autoreset_inside_would_leak_histories_and_is_refused():
    advice = "begins episodes in step.*; put Autoreset around {0}, or use VectorForecast"
    inside: Any = TimeLimit(Autoreset(Crowd()), 5)
    for wrap in (SceneObservation, ForecastObservation):
        with pytest.raises(UserError, match=f"^{wrap.__name__} must see each reset, .*{advice.format(wrap.__name__)}"):
            wrap(inside, reader=READER)
    with pytest.raises(UserError, match="^ForecastObservation must see each reset"):
        ForecastObservation(Autoreset(scenes()), "constant-velocity")


def test_autoreset_around_begins_with_an_empty_history():
    env: Any = Autoreset(ForecastObservation(Crowd(duration=2), "constant-velocity", reader=READER))
    first, _ = env.reset(seed=0)
    for _ in range(2):
        *_, over, _ = env.step(env.action_space.sample())
    assert over
    opened, *_ = env.step(env.action_space.sample())
    assert isinstance(env.unwrapped, gym.Env) and env.unwrapped.time == 0
    assert opened["forecast"].shape == first["forecast"].shape


def test_vector_wrappers_say_in_gymnasiums_words_how_to_make_scenes():
    plain, shown = SyncVectorEnv([DictCrowd]), SyncVectorEnv([with_forecasts])
    with pytest.raises(UserError, match=r"make them with gym.make_vec\(id, num_envs, wrappers=\[SceneObservation\]\)"):
        VectorForecast(plain, "constant-velocity")
    with pytest.raises(UserError, match=r"got Box observations without them; make them with gym.make_vec"):
        VectorForecast(shown, "constant-velocity")
    with pytest.raises(UserError, match=r"with wrappers=\[functools.partial\(SceneObservation, reader=...\)\] of gym"):
        VectorForecast(SyncVectorEnv([scenes]), "constant-velocity", reader=READER)
    with pytest.raises(UserError, match=r"make them with make_vec_env\(..., wrapper_class=SceneObservation\)"):
        VecForecast(DummyVecEnv([DictCrowd]), "constant-velocity")


def test_environments_in_other_processes_cannot_be_copied_and_go_on():
    env = VectorForecast(AsyncVectorEnv([scenes, scenes]), "constant-velocity")
    env.reset(seed=0)
    with pytest.raises(UserError, match=r"in processes of their own .AsyncVectorEnv. cannot be copied; use SyncV"):
        deepcopy(env)
    env.step(env.action_space.sample())
    env.close()
