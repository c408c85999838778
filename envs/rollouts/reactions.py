"""Perturbs agents of running episodes and pairs the true shifts of receivers with the predicted ones.

At random steps the world is branched (`envs.rollouts.branches`): one agent loses speed at once, or is taken out. The
true shift is where a receiver is in that branch, minus where it is in the plain one. The predicted shift is the
difference of two forecasts of one forecaster, whose history is the same up to the last step: one of the scene as it
is, one of the scene as perturbed. Each is the single forecast. The world goes on as if nothing had been
asked. `predictor.evaluation.reactions` makes numbers of the shifts.

Whether two cars touch turns on centimetres, and a crash is then a shift of tens of metres: perturbations of which the
receiver crashes in one branch are marked, and so are those in which it changes lane in one branch alone.
"""

import copy
import functools
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from envs.rollouts.branches import Branches, BranchPoint
from envs.rollouts.cause_run import FIRST_STEP, CauseTask
from envs.rollouts.foreseen import FORESEEN, foreseen_shift
from envs.rollouts.interventions import is_on_roads
from envs.rollouts.reaction_cells import Cell, cells_of, is_moved_as_asked, pairs_of
from envs.rollouts.side_forecasts import SideForecaster, checkpoint_forecasters
from envs.rollouts.world import World
from envs.seeding import Purpose, episode_rng
from envs.simulators.interventions import Intervention, NotAllowedError
from predictor.baselines.constant_velocity import ConstantVelocity
from predictor.baselines.nearest_neighbour import NearestNeighbour, fit_from_stores
from predictor.scene import Scene, SceneSpec

STRAIGHT, NEIGHBOURS = "constant velocity", "nearest neighbours"
"""Names of the forecasters that no checkpoint holds."""
SHARE = 0.15
"""Probability that agents are perturbed at a step."""
MOST_BRANCHES = 4
"""Largest number of interventions that are tried for one cell at one step."""

SAME_PATH_M = 2.0
"""Largest distance of two paths that count as one [m]: half a lane's width."""


@dataclass(frozen=True, kw_only=True)
class ReactionTask(CauseTask):
    """Settings of one episode; can be pickled."""

    horizon_steps: int
    """Number of steps forecast and played."""
    cells: tuple[str, ...]
    """Names of the cells to measure; what is found in one does not depend on the others."""
    stores: tuple[str, ...] = ()
    """Stores to fit nearest neighbours to; empty leaves them out."""


@dataclass(frozen=True)
class Perturbation:
    """One perturbation and the shifts of one receiver."""

    cell: str
    """Name of the cell."""
    seed: int
    """Seed of the episode."""
    step: int
    """Step of the episode."""
    sender: int
    """Id of the agent that was perturbed."""
    receiver: int
    """Id of the agent whose shifts these are."""
    true_m: Float[np.ndarray, "horizon axes"]
    """True shift [m], world axes."""
    predicted_m: dict[str, Float[np.ndarray, "horizon axes"]]
    """Predicted shift [m], by forecaster."""
    crashed: bool = False
    """Whether the receiver crashes in one of the branches."""
    swerved: bool | None = None
    """Whether it leaves the path that it takes in the other branch, as by a change of lane; None off the roads."""


def play_reactions(task: ReactionTask) -> list[Perturbation]:
    """Plays one episode and returns its perturbations."""
    world = task.opened()
    forecasters = _forecasters(task, world.spec)
    rng = episode_rng(task.seed, Purpose.REACTIONS)
    found: list[Perturbation] = []
    for step in range(task.max_steps):
        chosen = rng.random() < SHARE and step >= FIRST_STEP
        before = copy.deepcopy(forecasters) if chosen else {}
        for forecaster in forecasters.values():
            forecaster.observe(world.perceived())
        if chosen:
            moment = Moment(world, before, forecasters, task.horizon_steps, task.hidden_draws)
            cells = cells_of(world)
            for cell, own in zip(cells, rng.spawn(len(cells)), strict=True):
                if cell.name in task.cells and (one := moment.perturbed(cell, own)) is not None:
                    found.append(replace(one, seed=task.seed, step=step))
        if world.step():
            break
    return found


class Moment:
    """One step of a running world at which perturbations are tried.

    Args:
        world: the world; it is not changed.
        before: forecasters that have not observed the present scene yet.
        now: the same forecasters, which have.
        horizon_steps: number of steps to forecast and to play.
        hidden_draws: number of worlds that look the same, of which the mean is foreseen; 0 for none.
    """

    def __init__(
        self,
        world: World,
        before: Mapping[str, SideForecaster],
        now: Mapping[str, SideForecaster],
        horizon_steps: int,
        hidden_draws: int = 0,
    ) -> None:
        """Keeps all, and plays nothing before it is needed."""
        self._world, self._before, self._now, self._horizon = world, before, now, horizon_steps
        self._draws = hidden_draws
        self._scene = world.perceived()
        self._tried: dict[Intervention, Branches | None] = {}

    def perturbed(self, cell: Cell, rng: np.random.Generator) -> Perturbation | None:
        """Returns one random perturbation of a kind, with the true and the predicted shifts.

        None if none was found: pairs are tried in random order, with at most `MOST_BRANCHES` interventions.
        """
        pairs = pairs_of(cell, self._world)
        tried: set[Intervention] = set()
        for index in rng.permutation(len(pairs)):
            receiver, sender = pairs[index]
            intervention = cell.intervention(sender, self._horizon)
            if intervention not in tried and len(tried) == MOST_BRANCHES:
                continue
            tried.add(intervention)
            branches = self._branches(intervention)
            true_m = None if branches is None else branches.shift_of(receiver)
            if branches is None or true_m is None or not is_moved_as_asked(cell, self._world, true_m):
                continue
            predicted_m = self._predicted(branches.perturbed.perceived[0], receiver)
            if predicted_m is not None:
                if self._draws:
                    drawn = self._world, intervention, receiver, self._horizon, self._draws, rng
                    predicted_m |= {name: foreseen_shift(*drawn, perceived_only=one) for name, one in FORESEEN.items()}
                crashed = receiver in branches.crashed
                swerved = _swerved(branches, receiver) if is_on_roads(self._world) else None
                return Perturbation(cell.name, 0, 0, sender, receiver, true_m, predicted_m, crashed, swerved)
        return None

    @functools.cached_property
    def _point(self) -> BranchPoint:
        return BranchPoint(self._world, self._horizon)

    @functools.cached_property
    def _plain(self) -> dict[str, Float[np.ndarray, "agents horizon axes"]]:
        """Forecasts of the plain scene, by forecaster; their noise is not used up."""
        return {name: _positions(copy.deepcopy(forecaster)) for name, forecaster in self._now.items()}

    def _branches(self, intervention: Intervention) -> Branches | None:
        """Returns what an intervention does, played once; None if the agent does not allow it."""
        if intervention not in self._tried:
            try:
                self._tried[intervention] = self._point.perturbed(intervention)
            except NotAllowedError:  # one that does not act by itself
                self._tried[intervention] = None
        return self._tried[intervention]

    def _predicted(self, scene: Scene, receiver: int) -> dict[str, Float[np.ndarray, "horizon axes"]] | None:
        """Returns the predicted shifts of a receiver; None if the perturbed scene does not have it."""
        places = _place(scene, receiver), _place(self._scene, receiver)
        if places[0] is None or places[1] is None:
            return None
        shifts = {}
        for name, forecaster in self._before.items():
            fork = copy.deepcopy(forecaster)
            fork.observe(scene)
            shifts[name] = _positions(fork)[places[0]] - self._plain[name][places[1]]
        return shifts


def _positions(forecaster: SideForecaster) -> Float[np.ndarray, "agents horizon axes"]:
    """Returns the single forecast of the latest scene [m]; its origin, if any, is where the ego is now."""
    return forecaster.forecast().xy[0, 0].cpu().numpy().astype(np.float64)


def _place(scene: Scene, agent: int) -> int | None:
    """Returns an agent's index in a scene; None if it is not there."""
    found = np.flatnonzero(scene.valid & (scene.ids == agent))
    return int(found[0]) if len(found) else None


def _swerved(branches: Branches, receiver: int) -> bool:
    """Returns whether the receiver's paths in the two branches lie more than `SAME_PATH_M` apart somewhere.

    Compared are the places of the branch in which it comes less far with the line through those of the other one, so
    that who only drives slower or faster does not swerve.
    """
    column, axes = branches.ids.tolist().index(receiver), branches.axes
    paths = [branch.states[:, column, :axes] for branch in (branches.plain, branches.perturbed)]
    short, long = sorted(paths, key=lambda path: float(np.linalg.norm(np.diff(path, axis=0), axis=-1).sum()))
    begins, along = long[:-1], np.diff(long, axis=0)
    squares = np.maximum(np.square(along).sum(axis=-1), 1e-12)
    share = np.clip(((short[:, None] - begins) * along).sum(axis=-1) / squares, 0.0, 1.0)
    apart_m = np.linalg.norm(short[:, None] - begins - share[..., None] * along, axis=-1).min(axis=1)
    return bool(apart_m.max() > SAME_PATH_M)


@functools.lru_cache(maxsize=2)
def _kept_neighbours(stores: tuple[str, ...], spec: SceneSpec, horizon_steps: int, env_id: str) -> NearestNeighbour:
    return fit_from_stores([Path(store) for store in stores], spec, horizon_steps, f"env '{env_id}'")


def _forecasters(task: ReactionTask, spec: SceneSpec) -> dict[str, SideForecaster]:
    """Returns new forecasters for an episode, by name."""
    found = checkpoint_forecasters(task.checkpoints, spec, task.env_id)
    if task.stores:
        found[NEIGHBOURS] = _kept_neighbours(task.stores, spec, task.horizon_steps, task.env_id)
    found[STRAIGHT] = ConstantVelocity(spec)
    return {name: SideForecaster(forecaster, spec, task.horizon_steps) for name, forecaster in found.items()}
