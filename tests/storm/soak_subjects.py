"""What a soak steps: `VecForecast`, `ForecastParallelEnv` and EnvPool's vector environment; agents come and go."""

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
from pettingzoo import ParallelEnv
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from envs.parallel import ForecastParallelEnv
from envs.readers.base import MultiagentScene, pad_multiagent_scene
from envs.readers.function import FunctionReader
from envs.sb3.agents_as_rows import ParallelVecEnv
from envs.sb3.envpool import EnvPoolVecEnv
from envs.sb3.forecast import VecForecast
from envs.wrappers import SceneObservation
from predictor.checkpoint import load_checkpoint
from predictor.scene import Scene, SceneSpec

HORIZON = 2
"""Number of steps to forecast: only observing keeps memory, and short forecasts leave more time for it."""
PEERS = 6
"""Number of agents that the multiagent field may hold."""
_FIELD = SceneSpec(dt_s=1.0, frame=("world", "world"), has_ego=False, perception_m=200.0, max_agents=PEERS)


class Field(ParallelEnv):
    """Agents that drift, die and join at random; a new life has a new number."""

    metadata: dict[str, Any] = {"name": "soak_field", "render_modes": []}
    render_mode = None

    def __init__(self) -> None:
        self.possible_agents = [f"peer_{i}" for i in range(PEERS)]
        self.agents: list[str] = []
        self._space, self._actions = gym.spaces.Box(-np.inf, np.inf, (1,), np.float32), gym.spaces.Discrete(2)
        self._rng, self._lives = np.random.default_rng(0), 0

    def observation_space(self, agent: str) -> gym.Space:
        return self._space

    def action_space(self, agent: str) -> gym.Space:
        return self._actions

    def make_scene_reader(self) -> "FieldReader":
        return FieldReader()

    def reset(self, seed: int | None = None, options: Any = None) -> tuple[dict[str, Any], dict[str, Any]]:
        if seed is not None:
            self._rng = np.random.default_rng(seed)
        self.states: dict[str, np.ndarray] = {}
        self.ids: dict[str, int] = {}
        self.agents = []
        self._join(self.possible_agents[:3])
        self.seen = list(self.agents)
        return self._observed(self.seen), {agent: {} for agent in self.seen}

    def step(self, actions: dict[str, Any]) -> tuple[dict[str, Any], ...]:
        for state in self.states.values():
            state[:2] += state[2:]
        over = bool(self._rng.random() < 0.03)
        acted = list(self.agents)
        ended = {agent: over or bool(self._rng.random() < 0.1) for agent in acted}
        self.seen = acted
        observations, infos = self._observed(acted), {agent: {} for agent in acted}
        self.agents = [agent for agent in acted if not ended[agent]]
        if not over and self.agents:
            away = [a for a in self.possible_agents if a not in acted and self._rng.random() < 0.2]
            for agent in away:
                self.states.pop(agent, None)
            self._join(away)
            self.seen = acted + away
            observations = self._observed(self.seen)
        nothing = dict.fromkeys(acted, False)
        return observations, dict.fromkeys(acted, 0.0), ended, nothing, infos

    def _join(self, names: list[str]) -> None:
        for name in names:
            self.states[name] = self._rng.normal(size=4) * (20.0, 20.0, 1.0, 1.0)
            self.ids[name], self._lives = self._lives, self._lives + 1
        self.agents = [agent for agent in self.possible_agents if agent in names or agent in self.agents]

    def _observed(self, names: list[str]) -> dict[str, Any]:
        return {agent: np.zeros(1, np.float32) for agent in names}


class Churning(gym.Env):
    """Road on which some agents vanish at each step and others appear, with ids never used before."""

    observation_space = gym.spaces.Box(-1, 1, (1,), np.float32)
    action_space = gym.spaces.Discrete(2)

    def __init__(self, agents: int, replaced: float) -> None:
        """Sets the mean number of agents around the ego and the share that is replaced at each step."""
        self._mean, self._replaced = agents, replaced
        self._next = 1

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Starts an episode with new agents."""
        super().reset(seed=seed)
        self.states, self.ids = np.array([[0.0, 4.0, 25.0, 0.0]]), np.array([0])
        self._enter(self._mean)
        return np.zeros(1, np.float32), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Moves all agents, replaces some, and ends the episode with probability 0.03."""
        self.states[:, :2] += self.states[:, 2:]
        stays = self.np_random.random(len(self.ids)) > self._replaced
        stays[0] = True
        self.states, self.ids = self.states[stays], self.ids[stays]
        self._enter(int(self.np_random.poisson(max(0.0, self._mean + 1 - len(self.ids)))))
        ended = bool(self.np_random.random() < 0.03)
        return np.zeros(1, np.float32), 0.0, ended, False, {}

    def _enter(self, count: int) -> None:
        near = self.np_random.normal(size=(count, 4)) * (30, 4, 3, 0.1) + self.states[0] * (1, 0, 1, 0)
        self.states = np.concatenate([self.states, near])
        self.ids = np.concatenate([self.ids, self._next + np.arange(count)])
        self._next += count


def read(env: gym.Env) -> Scene:
    """Returns the scene of all agents on the road."""
    inner: Any = env.unwrapped
    return Scene(inner.states.copy(), inner.ids.astype(np.int64), np.ones(len(inner.ids), dtype=np.bool_))


class FieldReader:
    """Reads all agents that are observed now."""

    spec = _FIELD

    def reset(self) -> None:
        """Forgets nothing: the field numbers its agents."""

    def read(self, env: Any) -> MultiagentScene:
        field = env.unwrapped
        states = np.array([field.states[name] for name in field.seen])
        ids = np.array([field.ids[name] for name in field.seen], dtype=np.int64)
        scene = Scene(states, ids, np.ones(len(ids), dtype=np.bool_))
        return pad_multiagent_scene(scene, {n: i for i, n in enumerate(field.seen)}, np.zeros(len(ids)), _FIELD)


def egos(rows: int) -> VecEnv:
    """Gymnasium environments under `VecForecast`: a fifth of the agents is replaced at each step."""
    spec: SceneSpec = load_checkpoint("highway")[1].spec
    reader = FunctionReader(read, spec)
    venv = DummyVecEnv([lambda: SceneObservation(Churning(6, 0.2), reader=reader)] * rows)
    return VecForecast(venv, "highway", horizon_steps=HORIZON)


def multiagent(rows: int) -> VecEnv:
    """PettingZoo environments under `ForecastParallelEnv`, which share one forward; agents die and join."""
    copies = max(1, rows // PEERS)
    return ParallelVecEnv([lambda: ForecastParallelEnv(Field(), "roundabout", horizon_steps=HORIZON)] * copies)


def envpool(rows: int) -> VecEnv:
    """EnvPool's vector environment under `VecForecast`, stepped by one thread."""
    venv = EnvPoolVecEnv("HighwayFast-v0", rows, seed=0, num_threads=1)
    return VecForecast(venv, "highway", horizon_steps=HORIZON)


SUBJECTS: dict[str, Callable[[int], VecEnv]] = {"egos": egos, "multiagent": multiagent, "envpool": envpool}
"""Vector environments by name; each takes its number of rows, which for agents that all learn is learners."""
