"""Driving scenarios with mixed drivers, as gymnasium ids: a driver's traits can be inferred from its past motion.

Each driver of these environments has traits of its own (a law of driving, a wished speed, a time gap, ...), drawn from
the environment's generator and constant during the episode. No observation shows them; labels do
(`envs.readers.highway_labels`). Otherwise they are highway-env's environments, read, wrapped and drawn like those.
Importing this module registers the ids; a process that has not imported it makes them by
`gym.make("envs.simulators.mixed_traffic:highway-mixed-v0")`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, ClassVar, Literal

import gymnasium as gym
import numpy as np
from highway_env.envs.common.abstract import AbstractEnv
from highway_env.envs.highway_env import HighwayEnvFast
from highway_env.envs.intersection_env import ConnectedLaneIntersectionEnv
from highway_env.envs.merge_env import ConnectedLaneMergeGenericEnv
from highway_env.envs.roundabout_env import ConnectedLaneRoundaboutGenericEnv
from highway_env.vehicle.behavior import AggressiveVehicle, DefensiveVehicle, IDMVehicle, LinearVehicle
from highway_env.vehicle.controller import ControlledVehicle

from predictor.support.errors import UserError

DriverKind = Literal["idm", "aggressive", "defensive"]
DRIVER_KINDS: tuple[DriverKind, ...] = ("idm", "aggressive", "defensive")
"""The intelligent driver model, and highway-env's two linear laws; a label holds the index in this tuple."""
Range = tuple[float, float]
"""Bounds of a uniform distribution."""
_MAY_BE_ZERO = ("jam_gap_m", "politeness", "lane_change_gain_mps2")


@dataclass(frozen=True)
class Traits:
    """Traits of one driver, which no observation shows."""

    kind: DriverKind
    """Law of acceleration: IDM, or linear with the weights of `AggressiveVehicle` or `DefensiveVehicle`."""
    speed_factor: float
    """Wished speed over the one that the road asks for (the lane's limit)."""
    time_gap_s: float
    """Wished time gap to the leader (`TIME_WANTED`)."""
    jam_gap_m: float
    """Wished distance to a leader at rest, bumper to bumper (`DISTANCE_WANTED` counts one length more)."""
    acceleration_mps2: float
    """IDM's acceleration at rest on a free road (`COMFORT_ACC_MAX`)."""
    braking_mps2: float
    """Comfortable deceleration of IDM, positive (`-COMFORT_ACC_MIN`)."""
    exponent: float
    """IDM's exponent of acceleration (`DELTA`); larger accelerates longer up to the wished speed."""
    politeness: float
    """Weight of the others' loss of acceleration in a lane change (MOBIL's `POLITENESS`)."""
    lane_change_gain_mps2: float
    """Acceleration that a change of lane must gain (`LANE_CHANGE_MIN_ACC_GAIN`)."""


@dataclass(frozen=True)
class KindMix:
    """Drivers of one kind."""

    share: float
    """Probability of this kind."""
    speed_factor: Range
    """Range of `Traits.speed_factor`."""
    time_gap_s: Range
    """Range of `Traits.time_gap_s`."""


@dataclass(frozen=True)
class DriverMix:
    """Distribution of traits; docs/datasets/mixed.md has the sources."""

    idm: KindMix = KindMix(1 / 3, speed_factor=(0.55, 1.0), time_gap_s=(0.8, 2.4))
    """IDM drivers; they keep to the lane's limit, so a factor above 1 would have no effect."""
    aggressive: KindMix = KindMix(1 / 3, speed_factor=(0.8, 1.1), time_gap_s=(1.2, 2.0))
    """Linear drivers with weak reactions; fast, at short gaps."""
    defensive: KindMix = KindMix(1 / 3, speed_factor=(0.55, 0.9), time_gap_s=(1.8, 2.8))
    """Linear drivers with strong reactions; slow, at long gaps."""
    jam_gap_m: Range = (1.5, 4.0)
    """Range for all kinds."""
    acceleration_mps2: Range = (0.4, 1.5)
    """Range for all kinds; linear drivers use it where they yield and in lane changes."""
    braking_mps2: Range = (1.5, 3.0)
    """Range for all kinds; linear drivers use it where they yield and in lane changes."""
    exponent: Range = (3.5, 4.5)
    """Range for all kinds, used as `acceleration_mps2`."""
    politeness: Range = (0.0, 1.0)
    """Range for all kinds."""
    lane_change_gain_mps2: Range = (0.1, 1.0)
    """Range for all kinds."""

    def __post_init__(self) -> None:
        """Checks shares and ranges.

        Raises:
            UserError: shares that do not sum to 1, or a range that is not positive or the wrong way round.
        """
        shares = [self.of(kind).share for kind in DRIVER_KINDS]
        if min(shares) < 0 or abs(sum(shares) - 1) > 1e-9:
            raise UserError(f"shares of driver kinds must not be negative and must sum to 1, got {shares}")
        ranges = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in DRIVER_KINDS}
        for kind in DRIVER_KINDS:
            for name in ("speed_factor", "time_gap_s"):
                ranges[f"{kind}.{name}"] = getattr(self.of(kind), name)
        for name, (low, high) in ranges.items():
            if not 0 <= low <= high or low == 0 and name not in _MAY_BE_ZERO:
                least = "0 <= low" if name in _MAY_BE_ZERO else "0 < low"
                raise UserError(f"{name} needs {least} <= high, got ({low:g}, {high:g})")

    def of(self, kind: DriverKind) -> KindMix:
        """Returns the drivers of a kind."""
        found: KindMix = getattr(self, kind)
        return found

    def draw(self, rng: np.random.Generator) -> Traits:
        """Draws one driver; every kind takes equally many numbers from the generator."""
        kind = DRIVER_KINDS[int(rng.choice(len(DRIVER_KINDS), p=[self.of(kind).share for kind in DRIVER_KINDS]))]
        own = self.of(kind)
        return Traits(
            kind,
            speed_factor=rng.uniform(*own.speed_factor),
            time_gap_s=rng.uniform(*own.time_gap_s),
            jam_gap_m=rng.uniform(*self.jam_gap_m),
            acceleration_mps2=rng.uniform(*self.acceleration_mps2),
            braking_mps2=rng.uniform(*self.braking_mps2),
            exponent=rng.uniform(*self.exponent),
            politeness=rng.uniform(*self.politeness),
            lane_change_gain_mps2=rng.uniform(*self.lane_change_gain_mps2),
        )


class MixedDriver(LinearVehicle):
    """Driver with traits of its own, in whatever way highway-env creates it.

    All kinds steer alike, with highway-env's lane controller: its linear one reveals no more about a driver. Another
    mix is a subclass with another `mix`, named in the env's config as ``other_vehicles_type``.

    Args:
        road: road that it drives on; its generator draws the traits.
        position: position [m].
        heading: heading [rad].
        speed: speed [m/s].
        target_lane_index: lane that it steers for; None takes the nearest.
        target_speed: speed that the road asks for [m/s]; None takes the limit of its lane.
        route: lanes to follow.
        enable_lane_change: whether it may change lane by its own choice.
        timer: time since it last considered a lane change [s].
        traits: traits of an existing driver; None draws new ones.
    """

    mix: ClassVar[DriverMix] = DriverMix()
    """Distribution of the traits."""

    def __init__(
        self,
        road: Any,
        position: Any,
        heading: float | int = 0,
        speed: float | int = 0,
        target_lane_index: Any = None,
        target_speed: float | int | None = None,
        route: Any = None,
        enable_lane_change: bool = True,
        timer: float | int | None = None,
        traits: Traits | None = None,
    ) -> None:
        """Draws the traits and sets highway-env's parameters by them."""
        self.traits = self.mix.draw(road.np_random) if traits is None else traits
        super().__init__(
            road, position, heading, speed, target_lane_index, target_speed, route, enable_lane_change, timer
        )
        asked_mps = self.lane.speed_limit if target_speed is None else target_speed
        if asked_mps is not None:
            self.target_speed = asked_mps  # also 0, which highway-env reads as None
        self.collecting_data = False  # highway-env would keep a growing list for each linear driver
        # On the instance: intersection environments write over constants of the class.
        self.TIME_WANTED = self.traits.time_gap_s
        self.DISTANCE_WANTED = self.LENGTH + self.traits.jam_gap_m
        self.COMFORT_ACC_MAX = self.traits.acceleration_mps2
        self.COMFORT_ACC_MIN = -self.traits.braking_mps2
        self.DELTA = self.traits.exponent
        self.POLITENESS = self.traits.politeness
        self.LANE_CHANGE_MIN_ACC_GAIN = self.traits.lane_change_gain_mps2
        if self.traits.kind != "idm":
            law = AggressiveVehicle if self.traits.kind == "aggressive" else DefensiveVehicle
            self.ACCELERATION_PARAMETERS = law.ACCELERATION_PARAMETERS

    @property
    def target_speed(self) -> float:
        """Wished speed [m/s]; set it to the speed that the road asks for, which the driver's factor scales."""
        return self.traits.speed_factor * self._asked_mps

    @target_speed.setter
    def target_speed(self, asked_mps: float | int) -> None:
        self._asked_mps = asked_mps

    @classmethod
    def create_from(cls, vehicle: ControlledVehicle) -> "MixedDriver":
        """Returns a copy of the driver; for another class of vehicle, a new driver at that vehicle's place."""
        same = isinstance(vehicle, MixedDriver)
        return cls(
            vehicle.road,
            vehicle.position,
            vehicle.heading,
            vehicle.speed,
            vehicle.target_lane_index,
            vehicle._asked_mps if same else vehicle.target_speed,
            vehicle.route,
            getattr(vehicle, "enable_lane_change", True),
            getattr(vehicle, "timer", None),
            vehicle.traits if same else None,
        )

    def randomize_behavior(self) -> None:
        """Does nothing: the traits are drawn already, and only some environments call this."""

    def acceleration(self, ego_vehicle: Any, front_vehicle: Any = None, rear_vehicle: Any = None) -> float:
        """Returns the acceleration [m/s²] of this driver in place of `ego_vehicle`, by IDM's law while it yields."""
        # A linear driver that has to yield at a crossing would drive on into it.
        by_idm = self.traits.kind == "idm" or getattr(self, "is_yielding", False)
        law = IDMVehicle if by_idm else LinearVehicle
        return float(law.acceleration(self, ego_vehicle, front_vehicle, rear_vehicle))

    def steering_control(self, target_lane_index: Any) -> float:
        """Returns the steering angle [rad] towards the middle of a lane."""
        return float(ControlledVehicle.steering_control(self, target_lane_index))


class _Mixed(AbstractEnv):
    changes: ClassVar[dict[str, Any]] = {}

    @classmethod
    def default_config(cls) -> dict[str, Any]:
        """Returns the base's config with mixed drivers."""
        drivers = f"{MixedDriver.__module__}.{MixedDriver.__qualname__}"
        return {**super().default_config(), "other_vehicles_type": drivers, **cls.changes}


class MixedHighwayEnv(_Mixed, HighwayEnvFast):
    """highway-fast-v0 among mixed drivers, which start at about equal speeds and change to their wished ones."""


class MixedMergeEnv(_Mixed, ConnectedLaneMergeGenericEnv):
    """merge-generic-v1 among more, mixed drivers."""

    changes = {"vehicles_count": 8}

    def _is_terminated(self) -> bool:
        return bool(super()._is_terminated())  # NumPy's there, which Stable-Baselines3's checker refuses


class MixedRoundaboutEnv(_Mixed, ConnectedLaneRoundaboutGenericEnv):
    """roundabout-generic-v1 among mixed drivers."""

    SPEED_LIMIT_MPS: ClassVar[float] = 14.0
    """Speed at which highway-env starts its drivers; at the lanes' default limit of 20 m/s the lateral acceleration
    would be twice gravity here."""

    def _make_road(self) -> None:
        super()._make_road()
        for lane in self.road.network.lanes_list():
            lane.speed_limit = self.SPEED_LIMIT_MPS


class MixedIntersectionEnv(_Mixed, ConnectedLaneIntersectionEnv):
    """intersection-v2 among mixed drivers."""


BASE_ID = {
    "highway-mixed-v0": "highway-fast-v0",
    "merge-mixed-v0": "merge-generic-v1",
    "roundabout-mixed-v0": "roundabout-generic-v1",
    "intersection-mixed-v0": "intersection-v2",
}
"""Id defined here → the id of highway-env that it varies."""
_CLASSES: Mapping[str, type[AbstractEnv]] = {
    "highway-mixed-v0": MixedHighwayEnv,
    "merge-mixed-v0": MixedMergeEnv,
    "roundabout-mixed-v0": MixedRoundaboutEnv,
    "intersection-mixed-v0": MixedIntersectionEnv,
}


def register_scenarios(classes: Mapping[str, type[AbstractEnv]] = _CLASSES) -> None:
    """Registers ids with gymnasium; may be called again."""
    for env_id, env_class in classes.items():
        if env_id not in gym.registry:
            gym.register(env_id, entry_point=f"{env_class.__module__}:{env_class.__qualname__}")


register_scenarios()
