"""The planner takes the best plan within its risk, ties and "all too risky" by rule, and drives highway-env."""

import os
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from highway_env.vehicle.objects import Obstacle

from envs.drivers.ego import make_ego_driver
from envs.drivers.planner import (
    Planner,
    PlannerConfig,
    choose,
    expected_rewards,
    forecaster_for,
    is_planner,
    planner_checkpoint,
    planner_config,
    planner_driver,
)
from envs.plans import Plans
from envs.readers.entities import EntityRowsReader
from envs.registry import make_env
from envs.wrappers import ForecastObservation, SceneObservation
from predictor.baselines.constant_velocity import ConstantVelocity, NoisyConstantVelocity
from predictor.checkpoint import WEIGHTS, load_checkpoint, resolve, weights_stamp
from predictor.scene import SceneSpec
from predictor.support.errors import UserError

ROAD = SceneSpec(dt_s=1.0, frame=("ego", "world"))


def plans_worth(*rewards: float, crash: float = -1.0) -> Plans:
    """Plans of two steps with these rewards in each."""
    table = np.repeat(np.array(rewards)[:, None], 2, axis=1)
    states = np.zeros((len(rewards), 2, 4))
    return Plans(states, tuple(range(len(rewards))), table, np.full_like(table, crash))


def surviving(*risks: float) -> np.ndarray:
    """No collision in the first step, one in the second with these probabilities."""
    return np.stack([np.ones(len(risks)), 1 - np.array(risks)], axis=1)


def test_where_no_checkpoint_ships_the_message_names_the_way_to_give_one():
    env = gym.make("tests.envs.own_plans:Planned-v0")
    env.reset(seed=0)
    with pytest.raises(UserError, match="no checkpoint ships for env .*Planned-v0': name the planner's forecaster, as"):
        planner_driver("planner", env, np.random.default_rng(0))
    assert planner_driver("planner:constant-velocity", env, np.random.default_rng(0)).plan_model.names == ("up", "down")


def test_the_value_counts_rewards_until_a_collision_and_its_reward_then():
    values = expected_rewards(plans_worth(1.0, 1.0), np.array([[1.0, 0.75], [0.5, 0.5]]))
    np.testing.assert_allclose(values, [1.0 + 0.75 - 0.25, 0.5 - 0.5 + 0.5])


@pytest.mark.parametrize(
    ("rewards", "risks", "max_risk", "chosen"),
    [
        ((0.5, 0.9, 0.7), (0.0, 0.0, 0.0), 0.05, 1),  # the best of the safe
        ((0.5, 9.0, 0.7), (0.0, 0.06, 0.0), 0.05, 2),  # better, but too risky
        ((0.5, 9.0, 0.7), (0.0, 0.05, 0.0), 0.05, 1),  # as risky as it may be
        ((0.7, 0.7, 0.7), (0.0, 0.0, 0.0), 0.05, 0),  # equal: the first of the model
        ((9.0, 0.1, 0.2), (0.9, 0.3, 0.4), 0.05, 1),  # all too risky: the least risk
        ((0.1, 0.3, 0.3), (0.3, 0.3, 0.3), 0.05, 1),  # of equal risks the highest value, then the first
        ((0.2, 0.3), (1.0, 1.0), 1.0, 1),  # any risk may be taken
    ],
)
def test_the_rules(rewards: tuple[float, ...], risks: tuple[float, ...], max_risk: float, chosen: int):
    assert choose(plans_worth(*rewards), surviving(*risks), max_risk) == chosen


def test_of_equal_values_the_least_risk_is_taken():
    plans = plans_worth(1.0, 1.0, crash=1.0)  # a collision costs nothing
    assert choose(plans, surviving(0.04, 0.0), 0.05) == 1


def traffic(gap_m: float, speed_mps: float) -> gym.Env:
    """highway-fast-v0 with one slow vehicle ahead of the ego, whose lane has no others beside it."""
    from highway_env.vehicle.kinematics import Vehicle

    env = make_env("highway-fast-v0")
    env.reset(seed=0)
    base: Any = env.unwrapped
    ahead = Vehicle(base.road, base.vehicle.position + [gap_m, 0.0], 0.0, speed_mps)
    base.road.vehicles = [base.vehicle, ahead]
    return env


def drive(planner: Planner, env: gym.Env, steps: int) -> bool:
    for _ in range(steps):
        *_, terminated, truncated, info = env.step(planner())
        if terminated or truncated:
            break
    return bool(info["crashed"])


def test_a_slow_vehicle_ahead_is_avoided_where_idle_collides():
    env = traffic(45.0, 10.0)
    planner = Planner(env, ConstantVelocity(ROAD))
    action = planner()
    names = planner.plan_model.names
    assert 1 - planner.survival[names.index("IDLE"), -1] == 1.0  # 25 m/s against 10 m/s over 40 m in 5 s
    assert (
        names[planner.chosen] in ("SLOWER", "LANE_LEFT", "LANE_RIGHT")
        and action == planner.plans.actions[planner.chosen]
    )  # type: ignore[union-attr]
    assert not drive(Planner(env, ConstantVelocity(ROAD)), env, 6)
    idle = traffic(45.0, 10.0)
    assert any(idle.step(1)[4]["crashed"] for _ in range(6))


@pytest.mark.parametrize(("behind_m", "collides"), [(-3.0, True), (-2.25, True), (-1.5, True), (-8.0, False)])
def test_a_lane_change_beside_a_vehicle_is_risky_where_it_collides(behind_m: float, collides: bool):
    """Contacts of the first second are on the way: at its end the ego has passed the vehicle."""
    env = traffic(behind_m, 20.0)
    ego, other = env.unwrapped.road.vehicles  # type: ignore[attr-defined]
    side, action = (4.0, "LANE_RIGHT") if ego.lane_index[2] < 2 else (-4.0, "LANE_LEFT")
    other.position = other.position + [0.0, side]
    planner = Planner(env, ConstantVelocity(ROAD))
    planner()
    plan = planner.plan_model.names.index(action)
    assert planner.survival[plan, 0] == (0.0 if collides else 1.0)
    assert env.step(planner.plans.actions[plan])[4]["crashed"] == collides  # type: ignore[union-attr]


def test_an_obstacle_ahead_is_avoided_though_no_forecast_has_it():
    env = traffic(400.0, 40.0)
    base: Any = env.unwrapped
    base.road.objects.append(Obstacle(base.road, base.vehicle.position + [45.0, 0.0]))
    planner = Planner(env, ConstantVelocity(ROAD))
    planner()
    assert planner.survival[planner.plan_model.names.index("IDLE"), -1] == 0.0
    assert not drive(Planner(env, ConstantVelocity(ROAD)), env, 6)


def test_an_empty_road_is_driven_fast():
    env = traffic(400.0, 40.0)
    planner = Planner(env, ConstantVelocity(ROAD))
    for _ in range(5):
        env.step(planner())
    assert env.unwrapped.vehicle.speed > 28  # type: ignore[attr-defined]
    np.testing.assert_array_equal(planner.survival, 1.0)


@pytest.mark.parametrize("wrap", [None, SceneObservation, ForecastObservation])
def test_the_driver_is_the_same_over_any_wrapper(wrap: Any):
    """It keeps its own history, so that it may drive a plain environment."""
    env = make_env("highway-fast-v0")
    plain = make_env("highway-fast-v0")
    wrapped = env if wrap is None else wrap(env)
    wrapped.reset(seed=3)
    plain.reset(seed=3)
    name = "planner" if wrap is ForecastObservation else "planner:highway"
    ego, expected = (
        make_ego_driver(n, e, np.random.default_rng(0)) for n, e in ((name, wrapped), ("planner:highway", plain))
    )
    for _ in range(3):
        action = ego(None)
        assert action == expected(None) and action in env.action_space
        wrapped.step(action)
        plain.step(action)


def test_names_of_the_planner():
    assert is_planner("planner") and is_planner("planner:highway") and not is_planner("planners")
    assert is_planner("planner@0.3") and is_planner("planner@0.3:highway") and not is_planner("own:planner@0.3")
    named = {"planner": ("", 0.05), "planner:highway": ("highway", 0.05), "planner@0.3": ("", 0.3)}
    named |= {"planner@1:hub:me/mine@main": ("hub:me/mine@main", 1.0), "planner:hub:me/mine@1": ("hub:me/mine@1", 0.05)}
    for name, (checkpoint, risk) in named.items():
        assert (planner_checkpoint(name), planner_config(name).max_risk) == (checkpoint, risk)


@pytest.mark.parametrize("risk", ["", "much", "1.5", "-0.1", "nan"])
def test_a_bound_that_is_none_is_refused(risk: str):
    with pytest.raises(UserError, match=r"planner@RISK needs a largest .* from 0 to 1 \(planner@0.3\), got 'plann"):
        make_ego_driver(f"planner@{risk}", make_env("highway-fast-v0"), np.random.default_rng(0))


def test_the_bound_in_the_name_is_the_drivers():
    env = make_env("highway-fast-v0")
    env.reset(seed=0)
    for name, expected in {"planner": 0.05, "planner@0.3": 0.3, "planner@0.4:oracle": 0.4}.items():
        driver: Any = make_ego_driver(name, env, np.random.default_rng(0))
        assert driver.config == PlannerConfig(max_risk=expected, true_futures="oracle" in name)


class Blank(gym.Env):
    observation_space = gym.spaces.Box(-1, 1, (1,))
    action_space = gym.spaces.Discrete(2)


class Deaf:
    names = ("on",)

    def plans(self) -> Plans:
        raise AssertionError


class WithoutRewards:
    names = ("only",)

    def plans(self, env: gym.Env, horizon_steps: int) -> Plans:
        vehicle: Any = env.unwrapped.vehicle  # type: ignore[attr-defined]
        return Plans(np.tile([*vehicle.position, 0.0, 0.0], (1, horizon_steps, 1)), (1,))


def test_environments_and_models_that_do_not_fit_are_refused():
    with pytest.raises(UserError, match="no plan model knows Blank"):
        make_ego_driver("planner", Blank(), np.random.default_rng(0))
    env = make_env("highway-fast-v0")
    with pytest.raises(UserError, match="no checkpoint 'absent'"):
        make_ego_driver("planner:absent", env, np.random.default_rng(0))
    with pytest.raises(UserError, match="the planner's forecaster was trained at dt_s=0.2"):
        Planner(env, ConstantVelocity(SceneSpec(dt_s=0.2, frame=("ego", "world"))))
    env.reset(seed=0)
    with pytest.raises(UserError, match="the planner needs rewards, but plan model WithoutRewards gives none"):
        Planner(env, ConstantVelocity(ROAD), WithoutRewards())()
    with pytest.raises(UserError, match="max_risk must be from 0 to 1, got 1.5"):
        PlannerConfig(max_risk=1.5)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (lambda env, f: Planner(env, (f, "info")), "a forecaster needs spec, .*but tuple has no spec"),
        (lambda env, f: Planner(env, "absent"), "no checkpoint 'absent'"),
        (lambda env, f: Planner(env, f, True), "plan_model must be None, or an object with names and plans"),
        (
            lambda env, f: Planner(env, f, WithoutRewards),
            "got a class: write WithoutRewards",
        ),
        (lambda env, f: Planner(env, f, Deaf()), "plans of plan model Deaf must take an environment and horizon_steps"),
        (lambda env, f: Planner(env, f, config=PlannerConfig(max_risk="0.1")), "max_risk must be a number, got '0.1'"),  # type: ignore[arg-type]
        (lambda env, f: Planner(env, f, config=PlannerConfig(horizon_steps=2.5)), "horizon_steps must be .*, got 2.5"),  # type: ignore[arg-type]
    ],
)
def test_what_a_planner_is_not_made_of_is_one_sentence(given: Any, message: str):
    with pytest.raises(UserError, match=message):
        given(make_env("highway-fast-v0"), ConstantVelocity(ROAD))


def test_samples_come_from_the_planner_s_own_generator():
    """A driver's generator is of its episode's seed: with one for all, all episodes had one noise."""
    env = make_env("highway-fast-v0")
    env.reset(seed=0)
    drawing = NoisyConstantVelocity(ROAD, 3.0, 1.0)

    def survival(rng: np.random.Generator | None) -> Any:
        planner = Planner(env, drawing, rng=rng, config=PlannerConfig(num_samples=50))
        planner()
        return planner.survival

    one, same, other = (survival(np.random.default_rng(seed)) for seed in (1, 1, 2))
    assert np.array_equal(one, same) and not np.array_equal(one, other)


def test_a_planner_takes_the_name_of_a_checkpoint():
    env = make_env("highway-fast-v0")
    env.reset(seed=0)
    by_name, loaded = Planner(env, "highway"), Planner(env, load_checkpoint("highway")[0])
    assert by_name() == loaded() and np.array_equal(by_name.survival, loaded.survival)


def test_a_checkpoint_that_was_replaced_is_loaded_anew(tmp_path: Path):
    shutil.copytree(resolve("highway"), tmp_path / "mine")
    env, name = make_env("highway-fast-v0"), str(tmp_path / "mine")
    first = forecaster_for(env, name)
    assert forecaster_for(env, name) is first
    shutil.copytree(resolve("merge"), tmp_path / "mine", dirs_exist_ok=True)
    os.utime(tmp_path / "mine" / WEIGHTS, ns=(1, 1))  # copies keep the time; of another size or not, it is another file
    assert forecaster_for(env, name) is not first
    assert weights_stamp("constant-velocity") == (0, 0)


def test_in_a_wrapper_the_planner_perceives_no_more_than_its_forecaster_was_trained_with():
    """Else one driver's name is two drivers: alone in an environment, and where scenes are recorded."""
    narrow = ConstantVelocity(replace(ROAD, perception_m=30.0, max_agents=3))
    seen, survivals = [], []
    for wrap in (lambda env: env, SceneObservation, lambda env: SceneObservation(env, perception_m=20.0)):
        env = wrap(make_env("highway-fast-v0"))
        env.reset(seed=0)
        driver = Planner(env, narrow)
        for _ in range(3):
            env.step(driver())
        seen.append((driver._spec.perception_m, driver._spec.max_agents))
        survivals.append(driver.survival)
    assert seen == [(30.0, 3), (30.0, 3), (20.0, 3)]
    np.testing.assert_array_equal(survivals[0], survivals[1])
    wide = Planner(SceneObservation(make_env("highway-fast-v0")), ConstantVelocity(ROAD))
    assert (wide._spec.perception_m, wide._spec.max_agents) == (ROAD.perception_m, ROAD.max_agents)


class Rows(gym.Env):
    """The ego stands; another agent comes towards it. What there is stands in the observation alone."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (2, 4), np.float64)
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.time = 0
        return self._table(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.time += 1
        return self._table(), 0.0, self.time == 3, False, {}

    def _table(self) -> np.ndarray:
        return np.array([[0.0, 0.0, 0.0, 0.0], [20.0 - 5.0 * self.time, 0.0, -5.0, 0.0]])


class StayOrLeave:
    names = ("stay", "leave")

    def plans(self, env: gym.Env, horizon_steps: int) -> Plans:
        states = np.zeros((2, horizon_steps, 4))
        states[1, :, 1] = 50.0
        return Plans(states, (0, 1), rewards=np.array([[1.0], [0.9]]).repeat(horizon_steps, axis=1))


@pytest.mark.parametrize("wrapped", [False, True])
def test_a_reader_of_observations_serves_the_planner(wrapped: bool, monkeypatch: pytest.MonkeyPatch):
    """Alone the planner shows it each observation; in a wrapper, the wrapper has."""
    layout = SceneSpec(dt_s=1.0, max_agents=2)
    monkeypatch.setattr("envs.readers._REGISTERED", {Rows: EntityRowsReader(("x", "y", "vx", "vy"), layout)})
    monkeypatch.setattr("envs.plans._REGISTERED", {Rows: lambda env: StayOrLeave()})
    env: gym.Env = SceneObservation(Rows()) if wrapped else Rows()
    driver = make_ego_driver("planner:constant-velocity", env, np.random.default_rng(0))
    obs, _ = env.reset(seed=0)
    assert driver(obs) == 1
    obs = env.step(1)[0]
    assert driver(obs) == 1


def test_a_wrapper_that_changes_actions_is_refused():
    env = make_env("highway-fast-v0", config={"action": {"type": "ContinuousAction"}})
    with pytest.raises(
        UserError, match="actions of the environment itself, which RescaleAction changes; put RescaleAction around"
    ):
        Planner(gym.wrappers.RescaleAction(env, np.float32(-2), np.float32(2)), ConstantVelocity(ROAD))
    env.reset(seed=0)
    clipped, plain = Planner(gym.wrappers.ClipAction(env), ConstantVelocity(ROAD)), Planner(env, ConstantVelocity(ROAD))
    np.testing.assert_array_equal(clipped(), plain())
