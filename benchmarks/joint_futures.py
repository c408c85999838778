"""Measures how the joint error of sampled futures depends on how many agents they have to be right about at once.

`python -m benchmarks.joint_futures --env-ids exit-v1` plays the episodes of `envs.evaluate` and scores each scene with
its 1, 2, 3, … nearest agents. Three errors stand beside each other: the single forecast, the best sample of each agent,
and the best sample of all these agents together; the last one also with the samples of each agent in an order of its
own. Where mixing them changes nothing, the samples say nothing about which futures belong together.
"""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from envs.evaluate import EvaluateConfig
from envs.registry import checkpoint_for
from envs.rollouts.episode import MODEL, EpisodeTask, play
from envs.rollouts.workers import EpisodePool
from envs.rollouts.world import default_drivers, open_world
from predictor.checkpoint import load_forecaster
from predictor.evaluation.displacement import displacement
from predictor.evaluation.outcomes import Outcome
from predictor.support.command_line import parse
from predictor.support.config_checks import check_at_least
from predictor.support.errors import UserError, run_entry_point
from predictor.support.files import check_out_file, write_json
from predictor.support.markdown import table
from predictor.support.progress import track
from predictor.support.provenance import provenance

SHUFFLES = 10
"""Number of random orders of each agent's samples over which the error of mixed samples is averaged."""


@dataclass(frozen=True)
class JointConfig:
    """Scores forecasts by the number of agents that one sample has to be right about."""

    env_ids: tuple[str, ...] = ("exit-v1", "highway-mixed-v0", "merge-v1", "roundabout-v1")
    """Environments, each with the checkpoint that ships for it."""
    episodes: int = 50
    """Number of episodes of each environment."""
    num_samples: int = 20
    """Number of futures of each scene (K)."""
    agents: tuple[int, ...] = (1, 2, 3, 5, 8)
    """Numbers of agents: the nearest to the ego, or without one the first in the order of the environment."""
    out: Path | None = None
    """JSON file to write the result to."""

    def __post_init__(self) -> None:
        """Checks ranges.

        Raises:
            UserError: a value is out of range or missing.
        """
        check_at_least(self, 1, "episodes", "num_samples", "agents")
        for name in ("env_ids", "agents"):
            if not getattr(self, name):
                raise UserError(f"{name} needs at least one value, got none")
        if len({*self.env_ids}) < len(self.env_ids):
            raise UserError(f"env_ids must differ, got {', '.join(self.env_ids)}")
        check_out_file(self.out)


@dataclass(frozen=True)
class Errors:
    """Mean errors [m] of the scenes with at least this number of agents, each scored with its nearest ones."""

    agents: int
    """Number of agents."""
    scenes: int
    """Number of scenes."""
    single: float
    """Displacement of the single forecast, sample 0."""
    best: float
    """Displacement of each agent's best sample."""
    joint: float
    """Displacement of the sample that is best for these agents together."""
    mixed: float
    """Displacement of the sample that is best for all if the samples of each agent have an order of their own."""

    def cells(self) -> tuple[str, ...]:
        """Returns the cells of a line of the table: errors, and how far each is below the single forecast's."""
        found = [f"{e:.3f} ({100 * (1 - e / self.single):.0f} %)" for e in (self.best, self.joint, self.mixed)]
        return (str(self.agents), f"{self.scenes:,}", f"{self.single:.3f}", *found)


def errors_of(
    displacements: Sequence[Float[np.ndarray, "samples agents"]], agents: int, rng: np.random.Generator
) -> Errors | None:
    """Returns the errors with a number of agents; None if no scene has so many.

    Args:
        displacements: mean displacement of each sample and agent of each scene, the nearest agent first [m].
        agents: number of agents.
        rng: draws the orders of the samples.
    """
    found = [scene[:, :agents] for scene in displacements if scene.shape[1] >= agents]
    if not found:
        return None
    scenes = np.stack(found)
    mixed = [rng.permuted(scenes, axis=1).mean(2).min(1).mean() for _ in range(SHUFFLES)]
    means = (scenes[:, 0].mean(), scenes.min(1).mean(), scenes.mean(2).min(1).mean(), np.mean(mixed))
    return Errors(agents, len(scenes), *map(float, means))


def displacements_of(outcome: Outcome) -> Iterator[Float[np.ndarray, "samples agents"]]:
    """Yields the mean displacement [m] of each sample and agent of each scene; agents whose whole future is known."""
    mean_m = displacement(outcome.forecast, outcome.future).mean(-1)
    for scene, whole in zip(mean_m, outcome.valid.all(-1), strict=True):
        if whole.any():
            yield scene[:, whole].double().numpy()


def measure(env_id: str, config: JointConfig) -> list[Errors]:
    """Plays an environment's episodes and returns the errors for each number of agents that a scene has."""
    checkpoint, driver = checkpoint_for(env_id), default_drivers(env_id)[0]
    world = open_world(env_id, driver, checkpoint)
    horizon = load_forecaster(checkpoint, world.spec, f"env '{env_id}'").horizon_steps
    world.close()
    scenes: list[np.ndarray] = []
    first, steps = EvaluateConfig.seed, EvaluateConfig.max_steps
    tasks = [
        EpisodeTask(env_id, checkpoint, driver, first + i, config.num_samples, horizon, steps)
        for i in range(config.episodes)
    ]
    with EpisodePool(play, workers=1) as pool:  # highway-env's intersection changes drivers for a whole process
        for episode in track(pool.results(tasks), f"play {env_id}", total=len(tasks)):
            scenes.extend(displacements_of(episode.outcomes[MODEL]))
    rng = np.random.default_rng(0)
    return [found for agents in config.agents if (found := errors_of(scenes, agents, rng)) is not None]


def main() -> None:
    """Runs the command."""
    config = parse(JointConfig, __doc__)
    torch.set_num_threads(1)
    for env_id in config.env_ids:  # raises before any is played
        checkpoint_for(env_id)
    results = {env_id: measure(env_id, config) for env_id in config.env_ids}
    headings = ("env", "agents", "scenes", "single forecast [m]", "best of each", "joint best", "joint best, mixed")
    print(table(headings, [(env_id, *one.cells()) for env_id, found in results.items() for one in found]))
    if config.out is not None:
        content: dict[str, Any] = {env_id: [asdict(one) for one in found] for env_id, found in results.items()}
        write_json(config.out, {"errors": content, "provenance": provenance(("torch", "highway-env"))})


if __name__ == "__main__":
    run_entry_point(main)
