"""Measures reactions in one environment: plays episodes in parallel until each cell has enough perturbations."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from envs.registry import name_with
from envs.rollouts.cause_run import CauseRun
from envs.rollouts.interventions import kinds_of
from envs.rollouts.reaction_cells import FALSE_BESIDE, cells_of
from envs.rollouts.reactions import Perturbation, ReactionTask, play_reactions
from envs.rollouts.side_forecasts import fitting_checkpoints
from predictor.checkpoint import load_forecaster
from predictor.evaluation.reactions import Reaction, Shifts, false_reaction, reaction
from predictor.evaluation.standard_errors import Estimate
from predictor.support.progress import WorkShown


@dataclass(frozen=True, kw_only=True)
class ReactionRun(CauseRun):
    """Settings of the measurement in one environment."""

    perturbations: int
    """Number of perturbations of each cell."""
    horizon_steps: int | None = None
    """Number of steps forecast and played; None takes the first checkpoint's."""
    stores: tuple[str, ...] = ()
    """Stores to fit nearest neighbours to; empty leaves them out."""


@dataclass(frozen=True)
class CellReactions:
    """Reactions to one kind of perturbation."""

    name: str
    """Name of the cell."""
    pairs: int
    """Number of perturbations that count."""
    reactions: dict[str, Reaction]
    """Reaction of each forecaster, by name; empty if nothing was found."""
    on_path: dict[str, Reaction]
    """Reaction over the receivers that keep to their path in both branches; empty off the roads and of bystanders."""
    false_reactions: dict[str, Estimate | None]
    """False reaction of each forecaster in a cell of bystanders; empty in others."""
    crashed: int = 0
    """Number of perturbations that do not count, because the receiver crashes in one of the branches."""


@dataclass(frozen=True)
class EnvReactions:
    """Reactions in one environment."""

    env_id: str
    """Id of the environment."""
    driver: str
    """Name of the driver."""
    dt_s: float
    """Time step [s]."""
    horizon_steps: int
    """Number of steps forecast and played."""
    asked: int
    """Number of perturbations that were asked for in each cell."""
    episodes: int
    """Number of episodes that were enough, or all that were allowed."""
    cells: list[CellReactions]
    """Cells, in the order of the table."""
    misfits: dict[str, str]
    """Reason for each checkpoint that was left out, by its name."""
    perturbations: list[Perturbation]
    """All perturbations, with their shifts."""
    env_kwargs: str = ""
    """Arguments of the environment, as the text of a JSON object; empty for none."""

    @property
    def env(self) -> str:
        """Id of the environment, with its arguments where it had some."""
        return name_with(self.env_id, self.env_kwargs)


def measure_reactions(run: ReactionRun) -> EnvReactions:
    """Plays the episodes of one environment and summarises the reactions of all forecasters.

    The result does not depend on the number of workers: perturbations are taken in the order of the episodes.

    Raises:
        UserError: the environment cannot be perturbed or copied, checkpoints perceive differently, or none fits.
    """
    world = run.open()
    spec, names = world.spec, [cell.name for cell in cells_of(world)]
    kinds_of(world)
    world.close()
    fitting, misfits = fitting_checkpoints(run.env_id, run.checkpoints, spec)
    horizon = run.horizon_steps or load_forecaster(fitting[0], spec, run.env_id).horizon_steps
    found, episodes = _play_until_enough(run, fitting, horizon, names)
    return EnvReactions(
        run.env_id,
        run.driver,
        spec.dt_s,
        horizon,
        run.perturbations,
        episodes,
        [_cell(name, found) for name in names],
        misfits,
        found,
        run.env_kwargs,
    )


def _play_until_enough(
    run: ReactionRun, checkpoints: tuple[str, ...], horizon_steps: int, names: Sequence[str]
) -> tuple[list[Perturbation], int]:
    """Returns the first perturbations of each cell, and the number of episodes that they took."""
    found: dict[str, list[Perturbation]] = {name: [] for name in names}
    played, needed = 0, 0
    with (
        run.pool(play_reactions) as pool,
        WorkShown(f"reactions {run.env_id}", len(names) * run.perturbations) as shown,
    ):
        while played < run.episodes:
            wanted = tuple(name for name in names if _count(found[name]) < run.perturbations)
            if not wanted:
                break
            wave = range(played, min(played + 2 * pool.size, run.episodes))
            tasks = [
                ReactionTask(
                    **run.of_episode(i, checkpoints), horizon_steps=horizon_steps, cells=wanted, stores=run.stores
                )
                for i in wave
            ]
            for episode, ones in zip(wave, pool.results(tasks), strict=True):
                for one in ones:
                    if _count(found[one.cell]) < run.perturbations:
                        found[one.cell].append(one)
                        needed = episode + 1
                        shown.advance(not one.crashed)
            played = wave.stop
    enough = all(_count(ones) == run.perturbations for ones in found.values())
    return [one for ones in found.values() for one in ones], needed if enough else played


def _count(found: Sequence[Perturbation]) -> int:
    """Returns how many perturbations count."""
    return sum(not one.crashed for one in found)


def _shifts_of(found: Sequence[Perturbation]) -> dict[str, Shifts]:
    """Returns the shifts of one cell, by forecaster."""
    if not found:
        return {}
    true_m, episode = np.stack([one.true_m for one in found]), np.array([one.seed for one in found])
    return {
        name: Shifts(true_m, np.stack([one.predicted_m[name] for one in found]), episode)
        for name in found[0].predicted_m
    }


def _cell(name: str, found: Sequence[Perturbation]) -> CellReactions:
    """Returns the reactions of a cell; slope and correlation where receivers truly move."""
    own = [one for one in found if one.cell == name and not one.crashed]
    crashed = sum(one.cell == name and one.crashed for one in found)
    shifts = _shifts_of(own)
    reactions = {forecaster: reaction(one) for forecaster, one in shifts.items()}
    if name not in FALSE_BESIDE:
        on_path = _shifts_of([one for one in own if one.swerved is False])
        kept = {forecaster: reaction(one) for forecaster, one in on_path.items()}
        return CellReactions(name, len(own), reactions, kept, {}, crashed)
    still = {
        forecaster: replace(one, slope=None, correlation=None, correlation_of_steps=None)
        for forecaster, one in reactions.items()
    }
    beside = _shifts_of([one for one in found if one.cell == FALSE_BESIDE[name] and not one.crashed])
    false = {key: false_reaction(one, beside[key]) if beside else None for key, one in shifts.items()}
    return CellReactions(name, len(own), still, {}, false, crashed)
