"""Interventions in highway-env: one vehicle's acceleration, lane or presence, overridden in every simulated frame.

`RoadInterventions` stands in the road's `act`: all drivers decide as always, then the overridden vehicles' actions are
replaced. A vehicle that brakes or accelerates is steered by its own driver and begins no lane change; one that changes
lane keeps its own speed control. One that is taken out drives on unseen: nobody reacts to it, and it comes back when
its time is over and its place is free.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from highway_env.envs.common.abstract import AbstractEnv
from highway_env.vehicle.controller import ControlledVehicle
from highway_env.vehicle.kinematics import Vehicle

from envs.simulators.held_agents import HeldAgents, MotionLog
from envs.simulators.intervention import Intervention, NotAllowedError

MOTION = ("position", "heading", "speed", "lane", "lane_index", "target_lane_index", "route", "action", "crashed")
"""Attributes of a vehicle that make up its motion in a frame; others foresee it along its route."""
CHANGE_MPS = {"brake": 8.0, "accelerate": 5.0}
"""Changes of speed where an intervention names none; 8 m/s is the larger one of docs/datasets/env.md's measurements."""
RATE_MPS2 = {"brake": 6.0, "accelerate": 3.0}
"""Rates where an intervention names none: highway-env's strongest braking (`IDMVehicle.ACC_MAX`) and its comfortable
acceleration (`COMFORT_ACC_MAX`)."""
BRAKING_MPS2 = 6.0
"""Deceleration that an accelerating vehicle keeps room for."""
TIME_GAP_S = 1.0
"""Time gap to the vehicle in front below which an accelerating vehicle's driver decides again [s]."""
RETURN_GAP_S = 0.5
"""Least time gap, beside one vehicle length, in front and behind where a vehicle comes back [s]."""


def intervene_on_road(env: AbstractEnv, vehicle: Vehicle, intervention: Intervention) -> None:
    """Begins an intervention on a vehicle of a running environment.

    Raises:
        NotAllowedError: the vehicle is under an intervention already, has no such lane, is steered by a policy
            itself, or would be taken out although a policy drives it.
    """
    name = f"agent {intervention.agent}"
    if (standing := env.road.__dict__.get("act")) is not None:
        standing.end_finished()
    if intervention.agent in road_interventions(env):
        raise NotAllowedError(f"{name} is under an intervention already; let it end, or choose another agent")
    if intervention.kind == "remove":
        if vehicle in env.controlled_vehicles:
            raise NotAllowedError(
                f"{name} is driven by a policy and cannot be taken out; brake it, or choose another agent"
            )
        begun: _Override = _Absence(vehicle, intervention, env)
    elif intervention.kind in ("left", "right"):
        begun = _LaneChange(vehicle, intervention, env)
    else:
        begun = _SpeedChange(vehicle, intervention, env)
    if intervention.steps:
        begun.begin()
        _standing(env.road).running.append(begun)


def log_road(env: AbstractEnv) -> MotionLog:
    """Begins to log the motion of all vehicles on the road, and returns the log."""
    standing = _standing(env.road)
    standing.log = MotionLog(env.road.vehicles, MOTION)
    return standing.log


def hold_on_road(env: AbstractEnv, log: MotionLog, free: Sequence[Vehicle]) -> None:
    """Holds all vehicles but some to a log; called before any intervention."""
    _standing(env.road).held = HeldAgents(env.road.vehicles, log, free)


def _standing(road: Any) -> "RoadInterventions":
    """Returns what stands in the road's `act`; puts it there if nothing does."""
    if "act" not in road.__dict__:
        road.act = RoadInterventions(road)
    found: RoadInterventions = road.act
    return found


def road_interventions(env: AbstractEnv) -> dict[int, Intervention]:
    """Returns the interventions that act on the next frame, by agent."""
    standing = env.road.__dict__.get("act")
    found = [] if standing is None else standing.running
    return {one.intervention.agent: one.intervention for one in found if one.frames > 0 or not one.can_end()}


class RoadInterventions:
    """Interventions that are in force on a road; called in place of `Road.act`.

    Args:
        road: the road.
    """

    def __init__(self, road: Any) -> None:
        """Starts without interventions."""
        self.road = road
        self.running: list[_Override] = []
        self.log: MotionLog | None = None
        self.held: HeldAgents | None = None

    def __call__(self) -> None:
        """Lets all drivers decide, then overrides; ends what is over, and leaves the road when all is."""
        self.end_finished()
        for one in self.running:
            one.before()
        if self.held is None:
            type(self.road).act(self.road)
        else:
            self.held.place()
            for vehicle in self.road.vehicles:
                if vehicle not in self.held:
                    vehicle.act()
        for one in self.running:
            one.after()
            one.frames -= 1
        if self.log is not None:
            self.log.note(self.road.vehicles)
        if not self.running and self.log is None and self.held is None:
            del self.road.act

    def end_finished(self) -> None:
        """Gives back the vehicles of interventions that are over."""
        self.running = [one for one in self.running if one.frames > 0 or not one.end()]


class _Override:
    """One intervention in force.

    Attributes:
        frames: number of simulated frames that are left.
    """

    def __init__(self, vehicle: Any, intervention: Intervention, env: AbstractEnv) -> None:
        self.vehicle, self.intervention, self.road = vehicle, intervention, env.road
        per_step = int(env.config["simulation_frequency"] // env.config["policy_frequency"])
        self.frames = intervention.steps * per_step
        self.dt_s = 1 / env.config["simulation_frequency"]
        self._lane: Any = getattr(vehicle, "target_lane_index", None)
        self._may_change_lane = getattr(vehicle, "enable_lane_change", None)

    def begin(self) -> None:
        """Forbids the driver a lane change of its own."""
        if self._may_change_lane is not None:
            self.vehicle.enable_lane_change = False

    def before(self) -> None:
        """Puts a lane back that the policy chose meanwhile; called before the drivers decide."""
        target = getattr(self.vehicle, "target_lane_index", None)
        if target is not None and target[:2] == self._lane[:2]:
            self.vehicle.target_lane_index = self._lane

    def after(self) -> None:
        """Follows the road; called after the drivers decided."""
        self._lane = getattr(self.vehicle, "target_lane_index", None)

    def can_end(self) -> bool:
        """Returns whether it may end now, if no frames are left."""
        return True

    def end(self) -> bool:
        """Gives the vehicle back to its driver; returns whether that was possible."""
        if self._may_change_lane is not None:
            self.vehicle.enable_lane_change = self._may_change_lane
        return True


class _SpeedChange(_Override):
    def __init__(self, vehicle: Any, intervention: Intervention, env: AbstractEnv) -> None:
        super().__init__(vehicle, intervention, env)
        change_mps = intervention.change_mps or CHANGE_MPS[intervention.kind]
        self._rate_mps2 = intervention.rate_mps2 or RATE_MPS2[intervention.kind]
        lowest = min(vehicle.speed, 0.0)  # a vehicle that rolls backwards is not stopped
        self._target_mps = float(np.clip(vehicle.speed + intervention.sign * change_mps, lowest, vehicle.MAX_SPEED))
        self._given: dict[str, Any] | None = None
        self._put: dict[str, Any] | None = None
        if intervention.at_once:
            vehicle.speed = self._target_mps

    def before(self) -> None:
        """Gives the driver its own last action back: a policy's is kept over several frames."""
        super().before()
        self._give_back()

    def after(self) -> None:
        """Replaces the acceleration: braking bounds the driver's speed, accelerating overrides it while there is room.

        A driver may always brake harder than asked.
        """
        super().after()
        self._given = self.vehicle.action
        wished = (self._target_mps - self.vehicle.speed) / self.dt_s
        wished = float(np.clip(wished, -self._rate_mps2, self._rate_mps2))
        own = float(self._given["acceleration"])
        if self.intervention.kind == "brake":
            chosen = min(own, wished)
        else:
            chosen = wished if self._has_room() else own
        self._put = self.vehicle.action = {**self._given, "acceleration": chosen}

    def end(self) -> bool:
        self._give_back()
        return super().end()

    def _give_back(self) -> None:
        if self._given is not None and self.vehicle.action is self._put:
            self.vehicle.action = self._given

    def _has_room(self) -> bool:
        front, _ = self.road.neighbour_vehicles(self.vehicle)
        if front is None:
            return True
        gap_m = abs(float(self.vehicle.lane_distance_to(front))) - self.vehicle.LENGTH
        closing_mps = max(float(self.vehicle.speed - front.velocity @ self.vehicle.direction), 0.0)
        return gap_m > TIME_GAP_S * self.vehicle.speed + closing_mps**2 / (2 * BRAKING_MPS2)


class _LaneChange(_Override):
    def __init__(self, vehicle: Any, intervention: Intervention, env: AbstractEnv) -> None:
        super().__init__(vehicle, intervention, env)
        name, side = f"agent {intervention.agent}", intervention.kind
        if not isinstance(vehicle, ControlledVehicle):
            raise NotAllowedError(
                f"{name} is steered by its policy itself and cannot be sent to another lane; brake it"
            )
        start, end, lane = vehicle.target_lane_index
        aside = (start, end, -1 if lane is None else lane + (1 if side == "right" else -1))
        lanes = vehicle.road.network.graph[start][end]
        inside = 0 <= aside[2] < len(lanes)
        if not inside or not vehicle.road.network.get_lane(aside).is_reachable_from(vehicle.position):
            raise NotAllowedError(f"{name} has no lane on its {side}; choose the other side, or another agent")
        self._aside = aside

    def begin(self) -> None:
        super().begin()
        self._lane = self.vehicle.target_lane_index = self._aside


class _Absence(_Override):
    def begin(self) -> None:
        """Takes the vehicle out of the road's list; its driver goes on and sees the others."""
        self._place = self.road.vehicles.index(self.vehicle)
        self.road.vehicles.remove(self.vehicle)

    def before(self) -> None:
        """Does nothing: the vehicle drives as it likes."""

    def after(self) -> None:
        """Lets the vehicle drive on unseen."""
        self.vehicle.act()
        self.vehicle.step(self.dt_s)

    def can_end(self) -> bool:
        """Returns whether the vehicle's place is free."""
        return all(self._leaves_room(other) for other in [*self.road.vehicles, *self.road.objects])

    def end(self) -> bool:
        """Puts the vehicle back if its place is free."""
        if not self.can_end():
            return False
        self.road.vehicles.insert(min(self._place, len(self.road.vehicles)), self.vehicle)
        return True

    def _leaves_room(self, other: Any) -> bool:
        if np.linalg.norm(other.position - self.vehicle.position) < self.vehicle.LENGTH:
            return False
        lane = self.vehicle.lane
        own_m, _ = lane.local_coordinates(self.vehicle.position)
        along_m, aside_m = lane.local_coordinates(other.position)
        if not lane.on_lane(other.position, along_m, aside_m, margin=1):
            return True
        behind_mps = self.vehicle.speed if along_m > own_m else other.speed
        return bool(abs(along_m - own_m) > 2 * self.vehicle.LENGTH + RETURN_GAP_S * max(behind_mps, 0.0))
