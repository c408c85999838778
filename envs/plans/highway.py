"""Plans for highway-env: each of its meta-actions, or accelerations and lanes where controls are continuous.

The ego alone is copied onto an empty copy of its road and simulated by highway-env's own vehicle, frame by frame, as
the environment would; the environment is not touched. Rewards are the environment's own, with its own weights: its
reward function is called with the copied ego in place of the ego. Terms that depend on other vehicles (merge-v1's speed
on the ramp) see an empty road.
"""

import copy
from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from highway_env.envs.common.action import ContinuousAction, DiscreteAction, DiscreteMetaAction
from highway_env.vehicle.controller import ControlledVehicle, MDPVehicle
from highway_env.vehicle.dynamics import BicycleVehicle
from highway_env.vehicle.kinematics import Vehicle

from envs.plans.base import Plans
from envs.readers.highway import is_highway_env
from predictor.support.errors import UserError

META_ACTIONS = ("IDLE", "SLOWER", "FASTER", "LANE_LEFT", "LANE_RIGHT")
"""Meta-actions in the order of plans; those that an environment lacks are left out."""
THROTTLES = {"keep": 0.0, "brake": -1.0, "accelerate": 1.0}
"""Accelerations of plans with continuous controls, as fractions of the strongest."""
MARGIN_M = 1.0
"""Gap below which the planner counts a contact [m].

A lane change is quickest at its beginning, where a straight move between two steps is still short, and highway-env
counts vehicles that would overlap in the next frame as collided. Of 250 lane changes beside a vehicle of constant speed
163 collided: without a margin 15 of these were called free, with 0.5 m 2, with 1 m none. Of the others 0, 3 and 17 were
called collisions.
"""
LANES = {"": 0, " left": -1, " right": 1}
"""Lanes of plans with continuous steering, relative to the present one."""
_MOVE_WITHOUT_LANE = (MDPVehicle, Vehicle, BicycleVehicle)
"""Vehicles whose motion does not depend on the lane that they are found on. It is looked up once per policy step, not
in each frame: highway-env measures the distance to every lane of the road for it."""


class _Control(NamedTuple):
    """Continuous controls that a plan holds: a throttle, and a lane that it steers to."""

    throttle: float
    lane: int


class HighwayPlans:
    """Plan model for single-ego highway-env environments; see `envs.plans.base.PlanModel`.

    With meta-actions, a plan takes one action and then IDLE; one that is not possible (a lane change at the edge of the
    road) is as IDLE. With continuous controls, a plan holds an acceleration, within speeds from 0 to the vehicle's
    largest, and steers to the present lane, the one to its left or to its right.

    Args:
        env: the environment.

    Raises:
        UserError: not a highway-env environment, or actions of another kind.
    """

    def __init__(self, env: gym.Env) -> None:
        """Lists the candidates."""
        if not is_highway_env(env):
            raise UserError(f"HighwayPlans needs a highway-env environment, got {type(env.unwrapped).__name__}")
        kind: Any = env.unwrapped.action_type  # type: ignore[attr-defined]
        self._candidates: dict[str, Any] = {}
        self._actions: tuple[int, ...] | None = None
        if isinstance(kind, DiscreteMetaAction):
            self._candidates = {name: name for name in META_ACTIONS if name in kind.actions_indexes}
            self._actions = tuple(kind.actions_indexes[name] for name in self._candidates)
        elif isinstance(kind, ContinuousAction) and not isinstance(kind, DiscreteAction):
            throttles = THROTTLES if kind.longitudinal else {"keep": 0.0}
            lanes = LANES if kind.lateral else {"": 0}
            self._candidates = {f"{t}{s}": _Control(throttles[t], lanes[s]) for s in lanes for t in throttles}
        else:
            raise UserError(
                f"plans are known for DiscreteMetaAction and ContinuousAction of highway-env, got "
                f"{type(kind).__name__}; pass what_if= a plan model of your own (docs/what_if.md)"
            )

    @property
    def names(self) -> tuple[str, ...]:
        """Name of each plan."""
        return tuple(self._candidates)

    @property
    def actions(self) -> tuple[int, ...] | None:
        """Meta-action with which each plan begins; None with continuous controls, which depend on the state."""
        return self._actions

    def plans(self, env: gym.Env, horizon_steps: int) -> Plans:
        """Returns the plans from the environment's present state, which stays as it is."""
        runs = [_simulate(env.unwrapped, candidate, horizon_steps) for candidate in self._candidates.values()]
        states, actions, rewards, crash_rewards, crashed = zip(*runs, strict=True)
        first, later = tuple(a[0] for a in actions), tuple(tuple(a[1:]) for a in actions)
        made = Plans(np.stack(states), first, np.array(rewards), np.array(crash_rewards), np.array(crashed))
        return replace(made, later_actions=later, margin_m=MARGIN_M)


def _simulate(env: Any, candidate: str | _Control, horizon_steps: int) -> tuple[Any, ...]:
    """Returns states, actions, rewards without and with a collision, and collisions of a candidate, for each step."""
    alone = _Alone(env)
    frames = int(env.config["simulation_frequency"] // env.config["policy_frequency"])
    states, actions, rewards, crash_rewards, crashed = [], [], [], [], []
    target = alone.lane_beside(candidate.lane) if isinstance(candidate, _Control) else None
    for step in range(horizon_steps):
        if isinstance(candidate, _Control):
            action, target = alone.controls(candidate.throttle, target, frames)
        else:
            action = alone.action_type.actions_indexes[candidate if step == 0 else "IDLE"]
        actions.append(action)
        alone.advance(action, frames)
        states.append(alone.state())
        crashed.append(bool(alone.ego.crashed))
        rewards.append(alone.reward(action, crashed=crashed[-1]))
        crash_rewards.append(alone.reward(action, crashed=True))
    return np.array(states), actions, rewards, crash_rewards, crashed


class _Alone:
    """The ego on an otherwise empty copy of its road."""

    def __init__(self, env: Any) -> None:
        ego, road = env.vehicle, env.road
        self.road = copy.copy(road)
        vars(self.road).pop("act", None)  # interventions in force, which would act on the road itself
        self.road.vehicles, self.road.record_history = [], False
        self.road.np_random = copy.deepcopy(road.np_random)
        kept = (road.network, ego.lane)
        memo: dict[int, Any] = {id(part): part for part in kept} | {id(road): self.road}
        if hasattr(ego, "history"):
            memo[id(ego.history)] = deque(maxlen=ego.history.maxlen)
        self.road.objects = copy.deepcopy(road.objects, memo)
        self.ego: Any = copy.deepcopy(ego, memo)
        self.road.vehicles = [self.ego]
        self._env: Any = object.__new__(type(env))
        self._env.__dict__.update(env.__dict__)
        self._env.road, self._env.controlled_vehicles = self.road, [self.ego]
        for name in ("observation_type", "observation_type_parking"):  # which parking's reward looks through
            if name in vars(env):
                looks = copy.copy(getattr(env, name))
                looks.env, looks.observer_vehicle = self._env, self.ego
                setattr(self._env, name, looks)
        self.action_type: Any = copy.copy(env.action_type)
        self.action_type.env, self.action_type.controlled_vehicle = self._env, self.ego
        if type(self.ego) in _MOVE_WITHOUT_LANE:
            self.ego.on_state_update = lambda: None
        self._dt_s = 1 / env.config["simulation_frequency"]

    def advance(self, action: Any, frames: int) -> None:
        """Simulates one policy step."""
        for frame in range(frames):
            if frame == 0:
                self.action_type.act(action)
            self.road.act()
            self.road.step(self._dt_s)
        type(self.ego).on_state_update(self.ego)

    def state(self) -> tuple[float, float, float, float]:
        """Returns position [m] and velocity [m/s]."""
        x_m, y_m = self.ego.position
        vx_mps, vy_mps = self.ego.speed * np.cos(self.ego.heading), self.ego.speed * np.sin(self.ego.heading)
        return float(x_m), float(y_m), float(vx_mps), float(vy_mps)

    def reward(self, action: Any, crashed: bool) -> float:
        """Returns the environment's reward for this state."""
        before, self.ego.crashed = self.ego.crashed, crashed
        reward = float(self._env._reward(action))
        self.ego.crashed = before
        return reward

    def lane_beside(self, offset: int) -> Any:
        """Returns the index of a lane beside the present one; the present one if there is no such lane."""
        start, end, lane = self.ego.lane_index
        beside = (start, end, None if lane is None else lane + offset)
        if not offset or beside not in self.road.network.side_lanes(self.ego.lane_index):
            return self.ego.lane_index
        return beside

    def controls(self, throttle: float, target: Any, frames: int) -> tuple[np.ndarray, Any]:
        """Returns the action of one policy step, and the lane to steer to from then on."""
        kind, ego = self.action_type, self.ego
        driver = ControlledVehicle(self.road, ego.position, ego.heading, ego.speed, target_lane_index=target)
        driver.follow_road()
        values = []
        if kind.longitudinal:
            step_s = frames * self._dt_s
            strongest = max(kind.acceleration_range)
            least, most = kind.speed_range or (0.0, ego.MAX_SPEED)
            wanted = np.clip(ego.speed + throttle * strongest * step_s, max(least, 0.0), most)
            change = float(wanted - ego.speed) / step_s if throttle else 0.0
            values.append(_share(change, kind.acceleration_range))
        if kind.lateral:
            values.append(_share(driver.steering_control(driver.target_lane_index), kind.steering_range))
        return np.array(values, dtype=np.float32), driver.target_lane_index


def _share(value: float, limits: Sequence[float | int]) -> float:
    """Returns the action in [-1, 1] that highway-env maps to a value."""
    low, high = limits
    return float(np.clip(2 * (value - low) / (high - low) - 1, -1, 1))
