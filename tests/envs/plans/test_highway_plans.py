"""Plans of highway-env are what the ego does when it is alone, and making them changes nothing."""

from copy import deepcopy
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from envs.arms import Arm
from envs.plans import HighwayPlans, Plans, checked_plans, plan_model_for, register_plan_model
from envs.plans import base as plans_base
from envs.plans import highway as plans_highway
from envs.readers.highway import HighwayReader
from envs.registry import make_env
from envs.simulators.highway_interventions import intervene_on_road, log_road
from envs.simulators.intervention import Intervention
from envs.wrappers import ForecastObservation
from predictor.support.errors import UserError

HORIZON = 4


def alone(env_id: str, seed: int = 1, **config: Any) -> gym.Env:
    """An environment whose other vehicles are gone."""
    env = make_env(env_id, **({"config": config} if config else {}))
    env.reset(seed=seed)
    base: Any = env.unwrapped
    base.road.vehicles = [base.vehicle]
    return env


def driven(env: gym.Env, actions: list[Any]) -> tuple[np.ndarray, list[float]]:
    """True states of the ego and rewards after each of these actions."""
    reader, states, rewards = HighwayReader(env), [], []
    for action in actions:
        rewards.append(float(env.step(action)[1]))
        states.append(reader.read_all(env).states[0])
    return np.array(states), rewards


@pytest.mark.parametrize("env_id", ["highway-fast-v0", "merge-v1", "roundabout-v1", "intersection-v2"])
def test_a_plan_is_what_the_ego_then_does_and_earns_alone(env_id: str):
    env = alone(env_id)
    if env_id == "intersection-v2":
        env.unwrapped.config["initial_vehicle_count"] = 0  # type: ignore[attr-defined]
        env.unwrapped.config["spawn_probability"] = 0  # type: ignore[attr-defined]
    model = plan_model_for(env)
    plans = checked_plans(model, env, HORIZON, 4)
    assert isinstance(model, HighwayPlans) and set(model.names) >= {"IDLE", "SLOWER", "FASTER"}
    idle = plans.actions[model.names.index("IDLE")]
    assert plans.rewards is not None
    for plan, action in enumerate(plans.actions):
        assert plans.later_actions is not None and plans.later_actions[plan] == (idle,) * (HORIZON - 1)
        states, rewards = driven(deepcopy(env), [action, *plans.later_actions[plan]])
        np.testing.assert_allclose(plans.states[plan], states, atol=1e-6, err_msg=model.names[plan])
        np.testing.assert_allclose(plans.rewards[plan], rewards, atol=1e-9, err_msg=model.names[plan])


@pytest.mark.parametrize("env_id", ["highway-fast-v0", "merge-v1", "roundabout-v1", "intersection-v2", "racetrack-v1"])
def test_lanes_are_found_once_per_step_and_plans_stay_the_same(env_id: str, monkeypatch: pytest.MonkeyPatch):
    env = make_env(env_id)
    env.reset(seed=2)
    network: Any = env.unwrapped.road.network  # type: ignore[attr-defined]
    looked: list[Any] = []
    find = network.get_closest_lane_index
    monkeypatch.setattr(network, "get_closest_lane_index", lambda *a: (looked.append(a), find(*a))[1])
    model = plan_model_for(env)
    counts, made = [], []
    for vehicles in (plans_highway._MOVE_WITHOUT_LANE, ()):
        monkeypatch.setattr(plans_highway, "_MOVE_WITHOUT_LANE", vehicles)
        looked.clear()
        made.append(model.plans(env, HORIZON))
        counts.append(len(looked))
    frames: int = env.unwrapped.config["simulation_frequency"] // env.unwrapped.config["policy_frequency"]  # type: ignore[attr-defined]
    assert counts[1] - counts[0] == len(model.names) * HORIZON * frames
    for name in ("states", "rewards", "crash_rewards", "crashed"):
        np.testing.assert_array_equal(getattr(made[0], name), getattr(made[1], name))
    assert str(made[0].later_actions) == str(made[1].later_actions)


def test_continuous_plans_are_repeated_by_their_actions():
    env = alone("racetrack-v1")
    model = plan_model_for(env)
    assert model.names == ("keep", "keep left", "keep right")
    plans = model.plans(env, HORIZON)
    for plan, action in enumerate(plans.actions):
        assert action in env.action_space
        assert plans.later_actions is not None
        states, _ = driven(deepcopy(env), [action, *plans.later_actions[plan]])
        np.testing.assert_allclose(plans.states[plan], states, atol=1e-4)
    lateral_m = [env.unwrapped.vehicle.lane.local_coordinates(state[:2])[1] for state in plans.states[:, -1]]  # type: ignore[attr-defined]
    assert abs(lateral_m[0]) < 1.5


def test_throttles_stay_between_standing_and_the_largest_speed():
    env = alone("highway-fast-v0", action={"type": "ContinuousAction"})
    model = plan_model_for(env)
    assert len(model.names) == 9 and model.names[:3] == ("keep", "brake", "accelerate")
    speed_mps = np.hypot(*model.plans(env, 10).states[:3, :, 2:].transpose(2, 0, 1))
    np.testing.assert_allclose(speed_mps[0], speed_mps[0, 0], atol=1e-6)
    assert speed_mps[1, -1] < 1e-3 and speed_mps[2, -1] == pytest.approx(40.0, abs=0.5)
    assert (np.diff(speed_mps[1]) <= 1e-6).all() and (np.diff(speed_mps[2]) >= -1e-6).all()


@pytest.mark.parametrize("env_id", ["highway-fast-v0", "intersection-v2", "racetrack-v1"])
def test_planning_changes_nothing_in_the_environment(env_id: str):
    """With and without it, the same episode."""
    episodes = []
    for asks in (False, True):
        env = make_env(env_id)
        env.reset(seed=5)
        model, found = plan_model_for(env), []
        for _ in range(4):
            if asks:
                model.plans(env, HORIZON)
            _, reward, *_ = env.step(env.action_space.sample() if asks is None else _constant(env))
            found.append((HighwayReader(env).read_all(env).states, reward))
        episodes.append(found)
    for (states, reward), (other, again) in zip(*episodes, strict=True):
        np.testing.assert_array_equal(states, other)
        assert reward == again


def _constant(env: gym.Env) -> Any:
    return 1 if isinstance(env.action_space, gym.spaces.Discrete) else np.zeros(env.action_space.shape, np.float32)


def test_the_other_vehicles_change_no_plan():
    env = make_env("highway-fast-v0")
    env.reset(seed=2)
    before = plan_model_for(env).plans(env, HORIZON)
    base: Any = env.unwrapped
    base.road.vehicles = [base.vehicle]
    after = plan_model_for(env).plans(env, HORIZON)
    np.testing.assert_array_equal(before.states, after.states)


def test_plans_are_the_same_while_an_intervention_is_in_force_and_use_up_nothing_of_it():
    """It is called in place of `Road.act`, by whichever road has it."""
    env = make_env("highway-fast-v0")
    env.reset(seed=2)
    before = plan_model_for(env).plans(env, HORIZON)
    base: Any = env.unwrapped
    log = log_road(base)
    intervene_on_road(base, base.road.vehicles[1], Intervention(1, "brake", 2, change_mps=5.0))
    frames = [one.frames for one in base.road.act.running]
    after = plan_model_for(env).plans(env, HORIZON)
    np.testing.assert_array_equal(before.states, after.states)
    np.testing.assert_array_equal(before.rewards, after.rewards)
    assert [one.frames for one in base.road.act.running] == frames != []
    assert len(log.frames) == 0


def test_a_collision_is_worth_what_the_environment_says():
    env = alone("highway-fast-v0")
    plans = plan_model_for(env).plans(env, HORIZON)
    assert plans.rewards is not None and plans.crash_rewards is not None and plans.crashed is not None
    config = env.unwrapped.config  # type: ignore[attr-defined]
    span = config["high_speed_reward"] + config["right_lane_reward"] - config["collision_reward"]
    np.testing.assert_allclose(plans.rewards - plans.crash_rewards, -config["collision_reward"] / span)
    assert not plans.crashed.any() and not env.unwrapped.vehicle.crashed  # type: ignore[attr-defined]


def test_a_fixed_obstacle_is_a_collision_of_the_plan_alone():
    env = alone("highway-fast-v0")
    base: Any = env.unwrapped
    from highway_env.vehicle.objects import Obstacle

    obstacle = Obstacle(base.road, base.vehicle.position + [35.0, 0.0])
    base.road.objects.append(obstacle)
    plans = plan_model_for(env).plans(env, HORIZON)
    assert plans.crashed is not None and plans.crashed[0].any() and plans.crashed[0, -1]
    assert not obstacle.hit and not base.vehicle.crashed


class Blank(gym.Env):
    observation_space = gym.spaces.Box(-1, 1, (1,))
    action_space = gym.spaces.Discrete(2)


class TwoPlans:
    names = ("stay", "go")

    def __init__(self, found: Any) -> None:
        self.found = found

    def plans(self, env: gym.Env, horizon_steps: int) -> Any:
        return self.found


def given(
    states: Any,
    actions: Any,
    rewards: np.ndarray | None = None,
    later: Any = None,
    margin_m: Any = 0.0,
    size_m: Any = (5.0, 2.0),
    crashed: Any = None,
) -> Any:
    """What a careless model may return; `Plans` itself refuses such shapes while shapes are checked."""
    return SimpleNamespace(
        states=states,
        actions=actions,
        rewards=rewards,
        crash_rewards=None,
        crashed=crashed,
        later_actions=later,
        margin_m=margin_m,
        size_m=size_m,
    )


class Reversed(gym.ActionWrapper):
    """Numbers the actions from the other end."""

    def action(self, action: int) -> int:
        return 4 - action


def test_a_registered_model_serves_its_class_and_others_are_refused(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("envs.plans._REGISTERED", {})
    with pytest.raises(UserError, match="no plan model knows Blank: pass what_if= an object with names and plans"):
        plan_model_for(Blank())
    with pytest.raises(
        UserError, match="the environment itself, which Reversed changes; put Reversed around what needs"
    ):
        ForecastObservation(Reversed(make_env("highway-fast-v0")), "constant-velocity", arm=Arm("oracle"))
    model = TwoPlans(Plans(np.zeros((2, 3, 4)), (0, 1)))
    assert isinstance(model, plans_base.PlanModel)
    register_plan_model(Blank, lambda env: model)
    assert plan_model_for(Blank()) is model
    register_plan_model(Blank, lambda env: env.lanes)  # type: ignore[attr-defined]
    with pytest.raises(UserError, match="the plan model registered for Blank failed: .*no attribute 'lanes'"):
        plan_model_for(Blank())


@pytest.mark.parametrize(
    ("found", "message"),
    [
        (given(np.zeros((2, 2, 4)), (0, 1)), r"states need the shape \(2, 3, 4\), got \(2, 2, 4\)"),
        (given(np.full((2, 3, 4), np.nan), (0, 1)), "states must be finite, got NaN or infinity"),
        (
            given(np.zeros((2, 3, 4)), (0, 1), later=((0, 0), (0,))),
            r"later_actions need 2 for each of 2 plans, got \[2, 1\]",
        ),
        (given(np.zeros((2, 3, 4)), (0, 1), margin_m=-0.1), "margin_m must be finite and at least 0, got -0.1"),
        (given(np.zeros((2, 3, 4)), (0, 1), size_m=(np.nan, 2.0)), r"size_m must be .*, got \(nan, 2.0\)"),
        (given(np.zeros((2, 3, 4)), (0, 1), size_m=(5.0, -2.0)), "size_m must be length and width"),
        (given(np.zeros((2, 3, 4)), (0, 1), size_m=5.0), "size_m must be length and width .*got 5.0"),
        (given(np.zeros((2, 3, 4)), (0,)), "each of its 2 plans needs one action, got 1"),
        (given(np.zeros((2, 3, 4)), (0, 1), np.zeros((2, 2))), r"rewards need the shape \(2, 3\), got \(2, 2\)"),
        (given(np.zeros((2, 3, 4)), (0, 1), margin_m=None), "margin_m must be finite and at least 0, got None"),
        (given(np.zeros((2, 3, 4)), None), "actions must be one for each plan, got None"),
        (given(np.zeros((2, 3, 4)), (0, 1), later=5), "later_actions must be one for each plan, got 5"),
        (given(np.zeros((2, 3, 4)), (0, 1), later=(1, 2)), r"later_actions need 2 for each of 2 plans, got \[1, 1\]"),
        (given(np.zeros((2, 3, 4)), (0, 1), later=(((0, np.zeros(2)),),) * 2), r"later_actions need 2 .*got \[1, 1\]"),
        (given(np.zeros((2, 3, 4)), (0, 1), size_m=((5.0, 2.0), 1.0)), "size_m must be length and width"),
        (given([[[0.0] * 4] * 3, [[0.0] * 4] * 2], (0, 1)), "states must be an array: "),
        (
            given(np.zeros((2, 3, 4)), (0, 1), crashed=np.zeros((2, 3), np.int64)),
            "crashed must be .* bool.*, got int64",
        ),
    ],
)
def test_plans_that_do_not_fit_are_refused(found: Any, message: str):
    with pytest.raises(UserError, match=f"plan model TwoPlans: {message}"):
        checked_plans(TwoPlans(found), Blank(), 3, 4)


def test_lists_are_arrays():
    plans = checked_plans(TwoPlans(given([[[0.0] * 4] * 3] * 2, [0, 1], crashed=[[False] * 3] * 2)), Blank(), 3, 4)
    assert isinstance(plans, Plans) and plans.actions == (0, 1)
    assert isinstance(plans.states, np.ndarray) and plans.crashed is not None and plans.crashed.dtype == np.bool_


def test_rewards_of_parking_are_those_of_the_plan():
    """Its reward looks through an observation that knows the environment."""
    env = make_env("parking-v0")
    env.reset(seed=10)
    plans = HighwayPlans(env).plans(env, 4)
    assert plans.rewards is not None and np.ptp(plans.rewards, axis=1).max() > 0.005
    best = int(np.argmax(np.abs(plans.rewards[:, 0] - plans.rewards[:, 0].mean())))
    _, reward, *_ = env.step(plans.actions[best])
    assert reward == pytest.approx(plans.rewards[best, 0], abs=1e-6)
    env.close()


def test_the_order_of_actions_is_that_of_the_plans():
    class Named(TwoPlans):
        actions: Any = (1, 0)

    found = Plans(np.zeros((2, 3, 4)), (0, 1))
    with pytest.raises(UserError, match=r"Named: its attribute actions must be .*, got \(1, 0\) and .*with \(0, 1\)"):
        checked_plans(Named(found), Blank(), 3, 4)
    for same in ((0, 1), [0, 1], np.array([0, 1]), None):
        Named.actions = same
        assert checked_plans(Named(found), Blank(), 3, 4).actions == found.actions
    Named.actions = (0,)
    with pytest.raises(UserError, match="its attribute actions must be those of its plans"):
        checked_plans(Named(found), Blank(), 3, 4)


def test_actions_without_plans_are_refused():
    env = make_env("highway-fast-v0", config={"action": {"type": "DiscreteAction"}})
    with pytest.raises(UserError, match="plans are known for DiscreteMetaAction and ContinuousAction .*DiscreteAction"):
        plan_model_for(env)
    with pytest.raises(UserError, match="HighwayPlans needs a highway-env environment, got Blank"):
        HighwayPlans(Blank())


def test_plans_keep_what_a_model_writes_over():
    buffer = np.zeros((2, 3, 4))
    plans = checked_plans(TwoPlans(given(buffer, (0, 1), rewards=buffer[..., 0])), Blank(), 3, 4)
    buffer += 1
    assert not plans.states.any() and plans.rewards is not None and not plans.rewards.any()


def test_actions_may_be_dicts_of_arrays():
    def actions(push: float) -> tuple[Any, ...]:
        return {"push": np.zeros(2), "turn": 1}, {"push": np.full(2, push), "turn": 1}

    model = TwoPlans(given(np.zeros((2, 3, 4)), actions(1.0)))
    model.actions = actions(1.0)  # type: ignore[attr-defined]
    assert checked_plans(model, Blank(), 3, 4).actions[1]["turn"] == 1
    model.actions = actions(2.0)  # type: ignore[attr-defined]
    with pytest.raises(UserError, match="its attribute actions must be those of its plans"):
        checked_plans(model, Blank(), 3, 4)
