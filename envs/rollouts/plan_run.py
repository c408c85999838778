"""Measures what-if forecasts in one environment: errors with and without the ego's plan, and choices between plans."""

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from envs.plans import plan_model_for
from envs.readers import outcome_keys
from envs.registry import name_with
from envs.rollouts.branches import copied
from envs.rollouts.cause_run import EVERY, FIRST_STEP, CauseRun
from envs.rollouts.interventions import knows_bodies
from envs.rollouts.plan_moments import PlanMoment, PlanTask, play_plans
from envs.rollouts.side_forecasts import fitting_checkpoints
from envs.rollouts.world import open_to_look
from predictor.checkpoint import load_forecaster
from predictor.evaluation.standard_errors import Estimate, estimate, quotient
from predictor.support.errors import UserError
from predictor.support.progress import track


@dataclass(frozen=True, kw_only=True)
class PlanRun(CauseRun):
    """Settings of the measurement in one environment."""

    horizon_steps: int | None = None
    """Number of steps forecast and played; None takes the first checkpoint's."""


@dataclass(frozen=True)
class Benefit:
    """Errors of the others' single forecasts without and with the ego's plan; None where nothing is compared."""

    agents: int
    """Number of forecasts."""
    without_m: float | None
    """Mean displacement of the forecasts that know no plan [m]."""
    with_m: float | None
    """Mean displacement with the plan given [m]."""
    reduction: Estimate | None
    """1 − with / without, paired; above 0 the plan helps."""


@dataclass(frozen=True)
class PlanScores:
    """Scores of one forecaster."""

    own: Benefit
    """With the true plan given: what the ego then did."""
    plans: Benefit
    """With the plans of the plan model, each against what followed when it was played."""
    choices: int
    """Number of pairs of plans of one moment of which one alone ended in a collision."""
    right: Estimate | None
    """Share of those pairs in which that plan had the higher risk; equal risks count half."""
    right_of_planner: Estimate | None
    """Share of those pairs that the risk with the planner's margin orders so."""
    brier: Estimate | None
    """Mean squared difference of risk and outcome over all plans."""


@dataclass(frozen=True)
class EnvPlans:
    """Scores of what-if forecasts in one environment."""

    env_id: str
    """Id of the environment."""
    driver: str
    """Name of the driver."""
    dt_s: float
    """Time step [s]."""
    horizon_steps: int
    """Number of steps forecast and played."""
    episodes: int
    """Number of episodes with a moment, of those that were played."""
    plan_names: tuple[str, ...]
    """Name of each plan."""
    moments: int
    """Number of moments."""
    crashed: list[float]
    """Share of the moments in which each plan ended in a collision."""
    scores: dict[str, PlanScores]
    """Scores by forecaster; whoever knows the drivers (`envs.rollouts.foreseen`) has that of its choices alone."""
    misfits: dict[str, str]
    """Reason for each checkpoint that was left out, by its name."""
    env_kwargs: str = ""
    """Arguments of the environment, as the text of a JSON object; empty for none."""

    @property
    def env(self) -> str:
        """Id of the environment, with its arguments where it had some."""
        return name_with(self.env_id, self.env_kwargs)


def check_has_plans(env_id: str, driver: str, env_kwargs: str = "") -> None:
    """Checks that the ego of an environment has plans, and that these can be played and judged.

    A trained policy (.zip) is not loaded for it: the environment is opened with an idle ego.

    Raises:
        UserError: it has none, the environment cannot be copied or reports no crashes, or it is unknown.
    """
    with closing(open_to_look(env_id, driver, env_kwargs)) as world:
        if not world.spec.has_ego:
            raise UserError(f"plans are those of one ego, and {env_id} has several agents; use an env with one ego")
        plan_model_for(world.env)
        if not knows_bodies(world) and not outcome_keys(world.env).crash:
            raise UserError(
                f"{env_id} does not report crashes, with which the risk of a plan is compared; name the key of its "
                "infos: register_reader(..., crash_key=...)"
            )
        world.reset(0)
        try:
            copied(world)
        except UserError:
            raise
        except Exception as error:
            raise UserError(
                f"plans are played in copies, and copy.deepcopy of {env_id} failed ({type(error).__name__}: {error}); "
                "make its class copyable (__deepcopy__)"
            ) from error


def measure_plans(run: PlanRun) -> EnvPlans:
    """Plays the episodes of one environment and scores all forecasters on the same moments.

    Raises:
        UserError: the environment has no plan model, cannot be copied, checkpoints perceive differently, none fits, or
            no episode is long enough.
    """
    check_has_plans(run.env_id, run.driver, run.env_kwargs)
    with closing(run.open()) as world:
        spec = world.spec
        world.reset(run.seed)
        names = plan_model_for(world.env).names
    fitting, misfits = fitting_checkpoints(run.env_id, run.checkpoints, spec)
    horizon = run.horizon_steps or load_forecaster(fitting[0], spec, run.env_id).horizon_steps
    tasks = [PlanTask(**run.of_episode(i, fitting), horizon_steps=horizon) for i in range(run.episodes)]
    with run.pool(play_plans) as pool:
        played = pool.results(tasks)
        episodes = [found for found in track(played, f"plans {run.env_id}", total=len(tasks)) if found]
    if not episodes:
        raise UserError(
            f"{run.env_id}: none of {run.episodes} episodes has a step to measure, every {EVERY}th from a random one "
            f"on, after {FIRST_STEP} others; add --episodes, or raise --max-steps ({run.max_steps})"
        )
    moments = [moment for found in episodes for moment in found]
    crashed = np.mean([moment.crashed[1:] for moment in moments], axis=0)
    return EnvPlans(
        run.env_id,
        run.driver,
        spec.dt_s,
        horizon,
        len(episodes),
        names,
        len(moments),
        crashed.tolist(),
        {name: scores_of(episodes, name) for name in dict.fromkeys(name for moment in moments for name in moment.risk)},
        misfits,
        run.env_kwargs,
    )


def scores_of(episodes: Sequence[Sequence[PlanMoment]], name: str) -> PlanScores:
    """Returns the scores of one forecaster.

    Args:
        episodes: moments of each episode.
        name: name of the forecaster.
    """
    own, plans, choices, guarded, squares = (
        np.array(sums) for sums in zip(*(_sums(found, name) for found in episodes), strict=True)
    )
    return PlanScores(
        _benefit(own), _benefit(plans), int(choices[:, 1].sum()), _share(choices), _share(guarded), _share(squares)
    )


def _sums(moments: Sequence[PlanMoment], name: str) -> tuple[Float[np.ndarray, " parts"], ...]:
    """Returns the sums of an episode: errors without, with and agents (own, plans), right and all choices, squares.

    The choices are by the risk, and by the risk with the planner's margin.
    """
    forecast = [m for m in moments if name in m.with_m]  # all, or of whoever has risks alone none
    none = [np.zeros(len(moments[0].crashed))] * 3
    errors = np.array([[m.without_m[name], m.with_m[name], m.agents] for m in forecast] or [none])
    squares = [[((m.risk[name] - m.crashed[1:]) ** 2).sum(), len(m.risk[name])] for m in forecast]
    choices, guarded = (
        [right_choices(risk[name], m.crashed[1:]) for m, risk in zip(moments, risks, strict=True) if name in risk]
        for risks in ([m.risk for m in moments], [m.risk_of_planner for m in moments])
    )
    counts = (np.sum([(0.0, 0), *pairs], axis=0) for pairs in (choices, guarded, squares))
    return errors[:, :, 0].sum(axis=0), errors[:, :, 1:].sum(axis=(0, 2)), *counts


def right_choices(risk: Float[np.ndarray, " plans"], crashed: Bool[np.ndarray, " plans"]) -> tuple[float, int]:
    """Returns how many pairs of a plan that collides and one that does not have their risks in order, and all pairs."""
    ahead = risk[crashed][:, None] - risk[~crashed]
    return float((ahead > 0).sum() + 0.5 * (ahead == 0).sum()), ahead.size


def _benefit(sums: Float[np.ndarray, "episodes 3"]) -> Benefit:
    without, given, agents = sums.sum(axis=0)
    if not agents:
        return Benefit(0, None, None, None)
    reduction = estimate(sums, lambda drawn: 1 - quotient(drawn[:, 1], drawn[:, 0]))
    return Benefit(int(agents), float(without / agents), float(given / agents), reduction)


def _share(sums: Float[np.ndarray, "episodes 2"]) -> Estimate | None:
    return estimate(sums, lambda drawn: quotient(drawn[:, 0], drawn[:, 1]))
