"""Vector environments for training and evaluation.

Environments with one ego run in spawned processes with one torch thread each, or in EnvPool; the forecaster runs once
per step for all of them, in the main process. In PettingZoo tasks every learner is an environment of the vector, and a
named driver (`envs.drivers.all_agents`) drives the agents that do not learn. The task (`agents.task`) determines what a
policy sees, so that training, evaluation and video agree.
"""

import multiprocessing
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from pettingzoo import ParallelEnv
from pettingzoo.utils import BaseParallelWrapper
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecMonitor

from agents.shaping import shaped
from agents.task import Task
from envs.drivers.all_agents import Driver, make_driver
from envs.drivers.ego import constant_actions, make_ego_driver
from envs.drivers.trained import EgoDriver
from envs.own_observation import without_added
from envs.readers import multiagent_env_id, outcome_keys
from envs.registry import envpool_task_of
from envs.rollouts.driving_measures import DrivingMeasures, recorder_for
from envs.sb3.agents_as_rows import AgentMonitor, ParallelVecEnv
from envs.sb3.envpool import EnvPoolVecEnv
from envs.sb3.forecast import VecForecast
from envs.sb3.padded_spaces import learners_named
from envs.sb3.workers import WorkerVecEnv
from envs.scene_stream import NOISE_SEED_INFO
from envs.seeding import driver_rng
from envs.supervision import Place, SupervisedEnv, check_numbers, named
from envs.wrappers import SceneObservation, scene_source, scenes_inside
from predictor.scene import SceneSpec
from predictor.support.errors import UserError

MOST_STEPS = 100_000
"""Number of steps after which an episode that is measured counts as endless."""
EPISODE_INFO = "seeded_episode"
"""Key of the last info of an episode under which `SeededEpisodes` puts its result."""


@dataclass(frozen=True)
class EpisodeResult:
    """Result of one episode."""

    seed: int
    """Seed that the episode was reset with."""
    episode_return: float
    """Undiscounted sum of rewards; the mean over the learners where there are several."""
    length: int
    """Number of policy steps."""
    crashed: bool | None
    """Whether the env reported a crash of the ego at any step; None if it never reports crashes or has no ego."""
    mean_speed_mps: float
    """Mean over steps of the ego's speed [m/s]; NaN if the env does not report it."""
    returns_by_role: dict[str, float] = field(default_factory=dict)
    """Mean return of the learners of each role; empty if there is one role."""
    action_counts: dict[str, int] = field(default_factory=dict)
    """Number of steps with each action that the ego took, by its name in `envs.drivers.ego.constant_actions`; empty if
    actions are not discrete or there is no ego."""
    success: bool | None = None
    """Whether the env reported success in the last step, and no crash; None if it does not report success."""
    driving: DrivingMeasures | None = None
    """Measures of the ego's driving; None if the env is not highway-env's or has no ego."""


class DrivenEnv(BaseParallelWrapper):
    """Makes a new driver in each episode, for the agents that do not learn.

    Args:
        env: a PettingZoo environment.
        driver: name of the driver in `envs.drivers.all_agents`.
        learners: names of the agents that learn.

    Attributes:
        episodes: number of resets so far.
    """

    def __init__(self, env: ParallelEnv, driver: str, learners: Collection[str]) -> None:
        """Wraps the environment; the first driver is made after the first reset."""
        super().__init__(env)
        self._name, self._id, self._place = driver, multiagent_env_id(env), Place()
        self._learners = frozenset(learners)
        self._rng = driver_rng(0)
        self._driver: Driver | None = None
        self.episodes = 0

    def drive_others(self, observations: Mapping[str, Any]) -> dict[str, Any]:
        """Returns the actions of the agents that do not learn, chosen by the driver of this episode.

        It is made when it is first needed, as some names cannot drive some environments.

        Args:
            observations: observation of each living agent, with or without forecasts.

        Raises:
            UserError: see `envs.drivers.all_agents.make_driver`.
        """
        others = {name: without_added(seen) for name, seen in observations.items() if name not in self._learners}
        if not others:
            return {}
        if self._driver is None:
            self._driver = make_driver(self._name, self.env, self._rng)
        return self._driver(others)

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict[str, Any], Any]:
        """Resets the environment; a seed also fixes the drivers of this and the following episodes."""
        self._place.begin(seed)
        with named(self._id, self._place):
            observations, infos = self.env.reset(seed=seed, options=options)
        if seed is not None:
            self._rng = driver_rng(seed)
        self._driver = None
        self.episodes += 1
        return observations, infos

    def step(self, actions: dict[str, Any]) -> tuple[dict[str, Any], ...]:
        """Steps the environment.

        Raises:
            EnvironmentFailedError: it raised, or returned NaN.
        """
        self._place.move()
        with named(self._id, self._place):
            observations, rewards, *ends = self.env.step(actions)
            check_numbers(observations, sum(rewards.values()))
        return observations, rewards, *ends


def drive(env: Any, observations: Mapping[str, Any], generator: np.random.Generator) -> dict[str, Any]:
    """Returns the actions of the agents that do not learn, for `ParallelVecEnv`: those of the episode's driver."""
    actions: dict[str, Any] = env.drive_others(observations)
    return actions


def own_observations(observations: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the environment's own observation of each agent, without forecasts."""
    return {name: without_added(seen) for name, seen in observations.items()}


@dataclass(frozen=True)
class MakeCopy:
    """Picklable constructor of one copy of a task's environment."""

    task: Task
    """Task whose environment is made."""
    render_mode: str | None = None
    """Render mode of the environment."""
    for_learning: bool = False
    """Whether rewards are shaped where those of the environment are rare (`agents.shaping`)."""

    def __call__(self) -> ParallelEnv:
        """Makes the environment in a `DrivenEnv`, with forecasts around it unless the task observes none."""
        options = {} if self.render_mode is None else {"render_mode": self.render_mode}
        made = self.task.make(**options)
        env = DrivenEnv(shaped(made) if self.for_learning else made, self.task.driver, learners_of(self.task, made))
        return env if self.task.observe == "none" else self.task.wrapped(env)


def learners_of(task: Task, env: ParallelEnv) -> list[str]:
    """Returns the names of the agents that learn."""
    return learners_named(env.possible_agents, task.learners, task.env_id)


def make_multiagent_venv(task: Task, copies: int, for_learning: bool = False) -> AgentMonitor:
    """Makes a vector of all learners of some copies of a task's environment, with statistics of each learner's life.

    `for_learning` shapes rewards, see `MakeCopy`.
    """
    make = MakeCopy(task, for_learning=for_learning)
    env = make()
    learners = learners_of(task, env)
    env.close()
    partner = None if len(learners) == len(env.possible_agents) else drive
    return AgentMonitor(ParallelVecEnv([make] * copies, agents=learners, partner=partner))


def make_venv(
    task: Task, num_envs: int, seeded: bool = False, in_process: bool | None = None, shaping: bool = False
) -> VecEnv:
    """Makes the parallel environments of a task, with episode statistics and (unless `observe` is none) forecasts.

    Args:
        task: environment and what the policy sees.
        num_envs: number of environments; of a PettingZoo environment the number of copies, each with one environment of
            the vector per learner.
        seeded: whether to wrap each environment in `SeededEpisodes`, for evaluation (gymnasium backend only).
        in_process: whether the environments of Gymnasium run in this process, else in spawned ones, and those of
            EnvPool in one thread, else in as many as it takes; None: one of Gymnasium does, all others do not.
        shaping: whether rewards are shaped where those of the environment are rare (`agents.shaping`).
    """
    if task.is_multiagent:
        return make_multiagent_venv(task, num_envs, shaping)
    venv: VecEnv
    spec = task.scene_spec
    if task.backend == "envpool":
        venv = EnvPoolVecEnv(
            envpool_task_of(task.env_id),
            num_envs,
            scenes=spec is not None,
            perception_m=None if spec is None else spec.perception_m,
            max_agents=None if spec is None else spec.max_agents,
            num_threads=1 if in_process else 0,
        )
    else:
        make = _MakeEnv(task, spec, seeded)
        here = num_envs == 1 if in_process is None else in_process
        makers: list[Callable[[], gym.Env]] = [make] * num_envs
        venv = DummyVecEnv(makers) if here else WorkerVecEnv(makers, task.env_id, task.timeout_s)
    if task.observe != "none":
        venv = VecForecast(venv, **task.options)
    return VecMonitor(venv)


@dataclass(frozen=True)
class _MakeEnv:
    """Picklable constructor of one environment."""

    task: Task
    scene_spec: SceneSpec | None
    seeded: bool

    def __call__(self) -> gym.Env:
        if multiprocessing.parent_process() is not None:
            torch.set_num_threads(1)  # the environments already fill the cores
        env = self.task.make(disable_env_checker=True)
        if self.scene_spec is not None:
            env = SceneObservation(env, self.scene_spec.perception_m, self.scene_spec.max_agents)
        env = SupervisedEnv(env, self.task.env_id)
        return SeededEpisodes(env, self.task.crash_key, self.task.success_key) if self.seeded else env


def check_ends(steps: int, source: str) -> None:
    """Checks that an episode that goes on has not gone on forever: some drivers never move.

    Args:
        steps: number of its steps.
        source: name of the environment, for messages.

    Raises:
        UserError: it has `MOST_STEPS`.
    """
    if steps >= MOST_STEPS:
        raise UserError(
            f"{source}: an episode has not ended after {steps:,} steps; give the environment a limit, in gymnasium "
            "max_episode_steps when it is registered, or the wrapper TimeLimit"
        )


class SeededEpisodes(gym.Wrapper):
    """Plays queued seeds one after another and puts an `EpisodeResult` into the last info of each episode.

    Episodes beyond the queue repeat the last seed and have no result. The seed is also that of the noise of sampled
    forecasts, so that results depend neither on the number of environments nor on the episodes before. A driver of
    `envs.drivers.ego` can replace the received actions; it has its own generator per seed, too.

    Args:
        env: one environment.
        crash_key: key of the infos that says whether the ego has crashed; None takes the env's (`register_reader`).
        success_key: key that says whether it has succeeded; None takes the env's.
    """

    def __init__(self, env: gym.Env, crash_key: str | None = None, success_key: str | None = None) -> None:
        """Wraps the environment with an empty queue."""
        super().__init__(env)
        self._keys = outcome_keys(env, crash_key, success_key)
        self._action_names = {number: name for name, number in constant_actions(env).items()}
        self._recorder = recorder_for(env)
        self._scenes = scenes_inside(env)
        self._seeds: list[int] = []
        self._last: int | None = None
        self._driver_name: str | None = None
        self._driver: EgoDriver | None = None
        self._seed: int | None = None

    def queue(self, seeds: Sequence[int], driver: str | None = None) -> None:
        """Sets the seeds of the next episodes, from the next reset on, and the driver that drives them, if any."""
        self._seeds, self._driver_name = list(seeds), driver

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Starts the next queued episode."""
        self._seed = self._seeds.pop(0) if self._seeds else None
        self._last = self._last if self._seed is None else self._seed
        if self._scenes is not None:  # a driver by name sees none
            self._scenes.plans_paused = self._driver_name is not None
        obs, info = self.env.reset(seed=seed if self._last is None else self._last, options=options)
        self._driver = None
        if self._driver_name is not None:
            self._driver = make_ego_driver(self._driver_name, self.env, driver_rng(self._last))
        self._rewards: list[float] = []
        self._speeds_mps: list[float] = []
        self._actions: Counter[str] = Counter()
        self._crashed: bool | None = None
        self._obs = obs
        if self._recorder is not None:
            self._recorder.begin()
        return obs, info if self._seed is None else info | {NOISE_SEED_INFO: self._seed}

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Makes a step and records what the result needs."""
        if self._driver is not None:
            with named(scene_source(self.env), f"seed {self._last}, step {len(self._rewards) + 1}"):
                action = self._driver(without_added(self._obs))
        obs, reward, terminated, truncated, info = self.env.step(action)
        self._obs = obs
        self._rewards.append(float(reward))
        speed_mps = info.get("speed")
        if isinstance(speed_mps, int | float | np.integer | np.floating):  # others may call a vector so
            self._speeds_mps.append(float(speed_mps))
        if self._action_names:
            self._actions[self._action_names.get(int(action), f"action-{int(action)}")] += 1
        crashed = self._keys.crashed(info)
        if crashed is not None:
            self._crashed = bool(self._crashed) or crashed
        if self._recorder is not None:
            self._recorder.note()
        if self._seed is not None:
            if terminated or truncated:
                info = {**info, EPISODE_INFO: self._result(self._seed, info)}  # some environments reuse theirs
            else:
                check_ends(len(self._rewards), f"env '{scene_source(self.env)}'")
        return obs, reward, terminated, truncated, info

    def _result(self, seed: int, last_info: Mapping[str, Any]) -> EpisodeResult:
        success = self._keys.succeeded(last_info)
        return EpisodeResult(
            seed,
            float(np.sum(self._rewards)),
            len(self._rewards),
            self._crashed,
            float(np.mean(self._speeds_mps)) if self._speeds_mps else float("nan"),
            action_counts=dict(self._actions),
            success=None if success is None else success and not self._crashed,
            driving=None if self._recorder is None else self._recorder.measures(),
        )
