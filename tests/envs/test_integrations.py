"""An environment of one's own with a reader of one's own, through the ways in which libraries make environments."""

import importlib
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv

import envs.readers
from envs.readers import MakeReader, register_reader
from envs.readers.entities import EntityRowsReader
from envs.readers.function import FunctionReader
from envs.sb3.forecast import VecForecast
from envs.vector import VectorForecast
from envs.wrappers import ForecastObservation, SceneObservation
from predictor.scene import Scene, SceneSpec
from tests.envs.helpers import assert_same, save_tiny

SPEC = SceneSpec(dt_s=0.5, perception_m=50.0, max_agents=4)
AGENTS, STEPS = 5, 8
DURATIONS = (3, 5)
COLUMNS = ("x", "y", "vx", "vy")


class Plaza(gym.Env):
    """An ego among walkers on accelerated paths; an episode ends after `duration` steps. Another one at each reset."""

    metadata = {"render_modes": ["rgb_array"]}
    observation_space = gym.spaces.Box(-1000, 1000, (AGENTS, 4), np.float64)
    action_space = gym.spaces.Box(-1, 1, (2,), np.float32)

    def __init__(self, duration: int = 3, render_mode: str | None = None) -> None:
        self.duration = duration

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.time = 0
        self.states = np.concatenate(
            [self.np_random.permutation(AGENTS)[:, None] * 9.0, self.np_random.normal(size=(AGENTS, 3))], axis=1
        )
        self.push = self.np_random.uniform(-1, 1, (AGENTS, 2))
        return self.states.copy(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        self.time += 1
        self.push[0] = action
        self.states[:, :2] += self.states[:, 2:] * SPEC.dt_s + self.push * SPEC.dt_s**2 / 2
        self.states[:, 2:] += self.push * SPEC.dt_s
        return self.states.copy(), 1.0, self.time == self.duration, False, {}


def read_plaza(env: gym.Env) -> Scene:
    states = env.unwrapped.states
    return Scene(states.copy(), np.arange(len(states)) + 10, np.ones(len(states), dtype=np.bool_))


ASKED = FunctionReader(read_plaza, SPEC)
SHOWN = EntityRowsReader(COLUMNS, SPEC, gate_m=3.0)
READERS = {"function": ASKED, "entities": SHOWN}


@pytest.fixture(autouse=True)
def plaza(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(envs.readers, "_REGISTERED", {})
    gym.register("Plaza-v0", f"{__name__}:Plaza")
    yield
    del gym.registry["Plaza-v0"]


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> str:
    return save_tiny(tmp_path_factory.mktemp("checkpoints") / "tiny-plaza", SPEC)


def actions(i: int) -> np.ndarray:
    return np.random.default_rng(i).uniform(-1, 1, (STEPS, 2)).astype(np.float32)


def alone(duration: int, reader: MakeReader, checkpoint: str, i: int, idle_steps: bool = False) -> list[Any]:
    """Returns (observation, closing observation or None) of each step of an environment, played by one wrapper."""
    env = ForecastObservation(Plaza(duration), checkpoint, reader=reader)
    shown: list[Any] = [(env.reset(seed=i)[0], None)]
    fresh = False
    for action in actions(i):
        if fresh:
            shown.append((env.reset()[0], None))
            fresh = False
            continue
        obs, _, terminated, _, _ = env.step(action)
        if terminated and not idle_steps:
            shown.append((env.reset()[0], obs))
        else:
            shown.append((obs, None))
            fresh = terminated
    return shown


def one_of(observations: Mapping[str, Any], i: int) -> dict[str, Any]:
    return {key: value[i] for key, value in observations.items()}


# --- gymnasium.make ---------------------------------------------------------------------------------------------------


def rollout(env: gym.Env) -> list[Any]:
    found = [env.reset(seed=3)[0]]
    for action in actions(0)[:3]:
        found.append(env.step(action)[0])
    return found


@pytest.mark.parametrize("reader", READERS)
def test_make_wraps_with_a_reader_and_its_spec_makes_the_same_again(reader: str, checkpoint: str):
    wrapper = ForecastObservation.wrapper_spec(checkpoint=checkpoint, num_samples=2, reader=READERS[reader])
    env = gym.make(replace(gym.spec("Plaza-v0"), additional_wrappers=(wrapper,)))
    again = gym.make(env.spec)
    by_hand = ForecastObservation(Plaza(), checkpoint, num_samples=2, reader=READERS[reader])
    assert env.spec == again.spec
    for first, second, want in zip(rollout(env), rollout(again), rollout(by_hand), strict=True):
        assert_same(first, want, 0.0)
        assert_same(second, want, 0.0)


def test_a_registered_reader_keeps_the_spec_text(checkpoint: str):
    """Nothing callable is in the spec, so that it survives JSON."""
    register_reader(Plaza, ASKED)
    spec = replace(gym.spec("Plaza-v0"), additional_wrappers=(ForecastObservation.wrapper_spec(checkpoint=checkpoint),))
    again = EnvSpec.from_json(spec.to_json())
    for obs, want in zip(
        rollout(gym.make(again)), rollout(ForecastObservation(Plaza(), checkpoint, reader=ASKED)), strict=True
    ):
        assert_same(obs, want, 0.0)


# --- gymnasium's vector environments ----------------------------------------------------------------------------------


def make_one(duration: int, reader: MakeReader) -> gym.Env:
    return SceneObservation(Plaza(duration), reader=reader)


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
@pytest.mark.parametrize("reader", READERS)
def test_vector_envs_are_as_if_alone(reader: str, mode: AutoresetMode, checkpoint: str):
    makers = [partial(make_one, duration, READERS[reader]) for duration in DURATIONS]
    idle = mode is AutoresetMode.NEXT_STEP
    wanted = [alone(duration, READERS[reader], checkpoint, i, idle) for i, duration in enumerate(DURATIONS)]
    env = VectorForecast(SyncVectorEnv(makers, autoreset_mode=mode), checkpoint)
    obs, infos = env.reset(seed=[0, 1])
    closings = 0
    for step in range(STEPS + 1):
        for i, shown in enumerate(wanted):
            assert_same(one_of(obs, i), shown[step][0])
            if shown[step][1] is not None:
                assert_same(infos["final_obs"][i], shown[step][1])
                closings += 1
        if step < STEPS:
            obs, _, _, _, infos = env.step(np.stack([actions(i)[step] for i in range(len(DURATIONS))]))
    assert closings == (0 if idle else 3)


# Python 3.12 warns of every fork of a process with threads; that it works is what is tested.
@pytest.mark.filterwarnings("ignore:.*use of fork.. may lead to deadlocks:DeprecationWarning")
def test_each_worker_process_has_its_own_reader(checkpoint: str):
    makers = [partial(make_one, duration, SHOWN) for duration in DURATIONS]
    vector = AsyncVectorEnv(makers, autoreset_mode=AutoresetMode.SAME_STEP, context="fork")
    wanted = [alone(duration, SHOWN, checkpoint, i) for i, duration in enumerate(DURATIONS)]
    env = VectorForecast(vector, checkpoint)
    try:
        obs, _ = env.reset(seed=[0, 1])
        for step in range(4):
            for i, shown in enumerate(wanted):
                assert_same(one_of(obs, i), shown[step][0])
            obs, *_ = env.step(np.stack([actions(i)[step] for i in range(len(DURATIONS))]))
    finally:
        env.close()


# --- Stable-Baselines3 ------------------------------------------------------------------------------------------------


def check_sb3_envs(venv: VecEnv, reader: MakeReader, checkpoint: str, duration: int = 3) -> None:
    """Environments, and what closes their episodes, are as if alone."""
    wanted = [alone(duration, reader, checkpoint, i) for i in range(venv.num_envs)]
    try:
        venv.seed(0)
        obs: Any = venv.reset()
        infos: Any = [{}] * venv.num_envs
        for step in range(STEPS + 1):
            for i, shown in enumerate(wanted):
                assert_same(one_of(obs, i), shown[step][0])
                if shown[step][1] is not None:
                    assert_same(infos[i]["terminal_observation"], shown[step][1])
            if step < STEPS:
                obs, _, _, infos = venv.step(np.stack([actions(i)[step] for i in range(venv.num_envs)]))
    finally:
        venv.close()


@pytest.mark.slow
@pytest.mark.parametrize("kind", [DummyVecEnv, partial(SubprocVecEnv, start_method="spawn")], ids=["dummy", "spawn"])
def test_sb3_takes_it_as_a_wrapper_class(kind: Callable[..., VecEnv], checkpoint: str):
    """One wrapper in each environment; the reader travels to the worker process with its arguments."""
    kwargs = {"checkpoint": checkpoint, "reader": SHOWN}
    count = 2 if kind is DummyVecEnv else 1
    venv = make_vec_env(Plaza, count, wrapper_class=ForecastObservation, wrapper_kwargs=kwargs, vec_env_cls=kind)
    check_sb3_envs(venv, SHOWN, checkpoint)


@pytest.mark.parametrize("reader", READERS)
def test_sb3_shares_one_forward(reader: str, checkpoint: str):
    kwargs = {"reader": READERS[reader]}
    venv = make_vec_env("Plaza-v0", n_envs=2, wrapper_class=SceneObservation, wrapper_kwargs=kwargs)
    check_sb3_envs(VecForecast(venv, checkpoint), READERS[reader], checkpoint)


@pytest.mark.parametrize(("flatten", "policy"), [(False, "MultiInputPolicy"), (True, "MlpPolicy")])
def test_sb3_learns(flatten: bool, policy: str, checkpoint: str):
    kwargs = {"checkpoint": checkpoint, "flatten": flatten, "reader": ASKED}
    venv = make_vec_env("Plaza-v0", n_envs=2, wrapper_class=ForecastObservation, wrapper_kwargs=kwargs, seed=0)
    model = PPO(policy, venv, n_steps=4, batch_size=4, n_epochs=1, policy_kwargs={"net_arch": [4]}, device="cpu")
    assert model.learn(16).num_timesteps == 16


# --- rl-baselines3-zoo ------------------------------------------------------------------------------------------------


def zoo_wrapper(entry: Any) -> Callable[[Any], Any]:
    """What the zoo makes of its keys env_wrapper and vec_env_wrapper: dotted names, with arguments or without."""
    steps = []
    for item in entry if isinstance(entry, list) else [entry]:
        ((name, kwargs),) = item.items() if isinstance(item, Mapping) else [(item, {})]
        module, _, attribute = name.rpartition(".")
        steps.append(partial(getattr(importlib.import_module(module), attribute), **kwargs))

    def wrap(env: Any) -> Any:
        for step in steps:
            env = step(env)
        return env

    return wrap


def zoo_envs(settings: Mapping[str, Any]) -> VecEnv:
    """In the zoo's order: each environment is wrapped, then all of them."""
    spec = gym.spec("Plaza-v0")
    venv = make_vec_env(
        lambda **kwargs: spec.make(**kwargs), n_envs=2, wrapper_class=zoo_wrapper(settings["env_wrapper"])
    )
    return zoo_wrapper(settings["vec_env_wrapper"])(venv) if "vec_env_wrapper" in settings else venv


def test_the_zoo_wraps_each_environment(checkpoint: str):
    register_reader(Plaza, ASKED)
    venv = zoo_envs({"env_wrapper": {"envs.wrappers.ForecastObservation": {"checkpoint": checkpoint}}})
    check_sb3_envs(venv, ASKED, checkpoint)


def test_the_zoo_stacks_wrappers(checkpoint: str):
    register_reader(Plaza, ASKED)
    entry = ["envs.wrappers.SceneObservation", {"envs.wrappers.ForecastObservation": {"checkpoint": checkpoint}}]
    check_sb3_envs(zoo_envs({"env_wrapper": entry}), ASKED, checkpoint)


def test_the_zoo_wraps_all_of_them_at_once(checkpoint: str):
    register_reader(Plaza, ASKED)
    settings = {
        "env_wrapper": "envs.wrappers.SceneObservation",
        "vec_env_wrapper": {"envs.sb3.forecast.VecForecast": {"checkpoint": checkpoint}},
    }
    venv = zoo_envs(settings)
    assert isinstance(venv, VecForecast)
    check_sb3_envs(venv, ASKED, checkpoint)


def test_the_guides_zoo_settings_make_an_environment():
    """The page's YAML, with a checkpoint that exists."""
    yaml = pytest.importorskip("yaml")
    guide = (Path(__file__).resolve().parents[2] / "docs" / "wrap_your_env.md").read_text()
    (text,) = re.findall(r"^```yaml\n(.*?)^```$", guide, flags=re.MULTILINE | re.DOTALL)
    (settings,) = yaml.safe_load(text.replace("runs/crossing/checkpoint", "constant-velocity")).values()
    register_reader(Plaza, ASKED)
    venv = zoo_envs(settings)
    assert venv.observation_space["forecast"].shape == (SPEC.max_agents - 1, 5, 2)
    assert settings["policy"] == "MultiInputPolicy"
