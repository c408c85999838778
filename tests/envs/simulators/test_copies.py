"""Copies and pickles of running environments continue exactly where the original is."""

import copy
import pickle
from collections.abc import Callable
from typing import Any

import cloudpickle
import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils import EzPickle

from envs.parallel import ForecastParallelEnv
from envs.readers import EntityRowsReader, FunctionReader
from envs.registry import make_env, make_multiagent_env
from envs.wrappers import ForecastObservation, SceneObservation
from predictor.scene import Scene, SceneSpec
from predictor.support.errors import UserError

Observed = dict[str, Any]
WAYS: dict[str, Callable[[Any], Any]] = {
    "deepcopy": copy.deepcopy,
    "pickle": lambda env: pickle.loads(pickle.dumps(env)),
    "cloudpickle": lambda env: pickle.loads(cloudpickle.dumps(env)),
}
"""Ways to copy; SuperSuit's concat_vec_envs uses the last."""
KINEMATICS = ("presence", "x", "y", "vx", "vy")
SPEC = SceneSpec(dt_s=1.0, max_agents=5, perception_m=60.0)


def read_vehicles(env: gym.Env) -> Scene:
    """Reads vehicles, numbered by their place in the list; at the top of the module, so that it can be pickled."""
    road, ego = env.unwrapped.road, env.unwrapped.vehicle  # type: ignore[attr-defined]
    vehicles = [ego, *(v for v in road.vehicles if v is not ego)]
    states = np.array([[*v.position, *v.velocity] for v in vehicles], dtype=np.float64)
    return Scene(states, np.arange(len(vehicles)), np.ones(len(vehicles), dtype=np.bool_), float(ego.heading))


class Walkers(gym.Env, EzPickle):
    """Walks at random; pickles by itself as a new environment, like mpe2's."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (4,), np.float64)
    action_space = gym.spaces.Discrete(2)

    def __init__(self) -> None:
        EzPickle.__init__(self)
        self.states = np.zeros((3, 4))

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.states = self.np_random.normal(size=(3, 4))
        return self.states[0].copy(), {}

    def step(self, action: int) -> tuple[np.ndarray, float, bool, bool, dict]:
        self.states += self.np_random.normal(size=(3, 4)) + action
        return self.states[0].copy(), 0.0, False, False, {}


def read_walkers(env: gym.Env) -> Scene:
    states: np.ndarray = env.unwrapped.states  # type: ignore[attr-defined]
    return Scene(states.copy(), np.arange(3), np.ones(3, dtype=np.bool_))


def entity_rows() -> gym.Env:
    config = {"observation": {"type": "Kinematics", "absolute": True, "normalize": False, "clip": False}}
    env = make_env("highway-fast-v0", config=config)
    return SceneObservation(env, reader=EntityRowsReader(KINEMATICS, SPEC))


EGO: dict[str, Callable[[], gym.Env]] = {
    **{
        env_id: lambda env_id=env_id: SceneObservation(make_env(env_id))  # type: ignore[misc]
        for env_id in (
            "highway-fast-v0",
            "roundabout-v1",
            "intersection-v2",
            "racetrack-v1",
            "highway-mixed-v0",
            "intersection-mixed-v0",
        )
    },
    "function": lambda: SceneObservation(make_env("highway-fast-v0"), reader=FunctionReader(read_vehicles, SPEC)),
    "entity-rows": entity_rows,
    "ez-pickle": lambda: SceneObservation(Walkers(), reader=FunctionReader(read_walkers, SPEC)),
    "forecasts": lambda: ForecastObservation(make_env("roundabout-v1"), "roundabout", num_samples=3),
}
MULTIAGENT = {
    "simple_tag_v3": "simple-tag",
    "simple_spread_v3": "constant-velocity",
    "collect_treasure_v1": "constant-velocity",
    "pursuit_v5": "constant-velocity",
    "intersection-multi-agent-v2": "intersection",
}
"""PettingZoo id → checkpoint."""


def ego_steps(env: gym.Env, steps: int, seed: int) -> list[Observed]:
    """Observations of some steps with the same actions; a finished episode is followed by an unseeded one."""
    rng, observed = np.random.default_rng(seed), []
    for _ in range(steps):
        space = env.action_space
        action = int(rng.integers(space.n)) if isinstance(space, gym.spaces.Discrete) else rng.uniform(-0.3, 0.3, 1)
        seen, reward, terminated, truncated, _ = env.step(np.asarray(action, dtype=space.dtype)[()])
        observed.append({**seen, "reward": np.array(reward)})
        if terminated or truncated:
            observed.append(env.reset()[0])
    return observed


def all_agents_steps(env: ForecastParallelEnv, steps: int, seed: int) -> list[Observed]:
    rng, observed = np.random.default_rng(seed), []
    for _ in range(steps):
        if not env.agents:
            env.reset()
        actions = {agent: int(rng.integers(env.action_space(agent).n)) for agent in env.agents}
        seen = env.step(actions)[0]
        scene = {"ids": env.scene.scene.ids, "states": env.scene.scene.states}
        observed.append({**scene, **{f"{agent} {key}": seen[agent][key] for agent in seen for key in seen[agent]}})
    return observed


def assert_equal(found: list[Observed], expected: list[Observed]) -> None:
    assert len(found) == len(expected)
    for step, (one, other) in enumerate(zip(found, expected, strict=True)):
        assert one.keys() == other.keys()
        for key in one:
            np.testing.assert_array_equal(one[key], other[key], err_msg=f"step {step}: {key}")


@pytest.mark.slow
@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("name", EGO)
def test_a_copy_of_a_running_environment_continues_exactly(name: str, way: str):
    env = EGO[name]()
    env.reset(seed=3)
    ego_steps(env, 3, seed=0)
    copied, again = WAYS[way](env), WAYS[way](env)
    expected = ego_steps(env, 10, seed=1)
    assert_equal(ego_steps(copied, 10, seed=1), expected)
    assert_equal(ego_steps(WAYS[way](again), 10, seed=1), expected)  # a copy of a copy, after the original went on


@pytest.mark.slow
@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("env_id", MULTIAGENT)
def test_a_copy_of_a_running_multiagent_environment_continues_exactly(env_id: str, way: str):
    env = ForecastParallelEnv(make_multiagent_env(env_id), MULTIAGENT[env_id])
    env.reset(seed=3)
    all_agents_steps(env, 3, seed=0)
    copied, again = WAYS[way](env), WAYS[way](env)
    expected = all_agents_steps(env, 10, seed=1)
    assert_equal(all_agents_steps(copied, 10, seed=1), expected)
    assert_equal(all_agents_steps(WAYS[way](again), 10, seed=1), expected)


def test_a_copy_of_an_environment_that_was_not_reset_can_be_reset():
    for make in (EGO["roundabout-v1"], EGO["ez-pickle"]):
        env = make()
        copied = copy.deepcopy(env)
        np.testing.assert_array_equal(copied.reset(seed=1)[0]["scene_states"], env.reset(seed=1)[0]["scene_states"])


def test_a_running_envpool_environment_says_that_it_cannot_be_copied():
    pytest.importorskip("envpool")
    env = SceneObservation(make_env("envpool/HighwayFast-v0"))
    fresh = copy.deepcopy(env)
    first = env.reset(seed=1)[0]
    np.testing.assert_array_equal(fresh.reset(seed=1)[0]["scene_states"], first["scene_states"])
    for way in WAYS.values():
        with pytest.raises(UserError, match="a running EnvPool environment cannot be copied or pickled .*HighwayFast"):
            way(env)
