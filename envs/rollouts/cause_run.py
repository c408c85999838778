"""Settings that the measurements of causes share: reactions, inferred edges, plans."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from envs.rollouts.cluster_pool import episode_pool
from envs.rollouts.workers import EpisodePool, Result
from envs.rollouts.world import World, open_world
from envs.supervision import TIMEOUT_S


@dataclass(frozen=True, kw_only=True)
class CauseRun:
    """Settings of the measurement in one environment."""

    env_id: str
    """Id of the environment."""
    driver: str
    """Name of the driver."""
    checkpoints: tuple[str, ...]
    """Checkpoints to measure."""
    episodes: int
    """Number of episodes; of reactions the largest one."""
    seed: int
    """Seed of the first episode."""
    max_steps: int
    """Largest length of an episode [policy steps]."""
    workers: int
    """Number of parallel processes."""
    timeout_s: float = TIMEOUT_S
    """Largest time between two steps of an episode [s]."""
    cluster: str | None = None
    """Address of a Ray cluster that plays in place of this machine."""
    env_kwargs: str = ""
    """Arguments of the environment, as the text of a JSON object; empty for none."""

    def open(self) -> World:
        """Opens the environment, to look at it; no policy is loaded to drive it."""
        driver = self.driver if not self.driver.endswith(".zip") else "idle"
        return open_world(self.env_id, driver, env_kwargs=self.env_kwargs)

    def pool(self, play: Callable[[Any], Result]) -> EpisodePool[Result]:
        """Returns the processes that play this measurement's tasks; a context manager."""
        return episode_pool(play, self.workers, self.timeout_s, cluster=self.cluster)
