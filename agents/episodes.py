"""Episodes on given seeds, one result each; rows play their queues in parallel."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from envs.egos import Ego, make_ego

EPISODE_INFO = "seeded_episode"
"""Key under which `SeededEpisodes` leaves the result of an episode in its last info."""


@dataclass(frozen=True)
class EpisodeResult:
    """What happened in one episode."""

    seed: int
    """Seed it was reset with."""
    episode_return: float
    """Undiscounted sum of rewards; the mean over the learners where there are several."""
    length: int
    """Policy steps."""
    crashed: bool | None
    """Whether the env reported a crash of the ego at any step; None where there is no ego."""
    mean_speed_mps: float
    """Mean over steps of the ego's speed [m/s]; NaN where the env reports none."""
    returns_by_role: dict[str, float] = field(default_factory=dict)
    """Mean return of the learners of each role, where there are several roles."""


class SeededEpisodes(gym.Wrapper):
    """Plays queued seeds one after another and leaves an `EpisodeResult` in the last info of each episode.

    Episodes beyond the queue go on unseeded and leave no result. An ego from `envs.egos` may drive in place of the
    actions that arrive, with its own generator per seed, so its episodes do not depend on the number of rows.

    Args:
        env: one row.
    """

    def __init__(self, env: gym.Env) -> None:
        """Nothing is queued yet."""
        super().__init__(env)
        self._seeds: list[int] = []
        self._ego_name: str | None = None
        self._ego: Ego | None = None
        self._seed: int | None = None

    def queue(self, seeds: Sequence[int], ego: str | None = None) -> None:
        """Seeds of the next episodes, from the next reset on; `ego` drives them if given."""
        self._seeds, self._ego_name = list(seeds), ego

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start the next queued episode."""
        self._seed = self._seeds.pop(0) if self._seeds else None
        obs, info = self.env.reset(seed=seed if self._seed is None else self._seed, options=options)
        self._ego = None
        if self._ego_name is not None:
            self._ego = make_ego(self._ego_name, self.env, np.random.default_rng(self._seed))
        self._rewards: list[float] = []
        self._speeds_mps: list[float] = []
        self._crashed = False
        self._obs = obs
        return obs, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step, and note what the result needs."""
        if self._ego is not None:
            action = self._ego(self._obs)
        obs, reward, terminated, truncated, info = self.env.step(action)
        self._obs = obs
        self._rewards.append(float(reward))
        self._speeds_mps.append(float(info.get("speed", np.nan)))
        self._crashed |= bool(info.get("crashed", False))
        if (terminated or truncated) and self._seed is not None:
            speed = float(np.mean(self._speeds_mps))
            info[EPISODE_INFO] = EpisodeResult(
                self._seed, float(np.sum(self._rewards)), len(self._rewards), self._crashed, speed
            )
        return obs, reward, terminated, truncated, info


def run_episodes(
    venv: VecEnv,
    policy: Callable[[Any], Any] | str,
    seeds: Sequence[int],
    on_episode: Callable[[], None] = lambda: None,
) -> list[EpisodeResult]:
    """Play one episode per seed, all rows in parallel.

    Args:
        venv: from `make_rows(..., seeded=True)`.
        policy: from a batch of observations to a batch of actions, or the name of an ego from `envs.egos`.
        seeds: one per episode, all different.
        on_episode: called after each episode (progress bars).

    Returns:
        Results in the order of the seeds.
    """
    ego = policy if isinstance(policy, str) else None
    if ego is not None:
        venv = venv.unwrapped  # nobody looks at the forecasts, so none are made
    for row in range(venv.num_envs):
        venv.env_method("queue", list(seeds[row :: venv.num_envs]), ego, indices=[row])
    no_actions = np.zeros((venv.num_envs, *(venv.action_space.shape or ())), dtype=venv.action_space.dtype)
    results: dict[int, EpisodeResult] = {}
    obs = venv.reset()
    while len(results) < len(seeds):
        actions = no_actions if isinstance(policy, str) else policy(obs)
        obs, _, _, infos = venv.step(actions)
        for info in infos:
            if EPISODE_INFO in info:
                result = info[EPISODE_INFO]
                results[result.seed] = result
                on_episode()
    return [results[seed] for seed in seeds]
