"""Measures policies: plays given seeds with a trained policy or with a named driver in its place."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from agents.task import Task
from agents.vec_envs import EPISODE_INFO, EpisodeResult, make_multiagent_venv, make_venv, own_observations
from envs.drivers.all_agents import has_heuristic, make_driver
from envs.readers.base import role_of
from envs.sb3.acting import ActingPolicy
from envs.sb3.agents_as_rows import ParallelVecEnv
from envs.seeding import driver_rng


@runtime_checkable
class Arena(Protocol):
    """Plays episodes; results depend on policy and seeds alone."""

    @property
    def baselines(self) -> tuple[str, ...]:
        """Names of the drivers that a trained policy is compared with."""

    def play(
        self, policy: BaseAlgorithm | str, seeds: Sequence[int], on_episode: Callable[[], None] = lambda: None
    ) -> list[EpisodeResult]:
        """Plays one episode per seed, in the order of the seeds; a policy takes its most likely actions."""

    def close(self) -> None:
        """Closes the environments."""


class EgoArena:
    """Plays seeds in parallel copies of an environment with one ego, always in the original (Gymnasium) simulator.

    Args:
        task: environment and what the policy sees.
        num_envs: number of parallel environments.
        in_process: whether they run in this process.
    """

    baselines = ("random", "idle")

    def __init__(self, task: Task, num_envs: int, in_process: bool = False) -> None:
        """Starts the environments."""
        self._venv = make_venv(replace(task, backend="gymnasium"), num_envs, seeded=True, in_process=in_process)

    def play(
        self, policy: BaseAlgorithm | str, seeds: Sequence[int], on_episode: Callable[[], None] = lambda: None
    ) -> list[EpisodeResult]:
        """Plays one episode per seed, as `Arena.play` describes."""
        return run_episodes(self._venv, policy if isinstance(policy, str) else ActingPolicy(policy), seeds, on_episode)

    def close(self) -> None:
        """Stops the environments."""
        self._venv.close()


def open_arena(task: Task, num_envs: int, in_process: bool = False) -> Arena:
    """Returns the arena that fits a task; `in_process` keeps all of its environments in this process."""
    return MultiagentArena(task) if task.is_multiagent else EgoArena(task, num_envs, in_process)


def run_episodes(
    venv: VecEnv,
    policy: Callable[[Any, Bool[np.ndarray, " envs"]], Any] | str,
    seeds: Sequence[int],
    on_episode: Callable[[], None] = lambda: None,
) -> list[EpisodeResult]:
    """Plays one episode per seed, all environments in parallel.

    Args:
        venv: environments from `make_venv(..., seeded=True)`.
        policy: function from a batch of observations, and which of them are the first of an episode, to a batch of
            actions; or the name of a driver of `envs.drivers.ego`.
        seeds: one seed per episode, all different.
        on_episode: called after each episode (progress bars).

    Returns:
        The results, in the order of the seeds.
    """
    driver = policy if isinstance(policy, str) else None
    if driver is not None:
        venv = venv.unwrapped  # a driver by name sees no forecasts, so none are made
    for index in range(venv.num_envs):
        venv.env_method("queue", list(seeds[index :: venv.num_envs]), driver, indices=[index])
    no_actions = np.zeros((venv.num_envs, *(venv.action_space.shape or ())), dtype=venv.action_space.dtype)
    results: dict[int, EpisodeResult] = {}
    obs, starts = venv.reset(), np.ones(venv.num_envs, dtype=bool)
    while len(results) < len(seeds):
        actions = no_actions if isinstance(policy, str) else policy(obs, starts)
        obs, _, starts, infos = venv.step(actions)
        for info in infos:
            if EPISODE_INFO in info:
                result = info[EPISODE_INFO]
                results[result.seed] = result
                on_episode()
    return [results[seed] for seed in seeds]


class MultiagentArena:
    """Plays seeds of a PettingZoo environment with a policy, or with a driver in place of the learners; see `Arena`.

    Args:
        task: a PettingZoo task.

    Attributes:
        baselines: random and heuristic; idle where the environment has no heuristic driver.
    """

    def __init__(self, task: Task) -> None:
        """Makes one copy of the environment; results do not depend on the number of copies."""
        self._monitor = make_multiagent_venv(task, 1)
        venv = self._monitor.venv
        assert isinstance(venv, ParallelVecEnv)
        self._venv = venv
        self._env: Any = venv.envs[0]  # has what `DrivenEnv` has
        self.baselines = ("random", "heuristic" if has_heuristic(self._env) else "idle")

    def play(
        self, policy: BaseAlgorithm | str, seeds: Sequence[int], on_episode: Callable[[], None] = lambda: None
    ) -> list[EpisodeResult]:
        """Plays one episode per seed; the return is the mean over the learners."""
        results = []
        for seed in seeds:
            results.append(self._driven(policy, seed) if isinstance(policy, str) else self._learned(policy, seed))
            on_episode()
        return results

    def close(self) -> None:
        """Closes the environment."""
        self._venv.close()

    def _learned(self, policy: BaseAlgorithm, seed: int) -> EpisodeResult:
        self._venv.seed(seed)
        observations: Any = self._venv.reset()
        act, starts = ActingPolicy(policy), np.ones(self._venv.num_envs, dtype=bool)
        episode, steps = self._env.episodes, 0
        returns = dict.fromkeys(self._venv.agents_of_envs, 0.0)
        while self._env.episodes == episode:
            observations, rewards, starts, _ = self._venv.step(act(observations, starts))
            for agent, reward in zip(self._venv.agents_of_envs, rewards.tolist(), strict=True):
                returns[agent] += reward
            steps += 1
        return _result(seed, steps, returns)

    def _driven(self, name: str, seed: int) -> EpisodeResult:
        env = self._env
        observations, _ = env.reset(seed=seed)
        driver = make_driver(name, env, driver_rng(seed, group=1))  # group 0: agents that do not learn
        returns = dict.fromkeys(self._venv.agents_of_envs, 0.0)
        steps, lived = 0, set(env.agents)
        while env.agents and not (lived.issuperset(returns) and returns.keys().isdisjoint(env.agents)):
            own = own_observations(observations)
            actions = driver({agent: seen for agent, seen in own.items() if agent in returns})
            observations, rewards, *_ = env.step(actions_of_others(env, own, returns) | actions)
            lived.update(env.agents)
            for agent in returns:
                returns[agent] += float(rewards.get(agent, 0.0))
            steps += 1
        return _result(seed, steps, returns)


def actions_of_others(env: Any, own: Mapping[str, Any], learners: Collection[str]) -> dict[str, Any]:
    """Returns the actions of the agents that do not learn, chosen by the environment's driver.

    Args:
        env: environment with a `DrivenEnv` inside.
        own: the environment's own observation of each living agent.
        learners: names of the agents that learn.
    """
    others = {agent: seen for agent, seen in own.items() if agent not in learners}
    return env.driver(others) if others else {}


def _result(seed: int, steps: int, returns: Mapping[str, float]) -> EpisodeResult:
    roles: dict[str, list[float]] = {}
    for agent, value in returns.items():
        roles.setdefault(role_of(agent), []).append(value)
    by_role = {role: float(np.mean(values)) for role, values in roles.items()} if len(roles) > 1 else {}
    return EpisodeResult(seed, float(np.mean(list(returns.values()))), steps, None, float("nan"), by_role)
