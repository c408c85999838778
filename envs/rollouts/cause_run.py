"""Settings that the measurements of causes share: reactions, inferred edges, plans."""

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

from envs.rollouts.cluster_pool import episode_pool
from envs.rollouts.kept_world import kept_world
from envs.rollouts.side_forecasts import open_for_checkpoints
from envs.rollouts.workers import EpisodePool, Result
from envs.rollouts.world import World, open_to_look
from envs.seeding import Purpose, episode_rng
from envs.supervision import TIMEOUT_S

FIRST_STEP = 3
"""First step that is measured; forecasters have seen the motion by then."""
EVERY = 5
"""Number of steps from one at which copies are played to the next, where they are at equal distances."""


@dataclass(frozen=True, kw_only=True)
class CauseTask:
    """Settings of one episode; can be pickled."""

    env_id: str
    """Id of the environment."""
    driver: str
    """Name of the driver."""
    checkpoints: tuple[str, ...]
    """Checkpoints to measure; the first one's perception holds for all."""
    seed: int
    """Seed of the episode; of a run, of its first one."""
    max_steps: int
    """Largest length of an episode [policy steps]."""
    env_kwargs: str = ""
    """Arguments of the environment, as the text of a JSON object; empty for none."""
    hidden_draws: int = 0
    """Number of worlds that look the same, in which is played what somebody foresees (`envs.rollouts.foreseen`); 0 for
    none. Inferred edges have no use for it."""

    def opened(self) -> World:
        """Returns the world of the episode, reset; a process keeps it for its next one."""
        wanted = self.env_id, self.driver, self.checkpoints, self.env_kwargs
        world = kept_world(wanted, lambda: open_for_checkpoints(*wanted))
        world.reset(self.seed)
        return world

    def measured_steps(self, purpose: Purpose) -> range:
        """Returns the steps of the episode, at equal distances from a random one on, that are measured.

        Args:
            purpose: what is measured; each draws steps of its own.
        """
        drawn = int(episode_rng(self.seed, purpose).integers(EVERY))
        return range(FIRST_STEP + (drawn - FIRST_STEP) % EVERY, self.max_steps, EVERY)


@dataclass(frozen=True, kw_only=True)
class CauseRun(CauseTask):
    """Settings of the measurement in one environment."""

    episodes: int
    """Number of episodes; of reactions the largest one."""
    workers: int
    """Number of parallel processes."""
    timeout_s: float = TIMEOUT_S
    """Largest time between two steps of an episode [s]."""
    cluster: str | None = None
    """Address of a Ray cluster that plays in place of this machine."""

    def open(self) -> World:
        """Opens the environment, to look at it; no policy is loaded to drive it."""
        return open_to_look(self.env_id, self.driver, self.env_kwargs)

    def pool(self, play: Callable[[Any], Result]) -> EpisodePool[Result]:
        """Returns the processes that play this measurement's tasks; a context manager."""
        return episode_pool(play, self.workers, self.timeout_s, cluster=self.cluster)

    def of_episode(self, number: int, checkpoints: tuple[str, ...]) -> dict[str, Any]:
        """Returns the arguments of a `CauseTask`.

        Args:
            number: number of the episode.
            checkpoints: those that fit the environment.
        """
        own = {field.name: getattr(self, field.name) for field in fields(CauseTask)}
        return own | {"checkpoints": checkpoints, "seed": self.seed + number}
