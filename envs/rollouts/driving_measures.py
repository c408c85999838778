"""Measures how a single ego of highway-env drives: the simulator is read once after each policy step.

Accelerations are differences of the ego's speed over a policy step, and jerk is the difference of two of these, so
environments with policy steps of different length cannot be compared. What the simulator does to vehicles that have
collided is no driving: a step that ends with a crash of the ego has no acceleration, and its time to contact is 0.
"""

from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from highway_env.vehicle.kinematics import Vehicle

from envs.readers.base import policy_step_s
from envs.readers.highway import is_highway_env, vehicles_of
from envs.rollouts.time_to_contact import times_to_contact

LONGEST_S = 10.0
"""Largest time to contact [s]; later contacts, and none at all, count as this. Critical ones take a few seconds at
most."""
LOW_QUANTILE = 0.05
"""Quantile of the steps' times to contact that is reported beside the minimum."""
HARD_BRAKING_MPS2 = 3.0
"""Deceleration from which on braking is hard [m/s²]: above what drivers need for a stop that they expect, where the
deceleration peaks at about 0.25 g = 2.5 m/s² (Roenitz et al., SAE 1999-01-0098)."""


@dataclass(frozen=True)
class DrivingMeasures:
    """Measures of one episode."""

    time_s: float
    """Simulated time [s]."""
    off_road_share: float
    """Share of steps after which the ego's centre is beyond the borders of its nearest lane, as highway-env tells."""
    lane_changes: int
    """Number of steps after which the ego's nearest lane is another one that is not the continuation of the former."""
    min_time_to_contact_s: float
    """Smallest time to contact with another vehicle after a step [s], at most `LONGEST_S`; 0 with a crash."""
    low_time_to_contact_s: float
    """5 % quantile of the times to contact over the steps [s]."""
    hard_brake_share: float | None
    """Share of steps whose mean deceleration is above `HARD_BRAKING_MPS2`; None without a step before a crash."""
    jerk_rms_mps3: float | None
    """Root mean square of the jerk along the ego's direction [m/s³]; None with less than two steps before a crash."""


class DrivingRecorder:
    """Records the ego of a highway-env environment during one episode after the other.

    Args:
        env: the environment.
    """

    def __init__(self, env: gym.Env) -> None:
        """Reads the length of a policy step."""
        self._env = env

    def begin(self) -> None:
        """Starts an episode; called after the reset."""
        ego = self._ego
        self._dt_s = policy_step_s(self._env.unwrapped.config)  # type: ignore[attr-defined]
        self._speeds_mps = [float(ego.speed)]
        self._lane = ego.lane_index
        self._lane_changes = 0
        self._off_road: list[bool] = []
        self._contacts_s: list[float] = []

    def note(self) -> None:
        """Records the state after a policy step."""
        ego = self._ego
        self._off_road.append(not ego.on_road)
        self._lane_changes += is_lane_change(ego.road.network, self._lane, ego.lane_index)
        self._lane = ego.lane_index
        self._contacts_s.append(0.0 if ego.crashed else min(LONGEST_S, next_contact_s(vehicles_of(self._env))))
        if not ego.crashed:
            self._speeds_mps.append(float(ego.speed))

    def measures(self) -> DrivingMeasures:
        """Returns the measures of the episode so far, which has at least one step."""
        accelerations = np.diff(self._speeds_mps) / self._dt_s
        braking = -np.diff(np.abs(self._speeds_mps)) / self._dt_s  # also of a car that drives backwards
        jerks = np.diff(accelerations) / self._dt_s
        return DrivingMeasures(
            len(self._off_road) * self._dt_s,
            float(np.mean(self._off_road)),
            self._lane_changes,
            min(self._contacts_s),
            float(np.quantile(self._contacts_s, LOW_QUANTILE)),
            float(np.mean(braking > HARD_BRAKING_MPS2)) if len(accelerations) else None,
            float(np.sqrt(np.mean(jerks**2))) if len(jerks) else None,
        )

    @property
    def _ego(self) -> Any:
        return self._env.unwrapped.vehicle  # type: ignore[attr-defined]


def recorder_for(env: gym.Env) -> DrivingRecorder | None:
    """Returns a recorder; None for environments that are not highway-env's, or that have several egos."""
    if not is_highway_env(env) or len(env.unwrapped.controlled_vehicles) != 1:  # type: ignore[attr-defined]
        return None
    return DrivingRecorder(env)


def next_contact_s(vehicles: list[Vehicle]) -> float:
    """Returns the time to the first contact of the first vehicle with another one [s]; infinity if there is none.

    Every vehicle is a rectangle of its own size that keeps its velocity and heading.
    """
    if len(vehicles) < 2:
        return float("inf")
    positions_m = np.array([v.position for v in vehicles], dtype=np.float64)
    speeds_mps = np.array([v.speed for v in vehicles], dtype=np.float64)
    headings_rad = np.array([v.heading for v in vehicles], dtype=np.float64)
    sizes_m = np.array([(v.LENGTH, v.WIDTH) for v in vehicles], dtype=np.float64)
    velocities_mps = speeds_mps[:, None] * np.stack([np.cos(headings_rad), np.sin(headings_rad)], axis=-1)
    times_s = times_to_contact(
        positions_m[1:] - positions_m[0],
        velocities_mps[1:] - velocities_mps[0],
        float(headings_rad[0]),
        headings_rad[1:],
        sizes_m[0],
        sizes_m[1:],
    )
    return float(times_s.min())


def is_lane_change(network: Any, before: tuple[str, str, int], now: tuple[str, str, int]) -> bool:
    """Returns whether a vehicle left its lane sideways between two lanes, given by their indices.

    Lanes of one segment of the road are side by side. From one segment to the next, a lane is continued by the one that
    begins where it ends. Between segments that do not follow each other no change is counted.

    Args:
        network: the road network.
        before: start, end and number of the lane of the step before.
        now: those of the present lane.
    """
    if before[:2] == now[:2]:
        return before[2] != now[2]
    if before[1] != now[0]:
        return False
    old, new = network.get_lane(before), network.get_lane(now)
    gap_m = np.hypot(*(np.asarray(new.position(0, 0)) - np.asarray(old.position(old.length, 0))))
    return bool(gap_m > new.width_at(0) / 2)
