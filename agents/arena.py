"""Where policies are measured: plays given seeds with a trained policy or with a named driver in its place."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Protocol, runtime_checkable

from stable_baselines3.common.base_class import BaseAlgorithm

from agents.episodes import EpisodeResult, run_episodes
from agents.parallel_rows import ParallelArena
from agents.rows import make_rows
from agents.task import Task


@runtime_checkable
class Arena(Protocol):
    """Plays episodes; results depend on policy and seeds alone."""

    @property
    def baselines(self) -> tuple[str, ...]:
        """Drivers to stand beside a trained policy."""

    def play(
        self, policy: BaseAlgorithm | str, seeds: Sequence[int], on_episode: Callable[[], None] = lambda: None
    ) -> list[EpisodeResult]:
        """One episode per seed, in their order; a policy takes its most likely actions."""

    def close(self) -> None:
        """Close the environments."""


class EgoArena:
    """Parallel rows of an environment with one ego, always the gymnasium one: what counts is the original.

    Args:
        task: what is driven.
        num_rows: parallel environments.
    """

    baselines = ("random", "idle")

    def __init__(self, task: Task, num_rows: int) -> None:
        """Start the rows."""
        self._venv = make_rows(replace(task, backend="gymnasium"), num_rows, seeded=True)

    def play(
        self, policy: BaseAlgorithm | str, seeds: Sequence[int], on_episode: Callable[[], None] = lambda: None
    ) -> list[EpisodeResult]:
        """As `Arena`."""
        if isinstance(policy, str):
            return run_episodes(self._venv, policy, seeds, on_episode)
        return run_episodes(self._venv, lambda obs: policy.predict(obs, deterministic=True)[0], seeds, on_episode)

    def close(self) -> None:
        """Stop the rows."""
        self._venv.close()


def open_arena(task: Task, num_rows: int) -> Arena:
    """An arena for a task."""
    return ParallelArena(task) if task.is_parallel else EgoArena(task, num_rows)
