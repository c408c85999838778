"""PettingZoo tasks: agents as rows of one policy for training, and episodes on given seeds for evaluation.

Agents that do not learn are driven by name (`envs.drivers`), anew in each episode. As in `agents.rows`, one place
decides what a policy sees.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from pettingzoo import ParallelEnv
from pettingzoo.utils import BaseParallelWrapper
from stable_baselines3.common.base_class import BaseAlgorithm

from agents.episodes import EpisodeResult
from agents.task import Task, resolve_device
from envs.drivers import Driver, make_driver
from envs.multiagent import AgentMonitor, ParallelVecEnv
from envs.multiagent_spaces import learners_named, role_of
from envs.parallel import ForecastParallelEnv
from envs.parallel_registry import PARALLEL_CHECKPOINTS, make_parallel_env, shared_reader_for
from envs.render_shared import SharedRecording, record_parallel_episode
from predictor.checkpoint import CONSTANT_VELOCITY
from predictor.errors import UserError


class DrivenEnv(BaseParallelWrapper):
    """Has a fresh driver in each episode, for the agents that do not learn.

    Args:
        env: what is driven.
        driver: its name in `envs.drivers`.

    Attributes:
        episodes: resets so far.
    """

    def __init__(self, env: ParallelEnv, driver: str) -> None:
        """Nothing is reset yet."""
        super().__init__(env)
        self._name = driver
        self._rng = np.random.default_rng(0)
        self._driver: Driver | None = None
        self.episodes = 0

    @property
    def driver(self) -> Driver:
        """Of this episode; made when somebody first needs it, as not every name can drive every environment.

        Raises:
            UserError: as `envs.drivers.make_driver`.
        """
        if self._driver is None:
            self._driver = make_driver(self._name, self.env, self._rng)
        return self._driver

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict[str, Any], Any]:
        """Reset; a seed also fixes the drivers of this and the following episodes."""
        observations, infos = self.env.reset(seed=seed, options=options)
        if seed is not None:
            self._rng = np.random.default_rng(seed)
        self._driver = None
        self.episodes += 1
        return observations, infos


def drive(env: Any, observations: Mapping[str, Any], generator: np.random.Generator) -> dict[str, Any]:
    """The partner of `ParallelVecEnv`: the episode's driver acts on the agents' own observations."""
    return env.driver(own_observations(observations))


def own_observations(observations: Mapping[str, Any]) -> dict[str, Any]:
    """What the environment itself gave each agent, without forecasts."""
    return {name: seen["observation"] if isinstance(seen, dict) else seen for name, seen in observations.items()}


@dataclass(frozen=True)
class MakeCopy:
    """Picklable constructor of one copy of a task's environment."""

    task: Task
    """What to make."""
    render_mode: str | None = None
    """Passed on to the environment."""

    def __call__(self) -> ParallelEnv:
        """The environment in a `DrivenEnv`, with forecasts around it unless the task observes none."""
        options = {} if self.render_mode is None else {"render_mode": self.render_mode}
        env = DrivenEnv(make_parallel_env(self.task.env_id, **options), self.task.partner)
        if self.task.observe == "none":
            return env
        return ForecastParallelEnv(env, self.task.forecaster, device=resolve_device(self.task.device))


def learners_of(task: Task, env: ParallelEnv) -> list[str]:
    """The agents that learn."""
    return learners_named(env.possible_agents, task.learners, task.env_id)


def make_parallel_rows(task: Task, copies: int) -> AgentMonitor:
    """All learners of some copies of a task's environment, with statistics over lives."""
    make = MakeCopy(task)
    env = make()
    learners = learners_of(task, env)
    env.close()
    partner = None if len(learners) == len(env.possible_agents) else drive
    return AgentMonitor(ParallelVecEnv([make] * copies, agents=learners, partner=partner))


class ParallelArena:
    """Plays seeds with a policy or with a driver in the learners' place; see `agents.arena.Arena`.

    Args:
        task: a PettingZoo task.

    Attributes:
        baselines: random and heuristic; idle where no heuristic drives the environment.
    """

    def __init__(self, task: Task) -> None:
        """One copy; results do not depend on how many there are."""
        self._monitor = make_parallel_rows(task, 1)
        venv = self._monitor.venv
        assert isinstance(venv, ParallelVecEnv)
        self._venv = venv
        self._env: Any = venv.envs[0]  # has what `DrivenEnv` has
        self.baselines = ("random", "heuristic" if _has_heuristic(self._env) else "idle")

    def play(
        self, policy: BaseAlgorithm | str, seeds: Sequence[int], on_episode: Callable[[], None] = lambda: None
    ) -> list[EpisodeResult]:
        """One episode per seed; the return is the mean over the learners."""
        results = []
        for seed in seeds:
            results.append(self._driven(policy, seed) if isinstance(policy, str) else self._learned(policy, seed))
            on_episode()
        return results

    def close(self) -> None:
        """Close the environment."""
        self._venv.close()

    def _learned(self, policy: BaseAlgorithm, seed: int) -> EpisodeResult:
        self._venv.seed(seed)
        observations: Any = self._venv.reset()
        episode, steps = self._env.episodes, 0
        returns = dict.fromkeys(self._venv.row_agents, 0.0)
        while self._env.episodes == episode:
            actions = policy.predict(observations, deterministic=True)[0]
            observations, rewards, _, _ = self._venv.step(actions)
            for agent, reward in zip(self._venv.row_agents, rewards.tolist(), strict=True):
                returns[agent] += reward
            steps += 1
        return _result(seed, steps, returns)

    def _driven(self, name: str, seed: int) -> EpisodeResult:
        env = self._env
        observations, _ = env.reset(seed=seed)
        driver = make_driver(name, env, np.random.default_rng(seed))
        returns = dict.fromkeys(self._venv.row_agents, 0.0)
        steps, lived = 0, set(env.agents)
        while env.agents and not (lived.issuperset(returns) and returns.keys().isdisjoint(env.agents)):
            own = own_observations(observations)
            actions = driver({agent: seen for agent, seen in own.items() if agent in returns})
            observations, rewards, *_ = env.step(_partners_actions(env, own, returns) | actions)
            lived.update(env.agents)
            for agent in returns:
                returns[agent] += float(rewards.get(agent, 0.0))
            steps += 1
        return _result(seed, steps, returns)


def _partners_actions(env: Any, own: Mapping[str, Any], learners: Collection[str]) -> dict[str, Any]:
    """Actions of those who do not learn."""
    others = {agent: seen for agent, seen in own.items() if agent not in learners}
    return env.driver(others) if others else {}


def _has_heuristic(env: ParallelEnv) -> bool:
    try:
        make_driver("heuristic", env, np.random.default_rng(0))
    except UserError:
        return False
    return True


def _result(seed: int, steps: int, returns: Mapping[str, float]) -> EpisodeResult:
    roles: dict[str, list[float]] = {}
    for agent, value in returns.items():
        roles.setdefault(role_of(agent), []).append(value)
    by_role = {role: float(np.mean(values)) for role, values in roles.items()} if len(roles) > 1 else {}
    return EpisodeResult(seed, float(np.mean(list(returns.values()))), steps, None, float("nan"), by_role)


def record_task(task: Task, policy: BaseAlgorithm, seed: int, max_steps: int) -> SharedRecording | None:
    """Play one episode for a film; forecasts are drawn also for a policy that sees none.

    Returns:
        The recording; None if no reader knows the environment.
    """
    filmed = task
    if task.observe == "none":
        if not _has_reader(task.env_id):
            return None
        shown = None if task.env_id in PARALLEL_CHECKPOINTS else CONSTANT_VELOCITY
        filmed = replace(task, observe="forecast", checkpoint=shown)
    env = MakeCopy(filmed)()
    assert isinstance(env, ForecastParallelEnv)
    learners = learners_of(task, env)
    rows = make_parallel_rows(task, 1).venv  # knows how spaces are padded
    assert isinstance(rows, ParallelVecEnv)

    def act(observations: dict[str, Any]) -> dict[str, Any]:
        own = own_observations(observations)
        actions = _partners_actions(env, own, learners)
        for agent in observations:
            if agent in learners:
                seen = own[agent] if task.observe == "none" else observations[agent]
                chosen = policy.predict(rows.row_of(agent, seen), deterministic=True)[0]
                actions[agent] = rows.own_action(agent, chosen)
        return actions

    try:
        return record_parallel_episode(env, act, seed=seed, max_steps=max_steps)
    finally:
        env.close()
        rows.close()


def _has_reader(env_id: str) -> bool:
    env = make_parallel_env(env_id)
    try:
        shared_reader_for(env)
    except UserError:
        return False
    finally:
        env.close()
    return True
