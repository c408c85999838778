from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from highway_env.vehicle.objects import Obstacle

from envs.plans import plan_model_for
from envs.rollouts import cause_run, plan_moments
from envs.rollouts.branches import BranchPoint, copied
from envs.rollouts.cause_run import EVERY, FIRST_STEP
from envs.rollouts.foreseen import FORESEEN
from envs.rollouts.plan_moments import STRAIGHT, PlanTask, moment, play_plans
from envs.rollouts.side_forecasts import SideForecaster
from envs.rollouts.world import EgoWorld, open_world
from envs.seeding import Purpose, episode_rng
from predictor.baselines.constant_velocity import ConstantVelocity
from predictor.support.errors import UserError
from tests.envs.evaluation import TAG, forget
from tests.envs.interventions import assert_same_scenes, played, road_world

OWN = "tests.envs.own_plans:"
HORIZON = 4
SLOW_AHEAD = ((60.0, 8.0), (300.0, 0.0))
"""A driver 60 m ahead of the ego on its lane (id 1), and one out of sight on another (id 2)."""


@pytest.fixture(autouse=True)
def nothing_is_kept() -> Iterator[None]:
    forget()
    yield
    forget()


def slow_ahead() -> EgoWorld:
    """The ego at 25 m/s, by now 45 m behind a driver that stays at 10 m/s."""
    world = road_world(*SLOW_AHEAD, ego_m=(0.0, 8.0), speed_mps=10.0)
    simulator: Any = world.env.unwrapped
    simulator.vehicle.speed = simulator.vehicle.target_speed = 25.0
    world.step()
    return world


def observed(world: EgoWorld) -> dict[str, SideForecaster]:
    forecaster = SideForecaster(ConstantVelocity(world.spec), world.spec, HORIZON)
    forecaster.observe(world.perceived())
    return {STRAIGHT: forecaster}


def test_a_plan_that_runs_into_the_car_ahead_collides_and_is_the_riskiest():
    world = slow_ahead()
    model = plan_model_for(world.env)
    found = moment(world, model, observed(world), 0, 0, HORIZON)
    outcome = dict(zip(model.names, found.crashed[1:], strict=True))
    assert outcome["IDLE"] and outcome["FASTER"] and not outcome["LANE_LEFT"]
    assert found.crashed[0] == outcome["IDLE"]  # its own driver is idle
    risk = dict(zip(model.names, found.risk[STRAIGHT], strict=True))
    assert risk["FASTER"] == risk["IDLE"] == 1.0 and risk["LANE_LEFT"] == 0.0


def test_whoever_knows_the_drivers_is_asked_only_where_there_is_a_choice():
    world = road_world((300.0, 0.0), ego_m=(0.0, 8.0))
    world.step()
    found = moment(world, plan_model_for(world.env), observed(world), 0, 3, HORIZON, hidden_draws=2)
    assert not found.crashed.any() and [*found.risk] == [STRAIGHT]


def test_both_who_know_the_drivers_are_asked(monkeypatch: pytest.MonkeyPatch):
    asked: list[bool] = []

    def risk(*given: Any, perceived_only: bool) -> np.ndarray:
        asked.append(perceived_only)
        return np.zeros(len(given[1]))

    monkeypatch.setattr(plan_moments, "foreseen_risk", risk)
    world = slow_ahead()
    moment(world, plan_model_for(world.env), observed(world), 0, 3, HORIZON, hidden_draws=2)
    assert asked == [False, True]


def test_an_episode_hands_the_number_of_draws_on(monkeypatch: pytest.MonkeyPatch):
    handed: list[int] = []
    ask = plan_moments.moment
    monkeypatch.setattr(plan_moments, "moment", lambda *given: handed.append(given[6]) or ask(*given))
    play_plans(replace(plan_task("highway-fast-v0", "idle", 0, 9, 2), hidden_draws=3))
    assert handed and set(handed) == {3}


def test_whoever_knows_the_drivers_has_risks_and_no_errors():
    """Nothing is hidden on that road but the driver of the ego, whom plans replace."""
    world = slow_ahead()
    model = plan_model_for(world.env)
    plain = moment(world, model, observed(world), 0, 3, HORIZON)
    found = moment(world, model, observed(world), 0, 3, HORIZON, hidden_draws=2)
    assert [*found.risk] == [STRAIGHT, *FORESEEN] and [*plain.risk] == [STRAIGHT]
    for name in FORESEEN:
        np.testing.assert_array_equal(found.risk[name], found.crashed[1:])
        assert name not in found.with_m | found.without_m | found.risk_of_planner
    np.testing.assert_array_equal(found.risk[STRAIGHT], plain.risk[STRAIGHT])


class Wide:
    """The plan model of highway-env with so large a margin that nobody can pass."""

    def __init__(self, model: Any) -> None:
        self._model, self.names = model, model.names

    def plans(self, env: Any, horizon_steps: int) -> Any:
        return replace(self._model.plans(env, horizon_steps), margin_m=9.0)


def test_the_planners_risk_has_its_margin_around_every_agent():
    world = slow_ahead()
    usual, wide = (moment(world, model, observed(world), 0, 0, HORIZON)
                   for model in (plan_model_for(world.env), Wide(plan_model_for(world.env))))  # fmt: skip
    left = plan_model_for(world.env).names.index("LANE_LEFT")
    assert usual.risk_of_planner[STRAIGHT][left] == 0.0 and wide.risk_of_planner[STRAIGHT][left] == 1.0
    np.testing.assert_array_equal(usual.risk[STRAIGHT], wide.risk[STRAIGHT])


def test_a_plan_that_runs_into_an_obstacle_collides_and_is_risky():
    world = road_world((300.0, 0.0), ego_m=(0.0, 8.0), speed_mps=25.0)
    simulator: Any = world.env.unwrapped
    simulator.road.objects.append(Obstacle(simulator.road, simulator.vehicle.position + [70.0, 0.0]))
    world.step()
    model = plan_model_for(world.env)
    found = moment(world, model, observed(world), 0, 0, HORIZON)
    outcome, risk = (dict(zip(model.names, of, strict=True)) for of in (found.crashed[1:], found.risk[STRAIGHT]))
    assert outcome["IDLE"] and risk["IDLE"] == 1.0
    assert not outcome["LANE_LEFT"] and risk["LANE_LEFT"] == 0.0


def test_errors_are_those_of_the_others_where_nobody_collides():
    world = slow_ahead()
    found = moment(world, plan_model_for(world.env), observed(world), 0, 0, HORIZON)
    assert found.agents.tolist() == [0 if crashed else 1 for crashed in found.crashed]  # one is out of sight
    safe = ~found.crashed
    assert (found.without_m[STRAIGHT][~safe] == 0).all()
    point = BranchPoint(world, HORIZON)
    straight_m = 70.0 + 10.0 * np.arange(1, HORIZON + 1)
    index = point.ids.tolist().index(1)
    branch = point.driven(lambda obs: world.env.unwrapped.action_type.actions_indexes["LANE_LEFT"])  # type: ignore[attr-defined]
    true_m = branch.states[1:, index, :2]
    expected = np.hypot(true_m[:, 0] - straight_m, true_m[:, 1] - 8.0).mean()
    left = 1 + plan_model_for(world.env).names.index("LANE_LEFT")
    assert found.without_m[STRAIGHT][left] == pytest.approx(expected, abs=0.05)
    np.testing.assert_array_equal(found.without_m[STRAIGHT], found.with_m[STRAIGHT])  # it does not react


@pytest.mark.slow
def test_the_world_is_not_touched_and_another_driver_holds_in_the_copy_alone():
    first, second = open_world("highway-fast-v0", "varied"), open_world("highway-fast-v0", "varied")
    assert isinstance(first, EgoWorld)
    first.reset(3)
    second.reset(3)
    scene = first.full_scene()
    moment(first, plan_model_for(first.env), observed(first), 3, 0, HORIZON)
    assert_same_scenes([first.full_scene()], [scene])
    assert_same_scenes(played(first, 5), played(second, 5))


def test_the_true_plan_is_what_the_ego_does_in_the_plain_branch(monkeypatch: pytest.MonkeyPatch):
    world = slow_ahead()
    given: list[np.ndarray] = []
    original = SideForecaster.forecast_plans

    def noting(self: SideForecaster, plans: np.ndarray) -> Any:
        given.append(plans)
        return original(self, plans)

    monkeypatch.setattr(SideForecaster, "forecast_plans", noting)
    model = plan_model_for(world.env)
    moment(world, model, observed(world), 0, 0, HORIZON)
    (plans,) = given
    assert plans.shape == (1 + len(model.names), HORIZON, 4)
    np.testing.assert_array_equal(plans[0], [scene.states[0] for scene in played(copied(world), HORIZON)])


def plan_task(env_id: str, driver: str, seed: int, max_steps: int, horizon_steps: int) -> PlanTask:
    return PlanTask(
        env_id=env_id,
        driver=driver,
        checkpoints=("constant-velocity",),
        seed=seed,
        max_steps=max_steps,
        horizon_steps=horizon_steps,
    )


@pytest.mark.slow
def test_moments_come_at_every_fifth_step_from_a_random_one_on():
    task = plan_task("highway-fast-v0", "idle", 7, 16, 2)
    moments = play_plans(task)
    first = int(episode_rng(7, Purpose.PLANS).integers(EVERY))
    assert moments and all(m.step % EVERY == first and m.step >= FIRST_STEP and m.seed == 7 for m in moments)
    again = play_plans(task)
    for one, other in zip(moments, again, strict=True):
        np.testing.assert_array_equal(one.crashed, other.crashed)
        np.testing.assert_array_equal(one.without_m[STRAIGHT], other.without_m[STRAIGHT])


def own_moments(env_id: str, driver: str, monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Steps of the moments of an episode of seed 8 with a horizon of four steps, each step one if it counts."""
    monkeypatch.setattr(cause_run, "EVERY", 1)
    return [found.step for found in play_plans(plan_task(OWN + env_id, driver, 8, 30, 4))]


def test_plans_that_a_time_limit_cuts_are_no_moments(monkeypatch: pytest.MonkeyPatch):
    assert own_moments("Short-v0", "idle", monkeypatch) == [3, 4, 5], "9 steps, of which 4 follow each"


def test_there_are_no_moments_after_a_collision_that_ends_no_episode(monkeypatch: pytest.MonkeyPatch):
    world = open_world(OWN + "Planned-v0", "random")
    assert isinstance(world, EgoWorld)
    world.reset(8)
    hit = next(step for step in range(30) if world.step() or world.crashed)
    assert own_moments("Planned-v0", "random", monkeypatch) == list(range(3, hit + 1)) and hit == 11


def test_plans_without_later_actions_cannot_be_played():
    world = slow_ahead()
    model = plan_model_for(world.env)

    class First:
        names = model.names

        def plans(self, env: Any, horizon_steps: int) -> Any:
            return replace(model.plans(env, horizon_steps), later_actions=None)

    with pytest.raises(UserError, match="plan model First gives the first action of each plan alone; give later_act"):
        moment(world, First(), observed(world), 0, 0, HORIZON)


def test_only_an_ego_can_be_handed_over():
    world = open_world(TAG, "heuristic")
    world.reset(0)
    with pytest.raises(UserError, match="needs an environment with one ego, this one has several"):
        BranchPoint(world, 1).driven(lambda obs: 0)


def test_modes_are_as_many_as_the_planner_takes():
    from envs.drivers import planner

    assert plan_moments.MODES == planner.MODES
