"""Plays episodes, and what follows at some of their steps if the ego takes each plan, for `envs.evaluate --plans`.

At every fifth step, from a random one on, the world is copied and played for the horizon with the ego's own driver, and
with each plan of the environment's plan model, all with equal random numbers. Each forecaster says beforehand what the
others will do if the ego does what it then did, or follows the plan; and how likely the plan ends in a collision.
"""

import functools
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from envs.drivers.planner import MODES
from envs.plans import PlanModel, checked_plans, plan_model_for
from envs.plans.base import Plans
from envs.plans.contact import contacts
from envs.rollouts.branches import Branch, BranchPoint
from envs.rollouts.cause_run import CauseTask
from envs.rollouts.foreseen import FORESEEN, foreseen_risk
from envs.rollouts.moving import moving_agents
from envs.rollouts.reactions import STRAIGHT
from envs.rollouts.side_forecasts import SideForecaster, checkpoint_forecasters
from envs.rollouts.world import EgoWorld, World
from envs.seeding import Purpose, episode_rng
from predictor.baselines.constant_velocity import ConstantVelocity
from predictor.forecaster import has_scale
from predictor.scene import Forecast, Scene, SceneBatch
from predictor.support.errors import UserError


@dataclass(frozen=True, kw_only=True)
class PlanTask(CauseTask):
    """Settings of one episode; can be pickled."""

    horizon_steps: int
    """Number of steps forecast and played."""


@dataclass(frozen=True)
class PlanMoment:
    """One step of an episode with what followed; branch 0 is the ego's own driver, the others are its plans."""

    seed: int
    """Seed of the episode."""
    step: int
    """Step within the episode."""
    crashed: Bool[np.ndarray, " branches"]
    """Whether the ego had collided by the end of the horizon."""
    whole: bool
    """Whether every branch reached the end of the horizon or of the episode, or a collision; not a time limit."""
    agents: Int[np.ndarray, " branches"]
    """Number of agents whose forecasts are compared: perceived, there for the whole horizon; 0 after a collision."""
    without_m: dict[str, Float[np.ndarray, " branches"]]
    """Sum over those agents of the mean displacement of the single forecast that knows no plan, by forecaster [m]."""
    with_m: dict[str, Float[np.ndarray, " branches"]]
    """Such a sum for the forecast that is given the plan; in branch 0 the plan is what the ego then did."""
    risk: dict[str, Float[np.ndarray, " plans"]]
    """Forecast probability of a collision within the horizon, by forecaster; the own driver has none. Whoever knows the
    drivers (`envs.rollouts.foreseen`) has this alone, and only where some plans collide and others do not."""
    risk_of_planner: dict[str, Float[np.ndarray, " plans"]]
    """Forecast probability with the plan model's margin around every agent, by which the planner chooses."""


def play_plans(task: PlanTask) -> list[PlanMoment]:
    """Plays one episode, to its end or a collision of the ego, and returns its moments.

    Those after which the time limit ends a branch without a collision are left out: what follows is not known.
    """
    world = task.opened()
    model = plan_model_for(world.env)
    found = {STRAIGHT: ConstantVelocity(world.spec)} | checkpoint_forecasters(task.checkpoints, world.spec, task.env_id)
    forecasters = {
        name: SideForecaster(
            forecaster, world.spec, task.horizon_steps, samples=MODES if has_scale(forecaster) else 1, seed=task.seed
        )
        for name, forecaster in found.items()
    }
    measured, moments = task.measured_steps(Purpose.PLANS), []
    for step in range(task.max_steps):
        for forecaster in forecasters.values():
            forecaster.observe(world.perceived())
        if step in measured:
            asked = moment(world, model, forecasters, task.seed, step, task.horizon_steps, task.hidden_draws)
            if asked.whole:
                moments.append(asked)
        if world.step() or (isinstance(world, EgoWorld) and world.crashed):
            break  # a copy of a world that has crashed would count as another collision
    return moments


def moment(
    world: World,
    model: PlanModel,
    forecasters: dict[str, SideForecaster],
    seed: int,
    step: int,
    horizon_steps: int,
    hidden_draws: int = 0,
) -> PlanMoment:
    """Plays the present step with every plan.

    Args:
        world: a running world with one ego; it is not changed.
        model: source of the plans.
        forecasters: forecasters that have observed the present scene.
        seed: seed of the episode.
        step: step within the episode.
        horizon_steps: number of steps to play.
        hidden_draws: number of worlds that look the same, in which the plans are played as well; 0 for none.

    Raises:
        UserError: the environment cannot be copied, or its plan model does not say how plans go on.
    """
    scene = world.perceived()
    plans = checked_plans(model, world.env, horizon_steps, world.spec.num_features, scene, world.spec)
    point = BranchPoint(world, horizon_steps, perturbs=False)
    scripts = [functools.partial(_taking, actions) for actions in _scripts(plans, model)]
    played = [point.plain, *(point.driven(begun()) for begun in scripts)]
    ego = int(point.ids[0])
    crashed = np.array([ego in branch.crashed for branch in played])
    whole = all(hit or not branch.cut for hit, branch in zip(crashed, played, strict=True))
    future = [_future(scene, branch, point.ids) for branch in played]
    counted = [
        valid & moving_agents(scene, world.spec) & (not hit) for (_, valid), hit in zip(future, crashed, strict=True)
    ]
    for valid in counted:
        valid[0] = False  # the ego
    followed = np.concatenate([point.plain.states[None, 1:, 0], plans.states])
    without_m, with_m, risk, risk_of_planner = {}, {}, {}, {}
    for name, forecaster in forecasters.items():
        plain, planned = forecaster.forecast(), forecaster.forecast_plans(followed)
        without_m[name] = np.array(
            [_error_m(plain.xy[0, 0].cpu().numpy(), xy, ok) for (xy, _), ok in zip(future, counted, strict=True)]
        )
        with_m[name] = np.array(
            [
                _error_m(planned.xy[0, branch, 0].cpu().numpy(), xy, ok)
                for branch, ((xy, _), ok) in enumerate(zip(future, counted, strict=True))
            ]
        )
        risk[name] = _risk(planned, scene, plans, world.spec.dt_s, 0.0)
        risk_of_planner[name] = _risk(planned, scene, plans, world.spec.dt_s, plans.margin_m)
    if hidden_draws and len(set(crashed[1:].tolist())) == 2:  # it costs most, and elsewhere there is nothing to choose
        drawn = world, scripts, horizon_steps, hidden_draws, episode_rng(seed, Purpose.HIDDEN).spawn(step + 1)[step]
        risk |= {name: foreseen_risk(*drawn, perceived_only=only) for name, only in FORESEEN.items()}
    agents = np.array([ok.sum() for ok in counted])
    return PlanMoment(seed, step, crashed, whole, agents, without_m, with_m, risk, risk_of_planner)


def _taking(actions: Iterable[object]) -> Callable[[object], object]:
    """Returns a driver that takes these actions, whatever it sees."""
    left = iter(actions)
    return lambda _: next(left)


def _scripts(plans: Plans, model: PlanModel) -> list[tuple[object, ...]]:
    if plans.later_actions is None:
        raise UserError(
            f"plan model {type(model).__name__} gives the first action of each plan alone; give later_actions too, to "
            "have its plans played"
        )
    return [(first, *later) for first, later in zip(plans.actions, plans.later_actions, strict=True)]


def _future(
    scene: Scene, branch: Branch, ids: Int[np.ndarray, " present"]
) -> tuple[Float[np.ndarray, "agents horizon 2"], Bool[np.ndarray, " agents"]]:
    """Returns the true positions of the agents of a scene, relative to the ego's now, and who is there all the time."""
    column = {int(agent): i for i, agent in enumerate(ids)}
    place = np.array([column.get(int(agent), -1) for agent in scene.ids])
    there = scene.valid & (place >= 0)
    xy = branch.states[1:, place, :2].swapaxes(0, 1) - scene.states[0, :2]
    return xy, there & branch.valid[1:, place].all(axis=0)


def _error_m(
    forecast: Float[np.ndarray, "agents horizon 2"],
    future: Float[np.ndarray, "agents horizon 2"],
    counted: Bool[np.ndarray, " agents"],
) -> float:
    """Computes the sum over agents of the mean displacement [m]."""
    return float(np.linalg.norm(forecast[counted] - future[counted], axis=-1).mean(axis=-1).sum())


def _risk(planned: Forecast, scene: Scene, plans: Plans, dt_s: float, margin_m: float) -> Float[np.ndarray, " plans"]:
    """Computes the risk of each plan, as the planner does with this margin; the first entry is no plan's."""
    length_m, width_m = (size + margin_m for size in plans.size_m)  # half of it around each agent
    survival = contacts(planned, SceneBatch.stack([scene]), (length_m, width_m), dt_s).survival()[0, 1:, -1]
    if plans.crashed is not None:
        survival = survival * ~plans.crashed[:, -1]
    return 1.0 - survival
