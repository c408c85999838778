"""Measures policies: plays given seeds with a trained policy or with a named driver in its place."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Protocol, runtime_checkable

import gymnasium as gym
import numpy as np
import torch
from jaxtyping import Bool
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from agents.task import Task
from agents.vec_envs import (
    EPISODE_INFO,
    EpisodeResult,
    MakeCopy,
    check_ends,
    learners_of,
    make_multiagent_venv,
    make_venv,
    own_observations,
)
from envs.drivers.all_agents import has_heuristic, make_driver
from envs.parallel import living
from envs.readers.base import role_of
from envs.sb3.acting import ActingPolicy, sizes_of_space, space_as_stored
from envs.sb3.agents_as_rows import ParallelVecEnv
from envs.seeding import driver_rng
from predictor.own_forecasters import is_own
from predictor.support.errors import UserError, short


@runtime_checkable
class Arena(Protocol):
    """Plays episodes; results depend on policy and seeds alone."""

    @property
    def baselines(self) -> tuple[str, ...]:
        """Names of the drivers that a trained policy is compared with."""

    def play(
        self, policy: BaseAlgorithm | str, seeds: Sequence[int], on_episode: Callable[[], None] = lambda: None
    ) -> list[EpisodeResult]:
        """Plays one episode per seed, in the order of the seeds; a policy takes its most likely actions.

        Raises:
            UserError: the policy was trained on observations or actions of other sizes.
        """

    def close(self) -> None:
        """Closes the environments."""


class EgoArena:
    """Plays seeds in parallel copies of an environment with one ego, always in the original (Gymnasium) simulator.

    Args:
        task: environment and what the policy sees.
        num_envs: number of parallel environments.
        in_process: whether they run in this process; None: one does, several do not.
    """

    baselines = ("random", "idle")

    def __init__(self, task: Task, num_envs: int, in_process: bool | None = None) -> None:
        """Starts the environments."""
        self._venv = make_venv(replace(task, backend="gymnasium"), num_envs, seeded=True, in_process=in_process)

    def play(
        self, policy: BaseAlgorithm | str, seeds: Sequence[int], on_episode: Callable[[], None] = lambda: None
    ) -> list[EpisodeResult]:
        """Plays one episode per seed, as `Arena.play` describes."""
        acting = policy if isinstance(policy, str) else _acting(policy, self._venv)
        return run_episodes(self._venv, acting, seeds, on_episode)

    def close(self) -> None:
        """Stops the environments."""
        self._venv.close()


def _acting(policy: BaseAlgorithm, venv: VecEnv) -> ActingPolicy:
    """Returns the policy as it acts in environments.

    Raises:
        UserError: it was trained on observations or actions of other sizes.
    """
    for what in ("observation", "action"):
        trained, found = (_parts(space_as_stored(getattr(of, f"{what}_space"))) for of in (policy, venv))
        for key in dict.fromkeys((*trained, *found)):
            own, here = trained.get(key), found.get(key)
            if own is None or here is None or sizes_of_space(own) != sizes_of_space(here):
                name = f"{what} '{key}'" if key else what
                raise UserError(
                    f"the policy was trained with the {name} {short(own)}, got {short(here)}; give the environment the "
                    "arguments of the training"
                )
    return ActingPolicy(policy)


def _parts(space: gym.Space) -> Mapping[str, gym.Space]:
    return space.spaces if isinstance(space, gym.spaces.Dict) else {"": space}


def open_arena(task: Task, num_envs: int, in_process: bool | None = None) -> Arena:
    """Returns the arena that fits a task; `in_process` is for those of Gymnasium, see `EgoArena`."""
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

    A policy plays several copies side by side, which share one forecast per step; a driver sees no forecasts.

    Args:
        task: a PettingZoo task.
        most_copies: largest number of copies side by side.

    Attributes:
        baselines: random and heuristic; idle where the environment has no heuristic driver.
    """

    def __init__(self, task: Task, most_copies: int = 16) -> None:
        """Makes the environment of the drivers; copies for a policy are made when the first one plays."""
        self._task, self._most = task, most_copies
        self._env: Any = MakeCopy(
            replace(task, observe="none", checkpoint=None, perception_m=None, sizes_of=None)
        )()  # has what `DrivenEnv` has
        self._learners = learners_of(task, self._env)
        self._venv: ParallelVecEnv | None = None
        self.baselines = ("random", "heuristic" if has_heuristic(self._env) else "idle")

    def play(
        self, policy: BaseAlgorithm | str, seeds: Sequence[int], on_episode: Callable[[], None] = lambda: None
    ) -> list[EpisodeResult]:
        """Plays one episode per seed; the return is the mean over the learners."""
        results: list[EpisodeResult] = []
        if isinstance(policy, str):
            for seed in seeds:
                results.append(self._driven(policy, seed))
                on_episode()
            return results
        venv = self._copies(min(self._most, len(seeds)))
        for first in range(0, len(seeds), len(venv.envs)):
            played = self._learned(venv, policy, seeds[first : first + len(venv.envs)])
            results += played
            for _ in played:
                on_episode()
        return results

    def close(self) -> None:
        """Closes the environments."""
        self._env.close()
        if self._venv is not None:
            self._venv.close()

    def _copies(self, count: int) -> ParallelVecEnv:
        """Returns at least so many copies, those of before if they are enough."""
        if self._venv is None or len(self._venv.envs) < count:
            if self._venv is not None:
                self._venv.close()
            with torch.random.fork_rng(devices=[]):  # loading a forecaster draws, which a training must not notice
                venv = make_multiagent_venv(self._task, count).venv
            assert isinstance(venv, ParallelVecEnv)
            self._venv = venv
        return self._venv

    def _learned(self, venv: ParallelVecEnv, policy: BaseAlgorithm, seeds: Sequence[int]) -> list[EpisodeResult]:
        """Plays one episode in each copy; copies beyond the seeds play the last one again, and do not count."""
        copies: list[Any] = venv.envs
        venv.seed([seeds[min(copy, len(seeds) - 1)] for copy in range(len(copies))])
        observations: Any = venv.reset()
        episodes, lengths = [env.episodes for env in copies], [0] * len(copies)
        returns = [dict.fromkeys(self._learners, 0.0) for _ in copies]
        act, starts = _acting(policy, venv), np.ones(venv.num_envs, dtype=bool)
        playing = set(range(len(seeds)))
        while playing:
            observations, rewards, starts, _ = venv.step(act(observations, starts))
            for copy, agent, reward in zip(venv.copies_of_envs, venv.agents_of_envs, rewards.tolist(), strict=True):
                if copy in playing:
                    returns[copy][agent] += reward
            for copy in playing:
                lengths[copy] += 1
            playing = {copy for copy in playing if copies[copy].episodes == episodes[copy]}
            for copy in playing:
                check_ends(lengths[copy], self._task.env_id)
        return [_result(seed, lengths[copy], returns[copy]) for copy, seed in enumerate(seeds)]

    def _driven(self, name: str, seed: int) -> EpisodeResult:
        env = self._env
        observations, _ = env.reset(seed=seed)
        driver = make_driver(name, env, driver_rng(seed, group=1))  # group 0: agents that do not learn
        returns = dict.fromkeys(self._learners, 0.0)
        steps, left = 0, list(env.agents)
        lived = set(left)
        while left and not (lived.issuperset(returns) and returns.keys().isdisjoint(left)):
            check_ends(steps, self._task.env_id)
            own = own_observations({agent: observations[agent] for agent in left if agent in observations})
            seen = own if is_own(name) else {agent: one for agent, one in own.items() if agent in returns}
            chosen = {agent: action for agent, action in driver(seen).items() if agent in returns}
            acting = returns.keys() & left
            observations, rewards, terminated, truncated, _ = env.step(env.drive_others(own) | chosen)
            left = living(env, terminated, truncated)
            lived.update(left)
            for agent in acting:  # some environments go on rewarding agents that have ended
                returns[agent] += float(rewards.get(agent, 0.0))
            steps += 1
        return _result(seed, steps, returns)


def _result(seed: int, steps: int, returns: Mapping[str, float]) -> EpisodeResult:
    roles: dict[str, list[float]] = {}
    for agent, value in returns.items():
        roles.setdefault(role_of(agent), []).append(value)
    by_role = {role: float(np.mean(values)) for role, values in roles.items()} if len(roles) > 1 else {}
    return EpisodeResult(seed, float(np.mean(list(returns.values()))), steps, None, float("nan"), by_role)
